"""Constant folding: equations of numbers are computed while tracing, by NumPy, which compiles nothing, or by JAX where the two differ."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.extend import core

FOLDABLE = frozenset(map(np.dtype, ("bool", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)), "float32", "float64")))


def is_foldable(atom: Any) -> bool:
    """Whether NumPy and JAX agree on arithmetic of this dtype; with complex numbers or half precision that is not certain."""
    return not has_extended_dtype(atom) and np.dtype(atom.aval.dtype) in FOLDABLE


def is_numeric(x: Any) -> bool:
    """Whether its numbers are at hand: not traced, no key of random numbers, and not another object."""
    if isinstance(x, jax.Array) and jax.dtypes.issubdtype(x.dtype, jax.dtypes.extended):
        return False
    return isinstance(x, (np.ndarray, np.generic, jax.Array, int, float)) and not isinstance(x, jax.core.Tracer)


def has_extended_dtype(atom: Any) -> bool:
    """Whether its elements are not numbers at all, like those of a random key."""
    return jax.dtypes.issubdtype(atom.aval.dtype, jax.dtypes.extended)


def folded(primitive: core.Primitive, params: dict, dtype: Any, *numbers: Any) -> Any:
    """An element-wise primitive of numbers, as JAX computes it."""
    function = NUMPY.get(primitive.name)
    result = converted(numbers[0], dtype) if primitive.name == "convert_element_type" else function(*numbers) if function else None
    if result is None:
        with jax.ensure_compile_time_eval():
            return np.asarray(primitive.bind(*numbers, **params))[()]
    return np.asarray(result).astype(dtype)[()]


def converted(x: Any, dtype: Any) -> Any:
    """In another dtype; None where a number is out of its range, where NumPy and XLA differ."""
    if np.dtype(dtype).kind in "iu" and x.dtype.kind == "f":
        ends = np.iinfo(dtype)
        return x.astype(dtype) if np.all((x > float(ends.min)) & (x < float(ends.max))) else None
    return x.astype(dtype)


def _quotient(x, y):
    if x.dtype.kind == "f":
        return x / y
    return None if np.any(y == 0) else (x - np.fmod(x, y)) // y


def _remainder(x, y):
    return None if x.dtype.kind != "f" and np.any(y == 0) else np.fmod(x, y)


# NumPy functions of element-wise primitives; others are folded by JAX itself, as where the function returns None.

NUMPY: dict[str, Callable] = {
    **dict(add=np.add, add_any=np.add, sub=np.subtract, mul=np.multiply, neg=np.negative, abs=np.abs, sign=np.sign, pow=np.power),
    **dict(exp=np.exp, exp2=np.exp2, log=np.log, log1p=np.log1p, expm1=np.expm1, sqrt=np.sqrt, cbrt=np.cbrt),
    **dict(sin=np.sin, cos=np.cos, tan=np.tan, asin=np.arcsin, acos=np.arccos, atan=np.arctan, atan2=np.arctan2),
    **dict(sinh=np.sinh, cosh=np.cosh, tanh=np.tanh, asinh=np.arcsinh, acosh=np.arccosh, atanh=np.arctanh),
    **dict(eq=np.equal, ne=np.not_equal, lt=np.less, le=np.less_equal, gt=np.greater, ge=np.greater_equal, is_finite=np.isfinite),
    "max": np.maximum,
    "min": np.minimum,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "xor": np.bitwise_xor,
    "not": np.invert,
    "div": _quotient,
    "rem": _remainder,
    "rsqrt": lambda x: 1 / np.sqrt(x),
    "floor": np.floor,
    "ceil": np.ceil,
    "clamp": lambda low, x, high: np.minimum(np.maximum(low, x), high),
    "select_n": lambda which, *cases: np.choose(which, cases, mode="clip"),
    "stop_gradient": lambda x: x,
}


def as_function(equation: Any) -> Callable[..., list]:
    """The equation as a function of its operands."""
    places = {atom: i for i, atom in enumerate(equation.invars) if not isinstance(atom, core.Literal)}
    jaxpr = _empty_jaxpr().replace(invars=list(places), outvars=equation.outvars, eqns=[equation], effects=equation.effects)
    function = core.jaxpr_as_fun(core.ClosedJaxpr(jaxpr, ()))
    return lambda *operands: function(*(operands[i] for i in places.values()))


def bound(equation: Any, *operands: Any) -> list:
    """The outputs of its primitive for operands of any kind, in place of numbers in the equation, too."""
    out = equation.primitive.bind(*operands, **equation.primitive.get_bind_params(equation.params))
    return list(out) if equation.primitive.multiple_results else [out]


@functools.cache
def _empty_jaxpr() -> Any:
    """An empty program."""
    return jax.make_jaxpr(lambda: ())().jaxpr


def fold_by_jax(equation: Any, operands: Any) -> list[np.ndarray]:
    """The outputs of an equation of numbers, computed by JAX while tracing."""
    with jax.ensure_compile_time_eval():
        return [np.asarray(x) for x in as_function(equation)(*operands)]
