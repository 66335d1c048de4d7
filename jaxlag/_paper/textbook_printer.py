"""The common part of plain text and LaTeX: sums, products, powers and symbols as in a textbook."""

from collections.abc import Sequence
from typing import Any

import sympy
from sympy import Abs, Expr, Rational, Symbol
from sympy.printing.conventions import split_super_sub
from sympy.printing.printer import Printer

from .notation import PARAMETER, Notation, is_decimal, is_in_denominator, is_negative


class Textbook(Printer):
    """An abstract printer: parameters before coordinates before velocities, ẍ after its factor."""

    minus = "-"
    deviation = "δ"  # in front of a small deviation from a value

    def __init__(self, notation: Notation, **settings: Any):
        super().__init__(settings)
        self.notation = notation

    def fraction(self, above: Sequence[Expr], below: Sequence[Expr], is_followed: bool) -> str:
        """Factors over factors, possibly followed by other factors."""
        raise NotImplementedError

    def bracketed(self, text: str) -> str:
        """The text in brackets."""
        raise NotImplementedError

    def power(self, base: str, exponent: Expr) -> str:
        """A power."""
        raise NotImplementedError

    def letter(self, name: str, dots: int) -> str:
        """A symbol with its dots and subscripts."""
        raise NotImplementedError

    def partial(self, name: str, symbol: Symbol) -> str:
        """A partial derivative, ∂L/∂φ̇."""
        raise NotImplementedError

    def time_derivative(self, text: str) -> str:
        """A derivative with respect to time."""
        raise NotImplementedError

    def with_index(self, name: str, symbol: Symbol) -> str:
        """A component, Q_φ."""
        raise NotImplementedError

    def reaction(self, symbol: Symbol) -> str:
        """A component of Gᵀλ."""
        raise NotImplementedError

    def after(self, symbol: Symbol) -> str:
        """A sampled state after its update, or a rate after an impact, u⁺."""
        raise NotImplementedError

    def before(self, symbol: Symbol) -> str:
        """A rate before an impact, ġ⁻."""
        raise NotImplementedError

    def _print_Symbol(self, symbol: Symbol, style: Any = None) -> str:
        name, dots = self.notation.dotted.get(symbol, (symbol.name, 0))
        return self.deviation + self.letter(name[1:], dots) if symbol in self.notation.deviations else self.letter(name, dots)

    def _print_Add(self, formula: Expr, order: Any = None) -> str:
        first, *others = self.notation.terms(formula)
        signs = [(self.minus, -term) if is_negative(term) else ("+", term) for term in others]
        return "".join([self.factor(first), *(f" {sign} {self.factor(term)}" for sign, term in signs)])

    def _print_Mul(self, formula: Expr) -> str:
        number, factors = formula.as_coeff_mul()
        return self.minus + self._product(-number, factors) if number.is_negative else self._product(number, factors)

    def _print_Pow(self, formula: Expr) -> str:
        base, exponent = formula.as_base_exp()
        if is_in_denominator(formula):
            return self._product(sympy.Integer(1), [formula])
        if exponent == Rational(1, 2):
            return self._print_root(base)
        if base.is_Add and exponent.is_even and is_negative(self.notation.in_order(base)[0]):
            base = -base
        return self.power(self._print(base) if base.is_Symbol or isinstance(base, Abs) else self.bracketed(self._print(base)), exponent)

    def _print_Rational(self, number: Expr) -> str:
        if is_decimal(number):
            return self._print(sympy.Float(number, 15))
        return (self.minus if number < 0 else "") + self._product(abs(number), [])

    def _print_Integer(self, number: Expr) -> str:
        return str(number).replace("-", self.minus)

    def _print_Float(self, number: Expr) -> str:
        return f"{float(number):.15g}"

    def _product(self, number: Expr, factors: Sequence[Expr]) -> str:
        """A positive number times factors: one fraction, of parameters alone if the denominator has no other symbols."""
        factors = _merged_abs_powers(factors)
        below = [1 / factor for factor in factors if is_in_denominator(factor)]
        above = [factor for factor in factors if not is_in_denominator(factor)]
        up, down = (number, sympy.Integer(1)) if number.is_Float or is_decimal(number) else number.as_numer_denom()
        fixed = [factor for factor in above if self.notation.highest(factor) <= PARAMETER]
        is_fixed = all(self.notation.highest(factor) <= PARAMETER for factor in below) and (fixed or up != 1)
        inside = [] if not below else fixed if is_fixed else above
        rest = self.notation.factors(factor for factor in above if factor not in inside)
        above, below = ([*([x] if x != 1 else []), *self.notation.factors(part)] for x, part in ((up, inside), (down, below)))
        lead = self.fraction(above or [up], below, bool(rest)) if below else " ".join(map(self.factor, above))
        return " ".join(filter(None, [lead, *map(self.factor, rest)])) or "1"

    def factor(self, factor: Expr) -> str:
        """A factor of a product, in brackets if it is a sum."""
        text = self._print(factor)
        return self.bracketed(text) if factor.is_Add or isinstance(factor, sympy.Piecewise) else text


def _merged_abs_powers(factors: Sequence[Expr]) -> list[Expr]:
    """Factors with |u|³ in place of u² |u|."""
    out = list(factors)
    for abs_ in [factor for factor in factors if isinstance(factor, Abs)]:
        for factor in factors:
            base, exponent = factor.as_base_exp()
            if base == abs_.args[0] and exponent.is_Integer and exponent > 0 and exponent % 2 == 0:
                out = [x for x in out if x not in (abs_, factor)] + [sympy.Pow(abs_, exponent + 1, evaluate=False)]
    return out


NUMBERS = {"pi", "π"}  # names that would be read as a number: they stay words


def split_name(name: str) -> tuple[str, list[str]]:
    """The letter of a name, and its subscripts."""
    letter, above, below = split_super_sub(name)
    return letter, [*above, *below]
