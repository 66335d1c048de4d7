"""Newton's method for a point of a curve R(x, p) = 0 in a plane across it."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._linear.newton import least_change

UNKNOWN = 1e-30  # a scale that stands for none


class Plane(NamedTuple):
    """A plane through z across a curve, in units of `scale`; for a special point the two vectors that border its critical matrix."""

    z: Float[Array, " u"]
    direction: Float[Array, " u"]
    scale: Float[Array, " u"]
    borders: tuple[Array, Array]


class InPlane(NamedTuple):
    """What Newton's method found: the point; the Jacobian, the residual and what is told `aside` where it was evaluated last; whether its
    last step was small, and how many turns there were.
    """

    z: Float[Array, " u"]
    J: Float[Array, "k u"]
    left: Float[Array, " k"]
    aside: Any
    done: Bool[Array, ""]
    turns: Int[Array, ""]


def in_plane(evaluated: Callable, plane: Plane, turns: Any, small: Any, cleaned: Callable = lambda J, aside: J) -> InPlane:
    """The point in a plane where R = 0, by at most so many `turns`; none only evaluates. `evaluated(z)` is R and what is told aside;
    `cleaned(J, aside)` a Jacobian without what is rounding.
    """

    def both(z):
        left, aside = evaluated(z)
        return left, (left, aside)

    def turn(carry):
        z, *_, i = carry
        J, (left, aside) = jax.jacfwd(both, has_aux=True)(z)
        J = cleaned(J, aside)
        across = (z - plane.z) / plane.scale @ plane.direction
        A, b = jnp.concatenate([J, (plane.direction / plane.scale)[None]]), jnp.append(left, across)
        step = jnp.where(i < turns, -least_change(A, b, plane.scale), 0)
        done = jnp.max(jnp.abs(step / plane.scale)) <= small
        return z + step, J, left, aside, done & (turns > 0) & jnp.all(jnp.isfinite(J)), i + 1

    def going_on(carry):
        z, J, *_, done, i = carry
        return ~done & (i <= turns) & jnp.all(jnp.isfinite(z)) & ((i == 0) | jnp.all(jnp.isfinite(J)))

    shapes = jax.eval_shape(lambda z: (jax.jacfwd(both, has_aux=True)(z)[0], *both(z)[1]), plane.z)
    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    z, J, left, aside, done, i = jax.lax.while_loop(going_on, turn, (plane.z, *nothing, jnp.array(False), jnp.array(0)))
    return InPlane(z, J, left, aside, done, i)
