"""Unilateral contact at one state: which contacts are closed.

    g ≥ 0,  λ ≥ 0,  g λ = 0        of positions;  and where g = 0 and ġ = 0:   g̈ ≥ 0,  λ ≥ 0,  g̈ λ = 0

A closed contact is a row of G, g = 0; an open one is a row of zeros, whose λ is zero. In each choice of the closed ones the system is an
ordinary one, with or without dry friction, so the rest of the package need not know about contact.
Source: Pfeiffer & Glocker, Multibody Dynamics with Unilateral Contacts, chapters 5 and 6; Glocker, Set-Valued Force Laws, chapter 10.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._model.flat import Flat, variant
from .._program.implicit import implicit_root, open_function
from .._program.scalarise import scalarised
from .augmented_inertia import augmented, unit_lengths
from .constrained_acceleration import Impulse, constrained_acceleration
from .constrained_slip import on_constraints
from .friction_elements import FrictionElements, find_elements, with_all_masses
from .frictional_contact import Problem, choice, turning
from .lagrange import constraint_rows, inertia, position_residual
from .pseudo_inverse import pseudo_inverse
from .saddle_point import SaddlePoint, reach_of, saddle_point
from .slip_direction import unit, without_force
from .stick_slip import NEXT, Friction, Mode, ModeSelection, Search, bounds, first_mode, in_mode, sticking

OUTWARDS = 6  # Newton steps that put a start on its obstacle
ROUNDING = 0.75  # power of eps, what counts as rounding of a gap, its rate, its acceleration and its force


def in_contact(flat: Flat, closed: Bool[Array, " c"]) -> Flat:
    """The system with these contacts closed."""

    def holonomic(t, q):
        return jnp.concatenate([flat.bilateral(t, q), jnp.where(closed, flat.gaps(t, q), 0)])

    return variant(flat, _in_some_contact, holonomic=holonomic, closed=closed) if flat.contacts else flat


def _in_some_contact(flat: Flat, t, q, v) -> Flat:
    """The system with contacts of which it is not known whether they are closed."""
    return in_contact(flat, jnp.broadcast_to(t > 0, flat.gap_count))


def free(flat: Flat) -> Flat:
    """The system without its contacts: fewer rows, those of the other constraints."""

    def of_all(function):
        def padded(t, q, v, multipliers):
            before, behind = jnp.split(multipliers, [flat.rows_of_bilateral])
            return function(t, q, v, jnp.concatenate([before, jnp.zeros(flat.gap_count, q.dtype), behind]))

        return padded

    dissipations, forces = ({name: of_all(term) for name, term in of.items()} for of in (flat.dissipations, flat.forces))
    return variant(flat, _free, holonomic=flat.bilateral, closed=None, dissipations=dissipations, forces=forces)


def _free(flat: Flat, t, q, v) -> Flat:
    return free(flat)


def contact_rows(flat: Flat, multipliers: Float[Array, " m"]) -> Float[Array, " c"]:
    """Of the multipliers of all rows, those of the contacts."""
    holonomic = flat.rows_of_bilateral
    return multipliers[holonomic : holonomic + flat.gap_count]


def gap_rates(flat: Flat, t, q, v) -> Float[Array, " c"]:
    """ġ of all contacts."""
    return jax.jvp(flat.gaps, (t, q), (jnp.ones_like(t), v))[1]


def gap_accelerations(flat: Flat, t, q, v, qddot) -> Float[Array, " c"]:
    """g̈ of all contacts."""
    return jax.jvp(lambda t, q, v: gap_rates(flat, t, q, v), (t, q, v), (jnp.ones_like(t), v, qddot))[1]


def on_contact(flat: Flat, t, q, v, closed: Bool[Array, " c"]) -> Float[Array, " n"]:
    """q, put on these contacts where it is but for rounding, and so are its derivatives: of many impacts they would add up."""

    def put(t, q, v, closed):
        g, G = position_residual(in_contact(flat, closed), t, q)
        return q + saddle_point(inertia(with_all_masses(flat), t, q, v), G, jnp.zeros_like(q), -g, reach_of(q)).x

    return scalarised(put)(t, q, v, closed)


def outside(flat: Flat, t, q, v) -> Float[Array, " n"]:
    """q, put on the obstacles that it lies inside of."""
    if not flat.contacts:
        return q
    inside = flat.gaps(t, q) < 0
    return jax.lax.scan(lambda q, _: (on_contact(flat, t, q, v, inside), None), q, length=OUTWARDS)[0]


class GapScales(NamedTuple):
    """Of each contact, the gap and the rate of approach that errors of positions and velocities amount to."""

    gap: Float[Array, " c"]
    rate: Float[Array, " c"]


def gap_scales(flat: Flat, t, q, v, of_positions: Float[Array, " n"], of_velocities: Float[Array, " n"]) -> GapScales:
    """Gaps and rates that these errors amount to."""
    G = jnp.abs(jax.lax.stop_gradient(jax.jacfwd(flat.gaps, argnums=1)(t, q)))
    return GapScales(_times(G, of_positions), _times(G, of_velocities))


def roundings(x: Float[Array, " n"], own: Any) -> Float[Array, " n"]:
    """Of each number of a state, what counts as its rounding, with some of its own scale for one that is zero just now."""
    little = jnp.finfo(x.dtype).eps ** ROUNDING
    return little * jnp.abs(jax.lax.stop_gradient(x)) + little**2 * own


def roundings_beside(flat: Flat, t, q, v) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Of each velocity, what counts as rounding where an impact gives the energy of some to others: that of the largest it could be; and
    likewise of each coordinate, which come first.
    """
    t, q, v = jax.lax.stop_gradient((t, q, v))
    M = inertia(flat, t, q, v)
    mass = jnp.diagonal(M.as_matrix())

    def of(x):
        largest = jnp.sqrt(jnp.maximum(x @ M.mv(x), 0) / jnp.where(mass > 0, mass, jnp.inf))
        largest = jnp.maximum(jnp.abs(x), largest)
        return roundings(largest, largest)

    return of(q), of(v)


class Contacts(NamedTuple):
    """Contacts with g = 0 and ġ = 0, to choose the closed ones from: those chosen so far, how often they changed, and what of their forces
    and accelerations counts as rounding: which pull they may have, below zero of those that open where nothing presses them.

    All candidates are closed at first. One by one, the contact that pulls most opens, and where none pulls, the one that goes deepest
    closes, until none pulls and none goes deeper. If that takes long, they change in the order of their numbers, which ends without
    friction in any case (Murty, Linear Complementarity, chapter 4).
    """

    candidates: Bool[Array, " c"]
    closed: Bool[Array, " c"]
    turn: Any
    force: Float[Array, " c"]
    acceleration: Float[Array, " c"]
    impulse: Impulse | None = None  # of an impact: for accelerations it has velocities, for forces impulses

    @classmethod
    def of(
        cls,
        flat: Flat,
        t,
        q,
        v,
        candidates: Bool[Array, " c"],
        loose: Float[Array, " c"] | None = None,
        least: Float[Array, " c"] | None = None,
        impulse: Impulse | None = None,
    ) -> "Contacts":
        """All candidates closed; those that are `loose` open where no more than that presses them, at an acceleration of no less than
        the `least`.
        """
        of_state = lambda t, q, v, impulse: _scales(flat, t, q, v, impulse)
        force, acceleration = jax.lax.stop_gradient(scalarised(of_state)(t, q, v, impulse))
        force = force if loose is None else jnp.where(loose > 0, -force - loose, force)
        acceleration = acceleration if least is None else jnp.maximum(acceleration, least)
        return cls(candidates, candidates, jnp.array(0), force, acceleration, impulse)

    def applied_to(self, flat: Flat) -> Flat:
        """The system with those that are closed."""
        return in_contact(flat, self.closed)

    @property
    def size(self) -> int:
        """How many contacts there are."""
        return self.closed.size

    @property
    def choices(self) -> int:
        """How many there are."""
        return 2**self.closed.size

    @property
    def is_long(self) -> Bool[Array, ""]:
        """Whether contacts have changed so often that they might have begun to repeat themselves."""
        return self.turn > 4 * self.closed.size + 2 ** min(self.closed.size, 10)

    def chosen(self, number: Any) -> "Contacts":
        """The choice of this number, all candidates closed in that of zero."""
        return self._replace(closed=self.candidates & (number & 2 ** np.arange(self.closed.size) == 0))

    def begun(self, selection: ModeSelection, search: Search, friction_in: Callable) -> Search:
        """The search as it begins."""
        if not begins_with_choice(selection.flat, selection.elements):
            return search
        everywhere = jnp.ones_like(selection.at_rest)
        sigma = without_force(selection.elements, selection.sigma, everywhere)
        alone = friction_in(sigma, self._replace(closed=jnp.zeros_like(self.closed)))
        return from_choice(selection, search, Alone.of(selection.flat, alone))

    def unloaded(self, bound: Float[Array, " e"]) -> Bool[Array, " e"]:
        """Which elements no force loads while a contact is open."""
        return (bound == 0) & ~jnp.all(self.closed)

    def next(
        self, flat: Flat, t, q, v, qddot, multipliers, agreed: Any = True, hopeless: Any = False
    ) -> tuple["Contacts", Bool[Array, ""], Float[Array, " c"]]:
        """Other ones, where the friction is `agreed` on and a contact pulls or goes deeper; whether there was any; how all depart. If
        agreement is `hopeless`, what pulls opens as well.
        """
        size = flat.gap_count
        pull = jnp.where(self.closed & (agreed | hopeless), -contact_rows(flat, multipliers) - self.force, -jnp.inf)
        departs = departures(flat, t, q, v, qddot, self.impulse)
        deeper = jnp.where(agreed & self.candidates & ~self.closed, -departs - self.acceleration, -jnp.inf)
        in_order = jnp.where((pull > 0) | (deeper > 0), size - jnp.arange(size, dtype=v.dtype), 0)
        excess = jnp.where(self.turn > 2 * size, in_order, jnp.where(jnp.any(pull > 0), pull, deeper))
        flips = (jnp.arange(size) == jnp.argmax(excess)) & (excess > 0)
        return self._replace(closed=self.closed ^ flips, turn=self.turn + 1), jnp.any(flips), departs


def begins_with_choice(flat: Flat, elements: FrictionElements | None) -> bool:
    """Whether a search for the mode begins with a `choice`: where friction of contacts has directions."""
    return bool(flat.contacts) and elements is not None and bool(np.any(elements.is_vector)) and not flat.massless


class Alone(NamedTuple):
    """Accelerations without contacts and friction, or velocities of an impact; the multipliers of other constraints; slip rates."""

    x: Float[Array, " n"]
    multipliers: Float[Array, " m"]
    slip_rate: Float[Array, " r"]

    @classmethod
    def of(cls, flat: Flat, found: Friction) -> "Alone":
        """That which was found with all contacts open and no friction."""
        return cls(found.qddot, found.multipliers[: flat.rows], found.slip_rate)


def from_choice(selection: ModeSelection, search: Search, alone: Alone) -> Search:
    """A search for the mode from a `choice`; as it was, where none is found."""
    problem, rounding = _condensed(selection, search.contacts, alone)
    chosen = choice(problem)
    contacts, mode = search.contacts._replace(closed=chosen.closed), search.mode._replace(sigma=chosen.sigma)
    scale = chosen.scale + 1e8 * selection.elements.norms(rounding)  # of the scale of slip rates 1e-6 is next to nothing
    onward = Search(jnp.array(NEXT), contacts, mode, *search[3:-1], scale)
    return jax.tree.map(lambda new, old: jnp.where(chosen.found, new, old), onward, search)


def turned_with(selection: ModeSelection, mode: Mode, contacts: Contacts, alone: Alone) -> Float[Array, " r"]:
    """σ of the mode that was found, with the derivative of what begins to slip by it; what that follows from is asked for with it alone."""
    given = jax.lax.stop_gradient(mode.sigma)

    def turned():
        begins = jax.lax.stop_gradient((mode.bound != 0) & ~mode.held)
        return turning(_condensed(selection, contacts, alone)[0], contacts.closed, given, begins)

    opened, within = open_function(turned)
    return implicit_root(lambda within, sigma: sigma - opened(*within), lambda within, sigma, left: -left, within, given)


def _condensed(selection: ModeSelection, contacts: Contacts, alone: Alone) -> tuple[Problem, Float[Array, " r"]]:
    """The forces of contacts and friction, and what of the slip rates alone is rounding."""
    flat, elements, t, q, v, at_rest = (getattr(selection, name) for name in ("flat", "elements", "t", "q", "v", "at_rest"))
    count = flat.gap_count
    rows = flat.rows_of_bilateral + np.arange(count)
    _, G, _ = constraint_rows(in_contact(flat, jnp.ones(count, bool)), t, q, v)
    of_slip = jax.jacfwd(elements.slip, argnums=2)(t, q, v)
    A, G = jnp.concatenate([G[rows], of_slip]), G[: flat.rows].at[rows].set(0)
    M = augmented(inertia(flat, t, q, v).as_matrix(), G)[0]
    free, held = jnp.split(jnp.linalg.solve(M, jnp.concatenate([A, G]).T), [len(A)], axis=1)
    of_others = -pseudo_inverse(G @ held) @ (G @ free) if flat.rows > count else jnp.zeros_like(G @ free)
    b = jnp.concatenate([departures(flat, t, q, v, alone.x, selection.impulse), alone.slip_rate])
    slip = elements.slip(t, q, v)
    keeps = at_rest | (elements.norms(slip) == 0)
    sigma = jnp.where(keeps[elements.element_of_row], selection.sigma, unit(elements, slip))

    def bound(forces):
        multipliers = (alone.multipliers + of_others @ forces).at[rows].set(forces[:count])
        return bounds(elements, sigma, t, q, v, multipliers)

    W, among = A @ (free + held @ of_others), (elements, bound, at_rest, selection.breaking & at_rest, sigma)
    rounding = jnp.finfo(v.dtype).eps * (jnp.abs(of_slip) @ jnp.abs(alone.x))
    return Problem(W, b, contacts.candidates, *among, contacts.acceleration), rounding


def accelerated(flat: Flat, t, q, v, impulse: Impulse | None = None) -> SaddlePoint:
    """q̈ and λ, or q̇⁺ and Λ of an impact, in scalars where there are few."""
    return scalarised(lambda t, q, v, impulse: constrained_acceleration(flat, t, q, v, impulse=impulse))(t, q, v, impulse)


def departures(flat: Flat, t, q, v, x, impulse: Impulse | None) -> Float[Array, " c"]:
    """g̈ of all contacts, where x is q̈; of an impact, where it is q̇⁺, ġ⁺ beyond the rate at which they return."""
    of_motion = lambda: gap_accelerations(flat, t, q, v, x)
    return of_motion() if impulse is None else impulse.instead(lambda: gap_rates(flat, t, q, x) + impulse.returned, of_motion)


class Chosen(NamedTuple):
    """Which contacts are closed; whether forces and accelerations are consistent."""

    closed: Bool[Array, " c"]
    consistent: Bool[Array, ""]


def select_closed(
    flat: Flat,
    t,
    q,
    v,
    candidates: Bool[Array, " c"],
    loose: Float[Array, " c"] | None = None,
    least: Float[Array, " c"] | None = None,
    impulse: Impulse | None = None,
) -> Chosen:
    """Which of the candidates are closed, without friction."""
    t, q, v, impulse = jax.lax.stop_gradient((t, q, v, impulse))

    def turn(carry):
        contacts, _ = carry
        qddot, multipliers, _ = accelerated(contacts.applied_to(flat), t, q, v, impulse)
        return contacts.next(flat, t, q, v, qddot, multipliers)[:2]

    most = 4 * flat.gap_count + 2 ** min(flat.gap_count, 10)
    start = Contacts.of(flat, t, q, v, candidates, loose, least, impulse), jnp.any(candidates)
    contacts, changes = jax.lax.while_loop(lambda carry: carry[1] & (carry[0].turn < most), turn, start)
    return Chosen(contacts.closed, ~changes)


def _scales(flat, t, q, v, impulse):
    """Those of the motion without contact."""
    return scales_of(flat, t, q, v, constrained_acceleration(free(flat), t, q, v, impulse=impulse).x, impulse)


def scales_of(flat: Flat, t, q, v, alone: Float[Array, " n"], impulse: Impulse | None) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """Of each contact, the force and the acceleration that count as rounding, relative to those of the motion `alone`, without contact."""
    G = jnp.abs(jax.jacfwd(flat.gaps, argnums=1)(t, q))
    drift = jnp.abs(departures(flat, t, q, v, jnp.zeros_like(v), impulse))
    force, size = jnp.abs(inertia(flat, t, q, v).mv(alone)), jnp.sum(G**2, axis=1)
    little = jnp.finfo(v.dtype).eps ** ROUNDING
    return little * _times(G, force) / jnp.where(size > 0, size, 1), little * (_times(G, jnp.abs(alone)) + drift)


def _times(G, x):
    """G x, in sums: of many states at once a product would be one of matrices, for a library (`_program.whole_kernel`)."""
    return jnp.sum(G * x[None], axis=1)


def idle(flat: Flat, elements: FrictionElements, sigma: Float[Array, " r"], bound: Float[Array, " e"]) -> Bool[Array, " e"]:
    """Which elements slip without a force while a contact is open: which way they do says nothing, and is found again where it closes."""
    if flat.closed is None:
        return jnp.zeros(elements.size, bool)
    return (bound == 0) & ~sticking(elements, sigma) & ~jnp.all(flat.closed)


def touching(flat: Flat, t, q, v, scales: GapScales) -> Bool[Array, " c"]:
    """Which contacts touch, and neither open nor close."""
    return (flat.gaps(t, q) <= scales.gap) & (jnp.abs(gap_rates(flat, t, q, v)) <= scales.rate)


def barely_touching(mode: Flat, t, q, v, multipliers: Float[Array, " m"], forces: Float[Array, " n"]) -> Bool[Array, " c"]:
    """Which contacts touch, and neither open nor close, where nothing presses them: the motion is another one on either side of such a
    state. `mode`: `in_current_mode`; `multipliers`: those in it; `forces`: the size of those that act on each coordinate.
    """
    if mode.closed is None:
        return jnp.zeros(0, bool)
    t, q, v, multipliers, forces = jax.lax.stop_gradient((t, q, v, multipliers, forces))
    G = jax.jacfwd(mode.gaps, argnums=1)(t, q)
    lengths = unit_lengths(inertia(mode, t, q, v).as_matrix(), G)
    pushes, others = (jnp.max(jnp.where(G != 0, x * lengths[None], 0), axis=1) for x in (jnp.abs(G), forces[None]))
    pressed = mode.closed & (contact_rows(mode, multipliers) * pushes > jnp.finfo(q.dtype).eps ** 0.5 * others)
    return touching(mode, t, q, v, gap_scales(mode, t, q, v, *roundings_beside(mode, t, q, v))) & ~pressed


def in_current_mode(flat: Flat, t, q, v) -> Flat:
    """The system in the mode that holds at this state: its closed contacts among the constraints, its dry friction sliding or sticking.

    Contacts that touch and neither open nor close, to rounding, are closed where they push.
    """
    elements = find_elements(flat)
    if not flat.contacts:
        if elements is None:
            return flat
        sigma = first_mode(flat, elements, t, q, v)[0].sigma
        return in_mode(flat, on_constraints(flat, elements, t, q, v), sigma)
    scales = gap_scales(flat, t, q, v, *roundings_beside(flat, t, q, v))
    candidates = touching(flat, t, q, v, scales)
    if elements is None:
        return in_contact(flat, select_closed(flat, t, q, v, candidates).closed)
    mode, contacts = first_mode(flat, elements, t, q, v, Contacts.of(flat, t, q, v, candidates))
    flat = contacts.applied_to(flat)
    return in_mode(flat, on_constraints(flat, elements, t, q, v), mode.sigma)
