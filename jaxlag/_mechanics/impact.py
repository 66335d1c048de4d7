"""Impact: velocities that jump where contacts close.

    M (q̇⁺ − q̇⁻) = GᵀΛ + friction,   ġ⁺ + e min(ġ⁻, 0) ≥ 0,  Λ ≥ 0,  one of them zero      of the contacts that touch (Newton)
                                     ġ⁺ = 0 and a⁺ = 0                                     of all other constraints

By Poisson's law there are two such impacts, both without e: the compression, with the impulses Λᶜ, and the expansion, with Λ ≥ e Λᶜ.
Friction takes the impulses for the forces it follows: D is homogeneous in them. So the equations of an impact are those of motion, in which
q̇⁺ stands for q̈ and Λ for λ, and the laws of contact and friction are those of `contact` and `stick_slip`.
Source: Glocker, Set-Valued Force Laws, chapter 10; Pfeiffer & Glocker, Multibody Dynamics with Unilateral Contacts, chapter 8.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._model.flat import Flat, rows_by_name
from .constrained_acceleration import Impulse
from .constrained_slip import on_constraints
from .contact import (
    ROUNDING,
    Alone,
    Contacts,
    accelerated,
    begins_with_choice,
    contact_rows,
    gap_rates,
    in_contact,
    select_closed,
    turned_with,
)
from .friction_elements import FrictionElements, with_all_masses
from .friction_treatment import Regularised, StickSlip
from .lagrange import constraint_rows
from .massless import inertial_part
from .slip_direction import without_force
from .stick_slip import Friction, ModeSelection, bounds, friction, friction_by_term, select_mode

RISE = 1e-9  # of the energy exchanged, by which an impact may raise it by rounding


class Impact(NamedTuple):
    """q̇ after an impact; the impulses of the contacts; the work of each constraint and dissipation term; whether the laws of contact and
    friction have a solution; whether it takes energy and gives none; whether friction is homogeneous in the impulses it follows.
    """

    v: Float[Array, " n"]
    impulses: Float[Array, " c"]
    works: dict[str, Float[Array, ""]]
    consistent: Bool[Array, ""]
    dissipates: Bool[Array, ""]
    impulsive: Bool[Array, ""]


class Phase(NamedTuple):
    """q̇ after an impact, or after a phase of one; the impulses of the contacts; works by name; whether there is a solution, and friction is
    homogeneous; the energy that is gained, and all that is exchanged.
    """

    v: Float[Array, " n"]
    impulses: Float[Array, " c"]
    works: dict[str, Float[Array, ""]]
    consistent: Bool[Array, ""]
    impulsive: Bool[Array, ""]
    gained: Float[Array, ""]
    exchanged: Float[Array, ""]

    @property
    def found(self) -> Impact:
        """Of all that is known of it, what matters behind."""
        dissipates, impulsive = jax.lax.stop_gradient((self.gained <= RISE * self.exchanged, self.impulsive))
        return Impact(self.v, self.impulses, self.works, self.consistent, dissipates, impulsive)


def impact(flat: Flat, elements: FrictionElements | None, t, q, v, near: Bool[Array, " c"], e: Float[Array, " c"]) -> Impact:
    """The impact of the contacts that are `near`, some of which approach; `e`: their restitution.

    By Poisson's law compression, as without restitution, and then expansion, in which e of the impulses is given.
    """
    phase = of_compression(flat, t, q, v, e)
    total = _phase(flat, elements, t, q, v, near, phase)
    if any(flat.poisson):
        expansion, loose = of_expansion(flat, phase, e, total.impulses, gap_rates(flat, t, q, v))
        total = together(total, _phase(flat, elements, t, q, total.v, near, expansion, *loose))
    return total.found


def of_compression(flat: Flat, t, q, v, e: Float[Array, " c"]) -> Impulse:
    """The first phase, by Newton's law the only one: that of contacts which return with e times the rate of their approach."""
    rates = gap_rates(flat, t, q, v)
    returned = jnp.where((rates < 0) & ~np.array(flat.poisson, bool), e * rates, 0)
    return Impulse(returned, jnp.zeros_like(returned))


def of_expansion(flat: Flat, compression: Impulse, e, impulses: Float[Array, " c"], rates: Float[Array, " c"]) -> tuple[Impulse, Array]:
    """The second phase by Poisson's law; and how much of impulses and of rates is rounding: what compression leaves of rates closes no
    contact that departs as e grows.
    """
    of_poisson = np.array(flat.poisson, bool)
    little = jnp.finfo(impulses.dtype).eps ** ROUNDING
    loose = little * jax.lax.stop_gradient(jnp.where(of_poisson, jnp.stack([impulses, jnp.abs(rates)]), 0))
    return compression._replace(given=jnp.where(of_poisson, e * impulses, 0)), loose


def together(first: Phase, second: Phase) -> Phase:
    """Two phases of an impact, one after the other."""
    works = {name: first.works[name] + second.works[name] for name in first.works}
    sums = (getattr(first, name) + getattr(second, name) for name in ("gained", "exchanged"))
    both = first.consistent & second.consistent, first.impulsive & second.impulsive
    return Phase(second.v, first.impulses + second.impulses, works, *both, *sums)


def _phase(flat, elements, t, q, v, near, impulse: Impulse, loose=None, least=None) -> Phase:
    """An impact with the contacts that are `near`; what more of impulses is rounding, and what rates are at least."""
    momentum, of_impact = of_impulses(flat, elements, t, q, v, impulse)
    if of_impact is None:
        chosen = select_closed(momentum, t, q, v, near, loose, least, impulse)
        after, multipliers, _ = accelerated(in_contact(momentum, chosen.closed), t, q, v, impulse)
        return phase_behind(flat, None, t, q, v, impulse, (after, multipliers), chosen.consistent)
    everywhere, still = jnp.ones(of_impact.size, bool), jnp.zeros(of_impact.element_of_row.size, v.dtype)
    contacts = Contacts.of(momentum, t, q, v, near, loose, least, impulse)
    mode, contacts = select_mode(momentum, of_impact, t, q, v, still, everywhere, ~everywhere, contacts, impulse=impulse)
    rubbed = lambda closed, sigma: friction(closed, on_constraints(closed, of_impact, t, q, v), sigma, t, q, v, impulse=impulse)
    if begins_with_choice(momentum, of_impact):
        alone = rubbed(in_contact(momentum, jnp.zeros_like(near)), without_force(of_impact, still, everywhere))
        selection = ModeSelection(momentum, of_impact, t, q, v, still, everywhere, ~everywhere, impulse)
        mode = mode._replace(sigma=turned_with(selection, mode, contacts, Alone.of(momentum, alone)))
    found = rubbed(contacts.applied_to(momentum), mode.sigma)
    rubbing = Rubbing(elements, of_impact, mode.sigma, mode.held, found)
    return phase_behind(flat, rubbing, t, q, v, impulse, (found.qddot, found.multipliers), mode.consistent)


class Rubbing(NamedTuple):
    """Friction in an impact: its elements, those of impulses, and how it was found."""

    elements: FrictionElements
    of_impact: FrictionElements
    sigma: Float[Array, " r"]
    held: Bool[Array, " e"]
    found: Friction


def phase_behind(flat: Flat, rubbing: Rubbing | None, t, q, v, impulse: Impulse, solution: tuple, consistent) -> Phase:
    """What follows of q̇⁺ and Λ."""
    (after, multipliers), approach = solution, gap_rates(flat, t, q, v)
    lost, rubbed, impulsive = jnp.zeros((), v.dtype), {}, jnp.array(True)
    if rubbing is not None:
        elements, of_impact, sigma, held, found = rubbing
        lost = found.force @ (elements.slip(t, q, v) + elements.slip(t, q, after))
        rubbed = friction_by_term(of_impact, sigma, held, t, q, v, found)
        twice = bounds(of_impact, sigma, t, q, v, 2 * multipliers[: flat.rows] + impulse.among_rows(flat))
        impulsive = ~jnp.any(jnp.abs(twice - 2 * found.bound) > RISE * (jnp.abs(twice) + jnp.abs(found.bound)))
    impulses, departure = contact_rows(flat, multipliers) + impulse.given, gap_rates(flat, t, q, after)
    gained = impulses @ (approach + departure) + lost
    exchanged = jnp.abs(impulses) @ (jnp.abs(approach) + jnp.abs(departure))
    multipliers = multipliers[: flat.rows] + impulse.among_rows(flat)
    works = _works(flat, None if rubbing is None else rubbing.elements, t, q, (v + after) / 2, multipliers, rubbed)
    return Phase(after, impulses, works, consistent, impulsive, gained, exchanged)


def _works(flat, elements, t, q, mean, multipliers, rubbed):
    """Of each impulse, its product with the mean of the rates before and after."""
    _, G, _ = constraint_rows(in_contact(flat, jnp.ones(flat.gap_count, bool)), t, q, mean)
    works = {name: multipliers[rows] @ (G[rows] @ mean) for name, rows in rows_by_name(flat).items()}
    if elements is None:
        return works
    _, rate = jax.jvp(lambda v: elements.slip(t, q, v), (mean,), (mean,))
    return works | {name: jnp.ravel(force) @ rate[elements.rows_of_term[name]] for name, (force, _) in rubbed.items()}


def no_impact(flat: Flat, elements: FrictionElements | None, v) -> Impact:
    """That of nothing: q̇ stays as it is."""
    yes, none = jnp.array(True), jnp.zeros((), v.dtype)
    terms = {} if elements is None else elements.rows_of_term
    return Impact(v, jnp.zeros(flat.gap_count, v.dtype), {name: none for name in (*rows_by_name(flat), *terms)}, yes, yes, yes)


def check_impacts(flat: Flat, treatment: StickSlip | Regularised) -> None:
    """Refuses friction whose impulses are not solved for."""
    if not flat.needs_multipliers:
        return
    if isinstance(treatment, Regularised):
        raise ValueError(
            "`friction` must be `StickSlip()` where contacts rub, whose impacts take the impulses for the forces, but is `Regularised`. "
            "Leave it out."
        )


def of_impulses(flat: Flat, elements: FrictionElements | None, t, q, v, impulse: Impulse) -> tuple[Flat, FrictionElements | None]:
    """The system of an impact, in which no finite force has a part; and its friction, whose bounds follow impulses, and no slip."""
    if flat.massless:
        flat = inertial_part(with_all_masses(flat), t, q, v)._replace(massless=())
        elements = None if elements is None else elements._replace(massless=np.array(-1))
    if elements is None:
        return flat._replace(dissipations={}, forces={}, needs_multipliers=False), None
    given, still, nothing = impulse.among_rows(flat), jnp.zeros(elements.size, v.dtype), jnp.zeros_like(v)

    def impulsive(D):
        """D of the impulses: what does not follow them is finite, and has no part in an impact."""
        bound = lambda impulses: jax.grad(lambda u: D(t, q, v, impulses, u))(still)
        of_impact = lambda t, q, v, impulses, u: u @ (bound(impulses[: given.size] + given) - bound(jnp.zeros_like(given)))
        return _either(impulse, of_impact, D)

    potentials = {name: impulsive(D) for name, D in elements.potentials.items()}
    forces = {name: _either(impulse, lambda *_: nothing, Q) for name, Q in flat.forces.items()}
    everything = jnp.full(elements.size, jnp.finfo(v.dtype).max ** 0.5)  # friction is along the slip behind the impact
    near_rest = impulse.instead(lambda: everything, lambda: jnp.broadcast_to(elements.near_rest, everything.shape))
    return flat._replace(dissipations={}, forces=forces), elements._replace(potentials=potentials, near_rest=near_rest)


def _either(impulse: Impulse, of_impact, of_motion):
    """One function or the other."""
    return lambda *state: impulse.instead(lambda: of_impact(*state), lambda: of_motion(*state))
