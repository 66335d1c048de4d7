"""Roots by Newton's method where the Jacobian may be singular or not square, with derivatives by the implicit function theorem."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Bool, Float

from .._program.conditions import halved
from .._program.implicit import implicit_root
from .._program.size_of_terms import size_of_terms
from .._program.sparse_matrix import SparseMatrix

ITERATIONS = 100
TIES = 8  # unknowns that a unit is handed on through: a state that follows a state that follows a coordinate
Residual = Callable[[Any, Float[Array, " u"]], Float[Array, " r"]]  # R(args, w)


class Root(NamedTuple):
    """w with R(w) = 0, whether it is one, and the size of what cancels in each equation."""

    w: Float[Array, " u"]
    found: Bool[Array, ""]
    size: Float[Array, " r"]


def root_near(
    residual: Residual, args: Any, guess: Float[Array, " u"], units: Float[Array, " u"], ease: Float[Array, " u"] | float = 1.0
) -> Root:
    """The root that Newton's method finds from a guess; of several that nothing decides between, the nearest in these `units`, where to
    move one unknown costs less the greater its `ease`. Those whose unit is zero take it from the others: `units_beside`.
    """
    fixed, guess = jax.lax.stop_gradient((args, guess))
    slope = lambda w: jax.jacfwd(residual, 1)(fixed, w)
    units = jax.lax.stop_gradient(units_beside(slope(guess), units))
    of = jnp.where(units > 0, units, 1)

    def changes(w):
        J = slope(w)
        return lambda w: -least_change(J, residual(fixed, w), ease * of)

    w, reach = newton(changes, guess, units)
    return root_of_size(lambda w: residual(fixed, w), slope(w), w, reach)._replace(w=differentiable_root(residual, args, w, of))


def units_beside(J: Float[Array, "r u"], units: Float[Array, " u"]) -> Float[Array, " u"]:
    """Units of all unknowns where those of some are known and others are 0: such that in each equation that holds one whose unit is known
    the other counts for no more than that. They follow all changes of units. Those that no equation ties to others keep 0.
    """
    size = jnp.abs(J)

    def turn(_, units):
        rows = jnp.max(size * units[None], axis=1, initial=0.0)[:, None]
        ties = (size > 0) & (rows > 0)
        found = jnp.min(jnp.where(ties, rows / jnp.where(ties, size, 1), jnp.inf), axis=0, initial=jnp.inf)
        return jnp.where((units > 0) | ~jnp.isfinite(found), units, found)

    return jax.lax.fori_loop(0, min(TIES, units.size), turn, units.astype(J.dtype))


def newton(
    changes: Callable[[Array], Callable[[Array], Array]], guess: Float[Array, " u"], units: Float[Array, " u"]
) -> tuple[Float[Array, " u"], Float[Array, " u"]]:
    """Where Newton's method comes to rest, and the reach of each unknown, of which some eps are rounding; `changes(w)` is
    w' ↦ −J(w)⁻¹ R(w').

    A step is halved until the step that would follow it is shorter: a test that does not depend on the units of R or w. In these `units`
    the reach is the largest unknown, at the start or now; where a unit is 0, it is its own. What is nothing beside the start is zero.

    Source: Deuflhard, Newton Methods for Nonlinear Problems, section 3.3.2 (natural monotonicity test).
    """
    eps, known = jnp.finfo(guess.dtype).eps, units > 0

    def reach(w):
        largest = jnp.maximum(jnp.abs(w), jnp.abs(guess))
        return jnp.where(known, units * jnp.max(jnp.where(known, largest / jnp.where(known, units, 1), 0), initial=0.0), largest)

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
        near = length(step, w) <= eps**0.5  # where rounding decides what is shorter
        return w + jnp.where(near, 1.0, part) * step, length(step, w) <= 8 * eps, i + 1

    def is_on_its_way(carry):
        w, done, i = carry
        return (i < ITERATIONS) & ~done & jnp.all(jnp.isfinite(w))

    w, _, _ = jax.lax.while_loop(is_on_its_way, turn, (guess, jnp.array(False), jnp.array(0)))
    w = jnp.where(jnp.all(jnp.abs(w) <= 8 * eps * reach(guess)), 0, w)
    return w, reach(w)


def root_of_size(residual: Callable[[Array], Array], J: Array | SparseMatrix, w: Array, reach: Array) -> Root:
    """Whether w is a root: what is left is rounding beside the terms that cancel, or what a change of w by rounding brings about."""
    size = abs(J) @ reach + size_of_terms(residual, w)
    return Root(w, jnp.all(jnp.isfinite(w)) & is_nothing(residual(w), size), size)


def is_nothing(R: Float[Array, " r"], size: Float[Array, " r"]) -> Bool[Array, ""]:
    """Whether what is left of equations is rounding, beside the size of what cancels in them."""
    return jnp.all(jnp.abs(R) <= jnp.finfo(R.dtype).eps ** 0.5 * size)


def differentiable_root(residual: Residual, args: Any, w: Float[Array, " u"], units: Float[Array, " u"]) -> Float[Array, " u"]:
    """w, which depends on args as R(args, w) = 0 says; of several ways to change with them, by the shortest in these units."""
    in_units = lambda given, w: residual(given[0], w)
    return implicit_root(in_units, functools.partial(_change, residual), (args, units), w)


def _change(residual, given, w, R):
    args, units = given
    return -least_change(jax.jacfwd(residual, 1)(args, w), R, units)


def least_change(J: Float[Array, "r u"], R: Float[Array, " r"], scale: Any) -> Float[Array, " u"]:
    """The least x with J x = R, x in units of `scale`, and each row of J in its own."""
    scale = jnp.broadcast_to(jnp.asarray(scale, J.dtype), J.shape[1:])
    scaled = J * scale[None, :]
    size = jnp.max(jnp.abs(jax.lax.stop_gradient(scaled)), axis=1, initial=0.0)
    rows = jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1), 1)
    solver = lx.SVD(rcond=float(jnp.finfo(J.dtype).eps) ** 0.625)
    return scale * lx.linear_solve(lx.MatrixLinearOperator(rows[:, None] * scaled), rows * R, solver, throw=False).value
