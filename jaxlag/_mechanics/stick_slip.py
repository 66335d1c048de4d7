"""Dry friction: the modes of sliding and sticking, and when each ends.

    slipping  σ = ±1 (or the direction of slip):  D(u) with u = ‖s‖, smooth;  force −F s/‖s‖, F = ∂D/∂u
    sticking  σ = 0:                              s = 0, a nonholonomic constraint;  force μ, its multiplier, ‖μ‖ ≤ F

In each mode the system is an ordinary one, so the rest of the package need not know about friction.
Source: Pfeiffer & Glocker, Multibody Dynamics with Unilateral Contacts, chapters 5 and 6.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._model.flat import Flat, variant
from .._program.implicit import undifferentiated
from .._program.scalarise import scalarised
from .constrained_acceleration import Correction, Impulse, constrained_motion
from .constrained_slip import directed, extent_of, freely, on_constraints
from .friction_elements import FrictionElements, find_elements
from .load_sharing import may_share, shared
from .sliders import Sliders, rates_of_forces, rounding_of_multipliers
from .slip_direction import friction_and_direction, turning, unit


def in_mode(flat: Flat, elements: FrictionElements, sigma: Float[Array, " r"]) -> Flat:
    """The system in one mode: D with ‖s‖ = σ·s where it slips, and s = 0 among the constraints where it sticks."""
    stuck = sticking(elements, sigma)[elements.element_of_row]
    extent = lambda t, q, v: extent_of(elements, sigma, elements.slip(t, q, v))
    held_slip = lambda t, q, v: freely(elements, elements.slip(t, q, v))

    def slipping(D):
        return lambda t, q, v, multipliers: D(t, q, v, multipliers, extent(t, q, v))

    def with_rows(rows, otherwise=lambda t, q, v: 0):
        at = lambda t, q, v: jnp.where(stuck[rows], held_slip(t, q, v)[rows], otherwise(t, q, v))
        return lambda t, q, v: jnp.concatenate([flat.nonholonomic(t, q, v), at(t, q, v)])

    held = {name: flat.rows + rows for name, rows in elements.own_rows.items()}
    dissipations = {name: slipping(D) for name, D in elements.potentials.items()}
    if not elements.size:
        return flat._replace(dissipations=dissipations)
    mode = variant(flat, _in_some_mode, dissipations=dissipations, held=held)
    every = np.arange(stuck.size)
    light = every[elements.massless >= 0] if np.ndim(elements.massless) else every[:0]
    if not light.size:
        return mode._replace(nonholonomic=with_rows(every))
    slip, beside = lambda t, q, v: elements.slip(t, q, v)[light], with_rows(np.setdiff1d(every, light))
    mode = mode._replace(sliders=Sliders(elements.massless[light], flat.rows + light, stuck[light], slip, beside))
    rates = lambda t, q, v: jnp.zeros(stuck.size, v.dtype).at[light].set(rates_of_forces(mode, t, q, v))
    return mode._replace(nonholonomic=with_rows(every, rates))


def _in_some_mode(flat: Flat, t, q, v) -> Flat:
    """The system in a mode of which nothing is known."""
    elements = find_elements(flat)
    assert elements is not None  # or there would be no mode
    return in_mode(flat, elements, jnp.broadcast_to(t, elements.element_of_row.size))


def sticking(elements: FrictionElements, sigma: Float[Array, " r"]) -> Bool[Array, " e"]:
    """Which elements stick."""
    return elements.norms(sigma) == 0


class Friction(NamedTuple):
    """At one state in one mode: velocities, with those that D decides, accelerations and multipliers; per row, friction force and rate of
    the slip; per element, its bound, the margin of its mode, negative where that has ended, whether constraints drive its slip, and whether
    that is along a line.
    """

    qdot: Float[Array, " n"]
    qddot: Float[Array, " n"]
    multipliers: Float[Array, " m"]
    force: Float[Array, " r"]
    slip_rate: Float[Array, " r"]
    bound: Float[Array, " e"]
    margin: Float[Array, " e"]
    driven: Bool[Array, " e"]
    straight: Bool[Array, " e"]


# Scalar operations: those of an acceleration that is scalar code, and half as many for what follows from it. One with a rod and an element
# of friction has 900; as arrays it takes 1.3 times as long to compile, and the watch of a step, which differentiates it, twice.
MOST_OPERATIONS = 1200


def friction(
    flat: Flat,
    elements: FrictionElements,
    sigma,
    t,
    q,
    v,
    feedback=None,
    impulse: Impulse | None = None,
    correction: Correction | None = None,
    shares: Any = True,
) -> Friction:
    """Friction forces of elements on the constraints; `margin` < 0 where a mode has ended: the slip reverses, or a bound is exceeded.

    Of an impact, friction begins from rest, and q̇⁺, Λ and the slip behind stand in the place of q̈, λ and the slip rate; of a state that is
    put back on its constraints, what it takes stands in the place of q̈, and the rest is of no use. Where nothing but accelerations is
    asked for, no admissible share of loads is looked for, which have the same motion: not unless it `shares`.
    """

    def of_state(sigma, t, q, v, impulse, correction):
        return _friction(flat, elements, sigma, t, q, v, feedback, impulse, correction, shares)

    return scalarised(of_state, limit=MOST_OPERATIONS, apart=True)(sigma, t, q, v, impulse, correction)


def _friction(flat, elements, sigma, t, q, v, feedback, impulse, correction, shares):
    stuck, of = sticking(elements, sigma), elements.element_of_row
    mode = in_mode(flat, elements, sigma)
    v, (qddot, multipliers, _) = constrained_motion(mode, t, q, v, feedback, impulse, correction)
    slip, slip_rate = _slip_and_rate(elements, t, q, v, qddot, impulse)
    if np.any(elements.is_quasistatic):  # what has no inertia slips at once
        still = slip_of(elements, t, q, v, 1e2 * jnp.finfo(v.dtype).eps * jnp.abs(v))
        slip_rate = jnp.where((elements.is_quasistatic & (elements.norms(slip) > still))[of], slip, slip_rate)
    extent, pull = jax.vjp(lambda slip: extent_of(elements, sigma, slip), slip)
    bound_of = lambda multipliers: _bounds(elements, extent, t, q, v, multipliers)
    left = bound_of(multipliers) - elements.norms(freely(elements, multipliers[flat.rows :]))
    if may_share(flat, elements):
        share = lambda: tuple(shared(mode, elements, t, q, v, multipliers, bound_of, stuck))
        multipliers, left = share() if shares is True else jax.lax.cond(shares, share, lambda: (multipliers, left))
    bound = bound_of(multipliers)
    force = jnp.where(stuck[of], freely(elements, multipliers[flat.rows :]), -pull(bound)[0])
    going = elements.sums(directed(elements, sigma) * slip) + jnp.where(elements.straight, 0, 1e-6 * elements.near_rest)
    driven, straight = (jnp.broadcast_to(x, stuck.shape) for x in (elements.driven, elements.straight))
    rounding = 1e2 * jnp.finfo(v.dtype).eps * jnp.abs(bound)
    if mode.sliders is not None:
        rounding = rounding.at[of[mode.sliders.rows - flat.rows]].add(rounding_of_multipliers(mode, t, q, v))
    resting = jnp.where(driven, -jnp.abs(bound), left + rounding)
    return Friction(v, qddot, multipliers, force, slip_rate, bound, jnp.where(stuck, resting, going), driven, straight)


def _slip_and_rate(elements: FrictionElements, t, q, v, qddot, impulse: Impulse | None):
    """s and its rate; of an impact, which begins from rest, nothing and s behind it."""
    of_motion = lambda: jax.jvp(elements.slip, (t, q, v), (jnp.ones_like(t), v, qddot))
    if impulse is None:
        return of_motion()
    behind = elements.slip(t, q, qddot)
    return impulse.instead(lambda: (jnp.zeros_like(behind), behind), of_motion)


def bounds(elements: FrictionElements, sigma, t, q, v, multipliers) -> Float[Array, " e"]:
    """∂D/∂u: what friction is where an element slips, and what it does not exceed where it sticks."""
    return _bounds(elements, extent_of(elements, sigma, elements.slip(t, q, v)), t, q, v, multipliers)


def _bounds(elements, extent, t, q, v, multipliers):
    total = lambda u: sum((D(t, q, v, multipliers, u) for D in elements.potentials.values()), start=jnp.zeros((), q.dtype))
    return jax.grad(total)(extent)


class Mode(NamedTuple):
    """A mode σ; which elements stand still at their bound because others hold them; whether its forces are consistent; the bounds."""

    sigma: Float[Array, " r"]
    held: Bool[Array, " e"]
    consistent: Bool[Array, ""]
    bound: Float[Array, " e"]


class Search(NamedTuple):
    """The state of the search for a mode, and for the closed contacts; slip rates without friction, the scale for others."""

    stage: Any
    contacts: Any
    mode: Mode
    turns: Any  # since the contacts changed
    tried: Any  # of all modes in order, how many were, where a search did not end
    only: Any  # the number of the first of them that is consistent, if all others that are have the same motion
    rates: Float[Array, " k"]  # of that motion, how contacts depart and what slips
    clearly: Bool[Array, " e"]  # broken away by more than rounding
    free_rate: Float[Array, " e"]


LOOSE, FIRST, NEXT, HOLD, DONE = range(5)  # stages of the search
MOST_MODES = 2000  # which are tried one after the other, where a search does not end
NONE, SEVERAL = -1, -2  # of these, where no mode is consistent so far, or others with another motion are


class NoContact(NamedTuple):
    """Contacts to choose from, where there are none."""

    @property
    def size(self) -> int:
        """How many contacts there are."""
        return 0

    @property
    def choices(self) -> int:
        """How many choices there are."""
        return 1

    @property
    def is_long(self) -> bool:
        """Whether they might have begun to repeat themselves."""
        return False

    @property
    def acceleration(self) -> np.ndarray:
        """What counts as rounding of how they depart."""
        return np.zeros(0)

    def chosen(self, number: Any) -> "NoContact":
        """The choice of this number."""
        return self

    def applied_to(self, flat: Flat) -> Flat:
        """The system with those that are closed."""
        return flat

    def begun(self, selection: Any, search: Any, friction_in: Callable) -> Any:
        """The search as it begins."""
        return search

    def unloaded(self, bound: Float[Array, " e"]) -> Bool[Array, " e"]:
        """Which elements no open contact loads."""
        return jnp.zeros(bound.size, bool)

    def next(
        self, flat: Flat, t, q, v, qddot, multipliers, agreed: Any = True, hopeless: Any = False
    ) -> tuple["NoContact", bool, np.ndarray]:
        """Other ones, where the friction is `agreed` on and a contact pulls or goes deeper; whether there was any; how all depart."""
        return self, False, np.zeros(0)


@dataclasses.dataclass(frozen=True)
class ModeSelection:
    """Mode selection where the elements `at_rest` have no slip; the others continue to slip along σ.

    All at rest stick, except those `breaking` away at their bound; where some have several rows, they begin as they do together
    (`slip_direction`). One by one, the element farthest beyond its bound slips against its force, and one that would start backwards
    sticks again, until none is beyond its bound and none moves backwards. Of dependent elements some may be at their bound while others
    hold them: one of the possible shares, with the same motion for all. Where one of the contacts pulls or goes deeper in this mode, it
    changes and all begins anew. Where that does not end, as it may where inertia couples normal and friction forces, all modes are tried
    in turn, unless they are too many, so that one motion, and one alone, is possible in the mode that is found.
    """

    flat: Flat
    elements: FrictionElements
    t: Any
    q: Float[Array, " n"]
    v: Float[Array, " n"]
    sigma: Float[Array, " r"]
    at_rest: Bool[Array, " e"]
    breaking: Bool[Array, " e"]
    impulse: Impulse | None = None  # of an impact, which begins from rest

    def slip(self) -> Float[Array, " r"]:
        """The slip velocities."""
        of_motion = lambda: self.elements.slip(self.t, self.q, self.v)
        return of_motion() if self.impulse is None else self.impulse.instead(lambda: jnp.zeros_like(self.sigma), of_motion)

    def drift(self) -> Float[Array, " r"]:
        """Slip rates without accelerations; of an impact, slip without velocities."""
        slip, t, q, v = self.elements.slip, self.t, self.q, self.v
        of_motion = lambda: jax.jvp(lambda t, q: slip(t, q, v), (t, q), (jnp.ones_like(t), v))[1]
        return of_motion() if self.impulse is None else self.impulse.instead(lambda: slip(t, q, jnp.zeros_like(v)), of_motion)

    @property
    def most(self) -> int:
        """Turns that a search takes at most, while no contact changes."""
        return 4 * self.elements.size + 6

    @property
    def resting(self) -> Float[Array, " r"]:
        """σ where all at rest stick."""
        return jax.lax.stop_gradient(jnp.where(self.at_rest[self.elements.element_of_row], 0, self.sigma))

    def start(self, contacts: Any = NoContact()) -> Search:
        """Nothing is known yet."""
        nothing, no = jnp.zeros(self.elements.size, self.v.dtype), jnp.zeros(self.elements.size, bool)
        mode, zero = Mode(self.resting, no, jnp.array(False), nothing), jnp.array(0)
        rates = jnp.zeros(contacts.size + self.sigma.size, self.v.dtype)
        return Search(jnp.array(LOOSE), contacts, mode, zero, zero, jnp.array(NONE), rates, no, nothing)

    def _count(self, contacts: Any) -> int:
        """How many modes there are to try in order: none of elements of several rows, nor where there are too many."""
        count = 3**self.elements.size * contacts.choices
        return 0 if np.any(self.elements.is_vector) or count > MOST_MODES else count

    def _in_order(self, number: Any, contacts: Any) -> tuple[Float[Array, " r"], Any]:
        """Of these modes the one of this number: σ, and which contacts are closed. What breaks away at its bound sticks last."""
        size = self.elements.size
        if not self._count(contacts):
            return self.resting, contacts
        digits = jax.lax.div(number, 3 ** np.arange(size)) + self.breaking.astype(int)
        way = jnp.where(self.at_rest, jax.lax.rem(digits + 1, 3) - 1, 0).astype(self.sigma.dtype)[self.elements.element_of_row]
        return self.resting + way, contacts.chosen(jax.lax.div(number, 3**size))

    def _among_others(self, search: Search, consistent, broken, rates: Float[Array, " k"]) -> tuple[Any, Float[Array, " k"]]:
        """Which of the modes that are tried in order is consistent, with the one that was tried last, and its rates. Where a mode may have
        no forces or several (`self_consistent`), it is `broken`: the motion beside is one of several then; of an impact that is no
        objection.
        """
        if not self._count(search.contacts):
            return search.only, search.rates
        rounding = jnp.concatenate([search.contacts.acceleration, 1e-9 * search.free_rate[self.elements.element_of_row]])
        size = jnp.maximum(jnp.abs(rates), jnp.abs(search.rates))
        differs = jnp.any(jnp.abs(rates - search.rates) > 1e-6 * size + rounding)
        is_one, first = consistent & (search.tried > 0), search.only == NONE
        if self.impulse is not None:
            broken = self.impulse.instead(lambda: jnp.zeros_like(broken), lambda: broken)
        only = jnp.where(is_one & first, search.tried - 1, jnp.where(is_one & differs | broken, SEVERAL, search.only))
        return only, jnp.where(is_one & first, rates, search.rates)

    def kinds(self, search: Search) -> tuple[Any, Any, Any, Any]:
        """Which elements are freed of their force, which slip that were at rest; whether all begins anew, and whether some break away."""
        released = self.at_rest & ~sticking(self.elements, search.mode.sigma)
        freed = jnp.where(search.stage == LOOSE, self.at_rest, released & (search.stage == HOLD))
        return freed, released, search.stage == LOOSE, jnp.any(self.breaking)

    def _torn(self, found: Friction, free_rate: Float[Array, " e"], stuck: Bool[Array, " e"]) -> Bool[Array, " e"]:
        """Of elements that cannot stick at the same time, as on belts that move apart, or beside a contact that returns from an impact,
        the one farthest from rest.
        """
        norms = self.elements.norms
        rate, most = norms(found.slip_rate), jnp.max(norms(self.drift()), initial=0.0)
        if self.impulse is not None:
            most = self.impulse.instead(lambda: jnp.maximum(most, jnp.max(free_rate, initial=0.0)), lambda: most)
        return _greatest(rate, stuck & (rate > 1e-6 * most) & (rate > 1e-9 * free_rate) & (most > 0))

    def next(self, search: Search, found: Friction, turned: Float[Array, " r"], turns: Any) -> Search:
        """Onward with the friction that was `found` in the mode of the search, and with σ `turned`, where it `turns`."""
        elements, at_rest, breaking, of = self.elements, self.at_rest, self.breaking, self.elements.element_of_row
        mode, stage = search.mode, search.stage
        _, released, *_ = self.kinds(search)
        rate = elements.norms(found.slip_rate)

        over = jnp.where((stuck := sticking(elements, mode.sigma)) & ~found.driven, -found.margin, -jnp.inf)
        idle = search.contacts.unloaded(found.bound)  # let go at once, and for good: it has no part in what the others do
        beyond = _greatest(over, (over > 0) & ~idle)
        backwards = -elements.sums(found.slip_rate * mode.sigma)
        holds = released & ~idle & ~(elements.is_vector & (found.bound == 0))
        returning = _greatest(backwards, holds & (backwards > jnp.where(search.clearly, 0, 1e-6 * search.free_rate)))
        torn = self._torn(found, search.free_rate, over > -jnp.inf) & ~jnp.any(beyond) | (stuck & found.driven)
        along = (over > -1e-6 * jnp.abs(found.bound)) & elements.are_shared  # those of a share break away together
        leaving = jnp.where((stage == FIRST) & jnp.any(breaking), breaking | along, beyond | torn)
        leaving = (leaving & (stage != LOOSE)) | (idle & (over > -jnp.inf))
        returning = returning & ~jnp.any(leaving) & ~turns
        onward = jnp.where((rate > 0)[of], found.slip_rate, self.slip())
        way = jnp.where(((beyond | breaking | along) & ~found.driven)[of], -found.force, onward)
        away = jnp.where(idle[of], 1, unit(elements, way))
        sigma = jnp.where(leaving[of], away, jnp.where(returning[of], 0, turned))
        far = (stage == LOOSE) & ~sticking(elements, turned) | leaving & (over > 1e-6 * jnp.abs(found.bound))
        clearly = (search.clearly | far) & ~returning
        in_current_mode = ~jnp.any(leaving | returning) & ~turns
        agrees = in_current_mode & jnp.all(jnp.isfinite(found.force))

        all_slip = (stage == LOOSE) & ~jnp.any(at_rest)  # nothing to choose
        within = (stage == FIRST) | (stage == NEXT) | all_slip
        last = all_slip | ~jnp.any(at_rest & ~idle & ~sticking(elements, sigma))  # nothing that others may hold
        asked = self.flat, self.t, self.q, self.v, found.qddot, found.multipliers
        contacts, changes, departs = search.contacts.next(*asked, agrees, search.turns > self.most)
        following = jnp.where(within, jnp.where(in_current_mode, jnp.where(last, DONE, HOLD), NEXT), jnp.where(stage == LOOSE, FIRST, DONE))
        consistent, broken = agrees & jnp.logical_not(changes), in_current_mode & ~agrees
        only, rates = self._among_others(search, within & consistent, broken, jnp.concatenate([departs, found.slip_rate]))
        count = self._count(search.contacts)
        is_long = (search.turns > self.most + 2) | search.contacts.is_long | broken | (search.tried > 0)
        fails = within & (((search.tried > 0) & (search.tried <= count)) | (is_long & ~consistent))
        tries = fails & ((search.tried < count) | ((search.tried == count) & (only >= 0)))
        anew = within & changes & ~fails
        following = jnp.where(fails, jnp.where(tries, NEXT, DONE), jnp.where(anew, LOOSE, following))
        onward = jnp.where(anew, self.resting, jnp.where(within | (stage == LOOSE), sigma, mode.sigma))
        sigma, others = self._in_order(jnp.where(search.tried < count, search.tried, only), search.contacts)
        contacts = jax.tree.map(lambda new, old: jnp.where(anew, new, old), contacts, search.contacts)
        return Search(
            following,
            jax.tree.map(lambda new, old: jnp.where(tries, new, old), others, contacts),
            Mode(
                jnp.where(tries, sigma, onward),
                jnp.where(stage == HOLD, released & ~idle & ~elements.is_quasistatic & (rate <= 1e-6 * search.free_rate), mode.held),
                jnp.where(within, consistent & ~fails, mode.consistent),
                jnp.where(within, found.bound, mode.bound),
            ),
            jnp.where(anew, 0, search.turns + 1),
            jnp.where(tries, search.tried + 1, search.tried),
            only,
            rates,
            jnp.where(within | (stage == LOOSE), clearly & ~anew, search.clearly),
            jnp.where(stage == LOOSE, rate, search.free_rate),
        )


def select_mode(
    flat: Flat,
    elements: FrictionElements,
    t,
    q,
    v,
    sigma,
    at_rest,
    breaking,
    contacts: Any = NoContact(),
    friction_in: Any = None,
    impulse=None,
) -> tuple[Mode, Any]:
    """The mode by a `ModeSelection`, and the closed contacts among `contacts`. `friction_in(σ, contacts)` is the friction of this state in
    another mode, if there is a program of it.
    """
    friction_in = friction_in or _in_modes(flat, elements, t, q, v, impulse)
    selection = ModeSelection(flat, elements, t, q, v, sigma, at_rest, breaking, impulse)

    def turn(search):
        in_mode = lambda sigma: friction_in(sigma, search.contacts)
        found = friction_and_direction(elements, in_mode, search.mode.sigma, *selection.kinds(search), search.free_rate)
        return selection.next(search, *found)

    # Nothing here is differentiated, so that the loop may end by itself: a motion behind many jumps of an input takes a tenth less.
    start = lambda: contacts.begun(selection, selection.start(contacts), friction_in)
    done = undifferentiated(lambda: jax.lax.while_loop(lambda search: search.stage != DONE, turn, start()))()
    return done.mode, done.contacts


def _in_modes(flat: Flat, elements: FrictionElements, t, q, v, impulse: Impulse | None = None) -> Callable:
    """Friction at this state as a function of σ and of the contacts."""
    on = lambda chosen, sigma: friction(chosen, on_constraints(chosen, elements, t, q, v), sigma, t, q, v, impulse=impulse)
    return lambda sigma, contacts: on(contacts.applied_to(flat), sigma)


def _greatest(x, among):
    """The greatest entry among those marked, if there are any."""
    if not x.size:
        return among
    return among & (jnp.arange(x.size) == jnp.argmax(jnp.where(among, x, -jnp.inf)))


def first_mode(
    flat: Flat, elements: FrictionElements, t, q, v, contacts: Any = NoContact(), friction_in: Callable | None = None
) -> tuple[Mode, Any]:
    """The initial mode: what moves slips along its motion; what rests sticks or breaks away. And the contacts chosen with it."""
    at_rest, sigma = slipping(elements, t, q, v)
    friction_in = friction_in or _in_modes(flat, elements, t, q, v)
    mode, contacts = select_mode(flat, elements, t, q, v, sigma, at_rest, jnp.zeros_like(at_rest), contacts, friction_in)
    begin = at_rest & ~sticking(elements, mode.sigma) & ~mode.held & ~elements.is_quasistatic
    return mode._replace(sigma=turning(elements, lambda sigma: friction_in(sigma, contacts).slip_rate, mode.sigma, begin)), contacts


def slipping(elements: FrictionElements, t, q, v) -> tuple[Bool[Array, " e"], Float[Array, " r"]]:
    """Which elements are at rest, and the directions of the others, but for rounding."""
    slip = jax.lax.stop_gradient(elements.slip(t, q, v))
    size = elements.norms(slip)
    at_rest = elements.is_quasistatic | (size <= slip_of(elements, t, q, v, 1e2 * jnp.finfo(v.dtype).eps * jnp.abs(v)))
    return at_rest, jnp.where(at_rest[elements.element_of_row], 0, slip / jnp.where(at_rest, 1, size)[elements.element_of_row])


def slip_of(elements: FrictionElements, t, q, v, errors: Float[Array, " n"]) -> Float[Array, " e"]:
    """The slip tolerance per element, each in its own units: the slip that errors of the velocities amount to."""
    return elements.norms(jnp.abs(jax.jacfwd(elements.slip, argnums=2)(t, q, v)) @ errors)


def redirected(elements: FrictionElements, sigma, held, t, q, v):
    """σ, with the direction of slipping elements of several rows updated to their motion; not of what has come past rest."""
    of, slip = elements.element_of_row, elements.slip(t, q, v)
    several, size, onward = elements.is_vector & ~elements.straight, elements.norms(slip), elements.sums(sigma * slip) > 0
    moves = several & onward & (size > slip_of(elements, t, q, v, jnp.finfo(v.dtype).eps * jnp.abs(v)))
    turns = (moves & ~sticking(elements, sigma) & ~held)[of]
    if not np.any(elements.is_vector):
        return sigma
    new = jax.lax.stop_gradient(jnp.where(turns, slip / jnp.where(turns, size[of], 1), directed(elements, sigma)))
    return jnp.where(new == sigma, sigma, new)  # where nothing moved, with the derivative that it begins with


def friction_by_term(elements: FrictionElements, sigma, held, t, q, v, found: Friction) -> dict[str, tuple[Array, Array]]:
    """Force on each slip velocity and whether it sticks, by dissipation term. Where several terms act on one slip velocity, each has
    a share of the force in proportion to its bound.
    """
    of, stuck = elements.element_of_row, sticking(elements, sigma) | held
    extent, forces = extent_of(elements, sigma, elements.slip(t, q, v)), {}
    for name, rows in elements.rows_of_term.items():
        bound = jax.grad(lambda u, D=elements.potentials[name]: D(t, q, v, found.multipliers, u))(extent)
        share = bound / jnp.where(found.bound != 0, found.bound, 1)
        shape = () if rows.size == 1 else (rows.size,)
        forces[name] = (share[of[rows]] * found.force[rows]).reshape(shape), stuck[of[rows]].reshape(shape)
    return forces
