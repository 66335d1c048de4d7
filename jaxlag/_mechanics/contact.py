"""Unilateral contact at one state: which contacts are closed.

    g ≥ 0,  λ ≥ 0,  g λ = 0        of positions;  and where g = 0 and ġ = 0:   g̈ ≥ 0,  λ ≥ 0,  g̈ λ = 0

A closed contact is a row of G, g = 0; an open one is a row of zeros, whose λ is zero. In each choice of the closed ones the system is an
ordinary one, with or without dry friction, so the rest of the package need not know about contact.
Source: Pfeiffer & Glocker, Multibody Dynamics with Unilateral Contacts, chapters 5 and 6; Glocker, Set-Valued Force Laws, chapter 10.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._model.flat import Flat
from .friction_elements import FrictionElements, find_elements
from .lagrange import inertia, position_residual
from .saddle_point import constrained_acceleration, reach_of, saddle_point
from .stick_slip import Mode, first_mode, friction, in_mode

ROUNDING = 1e4  # times eps, what counts as rounding of a gap, its rate, its acceleration and its force


def in_contact(flat: Flat, closed: Bool[Array, " c"]) -> Flat:
    """The system with these contacts closed."""

    def holonomic(t, q):
        return jnp.concatenate([flat.bilateral(t, q), jnp.where(closed, flat.gaps(t, q), 0)])

    return flat._replace(holonomic=holonomic) if flat.contacts else flat


def contact_rows(flat: Flat, multipliers: Float[Array, " m"]) -> Float[Array, " c"]:
    """Of the multipliers of all rows, those of the contacts."""
    holonomic = flat.rows_of_bilateral
    return multipliers[holonomic : holonomic + len(flat.contacts)]


def gap_rates(flat: Flat, t, q, v) -> Float[Array, " c"]:
    """ġ of all contacts."""
    return jax.jvp(flat.gaps, (t, q), (jnp.ones_like(t), v))[1]


def gap_accelerations(flat: Flat, t, q, v, qddot) -> Float[Array, " c"]:
    """g̈ of all contacts."""
    return jax.jvp(lambda t, q, v: gap_rates(flat, t, q, v), (t, q, v), (jnp.ones_like(t), v, qddot))[1]


def on_contact(flat: Flat, t, q, v, closed: Bool[Array, " c"]) -> Float[Array, " n"]:
    """q, put on these contacts where it is but for rounding, and so are its derivatives: of many impacts they would add up."""
    g, G = position_residual(in_contact(flat, closed), t, q)
    return q + saddle_point(inertia(flat, t, q, v)[0], G, jnp.zeros_like(q), -g, reach_of(q)).x


class GapScales(NamedTuple):
    """Of each contact, the gap and the rate of approach that errors of positions and velocities amount to."""

    gap: Float[Array, " c"]
    rate: Float[Array, " c"]


def gap_scales(flat: Flat, t, q, v, of_positions: Float[Array, " n"], of_velocities: Float[Array, " n"]) -> GapScales:
    """Those of these errors."""
    G = jnp.abs(jax.lax.stop_gradient(jax.jacfwd(flat.gaps, argnums=1)(t, q)))
    return GapScales(G @ of_positions, G @ of_velocities)


def roundings(x: Float[Array, " n"]) -> Float[Array, " n"]:
    """Of each number of a state, what counts as its rounding, with some for a state that is zero."""
    eps = ROUNDING * jnp.finfo(x.dtype).eps
    return eps * jnp.abs(jax.lax.stop_gradient(x)) + eps**2


class Closed(NamedTuple):
    """Which contacts are closed; the mode of friction with them, where there is any; whether forces and accelerations are consistent."""

    closed: Bool[Array, " c"]
    mode: Mode | None
    consistent: Bool[Array, ""]


class _Search(NamedTuple):
    turn: Any
    closed: Bool[Array, " c"]
    mode: Mode | None
    changed: Bool[Array, ""]


def select_closed(flat: Flat, elements: FrictionElements | None, t, q, v, candidates: Bool[Array, " c"], mode_of: Callable) -> Closed:
    """Which of the `candidates`, contacts with g = 0 and ġ = 0, stay closed; `mode_of(flat)` is the mode of friction with some closed.

    All candidates are closed at first. One by one, the contact that pulls most opens, and where none pulls, the one that goes deepest
    closes, until none pulls and none goes deeper. If that takes long, they change in the order of their numbers, which ends without
    friction in any case (Murty, Linear Complementarity, chapter 4).
    """
    t, q, v = jax.lax.stop_gradient((t, q, v))
    pull_scale, deep_scale = _scales(flat, t, q, v)
    size = len(flat.contacts)

    def solved(closed):
        with_closed = in_contact(flat, closed)
        if elements is None:
            qddot, multipliers, _ = constrained_acceleration(with_closed, t, q, v)
            return None, qddot, multipliers
        mode = mode_of(with_closed)
        found = friction(with_closed, elements, mode.sigma, t, q, v)
        return mode, found.qddot, found.multipliers

    def turn(search):
        mode, qddot, multipliers = jax.lax.stop_gradient(solved(search.closed))
        pull = jnp.where(search.closed, -contact_rows(flat, multipliers) - pull_scale, -jnp.inf)
        deeper = jnp.where(candidates & ~search.closed, -gap_accelerations(flat, t, q, v, qddot) - deep_scale, -jnp.inf)
        excess = jnp.where(jnp.any(pull > 0), pull, deeper)
        in_order = jnp.where((pull > 0) | (deeper > 0), -jnp.arange(size, dtype=v.dtype) + size, 0)
        excess = jnp.where(search.turn > 2 * size, in_order, excess)
        flips = (jnp.arange(size) == jnp.argmax(excess)) & (excess > 0)
        return _Search(search.turn + 1, search.closed ^ flips, mode, jnp.any(flips))

    def going_on(search):
        return search.changed & (search.turn < 4 * size + 2 ** size.bit_length() + 8)

    mode = None if elements is None else jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(mode_of, flat))
    done = jax.lax.while_loop(going_on, turn, _Search(0, candidates, mode, jnp.array(True)))
    consistent = ~done.changed if done.mode is None else ~done.changed & done.mode.consistent
    return Closed(done.closed, done.mode, consistent)


def _scales(flat, t, q, v):
    """Of each contact, the force and the acceleration that count as rounding, beside those of the motion without contact."""
    free = constrained_acceleration(flat, t, q, v).x
    G = jnp.abs(jax.jacfwd(flat.gaps, argnums=1)(t, q))
    drift = jnp.abs(gap_accelerations(flat, t, q, v, jnp.zeros_like(v)))
    force, size = jnp.abs(inertia(flat, t, q, v)[0].mv(free)), jnp.sum(G**2, axis=1)
    eps = ROUNDING * jnp.finfo(v.dtype).eps
    return eps * (G @ force) / jnp.where(size > 0, size, 1), eps * (G @ jnp.abs(free) + drift)


def touching(flat: Flat, t, q, v, scales: GapScales) -> tuple[Bool[Array, " c"], Bool[Array, " c"]]:
    """Which contacts touch, and which of these neither open nor close."""
    near = jax.lax.stop_gradient(flat.gaps(t, q)) <= scales.gap
    return near, near & (jnp.abs(gap_rates(flat, t, q, v)) <= scales.rate)


def in_current_mode(flat: Flat, t, q, v) -> Flat:
    """The system in the mode that holds at this state: its closed contacts among the constraints, its dry friction sliding or sticking.

    Contacts that touch and neither open nor close, to rounding, are closed where they push.
    """
    elements = find_elements(flat, t, q, v)
    if flat.contacts:
        scales = gap_scales(flat, t, q, v, roundings(q) + roundings(jnp.ones_like(q)), roundings(v) + roundings(jnp.ones_like(v)))
        candidates = touching(flat, t, q, v, scales)[1]
        chosen = select_closed(flat, elements, t, q, v, candidates, lambda flat: first_mode(flat, elements, t, q, v))
        flat = in_contact(flat, chosen.closed)
        return flat if chosen.mode is None else in_mode(flat, elements, chosen.mode.sigma)
    return flat if elements is None else in_mode(flat, elements, first_mode(flat, elements, t, q, v).sigma)
