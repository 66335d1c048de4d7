"""Jacobians in as few directions as their zeros allow.

Columns that share no row are differentiated in one direction together (Curtis, Powell & Reid, J. Inst. Maths Applics 13 (1974) 117):
rods that each join two of many points take four directions in the plane, however long the chain is. The zeros are seen in the program.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Bool, Float

from .interpreter import Reader, opened
from .scalar_graph import Algebra, Entry, TooLong, UnknownPrimitive
from .structured_jacobian import matrix

FEW = 3  # columns; up to here a direction for each costs less than looking for zeros
SCALARS = 5  # columns; up to here most programs are written out in scalars, and are shortest in a direction for each column
LIMIT = 20_000  # scalar operations that are looked at, in a second or less


def jacobian(function: Callable, x: Float[Array, " n"]) -> tuple[Float[Array, " m"], lx.AbstractLinearOperator]:
    """f(x) and ∂f/∂x, which is a `DiagonalLinearOperator` where it is seen to be one."""
    y, push = jax.linearize(function, x)
    pattern = np.ones((y.size, x.size), bool) if x.size <= FEW else dependence(function, x)
    if pattern.shape[0] == pattern.shape[1] > FEW and np.array_equal(pattern, np.eye(x.size)):
        return y, lx.DiagonalLinearOperator(push(jnp.ones_like(x)))
    color = _colors(pattern)
    if x.size > SCALARS and max(color) + 1 == x.size and (columns := matrix(function, x)) is not None:
        return y, lx.MatrixLinearOperator(columns)
    directions = jnp.asarray(color[:, None] == np.arange(max(color, default=-1) + 1), x.dtype)
    columns = jax.vmap(push, in_axes=1, out_axes=1)(directions)
    if directions.shape[1] < x.size:
        columns = jnp.where(pattern, columns[:, color], 0)
    return y, lx.MatrixLinearOperator(columns)


def dependence(function: Callable, x: Array) -> Bool[np.ndarray, "m n"]:
    """Whether entry i of f(x) depends on entry j of x; all do where the program is too long to be looked at."""
    closed, out = jax.make_jaxpr(function, return_shape=True)(x)
    try:
        reader = Reader(_Names(), LIMIT)
        inputs, outputs = opened(closed, reader)
    except (TooLong, UnknownPrimitive):
        return np.ones((out.size, x.size), bool)
    reached = {entry: 1 << j for j, entry in enumerate(inputs[-1].flat)}  # sets of j, as bits
    for entry in reader.entries:
        for operand in entry.operands:
            reached[entry] = reached.get(entry, 0) | reached.get(operand, 0)
    rows = [reached.get(entry, 0) if isinstance(entry, Entry) else 0 for entry in outputs[0].flat]
    return np.array([[row >> j & 1 for j in range(x.size)] for row in rows], bool).reshape(out.size, x.size)


class _Names(Algebra):
    """Operations without values: only what depends on what is asked for."""

    def function(self, primitive, params, dtype):
        return primitive.bind

    def block(self, equation):
        return equation.primitive.bind


def _colors(pattern) -> np.ndarray:
    """A number for each column, the least that no column before it has with which it shares a row."""
    if pattern.all():
        return np.arange(pattern.shape[1])
    color, meets = np.zeros(pattern.shape[1], int), pattern.T.astype(int) @ pattern > 0
    for j in range(1, color.size):
        taken = set(color[:j][meets[j, :j]])
        color[j] = next(c for c in range(j + 1) if c not in taken)
    return color
