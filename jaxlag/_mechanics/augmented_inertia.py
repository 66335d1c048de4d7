"""M + GᵀWG, which says the same as M on the null space of G and is positive there and beside; and units that make all inertias alike."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float

from .._program.conditions import everywhere
from .._program.shifted_factors import inverse_lengths
from .._program.sparse_matrix import SparseMatrix
from .structured_inertia import StructuredInertia


def augmented(M, G):
    """M + GᵀWG, with W such that a row of it is as heavy as what it moves; the solution does not depend on W."""
    W = jax.lax.stop_gradient(_weights(jnp.diagonal(M), G**2))
    return M + G.T @ (W[:, None] * G), W


def unit_lengths(M: Float[Array, "n n"], G: Float[Array, "m n"]) -> Float[Array, " n"]:
    """Units of the coordinates in which each has inertia of order one, whatever units they are given in; of what has no mass, by rows."""
    units, present = inverse_lengths(jnp.diagonal(augmented(M, G)[0]), 0)
    return jnp.where(present, units, 1)


def units_alike(M: lx.AbstractLinearOperator, rows: Sequence[Any]) -> Float[Array, " n"]:
    """`unit_lengths` of an M and rows of any kind; of many coordinates those of their masses, and 0 where these are not seen."""
    if isinstance(M, StructuredInertia) and M.sums:
        return jnp.zeros(M.size, M.slopes.values.dtype)
    if isinstance(M, lx.DiagonalLinearOperator) and not rows:
        return jnp.where(M.diagonal > 0, units_of_mass(M.diagonal), 1)
    if not isinstance(M, StructuredInertia) and not any(isinstance(G, SparseMatrix) for G in rows):
        M = M.as_matrix()
        return unit_lengths(M, jnp.concatenate([jnp.zeros((0, len(M)), M.dtype), *rows]))
    return units_of_mass(M.slopes.diagonal if isinstance(M, StructuredInertia) else lx.diagonal(M))


def units_of_mass(mass: Float[Array, " n"]) -> Float[Array, " n"]:
    """Units in which each coordinate has inertia 1; 0 of what has none."""
    return inverse_lengths(mass, 0)[0]


def alike(M: lx.AbstractLinearOperator, rows: Sequence[Any], size: Float[Array, " n"]) -> Float[Array, " n"]:
    """`by_weight` in the units of M and rows."""
    return by_weight(jax.lax.stop_gradient(units_alike(M, rows)), size)


def by_weight(units: Float[Array, "n *members"], size: Float[Array, "n *k"]) -> Float[Array, "n *k"]:  # noqa: F821
    """Sizes of the numbers of a state, each at least what weighs as much as the largest of the others: mass tells what is small of a number
    that is zero.
    """
    units = units.reshape(*units.shape, *[1] * (size.ndim - units.ndim)).astype(size.dtype)
    share = jnp.where(units > 0, size / jnp.where(units > 0, units, 1), 0)
    return jnp.maximum(size, units * jnp.max(share, axis=0, keepdims=True, initial=0.0))


def _weights(masses: Float[Array, " n"], squares: Float[Array, "m n"]) -> Float[Array, " m"]:
    """What each row weighs: one over its length² in units in which all that it moves has mass 1, whatever the units are. What has no
    mass weighs what the rows do that hold it to masses; and a row that moves nothing else, what makes its length one.
    """
    inverse = lambda x: jnp.where(x > 0, 1 / jnp.where(x > 0, x, 1), 0)

    def added(W):
        return jnp.where(W > 0, W, inverse(squares @ inverse(masses + W @ squares)))

    W = added(jnp.zeros_like(squares[:, 0]))
    if len(W) > 1:
        behind = lambda: jax.lax.fori_loop(1, len(W), lambda _, W: added(W), W)
        W = jax.lax.cond(everywhere(jnp.all(W > 0)), lambda: W, behind)
    return jnp.where(W > 0, W, inverse(jnp.sum(squares, axis=1)))
