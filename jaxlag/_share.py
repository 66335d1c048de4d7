"""How elements of friction that stick share a load that they hold together, as the legs of a plate do.

Of all multipliers with the same effect, those that use the most loaded element least:

    min ρ   such that  ‖μ_i‖ ≤ ρ F_i,   μ = μ₀ + N z,   N a basis of {μ : Jᵀμ = 0}

ρ < 1 while some share is possible. At ρ = 1 none is any more, and the forces are along slips that go together: the limit theorem of
plasticity. Solved by a barrier, along whose path the slips go together already.
Source: Moreau, Application of convex analysis to some problems of dry friction (1979); Boyd & Vandenberghe, Convex Optimization, chapter 11.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._kinks import Kinks
from ._multipliers import everywhere

STEPS = 4  # of Newton's method, each time that the barrier is made four times as steep


class Share(NamedTuple):
    """Multipliers of the rows; and, per element, how much of its bound is left."""

    multipliers: Float[Array, " r"]
    margin: Float[Array, " e"]


def shared(
    kinks: Kinks, J: Float[Array, "r n"], multipliers: Float[Array, " r"], bound: Float[Array, " e"], stuck: Bool[Array, " e"]
) -> Share:
    """The best share of those `stuck`, and how much of its bound each has left. The share itself is not differentiated, its ρ is."""
    of, sums, eps = kinks.element_of_row, kinks.sums, jnp.finfo(bound.dtype).eps
    fixed = jax.lax.stop_gradient
    length = jnp.linalg.norm(fixed(J), axis=1)
    unit = jnp.where((stuck[of] & (length > 0))[:, None], fixed(J) / jnp.where(length > 0, length, 1)[:, None], 0)
    values, U = jnp.linalg.eigh(unit @ unit.T + jnp.diag(1.0 * (jnp.sum(unit**2, axis=1) == 0)))
    free = values <= eps**0.75 * values[-1]
    scale = jnp.where(stuck, jnp.maximum(fixed(bound), eps * jnp.max(fixed(bound), initial=0)), 0)
    scale = jnp.where(scale > 0, scale, 1)
    N = jnp.where(free[None, :], U / jnp.where(length > 0, length, 1)[:, None], 0) / scale[of][:, None]
    mine = of[:, None] == np.arange(kinks.elements)[None, :]
    given = jnp.where(stuck[of], fixed(multipliers), 0) / scale[of]

    def central(z, tau, steepness):
        """A step towards the centre of what is left for (z, τ), of t τ − Σ log(τ² − ‖u_i‖²) with the steepness t."""
        u = given + N @ z
        room = jnp.where(stuck, tau**2 - sums(u**2), 1)
        by_u, by_tau = 2 * u / room[of], jnp.where(stuck, -2 * tau / room, 0)
        by_z = jnp.where(mine, by_u[:, None], 0).T @ N  # of each element
        curve_z = N.T @ (jnp.where(stuck, 2 / room, 0)[of][:, None] * N) + by_z.T @ by_z + jnp.diag(~free).astype(u.dtype)
        mixed, curve_tau = by_z.T @ by_tau, jnp.sum(by_tau**2 - jnp.where(stuck, 2 / room, 0))
        curve = jnp.block([[curve_z, mixed[:, None]], [mixed[None, :], curve_tau[None, None]]])
        slope = jnp.append(N.T @ by_u, steepness + jnp.sum(by_tau))
        step = -jnp.linalg.solve(curve, slope)
        decrement = jnp.sqrt(jnp.maximum(-slope @ step, 0))
        step = step / jnp.where(decrement > 0.25, 1 + decrement, 1)
        return z + step[:-1], tau + step[-1]

    def best():
        start = jnp.zeros_like(given), 1 + 2 * jnp.sqrt(jnp.max(sums(given**2)))
        rounds = int(-0.3 * np.log2(float(eps))) + 1
        steeper = lambda k, state: central(*state, 4.0 ** (k // STEPS))
        z, tau = jax.lax.fori_loop(0, STEPS * rounds, steeper, start)
        room = jnp.where(stuck, tau**2 - sums((given + N @ z) ** 2), 1)
        return scale[of] * (N @ z), jnp.where(stuck, 1 / room, 0)

    none = lambda: (jnp.zeros_like(given), jnp.zeros_like(scale))
    change, weight = jax.lax.cond(everywhere(~jnp.any(free)), none, best)
    weight = weight / jnp.where(jnp.sum(weight) > 0, jnp.sum(weight), 1)
    multipliers = multipliers + fixed(change)
    use = kinks.norms(multipliers)
    alone = bound - use
    together = bound * (1 - jnp.sum(weight * use / scale) / jnp.where(jnp.sum(weight) > 0, 1, 1))
    slack = jnp.where(weight > 1e-3 * jnp.max(weight), together, alone)
    return Share(multipliers, fixed(alone) + slack - fixed(slack))
