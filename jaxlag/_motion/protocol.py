"""What the integration asks of equations of motion: the protocol that a single motion, its variations and a batch of motions share."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
from jaxtyping import Array, PyTree

from .._mechanics.projection import Projection
from .._program.jit import jitted


class Arguments(NamedTuple):
    """What the right-hand side depends on besides t and y: diffrax's `args`."""

    params: PyTree  # of the system; in a batch, those that all members share
    scales: Any = None  # `Scales`; None where no event is located
    own: PyTree = None  # in a batch, the params of each member, members last
    directions: tuple = ()  # of the variational equations, for each order: derivatives of (params, own), directions last


def undifferentiated(tree: PyTree) -> PyTree:
    """The same numbers, not differentiated; params may hold functions beside."""
    return jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf, tree)


@runtime_checkable
class FirstOrderSystem(Protocol):
    """ẏ = f(t, y) on a manifold, as the integration sees it."""

    @property
    def modes(self) -> int:
        """How many elements of dry friction and contacts change their modes; 0 where the right-hand side is smooth."""

    @property
    def size(self) -> int:
        """n, the number of coordinates: the first entries of y, whose velocities are the next."""

    @property
    def follows_time(self) -> bool:
        """Whether functions of the system depend on the time."""

    @property
    def as_written(self) -> "FirstOrderSystem":
        """The same, whose functions are not held on the sides of surfaces: as programs that tell what follows the time."""

    @property
    def controlled(self) -> tuple[bool, ...]:
        """Which of the first entries of y set the steps by their error: positions, velocities, states of first order."""

    @property
    def projection(self) -> Projection | None:
        """What puts y back on the manifold, if there is one."""

    def rates(self, t: Any, y: Array, args: Arguments) -> Array:
        """ẏ."""

    def projected(self, t: Any, y: Array, args: Arguments) -> Array:
        """y, put back on the manifold."""


@dataclasses.dataclass(frozen=True)
class AugmentedSystem(abc.ABC):
    """A smooth `FirstOrderSystem` whose y has one more axis, its last: of variations, or of the members of a batch."""

    equations: FirstOrderSystem
    modes = contacts = events = 0
    elsewhere: ClassVar[frozenset[int]] = frozenset()
    varying_periods: ClassVar = ()

    def periods(self, params: PyTree) -> list[Array]:
        """None: no state is sampled."""
        return []

    @property
    def size(self) -> int:
        """The same as of the equations alone."""
        return self.equations.size

    @property
    def follows_time(self) -> bool:
        """The same as of the equations alone."""
        return self.equations.follows_time

    @property
    def as_written(self) -> "AugmentedSystem":
        """The same of the equations as they are written."""
        return dataclasses.replace(self, equations=self.equations.as_written)

    @property
    def controlled(self) -> tuple[bool, ...]:
        """The same as of the equations alone."""
        return self.equations.controlled

    @property
    def projection(self) -> Projection | None:
        """What puts y back on the manifold, if there is one."""
        return self.equations.projection

    def rates(self, t: Any, y: Array, args: Arguments) -> Array:
        """ẏ."""
        return _along_axis(self, "rates", t, y, args)

    def projected(self, t: Any, y: Array, args: Arguments) -> Array:
        """y, put back on the manifold."""
        return _along_axis(self, "projected", t, y, args)

    @abc.abstractmethod
    def along_axis(self, function: Callable, t: Any, y: Any, args: Arguments) -> Any:
        """A function (t, y, args) of the equations, for all that lies along the last axis."""


@jitted  # so that diffrax's many calls trace it once
def _along_axis(augmented: AugmentedSystem, name: str, t: Any, y: Any, args: Arguments) -> Array:
    return augmented.along_axis(getattr(augmented.equations, name), t, y, args)
