"""The equations of motion of a batch of members that share their steps."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

from .protocol import Arguments, AugmentedSystem


class BatchedEquations(AugmentedSystem):
    """The `FirstOrderSystem` of members that share their steps: y has them as its last axis."""

    def along_axis(self, function: Callable, t: Any, y: Any, args: Arguments) -> Any:
        member = lambda y, own: function(t, y, Arguments(eqx.combine(args.params, own), args.scales))
        return jax.vmap(member, in_axes=-1, out_axes=-1)(y, args.own)
