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

from .._model.flat import Flat, read_once, variant
from .._program.sparse_jacobian import jacobian, underdetermined
from .._program.sparsity import sparsity_pattern
from .convex_dissipation import by_newton
from .lagrange import applied_force, inertial_force, pattern_of_rows, smooth_force, velocity_residual
from .saddle_point import Sound, saddle_point
from .sliders import are_of_sliders, motion_of_sliders

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
    """Coordinates z whose velocities D decides; which rows of ψ these are in; and whether the forces on z are affine in ż: all seen in the
    programs.
    """

    coordinates: Int[np.ndarray, " k"]
    rows: Bool[np.ndarray, " m"]
    is_affine: bool = True


def first_order(flat: Flat) -> FirstOrder:
    """Massless coordinates that constraints alone cannot hold, and to which D, or a constraint with it, gives a velocity."""
    if not flat.massless:
        return FirstOrder(np.zeros(0, int), np.zeros(flat.rows, bool))
    return read_once(flat, _first_order)


def _first_order(flat: Flat, t, q, v) -> FirstOrder:
    massless = np.array(flat.massless)
    in_rows = read_once(flat, pattern_of_rows)[:, massless]
    of_lagrangian, of_applied = read_once(flat, _inertial_slopes, stated=True), _slopes(_applied, flat, t, q, v)
    resisted = np.any(of_lagrangian.depends | of_applied.depends, axis=1)
    stated, of_contacts = _stated_rows(flat, t, q)
    decided = underdetermined(in_rows[stated]) & (resisted | np.any(in_rows[stated], axis=0))
    rows = np.any(in_rows[:, decided], axis=1)
    if np.any(rows[of_contacts]):
        raise ValueError(NO_CONTACT)
    if np.any(decided):
        if flat.needs_multipliers:
            raise ValueError(NO_MULTIPLIERS)
        coupled = of_lagrangian.depends | _slopes(_force, flat, t, q, v).depends
        if np.any((coupled & ~np.eye(massless.size, dtype=bool))[np.ix_(decided, decided)]):
            raise ValueError(RECIPROCAL)
    bends = (of_lagrangian.bends | of_applied.bends)[np.ix_(decided, decided)]
    return FirstOrder(massless[decided], rows, not np.any(bends))


class Slopes(NamedTuple):
    """Of the slopes of forces on massless coordinates, by their velocities: which there are, and which change with these velocities."""

    depends: Bool[np.ndarray, "k k"]
    bends: Bool[np.ndarray, "k k"]


def _slopes(force: Callable, flat: Flat, t, q, v) -> Slopes:
    """Slopes of `force(flat, t, q, v)` along a direction of which nothing is known."""
    massless = np.array(flat.massless)

    def slope(at_and_along):
        at, along = jnp.split(at_and_along, 2)
        return jax.jvp(lambda w: force(flat, t, q, v.at[massless].set(w))[massless], (at,), (along,))[1]

    bends, depends = np.split(sparsity_pattern(slope, jnp.concatenate([v[massless]] * 2)), 2, axis=1)
    return Slopes(depends, bends)


def _inertial_slopes(flat: Flat, t, q, v) -> Slopes:
    return _slopes(inertial_force, flat, t, q, v)


def _applied(flat: Flat, t, q, v) -> Float[Array, " n"]:
    return applied_force(flat, t, q, v, jnp.zeros(flat.rows, v.dtype))


def _force(flat: Flat, t, q, v) -> Float[Array, " n"]:
    """Q alone."""
    return sum((Q(t, q, v, jnp.zeros(flat.rows, v.dtype)) for Q in flat.forces.values()), start=jnp.zeros_like(v))


def plastic(sliding: Flat, slip: Callable, t, q, v) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"], Int[np.ndarray, " d"]]:
    """Rows of `slip`, and the coordinate of each: without inertia, and resisted by dry friction on this slip alone; and the coordinates
    whose velocities D decides while all slips.

    Refused where it is one of several slips or coordinates, a constraint acts on it, or the other forces on it depend on velocities.
    """
    massless = np.array(sliding.massless)
    in_rows = read_once(sliding, pattern_of_rows)[:, massless]
    decided = _first_order(sliding, t, q, v).coordinates
    undecided = underdetermined(in_rows[_stated_rows(sliding, t, q)[0]]) & ~np.isin(massless, decided)
    slips = sparsity_pattern(lambda dv: jax.jvp(lambda v: slip(t, q, v), (v,), (dv,))[1], v)[:, massless[undecided]]
    rows, columns = np.nonzero(slips)
    coordinates = massless[undecided][columns]
    if rows.size:
        alone = np.all(slips.sum(0) <= 1) and np.all(slips.sum(1) <= 1)
        force = lambda dv: jax.jvp(lambda v: smooth_force(sliding, t, q, v)[coordinates], (v,), (dv,))[1]
        if not alone or np.any(in_rows[:, undecided]) or np.any(sparsity_pattern(force, v)):
            raise ValueError(SEVERAL)
    return rows, coordinates, decided


def _stated_rows(flat: Flat, t, q) -> tuple[np.ndarray, slice]:
    """Rows of ψ that the user has stated as equations, and those of contacts, which may be open; behind them, those of friction."""
    holonomic, contacts = flat.holonomic(t, q).size, slice(flat.rows_of_bilateral, flat.holonomic(t, q).size)
    beside = flat.rows - flat.rows_of_bilateral - flat.gap_count
    return np.r_[: contacts.start, holonomic : holonomic + beside], contacts


class FirstOrderRates(NamedTuple):
    """q̇ with the velocities that D decides; λ of the rows that these are in, and the forces Gᵀλ; and whether both are sound."""

    v: Float[Array, " n"]
    multipliers: Float[Array, " m"]
    reaction: Float[Array, " n"]
    sound: Sound


def with_first_order_rates(flat: Flat, t, q, v) -> FirstOrderRates:
    """q̇ with the velocities that D decides, whatever they were before; in a mode of dry friction, those of sliders with them."""
    z, rows, _ = first_order(flat)
    yes, sliders = jnp.array(True), flat.sliders
    found = FirstOrderRates(v, jnp.zeros(rows.size, v.dtype), jnp.zeros_like(v), Sound(yes, yes))
    if sliders is None:
        return _with_decided(flat, t, q, found) if z.size else found
    moves = motion_of_sliders(flat, t, q, v)  # what they hold depends on no velocity
    found = found._replace(multipliers=found.multipliers.at[sliders.rows].set(moves.multipliers), reaction=moves.reaction)
    if z.size:
        found = _with_decided(flat, t, q, found)
        moves = motion_of_sliders(flat, t, q, found.v)
    return found._replace(v=found.v.at[sliders.coordinates].set(moves.v))


def _with_decided(flat: Flat, t, q, found: FirstOrderRates) -> FirstOrderRates:
    """With the velocities that smooth dissipation decides, beside the reaction that was found of the rest."""
    z, rows, is_affine = first_order(flat)
    rows = rows & ~are_of_sliders(flat, rows.size)
    v, of = found.v, lambda v, w: v.at[z].set(w)
    beside = flat if flat.sliders is None else flat._replace(forces=flat.forces | {"": lambda *_: found.reaction})

    def equations(t, q, v, w):
        """−∂(force)/∂ż, the force at rates w, ∂ψ/∂ż and −ψ."""
        F, slope = jacobian(lambda w: -smooth_force(beside, t, q, of(v, w))[z], w)
        psi, G = jacobian(lambda w: velocity_residual(flat, t, q, of(v, w))[rows], w)
        return slope, G.as_matrix(), -F, -psi

    if is_affine:  # not even by a comparison, as that of unlike dampers is not
        w, of_rows, sound = saddle_point(*equations(t, q, v, jnp.zeros(z.size, v.dtype)))
    else:
        w, of_rows, sound = by_newton(beside, z, rows, equations, t, q, v)
    multipliers = jnp.zeros_like(found.multipliers).at[np.flatnonzero(rows)].set(of_rows)
    there = of(v, w)
    reaction = jax.vjp(lambda v: velocity_residual(flat, t, q, v), there)[1](multipliers)[0] if np.any(rows) else jnp.zeros_like(v)
    return FirstOrderRates(there, found.multipliers + multipliers, found.reaction + reaction, sound)


def without_inertia(flat: Flat) -> Int[np.ndarray, " k"]:
    """Coordinates whose velocities D decides: in a mode of dry friction, those that slide or stick without inertia, too."""
    z = first_order(flat).coordinates
    return z if flat.sliders is None else np.union1d(z, flat.sliders.coordinates)


def inertial_part(flat: Flat, t, q, v, reaction: Float[Array, " n"] | None = None) -> Flat:
    """The system of what has inertia: a mass, which nothing feels, stands in for each one that is missing. The rows of ψ that ż is in are
    zero, and those of sliders left out, with the forces of their λ as a `reaction`.
    """
    (_, rows, _), light = first_order(flat), without_inertia(flat)
    if not light.size:
        return flat
    size, theirs = flat.holonomic(t, q).size, are_of_sliders(flat, rows.size)
    zero_in = lambda function, rows: (lambda *given: jnp.where(rows, 0, function(*given))) if np.any(rows) else function
    others = flat.nonholonomic if flat.sliders is None else flat.sliders.beside
    return variant(
        with_masses(flat, light),
        _some_inertial_part,
        forces=flat.forces if reaction is None else flat.forces | {"": lambda *_: reaction},
        holonomic=zero_in(flat.holonomic, rows[:size]),
        bilateral=zero_in(flat.bilateral, rows[: flat.rows_of_bilateral]),
        nonholonomic=zero_in(others, rows[size:][~theirs[size:]]),
        massless=(),
        sliders=None,
    )


def _some_inertial_part(flat: Flat, t, q, v) -> Flat:
    """That of which nothing is known."""
    return inertial_part(flat, t, q, v, v)


def with_masses(flat: Flat, coordinates: Int[np.ndarray, " k"]) -> Flat:
    """The system with masses, as large as those of the other coordinates on average, on `coordinates`: for M alone, nothing feels them."""
    return flat._replace(stand_ins=tuple(sorted({*flat.stand_ins, *map(int, coordinates)})))
