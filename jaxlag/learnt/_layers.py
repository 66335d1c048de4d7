"""Layers that keep a network convex or increasing, their initial weights, and the checks of sizes.

Weights are made positive by softplus. The activation σ(x) = ½(x + √(1 + x²)) is convex and increasing (Barron, Squareplus,
arXiv:2112.11687): the remainder of σ beyond its tangent is δ² over a positive number, exactly zero and flat at δ = 0, where softplus would
leave the rounding error of a difference.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

Scale = Any  # positive numbers, structured like q: `as_scale` checks them


def squareplus(x):
    """σ(x), convex and increasing."""
    return 0.5 * (x + jnp.sqrt(1 + x**2))


def convex_remainder(c, d):
    """σ(c + d) − σ(c) − σ'(c) d ≥ 0, convex in d.

    With p = 1 + c(c + d) and m = √(1 + c²) √(1 + (c + d)²) it is ½(m − p)/√(1 + c²), where m − p = d²/(m + p). This takes the form that
    adds numbers of equal sign, so that nothing cancels.
    """
    root = jnp.sqrt(1 + c**2)
    p = 1 + c * (c + d)
    same_sign = p > 0
    both = root * jnp.sqrt(1 + (c + d) ** 2) + jnp.where(same_sign, p, -p)
    return 0.5 * jnp.where(same_sign, d**2 / both, both) / root


def increase(c, y):
    """σ(c + y) − σ(c), increasing and convex in y; exactly zero at y = 0."""
    return 0.5 * y * (1 + (2 * c + y) / (jnp.sqrt(1 + (c + y) ** 2) + jnp.sqrt(1 + c**2)))


def expand(c, linear, beyond):
    """σ(c + linear + beyond) as its value at c, its linear part and the remainder."""
    slope = 0.5 * (1 + c / jnp.sqrt(1 + c**2))
    return squareplus(c), slope * linear, slope * beyond + convex_remainder(c, linear + beyond)


def half_bounded(u):
    """The second half of u as it is, and the first half bounded by u/√(1 + u²)."""
    half = u.size // 2
    return jnp.concatenate([u[half:], u[:half] / jnp.sqrt(1 + u[:half] ** 2)])


def input_layer(key, width, n):
    """Weights and biases of a layer from x: directions of any sign, sizes spread over two decades around the scale."""
    at_direction, at_size, at_bias = jax.random.split(key, 3)
    size = 10 ** jax.random.uniform(at_size, (width, 1), minval=-1, maxval=1)
    direction = jax.random.normal(at_direction, (width, n))
    return size * direction / jnp.linalg.norm(direction, axis=1, keepdims=True), jax.random.normal(at_bias, (width,))


def weight_shapes(width, depth):
    """The shapes of the weights between `depth` layers, and of the output weights."""
    return [(width, width)] * (depth - 1) + [(width,)]


def positive_weights(key, shape, steepness=1.0):
    """Raw weights: after softplus, they take roughly the mean of the incoming units, each divided by its steepness."""
    mean = jnp.broadcast_to(1 / (shape[-1] * steepness), shape)
    return jnp.log(jnp.expm1(mean)) + 0.5 * jax.random.normal(key, shape)


def flat_numbers(tree):
    """The numbers of a pytree as a tuple; by NumPy, so that a network can be made under `jit`."""
    return tuple(float(number) for leaf in jax.tree.leaves(tree) for number in np.ravel(leaf))


def as_scale(scale):
    """The scale as a tuple of positive numbers, one for each coordinate."""
    numbers = flat_numbers(scale)
    if not numbers or not all(0 < number < math.inf for number in numbers):
        raise ValueError(f"`scale` must be positive numbers, one for each coordinate, but is {scale}. Give the size of what goes in.")
    return numbers


def as_positive(name, value):
    """`value` as a positive, finite float."""
    if not 0 < float(value) < math.inf:
        raise ValueError(f"`{name}` must be positive, but is {value}. Give the size of what comes out.")
    return float(value)


def as_count(name, value, least=1):
    """`value`, which must be at least `least`."""
    if value < least:
        raise ValueError(f"`{name}` must be at least {least}, but is {value}. A network needs layers and units.")
    return value


def scaled(x, scale, name, origin=None):
    """(x − origin) / scale, as a vector."""
    flat, _ = ravel_pytree(x)
    if flat.size != len(scale):
        raise ValueError(
            f"`{name}` must have the size of `scale`, {len(scale)}, but has {flat.size}. "
            f"Make the network with a scale structured like `{name}`."
        )
    flat = flat if jnp.issubdtype(flat.dtype, jnp.floating) else flat.astype(float)
    vector = lambda numbers: jnp.asarray(numbers, flat.dtype)
    return (flat if origin is None else flat - vector(origin)) / vector(scale)
