"""Events of velocities that friction holds: their witnesses are zero but for rounding, of which no past motion says how large it is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

STOPS = {"stops": jl.Event(lambda qdot: qdot, most=3)}
UNITS = {"m, kg, s": (1.0, 1.0, 1.0), "mm, t, s": (1e3, 1e-3, 1.0), "nm, kg, µs": (1e9, 1.0, 1e6), "Mm, g, years": (1e-6, 1e3, 3.2e-8)}
dry = lambda qdot, mu, N: mu * N * jnp.abs(qdot)
incline = jl.System(lambda q, qdot, m, g, slope: 0.5 * m * qdot**2 - m * g * jnp.sin(slope) * q, dissipation={"dry": dry}, events=STOPS)
shaken = jl.System(
    lambda qdot, m: 0.5 * m * qdot**2, force=lambda t, A, w: A * jnp.sin(w * t), dissipation={"dry": lambda qdot, F: F * jnp.abs(qdot)},
    events=STOPS,
)  # fmt: skip


@pytest.mark.parametrize("units", UNITS.values(), ids=UNITS)
def test_a_block_on_an_incline_stays_and_stops_where_it_should(units):
    """From rest steps shrank to nothing at t = 0, since the velocity, 1e-32, was on the wrong side of zero."""
    length, mass, time = units
    g, slope, u = 9.81 * length / time**2, 0.4, 3.0 * length / time
    params = {"m": 2.5 * mass, "g": g, "slope": slope, "N": 2.5 * mass * g * np.cos(slope), "mu": 0.6}
    ts = time * np.linspace(0, 2, 5)
    rest = jl.simulate(incline, 0.0, 0.0, ts, params)
    assert np.all(np.isnan(rest.events["stops"].ts)) and np.max(np.abs(rest.q)) < 1e-20 * length
    stop = lambda mu: jl.simulate(incline, 0.0, u, ts, params | {"mu": mu}).events["stops"].ts[0]
    exact = lambda mu: u / (g * (np.sin(slope) + mu * np.cos(slope)))
    for mu in (0.3, 0.6):  # slides back, and sticks
        np.testing.assert_allclose(stop(mu), exact(mu), rtol=1e-9)
        slope_of_it = -(exact(mu) ** 2) * g * np.cos(slope) / u
        np.testing.assert_allclose([jax.grad(stop)(mu), jax.jacfwd(stop)(mu)], slope_of_it, rtol=1e-8)


@pytest.mark.parametrize("late", [0.0, 1e9], ids=["from 0", "from 1e9"])
@pytest.mark.parametrize("units", UNITS.values(), ids=UNITS)
def test_what_a_force_tears_off_stops_when_it_should(units, late):
    """From A sin ωt = F on m q̈ = A sin ωt − F: at rest again where A (cos ωs − cos ωt) / ω = F (t − s), by SciPy's root."""
    from scipy.optimize import brentq

    length, mass, time = units
    params = {"m": mass, "A": mass * length / time**2, "w": 1 / time, "F": 0.5 * mass * length / time**2}
    ts = time * np.linspace(0, 5, 6)
    start = np.arcsin(0.5)
    stop = brentq(lambda t: np.cos(start) - np.cos(t) - 0.5 * (t - start), 3, 4.5, xtol=1e-14)
    late = late * time - late * time % (2 * np.pi * time)
    tolerance = 1e-8 if late == 0 else 1e-6
    motion = jl.simulate(shaken, 0.0, 0.0, late + ts, params)
    found = (motion.events["stops"].ts - late) / time
    np.testing.assert_allclose(found[0], stop, rtol=tolerance)
    held = jl.simulate(shaken, 0.0, 0.0, late + ts, params | {"F": 2 * params["F"] * 1.1})
    assert np.all(np.isnan(held.events["stops"].ts))


def test_two_blocks_that_hold_each_other_have_no_event():
    witness = lambda qdot: 0.3 * qdot["a"] + qdot["b"]
    directions = jl.direction.Either(), jl.direction.Falling(), jl.direction.Rising(), jl.direction.Negative()
    blocks = jl.System(
        lambda q, qdot: 0.5 * (qdot["a"] ** 2 + 0.7 * qdot["b"] ** 2 + 0.6 * qdot["a"] * qdot["b"]) - 17.3 * (q["a"] - q["b"]) ** 2,
        force=lambda t: {"a": 0.1 * jnp.sin(3 * t) + 0.37, "b": 0.3 + 0 * t},
        dissipation={"dry": lambda qdot: 0.7 * (jnp.abs(qdot["a"]) + 1.3 * jnp.abs(qdot["b"]))},
        events={type(direction).__name__: jl.Event(witness, direction=direction) for direction in directions},
    )
    none = {"a": 0.0, "b": 0.0}
    motion = jl.simulate(blocks, none, none, np.linspace(0, 10, 3))
    assert all(np.all(np.isnan(event.ts)) for event in motion.events.values())


@pytest.mark.parametrize("load, direction, count", [
    (lambda t, A: -A * t, None, 0), (lambda t, A: A * t, None, 0), (lambda t, A: -A * t, jl.direction.Falling(), 0),
    (lambda t, A: -A * t, jl.direction.Negative(), 1), (lambda t, A: A * (t - 1.5 * t**2), None, 1),
])  # fmt: skip
def test_a_velocity_that_leaves_zero_slowly_is_no_event(load, direction, count):
    """Under a load that begins at zero; the last one comes back through zero at t = 1."""
    event = jl.Event(lambda qdot: qdot, **({} if direction is None else {"direction": direction}))
    pushed = jl.System(lambda qdot: 0.5 * qdot**2, force=load, events={"zero": event})
    for unit in (1e-9, 1.0, 1e6):
        ts = jl.simulate(pushed, 0.0, 0.0, np.linspace(0, 1.5, 4), {"A": unit}).events["zero"].ts
        assert np.sum(np.isfinite(ts)) == count
        if count and direction is None:
            np.testing.assert_allclose(ts[0], 1.0, rtol=1e-9)


def test_events_are_printed_without_the_places_that_are_left():
    turning = jl.System(lambda q, qdot: 0.5 * qdot**2 - 2 * q**2, events={"turn": jl.Event(lambda qdot: qdot)})
    printed = repr(jl.simulate(turning, 0.0, 1.0, [0.0, 3.0]).events["turn"])
    assert printed == "EventState: 2 of at most 100, ts = [0.78539816 2.35619449]"
