"""Derivatives of formulas with nonsmooth terms: |u|, sign, floor, ceiling, min and max."""

import sympy
from sympy import Expr, Symbol


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
