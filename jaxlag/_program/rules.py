"""Rules of primitives: how equations over arrays become operations on their elements. Here arithmetic, sums, products, calls, loops.

Each rule takes the interpreter (`_program.interpreter`), the equation and its operands, and returns the outputs; NotImplemented
leaves the equation whole. Others are in `_program.data_movement` and `_program.elimination`.
"""

import functools
import math
from collections.abc import Callable

import jax
import numpy as np
from jax import lax
from jax.extend import core

from .constants import folded
from .expressions import Arrays, Node, objects
from .primitives import CALLS, CALLS_WITH_DERIVATIVE_RULE
from .walker import branch_index, called_program, unrolled_scan

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
    n = equation.params.get("y", 2)
    numbers = _fold(interpreter, np.square, x) if n == 2 else None
    return map_elements(functools.partial(interpreter.power, n=n), x) if numbers is None else numbers


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


@rule(*CALLS)
def _call(interpreter, equation, *operands):
    shortcut = interpreter.algebra.shortcut(equation)
    if shortcut is not None and any(x.dtype == object for x in operands):
        return interpreter.block(shortcut, operands, equation.outvars)
    return interpreter.run(called_program(equation), operands)


@rule(*CALLS_WITH_DERIVATIVE_RULE)
def _call_with_derivative_rule(interpreter, equation, *operands):
    """Taken apart, unless the algebra differentiates nodes: then it stays in one piece, with its rule."""
    results, known = _call(interpreter, equation, *operands), all(x.dtype != object for x in operands)
    return results if known or interpreter.algebra.block(equation) is None else NotImplemented


@rule("platform_index")
def _platform_index(interpreter, equation):
    fits = [names is None or jax.default_backend() in names for names in equation.params["platforms"]]
    return np.asarray(fits.index(True), np.int32)


@rule("cond")
def _cond(interpreter, equation, index, *operands):
    if index.dtype == object:
        return NotImplemented
    return interpreter.run(equation.params["branches"][branch_index(index, equation.params)], operands)


@rule("while")
def _while(interpreter, equation, *operands):
    p = equation.params
    i, j = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]
    condition, consts, state = operands[:i], operands[i:j], list(operands[j:])
    while (goes_on := interpreter.run(p["cond_jaxpr"], [*condition, *state])[0]).dtype != object and goes_on.ndim == 0:
        if not goes_on:
            return state
        state = interpreter.run(p["body_jaxpr"], [*consts, *state])
    return NotImplemented


@rule("scan")
def _scan(interpreter, equation, *operands):
    p = equation.params
    if not p["length"]:
        return NotImplemented
    row = lambda x, k: np.asarray(x[k], x.dtype)
    carry, columns = unrolled_scan(p, operands, lambda inputs: interpreter.run(p["jaxpr"], inputs), row)
    return [*carry, *(np.stack(promoted(*column)) for column in columns)]
