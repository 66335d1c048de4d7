"""How large the terms are that a function adds up: where they cancel to zero, rounding is small compared with them."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .constants import bound
from .primitives import CALLS, SUMS
from .walker import walk


def size_of_terms(function: Callable, x: Float[Array, " n"]) -> Float[Array, " m"]:
    """Σ |∂f/∂a| |a| over the terms a that are added up on the way from x to f, to within some factor: of y − l (1 − cos φ) it is |y| and
    some l, however small y and φ are. It has the unit of f.

    One derivative tells: each term grows or shrinks by once to twice a share of itself, at random, so that what cancels is seen. What does
    not depend on x counts as one term each, and a loop as a function of what enters it.
    """
    program = jax.make_jaxpr(function)(x)

    def changed(share):
        draw = np.random.default_rng(0)

        def evaluate(equation, operands):
            values, depends = [value for value, _ in operands], any(of_x for _, of_x in operands)
            if depends and equation.primitive.name in SUMS:
                values = [_changed(value, share, draw) for value in values]
            return [(value, depends) for value in bound(equation, *values)]

        ((value, _),) = walk(program, [(x, True)], evaluate, lambda value: (value, False), opened=CALLS)
        return value

    return jnp.abs(jax.jvp(changed, (jnp.zeros((), x.dtype),), (jnp.ones((), x.dtype),))[1])


def _changed(value, share, draw):
    """A number changed by one to two times a share of itself, up or down; an integer as it is."""
    dtype, shape = jnp.result_type(value), np.shape(value)
    if not jnp.issubdtype(dtype, jnp.floating):
        return value
    return value * (1 + share * (draw.uniform(1, 2, shape) * draw.choice([-1.0, 1.0], shape)).astype(dtype))
