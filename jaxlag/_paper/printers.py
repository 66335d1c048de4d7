"""Formulas set as in a textbook, in Unicode and in LaTeX: parameters before coordinates before velocities, ẍ behind its factor."""

import re
import unicodedata
from collections.abc import Iterable, Sequence
from typing import Any, ClassVar

import sympy
from sympy import Abs, Expr, Mul, Rational, Symbol
from sympy.core.function import Function
from sympy.functions.elementary.trigonometric import TrigonometricFunction
from sympy.printing.conventions import split_super_sub
from sympy.printing.latex import LatexPrinter, translate
from sympy.printing.pretty.pretty_symbology import greek_unicode, sub
from sympy.printing.printer import Printer
from sympy.printing.str import StrPrinter

from .derivation import Statement

PARAMETER, MULTIPLIER, POSITION, VELOCITY, ACCELERATION = range(5)


class Notation:
    """What symbols mean: of which kind each is, which comes first, and which letter has how many dots."""

    def __init__(self, s: Statement, parameters: Iterable[Symbol]):
        kinds = tuple(parameters), s.multipliers, (s.t, *s.q), s.qdot, s.qddot
        self.kind = {symbol: kind for kind, symbols in enumerate(kinds) for symbol in symbols}
        self.place = {symbol: i for i, symbol in enumerate(self.kind)}
        self.dotted = {y: (x.name, dots) for dots, ys in ((1, s.qdot), (2, s.qddot)) for x, y in zip(s.q, ys, strict=True)}

    def highest(self, formula: Expr) -> int:
        """The highest kind among the symbols of a formula; −1 for a number."""
        return max((self.kind.get(symbol, PARAMETER) for symbol in formula.free_symbols), default=-1)

    def places(self, formula: Expr, kind: int) -> list[int]:
        """Where its symbols of a kind stand."""
        return sorted(self.place.get(x, -1) for x in formula.free_symbols if self.kind.get(x, PARAMETER) == kind)

    def in_order(self, formula: Expr) -> list[Expr]:
        """The terms of a sum: accelerations, velocities, positions, parameters, and bare symbols first."""

        def order(term):
            kind, factors = self.highest(term), [factor for factor in Mul.make_args(term) if not factor.is_number]
            places = self.places(term, kind), self.places(term, PARAMETER)
            return -kind, kind != ACCELERATION and not (len(factors) == 1 and factors[0].is_Symbol), places, sympy.default_sort_key(term)

        return sorted(sympy.Add.make_args(formula), key=order)

    def terms(self, formula: Expr) -> list[Expr]:
        """The terms of a sum in order, but the first one positive where one is."""
        terms = self.in_order(formula)
        if terms[-1].is_number and any(_is_below(factor) for term in terms for factor in Mul.make_args(term)):
            terms = [terms[-1], *terms[:-1]]  # 1 + l/r, but x + 1
        first = next((term for term in terms if not _is_negative(term)), terms[0])
        return terms if self.highest(terms[0]) == ACCELERATION else [first, *(term for term in terms if term is not first)]

    def factors(self, factors: Iterable[Expr]) -> list[Expr]:
        """Factors as they stand in a product: numbers, parameters, positions, velocities, accelerations, and functions behind them all."""

        def order(factor):
            base, kind = factor.as_base_exp()[0], self.highest(factor)
            if kind == PARAMETER and base.is_Add:
                place = -0.5  # (m₁ + m₂) g
            elif isinstance(base, Function) and not isinstance(base, Abs):
                place = 10
            else:
                place = kind + 0.2 * isinstance(base, Abs) + 0.4 * base.is_Add  # k |ẋ + v| (ẋ + v)
            return place, self.places(factor, kind), sympy.default_sort_key(factor)

        return sorted(factors, key=order)


def _is_negative(term: Expr) -> bool:
    return bool(term.as_coeff_Mul()[0].is_negative)


def _is_decimal(number: Expr) -> bool:
    """Whether a fraction is better written with a point, as 9.81 is."""
    return number.is_Rational and number.q > 10 and number.q % 5 == 0 and 10**6 % number.q == 0


class Textbook(Printer):
    """What both ways of writing share: sums, products, powers and symbols."""

    minus = "-"

    def __init__(self, notation: Notation, **settings: Any):
        super().__init__(settings)
        self.notation = notation

    def fraction(self, above: Sequence[Expr], below: Sequence[Expr], is_followed: bool) -> str:
        """Factors over factors; `is_followed` by others."""
        raise NotImplementedError

    def bracketed(self, text: str) -> str:
        """In brackets."""
        raise NotImplementedError

    def raised(self, base: str, exponent: Expr) -> str:
        """A power."""
        raise NotImplementedError

    def letter(self, name: str, dots: int) -> str:
        """A symbol with its dots, and what follows it below."""
        raise NotImplementedError

    def _print_Symbol(self, symbol: Symbol, style: Any = None) -> str:
        return self.letter(*self.notation.dotted.get(symbol, (symbol.name, 0)))

    def _print_Add(self, formula: Expr, order: Any = None) -> str:
        first, *others = self.notation.terms(formula)
        signs = [(self.minus, -term) if _is_negative(term) else ("+", term) for term in others]
        return "".join([self.factor(first), *(f" {sign} {self.factor(term)}" for sign, term in signs)])

    def _print_Mul(self, formula: Expr) -> str:
        number, factors = formula.as_coeff_mul()
        return self.minus + self._product(-number, factors) if number.is_negative else self._product(number, factors)

    def _print_Pow(self, formula: Expr) -> str:
        base, exponent = formula.as_base_exp()
        if _is_below(formula):
            return self._product(sympy.Integer(1), [formula])
        if exponent == Rational(1, 2):
            return self._print_root(base)
        if base.is_Add and exponent.is_even and _is_negative(self.notation.in_order(base)[0]):
            base = -base
        return self.raised(self._print(base) if base.is_Symbol or isinstance(base, Abs) else self.bracketed(self._print(base)), exponent)

    def _print_Rational(self, number: Expr) -> str:
        if _is_decimal(number):
            return self._print(sympy.Float(number, 15))
        return (self.minus if number < 0 else "") + self._product(abs(number), [])

    def _print_Integer(self, number: Expr) -> str:
        return str(number).replace("-", self.minus)

    def _print_Float(self, number: Expr) -> str:
        return f"{float(number):.15g}"

    def _product(self, number: Expr, factors: Sequence[Expr]) -> str:
        """A positive number times factors: one fraction, of parameters alone where only they are below."""
        factors = _sizes_joined(factors)
        below = [1 / factor for factor in factors if _is_below(factor)]
        above = [factor for factor in factors if not _is_below(factor)]
        up, down = (number, sympy.Integer(1)) if number.is_Float or _is_decimal(number) else number.as_numer_denom()
        fixed = [factor for factor in above if self.notation.highest(factor) <= PARAMETER]
        is_fixed = all(self.notation.highest(factor) <= PARAMETER for factor in below) and (fixed or up != 1)
        inside = [] if not below else fixed if is_fixed else above
        rest = self.notation.factors(factor for factor in above if factor not in inside)
        above, below = ([*([x] if x != 1 else []), *self.notation.factors(part)] for x, part in ((up, inside), (down, below)))
        lead = self.fraction(above or [up], below, bool(rest)) if below else " ".join(map(self.factor, above))
        return " ".join(filter(None, [lead, *map(self.factor, rest)])) or "1"

    def factor(self, factor: Expr) -> str:
        """A factor among others, in brackets where it is a sum."""
        text = self._print(factor)
        return self.bracketed(text) if factor.is_Add or isinstance(factor, sympy.Piecewise) else text


def _is_below(factor: Expr) -> bool:
    return _is_negative(factor.as_base_exp()[1]) and not isinstance(factor, sympy.exp)


def _sizes_joined(factors: Sequence[Expr]) -> list[Expr]:
    """With |u|³ in place of u² |u|."""
    out = list(factors)
    for size in [factor for factor in factors if isinstance(factor, Abs)]:
        for factor in factors:
            base, exponent = factor.as_base_exp()
            if base == size.args[0] and exponent.is_Integer and exponent > 0 and exponent % 2 == 0:
                out = [x for x in out if x not in (size, factor)] + [sympy.Pow(size, exponent + 1, evaluate=False)]
    return out


def _is_bare(formula: Expr) -> bool:
    """Whether it is a function that is written without brackets: sin φ."""
    return isinstance(formula, TrigonometricFunction) and formula.args[0].is_Symbol


def _parts(name: str) -> tuple[str, list[str]]:
    """The letter of a name, and what stands below it."""
    letter, above, below = split_super_sub(name)
    return letter, [*above, *below]


class Unicode(Textbook, StrPrinter):
    """One line of text."""

    minus = "−"
    FRACTIONS: ClassVar = {
        Rational(*pair): sign for *pair, sign in ((1, 2, "½"), (1, 3, "⅓"), (2, 3, "⅔"), (1, 4, "¼"), (3, 4, "¾"), (1, 8, "⅛"))
    }
    RAISED = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
    NAMES: ClassVar = {"asin": "arcsin", "acos": "arccos", "atan": "arctan", "log": "ln", "Max": "max", "Min": "min", "ceiling": "ceil"}

    def fraction(self, above, below, is_followed):
        """(g/l) sin φ, and ½ where there is such a character."""
        whole = Mul(*above, *(1 / factor for factor in below)) if all(x.is_Rational for x in (*above, *below)) else None
        if whole in self.FRACTIONS:
            return self.FRACTIONS[whole]
        up, down = (" ".join(map(self.factor, factors)) for factors in (above, below))
        if _is_bare(above[-1].as_base_exp()[0]):
            up = self.bracketed(up)  # sin φ/r were the sine of φ/r
        text = f"{up}/{self.bracketed(down) if len(below) > 1 else down}"
        return self.bracketed(text) if is_followed else text

    def bracketed(self, text):
        """In round brackets."""
        return f"({text})"

    def raised(self, base, exponent):
        """x², x^(3/2)."""
        if exponent.is_Integer:
            return base + str(exponent).translate(self.RAISED)
        return f"{base}^{self._print(exponent) if exponent.is_Symbol else self.bracketed(self._print(exponent))}"

    def letter(self, name, dots):
        """ẍ₂, Θₛ; a word has its dots behind it: wheel˙."""
        letter, below = _parts(name)
        letter = greek_unicode.get(letter, letter)
        if len(letter) > 1:
            return self.letter(name, 0) + ["", "˙", "¨"][dots] if dots else letter + self._lowered(below)
        return unicodedata.normalize("NFC", letter + ["", "\u0307", "\u0308"][dots]) + self._lowered(below)

    def _lowered(self, below):
        has_small = all(character in sub for part in below for character in part) and all(len(p) == 1 or p.isdigit() for p in below)
        return "".join(sub[character] for part in below for character in part) if has_small else f"_{','.join(below)}"

    def _print_root(self, base):
        return f"√{self._print(base) if base.is_Symbol or base.is_Integer else self.bracketed(self._print(base))}"

    def _print_Abs(self, formula):
        return f"|{self._print(formula.args[0])}|"

    def _print_Function(self, formula, raised=""):
        name = self.NAMES.get(formula.func.__name__, formula.func.__name__)
        arguments = ", ".join(map(self._print, formula.args))
        return f"{name}{raised} {arguments}" if _is_bare(formula) else f"{name}{raised}({arguments})"

    _print_LatticeOp = _print_Function

    def _print_Pow(self, formula):
        base, exponent = formula.as_base_exp()
        if isinstance(base, TrigonometricFunction) and exponent.is_Integer and exponent > 0:
            return self._print_Function(base, self.raised("", exponent))
        return super()._print_Pow(formula)

    def _print_Pi(self, formula):
        return "π"

    def _print_Piecewise(self, formula):
        when = lambda condition: "otherwise" if condition is sympy.true else f"if {self._print(condition)}"
        return "; ".join(f"{self._print(case)} {when(condition)}" for case, condition in formula.args)

    def partial(self, name: str, symbol: Symbol) -> str:
        """∂L/∂φ̇."""
        return f"∂{name}/∂{self._print(symbol)}"

    def in_time(self, text: str) -> str:
        """d/dt of it."""
        return f"d/dt {text}"

    def indexed(self, name: str, symbol: Symbol) -> str:
        """Q_φ."""
        return f"{name}_{self._print(symbol)}"

    def reaction(self, symbol: Symbol) -> str:
        """(Gᵀλ)_φ."""
        return f"(Gᵀλ)_{self._print(symbol)}"


class Latex(Textbook, LatexPrinter):
    """LaTeX, as much of it as mathtext knows."""

    LETTERS: ClassVar = {"phi": r"\varphi", "epsilon": r"\varepsilon"}

    def __init__(self, notation: Notation):
        super().__init__(notation, fold_func_brackets=True, inv_trig_style="full")

    def _needs_function_brackets(self, formula):
        return not formula.is_Symbol

    def _print_Float(self, number):
        significand, *power = super()._print_Float(number).split("e")
        return rf"{significand} \cdot 10^{{{int(power[0])}}}" if power else significand

    def fraction(self, above, below, is_followed):
        """One below the other, so without brackets."""
        up, down = (" ".join(map(self.factor, part)) if len(part) > 1 else self._print(part[0]) for part in (above, below))
        return rf"\frac{{{up}}}{{{down}}}"

    def bracketed(self, text):
        """In round brackets of the right size."""
        return rf"\left({text}\right)"

    def raised(self, base, exponent):
        """x^{2}, x^{3/2}."""
        return f"{base}^{{{exponent if exponent.is_Rational else self._print(exponent)}}}"

    def letter(self, name, dots):
        r"""\ddot{x}_{2}, \Theta_{s}."""
        letter, below = _parts(name)
        letter = self.LETTERS.get(letter, translate(letter))
        letter = letter if len(letter) == 1 or letter.startswith("\\") else rf"\mathrm{{{letter}}}"
        is_word = lambda part: re.match(r"[^\W\d_]{2}", part) and translate(part) == part
        small = [rf"\mathrm{{{part}}}" if is_word(part) else translate(part) for part in below]
        return ["{}", r"\dot{{{}}}", r"\ddot{{{}}}"][dots].format(letter) + (f"_{{{','.join(small)}}}" if below else "")

    def _print_root(self, base):
        return rf"\sqrt{{{self._print(base)}}}"

    def _print_Pow(self, formula):
        base, exponent = formula.as_base_exp()
        if isinstance(base, TrigonometricFunction) and exponent.is_Integer and exponent > 0:
            return LatexPrinter._print_Pow(self, formula)
        return Textbook._print_Pow(self, formula)

    def partial(self, name: str, symbol: Symbol) -> str:
        r"""\partial L / \partial \dot\varphi."""
        return rf"\frac{{\partial {name}}}{{\partial {self._print(symbol)}}}"

    def in_time(self, text: str) -> str:
        r"""d/dt of it."""
        return rf"\frac{{d}}{{dt}} {text}"

    def indexed(self, name: str, symbol: Symbol) -> str:
        r"""Q_{\varphi}."""
        return f"{name}_{{{self._print(symbol)}}}"

    def reaction(self, symbol: Symbol) -> str:
        r"""(G^T\lambda)_{\varphi}."""
        return rf"(G^{{T}} \lambda)_{{{self._print(symbol)}}}"
