"""Rules of primitives that move data: reshaping, joining and slicing, gather and scatter, dynamic slices."""

import functools
from collections.abc import Callable

import numpy as np
from jax import lax
from jax.extend import core

from .expressions import objects
from .rules import RULES, map_elements, promoted, rule


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


def _windows(starts, shape, sizes, start_dims, batch_dims, start_batch_dims, clip):
    """For each vector of starts, its position among them and its window of an array; None for a window that does not fit."""
    room = np.array(shape, int) - sizes
    for at in np.ndindex(starts.shape[:-1]):
        start = np.zeros(len(shape), int)
        start[list(start_dims)] = starts[at]
        start[list(batch_dims)] = [at[d] for d in start_batch_dims]
        start = np.clip(start, 0, room) if clip else start
        fits = ((start >= 0) & (start <= room)).all()
        yield at, tuple(slice(i, i + n) for i, n in zip(start, sizes, strict=True)) if fits else None


@rule("gather")
def _gather(interpreter, equation, x, starts):
    p, dims = equation.params, equation.params["dimension_numbers"]
    if starts.dtype == object:
        return NotImplemented
    clip = p["mode"] in (lax.GatherScatterMode.CLIP, lax.GatherScatterMode.PROMISE_IN_BOUNDS)
    out = np.empty(equation.outvars[0].aval.shape, x.dtype)
    part = np.moveaxis(out, [d for d in range(out.ndim) if d not in dims.offset_dims], range(starts.ndim - 1))
    dropped = (*dims.collapsed_slice_dims, *dims.operand_batching_dims)
    kept = [n for d, n in enumerate(p["slice_sizes"]) if d not in dropped]
    batch = dims.operand_batching_dims, dims.start_indices_batching_dims
    for at, window in _windows(starts, x.shape, p["slice_sizes"], dims.start_index_map, *batch, clip):
        if window is None:
            return NotImplemented
        part[(*at, ...)] = x[window].reshape(kept)
    return out


def _register_scatter(name: str, primitive: core.Primitive | None) -> None:
    @rule(name)
    def scatter(interpreter, equation, x, starts, updates):
        p, dims = equation.params, equation.params["dimension_numbers"]
        if starts.dtype == object or (primitive is None and p["update_jaxpr"] is not None):
            return NotImplemented  # the latter applies a function to the element in place
        combine = functools.partial(interpreter.apply, primitive, {}, equation.outvars[0].aval.dtype)
        x, updates = objects(x).copy(), objects(updates)
        part = np.moveaxis(updates, [d for d in range(updates.ndim) if d not in dims.update_window_dims], range(starts.ndim - 1))
        dropped = (*dims.inserted_window_dims, *dims.operand_batching_dims)
        sizes = np.ones(x.ndim, int)
        sizes[[d for d in range(x.ndim) if d not in dropped]] = [updates.shape[d] for d in dims.update_window_dims]
        batch = dims.operand_batching_dims, dims.scatter_indices_batching_dims
        clip = p["mode"] == lax.GatherScatterMode.CLIP
        for at, window in _windows(starts, x.shape, sizes, dims.scatter_dims_to_operand_dims, *batch, clip):
            if window is not None:
                update = part[(*at, ...)].reshape(sizes)
                x[window] = update if primitive is None else map_elements(combine, x[window], update)
        return x


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
