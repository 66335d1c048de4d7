"""Dry friction: the modes of sliding and sticking, and how long each lasts.

    slipping  σ = ±1 (or the direction of slip):  D(u) with u = ‖s‖, smooth;  force −F s/‖s‖, F = ∂D/∂u
    sticking  σ = 0:                              s = 0, a nonholonomic constraint;  force μ, its multiplier, ‖μ‖ ≤ F

In each mode the system is an ordinary one, so the rest of the package need not know of friction.
Source: Pfeiffer & Glocker, Multibody Dynamics with Unilateral Contacts, chapters 5 and 6.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._model.numbers import count, number
from .._model.system import Flat
from .friction_terms import Kinks, kinks_of
from .load_sharing import shared
from .saddle_point import constrained_acceleration


def in_mode(flat: Flat, kinks: Kinks, sigma: Float[Array, " r"]) -> Flat:
    """The system in one mode: D with ‖s‖ = σ·s where it slips, and s = 0 among the constraints where it sticks."""
    stuck = sticking(kinks, sigma)
    extent = lambda t, q, v: _extent(kinks, sigma, kinks.slip(t, q, v))

    def slipping(D):
        return lambda t, q, v, multipliers: D(t, q, v, multipliers, extent(t, q, v))

    def nonholonomic(t, q, v):
        held = jnp.where(stuck[kinks.element_of_row], kinks.slip(t, q, v), 0)
        return jnp.concatenate([flat.nonholonomic(t, q, v), held])

    held = {name: flat.rows + rows for name, rows in kinks.own_rows.items()}
    return flat._replace(dissipations={name: slipping(D) for name, D in kinks.lifted.items()}, nonholonomic=nonholonomic, held=held)


def sticking(kinks: Kinks, sigma: Float[Array, " r"]) -> Bool[Array, " e"]:
    """Which elements stick."""
    return kinks.norms(sigma) == 0


def _extent(kinks, sigma, slip):
    """u = ‖s‖ of each element: σ s for a single row, which goes on smoothly through s = 0; of several rows σ·s near rest alone."""
    along, norm = kinks.sums(sigma * slip), kinks.norms(slip)
    near_rest = norm <= jnp.maximum(kinks.near_rest, jnp.finfo(slip.dtype).tiny ** 0.25)
    return jnp.where(sticking(kinks, sigma), 0, jnp.where(kinks.several & ~near_rest, norm, along))


class Friction(NamedTuple):
    """At one state in one mode: acceleration and multipliers; force and rate of the slip over the rows; bound, and how far from its end
    the mode is, per element, were each free to slip.
    """

    qddot: Float[Array, " n"]
    multipliers: Float[Array, " m"]
    force: Float[Array, " r"]
    slip_rate: Float[Array, " r"]
    bound: Float[Array, " e"]
    margin: Float[Array, " e"]


def friction(flat: Flat, kinks: Kinks, sigma, t, q, v, feedback=None) -> Friction:
    """Friction forces on the slip velocities; `margin` < 0 where the mode has ended: the slip reversed, or the bound exceeded."""
    stuck, of = sticking(kinks, sigma), kinks.element_of_row
    qddot, multipliers, _ = constrained_acceleration(in_mode(flat, kinks, sigma), t, q, v, feedback)
    slip, slip_rate = jax.jvp(kinks.slip, (t, q, v), (jnp.ones_like(t), v, qddot))
    total = lambda u: sum(D(t, q, v, multipliers, u) for D in kinks.lifted.values())
    extent, pull = jax.vjp(lambda slip: _extent(kinks, sigma, slip), slip)
    bound = jax.grad(total)(extent)
    held = multipliers[flat.rows :]
    left = bound - kinks.norms(held)
    if kinks.are_shared:
        held, left = shared(kinks, jax.jacfwd(kinks.slip, argnums=2)(t, q, v), held, bound, stuck)
    force = jnp.where(stuck[of], held, -pull(bound)[0])
    going = kinks.sums(sigma * slip) + 1e-6 * kinks.near_rest
    margin = jnp.where(stuck, left + 1e2 * jnp.finfo(v.dtype).eps * jnp.abs(bound), going)
    return Friction(qddot, multipliers, force, slip_rate, bound, margin)


class Mode(NamedTuple):
    """A mode σ; which elements stand still at their bound, because others hold them; whether the forces agree with it; the bounds."""

    sigma: Float[Array, " r"]
    held: Bool[Array, " e"]
    consistent: Bool[Array, ""]
    bound: Float[Array, " e"]


class _Search(NamedTuple):
    """How far the search for a mode has come; slip rates without friction, by which others are judged."""

    stage: Any
    mode: Mode
    clearly: Bool[Array, " e"]  # broken away, and not by rounding
    free_rate: Float[Array, " e"]


LOOSE, FIRST, NEXT, HOLD, DONE = range(5)  # stages of the search


def settle(flat: Flat, kinks: Kinks, t, q, v, sigma, at_rest: Bool[Array, " e"], breaking: Bool[Array, " e"]) -> Mode:
    """The mode that follows where the elements `at_rest` have no slip; the others slip on along σ.

    All at rest stick, but those `breaking` away at their bound. One after the other, the one farthest beyond its bound slips against its
    force, and one that would set off backwards sticks again, until none is beyond and none goes backwards. Of dependent elements some
    may be at their bound while others hold them: of the shares that are possible that is one, and the motion is the same for all.
    """
    of = kinks.element_of_row
    t, q, v = jax.lax.stop_gradient((t, q, v))
    loose = jnp.finfo(v.dtype).tiny ** 0.25  # a σ of this length slips without a force
    no = jnp.zeros(kinks.elements, bool)

    def turn(search):
        mode, stage = search.mode, search.stage
        released = at_rest & ~sticking(kinks, mode.sigma)
        freed = jnp.where(stage == LOOSE, at_rest, released & (stage == HOLD))
        found = jax.lax.stop_gradient(friction(flat, kinks, jnp.where(freed[of], loose, mode.sigma), t, q, v))
        rate = kinks.norms(found.slip_rate)

        over = jnp.where(sticking(kinks, mode.sigma), -found.margin, -jnp.inf)
        beyond = _greatest(over, over > 0)
        backwards = -kinks.sums(found.slip_rate * mode.sigma)
        returning = _greatest(backwards, released & (backwards > jnp.where(search.clearly, 0, 1e-6 * search.free_rate)))
        torn = _torn(kinks, t, q, v, found, search.free_rate, over > -jnp.inf) & ~jnp.any(beyond)
        along = (over > -1e-6 * jnp.abs(found.bound)) & kinks.are_shared  # those of a share break away together
        leaving = jnp.where((stage == FIRST) & jnp.any(breaking), breaking | along, beyond | torn)
        returning = returning & ~jnp.any(leaving)
        way = jnp.where((beyond | breaking | along)[of], -found.force, found.slip_rate)
        size = kinks.norms(way)[of]
        sigma = jnp.where(leaving[of], way / jnp.where(size > 0, size, 1), jnp.where(returning[of], 0, mode.sigma))
        clearly = (search.clearly | (leaving & (over > 1e-6 * jnp.abs(found.bound)))) & ~returning
        settled = ~jnp.any(leaving | returning)
        agrees = settled & jnp.all(jnp.isfinite(found.force))

        within = (stage == FIRST) | (stage == NEXT)
        return _Search(
            jnp.where(within, jnp.where(settled, HOLD, NEXT), jnp.where(stage == LOOSE, FIRST, DONE)),
            Mode(
                jnp.where(within, sigma, mode.sigma),
                jnp.where(stage == HOLD, released & (rate <= 1e-6 * search.free_rate), mode.held),
                jnp.where(within, agrees, mode.consistent),
                jnp.where(within, found.bound, mode.bound),
            ),
            jnp.where(within, clearly, search.clearly),
            jnp.where(stage == LOOSE, rate, search.free_rate),
        )

    nothing = jnp.zeros(kinks.elements, v.dtype)
    resting = jax.lax.stop_gradient(jnp.where(at_rest[of], 0, sigma))
    start = _Search(jnp.array(LOOSE), Mode(resting, no, jnp.array(False), nothing), no, nothing)
    needed = lambda _, search: jax.lax.cond(search.stage == DONE, lambda search: search, turn, search)
    return jax.lax.fori_loop(0, 4 * kinks.elements + 6, needed, start).mode


def _greatest(x, among):
    """The one entry that is greatest among some, if there are any."""
    return among & (jnp.arange(x.size) == jnp.argmax(jnp.where(among, x, -jnp.inf)))


def _torn(kinks, t, q, v, found, free_rate, stuck):
    """Of elements that cannot stick together, as on belts that part, the one farthest from its rest."""
    _, drift = jax.jvp(lambda t, q: kinks.slip(t, q, v), (t, q), (jnp.ones_like(t), v))
    most, rate = jnp.max(kinks.norms(drift), initial=0.0), kinks.norms(found.slip_rate)
    return _greatest(rate, stuck & (rate > 1e-6 * most) & (rate > 1e-9 * free_rate) & (most > 0))


def first_mode(flat: Flat, kinks: Kinks, t, q, v) -> Mode:
    """The mode at a start: what moves slips along its motion; what rests sticks, or breaks away."""
    slip = jax.lax.stop_gradient(kinks.slip(t, q, v))
    size = kinks.norms(slip)
    at_rest = size <= slip_of(kinks, t, q, v, 1e2 * jnp.finfo(v.dtype).eps * jnp.abs(v))
    sigma = slip / jnp.where(at_rest, 1, size)[kinks.element_of_row]
    return settle(flat, kinks, t, q, v, sigma, at_rest, jnp.zeros_like(at_rest))


def slip_of(kinks: Kinks, t, q, v, errors: Float[Array, " n"]) -> Float[Array, " e"]:
    """How much slip errors of the velocities come to, per element: each in its own units."""
    return kinks.norms(jnp.abs(jax.jacfwd(kinks.slip, argnums=2)(t, q, v)) @ errors)


def redirected(kinks: Kinks, sigma, held, t, q, v):
    """σ of the slipping elements of several rows, turned along with their motion."""
    of, slip = kinks.element_of_row, kinks.slip(t, q, v)
    several, size = kinks.several, kinks.norms(slip)
    turns = (several & (size > slip_of(kinks, t, q, v, jnp.finfo(v.dtype).eps * jnp.abs(v))) & ~sticking(kinks, sigma) & ~held)[of]
    return jnp.where(turns, slip / jnp.where(turns, size[of], 1), sigma) if np.any(several) else sigma


def friction_by_term(kinks: Kinks, sigma, held, t, q, v, found: Friction) -> dict[str, tuple[Array, Array]]:
    """Force on each slip velocity and whether it sticks, by dissipation term. Where several terms rub on one slip velocity, each has
    its share of the force by its bound.
    """
    of, stuck = kinks.element_of_row, sticking(kinks, sigma) | held
    extent, forces = _extent(kinks, sigma, kinks.slip(t, q, v)), {}
    for name, rows in kinks.rows_of_term.items():
        bound = jax.grad(lambda u, D=kinks.lifted[name]: D(t, q, v, found.multipliers, u))(extent)
        share = bound / jnp.where(found.bound != 0, found.bound, 1)
        shape = () if rows.size == 1 else (rows.size,)
        forces[name] = (share[of[rows]] * found.force[rows]).reshape(shape), stuck[of[rows]].reshape(shape)
    return forces


@dataclasses.dataclass(frozen=True)
class StickSlip:
    """Dry friction as it is: exact sticking, exact stopping, breaking away at the bound. The default.

    Each kink μN|s| of D slips with the force −μN sign(s), sticks as a constraint s = 0 with a multiplier of its own while that is
    within ±μN, and the times at which it changes from one to the other are located to rounding and differentiated.

    Where elements hold a load that they can share in more than one way, as the legs of a plate, they hold it as long as one way is
    possible, and the motion is the same for all. The forces reported are then one of them: of slip velocities of several components that
    which uses the most loaded element least, of others those of least norm until one is at its bound. They are not differentiated so.

    **Arguments:** `max_transitions`: changes of mode after which the motion is given up as chattering.

    **Source:** Pfeiffer & Glocker, Multibody Dynamics with Unilateral Contacts, chapters 5 and 6; of shares Moreau, Application of
    convex analysis to some problems of dry friction (1979).

    ```python
    import jaxlag as jl
    jl.StickSlip(max_transitions=100)
    ```
    """

    max_transitions: int = 10_000

    def __post_init__(self):
        count(self.max_transitions, "`max_transitions`", least=0, cure="The default is 10_000.")


@dataclasses.dataclass(frozen=True)
class Regularised:
    """Dry friction made smooth: |s| becomes √(s² + w²) − w, of force −F s/√(s² + w²).

    It cannot hold a load: under a force f < F it creeps with the velocity w f/√(F² − f²), that is w/√3 at half the bound. And it makes the
    equations stiff, with a time constant of m w/F.

    **Arguments:** `width`: the velocity w, in the units of s.

    **Source:** Armstrong-Hélouvry, Dupont & Canudas de Wit, Automatica 30 (1994) 1083-1138.

    ```python
    import jaxlag as jl
    jl.Regularised(width=1e-4)
    ```
    """

    width: float

    def __post_init__(self):
        width = number(self.width, "`width`", positive=True, cure="Take some thousandths of the velocities that occur.")
        object.__setattr__(self, "width", float(width))

    def smooth(self, flat: Flat, kinks: Kinks) -> Flat:
        """The system with smooth friction."""

        def extent(t, q, v):
            return jnp.sqrt(kinks.sums(kinks.slip(t, q, v) ** 2) + self.width**2) - self.width

        def smoothed(D):
            return lambda t, q, v, multipliers: D(t, q, v, multipliers, extent(t, q, v))

        return flat._replace(dissipations={name: smoothed(D) for name, D in kinks.lifted.items()})


def settled(flat: Flat, t, q, v) -> Flat:
    """The system in the mode that holds at this state; without dry friction the system as it is."""
    kinks = kinks_of(flat, t, q, v)
    return flat if kinks is None else in_mode(flat, kinks, first_mode(flat, kinks, t, q, v).sigma)
