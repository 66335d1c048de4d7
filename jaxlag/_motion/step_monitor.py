"""Monitoring a step, so that no end of a mode and no pulse is missed.

A mode may end and begin again between two samples of a step in two ways. What follows the state is smooth on a step, so a dip shows in
the slopes at the samples on both sides of it; a gap, which may be as rough as an obstacle, is bounded along the path. What follows time
alone, such as a load that comes as a pulse, need not show at all: bounds of it over the whole interval (`_program.time_bounds`) say by
how much it may have changed there. Wherever a margin may have been used up, samples are closer.
"""

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


class _Search(NamedTuple):
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


def first_end(
    margins: Callable, path: Callable, t0, t1, elements: int, scales: Any, exactly: Any = True, between: Callable | None = None
) -> Seen:
    """When the first of `margins(t, y, start)` turns negative along a `path`; the elements' bounds come after their margins, and count.

    `start` is y at the start, where what stays as it is along the path may be taken from. Not `exactly`: only whether there is an end.
    `between(low, high)` are those of the elements' margins that may be negative between two times, for all that is known of them.
    """
    of_time_alone = time_dependence(lambda t, y: margins(t, y, y), t0, path(t0))
    look, near = _looking(margins, path, t0, t1, of_time_alone), NEAR * scales.grain
    grain = 4 * scales.grain  # within which what follows the time has steps that are no jumps
    brief = jnp.maximum(BRIEF * scales.duration, near)
    none = np.zeros(elements, bool)
    hides = lambda low, high: jnp.concatenate([none if between is None else between(low, high), none])
    if of_time_alone is not None and not of_time_alone.is_bounded:
        brief = jnp.maximum(brief, jnp.minimum(UNBOUNDED * scales.duration, scales.spacing))

    def closer(search):
        low, high, found, rounds, sections, *_, largest = search
        evenly = lambda: low + (high - low) / LOOKS * np.arange(LOOKS + 1)
        ts = jax.lax.cond(found, lambda: _around(low, high, *search[5:7]), evenly)
        ts = jnp.where(np.arange(ts.size) == ts.size - 1, high, ts)
        part = jnp.diff(ts)[:, None]
        value, slope, change = look(ts)
        hidden = jax.vmap(hides)(ts[:-1], ts[1:]) & (part > brief)
        largest = jnp.maximum(largest, jnp.max(jnp.abs(value), axis=0))
        value = value + jnp.where(np.arange(2 * elements) < elements, 0, 1e-9 * largest)[None]  # a bound of zero is none that is negative
        beyond = jnp.any(value[1:] < 0, axis=1)
        doubtful = jnp.any(_dips(value, slope, part) & (part > near) | hidden | (value[:-1] + value[1:] < change) & (part > brief), axis=1)
        wanted = beyond | (doubtful & ~found)
        i = jnp.where(jnp.any(wanted), jnp.argmax(wanted), LOOKS - 1)  # the end itself may be beyond by rounding alone
        onward = ~found & ~jnp.any(wanted)
        hit = ~onward & beyond[i] & (found | ~jnp.any(hidden[i]))  # of several ends in it, the first
        new = lambda now, before: jnp.where(hit, now, before)
        return _Search(
            jnp.where(onward, high, ts[i]),
            jnp.where(onward, t1, ts[i + 1]),
            found | hit,
            rounds + 1,
            sections + (found | hit),
            *(new(now, before) for now, before in zip((value[i], value[i + 1], slope[i + 1]), search[5:8], strict=True)),
            largest,
        )

    def going_on(search):
        middle, wide = (search.low + search.high) / 2, search.high - search.low > jnp.maximum(grain, 1e-13 * (t1 - t0))
        wide |= jnp.any(_jumps(search)) & (search.low < middle) & (middle < search.high)  # to the very time at which it jumps
        narrowing = exactly & wide & (search.sections < SECTIONS)
        return jnp.where(search.found, narrowing, (search.low < t1) & (search.rounds < ROUNDS))

    nothing, time = jnp.zeros(2 * elements, path(t0).dtype), jnp.asarray(t0, path(t0).dtype)
    start = _Search(time, jnp.asarray(t1, time.dtype), jnp.array(False), 0, 0, *[nothing] * 4)
    done = repeated(closer, start, going_on, start.low < t1)
    slope = jnp.where(_jumps(done), -jnp.inf, done.slope)
    is_margin = jnp.any(done.behind[:elements] < 0)
    return Seen(done.found & is_margin, done.found & ~is_margin, ~done.found & (done.low < t1), done.high, slope[:elements])


def _jumps(search: _Search) -> Bool[Array, " m"]:
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

    if of_time_alone is None:
        changed = lambda ts: jnp.zeros(())
    else:
        reach = jnp.max(jax.lax.map(lambda t: _reach(of_time_alone, t, path(t)), jnp.linspace(t0, t1, 3)), axis=0)
        changed = lambda ts: jax.vmap(lambda start, end: _change(of_time_alone, reach, start, end))(ts[:-1], ts[1:])

    def looks(ts):
        value, slope = jax.vmap(along)(ts)
        return Looks(value, slope, changed(ts))

    return looks


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
