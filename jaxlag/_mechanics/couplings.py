"""Which term of a system of many coordinates couples them all, so that a solve finds no zeros to leave out."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Bool, Float

from .._model.flat import Flat, rows_by_name
from .._program.expressions import TooLong
from .._program.sparse_jacobian import MANY, few_colors
from .._program.sparsity import dependence
from .lagrange import inertia, velocity_residual

NOT_READ = -1
MATRICES = OF_L, OF_V, OF_D, OF_ROWS = "∂²L/∂q̇²", "∂²L/∂q²", "∂²D/∂q̇²", "G"


class Coupling(NamedTuple):
    """Second derivatives of a term, or the rows of a constraint: how many of the numbers may differ from zero (`NOT_READ` where the
    program is too long), of how many, and whether too few are zeros to be left out.
    """

    entries: int | np.ndarray
    size: int | np.ndarray
    is_full: bool | np.ndarray


def couplings(flat: Flat, t, q, v) -> dict[tuple[str, str], Coupling]:
    """By matrix and term; none where there are too few coordinates for zeros to be left out."""
    if q.size < MANY:
        return {}
    return {(matrix, name): _coupling(*of) for matrix, name, *of in _functions(flat, t, q, v)}


def uses_all_numbers(flat: Flat, t, q, v) -> Bool[Array, ""]:
    """Whether M is taken with all its numbers, where no structure of it is seen."""
    return jnp.array(isinstance(inertia(flat, t, q, v), lx.MatrixLinearOperator))


def _functions(flat, t, q, v) -> Iterator[tuple[str, str, Callable, Float[Array, " n"], np.ndarray | None]]:
    """What to differentiate, by which vector, and which rows of it."""
    for name, L in flat.lagrangians.items():
        yield OF_L, name, lambda v, L=L: jax.grad(L, argnums=2)(t, q, v), v, None
        yield OF_V, name, lambda q, L=L: jax.grad(L, argnums=1)(t, q, v), q, None
    multipliers = jnp.zeros(flat.rows, v.dtype)
    for name, D in flat.dissipations.items():
        yield OF_D, name, lambda v, D=D: jax.grad(D, argnums=2)(t, q, v, multipliers), v, None
    for name, rows in rows_by_name(flat).items():
        yield OF_ROWS, name, lambda v: velocity_residual(flat, t, q, v), v, rows


def _coupling(function, x, rows):
    try:
        pattern = dependence(function, x)
    except TooLong:
        return Coupling(NOT_READ, (x.size if rows is None else rows.size) * x.size, True)
    pattern = pattern if rows is None else pattern[rows]
    return Coupling(pattern.nnz, pattern.shape[0] * pattern.shape[1], pattern.nnz > 0 and few_colors(pattern) is None)
