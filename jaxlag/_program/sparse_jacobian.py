"""Sparse Jacobians in as few directions as their zeros allow.

Columns that share no row are differentiated in one direction together (Curtis, Powell & Reid, J. Inst. Maths Applics 13 (1974) 117):
rods that each join two of many points take four directions in the plane, however long the chain is. The zeros are read from the program.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Bool, Float

from .expressions import Algebra, Node, TooLong, UnknownPrimitive
from .interpreter import Interpreter, traced
from .structured_jacobian import structured_jacobian

MAX_DENSE_COLUMNS = 3  # up to here a direction for each column costs less than looking for zeros
MAX_SCALAR_COLUMNS = 5  # up to here most programs become scalar code, which is shortest with a direction for each column
MAX_OPERATIONS = 20_000  # scalar operations that are searched, in a second or less


def jacobian(function: Callable, x: Float[Array, " n"]) -> tuple[Float[Array, " m"], lx.AbstractLinearOperator]:
    """f(x) and ∂f/∂x, which is a `DiagonalLinearOperator` where its program shows that it is diagonal."""
    y, push = jax.linearize(function, x)
    pattern = np.ones((y.size, x.size), bool) if x.size <= MAX_DENSE_COLUMNS else sparsity_pattern(function, x)
    if pattern.shape[0] == pattern.shape[1] > MAX_DENSE_COLUMNS and np.array_equal(pattern, np.eye(x.size)):
        return y, lx.DiagonalLinearOperator(push(jnp.ones_like(x)))
    color = _colors(pattern)
    if x.size > MAX_SCALAR_COLUMNS and max(color) + 1 == x.size and (columns := structured_jacobian(function, x)) is not None:
        return y, lx.MatrixLinearOperator(columns)
    directions = jnp.asarray(color[:, None] == np.arange(max(color, default=-1) + 1), x.dtype)
    columns = jax.vmap(push, in_axes=1, out_axes=1)(directions)
    if directions.shape[1] < x.size:
        columns = jnp.where(pattern, columns[:, color], 0)
    return y, lx.MatrixLinearOperator(columns)


def sparsity_pattern(function: Callable, x: Array) -> Bool[np.ndarray, "m n"]:
    """Whether element i of f(x) depends on element j of x; where the program is too long to be searched, all do."""
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


def _colors(pattern) -> np.ndarray:
    """Greedy coloring: for each column the least number that no earlier column with a row in common has."""
    if pattern.all():
        return np.arange(pattern.shape[1])
    color, shares_row = np.zeros(pattern.shape[1], int), pattern.T.astype(int) @ pattern > 0
    for j in range(1, color.size):
        used = set(color[:j][shares_row[j, :j]])
        color[j] = next(c for c in range(j + 1) if c not in used)
    return color
