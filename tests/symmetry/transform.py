"""The same motion written down otherwise: a system beside it, its inputs, and the way back of each result.

Units, the clock and mirrors are numbers of one program: `in_units` states a case once, with L'(t', q', q̇') = E L((t' − T)/τ, q'/s, q̇' τ/s),
and `Units` are entries of its params, so that a thousand of them are compiled once. What changes the program (order, names, what stands
beside, how a constraint is written) makes another `Case`.
"""

import inspect
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from generate import Case, Term

import jaxlag as jl


class Units(NamedTuple):
    """Numbers that multiply what is stated: t' = τ t + T, q' = s q + a + u t', L' = E L, g' = r g, z' = σ z, p' = k p, y' = c y."""

    start: Any
    time: Any
    energy: Any
    length: Any  # s of each coordinate
    shift: Any  # a of each coordinate
    drift: Any  # u of each coordinate
    rows: dict[str, Any]
    states: dict[str, Any]
    params: dict[str, Any]
    channels: Any = 1.0


ROWS = ("holonomic", "nonholonomic", "unilateral")
FIXED = ("units", "restitution")


def plain(case: Case) -> Units:
    """The units in which the case is stated."""
    rows = {name: 1.0 for slot in ROWS for name in case.terms.get(slot, {})}
    params = {name: 1.0 for name in case.params}
    one = np.ones(case.n)
    return Units(0.0, 1.0, 1.0, one, 0 * one, 0 * one, rows, dict.fromkeys(case.states, 1.0), params)


APART = 1e-14  # of a row to another, at least: their lengths in one unit differ by a few


def drawn_units(case: Case, seed: int, which: str) -> Units:
    """Units of a transformation: each number a power of ten."""
    draw, units = np.random.default_rng([seed, *which.encode()]), plain(case)
    decades = lambda most, *shape: 10.0 ** draw.integers(-most, most + 1, shape)
    one_of = lambda *values: float(draw.choice(values))
    named = lambda of, most: {name: float(decades(most)) for name in of}
    match which:
        case "clock":
            return units._replace(start=one_of(1e3, 1e6, 1e7, 1e8, 1.7e9, 2e9))
        case "time":
            return units._replace(time=float(decades(6)))
        case "energy":
            return units._replace(energy=float(decades(9)))
        case "length":
            return units._replace(length=units.length * float(decades(9)))
        case "each length":
            return units._replace(length=decades(9, case.n))
        case "rows":
            rows = named(units.rows, 9)  # one that is lost in the rounding of another is refused
            least = APART * max(rows.values(), default=0.0)
            return units._replace(rows={name: max(x, least) for name, x in rows.items()}, states=named(units.states, 9))
        case "params":
            return units._replace(params=named(units.params, 9))
        case "channels":
            return units._replace(channels=float(decades(9)))
        case "mirror":
            return units._replace(length=np.where(draw.random(case.n) < 0.5, -1.0, 1.0))
        case "shift":
            return units._replace(shift=one_of(1.0, 1e2, 1e4) * draw.normal(size=case.n))
        case "frame":
            return units._replace(drift=one_of(1.0, 1e2, 1e4) * draw.normal(size=case.n))
        case "all":
            more = {"rows": named(units.rows, 4), "states": named(units.states, 4), "params": named(units.params, 4)}
            return units._replace(time=float(decades(4)), energy=float(decades(6)), length=decades(5, case.n), **more)
    raise ValueError(which)


NUMBERS = ("clock", "time", "energy", "length", "each length", "rows", "params", "channels", "mirror", "shift", "frame", "all")


def _translated(params, t_given):
    """The parameters in the units of the case; signals as they are called at this time."""
    k = params["units"].params

    def one(name, x):
        if callable(x):  # a signal, or what stands for it between two of its samples
            return lambda t: x(t_given) / k[name]
        return jax.tree.map(lambda y: y / k[name], x)

    return {name: one(name, x) for name, x in params.items() if name != "units"}


def _stated(f: Callable, names: tuple[str, ...], factor: Callable, scaled: tuple[str, ...]) -> Callable:
    """A user's function in the units of params: of the arguments `scaled`, and by name of what else it receives."""

    def stated(params, t, q, qdot=None, **more):
        u = params["units"]
        inside = {name: x / u.states.get(name, 1.0) for name, x in more.items()}
        place = (q - u.shift - u.drift * t) / u.length
        rate = None if qdot is None else (qdot - u.drift) * u.time / u.length
        return factor(u) * f((t - u.start) / u.time, place, rate, _translated(params, t), **inside)

    def by_name(**given):
        return stated(**given)

    arguments = [inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY) for name in ("params", *scaled, *names)]
    by_name.__signature__ = inspect.Signature(arguments)  # a function receives what it names
    return by_name


FACTORS = {
    "lagrangian": lambda name: lambda u: u.energy,
    "dissipation": lambda name: lambda u: u.energy / u.time,
    "force": lambda name: lambda u: u.energy / u.length,
    "holonomic": lambda name: lambda u: u.rows[name],
    "nonholonomic": lambda name: lambda u: u.rows[name],
    "unilateral": lambda name: lambda u: u.rows[name],
}
SYSTEMS: dict[Any, jl.System] = {}


def in_units(case: Case) -> jl.System:
    """The system of a case, in units that are an entry of its params; one for all cases with the same terms."""
    key = tuple((slot, *named.items()) for slot, named in case.terms.items()), tuple(case.states.items()), case.restitution
    if key not in SYSTEMS:
        SYSTEMS[key] = _system(case)
    return SYSTEMS[key]


def _system(case: Case) -> jl.System:
    def of(slot, name, term: Term):
        scaled = ("t", "q") if slot in ("holonomic", "unilateral") else ("t", "q", "qdot")
        f = _stated(term.f, term.names, FACTORS[slot](name), scaled)
        if slot == "unilateral":
            return jl.Contact(f, restitution=lambda params: params["restitution"])
        return f

    slots = {slot: {name: of(slot, name, term) for name, term in named.items()} for slot, named in case.terms.items()}
    states = {name: _state(name, *given) for name, given in case.states.items()}
    return jl.System(slots.pop("lagrangian"), states=states or None, **slots)


def _state(name: str, term: Term, every: float, start: float) -> Any:
    """A state beside q; its rate has the unit of the state over that of time."""
    begin = lambda params: start * params["units"].states[name] + 0.0
    if not every:
        return jl.State(_stated(term.f, term.names, lambda u: u.states[name] / u.time, ("t", "q", "qdot")), begin)
    update = _stated(term.f, term.names, lambda u: u.states[name], ("t", "q", "qdot"))
    return jl.Sampled(update, every=lambda params: every * params["units"].time, start=begin)


class Inputs(NamedTuple):
    """What a question is asked with."""

    q: Any
    qdot: Any
    ts: Any
    params: dict[str, Any]


def inputs_of(case: Case, u: Units) -> Inputs:
    """Those of a case in other units."""

    def one(name, x):
        k = 1.0 if name in FIXED else u.params[name]
        if isinstance(x, jl.Signal):
            return jl.Signal(u.time * np.asarray(x.ts) + u.start, k * np.asarray(x.values), x.interpolation)
        return jax.tree.map(lambda y: k * np.asarray(y), x)

    params = {name: one(name, x) for name, x in case.params.items()}
    ts = u.time * np.asarray(case.ts) + u.start
    q = u.length * case.q0 + u.shift + u.drift * ts[0]
    numbers = u._replace(params=u.params | dict.fromkeys(FIXED, 1.0))
    as_arrays = jax.tree.map(lambda x: jnp.asarray(x, float), numbers)
    return Inputs(q, u.length / u.time * case.qdot0 + u.drift, ts, params | {"units": as_arrays})


class Seen(NamedTuple):
    """A result, and how to go back to the units of the case: x = (x' − offset)/factor; `within`: how far it may be off there."""

    value: Any
    factor: Any = 1.0
    offset: Any = 0.0
    within: float | None = None

    @property
    def back(self) -> np.ndarray:
        """In the units of the case."""
        return (np.asarray(self.value, float) - self.offset) / self.factor
