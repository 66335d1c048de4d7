"""Newton's matrix of a function of many numbers, sparse: its pattern, its factors from a few directions, and what it solves."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jax import lax
from jaxtyping import Array, Bool, Float

from .block_tridiagonal import Factors, blocks, factorised, solution, transposed
from .expressions import TooLong
from .shifted_factors import SHIFT, inverse_lengths, refine, scales, shifted_where_singular, signs
from .sparse_jacobian import SPARSE
from .sparse_matrix import SparseMatrix, SparsityPattern, colors, gather_static, summed_by
from .sparsity import dependence


def newton_pattern(function: Callable, x: Float[Array, " k"], n: int) -> SparsityPattern | None:
    """The pattern of Newton's matrix in u of f(q, v, u) = 0, where q and v, n numbers each, move with the first n of u; others, and their
    rows, come last. x = (q, v, u). None where a dense matrix serves better, or the program is too long to be read.
    """
    try:
        found = dependence(function, x)
    except TooLong:
        return None
    moving = found[:, :n] + found[:, n : 2 * n] + found[:, 2 * n : 3 * n]
    return square_pattern(scipy.sparse.hstack([moving, found[:, 3 * n :]], "csr"), last=n)


def square_pattern(pattern: scipy.sparse.csr_matrix, last: int | None = None, sparse: int = SPARSE) -> SparsityPattern | None:
    """The pattern of a square matrix and its diagonal; None where a dense matrix serves better, which has not `sparse` times as many rows
    as there are entries in one, directions, and rows in a block.
    """
    n = pattern.shape[0]
    whole = scipy.sparse.identity(n, bool, "csr") + pattern
    if sparse * np.diff(whole.indptr).max() > n or sparse * (max(colors(whole)) + 1) > n:
        return None
    found = SparsityPattern.of(whole, last)
    return found if sparse * blocks(found).size <= n else None


class NewtonFactors(NamedTuple):
    """Factors of a matrix in `units` in which its numbers are near one; where rows that come last depend on each other, in so far as
    they are not `regular`, with a δ in place of their zeros: what is left of a solution puts it right.
    """

    of: Factors
    units: Float[Array, " n"]
    regular: Bool[Array, ""]


def factors_along(push: Callable, pattern: SparsityPattern, like: Float[Array, "n *b"]) -> NewtonFactors:  # noqa: F821
    """Factors of a matrix, by its products along a few directions; of each of a batch, along the last axis. They are not differentiated."""
    color = colors(pattern.to_scipy())
    directions = jnp.asarray(np.arange(max(color) + 1)[:, None] == color, like.dtype)
    directions = jnp.broadcast_to(directions.reshape(*directions.shape, *[1] * (like.ndim - 1)), (len(directions), *like.shape))
    values = jax.vmap(push)(directions)[color[pattern.columns], pattern.rows]
    return lax.stop_gradient(_of_each(lambda values: newton_factors(SparseMatrix(values, pattern)), like)(values))


def newton_factors(A: SparseMatrix) -> NewtonFactors:
    """Factors of [K −Gᵀ; G 0]: with δ > 0 in place of the 0, what is left of it when K is eliminated, δ + G K⁻¹Gᵀ, is positive if K is."""
    (n, _), last = A.shape, A.pattern.last
    if last is None or last == n:
        return NewtonFactors(factorised(A), jnp.ones(n, A.values.dtype), jnp.array(True))
    rows, columns, is_last = A.pattern.rows, A.pattern.columns, np.arange(n) >= last
    on_diagonal = summed_by(A.pattern, jnp.where((rows == columns) & (rows < last), A.values, 0))
    units = jnp.where(is_last, 0, lax.rsqrt(scales(on_diagonal)))
    weights, present = inverse_lengths(summed_by(A.pattern, (A.values * gather_static(units, columns)) ** 2), 0)
    units = jnp.where(is_last, jnp.where(present, weights, 1), units)
    scaled = SparseMatrix(A.values * gather_static(units, rows) * gather_static(units, columns), A.pattern)
    shift = jnp.where(is_last, jnp.finfo(units.dtype).eps ** SHIFT, 0.0).astype(units.dtype)
    probe = signs((n,), units.dtype)
    factors, shifted = shifted_where_singular(
        lambda shift: factorised(scaled.plus_diagonal(shift)), lambda factors: solution(A.pattern, factors, probe), shift
    )
    return NewtonFactors(factors, units, ~shifted)


def by_factors(pattern: SparsityPattern, factors: NewtonFactors, b: Float[Array, "n *b"]) -> Float[Array, "n *b"]:  # noqa: F821
    """A⁻¹ b, of each of a batch."""
    return _of_each(lambda factors, b: factors.units * solution(pattern, factors.of, factors.units * b), b)(factors, b)


def refined(matvec: Callable, pattern: SparsityPattern, factors: NewtonFactors, b: Float[Array, "n *b"]) -> Float[Array, "n *b"]:  # noqa: F821
    """A⁻¹ b, what is left put right: once, or where rows depend on each other until it is."""
    return refine(lambda b: by_factors(pattern, factors, b), matvec, b, 1, ~jnp.all(factors.regular))


def linear_solution(push: Callable, pattern: SparsityPattern, b: Float[Array, "n *b"]) -> Float[Array, "n *b"]:  # noqa: F821
    """x with push(x) = b, what is left put right once; linear in b, and differentiated as such."""
    factors = factors_along(push, pattern, b)
    turned = factors._replace(of=_of_each(transposed, b)(factors.of))
    solve = lambda factors: lambda matvec, b: refined(matvec, pattern, factors, b)
    return lax.custom_linear_solve(push, b, solve(factors), solve(turned))


def _of_each(function: Callable, like: Array) -> Callable:
    """A function of a vector, or of each of a batch of them."""
    return function if like.ndim == 1 else jax.vmap(function, in_axes=-1, out_axes=-1)
