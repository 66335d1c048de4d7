"""Coordinates without inertia, whose velocities the dissipation function decides.

    ∂D/∂ż = ∂L/∂z + Q_z + (Gᵀλ)_z,      ψ(t, q, q̇) = 0 in the rows of ψ that ż is in

Where M has rows of zeros, Lagrange's equations hold no q̈: they say ż, and λ of these rows, from t, q and the velocities of what has
inertia. So ż is no part of the state. A coordinate without inertia that constraints hold as they are is left to them.
Source: Onsager, Phys. Rev. 37 (1931) 405; Doi, J. Phys.: Condens. Matter 23 (2011) 284118, section 2.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._model.flat import Flat
from .._program.sparse_jacobian import jacobian, sparsity_pattern, underdetermined
from .convex_dissipation import by_newton, smooth_force
from .lagrange import constraint_rows, inertia, velocity_residual
from .saddle_point import Sound, reach_of, saddle_point
from .self_consistent import is_affine

RECIPROCAL = (
    "`lagrangian` and `force` must not couple the velocities of coordinates without inertia among each other, but do. "
    "Give these coordinates inertia, or write the coupling as a dissipation function."
)
NO_MULTIPLIERS = (
    "`dissipation` and `force` must not depend on `multipliers` where coordinates have no inertia, but one does. "
    "Give these coordinates a mass, or write the force by the coordinates."
)
SEVERAL = (
    "`dissipation` must hold a coordinate without inertia by one dry friction on one slip velocity, with springs and inputs beside it, but "
    "has another form: a slip between two such coordinates, in a plane, or with forces that depend on other velocities. "
    "Give the coordinate a mass, or a dashpot beside its friction."
)
NO_CONTACT = (
    "`unilateral` must not touch coordinates without inertia, but does: an impact would need their mass. "
    "Give these coordinates a mass, or state the contact for those that have one."
)


class FirstOrder(NamedTuple):
    """Coordinates z whose velocities D decides, and which rows of ψ these are in: both seen in the programs."""

    coordinates: Int[np.ndarray, " k"]
    rows: Bool[np.ndarray, " m"]


def first_order(flat: Flat, t, q, v) -> FirstOrder:
    """Those of the massless coordinates that constraints alone cannot hold, and that D, or a constraint with it, gives a velocity."""
    if not flat.massless:
        return FirstOrder(np.zeros(0, int), np.zeros(flat.rows, bool))
    massless, in_rows = np.array(flat.massless), _rows_with(flat, t, q, v)
    moved = lambda w: v.at[massless].set(w)
    decay = lambda dw: jax.jvp(lambda w: smooth_force(flat, t, q, moved(w))[massless], (v[massless],), (dw,))[1]
    resisted = np.any(sparsity_pattern(decay, v[massless]), axis=1)
    stated, of_contacts = _stated_rows(flat, t, q)
    decided = underdetermined(in_rows[stated]) & (resisted | np.any(in_rows[stated], axis=0))
    rows = np.any(in_rows[:, decided], axis=1)
    if np.any(rows[of_contacts]):
        raise ValueError(NO_CONTACT)
    return FirstOrder(massless[decided], rows)


def plastic(sliding: Flat, slip: Callable, t, q, v) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Rows of `slip`, and the coordinate of each: without inertia, and resisted by dry friction on this slip alone.

    Refused where it is one of several slips or coordinates, a constraint acts on it, or the other forces on it depend on velocities.
    """
    massless, in_rows = np.array(sliding.massless), _rows_with(sliding, t, q, v)
    undecided = underdetermined(in_rows[_stated_rows(sliding, t, q)[0]]) & ~np.isin(massless, first_order(sliding, t, q, v).coordinates)
    slips = sparsity_pattern(lambda dv: jax.jvp(lambda v: slip(t, q, v), (v,), (dv,))[1], v)[:, massless[undecided]]
    rows, columns = np.nonzero(slips)
    coordinates = massless[undecided][columns]
    if rows.size:
        alone = np.all(slips.sum(0) <= 1) and np.all(slips.sum(1) <= 1)
        force = lambda dv: jax.jvp(lambda v: smooth_force(sliding, t, q, v)[coordinates], (v,), (dv,))[1]
        if not alone or np.any(in_rows[:, undecided]) or np.any(sparsity_pattern(force, v)):
            raise ValueError(SEVERAL)
    return rows, coordinates


def _rows_with(flat: Flat, t, q, v) -> Bool[np.ndarray, "m k"]:
    """In which rows of ψ the velocities of massless coordinates are."""
    massless = np.array(flat.massless)
    return sparsity_pattern(lambda w: velocity_residual(flat, t, q, v.at[massless].set(w)), v[massless])


def _stated_rows(flat: Flat, t, q) -> tuple[np.ndarray, slice]:
    """Rows of ψ that the user has stated as equations, and those of contacts, which may be open; behind them, those of friction."""
    holonomic, contacts = flat.holonomic(t, q).size, slice(flat.rows_of_bilateral, flat.holonomic(t, q).size)
    beside = flat.rows - flat.rows_of_bilateral - len(flat.contacts)
    return np.r_[: contacts.start, holonomic : holonomic + beside], contacts


class Completed(NamedTuple):
    """q̇ with the velocities that D decides; λ of the rows that these are in; and whether both are sound."""

    v: Float[Array, " n"]
    multipliers: Float[Array, " m"]
    sound: Sound


def completed(flat: Flat, t, q, v) -> Completed:
    """q̇ with the velocities that D decides, whatever they were before."""
    z, rows = first_order(flat, t, q, v)
    multipliers, yes = jnp.zeros(rows.size, v.dtype), jnp.array(True)
    if not z.size:
        return Completed(v, multipliers, Sound(yes, yes))
    _check(flat, z, t, q, v)
    of = lambda v, w: v.at[z].set(w)

    def equations(t, q, v, w):
        """−∂(force)/∂ż, the force at rates w, ∂ψ/∂ż and −ψ."""
        F, slope = jacobian(lambda w: -smooth_force(flat, t, q, of(v, w))[z], w)
        psi, G = jacobian(lambda w: velocity_residual(flat, t, q, of(v, w))[rows], w)
        return slope, G.as_matrix(), -F, -psi

    if is_affine(lambda w: smooth_force(flat, t, q, of(v, w))[z], v[z]):  # not even by a comparison, as that of unlike dampers is not
        found = saddle_point(*equations(t, q, v, jnp.zeros(z.size, v.dtype)))
        w, of_rows, sound = found
    else:
        w, of_rows, sound = by_newton(flat, z, rows, equations, t, q, v)
    return Completed(of(v, w), multipliers.at[np.flatnonzero(rows)].set(of_rows), sound)


def _check(flat: Flat, z, t, q, v) -> None:
    if flat.needs_multipliers:
        raise ValueError(NO_MULTIPLIERS)

    def unsymmetric(dw):
        def beside_dissipation(w):
            moved = v.at[z].set(w)
            Q = sum((Q(t, q, moved, jnp.zeros(flat.rows, v.dtype)) for Q in flat.forces.values()), start=jnp.zeros_like(v))
            return (inertia(flat, t, q, moved)[1] + Q)[z]

        return jax.jvp(beside_dissipation, (v[z],), (dw,))[1]

    coupled = sparsity_pattern(unsymmetric, v[z])
    if np.any(coupled & ~np.eye(z.size, dtype=bool)):
        raise ValueError(RECIPROCAL)


def inertial_part(flat: Flat, t, q, v, reaction: Float[Array, " n"] | None = None) -> Flat:
    """The system of what has inertia: a mass, which nothing feels, stands in for each one that is missing, and the rows of ψ that ż is in
    are left out, with the forces of their λ as a `reaction`.
    """
    z, rows = first_order(flat, t, q, v)
    if not z.size:
        return flat
    size = flat.holonomic(t, q).size
    without = lambda function, rows: lambda *given: jnp.where(rows, 0, function(*given))
    forces = flat.forces if reaction is None else flat.forces | {"": lambda *_: reaction}
    return with_masses(flat, z, t, q, v)._replace(
        forces=forces,
        holonomic=without(flat.holonomic, rows[:size]),
        bilateral=without(flat.bilateral, rows[: flat.rows_of_bilateral]),
        nonholonomic=without(flat.nonholonomic, rows[size:]),
        massless=(),
    )


def with_masses(flat: Flat, coordinates, t, q, v) -> Flat:
    """The system with masses, as large as those of the other coordinates on average, on `coordinates`."""
    others = np.setdiff1d(np.arange(v.size), coordinates)
    given = jnp.diagonal(inertia(flat, t, q, v)[0].as_matrix())[others]
    mean = jax.lax.stop_gradient(jnp.sum(given) / max(others.size, 1))
    mass = jnp.where(mean > 0, mean, 1)
    return flat._replace(lagrangian=lambda t, q, v: flat.lagrangian(t, q, v) + mass / 2 * jnp.sum(v[coordinates] ** 2))


def nearest_velocity(flat: Flat, t, q, v) -> Float[Array, " n"]:
    """q̇ on the constraints, nearest in the metric of M."""
    psi, G, _ = constraint_rows(flat, t, q, v)
    return v + saddle_point(inertia(flat, t, q, v)[0], G, jnp.zeros_like(v), -psi, reach_of(v)).x
