"""The constrained solve M x = f + Gᵀλ, G x = c where M and G are sparse: rigid bodies and their joints, however many.

In units in which M has ones on its diagonal and rows have length 1, x and −λ solve one symmetric system,

    [M  Gᵀ] [ x]   [f]
    [G  0 ] [−λ] = [c].

It is eliminated block by block, each multiplier behind all that its row holds: then no pivot is zero, since a part of the bodies and the
joints between them is a mechanism as well. M need be positive on the null space of G only, as of quaternions: GᵀG is added to it, and
taken out of the solution by putting that right once. Where rows depend on each other, so is a −δ in place of the 0.

Source: Benzi, Golub & Liesen, Numerical solution of saddle point problems, Acta Numerica 2005, sections 5, 6 and 8.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .._program.block_tridiagonal import Factors as Blocks
from .._program.block_tridiagonal import blocks, positive_eigenvalues, solution
from .._program.block_tridiagonal import factorised as by_blocks
from .._program.conditions import everywhere
from .._program.registry import remembered
from .._program.shifted_factors import inverse_lengths, refine, scales, shifted_where_singular, shifts, signs
from .._program.sparse_jacobian import SPARSE
from .._program.sparse_matrix import SparseMatrix, SparsityPattern, assembled, gather_static, summed_by
from .sparse_saddle_point import rotation

EXACT = 2  # times that a solution is put right where rows are independent: once for GᵀG, once for rounding


class Whole(NamedTuple):
    """How the matrix of (x, −λ) is put together: fixed while tracing, by the places of M and G alone."""

    pattern: SparsityPattern
    pairs: tuple[np.ndarray, np.ndarray]  # of entries of G in one row
    sums: SparsityPattern  # by which entries of M, pairs, entries of G, of Gᵀ and the δ are added up


@remembered
def whole(M: SparsityPattern, G: SparsityPattern) -> Whole | None:
    """None where blocks would be so large that a full matrix serves as well."""
    (m, n), (by_columns, number) = G.shape, G.transposed
    first, second = (number[pairs] for pairs in by_columns.pairs_in_a_column())
    of_rows = n + np.arange(m)
    rows = np.concatenate([M.rows, G.columns[first], n + G.rows, G.columns, of_rows])
    columns = np.concatenate([M.columns, G.columns[second], G.columns, n + G.rows, of_rows])
    pattern, sums = assembled(rows, columns, n + m, n)
    return Whole(pattern, (first, second), sums) if SPARSE * blocks(pattern).size <= n + m else None


class Factors(NamedTuple):
    """What the solve takes as constant: the factors; the units of x and of rows; whether rows are independent; whether M is positive on
    their null space.
    """

    of: Blocks
    units: Float[Array, " n"]
    weights: Float[Array, " m"]
    regular: Bool[Array, ""]
    determined: Bool[Array, ""]


def factorised(M: SparseMatrix, G: SparseMatrix) -> Factors:
    """Rows that depend on each other are seen by what the inverse makes of a vector at random; then δ is not zero, and a solution is put
    right more often. M is positive on their null space where as many eigenvalues are negative as there are rows (Sylvester).
    """
    how, (m, n) = whole(M.pattern, G.pattern), G.shape
    assert how is not None  # asked where it is of use
    units = lax.rsqrt(masses(M))
    values = G.values * gather_static(units, G.pattern.columns)
    weights, present = inverse_lengths(summed_by(G.pattern, values**2))
    values, (first, second) = values * gather_static(weights, G.pattern.rows), how.pairs
    of_M = M.values * gather_static(units, M.pattern.rows) * gather_static(units, M.pattern.columns)
    probe = signs((n + m,), values.dtype)

    def factored(delta):
        entries = jnp.concatenate([of_M, gather_static(values, first) * gather_static(values, second), values, values, -delta])
        K = SparseMatrix(summed_by(how.sums, gather_static(entries, how.sums.columns)), how.pattern)
        return K, by_blocks(K)

    probed = lambda found: solution(how.pattern, found[1], probe)
    (K, factors), shifted = shifted_where_singular(factored, probed, shifts(weights, present) + ~present)
    rising, sound = positive_eigenvalues(K, factors)
    return Factors(factors, units, weights, everywhere(~shifted), (rising == n) & sound)


def masses(M: SparseMatrix) -> Float[Array, " n"]:
    """The diagonal of M, where that is not (next to) nothing relative to its largest number, as of what constraints alone hold."""
    return scales(summed_by(M.pattern, jnp.where(M.pattern.rows == M.pattern.columns, M.values, 0)))


def is_determined(_: SparseMatrix, factors: Factors) -> Bool[Array, ""]:
    """Whether M is positive on the null space of the rows."""
    return factors.determined


def solver(M: SparseMatrix, G: SparseMatrix, factors: Factors) -> tuple[Callable, Callable]:
    """(f, c) ↦ (x, λ); and (dG, λ) ↦ how λ turns with the null space of Gᵀ to stay of least norm."""
    how, n = whole(M.pattern, G.pattern), G.shape[1]
    assert how is not None  # asked where it is of use
    scale = jnp.concatenate([factors.units, factors.weights])[:, None]
    apart = lambda given: (given[:n], given[n:])

    def by_matrix(given):
        x, pull = apart(given)
        return jnp.concatenate([M @ x + G.T @ pull, G @ x])

    def once(given):
        return scale * jax.vmap(lambda b: solution(how.pattern, factors.of, b), in_axes=1, out_axes=1)(scale * given)

    refined = lambda matvec, given: refine(once, matvec, given, EXACT, ~factors.regular)

    def solve(f, c):
        x, pull = apart(lax.custom_linear_solve(by_matrix, jnp.concatenate([f, c]), refined, symmetric=True))
        return x, -pull

    return solve, rotation(G, solve, factors.regular)
