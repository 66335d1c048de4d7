"""State and params as compiled programs take them: what is one number in a single array, since each array more takes up to 2 µs."""

import dataclasses
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._program.jit import is_concrete
from .._program.registry import Table

Trees = tuple[PyTree, PyTree, PyTree]  # q, qdot, params


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Given:
    """A checked state and params."""

    numbers: Float[Array | np.ndarray, " numbers"]  # leaves that are single numbers in double precision, as JAX has it
    others: list[Any]
    structure: Any = dataclasses.field(metadata={"static": True})
    is_number: tuple[bool, ...] = dataclasses.field(metadata={"static": True})  # of each leaf

    @classmethod
    def of(cls, checked: Trees) -> "Given":
        """Of pytrees of arrays; what is traced, be it a number, stays by itself."""
        leaves, structure = jax.tree.flatten(checked)
        double, known = jax.dtypes.canonicalize_dtype(float), is_concrete(leaves)
        is_number = tuple(known and getattr(leaf, "shape", None) == () and leaf.dtype == double for leaf in leaves)
        numbers = np.array([leaf.item() for leaf, single in zip(leaves, is_number, strict=True) if single], double)
        return cls(numbers, [leaf for leaf, single in zip(leaves, is_number, strict=True) if not single], structure, is_number)

    @property
    def trees(self) -> Trees:
        """q, qdot and params."""
        numbers, others = iter(_one_by_one(self.numbers)), iter(self.others)
        return jax.tree.unflatten(self.structure, [next(numbers if single else others) for single in self.is_number])

    @property
    def dtype(self) -> np.dtype:
        """That of the coordinates."""
        return self.numbers.dtype if self.is_number[0] else self.others[0].dtype


def _one_by_one(numbers):
    if isinstance(numbers, np.ndarray):
        return [numbers[i, ...] for i in range(len(numbers))]
    return [number.reshape(()) for number in jax.lax.split(numbers, [1] * len(numbers))] if len(numbers) else []


_CHECKED = Table()  # the structures that passed the checks


def known(as_given: Trees) -> Given | None:
    """Plain numbers in a structure that passed the checks before, which say nothing of their values; otherwise None."""
    leaves, structure = jax.tree.flatten(as_given)
    double = jax.dtypes.canonicalize_dtype(float)
    found = _CHECKED.get((structure, *map(type, leaves), double))
    return None if found is None else Given(np.array(leaves, double), [], *found)


def remember(as_given: Trees, checked: Given) -> None:
    """From now on `known`, where it consists of plain numbers, each of which has become an array."""
    leaves, structure = jax.tree.flatten(as_given)
    kinds = tuple(map(type, leaves))
    if checked.structure == structure and not checked.others and {*kinds} <= {float, int, np.float64}:
        _CHECKED[structure, *kinds, checked.dtype] = (structure, checked.is_number)
