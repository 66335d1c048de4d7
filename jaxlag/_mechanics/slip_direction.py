"""The direction in which elements of several rows begin to slip: that of their slip rate, which their friction has a part in.

With w(σ) = ṡ where friction −F σ acts at rest, s = w(s/‖s‖) is the slip after a unit of time: the gradient, in the metric of the masses,
of the convex ½‖s − w(0)‖² + Σ F_i ‖s_i‖ is zero. Where a load rises up to the bound, the friction that held it has this direction already;
where it begins beyond the bound, as one that is switched on, it has not. It is looked for with s/√(‖s‖² + δ²), of an ever smaller δ, and
made exact by Newton's method.
Source: Moreau, Unilateral contact and dry friction in finite freedom dynamics (1988), section 8.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._program.conditions import repeated
from .._program.implicit import implicit_root, open_function
from .friction_elements import FrictionElements

ACROSS = 1e-9  # of the slip rate, what may be left of it across σ
CLEAR = 1e-6  # of that without friction, a slip rate whose direction can be made exact
CHANGE = 1e-3  # of σ, for the derivative of w, which is affine in σ but where bounds move with the multipliers
AGREES = 1e-3  # what σ and the direction of w(σ) may differ by: at the very bound w is rounding, and goes any way
SMALLEST = 0.6  # power of eps, δ relative to the scale of the slip rates in the end
SLIPS = 30  # times it, what may slip; friction at 0.9995 of its bound slips by as much
SURELY = 1e-4  # of its scale, what slips beside what breaks away, for which s is some δ^(2/3)
TURNS = 6  # of Newton's method for each δ
PARTS = 0.5 ** np.arange(6)  # of a step, of which the best is taken


def friction_and_direction(
    elements: FrictionElements,
    friction_in: Callable,
    sigma: Float[Array, " r"],
    freed: Bool[Array, " e"],
    released: Bool[Array, " e"],
    anew: Bool[Array, ""],
    breaks: Bool[Array, ""],
    free_rate: Float[Array, " e"],
) -> tuple[Any, Float[Array, " r"], Bool[Array, ""]]:
    """Friction in the mode σ, with those `freed` without a force; σ, with those as they begin to slip or stick together where all begins
    `anew`, and others that begin to slip, being `released`, turned by one step to where they go; and whether any of these was. Where one
    `breaks` away at its bound, the force that held it says more of small slip rates.

    One program of `friction_in` serves all: it runs once, and once for each row where σ is to be changed.
    """
    given, kinds = without_force(elements, sigma, freed), (freed, released, anew)
    if not np.any(elements.is_vector):
        return friction_in(given), *turned_by_rates(elements, None, sigma, None, kinds, breaks, free_rate)
    r = sigma.size

    def evaluated(carry):
        i, found, rates = carry
        other = friction_in(given + changed_row(i - 1, r, sigma.dtype))
        found = jax.tree.map(lambda new, old: jnp.where(i == 0, new, old), other, found)
        return i + 1, found, rates.at[i].set(other.slip_rate)

    going_on = lambda carry: (carry[0] <= r) & asks_for_rates(elements, carry[1], sigma, kinds, free_rate)
    nothing = jax.tree.map(lambda like: jnp.zeros(like.shape, like.dtype), jax.eval_shape(friction_in, given))
    _, found, rates = repeated(evaluated, (0, nothing, jnp.zeros((r + 1, r), sigma.dtype)), going_on)
    return found, *turned_by_rates(elements, found, sigma, rates, kinds, breaks, free_rate)


def changed_row(i, r: int, dtype: Any) -> Float[Array, " r"]:
    """By what σ is changed in row i, for the derivative of the slip rate; of no row there is no change."""
    return jnp.where(jnp.arange(r) == i, CHANGE, jnp.zeros(r, dtype))


def asks_for_rates(elements: FrictionElements, found: Any, sigma, kinds, free_rate) -> Bool[Array, ""]:
    """Whether slip rates with σ changed in each row are needed beside the friction that was `found`: where some of several rows turn."""
    if not np.any(elements.is_vector):
        return jnp.array(False)
    freed, _, anew = kinds
    begin = anew & jnp.any(freed & elements.is_vector)
    return begin | jnp.any(_turning(elements, found, sigma, kinds, free_rate))


def _turning(elements, found, sigma, kinds, free_rate):
    freed, released, _ = kinds
    along = elements.sums(sigma * found.slip_rate)
    across = elements.norms(found.slip_rate - along[elements.element_of_row] * sigma)
    off = across > ACROSS * along + 1e3 * jnp.finfo(sigma.dtype).eps * free_rate
    off = off & (along > CLEAR * free_rate) | (found.bound == 0) & (off | (along < 0))  # without a bound, it goes where it goes
    return released & ~freed & elements.is_vector & ~found.straight & off


def turned_by_rates(
    elements: FrictionElements, found: Any, sigma: Float[Array, " r"], rates, kinds: tuple, breaks: Bool[Array, ""], free_rate
) -> tuple[Float[Array, " r"], Bool[Array, ""]]:
    """σ turned, and whether any element that slips was, by the slip `rates` in σ and with each of its rows changed."""
    (freed, _, anew), of = kinds, elements.element_of_row
    if not np.any(elements.is_vector):
        return jnp.where((freed & anew)[of], 0, sigma), jnp.array(False)
    begin, w, turns = anew & jnp.any(freed & elements.is_vector), rates[0], _turning(elements, found, sigma, kinds, free_rate)
    slope = ((rates[1:] - w[None]) / CHANGE).T
    line = jnp.where(found.straight[of], jnp.abs(unit(elements, w)), 1)  # a change of σ across a line is turned along it
    slope = slope * line[None, :]
    unbound = (turns & (found.bound == 0))[of]
    turned = jnp.where(unbound, unit(elements, w), _turned(elements, sigma, w, slope, turns & (found.bound != 0)))
    begun = lambda: _begun(elements, w, slope, freed & ~found.driven & ~elements.is_quasistatic, found.bound, breaks)
    begun = jax.lax.cond(begin, begun, lambda: jnp.zeros_like(sigma))
    return jnp.where((freed & anew)[of], begun, turned), jnp.any(turns)


def without_force(elements: FrictionElements, sigma: Float[Array, " r"], freed: Bool[Array, " e"]) -> Float[Array, " r"]:
    """σ where those `freed` slip without a force, as one of next to no length has it."""
    return jnp.where(freed[elements.element_of_row], jnp.finfo(sigma.dtype).tiny ** 0.25, sigma)


def turning(elements: FrictionElements, slip_rate_in: Callable, sigma: Float[Array, " r"], begin: Bool[Array, " e"]) -> Array:
    """σ, which turns with all that `slip_rate_in(σ)` depends on where elements `begin` to slip: there it is w(σ)/‖w(σ)‖."""
    if not np.any(elements.is_vector):
        return sigma
    of, given = elements.element_of_row, jax.lax.stop_gradient(sigma)
    rate, closed_over = open_function(slip_rate_in, given)

    def residual(args, sigma):
        given, begin, *closed_over = args
        way = unit(elements, rate(sigma, *closed_over))
        agrees = elements.norms(jax.lax.stop_gradient(way) - given)[of] < AGREES
        return sigma - jnp.where((begin > 0) & agrees, way, given)

    def change(args, sigma, left):
        return -jnp.linalg.solve(jax.jacfwd(lambda sigma: residual(args, sigma))(sigma), left)

    begin = (begin & elements.is_vector & ~elements.straight)[of].astype(sigma.dtype)
    return implicit_root(residual, change, (given, begin, *closed_over), given)


def unit(elements: FrictionElements, rows: Float[Array, " r"]) -> Float[Array, " r"]:
    """The rows of each element by their length; zero where that is zero."""
    length = elements.norms(rows)[elements.element_of_row]
    return rows / jnp.where(length > 0, length, 1)


def _turned(elements, sigma, w, slope, turns):
    """σ by one step of Newton's method for s = w(s/‖s‖) in the elements that turn."""
    of, one = elements.element_of_row, jnp.eye(sigma.size, dtype=sigma.dtype)
    rows, size = turns[of], jnp.where(turns, elements.sums(sigma * w), 1)[of]
    same = (of[:, None] == of[None, :]) & rows[:, None]
    turn = (one - jnp.where(same, jnp.outer(sigma, sigma), 0)) / size[:, None]
    among = jnp.where(rows[:, None] & rows[None, :], slope, 0)
    onward = size * sigma + jnp.linalg.solve(one - among @ turn, jnp.where(rows, w - size * sigma, 0))
    return jnp.where(rows, unit(elements, onward), sigma)


def _begun(elements, w, slope, freed, bound, breaks):
    """σ of the elements that were without friction, those that stick zero: of s = w(s/√(‖s‖² + δ²)) for a small δ."""
    of, one = elements.element_of_row, jnp.eye(w.size, dtype=w.dtype)
    rows = freed[of]
    slope = jnp.where(rows[:, None] & rows[None, :], slope, 0)
    scale = elements.norms(w) + elements.norms(jnp.sqrt(jnp.sum(slope**2, axis=1)))
    of_each = jnp.where(scale > 0, scale, 1)[of]
    slope, w = slope / of_each[:, None], jnp.where(rows, w, 0) / of_each
    same = of[:, None] == of[None, :]

    halvings = int(-SMALLEST * np.log2(float(jnp.finfo(w.dtype).eps))) + 1

    def residual(s, delta):
        length = jnp.sqrt(elements.sums(s**2) + delta**2)[of]
        return s - w - slope @ (s / length), s / length, length

    def newton(i, s):
        delta = 0.5 ** (i // TURNS)
        left, sigma, length = residual(s, delta)
        turn = (one - jnp.where(same, jnp.outer(sigma, sigma), 0)) / length[:, None]
        step = jnp.linalg.solve(one - slope @ turn, left)
        tried = s[None] - jnp.multiply.outer(PARTS.astype(s.dtype), step)
        return tried[jnp.argmin(jax.vmap(lambda s: jnp.sum(residual(s, delta)[0] ** 2))(tried))]

    s = jax.lax.fori_loop(0, TURNS * halvings, newton, w)
    least = jnp.where(breaks, SURELY, SLIPS * 0.5**halvings)
    slips = (elements.norms(s) > least) | (bound == 0)  # without a bound, it holds nothing
    return jnp.where((freed & slips)[of], unit(elements, s), 0)
