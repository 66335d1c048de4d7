"""On which side of the surface of an event forces are taken: on that where the motion is, to the very end of a step that ends there."""

from typing import Any

import jax
import jax.numpy as jnp

from .._model.flat import Flat

CLEARLY = 4  # roundings of a witness, from which on a comparison sees its side


def on_held_sides(flat: Flat, t, parts: Any, args: Any) -> Any:
    """The state at which forces are taken: where a witness has not its sign by a few roundings, the nearest one where it has.

    So a stage on the surface itself, or just beyond, does not see what holds behind, and the derivative by the time at which the motion
    arrives has the forces of both sides. The way there is not differentiated. Witnesses of constraint forces are not followed.
    """
    if args.scales is None or flat.events_need_multipliers:
        return parts
    given = jax.lax.stop_gradient((parts.q, parts.v))
    at = lambda q, v: flat.witnesses(t, q, v, jnp.zeros(flat.rows, v.dtype))
    value, slopes = at(*given), jax.jacfwd(at, argnums=(0, 1))(*given)
    size = args.scales.roundings(parts.q, parts.v)
    least = CLEARLY * sum(jnp.abs(by) @ of for by, of in zip(slopes, size, strict=True))
    far = least - parts.sign * value
    amount = jnp.where((far > 0) & (parts.sign != 0), parts.sign * far, 0)
    squares = sum(by**2 @ of**2 for by, of in zip(slopes, size, strict=True))
    amount = amount / jnp.where(squares > 0, squares, jnp.inf)
    dq, dv = (of**2 * (amount @ by) for by, of in zip(slopes, size, strict=True))
    dq, dv = jax.lax.stop_gradient((dq, dv))
    return parts._replace(q=parts.q + dq, v=parts.v + dv)
