"""How a minimum depends on the numbers of its problem, by the implicit function theorem."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from .._program.implicit import implicit_root
from .chain import Chain
from .interior_point import Point, factorised


def differentiable(chain_of: Callable[[Any], Chain], args: Any, point: Point, mu: Any) -> Point:
    """The same point, as a function of args: where ∇f + Jᵀy = z_l − z_u, c = 0, z_l (x − l) = z_u (u − x) = μ."""
    w, unravel = ravel_pytree(point)

    def residual(args, w):
        chain, (x, y, zl, zu) = chain_of(args), unravel(w)
        gradient, c = chain.stationary(x, y)
        below, above = (jnp.isfinite(end) for end in (chain.lower, chain.upper))
        to_lower = jnp.where(below, zl * (x - jnp.where(below, chain.lower, 0)) - mu, zl)
        to_upper = jnp.where(above, zu * (jnp.where(above, chain.upper, 0) - x) - mu, zu)
        return ravel_pytree(Point(gradient - zl + zu, c, to_lower, to_upper))[0]

    def change(args, w, R):
        chain, (x, y, zl, zu), r = chain_of(args), unravel(w), unravel(R)
        below, above = jnp.isfinite(chain.lower), jnp.isfinite(chain.upper)
        to_lower = jnp.where(below, x - jnp.where(below, chain.lower, 0), 1)
        to_upper = jnp.where(above, jnp.where(above, chain.upper, 0) - x, 1)
        kkt, _ = factorised(chain.linearised(x, y), zl / to_lower + zu / to_upper, jnp.zeros((), x.dtype))
        dx, dy = kkt(-r.x - r.below / to_lower + r.above / to_upper, -r.y)
        return ravel_pytree(Point(dx, dy, (-r.below - zl * dx) / to_lower, (-r.above + zu * dx) / to_upper))[0]

    return unravel(implicit_root(residual, change, args, w))
