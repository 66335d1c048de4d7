"""A motion as a compiled program hands it to Python: most of its samples in one array, since each array more takes a program 2 µs.

What Python knows already, the params, does not come back at all.
"""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._program.jit import is_called_by_python, options
from .padding import EXACT
from .trajectory import Trajectory, of_samples


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Table:
    """A `Trajectory` without its params, perhaps with more samples than are wanted."""

    rows: Float[Array, "rows T"]  # what is one real number at each sample
    columns: list[Array | np.ndarray]  # what else has the samples as its first axis
    others: list[Array | np.ndarray]
    structure: Any = dataclasses.field(metadata={"static": True})  # of the trajectory
    order: tuple[int, ...] = dataclasses.field(metadata={"static": True})  # of its leaves, among rows, columns, others and params

    @classmethod
    def of(cls, t: Trajectory) -> "Table":
        """In the program that computes the motion."""
        leaves, structure = jax.tree.flatten(t)
        at: Any = jax.tree.unflatten(structure, range(len(leaves)))
        samples, known = jax.tree.leaves(of_samples(at)), at.provenance.numbers
        is_row = lambda x: x.ndim == 1 and x.dtype == t.ts.dtype and t.ts.size > EXACT  # fewer are not cut
        rows = [i for i in samples if is_row(leaves[i])]
        columns = [i for i in samples if not is_row(leaves[i])]
        others = [i for i in range(len(leaves)) if i not in {*samples, *known}]
        order = np.argsort([*rows, *columns, *others, *known]).tolist()
        together = jnp.stack([leaves[i] for i in rows]) if rows else jnp.zeros((0, t.ts.size))
        return cls(together, [leaves[i] for i in columns], [leaves[i] for i in others], structure, tuple(order))

    def trajectory(self, length: int, params: PyTree) -> Trajectory:
        """The first samples of the motion, which was computed from these params."""
        cut = _cut() if is_called_by_python([self.rows]) else _first
        rows, columns = cut(self.rows, self.columns, length) if len(self.rows) else (self.rows, self.columns)
        known = [leaf for leaf in jax.tree.leaves(params) if eqx.is_array(leaf)]
        leaves = [*rows, *columns, *self.others, *known]
        return jax.tree.unflatten(self.structure, [leaves[i] for i in self.order])


@functools.cache
def _cut():
    """`_first`, compiled when it is needed: then XLA may be asked which options it knows."""
    return jax.jit(_first, static_argnums=2, compiler_options=options())


def _first(rows, columns, length):
    """The rows one by one, and the columns, both cut to length."""
    return [row[:length] for row in rows], [column[:length] for column in columns]
