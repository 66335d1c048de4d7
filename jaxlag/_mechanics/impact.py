"""Impact: velocities that jump where contacts close.

    M (q̇⁺ − q̇⁻) = GᵀΛ + friction,   ġ⁺ + e min(ġ⁻, 0) ≥ 0,  Λ ≥ 0,  one of them zero      of the contacts that touch (Newton)
                                     ġ⁺ = 0 and a⁺ = 0                                     of all other constraints

By Poisson's law there are two such impacts, both without e: the compression, with the impulses Λᶜ, and the expansion, with Λ ≥ e Λᶜ.
Friction takes the impulses for the forces it follows: D is homogeneous in them. So an impact is the acceleration of a system at rest in a
time of its own, in which q̇⁺ stands for q̈ and Λ for λ, and the laws of contact and friction are those of `contact` and `stick_slip`.
Source: Glocker, Set-Valued Force Laws, chapter 10; Pfeiffer & Glocker, Multibody Dynamics with Unilateral Contacts, chapter 8.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._model.flat import Flat, rows_by_name
from .constrained_slip import on_constraints
from .contact import ROUNDING, Contacts, accelerated, contact_rows, gap_rates, in_contact, select_closed
from .friction_elements import FrictionElements, with_all_masses
from .friction_treatment import Regularised, StickSlip
from .lagrange import constraint_rows, inertia
from .massless import inertial_part
from .stick_slip import bounds, friction, friction_by_term, select_mode

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


def impact(flat: Flat, elements: FrictionElements | None, t, q, v, near: Bool[Array, " c"], e: Float[Array, " c"]) -> Impact:
    """The impact of the contacts that are `near`, some of which approach; `e`: their restitution.

    By Poisson's law compression, as without restitution, and then expansion, in which e of the impulses is given.
    """
    of_poisson = np.array(flat.poisson, bool)
    rates = gap_rates(flat, t, q, v)
    returned = jnp.where((rates < 0) & ~of_poisson, e * rates, 0)
    phases = [_phase(flat, elements, t, q, v, near, returned)]
    if of_poisson.any():
        (compression,) = phases
        given = jnp.where(of_poisson, e * compression.impulses, 0)
        little = jnp.finfo(v.dtype).eps ** ROUNDING  # what compression leaves of rates closes no contact that departs as e grows
        loose = little * jax.lax.stop_gradient(jnp.where(of_poisson, jnp.stack([compression.impulses, jnp.abs(rates)]), 0))
        phases.append(_phase(flat, elements, t, q, compression.v, near, returned, given, tuple(loose)))
    total = functools.partial(functools.reduce, jnp.add)
    impulses, gained, exchanged = (total([getattr(phase, name) for phase in phases]) for name in ("impulses", "gained", "exchanged"))
    works = {name: total([phase.works[name] for phase in phases]) for name in phases[0].works}
    consistent, impulsive = (jnp.all(jnp.stack([getattr(phase, name) for phase in phases])) for name in ("consistent", "impulsive"))
    return Impact(phases[-1].v, impulses, works, consistent, *jax.lax.stop_gradient((gained <= RISE * exchanged, impulsive)))


def _phase(flat, elements, t, q, v, near, returned, given=None, loose=()) -> Phase:
    """An impact in which ġ⁺ + `returned` ≥ 0 and impulses are at least those `given`; `loose`: what more of impulses and what rates are
    rounding.
    """
    approach = gap_rates(flat, t, q, v)
    fast, of_impact = _in_fast_time(flat, elements, t, q, v, returned, given)
    zero, origin = jnp.zeros_like(t), jnp.zeros_like(q)
    if elements is None or of_impact is None:
        chosen = select_closed(fast, zero, origin, origin, near, *loose)
        after, multipliers, _ = accelerated(in_contact(fast, chosen.closed), zero, origin, origin)
        lost, rubbed, consistent, impulsive = jnp.zeros((), v.dtype), {}, chosen.consistent, jnp.array(True)
    else:
        everywhere, still = jnp.ones(of_impact.size, bool), jnp.zeros(of_impact.element_of_row.size, v.dtype)
        contacts = Contacts.of(fast, zero, origin, origin, near, *loose)
        mode, contacts = select_mode(fast, of_impact, zero, origin, origin, still, everywhere, ~everywhere, contacts)
        sigma, held, consistent = mode.sigma, mode.held, mode.consistent
        fast = contacts.applied_to(fast)
        found = friction(fast, on_constraints(fast, of_impact, zero, origin, origin), sigma, zero, origin, origin)
        after, multipliers = found.qddot, found.multipliers
        lost = found.force @ (elements.slip(t, q, v) + elements.slip(t, q, after))
        rubbed = friction_by_term(of_impact, sigma, held, zero, origin, origin, found)
        twice = bounds(of_impact, sigma, zero, origin, origin, 2 * multipliers + _at_contacts(flat, given))
        impulsive = jnp.all(jnp.abs(twice - 2 * found.bound) <= RISE * (jnp.abs(twice) + jnp.abs(found.bound)))
    multipliers = multipliers + _at_contacts(flat, given)
    impulses, departure = contact_rows(flat, multipliers), gap_rates(flat, t, q, after)
    gained = impulses @ (approach + departure) + lost
    exchanged = jnp.abs(impulses) @ (jnp.abs(approach) + jnp.abs(departure))
    works = _works(flat, elements, t, q, (v + after) / 2, multipliers, rubbed)
    return Phase(after, impulses, works, consistent, impulsive, gained, exchanged)


def _at_contacts(flat, given):
    """Impulses of the contacts among those of all rows."""
    if given is None:
        return 0
    before, behind = flat.rows_of_bilateral, flat.rows - flat.rows_of_bilateral - given.size
    return jnp.concatenate([jnp.zeros(before, given.dtype), given, jnp.zeros(behind, given.dtype)])


def _works(flat, elements, t, q, mean, multipliers, rubbed):
    """Of each impulse, its product with the mean of the rates before and after."""
    _, G, _ = constraint_rows(in_contact(flat, jnp.ones(len(flat.contacts), bool)), t, q, mean)
    works = {name: multipliers[rows] @ (G[rows] @ mean) for name, rows in rows_by_name(flat).items()}
    if elements is None:
        return works
    _, rate = jax.jvp(lambda v: elements.slip(t, q, v), (mean,), (mean,))
    return works | {name: jnp.ravel(force) @ rate[elements.rows_of_term[name]] for name, (force, _) in rubbed.items()}


def no_impact(flat: Flat, elements: FrictionElements | None, v) -> Impact:
    """That of nothing: q̇ stays as it is."""
    yes, none = jnp.array(True), jnp.zeros((), v.dtype)
    terms = {} if elements is None else elements.rows_of_term
    return Impact(v, jnp.zeros(len(flat.contacts), v.dtype), {name: none for name in (*rows_by_name(flat), *terms)}, yes, yes, yes)


def check_impacts(flat: Flat, elements: FrictionElements | None, treatment: StickSlip | Regularised) -> None:
    """Refuses friction whose impulses are not solved for."""
    if not flat.needs_multipliers:
        return
    if isinstance(treatment, Regularised):
        raise ValueError(
            "`friction` must be `StickSlip()` where contacts rub, whose impacts take the impulses for the forces, but is `Regularised`. "
            "Leave it out."
        )
    if elements is not None and np.any(elements.is_vector):
        raise ValueError(
            "`dissipation` must rub along single directions where an impact may multiply its normal force, but holds the norm of a slip "
            "velocity of several components, whose direction in an impact is not solved for. Move in a plane, or leave out `unilateral`."
        )


def _in_fast_time(flat, elements, t, q, v, returned, given):
    """The system of an impact: x stands for a change of q, its acceleration from rest for q̇⁺."""
    flat = inertial_part(with_all_masses(flat), t, q, v)
    M = inertia(flat, t, q, v)
    momentum = M.mv(v)
    if given is not None:
        momentum = momentum + jax.vjp(lambda v: gap_rates(flat, t, q, v), v)[1](given)[0]
    rates = lambda v: (jax.jvp(flat.bilateral, (t, q), (jnp.ones_like(t), v))[1], gap_rates(flat, t, q, v), flat.nonholonomic(t, q, v))
    drift = rates(jnp.zeros_like(v))
    along = lambda x: jax.jvp(rates, (jnp.zeros_like(v),), (x,))[1]  # affine in q̇
    fast = flat._replace(
        lagrangian=lambda s, x, w: w @ M.mv(w) / 2 + momentum @ x,
        bilateral=lambda s, x: along(x)[0] + s**2 / 2 * drift[0],
        gaps=lambda s, x: along(x)[1] + s**2 / 2 * (drift[1] + returned),
        nonholonomic=lambda s, x, w: along(w)[2] + s * drift[2],
        dissipations={},
        forces={},
        massless=(),
        stand_ins=(),
    )
    fast = fast._replace(holonomic=lambda s, x: jnp.concatenate([fast.bilateral(s, x), jnp.zeros_like(drift[1])]))
    if elements is None:
        return fast._replace(needs_multipliers=False), None
    at_rest, all_given = elements.slip(t, q, jnp.zeros_like(v)), _at_contacts(flat, given)

    def slip(s, x, w):
        return jax.jvp(lambda v: elements.slip(t, q, v), (jnp.zeros_like(v),), (w,))[1] + s * at_rest

    def impulsive(D):
        """D of the impulses: what does not follow them is finite, and has no part in an impact."""
        return lambda s, x, w, impulses, u: D(t, q, v, impulses + all_given, u) - D(t, q, v, jnp.zeros_like(impulses), u)

    potentials = {name: impulsive(D) for name, D in elements.potentials.items()}
    return fast, elements._replace(slip=slip, potentials=potentials, near_rest=0.0)
