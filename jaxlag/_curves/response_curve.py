"""How a periodic motion depends on a parameter: the response curve of a nonlinear machine."""

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Complex, Float, PyTree

from .._linear.not_differentiated import without_derivative
from .._linear.periodic import FINER, PeriodicOrbit
from .._linear.return_map import Given
from .._model.event import Every
from .._model.numbers import count
from .._model.system import System
from .._model.validation import parameters
from .._motion.scales import tolerances_of
from .._program.jit import is_concrete
from .._program.jit import values as known_values
from .arclength import Point, bounded
from .critical import FLIP, FOLD, TORUS
from .curve import ENDS, beside, joined, place_of, refuse_outside
from .measures import Measured, measures_of
from .orbit_curve import Asked, OrbitCurve
from .orbits import ORDINARY, Family, Numbers, Told, with_value
from .special_points import BRANCH, CORNER, Special, changes_of_orbits, with_special_points

NEUTRAL = 1e-6  # of a multiplier of 1: errors of motions


class SpecialPoint(eqx.Module):
    """Where a periodic motion changes its character: `kind`, the `value` of the parameter, the `orbit` there, and what was `measured`.

    Kinds: "fold", where the curve turns back; "flip", where a motion of twice the period branches off; "torus" (Neimark–Sacker), where a
    second frequency appears; "branch point", where another curve crosses; "grazing", where a contact begins to knock; "sticking", where
    friction begins to stick or lets go; "reversal", where a sliding velocity reverses more often; "event", where an event of the system
    happens more often. `index`: its number among the points of the curve; `what`: the name of the contact or the event.
    """

    kind: str = eqx.field(static=True)
    value: Float[Array, ""]
    orbit: PeriodicOrbit
    measured: dict[str, Measured]
    index: int = eqx.field(static=True)
    what: str = eqx.field(static=True, default="")

    @property
    def amplitude(self) -> dict[str, Any]:
        """Half the distance of the greatest and the least value of each measure."""
        return {name: (at.highest - at.lowest) / 2 for name, at in self.measured.items()}


class ResponseCurve(eqx.Module):
    """Periodic motions over a parameter, as `response_curve` returns them: points along a curve that may turn back.

    - `over`, `values` (n): the parameter, and its value at each point.
    - `q`, `qdot`, `states`: at the section, structured as in the orbit, with the points as first axis; `period` (n); `drift` as q.
    - `multipliers` (n, k): the Floquet multipliers; `is_stable` (n): whether none is greater than 1 in absolute value, beyond
      the errors of motions.
    - `measured`: by name the `highest` and the `lowest` value in a period (n), and `harmonics` (n, 9), c₀ the mean: f = Re Σ cₘ
      exp(2π i m t/T). `amplitude` and `phase` are made of them.
    - `special`: where motions change, as `SpecialPoint`s, in the order of the points.
    - `ends`: why the curve ends at its first and its last point.
    """

    over: str = eqx.field(static=True)
    values: Float[Array, " n"]
    q: PyTree
    qdot: PyTree
    states: dict[str, PyTree]
    period: Float[Array, " n"]
    drift: PyTree
    multipliers: Complex[Array, "n k"]
    measured: dict[str, Measured]
    special: tuple[SpecialPoint, ...]
    ends: tuple[str, str] = eqx.field(static=True)
    _first: PeriodicOrbit
    _asked: Asked = eqx.field(static=True)

    if TYPE_CHECKING:  # put here by `jaxlag.plot`
        plot: ClassVar[Callable[..., Any]]

    @property
    def system(self) -> System:
        """The system that moves."""
        return self._first.system

    @property
    def is_stable(self) -> Bool[Array, " n"]:
        """Whether no small deviation from each motion grows."""
        return jnp.all(jnp.abs(self.multipliers) <= 1 + NEUTRAL, axis=1)

    @property
    def amplitude(self) -> dict[str, Float[Array, " n"]]:
        """Half the distance of the greatest and the least value in a period, by name."""
        return {name: (at.highest - at.lowest) / 2 for name, at in self.measured.items()}

    @property
    def phase(self) -> dict[str, Float[Array, " n"]]:
        """The phase of the first harmonic, by name: f = |c₁| cos(2π t/T + phase)."""
        return {name: jnp.angle(at.harmonics[..., 1]) for name, at in self.measured.items()}

    def __len__(self) -> int:
        return self.values.shape[0]

    def orbit(self, i: int) -> PeriodicOrbit:
        """The periodic motion at point `i`."""
        if not -len(self) <= i < len(self):
            raise IndexError(f"`orbit({i})` must be there, but there are {len(self)} points.")
        state = jax.tree.map(lambda x: x[i], (self.q, self.qdot, self.states, self.period, self.drift, self.multipliers))
        first = self._first
        params = with_value(first.params, place_of(first.params, self.over), self.values[i])
        return PeriodicOrbit(*state, first.t, params, first.tolerances, first.system, first.setting)

    def at(self, value: float) -> tuple[PeriodicOrbit, ...]:
        """The periodic motions at a `value` of the parameter, in the order of the curve. Their derivatives are those at this value.

        **Raises:** `ValueError` if one that the curve passes is not found.
        """
        curve, values = _curve(self.orbit(0), self._first.params, self._asked), np.asarray(jax.lax.stop_gradient(self.values))
        ends = values[1:].copy()
        ends[-1] += (values[-1] == value) * (values[-1] - values[-2])  # the last point is part of the curve, too
        passes = np.flatnonzero((values[:-1] <= value) & (value < ends) | (values[:-1] >= value) & (value > ends))
        found = []
        for i in passes:
            here, after = (_flat(self.orbit(k), curve.family) for k in (int(i), int(i) + 1))
            point = curve.at_parameter(here + (value - values[i]) / (values[i + 1] - values[i]) * (after - here))
            if point is None:
                raise ValueError(f"`value` must be one at which the curve has a motion, but at {value:g} none was found near point {i}.")
            found.append(_with(self._first, curve, curve.shown(point), _multipliers(point)))
        return tuple(found)

    def branch(self, i: int, *, values: Any = None, steps: int | None = None) -> "ResponseCurve":
        """The other curve through special point `i`: of motions of twice the period from a flip, of what crosses at a branch point.
        `values`, `steps`: as for `response_curve`; those of this curve, if not given.

        **Raises:** `ValueError` at another special point, or where no other curve is found.
        """
        point = self.special[i]
        if point.kind not in (FLIP, BRANCH):
            raise ValueError(f"`branch({i})` must be of a flip or a branch point, but that is a {point.kind}. Choose one of those.")
        asked = self._asked
        bounds = asked.bounds if values is None else bounded(values)
        asked = asked._replace(bounds=bounds, steps=asked.steps if steps is None else _counts(asked.samples, steps)[1])
        orbit = point.orbit
        if point.kind == FLIP:
            twice = orbit.setting._replace(turns=2 * orbit.setting.turns)
            orbit = dataclasses.replace(orbit, setting=twice, period=2 * orbit.period)
        curve = _curve(orbit, orbit.params, asked)
        sides = curve.beside(_flat(orbit, curve.family), point.kind)
        if not sides:
            raise ValueError(f"`branch({i})` must find another curve, but Newton's method finds none. Widen `values`.")
        return _shown(curve, orbit, *beside(sides))

    def __repr__(self) -> str:
        head = f"ResponseCurve of {len(self)} periodic motions over {self.over}"
        if not is_concrete(self):
            return f"{head} (traced)"
        first, last = float(self.values[0]), float(self.values[-1])
        stable = np.asarray(self.is_stable)
        rows = [f"from {first:.6g} ({self.ends[0]}) to {last:.6g} ({self.ends[1]})"]
        rows += [f"{int(stable.sum())} of them stable" if stable.any() else "none of them stable"]
        for name, amplitude in self.amplitude.items():
            i = int(np.argmax(amplitude))
            rows.append(f"largest amplitude of {name}: {float(amplitude[i]):.6g} at {self.over} = {float(self.values[i]):.6g}")
        for point in self.special:
            rows.append(f"{point.kind}{f' ({point.what})' if point.what else ''} at {self.over} = {float(point.value):.8g}")
        return "\n".join([head, *(f"  {row}" for row in rows)])


def response_curve(
    orbit: PeriodicOrbit,
    params: PyTree = None,
    *,
    over: str,
    values: tuple[Any, Any],
    of: Any = None,
    samples: int = 256,
    steps: int = 400,
) -> ResponseCurve:
    r"""How a periodic motion depends on a parameter: its amplitudes, its stability, and where it changes.

    $$ P(x; p) = x, \qquad t^T \left(z - z_0 - s\,t\right) = 0, \qquad z = (x, p) $$

    P is the return map of `periodic`, with impacts, friction that sticks and events. The curve of its fixed points is followed by its arc
    length s, so that it may turn back, from `orbit` to both sides. Between points at which a multiplier passes 1 or −1 or a pair of them
    the unit circle, and between those with another number of impacts, of stops of friction or of reversals, the place is located.

    **Arguments:**

    - `orbit`: of `periodic`, at a value of the parameter between `values`; with a force that depends on the parameter, the section is
      `Every(period)` with the period as a function of it, and states are those at the orbit's t in the first period.
    - `params`: those of the orbit, if not given: pass them to differentiate in them without differentiating the orbit.
    - `over`: the name of a number in params; `values`: (lower, upper), between which the curve is followed.
    - `of`: what is measured of each motion: functions by name, by the argument rule, of `t, q, qdot, qddot, multipliers, states` and
      params; each returns a number. All coordinates, if not given.
    - `samples`: of a period, from which harmonics are computed; where a function bends they are exact to the order of `samples`⁻².
    - `steps`: how many points there are at most to either side.

    Any consistent units.

    **Returns:** a `ResponseCurve`; print it, draw it with `plot.response_curve`. Differentiable in `params`, to any order: a point moves
    across the curve, folds, flips and tori move with what makes them so. The derivatives of multipliers and of the points at which
    impacts, stops or reversals change and branches cross are NaN.

    **Raises:** `ValueError` if `over` names no number, the orbit is none at its value or outside `values`, `params` are hidden by `jit` or
    one set of many under `vmap`, or a function of `of` is no number.

    **Source:** Nayfeh & Balachandran, Applied Nonlinear Dynamics, chapter 6; Kuznetsov, Elements of Applied Bifurcation Theory, sections
    10.2, 10.3; di Bernardo et al., Piecewise-smooth Dynamical Systems, section 7.3 (grazing).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    duffing = jl.System(
        lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * q**2 - 0.25 * c * q**4,
        dissipation=lambda qdot, d: 0.5 * d * qdot**2,
        force=lambda t, w: 0.3 * jnp.cos(w * t),
    )
    params = {"c": 1.0, "d": 0.1, "w": 0.5}
    orbit = jl.periodic(duffing, 0.4, 0.0, params, section=jl.Every(lambda w: 2 * jnp.pi / w))
    curve = jl.response_curve(orbit, over="w", values=(0.3, 2.5))
    curve.special[0].value  # 1.7797, the first fold
    ```
    """
    given = orbit.params if params is None else parameters(params, orbit.q)
    asked = Asked(over, bounded(values), measures_of(of, orbit.q), *_counts(samples, steps))
    if isinstance(orbit.setting.section, Every):  # the same motion, begun early: a phase ω t of a late t would turn often with ω
        t, period = jax.lax.stop_gradient((orbit.t, orbit.period))
        orbit = dataclasses.replace(orbit, t=t - period * jnp.floor(t / period))
    curve = _curve(orbit, given, asked)
    start = np.asarray(jax.tree.leaves(curve.known.given.params)[curve.family.place])
    sides = curve.through(np.append(_flat(orbit, curve.family)[:-1], start))
    if sides is None:
        raise ValueError(f"`orbit` must be a periodic motion at its {over}, but none was found there with `params`. Compute it with them.")
    return _shown(curve, orbit, *joined(*sides))


def _counts(samples: Any, steps: Any) -> tuple[int, int]:
    return count(samples, "`samples`", least=32, cure="Give e.g. 256."), count(steps, "`steps`", cure="Give e.g. 400.")


def _curve(orbit: PeriodicOrbit, params: PyTree, asked: Asked) -> OrbitCurve:
    """The curve through an orbit, to be followed."""
    fixed = jax.lax.stop_gradient
    place = place_of(params, asked.over)
    start = known_values(jax.tree.leaves(params)[place])
    refuse_outside(start, asked.bounds, asked.over)
    asked_for, absolute = orbit.tolerances
    rtol, atol = tolerances_of(asked_for, absolute, orbit.q)
    tolerances = (rtol if asked_for is not None else FINER * rtol, atol)
    state = fixed({"q": orbit.q, "qdot": orbit.qdot, "states": orbit.states})
    t, width = fixed(orbit.t), jnp.asarray(asked.bounds[1] - asked.bounds[0], jnp.result_type(rtol))
    numbers = Numbers(Given(state, params, t, jnp.zeros_like(t), tolerances), fixed(orbit.period), width)
    return OrbitCurve(Family(orbit.system, orbit.setting, place), asked, numbers)


def _flat(orbit: PeriodicOrbit, family: Family) -> np.ndarray:
    """The point of an orbit: the state that returns, and the parameter."""
    state = ravel_pytree({"q": orbit.q, "qdot": orbit.qdot, "states": orbit.states})[0]
    x = np.asarray(jax.lax.stop_gradient(state))[list(family.map.returning)]
    return np.append(x, np.asarray(jax.lax.stop_gradient(jax.tree.leaves(orbit.params)[family.place])))


def _shown(curve: OrbitCurve, orbit: PeriodicOrbit, runs: list[list[Point]], ends: tuple[str, str]) -> ResponseCurve:
    """The curve as it is returned."""
    points, found = with_special_points(curve, runs, changes_of_orbits)
    special = [_special(curve, orbit, i, at) for i, at in found.items()]
    told = [curve.shown(point) for point in points]
    whole = jax.tree.map(lambda *x: jnp.stack(x), *told)
    measured = dict(zip((m.name for m in curve.asked.measures), whole.measured, strict=True))
    multipliers = without_derivative(jnp.stack([_multipliers(point) for point in points]), curve.numbers.given.params)
    state = whole.state
    shown = whole.z[:, -1], state["q"], state["qdot"], state["states"], whole.period, whole.drift, multipliers, measured
    said = lambda end, at, way: ENDS[end] + (f": {curve.why(at, way)}" if end == "lost" else "")
    why = said(ends[0], points[0], -1), said(ends[1], points[-1], 1)
    return ResponseCurve(curve.asked.over, *shown, tuple(special), why, _with(orbit, curve, told[0]), curve.asked)


def _multipliers(point: Point) -> Array:
    return jnp.asarray(
        np.array(sorted(np.linalg.eigvals(point.J[:, :-1] + np.eye(len(point.J))), key=lambda m: (-abs(m), m.imag)), complex)
    )


def _special(curve: OrbitCurve, orbit: PeriodicOrbit, i: int, at: Special) -> SpecialPoint:
    """A special point as it is returned."""
    told = curve.shown(at.at, at.kind if at.kind in (FOLD, FLIP, TORUS) else ORDINARY, at.borders)
    if at.kind in (BRANCH, CORNER):
        told = jax.tree.map(lambda x: without_derivative(x, curve.numbers.given.params), told)
    measured = dict(zip((m.name for m in curve.asked.measures), told.measured, strict=True))
    kind, what = _corner(curve, *at.corners) if at.kind == CORNER else (at.kind, "")
    multipliers = without_derivative(_multipliers(at.at), curve.numbers.given.params)
    return SpecialPoint(kind, told.z[-1], _with(orbit, curve, told, multipliers), measured, i, what)


def _corner(curve: OrbitCurve, before: tuple, after: tuple) -> tuple[str, str]:
    """What changes at a corner: its kind, and the name of the contact or the event."""
    system = curve.family.system
    named = [*(("grazing", name) for name, _ in system.unilateral), *(("event", name) for name in dict(system.events))]
    of_friction = len(before) - len(named)
    for i, (kind, name) in enumerate(named, of_friction):
        if before[i] != after[i]:
            return kind, name
    return ("sticking" if before[1] != after[1] else "reversal"), ""


def _with(orbit: PeriodicOrbit, curve: OrbitCurve, told: Told, multipliers: Any = None) -> PeriodicOrbit:
    """The orbit that was told of."""
    given, state = curve.numbers.given, told.state
    params = with_value(given.params, curve.family.place, told.z[-1])
    multipliers = jnp.full(told.z.shape[-1] - 1, jnp.nan + 0j) if multipliers is None else multipliers
    more = multipliers, orbit.t, params, orbit.tolerances, orbit.system, curve.family.map
    return PeriodicOrbit(state["q"], state["qdot"], state["states"], told.period, told.drift, *more)
