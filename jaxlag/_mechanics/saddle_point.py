"""The constrained solve: x and λ of  M x = f + Gᵀλ,  G x = c."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Bool, Float

from .._model.flat import Flat
from .lagrange import applied_force, constraint_rows, inertia
from .pseudo_inverse import Request, applied, by_rows, everywhere, inverse_of


class Sound(NamedTuple):
    """Whether a constrained solve has a solution, and one only: `determined` is false where M leaves a direction free that no
    constraint holds, `satisfied` where rows of G x = c contradict each other, or are too nearly the same to be told apart.
    """

    determined: Bool[Array, ""]
    satisfied: Bool[Array, ""]


class Near(NamedTuple):
    """The state that a solve puts right: by rounding alone, or, where it is clearly `off`, as far as need be."""

    state: Float[Array, " n"]
    off: Bool[Array, ""] | None = None

    def tolerance(self) -> Float[Array, " n"]:
        """How far each of its numbers may go in a direction that is barely held."""
        near = jnp.finfo(self.state.dtype).eps ** 0.5
        return (1 + jnp.abs(jax.lax.stop_gradient(self.state))) * (near if self.off is None else jnp.where(self.off, 1 / near, near))


class SaddlePoint(NamedTuple):
    """Solution of the constrained solve, and whether it is one."""

    x: Float[Array, "n *k"]  # noqa: F821
    multipliers: Float[Array, "m *k"]  # noqa: F821
    sound: Sound


def saddle_point(M: lx.AbstractLinearOperator, G: Float[Array, "m n"], f, c, near: Near | None = None) -> SaddlePoint:
    """The unique x and the λ of least norm with M x = f + Gᵀλ and G x = c.

    f and c are vectors, or as many columns each. M need be positive definite on the null space of G only, and rows of G may
    depend on each other. Where M is seen to be diagonal, as of points in Cartesian coordinates, it is divided by, unless a mass is
    (next to) nothing beside another.

    A direction that G barely holds is held where that takes x about as far as all else does, or, where x puts a state right, no farther
    than `near` says. What is asked beyond that, the error of a state asks for, as of a mechanism that passes a singular position.
    """
    if f.ndim == 1:
        found = saddle_point(M, G, f[:, None], c[:, None], near)
        return found._replace(x=found.x[:, 0], multipliers=found.multipliers[:, 0])
    if not isinstance(M, lx.DiagonalLinearOperator):
        return _saddle_point(M, G, f, c, near)
    heavy = M.diagonal > jnp.finfo(f.dtype).eps ** 0.25 * jnp.max(jnp.abs(M.diagonal))
    divided = _saddle_point(lx.DiagonalLinearOperator(jnp.where(heavy, M.diagonal, 1)), G, f, c, near)
    full = lambda: _saddle_point(lx.MatrixLinearOperator(M.as_matrix()), G, f, c, near)
    return jax.lax.cond(everywhere(jnp.all(heavy)), lambda: divided, full)


@jax.custom_jvp
def _saddle_point(M, G, f, c, near) -> SaddlePoint:
    solve, _, determined, satisfied = _solver(M, G, f, c, near)
    x, multipliers = solve(f, c)
    return SaddlePoint(x, multipliers, Sound(determined, satisfied))


@_saddle_point.defjvp
def _saddle_point_jvp(primals, tangents):
    """One more solve:  M dx = df − dM x + dGᵀλ + Gᵀdλ,  G dx = dc − dG x.

    Through the formula, the derivative of the pseudo-inverse would cancel where a mechanism passes a singular position.
    """
    (M, G, f, c, near), (dM, dG, df, dc, _) = primals, tangents
    found = _saddle_point(M, G, f, c, near)
    solve, rotated, *_ = _solver(M, G, f, c, near)
    dx, d_multipliers = solve(df + dG.T @ found.multipliers - jax.vmap(dM.mv, 1, 1)(found.x), dc - dG @ found.x)
    still = jax.tree.map(lambda flag: np.zeros(jnp.shape(flag), jax.dtypes.float0), found.sound)
    return found, SaddlePoint(dx, d_multipliers + rotated(dG, found.multipliers), still)


def _solver(M, G, f, c, near):
    """(f, c) ↦ (x, λ); (dG, λ) ↦ how λ turns with the null space of Gᵀ to stay of least norm; whether M is positive there; whether
    rows that follow from others do so for this c too.

    On the constraint M + GᵀWG says the same as M, with GᵀWc added to f, and is positive definite: so one factorisation and the
    pseudo-inverse of the small matrix S = G (M + GᵀWG)⁻¹ Gᵀ serve every case. W = 0 where M is diagonal, and positive itself.
    Source: Benzi, Golub & Liesen, Numerical solution of saddle point problems, Acta Numerica 2005, sections 5 and 6.
    """
    fixed = jax.lax.stop_gradient
    if isinstance(M, lx.DiagonalLinearOperator):
        W, by_inertia, determined = jnp.zeros_like(G[:, 0]), lambda B: B / M.diagonal[:, None], jnp.array(True)
        by_root = lambda B: B / jnp.sqrt(fixed(M.diagonal))[:, None]
    else:
        A, W = augmented(M.as_matrix(), G)
        A = jax.lax.optimization_barrier(A)  # its diagonal would be computed anew
        factor = jnp.linalg.cholesky(fixed(A))
        by_inertia, determined = lambda B: _solve(A, factor, B), _is_positive(factor, A)
        by_root = lambda B: jax.scipy.linalg.solve_triangular(factor, B, lower=True)
    mobility = by_inertia(G.T)
    S = G @ mobility
    load = lambda f, c: f + G.T @ (W[:, None] * c)

    def request():
        tolerance = None if near is None else near.tolerance()
        length = None if tolerance is None else jnp.sqrt(tolerance @ fixed(M.as_matrix()) @ tolerance)
        return Request(by_root(fixed(G.T)).T, fixed(c), by_root(fixed(load(f, c))), length)

    inverse, satisfied = inverse_of(S, fixed(c), lambda D: by_rows(request(), fixed(D)))

    def solve(f, c):
        free = by_inertia(load(f, c))
        multipliers = applied(S, inverse, c - G @ free)
        return free + mobility @ multipliers, multipliers

    def rotated(dG, multipliers):
        change = dG @ (mobility @ applied(S, inverse, multipliers))
        return change - S @ applied(S, inverse, change)

    return solve, rotated, determined, satisfied


def is_determined(M: Float[Array, "n n"], G: Float[Array, "m n"]) -> Bool[Array, ""]:
    """Whether M is positive definite on the null space of G."""
    A = jax.lax.stop_gradient(augmented(M, G)[0])
    return _is_positive(jnp.linalg.cholesky(A), A)


def augmented(M, G):
    """M + GᵀWG, with W such that a row of it is as heavy as M is on average; the solution does not depend on W."""
    size, mean = jnp.sum(G**2, axis=1), jnp.mean(jnp.diagonal(M))
    W = jax.lax.stop_gradient(jnp.where(mean > 0, mean, 1.0) / jnp.where(size > 0, size, jnp.inf))
    return M + G.T @ (W[:, None] * G), W


def _is_positive(factor, A):
    """Whether no pivot of the Cholesky factor of A is mere rounding, some n eps of its diagonal entry."""
    threshold = 10 * A.shape[0] * jnp.finfo(A.dtype).eps
    return jnp.all(jnp.diagonal(factor) ** 2 > threshold * jnp.diagonal(A))


def _solve(A, factor, B):
    """A⁻¹B by the Cholesky factor at hand; its derivative is one more such solve, never that of the factorisation."""
    by_factor = lambda _, B: jax.scipy.linalg.cho_solve((factor, True), B)
    return jax.lax.custom_linear_solve(lambda X: A @ X, B, by_factor, symmetric=True)


def constrained_acceleration(flat: Flat, t, q, v, feedback=None) -> SaddlePoint:
    """q̈ and λ of  M q̈ = f + Gᵀλ,  G q̈ = −γ − feedback(t, q, v)."""
    M, inertial = inertia(flat, t, q, v)
    _, G, gamma = constraint_rows(flat, t, q, v)
    c = -gamma if feedback is None else -gamma - feedback(flat, t, q, v)
    force = lambda multipliers: applied_force(flat, t, q, v, multipliers)
    if not flat.needs_multipliers:
        return saddle_point(M, G, inertial + force(jnp.zeros_like(c)), c)
    # The solution is affine in the force, which is part of it by λ: one solve says how.
    beside = lambda vector, matrix: jnp.concatenate([vector[:, None], matrix], axis=1)
    columns = saddle_point(M, G, beside(inertial, jnp.eye(v.size, dtype=v.dtype)), beside(c, jnp.zeros((c.size, v.size), v.dtype)))
    affine = lambda columns, force: columns[:, 0] + columns[:, 1:] @ force
    multipliers = _self_consistent(lambda multipliers: affine(columns.multipliers, force(multipliers)), jnp.zeros_like(c))
    return SaddlePoint(affine(columns.x, force(multipliers)), multipliers, columns.sound)


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


MULTIPLIER_ITERATIONS = 3
CONTRADICTION = (
    "`holonomic` and `nonholonomic` must not contradict each other, but no acceleration satisfies them all here, or two rows are too "
    "nearly the same to tell. Look for constraints that say nearly the same; put a state by hand on them by `consistent_state`."
)
NO_INERTIA = (
    "`lagrangian` must give every direction inertia that no constraint holds, but the mass matrix is singular "
    "(or not positive) on the null space of the constraints. Add the missing mass (a small one with a solver for stiff systems, "
    "`solver=diffrax.Kvaerno5()`), add a constraint that holds it, or leave the coordinate out."
)
