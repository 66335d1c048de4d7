"""Roots by Newton's method for Jacobians that may be singular or not square, with derivatives by the implicit function theorem."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from .._program.conditions import halved
from .._program.implicit import implicit_root
from .._program.size_of_terms import size_of_terms
from .._program.sparse_matrix import SparseMatrix

ITERATIONS = 100
ROUNDING = 64  # eps: rounding error of Jacobians
TIES = 8  # longest chain of unknowns that hand on a unit: a state that follows a state that follows a coordinate
NO_FORCES = np.zeros(0)
Residual = Callable[[Any, Float[Array, " u"]], Float[Array, " r"]]  # R(args, w)


class Root(NamedTuple):
    """A candidate w for R(w) = 0, whether it is a root, and the size of the terms that cancel in each equation; where they are known, units
    of all unknowns, for the length of a step.
    """

    w: Float[Array, " u"]
    found: Bool[Array, ""]
    size: Float[Array, " r"]
    units: Float[Array, " u"] | None = None


def root_near(
    residual: Residual,
    args: Any,
    guess: Float[Array, " u"],
    units: Float[Array, " u"],
    forces_on: Float[Array, " f"],
    ways: int,
    ease: Float[Array, " u"] | float = 1.0,
) -> Root:
    """The root that Newton's method finds from a guess. If the equations leave several open, it is the nearest in these `units`, where an
    unknown costs less to move the greater its `ease`. Unknowns with unit zero take their units from the others: `units_beside`.
    `forces_on`: units of the coordinates whose forces are the first equations. The unknowns after the first `ways` are forces, such as
    multipliers. It is not differentiated.
    """
    fixed, guess = jax.lax.stop_gradient((args, guess))
    slope = lambda w, units: _felt(jax.jacfwd(residual, 1)(fixed, w), forces_on, units)
    units = jax.lax.stop_gradient(units_beside(slope(guess, units), units))
    of = jax.lax.stop_gradient(_units_of_steps(slope(guess, units), units, forces_on))

    def changes(w):
        J = slope(w, units)
        return lambda w: -least_change(J, residual(fixed, w), ease * of)

    w, reach = newton(changes, guess, units, ways)
    J, terms = slope(w, units), _terms(residual, fixed, w)
    reach = jnp.where(units > 0, reach, jnp.maximum(reach, _reach_of_forces(J[: forces_on.size], terms[: forces_on.size], forces_on)))
    return root_of_size(residual(fixed, w), J, terms, w, reach)._replace(units=of)


def _terms(residual: Residual, args: Any, w: Float[Array, " u"]) -> Float[Array, " r"]:
    """The size of the terms that cancel in the equations at w, including terms of args alone."""
    numbers, others = eqx.partition(args, eqx.is_inexact_array)
    given, unravel = ravel_pytree((numbers, w))

    def of_all(given):
        numbers, w = unravel(given)
        return residual(eqx.combine(numbers, others), w)

    return size_of_terms(of_all, given)


def _reach_of_forces(J: Float[Array, "f u"], terms: Float[Array, " f"], units: Float[Array, " f"]) -> Float[Array, " u"]:
    """The reach of unknowns in forces alone, such as multipliers: the terms that cancel in these forces over the largest weight."""
    share = units[:, None] * jnp.abs(J)
    weight = jnp.max(share, axis=0, initial=0.0)
    cancels = jnp.max(jnp.where(share > 0, (units * terms)[:, None], 0), axis=0, initial=0.0)
    return jnp.where(weight > 0, cancels / jnp.where(weight > 0, weight, 1), 0)


def units_beside(J: Float[Array, "r u"], units: Float[Array, " u"]) -> Float[Array, " u"]:
    """Units of all unknowns, given the units of some and 0 for the others: in each equation with an unknown of known unit, the other counts
    for no more than that one. The units follow all changes of units. Unknowns that no equation ties to others keep 0.
    """
    size = jnp.abs(J)

    def turn(_, units):
        rows = jnp.max(size * units[None], axis=1, initial=0.0)[:, None]
        ties = (size > 0) & (rows > 0)
        found = jnp.min(jnp.where(ties, rows / jnp.where(ties, size, 1), jnp.inf), axis=0, initial=jnp.inf)
        return jnp.where((units > 0) | ~jnp.isfinite(found), units, found)

    return jax.lax.fori_loop(0, min(TIES, units.size), turn, units.astype(J.dtype))


def _units_of_steps(J: Float[Array, "r u"], units: Float[Array, " u"], forces_on: Float[Array, " f"]) -> Float[Array, " u"]:
    """Units of all unknowns, for the length of a step. Unknowns that nothing ties to a coordinate, such as velocities and multipliers if
    forces depend on no position, are measured by the forces they cause: one unit makes one unit of energy.
    """
    energy = jnp.max(forces_on[:, None] * jnp.abs(J[: forces_on.size]), axis=0, initial=0.0)
    units = jnp.where((units > 0) | (energy == 0), units, 1 / jnp.where(energy > 0, energy, 1))
    units = units_beside(J, units)
    return jnp.where(units > 0, units, 1)


def _felt(J: Float[Array, "r u"], forces_on: Float[Array, " f"], units: Float[Array, " u"]) -> Float[Array, "r u"]:
    """J `without_rounding` in its first rows, which are forces."""
    return without_rounding(J, jnp.pad(forces_on, (0, len(J) - forces_on.size))[:, None], units[None])


def without_rounding(J: Array, of_rows: Array, of_columns: Array) -> Array:
    """Entries of a Jacobian, in any form, with 0 where a force changes with an unknown by rounding alone, relative to its change with
    another: an entry that is zero by symmetry yields no equation. In these units of rows and columns, all entries are energies.
    """
    energies = jnp.abs(J) * of_rows * of_columns
    return jnp.where((energies > 0) & (energies <= ROUNDING * jnp.finfo(J.dtype).eps * jnp.max(energies, initial=0.0)), 0, J)


def newton(
    changes: Callable[[Array], Callable[[Array], Array]], guess: Float[Array, " u"], units: Float[Array, " u"], ways: int
) -> tuple[Float[Array, " u"], Float[Array, " u"]]:
    """The point at which Newton's method stops, and the reach of each unknown, of which some eps are rounding; `changes(w)` is w' ↦ −J(w)⁻¹
    R(w').

    A step is halved until the step that would follow it is shorter: a test that does not depend on the units of R or w. The reach is the
    largest of the first `ways` unknowns in these `units`, at the start or now, and at least the size of each unknown itself: forces, which
    contradictory constraints can make arbitrarily large, say nothing about the reach of a state. A result within rounding of the start's
    reach is set to zero.

    Source: Deuflhard, Newton Methods for Nonlinear Problems, section 3.3.2 (natural monotonicity test).
    """
    eps, known = jnp.finfo(guess.dtype).eps, units > 0

    def reach(w):
        largest = jnp.maximum(jnp.abs(w), jnp.abs(guess))
        shares = jnp.where(known, largest / jnp.where(known, units, 1), 0)
        return jnp.maximum(largest, units * jnp.max(shares[:ways], initial=0.0))

    def length(step, w):
        return jnp.max(jnp.where(step == 0, 0, jnp.abs(step) / reach(w)), initial=0.0)

    def turn(carry):
        w, _, i = carry
        change = changes(w)
        step = change(w)

        def is_shorter(part):
            after = length(change(w + part * step), w)
            return jnp.isfinite(after) & (after <= (1 - part / 4) * length(step, w))

        part, _ = halved(is_shorter, 1e-3, w.dtype)
        near = length(step, w) <= eps**0.5  # rounding decides which step is shorter
        return w + jnp.where(near, 1.0, part) * step, length(step, w) <= 8 * eps, i + 1

    def is_on_its_way(carry):
        w, done, i = carry
        return (i < ITERATIONS) & ~done & jnp.all(jnp.isfinite(w))

    w, _, _ = jax.lax.while_loop(is_on_its_way, turn, (guess, jnp.array(False), jnp.array(0)))
    w = jnp.where(jnp.abs(w) <= 8 * eps * reach(guess), 0, w)
    return w, reach(w)


def root_of_size(R: Array, J: Array | SparseMatrix, terms: Array, w: Array, reach: Array) -> Root:
    """w as a `Root`: found if the residual is rounding of the terms that cancel, or the effect of rounding w."""
    size = abs(J) @ reach + terms
    return Root(w, jnp.all(jnp.isfinite(w)) & is_nothing(R, size), size)


def is_nothing(R: Float[Array, " r"], size: Float[Array, " r"]) -> Bool[Array, ""]:
    """Whether the residual of equations is rounding, relative to the size of the terms that cancel in them."""
    return jnp.all(jnp.abs(R) <= jnp.finfo(R.dtype).eps ** 0.5 * size)


def differentiable_root(
    residual: Residual, args: Any, w: Float[Array, " u"], units: Float[Array, " u"], forces_on: Float[Array, " f"] = NO_FORCES
) -> Float[Array, " u"]:
    """w as the function of args that R(args, w) = 0 defines; if several changes are possible, the shortest in these units. `forces_on` as
    for `root_near`.
    """
    in_units = lambda given, w: residual(given[0], w)
    return implicit_root(in_units, functools.partial(_change, residual), (args, units, forces_on), w)


def _change(residual, given, w, R):
    args, units, forces_on = given
    return -least_change(_felt(jax.jacfwd(residual, 1)(args, w), forces_on, units), R, units)


def least_change(J: Float[Array, "r u"], R: Float[Array, " r"], scale: Any) -> Float[Array, " u"]:
    """The x of least norm with J x = R, with x in units of `scale` and each row of J in its own unit."""
    scale = jnp.broadcast_to(jnp.asarray(scale, J.dtype), J.shape[1:])
    scaled = J * scale[None, :]
    size = jnp.max(jnp.abs(jax.lax.stop_gradient(scaled)), axis=1, initial=0.0)
    rows = jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1), 1)
    solver = lx.SVD(rcond=float(jnp.finfo(J.dtype).eps) ** 0.625)
    return scale * lx.linear_solve(lx.MatrixLinearOperator(rows[:, None] * scaled), rows * R, solver, throw=False).value
