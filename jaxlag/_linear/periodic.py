"""Periodic motions: limit cycles, their periods and stability."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Complex, Float, PyTree

from .._mechanics.friction_treatment import Regularised, StickSlip
from .._model.event import Event, Every
from .._model.numbers import number
from .._model.paths import entry_names, is_within, listed
from .._model.state_values import given_states, start_values
from .._model.system import System
from .._model.validation import parameters, state
from .._motion.scales import tolerances_of
from .._motion.simulate import simulate
from .._motion.trajectory import Trajectory
from .._program.jit import is_concrete, seen
from .equilibrium import without_dust
from .return_map import Given, Orbit, Setting, orbit_near

FINER = 1e-2  # of the usual tolerances


class PeriodicOrbit(eqx.Module):
    """A motion that returns to its state.

    - `q`, `qdot`, `states`: at the section, just before its event, structured as given.
    - `period`: the time from there to the next passage.
    - `drift`: by how much the `cyclic` coordinates change in a period, structured like q; 0 for the others.
    - `multipliers`: the Floquet multipliers: eigenvalues of the derivative of the return map with respect to all of the state that returns,
      the largest first. A small deviation is multiplied by them in a period; deviations along the motion and off the constraints do not
      last: 0.
    - `is_stable`: whether all of them are less than 1 in absolute value.
    - `t`, `params`, `system`: the time at the section, and what was given; `setting` and `tolerances`, with which it was computed.
    """

    q: PyTree
    qdot: PyTree
    states: dict[str, PyTree]
    period: Float[Array, ""]
    drift: PyTree
    multipliers: Complex[Array, " k"]
    t: Float[Array | np.ndarray, ""]
    params: PyTree
    tolerances: PyTree
    system: System = eqx.field(static=True)
    setting: Setting = eqx.field(static=True)

    @property
    def is_stable(self) -> Any:
        """Whether small deviations die out."""
        return jnp.all(jnp.abs(self.multipliers) < 1)

    def motion(self, samples: int = 201, **settings: Any) -> Trajectory:
        """One period of the motion at some `samples`, from `simulate`, computed as the orbit was except for `settings`."""
        ts, (rtol, atol) = self.t + self.period * jnp.linspace(0, 1, samples), self.tolerances
        given = self.setting.of_motions() | {"rtol": rtol, "atol": atol} | settings
        return simulate(self.system, self.q, self.qdot, ts, self.params, states=self.states, **given)

    def __repr__(self) -> str:
        if not is_concrete((self.q, self.period, self.multipliers)):
            return "PeriodicOrbit(traced)"
        numbers = lambda tree: without_dust(np.asarray(ravel_pytree(tree)[0]))
        value = lambda tree, name: ", ".join(f"{entry} = {x:.6g}" for entry, x in zip(entry_names(tree, name), numbers(tree), strict=True))
        rows = [("period", f"{self.period:.8g}"), ("at", value(self.q, "q")), ("moving with", value(self.qdot, "q"))]
        if self.states:
            rows.append(("states", value(self.states, "")))
        if np.any(ravel_pytree(self.drift)[0]):
            rows.append(("drift", value(self.drift, "q")))
        of = [f"{m.real:.4g}" if abs(m.imag) < 1e-12 else f"{m:.4g}" for m in np.asarray(self.multipliers) if abs(m) > 1e-9]
        rows.append(("multipliers", ", ".join([*of, *["0"] * (len(of) < self.multipliers.size)])))
        rows.append(("stability", "stable" if self.is_stable else "not stable"))
        return "\n".join(["PeriodicOrbit", *(f"  {name:<13}{text}" for name, text in rows)])


def periodic(
    system: System,
    q0: PyTree,
    qdot0: PyTree,
    params: PyTree = None,
    *,
    section: Event | Every,
    longest: Any = None,
    cyclic: Sequence[str] = (),
    t: Any = 0.0,
    states: PyTree = None,
    friction: StickSlip | Regularised = StickSlip(),
    solver: Any = None,
    rtol: Any = None,
    atol: Any = None,
    max_steps: int = 100_000,
) -> PeriodicOrbit:
    r"""A periodic motion near a guess: the fixed point of the return map P of a section, by Newton's method.

    $$ P(x; p) = x, \qquad \frac{dx}{dp} = \left(1 - \frac{\partial P}{\partial x}\right)^{-1}\frac{\partial P}{\partial p} $$

    x is the state (q, q̇, z) at a passage through the section, P(x) that at the next. Impacts, friction that sticks and events within the
    period are part of P and of its derivative.

    **Arguments:**

    - `system`: if the section is an event, one in which nothing depends on t.
    - `q0`, `qdot0`, `states`, `params`: a guess, as for `simulate`; for a stable cycle, any state from which it is reached.
    - `section`: `Event(when, direction=...)`, passed once in a period; or `Every(period)`, for a force that is periodic in t.
    - `longest`: a time within which the motion from the guess passes through the section twice; needed if it is an event.
    - `cyclic`: names of coordinates on which nothing depends and which need not return, such as a distance travelled or a full turn.
    - `t`: the time at the start, the phase of a periodic force.
    - `friction`, `solver`, `rtol`, `atol`, `max_steps`: as for `simulate`; tolerances are a hundredth of those by default.

    Any consistent units.

    **Returns:** a `PeriodicOrbit`; print it. Differentiable in `params` to any order.

    **Raises:** `ValueError` if the guess does not pass through the section twice, no periodic motion is found, or it depends on when it
    begins; of many under `vmap`, if the first has none. Under `jit`, and of the others, all is NaN there.

    **Source:** Nayfeh & Balachandran, Applied Nonlinear Dynamics, sections 3.5 (Floquet) and 5.5 (Poincaré maps, shooting); Leine & van
    Campen, European Journal of Mechanics A 25 (2006) 595-616 (through impacts and friction).

    ```python
    import jax, jax.numpy as jnp
    import jaxlag as jl
    top = jl.Event(lambda qdot: qdot, direction=jl.direction.Falling())
    oscillator = jl.System(  # van der Pol's
        lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2, force=lambda q, qdot, mu: mu * (1 - q**2) * qdot
    )
    orbit = jl.periodic(oscillator, 1.0, 0.0, {"mu": 1.0}, section=top, longest=20.0)
    orbit.period  # 6.663287
    orbit.q  # 2.008620
    ```
    """
    q0, qdot0 = state(q0, qdot0, ("q0", "qdot0"))
    dtype = jax.tree.leaves(q0)[0].dtype
    params, states = parameters(params, q0), given_states(system, states, q0)
    t, longest = _given(section, longest, t, dtype)
    tolerances = tolerances_of(rtol, atol, q0)
    tolerances = tolerances if rtol is not None else (FINER * tolerances[0], tolerances[1])
    at = start_values(system, states, t, q0, qdot0, params)
    start = {"q": q0, "qdot": qdot0, "states": at}
    setting = Setting(section, _returning(system, q0, at, cyclic), friction, solver, max_steps)
    found = orbit_near(system, setting, Given(start, params, t, longest, tolerances))
    values = seen(found)
    names = [name for part in ("q", "qdot", "states") for name in entry_names(start[part], part)]
    if values is not None:
        _refuse(jax.tree.map(np.asarray, values), [names[i] for i in setting.returning])
    is_one = found.passes & found.returns & found.always
    entries, unravel = ravel_pytree(found.change["q"])
    returns = np.isin(np.arange(entries.size), setting.returning)
    shown = found.start, found.period, unravel(jnp.where(returns, 0, entries)), found.multipliers
    start, period, drift, multipliers = jax.tree.map(lambda x: jnp.where(is_one, x, jnp.nan), shown)
    more = multipliers, t, params, jax.tree.map(jnp.asarray, (rtol, atol)), system, setting
    return PeriodicOrbit(start["q"], start["qdot"], start["states"], period, drift, *more)


def _given(section, longest, t, dtype):
    """The start time, and the time within which the first two passages are looked for."""
    if not isinstance(section, (Event, Every)) or (isinstance(section, Event) and not callable(section.when)):
        raise TypeError(
            f"`section` must be an `Event` with a function, or `Every(period)`, but is {section!r}. "
            "Write e.g. `jl.Event(lambda qdot: qdot, direction=jl.direction.Falling())`."
        )
    t = number(t, "`t`", dtype, cure="Pass one time.")
    if isinstance(section, Every):
        return t, jnp.zeros((), dtype)
    cure = "Pass some periods' time."
    if longest is None:
        raise TypeError(f"`longest` must be the time in which the guess passes through the section twice, but was not given. {cure}")
    return t, number(longest, "`longest`", dtype, positive=True, cure=cure)


def _returning(system, q, states, cyclic):
    """Indices of the entries of the state that return."""
    entries, beside = entry_names(q, "q"), len(ravel_pytree(states)[0])
    cyclic = listed(cyclic)
    for name in cyclic:
        if not any(is_within(entry, name) for entry in entries):
            raise ValueError(f"`cyclic` must name coordinates, but holds {name!r}. The coordinates are {', '.join(entries)}.")
    of_q = [i for i, entry in enumerate(entries) if not any(is_within(entry, name) for name in cyclic)]
    return (*of_q, *range(len(entries), 2 * len(entries) + beside))


def _refuse(found: Orbit, names: list[str]) -> None:
    """Raises if nothing was found."""
    if not found.passes:
        raise ValueError(
            "`longest` must be a time in which the motion from the guess passes through the section twice, but it does not, or fails "
            "before. Look at it by `simulate(..., events={'section': section})`."
        )
    if not found.returns:
        left = np.abs(np.nan_to_num(found.left, nan=np.inf))
        i = int(np.argmax(left))
        raise ValueError(
            f"`q0` must be near a periodic motion, but none was found: {names[i]} returns off by {left[i]:.3g}. Start on a motion that has "
            "settled, or name in `cyclic` what need not return."
        )
    if not found.always:
        raise ValueError(
            "`section` must be `Every(period)` where the system depends on t, but the motion found returns only if it begins at `t`. "
            "Pass the period of what depends on t."
        )
