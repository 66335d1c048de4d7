"""Acceleration and multipliers of a state: Lagrange's equations of the first kind, solved."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._model.flat import Flat
from .._program.sparse_matrix import dense
from .lagrange import applied_force, inertia, inertial_force, velocity_rows
from .massless import inertial_part, with_first_order_rates, without_inertia
from .pseudo_inverse import Constraints
from .saddle_point import SaddlePoint, Sound, saddle_point, saddle_point_beside
from .self_consistent import others, self_consistent
from .sliders import are_of_sliders


def constrained_acceleration(flat: Flat, t, q, v, feedback=None) -> SaddlePoint:
    """q̈ and λ of  M q̈ = f + Gᵀλ,  G q̈ = −γ − feedback(t, q, v); of coordinates without inertia, the rate of the velocity that D decides."""
    return constrained_motion(flat, t, q, v, feedback)[1]


def constrained_motion(flat: Flat, t, q, v, feedback=None) -> tuple[Float[Array, " n"], SaddlePoint]:
    """q̇ with the velocities that D decides, and q̈ and λ."""
    light = without_inertia(flat)
    if not light.size:
        return v, _by_inertia(flat, t, q, v, feedback, light)
    (v, multipliers, reaction, sound), along = jax.linearize(lambda t, q, v: with_first_order_rates(flat, t, q, v), t, q, v)
    found = _by_inertia(inertial_part(flat, t, q, v, reaction), t, q, v, feedback, light)
    rate = along(jnp.ones_like(t), v, found.x).v
    is_sound = Sound(*(a & b for a, b in zip(sound, found.sound, strict=True)))
    kept = np.flatnonzero(~are_of_sliders(flat, multipliers.size))
    return v, SaddlePoint(found.x.at[light].set(rate[light]), multipliers.at[kept].add(found.multipliers), is_sound)


def _by_inertia(flat: Flat, t, q, v, feedback, light: np.ndarray) -> SaddlePoint:
    """q̈ and λ where everything has inertia, or is held by constraints; those `light` have that of another part."""
    M, inertial = inertia(flat, t, q, v), inertial_force(flat, t, q, v)
    _, G, gamma = velocity_rows(flat, t, q, v)
    c = -gamma if feedback is None else -gamma - feedback(flat, t, q, v)
    force = lambda multipliers: applied_force(flat, t, q, v, multipliers)
    if not flat.needs_multipliers:
        found = saddle_point_beside(light, M, G, inertial + force(jnp.zeros_like(c)), c, near=_near(flat, t, q, v, c.size))
        return found._replace(multipliers=_pushing(flat, found.multipliers))
    columns, reaction, unit = _by_force(flat, M, G, inertial, c, force, _near(flat, t, q, v, c.size))
    multipliers = _pushing(flat, self_consistent(reaction, unit))
    return SaddlePoint(_affine(columns.x, force(multipliers)), multipliers, columns.sound)


def _near(flat: Flat, t, q, v, rows: int) -> Constraints | None:
    """The constraints about a state within a step, which is off them by its error; one row depends on no other."""
    if not flat.holonomic_names or rows < 2:
        return None

    def off():
        g = jax.lax.stop_gradient(flat.holonomic(t, q))
        return jnp.pad(g, (0, rows - g.size))

    return Constraints(off, lambda change: jax.lax.stop_gradient(dense(velocity_rows(flat, t, q + change, v)[1])))


def _by_force(flat: Flat, M, G, inertial, c, force: Callable, near=None) -> tuple[SaddlePoint, Callable, Float[Array, " m"]]:
    """The solution, which is affine in the applied force: beside that without one, what each force adds; λ ↦ the λ that the forces of λ
    bring about; and a unit of each: as large as the forces of one size, in the metric of M, make it.
    """
    beside = lambda vector, matrix: jnp.concatenate([vector[:, None], matrix], axis=1)
    n, dtype = inertial.size, inertial.dtype
    columns = saddle_point(M, G, beside(inertial, jnp.eye(n, dtype=dtype)), beside(c, jnp.zeros((c.size, n), dtype)), near=near)
    reaction = lambda multipliers: _affine(columns.multipliers, force(_pushing(flat, multipliers)))
    by_force = columns.multipliers[:, 1:]
    size = jnp.sqrt(jnp.sum(by_force.T * jax.vmap(M.mv, 1, 1)(by_force.T), axis=0))
    return columns, reaction, jnp.where(size > 0, size, 1)


def _affine(columns, force):
    return columns[:, 0] + columns[:, 1:] @ force


def other_multipliers(flat: Flat, t, q, v, multipliers) -> Float[Array, "o m"]:
    """Others than those known with which the forces that depend on λ agree, as far as a search finds some; NaN where it does not."""
    M, inertial = inertia(flat, t, q, v), inertial_force(flat, t, q, v)
    _, G, gamma = velocity_rows(flat, t, q, v)
    _, reaction, unit = _by_force(flat, M, G, inertial, -gamma, lambda multipliers: applied_force(flat, t, q, v, multipliers))
    return others(reaction, multipliers, unit, jax.random.key(0))


def _pushing(flat: Flat, multipliers):
    """λ, that of an open contact zero and no rounding."""
    if flat.closed is None:
        return multipliers
    start, end = flat.rows_of_bilateral, flat.rows_of_bilateral + len(flat.contacts)
    before, of_contacts, behind = jnp.split(multipliers, [start, end])
    return jnp.concatenate([before, jnp.where(flat.closed, of_contacts, 0), behind])
