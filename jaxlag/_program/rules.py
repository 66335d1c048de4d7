"""Rules of primitives: how equations over arrays become operations on their elements. Here arithmetic, reductions and products.

Each rule takes the interpreter (`_program.interpreter`), the equation and its operands, and returns the outputs; NotImplemented
leaves the equation whole. Others are in `_program.data_movement`, `_program.control_flow` and `_program.elimination`.
"""

import functools
import math
from collections.abc import Callable

import numpy as np
from jax import lax
from jax.extend import core

from .constants import folded
from .expressions import Arrays, Node, objects

RULES: dict[str, Callable] = {}


def rule(*names: str) -> Callable:
    """Registers a function as the rule of these primitives."""

    def register(function: Callable) -> Callable:
        RULES.update(dict.fromkeys(names, function))
        return function

    return register


def promoted(*arrays: np.ndarray) -> Arrays:
    """All as arrays of objects, where one is."""
    return [objects(x) for x in arrays] if any(x.dtype == object for x in arrays) else list(arrays)


def map_elements(function: Callable, *arrays: np.ndarray) -> np.ndarray:
    """A function of each of their elements."""
    return np.asarray(np.frompyfunc(function, len(arrays), 1)(*map(objects, arrays)), object)


@rule("convert_element_type")
def _convert(interpreter, equation, x):
    dtype = equation.params["new_dtype"]

    def convert(x):
        if isinstance(x, Node):
            return x if x.dtype == dtype else interpreter.operation(equation.primitive, equation.params, dtype, x)
        return folded(equation.primitive, equation.params, dtype, x)

    return np.asarray(convert(x)) if x.dtype != object else map_elements(convert, x)


@rule("integer_pow", "square")
def _power(interpreter, equation, x):
    return map_elements(functools.partial(interpreter.power, n=equation.params.get("y", 2)), x)


def _fold(interpreter, function: Callable, *arrays: np.ndarray) -> np.ndarray | None:
    """A function of numbers; None where a node is among them, or where the algebra does not fold the result."""
    if any(x.dtype == object for x in arrays):
        return None
    result = np.asarray(function(*arrays))
    return result if np.all(interpreter.algebra.folds(result)) else None


def _register_reduction(name: str, primitive: core.Primitive, ufunc: np.ufunc) -> None:
    def combining(interpreter, equation):
        return np.frompyfunc(functools.partial(interpreter.apply, primitive, {}, equation.outvars[0].aval.dtype), 2, 1)

    @rule(f"reduce_{name}")
    def reduce(interpreter, equation, x):
        axes = tuple(equation.params["axes"])
        if (x.size == 0 and ufunc.identity is None) or _has_ties(interpreter, equation, x, math.prod(x.shape[axis] for axis in axes)):
            return NotImplemented
        numbers = _fold(interpreter, lambda x: ufunc.reduce(x, axis=axes, dtype=x.dtype), x)
        if numbers is not None:
            return numbers
        combine, x = combining(interpreter, equation), objects(x)
        for axis in sorted(axes, reverse=True):
            x = combine.reduce(x, axis)
        return np.asarray(x, object)

    @rule(f"cum{name}")
    def accumulate(interpreter, equation, x):
        axis = equation.params["axis"]
        if _has_ties(interpreter, equation, x, x.shape[axis]):
            return NotImplemented
        flipped = functools.partial(np.flip, axis=axis) if equation.params["reverse"] else lambda x: x
        numbers = _fold(interpreter, lambda x: flipped(ufunc.accumulate(flipped(x), axis, dtype=x.dtype)), x)
        return flipped(combining(interpreter, equation).accumulate(flipped(objects(x)), axis)) if numbers is None else numbers


def _has_ties(interpreter, equation, x, count: int) -> bool:
    """Whether the derivative depends on how the largest of several is taken: of three that are equal each has a third of it."""
    extremal = equation.primitive.name.endswith(("max", "min"))
    return extremal and count > 2 and x.dtype == object and interpreter.algebra.block(equation) is not None


_register_reduction("sum", lax.add_p, np.add)
_register_reduction("prod", lax.mul_p, np.multiply)
_register_reduction("and", lax.and_p, np.bitwise_and)
_register_reduction("or", lax.or_p, np.bitwise_or)
_register_reduction("max", lax.max_p, np.maximum)
_register_reduction("min", lax.min_p, np.minimum)


@rule("dot_general")
def _dot_general(interpreter, equation, x, y):
    p, aval = equation.params, equation.outvars[0].aval
    (x_sum, y_sum), (x_batch, y_batch) = p["dimension_numbers"]
    plain = p["precision"] is None or set(np.ravel(p["precision"])) <= set(lax.Precision)  # type: ignore[arg-type]
    if not plain or aval.dtype.kind != "f" or any(atom.aval.dtype != aval.dtype for atom in equation.invars):
        return NotImplemented

    def as_matrices(array, batch, summed):
        """With the axes batch, free, summed."""
        free = [d for d in range(array.ndim) if d not in (*batch, *summed)]
        sizes = [math.prod(array.shape[d] for d in dims) for dims in (batch, free, summed)]
        return array.transpose(*batch, *free, *summed).reshape(sizes)

    x, y = as_matrices(x, x_batch, x_sum), as_matrices(y, y_batch, y_sum)
    numbers = _fold(interpreter, lambda x, y: x @ y.swapaxes(1, 2), x, y)
    if numbers is not None:
        return numbers.reshape(aval.shape)
    interpreter.count_work(x.size * y.shape[1])
    products = np.frompyfunc(interpreter.mul, 2, 1)(objects(x)[:, :, None], objects(y)[:, None])
    if products.size == 0:
        return np.zeros(aval.shape, aval.dtype)
    return np.frompyfunc(interpreter.add, 2, 1).reduce(products, -1).reshape(aval.shape)
