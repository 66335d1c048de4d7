"""The mechanical system as its user states it, and the same system over flat vectors."""

import dataclasses
from collections.abc import Callable, Collection, Mapping
from typing import Any

from .contact import Contact, NewtonRestitution, PoissonRestitution
from .event import Event, events_of
from .injection import check_function, needs
from .pickling import picklable, unpickled
from .states import Named, Sampled, State, states_of

Terms = tuple[tuple[str, Callable], ...]
Slot = Any  # a function, a mapping from names to functions, or None: `_terms` checks it
SLOTS = ("lagrangian", "dissipation", "force", "holonomic", "unilateral", "nonholonomic")
CONSTRAINT_SLOTS = {
    "holonomic": False,
    "unilateral": False,
    "nonholonomic": True,
}  # in the order of the rows of G; whether velocities are given to it
EXPLICIT_TIME = "time"  # the name, among the powers, of the energy that enters through explicit time in L


@dataclasses.dataclass(frozen=True, init=False, repr=False)
class System:
    r"""A mechanical system, given by its energies, forces and constraints.

    $$ \frac{d}{dt}\frac{\partial L}{\partial\dot q} - \frac{\partial L}{\partial q}
       + \frac{\partial D}{\partial\dot q} = Q + G^T\lambda, \qquad g(t, q) = 0, \qquad a(t, q, \dot q) = 0 $$

    Each slot takes one function or a mapping of named functions. Terms add up, and results are reported under their names; a single
    function has the name of its slot. A function receives exactly the arguments it names: `t`, `q`, `qdot`, `params`, any entry of
    `params` where that is a mapping, the states by their names, and, in `dissipation` and `force`, `multipliers`.

    **Arguments:**

    - `lagrangian`: L(t, q, q̇), a real scalar.
    - `dissipation`: D(t, q, q̇), a real scalar; the generalized force is −∂D/∂q̇.
    - `force`: Q(t, q, q̇), with the structure and shapes of q; lists may stand for vectors, and if q is a mapping, coordinates without a
      force may be omitted.
    - `holonomic`: g(t, q), an array of any shape or a pytree of arrays, kept at zero.
    - `nonholonomic`: a(t, q, q̇), likewise, affine in q̇, kept at zero.
    - `unilateral`: gaps g(t, q) ≥ 0 of contacts, each a real number or an array of them, or `Contact(gap, restitution)`: a table, a stop, a
      slack string. λ ≥ 0 pushes along +∇g while g = 0, and is 0 while the contact is open; closing is an impact.
    - `one_sided`: a name or names of holonomic constraints that push and never pull, as a table does: g ≥ 0 and λ ≥ 0, where λ > 0 pushes
      along +∇g. The motion is still computed with g = 0; `Trajectory.pulling()`, the printed trajectory, `examine` and `plot.forces` report
      times with λ < 0, at which the contact would have opened.
    - `states`: by name, states in addition to q: `State(rate)`, of first order, ż = rate(…), or `Sampled(update, every)`, which changes
      only at sample times, as in a digital controller.
    - `events`: by name, `Event(when, then)`: what happens when a function of the state passes through zero, or at given times;
      `with_events(...)` replaces them.
    - `units`: units as text, by the name of a coordinate, a state, a parameter, a term or a channel of an experiment, and of `"t"` and
      `"energy"`, e.g. `{"t": "s", "x": "m", "b": "N s/m"}`. They label pictures, fits and tables; nothing is computed with them.

    **Fields:** `lagrangian`, `dissipation`, `force`, `holonomic`, `unilateral` and `nonholonomic`, each a tuple of (name, function);
    `dict(system.lagrangian)` can be passed to another system; `restitution` and `laws`, tuples of (name, number or function) and of (name,
    law); `one_sided`, a tuple of names; `states`, `events` and `units`, tuples of (name, state), (name, event) and (name, unit).

    Any consistent set of units. Functions may return plain numbers, integers or lists, which become floating arrays. A system is immutable,
    hashable and compared by its functions. Create it once: a system created again from new functions is compiled again. Its compiled
    programs, and everything that its functions close over, stay in memory until `jax.clear_caches()`.

    **Raises:** `TypeError` if a slot holds no function, `states` no state or `units` no text; `ValueError` if two terms have the same
    name, if `one_sided` names no holonomic constraint, or if a position constraint depends on a state that q̇ drives or that jumps.

    **Source:** Goldstein, Classical Mechanics, 3rd ed., sections 1.5 and 2.4; sign of λ: M q̈ = f + Gᵀλ.

    ```python
    import jaxlag as jl

    def lagrangian(q, qdot, m, c):
        return 0.5 * m * qdot**2 - 0.5 * c * q**2

    system = jl.System(lagrangian, dissipation=lambda qdot, b: 0.5 * b * qdot**2)
    jl.acceleration(system, q=1.0, qdot=0.5, params={"m": 2.0, "c": 8.0, "b": 1.0}).qddot  # -4.25
    ```
    """

    lagrangian: Terms
    dissipation: Terms
    force: Terms
    holonomic: Terms
    unilateral: Terms
    nonholonomic: Terms
    restitution: tuple[tuple[str, Any], ...]
    laws: tuple[tuple[str, NewtonRestitution | PoissonRestitution], ...]
    one_sided: tuple[str, ...]
    states: Named
    events: tuple[tuple[str, Event], ...]
    units: tuple[tuple[str, str], ...]

    def __init__(
        self,
        lagrangian: Slot,
        *,
        dissipation: Slot = None,
        force: Slot = None,
        holonomic: Slot = None,
        unilateral: Slot | Contact = None,
        nonholonomic: Slot = None,
        one_sided: Any = (),  # a name, or a collection of names
        states: Mapping[str, State | Sampled] | None = None,
        events: Mapping[str, Event] | None = None,
        units: Mapping[str, str] | None = None,
    ):
        contacts = _contacts(unilateral)
        gaps = {name: contact.gap for name, contact in contacts.items()}
        object.__setattr__(self, "restitution", tuple((name, contact.restitution) for name, contact in contacts.items()))
        object.__setattr__(self, "laws", tuple((name, contact.law) for name, contact in contacts.items()))
        for slot, given in zip(SLOTS, (lagrangian, dissipation, force, holonomic, gaps, nonholonomic), strict=True):
            object.__setattr__(self, slot, _terms(slot, given))
        if not self.lagrangian:
            raise TypeError("`lagrangian` must be a function L(q, qdot), but none was given. Pass at least the kinetic energy.")
        for name in self.terms:
            if self.terms.count(name) > 1:
                raise ValueError(
                    f"terms must have different names, but two are called {name!r}. "
                    "Rename one: powers and multipliers are reported by name."
                )
        given = one_sided if isinstance(one_sided, Collection) and not isinstance(one_sided, str) else (one_sided,)
        known = [name for name, _ in self.holonomic]
        for name in given:
            if name not in known:
                there = ", ".join(known) or "none"
                raise ValueError(f"`one_sided` must name holonomic constraints, but holds {name!r}. There are {there}.")
        object.__setattr__(self, "one_sided", tuple(name for name in known if name in given))
        object.__setattr__(self, "states", states_of(states))
        object.__setattr__(self, "events", events_of(events, contacts))
        object.__setattr__(self, "units", _units(units))
        for slot in ("holonomic", "unilateral"):
            for name, function in getattr(self, slot):
                _check_position(role(slot, name), function, dict(self.states))

    def with_events(self, events: Mapping[str, Event] | None) -> "System":
        """The system with these `events`, by name, in place of its own; None removes them."""
        return self._with(events=events_of(events, [name for name, _ in self.unilateral]))

    def with_terms(self, lagrangian: Mapping[str, Callable] | None = None, dissipation: Mapping[str, Callable] | None = None) -> "System":
        """The system with further terms of L and D.

        **Arguments:** `lagrangian`, `dissipation`: functions by name, as for `System`. **Raises:** `ValueError` if a name is taken.
        """
        changed = {}
        for slot, given in (("lagrangian", lagrangian), ("dissipation", dissipation)):
            for name in given or {}:
                if name in dict(getattr(self, slot)):
                    raise ValueError(f"`{slot}` must have new names, but the system has a term {name!r} already. Rename it.")
            changed[slot] = (*getattr(self, slot), *_terms(slot, given or None))
        return self._with(**changed)

    def with_functions(self, change: Callable[[Callable], Callable]) -> "System":
        """The system with each of its terms as `change(term)` makes it."""
        return self._with(**{slot: tuple((name, change(function)) for name, function in getattr(self, slot)) for slot in SLOTS})

    def _with(self, **changed: Any) -> "System":
        new = object.__new__(System)
        for field in dataclasses.fields(self):
            object.__setattr__(new, field.name, changed.get(field.name, getattr(self, field.name)))
        return new

    def __copy__(self) -> "System":
        return self

    def __deepcopy__(self, memo: Any) -> "System":
        return self

    def __reduce__(self) -> Any:
        references = {slot: {name: picklable(f, role(slot, name)) for name, f in getattr(self, slot)} for slot in SLOTS}
        restitution = {name: picklable(e, f"`restitution` of {name!r}") if callable(e) else e for name, e in self.restitution}
        return _unpickled, (references, self.one_sided, dict(self.states), restitution, dict(self.events), dict(self.laws), self.units)

    def __repr__(self) -> str:
        def listed(slot: str, terms: Terms) -> str:
            return slot if [name for name, _ in terms] == [slot] else f"{slot}: {', '.join(name for name, _ in terms)}"

        parts = [listed(slot, getattr(self, slot)) for slot in SLOTS if getattr(self, slot)]
        parts += [f"one-sided: {', '.join(self.one_sided)}"] * bool(self.one_sided)
        parts += [f"states: {', '.join(dict(self.states))}"] * bool(self.states)
        return f"System({'; '.join(parts)})"

    @property
    def constraints(self) -> tuple[str, ...]:
        """Names of all constraints, in the order of the rows of G."""
        return tuple(name for slot in CONSTRAINT_SLOTS for name, _ in getattr(self, slot))

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of all terms that do work: dissipation, forces, constraints, and explicit time in L."""
        return (*(name for name, _ in (*self.dissipation, *self.force)), *self.constraints, EXPLICIT_TIME)


def _unpickled(
    references: Any, one_sided: Any, states: Any = None, restitution: Any = None, events: Any = None, laws: Any = (), units: Any = ()
) -> System:
    slots = {slot: {name: unpickled(f) for name, f in terms.items()} for slot, terms in references.items()}
    laws = dict(laws)
    law = lambda name: laws.get(name, NewtonRestitution())
    contacts = {name: Contact(slots["unilateral"][name], unpickled(e), law(name)) for name, e in (restitution or {}).items()}
    return System(**slots | {"unilateral": contacts}, one_sided=one_sided, states=states, events=events, units=dict(units))


def _units(given: Any) -> tuple[tuple[str, str], ...]:
    """The units by name."""
    if given is not None and not (isinstance(given, Mapping) and all(isinstance(x, str) for x in (*given, *given.values()))):
        raise TypeError(
            f'`units` must be a mapping from names to units as text, but is {given!r}. Write e.g. `units={{"t": "s", "x": "m"}}`.'
        )
    return tuple((given or {}).items())


def _contacts(given: Any) -> dict[str, Contact]:
    """The contacts by name."""
    if given is None:
        return {}
    terms = dict(given) if isinstance(given, Mapping) else {"unilateral": given}
    for name, term in terms.items():
        if not isinstance(term, Contact) and not callable(term):
            raise TypeError(
                f"`unilateral` must hold gaps g(t, q) or `Contact`s, but it holds {term!r} under {name!r}. Write e.g. "
                "`unilateral={'table': lambda q: q['y']}`."
            )
    return {name: term if isinstance(term, Contact) else Contact(term) for name, term in terms.items()}


def _check_position(label: str, function: Callable, states: dict[str, State | Sampled]) -> None:
    """Refuses a position constraint on a state that jumps, or whose second derivative needs the acceleration that it is to give."""
    for name, state in states.items():
        if needs(function, name) and (isinstance(state, Sampled) or needs(state.rate, "qdot")):
            why = "jumps" if isinstance(state, Sampled) else "is driven by qdot"
            raise ValueError(
                f"{label} must depend on states that follow from t, q and states alone, but {name!r} {why}, which would need an infinite "
                "or an unknown acceleration. Write the constraint for velocities, as `nonholonomic`."
            )


def _terms(slot: str, given: Any) -> Terms:
    if given is None:
        return ()
    terms = tuple(given.items()) if isinstance(given, Mapping) else ((slot, given),)
    for name, function in terms:
        if not isinstance(name, str) or not callable(function):
            raise TypeError(
                f"`{slot}` must be a function or a mapping from names to functions, but it holds {function!r} under {name!r}. "
                "Pass the function itself, not its value."
            )
        check_function(function, role(slot, name))
    return terms


def role(slot: str, name: str) -> str:
    """The name of a user's function in messages."""
    return f"`{slot}`" if name == slot else f"`{slot}` {name!r}"
