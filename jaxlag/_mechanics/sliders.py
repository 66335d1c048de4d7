"""Coordinates z without inertia that dry friction alone resists, with springs and inputs beside it, as in Jenkin's elements.

    sticks   s(t, q, q̇) = 0,   μ = −h/a with a = ∂s/∂ż
    slips    dh/dt = 0,        h = 0

h(t, q) is the force on z: where it slips, with friction at its bound. Either says ż from the velocities of what has inertia, and μ: nothing
of them is integrated, and no multiplier is solved for.
Source: Iwan, J. Appl. Mech. 33 (1966) 893; Simo & Hughes, Computational Inelasticity, section 1.2.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._model.flat import Flat, read_once
from .._program.size_of_terms import size_of_terms
from .._program.sparsity import sparsity_pattern
from .lagrange import smooth_force


class Sliders(NamedTuple):
    """In one mode of friction: the coordinates z, of each its row of ψ, whether it sticks, and its slip velocity; and the nonholonomic rows
    of all the others.
    """

    coordinates: Int[np.ndarray, " k"]
    rows: Int[np.ndarray, " k"]
    stuck: Bool[Array, " k"]
    slip: Callable[..., Float[Array, " k"]]  # s(t, q, v)
    beside: Callable[..., Float[Array, " o"]]  # (t, q, v)


def are_of_sliders(flat: Flat, rows: int) -> Bool[np.ndarray, " m"]:
    """Which of the rows of ψ are those of sliders."""
    return np.zeros(rows, bool) if flat.sliders is None else np.isin(np.arange(rows), flat.sliders.rows)


class SlidersMotion(NamedTuple):
    """Velocities of sliders, their multipliers, and the forces Gᵀμ of these."""

    v: Float[Array, " k"]
    multipliers: Float[Array, " k"]
    reaction: Float[Array, " n"]


def force_on_sliders(flat: Flat, t, q) -> Float[Array, " k"]:
    """h, in the mode of `flat`: none of these forces depends on velocities."""
    return smooth_force(flat, t, q, jnp.zeros_like(q))[flat.sliders.coordinates]


def rates_of_forces(flat: Flat, t, q, v) -> Float[Array, " k"]:
    """dh/dt."""
    return jax.jvp(lambda t, q: force_on_sliders(flat, t, q), (t, q), (jnp.ones_like(t), v))[1]


def motion_of_sliders(flat: Flat, t, q, v) -> SlidersMotion:
    """How sliders move with the velocities of the rest, and what they hold; of what slips, friction is among the forces of its mode."""
    z, _, stuck, slip, _ = flat.sliders
    v, along = v.at[z].set(0), jnp.zeros_like(v).at[z].set(1)
    s, by_velocity = jax.linearize(lambda v: slip(t, q, v), v)
    slope = by_velocity(along)  # a slip depends on no slider but its own
    h, change = jax.linearize(lambda t, q: force_on_sliders(flat, t, q), t, q)
    multipliers = jnp.where(stuck, -h / jnp.where(stuck, slope, 1), 0)
    own = lambda x: change(jnp.zeros_like(t), jnp.zeros_like(q).at[z].set(x))
    rates = _solved(flat, own, slope, jnp.where(stuck, s, change(jnp.ones_like(t), v)))
    return SlidersMotion(rates, multipliers, jax.linear_transpose(by_velocity, v)(multipliers)[0])


def rounding_of_multipliers(flat: Flat, t, q, v) -> Float[Array, " k"]:
    """What μ may be off by: where slip ends, the force on a slider is at its bound, and springs of far larger forces may cancel in it."""
    z, _, _, slip, _ = flat.sliders
    slope = jax.jvp(lambda v: slip(t, q, v), (v,), (jnp.zeros_like(v).at[z].set(1),))[1]
    terms = size_of_terms(lambda q: force_on_sliders(flat, t, q), q)
    return jax.lax.stop_gradient(10 * jnp.finfo(q.dtype).eps * terms / jnp.abs(slope))


def with_sliders_returned(flat: Flat, t, q) -> Float[Array, " n"]:
    """q with what slips moved towards h = 0, by one step of Newton's method."""
    z, stuck = flat.sliders.coordinates, flat.sliders.stuck
    h, change = jax.linearize(lambda x: force_on_sliders(flat, t, q.at[z].set(x)), q[z])
    return q.at[z].add(_solved(flat, change, jnp.ones_like(h), jnp.where(stuck, 0, h)))


def _solved(flat: Flat, change: Callable, slope: Float[Array, " k"], off: Float[Array, " k"]) -> Float[Array, " k"]:
    """Of each slider what takes `off` to zero: by its own `slope` where it sticks, and together by the `change` of h where they slip."""
    stuck, one = flat.sliders.stuck, jnp.ones_like(off)
    if are_apart(flat):
        return -off / jnp.where(stuck, slope, change(one))
    return -jnp.linalg.solve(jnp.where(stuck[:, None], jnp.diag(slope), jax.vmap(change, 0, 1)(jnp.diag(one))), off)


def are_apart(flat: Flat) -> bool:
    """Whether the force on a slider depends on no other one, as is seen in the programs."""
    return read_once(flat, _are_apart)


def _are_apart(flat: Flat, t, q, v) -> bool:
    z = flat.sliders.coordinates
    pattern = sparsity_pattern(lambda x: force_on_sliders(flat, t, q.at[z].set(x)), q[z])
    return not np.any(pattern & ~np.eye(z.size, dtype=bool))
