"""The constrained solve M x = f + Gᵀλ, G x = c where M is diagonal and G sparse: rods between points, however many.

S = G M⁻¹ Gᵀ couples rows that share a coordinate. With the rows in an order of small bandwidth b, S is block tridiagonal: m b² operations,
a number that grows with m alone for a chain (b = 1, 2), for a tree or a strip; and one block after the other in the program.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .._program.block_tridiagonal import Blocks, blocks, by_cholesky, cholesky
from .._program.conditions import everywhere
from .._program.registry import remembered
from .._program.shifted_factors import inverse_lengths, refine, shifted_where_singular, shifts, signs
from .._program.sparse_matrix import SparseMatrix, SparsityPattern, assembled, gather_static, row_sums, summed_by
from .pseudo_inverse import FOLLOWS


class Elimination(NamedTuple):
    """How S is made and eliminated: fixed while tracing, by the pattern of G alone."""

    blocks: Blocks
    pairs: tuple[np.ndarray, np.ndarray]  # of entries of G in one column
    sums: SparsityPattern  # by which pairs are added up
    entry: np.ndarray  # for each number of the blocks on and below the diagonal which sum it is, the last where it is none


@remembered
def elimination(G: SparsityPattern) -> Elimination:
    """The elimination of S for rows of this pattern."""
    first, second = G.pairs_in_a_column()
    S, sums = assembled(G.rows[first], G.rows[second], G.shape[0])
    how = blocks(S, 1)
    used, entry = np.unique(np.minimum(how.entries[:, :2], S.rows.size), return_inverse=True)  # S is symmetric: not above the diagonal
    kept = np.isin(sums.rows, used)
    terms = sums.columns[kept]
    sums = SparsityPattern(np.searchsorted(used, sums.rows[kept]), np.arange(terms.size), (used.size - 1, terms.size))
    return Elimination(how, (first[terms], second[terms]), sums, entry.reshape(how.entries[:, :2].shape))


class Factors(NamedTuple):
    """What the solve takes as constant: a factor of S by blocks, in rows of unit length and in the order of elimination; whether rows
    are independent; the lengths 1/D.
    """

    of: tuple[Array, Array]
    regular: Bool[Array, ""]
    D: Float[Array, "b s"]


def factorised(M: lx.DiagonalLinearOperator, G: SparseMatrix) -> Factors:
    """A factor of S, or, where rows depend on each other, of S + δ 1: then a solution is put right more often.

    They are seen by what S⁻¹ makes of a vector at random: in the null space of S that is as large as rounding allows.
    """
    how = elimination(G.pattern)
    first, second = how.pairs
    pairs = gather_static(G.values, first) * gather_static(G.values, second) / gather_static(M.diagonal, G.pattern.columns[first])
    S = gather_static(jnp.append(summed_by(how.sums, pairs), 0), how.entry)
    diagonal = jax.vmap(jnp.diag)
    D, present = inverse_lengths(jnp.diagonal(S[:, 0], axis1=1, axis2=2))
    before = jnp.concatenate([jnp.zeros_like(D[:1]), D[:-1]])
    on = S[:, 0] * D[:, :, None] * D[:, None, :] + diagonal((~present).astype(S.dtype))
    below = S[:, 1] * D[:, :, None] * before[:, None, :]
    probe, is_work = signs((*D.shape, 1), D.dtype), how.blocks.size > 1

    factored = lambda shift: cholesky(on + diagonal(shift), below)
    factors, shifted = shifted_where_singular(factored, lambda found: by_cholesky(found, probe), shifts(D, present), is_work)
    return Factors(factors, everywhere(~shifted & (jnp.sum(present) == G.shape[0])), D)


def solver(M: lx.DiagonalLinearOperator, G: SparseMatrix, factors: Factors) -> tuple[Callable, Callable]:
    """(f, c) ↦ (x, λ); and (dG, λ) ↦ how λ turns with the null space of Gᵀ to stay of least norm."""
    how = elimination(G.pattern).blocks
    back = np.argsort(how.order)
    by_inertia = lambda F: F / M.diagonal[:, None]
    S = lambda X: G @ by_inertia(G.T @ X)

    def once(R):
        parts = jnp.concatenate([gather_static(R, how.order), jnp.zeros((how.padding, R.shape[1]), R.dtype)]).reshape(*factors.D.shape, -1)
        scaled = factors.D[:, :, None] * by_cholesky(factors.of, factors.D[:, :, None] * parts)
        return gather_static(scaled.reshape(-1, R.shape[1]), back)

    refined = lambda matvec, R: refine(once, matvec, R, 0, ~factors.regular)
    by_rows = lambda R: lax.custom_linear_solve(S, R, refined, symmetric=True)

    def solve(f, c):
        multipliers = by_rows(c - G @ by_inertia(f))
        return by_inertia(f + G.T @ multipliers), multipliers

    return solve, rotation(G, solve, factors.regular)


def rotation(G: SparseMatrix, solve: Callable, regular: Bool[Array, ""]) -> Callable:
    """(dG, λ) ↦ how λ turns with the null space of Gᵀ to stay of least norm: not at all where rows are independent."""

    def turned(dG, multipliers):
        nothing = jnp.zeros((G.shape[1], multipliers.shape[1]), multipliers.dtype)
        change = dG @ solve(nothing, multipliers)[0]
        return change - G @ solve(nothing, change)[0]

    return lambda dG, multipliers: lax.cond(regular, lambda _, multipliers: jnp.zeros_like(multipliers), turned, dG, multipliers)


def is_determined(M: lx.DiagonalLinearOperator, _: Factors) -> Bool[Array, ""]:
    """Whether no mass is missing."""
    return jnp.all(M.diagonal > 0)


def masses(M: lx.DiagonalLinearOperator) -> Float[Array, " n"]:
    """The diagonal of M."""
    return M.diagonal


def is_satisfied(G: SparseMatrix, c, x, free) -> Bool[Array, ""]:
    """Whether G x = c, each row in its own units, as far as rounding lets it be beside the motion without constraints: what rows that
    follow from others ask for follows too.
    """
    size = row_sums(G)[:, None]
    unit = jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1), 1)
    scale = unit * (jnp.abs(c) + abs(G) @ (jnp.abs(x) + jnp.abs(free)))
    allowed = jnp.finfo(x.dtype).eps ** FOLLOWS * jnp.max(scale, axis=0, initial=0.0, keepdims=True)
    return jnp.all(unit * jnp.abs(G @ x - c) <= allowed)
