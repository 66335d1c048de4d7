"""Minima of a potential on the constraints, by Newton's method that goes downhill."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

STEPS = 200


def minimum_near(V: Callable, g: Callable, q: Float[Array, " n"], moving: Any) -> Float[Array, " n"]:
    """A minimum of V on g = 0, in which only `moving` coordinates move: good to some digits, for a root of the equations to go on from.

    On the tangent space of g, Newton's step with the sizes of the curvatures, also of negative ones; from a saddle or a maximum along
    the most negative one. A step is put back on the constraints, and halved until V is lower.

    Source: Absil, Mahony & Sepulchre, Optimization Algorithms on Matrix Manifolds, section 4.1; Gill & Murray, Math. Programming 7 (1974).
    """
    eps = jnp.finfo(q.dtype).eps
    slope_of_g = lambda q: jax.jacfwd(g)(q)[:, moving]
    pinv = lambda G: jnp.linalg.pinv(G, rtol=eps**0.3125)

    def on_constraints(q):
        return jax.lax.fori_loop(0, 5, lambda _, q: q.at[moving].add(-pinv(slope_of_g(q)) @ g(q)), q)

    def turn(carry):
        q, _, i = carry
        G, slope = slope_of_g(q), jax.grad(V)(q)[moving]
        inverse = pinv(G)
        multipliers = inverse.T @ slope
        K = jax.hessian(lambda q: V(q) - multipliers @ g(q))(q)[moving][:, moving]
        P = jnp.eye(len(slope), dtype=q.dtype) - inverse @ G
        curvature, directions = jnp.linalg.eigh(P @ (K + K.T) @ P / 2)
        largest = jnp.max(jnp.abs(curvature), initial=0.0)
        along = directions.T @ (P @ slope)
        reach = 1 + jnp.max(jnp.abs(q))
        floor = eps**0.5 * largest + jnp.max(jnp.abs(along), initial=0.0) * 1e-3 / reach + eps
        step = -directions @ (along / jnp.maximum(jnp.abs(curvature), floor))
        flat = jnp.max(jnp.abs(step), initial=0.0) <= eps**0.5 * reach
        falls = curvature[0] < -(eps**0.5) * largest
        step = jnp.where(flat & falls, step + 0.1 * reach * directions[:, 0], step)
        step = step / jnp.maximum(1, jnp.max(jnp.abs(step), initial=0.0) / (0.5 * reach))
        tried = lambda part: on_constraints(q.at[moving].add(part * step))
        is_on = lambda q: jnp.all(jnp.abs(g(q)) <= eps**0.5 * (jnp.abs(jax.jacfwd(g)(q)) @ (1 + jnp.abs(q))))
        is_lower = lambda part: (V(tried(part)) < V(q)) & is_on(tried(part))
        part = jax.lax.while_loop(lambda part: (part > eps) & ~is_lower(part), lambda part: part / 2, jnp.ones((), q.dtype))
        lower = is_lower(part)
        return jnp.where(lower, tried(part), q), lower & ~(flat & ~falls), i + 1

    q, _, _ = jax.lax.while_loop(lambda carry: carry[1] & (carry[2] < STEPS), turn, (on_constraints(q), jnp.array(True), jnp.array(0)))
    return q
