"""What the integration asks of equations of motion: the protocol that a single motion, its variations and a batch of motions share."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from .._mechanics.projection import Projection
from .._model.signal import least_spacing, origin_of
from .._program.jit import jitted


class Scales(NamedTuple):
    """What counts as small in a motion: tolerances, its duration, the sample spacing of its inputs, the rounding of its times, and that of
    the times that functions see, where they ask for them.
    """

    rtol: Any
    atol: Any
    duration: Any
    spacing: Any
    rounding: Any
    grain: Any

    @classmethod
    def of(cls, tolerances: tuple[Array, Array], ts: Array, params: PyTree, sees_time: bool) -> "Scales":
        """The scales of a motion at the times `ts` since the origin of `params`."""
        end, (rtol, atol), eps = jnp.maximum(jnp.abs(ts[0]), jnp.abs(ts[-1])), tolerances, jnp.finfo(ts.dtype).eps
        seen = end + jnp.abs(origin_of(params)) if sees_time else end
        found = cls(rtol, atol, ts[-1] - ts[0], least_spacing(params, ts.dtype), eps * end, eps * seen)
        return jax.lax.stop_gradient(found)

    @property
    def slow(self) -> Array:
        """Per velocity, the slip below which its direction is not worth the many steps that resolving it would take.

        Where elements begin to slide together, a velocity may be off by this much.
        """
        return 1e2 * self.atol

    def error(self, v: Array) -> Array:
        """Per velocity, the error of the integration: slip below it counts as rest where another element changes its mode."""
        return 10 * (self.rtol * jnp.abs(v) + self.atol)


class Arguments(NamedTuple):
    """What the right-hand side depends on besides t and y: diffrax's `args`."""

    params: PyTree  # of the system; in a batch, those that all members share
    scales: Scales | None = None  # None where no event is located
    own: PyTree = None  # in a batch, the params of each member, members last
    directions: tuple = ()  # of the variational equations, for each order: derivatives of (params, own), directions last


@runtime_checkable
class FirstOrderSystem(Protocol):
    """ẏ = f(t, y) on a manifold, as the integration sees it."""

    @property
    def modes(self) -> int:
        """How many elements of dry friction and contacts change their modes; 0 where the right-hand side is smooth."""

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

    def error_norm(self, error: Array) -> Array:
        """The size of an error of y."""


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
    def error_norm(self, error: Array) -> Array:
        """The size of an error of y."""

    @abc.abstractmethod
    def along_axis(self, function: Callable, t: Any, y: Any, args: Arguments) -> Array:
        """A function (t, y, args) of the equations, for all that lies along the last axis."""


@jitted  # so that diffrax's many calls trace it once
def _along_axis(augmented: AugmentedSystem, name: str, t: Any, y: Any, args: Arguments) -> Array:
    return augmented.along_axis(getattr(augmented.equations, name), t, y, args)
