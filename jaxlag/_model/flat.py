"""The system over flat vectors: what the mechanics works on."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from .._program.conditions import zeros_like
from .._program.sparse_jacobian import empty_rows
from .contact import PoissonRestitution
from .event import Every, merged
from .injection import asks_for, call, described, needs
from .reading import Source, StatesAt
from .signal import at_time, origin_of
from .state_values import of_first_order, sampled, shaped_like
from .states import flowing, values_at
from .system import CONSTRAINT_SLOTS, System, role


class Flat(NamedTuple):
    """A system with its parameters, over flat vectors q, v of length n and λ of length m: what the mechanics works on."""

    lagrangian: Callable[..., Float[Array, ""]]  # L(t, q, v)
    lagrangians: dict[str, Callable[..., Float[Array, ""]]]  # its terms
    dissipations: dict[str, Callable[..., Float[Array, ""]]]  # D(t, q, v, λ)
    forces: dict[str, Callable[..., Float[Array, " n"]]]  # Q(t, q, v, λ)
    holonomic: Callable[..., Float[Array, " h"]]  # g(t, q), and zeros of the contacts that are open
    bilateral: Callable[..., Float[Array, " b"]]  # g(t, q) alone
    gaps: Callable[..., Float[Array, " c"]]  # of all contacts, (t, q)
    restitution: Callable[..., Float[Array, " c"]]  # e(t, speeds of approach)
    nonholonomic: Callable[..., Float[Array, " k"]]  # a(t, q, v)
    position: Callable[..., PyTree]  # x(t, q) of a position map
    unravel: Callable[[Float[Array, " n"]], PyTree]
    unravel_multipliers: Callable[[Float[Array, " m"]], dict[str, PyTree]]
    state_rates: Callable[..., dict[str, PyTree]]  # ż(t, q, v) of the states of first order
    updates: Callable[..., dict[str, PyTree]]  # u(t, q, v) of the sampled ones
    witnesses: Callable[..., Float[Array, " e"]]  # w(t, q, v, multipliers) of the events
    happened: Callable[..., tuple[Float[Array, " n"], Float[Array, " n"], dict[str, PyTree]]]  # q, q̇ and states after an event, by name
    needs_multipliers: bool
    events_need_multipliers: bool
    holonomic_names: tuple[str, ...]
    contacts: dict[str, tuple[int, ...]]  # the shapes of their gaps
    poisson: tuple[bool, ...]  # which of all gaps follow Poisson's law
    terms: tuple[str, ...]
    rows: int  # of G, those of the user's constraints
    rows_of_bilateral: int  # of those, the first, of `holonomic` alone
    massless: tuple[int, ...]  # coordinates of which M has rows of zeros, as L is written
    source: Source  # what it was bound from
    closed: Bool[Array, " c"] | None = None  # those of the contacts, where it was chosen
    held: dict[str, np.ndarray] = {}  # noqa: RUF012 - rows of G beyond those, with which a dissipation term sticks
    sliders: Any = None  # in a mode of friction, what it alone resists and has no inertia
    stand_ins: tuple[int, ...] = ()  # coordinates of which M has a mass, as large as those of others, that nothing feels

    @property
    def gap_count(self) -> int:
        """c: how many gaps all contacts have."""
        return sum(map(math.prod, self.contacts.values()))

    def by_contact(self, of_gaps: Array) -> dict[str, Array]:
        """What is known of all gaps, by contact and in the shape of its gaps."""
        return dict(zip(self.contacts, _apart(of_gaps, self.contacts.values()), strict=True))


def bind(system: System, like: PyTree, params: PyTree, states: StatesAt | None = None) -> Flat:
    """The system over flat vectors, for coordinates structured `like` these, which need be shapes only."""
    source = Source.of(system, like, params, states)
    return _flat(source, source.read(_coordinates_without_inertia, _flat))


def read_once(flat: Flat, question: Callable[[Flat, Any, Any, Any], Any], stated: bool = False) -> Any:
    """What `question(flat, t, q, v)` sees in the programs of a system, whatever its numbers: asked once for each system and form of its
    arguments, and for each `variant`; or for the system as it was `stated`, where none matters.
    """
    return (flat.source._replace(variants=()) if stated else flat.source).read(question, bound_from)


def bound_from(source: Source) -> Flat:
    """The system as it was bound, before it was varied."""
    return bind(source.system, source.like, source.params, source.states)


def variant(flat: Flat, of: Callable[[Flat, Any, Any, Any], Flat], **changes: Any) -> Flat:
    """The system with some changes, as `of(flat, t, q, v)` makes them where numbers are unknown."""
    return flat._replace(source=flat.source.with_variant(of), **changes)


def _flat(source: Source, massless: tuple[int, ...] = ()) -> Flat:
    system, states = source.system, source.states
    bound = _Bound(system, source.like, source.params, {} if states is None else states.values)
    if states is not None:
        bound.let_flow(*states[1:])
    return Flat(
        lagrangian=bound.lagrangian,
        lagrangians={name: partial(bound.energy, (name, L)) for name, L in system.lagrangian},
        dissipations={name: partial(bound.dissipation, (name, D)) for name, D in system.dissipation},
        forces={name: partial(bound.force, (name, Q)) for name, Q in system.force},
        holonomic=bound.holonomic,
        bilateral=bound.bilateral,
        gaps=bound.gaps,
        restitution=bound.restitution,
        nonholonomic=bound.nonholonomic,
        position=bound.position,
        unravel=bound.unravel,
        unravel_multipliers=bound.unravel_multipliers,
        state_rates=bound.state_rates,
        updates=bound.updates,
        witnesses=bound.witnesses,
        happened=bound.happened,
        needs_multipliers=any(asks_for(function, "multipliers") for _, function in (*system.dissipation, *system.force)),
        events_need_multipliers=any(callable(event.when) and asks_for(event.when, "multipliers") for _, event in system.events),
        holonomic_names=tuple(name for name, _ in (*system.holonomic, *system.unilateral)),
        contacts=bound.gap_shapes,
        poisson=tuple(
            isinstance(law, PoissonRestitution)
            for (_, law), shape in zip(system.laws, bound.gap_shapes.values(), strict=True)
            for _ in range(math.prod(shape))
        ),
        terms=system.terms,
        rows=bound.rows,
        rows_of_bilateral=bound.rows_of_bilateral,
        massless=massless,
        source=source,
    )


def _coordinates_without_inertia(flat: Flat, t: Any, q: Any, v: Any) -> tuple[int, ...]:
    """Coordinates of which M has rows of zeros."""
    momentum = lambda v: jax.grad(flat.lagrangian, argnums=2)(t, q, v)
    return tuple(int(i) for i in empty_rows(lambda dv: jax.jvp(momentum, (v,), (dv,))[1], v))


class _Bound:
    """The functions of a system with their parameters, over flat vectors."""

    def __init__(self, system: System, like: PyTree, params: PyTree, states: Mapping[str, PyTree]):
        self.system, self.params, self.states = system, params, states
        self.zeros = zeros_like(like)
        zero, self.unravel = ravel_pytree(self.zeros)
        t = jnp.zeros((), zero.dtype)
        shapes = [
            jax.eval_shape(lambda slot=slot, term=term, v=zero if has_velocity else None: self.value(slot, term, t, zero, v))
            for slot, has_velocity in CONSTRAINT_SLOTS.items()
            for term in getattr(system, slot)
        ]
        residuals, self.unravel_residuals = ravel_pytree([jax.tree.map(lambda s: jnp.zeros(s.shape, zero.dtype), s) for s in shapes])
        self.rows = residuals.size
        first = len(system.holonomic)
        self.rows_of_bilateral = sum(int(np.prod(s.shape)) for s in jax.tree.leaves(shapes[:first]))
        self.gap_shapes = {name: shapes[first + i].shape for i, (name, _) in enumerate(system.unilateral)}

    def value(self, slot, term, t, q, v, **more):
        """What one of the user's functions returns."""
        name, function = term
        return self._called(function, role(slot, name), t, q, v, **more)

    def _called(self, function, label, t, q, v, **more):
        params, now = at_time(self.params, t)
        state = {"t": now, "q": self.unravel(q)} | ({} if v is None else {"qdot": self.unravel(v)})
        return call(function, label, params, **state, **values_at(self.states, t), states=self.states, **more)

    def lagrangian(self, t, q, v):
        return sum((self.energy(term, t, q, v) for term in self.system.lagrangian), start=jnp.zeros((), q.dtype))

    def energy(self, term, t, q, v):
        return jnp.asarray(self.value("lagrangian", term, t, q, v), q.dtype)

    def dissipation(self, term, t, q, v, multipliers):
        return jnp.asarray(self.value("dissipation", term, t, q, v, multipliers=self.unravel_multipliers(multipliers)), q.dtype)

    def force(self, term, t, q, v, multipliers):
        given = self.value("force", term, t, q, v, multipliers=self.unravel_multipliers(multipliers))
        return flat_like(self.zeros, role("force", term[0]), given)

    def bilateral(self, t, q):
        return self._residuals("holonomic", t, q, None)

    def gaps(self, t, q):
        return self._residuals("unilateral", t, q, None)

    def holonomic(self, t, q):
        return jnp.concatenate([self.bilateral(t, q), jnp.zeros(sum(map(math.prod, self.gap_shapes.values())), q.dtype)])

    def restitution(self, t, speeds):
        def of_one(name, given, speed):
            if callable(given):
                given = call(given, f"`restitution` of {name!r}", at_time(self.params, t)[0], speed=speed)
            e = jnp.broadcast_to(jnp.asarray(given, speed.dtype), speed.shape)
            return jnp.where(e < 0, 0, jnp.where(e > 1, 1, e))  # not `clip`, which halves the derivative at 0 and 1

        of_contacts = zip(self.system.restitution, _apart(speeds, self.gap_shapes.values()), strict=True)
        found = [jnp.ravel(of_one(*term, speed)) for term, speed in of_contacts]
        return jnp.concatenate([jnp.zeros(0, speeds.dtype), *found])

    def nonholonomic(self, t, q, v):
        return self._residuals("nonholonomic", t, q, v)

    def _residuals(self, slot, t, q, v):
        parts = [ravel_pytree(self.value(slot, term, t, q, v))[0].astype(q.dtype) for term in getattr(self.system, slot)]
        return jnp.concatenate([jnp.zeros(0, q.dtype), *parts])

    def position(self, at, t, q):
        return jax.tree.map(lambda x: jnp.asarray(x, q.dtype), self._called(at, "a position map", t, q, None))

    def state_rates(self, t, q, v):
        return self._of_states("rate", {name: state.rate for name, state in of_first_order(self.system).items()}, t, q, v)

    def updates(self, t, q, v):
        return self._of_states("update", {name: state.update for name, state in sampled(self.system).items()}, t, q, v)

    def witnesses(self, t, q, v, multipliers):
        found = [self._witness(name, event.when, t, q, v, multipliers) for name, event in self.system.events]
        return jnp.stack(found) if found else jnp.zeros(0, q.dtype)

    def _witness(self, name, when, t, q, v, multipliers):
        """A function that passes through zero where the event happens; one of times changes its sign at each of them."""
        if isinstance(when, str):  # an impact is seen otherwise
            return jnp.ones((), q.dtype)
        if isinstance(when, tuple):
            until = jnp.asarray(np.array(when) - origin_of(self.params) - t, q.dtype)
            return jnp.prod(jnp.where(until < 0, -1, 1)) * jnp.min(jnp.abs(until))
        if isinstance(when, Every):
            given = call(when.period, f"`period` of {name!r}", at_time(self.params, t)[0]) if callable(when.period) else when.period
            return jnp.sin(jnp.pi * (jnp.fmod(origin_of(self.params), 2 * given) + t) / jnp.asarray(given, q.dtype))
        w = self._called(when, f"`when` of {name!r}", t, q, v, multipliers=self.unravel_multipliers(multipliers))
        return jnp.asarray(w, q.dtype)

    def happened(self, name, t, q, v):
        event = dict(self.system.events)[name]
        given = self._called(event.then, f"`then` of {name!r}", t, q, v)
        now = {"q": self.unravel(q), "qdot": self.unravel(v), "states": dict(values_at(self.states, t))}
        after = merged(f"`then` of {name!r}", now, given)
        return ravel_pytree(after["q"])[0], ravel_pytree(after["qdot"])[0], after["states"]

    def _of_states(self, what, functions, t, q, v):
        values = values_at(self.states, t)
        found = {}
        for name, function in functions.items():
            label = f"`{what}` of state {name!r}"
            found[name] = shaped_like(label, values[name], self._called(function, label, t, q, v))
        return found

    def let_flow(self, t, q, v):
        """From here on the states change with time, as they do at this state: what differentiates by t sees their rates."""
        values, rates = self.states, self.state_rates(t, q, v)
        derivatives = [values, rates]
        if any(needs(g, name) for _, g in self.system.holonomic for name in rates):  # of g the second derivative by time is needed
            of = lambda t, q, states: _Bound(self.system, self.zeros, self.params, values | states).state_rates(t, q, v)
            flown = {name: values[name] for name in rates}
            derivatives.append(jax.jvp(of, (t, q, flown), (jnp.ones_like(t), v, rates))[1])
        self.states = values | {name: flowing(t, *(of_order[name] for of_order in derivatives)) for name in rates}

    def unravel_multipliers(self, multipliers):
        return dict(zip(self.system.constraints, self.unravel_residuals(multipliers[: self.rows]), strict=True))


def _apart(values: Array, shapes: Iterable[tuple[int, ...]]) -> Iterator[Array]:
    """Arrays of these shapes, of which there are the values one after the other."""
    start = 0
    for shape in shapes:
        end = start + math.prod(shape)
        yield values[start:end].reshape(shape)
        start = end


def flat_like(like: PyTree, label: str, given: PyTree) -> Float[Array, " n"]:
    """What a force returned, as a flat vector in the order of the coordinates `like`.

    Entries of mappings may be left out, lists stand for arrays, and a plain 0 for zeros of any shape.
    """
    parts = jax.tree_util.tree_flatten_with_path(given)[0]
    places = jax.tree_util.tree_flatten_with_path(like)[0]
    for path, _ in parts:
        if not any(path[: len(place)] == place for place, _ in places):
            at = jax.tree_util.keystr(path) or "without a name"
            raise ValueError(f"{label} must be shaped like q, but returned an entry {at} that is not in q. {SHAPED}")
    return jnp.concatenate([_part(place, leaf, parts, label) for place, leaf in places])


SHAPED = "Return one entry for each coordinate; where q is a mapping, coordinates without a force may be left out."


def _part(place, coordinate, parts, label):
    """The force on one array of coordinates, flat."""
    label, shape = f"{label}{jax.tree_util.keystr(place)}", coordinate.shape
    own = [(path[len(place) :], x) for path, x in parts if path[: len(place)] == place]
    if not own:
        known = max((_common(place, path) for path, _ in parts), default=0)
        if not (known < len(place) and isinstance(place[known], jax.tree_util.DictKey)):
            raise ValueError(f"{label} must be real and of shape {shape}, but nothing was returned. {SHAPED}")
        return jnp.zeros(coordinate.size, coordinate.dtype)
    flat = []
    for path, x in own:
        rest = shape[len(path) :]
        in_list = len(path) <= len(shape) and all(isinstance(key, jax.tree_util.SequenceKey) for key in path)
        is_zero = isinstance(x, np.ndarray) and x.shape == () and x == 0  # a plain one
        if not in_list or (x.shape != rest and not is_zero):
            of = f" of {len(own)} entries with" if path else ""
            raise ValueError(f"{label} must be real and of shape {shape}, but is{of} {described(x)}. {SHAPED}")
        flat.append(jnp.ravel(jnp.broadcast_to(jnp.asarray(x, coordinate.dtype), rest)))
    if sum(x.size for x in flat) != coordinate.size:
        raise ValueError(f"{label} must be real and of shape {shape}, but has {len(own)} entries. {SHAPED}")
    return jnp.concatenate(flat)


def _common(one: tuple, other: tuple) -> int:
    """How many keys two paths have in common."""
    return next((i for i, pair in enumerate(zip(one, other, strict=False)) if pair[0] != pair[1]), min(len(one), len(other)))


def rows_by_name(flat: Flat) -> dict[str, np.ndarray]:
    """Which rows of G, and entries of λ, belong to which constraint."""
    with jax.ensure_compile_time_eval():
        rows = jax.tree.map(np.asarray, flat.unravel_multipliers(jnp.arange(flat.rows, dtype=float)))
    return {name: np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(rows[name])]).astype(int) for name in rows}
