"""Velocities at which a convex dissipation function balances the forces: the least of D(ż) − F ż on the constraints."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float

from .._model.flat import Flat
from .._program.scalarise import scalarised
from .constrained_root import Linear, root_of
from .lagrange import smooth_force, velocity_residual
from .saddle_point import Sound, is_determined, saddle_point

ITERATIONS = 100  # of Newton's method; from rest, a few more than from a motion
HALVINGS = 1100  # of a step, from the largest number to the least
NEAR = 0.1875  # exponent of eps (1.2e-3 in double precision), at which distance a D is flat that does not decide velocities
LEAST = 0.125  # exponent of the least number (3e-39), at which velocity a D is looked at where nothing moves: its square is one too


def by_newton(flat: Flat, z, rows, equations: Callable, t, q, v) -> tuple[Array, Array, Sound]:
    """ż and λ where D is convex: least D(ż) − F ż on ψ = 0, by Newton's method with a line search."""
    k, faint = z.size, jnp.finfo(v.dtype).tiny ** 0.5
    like = jnp.concatenate([v[z], jnp.zeros(int(rows.sum()), v.dtype)])

    @scalarised
    def residual(args, w):
        (t, q, v), (w, multipliers) = args, jnp.split(w, [k])
        moved = lambda w: v.at[z].set(w)
        psi, pull = jax.vjp(lambda w: velocity_residual(flat, t, q, moved(w))[rows], w)
        return jnp.concatenate([-smooth_force(flat, t, q, moved(w))[z] - pull(multipliers)[0], psi])

    @scalarised
    def linear(args, w):
        slope, G, F, c = equations(*args, w[:k])
        return Linear(lx.MatrixLinearOperator(slope.as_matrix() + faint * jnp.eye(k)), G, F, c)

    def search(linear, args):
        at_rest = linear(args, jnp.zeros_like(like))
        force = lambda w: linear(args, jnp.concatenate([w, like[k:]])).f
        given = _first_guess(force, at_rest, args[2][z])

        def newton(carry):
            w, _, _, i = carry
            at = linear(args, w)
            d, multipliers, _ = at.solution()
            share = _length(lambda share: -(force(w[:k] + share * d) + at.G.T @ multipliers) @ d)
            there = w[:k] + share * d
            moves = (share < 1) | jnp.any(jnp.abs(d) > 4 * jnp.finfo(v.dtype).eps * (jnp.abs(there) + _rates(at_rest, at, there)))
            return jnp.concatenate([there, multipliers]), force(there) + at.G.T @ multipliers, moves, i + 1

        start = jnp.concatenate([given, jnp.zeros_like(like[k:])]), jnp.zeros_like(given), jnp.array(True), jnp.array(0)
        w, left, _, _ = jax.lax.while_loop(lambda carry: carry[2] & (carry[3] < ITERATIONS), newton, start)
        at = linear(args, w)
        solved = jnp.all(jnp.abs(left) <= jnp.finfo(v.dtype).eps ** 0.5 * (_forces(at_rest, at, w[:k]) + jnp.abs(at.G.T) @ jnp.abs(w[k:])))
        return w, (solved & resists(args, _rates(at_rest, at, w[:k]), w[:k]), at.solution().sound.satisfied)

    def resists(args, rates, w):
        """Whether D is bent around w, where it may be flat at one place, as |ż|³ is at rest, or have no slope, as |ż|^1.5 has none."""
        size = jnp.maximum(jnp.abs(w) + rates, jnp.finfo(v.dtype).tiny ** LEAST)
        near = jnp.finfo(v.dtype).eps ** NEAR * size * jnp.linspace(1, 2, k, dtype=v.dtype)
        (above, G, *_), (below, *_) = (equations(*args, w + beside) for beside in (near, -near))
        return is_determined(lx.MatrixLinearOperator(above.as_matrix() + below.as_matrix()), G)

    w, sound = root_of(residual, linear, search, (t, q, v), like)
    rates, multipliers = jnp.split(w, [k])
    return rates, multipliers, Sound(*sound)


def _forces(at_rest: Linear, at: Linear, w: Float[Array, " k"]) -> Float[Array, " k"]:
    """The size of the terms of the force on each coordinate: that at rest, and what each velocity adds."""
    return jnp.abs(at_rest.f) + jnp.where(w != 0, jnp.abs(at.M.as_matrix()), 0) @ jnp.abs(w)


def _rates(at_rest: Linear, at: Linear, w: Float[Array, " k"]) -> Float[Array, " k"]:
    """The velocities that these terms make against the slope of each coordinate, in its own unit."""
    slope = jnp.diagonal(at.M.as_matrix())
    there = slope > 2 * jnp.finfo(w.dtype).tiny ** 0.5
    return jnp.where(there, _forces(at_rest, at, w) / jnp.where(there, slope, 1), 0)


def _first_guess(force: Callable, at_rest: Linear, given: Float[Array, " k"]) -> Float[Array, " k"]:
    """The rates given, where they balance half of the forces; or else, along the forces, as fast as balances these, to a factor of two."""
    identity = lambda f, c: saddle_point(lx.MatrixLinearOperator(jnp.eye(given.size, dtype=given.dtype)), at_rest.G, f, c).x
    slowest = identity(jnp.zeros_like(given), at_rest.c)
    allowed = lambda w: identity(force(w), jnp.zeros_like(at_rest.c))
    given = jnp.where(jnp.isfinite(given), given, 0)
    given, along = given + identity(jnp.zeros_like(given), at_rest.c - at_rest.G @ given), allowed(slowest)
    along = along / jnp.maximum(jnp.max(jnp.abs(along)), jnp.finfo(given.dtype).tiny)
    largest = int(jnp.finfo(given.dtype).maxexp)
    ahead = lambda k: -force(slowest + jnp.exp2(k.astype(given.dtype)) * along) @ along
    searched = lambda: slowest + _power_of_two(lambda k: ahead(k) <= 0, -largest, largest) * along
    is_near = jnp.max(jnp.abs(allowed(given))) <= jnp.max(jnp.abs(allowed(slowest))) / 2
    return jax.lax.cond(is_near, lambda: given, searched)


def _length(slope: Callable) -> Float[Array, ""]:
    """How much of a step of Newton's method to take, a power of ½: the longest that does not go far beyond the minimum along it."""
    start = slope(0.0)
    within = lambda k: slope(jnp.exp2(k.astype(start.dtype))) <= jnp.abs(start) / 2
    return jax.lax.cond(within(jnp.array(0)), lambda: jnp.ones_like(start), lambda: _power_of_two(within, -HALVINGS, 0))


def _power_of_two(within: Callable, least: int, most: int) -> Float[Array, ""]:
    """The largest power that is still within, by bisection of its exponent."""

    def bisect(carry):
        low, high = carry
        middle = (low + high) // 2
        return jax.tree.map(lambda a, b: jnp.where(within(middle), a, b), (middle, high), (low, middle))

    exponent, _ = jax.lax.while_loop(lambda carry: carry[1] - carry[0] > 1, bisect, (jnp.array(least), jnp.array(most)))
    return jnp.exp2(exponent.astype(float))
