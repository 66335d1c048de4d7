"""Rules of primitives that move data: reshaping, joining and slicing, gather and scatter, dynamic slices."""

import math
from collections.abc import Callable

import numpy as np
from jax import lax
from jax.extend import core

from .expressions import objects
from .rules import RULES, promoted, rule


def _register_movements(**movements: Callable) -> None:
    """Registers rules that need no interpreter: functions of the parameters and the operands."""
    for name, movement in movements.items():
        RULES[name] = lambda interpreter, equation, *operands, movement=movement: movement(equation.params, *promoted(*operands))


def _broadcast(p, x):
    shape = np.ones(len(p["shape"]), int)
    shape[list(p["broadcast_dimensions"])] = x.shape
    return np.broadcast_to(x.reshape(shape), p["shape"])


def _pad(p, x, value):
    low, high, inner = np.array(p["padding_config"], int).reshape(-1, 3).T
    out = np.broadcast_to(value, low + high + x.shape + inner * np.maximum(np.array(x.shape, int) - 1, 0)).copy()
    places = [first + np.arange(n) * (1 + step) for first, n, step in zip(low, x.shape, inner, strict=True)]
    kept = [(place >= 0) & (place < n) for place, n in zip(places, out.shape, strict=True)]
    out[np.ix_(*[place[keep] for place, keep in zip(places, kept, strict=True)])] = x[np.ix_(*kept)]
    return out


_register_movements(
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
    pad=_pad,
    copy=lambda p, x: x,
    optimization_barrier=lambda p, *xs: list(xs),
    iota=lambda p: _broadcast(p | {"broadcast_dimensions": (p["dimension"],)}, np.arange(p["shape"][p["dimension"]], dtype=p["dtype"])),
)


def _windows(starts, shape, sizes, start_dims, batch_dims, start_batch_dims, clip) -> np.ndarray:
    """The number that each element of each window has in an array of this shape; −1 in windows that do not fit."""
    room = np.array(shape, int) - sizes
    start = np.zeros((*starts.shape[:-1], len(shape)), int)
    start[..., list(start_dims)] = starts
    for d, k in zip(batch_dims, start_batch_dims, strict=True):
        start[..., d] = np.expand_dims(np.arange(starts.shape[k]), [i for i in range(starts.ndim - 1) if i != k])
    start = np.clip(start, 0, room) if clip else start
    fits = ((start >= 0) & (start <= room)).all(-1)
    strides = np.array([math.prod(shape[d + 1 :]) for d in range(len(shape))], int)
    windows, whole = (x.reshape(*x.shape, *[1] * len(sizes)) for x in (start @ strides, fits))
    return np.where(whole, windows + np.tensordot(strides, np.indices(sizes), 1), -1)


@rule("gather")
def _gather(interpreter, equation, x, starts):
    """Without an interpreter −1 in windows that do not fit."""
    p, dims = equation.params, equation.params["dimension_numbers"]
    if starts.dtype == object:
        return NotImplemented
    clip = p["mode"] in (lax.GatherScatterMode.CLIP, lax.GatherScatterMode.PROMISE_IN_BOUNDS)
    batch = dims.operand_batching_dims, dims.start_indices_batching_dims
    places = _windows(starts, x.shape, p["slice_sizes"], dims.start_index_map, *batch, clip)
    dropped = [starts.ndim - 1 + d for d in (*dims.collapsed_slice_dims, *dims.operand_batching_dims)]
    shape = equation.outvars[0].aval.shape
    batch_axes = [d for d in range(len(shape)) if d not in dims.offset_dims]
    places = np.moveaxis(places.squeeze(tuple(dropped)), range(starts.ndim - 1), batch_axes)
    if interpreter is not None and np.any(places < 0):
        return NotImplemented
    flat = x.ravel() if np.all(places >= 0) else np.append(x.ravel(), -1)
    return flat[places.ravel()].reshape(places.shape)


def scattered(equation, x, starts, updates) -> tuple[np.ndarray, np.ndarray]:
    """Where updates go: for each that goes anywhere the number of the element of x, and itself."""
    p, dims = equation.params, equation.params["dimension_numbers"]
    part = np.moveaxis(updates, [d for d in range(updates.ndim) if d not in dims.update_window_dims], range(starts.ndim - 1))
    dropped = (*dims.inserted_window_dims, *dims.operand_batching_dims)
    windows = iter(updates.shape[d] for d in dims.update_window_dims)
    sizes = [1 if d in dropped else next(windows) for d in range(len(x.shape))]
    batch = dims.operand_batching_dims, dims.scatter_indices_batching_dims
    clip = p["mode"] == lax.GatherScatterMode.CLIP
    places = _windows(starts, x.shape, sizes, dims.scatter_dims_to_operand_dims, *batch, clip).ravel()
    return places[places >= 0], part.ravel()[places >= 0]


def _register_scatter(name: str, primitive: core.Primitive | None) -> None:
    @rule(name)
    def scatter(interpreter, equation, x, starts, updates):
        if starts.dtype == object or (primitive is None and equation.params["update_jaxpr"] is not None):
            return NotImplemented  # the latter applies a function to the element in place
        x, updates = promoted(x, updates)
        flat = objects(x).ravel().copy() if primitive else x.ravel().copy()
        places, new = scattered(equation, x, starts, updates)
        if primitive is None:
            flat[places] = new
        for place, update in zip(places, objects(new), strict=True) if primitive else ():
            flat[place] = interpreter.apply(primitive, {}, equation.outvars[0].aval.dtype, flat[place], update)
        return flat.reshape(x.shape)


_register_scatter("scatter", None)
_register_scatter("scatter-add", lax.add_p)
_register_scatter("scatter-mul", lax.mul_p)


@rule("dynamic_slice", "dynamic_update_slice")
def _dynamic_slice(interpreter, equation, x, *rest):
    updates, starts = (rest[:1], rest[1:]) if equation.primitive is lax.dynamic_update_slice_p else ((), rest)
    if any(start.dtype == object for start in starts):
        return NotImplemented
    sizes = updates[0].shape if updates else equation.params["slice_sizes"]
    window = tuple(slice(i := min(max(int(start), 0), size - n), i + n) for start, size, n in zip(starts, x.shape, sizes, strict=True))
    if not updates:
        return x[window]
    x, update = promoted(x.copy(), updates[0])
    x[window] = update
    return x
