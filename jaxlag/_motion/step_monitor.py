"""Monitoring a step, so that no end of a mode and no pulse is missed.

A mode may end and begin again between two samples of a step in two ways. What follows the state is smooth on a step, so a dip shows in
the slopes at the samples on both sides of it; a gap, which may be as rough as an obstacle, is bounded along the path. What follows time
alone, such as a load that comes as a pulse, need not show at all: bounds of it over the whole interval (`_program.time_bounds`) say by
how much it may have changed there. Wherever a margin may have been used up, samples are closer.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from .._program.conditions import repeated
from .._program.time_bounds import TimeDependence, time_dependence
from .pulses import BRIEF, UNBOUNDED

LOOKS = 8  # parts of an interval, at whose ends it is looked at
EVENLY = tuple(i / LOOKS for i in range(LOOKS + 1))
CHEBYSHEV = tuple((1 - np.cos(np.pi * np.arange(LOOKS + 1) / LOOKS)) / 2)
TO_SERIES = np.linalg.inv(np.polynomial.chebyshev.chebvander(2 * np.array(CHEBYSHEV) - 1, LOOKS))  # of Chebyshev polynomials
NEARER = (1e-2, 1e-4, 1e-7)  # of an interval with an end in it, how close around the root of its chord it is looked at next
SECTIONS = 60  # of an interval with an end in it; some four do where the margin is smooth, and each halves it where it jumps
ROUNDS = 256  # of looks, after which the step is too long to be watched
NEAR = 64  # roundings of time, below which no dip is looked for


class Seen(NamedTuple):
    """Along a step: whether a mode ends, a bound turns negative before, or neither is sure; when; the slopes of the margins there."""

    ended: Any
    negative: Any
    unsure: Any
    time: Any
    slope: Float[Array, " e"]  # −∞ where a margin jumps


class Looks(NamedTuple):
    """Margins and bounds at some times: values and slopes, and by how much the time alone may have changed them in between."""

    value: Float[Array, "k m"]
    slope: Float[Array, "k m"]
    change: Float[Array, "k-1 m"]


class Search(NamedTuple):
    """The interval looked at; whether an end is in it; how often was looked, and how often since; what was seen at its ends."""

    low: Any
    high: Any
    found: Any
    rounds: Any
    sections: Any
    before: Float[Array, " m"]
    behind: Float[Array, " m"]
    slope: Float[Array, " m"]
    largest: Float[Array, " m"]


@dataclasses.dataclass(frozen=True)
class Monitor:
    """The search for the first end of a mode along a path from t0 to t1, look by look: at some times each, of which it says the next.

    `hides(low, high, before, behind)` are those of the margins that may be negative between two times at which they are known, for all that
    is known of them; `bounded`: whether there are bounds of all that follows the time alone. It is looked at `nodes` of an interval, from 0
    to 1, until there is an end in it.
    """

    elements: int
    scales: Any
    t0: Any
    t1: Any
    bounded: bool = True
    hides: Callable | None = None
    nodes: tuple[float, ...] = EVENLY

    def start(self, dtype: Any) -> Search:
        """Nothing is seen yet."""
        nothing, time = jnp.zeros(2 * self.elements, dtype), jnp.asarray(self.t0, dtype)
        return Search(time, jnp.asarray(self.t1, dtype), jnp.array(False), jnp.array(0), jnp.array(0), *[nothing] * 4)

    def times(self, search: Search) -> Float[Array, " k"]:
        """Where it is looked at next."""
        low, high = search.low, search.high
        evenly = lambda: low + (high - low) * np.array(self.nodes, low.dtype)
        ts = jax.lax.cond(search.found, lambda: _around(low, high, search.before, search.behind), evenly)
        return jnp.where(np.arange(ts.size) == ts.size - 1, high, ts)

    def closer(self, search: Search, ts: Float[Array, " k"], looks: Looks) -> Search:
        """With what was seen at these times."""
        value, slope, change = looks
        near = NEAR * self.scales.grain
        brief = jnp.maximum(BRIEF * self.scales.duration, near)
        if not self.bounded:
            brief = jnp.maximum(brief, jnp.minimum(UNBOUNDED * self.scales.duration, self.scales.spacing))
        found, part = search.found, jnp.diff(ts)[:, None]
        hidden = jnp.zeros((len(ts) - 1, value.shape[1]), bool)
        if (hides := self.hides) is not None:
            none = np.zeros(self.elements, bool)
            of_margins = value[:, : self.elements]
            given = ts[:-1], ts[1:], of_margins[:-1], of_margins[1:]
            hidden = jax.vmap(lambda *given: jnp.concatenate([hides(*given), none]))(*given) & (part > brief)
        largest = jnp.maximum(search.largest, jnp.max(jnp.abs(value), axis=0))
        is_bound = np.arange(2 * self.elements) >= self.elements  # a bound of zero is none that is negative
        value = value + jnp.where(is_bound, 1e-9 * largest, 0)[None]
        beyond = jnp.any(value[1:] < 0, axis=1)
        doubtful = jnp.any(
            _dips(value, slope, part) & (part > near) | hidden | (jnp.maximum(value[:-1], value[1:]) < change) & (part > brief), axis=1
        )
        wanted = beyond | (doubtful & ~found)
        i = jnp.where(jnp.any(wanted), jnp.argmax(wanted), LOOKS - 1)  # the end itself may be beyond by rounding alone
        onward = ~found & ~jnp.any(wanted)
        hit = ~onward & beyond[i] & (found | ~jnp.any(hidden[i]))  # of several ends in it, the first
        new = lambda now, before: jnp.where(hit, now, before)
        return Search(
            low=jnp.where(onward, search.high, ts[i]),
            high=jnp.where(onward, self.t1, ts[i + 1]),
            found=found | hit,
            rounds=search.rounds + 1,
            sections=search.sections + (found | hit),
            before=new(value[i], search.before),
            behind=new(value[i + 1], search.behind),
            slope=new(slope[i + 1], search.slope),
            largest=largest,
        )

    def going_on(self, search: Search, exactly: Any = True) -> Bool[Array, ""]:
        """Whether to look once more; not `exactly`, only whether there is an end."""
        grain = 4 * self.scales.grain  # within which what follows the time has steps that are no jumps
        low, high = search.low, search.high
        middle, wide = (low + high) / 2, high - low > jnp.maximum(grain, 1e-13 * (self.t1 - self.t0))
        wide |= jnp.any(_jumps(search)) & (low < middle) & (middle < high)  # to the very time at which it jumps
        narrowing = exactly & wide & (search.sections < SECTIONS)
        return jnp.where(search.found, narrowing, (low < self.t1) & (search.rounds < ROUNDS))

    def seen(self, search: Search) -> Seen:
        """What was seen in the end."""
        slope = jnp.where(_jumps(search), -jnp.inf, search.slope)
        is_margin = jnp.any(search.behind[: self.elements] < 0)
        unsure = ~search.found & (search.low < self.t1)
        return Seen(search.found & is_margin, search.found & ~is_margin, unsure, search.high, slope[: self.elements])


def first_end(
    margins: Callable,
    path: Callable,
    t0,
    t1,
    elements: int,
    scales: Any,
    exactly: Any = True,
    between: Callable | None = None,
    as_written: Callable | None = None,
) -> Seen:
    """When the first of `margins(t, y, start)` turns negative along a `path`; the elements' bounds come after their margins, and count.

    `start` is y at the start, where what stays as it is along the path may be taken from. `exactly`, `between`: as of a `Monitor`.
    `as_written`: margins as programs that tell what follows the time, if others do.
    """
    of_time_alone = time_dependence(lambda t, y: (as_written or margins)(t, y, y), t0, path(t0))
    bounded = of_time_alone is None or of_time_alone.is_bounded
    monitor, look = Monitor(elements, scales, t0, t1, bounded, between), _looking(margins, path, t0, t1, of_time_alone)

    def closer(search):
        ts = monitor.times(search)
        return monitor.closer(search, ts, look(ts))

    start = monitor.start(path(t0).dtype)
    return monitor.seen(repeated(closer, start, lambda search: monitor.going_on(search, exactly), start.low < t1))


def _jumps(search: Search) -> Bool[Array, " m"]:
    """Which margins fall below zero within the interval, and more than smooth ones would."""
    steep = 10 * jnp.abs(search.slope) * (search.high - search.low) + 1e-9 * search.largest
    return (search.behind < 0) & (search.before - search.behind > steep)


def _around(low, high, before, behind):
    """Times close to where the first of some chords is zero, and halfway, for a margin that jumps."""
    share = jnp.where(behind < 0, before / jnp.where(behind < 0, before - behind, 1), 1)
    root = low + (high - low) * jnp.clip(jnp.min(share), 0, 1)
    near = (high - low) * np.array([*NEARER, *(-d for d in NEARER)], low.dtype)
    return _ascending(jnp.clip(jnp.stack([low, high, (low + high) / 2, *(root + near)]), low, high))


def _ascending(x):
    """A few numbers in order: each goes to where as many are less, or equal and before it. (A sort is a call of its own.)"""
    row, column, i = x[None], x[:, None], np.arange(x.size)
    rank = jnp.sum((row < column) | ((row == column) & (i < i[:, None])), axis=1)
    return jnp.sum(jnp.where(rank[None] == i[:, None], row, 0), axis=1)


def _dips(value, slope, part):
    """Where the tangents at both ends of a part meet below zero."""
    (left, right), (falls, rises) = (value[:-1], value[1:]), (slope[:-1], slope[1:])
    turns = (falls < 0) & (rises > 0)
    meeting = (right - left - rises * part) / jnp.where(turns, falls - rises, 1)
    return turns & (left + falls * meeting < 0)


def _looking(margins, path, t0, t1, of_time_alone: TimeDependence | None) -> Callable[..., Looks]:
    """Looks at some times along a path."""

    start = path(t0)

    def along(t):
        y, dy = jax.jvp(path, (t,), (jnp.ones_like(t),))
        return jax.jvp(lambda t, y: margins(t, y, start), (t, y), (jnp.ones_like(t), dy))

    reach = None if of_time_alone is None else reach_of_time(of_time_alone, path, t0, t1)

    def looks(ts):
        value, slope = jax.vmap(along)(ts)
        return Looks(value, slope, changes_by_time(of_time_alone, reach, ts))

    return looks


def reach_of_time(of_time_alone: TimeDependence, path: Callable, t0, t1) -> Float[Array, "m p"]:
    """How steeply margins follow what follows the time alone, the most of three times along a path."""
    return jnp.max(jax.lax.map(lambda t: _reach(of_time_alone, t, path(t)), jnp.linspace(t0, t1, 3)), axis=0)


def changes_by_time(of_time_alone: TimeDependence | None, reach, ts: Float[Array, " k"]) -> Array:
    """By how much the time alone may change margins from one time to the next, which they are so steep in as `reach` says."""
    if of_time_alone is None:
        return jnp.zeros(())
    return jax.vmap(lambda start, end: _change(of_time_alone, reach, start, end))(ts[:-1], ts[1:])


def slopes_of_interpolant(low, high, values: Float[Array, "k m"], ts: Float[Array, " j"]) -> Float[Array, "j m"]:
    """The slopes at some times of the polynomial through `values` at `CHEBYSHEV` nodes from one time to another.

    Source: Trefethen, Approximation Theory and Approximation Practice, chapters 3 and 21.
    """
    s = (2 * (ts - low) / (high - low) - 1).astype(values.dtype)
    second = [jnp.ones_like(s), 2 * s]  # Chebyshev polynomials of the second kind, U; of the first, T'ₙ = n Uₙ₋₁
    while len(second) < LOOKS:
        second.append(2 * s * second[-1] - second[-2])
    rates = [jnp.zeros_like(s), *(n * U for n, U in enumerate(second, 1))]
    coefficients = jnp.sum(TO_SERIES.astype(values.dtype)[:, :, None] * values[None], axis=1)
    return 2 / (high - low) * jnp.sum(jnp.stack(rates, axis=1)[:, :, None] * coefficients[None], axis=1)


def _reach(of_time_alone: TimeDependence, t, y) -> Float[Array, "m p"]:
    """|∂f/∂φ|, one entry of φ at a time: where numbers have one axis and their derivatives two, XLA computes long chains of both in one
    kernel, each term anew for each that asks for it, which does not end.
    """
    found = of_time_alone.phi(t)
    phi, unravel = ravel_pytree(eqx.filter(found, eqx.is_inexact_array))
    rest = lambda phi: of_time_alone.rest(eqx.combine(unravel(phi), found), y)
    return jnp.abs(jax.lax.map(lambda one: jax.jvp(rest, (phi,), (one,))[1], jnp.eye(phi.size, dtype=phi.dtype))).T


def _change(of_time_alone: TimeDependence, reach, start, end):
    """By how much φ may change f from one time to another, with |∂f/∂φ|; choices may change it altogether."""
    intervals = of_time_alone.bounds(start, end)
    widths = [high - low for low, high in intervals if jnp.issubdtype(low.dtype, jnp.inexact)]
    switches = [jnp.any(low != high) for low, high in intervals if not jnp.issubdtype(low.dtype, jnp.inexact)]
    width = jnp.concatenate([jnp.ravel(width) for width in widths]) if widths else jnp.zeros(0, reach.dtype)
    change = jnp.sum(jnp.where(reach == 0, 0, reach * width[None]), axis=1)
    return jnp.where(jnp.any(jnp.stack(switches)), jnp.inf, change) if switches else change
