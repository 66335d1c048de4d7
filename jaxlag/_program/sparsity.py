"""Which numbers of f(x) depend on which of x, read from the program of f.

Of few x it is read element by element, as scalar code (`_program.interpreter`): products with zero, terms that cancel and branches of a
known condition are no dependence, and a program of too many operations depends on all. From `MANY` x on it is read array by array: its
length costs, not that of its arrays. Each array stands as a sparse matrix, a row for each of its elements and a column for each of x;
arithmetic adds rows, what moves data picks them. Only zeros of known factors of a `dot_general` are left out there, and terms that cancel
are a dependence. The elements of 1000 rods between points take 0.9 s, their arrays 0.01 s.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy.sparse
from jaxtyping import Array, Bool

from .constants import is_foldable, is_numeric
from .data_movement import RULES, scattered
from .expressions import Algebra, Node, TooLong, UnknownPrimitive
from .interpreter import Interpreter, traced
from .primitives import ANY_CALL, CONTROL_FLOW, ELEMENTWISE, MOVEMENTS, POWERS, REDUCTIONS, RUNNING
from .walker import columns_of_branches, unrolled_scan, walk

MANY = 64  # x, from which on programs are read array by array, and zeros may be left out
MAX_OPERATIONS = 20_000  # scalar operations that are searched, in a second or less
MAX_ENTRIES = 4_000_000  # of a pattern: some 50 MB
MAX_TURNS = 5_000  # of the scans of a program: some ten seconds
MAX_NUMBERS = 1_000_000  # of an array that is computed while tracing


class Value(NamedTuple):
    """An array of the program: the elements of x that each of its own depends on, and its numbers where they are known."""

    shape: tuple[int, ...]
    rows: scipy.sparse.csr_matrix | None  # None: it depends on none
    numbers: np.ndarray | None


def dependence(function: Callable, x: Array | jax.ShapeDtypeStruct) -> scipy.sparse.csr_matrix:
    """Whether element i of f(x) depends on element j of x, as a sparse (m, n) matrix.

    **Raises:** `TooLong` if the pattern has too many entries, or the program has loops of too many turns, or effects.
    """
    return array_by_array(function, x) if x.size >= MANY else scipy.sparse.csr_matrix(sparsity_pattern(function, x))


def sparsity_pattern(function: Callable, x: Array | jax.ShapeDtypeStruct) -> Bool[np.ndarray, "m n"]:
    """The same element by element, with its zeros; where the program is too long to be searched, all depend on all."""
    closed, out = jax.make_jaxpr(function, return_shape=True)(x)
    try:
        interpreter = Interpreter(_Dependence(), MAX_OPERATIONS)
        inputs, outputs = traced(closed, interpreter)
    except (TooLong, UnknownPrimitive):
        return np.ones((out.size, x.size), bool)
    reached = {node: 1 << j for j, node in enumerate(inputs[-1].flat)}  # sets of j, as bits
    for node in interpreter.nodes:
        for operand in node.operands:
            reached[node] = reached.get(node, 0) | reached.get(operand, 0)
    rows = [reached.get(node, 0) if isinstance(node, Node) else 0 for node in outputs[0].flat]
    return np.array([[row >> j & 1 for j in range(x.size)] for row in rows], bool).reshape(out.size, x.size)


class _Dependence(Algebra):
    """Operations without values: only what depends on what is of interest."""

    def function(self, primitive, params, dtype):
        return primitive.bind

    def block(self, equation):
        return equation.primitive.bind


def array_by_array(function: Callable, x: Array | jax.ShapeDtypeStruct) -> scipy.sparse.csr_matrix:
    """The dependence read from the program of arrays as it is."""
    closed, out = jax.make_jaxpr(function, return_shape=True)(x)
    if closed.effects:
        raise TooLong
    reader = _Reader(x.size)
    (found,) = reader.run(closed, [Value(x.shape, scipy.sparse.identity(x.size, bool, "csr"), None)])
    return _empty(out.size, x.size) if found.rows is None else found.rows


def _known(array: Any) -> Value:
    """An array from outside the program."""
    return Value(np.shape(array), None, np.asarray(array) if is_numeric(array) and np.size(array) <= MAX_NUMBERS else None)


def _empty(m: int, n: int) -> scipy.sparse.csr_matrix:
    return _pairs(np.zeros(0, int), np.zeros(0, int), m, n)


class _Reader:
    """The rules by which equations hand on what their operands depend on."""

    def __init__(self, width: int):
        self.width, self.turns, self.constants = width, 0, Interpreter(Algebra())

    def equation(self, equation: Any, operands: list[Value]) -> list[Value]:
        name = equation.primitive.name
        if all(x.rows is None for x in operands) and (name != "scan" or not any(map(_is_whole, equation.outvars))):
            return self._constant(equation, operands)
        if name in ELEMENTWISE or name in POWERS:
            moved = self._selected(equation, operands) if name == "select_n" else None
            return moved or [self._result(equation.outvars[0], self._union([self._broadcast(x, equation) for x in operands]))]
        if name in MOVEMENTS and (moved := self._moved(equation, operands)):
            return moved
        rule = {"dot_general": self._product, "scatter-add": self._added, "scan": self._scan, "cond": self._cond}.get(name)
        rule = self._summed if name in REDUCTIONS else self._cumulated if name in RUNNING else rule
        return (rule and rule(equation, operands)) or self._of_everything(equation, operands)

    def run(self, program: Any, operands: list[Value]) -> list[Value]:
        return walk(program, operands, self.equation, _known, opened=ANY_CALL)

    def _result(self, variable: Any, rows: scipy.sparse.csr_matrix | None) -> Value:
        return Value(variable.aval.shape, self._limited(rows), None)

    def _limited(self, rows):
        if rows is not None and rows.nnz > MAX_ENTRIES:
            raise TooLong
        return rows

    def _constant(self, equation, operands) -> list[Value]:
        """What depends on nothing: its numbers, where places are made of them."""
        atoms = [*equation.invars, *equation.outvars]
        small = all(is_foldable(atom) and atom.aval.size <= MAX_NUMBERS for atom in atoms) and all(x.numbers is not None for x in operands)
        if small and not equation.effects and equation.primitive.name not in CONTROL_FLOW:
            return [_known(x) for x in self.constants.evaluated(equation, [x.numbers for x in operands])]
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
        return self._picked(value.rows, np.broadcast_to(_numbers(value), shape).ravel())

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
        out = RULES[name](None, equation, *given)
        if out is NotImplemented:
            return None
        stacked = scipy.sparse.vstack([*(self._rows(operands[i]) for i in data), _empty(1, self.width)], "csr")
        picked = [np.where(x < 0, count, x).ravel() for x in (out if isinstance(out, list) else [out])]
        return [self._result(v, self._picked(stacked, x)) for v, x in zip(equation.outvars, picked, strict=True)]

    def _summed(self, equation, operands) -> list[Value]:
        (x,) = operands
        axes = equation.params["axes"]
        kept = [1 if d in axes else n for d, n in enumerate(x.shape)]
        group = np.broadcast_to(np.arange(math.prod(kept)).reshape(kept), x.shape)
        return [self._result(equation.outvars[0], _pairs(group, _numbers(x), math.prod(kept)) @ x.rows)]

    def _cumulated(self, equation, operands) -> list[Value]:
        (x,) = operands
        axis, n = equation.params["axis"], x.shape[equation.params["axis"]]
        if x.rows.nnz * (n + 1) > 4 * MAX_ENTRIES:
            raise TooLong
        numbers, (after, before) = np.moveaxis(_numbers(x), axis, 0), np.tril_indices(n)
        at, of = (before, after) if equation.params["reverse"] else (after, before)
        return [self._result(equation.outvars[0], _pairs(numbers[at], numbers[of], numbers.size, numbers.size) @ x.rows)]

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
        taken = [_pairs(where[present], at[present], out.aval.size, math.prod(x.shape)) @ x.rows for x, at in dependent]
        return [self._result(out, self._union(taken))]

    def _added(self, equation, operands) -> list[Value] | None:
        """Numbers added at known places."""
        array, places, updates = operands
        if places.numbers is None:
            return None
        at, of = scattered(equation, array, places.numbers, _numbers(updates))
        taken = None if updates.rows is None else _pairs(at, of, math.prod(array.shape), math.prod(updates.shape)) @ updates.rows
        return [self._result(equation.outvars[0], self._union([array.rows, taken]))]

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
        union = lambda v, values: self._result(v, self._union([self._of_all(index, v), *(x.rows for x in values)]))
        return list(map(union, equation.outvars, columns_of_branches(equation.params, given, self.run)))

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


def _numbers(x: Value) -> np.ndarray:
    """The elements of an array, numbered."""
    return np.arange(math.prod(x.shape)).reshape(x.shape)


def _numbered(values: list[Value]) -> tuple[list[np.ndarray], int]:
    """The elements of arrays, numbered through, and how many there are."""
    ends = np.cumsum([0, *(math.prod(x.shape) for x in values)])
    pairs = zip(values, ends[:-1], ends[1:], strict=True)
    return [np.arange(start, end).reshape(x.shape) for x, start, end in pairs], int(ends[-1])


def _by_batch_and_sum(x: Value, summed: tuple[int, ...], batch: tuple[int, ...]) -> np.ndarray:
    """The numbers of the elements of a factor, by batch, by what is neither, and by what is summed over."""
    free = [d for d in range(len(x.shape)) if d not in (*summed, *batch)]
    of = lambda dimensions: math.prod(x.shape[d] for d in dimensions)
    return _numbers(x).transpose([*batch, *free, *summed]).reshape(of(batch), of(free), of(summed))


def _pairs(rows: np.ndarray, columns: np.ndarray, m: int, n: int | None = None) -> scipy.sparse.csr_matrix:
    """The m × n matrix with entries at these places; without n, with as many columns as there are places."""
    return scipy.sparse.csr_matrix((np.ones(rows.size, bool), (rows.ravel(), columns.ravel())), (m, columns.size if n is None else n))


def _is_whole(atom: Any) -> bool:
    """Whether its numbers may be places."""
    return not jax.dtypes.issubdtype(atom.aval.dtype, np.inexact)
