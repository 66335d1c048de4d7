"""How large the terms are that a function adds up: where they cancel to zero, rounding is small compared with them."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .walker import CALLS, called_program, walk

ADDING = ("add", "sub", "add_any", "reduce_sum", "dot_general", "cumsum")


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
            if equation.primitive.name in CALLS:
                return walk(called_program(equation), operands, evaluate, _fixed, lambda atom: _fixed(atom.val))
            values, depends = [value for value, _ in operands], any(of_x for _, of_x in operands)
            if depends and equation.primitive.name in ADDING:
                values = [_changed(value, share, draw) for value in values]
            found = equation.primitive.bind(*values, **equation.primitive.get_bind_params(equation.params))
            return [(value, depends) for value in (found if equation.primitive.multiple_results else [found])]

        ((value, _),) = walk(program, [(x, True)], evaluate, _fixed, lambda atom: _fixed(atom.val))
        return value

    return jnp.abs(jax.jvp(changed, (jnp.zeros((), x.dtype),), (jnp.ones((), x.dtype),))[1])


def _fixed(value: Any) -> tuple[Any, bool]:
    """A number that does not depend on x."""
    return value, False


def _changed(value, share, draw):
    """A number changed by one to two times a share of itself, up or down; an integer as it is."""
    dtype, shape = jnp.result_type(value), np.shape(value)
    if not jnp.issubdtype(dtype, jnp.floating):
        return value
    return value * (1 + share * (draw.uniform(1, 2, shape) * draw.choice([-1.0, 1.0], shape)).astype(dtype))
