"""Products G D Gᵀ of a sparse G as block tridiagonal matrices, their factors, and substitution: one block after the other.

They couple rows that share a column. In an order of small bandwidth b a factor takes m b² operations.

Source: Cuthill & McKee, Proc. 24th Nat. Conf. ACM (1969) 157; Golub & Van Loan, Matrix Computations, 4th ed., section 4.5.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jax import lax
from jaxtyping import Array, Float

from .sparse_matrix import Places


class Elimination(NamedTuple):
    """How S is made and eliminated: fixed while tracing, by the places of G alone."""

    order: np.ndarray  # the rows, in the order of elimination
    size: int  # of a block
    blocks: int
    pairs: tuple[np.ndarray, np.ndarray]  # of entries of G in one column
    sums: Places  # by which pairs are added up
    entry: np.ndarray  # for each number of the blocks on and below the diagonal which sum it is, the last where it is none

    @property
    def padding(self) -> int:
        """Rows that fill up the last block."""
        return self.size * self.blocks - self.order.size


@functools.lru_cache(maxsize=64)
def elimination(places: Places) -> Elimination:
    """In the order of Cuthill and McKee, reversed."""
    from scipy.sparse.csgraph import reverse_cuthill_mckee  # imported here because that takes a while

    m = places.shape[0]
    pattern = places.pattern().astype(bool).astype(np.int64)
    coupled = (pattern @ pattern.T).tocsr()
    order = np.asarray(reverse_cuthill_mckee(coupled, symmetric_mode=True), int)
    rank = np.empty(m, int)
    rank[order] = np.arange(m)
    i, j = coupled.nonzero()
    size = max(1, int(np.abs(rank[i] - rank[j]).max(initial=0)))
    blocks = -(-m // size)
    first, second = pairs_in_a_column(places)
    at, beside = rank[places.rows[first]], rank[places.rows[second]]
    below = at // size - beside // size
    kept = (below == 0) | (below == 1)
    first, second, at, beside, below = (x[kept] for x in (first, second, at, beside, below))
    where = ((at // size * 2 + below) * size + at % size) * size + beside % size
    there, number = np.unique(where, return_inverse=True)
    sorting = np.argsort(number, kind="stable")
    sums = Places(number[sorting], np.arange(number.size), (there.size, number.size))
    entry = np.full(blocks * 2 * size * size, there.size)
    entry[there] = np.arange(there.size)
    return Elimination(order, size, blocks, (first[sorting], second[sorting]), sums, entry.reshape(blocks, 2, size, size))


def pairs_in_a_column(places: Places) -> tuple[np.ndarray, np.ndarray]:
    """All pairs of entries that stand in one column, by their numbers."""
    number = scipy.sparse.csc_matrix(places.pattern())
    starts, entries = number.indptr, number.data - 1
    count = np.diff(starts)
    first = np.repeat(np.arange(entries.size), np.repeat(count, count))
    within = np.arange(first.size) - np.repeat(np.cumsum(np.repeat(count, count)) - np.repeat(count, count), np.repeat(count, count))
    second = np.repeat(np.repeat(starts[:-1], count), np.repeat(count, count)) + within
    return entries[first], entries[second]


def factor(on: Float[Array, "b s s"], below: Float[Array, "b s s"]) -> tuple[Array, Array]:
    """L and W, block by block, with D = L Lᵀ + W Wᵀ and E = W Lᵀ of the block before; of single rows, the matrix itself."""
    if on.shape[1] == 1:
        return on, below

    def eliminate(L, blocks):
        D, E = blocks
        W = jax.scipy.linalg.solve_triangular(L, E.T, lower=True).T
        L = jnp.linalg.cholesky(D - W @ W.T)
        return L, (L, W)

    return lax.scan(eliminate, jnp.eye(on.shape[1], dtype=on.dtype), (on, below))[1]


def by_factor(factor: tuple[Array, Array], B: Float[Array, "b s k"]) -> Float[Array, "b s k"]:
    """By substitution forwards and backwards."""
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
