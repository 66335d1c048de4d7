"""Rules of linear algebra: factorisations and solves by elimination, element by element."""

import functools

import numpy as np
from jax import lax

from .expressions import Node, objects
from .rules import map_elements, rule


@rule("cholesky")
def _cholesky(interpreter, equation, A):
    dtype = equation.outvars[0].aval.dtype
    L = objects(np.zeros(A.shape, dtype))
    for at in np.ndindex(A.shape[:-2]):
        a, l = objects(A[at]), L[at]
        for j in range(len(a)):
            for i in range(j, len(a)):
                rest = functools.reduce(interpreter.sub, map(interpreter.mul, l[i, :j], l[j, :j]), a[i, j])
                l[i, j] = (
                    interpreter.mul(rest, interpreter.div(dtype.type(1), l[j, j]))
                    if i > j
                    else interpreter.apply(lax.sqrt_p, {}, dtype, rest)
                )
    return L


@rule("triangular_solve")
def _triangular_solve(interpreter, equation, A, B):
    p, one = equation.params, equation.outvars[0].aval.dtype.type(1)
    transposed = p["transpose_a"] == p["left_side"]  # A X = B is solved with A or Aᵀ, for X or, where X is on the left, for Xᵀ
    A, X = objects(A.swapaxes(-1, -2) if transposed else A), objects(B).copy()
    for at in np.ndindex(A.shape[:-2]):
        a, x = A[at], X[at] if p["left_side"] else X[at].T
        backwards = p["lower"] == transposed
        for i in reversed(range(len(a))) if backwards else range(len(a)):
            known = slice(i + 1, None) if backwards else slice(i)
            for k in range(x.shape[1]):
                rest = functools.reduce(interpreter.sub, map(interpreter.mul, a[i, known], x[known, k]), x[i, k])
                x[i, k] = rest if p["unit_diagonal"] else interpreter.mul(rest, interpreter.div(one, a[i, i]))
    return X


@rule("lu")
def _lu(interpreter, equation, A):
    """P A = L U where the algebra has no numbers to choose pivots by: the first element that is not zero is the pivot."""
    if interpreter.algebra.block(equation) is not None:
        return NotImplemented
    *batch, rows, columns = A.shape
    A = objects(A).copy()
    pivots = np.zeros((*batch, min(rows, columns)), np.int32)
    permutation = np.broadcast_to(np.arange(rows, dtype=np.int32), (*batch, rows)).copy()
    for at in np.ndindex(*batch):
        a = A[at]
        for j in range(min(rows, columns)):
            k = pivots[(*at, j)] = next((i for i in range(j, rows) if isinstance(a[i, j], Node) or a[i, j] != 0), j)
            for swapped in (a, permutation[at]):
                swapped[[j, k]] = swapped[[k, j]]
            for i in range(j + 1, rows):
                a[i, j] = interpreter.div(a[i, j], a[j, j])
                a[i, j + 1 :] = [interpreter.sub(x, interpreter.mul(a[i, j], y)) for x, y in zip(a[i, j + 1 :], a[j, j + 1 :], strict=True)]
    return [A, pivots, permutation]


@rule("custom_linear_solve")
def _linear_solve(interpreter, equation, *operands):
    """The solution written out; where the algebra differentiates, in one piece, whose derivative comes from the equation it solves."""
    lengths, solve = equation.params["const_lengths"], equation.params["jaxprs"].solve
    before, function = lengths.matvec + lengths.vecmat, interpreter.algebra.block(equation)
    x = interpreter.run(solve, [*operands[before : before + lengths.solve], *operands[sum(lengths) :]])
    if function is None:
        return x
    # An element that is a number is one whatever the operands are; its derivative is zero.
    whole = interpreter.block(function, operands, equation.outvars)
    return [map_elements(lambda x, node: node if isinstance(x, Node) else x, *pair) for pair in zip(x, whole, strict=True)]
