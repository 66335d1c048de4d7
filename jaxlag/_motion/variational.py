"""The variational equations: a motion and its derivatives along some directions, integrated as one system.

    δẏ = ∂f/∂y δy + ∂f/∂p δp   beside   ẏ = f(t, y, p)

An explicit scheme gives of these what differentiating it would, for the same steps, which the motion alone sets.
Source: Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, eqs. I.14.13 and I.14.14.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .protocol import Arguments, AugmentedSystem


def jvp_along(function: Callable, x: Any, directions: Any) -> tuple[Any, Any, Any]:
    """`function(x) -> (y, aux)`: y, its derivatives along the directions, which come last in their leaves, and aux."""
    one = lambda dx: jax.jvp(function, (x,), (dx,), has_aux=True)
    return jax.vmap(one, in_axes=-1, out_axes=(None, -1, None))(directions)


def pushforward(solve: Callable) -> Callable:
    """How `solve` itself differentiates forward: y, its derivatives along directions, which come last in their leaves, and aux."""

    def push(varying, constant, directions, ts):
        return jvp_along(lambda varying: solve(eqx.combine(varying, constant), ts), varying, directions)

    return push


def split_varying(x: Any, dx: Any) -> tuple[Any, Any]:
    """What varies of x, and what is constant, whose dx is None."""
    return eqx.partition(x, jax.tree.map(lambda d: d is not None, dx, is_leaf=lambda d: d is None))


def with_variations(y: Array, dy: Array) -> Array:
    """y and its variations, as one array with the variations last."""
    return jnp.concatenate([y[..., None], dy], axis=-1)


class VariationalEquations(AugmentedSystem):
    """The `FirstOrderSystem` of a motion without stick and slip together with its variations, which are the last axis of y."""

    def error_norm(self, error: Array) -> Array:
        """The error of the motion alone sets the steps."""
        return self.equations.error_norm(error[..., 0])

    def along_axis(self, function: Callable, t: Any, y: Array, args: Arguments) -> Array:
        varying, constant = split_varying((args.params, args.own), args.directions)
        of_both = lambda both: (function(t, both[0], _arguments(eqx.combine(both[1], constant))), None)
        value, change, _ = jvp_along(of_both, (y[..., 0], varying), (y[..., 1:], args.directions))
        return with_variations(value, change)


def _arguments(numbers):
    params, own = numbers
    return Arguments(params, own=own)
