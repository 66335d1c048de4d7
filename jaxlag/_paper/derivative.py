"""Derivatives of formulas with nonsmooth terms: |u|, sign, floor, ceiling, min and max."""

import functools
from collections.abc import Callable

import sympy
from sympy import Abs, Dummy, Expr, Symbol, sign


class _Abs(sympy.Function):
    def fdiff(self, argindex=1):
        return _Sign(self.args[0])


class _PiecewiseConstant(sympy.Function):
    def fdiff(self, argindex=1):
        return sympy.Integer(0)


_Sign, _Floor, _Ceiling = (type(name, (_PiecewiseConstant,), {}) for name in ("_Sign", "_Floor", "_Ceiling"))
NONSMOOTH = {sympy.Abs: _Abs, sympy.sign: _Sign, sympy.floor: _Floor, sympy.ceiling: _Ceiling}


def derivative(formula: Expr, symbol: Symbol) -> Expr:
    """The derivative of a real formula where it is smooth: d|u|/du = sign u, d sign u/du = 0."""
    if symbol not in formula.free_symbols:
        return sympy.Integer(0)
    if not formula.has(*NONSMOOTH, sympy.Max, sympy.Min):
        return formula.diff(symbol)
    for nonsmooth, differentiable in NONSMOOTH.items():
        formula = formula.replace(nonsmooth, differentiable)
    formula = formula.diff(symbol).replace(sympy.Heaviside, lambda u, *_: sympy.Piecewise((1, u > 0), (0, True)))
    for nonsmooth, differentiable in NONSMOOTH.items():
        formula = formula.replace(differentiable, nonsmooth)
    return formula


class Side(Dummy):
    """The side from which a kink is approached, 1 or −1."""


def one_sided(formula: Expr, is_zero: Callable[[Expr], bool]) -> Expr:
    """The formula next to its kinks: |u| as s u and sign u as s, with a `Side` s, where u is zero.

    A term that is smooth there has derivatives without s: |u| u, but not |u|.
    """
    sides: dict[Expr, Side] = {}
    at_kink = lambda e: isinstance(e, (Abs, sign)) and is_zero(e.args[0])
    beside = lambda e: sides.setdefault(e.args[0], Side(real=True)) * (e.args[0] if isinstance(e, Abs) else 1)
    for extremum, s in ((sympy.Max, 1), (sympy.Min, -1)):
        formula = formula.replace(extremum, lambda *parts, s=s: functools.reduce(lambda x, y: (x + y + s * Abs(x - y)) / 2, parts))
    return formula.replace(at_kink, beside)
