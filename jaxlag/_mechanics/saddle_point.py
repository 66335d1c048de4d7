"""The constrained solve: x and λ of  M x = f + Gᵀλ,  G x = c."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Bool, Float

from .._program.conditions import everywhere
from .._program.recursive_elimination import Factors as Articulated
from .._program.sparse_jacobian import MANY
from .._program.sparse_matrix import SparseMatrix, dense
from . import block_saddle_point, sparse_saddle_point
from .augmented_inertia import augmented
from .pseudo_inverse import Beside, Constraints, Inverse, Reach, Request, applied, by_rows, inverse_of
from .structured_inertia import MOST_FULL, StructuredInertia, by_inertia, is_positive, root_of_inverse
from .structured_inertia import factorised as structure_factorised

Rows = Float[Array, "m n"] | SparseMatrix
FEW = 16  # rows, from which on sparse ones are better kept so beside a sparse M


class Sound(NamedTuple):
    """Whether a constrained solve has a solution, and one only: `determined` is false where M leaves a direction free that no
    constraint holds, `satisfied` where rows of G x = c contradict each other, or are too nearly the same to be told apart.
    """

    determined: Bool[Array, ""]
    satisfied: Bool[Array, ""]


def reach_of(state: Float[Array, " n"], off: Bool[Array, ""] | None = None) -> Reach:
    """How far each number of a state may go in a direction that is barely held, where a solve puts the state right: by rounding alone,
    or, where it is clearly `off`, as far as need be.
    """
    near = jnp.finfo(state.dtype).eps ** 0.5 * jnp.abs(jax.lax.stop_gradient(state))
    return Reach(near if off is None else jnp.where(off, jnp.inf, near))


class SaddlePoint(NamedTuple):
    """Solution of the constrained solve, and whether it is one."""

    x: Float[Array, "n *k"]  # noqa: F821
    multipliers: Float[Array, "m *k"]  # noqa: F821
    sound: Sound


def saddle_point(M: lx.AbstractLinearOperator, G: Rows, f, c, reach: Reach | None = None, near: Constraints | None = None) -> SaddlePoint:
    """The unique x and the λ of least norm with M x = f + Gᵀλ and G x = c.

    f and c are vectors, or as many columns each. M need be positive definite on the null space of G only, and rows of G may
    depend on each other. Where M is seen to be diagonal, as of points in Cartesian coordinates, it is divided by, unless a mass is
    missing. Beside it G may be sparse.

    A direction that G barely holds is held where that takes x about as far as all else does, or, where x puts a state right, no farther
    than its `reach`. What is asked beyond that, the error of a state asks for, as of a mechanism that passes a singular position. What
    rows are but for the state being off the constraints that are `near`, as within a step, is not held.
    """
    if f.ndim == 1:
        found = saddle_point(M, G, f[:, None], c[:, None], reach, near)
        return found._replace(x=found.x[:, 0], multipliers=found.multipliers[:, 0])
    M, G = _for_rows(M, G)
    if isinstance(G, SparseMatrix):
        return _sparse_saddle_point(M, G, f, c)
    if not isinstance(M, lx.DiagonalLinearOperator):
        return _with_all_numbers_where_singular(M, G, lambda M: _saddle_point(M, G, f, c, reach, near))
    if not c.size and f.shape[0] >= MANY:
        return _free(M, f, c)
    there = M.diagonal > 0
    divided = _saddle_point(lx.DiagonalLinearOperator(jnp.where(there, M.diagonal, 1)), G, f, c, reach, near)
    full = lambda: _saddle_point(lx.MatrixLinearOperator(M.as_matrix()), G, f, c, reach, near)
    return jax.lax.cond(everywhere(jnp.all(there)), lambda: divided, full)


def _for_rows(M, G):
    """M and G as they are solved with: with as many of their zeros as that needs."""
    if isinstance(M, lx.DiagonalLinearOperator):
        return M, G
    is_sparse = isinstance(M, StructuredInertia) and isinstance(G, SparseMatrix) and G.shape[0] > FEW and not M.sums
    if is_sparse and block_saddle_point.whole(M.slopes.pattern, G.pattern) is not None:
        return M.slopes, G
    return M, dense(G)


def _with_all_numbers_where_singular(M, G, run):
    """run(M), where M is kept by its structure if it is positive itself: many constraints may hold what has no inertia."""
    if not isinstance(M, StructuredInertia) or G.shape[0] <= FEW or M.size > MOST_FULL:
        return run(M)
    positive = is_positive(M, structure_factorised(jax.lax.stop_gradient(M)))
    return jax.lax.cond(everywhere(positive), lambda: run(M), lambda: run(lx.MatrixLinearOperator(M.as_matrix())))


def _free(M: lx.DiagonalLinearOperator, f, c) -> SaddlePoint:
    """Without constraints each acceleration is that of its mass alone, however unlike these are: no matrix is needed beside."""
    there = M.diagonal > 0
    x = jnp.where(there[:, None], f / jnp.where(there, M.diagonal, 1)[:, None], jnp.nan)
    return SaddlePoint(x, c, Sound(jnp.all(there), jnp.array(True)))


def _saddle_point(M, G, f, c, reach, near) -> SaddlePoint:
    factors = _factorised(*jax.lax.stop_gradient((M, G, f, c, reach)), near)
    x, multipliers = _solution(M, G, f, c, factors)
    return SaddlePoint(x, multipliers, Sound(factors.determined, factors.satisfied))


def _sparse_saddle_point(M, G, f, c) -> SaddlePoint:
    """Rows that follow from others are judged by what is left of G x = c."""
    way = _way(M)
    factors = way.factorised(*jax.lax.stop_gradient((M, G)))
    x, multipliers = _solution(M, G, f, c, factors)
    judged = lambda f, c, x: sparse_saddle_point.is_satisfied(G, c, x, f / way.masses(M)[:, None])
    satisfied = jax.lax.cond(factors.regular, lambda *_: jnp.array(True), judged, *jax.lax.stop_gradient((f, c, x)))
    return SaddlePoint(x, multipliers, Sound(way.is_determined(M, factors), satisfied))


def _way(M):
    """How sparse rows are solved with."""
    return sparse_saddle_point if isinstance(M, lx.DiagonalLinearOperator) else block_saddle_point


def saddle_point_beside(
    apart: np.ndarray, M: lx.AbstractLinearOperator, G: Rows, f, c, reach: Reach | None = None, near: Constraints | None = None
) -> SaddlePoint:
    """`saddle_point` where few coordinates stand `apart`, which M and G couple with none: x is zero there, and no time goes into them."""
    kept = np.setdiff1d(np.arange(f.size), apart)
    if not 0 < kept.size < f.size < MANY or isinstance(G, SparseMatrix):
        return saddle_point(M, G, f, c, reach, near)
    if near is not None:
        near = Constraints(near.off, lambda change, rows=near.rows: rows(jnp.zeros_like(f).at[kept].set(change))[:, kept])
    is_diagonal = isinstance(M, lx.DiagonalLinearOperator)
    part = lx.DiagonalLinearOperator(M.diagonal[kept]) if is_diagonal else lx.MatrixLinearOperator(M.as_matrix()[np.ix_(kept, kept)])
    found = saddle_point(part, G[:, kept], f[kept], c, reach and reach._replace(sizes=reach.sizes[kept]), near)
    return found._replace(x=jnp.zeros_like(f).at[kept].set(found.x))


def saddle_solver(M: lx.AbstractLinearOperator, G: Rows, f, c, reach: Reach | None = None) -> Callable:
    """(f, c) ↦ (x, λ) as of `saddle_point`, for other vectors f and c; what G barely holds is held as it is for these."""
    M, G = _for_rows(M, G)

    def solution(f_other, c_other):
        def by(M):
            if isinstance(G, SparseMatrix):
                factors = _way(M).factorised(*jax.lax.stop_gradient((M, G)))
            else:
                factors = _factorised(*jax.lax.stop_gradient((M, G, f[:, None], c[:, None], reach)))
            x, multipliers = _solver(M, G, factors)[0](f_other[:, None], c_other[:, None])
            return x[:, 0], multipliers[:, 0]

        return _with_all_numbers_where_singular(M, G, by)

    return solution


class Factors(NamedTuple):
    """What the solve takes as constant: weights W and Cholesky factor of M + GᵀWG, or none of both where M is diagonal, and positive
    itself; S⁺ of S = G (M + GᵀWG)⁻¹ Gᵀ; whether M is positive there; whether rows that follow from others do so for this c too.
    """

    W: Float[Array, " m"] | None
    cholesky: Float[Array, "n n"] | Articulated | None
    inverse: Inverse
    determined: Bool[Array, ""]
    satisfied: Bool[Array, ""]


def _factorised(M, G, f, c, reach, near=None) -> Factors:
    """On the constraint M + GᵀWG says the same as M, with GᵀWc added to f, and is positive definite: so one factorisation and the
    pseudo-inverse of the small matrix S serve every case.

    Source: Benzi, Golub & Liesen, Numerical solution of saddle point problems, Acta Numerica 2005, sections 5 and 6.
    """
    if isinstance(M, lx.DiagonalLinearOperator):
        W, cholesky, determined = None, None, jnp.array(True)
        by_root = lambda B: B / jnp.sqrt(M.diagonal)[:, None]
    elif isinstance(M, StructuredInertia):
        W, cholesky = None, structure_factorised(M)
        determined, by_root = is_positive(M, cholesky), root_of_inverse(M, cholesky)
    else:
        A, W = augmented(M.as_matrix(), G)
        cholesky = jnp.linalg.cholesky(jax.lax.optimization_barrier(A))  # the diagonal of A would be computed anew
        determined = _is_positive(cholesky, A)
        by_root = lambda B: jax.scipy.linalg.solve_triangular(cholesky, B, lower=True)

    moved = _by_inertia(M, G, W, cholesky)
    change = lambda y: by_root((near.rows(moved((G.T @ y)[:, None])[:, 0]) - G).T).T

    def request():
        beside = near and Beside(near.off(), change)
        return Request(by_root(G.T).T, c, by_root(_load(G, W, f, c)), _reach_of_rows(M, G, W, reach), beside)

    S = G @ moved(G.T)
    inverse, satisfied = inverse_of(S, c, lambda D: by_rows(request(), D))
    return Factors(W, cholesky, inverse, determined, satisfied)


def _reach_of_rows(M, G, W, reach):
    """How far, in the metric of M, what each row sees may go: a coordinate that it does not touch has no say, in whatever unit."""
    if reach is None:
        return None
    if isinstance(M, StructuredInertia):
        return reach._replace(sizes=jnp.full(len(G), jnp.sqrt(reach.sizes @ M.mv(reach.sizes))))
    of_each = jnp.sqrt(jnp.diagonal(M.as_matrix()) + (0 if W is None else W @ G**2)) * reach.sizes
    return reach._replace(sizes=jnp.linalg.norm(jnp.where(G != 0, of_each, 0), axis=1))


def _load(G, W, f, c):
    return f if W is None else f + G.T @ (W[:, None] * c)


def _by_inertia(M, G, W, cholesky):
    """B ↦ (M + GᵀWG)⁻¹ B."""
    if cholesky is None:
        return lambda B: B / M.diagonal[:, None]
    if isinstance(M, StructuredInertia):
        return by_inertia(M, cholesky)
    A = M.as_matrix() + G.T @ (W[:, None] * G)
    return lambda B: _solve(A, cholesky, B)


@jax.custom_jvp
def _solution(M, G, f, c, factors):
    """What rows hold still is still: of x that cancels there is only rounding, as a compiler leaves it that joins products and sums."""
    solve, _ = _solver(M, G, factors)
    x, multipliers = solve(f, c)
    if isinstance(G, SparseMatrix) or not c.size:
        return x, multipliers
    pull = _by_inertia(M, G, factors.W, factors.cholesky)(G.T @ multipliers)
    return jnp.where(jnp.abs(x) <= 4 * jnp.finfo(x.dtype).eps * jnp.abs(pull), 0, x), multipliers


@_solution.defjvp
def _solution_jvp(primals, tangents):
    """One more solve:  M dx = df − dM x + dGᵀλ + Gᵀdλ,  G dx = dc − dG x.

    Through the formula, the derivative of the pseudo-inverse would cancel where a mechanism passes a singular position.
    """
    (M, G, f, c, factors), (dM, dG, df, dc, _) = primals, tangents
    x, multipliers = _solution(M, G, f, c, factors)
    solve, rotated = _solver(M, G, factors)
    if isinstance(M, StructuredInertia):  # whose entries are factors of each other
        turned = jax.jvp(lambda M: M.mv(x), (M,), (dM,))[1]
    else:
        turned = dM @ x if isinstance(M, SparseMatrix) else jax.vmap(dM.mv, 1, 1)(x)
    dx, d_multipliers = solve(df + dG.T @ multipliers - turned, dc - dG @ x)
    return (x, multipliers), (dx, d_multipliers + rotated(dG, multipliers))


def _solver(M, G, factors):
    """(f, c) ↦ (x, λ); and (dG, λ) ↦ how λ turns with the null space of Gᵀ to stay of least norm."""
    if isinstance(G, SparseMatrix):
        return _way(M).solver(M, G, factors)
    by_inertia, inverse = _by_inertia(M, G, factors.W, factors.cholesky), factors.inverse
    mobility = by_inertia(G.T)
    S = G @ mobility

    def solve(f, c):
        free = by_inertia(_load(G, factors.W, f, c))
        multipliers = applied(S, inverse, c - G @ free)
        x = free + mobility @ multipliers
        # What is light beside what holds it flies far without it, and in the sum rounding of that is left.
        left = applied(S, inverse, c - G @ x)
        return x + mobility @ left, multipliers + left

    def rotated(dG, multipliers):
        change = dG @ (mobility @ applied(S, inverse, multipliers))
        return change - S @ applied(S, inverse, change)

    return solve, rotated


def is_determined(M: lx.AbstractLinearOperator, G: Rows) -> Bool[Array, ""]:
    """Whether M is positive definite on the null space of G; a diagonal one beside sparse rows, everywhere."""
    M, G = jax.lax.stop_gradient(_for_rows(M, G))
    if isinstance(G, SparseMatrix):
        return _way(M).is_determined(M, _way(M).factorised(M, G))
    return _with_all_numbers_where_singular(M, G, lambda M: _is_definite(M, G))


def _is_definite(M, G):
    """The same of rows with all their zeros; of M that is kept by its structure, everywhere."""
    if isinstance(M, StructuredInertia):
        return is_positive(M, structure_factorised(M))
    if isinstance(M, lx.DiagonalLinearOperator) and not len(G) and M.diagonal.size >= MANY:
        return jnp.all(M.diagonal > 0)
    A = augmented(M.as_matrix(), G)[0]
    return _is_positive(jnp.linalg.cholesky(A), A)


def _is_positive(factor, A):
    """Whether no pivot of the Cholesky factor of A is mere rounding, some n eps of its diagonal entry."""
    threshold = 10 * A.shape[0] * jnp.finfo(A.dtype).eps
    return jnp.all(jnp.diagonal(factor) ** 2 > threshold * jnp.diagonal(A))


def _solve(A, factor, B):
    """A⁻¹B by the Cholesky factor at hand; its derivative is one more such solve, never that of the factorisation."""
    by_factor = lambda _, B: jax.scipy.linalg.cho_solve((factor, True), B)
    return jax.lax.custom_linear_solve(lambda X: A @ X, B, by_factor, symmetric=True)


CONTRADICTION = (
    "`holonomic` and `nonholonomic` must not contradict each other, but no acceleration satisfies them all here, or two rows are too "
    "nearly the same to tell, or one is lost in the rounding of another. Look for constraints that say nearly the same, or multiply one by "
    "a number; put a state by hand on them by `consistent_state`."
)
