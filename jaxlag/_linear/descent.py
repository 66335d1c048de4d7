"""Minima of a potential on the constraints, by a descending Newton method."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._mechanics.pseudo_inverse import CLEAR
from .._program.conditions import halved, repeated
from .._program.size_of_terms import size_of_terms

STEPS = 200


def minimum_near(V: Callable, g: Callable, q: Float[Array, " n"], moving: Any, units: Float[Array, " n"]) -> Float[Array, " n"]:
    """A minimum of V on g = 0 in the `moving` coordinates alone, accurate to some digits: a start for the root of the equations.

    Newton's step on the tangent space of g uses the absolute values of the curvatures; from a saddle or a maximum, the step follows the
    most negative curvature. Each step is projected onto the constraints and halved until V decreases. Everything is measured in `units`.

    Source: Absil, Mahony & Sepulchre, Optimization Algorithms on Matrix Manifolds, section 4.1; Gill & Murray, Math. Programming 7 (1974).
    """
    eps, units = jnp.finfo(q.dtype).eps, units[moving]
    at = lambda x: q.at[moving].set(units * x)
    slope_of_g = lambda x: jax.jacfwd(lambda x: g(at(x)))(x)

    def on_constraints(x):
        def put(_, x):
            G = slope_of_g(x)
            return x - _inverse(G) @ g(at(x))

        return jax.lax.fori_loop(0, 5, put, x)

    def turn(carry):
        x, _, i = carry
        G, slope = slope_of_g(x), jax.grad(lambda x: V(at(x)))(x)
        inverse = _inverse(G)
        multipliers = inverse.T @ slope
        K = jax.hessian(lambda x: V(at(x)) - multipliers @ g(at(x)))(x)
        P = jnp.eye(len(slope), dtype=q.dtype) - inverse @ G
        curvature, directions = jnp.linalg.eigh(P @ (K + K.T) @ P / 2)
        largest = jnp.max(jnp.abs(curvature), initial=0.0)
        along = directions.T @ (P @ slope)
        by_curvature = lambda floor: along / jnp.maximum(jnp.maximum(jnp.abs(curvature), floor), jnp.finfo(q.dtype).tiny)
        reach = jnp.max(jnp.maximum(jnp.abs(x), jnp.abs(first)), initial=0.0)
        reach = jnp.where(reach > 0, reach, jnp.max(jnp.abs(by_curvature(eps**0.5 * largest)), initial=0.0))
        nearby = jnp.max(jnp.abs(along), initial=0.0) * 1e-3 / jnp.where(reach > 0, reach, 1)
        step = -directions @ by_curvature(eps**0.5 * largest + nearby)
        flat = jnp.max(jnp.abs(step), initial=0.0) <= eps**0.5 * reach
        falls = curvature[0] < -(eps**0.5) * largest
        downhill = directions[:, 0] * far_down(lambda h: V(at(x + h * directions[:, 0])), 0.1 * reach)
        step = jnp.where(flat & falls, step + downhill, step)
        longest = jnp.max(jnp.abs(step), initial=0.0)
        step = step * jnp.where((reach > 0) & (longest > 0.5 * reach), 0.5 * reach / jnp.where(longest > 0, longest, 1), 1)
        tried = lambda part: on_constraints(x + part * step)
        is_lower = lambda part: (V(at(tried(part))) < V(at(x))) & is_on(tried(part))
        part, lower = halved(is_lower, eps, q.dtype)
        return jnp.where(lower, tried(part), x), lower & ~(flat & ~falls), i + 1

    def is_on(x):
        size = jnp.sum(jnp.abs(slope_of_g(x)), axis=1) * jnp.max(jnp.abs(x), initial=0.0) + size_of_terms(g, at(x))
        return jnp.all(jnp.abs(g(at(x))) <= eps**0.5 * size)

    first = on_constraints(q[moving] / units)
    start = first, jnp.array(True), jnp.array(0)
    return at(jax.lax.while_loop(lambda carry: carry[1] & (carry[2] < STEPS), turn, start)[0])


def _inverse(G: Float[Array, "m n"]) -> Float[Array, "n m"]:
    """G⁺, with each row of G in its own unit."""
    size = jnp.linalg.norm(G, axis=1, keepdims=True)
    unit = jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1), 1)
    return jnp.linalg.pinv(unit * G, rtol=jnp.finfo(G.dtype).eps ** CLEAR) * unit.T


def far_down(V: Callable, h: Float[Array, ""]) -> Float[Array, ""]:
    """The distance to descend from a saddle: h, or, if h is zero because the saddle is at zero, as far as V falls, found by doubling."""
    limits = jnp.finfo(h.dtype).tiny ** 0.25, jnp.finfo(h.dtype).max ** 0.25
    going_on = lambda h: (h > 0) & (h < limits[1]) & (V(2 * h) <= V(h))
    found = repeated(lambda h: 2 * h, jnp.where(h > 0, 0, limits[0] / 2).astype(h.dtype), going_on)
    return jnp.where(h > 0, h, found)
