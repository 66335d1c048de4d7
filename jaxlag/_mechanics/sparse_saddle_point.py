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

from .._program.block_tridiagonal import by_factor, elimination, factor
from .._program.conditions import everywhere
from .._program.shifted_factors import SHIFT, put_right, shifted_where_singular, signs
from .._program.sparse_matrix import SparseMatrix, picked, row_sums, summed_by
from .pseudo_inverse import FOLLOWS


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
    how, eps = elimination(G.places), jnp.finfo(G.values.dtype).eps
    first, second = how.pairs
    pairs = picked(G.values, first) * picked(G.values, second) / picked(M.diagonal, G.places.columns[first])
    S = picked(jnp.append(summed_by(how.sums, pairs), 0), how.entry)
    squares, diagonal = jnp.diagonal(S[:, 0], axis1=1, axis2=2), jax.vmap(jnp.diag)
    there = squares > (4 * eps) ** 2 * jnp.max(squares)  # a row of nothing but rounding has no part in it
    D = jnp.where(there, lax.rsqrt(jnp.where(there, squares, 1)), 0)
    before = jnp.concatenate([jnp.zeros_like(D[:1]), D[:-1]])
    on = S[:, 0] * D[:, :, None] * D[:, None, :] + diagonal((~there).astype(S.dtype))
    below = S[:, 1] * D[:, :, None] * before[:, None, :]
    typical = jnp.exp(-2 * jnp.mean(jnp.log(jnp.where(there, D, 1))))
    shift = eps**SHIFT * D**2 * typical  # as much for each row in the units given
    probe = signs((*D.shape, 1), D.dtype)

    factored = lambda shift: factor(on + diagonal(shift), below)
    factors, shifted = shifted_where_singular(factored, lambda factors: by_factor(factors, probe), shift, is_work=how.size > 1)
    return Factors(factors, everywhere(~shifted & (jnp.sum(there) == G.shape[0])), D)


def solver(M: lx.DiagonalLinearOperator, G: SparseMatrix, factors: Factors) -> tuple[Callable, Callable]:
    """(f, c) ↦ (x, λ); and (dG, λ) ↦ how λ turns with the null space of Gᵀ to stay of least norm."""
    how = elimination(G.places)
    back = np.argsort(how.order)
    by_inertia = lambda F: F / M.diagonal[:, None]
    S = lambda X: G @ by_inertia(G.T @ X)

    def once(R):
        blocks = jnp.concatenate([picked(R, how.order), jnp.zeros((how.padding, R.shape[1]), R.dtype)]).reshape(*factors.D.shape, -1)
        scaled = factors.D[:, :, None] * by_factor(factors.of, factors.D[:, :, None] * blocks)
        return picked(scaled.reshape(-1, R.shape[1]), back)

    refined = lambda matvec, R: put_right(once, matvec, R, 0, ~factors.regular)
    by_rows = lambda R: lax.custom_linear_solve(S, R, refined, symmetric=True)

    def solve(f, c):
        multipliers = by_rows(c - G @ by_inertia(f))
        return by_inertia(f + G.T @ multipliers), multipliers

    def rotated(dG, multipliers):
        def turned(dG, multipliers):
            change = dG @ by_inertia(G.T @ by_rows(multipliers))
            return change - S(by_rows(change))

        return lax.cond(factors.regular, lambda _, multipliers: jnp.zeros_like(multipliers), turned, dG, multipliers)

    return solve, rotated


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
