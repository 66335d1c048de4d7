"""Matrices of which only the entries that are not zero by structure are kept: their places are known while tracing."""

import functools
import itertools
import operator
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Float

from .jit import jitted

FEW = 8  # entries of a row, up to which they are added up one by one: rods between 10 000 points take 1.2 ms so, and 1.7 ms by a reduction
UNEVEN = 4  # rows are padded to the longest where that makes no more than so many times as many entries


class Places:
    """The rows and columns of the entries of a matrix, row by row; compared by them. `last`: the first of the rows that are eliminated
    only after all that they are coupled with, as those of multipliers are.
    """

    def __init__(self, rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int], last: int | None = None):
        self.rows, self.columns, self.shape, self.last = rows, columns, shape, last
        self.key = shape, last, rows.tobytes(), columns.tobytes()
        self.hash = hash(self.key)

    @classmethod
    def of(cls, pattern: Any, last: int | None = None) -> "Places":
        """Those of a sparse matrix of SciPy."""
        pattern = scipy.sparse.csr_matrix(pattern)
        pattern.sort_indices()
        m, n = pattern.shape
        return cls(np.repeat(np.arange(m), np.diff(pattern.indptr)), np.asarray(pattern.indices, int), (m, n), last)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Places) and self.key == other.key

    def __hash__(self) -> int:
        return self.hash

    def pattern(self) -> scipy.sparse.csr_matrix:
        """As a sparse matrix of SciPy, with the numbers of the entries, from 1 on."""
        return scipy.sparse.csr_matrix((np.arange(1, self.rows.size + 1), (self.rows, self.columns)), self.shape)

    @functools.cached_property
    def by_row(self) -> np.ndarray | None:
        """For each row the numbers of its entries, padded by the number of entries; None where rows are too uneven."""
        m, size = self.shape[0], self.rows.size
        count = np.bincount(self.rows, minlength=m)
        width = int(count.max(initial=0))
        if width * m > UNEVEN * size + m:
            return None
        padded = np.full((m, width), size)
        padded[self.rows, np.arange(size) - np.repeat(np.cumsum(count) - count, count)] = np.arange(size)
        return padded

    @functools.cached_property
    def transposed(self) -> tuple["Places", np.ndarray]:
        """Those of the transpose, and the numbers that its entries have here."""
        order = np.lexsort((self.rows, self.columns))
        return Places(self.columns[order], self.rows[order], self.shape[::-1], self.last), order


class SparseMatrix(eqx.Module):
    """A matrix by its entries."""

    values: Float[Array, " e"]
    places: Places = eqx.field(static=True)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.places.shape

    @property
    def T(self) -> "SparseMatrix":
        """The transpose."""
        places, order = self.places.transposed
        return SparseMatrix(picked(self.values, order), places)

    def __matmul__(self, x: Float[Array, "n *k"]) -> Float[Array, "m *k"]:  # noqa: F821
        """The product with a vector, or with a matrix column by column."""
        return _product(self, x)

    def __neg__(self) -> "SparseMatrix":
        return SparseMatrix(-self.values, self.places)

    def __abs__(self) -> "SparseMatrix":
        return SparseMatrix(jnp.abs(self.values), self.places)

    @property
    def diagonal(self) -> Float[Array, " m"]:
        """The numbers on the diagonal."""
        return summed_by(self.places, jnp.where(self.places.rows == self.places.columns, self.values, 0))

    def plus_diagonal(self, x: Float[Array, " n"]) -> "SparseMatrix":
        """With x added on the diagonal, all of which must be among the places."""
        return SparseMatrix(self.values.at[np.flatnonzero(self.places.rows == self.places.columns)].add(x), self.places)

    def columns(self, which: np.ndarray) -> "SparseMatrix":
        """Some of its columns, in this order."""
        new = np.full(self.shape[1], -1)
        new[which] = np.arange(which.size)
        kept = np.flatnonzero(new[self.places.columns] >= 0)
        kept = kept[np.lexsort((new[self.places.columns[kept]], self.places.rows[kept]))]
        places = Places(self.places.rows[kept], new[self.places.columns[kept]], (self.shape[0], which.size))
        return SparseMatrix(self.values[kept], places)

    def row_blocks(self, heights: tuple[int, ...]) -> list["SparseMatrix"]:
        """The matrices that it consists of, one below the other."""
        ends, parts = np.cumsum([0, *heights]), []
        for start, end in itertools.pairwise(ends):
            kept = slice(*np.searchsorted(self.places.rows, [start, end]))
            places = Places(self.places.rows[kept] - start, self.places.columns[kept], (int(end - start), self.shape[1]))
            parts.append(SparseMatrix(self.values[kept], places))
        return parts

    def as_matrix(self) -> Float[Array, "m n"]:
        """With its zeros."""
        return jnp.zeros(self.shape, self.values.dtype).at[self.places.rows, self.places.columns].set(self.values)


@jitted  # so that each of many products stands in a program as a call
def _product(matrix: SparseMatrix, x: Array) -> Array:
    places, values = matrix.places, matrix.values.reshape(-1, *[1] * (x.ndim - 1))
    if places.by_row is None:
        return _by_segments(places, values * picked(x, places.columns))
    padded, columns = _with_zero(values), np.append(places.columns, 0)
    return _row_by_row(places.by_row, lambda entry: picked(padded, entry) * picked(x, columns[entry]))


@jitted
def summed_by(places: Places, values: Float[Array, "e *k"]) -> Float[Array, "m *k"]:  # noqa: F821
    """The sum of each row."""
    if places.by_row is None:
        return _by_segments(places, values)
    padded = _with_zero(values)
    return _row_by_row(places.by_row, lambda entry: picked(padded, entry))


def picked(x: Float[Array, "n *k"], index: np.ndarray) -> Array:  # noqa: F821
    """x[index], of a known index within bounds: nothing of that stands in the program."""
    return x.at[index.astype(np.int32)].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _by_segments(places, values):
    return jax.ops.segment_sum(values, places.rows, places.shape[0], indices_are_sorted=True)


def _with_zero(values):
    return jnp.concatenate([values, jnp.zeros_like(values[:1])])


def _row_by_row(by_row: np.ndarray, term: Callable) -> Array:
    """The sum over the entries of each row of a term of their numbers; of few one by one, which XLA puts into one loop with their terms."""
    if 0 < by_row.shape[1] <= FEW:
        return functools.reduce(operator.add, [term(entry) for entry in by_row.T])
    return jnp.sum(term(by_row), axis=1)


def row_sums(matrix: Any) -> Float[Array, " m"]:
    """Σⱼ |aᵢⱼ|."""
    return summed_by(matrix.places, jnp.abs(matrix.values)) if isinstance(matrix, SparseMatrix) else jnp.sum(jnp.abs(matrix), axis=1)


def dense(matrix: Any) -> Float[Array, "m n"]:
    """A matrix with its zeros, whether it is kept with them or not."""
    return matrix.as_matrix() if isinstance(matrix, SparseMatrix) else matrix


def colors(pattern: Any) -> np.ndarray:
    """Greedy coloring: for each column the least number that no earlier column with a row in common has."""
    pattern = scipy.sparse.csr_matrix(pattern, dtype=np.int64)
    beside = (pattern.T @ pattern).tocsr()
    color, starts, others = np.zeros(pattern.shape[1], int), beside.indptr, beside.indices
    for j in range(1, color.size):
        before = others[starts[j] : starts[j + 1]]
        used = set(color[before[before < j]].tolist())
        color[j] = next(c for c in range(j + 1) if c not in used)
    return color
