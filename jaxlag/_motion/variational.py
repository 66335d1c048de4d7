"""The variational equations: a motion and its derivatives along some directions, integrated as one system.

    δẏ = ∂f/∂y δy + ∂f/∂p δp   beside   ẏ = f(t, y, p)

An explicit scheme gives of these what differentiating it would, for the same steps, which fit the worst of them (`step_size`).
Source: Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, eqs. I.14.13 and I.14.14.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .protocol import Arguments, AugmentedSystem, undifferentiated


def jvp_along(function: Callable, x: Any, directions: Any) -> tuple[Any, Any, Any]:
    """`function(x) -> (y, aux)`: y, its derivatives along the directions, which come last in their leaves, and aux."""
    one = lambda dx: jax.jvp(function, (x,), (dx,), has_aux=True)
    if all(dx.shape[-1] == 1 for dx in jax.tree.leaves(directions)):  # no batch: its program is a fifth shorter
        y, dy, aux = one(jax.tree.map(lambda dx: dx[..., 0], directions))
        return y, jax.tree.map(lambda dy: dy[..., None], dy), aux
    return jax.vmap(one, in_axes=-1, out_axes=(None, -1, None))(directions)


def derived(function: Callable, directions: Any) -> Callable:
    """x ↦ ((y, its derivatives along directions of what varies of x), aux); what is constant has None for its directions."""

    def both(x):
        varying, constant = split_varying(x, directions)
        y, dy, aux = jvp_along(lambda varying: function(eqx.combine(varying, constant)), varying, directions)
        return (y, dy), aux

    return both


def pushforward(solve: Callable) -> Callable:
    """How `solve` itself differentiates forward: y and aux with its derivatives along directions, those of each order in turn."""

    def push(inputs, directions, ts):
        function = lambda inputs: solve(inputs, ts)
        for of_order in directions:
            function = derived(function, of_order)
        return function(inputs)

    return push


def split_varying(x: Any, dx: Any) -> tuple[Any, Any]:
    """What varies of x, and what is constant, whose dx is None."""
    return eqx.partition(x, jax.tree.map(lambda d: d is not None, dx, is_leaf=lambda d: d is None))


def with_variations(y: Array, dy: Array) -> Array:
    """y and its variations, as one array with the variations last."""
    return jnp.concatenate([y[..., None], dy], axis=-1)


def varied_along(function: Callable, orders: Sequence) -> Callable:
    """A function (x, given) ↦ (value, aux) of x with variations as last axes, along directions of `given` for each order."""

    def of_order(function, directions):
        def varied(x, given):
            alone, change = (jax.tree.map(lambda leaf, part=part: leaf[part], x) for part in ((..., 0), (..., slice(1, None))))
            (value, change), aux = derived(lambda both: function(*both), (change, directions))((alone, given))
            return jax.tree.map(with_variations, value, change), aux

        return varied

    return functools.reduce(of_order, orders, function)


class VariationalEquations(AugmentedSystem):
    """The `FirstOrderSystem` of a motion without stick and slip together with its variations, which are the last axis of y.

    That of its variational equations in their turn has the second variations, and so on.
    """

    def along_axis(self, function: Callable, t: Any, y: Any, args: Arguments) -> Array:
        *before, directions = args.directions
        given = lambda numbers: Arguments(numbers[0], own=numbers[1], directions=tuple(before))
        along = varied_along(lambda y, numbers: (function(t, y, given(numbers)), None), [directions])
        return along(y, (args.params, args.own))[0]


class AccompaniedEquations(VariationalEquations):
    """The same where variations have a part in setting the steps alone: reverse mode goes through the motion and not through them."""

    def along_axis(self, function: Callable, t: Any, y: Any, args: Arguments) -> Array:
        alone = function(t, y[..., 0], args._replace(directions=args.directions[:-1]))
        accompanying = super().along_axis(function, *undifferentiated((t, y, args)))
        return with_variations(alone, jax.lax.stop_gradient(accompanying[..., 1:]))
