"""The equations of motion of a batch of members that share their steps."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._mechanics.projection import Projection
from .protocol import Arguments, FirstOrderSystem


@dataclasses.dataclass(frozen=True)
class BatchedEquations:
    """The `FirstOrderSystem` of members that share their steps: y has them as its last axis."""

    equations: FirstOrderSystem
    rows = 0

    @property
    def size(self) -> int:
        return self.equations.size

    @property
    def projection(self) -> Projection | None:
        return self.equations.projection

    def error_norm(self, error: Array) -> Array:
        """The largest of the members."""
        return jnp.max(self.equations.error_norm(error))

    def rates(self, t: Any, y: Array, args: Arguments) -> Array:
        return self._each(self.equations.rates, t, y, args)

    def projected(self, t: Any, y: Array, args: Arguments) -> Array:
        return self._each(self.equations.projected, t, y, args)

    def _each(self, function, t, y, args):
        member = lambda y, own: function(t, y, Arguments(eqx.combine(args.params, own), args.scales))
        return jax.vmap(member, in_axes=-1, out_axes=-1)(y, args.own)
