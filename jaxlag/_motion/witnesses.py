"""Witnesses of events: functions of the state that pass through zero where something happens."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._mechanics.contact import roundings
from .._model.event import Either, Rising
from .._model.flat import Flat
from .first_order import EquationsOfMotion
from .state_vector import Parts


def witness_margins(flat: Flat, t, parts: Parts) -> tuple[Float[Array, " w"], Float[Array, " w"]]:
    """Of each witness, its value with the sign that it has until it passes through zero, and what of it counts as rounding."""
    value, scale = _value_and_scale(flat, t, parts, roundings(parts.q), roundings(parts.v))
    return parts.sign * value, scale


def _value_and_scale(flat, t, parts, of_q, of_v):
    """Of each witness, its value, and what errors of q and q̇ amount to in it."""
    of = lambda t, q, v: flat.witnesses(t, q, v, jax.lax.stop_gradient(parts.happened))
    by_t, by_q, by_v = (jnp.abs(by) for by in jax.lax.stop_gradient(jax.jacfwd(of, argnums=(0, 1, 2))(t, parts.q, parts.v)))
    return of(t, parts.q, parts.v), by_t * roundings(t[None]) + jnp.sum(by_q * of_q[None], axis=1) + jnp.sum(by_v * of_v[None], axis=1)


def signs(flat: Flat, t, parts: Parts, qddot: Float[Array, " n"], of_q: Float[Array, " n"], of_v: Float[Array, " n"]) -> Float[Array, " w"]:
    """On which side of zero each witness is; of one that is zero but for errors of q and q̇, to which side it goes."""
    value, scale = _value_and_scale(flat, t, parts, of_q, of_v)
    of = lambda t, q, v: flat.witnesses(t, q, v, parts.happened)
    rate = jax.jvp(of, (t, parts.q, parts.v), (jnp.ones_like(t), parts.v, qddot))[1]
    side = jnp.where(jnp.abs(value) > scale, value, rate)
    return jax.lax.stop_gradient(jnp.where(side < 0, -1.0, 1.0).astype(value.dtype))


def matching(equations: EquationsOfMotion, sign: Float[Array, " w"]) -> Bool[Array, " w"]:
    """Which events happen where their witness had this sign and loses it."""
    of = [event.direction for _, event in equations.system.events]
    falls = np.array([not isinstance(direction, Rising) for direction in of])
    rises = np.array([isinstance(direction, (Rising, Either)) for direction in of])
    return jnp.where(sign > 0, falls, rises)
