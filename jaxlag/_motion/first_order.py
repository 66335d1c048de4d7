"""The equations of motion as a first-order system, ready to be integrated: ẏ = f(t, y), with y as in `state_vector`."""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from .._mechanics.constrained_acceleration import Correction, Impulse, constrained_acceleration
from .._mechanics.constrained_slip import Left, left_by_constraints, on_constraints
from .._mechanics.contact import free, in_contact
from .._mechanics.friction_elements import FrictionElements, light_coordinates, without_friction
from .._mechanics.impact import check_impacts, of_impulses
from .._mechanics.load_sharing import may_share
from .._mechanics.massless import with_first_order_rates
from .._mechanics.power import energy_exchange, listed_powers
from .._mechanics.projection import Projection, corrected
from .._mechanics.saddle_point import SaddlePoint
from .._mechanics.sliders import with_sliders_returned
from .._mechanics.stick_slip import Friction, friction, in_mode, redirected, slip_of, sticking
from .._mechanics.surfaces import CROSSING, bends, with_surfaces
from .._model.event import Event
from .._model.flat import Flat, StatesAt, bind
from .._model.signal import at_time, nonsmooth_signals
from .._model.state_values import NOTHING, Layout, of_first_order, period, ravelled, sampled
from .._model.system import System
from .._program.jit import jitted
from .._program.scalarise import scalarised
from .._program.walker import used_arguments
from .formulation import PROJECTION, Formulation
from .held_sides import on_held_sides
from .interval_inputs import at_events, called_elsewhere, follows_time, pieces_at, values_of, warn_of_delays
from .protocol import Arguments
from .state_vector import Parts


@dataclasses.dataclass(frozen=True)
class EquationsOfMotion:
    """The `FirstOrderSystem` of one motion, in the mode of friction and contact that its y holds."""

    system: System
    like: Layout  # of q
    formulation: Formulation
    rows: int = 0  # slip velocities with dry friction
    elements: int = 0  # elements of dry friction
    elsewhere: frozenset[int] = frozenset()  # signals that are asked for at other times than the present
    driving: frozenset[int] = frozenset()  # signals in holonomic constraints: velocities jump where these bend
    states: Layout = NOTHING  # of first order, by name
    sampled: Layout = NOTHING  # states that change at sample times
    gaps: tuple[tuple[str, tuple[int, ...]], ...] = ()  # the shapes of contacts, by name
    events: int = 0  # those of the system, and behind them surfaces across which forces may jump or bend
    light: tuple[int, ...] = ()  # coordinates without inertia, whose velocities follow from the rest
    entangled: bool = False  # whether elements of friction may share their forces in more than one way, or constraints drive their slips
    levels: tuple[int, ...] = ()  # of each event, by how many other surfaces its witness may jump
    sided: bool = False  # whether functions choose by the position, perhaps across the surface of an event
    sees_time: bool = False  # whether functions ask for the time, beside signals at that time
    follows_time: bool = True  # whether they depend on the time at all

    @property
    def contacts(self) -> int:
        """How many gaps there are."""
        return sum(math.prod(shape) for _, shape in self.gaps)

    @classmethod
    def of(cls, system: System, q0: PyTree, formulation: Formulation, params: PyTree, at: StatesAt) -> "EquationsOfMotion":
        """Looks for dry friction at the start, in shapes alone."""
        z, u = (Layout.of({name: at.values[name] for name in of}) for of in (of_first_order(system), sampled(system)))
        alone = cls(system, Layout.of(q0), formulation, states=z, sampled=u, events=len(system.events))
        if system.unilateral:
            gaps = bind(system, alone.like.shapes, params, at).contacts
            alone = dataclasses.replace(alone, gaps=tuple(gaps.items()))
        if nonsmooth_signals(params):
            of_all = lambda flat: (values_of(flat, *at[1:]), at_events(system, flat, *at[1:]))
            elsewhere = called_elsewhere(lambda params: of_all(bind(system, q0, params, at)), params)
            warn_of_delays(params, elsewhere)
            numbers, rest = eqx.partition(params, lambda leaf: isinstance(leaf, (jax.Array, np.ndarray)))
            used = used_arguments(lambda part: alone.flat_at(eqx.combine(part, rest), at).bilateral(*at[1:3]), numbers)[0]
            driving = (k for k, signal in enumerate(nonsmooth_signals(used)) if any(jax.tree.leaves(signal)))
            alone = dataclasses.replace(alone, elsewhere=elsewhere, driving=frozenset(driving))
        light = light_coordinates(alone.flat_at(params, at))
        at_time = lambda params, t: values_of(alone.flat_at(params, at._replace(t=t)), t, *at[2:])
        follows, sees = follows_time(at_time, system, params, at.t)
        alone = dataclasses.replace(alone, light=tuple(map(int, light)), sees_time=sees, follows_time=follows)
        located = formulation.surfaces.levels(alone.flat_at(params, at))
        has_witnesses = any(callable(event.when) for event in alone.watched)
        sided = bool(located) or (has_witnesses and bends(alone.flat_at(params, at)))
        levels = (0,) * alone.events + located
        alone = dataclasses.replace(alone, sided=sided, events=len(levels), levels=levels)
        elements = formulation.friction.elements(alone.flat_at(params, at))
        if system.unilateral:
            check_impacts(alone.flat_at(params, at), formulation.friction)
        if elements is None:
            return alone
        found = dataclasses.replace(alone, rows=elements.element_of_row.size, elements=elements.size)
        return dataclasses.replace(found, entangled=_are_entangled(found, alone.flat_at(params, at), elements, at))

    def flat(self, params: PyTree, at: StatesAt) -> Flat:
        """The system over flat vectors."""
        flat = bind(self.system, self.like.shapes, params, at)
        return with_surfaces(flat) if self.events > len(self.system.events) else flat

    def flat_at(self, params: PyTree, at: StatesAt) -> Flat:
        """The system over flat vectors at one time: its inputs are looked up once."""
        return self.flat(pieces_at(params, self.elsewhere, at.t, self.periods(params)), at)

    def states_of(self, t, parts: Parts) -> StatesAt:
        """The further states, at the time t."""
        return StatesAt(self.states.unravelled(parts.z) | self.sampled.unravelled(parts.u), t, parts.q, parts.v)

    def contents(self, t, parts: Parts, args: Arguments) -> tuple[Flat, FrictionElements | None]:
        """The system with its closed contacts, and its elements of dry friction where there are any."""
        flat = in_contact(self.flat_at(args.params, self.states_of(t, parts)), parts.closed > 0.5)
        if not self.rows:
            return flat, None
        elements = self.formulation.friction.elements(flat)
        assert elements is not None  # rows were counted from them
        if args.scales is not None and np.any(elements.is_vector):
            slow = slip_of(elements, t, parts.q, parts.v, args.scales.slow)
            elements = elements._replace(near_rest=jax.lax.stop_gradient(jnp.where(elements.is_vector, slow, 0)))
        return flat, elements

    def mode(self, t, parts: Parts, args: Arguments) -> tuple[Flat, Flat, FrictionElements | None]:
        """The system, the system in its mode σ, and its elements of dry friction on the constraints."""
        flat, elements = self.contents(t, parts, args)
        if elements is None:
            return flat, self.formulation.friction.smoothed(flat, t, parts.q, parts.v), None
        elements = on_constraints(flat, elements, t, parts.q, parts.v, lambda: _left_by_constraints(self, t, parts, args))
        return flat, in_mode(flat, elements, parts.sigma), elements

    @property
    def as_written(self) -> "EquationsOfMotion":
        """The same, whose functions are not held on the sides of surfaces: as programs that tell what follows the time."""
        return dataclasses.replace(self, sided=False)

    def on_held_sides(self, t, parts: Parts, args: Arguments) -> tuple[Any, Parts]:
        """The time and the state at which forces are taken: those themselves, unless functions jump or bend, or nearest by."""
        return on_held_sides(self.contents(t, parts, args)[0], t, parts, args, self.levels) if self.sided else (t, parts)

    def decided(self, t, parts: Parts, args: Arguments) -> Parts:
        """With the velocities that follow from the rest: between the ends of steps, those of coordinates without inertia are not kept."""
        if not self.light:
            return parts
        _, mode, _ = self.mode(t, parts, args)
        return parts._replace(v=with_first_order_rates(mode, t, parts.q, parts.v).v)

    @property
    def modes(self) -> int:
        """How many elements of dry friction and contacts change their modes, and events happen."""
        return self.elements + self.contacts + self.events

    @property
    def watched(self) -> tuple[Event, ...]:
        """The events of the system, and surfaces."""
        of_system = tuple(event for _, event in self.system.events)
        return of_system + (CROSSING,) * (self.events - len(of_system))

    @property
    def works(self) -> tuple[str, ...]:
        """Names of the works that are integrated."""
        return (*self.system.terms, PROJECTION) if self.formulation.works else ()

    @property
    def size(self) -> int:
        """n, the number of coordinates."""
        return self.like.size

    @property
    def sampled_names(self) -> tuple[str, ...]:
        """Names of the sampled states, in their order in y."""
        return tuple(self.sampled.shapes)

    @property
    def varying_periods(self) -> tuple[bool, ...]:
        """Of which sampled states the period depends on params."""
        return tuple(callable(sampled(self.system)[name].every) for name in self.sampled_names)

    def periods(self, params: PyTree) -> list[Float[Array, ""]]:
        """Those of the sampled states."""
        return [period(self.system, name, at_time(params, 0.0)[0]) for name in self.sampled_names]

    @property
    def controlled(self) -> tuple[bool, ...]:
        """Which of the first entries of y set the steps by their error: velocities that follow from the rest do not."""
        followed = {self.size + i for i in self.light}
        return tuple(i not in followed for i in range(2 * self.size + self.states.size))

    @property
    def sizes(self) -> tuple[int, ...]:
        """Of the parts of y."""
        beside = self.states.size, self.sampled.size, len(self.works)
        of_friction = self.rows, self.elements, min(self.elements, 1), self.elements
        of_events = self.events, self.events, self.seen, min(self.events, 1)
        return (self.size, self.size, *beside, *of_friction, *[self.contacts] * 5, *of_events)

    @property
    def width(self) -> int:
        """The size of y."""
        return sum(self.sizes)

    def parts(self, y) -> Parts:
        """y, taken apart."""
        return Parts(*jnp.split(y, np.cumsum(self.sizes)[:-1]))

    @property
    def seen(self) -> int:
        """How many numbers are recorded of an event, where there are any: the time, q, q̇ and the states."""
        return 1 + len(self.controlled) + self.sampled.size if self.system.events else 0

    @property
    def projection(self) -> Projection | None:
        """What puts steps back on the constraints, and on s = 0 where friction sticks, if anything has to."""
        chosen = self.formulation.stabilisation.projection()
        if self.elements or self.contacts or self.light:
            return chosen or Projection()
        return chosen if self.system.constraints else None

    def at_start(self, at: StatesAt, params) -> Parts:
        """y at the start, apart from its mode, on the constraints already: the sampled states are updated there."""
        _, t, q, v = at
        args, zeros = Arguments(params), lambda size: jnp.zeros(size, q.dtype)
        z, u = (ravelled({name: at.values[name] for name in of.shapes}, q.dtype) for of in (self.states, self.sampled))
        of_friction = map(zeros, (self.elements, min(self.elements, 1), self.elements))
        of_contact = zeros(self.contacts), zeros(self.contacts), zeros(self.contacts) + t, *map(zeros, (self.contacts, self.contacts))
        of_events = zeros(self.events), zeros(self.events), zeros(self.seen), zeros(min(self.events, 1))
        works, slipping = zeros(len(self.works)), zeros(self.rows) + 1  # for the time being
        parts = Parts(q, v, z, u, works, slipping, *(*of_friction, *of_contact, *of_events))
        if self.sampled.size:
            y = self.updated(t, parts.y, args, [True] * len(self.sampled_names))
            parts = self.parts(self.projected(t, y, args) if self.projection else y)._replace(works=parts.works)
        return parts

    def updated(self, t, y, args: Arguments, due: Sequence[Bool[Array, ""] | bool]) -> Float[Array, " y"]:
        """y after an update of the sampled states that are `due`, each of which sees the values before."""
        return _updated(self, t, y, args, tuple(due))

    def acceleration(self, mode: Flat, t, q, v) -> SaddlePoint:
        """q̈ and λ of the system in its mode."""
        feedback = self.formulation.stabilisation.feedback()
        return scalarised(lambda t, q, v: constrained_acceleration(mode, t, q, v, feedback), apart=True)(t, q, v)

    def accelerated(self, t, parts: Parts, args: Arguments, is_free: bool = False) -> SaddlePoint:
        """q̈ and λ in the mode of `parts`, or of the system `is_free` of its contacts: traced once, however often it is asked for."""
        return _accelerated(self, t, parts, self._without_scales(args), is_free)

    def _without_scales(self, args):
        """Scales are for slips that may turn."""
        return args._replace(scales=None) if self.rows == self.elements else args

    def friction(self, t, parts: Parts, args: Arguments, stabilised: bool = False) -> Friction:
        """Friction in the mode of `parts`, without or with the feedback of a stabilisation: traced once, however often it is asked for."""
        stabilised &= self.formulation.stabilisation.feedback() is not None
        return _friction(self, t, parts, self._without_scales(args), stabilised)

    def where_closed(self, parts: Parts, function: Callable, otherwise: Callable) -> Any:
        """`function()`, or `otherwise()` where there are contacts, but no friction, and all of them are open: at less cost."""
        return jax.lax.cond(jnp.any(parts.closed > 0.5), function, otherwise) if self.contacts and not self.rows else function()

    def rates(self, t, y, args):
        """ẏ."""
        return _rates(self, t, y, args)

    def rates_and_friction(
        self, t, parts: Parts, args: Arguments, impulse: Impulse | None = None, correction: Correction | None = None, shares: Any = True
    ) -> tuple[Array, Friction]:
        """ẏ and the friction in the mode of `parts`, by one evaluation, where friction and contact alone change modes; or, of an `impulse`
        that happens, the friction of an impact; or of a `correction`, that. For rates alone, loads need not be shared.
        """
        correction, shares = jax.tree.map(lambda x: jnp.asarray(x, bool), (correction, shares))  # so that it is traced once
        args = args if self.sided else self._without_scales(args)
        return _rates_and_friction(self, t, parts, args, impulse, correction, shares)

    @property
    def corrections(self) -> tuple[int, int]:
        """How many evaluations put positions back on their constraints, and how many all of a state: behind positions stand velocities,
        and those that follow from the rest.
        """
        if self.projection is None:
            return 0, 0
        holds = self.system.holonomic or self.contacts or self.light
        of_positions = self.projection.iterations if holds else 0
        return of_positions, of_positions + 1 + bool(self.light)

    def correction(self, k) -> Correction | None:
        """The one of this number, none of a negative one, if there is anything to keep."""
        of_positions, _ = self.corrections
        return Correction((k >= 0) & (k < of_positions), k == of_positions) if self.projection else None

    def next_correction(self, parts: Parts, found: Friction, k) -> Any:
        """The number of the one behind that of this number: Newton's steps square what is left, so that a small one is the last."""
        of_positions, _ = self.corrections
        small = jnp.all(jnp.abs(found.qddot) <= jnp.finfo(parts.q.dtype).eps ** 0.5 * jnp.abs(parts.q))
        return jnp.where(small & (k >= 0) & (k < of_positions), of_positions, k + 1)

    def where_corrected(self, t, parts: Parts, args: Arguments, found: Friction, k, otherwise: Array) -> Float[Array, " y"]:
        """y with the correction of this number, or of a negative one `otherwise`; what follows a change of y may take long."""
        follows = bool(self.works) or self.rows != self.elements
        corrected = lambda: self.corrected(t, parts, args, found, k)
        return jax.lax.cond(k >= 0, corrected, lambda: otherwise) if follows else jnp.where(k >= 0, corrected(), otherwise)

    def corrected(self, t, parts: Parts, args: Arguments, found: Friction, k) -> Float[Array, " y"]:
        """y with what the correction of this number has found."""
        q, v, (of_positions, all_of_them) = parts.q, parts.v, self.corrections
        if of_positions:
            moved = q + found.qddot
            if self.light:
                moved = self._with_sliders_returned(t, parts, args, moved)
            q = jnp.where(k < of_positions, moved, q)
        v = jnp.where(k == of_positions, corrected(v, found.qddot), v)
        return self.put_back(t, parts, q, jnp.where(k == all_of_them - 1, found.qdot, v) if self.light else v, args)

    def _with_sliders_returned(self, t, parts: Parts, args: Arguments, q):
        _, mode, _ = self.mode(t, parts, args)
        return q if mode.sliders is None else with_sliders_returned(mode, t, q)

    def put_back(self, t, parts: Parts, q, v, args: Arguments) -> Float[Array, " y"]:
        """y with this state in the place of its own, which was near: the work of that is counted, and slip turns with it."""
        flat, mode, elements = self.mode(t, parts, args)
        works, sigma = parts.works, parts.sigma
        if self.works:
            lift = energy_exchange(mode, t, q, v)[0] - energy_exchange(mode, t, parts.q, parts.v)[0]
            works = works.at[self.works.index(PROJECTION)].add(lift)
        if elements is not None:
            sigma = redirected(elements, sigma, parts.held > 0, t, q, v)
        return parts._replace(q=q, v=v, works=works, sigma=sigma).y

    def rubbing(self, t, parts: Parts, args: Arguments) -> tuple[Flat, FrictionElements]:
        """The system with its closed contacts, and its elements of dry friction, of which there may be none."""
        flat, elements = self.contents(t, parts, args)
        if elements is not None:
            return flat, elements
        return (smooth := self.formulation.friction.smoothed(flat, t, parts.q, parts.v)), without_friction(smooth)

    def projected(self, t, y, args):
        """y, put back on the constraints."""
        return _projected(self, t, y, args, False)

    def in_new_mode(self, t, y, args):
        """y, which kept the constraints of one mode of friction, put on those of another, which differ in the velocities alone."""
        return _projected(self, t, y, args, not self.light)

    def exhausted(self, y):
        """Whether there were more transitions than allowed."""
        return jnp.any(self.parts(y).transitions > self.formulation.friction.max_transitions)


def _are_entangled(equations: EquationsOfMotion, flat: Flat, elements: FrictionElements, at: StatesAt) -> bool:
    """Whether a share of friction is to be found beside its mode, or constraints may turn or drive a slip."""
    constraints = lambda t: (flat.holonomic(t, at.q), flat.nonholonomic(t, at.q, at.v))
    turned = bool(equations.system.constraints) and equations.rows != equations.elements
    return bool(may_share(flat, elements)) or turned or bool(used_arguments(constraints, at.t)[0])


def _on_held_sides(equations: EquationsOfMotion, at: Callable, t, parts: Parts, args) -> tuple[Array, Any]:
    """Rates, and what else `at(t, parts)` finds, on the sides that are held. Beyond a surface they are continued from there by their
    slopes, so that the stages of a step that ends there are those of a smooth motion.
    """
    if not equations.sided:
        return at(t, parts)
    of_state = lambda t, parts: (t, parts.q, parts.v, parts.z)
    held = equations.on_held_sides(t, parts, args)
    rates, found = at(*held)
    there, here = jax.lax.stop_gradient((of_state(*held), of_state(t, parts)))
    along = lambda t, q, v, z: at(t, held[1]._replace(q=q, v=v, z=z))[0]
    more = jax.lax.stop_gradient(jax.jvp(along, there, jax.tree.map(jnp.subtract, here, there))[1])
    return equations.parts(rates + jnp.where(jnp.isfinite(more), more, 0))._replace(q=parts.v).y, found


@jitted  # so that diffrax's many calls trace it once
def _rates(equations: EquationsOfMotion, t, y, args):
    moving = equations.decided(t, equations.parts(y), args)
    return _on_held_sides(equations, lambda t, parts: (_rates_at(equations, t, parts, args), None), t, moving, args)[0]


def _rates_at(equations: EquationsOfMotion, t, parts: Parts, args) -> Array:
    q, v, works, sigma, held = parts.q, parts.v, parts.works, parts.sigma, parts.held
    flat, mode, elements = equations.mode(t, parts, args)
    of = lambda is_free: lambda: equations.accelerated(t, parts, args, is_free).x
    qddot = equations.where_closed(parts, of(False), of(True))
    if equations.light:  # what follows from the rest has no rate of its own
        qddot = qddot.at[np.array(equations.light, int)].set(0)
    rates = ravelled(flat.state_rates(t, q, v), q.dtype)
    powers = listed_powers(mode, t, q, v) if equations.works else works
    stuck = parts.time_stuck if elements is None else jnp.maximum(sticking(elements, sigma).astype(q.dtype), held)
    resting = Parts(*(jnp.zeros_like(part) for part in parts))
    return resting._replace(q=v, v=qddot, z=rates, works=powers, time_stuck=stuck).y


@jitted
def _rates_and_friction(
    equations: EquationsOfMotion, t, parts: Parts, args, impulse: Impulse | None, correction: Correction | None, shares
) -> tuple[Array, Friction]:
    at = lambda t, parts: _rates_and_friction_at(equations, t, parts, args, impulse, correction, shares)
    rates, found = _on_held_sides(equations, at, t, parts, args)
    return rates, found._replace(qdot=parts.v) if equations.sided else found


def _rates_and_friction_at(equations: EquationsOfMotion, t, parts: Parts, args, impulse, correction, shares) -> tuple[Array, Friction]:
    q, v = parts.q, parts.v
    flat, elements = equations.rubbing(t, parts, args)
    if equations.elements:
        elements = on_constraints(flat, elements, t, q, v, lambda: _left_by_constraints(equations, t, parts, args))
    there, rubbing = (flat, elements) if impulse is None else of_impulses(flat, elements, t, q, v, impulse)
    assert rubbing is not None  # as many as there are elements
    found = friction(there, rubbing, parts.sigma, t, q, v, impulse=impulse, correction=correction, shares=shares)
    v, qddot = found.qdot, found.qddot.at[np.array(equations.light, int)].set(0)
    powers = listed_powers(in_mode(flat, elements, parts.sigma), t, q, v) if equations.works else parts.works
    stuck = jnp.maximum(sticking(elements, parts.sigma).astype(q.dtype), parts.held)
    resting = Parts(*(jnp.zeros_like(part) for part in parts))
    z = ravelled(flat.state_rates(t, q, v), q.dtype)
    return resting._replace(q=v, v=qddot, z=z, works=powers, time_stuck=stuck).y, found


@jitted
def _accelerated(equations: EquationsOfMotion, t, parts: Parts, args, is_free) -> SaddlePoint:
    _, mode, _ = equations.mode(t, parts, args)
    return equations.acceleration(free(mode) if is_free else mode, t, parts.q, parts.v)


@jitted
def _left_by_constraints(equations: EquationsOfMotion, t, parts: Parts, args) -> Left:
    flat, elements = equations.contents(t, parts, args)
    assert elements is not None  # asked where there is friction
    return left_by_constraints(flat, elements, t, parts.q, parts.v)


@jitted
def _friction(equations: EquationsOfMotion, t, parts: Parts, args, stabilised) -> Friction:
    flat, _, elements = equations.mode(t, parts, args)
    assert elements is not None  # asked where there is friction
    feedback = equations.formulation.stabilisation.feedback() if stabilised else None
    return friction(flat, elements, parts.sigma, t, parts.q, parts.v, feedback)


@jitted
def _updated(equations: EquationsOfMotion, t, y, args, due):
    parts = equations.parts(y)
    flat = equations.flat_at(args.params, equations.states_of(t, parts))
    new, old = flat.updates(t, parts.q, parts.v), equations.sampled.unravelled(parts.u)
    changed = {name: jax.tree.map(functools.partial(jnp.where, on), new[name], old[name]) for name, on in zip(old, due, strict=True)}
    return parts._replace(u=ravelled(changed, y.dtype)).y


@jitted
def _projected(equations: EquationsOfMotion, t, y, args, found):
    parts = equations.parts(y)
    t, there = equations.on_held_sides(t, parts, args)
    q, v = there.q, there.v
    flat, mode, _ = equations.mode(t, there, args)
    assert equations.projection is not None  # asked where there is something to keep
    projection = equations.projection
    of_none = (lambda: (q, v)) if flat.rows == equations.contacts else lambda: projection.project(free(mode), t, q, v, found=found)
    on_q, on_v = equations.where_closed(parts, lambda: projection.project(mode, t, q, v, found=found), of_none)
    return equations.put_back(t, parts, parts.q + (on_q - q), parts.v + (on_v - v), args)
