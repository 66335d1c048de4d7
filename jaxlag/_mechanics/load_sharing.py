"""How constraints and sticking friction share a load that they hold together, as the legs of a plate do, or a ladder's ends.

Of all multipliers x = (λ, μ) with the same effect, those that leave most of the bounds, which may move with the share, F(λ):

    max s   such that  ‖μ_i‖ ≤ F_i(λ) − s f_i,   λ_j ≥ s f_j of contacts,   x = x₀ + N z,   N a basis of all x without effect

f_i is the size of the bound, of a constant one F_i itself. s > 0 while some share is possible; at s = 0 none is any more, and where the
bounds are constant the forces are along compatible slips: the limit theorem of plasticity. A problem of linear and second-order cones,
solved by a barrier method. |λ| of a constraint that pushes and pulls is not concave: its sign is that of the share with the least
friction, and after it that of the share that was found.
Source: Moreau, Application of convex analysis to some problems of dry friction (1979); Boyd & Vandenberghe, Convex Optimization, ch. 11;
for bounds that move with the share Lobo et al., Applications of second-order cone programming, Linear Algebra Appl. 284 (1998) 193.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._model.flat import Flat
from .._program.implicit import undifferentiated
from .._program.shifted_factors import inverse_lengths
from .friction_elements import FrictionElements
from .lagrange import applied_force, constraint_rows, inertia

STEPS = 4  # of Newton's method, each time that the barrier is made four times as steep
LINEARISED = 4  # times at most, bounds that move: in 350 random grasps with |λ| once was enough, but for one
REACH = 1e3  # of the load, how large forces may be that hold each other


class Share(NamedTuple):
    """Multipliers of all rows; and, per element, how much of its bound is left."""

    multipliers: Float[Array, " m"]
    margin: Float[Array, " e"]


class _Found(NamedTuple):
    """A change without effect; of each constraint and element its scale and its weight, the derivative of s by the slack it has; and s."""

    change: Float[Array, " m"]
    scale: Float[Array, " k"]
    weight: Float[Array, " k"]
    s: Float[Array, ""]


def may_share(flat: Flat, elements: FrictionElements) -> bool:
    """Whether more than one share may be admissible, and matter: of elements of several rows; or where bounds move with the multipliers,
    unless there is one constraint with one element of friction, of which it leaves what it does not hold itself.
    """
    return elements.are_shared or (flat.needs_multipliers and flat.rows + elements.size > 2)


def shared(mode: Flat, elements: FrictionElements, t, q, v, multipliers: Float[Array, " m"], bounds: Callable, stuck) -> Share:
    """The best share in a `mode`, with `bounds` of the multipliers, of the elements `stuck`, and how much of their bounds it leaves."""
    pushes, holds = jnp.zeros(mode.rows, bool), jnp.ones(multipliers.size, bool)
    if mode.closed is not None:
        contacts = mode.rows_of_bilateral + np.arange(mode.closed.size)
        pushes, holds = pushes.at[contacts].set(mode.closed), holds.at[contacts].set(mode.closed)
    effect, mass = constraint_rows(mode, t, q, v)[1], jnp.diagonal(inertia(mode, t, q, v).as_matrix())
    if mode.needs_multipliers:  # the friction of what slips included
        effect = effect + jax.jacfwd(lambda x: applied_force(mode, t, q, v, x))(multipliers).T
    effect = jnp.where(holds[:, None], effect, 0)  # what is open has no force, whatever its friction would do
    effect = jax.lax.stop_gradient(effect / jnp.sqrt(jnp.where(mass > 0, mass, 1))[None, :])  # no unit of a coordinate is left
    return best_share(elements, effect, multipliers, bounds, jnp.concatenate([pushes, stuck]), LINEARISED if mode.needs_multipliers else 1)


def best_share(
    elements: FrictionElements, effect: Float[Array, "m n"], multipliers: Float[Array, " m"], bounds: Callable, there, rounds: int
) -> Share:
    """The best share of multipliers with this `effect`, in at most so many `rounds`; `there`, which constraints push and which elements
    stick. The share itself is not differentiated, its s is.
    """
    constraints = there.size - elements.size

    def room(x):
        return jnp.concatenate([x[:constraints], bounds(x)])

    def search(effect, multipliers, there):
        most = jnp.where(_may_depend(effect), rounds, 0)
        none = jnp.zeros(there.size, effect.dtype)
        better = lambda carry: (carry[0] + 1, _improved(elements, effect, multipliers, room, there, *carry))
        nothing = _Found(jnp.zeros_like(multipliers), none, none, jnp.full_like(none, -jnp.inf, shape=()))
        return jax.lax.while_loop(lambda carry: (carry[0] < most) & (carry[1].s < 0), better, (0, nothing))[1]

    change, scale, weight, _ = undifferentiated(search, in_turn=True)(effect, multipliers, there)
    multipliers = multipliers + change
    alone = room(multipliers) - jnp.append(jnp.zeros(constraints, effect.dtype), elements.norms(multipliers[constraints:]))
    s = weight @ (alone / jnp.where(scale > 0, scale, 1))
    left = jnp.where(weight > 1e-3, scale * s, alone)
    slope = jnp.where(there, left, 0)[:constraints] - jnp.where(there, alone, 0)[:constraints]  # so that openings are located
    return Share(multipliers.at[:constraints].add(slope - jax.lax.stop_gradient(slope)), left[constraints:])


def _unit_rows(rows):
    """Rows of length 1, and the lengths they had, 1 for rows of zeros."""
    squared = jnp.sum(rows**2, axis=1)
    length = jnp.sqrt(jnp.where(squared > 0, squared, 1))
    return rows / length[:, None], length


def _may_depend(rows):
    """Whether rows may depend on each other: an eigenvalue of their products, the square of a singular value, is below √eps."""
    unit, _ = _unit_rows(rows)
    shift = len(rows) * jnp.finfo(rows.dtype).eps ** 0.5
    return ~jnp.all(jnp.diagonal(jnp.linalg.cholesky(unit @ unit.T + jnp.diag(jnp.all(rows == 0, axis=1) - shift))) > 0)


def _improved(elements, rows, multipliers, room, there, turn, found: _Found) -> _Found:
    """The best share with the bounds linearised at the one found before, at first at that of the least friction."""
    constraints, of, m = there.size - elements.size, elements.element_of_row, multipliers.size
    pushes, takes_part = there[:constraints], jnp.append(jnp.ones(constraints, bool), there[constraints:][of])
    unit, length = _unit_rows(jnp.where(takes_part[:, None], rows, 0))
    load = jnp.linalg.norm(multipliers @ rows)
    alone = jnp.where(jnp.any(unit != 0, axis=1), load / length, 0)  # what each is where it holds the load alone
    N = _without_effect(unit) * alone[:, None]
    friction = jnp.where((jnp.arange(m) >= constraints) & (alone > 0), 1 / jnp.where(alone > 0, alone, 1), 0)
    rubbing = friction[:, None] * jnp.append(N, multipliers[:, None], axis=1)
    squares = rubbing.T @ rubbing
    at = multipliers + jnp.where(turn == 0, -N @ _solved(squares[:m, :m], squares[:m, m]), found.change)
    at = jnp.where(jnp.append(pushes, jnp.zeros(m - constraints, bool)), jnp.maximum(at, 1e-3 * alone), at)

    slope, given = jax.jacfwd(lambda x: (room(x),) * 2, has_aux=True)(at)
    constant = given - slope @ at
    scale = jnp.where(there, jnp.abs(constant) + jnp.abs(slope) @ alone, 0)
    scale = jnp.maximum(scale, jnp.finfo(scale.dtype).eps * jnp.max(scale))
    scale = jnp.where(there & (scale > 0), scale, 1)
    reach = REACH * (1 + jnp.abs(constant)[constraints:][of] @ jnp.where(takes_part, friction, 0)[constraints:])
    sides = jnp.concatenate([slope, jnp.eye(m, dtype=N.dtype)[constraints:]]) @ jnp.append(N, multipliers[:, None], axis=1)
    sides = sides.at[: there.size, m].add(constant) / jnp.append(scale, scale[constraints:][of])[:, None]
    z, s, weight = _centre(sides, np.append(np.arange(there.size), constraints + of), there, reach)
    return _Found(N @ z, scale, weight, s)


def _without_effect(unit):
    """A basis of {x : rowsᵀx = 0} among rows that are not zero, in some of its columns, the others zero."""
    none = jnp.all(unit == 0, axis=1)
    U, values, _ = jnp.linalg.svd(jnp.append(unit, jnp.diag(none.astype(unit.dtype)), axis=1), full_matrices=False)
    left_out = none[:, None] | (values > jnp.finfo(unit.dtype).eps ** 0.375 * values[0])[None, :]
    return jnp.where(left_out, 0, U)


def _solved(H, b):
    """H⁻¹b of a symmetric H, not negative but for rounding; zero where it has zeros."""
    size = jnp.diagonal(H)
    D, _ = inverse_lengths(size, 0)
    ridge = 10 * len(b) * jnp.finfo(b.dtype).eps + (size <= 0)
    factor = jnp.linalg.cholesky(H * jnp.outer(D, D) + jnp.diag(ridge))
    return D * jax.scipy.linalg.cho_solve((factor, True), D * b)


def _centre(sides, cone_of, there, reach):
    """z of the greatest s with ‖u + U z‖ ≤ a + A z − s in each of some cones `there`, and ‖z‖ ≤ reach (1 − s); s; the weight of each cone.

    `sides`: rows (A, a) of the cones, and then rows (U, u), each of one cone. The maximum of t s + Σ log((a + A z − s)² − ‖u + U z‖²) for
    an ever larger t, by Newton's method with steps that keep within.
    """
    d, k = sides.shape[1] - 1, there.size
    sides = jnp.concatenate([sides, jnp.diag(1 / jnp.append(jnp.full(d, reach), 1))])
    cone_of, is_left = np.append(cone_of, np.full(d + 1, k)), np.isin(np.arange(len(sides)), [*range(k), len(sides) - 1])
    form = np.where(cone_of == np.arange(k + 1)[:, None], np.where(is_left, 1.0, -1.0), 0.0)
    form, there = jnp.where(jnp.append(there, True)[:, None], form, 0).astype(sides.dtype), jnp.append(there, True)
    E = jnp.append(sides[:, :d], -is_left[:, None].astype(sides.dtype), axis=1)
    rounds = int(-0.3 * np.log2(float(jnp.finfo(sides.dtype).eps))) + 1

    def newton(carry):
        i, w = carry
        y = sides[:, d] + E @ w
        room = jnp.where(there, form @ y**2, 1)
        slope = 2 * (form / room[:, None] * y[None, :]) @ E
        curve = slope.T @ slope - 2 * E.T @ (jnp.sum(form / room[:, None], axis=0)[:, None] * E)
        gradient = jnp.sum(slope, axis=0) + 4.0 ** (i // STEPS) * (np.arange(d + 1) == d)
        step = _solved(curve, gradient)
        decrement = jnp.sqrt(jnp.maximum(gradient @ step, 0))
        return i + 1, w + step / jnp.where(decrement > 0.25, 1 + decrement, 1)

    u = jnp.sqrt(form @ jnp.where(is_left, 0, -(sides[:, d] ** 2)))
    start = jnp.min(jnp.where(there, jnp.where(form > 0, sides[None, :, d], 0).sum(1) - 2 * u, jnp.inf)) - 1
    _, w = jax.lax.while_loop(lambda carry: carry[0] < STEPS * rounds, newton, (0, jnp.zeros(d + 1, sides.dtype).at[d].set(start)))
    y = sides[:, d] + E @ w
    weight = (form > 0) @ jnp.where(is_left, y, 0) / jnp.where(there, form @ y**2, 1)
    weight = jnp.where(there, weight, 0)
    return w[:d], w[d], weight[:k] / jnp.sum(weight)
