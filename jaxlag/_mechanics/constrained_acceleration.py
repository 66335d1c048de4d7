"""Acceleration and multipliers of a state: Lagrange's equations of the first kind, solved."""

import jax
import jax.numpy as jnp

from .._model.flat import Flat
from .lagrange import applied_force, inertia, velocity_residual, velocity_rows
from .massless import completed, first_order, inertial_part
from .saddle_point import SaddlePoint, Sound, saddle_point

MULTIPLIER_ITERATIONS = 3


def constrained_acceleration(flat: Flat, t, q, v, feedback=None) -> SaddlePoint:
    """q̈ and λ of  M q̈ = f + Gᵀλ,  G q̈ = −γ − feedback(t, q, v); of coordinates without inertia, the rate of the velocity that D decides."""
    z, _ = first_order(flat, t, q, v)
    if not z.size:
        return _by_inertia(flat, t, q, v, feedback)
    decided = lambda t, q, v: completed(flat, t, q, v)
    v, multipliers, sound = decided(t, q, v)
    _, pull = jax.vjp(lambda v: velocity_residual(flat, t, q, v), v)
    found = _by_inertia(inertial_part(flat, t, q, v, pull(multipliers)[0]), t, q, v, feedback)
    _, rate = jax.jvp(lambda t, q, v: decided(t, q, v).v, (t, q, v), (jnp.ones_like(t), v, found.x))
    is_sound = Sound(*(a & b for a, b in zip(sound, found.sound, strict=True)))
    return SaddlePoint(found.x.at[z].set(rate[z]), found.multipliers + multipliers, is_sound)


def _by_inertia(flat: Flat, t, q, v, feedback) -> SaddlePoint:
    """q̈ and λ where everything has inertia, or is held by constraints."""
    M, inertial = inertia(flat, t, q, v)
    _, G, gamma = velocity_rows(flat, t, q, v)
    c = -gamma if feedback is None else -gamma - feedback(flat, t, q, v)
    force = lambda multipliers: applied_force(flat, t, q, v, multipliers)
    if not flat.needs_multipliers:
        found = saddle_point(M, G, inertial + force(jnp.zeros_like(c)), c)
        return found._replace(multipliers=_pushing(flat, found.multipliers))
    # The solution is affine in the force, which is part of it by λ: one solve says how.
    beside = lambda vector, matrix: jnp.concatenate([vector[:, None], matrix], axis=1)
    columns = saddle_point(M, G, beside(inertial, jnp.eye(v.size, dtype=v.dtype)), beside(c, jnp.zeros((c.size, v.size), v.dtype)))
    affine = lambda columns, force: columns[:, 0] + columns[:, 1:] @ force
    reaction = lambda multipliers: affine(columns.multipliers, force(_pushing(flat, multipliers)))
    multipliers = _pushing(flat, _self_consistent(reaction, jnp.zeros_like(c)))
    return SaddlePoint(affine(columns.x, force(multipliers)), multipliers, columns.sound)


def _pushing(flat: Flat, multipliers):
    """λ, that of an open contact zero and no rounding."""
    if flat.closed is None:
        return multipliers
    start, end = flat.rows_of_bilateral, flat.rows_of_bilateral + len(flat.contacts)
    before, of_contacts, behind = jnp.split(multipliers, [start, end])
    return jnp.concatenate([before, jnp.where(flat.closed, of_contacts, 0), behind])


def _self_consistent(reaction, start):
    """λ = reaction(λ) by Newton's method, where applied forces depend on the constraint forces they bring about.

    It is exact at once where the forces are linear in λ, as friction is. NaN where 1 − ∂reaction/∂λ has no positive determinant:
    then no λ, or more than one, solves it (Painlevé's paradox; Genot & Brogliato, Eur. J. Mech. A 18 (1999) 653).
    """

    def newton(multipliers, _):
        slope = jnp.eye(start.size, dtype=start.dtype) - jax.jacfwd(reaction)(multipliers)
        step = jnp.linalg.solve(slope, reaction(multipliers) - multipliers)
        return jnp.where(jnp.linalg.det(slope) > 0, multipliers + step, jnp.nan), None

    return jax.lax.scan(newton, start, length=MULTIPLIER_ITERATIONS)[0]
