"""Motions at late times, in Unix time 1.7e9 s: of them nothing is less exact than their sample times, which are 2.4e-7 s apart there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

LATE = 1.7e9
TS = np.linspace(0, 5, 11)


def spring(q, qdot, c):
    return 0.5 * qdot**2 - 0.5 * c * q**2


def dry(qdot, F):
    return F * jnp.abs(qdot)


rubbing = jl.System(spring, dissipation=dry)


def rubbing_at_five(c, F):
    """q(5) from q = 1: after k = 3 half periods, q = −(A cos(√c t − 3π) + F/c), A = 1 − 7 F/c."""
    return -((1 - 7 * F / c) * np.cos(np.sqrt(c) * 5 - 3 * np.pi) + F / c)


@pytest.mark.slow
@pytest.mark.parametrize("start", [1e7, LATE, -LATE])
def test_friction(start):
    ts, params = jnp.asarray(start + TS), {"c": 4.0, "F": 0.3}
    last = lambda ts, params: jl.simulate(rubbing, 1.0, 0.0, ts, params).q[-1]
    np.testing.assert_allclose(last(ts, params), rubbing_at_five(4.0, 0.3), rtol=1e-7)
    by_ts, by_params = jax.grad(last, argnums=(0, 1))(ts, params)
    speed = 2 * (1 - 7 * 0.3 / 4) * np.sin(10 - 3 * np.pi)
    np.testing.assert_allclose(by_ts, [-speed, *[0] * 9, speed], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(by_params["F"], 7 / 4 * np.cos(10 - 3 * np.pi) - 1 / 4, rtol=1e-6)
    _, tangent = jax.jvp(last, (ts, params), (jnp.ones_like(ts), {"c": 0.0, "F": 0.0}))
    np.testing.assert_allclose(tangent, 0, atol=1e-7)  # all times together


@pytest.mark.slow
def test_friction_in_single_precision():
    """Eighths of a second are all that there is at 2²⁰ s."""
    ts = np.asarray(2.0**20 + TS, np.float32)
    motion = jl.simulate(rubbing, np.float32(1), np.float32(0), ts, {"c": np.float32(4), "F": np.float32(0.3)})
    np.testing.assert_allclose(motion.q[-1], rubbing_at_five(4.0, 0.3), rtol=1e-3)


@pytest.mark.slow
def test_bouncing_ball():
    """Impacts and events of a ball in the closed form; h = 4.905 falls one second."""
    events = {
        "top": jl.Event(lambda qdot: qdot, direction=jl.direction.Falling()),
        "tick": jl.Event(jl.Every(0.5)),
        "hit": jl.Event("floor"),
    }
    floor = jl.Contact(lambda q: q, restitution=0.5)
    ball = jl.System(lambda q, qdot: 0.5 * qdot**2 - 9.81 * q, unilateral={"floor": floor}, events=events)
    motion = jl.simulate(ball, 4.905, 0.0, LATE + np.array([0.0, 1.5, 2.375]))
    of = lambda name, n: motion.events[name].ts[:n] - LATE
    np.testing.assert_allclose(of("hit", 2), [1, 2], atol=3e-7)
    np.testing.assert_allclose(of("top", 2), [1.5, 2.25], atol=3e-7)
    np.testing.assert_array_equal(of("tick", 4), [0.5, 1.0, 1.5, 2.0])
    np.testing.assert_allclose(motion.contacts["floor"].changed[1:] - LATE, [1, 2], atol=3e-7)
    np.testing.assert_allclose(motion.q[1:], 9.81 / 2 * np.array([0.5**2, 0.25**2 - 0.125**2]), rtol=1e-9)
    assert motion.stats["reached"] == LATE + 2.375


SHIFT = 2.0**30  # a multiple of all periods below
controlled = jl.System(
    spring,
    dissipation=dry,
    force=lambda t, push, load, wave, u: push(t) + load(t) + wave(t) + u,
    states={"u": jl.Sampled(lambda q, u: 0.5 * u - q, every=lambda T: T)},
)


def controlled_motion(start, delay):
    """A motion with inputs of all kinds and updates, at times that count from a start."""
    signal = lambda values, kind: jl.Signal(start + np.array([0.0, 1.0, 2.0, 3.5, 6.0]), values, kind, delay=delay)
    signals = {
        "push": signal([0.0, 1.0, -1.0, 2.0, 0.0], jl.interpolation.ZeroOrderHold()),
        "load": signal([1.0, 0.0, 3.0, -1.0, 0.0], jl.interpolation.Linear()),
        "wave": signal([0.0, 1.0, -2.0, 1.0, 0.5], jl.interpolation.Cubic()),
    }
    return jl.simulate(controlled, 1.0, 0.0, start + TS, {"c": 4.0, "F": 0.3, "T": 0.25} | signals)


@pytest.mark.slow
def test_inputs_and_updates():
    """A shift of the clock shifts all times, and changes nothing else: values, derivatives, steps."""
    early, late = controlled_motion(0.0, 0.125), controlled_motion(SHIFT, 0.125)
    np.testing.assert_array_equal(late.q, early.q)
    np.testing.assert_array_equal(late.states["u"], early.states["u"])
    assert late.stats["num_steps"] == early.stats["num_steps"]
    by_delay = [jax.grad(lambda delay, start=start: controlled_motion(start, delay).q[-1])(0.125) for start in (0.0, SHIFT)]
    np.testing.assert_array_equal(*by_delay)


timed = jl.System(
    lambda qdot: 0.5 * qdot**2,
    events={
        "kick": jl.Event((1.0, 2.625, SHIFT + 1.0, SHIFT + 2.625), lambda qdot: {"qdot": 2 * qdot}),
        "every": jl.Event(jl.Every(lambda T: T)),
        "asked": jl.Event(lambda t, first: jnp.sin(jnp.pi * (t - first))),
    },
)


@pytest.mark.slow
@pytest.mark.parametrize("start", [0.0, SHIFT])
def test_events_at_times(start):
    def happened(first, T):
        motion = jl.simulate(timed, 0.0, 1.0, start + TS, {"first": first, "T": T})
        return motion.q[-1], {name: event.ts[:4] for name, event in motion.events.items()}

    first, T = start + 0.1875, 0.7
    q, events = happened(first, T)
    np.testing.assert_allclose(q, 1.0 + 2 * 1.625 + 4 * 2.375, rtol=1e-12)
    np.testing.assert_array_equal(events["kick"][:2], start + np.array([1.0, 2.625]))
    k = np.floor(start / T) + np.arange(1, 5)
    np.testing.assert_allclose(events["every"], k * T, rtol=3e-16, atol=1e-12)
    np.testing.assert_allclose(events["asked"], first + np.arange(4), rtol=3e-16, atol=1e-12)
    _, changes = jax.jacfwd(happened, argnums=(0, 1))(first, T)
    np.testing.assert_allclose(changes["asked"][0], 1, rtol=1e-9)
    np.testing.assert_allclose(changes["every"][1], k, rtol=1e-9)


@pytest.mark.slow
def test_events_that_ask_for_signals_at_other_times():
    """u = 2 − 1.5 (t − 1) for 1 ≤ t ≤ 3 is zero at 7/3, and u(t − 0.3) is that later."""
    u = jl.Signal([0.0, 1.0, 3.0, 6.0], [1.0, 2.0, -1.0, -2.0], jl.interpolation.Linear())
    system = jl.System(lambda qdot: 0.5 * qdot**2, events={"zero": jl.Event(lambda t, u: u(t - 0.3), lambda t, u: {"qdot": u(t - 0.5)})})
    motion = jl.simulate(system, 0.0, 0.0, [0.0, 5.0], {"u": u})
    np.testing.assert_allclose(motion.events["zero"].ts[0], 7 / 3 + 0.3, rtol=1e-12)
    np.testing.assert_allclose(motion.qdot[-1], 1.5 * 0.2, rtol=1e-12)


def driven(t, start):
    return jnp.sin(4 * (t - start))


@pytest.mark.slow
@pytest.mark.parametrize("dissipation", [None, pytest.param(dry, marks=pytest.mark.slow)])
def test_functions_of_time(dissipation):
    """They see the time to its rounding, 2.4e-7 s, which is all that is lost: of a force that changes by 4 a second, 1e-6."""
    allowed = 1e-6
    system = jl.System(spring, force=driven, dissipation=dissipation)
    at = lambda start: jl.simulate(system, 1.0, 0.0, start + TS, {"c": 4.0, "F": 0.3, "start": start})
    early, late = at(0.0), at(LATE)
    np.testing.assert_allclose(late.q, early.q, atol=allowed)
    if dissipation is None:  # ẍ + 4 x = sin 4t
        np.testing.assert_allclose(late.q, np.cos(2 * TS) + np.sin(2 * TS) / 6 - np.sin(4 * TS) / 12, atol=allowed)
