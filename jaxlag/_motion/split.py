"""A step that may be cut where a mode of friction or contact ends, in its pieces."""

from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

from .step_monitor import Seen

# Phases of a step: the whole step, watched for the end of a mode; where one was seen, Newton's steps for its time, each of them the
# step up to there (the first makes the time right and its derivative, the others its higher derivatives), after the last of which the
# mode changes; and the rest of the step, watched for a second end. Where there is one, the step may end before it: a shorter rest.
WHOLE, NEWTON, CHANGE, REST, SHORT = range(5)
PHASES = np.array([WHOLE, NEWTON, NEWTON, CHANGE, REST], np.int32)
SEEN_LATE = np.array([WHOLE, NEWTON, NEWTON, NEWTON, CHANGE, REST], np.int32)  # as gaps and witnesses are, by their rounding
SIMULTANEOUS = 1e3  # modes that end within this many roundings of time end together


class SplitInterpolation(dfx.AbstractLocalInterpolation):
    """Dense output of a step with a change of mode in it, at `cut`."""

    t0: Any
    t1: Any
    cut: Any
    first: Any
    second: Any

    def evaluate(self, t0, t1=None, left=True):
        if t1 is not None:
            return self.evaluate(t1) - self.evaluate(t0)
        before = t0 < self.cut  # at the cut itself the next mode holds: where a bound jumps, the one before has ended there
        return jnp.where(before, self.first.evaluate(t0), self.second.evaluate(t0))


class Piece(NamedTuple):
    """A step or a part of one: its end, error, dense output, and the state of the solver."""

    y: Any
    error: Any
    dense: Any
    state: Any


class Cut(NamedTuple):
    """Where a step is cut: the time, and Newton's next estimate of it; y there in the next mode, whether that mode is consistent, and
    whether an impact there took energy and followed from impulses; whether the pieces on both sides can be used.
    """

    time: Any
    estimate: Any
    y: Any
    consistent: Any
    dissipates: Any
    impulsive: Any
    usable: Any


class Split(NamedTuple):
    """A step that may be cut: the pieces before and after the cut, the cut, and what was seen along the whole step."""

    first: Piece
    second: Piece
    cut: Cut
    seen: Seen


def next_estimate(cut: Cut, end, value, slope, late, step: tuple[Any, Any], args) -> tuple[Cut, Any, Any]:
    """Newton's next estimate of the time at which a mode ends, from the margins at the end of a piece of the step, and their slopes; which
    modes end there, and by how much margins move with the last digit of the time. `late`: the time that rounding may hide an end for.
    """
    (t0, t1), falling = step, slope < 0
    slack = jnp.maximum(late, args.scales.rounding)  # times near zero are finer than what happens at them
    until = jnp.where(falling, value / jnp.where(falling, -slope, 1), jnp.inf)
    first = jax.lax.stop_gradient(jnp.argmin(jnp.where(end + until >= t0 - slack, until, jnp.inf)))
    estimate = end - value[first] / jnp.where(falling[first], slope[first], -jnp.inf)
    near = jnp.abs(until[first]) <= jnp.maximum(slack[first], args.scales.rtol * (t1 - t0))  # it may have been seen on a path beyond others
    usable = jnp.any(falling) & (end >= t0 - slack[first]) & (end <= t1) & near
    moved = jnp.where(falling, -slope, 0) * args.scales.rounding
    ended = (jnp.arange(value.size) == first) | falling & (value <= SIMULTANEOUS * moved)
    return cut._replace(time=end, estimate=estimate, usable=usable), ended, moved
