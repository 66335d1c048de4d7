"""The constrained solve: x and λ of  M x = f + Gᵀλ,  G x = c."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Bool, Float

from ._mechanics import applied_force, constraint_rows, inertia
from ._system import Flat


class SaddlePoint(NamedTuple):
    """Solution of the constrained solve; `determined` is false where M leaves a direction free that no constraint holds."""

    x: Float[Array, "n *k"]
    multipliers: Float[Array, "m *k"]
    determined: Bool[Array, ""]


def saddle_point(M: lx.AbstractLinearOperator, G: Float[Array, "m n"], f, c) -> SaddlePoint:
    """The unique x and the λ of least norm with M x = f + Gᵀλ and G x = c.

    f and c are vectors, or as many columns each. M need be positive definite on the null space of G only, and rows of G may
    depend on each other. Where M is seen to be diagonal, as of points in Cartesian coordinates, it is divided by, unless a mass is
    (next to) nothing beside another.
    """
    if f.ndim == 1:
        x, multipliers, determined = saddle_point(M, G, f[:, None], c[:, None])
        return SaddlePoint(x[:, 0], multipliers[:, 0], determined)
    if not isinstance(M, lx.DiagonalLinearOperator):
        return _saddle_point(M, G, f, c)
    heavy = M.diagonal > jnp.finfo(f.dtype).eps ** 0.25 * jnp.max(jnp.abs(M.diagonal))
    divided = _saddle_point(lx.DiagonalLinearOperator(jnp.where(heavy, M.diagonal, 1)), G, f, c)
    full = lambda: _saddle_point(lx.MatrixLinearOperator(M.as_matrix()), G, f, c)
    return jax.lax.cond(everywhere(jnp.all(heavy)), lambda: divided, full)


@jax.custom_jvp
def _saddle_point(M, G, f, c) -> SaddlePoint:
    solve, _, determined = _solver(M, G)
    x, multipliers = solve(f, c)
    return SaddlePoint(x, multipliers, determined)


@_saddle_point.defjvp
def _saddle_point_jvp(primals, tangents):
    """One more solve:  M dx = df − dM x + dGᵀλ + Gᵀdλ,  G dx = dc − dG x.

    Through the formula, the derivative of the pseudo-inverse would cancel where a mechanism passes a singular position.
    """
    (M, G, f, c), (dM, dG, df, dc) = primals, tangents
    x, multipliers, determined = _saddle_point(M, G, f, c)
    solve, turned, _ = _solver(M, G)
    dx, d_multipliers = solve(df + dG.T @ multipliers - jax.vmap(dM.mv, 1, 1)(x), dc - dG @ x)
    return SaddlePoint(x, multipliers, determined), SaddlePoint(
        dx, d_multipliers + turned(dG, multipliers), np.zeros(jnp.shape(determined), jax.dtypes.float0)
    )


def _solver(M, G):
    """(f, c) ↦ (x, λ); (dG, λ) ↦ how λ turns with the null space of Gᵀ to stay of least norm; whether M is positive there.

    On the constraint M + GᵀWG says the same as M, with GᵀWc added to f, and is positive definite: so one factorisation and the
    pseudo-inverse of the small matrix S = G (M + GᵀWG)⁻¹ Gᵀ serve every case. W = 0 where M is diagonal, and positive itself.
    Source: Benzi, Golub & Liesen, Numerical solution of saddle point problems, Acta Numerica 2005, sections 5 and 6.
    """
    if isinstance(M, lx.DiagonalLinearOperator):
        W, by_inertia, determined = jnp.zeros_like(G[:, 0]), lambda B: B / M.diagonal[:, None], jnp.array(True)
    else:
        augmented, W = _augmented(M.as_matrix(), G)
        augmented = jax.lax.optimization_barrier(augmented)  # its diagonal would be computed anew
        factor = jnp.linalg.cholesky(jax.lax.stop_gradient(augmented))
        by_inertia, determined = lambda B: _solve(augmented, factor, B), _is_positive(factor, augmented)
    mobility = by_inertia(G.T)
    S = G @ mobility
    inverse = lambda r: least_norm(S, r)

    def solve(f, c):
        free = by_inertia(f + G.T @ (W[:, None] * c))
        multipliers = inverse(c - G @ free)
        return free + mobility @ multipliers, multipliers

    def turned(dG, multipliers):
        change = dG @ (mobility @ inverse(multipliers))
        return change - S @ inverse(change)

    return solve, turned, determined


@jax.custom_batching.custom_vmap
def everywhere(condition: Bool[Array, ""]) -> Bool[Array, ""]:
    """A condition; in a batch, whether it holds for all members, so that a `cond` on it stays one and not the work of both branches."""
    return condition


@everywhere.def_vmap
def _for_all_members(axis_size, in_batched, conditions):
    return everywhere(jnp.all(conditions)), False


def is_determined(M: Float[Array, "n n"], G: Float[Array, "m n"]) -> Bool[Array, ""]:
    """Whether M is positive definite on the null space of G."""
    augmented = jax.lax.stop_gradient(_augmented(M, G)[0])
    return _is_positive(jnp.linalg.cholesky(augmented), augmented)


def _augmented(M, G):
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


@jax.custom_jvp
def least_norm(S: Float[Array, "m m"], R: Float[Array, "m k"]) -> Float[Array, "m k"]:
    """S⁺R with the Moore–Penrose inverse of a symmetric positive semidefinite S.

    The rank is judged on S scaled to a unit diagonal, so that it does not depend on the units of the constraints: eigenvalues
    below τ = eps^(5/8) (1.6e-10 in double precision) of the largest, which is at most m, count as zero. None does where S − m τ 1
    has a Cholesky factorisation, and then that of S serves. A row of nothing but zeros has no part in it.
    """
    m = S.shape[0]
    if m < 2:
        return jnp.where(S > 0, R / jnp.where(S > 0, S, 1), 0) if m else R
    there = jnp.diagonal(S) > 0
    D = jnp.where(there, jax.lax.rsqrt(jnp.where(there, jnp.diagonal(S), 1)), 0)
    scaled = S * jnp.outer(D, D) + jnp.diag(~there).astype(S.dtype)
    least, one = m * jnp.finfo(S.dtype).eps ** 0.625, jnp.eye(m, dtype=S.dtype)
    regular = everywhere(jnp.all(jnp.diagonal(jnp.linalg.cholesky(scaled - least * one)) > 0))
    singular = jax.lax.cond(regular, lambda: jnp.zeros_like(S), lambda: _by_eigenvalues(scaled, D))
    factor = jnp.linalg.cholesky(jnp.where(regular, scaled, one))
    by_factor = D[:, None] * jax.scipy.linalg.cho_solve((factor, True), D[:, None] * R)
    return jnp.where(regular, by_factor, singular @ R)


@least_norm.defjvp
def _least_norm_jvp(primals, tangents):
    # Golub & Pereyra 1973, eq. 4.12, for constant rank: P = S⁺ turns with its null space, that of N = 1 − S P.
    (S, R), (dS, dR) = primals, tangents
    P = lambda X: least_norm(S, X)
    N = lambda X: X - S @ P(X)
    X = P(R)
    return X, P(dR - dS @ X) + N(dS @ P(X)) + P(P(dS @ N(R)))


def pseudo_inverse(S: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """Moore–Penrose inverse of a symmetric positive semidefinite S."""
    return least_norm(S, jnp.eye(len(S), dtype=S.dtype))


def _by_eigenvalues(scaled, D):
    """(D⁻¹ A D⁻¹)⁺ with what counts as zero of A taken out."""
    values, U = jnp.linalg.eigh(scaled)
    kept = values > jnp.finfo(scaled.dtype).eps ** 0.625 * values[-1]
    inverse = U @ (jnp.where(kept, 1 / jnp.where(kept, values, 1), 0)[:, None] * U.T) * jnp.outer(D, D)
    # Least norm in the units given: take out of range and domain what lies in the null space of S, spanned by V.
    V = jnp.where(kept, 0, D[:, None] * U)
    gram = jnp.linalg.cholesky(V.T @ V + jnp.diag(kept.astype(scaled.dtype)))
    out = jnp.eye(len(D), dtype=scaled.dtype) - V @ jax.scipy.linalg.cho_solve((gram, True), V.T)
    return out @ inverse @ out


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
    return SaddlePoint(affine(columns.x, force(multipliers)), multipliers, columns.determined)


def _self_consistent(reaction, start):
    """λ = reaction(λ) by Newton's method, where applied forces depend on the constraint forces they bring about.

    It is exact at once where the forces are linear in λ, as friction is. NaN where 1 − ∂reaction/∂λ has no positive determinant:
    then no λ, or more than one, solves it (Painlevé's paradox; Genot & Brogliato, Eur. J. Mech. A 18 (1999) 653).
    """

    def newton(multipliers, _):
        slope = jnp.eye(start.size, dtype=start.dtype) - jax.jacfwd(reaction)(multipliers)
        step = jnp.linalg.solve(slope, reaction(multipliers) - multipliers)
        return jnp.where(jnp.linalg.det(slope) > 0, multipliers + step, jnp.nan), None

    return jax.lax.scan(newton, start, length=NEWTON_STEPS)[0]


NEWTON_STEPS = 3
NO_INERTIA = (
    "`lagrangian` must give every direction inertia that no constraint holds, but the mass matrix is singular "
    "(or not positive) on the null space of the constraints. Add the missing mass, or a constraint."
)
