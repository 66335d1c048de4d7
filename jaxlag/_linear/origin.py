"""The state near which a system is linear."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, PyTree

from .._model.system import System
from .._motion.provenance import put_together, taken_apart


class Origin(eqx.Module):
    """The time, the state and the params at which all deviations are zero, and the units of the system. What is not an array in params is
    kept apart, so that a batch consists of arrays only.
    """

    t: Any
    q: PyTree
    qdot: PyTree
    numbers: list[Array | np.ndarray]
    rest: tuple = eqx.field(static=True)
    units: tuple[tuple[str, str], ...] = eqx.field(static=True)

    @classmethod
    def of(cls, t: Any, q: PyTree, qdot: PyTree, params: PyTree, system: System) -> "Origin":
        return cls(t, q, qdot, *taken_apart(params), system.units)

    @property
    def params(self) -> PyTree:
        """The params, reassembled."""
        return put_together(self.numbers, self.rest)
