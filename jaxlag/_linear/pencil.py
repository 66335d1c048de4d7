"""The motion near rest as a pencil of sparse matrices, read from the equations in a few directions, for any number of coordinates.

P(λ) x = Gᵀμ,   G x = 0,   P(λ) = λ² M + λ C + K:    deviations δq = x exp λt, δλ = μ exp λt
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Complex, Float, PyTree

from .._mechanics.friction_elements import find_elements
from .._mechanics.lagrange import imbalance
from .._model.flat import Flat
from .._model.system import System
from .._model.validation import checked
from .._program.expressions import TooLong
from .._program.jit import compiled
from .._program.size_of_terms import size_of_terms
from .._program.sparse_jacobian import entries
from .._program.sparse_matrix import SparseMatrix, SparsityPattern, colors
from .._program.sparsity import dependence

CURE = "Take `linearise(…).modes()`."


class Pencil(NamedTuple):
    """[K −Gᵀ; −G 0], C and M for (x, μ), with the same places; −f − Gᵀλ and −g, and the size of the terms that cancel there."""

    stiffness: SparseMatrix
    damping: SparseMatrix
    mass: SparseMatrix
    left: Float[Array, " w"]
    terms: Float[Array, " w"]


def _deviation(flat: Flat, t: Any, q: Array, multipliers: Array, along: Array, rate: Array, second_rate: Array) -> Float[Array, " w"]:
    """M q̈ − f − Gᵀλ and −g if q and λ deviate by `along`, q̇ by `rate` and q̈ by `second_rate`."""
    moved = lambda given: (given[: q.size], given[q.size :])
    (x, mu), (v, _), (a, _) = map(moved, (along, rate, second_rate))
    return jnp.concatenate([imbalance(flat, t, q + x, v, a, multipliers + mu)[0], -flat.holonomic(t, q + x)])


def _deviates(system: System, t: Any, q: PyTree, params: PyTree, multipliers: Array) -> tuple[Callable, Array, int]:
    """`_deviation` of a system at rest, the zero deviation, and the number of coordinates."""
    flat, t, q, v = checked(system, t, q, jax.tree.map(jnp.zeros_like, q), params, {})
    if find_elements(flat) is not None:
        raise ValueError(f"`dissipation` must have no dry friction in `lowest_modes`, but has. {CURE}")
    of = lambda *given: _deviation(flat, t, q, multipliers, *given)
    return of, jnp.zeros(q.size + flat.rows, q.dtype), q.size


@compiled
def pencil(system: System, t: Any, q: PyTree, params: PyTree, multipliers: Array) -> Pencil:
    """The pencil at rest at q, with constraint forces λ."""
    of, nothing, n = _deviates(system, t, q, params, multipliers)
    pattern = _pattern(lambda w: of(w, w, w), nothing)
    color, places = colors(pattern), SparsityPattern.of(pattern, n)

    def slope(i):
        at = lambda w: of(*(w if i == j else nothing for j in range(3)))
        return SparseMatrix(entries(jax.linearize(at, nothing)[1], color, pattern, nothing).values, places)

    terms = size_of_terms(lambda w: of(w, nothing, nothing), nothing)
    return Pencil(slope(0), slope(1), slope(2), of(nothing, nothing, nothing), terms)


def _pattern(function: Callable, w: Array) -> scipy.sparse.csr_matrix:
    """The places of possible entries of a Jacobian, and its diagonal."""
    try:
        found = dependence(function, w)
    except TooLong:
        found = scipy.sparse.csr_matrix(np.ones((w.size, w.size), bool))
    return scipy.sparse.csr_matrix(found + scipy.sparse.identity(w.size, bool, "csr"))


@compiled
def left_over(system: System, t: Any, q: PyTree, params: PyTree, multipliers: Array) -> Float[Array, " w"]:
    """−f − Gᵀλ and −g, to be differentiated."""
    of, nothing, _ = _deviates(system, t, q, params, multipliers)
    return of(nothing, nothing, nothing)


@compiled
def along_modes(
    system: System, t: Any, q: PyTree, params: PyTree, multipliers: Array, values: Complex[Array, " k"], vectors: Complex[Array, "w k"]
) -> Complex[Array, "w k"]:
    """P(λ) x − Gᵀμ and −G x of each mode as columns, to be differentiated."""
    of, nothing, _ = _deviates(system, t, q, params, multipliers)
    push = lambda *directions: jax.jvp(of, (nothing,) * 3, directions)[1]

    def one(value, vector):
        directions = vector, value * vector, value**2 * vector
        return push(*(x.real for x in directions)) + 1j * push(*(x.imag for x in directions))

    return jax.vmap(one, in_axes=(0, 1), out_axes=1)(values, vectors)
