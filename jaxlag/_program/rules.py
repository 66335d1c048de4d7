"""How the primitives of JAX are taken apart into operations on entries, and which of them only move entries about.

Each rule takes the reader (`_program.interpreter`), the equation and its operands, and gives the outputs; NotImplemented
leaves the equation whole.
"""

import functools
import math
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np
from jax import lax
from jax.extend import core

from .constants import folded
from .scalar_graph import Arrays, Entry, objects

RULES: dict[str, Callable] = {}


def alike(*arrays: np.ndarray) -> Arrays:
    """All with objects, where one has."""
    return [objects(x) for x in arrays] if any(x.dtype == object for x in arrays) else list(arrays)


def each(function: Callable, *arrays: np.ndarray) -> np.ndarray:
    """A function of each of their entries."""
    return np.asarray(np.frompyfunc(function, len(arrays), 1)(*map(objects, arrays)), object)


def rule(*names: str) -> Callable:
    """Registers a function as the rule of these primitives."""

    def register(function: Callable) -> Callable:
        RULES.update(dict.fromkeys(names, function))
        return function

    return register


def _moving(**movements: Callable) -> None:
    """Rules of equations that only move data: functions of the parameters and the operands."""
    for name, movement in movements.items():
        RULES[name] = lambda reader, equation, *operands, movement=movement: movement(equation.params, *alike(*operands))


def _broadcast(p, x):
    shape = np.ones(len(p["shape"]), int)
    shape[list(p["broadcast_dimensions"])] = x.shape
    return np.broadcast_to(x.reshape(shape), p["shape"])


def _padded(p, x, value):
    low, high, inner = np.array(p["padding_config"], int).reshape(-1, 3).T
    out = np.broadcast_to(value, low + high + x.shape + inner * np.maximum(np.array(x.shape, int) - 1, 0)).copy()
    places = [first + np.arange(n) * (1 + step) for first, n, step in zip(low, x.shape, inner, strict=True)]
    kept = [(place >= 0) & (place < n) for place, n in zip(places, out.shape, strict=True)]
    out[np.ix_(*[place[keep] for place, keep in zip(places, kept, strict=True)])] = x[np.ix_(*kept)]
    return out


_moving(
    reshape=lambda p, x: x.reshape(p["new_sizes"]) if p["dimensions"] is None else NotImplemented,
    squeeze=lambda p, x: np.squeeze(x, p["dimensions"]),
    transpose=lambda p, x: np.transpose(x, p["permutation"]),
    broadcast_in_dim=_broadcast,
    slice=lambda p, x: x[tuple(map(slice, p["start_indices"], p["limit_indices"], p["strides"] or [1] * x.ndim))],
    rev=lambda p, x: np.flip(x, p["dimensions"]),
    concatenate=lambda p, *xs: np.concatenate(xs, p["dimension"]),
    stack=lambda p, *xs: np.stack(xs, p["axis"]),
    unstack=lambda p, x: [np.asarray(part, x.dtype) for part in np.moveaxis(x, p["axis"], 0)],
    split=lambda p, x: np.split(x, np.cumsum(p["sizes"])[:-1], p["axis"]),
    tile=lambda p, x: np.tile(x, p["reps"]),
    pad=_padded,
    copy=lambda p, x: x,
    optimization_barrier=lambda p, *xs: list(xs),
    iota=lambda p: _broadcast(p | {"broadcast_dimensions": (p["dimension"],)}, np.arange(p["shape"][p["dimension"]], dtype=p["dtype"])),
)


@rule("convert_element_type")
def _converted(reader, equation, x):
    dtype = equation.params["new_dtype"]

    def convert(x):
        if isinstance(x, Entry):
            return x if x.dtype == dtype else reader.entry(equation.primitive, equation.params, dtype, x)
        return folded(equation.primitive, equation.params, dtype, x)

    return np.asarray(convert(x)) if x.dtype != object else each(convert, x)


@rule("integer_pow", "square")
def _power(reader, equation, x):
    return each(functools.partial(reader.power, n=equation.params.get("y", 2)), x)


def _at_once(reader, function: Callable, *arrays: np.ndarray) -> np.ndarray | None:
    """A function of numbers; None where an entry is among them, or the algebra would have what comes out as an entry."""
    if any(x.dtype == object for x in arrays):
        return None
    result = np.asarray(function(*arrays))
    return result if np.all(reader.algebra.folds(result)) else None


def _reducing(name: str, primitive: core.Primitive, ufunc: np.ufunc) -> None:
    def combining(reader, equation):
        return np.frompyfunc(functools.partial(reader.apply, primitive, {}, equation.outvars[0].aval.dtype), 2, 1)

    @rule(f"reduce_{name}")
    def reduced(reader, equation, x):
        axes = tuple(equation.params["axes"])
        if (x.size == 0 and ufunc.identity is None) or _has_ties(reader, equation, x, math.prod(x.shape[axis] for axis in axes)):
            return NotImplemented
        numbers = _at_once(reader, lambda x: ufunc.reduce(x, axis=axes, dtype=x.dtype), x)
        if numbers is not None:
            return numbers
        combine, x = combining(reader, equation), objects(x)
        for axis in sorted(axes, reverse=True):
            x = combine.reduce(x, axis)
        return np.asarray(x, object)

    @rule(f"cum{name}")
    def cumulated(reader, equation, x):
        axis = equation.params["axis"]
        if _has_ties(reader, equation, x, x.shape[axis]):
            return NotImplemented
        turned = functools.partial(np.flip, axis=axis) if equation.params["reverse"] else lambda x: x
        numbers = _at_once(reader, lambda x: turned(ufunc.accumulate(turned(x), axis, dtype=x.dtype)), x)
        return turned(combining(reader, equation).accumulate(turned(objects(x)), axis)) if numbers is None else numbers


def _has_ties(reader, equation, x, several: int) -> bool:
    """Whether the derivative depends on how the largest of several is taken: of three that are equal each has a third of it."""
    extremal = equation.primitive.name.endswith(("max", "min"))
    return extremal and several > 2 and x.dtype == object and reader.algebra.block(equation) is not None


_reducing("sum", lax.add_p, np.add)
_reducing("prod", lax.mul_p, np.multiply)
_reducing("and", lax.and_p, np.bitwise_and)
_reducing("or", lax.or_p, np.bitwise_or)
_reducing("max", lax.max_p, np.maximum)
_reducing("min", lax.min_p, np.minimum)


@rule("dot_general")
def _dot(reader, equation, x, y):
    p, aval = equation.params, equation.outvars[0].aval
    (x_sum, y_sum), (x_batch, y_batch) = p["dimension_numbers"]
    plain = p["precision"] is None or set(np.ravel(p["precision"])) <= set(lax.Precision)  # type: ignore[arg-type]
    if not plain or aval.dtype.kind != "f" or any(atom.aval.dtype != aval.dtype for atom in equation.invars):
        return NotImplemented

    def rows(array, batch, summed):
        free = [d for d in range(array.ndim) if d not in (*batch, *summed)]
        sizes = [math.prod(array.shape[d] for d in dims) for dims in (batch, free, summed)]
        return array.transpose(*batch, *free, *summed).reshape(sizes)

    x, y = rows(x, x_batch, x_sum), rows(y, y_batch, y_sum)
    numbers = _at_once(reader, lambda x, y: x @ y.swapaxes(1, 2), x, y)
    if numbers is not None:
        return numbers.reshape(aval.shape)
    reader.spend(x.size * y.shape[1])
    products = np.frompyfunc(reader.mul, 2, 1)(objects(x)[:, :, None], objects(y)[:, None])
    if products.size == 0:
        return np.zeros(aval.shape, aval.dtype)
    return np.frompyfunc(reader.add, 2, 1).reduce(products, -1).reshape(aval.shape)


def _windows(starts, shape, sizes, start_dims, batch_dims, start_batch_dims, clip):
    """For each vector of starts its place among them, and its window of an array; None for a window that does not fit."""
    room = np.array(shape, int) - sizes
    for at in np.ndindex(starts.shape[:-1]):
        start = np.zeros(len(shape), int)
        start[list(start_dims)] = starts[at]
        start[list(batch_dims)] = [at[d] for d in start_batch_dims]
        start = np.clip(start, 0, room) if clip else start
        fits = ((start >= 0) & (start <= room)).all()
        yield at, tuple(slice(i, i + n) for i, n in zip(start, sizes, strict=True)) if fits else None


@rule("gather")
def _gathered(reader, equation, x, starts):
    p, how = equation.params, equation.params["dimension_numbers"]
    if starts.dtype == object:
        return NotImplemented
    clip = p["mode"] in (lax.GatherScatterMode.CLIP, lax.GatherScatterMode.PROMISE_IN_BOUNDS)
    out = np.empty(equation.outvars[0].aval.shape, x.dtype)
    part = np.moveaxis(out, [d for d in range(out.ndim) if d not in how.offset_dims], range(starts.ndim - 1))
    gone = (*how.collapsed_slice_dims, *how.operand_batching_dims)
    kept = [n for d, n in enumerate(p["slice_sizes"]) if d not in gone]
    batch = how.operand_batching_dims, how.start_indices_batching_dims
    for at, window in _windows(starts, x.shape, p["slice_sizes"], how.start_index_map, *batch, clip):
        if window is None:
            return NotImplemented
        part[(*at, ...)] = x[window].reshape(kept)
    return out


def _scattering(name: str, primitive: core.Primitive | None) -> None:
    @rule(name)
    def scattered(reader, equation, x, starts, updates):
        p, how = equation.params, equation.params["dimension_numbers"]
        if starts.dtype == object or (primitive is None and p["update_jaxpr"] is not None):
            return NotImplemented  # the latter applies a function to what stands there
        combine = functools.partial(reader.apply, primitive, {}, equation.outvars[0].aval.dtype)
        x, updates = objects(x).copy(), objects(updates)
        part = np.moveaxis(updates, [d for d in range(updates.ndim) if d not in how.update_window_dims], range(starts.ndim - 1))
        gone = (*how.inserted_window_dims, *how.operand_batching_dims)
        sizes = np.ones(x.ndim, int)
        sizes[[d for d in range(x.ndim) if d not in gone]] = [updates.shape[d] for d in how.update_window_dims]
        batch = how.operand_batching_dims, how.scatter_indices_batching_dims
        clip = p["mode"] == lax.GatherScatterMode.CLIP
        for at, window in _windows(starts, x.shape, sizes, how.scatter_dims_to_operand_dims, *batch, clip):
            if window is not None:
                update = part[(*at, ...)].reshape(sizes)
                x[window] = update if primitive is None else each(combine, x[window], update)
        return x


_scattering("scatter", None)
_scattering("scatter-add", lax.add_p)
_scattering("scatter-mul", lax.mul_p)


@rule("dynamic_slice", "dynamic_update_slice")
def _at_start(reader, equation, x, *rest):
    updates, starts = (rest[:1], rest[1:]) if equation.primitive is lax.dynamic_update_slice_p else ((), rest)
    if any(start.dtype == object for start in starts):
        return NotImplemented
    sizes = updates[0].shape if updates else equation.params["slice_sizes"]
    window = tuple(slice(i := min(max(int(start), 0), size - n), i + n) for start, size, n in zip(starts, x.shape, sizes, strict=True))
    if not updates:
        return x[window]
    x, update = alike(x.copy(), updates[0])
    x[window] = update
    return x


# Calls and loops.

LONG = 1000  # operations on numbers: some 20 ms in Python, less than a program takes to compile


CALLS = ("jit", "pjit", "closed_call", "core_call", "remat", "remat2", "checkpoint")  # equations that call a program and do nothing else

RULED = ("custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr")  # and those that have a derivative rule of their own


def body(equation: Any) -> Any:
    """The program that an equation calls, closed."""
    p = equation.params
    program = p["jaxprs"].solve if "jaxprs" in p else next(p[name] for name in ("jaxpr", "call_jaxpr", "fun_jaxpr") if name in p)
    return program if hasattr(program, "consts") else core.ClosedJaxpr(program, ())


def primitives(program: Any) -> Iterator[str]:
    """The names of all that a program does, also within the programs it calls."""
    for equation in getattr(program, "jaxpr", program).eqns:
        yield equation.primitive.name
        for value in equation.params.values():
            for part in value if isinstance(value, (tuple, list)) else [value]:
                if hasattr(part, "eqns") or hasattr(part, "jaxpr"):
                    yield from primitives(part)


def turns(equation: Any) -> int | float:
    """How many operations a rule here would make of numbers one by one."""
    name, p = equation.primitive.name, equation.params
    if name == "while":
        return math.inf  # as long as it takes
    if name == "cond":
        return max(sum(map(turns, branch.jaxpr.eqns)) for branch in p["branches"])
    if name in (*CALLS, *RULED, "scan", "custom_linear_solve"):
        return p.get("length", 1) * sum(map(turns, body(equation).jaxpr.eqns))
    if name in ("cholesky", "lu", "triangular_solve"):
        return equation.invars[0].aval.size * equation.invars[0].aval.shape[-1]
    windows = math.prod(equation.invars[1].aval.shape[:-1]) if name.startswith(("gather", "scatter")) else 1
    return windows + equation.invars[0].aval.size if name.startswith("scatter") else windows


@rule(*CALLS)
def _called(reader, equation, *operands):
    shortcut = reader.algebra.shortcut(equation)
    if shortcut is not None and any(x.dtype == object for x in operands):
        return reader.block(shortcut, operands, equation.outvars)
    return reader.inner(body(equation), operands)


@rule(*RULED)
def _with_rule(reader, equation, *operands):
    """Taken apart, unless the algebra differentiates what is no number: then it stays in one piece, with its rule."""
    results, known = _called(reader, equation, *operands), all(x.dtype != object for x in operands)
    return results if known or reader.algebra.block(equation) is None else NotImplemented


@rule("platform_index")
def _platform(reader, equation):
    fits = [names is None or jax.default_backend() in names for names in equation.params["platforms"]]
    return np.asarray(fits.index(True), np.int32)


@rule("cond")
def _branch(reader, equation, index, *operands):
    branches = equation.params["branches"]
    return NotImplemented if index.dtype == object else reader.inner(branches[min(max(int(index), 0), len(branches) - 1)], operands)


@rule("while")
def _while(reader, equation, *operands):
    p = equation.params
    i, j = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]
    condition, consts, state = operands[:i], operands[i:j], list(operands[j:])
    while (goes_on := reader.inner(p["cond_jaxpr"], [*condition, *state])[0]).dtype != object and goes_on.ndim == 0:
        if not goes_on:
            return state
        state = reader.inner(p["body_jaxpr"], [*consts, *state])
    return NotImplemented


@rule("scan")
def _scan(reader, equation, *operands):
    p = equation.params
    i, j = p["num_consts"], p["num_consts"] + p["num_carry"]
    consts, carry, columns, rows = operands[:i], list(operands[i:j]), operands[j:], {}
    for k in reversed(range(p["length"])) if p["reverse"] else range(p["length"]):
        out = reader.inner(p["jaxpr"], [*consts, *carry, *(np.asarray(x[k], x.dtype) for x in columns)])
        carry, rows[k] = out[: len(carry)], out[len(carry) :]
    if not rows:
        return NotImplemented
    return [*carry, *(np.stack(alike(*column)) for column in zip(*(rows[k] for k in sorted(rows)), strict=True))]
