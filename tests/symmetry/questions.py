"""What is asked of a system, in any units, and what is to be the same: each result with its way back to the units of the case."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from generate import Case
from transform import Inputs, Seen, Units, in_units, inputs_of

import jaxlag as jl


def _rates(u: Units):
    return u.length / u.time


def _forces_of_rows(case: Case, u: Units, multipliers) -> dict[str, Seen]:
    """λ by constraint; where rows depend on each other, it is that of least norm, which depends on their units."""
    if case.kind == "redundant":
        return {}
    slow = case.terms.get("nonholonomic", {})
    return {f"λ {name}": Seen(x, u.energy / u.rows[name] / (u.time if name in slow else 1)) for name, x in multipliers.items()}


def acceleration(case: Case, u: Units) -> dict[str, Seen]:
    system, i = in_units(case), inputs_of(case, u)
    t, states = i.ts[3], _states(case, u)
    q = i.q + u.drift * (t - i.ts[0])
    found = jl.acceleration(system, q, i.qdot, i.params, t=t, states=states)
    force = jl.constraint_force(system, q, i.qdot, i.params, t=t, states=states) if _rows(case) else {}
    total = {"Gᵀλ": Seen(sum(map(np.asarray, force.values())), u.energy / u.length)} if force else {}
    return {"q̈": Seen(found.qddot, _rates(u) / u.time)} | total | _forces_of_rows(case, u, found.multipliers)


def _rows(case):
    return [name for slot in ("holonomic", "nonholonomic") for name in case.terms.get(slot, {})]


def _states(case: Case, u: Units):
    return {name: start * u.states[name] + 0.0 for name, (_, _, start) in case.states.items()} or None


def consistent_state(case: Case, u: Units) -> dict[str, Seen]:
    """From a state that is off the constraints."""
    i = inputs_of(case, u)
    off = np.linspace(0.05, -0.1, case.n)
    q, v = jl.consistent_state(in_units(case), i.q + off * u.length, i.qdot + off * _rates(u), i.params, t=i.ts[0])
    return {"q": Seen(q, u.length, u.shift + u.drift * i.ts[0]), "q̇": Seen(v, _rates(u), u.drift)}


def motion(case: Case, u: Units, **settings) -> dict[str, Seen]:
    i = inputs_of(case, u)
    found = jl.simulate(in_units(case), i.q, i.qdot, i.ts, i.params, works=True, **settings)
    shared = _rows(case) if case.kind == "redundant" else []  # as λ is
    works = {f"W {name}": Seen(x, u.energy) for name, x in found.work().items() if name not in ("time", "projection", *shared)}
    stuck = {f"sticking {name}": Seen(x.sticking) for name, x in found.friction.items()}
    forces = {f"friction {name}": Seen(x.force, u.energy / u.time) for name, x in found.friction.items()}
    counts = {"transitions": Seen(found.stats["transitions"])} if "transitions" in found.stats else {}
    states = {f"state {name}": Seen(x, u.states[name]) for name, x in found.states.items()}
    contacts = {}
    for name, x in found.contacts.items():
        contacts |= {f"closed {name}": Seen(x.closed), f"impacts {name}": Seen(x.impacts)}
        contacts[f"impulse {name}"] = Seen(x.impulse, u.energy * u.time / u.rows[name])
    return (
        _state(i, u, found)
        | {"q̈": Seen(found.qddot, _rates(u) / u.time)}
        | _forces_of_rows(case, u, found.multipliers)
        | (works if not np.any(u.drift) else {})
        | stuck
        | forces
        | counts
        | states
        | contacts
    )


def _state(i: Inputs, u: Units, found) -> dict[str, Seen]:
    at = u.shift + u.drift * np.asarray(i.ts)[:, None]
    return {"q": Seen(found.q, u.length, at), "q̇": Seen(found.qdot, _rates(u), u.drift)}


END = 9  # samples of a motion that is differentiated: 2 s


def _end(case: Case):
    def end(numbers, rest, i, settings):
        return jl.simulate(in_units(case), i.q, i.qdot, i.ts[:END], rest | numbers, throw=False, **settings).q[-1]

    return end


def _free(case: Case) -> list[str]:
    return [name for name, x in case.params.items() if not isinstance(x, jl.Signal)]


DERIVATIVES: dict = {}


def _derivative(case: Case, mode: Callable):
    key = in_units(case), mode
    if key not in DERIVATIVES:
        DERIVATIVES[key] = jax.jit(mode(_end(case)))
    return DERIVATIVES[key]


def _gradient(case: Case, u: Units, mode: Callable, settings: dict) -> dict[str, Seen]:
    i, free = inputs_of(case, u), _free(case)
    numbers = {name: jnp.asarray(i.params[name], float) for name in free}
    rest = {name: x for name, x in i.params.items() if name not in free}
    found = _derivative(case, mode)(numbers, rest, Inputs(i.q, i.qdot, i.ts, None), {"rtol": 1e-8} | settings)
    of = lambda name: u.length.reshape(-1, *[1] * np.ndim(case.params[name])) / (1.0 if name == "restitution" else u.params[name])
    return {f"dq/d{name}": Seen(found[name], of(name)) for name in free}


def gradient_forward(case: Case, u: Units, **settings) -> dict[str, Seen]:
    return _gradient(case, u, jax.jacfwd, settings)


def gradient_reverse(case: Case, u: Units, **settings) -> dict[str, Seen]:
    return _gradient(case, u, jax.jacrev, settings)


# At rest


def _unforced(i: Inputs) -> dict:
    return i.params | {"b": 0.0 * i.params["b"]}


def equilibrium(case: Case, u: Units) -> dict[str, Seen]:
    i = inputs_of(case, u)
    found = jl.equilibrium(in_units(case), i.q, _unforced(i))
    stiffness = {} if found.stiffness is None or case.kind == "massless" else {"stiffness": Seen(found.stiffness, 1 / u.time**2)}
    kind = {"stability": Seen(["stable", "unstable", "neutral"].index(found.stability) if len(found.stability) < 9 else 9)}
    return {"q": Seen(found.q, u.length, u.shift)} | _forces_of_rows(case, u, found.multipliers) | kind | stiffness


def _sorted(values):
    values = np.asarray(values)
    order = np.lexsort((np.round(values.imag, 8), np.round(values.real, 8)))
    return values[order]


def linear(case: Case, u: Units) -> dict[str, Seen]:
    """Eigenvalues, modes and a response about the position of rest q = 0."""
    i, push = inputs_of(case, u), 0
    at = u.shift + 0.0 * u.length
    found = jl.linearise(in_units(case), at, params=_unforced(i), inputs=["q"])
    values = _sorted(np.asarray(found.eigenvalues) * u.time)
    modes = found.modes()
    omega = np.array([0.3, 1.1, 2.7])
    response = np.asarray(found.frequency_response(omega / u.time)) * u.energy / (u.length[:, None] * u.length)[None]
    frequency = np.sort(np.asarray(modes.angular_frequency) * u.time)
    stable = {"modes": Seen(len(modes)), "stable": Seen(np.sum(np.asarray(modes.stable)))}
    seen = {"Re λ": Seen(values.real), "|Im λ|": Seen(np.sort(np.abs(values.imag))), "ω₀": Seen(frequency)}
    return seen | stable | {"Re H": Seen(response.real), "Im H": Seen(response.imag), "push": Seen(push)}


def locus(case: Case, u: Units) -> dict[str, Seen]:
    """Where the straight position loses its stability: cos-potential turned over, c negative."""
    i = inputs_of(case, u)
    values = u.params["c"] * np.linspace(-40.0, 10.0, 26)
    found = jl.root_locus(in_units(case), u.shift + 0.0 * u.length, params=_unforced(i), over="c", values=values)
    crossings = sorted(found.crossings, key=lambda c: float(c.value) / u.params["c"])
    at = np.array([float(c.value) for c in crossings])
    return {"crossings": Seen(len(at)), "value": Seen(at, u.params["c"]), "kind": Seen([c.kind == "divergence" for c in crossings])}


def examine(case: Case, u: Units) -> dict[str, Seen]:
    i = inputs_of(case, u)
    found = jl.examine(in_units(case), i.q, i.qdot, i.params, t=i.ts[0])
    numbers = {"dof": found.degrees_of_freedom, "rank": found.rank, "findings": len(found.findings)}
    fastest, slowest = found.time_constants
    seen = {name: Seen(x) for name, x in numbers.items()} | {"redundant": Seen(sum(found.redundant.values()))}
    return seen | {"fastest": Seen(fastest, u.time), "slowest": Seen(slowest, u.time), "light": Seen(len(found.without_inertia))}


def periodic(case: Case, u: Units) -> dict[str, Seen]:
    """The forced vibration, once a period of the force."""
    i = inputs_of(case, u)
    found = jl.periodic(in_units(case), i.q, i.qdot, i.params, section=ONCE_A_PERIOD, t=i.ts[0])
    sizes = np.sort(np.abs(np.asarray(found.multipliers)))[::-1]
    return {"q": Seen(found.q, u.length, u.shift), "q̇": Seen(found.qdot, _rates(u)), "T": Seen(found.period, u.time), "|μ|": Seen(sizes)}


def _period(params):
    u = params["units"]
    return 2 * jnp.pi * u.time * u.params["omega"] / params["omega"]


ONCE_A_PERIOD = jl.Every(_period)


# Identification


def _record(case: Case, u: Units, sigma: float | None = None):
    """The motion in the units of the case, computed tightly, with noise, of which `sigma` may be given; the same numbers in all units."""
    from transform import plain

    key = id(case)
    if key not in RECORDS:
        ts = np.linspace(0.0, 4.0, 81)
        own = case._replace(ts=ts)
        i = inputs_of(own, plain(own))
        exact = np.asarray(jl.simulate(in_units(own), i.q, i.qdot, ts, i.params, rtol=1e-11, atol=1e-12).q)
        RECORDS[key] = own, exact + 1e-3 * np.random.default_rng(0).normal(size=exact.shape)
    own, q = RECORDS[key]
    i = inputs_of(own, u)
    seen = {"q": u.channels * (u.length * q + u.shift + u.drift * i.ts[:, None])}
    return i, jl.Experiment(i.ts, seen, i.q, i.qdot, observe=_seen_position, sigma=sigma and {"q": sigma * u.channels * np.abs(u.length)})


def _seen_position(q, units):
    return {"q": units.channels * q}


RECORDS: dict = {}
IDENTIFIED = ("c", "d", "omega")


def _values(u: Units, found) -> dict[str, Seen]:
    seen = {}
    for name, k in u.params.items():
        if name in found.estimates:
            error = float(found.standard_errors[name]) / k
            seen |= {name: Seen(found.estimates[name], k, within=0.01 * error)}
            seen |= {f"± {name}": Seen(found.standard_errors[name], k, within=0.01 * error)}
    return seen


def fit(case: Case, u: Units) -> dict[str, Seen]:
    i, record = _record(case, u, sigma=1e-3)
    guess = i.params | {name: 1.1 * i.params[name] for name in IDENTIFIED}
    found = jl.fit(in_units(case), record, guess, free=IDENTIFIED)
    return _values(u, found) | {"converged": Seen(found.converged), "remarks": Seen(len(found.remarks))}


def regress(case: Case, u: Units) -> dict[str, Seen]:
    i, record = _record(case, u)
    unknown = i.params | {"c": np.nan, "d": np.nan}
    found = jl.regress(in_units(case), record, unknown, free=("c", "d"))
    more = {"linear": Seen(found.linear), "width": Seen(found.width, u.time), "windows": Seen(found.windows)}
    return _values(u, found) | more


def compare(case: Case, u: Units) -> dict[str, Seen]:
    i, record = _record(case, u)
    guess = i.params | {name: 1.1 * i.params[name] for name in IDENTIFIED}
    fits = {str(len(free)): jl.fit(in_units(case), record, guess, free=free) for free in (IDENTIFIED, IDENTIFIED[:2])}
    found = jl.compare(fits)
    differences = {f"Δ{which} {name}": Seen(x, within=0.01) for which in ("aic", "bic") for name, x in getattr(found, which).items()}
    return differences | {"best": Seen(int(found.names[0])), "unconverged": Seen(len(found.unconverged))}


QUESTIONS = {
    f.__name__: f
    for f in (
        acceleration, consistent_state, motion, gradient_forward, gradient_reverse, equilibrium, linear, locus, examine, periodic,
        fit, regress, compare,
    )
}  # fmt: skip
