"""Steps with dry friction in one loop: the same motions as by a loop for each purpose, from programs that hold the equations once."""

import collections

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._motion import integrate
from jaxlag._motion.step_monitor import CHEBYSHEV, slopes_of_interpolant
from jaxlag._program.walker import primitive_names, programs_within

TS = jnp.linspace(0, 4, 41)


def driven(t, A, w):
    return A * jnp.stack([jnp.cos(w * t), 0.7 * jnp.sin(2.3 * w * t)])


def spring(q, qdot, c):
    return 0.5 * qdot @ qdot - 0.5 * c * (q[0] ** 2 + (q[1] - q[0]) ** 2)


SYSTEMS = {
    "two elements": jl.System(spring, dissipation=lambda qdot, F: F * (jnp.abs(qdot[0]) + 0.5 * jnp.abs(qdot[1] - qdot[0])), force=driven),
    "in a plane": jl.System(spring, dissipation=lambda qdot, F: F * jnp.hypot(qdot[0], qdot[1]), force=driven),
    "on a rod": jl.System(
        spring,
        dissipation=lambda q, qdot, F: F * jnp.abs(q[0] * qdot[1] - q[1] * qdot[0]),
        holonomic={"rod": lambda q: q @ q - 1},
        force=driven,
    ),
    "beside a slider": jl.System(
        lambda q, qdot, c: spring(q, qdot, c) - 0.5 * qdot[1] ** 2,
        dissipation=lambda qdot, F: F * jnp.abs(qdot[1]) + 0.3 * F * jnp.abs(qdot[0]),
        force=lambda t, A, w: driven(t, A, w) * jnp.array([2, 0.3]),
    ),
    "on a wire": jl.System(
        spring,
        dissipation=lambda qdot, multipliers, F: 0.3 * F * jnp.abs(multipliers["wire"]) * jnp.abs(qdot[0]),
        holonomic={"wire": lambda q: q[1] - 0.3 * q[0] ** 2},
        force=driven,
    ),
    "on a floor": jl.System(
        spring,
        dissipation=lambda qdot, multipliers, F: F * jnp.abs(qdot[1] - qdot[0]) + 0.3 * multipliers["floor"] * jnp.abs(qdot[0]),
        unilateral={"floor": jl.Contact(lambda q: q[1], 0.6)},
        force=driven,
    ),
    "between walls": jl.System(
        spring,
        unilateral={
            "left": jl.Contact(lambda q, c: q[0] + 0.3 * q[1], 0.5, jl.PoissonRestitution()),
            "right": jl.Contact(lambda q, A, c: A / c - q[1], 0.7),
        },
        force=driven,
    ),
}


def state(name, rng):
    q, v = rng.normal(size=2), rng.normal(size=2)
    if name == "on a rod":
        q /= np.linalg.norm(q)
        v = v[0] * np.array([-q[1], q[0]])
    if name == "on a wire":
        q[1], v[1] = 0.3 * q[0] ** 2, 0.6 * q[0] * v[0]
    if name == "on a floor":
        q[1] = max(q[1], 0)  # half of them touch it
    if name == "between walls":
        q = np.array([0.5, -0.5])
    return q, v * rng.integers(2)


def motions(name, units, count):
    """Of random numbers, in units of length and time that are not of order one."""
    length, time = units
    rng = np.random.default_rng(7)
    scale = {"c": 1 / time**2, "F": length / time**2, "A": length / time**2, "w": 1 / time}
    motion = jax.jit(lambda q, v, params: jl.simulate(SYSTEMS[name], q, v, TS * time, params, throw=False))
    for _ in range(count):
        (q, v), numbers = state(name, rng), dict(zip("cFAw", rng.uniform([0.5, 0.05, 0.1, 0.3], [20, 2, 4, 6]), strict=True))
        params = {name: number * scale[name] for name, number in numbers.items()}
        yield motion(length * q, length / time * v, params)


@pytest.mark.parametrize(
    ("name", "units"),
    [
        ("on a rod", (1.0, 1.0)),
        pytest.param("two elements", (1e-6, 1e-3), marks=pytest.mark.slow),
        pytest.param("beside a slider", (1e3, 1e-6), marks=pytest.mark.slow),
        pytest.param("on a floor", (1e-6, 1e-3), marks=pytest.mark.slow),
    ],
)
def test_motions_are_those_of_a_loop_for_each_purpose(name, units, monkeypatch):
    _compare(name, units, monkeypatch, 12)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["in a plane", "on a wire", "two elements", "beside a slider", "between walls", "on a floor"])
def test_more_motions_are_those_of_a_loop_for_each_purpose(name, monkeypatch):
    _compare(name, (1.0, 1.0), monkeypatch, 60)


def _compare(name, units, monkeypatch, count):
    found = list(motions(name, units, count))
    monkeypatch.setattr(integrate, "has_one_evaluation", lambda *given: False)
    jax.clear_caches()
    expected = list(motions(name, units, count))
    jax.clear_caches()
    sliding = 0
    for one, other in zip(found, expected, strict=True):
        assert one.result == other.result == jl.results.RESULTS.successful
        scale = np.max(np.abs(other.q), initial=units[0] * 1e-3)
        np.testing.assert_allclose(one.q, other.q, atol=1e-6 * scale)
        impacts = [np.max(contact.impacts) for contact in other.contacts.values()]
        sliding += int(np.sum(other.stats.get("transitions", np.zeros(1))[-1]) + sum(impacts))
    ratios = [int(one.stats["num_steps"]) / int(other.stats["num_steps"]) for one, other in zip(found, expected, strict=True)]
    assert np.median(ratios) <= 1.03
    assert sliding > count / 4  # modes have changed


def turning(q):
    return q[0] - 0.3 * q[1]


WATCHED = {"turns": jl.Event(lambda qdot: qdot[0]), "passes": jl.Event(turning, direction=jl.direction.Rising()), "ticks": jl.Event([1.1])}
STOP = jl.System(
    spring,
    dissipation={
        "joint": lambda qdot, F: F * jnp.abs(qdot[1] - qdot[0]),
        "stop": lambda q, qdot, c: jnp.where(q[0] > 0, c, 0.0) * qdot[0] ** 2,
    },
    force=driven,
)
EVENTFUL = {
    "two elements": (SYSTEMS["two elements"], WATCHED),
    "beside a slider": (SYSTEMS["beside a slider"], WATCHED),
    "on a rod": (SYSTEMS["on a rod"], WATCHED),
    "smooth": (jl.System(spring, force=driven), WATCHED),
    "smooth, on a rod": (jl.System(spring, holonomic={"rod": lambda q: q @ q - 1}, force=driven), WATCHED),
    "on a floor": (SYSTEMS["on a floor"], WATCHED | {"strikes": jl.Event("floor")}),
    "between walls": (SYSTEMS["between walls"], WATCHED | {"strikes": jl.Event("left")}),
    "beyond a stop": (STOP, {"edge": jl.Event(lambda q: q[0])}),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["two elements", "smooth, on a rod", "beyond a stop"])
def test_events_are_those_of_a_loop_for_each_purpose(name, monkeypatch):
    _compare_events(name, monkeypatch, 12)


@pytest.mark.slow
@pytest.mark.parametrize("name", EVENTFUL)
def test_more_events_are_those_of_a_loop_for_each_purpose(name, monkeypatch):
    _compare_events(name, monkeypatch, 60)


def _compare_events(name, monkeypatch, count):
    """Times and counts of events, and the derivative of all these times by a number that moves them."""
    system, events = EVENTFUL[name]
    given = []
    rng = np.random.default_rng(11)
    for _ in range(count):
        q, v = state(name.removeprefix("smooth, "), rng)
        given.append((q, v, dict(zip("cFAw", rng.uniform([0.5, 0.05, 0.1, 0.3], [20, 2, 4, 6]), strict=True))))

    def found(q, v, params):
        def of(c):
            motion = jl.simulate(system, q, v, TS, params | {"c": c}, events=events, throw=False)
            times = {name: event.ts for name, event in motion.events.items()}
            return sum(jnp.sum(jnp.where(jnp.isfinite(ts), ts, 0)) for ts in times.values()), (motion.q, times, motion.result)

        return jax.value_and_grad(of, has_aux=True)(params["c"])

    run = jax.jit(found)
    here = [run(*numbers) for numbers in given]
    monkeypatch.setattr(integrate, "has_one_evaluation", lambda *given: False)
    jax.clear_caches()
    run, happened, failed = jax.jit(lambda *numbers: found(*numbers)), 0, 0
    for numbers, ((_, (q, times, result)), slope) in zip(given, here, strict=True):
        (_, (other_q, other_times, other)), other_slope = run(*numbers)
        assert result == jl.results.RESULTS.successful
        if other != result:
            failed += 1
            continue
        np.testing.assert_allclose(q, other_q, atol=1e-6 * np.max(np.abs(other_q)))
        for event, ts in times.items():
            np.testing.assert_allclose(ts, other_times[event], rtol=1e-6, err_msg=event)
            happened += int(np.sum(np.isfinite(ts)))
        np.testing.assert_allclose(slope, other_slope, rtol=1e-3, atol=1e-4)
    jax.clear_caches()
    assert happened > count
    assert failed <= count / 60  # a loop for each purpose ends where a slip turns at infinitely many impacts


@pytest.mark.slow
def test_where_all_times_are_the_same_there_is_the_start():
    """Behind the impact there, and in the mode that holds."""
    ball = jl.System(lambda q, qdot, g: 0.5 * qdot**2 - g * q, unilateral={"floor": jl.Contact(lambda q: q, 0.8)})
    motion = jax.jit(lambda v, ts: jl.simulate(ball, 0.0, v, ts, {"g": 9.81}, throw=False))
    once, twice = jnp.array([1.0, 1.0]), jnp.array([1.0, 2.0])
    np.testing.assert_allclose(motion(-1.0, once).qdot, 0.8, rtol=1e-14)
    np.testing.assert_allclose(motion(0.0, once).multipliers["floor"], 9.81, rtol=1e-14)
    np.testing.assert_allclose(motion(-1.0, twice).qdot[0], 0.8, rtol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("q", [(0.6, -0.8), (0.0, -1.0)], ids=["swings", "rests"])
def test_derivatives_in_nanometres_and_gigaseconds(q):
    """Of a pendulum on a rod with friction in its joint, beside differences; also without friction, on the side where there is some."""
    length, time, h = 1e-9, 1e9, 1e-5
    pendulum = jl.System(
        lambda q, qdot, m, g: 0.5 * m * qdot @ qdot - m * g * q[1],
        dissipation=lambda q, qdot, F, l: F * jnp.abs(q[0] * qdot[1] - q[1] * qdot[0]) / l,
        holonomic={"rod": lambda q, l: jnp.hypot(q[0], q[1]) - l},
    )
    unit = length / time**2
    params = lambda F: {"m": 2.0, "g": 9.81 * unit, "F": F * unit, "l": length}
    last = jax.jit(lambda F: jl.simulate(pendulum, length * jnp.array(q), jnp.zeros(2), 3 * time * TS / TS[-1], params(F)).q[-1] / length)
    slope = jax.jit(jax.jacfwd(last))
    for F in (0.0, 0.4):
        central = (last(F + h) - last(F - h)) / (2 * h) if F else (-3 * last(F) + 4 * last(F + h) - last(F + 2 * h)) / (2 * h)
        np.testing.assert_allclose(slope(F), central, atol=1e-7)


def loops(program):
    """All loops in a program."""
    for equation in getattr(program, "jaxpr", program).eqns:
        if equation.primitive.name == "while":
            yield equation
        for part in programs_within(equation):
            yield from loops(part)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "most"), [("on a rod", 8), ("in a plane", 4)])
def test_equations_stand_once_in_the_loop(name, most):
    """Of an energy that holds erf, derivatives and the projection included; a loop for each purpose held 19 and 7 of them."""
    system = SYSTEMS[name]
    marked = jl.System(
        lambda q, qdot, c: spring(q, qdot, c) + 1e-3 * jax.lax.erf(q[0]) * qdot[0] ** 2,
        dissipation=dict(system.dissipation),
        holonomic=dict(system.holonomic),
        force=driven,
    )
    q, v = state(name, np.random.default_rng(0))
    params = {"c": 1.0, "F": 0.2, "A": 1.0, "w": 2.0}
    program = jax.make_jaxpr(lambda q, v: jl.simulate(marked, q, v, TS, params, throw=False).q)(q, v)
    counts = [collections.Counter(primitive_names(loop.params["body_jaxpr"]))["erf"] for loop in loops(program)]
    assert 0 < max(counts) <= most


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (1e3, 1e3 + 3e-2), (-1e-9, 2e-9)])
def test_slopes_of_an_interpolant_are_those_of_its_polynomial(low, high):
    coefficients = np.random.default_rng(1).normal(size=(9, 3))
    at = lambda s: np.polynomial.polynomial.polyval(s, coefficients).T
    slope = lambda s: np.polynomial.polynomial.polyval(s, np.polynomial.polynomial.polyder(coefficients)).T
    middle, half = (low + high) / 2, (high - low) / 2
    s = np.linspace(-1, 1, 5)
    found = slopes_of_interpolant(low, high, jnp.asarray(at(2 * np.array(CHEBYSHEV) - 1)), jnp.asarray(middle + half * s))
    seen = (middle + half * s - middle) / half  # as times round
    np.testing.assert_allclose(found, slope(seen) / half, rtol=1e-9, atol=1e-9 / half)


def test_a_result_says_that_it_is_one():
    fall = jl.System(lambda q, qdot: 0.5 * qdot**2 - 9.81 * q)
    assert "successful" in repr(jl.simulate(fall, 0.0, 0.0, [0.0, 1.0]).result)
    stopped = jl.simulate(fall, 0.0, 0.0, [0.0, 1e3], max_steps=2, throw=False).result
    assert "max_steps" in repr(stopped) and "successful" not in repr(stopped)
