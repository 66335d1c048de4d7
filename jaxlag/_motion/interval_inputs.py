"""Measured inputs as the loop from node to node reads them: row by row, out of one vector."""

import dataclasses
import functools
import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._model.flat import Flat
from .._model.injection import needs
from .._model.signal import CalledElsewhere, Piece, Signal, SinceOrigin, is_nonsmooth, is_signal, nonsmooth_signals
from .._model.signal_interpolation import AbstractInterpolation
from .._model.system import System
from .._program.walker import used_arguments

SIMULTANEOUS = 1e-3  # of the period of a sampled state: a signal that jumps so close to a tick is meant to jump with it,
SELDOM = 0.25  # if its samples are no closer than this part of the period, on average


class Rows(NamedTuple):
    """An array within a vector, read row by row."""

    vector: Float[Array, " n"]
    start: int
    shape: tuple[int, ...]
    dtype: Any

    def at(self, i: Any, count: int = 1) -> Array:
        """Rows from the i-th on."""
        width = math.prod(self.shape[1:])
        part = jax.lax.dynamic_slice_in_dim(self.vector, self.start + i * width, count * width)
        return part.reshape(count, *self.shape[1:]).astype(self.dtype)


class Record(NamedTuple):
    """Times and values of a signal, row by row, and its delay."""

    ts: Rows
    values: Rows
    delay: Float[Array, ""]
    interpolation: AbstractInterpolation

    @classmethod
    def of(cls, signal: Signal) -> "Record":
        """Of a signal's own arrays."""
        rows = lambda x: Rows(jnp.ravel(x), 0, x.shape, x.dtype)
        return cls(rows(signal.ts), rows(signal.values), signal.delay, signal.interpolation)

    def piece(self, number: int, following: Int[Array, ""]) -> Piece:
        """The signal between the samples before `following` and there; before the first and behind the last it keeps the end value."""
        first = jnp.clip(following - 1, 0, self.ts.shape[0] - 2)
        ts, values = self.ts.at(first, 2), self.values.at(first, 2)
        if self.interpolation.jumps:
            values = jnp.where(following > first + 1, values[::-1], values)
        return Piece(ts + self.delay, values, self.interpolation, number)

    def time(self, i: Int[Array, ""], origin, periods: Sequence[Any]) -> Float[Array, ""]:
        """That of sample i, infinite where there is none; of a jump that is recorded for the tick of a sampled state, counted from the
        `origin`, that of the tick: a logger's clock is not quite that of the controller, which would read either value at random.
        """
        size = self.ts.shape[0]
        time = jnp.where(i < size, (self.ts.at(jnp.minimum(i, size - 1))[0] + self.delay).astype(origin.dtype), jnp.inf)
        for period in periods if self.interpolation.jumps else ():
            usual = (self.ts.at(size - 1)[0] - self.ts.at(0)[0]) / max(size - 1, 1)
            tick = origin + jnp.round((time - origin) / jnp.where(period > 0, period, 1)) * period
            is_meant = (jnp.abs(time - tick) <= SIMULTANEOUS * period) & (usual >= SELDOM * period) & jnp.isfinite(time)
            time = time + jax.lax.stop_gradient(jnp.where(is_meant, tick - time, 0).astype(time.dtype))
        return time

    def following(self, origin, periods: Sequence[Any]) -> Int[Array, ""]:
        """The first sample after the `origin`."""
        origin = jax.lax.stop_gradient(origin)
        times = self.ts.vector[self.ts.start : self.ts.start + self.ts.shape[0]].astype(origin.dtype) + self.delay.astype(origin.dtype)
        i = jnp.searchsorted(times, origin, side="right")
        return i + (self.time(i, origin, periods) <= origin)


class Place(eqx.Module):
    """The place in params of a signal that does not vary, apart from its delay: its samples are in a record."""

    number: int = eqx.field(static=True)
    delay: Any


def _is_input(node: Any) -> bool:
    return isinstance(node, Place) or is_signal(node)


class Inputs:
    """The inputs among params that jump or bend at their samples."""

    def __init__(self, columns: dict[int, tuple[Rows, Rows, Any]], elsewhere: frozenset[int], params: PyTree):
        self.params, self.elsewhere, self.records = params, elsewhere, []
        for node in jax.tree.leaves(params, is_leaf=_is_input):
            if isinstance(node, Place):
                ts, values, interpolation = columns[node.number]
                self.records.append(Record(ts, values, node.delay, interpolation))
            elif is_nonsmooth(node):
                self.records.append(Record.of(node))

    @property
    def jump(self) -> list[bool]:
        """Which of them jump."""
        return [record.interpolation.jumps for record in self.records]

    def times(self, following: tuple[Int[Array, ""], ...], origin, periods: Sequence[Any]) -> list[Float[Array, ""]]:
        """When the next sample of each comes; what follows in `following` are no signals."""
        return [record.time(i, origin, periods) for record, i in zip(self.records, following, strict=False)]

    def pieces(self, following: tuple[Int[Array, ""], ...]) -> PyTree:
        """Params with the inputs as they are up to the next sample of each."""
        between = iter([record.piece(k, i) for k, (record, i) in enumerate(zip(self.records, following, strict=False))])
        return _replaced(self.params, self.elsewhere, lambda k, node: next(between), lambda: next(between))


def _replaced(params: PyTree, kept: frozenset[int], new: Callable, skipped: Callable = lambda: None) -> PyTree:
    """Params with something new(number, node) in place of each input, apart from those that are `kept`."""
    count = iter(range(10**9))

    def of(node):
        if not (isinstance(node, Place) or is_nonsmooth(node)):
            return node
        k = next(count)
        if k in kept:
            skipped()
            return node
        return new(k, node)

    return jax.tree.map(of, params, is_leaf=_is_input)


class Recorded(NamedTuple):
    """Params and their directions with places for the signals that do not vary; and these signals, by their number."""

    params: PyTree
    directions: tuple
    signals: dict[int, Signal]

    @classmethod
    def of(cls, elsewhere: frozenset[int], params: PyTree, directions: tuple) -> "Recorded":
        """Those of params, but for signals whose samples vary along directions."""
        signals = nonsmooth_signals(params)
        varying = {
            k for of_order in directions for k, s in enumerate(nonsmooth_signals(of_order)) if s.ts is not None or s.values is not None
        }
        kept = frozenset(elsewhere | varying)
        place = lambda k, node: Place(k, node.delay)
        recorded = {k: signal for k, signal in enumerate(signals) if k not in kept}
        return cls(_replaced(params, kept, place), tuple(_replaced(d, kept, place) for d in directions), recorded)


def called_elsewhere(values: Callable, params: PyTree) -> frozenset[int]:
    """The signals that some function asks for at another time than the present, by their number; `values(params)` are all functions'."""
    found: set[int] = set()
    while True:
        try:
            jax.eval_shape(functools.partial(_of_pieces, values, params, frozenset(found)))
        except CalledElsewhere as error:
            found.add(error.args[0])
        else:
            return frozenset(found)


def values_of(flat: Flat, t, q, v) -> PyTree:
    """What all functions of a system return."""
    multipliers = jnp.zeros(flat.rows, v.dtype)
    given = [D(t, q, v, multipliers) for D in (*flat.dissipations.values(), *flat.forces.values())]
    of_states = flat.state_rates(t, q, v), flat.updates(t, q, v)
    return flat.lagrangian(t, q, v), flat.bilateral(t, q), flat.gaps(t, q), flat.nonholonomic(t, q, v), given, of_states


def at_events(system: System, flat: Flat, t, q, v) -> PyTree:
    """What the functions of events return."""
    changing = [name for name, event in system.events if event.then is not None]
    return flat.witnesses(t, q, v, jnp.zeros(flat.rows, v.dtype)), [flat.happened(name, t, q, v) for name in changing]


def follows_time(values: Callable, system: System, params: PyTree, t: Array) -> tuple[bool, bool]:
    """Whether functions depend on the time, and whether they ask for it, beside signals at that time; `values(params, t)` is what those
    that are no events' return.
    """
    if not isinstance(params, SinceOrigin):
        return True, False
    of_events = [function for _, event in system.events for function in (event.when, event.then) if callable(function)]
    of_times = lambda t, origin: values(dataclasses.replace(params, origin=origin), t)
    follows, sees = used_arguments(of_times, t, params.origin)
    return bool(follows), bool(sees) or any(needs(function, "t") for function in of_events)


def warn_of_delays(params: PyTree, elsewhere: frozenset[int]) -> None:
    """Of jumps at times that are not known, which steps go over and derivatives leave out."""
    if any(signal.interpolation.jumps for k, signal in enumerate(nonsmooth_signals(params)) if k in elsewhere):
        warnings.warn(
            "a zero-order hold must be asked for the present time, u(t), for steps to end where it jumps, but a function asks for another "
            "time: its derivative by that time counts as zero. Delay it by `Signal(..., delay=...)`.",
            stacklevel=2,
        )


def _of_pieces(values, params, kept):
    return values(_replaced(params, kept, _first_piece))


def _first_piece(number: int, signal: Signal) -> Piece:
    return Record.of(signal).piece(number, jnp.array(1))


def pieces_at(params: PyTree, elsewhere: frozenset[int], t: Any, periods: Sequence[Any]) -> PyTree:
    """Params with the inputs as they are behind the time t, a tick of all sampled states, but for those that are asked for `elsewhere`."""

    def of(number, signal):
        record = Record.of(signal)
        return record.piece(number, record.following(jnp.asarray(t), periods))

    return _replaced(params, elsewhere, of)


def packed(small: PyTree, large: list[Array]) -> tuple[Array, Callable, Callable]:
    """All numbers as one vector; a vector ↦ the small ones as they were; a vector ↦ the large arrays as `Rows`."""
    numbers, rest = eqx.partition(small, _is_packable)
    leaves, structure = jax.tree.flatten(numbers)
    dtype = jnp.result_type(float, *(x.dtype for x in (*leaves, *large) if x.dtype.kind == "f"))
    arrays = [*(_exact_in_floats(x) for x in leaves), *large]
    starts = [0]
    for x in arrays:
        starts.append(starts[-1] + x.size)

    def unpack(vector):
        parts = [vector[a : a + x.size].reshape(x.shape) for a, x in zip(starts, arrays[: len(leaves)], strict=False)]
        exact = [_from_floats(part, x) for part, x in zip(parts, leaves, strict=True)]
        return eqx.combine(jax.tree.unflatten(structure, exact), rest)

    def rows(vector):
        return [Rows(vector, a, x.shape, x.dtype) for a, x in zip(starts[len(leaves) :], large, strict=False)]

    return jnp.concatenate([jnp.ravel(x).astype(dtype) for x in arrays]), unpack, rows


def _exact_in_floats(x: Any) -> Array:
    """Integers of more than 16 bits as their halves or quarters, in a first axis: single precision holds no integers beyond 2²⁴."""
    x = jnp.asarray(x)
    if x.dtype.kind not in "iu" or x.dtype.itemsize <= 2:
        return x
    bits = x.astype(f"u{x.dtype.itemsize}")
    return jnp.stack([(bits >> 16 * k) & 0xFFFF for k in range(x.dtype.itemsize // 2)])


def _from_floats(found: Array, like: Any) -> Array:
    """An array out of the numbers that stand for it."""
    if like.dtype.kind == "f":
        return found.astype(like.dtype)
    if like.dtype.kind == "b" or like.dtype.itemsize <= 2:
        return jnp.round(found).astype(like.dtype)
    bits = jnp.round(found).astype(f"u{like.dtype.itemsize}")
    return functools.reduce(jnp.bitwise_or, (part << 16 * k for k, part in enumerate(bits))).astype(like.dtype)


def _is_packable(x: Any) -> Bool[Array, ""] | bool:
    return eqx.is_array(x) and not jnp.issubdtype(x.dtype, jax.dtypes.extended) and x.dtype != jax.dtypes.float0 and x.dtype.kind in "fbiu"
