"""Jacobians of many experiments: each depends on the shared parameters and on a few unknowns of its own, and on nothing else."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._program.jit import numpy_for


class Arrow(eqx.Module):
    r"""A Jacobian whose rows are those of `first`, of each of the `blocks`, and of `last`; x columns.

    A block (E, N, c) holds E experiments of N rows, and `columns` (E, c) says to which of x theirs belong: without its zeros it needs
    E N c numbers instead of E N x.

    **Source:** Björck, Numerical Methods for Least Squares Problems (1996), section 6.3 (block angular problems).
    """

    first: Any
    blocks: tuple[Any, ...]
    columns: tuple[Any, ...]
    last: Any

    @property
    def size(self) -> int:
        """x, the number of columns."""
        return self.first.shape[1]

    def split(self, r: Float[Array | np.ndarray, " n"]) -> tuple[Any, list[Any], Any]:
        """A number for each row, by the parts."""
        ends = np.cumsum([len(self.first), *(block.shape[0] * block.shape[1] for block in self.blocks)])
        first, *parts, last = (r[begin:end] for begin, end in zip([0, *ends], [*ends, len(r)], strict=True))
        return first, [part.reshape(block.shape[:2]) for part, block in zip(parts, self.blocks, strict=True)], last


def times(J: Any, step: Float[Array | np.ndarray, " x"]) -> Any:
    """J step."""
    if not isinstance(J, Arrow):
        return J @ step
    xnp = numpy_for(J.first, step)
    parts = [xnp.einsum("enc,ec->en", block, step[columns]).ravel() for block, columns in zip(J.blocks, J.columns, strict=True)]
    return xnp.concatenate([J.first @ step, *parts, J.last @ step])


def transposed(J: Any, r: Float[Array | np.ndarray, " n"]) -> Any:
    """Jᵀr."""
    if not isinstance(J, Arrow):
        return r @ J
    xnp = numpy_for(J.first, r)
    first, parts, last = J.split(r)
    return _sum(J, [xnp.einsum("enc,en->ec", *pair) for pair in zip(J.blocks, parts, strict=True)], first @ J.first + last @ J.last)


def norms(J: Any) -> Any:
    """Of each column."""
    xnp = numpy_for(J)
    if not isinstance(J, Arrow):
        return xnp.linalg.norm(J, axis=0)
    beside = xnp.sum(J.first**2, axis=0) + xnp.sum(J.last**2, axis=0)
    return xnp.sqrt(_sum(J, [xnp.sum(block**2, axis=1) for block in J.blocks], beside))


def over(J: Any, scale: Float[Array | np.ndarray, " x"]) -> Any:
    """Each column over its own number."""
    if not isinstance(J, Arrow):
        return J / scale[None, :]
    blocks = tuple(block / scale[columns][:, None] for block, columns in zip(J.blocks, J.columns, strict=True))
    return Arrow(J.first / scale[None, :], blocks, J.columns, J.last / scale[None, :])


def triangular(J: Any, r: Float[Array | np.ndarray, " n"]) -> tuple[Any, Any]:
    """R of J = QR, and Qᵀr."""
    if not isinstance(J, Arrow):
        Q, R = jnp.linalg.qr(J)
        return R, r @ Q
    first, parts, last = J.split(r)
    blocks = tuple(jnp.concatenate([block, part[..., None]], axis=2) for block, part in zip(J.blocks, parts, strict=True))
    columns = tuple(jnp.concatenate([columns, jnp.full_like(columns[:, :1], J.size)], axis=1) for columns in J.columns)
    together = Arrow(jnp.column_stack([J.first, first]), blocks, columns, jnp.column_stack([J.last, last]))
    R = jnp.linalg.qr(gathered(together), mode="r")[: J.size]
    return R[:, :-1], R[:, -1]


def gathered(J: Any) -> Any:
    """A matrix with the same JᵀJ, and of an `Arrow` no more rows of an experiment than it has columns."""
    if not isinstance(J, Arrow):
        return J
    xnp = numpy_for(J)
    blocks = tuple(xnp.linalg.qr(block, mode="r") if block.shape[1] > block.shape[2] else block for block in J.blocks)
    return whole(Arrow(J.first, blocks, J.columns, J.last))


def whole(J: Arrow) -> Any:
    """The matrix with all its zeros."""
    xnp, rows = numpy_for(J), [J.first]
    for block, columns in zip(J.blocks, J.columns, strict=True):
        at = np.arange(len(block))[:, None, None], np.arange(block.shape[1])[:, None], columns[:, None]
        wide = xnp.zeros((*block.shape[:2], J.size), block.dtype)
        if xnp is np:
            wide[at] = block
        else:
            wide = wide.at[at].set(block)
        rows.append(wide.reshape(-1, J.size))
    return xnp.concatenate([*rows, J.last])


def without(J: Any, i: int) -> Any:
    """Without the column of a shared parameter."""
    if not isinstance(J, Arrow):
        return jnp.delete(J, i, axis=1)
    fewer = lambda a: jnp.delete(a, i, axis=-1)
    columns = tuple(fewer(columns) - (fewer(columns) > i) for columns in J.columns)
    return Arrow(fewer(J.first), tuple(map(fewer, J.blocks)), columns, fewer(J.last))


def _sum(J, of_columns, total):
    """The sum of numbers that belong to the columns of each experiment, and of a total."""
    for columns, numbers in zip(J.columns, of_columns, strict=True):
        if isinstance(total, np.ndarray):
            np.add.at(total, columns, numbers)
        else:
            total = total.at[columns].add(numbers)
    return total
