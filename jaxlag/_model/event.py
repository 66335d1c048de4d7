"""Events, as the user states them: when something happens, and what happens then."""

import dataclasses
import itertools
from collections.abc import Callable, Collection, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .injection import check_function
from .numbers import count, number
from .pickling import picklable, unpickled


@dataclasses.dataclass(frozen=True)
class Falling:
    """The event happens when `when` becomes negative, not when it becomes positive."""


@dataclasses.dataclass(frozen=True)
class Rising:
    """The event happens when `when` becomes positive, not when it becomes negative."""


@dataclasses.dataclass(frozen=True)
class Either:
    """The event happens when `when` changes its sign, in either direction."""


@dataclasses.dataclass(frozen=True)
class Negative:
    """The event happens when `when` becomes negative, and at the start if it already is."""


@dataclasses.dataclass(frozen=True)
class Every:
    """An event happens at all multiples of a `period`: a positive number, or a function of params that returns one."""

    period: float | Callable

    def __post_init__(self):
        if callable(self.period):
            check_function(self.period, "`period`")
        else:
            number(self.period, "`period`", positive=True, cure="Take the time from one event to the next.")

    def __reduce__(self) -> Any:
        return _every, (picklable(self.period, "`period`") if callable(self.period) else self.period,)


@dataclasses.dataclass(frozen=True)
class Event:
    r"""Something that happens where a function of the state passes through zero, or at given times.

    $$ w(t^*, q, \dot q, z) = 0: \qquad (q, \dot q, z) \to h(t^*, q, \dot q, z) $$

    **Arguments:**

    - `when`: w, a function that returns one real number and is continuous; it receives the arguments it names, out of `t`, `q`, `qdot`,
      `multipliers`, `params`, its entries and the states. Or increasing times; or `Every(period)`; or the name of a contact, for each of
      its impacts. Events at given times happen only after the start.
    - `then`: the state after the event: a function that returns a mapping with some of "q", "qdot" and "states", each structured like the
      original; mappings may omit what stays the same. It may name the same arguments as `when`, except the multipliers. Default: the event
      is only recorded. To change a parameter, make it a constant state, e.g. `State(lambda: 0.0, start=1.0)`.
    - `stop`: whether the motion ends there. Later samples are NaN, and the motion counts as successful.
    - `direction`: one of `jaxlag.direction`: `Falling()`, `Rising()`, `Either()`, the default, or `Negative()`, which is `Falling()` and
      also happens at the start.
    - `most`: how many are recorded, 100 by default, the rest NaN; one more ends the motion, with a reason that says so.

    The time is located to rounding and differentiated exactly, as is the state that `then` returns, which is projected onto the constraints
    and out of obstacles. A sample exactly at the time of an event shows the state before or after it, depending on rounding. A sign change
    of w caused by an impact, a jump of an input or another event also triggers the event, but none happens twice at one time. Simultaneous
    events happen in the order in which they are listed. If a force jumps or bends across w = 0, steps end there, and up to there forces are
    those of the side that the motion comes from; where functions of the system choose by the position or the time, as `jnp.where` of q
    does, that holds without an event (`jl.surfaces.Located`).

    `equilibrium`, `linearise`, `examine` and `equations` ignore events. Any consistent units. Pass events by name to a system, `System(...,
    events={"latch": Event(...)})`, or to a motion, `simulate(..., events=...)`.

    **Raises:** `TypeError` or `ValueError` if these are not such functions, times and numbers.

    **Source:** Filippov, Differential Equations with Discontinuous Righthand Sides; Hiskens & Pai, IEEE Trans. Circuits Syst. I 47 (2000)
    204-220 (derivatives through events).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    turning = jl.Event(lambda qdot: qdot, direction=jl.direction.Falling())
    swing = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2, events={"turn": turning})
    motion = jl.simulate(swing, 0.0, 1.0, jnp.linspace(0, 10, 11), {"c": 4.0})
    motion.events["turn"].ts[:3]  # π/4 + k π = [0.785, 3.927, 7.069]
    ```
    """

    when: Any
    then: Callable | None = None
    stop: bool = False
    direction: Falling | Rising | Either | Negative = Either()
    most: int = 100

    def __post_init__(self):
        if callable(self.when):
            check_function(self.when, "`when`")
        elif not isinstance(self.when, (str, Every)):
            object.__setattr__(self, "when", _times(self.when))
        if self.then is not None:
            check_function(self.then, "`then`")
        if not isinstance(self.direction, (Falling, Rising, Either, Negative)):
            raise TypeError(
                f"`direction` must be one of `jaxlag.direction`, but is {self.direction!r}. Take `jaxlag.direction.Falling()`, say."
            )
        if self.direction != Either() and not callable(self.when):
            raise ValueError(
                f"`direction` must be left out for times and impacts, which have none, but is {self.direction!r}. Leave it out."
            )
        if not isinstance(self.stop, (bool, np.bool_)):
            raise TypeError(f"`stop` must be True or False, but is {self.stop!r}. Take one of these.")
        count(self.most, "`most`", least=1, cure="The default is 100.")

    def __reduce__(self) -> Any:
        of = lambda x, label: picklable(x, label) if callable(x) else x
        return _event, (of(self.when, "`when`"), of(self.then, "`then`"), self.stop, self.direction, self.most)


def events_of(given: Any, contacts: Collection[str]) -> tuple[tuple[str, Event], ...]:
    """The events of a system, by name, whose contacts have these names."""
    terms: tuple[Any, ...] = () if given is None else tuple(given.items()) if isinstance(given, Mapping) else ((None, given),)
    for name, event in terms:
        if not isinstance(name, str) or not isinstance(event, Event):
            raise TypeError(
                f"`events` must be a mapping from names to `Event`s, but holds {event!r} under {name!r}. Write e.g. "
                "`events={'latch': jl.Event(lambda q: q)}`."
            )
        if isinstance(event.when, str) and event.when not in contacts:
            there = ", ".join(contacts) or "none"
            raise ValueError(f"`when` of {name!r} must name a contact, but is {event.when!r}. There are {there} in `unilateral`.")
    return terms


def merged(label: str, now: Any, given: Any) -> Any:
    """What there is now, with the entries that are given in place of its own; mappings may leave out what stays."""
    if isinstance(now, Mapping) and isinstance(given, Mapping):
        for name in given:
            if name not in now:
                there = ", ".join(map(str, now))
                raise ValueError(
                    f"{label} must return entries of the state, but returned {name!r}. There are {there}; state what else "
                    "changes as a `State`."
                )
        return {name: merged(label, old, given[name]) if name in given else old for name, old in now.items()}
    shapes = [jax.tree.map(lambda x: jnp.shape(x), tree) for tree in (now, given)]
    if shapes[0] != shapes[1]:
        raise ValueError(f"{label} must return what has the shape of the state, {shapes[0]}, but returned {shapes[1]}. Keep its shape.")
    return jax.tree.map(lambda old, new: jnp.asarray(new, jnp.result_type(old)), now, given)


def _event(when: Any, then: Any, *rest: Any) -> Event:
    return Event(unpickled(when), unpickled(then), *rest)


def _every(period: Any) -> Every:
    return Every(unpickled(period))


def _times(given: Any) -> tuple[float, ...]:
    values = given if np.ndim(given) else [given]
    times = tuple(float(number(time, "`when`", cure="Take times, or a function.")) for time in values)
    if not times or any(late <= early for early, late in itertools.pairwise(times)):
        raise ValueError(f"`when` must be increasing times, but is {times}. Sort them, and name each once.")
    return times
