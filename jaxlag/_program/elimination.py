"""Linear algebra taken apart: factorisations and solves as rows of operations on entries."""

import functools

import numpy as np
from jax import lax

from .rules import each, rule
from .scalar_graph import Entry, objects


@rule("cholesky")
def _cholesky(reader, equation, A):
    dtype = equation.outvars[0].aval.dtype
    L = objects(np.zeros(A.shape, dtype))
    for at in np.ndindex(A.shape[:-2]):
        a, l = objects(A[at]), L[at]
        for j in range(len(a)):
            for i in range(j, len(a)):
                rest = functools.reduce(reader.sub, map(reader.mul, l[i, :j], l[j, :j]), a[i, j])
                l[i, j] = reader.mul(rest, reader.div(dtype.type(1), l[j, j])) if i > j else reader.apply(lax.sqrt_p, {}, dtype, rest)
    return L


@rule("triangular_solve")
def _triangular_solve(reader, equation, A, B):
    p, one = equation.params, equation.outvars[0].aval.dtype.type(1)
    turned = p["transpose_a"] == p["left_side"]  # A X = B is solved, with A or Aᵀ, for X or, where X stands on the left, Xᵀ
    A, X = objects(A.swapaxes(-1, -2) if turned else A), objects(B).copy()
    for at in np.ndindex(A.shape[:-2]):
        a, x = A[at], X[at] if p["left_side"] else X[at].T
        upwards = p["lower"] == turned
        for i in reversed(range(len(a))) if upwards else range(len(a)):
            known = slice(i + 1, None) if upwards else slice(i)
            for k in range(x.shape[1]):
                rest = functools.reduce(reader.sub, map(reader.mul, a[i, known], x[known, k]), x[i, k])
                x[i, k] = rest if p["unit_diagonal"] else reader.mul(rest, reader.div(one, a[i, i]))
    return X


@rule("lu")
def _lu(reader, equation, A):
    """P A = L U where the algebra has no numbers to choose pivots by: the first that is not zero serves."""
    if reader.algebra.block(equation) is not None:
        return NotImplemented
    *batch, rows, columns = A.shape
    A = objects(A).copy()
    pivots = np.zeros((*batch, min(rows, columns)), np.int32)
    permutation = np.broadcast_to(np.arange(rows, dtype=np.int32), (*batch, rows)).copy()
    for at in np.ndindex(*batch):
        a = A[at]
        for j in range(min(rows, columns)):
            k = pivots[(*at, j)] = next((i for i in range(j, rows) if isinstance(a[i, j], Entry) or a[i, j] != 0), j)
            for swapped in (a, permutation[at]):
                swapped[[j, k]] = swapped[[k, j]]
            for i in range(j + 1, rows):
                a[i, j] = reader.div(a[i, j], a[j, j])
                a[i, j + 1 :] = [reader.sub(x, reader.mul(a[i, j], y)) for x, y in zip(a[i, j + 1 :], a[j, j + 1 :], strict=True)]
    return [A, pivots, permutation]


@rule("custom_linear_solve")
def _linear_solve(reader, equation, *operands):
    """The solution written out; where the algebra differentiates, it gets its derivative from the equation it solves."""
    lengths, solve = equation.params["const_lengths"], equation.params["jaxprs"].solve
    before, right, function = lengths.matvec + lengths.vecmat, operands[sum(lengths) :], reader.algebra.block(equation)
    if function is not None:
        held = lambda x: reader.new(x.dtype, "held", lax.stop_gradient, (x,)) if isinstance(x, Entry) else x
        right = [each(held, x) for x in right]
    x = reader.inner(solve, [*operands[before : before + lengths.solve], *right])
    if function is None:
        return x
    # What comes out as a number is one whatever the operands are, and so is its derivative.
    whole = reader.block(function, [*x, *operands], equation.outvars)
    return [each(lambda x, entry: entry if isinstance(x, Entry) else x, *pair) for pair in zip(x, whole, strict=True)]
