"""Forces of contacts and dry friction together, with all else condensed: what closes, what sticks, and which way the rest slips.

    w = W Λ + b,     0 ≤ Λ_n ⊥ w_n ≥ 0,     ‖Λ_t‖ ≤ F(Λ),  and  Λ_t = −F w_t/‖w_t‖  where w_t ≠ 0

W = A M⁻¹ Aᵀ, with the bilateral constraints condensed, for the rows A of gaps and slips; w: accelerations, or velocities behind an impact.
The natural map, whose zero is the solution, is brought to zero by Newton's method; where that fails, from nearer by, after ever more plain
iterations of the map.
Source: Alart & Curnier, Comput. Methods Appl. Mech. Eng. 92 (1991) 353; Acary, Brémond & Huber, On solving contact problems with Coulomb
friction (2018).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._program.implicit import implicit_root, open_function, undifferentiated
from .friction_elements import FrictionElements
from .slip_direction import unit

TURNS = 20  # of Newton's method: five on the average, and 12 for two contacts at most
ROUNDS = 6  # of plain iterations, each three times as many as before
SOLVED = 0.6  # power of eps, what is left of the map relative to b
PARTS = 0.5 ** np.arange(7)  # of a step, of which the best is taken
CLOSER = 4  # steps of Newton's method where all directions are known: one, but for bounds that are not proportional to forces
BREAKS = 1e-7  # of its bound, by how much it is lowered where an element is known to break away


class Problem(NamedTuple):
    """W and b, gaps first; `candidates` for closing; the elements of friction; F(Λ); which elements are `at_rest`, the others slip
    along σ; which of those at rest are known to break away.
    """

    W: Float[Array, "k k"]
    b: Float[Array, " k"]
    candidates: Bool[Array, " c"]
    elements: FrictionElements
    bound: Callable[[Float[Array, " k"]], Float[Array, " e"]]
    at_rest: Bool[Array, " e"]
    breaking: Bool[Array, " e"]
    sigma: Float[Array, " r"]
    rounding: Float[Array, " c"]  # of the w of gaps: what departs by no more stays closed


class Choice(NamedTuple):
    """Which contacts are closed, σ, and slip rates that count as large; whether a solution was found."""

    closed: Bool[Array, " c"]
    sigma: Float[Array, " r"]
    scale: Float[Array, " e"]
    found: Bool[Array, ""]


def choice(problem: Problem) -> Choice:
    """That of the first solution which is found."""
    scaled, units = _scaled(problem)
    forces, found = _solution(scaled)
    normal, pull, size, limit = _projected(scaled, forces)
    elements, of = problem.elements, problem.elements.element_of_row
    slips = ~problem.at_rest | (size > limit)
    way = jnp.where(problem.at_rest[of], -unit(elements, pull), problem.sigma)
    b, tangential = jnp.abs(problem.b), units[normal.size :]
    rates = (b + jnp.abs(problem.W) @ jnp.concatenate([normal / units[: normal.size], jnp.zeros_like(tangential)]))[normal.size :]
    departs = (problem.W @ (forces / units) + problem.b)[: normal.size] > problem.rounding
    return Choice(problem.candidates & ~departs, jnp.where(slips[of], way, 0), elements.norms(rates), found)


def turning(problem: Problem, closed: Bool[Array, " c"], sigma: Float[Array, " r"], begins: Bool[Array, " e"]) -> Float[Array, " r"]:
    """σ of a solution, which in elements where slip `begins` is that of w_t, and turns with all that the problem depends on."""
    scaled, _ = _scaled(problem._replace(breaking=jnp.zeros_like(problem.breaking)))
    elements, of, contacts = problem.elements, problem.elements.element_of_row, closed.size
    slips, turns = (elements.norms(sigma) > 0)[of], (begins & problem.at_rest)[of]
    given = jnp.where(problem.at_rest[of], jax.lax.stop_gradient(sigma), problem.sigma)

    def way(w):
        slip = w[contacts:]
        return jnp.where(turns & (elements.norms(slip) > 0)[of], unit(elements, slip), given)

    def residual(forces, way):
        w = scaled.W @ forces + scaled.b
        of_slip = jnp.where(slips, forces[contacts:] + scaled.bound(forces)[of] * way(w), w[contacts:])
        return jnp.concatenate([jnp.where(closed, w[:contacts], forces[:contacts]), of_slip])

    def step(slope, left):
        little = jnp.finfo(left.dtype).eps ** 0.9 * jnp.eye(left.size, dtype=left.dtype)  # of forces that are shared any share will do
        return -jnp.linalg.solve(slope + little, left)

    def found(forces):
        along = lambda forces: residual(forces, lambda _: given)
        return jax.lax.fori_loop(0, CLOSER, lambda _, x: x + step(jax.jacfwd(along)(x), along(x)), forces)

    nothing = jnp.zeros_like(problem.b)
    opened, within = open_function(lambda forces: residual(forces, way), nothing)
    change = lambda within, forces, left: step(jax.jacfwd(lambda forces: opened(forces, *within))(forces), left)
    forces = implicit_root(lambda within, forces: opened(forces, *within), change, within, undifferentiated(found)(nothing))
    return jnp.where(turns, way(scaled.W @ forces + scaled.b), sigma)


def _scaled(problem: Problem) -> tuple[Problem, Float[Array, " k"]]:
    """In units in which W is of order one, the same for all directions of an element, so that discs stay round; and these units."""
    of, contacts = problem.elements.element_of_row, problem.candidates.size
    diagonal = jnp.diagonal(problem.W)
    of_elements = problem.elements.sums(diagonal[contacts:])
    squared = jnp.concatenate([diagonal[:contacts], of_elements[of]])
    units = jnp.sqrt(jnp.where(squared > 0, squared, 1))
    b = problem.b / units
    largest = jnp.max(jnp.abs(b), initial=0.0)
    one = jnp.where(largest > 0, largest, 1)
    of_bound = jnp.sqrt(jnp.where(of_elements > 0, of_elements, 1)) / one * jnp.where(problem.breaking, 1 - BREAKS, 1)
    bound = lambda forces: jnp.maximum(problem.bound(forces * one / units), 0) * of_bound
    return problem._replace(W=problem.W / jnp.outer(units, units), b=b / one, bound=bound), units / one


def _projected(problem: Problem, forces: Float[Array, " k"]) -> tuple[Array, Array, Array, Array]:
    """Of the forces after a step against w: those of contacts, which push; of elements, before they are bounded, ‖·‖, and the bounds."""
    contacts, (_, b, candidates, elements, bound, *_) = problem.candidates.size, problem
    onward = forces - (problem.W @ forces + b)
    normal = jnp.where(candidates, jnp.maximum(onward[:contacts], 0), 0)
    pull = onward[contacts:]
    limit = bound(jnp.concatenate([normal, forces[contacts:]]))
    return normal, pull, elements.norms(pull), limit


def _map(problem: Problem, forces: Float[Array, " k"]) -> Float[Array, " k"]:
    """What is zero in the solution."""
    normal, pull, size, limit = _projected(problem, forces)
    of, slips = problem.elements.element_of_row, size > limit
    resting = jnp.where(slips[of], pull * (limit / jnp.where(slips, size, 1))[of], pull)
    tangential = jnp.where(problem.at_rest[of], resting, -limit[of] * problem.sigma)
    return forces - jnp.concatenate([normal, tangential])


def _solution(problem: Problem) -> tuple[Float[Array, " k"], Bool[Array, ""]]:
    """Of a scaled problem; and whether it was found."""
    left = lambda forces: _map(problem, forces)
    eps, one = jnp.finfo(problem.b.dtype).eps, jnp.eye(problem.b.size, dtype=problem.b.dtype)
    size = lambda r: jnp.max(jnp.abs(r), initial=0.0)
    plainly = 1 / jnp.maximum(size(jnp.sum(jnp.abs(problem.W), axis=1)), 1)
    plain = lambda forces: forces - plainly * left(forces)

    def newton(carry):
        forces, r, _, i = carry
        step = jnp.linalg.solve(jax.jacfwd(left)(forces) + eps**0.6 * one, -r)
        tried = forces[None] + jnp.multiply.outer(PARTS.astype(r.dtype), jnp.where(jnp.isfinite(step), step, 0))
        remain = jax.vmap(left)(tried)
        best = jnp.argmin(jnp.sum(remain**2, axis=1))
        better = size(remain[best]) < (1 - 1e-6) * size(r)
        return jnp.where(better, tried[best], forces), jnp.where(better, remain[best], r), better, i + 1

    def turn(carry):
        start, *_, i = carry
        start = jax.lax.fori_loop(0, jnp.where(i > 0, 3**i, 0), lambda _, forces: plain(forces), start)
        going_on = lambda carry: carry[2] & (carry[3] < TURNS) & (size(carry[1]) > 4 * eps)
        forces, r, *_ = jax.lax.while_loop(going_on, newton, (start, left(start), jnp.array(True), jnp.array(0)))
        return start, forces, size(r) <= eps**SOLVED, i + 1

    nothing = jnp.zeros_like(problem.b)
    unsolved: Any = (nothing, nothing, jnp.array(False), jnp.array(0))
    _, forces, found, _ = jax.lax.while_loop(lambda carry: ~carry[2] & (carry[3] <= ROUNDS), turn, unsolved)
    return forces, found
