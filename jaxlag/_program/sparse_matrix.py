"""Matrices of which only the entries that are not zero by structure are kept: which these are is known while tracing."""

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
from jaxtyping import Array, Bool, Float

from .jit import jitted

FEW = 8  # entries of a row, up to which they are added up one by one: rods between 10 000 points take 1.2 ms so, and 1.7 ms by a reduction
UNEVEN = 4  # rows are padded to the longest where that makes no more than so many times as many entries


class SparsityPattern:
    """The rows and columns of the entries of a matrix, row by row; compared by them. `last`: the first of the rows that are eliminated
    only after all that they are coupled with, as those of multipliers are.
    """

    def __init__(self, rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int], last: int | None = None):
        self.rows, self.columns, self.shape, self.last = rows, columns, shape, last
        self.key = shape, last, rows.tobytes(), columns.tobytes()
        self.hash = hash(self.key)

    @classmethod
    def of(cls, pattern: Any, last: int | None = None) -> "SparsityPattern":
        """The pattern of a sparse matrix of SciPy."""
        pattern = scipy.sparse.csr_matrix(pattern)
        pattern.sort_indices()
        m, n = pattern.shape
        return cls(np.repeat(np.arange(m), np.diff(pattern.indptr)), np.asarray(pattern.indices, int), (m, n), last)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SparsityPattern) and self.key == other.key

    def __hash__(self) -> int:
        return self.hash

    def to_scipy(self) -> scipy.sparse.csr_matrix:
        """The sparse matrix of SciPy, with the numbers of the entries, from 1 on."""
        return scipy.sparse.csr_matrix((np.arange(1, self.rows.size + 1), (self.rows, self.columns)), self.shape)

    @functools.cached_property
    def by_row(self) -> np.ndarray | None:
        """The numbers of the entries of each row, padded by the number of entries; None where rows are too uneven."""
        m, size = self.shape[0], self.rows.size
        count = np.bincount(self.rows, minlength=m)
        width = int(count.max(initial=0))
        if width * m > UNEVEN * size + m:
            return None
        padded = np.full((m, width), size)
        padded[self.rows, np.arange(size) - np.repeat(np.cumsum(count) - count, count)] = np.arange(size)
        return padded

    def pairs_in_a_column(self) -> tuple[np.ndarray, np.ndarray]:
        """All pairs of entries that stand in one column, by their numbers."""
        number = scipy.sparse.csc_matrix(self.to_scipy())
        starts, entries = number.indptr, number.data - 1
        count = np.repeat(np.diff(starts), np.diff(starts))
        first = np.repeat(np.arange(entries.size), count)
        within = np.arange(first.size) - np.repeat(np.cumsum(count) - count, count)
        return entries[first], entries[np.repeat(np.repeat(starts[:-1], np.diff(starts)), count) + within]

    @functools.cached_property
    def transposed(self) -> tuple["SparsityPattern", np.ndarray]:
        """The pattern of the transpose, and the numbers that its entries have here."""
        order = np.lexsort((self.rows, self.columns))
        return SparsityPattern(self.columns[order], self.rows[order], self.shape[::-1], self.last), order


class SparseMatrix(eqx.Module):
    """A matrix by its entries."""

    values: Float[Array, " e"]
    pattern: SparsityPattern = eqx.field(static=True)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.pattern.shape

    @property
    def T(self) -> "SparseMatrix":
        """The transpose."""
        pattern, order = self.pattern.transposed
        return SparseMatrix(gather_static(self.values, order), pattern)

    def __matmul__(self, x: Float[Array, "n *k"]) -> Float[Array, "m *k"]:  # noqa: F821
        """The product with a vector, or with a matrix column by column."""
        return _product(self, x)

    def __neg__(self) -> "SparseMatrix":
        return SparseMatrix(-self.values, self.pattern)

    def __abs__(self) -> "SparseMatrix":
        return SparseMatrix(jnp.abs(self.values), self.pattern)

    @property
    def diagonal(self) -> Float[Array, " m"]:
        """The numbers on the diagonal."""
        return summed_by(self.pattern, jnp.where(self.pattern.rows == self.pattern.columns, self.values, 0))

    def plus_diagonal(self, x: Float[Array, " n"]) -> "SparseMatrix":
        """Adds x on the diagonal, all of which must be in the pattern."""
        return SparseMatrix(self.values.at[np.flatnonzero(self.pattern.rows == self.pattern.columns)].add(x), self.pattern)

    def columns(self, which: np.ndarray) -> "SparseMatrix":
        """The matrix of some of its columns, in this order."""
        new = np.full(self.shape[1], -1)
        new[which] = np.arange(which.size)
        kept = np.flatnonzero(new[self.pattern.columns] >= 0)
        kept = kept[np.lexsort((new[self.pattern.columns[kept]], self.pattern.rows[kept]))]
        pattern = SparsityPattern(self.pattern.rows[kept], new[self.pattern.columns[kept]], (self.shape[0], which.size))
        return SparseMatrix(self.values[kept], pattern)

    def row_blocks(self, heights: tuple[int, ...]) -> list["SparseMatrix"]:
        """The matrices that it consists of, one below the other."""
        ends, parts = np.cumsum([0, *heights]), []
        for start, end in itertools.pairwise(ends):
            kept = slice(*np.searchsorted(self.pattern.rows, [start, end]))
            pattern = SparsityPattern(self.pattern.rows[kept] - start, self.pattern.columns[kept], (int(end - start), self.shape[1]))
            parts.append(SparseMatrix(self.values[kept], pattern))
        return parts

    def as_matrix(self) -> Float[Array, "m n"]:
        """The dense matrix."""
        return jnp.zeros(self.shape, self.values.dtype).at[self.pattern.rows, self.pattern.columns].set(self.values)


@jitted  # so that each of many products stands in a program as a call
def _product(matrix: SparseMatrix, x: Array) -> Array:
    pattern, values = matrix.pattern, matrix.values.reshape(-1, *[1] * (x.ndim - 1))
    if pattern.by_row is None:
        return _by_segments(pattern, values * gather_static(x, pattern.columns))
    padded, columns = _with_zero(values), np.append(pattern.columns, 0)
    return _row_by_row(pattern.by_row, lambda entry: gather_static(padded, entry) * gather_static(x, columns[entry]))


@jitted
def summed_by(pattern: SparsityPattern, values: Float[Array, "e *k"]) -> Float[Array, "m *k"]:  # noqa: F821
    """The sum of each row."""
    if pattern.by_row is None:
        return _by_segments(pattern, values)
    padded = _with_zero(values)
    return _row_by_row(pattern.by_row, lambda entry: gather_static(padded, entry))


def gather_static(x: Float[Array, "n *k"], index: np.ndarray) -> Array:  # noqa: F821
    """The elements x[index] of a known index within bounds: nothing of that stands in the program."""
    return x.at[index.astype(np.int32)].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _by_segments(pattern, values):
    return jax.ops.segment_sum(values, pattern.rows, pattern.shape[0], indices_are_sorted=True)


def _with_zero(values):
    return jnp.concatenate([values, jnp.zeros_like(values[:1])])


def _row_by_row(by_row: np.ndarray, term: Callable) -> Array:
    """The sum over the entries of each row of a term of their numbers; of few one by one, which XLA puts into one loop with their terms."""
    if 0 < by_row.shape[1] <= FEW:
        return functools.reduce(operator.add, [term(entry) for entry in by_row.T])
    return jnp.sum(term(by_row), axis=1)


def row_sums(matrix: Any) -> Float[Array, " m"]:
    """Σⱼ |aᵢⱼ|."""
    return summed_by(matrix.pattern, jnp.abs(matrix.values)) if isinstance(matrix, SparseMatrix) else jnp.sum(jnp.abs(matrix), axis=1)


def with_rows_alone(matrix: Any, which: Bool[Array, " m"]) -> Any:
    """The matrix with zeros for its other rows."""
    if isinstance(matrix, SparseMatrix):
        return SparseMatrix(jnp.where(which[matrix.pattern.rows], matrix.values, 0), matrix.pattern)
    return jnp.where(which[:, None], matrix, 0)


def dense(matrix: Any) -> Float[Array, "m n"]:
    """The dense matrix, of a sparse one too."""
    return matrix.as_matrix() if isinstance(matrix, SparseMatrix) else matrix


def assembled(rows: np.ndarray, columns: np.ndarray, n: int, last: int | None = None) -> tuple[SparsityPattern, SparsityPattern]:
    """The pattern of an n × n matrix whose entries are sums, and that by which their terms, at the given rows and columns, are added up:
    its columns are the numbers of the terms in the order of its rows.
    """
    entry, number = np.unique(rows * n + columns, return_inverse=True)
    sorting = np.argsort(number, kind="stable")
    return SparsityPattern(entry // n, entry % n, (n, n), last), SparsityPattern(number[sorting], sorting, (entry.size, number.size))


def elimination_order(pattern: Any, last: int | None = None) -> np.ndarray:
    """The rows in an order of small bandwidth; those from `last` on behind all that they are coupled with: beside these alone, no pivot of
    theirs is zero.

    Source: Cuthill & McKee, Proc. 24th Nat. Conf. ACM (1969) 157; here reversed.
    """
    from scipy.sparse.csgraph import reverse_cuthill_mckee  # imported here because that takes a while

    coupled = scipy.sparse.csr_matrix(pattern, dtype=bool).astype(np.int64)
    order = np.asarray(reverse_cuthill_mckee((coupled + coupled.T).tocsr(), symmetric_mode=True), int)
    if last is None:
        return order
    (rows, columns), rank, is_last = coupled.nonzero(), np.argsort(order), np.arange(order.size) >= last
    place = np.where(is_last, -1, rank)
    np.maximum.at(place, rows, np.where(is_last[rows], rank[columns], -1))
    return np.lexsort((is_last, place))


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
