"""How sticking friction elements share a load that they hold together, as the legs of a plate do.

Of all multipliers with the same effect, those that use the most loaded element least:

    min ρ   such that  ‖μ_i‖ ≤ ρ F_i,   μ = μ₀ + N z,   N a basis of {μ : Jᵀμ = 0}

ρ < 1 while some share is possible. At ρ = 1 none is any more, and the forces are along compatible slips: the limit theorem of
plasticity. Solved by a barrier method, along whose path the slips are compatible already.
Source: Moreau, Application of convex analysis to some problems of dry friction (1979); Boyd & Vandenberghe, Convex Optimization, ch. 11.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .friction_elements import FrictionElements
from .pseudo_inverse import everywhere

STEPS = 4  # of Newton's method, each time that the barrier is made four times as steep


class Share(NamedTuple):
    """Multipliers of the rows; and, per element, how much of its bound is left."""

    multipliers: Float[Array, " r"]
    margin: Float[Array, " e"]


def shared(
    elements: FrictionElements, J: Float[Array, "r n"], multipliers: Float[Array, " r"], bound: Float[Array, " e"], stuck: Bool[Array, " e"]
) -> Share:
    """The best share of those `stuck`, and how much of its bound each has left. The share itself is not differentiated, its ρ is."""
    of, eps, fixed = elements.element_of_row, jnp.finfo(bound.dtype).eps, jax.lax.stop_gradient
    largest = jnp.max(jnp.where(stuck, bound, 0), initial=0)
    scale = jnp.where(stuck & (largest > 0), jnp.maximum(bound, eps * largest), 1)
    basis, free = _without_effect(fixed(J), stuck[of])
    N, given = basis / fixed(scale)[of][:, None], fixed(jnp.where(stuck[of], multipliers, 0) / scale[of])

    def best():
        z, weight = _centre(elements, given, N, free, stuck)
        return fixed(scale)[of] * (N @ z), weight

    none = lambda: (jnp.zeros_like(given), jnp.zeros_like(scale))
    change, weight = jax.lax.cond(everywhere(~jnp.any(free)), none, best)
    multipliers = multipliers + fixed(change)
    use = elements.norms(multipliers)
    alone, together = bound - use, bound * (1 - weight @ (use / scale))
    left = jnp.where(weight > 1e-3, together, alone)
    return Share(multipliers, fixed(alone) + left - fixed(left))


def _without_effect(J, stuck):
    """A basis of {μ : Jᵀμ = 0} among the rows that are stuck, in some of its columns, the others zero; and which these are."""
    length = jnp.linalg.norm(J, axis=1)
    there = stuck & (length > 0)
    unit = jnp.where(there[:, None], J / jnp.where(length > 0, length, 1)[:, None], 0)
    values, U = jnp.linalg.eigh(unit @ unit.T + jnp.diag((~there).astype(J.dtype)))
    free = values <= jnp.finfo(J.dtype).eps ** 0.75 * values[-1]
    return jnp.where(free[None, :], U / jnp.where(length > 0, length, 1)[:, None], 0), free


def _centre(elements, given, N, free, stuck):
    """z of the least ρ with ‖u_i‖ ≤ ρ, u = given + N z; and the weight of each element in it, the derivative of ρ by ‖u_i‖.

    The minimum of t ρ − Σ log(ρ² − ‖u_i‖²) for an ever larger t, by Newton's method with steps that keep within.
    """
    of, sums = elements.element_of_row, elements.sums
    mine = of[:, None] == np.arange(elements.size)[None, :]

    def newton(k, state):
        z, rho = state
        u = given + N @ z
        room = jnp.where(stuck, rho**2 - sums(u**2), 1)
        by_u, by_rho = 2 * u / room[of], jnp.where(stuck, -2 * rho / room, 0)
        by_z = jnp.where(mine, by_u[:, None], 0).T @ N  # of each element
        curve = N.T @ (jnp.where(stuck, 2 / room, 0)[of][:, None] * N) + by_z.T @ by_z + jnp.diag((~free).astype(u.dtype))
        mixed, curve_rho = by_z.T @ by_rho, jnp.sum(by_rho**2 - jnp.where(stuck, 2 / room, 0))
        slope = jnp.append(N.T @ by_u, 4.0 ** (k // STEPS) + jnp.sum(by_rho))
        step = -jnp.linalg.solve(jnp.block([[curve, mixed[:, None]], [mixed[None, :], curve_rho[None, None]]]), slope)
        decrement = jnp.sqrt(jnp.maximum(-slope @ step, 0))
        step = step / jnp.where(decrement > 0.25, 1 + decrement, 1)
        return z + step[:-1], rho + step[-1]

    rounds = int(-0.3 * np.log2(float(jnp.finfo(given.dtype).eps))) + 1
    start = jnp.zeros_like(given), 1 + 2 * jnp.sqrt(jnp.max(sums(given**2)))
    z, rho = jax.lax.fori_loop(0, STEPS * rounds, newton, start)
    weight = jnp.where(stuck, 1 / jnp.where(stuck, rho**2 - sums((given + N @ z) ** 2), 1), 0)
    return z, weight / jnp.sum(weight)
