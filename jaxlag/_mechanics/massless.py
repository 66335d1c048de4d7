"""Coordinates without inertia, whose velocities the dissipation function decides.

    ∂D/∂ż = ∂L/∂z + Q_z + (Gᵀλ)_z,      ψ(t, q, q̇) = 0 in the rows of ψ that ż is in

Where M has rows of zeros, Lagrange's equations hold no q̈: they say ż, and λ of these rows, from t, q and the velocities of what has
inertia. So ż is no part of the state. A coordinate without inertia that constraints hold as they are is left to them.
Source: Onsager, Phys. Rev. 37 (1931) 405; Doi, J. Phys.: Condens. Matter 23 (2011) 284118, section 2.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._model.flat import Flat
from .._program.scalarise import scalarised
from .._program.sparse_jacobian import jacobian, sparsity_pattern
from .constrained_root import Linear, root_of
from .lagrange import applied_force, constraint_rows, inertia, velocity_residual
from .saddle_point import Sound, is_determined, reach_of, saddle_point

ITERATIONS = 100  # of Newton's method; from rest, a few more than from a motion
HALVINGS = 1100  # of a step, from the largest number to the least
NEAR = 0.1875  # exponent of eps (1.2e-3 in double precision), at which distance a D is flat that does not decide velocities
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


def underdetermined(pattern: Bool[np.ndarray, "m k"]) -> Bool[np.ndarray, " k"]:
    """Unknowns that the equations of this pattern do not determine, whatever their numbers.

    Source: Dulmage & Mendelsohn, Canad. J. Math. 10 (1958) 517: what alternating paths from unmatched columns reach.
    """
    owner: dict[Any, Any] = {}  # row: the column that it determines

    def augment(column, seen):
        for row in np.flatnonzero(pattern[:, column]):
            if row not in seen:
                seen.add(row)
                if row not in owner or augment(owner[row], seen):
                    owner[row] = column
                    return True
        return False

    reached = {column for column in range(pattern.shape[1]) if not augment(column, set())}
    front = list(reached)
    while front:
        column = front.pop()
        found = {owner[row] for row in np.flatnonzero(pattern[:, column])} - reached
        reached |= found
        front += found
    return np.isin(np.arange(pattern.shape[1]), list(reached))


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

    if _is_linear(flat, z, t, q, v):
        found = saddle_point(*equations(t, q, v, jnp.zeros(z.size, v.dtype)))
        w, of_rows, sound = found
    else:
        w, of_rows, sound = _by_newton(flat, z, rows, equations, t, q, v)
    return Completed(of(v, w), multipliers.at[np.flatnonzero(rows)].set(of_rows), sound)


def smooth_force(flat: Flat, t, q, v):
    """∂L/∂q − … − ∂D/∂q̇ + Q: all but constraints."""
    return inertia(flat, t, q, v)[1] + applied_force(flat, t, q, v, jnp.zeros(flat.rows, v.dtype))


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


def _is_linear(flat: Flat, z, t, q, v) -> bool:
    """Whether the force is seen to be affine in ż: its slope does not depend on ż, not even by a comparison, as of unlike dampers."""
    slope = lambda w: jax.jvp(lambda w: smooth_force(flat, t, q, v.at[z].set(w))[z], (w,), (jnp.ones_like(w),))[1]
    return not np.any(sparsity_pattern(slope, v[z]))


def _by_newton(flat: Flat, z, rows, equations: Callable, t, q, v) -> tuple[Array, Array, Sound]:
    """ż and λ where D is convex: least D(ż) − F ż on ψ = 0, by Newton's method with a line search."""
    k, faint = z.size, jnp.finfo(v.dtype).tiny ** 0.5
    like = jnp.concatenate([v[z], jnp.zeros(int(rows.sum()), v.dtype)])

    @scalarised
    def residual(args, w):
        (t, q, v), (w, multipliers) = args, jnp.split(w, [k])
        moved = lambda w: v.at[z].set(w)
        psi, pull = jax.vjp(lambda w: velocity_residual(flat, t, q, moved(w))[rows], w)
        return jnp.concatenate([-smooth_force(flat, t, q, moved(w))[z] - pull(multipliers)[0], psi])

    @scalarised
    def linear(args, w):
        slope, G, F, c = equations(*args, w[:k])
        return Linear(lx.MatrixLinearOperator(slope.as_matrix() + faint * jnp.eye(k)), G, F, c)

    def search(linear, args):
        force = lambda w: linear(args, jnp.concatenate([w, like[k:]])).f
        given = _first_guess(force, linear(args, jnp.zeros_like(like)), args[2][z])

        def newton(carry):
            w, _, _, i = carry
            at = linear(args, w)
            d, multipliers, _ = at.solution()
            share = _length(lambda share: -(force(w[:k] + share * d) + at.G.T @ multipliers) @ d)
            there = w[:k] + share * d
            moves = (share < 1) | (jnp.max(jnp.abs(d)) > 4 * jnp.finfo(v.dtype).eps * jnp.max(jnp.abs(there)))
            return jnp.concatenate([there, multipliers]), force(there) + at.G.T @ multipliers, moves, i + 1

        start = jnp.concatenate([given, jnp.zeros_like(like[k:])]), jnp.zeros_like(given), jnp.array(True), jnp.array(0)
        w, left, _, _ = jax.lax.while_loop(lambda carry: carry[2] & (carry[3] < ITERATIONS), newton, start)
        scale = jnp.maximum(jnp.max(jnp.abs(force(given))), jnp.max(jnp.abs(force(jnp.zeros_like(given)))))
        solved = jnp.all(jnp.abs(left) <= jnp.finfo(v.dtype).eps ** 0.5 * scale)
        return w, (solved & resists(args, w[:k]), linear(args, w).solution().sound.satisfied)

    def resists(args, w):
        """Whether D is bent around w, where it may be flat at one place, as |ż|³ is at rest, or have no slope, as |ż|^1.5 has none."""
        near = jnp.finfo(v.dtype).eps ** NEAR * (1 + jnp.abs(w)) * jnp.linspace(1, 2, k, dtype=v.dtype)
        (above, G, *_), (below, *_) = (equations(*args, w + beside) for beside in (near, -near))
        return is_determined(lx.MatrixLinearOperator(above.as_matrix() + below.as_matrix()), G)

    w, sound = root_of(residual, linear, search, (t, q, v), like)
    rates, multipliers = jnp.split(w, [k])
    return rates, multipliers, Sound(*sound)


def _first_guess(force: Callable, at_rest: Linear, given: Float[Array, " k"]) -> Float[Array, " k"]:
    """The rates given, where they balance half of the forces; or else, along the forces, as fast as balances these, to a factor of two."""
    identity = lambda f, c: saddle_point(lx.MatrixLinearOperator(jnp.eye(given.size, dtype=given.dtype)), at_rest.G, f, c).x
    slowest = identity(jnp.zeros_like(given), at_rest.c)
    allowed = lambda w: identity(force(w), jnp.zeros_like(at_rest.c))
    given = jnp.where(jnp.isfinite(given), given, 0)
    given, along = given + identity(jnp.zeros_like(given), at_rest.c - at_rest.G @ given), allowed(slowest)
    along = along / jnp.maximum(jnp.max(jnp.abs(along)), jnp.finfo(given.dtype).tiny)
    largest = int(jnp.finfo(given.dtype).maxexp)
    ahead = lambda k: -force(slowest + jnp.exp2(k.astype(given.dtype)) * along) @ along
    searched = lambda: slowest + _power_of_two(lambda k: ahead(k) <= 0, -largest, largest) * along
    is_near = jnp.max(jnp.abs(allowed(given))) <= jnp.max(jnp.abs(allowed(slowest))) / 2
    return jax.lax.cond(is_near, lambda: given, searched)


def _length(slope: Callable) -> Float[Array, ""]:
    """How much of a step of Newton's method to take, a power of ½: the longest that does not go far beyond the minimum along it."""
    start = slope(0.0)
    within = lambda k: slope(jnp.exp2(k.astype(start.dtype))) <= jnp.abs(start) / 2
    return jax.lax.cond(within(jnp.array(0)), lambda: jnp.ones_like(start), lambda: _power_of_two(within, -HALVINGS, 0))


def _power_of_two(within: Callable, least: int, most: int) -> Float[Array, ""]:
    """The largest power that is still within, by bisection of its exponent."""

    def bisect(carry):
        low, high = carry
        middle = (low + high) // 2
        return jax.tree.map(lambda a, b: jnp.where(within(middle), a, b), (middle, high), (low, middle))

    exponent, _ = jax.lax.while_loop(lambda carry: carry[1] - carry[0] > 1, bisect, (jnp.array(least), jnp.array(most)))
    return jnp.exp2(exponent.astype(float))


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
