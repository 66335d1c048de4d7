"""Pulses: what follows time alone and comes and goes within a step, unseen by the stages that its error is estimated from.

Bounds over parts of the step (`_program.time_bounds`) tell where there can be none; where they leave it open, parts are halved, until the
function is seen to go where no stage saw it, or the part is as brief as what is looked for. Tables are looked at between their knots.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from .._program.time_functions import TimeFunctions, time_functions
from .protocol import Arguments, FirstOrderSystem, undifferentiated
from .tableaux import Tableau

BRIEF = 1e-7  # of the motion, how long a pulse lasts that is looked for,
UNBOUNDED = 2e-4  # where a function has no bounds
FAINT = 1e-2  # of its largest value, what a pulse may be and be overlooked, and in a table
FAINT_IN_TABLE = 1e-6
LOOKS = 100  # at a step; bounds of a sum of many waves may leave more open, and a table with more knots in a step makes it shorter
AT_ONCE = 32  # of them, where there are no bounds


class _Search(NamedTuple):
    """The part of a step that is looked at next, where the step has length 1; how often was looked; and whether a pulse was seen."""

    low: Any
    width: Any
    looks: Any
    found: Any


def hides_pulse(equations: FirstOrderSystem, nodes: np.ndarray, t0, t1, y, args: Arguments) -> Bool[Array, ""]:
    """Whether a function of time goes, within a step, far beyond what the stages see of it, which are at `nodes`, from 0 to 1.

    Of such a pulse the error of the step does not know. Not differentiated.
    """
    if not equations.follows_time:
        return jnp.array(False)
    t0, t1, y, args = undifferentiated((t0, t1, y, args))
    functions = time_functions(lambda t, y: equations.as_written.rates(t, y, args), t0, y)
    if functions is None:
        return jnp.array(False)
    assert args.scales is not None  # of every motion
    given = functions, nodes, t0, t1, args.scales.duration
    found = functions.are_bounded and _in_bounded(*given)
    return (found | (functions.are_read and _in_read(*given))) & (t1 - t0 > BRIEF * args.scales.duration)


def _in_bounded(functions: TimeFunctions, nodes, t0, t1, duration):
    """Whether one with bounds goes beyond what was seen of it."""
    at = lambda share: (t0 + share * (t1 - t0)).astype(t0.dtype)
    seen = jax.vmap(functions.values)(at(nodes))
    least, most = jnp.min(seen, axis=0), jnp.max(seen, axis=0)

    def look(search: _Search) -> _Search:
        """Goes on to the next part where this one hides nothing or is brief, and otherwise to the first half of it."""
        end = jnp.minimum(search.low + search.width, 1)
        middle, length = functions.values(at((search.low + end) / 2)), (end - search.low) * (t1 - t0)
        ends = jnp.stack([at(search.low), t0]), jnp.stack([at(end), t0 + duration])
        (low, least_of_all), (high, most_of_all) = jax.vmap(functions.bounds)(*ends)
        largest = jnp.maximum(-least_of_all, most_of_all)
        largest = jnp.where(jnp.isfinite(largest), largest, jnp.maximum(-least, most))
        beside = (most - least) / 2 + FAINT * largest
        within = lambda low, high: (low >= least - beside) & (high <= most + beside)
        brief = jnp.where(jnp.isfinite(high - low), BRIEF, UNBOUNDED) * duration
        return _gone_on(
            search, end, jnp.any(~within(low, high) & (length > brief)), jnp.any(~within(middle, middle) & jnp.isfinite(middle))
        )

    return _searched(look, t0.dtype)


def _in_read(functions: TimeFunctions, nodes, t0, t1, duration):
    """Whether one that is read of a table goes beyond what was seen of it."""
    at = lambda share: (t0 + share * (t1 - t0)).astype(t0.dtype)
    seen, _ = jax.vmap(functions.read)(at(nodes))
    least, most = jnp.min(seen, axis=0, keepdims=True), jnp.max(seen, axis=0, keepdims=True)
    beside = (most - least) / 2 + FAINT_IN_TABLE * jnp.maximum(-least, most)

    def look(search: _Search) -> _Search:
        """Goes on to the next part where no more than one knot lies between two looks, and otherwise to the first half of it."""
        end = jnp.minimum(search.low + search.width, 1)
        values, places = jax.vmap(functions.read)(at(search.low + (end - search.low) * np.linspace(0, 1, AT_ONCE + 1)))
        apart = (end - search.low) * (t1 - t0) / AT_ONCE
        skips = jnp.any(jnp.abs(jnp.diff(places, axis=0)) > 1) & (apart > BRIEF * duration)
        if not functions.are_known:
            skips |= apart > UNBOUNDED * duration
        beyond = (values < least - beside) | (values > most + beside)
        return _gone_on(search, end, skips, jnp.any(beyond) | (search.looks + 1 >= LOOKS))

    return _searched(look, t0.dtype)


def _gone_on(search: _Search, end, halves, found) -> _Search:
    low, width = jnp.where(halves, search.low, end), jnp.where(halves, 0.5, 2) * search.width
    return _Search(low, width, search.looks + 1, found)


def _searched(look: Callable, dtype):
    start = _Search(jnp.zeros((), dtype), jnp.ones((), dtype), 0, jnp.array(False))
    return jax.lax.while_loop(lambda search: (search.low < 1) & ~search.found & (search.looks < LOOKS), look, start).found


def nodes_of(solver: Any) -> np.ndarray:
    """The times, from 0 to 1, of the stages of a step that its error is estimated from."""
    tableau = getattr(solver, "tableau", None) or getattr(getattr(solver, "scheme", None), "tableau", None)
    if tableau is None:
        return np.linspace(0, 1, 5)
    estimates = tableau.errors if isinstance(tableau, Tableau) else [tableau.b_error]
    times = tableau.c if isinstance(tableau, Tableau) else [0.0, *tableau.c]
    return np.unique(np.clip([c for weights in estimates for c, weight in zip(times, weights, strict=False) if weight], 0, 1))
