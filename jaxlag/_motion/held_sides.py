"""On which side of the surface of an event forces are taken: on that where the motion is, to the very end of a step that ends there."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._mechanics.contact import roundings
from .._model.flat import Flat
from .._model.injection import asks_for
from .._model.state_values import ravelled

CLEARLY = 4  # roundings of a witness, from which on a comparison sees its side


def on_held_sides(flat: Flat, t, parts: Any, args: Any, levels: tuple[int, ...], below: int | None = None) -> tuple[Any, Any]:
    """The time and the state at which forces are taken: where a witness has not its sign by a few roundings, the nearest where it has.
    Witnesses come by their `levels`, since some jump where others pass through zero; only those `below` a level, if one is given.

    So a stage on the surface itself, or just beyond, does not see what holds behind, and the derivative by the time at which the motion
    arrives has the forces of both sides. The way there is not differentiated. Witnesses of constraint forces are not followed.
    """
    if args.scales is None:
        return t, parts
    for level in sorted(set(levels)):
        if below is None or level < below:
            t, parts = _moved(flat, t, parts, args, (np.array(levels) == level) & _follow_the_state(flat, len(levels)))
    return t, parts


def _follow_the_state(flat, count) -> np.ndarray:
    """Which witnesses do, rather than constraint forces."""
    of_forces = [callable(event.when) and asks_for(event.when, "multipliers") for _, event in flat.source.system.events]
    return ~np.array(of_forces + [False] * (count - len(of_forces)), bool)


def _moved(flat, t, parts, args, follows):
    given = jax.lax.stop_gradient((t[None], parts.q, parts.v))
    at = lambda t, q, v: flat.witnesses(t[0], q, v, jnp.zeros(flat.rows, v.dtype))
    value, slopes = at(*given), jax.jacfwd(at, argnums=(0, 1, 2))(*given)
    size = roundings(given[0], args.scales.duration), *args.scales.roundings(parts.q, parts.v)
    least = CLEARLY * sum(jnp.abs(by) @ of for by, of in zip(slopes, size, strict=True))
    far = least - parts.sign * value
    amount = jnp.where((far > 0) & (parts.sign != 0) & follows, parts.sign * far, 0)
    squares = sum(by**2 @ of**2 for by, of in zip(slopes, size, strict=True))
    amount = amount / jnp.where(squares > 0, squares, jnp.inf)
    dt, dq, dv = (of**2 * (amount @ by) for by, of in zip(slopes, size, strict=True))
    dz = dt[0] * ravelled(flat.state_rates(t, parts.q, parts.v), parts.z.dtype)  # states flow with the time
    dt, dq, dv, dz = jax.lax.stop_gradient((dt[0], dq, dv, dz))
    return t + dt, parts._replace(q=parts.q + dq, v=parts.v + dv, z=parts.z + dz)
