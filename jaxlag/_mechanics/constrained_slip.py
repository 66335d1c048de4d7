"""Slip velocities on the constraints: the part that these leave free, and the part that they decide.

Of s = A q̇ + s₀ with G q̇ + b = 0, A (1 − G⁺G) q̇ is free, in V = range A (1 − G⁺G), and the rest is decided. Friction may hold an
element along V alone, with P s = 0 and a force in V; across V the constraints hold what there is to hold. Where the decided part
(1 − P)(s₀ − A G⁺b) is not zero, an element cannot rest: its slip is driven, as that of a crank whose angle is prescribed.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._model.flat import Flat, read_once
from .._program.implicit import undifferentiated
from .._program.scalarise import scalarised
from .._program.sparsity import sparsity_pattern
from .friction_elements import FrictionElements, find_elements
from .lagrange import inertia, pattern_of_rows, velocity_residual
from .saddle_point import FEW

NOISE = 0.75  # power of eps, what is left of a row by rounding alone


class Left(NamedTuple):
    """P of all elements, in blocks; of each element, whether V is a line through rest, and whether its slip is driven."""

    free: Float[Array, "r r"]
    straight: Bool[Array, " e"]
    driven: Bool[Array, " e"]


def on_constraints(flat: Flat, elements: FrictionElements, t, q, v, left: Callable | None = None) -> FrictionElements:
    """The elements at this state, with what the constraints leave of their slip. Of many constraints that is not asked.

    `left()` is what they leave, where there is a program of it already.
    """
    if not 0 < flat.rows <= FEW or flat.massless or not read_once(flat, _may_be_decided):
        return elements._replace(free=None, straight=np.array(False), driven=np.array(False))
    found = left() if left else left_by_constraints(flat, elements, t, q, v)
    return elements._replace(**found._asdict())


def freely(elements: FrictionElements, rows: Float[Array, "r *k"]) -> Float[Array, "r *k"]:  # noqa: F821
    """Slips, or forces on them, without what constraints decide."""
    return rows if elements.free is None else elements.free @ rows


def directed(elements: FrictionElements, sigma: Float[Array, " r"]) -> Float[Array, " r"]:
    """σ, turned along where constraints leave a single direction of slip."""
    if elements.free is None or not np.any(elements.is_vector):
        return sigma
    along = freely(elements, sigma)
    size, turns = elements.norms(along), elements.straight & (elements.norms(along) > 0)
    ratio = jnp.where(turns, elements.norms(sigma) / jnp.where(turns, size, 1), 1)
    return jnp.where(turns[elements.element_of_row], along * ratio[elements.element_of_row], sigma)


def extent_of(elements: FrictionElements, sigma: Float[Array, " r"], slip: Float[Array, " r"]) -> Float[Array, " e"]:
    """u = ‖s‖ of each element: σ s for a single row or direction, smooth through s = 0; for others σ·s near rest only."""
    along, norm = elements.sums(directed(elements, sigma) * slip), elements.norms(slip)
    near_rest = norm <= jnp.maximum(elements.near_rest, jnp.finfo(slip.dtype).tiny ** 0.25)
    turns = elements.is_vector & ~elements.straight
    extent = jnp.where(turns & ~near_rest, norm, along) if np.any(elements.is_vector) else along
    return jnp.where(elements.norms(sigma) == 0, 0, extent)


def _may_be_decided(flat: Flat, t, q, v) -> bool:
    """Whether some slip moves nothing but what constraints move, too; nearly all slips of several components do."""
    elements = find_elements(flat)
    assert elements is not None  # asked where there are some
    if np.any(elements.is_vector):
        return True
    held = np.any(read_once(flat, pattern_of_rows), axis=0)
    return bool(np.any(np.all(held | ~sparsity_pattern(lambda v: elements.slip(t, q, v), v), axis=1)))


def left_by_constraints(flat: Flat, elements: FrictionElements, t, q, v) -> Left:
    """What few constraints leave of each slip: of a single row all or nothing, which does not change with the state."""
    found = lambda t, q, v: _left(flat, elements, t, q, v)
    return scalarised(found if np.any(elements.is_vector) else undifferentiated(found))(t, q, v)


def _left(flat: Flat, elements: FrictionElements, t, q, v) -> Left:
    """In the metric of the diagonal of M, which no unit of a coordinate changes."""
    still, mass = jnp.zeros_like(v), jnp.diagonal(inertia(flat, t, q, v).as_matrix())
    root = jnp.sqrt(jnp.where(mass > 0, mass, 1))
    rows = lambda function: (jax.jacfwd(function)(still) / root[None], function(still))
    basis, b = _orthonormal(*rows(lambda v: velocity_residual(flat, t, q, v)))
    A, s0 = rows(lambda v: elements.slip(t, q, v))
    rest, decided = _beside(basis, b, A, s0)
    eps, terms = jnp.finfo(v.dtype).eps, jnp.abs(s0) + jnp.abs(A @ basis.T) @ jnp.abs(b)
    rounding = eps**NOISE * terms + 4 * eps * jnp.abs(A) @ jnp.abs(root * v)
    size = lambda rows: elements.sums(jnp.sum(rows**2, axis=1))
    of, line = elements.element_of_row, jnp.zeros(elements.size, bool)
    there, seen = size(rest) > eps ** (2 * NOISE) * size(A), jnp.sum(rest**2, axis=1) > eps ** (2 * NOISE) * size(A)[of]
    rest = rest - jax.lax.stop_gradient(jnp.where(seen[:, None], 0, rest))  # no rounding, but what it changes by
    count = np.bincount(of)
    free = jnp.diag(jnp.where((count > 1)[of], 0, there[of]).astype(v.dtype))  # of a single row all or nothing
    for rows in sorted({*count} - {1}):  # those of as many rows together
        mine = np.stack([np.flatnonzero(of == e) for e in np.flatnonzero(count == rows)])
        P, rank = jax.vmap(_onto_range)(jnp.where(there[count == rows][:, None, None], rest[mine] @ rest[mine].mT, 0))
        places = (np.arange(of.size) == mine[..., None]).astype(v.dtype)
        free = free + jnp.einsum("eir,eij,ejs->rs", places, P, places)
        line = line.at[count == rows].set(rank == 1)
    decided = decided - free @ decided
    driven = elements.sums(decided**2) > elements.sums(rounding**2)  # squares, whose bounds over time are close
    return Left(free, line & ~driven, driven)


def _orthonormal(G: Float[Array, "m n"], b: Float[Array, " m"]) -> tuple[Float[Array, "m n"], Float[Array, " m"]]:
    """Rows that span those of G, with zeros in place of those that follow from others, and b along with them."""
    basis, beside = jnp.zeros_like(G), jnp.zeros_like(b)
    for i in range(len(G)):
        size = jnp.sum(G[i] ** 2)
        row, value = _beside(basis[:i], beside[:i], G[i : i + 1], b[i : i + 1])
        left = jnp.sum(row**2)
        length = jnp.sqrt(jnp.where(left > jnp.finfo(G.dtype).eps * size, left, jnp.inf))
        basis, beside = basis.at[i].set(row[0] / length), beside.at[i].set(value[0] / length)
    return basis, beside


def _beside(basis, b, A, s):
    """Rows A and their s without their parts along an orthonormal basis; twice, for the rounding (Golub & Van Loan, section 5.2.9)."""
    for _ in range(2 if len(basis) else 0):
        along = A @ basis.T
        A, s = A - along @ basis, s - along @ b
    return A, s


def _onto_range(W: Float[Array, "k k"]) -> tuple[Float[Array, "k k"], Array]:
    """The projector onto the range of a positive semidefinite W, and its rank.

    Of rank r, W satisfies a polynomial of degree r on its range: P = W M / e, with M and e of Faddeev and LeVerrier's r-th step.
    Source: Gantmacher, The Theory of Matrices I, section IV.5.
    """
    one, trace = jnp.eye(len(W), dtype=W.dtype), jnp.trace(W)
    W = W / jnp.where(trace > 0, trace, 1)
    M, P, before, rank = one, jnp.zeros_like(W), jnp.ones((), W.dtype), jnp.zeros((), W.dtype)
    for step in range(1, len(W) + 1):
        product = W @ M
        e = jnp.trace(product) / step
        is_more = (rank == step - 1) & (e > jnp.finfo(W.dtype).eps ** NOISE * before)
        P, rank = jnp.where(is_more, product / jnp.where(is_more, e, 1), P), rank + is_more
        M, before = e * one - product, jnp.where(is_more, e, 1)
    return P, rank
