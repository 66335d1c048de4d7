"""The constrained solve: x and λ of  M x = f + Gᵀλ,  G x = c."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Bool, Float

from .._model.system import Flat
from .lagrange import applied_force, constraint_rows, inertia


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

    def slack(self) -> Float[Array, " n"]:
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
    solve, turned, *_ = _solver(M, G, f, c, near)
    dx, d_multipliers = solve(df + dG.T @ found.multipliers - jax.vmap(dM.mv, 1, 1)(found.x), dc - dG @ found.x)
    still = jax.tree.map(lambda flag: np.zeros(jnp.shape(flag), jax.dtypes.float0), found.sound)
    return found, SaddlePoint(dx, d_multipliers + turned(dG, found.multipliers), still)


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

    def asked():
        slack = None if near is None else near.slack()
        length = None if slack is None else jnp.sqrt(slack @ fixed(M.as_matrix()) @ slack)
        return Asked(by_root(fixed(G.T)).T, fixed(c), by_root(fixed(load(f, c))), length)

    inverse, satisfied = _inverse(S, fixed(c), lambda D: _by_rows(asked(), fixed(D)))

    def solve(f, c):
        free = by_inertia(load(f, c))
        multipliers = _applied(S, inverse, c - G @ free)
        return free + mobility @ multipliers, multipliers

    def turned(dG, multipliers):
        change = dG @ (mobility @ _applied(S, inverse, multipliers))
        return change - S @ _applied(S, inverse, change)

    return solve, turned, determined, satisfied


@jax.custom_batching.custom_vmap
def everywhere(condition: Bool[Array, ""]) -> Bool[Array, ""]:
    """A condition; in a batch, whether it holds for all members, so that a `cond` on it stays one and not the work of both branches."""
    return condition


@everywhere.def_vmap
def _for_all_members(axis_size, in_batched, conditions):
    return everywhere(jnp.all(conditions)), False


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


class Asked(NamedTuple):
    """Of a constrained solve, in the metric of M: the `rows` of G, what is asked of them, the `free` motion without them, and, where
    that is given, how far x may go in directions that are barely held.
    """

    rows: Float[Array, "m n"]
    c: Float[Array, "m k"]
    free: Float[Array, "n k"]
    slack: Float[Array, ""] | None


class Inverse(NamedTuple):
    """S⁺, of an S with rows of length 1/D: by the Cholesky factor of D S D where S is `regular`, else as root rootᵀ; of one row, D."""

    regular: Bool[Array, ""]
    D: Float[Array, " m"]
    factor: Float[Array, "m m"]
    root: Float[Array, "m m"]


def _inverse(S: Float[Array, "m m"], c: Float[Array, "m k"], singular: Callable) -> tuple[Inverse, Bool[Array, ""]]:
    """S⁺ on the directions that are held, and whether what c asks of the others follows from these; `singular(D)` says so where the rank
    is in question.

    All is judged with rows scaled to unit length in the metric of M, so that it does not depend on the units of the constraints. Where
    S − m √eps 1 has a Cholesky factorisation, that of S serves: no eigenvalue is below √eps of the largest, which is at most m.
    """
    m, eps, size = S.shape[0], jnp.finfo(S.dtype).eps, jnp.diagonal(S)
    if m < 2:
        D = jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1), 0)
        return Inverse(jnp.array(True), D, S, S), jnp.all((size > 0)[:, None] | (c == 0))
    there = size > (4 * eps) ** 2 * jnp.max(size)  # a row of nothing but rounding has no part in it
    D = jnp.where(there, jax.lax.rsqrt(jnp.where(there, size, 1)), 0)
    nearly_zero = jnp.abs(c) <= eps**FOLLOWS * jnp.max(jnp.abs(c), axis=0, keepdims=True)
    follows = jnp.all(there[:, None] | nearly_zero)
    one, nothing = jnp.eye(m, dtype=S.dtype), jnp.zeros_like(S)
    scaled = S * jnp.outer(D, D) + jnp.diag(~there).astype(S.dtype)
    regular = everywhere(jnp.all(jnp.diagonal(jnp.linalg.cholesky(scaled - m * eps**0.5 * one)) > 0))
    root, others_follow = jax.lax.cond(regular, lambda: (nothing, jnp.array(True)), lambda: singular(D))
    return Inverse(regular, D, jnp.linalg.cholesky(jnp.where(regular, scaled, one)), root), follows & others_follow


def _by_rows(asked: Asked, D) -> tuple[Float[Array, "m m"], Bool[Array, ""]]:
    """A root of S⁺ by the singular values of the rows themselves, of which S holds the squares: rounding hides those below √eps there.

    Values above `CLEAR` of the largest count. Those down to `SEEN` count where what they ask for is no more than `FARTHER` times all the
    rest, or `slack`. Others are left out: below `NOISE`, where dependent rows have them by rounding, for good; above it, unsatisfied.
    """
    eps = jnp.finfo(D.dtype).eps
    U, values, _ = jnp.linalg.svd(D[:, None] * asked.rows)
    values = jnp.zeros_like(D).at[: values.size].set(values)
    wanted, rest = D[:, None] * asked.c, U.T @ (D[:, None] * (asked.c - asked.rows @ asked.free))
    clear, seen = values > eps**CLEAR * values[0], values > eps**SEEN * values[0]
    way = rest / jnp.where(seen, values, 1)[:, None]
    length = lambda x: jnp.linalg.norm(x, axis=0, keepdims=True)
    bound = FARTHER * (length(asked.free) + length(jnp.where(clear[:, None], way, 0))) if asked.slack is None else asked.slack
    held = clear | (seen & jnp.all(jnp.abs(way) <= bound, axis=1))
    contradicts = jnp.abs(rest) > eps**FOLLOWS * (length(wanted) + length(asked.free))
    satisfied = ~jnp.any(~held & ((values > eps**NOISE * values[0]) | jnp.any(contradicts, axis=1)))
    return _by_values(values**2, U, held, D), satisfied


def _by_values(values, U, held, D):
    """R with R Rᵀ = (D⁻¹ A D⁻¹)⁺, for A = U diag(values) Uᵀ with what is not held taken out."""
    size = jnp.where(held, jax.lax.rsqrt(jnp.where(held, values, 1)), 0)
    # Least norm in the units given: take out of range and domain what lies in the null space of S, spanned by V.
    V = jnp.where(held[None, :], 0, D[:, None] * U)
    gram = jnp.linalg.cholesky(V.T @ V + jnp.diag(held | (jnp.sum(V**2, axis=0) == 0)).astype(D.dtype))
    out = jnp.eye(len(D), dtype=D.dtype) - V @ jax.scipy.linalg.cho_solve((gram, True), V.T)
    return out @ (D[:, None] * U * size[None, :])


@jax.custom_jvp
def _applied(S: Float[Array, "m m"], inverse: Inverse, R: Float[Array, "m k"]) -> Float[Array, "m k"]:
    """S⁺R; differentiated at constant rank."""
    regular, D, factor, root = inverse
    if len(D) < 2:
        return D[:, None] * R
    by_factor = D[:, None] * jax.scipy.linalg.cho_solve((factor, True), D[:, None] * R)
    # A forward pass over a reverse one differentiates this body, not its rule: nothing is changed, but the derivative by S.
    fixed = jax.lax.stop_gradient(S)
    P = lambda X: root @ (root.T @ X)  # by parts: the product has lost the smaller values
    N, change, X = lambda X: X - fixed @ P(X), S - fixed, P(R)
    by_root = X - P(change @ X) + N(change @ P(X)) + P(P(change @ N(R)))
    return jnp.where(regular, by_factor, by_root)


@_applied.defjvp
def _applied_jvp(primals, tangents):
    # Golub & Pereyra 1973, eq. 4.12, for constant rank: P = S⁺ turns with its null space, that of N = 1 − S P.
    (S, inverse, R), (dS, _, dR) = primals, tangents
    P = lambda X: _applied(S, inverse, X)
    N = lambda X: X - S @ P(X)
    X = P(R)
    return X, P(dR - dS @ X) + N(dS @ P(X)) + P(P(dS @ N(R)))


def pseudo_inverse(S: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """Moore–Penrose inverse of a symmetric positive semidefinite S."""

    def singular(D):
        D = jax.lax.stop_gradient(D)
        values, U = jnp.linalg.eigh(jax.lax.stop_gradient(S) * jnp.outer(D, D))
        return _by_values(values, U, values > jnp.finfo(D.dtype).eps ** (2 * CLEAR) * values[-1], D), jnp.array(True)

    one = jnp.eye(len(S), dtype=S.dtype)
    return _applied(S, _inverse(S, jnp.zeros_like(S), singular)[0], one)


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

    return jax.lax.scan(newton, start, length=NEWTON_STEPS)[0]


NEWTON_STEPS = 3
# Exponents of eps (1.3e-5, 1.6e-10, 1.8e-12 and 1.3e-6 in double precision) and a factor, with which ranks are judged
CLEAR, SEEN, NOISE, FOLLOWS, FARTHER = 0.3125, 0.625, 0.75, 0.375, 2
CONTRADICTION = (
    "`holonomic` and `nonholonomic` must not contradict each other, but no acceleration satisfies them all here, or two rows are too "
    "nearly the same to tell. Look for constraints that say nearly the same; put a state by hand on them by `consistent_state`."
)
NO_INERTIA = (
    "`lagrangian` must give every direction inertia that no constraint holds, but the mass matrix is singular "
    "(or not positive) on the null space of the constraints. Add the missing mass (a small one with a solver for stiff systems, "
    "`solver=diffrax.Kvaerno5()`), add a constraint that holds it, or leave the coordinate out."
)
