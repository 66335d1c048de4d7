"""Newton's matrix of a function of many numbers, sparse: its places, its factors from a few directions, and what it solves."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jax import lax
from jaxtyping import Array, Float

from .array_dependence import dependence
from .block_tridiagonal_lu import Factors, factorised, order, solution, transposed
from .expressions import TooLong
from .sparse_jacobian import SPARSE
from .sparse_matrix import Places, SparseMatrix, colors


def newton_places(function: Callable, x: Float[Array, " k"], n: int) -> Places | None:
    """Those of 1 + A + B + …, where A, B, … are the n columns each of ∂f/∂x that come first; None where a dense matrix serves better.

    That is where there are many entries in a row, many directions, or blocks so large that there are few.
    """
    try:
        found = dependence(function, x)
    except TooLong:
        return None
    return sparse_places(found[:, :n] + found[:, n : 2 * n])


def sparse_places(pattern: scipy.sparse.csr_matrix, last: int | None = None, sparse: int = SPARSE) -> Places | None:
    """Those of a square matrix and its diagonal; None where a dense matrix serves better, which has not `sparse` times as many rows as
    there are entries in one, directions, and rows in a block.
    """
    n = pattern.shape[0]
    pattern = scipy.sparse.identity(n, bool, "csr") + pattern
    if sparse * np.diff(pattern.indptr).max() > n or sparse * (max(colors(pattern)) + 1) > n:
        return None
    places = Places.of(pattern, last)
    return places if sparse * order(places).size <= n else None


def factors_along(push: Callable, places: Places, like: Float[Array, "n *b"]) -> Factors:  # noqa: F821
    """Of a matrix, by its products along a few directions; of each of a batch, along the last axis. They are not differentiated."""
    color = colors(places.pattern())
    directions = jnp.asarray(np.arange(max(color) + 1)[:, None] == color, like.dtype)
    directions = jnp.broadcast_to(directions.reshape(*directions.shape, *[1] * (like.ndim - 1)), (len(directions), *like.shape))
    values = jax.vmap(push)(directions)[color[places.columns], places.rows]
    return lax.stop_gradient(_of_each(lambda values: factorised(SparseMatrix(values, places)), like)(values))


def by_factors(places: Places, factors: Factors, b: Float[Array, "n *b"]) -> Float[Array, "n *b"]:  # noqa: F821
    """A⁻¹ b, of each of a batch."""
    return _of_each(lambda factors, b: solution(places, factors, b), b)(factors, b)


def linear_solution(push: Callable, places: Places, b: Float[Array, "n *b"]) -> Float[Array, "n *b"]:  # noqa: F821
    """x with push(x) = b, what is left put right once; linear in b, and differentiated as such."""
    factors = factors_along(push, places, b)

    def refined(factors):
        def solve(matvec, b):
            x = by_factors(places, factors, b)
            return x + by_factors(places, factors, b - matvec(x))

        return solve

    return lax.custom_linear_solve(push, b, refined(factors), refined(_of_each(transposed, b)(factors)))


def _of_each(function: Callable, like: Array) -> Callable:
    """A function of a vector, or of each of a batch of them."""
    return function if like.ndim == 1 else jax.vmap(function, in_axes=-1, out_axes=-1)
