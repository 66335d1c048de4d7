"""Sparse Jacobians in as few directions as their zeros allow.

Columns that share no row are differentiated in one direction together (Curtis, Powell & Reid, J. Inst. Maths Applics 13 (1974) 117):
rods that each join two of many points take four directions in the plane, however long the chain is. The zeros are read from the program.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import scipy.sparse
from jaxtyping import Array, Bool, Float

from .expressions import TooLong
from .sparse_matrix import SparseMatrix, SparsityPattern, colors, gather_static
from .sparsity import MANY as MANY
from .sparsity import dependence, sparsity_pattern
from .structured_jacobian import structured_jacobian

MAX_DENSE_COLUMNS = 3  # up to here a direction for each column costs less than looking for zeros
MAX_SCALAR_COLUMNS = 5  # up to here most programs become scalar code, which is shortest with a direction for each column
SPARSE = 8  # times as many columns as directions, from which on they are


def jacobian(
    function: Callable, x: Float[Array, " n"], pattern_of: Callable[[], Bool[np.ndarray, "m n"]] | None = None
) -> tuple[Float[Array, " m"], lx.AbstractLinearOperator | SparseMatrix]:
    """f(x) and ∂f/∂x, which is a `DiagonalLinearOperator` where its program shows that it is diagonal, and a `SparseMatrix` where it is
    large and takes few directions. `pattern_of()`: where it is not large, which numbers of it may differ from zero, if that is known.
    """
    y, push = jax.linearize(function, x)
    if x.size >= MANY and (found := _by_arrays(function, push, x)) is not None:
        return y, found
    if x.size >= MANY and y.size * SPARSE <= x.size:
        return y, lx.MatrixLinearOperator(jax.jacrev(function)(x))  # of a few full rows, as of what the last link of a chain is held by
    if x.size <= MAX_DENSE_COLUMNS:
        pattern = np.ones((y.size, x.size), bool)
    else:
        pattern = pattern_of() if pattern_of else sparsity_pattern(function, x)
    if pattern.shape[0] == pattern.shape[1] > MAX_DENSE_COLUMNS and np.array_equal(pattern, np.eye(x.size)):
        return y, lx.DiagonalLinearOperator(push(jnp.ones_like(x)))
    color = np.arange(x.size) if pattern.all() else colors(pattern)
    if x.size > MAX_SCALAR_COLUMNS and max(color) + 1 == x.size and (columns := structured_jacobian(function, x)) is not None:
        return y, lx.MatrixLinearOperator(columns)
    columns = along(push, color, x)
    if columns.shape[1] < x.size:
        columns = jnp.where(pattern, columns[:, color], 0)
    return y, lx.MatrixLinearOperator(columns)


def _by_arrays(function: Callable, push: Callable, x: Float[Array, " n"]) -> lx.DiagonalLinearOperator | SparseMatrix | None:
    """∂f/∂x where the program of arrays shows that most of it is zeros."""
    try:
        pattern = dependence(function, x)
    except TooLong:
        return None
    m, n = pattern.shape
    if pattern.nnz == 0:
        return None
    if m == n == pattern.nnz and np.array_equal(pattern.indices, np.arange(n)) and np.array_equal(np.diff(pattern.indptr), np.ones(n)):
        return lx.DiagonalLinearOperator(push(jnp.ones_like(x)))
    if (color := few_colors(pattern)) is None:
        return None
    by_row = colors(pattern.T)
    if 2 * (max(by_row) + 1) <= max(color) + 1:
        pull = jax.linear_transpose(push, x)
        return entries(lambda y: pull(y)[0], by_row, pattern.T, x).T
    return entries(push, color, pattern, x)


def entries(push: Callable, color: np.ndarray, pattern: Any, x: Float[Array, " n"]) -> SparseMatrix:
    """The entries of a Jacobian, by directions of one color each."""
    places = SparsityPattern.of(pattern)
    directions = along(push, color, x).T  # as they are computed: this way around they are read faster, too
    return SparseMatrix(gather_static(directions.ravel(), color[places.columns] * places.shape[0] + places.rows), places)


def few_colors(pattern: Any) -> np.ndarray | None:
    """The colors of the columns of a sparse pattern; None where they are too many for its zeros to be left out."""
    n = pattern.shape[1]
    if SPARSE * np.diff(pattern.indptr).max(initial=0) > n or SPARSE * max(color := colors(pattern)) >= n:
        return None
    return color


def along(push: Callable, color: np.ndarray, x: Float[Array, " n"]) -> Float[Array, "m c"]:
    """The derivatives along directions, each the sum of the columns of one color."""
    directions = jnp.asarray(np.arange(max(color, default=-1) + 1)[:, None] == color, x.dtype)
    return jax.vmap(push, out_axes=1)(directions)


def empty_rows(function: Callable, x: Float[Array, " n"]) -> np.ndarray:
    """The numbers of the elements of f(x) that depend on none of x."""
    try:
        return np.flatnonzero(np.diff(dependence(function, x).indptr) == 0)
    except TooLong:
        return np.flatnonzero(~np.any(sparsity_pattern(function, x), axis=1))


def underdetermined(pattern: Bool[np.ndarray, "m k"]) -> Bool[np.ndarray, " k"]:
    """Unknowns that the equations of this pattern do not determine, whatever their numbers.

    Source: Dulmage & Mendelsohn, Canad. J. Math. 10 (1958) 517: what alternating paths from unmatched columns reach.
    """
    if not pattern.size:
        return np.ones(pattern.shape[1], bool)
    from scipy.sparse.csgraph import maximum_bipartite_matching  # imported here because that takes a while

    row_of = maximum_bipartite_matching(scipy.sparse.csr_matrix(pattern))  # of a column; −1 where none is left for it
    column_of = np.full(pattern.shape[0], -1)
    column_of[row_of[row_of >= 0]] = np.flatnonzero(row_of >= 0)
    reached = row_of < 0
    front = np.flatnonzero(reached)
    while front.size:
        behind = column_of[np.any(pattern[:, front], axis=1)]
        front = np.setdiff1d(behind[~reached[behind]], -1)
        reached[front] = True
    return reached
