"""The variational equations: a motion and its derivatives along some directions, integrated as one system.

    δẏ = ∂f/∂y δy + ∂f/∂p δp   beside   ẏ = f(t, y, p)

An explicit scheme gives of these what differentiating it would, for the same steps, which the motion alone sets.
Source: Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, eqs. I.14.13 and I.14.14.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array


def along(function: Callable, x: Any, directions: Any) -> tuple[Any, Any, Any]:
    """`function(x) -> (y, aux)`: y, its derivatives along the directions, which come last in their leaves, and aux."""
    one = lambda dx: jax.jvp(function, (x,), (dx,), has_aux=True)
    return jax.vmap(one, in_axes=-1, out_axes=(None, -1, None))(directions)


def parted(x: Any, dx: Any) -> tuple[Any, Any]:
    """What moves of x, and what stands still, whose dx is None."""
    return eqx.partition(x, jax.tree.map(lambda d: d is not None, dx, is_leaf=lambda d: d is None))


def beside(y: Array, dy: Array) -> Array:
    """y and its variations, as one array with the variations last."""
    return jnp.concatenate([y[..., None], dy], axis=-1)


@dataclasses.dataclass(frozen=True)
class Varied:
    """Equations of motion without stick and slip, with their variations; `args` are (params, δparams)."""

    equations: Any
    rows = 0

    @property
    def size(self) -> int:
        return self.equations.size

    @property
    def projection(self) -> Any:
        return self.equations.projection

    def error_norm(self, error) -> Array:
        """The error of the motion alone sets the steps."""
        return self.equations.error_norm(error[..., 0])

    def rates(self, t, y, args):
        return self._varied(self.equations.rates, t, y, args)

    def kept(self, t, y, args):
        return self._varied(self.equations.kept, t, y, args)

    def _varied(self, function, t, y, args):
        params, d_params = args
        moving, still = parted(params, d_params)
        of_both = lambda both: (function(t, both[0], (eqx.combine(both[1], still), None)), None)
        value, change, _ = along(of_both, (y[..., 0], moving), (y[..., 1:], d_params))
        return beside(value, change)
