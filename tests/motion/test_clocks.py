"""A set-point that was recorded by a clock which is not quite that of the controller that reads it."""

import jax
import numpy as np
import pytest
from scipy.linalg import expm

import jaxlag as jl

T, N = 0.01, 201
GOALS = np.where((np.arange(N) // 20) % 2 == 0, 1.0, -1.0)
servo = jl.System(
    lambda qdot, m: 0.5 * m * qdot**2,
    dissipation=lambda qdot, b: 0.5 * b * qdot**2,
    force=lambda u: u,
    states={"u": jl.Sampled(lambda q, qdot, t, goal, gain, T: gain * (goal(t) - q) - qdot * 0.01 / T, every=lambda T: T, start=0.0)},
)


def by_hand(gain=50.0, b=2.0):
    """m = 1, an exact step of the linear motion for each tick: the controller sees the new goal."""
    A = np.array([[0, 1, 0], [0, -b, 1], [0, 0, 0.0]])
    step, x, seen = expm(A * T), np.zeros(3), []
    for goal in GOALS:
        seen.append(x[0])
        x[2] = gain * (goal - x[0]) - x[1]
        x = step @ x
    return np.array(seen)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e5])
@pytest.mark.parametrize("late", [0.0, 1e6])
@pytest.mark.parametrize("off", [0.0, 3e-6, 4e-4], ids=lambda off: f"{off:g} of a tick")
def test_a_controller_reads_the_set_point_of_its_tick(off, late, scale):
    """With a clock off by 3e-8 s each update read the old or the new set-point at random: positions were off by 0.08."""
    ticks = scale * T * (np.arange(N) + late)
    recorded = ticks + scale * T * off * np.random.default_rng(0).uniform(-1, 1, N)
    recorded[0] = min(recorded[0], ticks[0])
    params = {"m": 1.0, "b": 2.0 / scale, "gain": 50.0 / scale**2, "T": T * scale}
    goal = jl.Signal(recorded, GOALS, jl.interpolation.ZeroOrderHold())
    position = lambda b: jl.simulate(servo, 0.0, 0.0, ticks, params | {"b": b, "goal": goal}).q
    np.testing.assert_allclose(position(params["b"]), by_hand(), atol=2e-6 if late else 1e-9)
    difference = (by_hand(b=2.001) - by_hand(b=1.999)) / 0.002
    along = jax.jvp(position, (params["b"],), (1.0 / scale,))[1]
    np.testing.assert_allclose(along, difference, atol=1e-5 * np.max(np.abs(difference)))


@pytest.mark.parametrize("sampled", ["at the ticks", "by the clock of the log"])
@pytest.mark.parametrize("off", [-4e-4, -3e-6, 3e-6, 4e-4])
def test_a_log_that_began_before(off, sampled):
    """All times of the log are late, or early, by a part of a tick; the first goal differs from that before the motion. Where samples of
    the motion stood between a tick and the time of its goal in the log, no further goal was read, and nothing moved.
    """
    shifts = T * off * np.random.default_rng(0).uniform(0.5, 1, N + 3)
    log = T * np.arange(-3, N) + shifts
    goal = jl.Signal(log, np.append([7.0, 7.0, 7.0], GOALS), jl.interpolation.ZeroOrderHold())
    ts = T * np.arange(N) if sampled == "at the ticks" else np.append(0.0, log[4:])
    motion = jl.simulate(servo, 0.0, 0.0, ts, {"m": 1.0, "b": 2.0, "gain": 50.0, "T": T, "goal": goal})
    np.testing.assert_allclose(motion.q + motion.qdot * (T * np.arange(N) - ts), by_hand(), atol=1e-9 + 100 * (off * T) ** 2)


def test_a_signal_that_is_finer_than_the_ticks_keeps_its_times():
    """A force in pulses of 1 ms beside a controller of 1 Hz: the momentum is the sum of all pulses, by hand."""
    pulses = np.random.default_rng(1).standard_normal(3001)
    pushed = jl.System(
        lambda qdot: 0.5 * qdot**2, force=lambda t, f, u: f(t) + 0 * u, states={"u": jl.Sampled(lambda q: q, every=1.0, start=0.0)}
    )
    times = 1e-3 * np.arange(3001) + 5e-4
    motion = jl.simulate(pushed, 0.0, 0.0, [0.0, 1.0, 2.0], {"f": jl.Signal(times, pulses, jl.interpolation.ZeroOrderHold())})
    upto = lambda t: np.sum(pulses[:-1] * np.clip(t - times[:-1], 0, 1e-3)) + pulses[0] * times[0]
    np.testing.assert_allclose(motion.qdot, [0.0, upto(1.0), upto(2.0)], rtol=1e-9, atol=1e-12)


def test_a_closed_loop_is_identified_whose_clock_is_off():
    """Friction was identified as −857 ± 3.3, "converged", from a log with such a clock; nothing, where its samples had it, too."""
    ticks = T * np.arange(N)
    recorded = ticks + 3e-8 * np.random.default_rng(0).standard_normal(N)
    recorded[0] = min(recorded[0], 0.0)
    seen = by_hand() + 1e-4 * np.random.default_rng(2).standard_normal(N)
    goal = jl.Signal(recorded, GOALS, jl.interpolation.ZeroOrderHold())
    log = jl.Experiment(recorded, seen, 0.0, 0.0, params={"goal": goal}, unknown=("q0", "qdot0"))
    found = jl.fit(servo, log, {"m": 1.3, "b": 1.0, "gain": 50.0, "T": T}, free=("m", "b"))
    assert found.converged
    for name, true in (("m", 1.0), ("b", 2.0)):
        assert abs(float(found.estimates[name]) - true) < 4 * float(found.standard_errors[name]) < 0.02
