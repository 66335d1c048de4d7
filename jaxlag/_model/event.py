"""Events, as the user states them: when something happens, and what happens then."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from .injection import check_function
from .numbers import count, number
from .pickling import picklable, unpickled


@dataclasses.dataclass(frozen=True)
class Falling:
    """An event happens where `when` becomes negative."""


@dataclasses.dataclass(frozen=True)
class Rising:
    """An event happens where `when` becomes positive."""


@dataclasses.dataclass(frozen=True)
class Either:
    """An event happens where `when` changes its sign, whichever way."""


@dataclasses.dataclass(frozen=True)
class Negative:
    """An event happens where `when` becomes negative, and at the start where it is so already."""


@dataclasses.dataclass(frozen=True)
class Event:
    r"""Something that happens where a function of the state passes through zero, or at given times.

    $$ w(t^*, q, \dot q) = 0: \qquad (q, \dot q, z) \to h(t^*, q, \dot q, z) $$

    **Arguments:**

    - `when`: w, a real number; it receives the arguments it names, out of `t`, `q`, `qdot`, `params`, its entries and the states. Or a
      time, or some, increasing: numbers, or a function of `params` and its entries that returns them.
    - `then`: what the state becomes: a mapping with some of "q", "qdot" and "states", each structured like its own, where mappings may
      leave out what stays. It receives what `when` does. Default: nothing, the event is counted.
    - `stop`: whether the motion ends there. Samples behind are NaN, and the motion is a success.
    - `direction`: `Falling()`, `Rising()`, `Either()`, the default, or `Negative()`, as `Falling()` and at the start, too.
    - `most`: how many are recorded; one more ends the motion with that reason.

    The time is located to rounding; a sample at it shows the state before. What `then` returns is put on the constraints, and is differentiated, as the time is. Any consistent
    units. A system takes events by name: `System(..., events={"latch": Event(...)})`.

    **Raises:** `TypeError` or `ValueError` where these are not such functions, times and numbers.

    **Source:** Filippov, Differential Equations with Discontinuous Righthand Sides; Hiskens & Pai, IEEE Trans. Circuits Syst. I 47 (2000)
    204-220 (derivatives through events).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    turning = jl.Event(lambda qdot: qdot, direction=jl.Falling())
    swing = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2, events={"turn": turning})
    motion = jl.simulate(swing, 0.0, 1.0, jnp.linspace(0, 10, 11), {"c": 4.0})
    motion.events["turn"].ts[:3]  # π/4 + k π = [0.785, 3.927, 7.069]
    ```
    """

    when: Any
    then: Callable | None = None
    stop: bool = False
    direction: Falling | Rising | Either | Negative = Either()
    most: int = 16

    def __post_init__(self):
        if not callable(self.when):
            object.__setattr__(self, "when", _times(self.when))
        for function, label in ((self.when, "`when`"), (self.then, "`then`")):
            if function is not None and not isinstance(function, tuple):
                check_function(function, label)
        if not isinstance(self.direction, (Falling, Rising, Either, Negative)):
            raise TypeError(
                f"`direction` must be `Falling()`, `Rising()`, `Either()` or `Negative()`, but is {self.direction!r}. Take one of these."
            )
        if not isinstance(self.stop, (bool, np.bool_)):
            raise TypeError(f"`stop` must be True or False, but is {self.stop!r}. Take one of these.")
        count(self.most, "`most`", least=1, cure="The default is 16.")

    def __reduce__(self) -> Any:
        of = lambda x, label: picklable(x, label) if callable(x) else x
        return _unpickled, (of(self.when, "`when`"), of(self.then, "`then`"), self.stop, self.direction, self.most)


def _unpickled(when: Any, then: Any, *rest: Any) -> Event:
    return Event(unpickled(when), unpickled(then), *rest)


def _times(given: Any) -> tuple[float, ...]:
    values = given if np.ndim(given) else [given]
    times = tuple(float(number(time, "`when`", cure="Take times, or a function.")) for time in values)
    if not times or any(late <= early for early, late in zip(times, times[1:], strict=False)):
        raise ValueError(f"`when` must be increasing times, but is {times}. Sort them, and name each once.")
    return times
