"""Functions of arrays as formulas: jaxprs evaluated over SymPy expressions, with exact numbers.

Imported only when a formula is asked for: SymPy is an extra.
"""

import functools
import itertools
import math
import operator
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import sympy
from jaxtyping import PyTree
from sympy.logic.boolalg import Boolean

from .._program.expressions import Algebra, filled
from .._program.interpreter import evaluate
from .._program.primitives import INTEGRAL
from .._program.walker import is_call_of


def formulas(function: Callable, *arguments: PyTree[np.ndarray]) -> PyTree[np.ndarray]:
    """`function` of pytrees of arrays of expressions or numbers; traced in double precision, regardless of the precision of simulations."""
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, float if x.dtype.kind in "Of" else x.dtype), arguments)
    with jax.enable_x64(True):
        closed, out = jax.make_jaxpr(function, return_shape=True)(*shapes)
        outputs = evaluate(closed, Formulas(), *jax.tree.leaves(arguments))
    return jax.tree.unflatten(jax.tree.structure(out), [_expressions(array) for array in outputs])


def _expressions(array: np.ndarray) -> np.ndarray:
    return array if array.dtype == object else filled(array.shape, map(exact, array.flat))


@functools.lru_cache(maxsize=4096)
def exact(x: Any) -> sympy.Basic:
    """A number as a person would write it: a simple fraction, of 1 or of π, or its root, if the float is the nearest one to it."""
    if x.dtype.kind != "f":
        return sympy.sympify(x.item())
    value, precision = float(x), np.finfo(x.dtype)
    if not math.isfinite(value):
        return sympy.sympify(value)
    if abs(value) <= precision.tiny:  # zero, or a threshold that keeps 0/0 out of a program
        return sympy.Integer(0)
    simple = 1000 if precision.bits == 64 else 100  # few enough that a float is unlikely to be the nearest to one by chance
    near = lambda y: sympy.Rational(*Fraction(y).limit_denominator(simple).as_integer_ratio())
    if x.dtype.type(float(near(value))) == x:
        return near(value)
    if precision.bits == 64 and float(np.float32(value)) == value:  # a number made in single precision
        return exact(np.float32(value))
    sign = int(math.copysign(1, value))
    roots = sympy.pi * near(value / math.pi), sign * sympy.sqrt(near(value**2)), sign * sympy.sqrt(sympy.pi * near(value**2 / math.pi))
    computed = lambda number: abs(float(number) - value) <= 2 * precision.eps * abs(value)  # within a few rounding errors
    return next(filter(computed, roots), sympy.Float(value))


class Formulas(Algebra):
    """Scalars are SymPy expressions of real symbols, truth values are SymPy's."""

    def number(self, x):
        """The number, exact if it was meant to be exact."""
        return exact(np.asarray(x)[()])

    def folds(self, x):
        """Integers and eighths, whose arithmetic is exact in floating point. 1/3 and √2 are left to SymPy."""
        return True if x.dtype.kind != "f" else (np.abs(x) < 2**15) & (8 * x == np.round(8 * x))

    def function(self, primitive, params, dtype):
        """The function from a table. Unknown integers have no division and no bitwise operations."""
        if primitive.name == "convert_element_type":
            return _converting(dtype)
        is_whole = np.issubdtype(dtype, np.integer)
        return None if is_whole and primitive.name in INTEGRAL else FUNCTIONS.get(primitive.name)

    def shortcut(self, equation):
        """Plain formulas of JAX functions whose programs guard against overflow or pivot."""
        name = equation.params.get("name")
        if name not in SHORTCUTS:
            return None
        function, formula = SHORTCUTS[name]
        return formula if is_call_of(equation, function) else None


def _is_truth(x: Any) -> bool:
    return isinstance(x, Boolean) and not isinstance(x, sympy.Expr)  # a symbol may be either


def _converting(dtype: Any) -> Callable:
    if np.issubdtype(dtype, np.bool_):
        return lambda x: sympy.Ne(x, 0)
    number = lambda x: sympy.Piecewise((1, x), (0, True)) if _is_truth(x) else x
    if np.issubdtype(dtype, np.integer):
        return lambda x: number(x) if _is_truth(x) or x.is_integer else sympy.sign(x) * sympy.floor(abs(x))
    return number


def _selected(which: Any, *cases: Any) -> Any:
    if not _is_truth(which):
        *others, last = cases
        return sympy.Piecewise(*((case, sympy.Eq(which, k)) for k, case in enumerate(others)), (last, True))
    no, yes = cases
    return sympy.ITE(which, yes, no) if _is_truth(yes) else sympy.Piecewise((yes, which), (no, True))


def _equal(x: Any, y: Any) -> Any:
    return sympy.Equivalent(x, y) if _is_truth(x) else sympy.Eq(x, y)


FUNCTIONS: dict[str, Callable] = {
    **dict(add=operator.add, add_any=operator.add, sub=operator.sub, mul=operator.mul, div=operator.truediv, neg=operator.neg),
    **dict(pow=operator.pow, sqrt=sympy.sqrt, rsqrt=lambda x: 1 / sympy.sqrt(x), abs=sympy.Abs, sign=sympy.sign),
    **dict(exp=sympy.exp, exp2=lambda x: 2**x, expm1=lambda x: sympy.exp(x) - 1, log=sympy.log, log1p=lambda x: sympy.log(1 + x)),
    **dict(sin=sympy.sin, cos=sympy.cos, tan=sympy.tan, asin=sympy.asin, acos=sympy.acos, atan=sympy.atan, atan2=sympy.atan2),
    **dict(sinh=sympy.sinh, cosh=sympy.cosh, tanh=sympy.tanh, asinh=sympy.asinh, acosh=sympy.acosh, atanh=sympy.atanh),
    **dict(cbrt=lambda x: sympy.sign(x) * sympy.cbrt(abs(x)), logistic=lambda x: 1 / (1 + sympy.exp(-x))),
    **dict(erf=sympy.erf, erfc=sympy.erfc, erf_inv=sympy.erfinv, lgamma=lambda x: sympy.log(abs(sympy.gamma(x))), digamma=sympy.digamma),
    **dict(max=sympy.Max, min=sympy.Min, clamp=lambda low, x, high: sympy.Min(sympy.Max(low, x), high)),
    **dict(floor=sympy.floor, ceil=sympy.ceiling, rem=lambda x, y: x - y * sympy.sign(x / y) * sympy.floor(abs(x / y))),
    **dict(eq=_equal, ne=lambda x, y: sympy.Not(_equal(x, y)), lt=operator.lt, le=operator.le, gt=operator.gt, ge=operator.ge),
    "and": sympy.And,
    "or": sympy.Or,
    "xor": sympy.Xor,
    "not": sympy.Not,
    **dict(select_n=_selected, stop_gradient=lambda x: x, is_finite=lambda x: sympy.true),
}


def _determinant(A: np.ndarray) -> list[np.ndarray]:
    batch = A.shape[:-2]
    return [filled(batch, [sympy.Matrix(A[at]).det(method="berkowitz") for at in np.ndindex(batch)])]


def _interpolated(x: np.ndarray, xp: np.ndarray, fp: np.ndarray, left: Any = None, right: Any = None) -> list[np.ndarray]:
    """Linear interpolation between the points of a table, constant beyond its ends."""
    points = list(zip(xp, fp, strict=True))
    line = lambda x, a, b: a[1] + (b[1] - a[1]) / (b[0] - a[0]) * (x - a[0])

    def at(x):
        inside = [(line(x, a, b), x < b[0]) for a, b in itertools.pairwise(points) if a[0] != b[0]]  # at equal points it jumps
        before, beyond = (end[()] if end is not None else f for end, f in ((left, fp[0]), (right, fp[-1])))
        return sympy.Piecewise((before, x < xp[0]), *inside, (fp[-1], sympy.Eq(x, xp[-1])), (beyond, True))

    return [filled(x.shape, map(at, x.flat))]


SHORTCUTS: dict[str, tuple[Callable, Callable]] = {
    "hypot": (jnp.hypot, lambda x, y: [filled(x.shape, (sympy.sqrt(a**2 + b**2) for a, b in zip(x.flat, y.flat, strict=True)))]),
    "det": (jnp.linalg.det, _determinant),
    "_interp": (jnp.interp, _interpolated),
}
