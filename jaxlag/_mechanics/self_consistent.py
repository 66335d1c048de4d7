"""Multipliers on which applied forces depend that they bring about themselves, λ = r(λ): as of friction of the reactions.

Newton's method from λ = 0, its steps halved until they lead nearer. A λ counts where det(1 − ∂r/∂λ) is positive there and on the way:
elsewhere none, or more than one, may solve the equation (Painlevé's paradox; Genot & Brogliato, Eur. J. Mech. A 18 (1999) 653).
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._program.conditions import repeated
from .._program.implicit import implicit_root, open_function
from .._program.sparsity import sparsity_pattern

ITERATIONS = 60
SHORTEST = 1e-9  # part of a step
OTHERS = 40  # starts of a search for other solutions, of sizes from 1e-4 to 1e4 of the one that is known

NOT_CONSISTENT = (
    "`dissipation` and `force` must allow multipliers that agree with the forces they bring about, but none were found: none exist there, "
    "or more than one (as in Painlevé's paradox, where friction is large). Lower the coefficient of friction, or write the force such that "
    "it does not grow with a power of `multipliers`."
)


def is_affine(function: Callable, x: Float[Array, " m"]) -> bool:
    """Whether the program of a function shows that it is, its slope taken along a direction of which nothing is known."""

    def slope(at_and_along):
        at, along = jnp.split(at_and_along, 2)
        return jax.jvp(function, (at,), (along,))[1]

    return not np.any(sparsity_pattern(slope, jnp.concatenate([x, x]))[:, : x.size])


def self_consistent(reaction: Callable, unit: Float[Array, " m"]) -> Float[Array, " m"]:
    """λ = r(λ), where each λ is compared with others in a `unit`; NaN where none is found."""
    start = jnp.zeros_like(unit)
    if is_affine(reaction, start):  # then one step is exact
        slope = _slope(reaction, start)
        return jnp.where(jnp.linalg.det(slope) > 0, jnp.linalg.solve(slope, reaction(start)), jnp.nan)
    reaction, within = open_function(reaction, start)
    fixed = jax.lax.stop_gradient(within)
    found = _by_newton(lambda x: reaction(x, *fixed), jax.lax.stop_gradient(unit))

    def change(within, w, R):
        return -jnp.linalg.solve(_slope(lambda x: reaction(x, *within), w), R)

    return implicit_root(lambda within, w: w - reaction(w, *within), change, within, jax.lax.stop_gradient(found))


def _slope(reaction: Callable, x: Float[Array, " m"]) -> Float[Array, "m m"]:
    """1 − ∂r/∂λ; where r has no slope, as √(λ₁² + λ₂²) at λ = 0, it is taken as zero, as that of |λ| is."""
    slope = jax.jacfwd(reaction)(x)
    return jnp.eye(x.size, dtype=x.dtype) - jnp.where(jnp.isnan(slope), 0, slope)


def _by_newton(reaction: Callable, unit: Float[Array, " m"], start: Float[Array, " m"] | None = None) -> Float[Array, " m"]:
    """λ = r(λ), from zero or from a `start`; NaN where it does not converge or, from zero, where the determinant is not positive on the
    way.
    """
    eps, size = jnp.finfo(unit.dtype).eps, lambda x: jnp.linalg.norm(x / unit)
    left = lambda x: reaction(x) - x

    def newton(carry):
        x, r, _, sound, i = carry
        slope = _slope(reaction, x)
        d, positive = jnp.linalg.solve(slope, r), jnp.linalg.det(slope) > 0
        shorter = lambda tried: (tried[0] / 2, left(x + tried[0] / 2 * d))
        too_far = lambda tried: ~(size(tried[1]) <= (1 - tried[0] / 4) * size(r)) & (tried[0] > SHORTEST)
        share, after = repeated(shorter, (jnp.full((), 2, unit.dtype), r), too_far)
        there, better = x + share * d, size(after) < size(r)
        moves = better & jnp.any(jnp.abs(share * d) > 4 * eps * jnp.abs(there))
        return jnp.where(better, there, x), jnp.where(better, after, r), moves, sound & (positive | (start is not None)), i + 1

    yes, at_zero = jnp.array(True), reaction(jnp.zeros_like(unit))
    begin = (jnp.zeros_like(unit), at_zero) if start is None else (start, left(start))
    going_on = lambda carry: carry[2] & carry[3] & (carry[4] < ITERATIONS)
    x, r, _, sound, _ = jax.lax.while_loop(going_on, newton, (*begin, yes, yes, 0))
    return jnp.where((size(r) <= eps**0.5 * (size(x) + size(at_zero))) & sound, x, jnp.nan)


def others(reaction: Callable, found: Float[Array, " m"], unit: Float[Array, " m"], key: Any) -> Float[Array, "o m"]:
    """Other solutions, from starts at random of many sizes; NaN where a search ends at none, or at the one `found`."""
    scale = jnp.linalg.norm(found / unit)
    sizes = jnp.where(scale > 0, scale, 1) * jnp.logspace(-4, 4, OTHERS, dtype=unit.dtype)
    starts = sizes[:, None] * unit[None] * jax.random.normal(key, (OTHERS, unit.size), unit.dtype)
    ends = jax.vmap(lambda start: _by_newton(reaction, unit, start))(starts)
    apart = jnp.linalg.norm((ends - found[None]) / unit[None], axis=1, keepdims=True)
    sizes = jnp.linalg.norm(ends / unit[None], axis=1, keepdims=True) + scale
    return jnp.where(apart > jnp.finfo(unit.dtype).eps ** 0.25 * sizes, ends, jnp.nan)
