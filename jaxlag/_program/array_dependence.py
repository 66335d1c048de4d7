"""Which numbers of an array depend on which of another, read from a program of arrays as it is: its length, not theirs, costs.

Each array of the program stands as a sparse matrix, a row for each of its elements and a column for each element of x. Arithmetic adds
rows, what moves data picks them: found by moving their numbers in place of the data. What a rule does not know depends on everything.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy.sparse
from jax import lax
from jaxtyping import Array

from .constants import ELEMENTWISE, is_foldable
from .expressions import TooLong
from .walker import CALLS, CALLS_WITH_DERIVATIVE_RULE, called_program, unrolled_scan, walk

MAX_ENTRIES = 4_000_000  # of a pattern: some 50 MB
MAX_TURNS = 5_000  # of the scans of a program: some ten seconds
MAX_NUMBERS = 1_000_000  # of an array that is computed while tracing
SUMS = ("reduce_sum", "reduce_max", "reduce_min", "reduce_prod", "reduce_and", "reduce_or", "argmax", "argmin")
CUMULATIVE = ("cumsum", "cumprod", "cummax", "cummin", "cumlogsumexp")
POWERS = ("integer_pow", "square", "convert_element_type")
MOVEMENTS = (
    "reshape", "squeeze", "transpose", "broadcast_in_dim", "slice", "rev", "concatenate", "stack", "unstack", "split", "tile", "pad",
    "copy", "dynamic_slice", "dynamic_update_slice", "gather", "scatter",
)  # fmt: skip


class Value(NamedTuple):
    """An array of the program: the elements of x that each of its own depends on, and its numbers where they are known."""

    shape: tuple[int, ...]
    rows: scipy.sparse.csr_matrix | None  # None: it depends on none
    numbers: np.ndarray | None


def dependence(function: Callable, x: Array | jax.ShapeDtypeStruct) -> scipy.sparse.csr_matrix:
    """Whether element i of f(x) depends on element j of x, as a sparse (m, n) matrix.

    **Raises:** `TooLong` if the pattern has too many entries, or the program has loops of too many turns, or effects.
    """
    closed, out = jax.make_jaxpr(function, return_shape=True)(x)
    if closed.effects:
        raise TooLong
    reader = _Reader(x.size)
    (found,) = walk(closed, [Value(x.shape, _ones(np.arange(x.size), x.size), None)], reader.equation, _known, _literal)
    return _empty(out.size, x.size) if found.rows is None else found.rows


def _known(array: Any) -> Value:
    """An array from outside the program."""
    at_hand = isinstance(array, (np.ndarray, np.generic, jax.Array, int, float)) and not isinstance(array, jax.core.Tracer)
    return Value(np.shape(array), None, np.asarray(array) if at_hand and np.size(array) <= MAX_NUMBERS else None)


def _literal(atom: Any) -> Value:
    return _known(np.asarray(atom.val, atom.aval.dtype))


def _ones(columns: np.ndarray, width: int) -> scipy.sparse.csr_matrix:
    """A row for each column that is named, with one entry there; an empty row for each −1."""
    there = columns >= 0
    starts = np.concatenate([[0], np.cumsum(there)])
    return scipy.sparse.csr_matrix((np.ones(starts[-1], bool), columns[there], starts), (columns.size, width))


def _empty(m: int, n: int) -> scipy.sparse.csr_matrix:
    return _pairs(np.zeros(0, int), np.zeros(0, int), (m, n))


class _Reader:
    """The rules by which equations hand on what their operands depend on."""

    def __init__(self, width: int):
        self.width, self.turns = width, 0

    def equation(self, equation: Any, operands: list[Value]) -> list[Value]:
        name = equation.primitive.name
        if name in (*CALLS, *CALLS_WITH_DERIVATIVE_RULE):
            return self.run(called_program(equation), operands)
        if all(x.rows is None for x in operands) and (name != "scan" or not any(map(_is_whole, equation.outvars))):
            return self._constant(equation, operands)
        if name in ELEMENTWISE or name in POWERS:
            moved = self._selected(equation, operands) if name == "select_n" else None
            return moved or [self._result(equation.outvars[0], self._union([self._broadcast(x, equation) for x in operands]))]
        if name in MOVEMENTS and (moved := self._moved(equation, operands)):
            return moved
        rule = {"dot_general": self._product, "scatter-add": self._added, "scan": self._scan, "cond": self._cond}.get(name)
        rule = self._summed if name in SUMS else self._cumulated if name in CUMULATIVE else rule
        return (rule and rule(equation, operands)) or self._of_everything(equation, operands)

    def run(self, program: Any, operands: list[Value]) -> list[Value]:
        return walk(program, operands, self.equation, _known, _literal)

    def _result(self, variable: Any, rows: scipy.sparse.csr_matrix | None) -> Value:
        return Value(variable.aval.shape, self._limited(rows), None)

    def _limited(self, rows):
        if rows is not None and rows.nnz > MAX_ENTRIES:
            raise TooLong
        return rows

    def _constant(self, equation, operands) -> list[Value]:
        """What depends on nothing: its numbers, where places are made of them."""
        atoms = [*equation.invars, *equation.outvars]
        small = all(atom.aval.size <= MAX_NUMBERS for atom in atoms) and not equation.effects
        if small and all(x.numbers is not None for x in operands) and all(map(is_foldable, atoms)) and not _is_loop(equation):
            with jax.ensure_compile_time_eval():
                out = equation.primitive.bind(*(x.numbers for x in operands), **equation.params)
            return [_known(x) for x in (out if equation.primitive.multiple_results else [out])]
        return [Value(getattr(v.aval, "shape", ()), None, None) for v in equation.outvars]

    def _rows(self, value: Value) -> scipy.sparse.csr_matrix:
        return _empty(math.prod(value.shape), self.width) if value.rows is None else value.rows

    def _union(self, parts):
        parts = [rows for rows in parts if rows is not None]
        return functools.reduce(lambda a, b: self._limited(a + b), parts) if parts else None

    def _broadcast(self, value: Value, equation):
        """The rows of an operand of arithmetic, repeated where its length is one beside others."""
        shape = equation.outvars[0].aval.shape
        if value.rows is None or value.shape == shape:
            return value.rows
        number = np.arange(math.prod(value.shape)).reshape(value.shape)
        return self._picked(value.rows, np.broadcast_to(number, shape).ravel())

    def _picked(self, rows, which: np.ndarray):
        """Rows by their numbers, where they do not become too many entries."""
        if int(np.diff(rows.indptr)[which].sum()) > MAX_ENTRIES:
            raise TooLong
        return rows[which]

    def _selected(self, equation, operands) -> list[Value] | None:
        which, *cases = operands
        if which.numbers is None or any(x.shape != which.shape for x in cases):
            return None
        stacked = scipy.sparse.vstack([self._rows(x) for x in cases], "csr")
        size = which.numbers.size
        return [self._result(equation.outvars[0], self._picked(stacked, which.numbers.astype(int).ravel() * size + np.arange(size)))]

    def _moved(self, equation, operands) -> list[Value] | None:
        """The numbers of the data, moved; None where places are not known."""
        name = equation.primitive.name
        data = {"dynamic_slice": [0], "dynamic_update_slice": [0, 1], "gather": [0], "scatter": [0, 2]}.get(name, range(len(operands)))
        if any(x.numbers is None for i, x in enumerate(operands) if i not in data):
            return None
        numbered, count = _numbered([operands[i] for i in data])
        given = [numbered[list(data).index(i)] if i in data else x.numbers for i, x in enumerate(operands)]
        with jax.ensure_compile_time_eval():
            out = equation.primitive.bind(*given, **equation.params)
        stacked = scipy.sparse.vstack([*(self._rows(operands[i]) for i in data), _empty(1, self.width)], "csr")
        picked = [np.asarray(x).ravel() for x in (out if equation.primitive.multiple_results else [out])]
        picked = [np.where((x >= 0) & (x < count), x, count) for x in picked]
        return [self._result(v, self._picked(stacked, x)) for v, x in zip(equation.outvars, picked, strict=True)]

    def _summed(self, equation, operands) -> list[Value]:
        (x,) = operands
        axes = equation.params["axes"]
        kept = [1 if d in axes else n for d, n in enumerate(x.shape)]
        group = np.broadcast_to(np.arange(math.prod(kept)).reshape(kept), x.shape).ravel()
        return [self._result(equation.outvars[0], _ones(group, math.prod(kept)).T.tocsr() @ x.rows)]

    def _cumulated(self, equation, operands) -> list[Value]:
        (x,) = operands
        axis, n = equation.params["axis"], x.shape[equation.params["axis"]]
        if x.rows.nnz * (n + 1) > 4 * MAX_ENTRIES:
            raise TooLong
        before = scipy.sparse.csr_matrix(np.tri(n, dtype=bool).T if equation.params["reverse"] else np.tri(n, dtype=bool))
        outer, inner = math.prod(x.shape[:axis]), math.prod(x.shape[axis + 1 :])
        eye = lambda k: scipy.sparse.identity(k, bool, "csr")
        everywhere = scipy.sparse.kron(scipy.sparse.kron(eye(outer), before), eye(inner), "csr")
        return [self._result(equation.outvars[0], everywhere.astype(bool) @ x.rows)]

    def _product(self, equation, operands) -> list[Value]:
        """Each element of the product, of those elements of both factors that it sums over; a zero that is known takes no part."""
        dimensions, out = equation.params["dimension_numbers"], equation.outvars[0]
        left, right = (_by_batch_and_sum(x, s, b) for x, s, b in zip(operands, *dimensions, strict=True))
        shape = (left.shape[0], left.shape[1], right.shape[1], left.shape[2])  # batch, rows, columns, summed
        if math.prod(shape) > MAX_ENTRIES:
            raise TooLong
        places = [np.broadcast_to(left[:, :, None], shape), np.broadcast_to(right[:, None], shape)]
        where = np.broadcast_to(np.arange(out.aval.size).reshape(*shape[:3], 1), shape)
        present = np.ones(shape, bool)
        for x, at in zip(operands, places, strict=True):
            if x.numbers is not None:
                present &= (x.numbers.ravel() != 0)[at]
        dependent = [(x, at) for x, at in zip(operands, places, strict=True) if x.rows is not None]
        taken = [_pairs(where[present], at[present], (out.aval.size, math.prod(x.shape))) @ x.rows for x, at in dependent]
        return [self._result(out, self._union(taken))]

    def _added(self, equation, operands) -> list[Value] | None:
        """Numbers added at known places: what a gather from there would read."""
        array, places, updates = operands
        if places.numbers is None:
            return None
        d = equation.params["dimension_numbers"]
        single = (*d.inserted_window_dims, *d.operand_batching_dims)
        windows = iter([updates.shape[k] for k in d.update_window_dims])
        sizes = tuple(1 if k in single else next(windows) for k in range(len(array.shape)))
        reading = lax.GatherDimensionNumbers(
            offset_dims=d.update_window_dims,
            collapsed_slice_dims=d.inserted_window_dims,
            start_index_map=d.scatter_dims_to_operand_dims,
            operand_batching_dims=d.operand_batching_dims,
            start_indices_batching_dims=d.scatter_indices_batching_dims,
        )
        with jax.ensure_compile_time_eval():
            (numbered,), count = _numbered([array])
            read = lax.gather(numbered, places.numbers, reading, sizes, mode="fill", fill_value=-1)
        at = np.asarray(read).ravel()
        there = (at >= 0) & (at < count)
        taken = _pairs(at[there], np.flatnonzero(there), (count, at.size))
        return [self._result(equation.outvars[0], self._union([array.rows, None if updates.rows is None else taken @ updates.rows]))]

    def _scan(self, equation, operands) -> list[Value]:
        """Turn by turn, since each may add to what the carry depends on."""
        p = equation.params
        self.turns += p["length"]
        if self.turns > MAX_TURNS:
            raise TooLong
        carry, columns = unrolled_scan(p, operands, lambda inputs: self.run(p["jaxpr"], inputs), self._row)
        stacked = [self._stacked(v, column) for v, column in zip(equation.outvars[len(carry) :], columns, strict=True)]
        return [*carry, *stacked]

    def _row(self, x: Value, k: int) -> Value:
        size = math.prod(x.shape[1:])
        rows = None if x.rows is None else x.rows[k * size : (k + 1) * size]
        return Value(x.shape[1:], rows, None if x.numbers is None else x.numbers[k])

    def _stacked(self, variable, column) -> Value:
        if all(x.rows is None for x in column):
            numbers = [x.numbers for x in column]
            return Value(variable.aval.shape, None, None if any(x is None for x in numbers) else np.stack(numbers))
        return self._result(variable, scipy.sparse.vstack([self._rows(x) for x in column], "csr"))

    def _cond(self, equation, operands) -> list[Value]:
        index, *given = operands
        outcomes = [self.run(branch, given) for branch in equation.params["branches"]]
        union = lambda v, values: self._result(v, self._union([self._of_all(index, v), *(x.rows for x in values)]))
        return [union(v, values) for v, values in zip(equation.outvars, zip(*outcomes, strict=True), strict=True)]

    def _of_everything(self, equation, operands) -> list[Value]:
        """Each output, of all that any operand depends on."""
        return [self._result(v, self._union([self._of_all(x, v) for x in operands])) for v in equation.outvars]

    def _of_all(self, x: Value, variable):
        """For each element of an output, all elements of an operand."""
        if x.rows is None:
            return None
        columns, size = np.unique(x.rows.indices), variable.aval.size
        if columns.size * size > MAX_ENTRIES:
            raise TooLong
        starts = np.arange(size + 1) * columns.size
        return scipy.sparse.csr_matrix((np.ones(starts[-1], bool), np.tile(columns, size), starts), (size, self.width))


def _numbered(values: list[Value]) -> tuple[list[np.ndarray], int]:
    """The elements of arrays, numbered through, and how many there are."""
    ends = np.cumsum([0, *(math.prod(x.shape) for x in values)])
    pairs = zip(values, ends[:-1], ends[1:], strict=True)
    return [np.arange(start, end).reshape(x.shape) for x, start, end in pairs], int(ends[-1])


def _by_batch_and_sum(x: Value, summed: tuple[int, ...], batch: tuple[int, ...]) -> np.ndarray:
    """The numbers of the elements of a factor, by batch, by what is neither, and by what is summed over."""
    free = [d for d in range(len(x.shape)) if d not in (*summed, *batch)]
    of = lambda dimensions: math.prod(x.shape[d] for d in dimensions)
    return _numbered([x])[0][0].transpose([*batch, *free, *summed]).reshape(of(batch), of(free), of(summed))


def _pairs(rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int]) -> scipy.sparse.csr_matrix:
    return scipy.sparse.csr_matrix((np.ones(rows.size, bool), (rows, columns)), shape)


def _is_whole(atom: Any) -> bool:
    """Whether its numbers may be places."""
    return not jax.dtypes.issubdtype(atom.aval.dtype, np.inexact)


def _is_loop(equation: Any) -> bool:
    return equation.primitive.name in ("while", "scan", "cond")
