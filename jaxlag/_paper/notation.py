"""The order of a textbook: the meaning of symbols, and the order of terms and factors that follows from it."""

from collections.abc import Iterable

import sympy
from sympy import Abs, Expr, Mul, Symbol
from sympy.core.function import Function

from .derivation import SymbolicSystem

PARAMETER, MULTIPLIER, POSITION, VELOCITY, ACCELERATION = range(5)


class Notation:
    """The kind of each symbol, its place among the others, and the dots on its letter."""

    def __init__(self, s: SymbolicSystem, parameters: Iterable[Symbol]):
        kinds = tuple(parameters), s.multipliers, (s.t, *s.q, *s.z, *s.u), (*s.qdot, *s.zdot), s.qddot
        self.kind = {symbol: kind for kind, symbols in enumerate(kinds) for symbol in symbols}
        self.place = {symbol: i for i, symbol in enumerate(self.kind)}
        gaps, rates = ([getattr(contact, name) for contact in s.contacts] for name in ("gap", "rate"))
        derived = (1, s.q, s.qdot), (2, s.q, s.qddot), (1, s.z, s.zdot), (1, gaps, rates)
        self.dotted = {y: (x.name, dots) for dots, xs, ys in derived for x, y in zip(xs, ys, strict=True)}
        self.deviations: frozenset[Symbol] = frozenset()  # symbols of names such as δphi, which are written δφ

    def highest(self, formula: Expr) -> int:
        """The highest kind among the symbols of a formula; −1 for a number."""
        return max((self.kind.get(symbol, PARAMETER) for symbol in formula.free_symbols), default=-1)

    def places(self, formula: Expr, kind: int) -> list[int]:
        """The places of a formula's symbols of one kind."""
        return sorted(self.place.get(x, -1) for x in formula.free_symbols if self.kind.get(x, PARAMETER) == kind)

    def in_order(self, formula: Expr) -> list[Expr]:
        """The terms of a sum: accelerations, velocities, positions, parameters; within each kind, bare symbols first."""

        def order(term):
            kind, factors = self.highest(term), [factor for factor in Mul.make_args(term) if not factor.is_number]
            places = self.places(term, kind), self.places(term, PARAMETER)
            return -kind, kind != ACCELERATION and not (len(factors) == 1 and factors[0].is_Symbol), places, sympy.default_sort_key(term)

        return sorted(sympy.Add.make_args(formula), key=order)

    def terms(self, formula: Expr) -> list[Expr]:
        """The terms of a sum in order, but led by a positive one if there is one."""
        terms = self.in_order(formula)
        if terms[-1].is_number and any(is_in_denominator(factor) for term in terms for factor in Mul.make_args(term)):
            terms = [terms[-1], *terms[:-1]]  # 1 + l/r, but x + 1
        first = next((term for term in terms if not is_negative(term)), terms[0])
        return terms if self.highest(terms[0]) == ACCELERATION else [first, *(term for term in terms if term is not first)]

    def factors(self, factors: Iterable[Expr]) -> list[Expr]:
        """Factors in the order of a product: numbers, parameters, positions, velocities, accelerations, and functions last."""

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


def is_negative(term: Expr) -> bool:
    """Whether a term is written with a minus sign."""
    return bool(term.as_coeff_Mul()[0].is_negative)


def is_decimal(number: Expr) -> bool:
    """Whether a fraction is better written as a decimal, such as 9.81."""
    return number.is_Rational and number.q > 10 and number.q % 5 == 0 and 10**6 % number.q == 0


def is_in_denominator(factor: Expr) -> bool:
    """Whether a factor is a power with a negative exponent."""
    return is_negative(factor.as_base_exp()[1]) and not isinstance(factor, sympy.exp)
