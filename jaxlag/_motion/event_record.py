"""What is recorded of events: each is a row behind the samples of a motion."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from .first_order import EquationsOfMotion
from .protocol import FirstOrderSystem

OFTEN = 1000  # crossings


def most(equations: FirstOrderSystem) -> np.ndarray:
    """How many of each event are recorded."""
    events = equations.system.events if isinstance(equations, EquationsOfMotion) else ()
    return np.array([event.most for _, event in events], int)


def with_events(equations: FirstOrderSystem, write: Callable, saved, samples: int, before: Float[Array, " y"] | None, y, number: Callable):
    """What is saved, and behind the `samples` each event that has happened since y was as it was `before`, or ever.

    `number(y)` is y without its variations.
    """
    if not (isinstance(equations, EquationsOfMotion) and equations.system.events):
        return saved
    now = equations.parts(number(y)).happened
    earlier = jnp.zeros_like(now) if before is None else equations.parts(before).happened
    start = samples
    for i, rows in enumerate(most(equations)):
        saved = write(saved, start + earlier[i].astype(int), y, (now[i] > earlier[i]) & (earlier[i] < rows))
        start += rows
    return saved


def records(
    equations: EquationsOfMotion, rows: Float[Array, "r y"], origin: Any
) -> dict[str, tuple[Array, PyTree, PyTree, dict[str, PyTree]]]:
    """By name, the times of events and q, q̇ and the states before each, from the rows behind the samples, on a clock whose zero is the
    `origin`; NaN beyond the last.
    """

    def of_one(y):
        sizes = 1, equations.size, equations.size, equations.states.size
        t, q, v, z, u = jnp.split(equations.parts(y).seen, np.cumsum(sizes))
        states = equations.states.unravelled(z) | equations.sampled.unravelled(u)
        return origin + t[0], equations.like.unravelled(q), equations.like.unravelled(v), states

    of_each = jnp.split(rows, np.cumsum(most(equations))[:-1])
    return {name: jax.vmap(of_one)(of) for (name, _), of in zip(equations.system.events, of_each, strict=False)}


def has_stopped(equations: FirstOrderSystem, y) -> Bool[Array, ""]:
    """Whether an event has ended the motion."""
    return jnp.any(equations.parts(y).stopped > 0) if isinstance(equations, EquationsOfMotion) else jnp.array(False)


def overflows(equations: EquationsOfMotion, y) -> Bool[Array, ""]:
    """Whether more events happened than are recorded."""
    return jnp.any(equations.parts(y).happened[: len(equations.system.events)] > most(equations))


def rattles(equations: EquationsOfMotion, y) -> Bool[Array, ""]:
    """Whether a surface of the position was crossed so often that a motion that has come no farther rattles about it."""
    return jnp.any(equations.parts(y).happened[len(equations.system.events) :] > OFTEN)
