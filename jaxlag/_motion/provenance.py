"""What a motion was computed from: the system and its params, or what a file keeps of them."""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, PyTree

from .._mechanics.friction_treatment import Regularised, StickSlip
from .._model.system import System


def taken_apart(params: PyTree) -> tuple[list[Array | np.ndarray], tuple]:
    """The arrays in params, and all else."""
    leaves, structure = jax.tree.flatten(params)
    numbers = [leaf for leaf in leaves if eqx.is_array(leaf)]
    return numbers, (structure, tuple(None if eqx.is_array(leaf) else leaf for leaf in leaves))


def put_together(numbers: list[Array | np.ndarray], rest: tuple) -> PyTree:
    """The params of both."""
    structure, others = rest
    arrays = iter(numbers)
    return jax.tree.unflatten(structure, [next(arrays) if other is None else other for other in others])


class Provenance(eqx.Module):
    """The system and params of a motion, and the treatment of friction. What is not an array in params is kept apart, so that batches
    of motions consist of arrays only.
    """

    numbers: list[Array | np.ndarray]
    system: System = eqx.field(static=True)
    rest: tuple = eqx.field(static=True)
    friction: StickSlip | Regularised = eqx.field(static=True)

    @classmethod
    def of(cls, system: System, params: PyTree, friction: StickSlip | Regularised = StickSlip()) -> "Provenance":
        numbers, rest = taken_apart(params)
        return cls(numbers, system, rest, friction)

    @property
    def params(self) -> PyTree:
        """The params, put together again."""
        return put_together(self.numbers, self.rest)

    @property
    def one_sided(self) -> tuple[str, ...]:
        """Names of the constraints that cannot pull."""
        return self.system.one_sided

    @property
    def units(self) -> tuple[tuple[str, str], ...]:
        """The units of what has a name."""
        return self.system.units


class Recorded(eqx.Module):
    """What a motion from a file has in place of its system: what the system had computed at the samples before it was saved."""

    energies: tuple[Array, Array]
    slip: dict[str, Array]
    params: PyTree
    one_sided: tuple[str, ...] = eqx.field(static=True)
    friction: StickSlip | Regularised = eqx.field(static=True)
    units: tuple[tuple[str, str], ...] = eqx.field(static=True)

    @property
    def system(self) -> System:
        """None is available."""
        raise ValueError(
            "a motion that was loaded from a file must do without its system, whose functions are not in the file, but these are needed "
            "here. Simulate it again; energies, works and slip velocities are there as they were saved."
        )
