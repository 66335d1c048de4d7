"""Sparse matrices as block tridiagonal ones, their factors, and substitution: one block after the other.

    A = (1 + W) D (1 + U),   W below, U above the diagonal,   Dₖ = Aₖₖ − Wₖ Aₖ₋₁ₖ

The matrix need not be symmetric; pivots are chosen within a block. One that is symmetric and positive has Cholesky's factors. In an order
of small bandwidth b a factor takes n b² operations.

Source: Golub & Van Loan, Matrix Computations, 4th ed., section 4.5.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .registry import remembered
from .sparse_matrix import SparseMatrix, SparsityPattern, elimination_order, gather_static

LEAST = 8  # rows of a block: 2000 rows in 3 a block are factorised in 2.0 ms, in 8 or 16 in 1.0 ms
SOUND = 0.75  # exponent of eps: the least part of the others in its block that a pivot is, where its sign is certain


class Blocks(NamedTuple):
    """How a matrix is cut into blocks: fixed while tracing, by its pattern alone."""

    order: np.ndarray  # the rows, in the order of elimination
    size: int  # of a block
    entries: np.ndarray  # (blocks, 3, size, size): of blocks on, below and above the diagonal; then zero, then one

    @property
    def padding(self) -> int:
        """Rows that fill up the last block."""
        return self.size * len(self.entries) - self.order.size


class Factors(NamedTuple):
    """D⁻¹, W and U, block by block."""

    inverse: Float[Array, "b s s"]
    below: Float[Array, "b s s"]
    above: Float[Array, "b s s"]


@remembered
def blocks(pattern: SparsityPattern, least: int = LEAST) -> Blocks:
    """Blocks of at least so many rows, in an order of small bandwidth."""
    n, order = pattern.shape[0], elimination_order(pattern.to_scipy(), pattern.last)
    rank = np.argsort(order)
    i, j = rank[pattern.rows], rank[pattern.columns]
    size = max(1, min(least, n), int(np.abs(i - j).max(initial=0)))
    count, zero, one = -(-n // size), pattern.rows.size, pattern.rows.size + 1
    entries = np.full((count, 3, size, size), zero)
    entries[i // size, (i // size - j // size) % 3, i % size, j % size] = np.arange(pattern.rows.size)
    padded = np.arange(n, count * size)
    entries[padded // size, 0, padded % size, padded % size] = one
    return Blocks(order, size, entries)


def factorised(A: SparseMatrix) -> Factors:
    """The factors; what is not finite in them says that a block of D has no inverse."""
    given = _by_blocks(A)

    def eliminate(before, block):
        inverse, above = before
        on, below, next_above = block
        W = below @ inverse
        inverse = jnp.linalg.inv(on - W @ above)
        return (inverse, next_above), (inverse, W)

    nothing = jnp.zeros_like(given[0, 0])
    _, (inverse, below) = lax.scan(eliminate, (nothing, nothing), (given[:, 0], given[:, 1], given[:, 2]))
    return Factors(inverse, below, inverse @ given[:, 2])


def _by_blocks(A: SparseMatrix) -> Float[Array, "b 3 s s"]:
    return gather_static(jnp.concatenate([A.values, jnp.array([0, 1], A.values.dtype)]), blocks(A.pattern).entries)


def transposed(factors: Factors) -> Factors:
    """Factors of Aᵀ = (1 + Uᵀ) Dᵀ (1 + Wᵀ)."""
    inverse, below, above = (jnp.swapaxes(x, 1, 2) for x in factors)
    nothing = jnp.zeros_like(below[:1])
    return Factors(inverse, jnp.concatenate([nothing, above[:-1]]), jnp.concatenate([below[1:], nothing]))


def positive_eigenvalues(A: SparseMatrix, factors: Factors) -> tuple[Int[Array, ""], Bool[Array, ""]]:
    """How many a symmetric matrix has, by Sylvester's law of inertia: those of its D; and whether none of these is rounding."""
    on, _, above = jnp.moveaxis(_by_blocks(A), 1, 0)
    D = on - factors.below @ jnp.concatenate([jnp.zeros_like(above[:1]), above[:-1]])
    values = jnp.linalg.eigvalsh((D + jnp.swapaxes(D, 1, 2)) / 2)
    size = jnp.abs(values)
    sound = jnp.all(jnp.min(size, axis=1) >= jnp.finfo(values.dtype).eps ** SOUND * jnp.max(size, axis=1))
    return jnp.sum(values > 0) - (size.size - A.shape[0]), sound


def solution(pattern: SparsityPattern, factors: Factors, b: Float[Array, " n"]) -> Float[Array, " n"]:
    """A⁻¹ b, by substitution forwards and backwards."""
    how = blocks(pattern)
    parts = jnp.concatenate([gather_static(b, how.order), jnp.zeros(how.padding, b.dtype)]).reshape(-1, how.size)

    def forwards(y, given):
        W, b = given
        y = b - W @ y
        return y, y

    def backwards(x, given):
        U, z = given
        x = z - U @ x
        return x, x

    nothing = jnp.zeros_like(parts[0])
    _, y = lax.scan(forwards, nothing, (factors.below, parts))
    z = jnp.einsum("bij,bj->bi", factors.inverse, y)
    _, x = lax.scan(backwards, nothing, (factors.above, z), reverse=True)
    return gather_static(x.ravel(), np.argsort(how.order))


def cholesky(on: Float[Array, "b s s"], below: Float[Array, "b s s"]) -> tuple[Array, Array]:
    """L and W, block by block, with D = L Lᵀ + W Wᵀ and E = W Lᵀ of the block before; of single rows, the matrix itself."""
    if on.shape[1] == 1:
        return on, below

    def eliminate(L, blocks):
        D, E = blocks
        W = jax.scipy.linalg.solve_triangular(L, E.T, lower=True).T
        L = jnp.linalg.cholesky(D - W @ W.T)
        return L, (L, W)

    return lax.scan(eliminate, jnp.eye(on.shape[1], dtype=on.dtype), (on, below))[1]


def by_cholesky(factor: tuple[Array, Array], B: Float[Array, "b s k"]) -> Float[Array, "b s k"]:
    """Solves by substitution forwards and backwards."""
    if B.shape[1] == 1:
        on, below = factor[0].ravel(), factor[1].ravel()
        return lax.linalg.tridiagonal_solve(below, on, jnp.append(below[1:], 0), B[:, 0])[:, None]

    def forwards(y, given):
        L, W, b = given
        y = jax.scipy.linalg.solve_triangular(L, b - W @ y, lower=True)
        return y, y

    def backwards(reaction, given):
        L, W, y = given
        x = jax.scipy.linalg.solve_triangular(L, y - reaction, lower=True, trans=1)
        return W.T @ x, x

    _, Y = lax.scan(forwards, jnp.zeros_like(B[0]), (*factor, B))
    return lax.scan(backwards, jnp.zeros_like(B[0]), (*factor, Y), reverse=True)[1]
