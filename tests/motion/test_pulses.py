"""Pulses between the steps of smooth motions: a force exp(−((t − ½)/w)²) moves a unit mass at rest by w √π/2 until t = 1."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._program.time_functions import time_functions

WIDE = 0.005
MOVED = WIDE * np.sqrt(np.pi) / 2
TS = np.array([0.0, 1.0])
T = lambda qdot: 0.5 * qdot**2
pulse = lambda t, w=WIDE: jnp.exp(-(((t - 0.5) / w) ** 2))
struck = jl.System(T, force=lambda t, A, unit: A * pulse(t / unit))


@pytest.mark.parametrize("solver", [None, diffrax.Tsit5()], ids=["Dop853", "Tsit5"])
def test_a_pulse_in_a_smooth_motion_is_found(solver):
    """Steps grew over it: 1e-151 in place of 0.0044, in three steps."""
    for unit in (1e-6, 1.0, 1e6):
        params = {"A": 1 / unit**2, "unit": unit}
        motion = jl.simulate(struck, 0.0, 0.0, unit * TS, params, solver=solver, atol=1e-17)
        np.testing.assert_allclose(motion.q[-1], MOVED, rtol=1e-7)
        assert motion.stats["num_steps"] < 600


@pytest.mark.slow
def test_derivatives_and_batches_see_the_pulse():
    last = lambda A, **how: jl.simulate(struck, 0.0, 0.0, TS, {"A": A, "unit": 1.0}, **how).q[-1]
    np.testing.assert_allclose(jax.grad(last)(2.0), MOVED, rtol=1e-7)
    np.testing.assert_allclose(jax.grad(lambda A: last(A, adjoint=diffrax.RecursiveCheckpointAdjoint()))(2.0), MOVED, rtol=1e-7)
    many = lambda A: jl.simulate_many(struck, 0.0, 0.0, TS, {"A": A, "unit": 1.0}, over=("A",)).q[:, -1]
    A = jnp.array([1.0, 0.0, -3.0])
    np.testing.assert_allclose(many(A), MOVED * A, rtol=1e-7)
    np.testing.assert_allclose(jax.jacobian(many)(A), MOVED * np.eye(3), rtol=1e-7, atol=1e-15)


LOADS = {
    "beside a wave": lambda t: pulse(t) + 0 * jnp.sin(3 * t),
    "of two steps": lambda t: (jnp.tanh((t - 0.495) / 1e-4) + jnp.tanh((0.505 - t) / 1e-4)) / 0.02 * np.sqrt(np.pi) * WIDE,
    "where a root has no value": lambda t: pulse(t) + 0 * jnp.where(t > 0.7, jnp.sqrt(t - 0.7), 0),
    "cut off": lambda t: jnp.where(jnp.abs(t - 0.5) < 8 * WIDE, pulse(t), 0),
    "of a table": lambda t: jnp.interp(t, TABLE, pulse(TABLE)),
    "of a short table": lambda t: pulse(0.5 + WIDE) * jnp.interp(t, KNOTS, jnp.array([0.0, 0.0, 1.0, 0.0, 0.0])) * AREA,
}
TABLE = np.linspace(0, 1, 801)
KNOTS = np.array([0.0, 0.4995, 0.5, 0.5005, 1.0])  # a triangle of area 0.0005
AREA = WIDE * np.sqrt(np.pi) / 0.0005 * np.e


@pytest.mark.slow
@pytest.mark.parametrize("load", LOADS.values(), ids=LOADS)
def test_pulses_of_any_kind(load):
    motion = jl.simulate(jl.System(T, force=load), 0.0, 0.0, TS)
    np.testing.assert_allclose(motion.q[-1], MOVED, rtol=2e-5)


@pytest.mark.slow
def test_pulses_of_signals_and_of_constraints_and_of_states():
    signal = jl.Signal(TABLE, pulse(TABLE), jl.interpolation.Cubic())
    motion = jl.simulate(jl.System(T, force=lambda t, u: u(t)), 0.0, 0.0, TS, {"u": signal})
    np.testing.assert_allclose(motion.q[-1], MOVED, rtol=2e-5)
    guided = jl.System(
        lambda qdot: 0.5 * qdot["x"] ** 2 + 0.5 * qdot["y"] ** 2 - 0.0,
        holonomic=lambda t, q: q["y"] - pulse(t, 0.02),  # moves x by its force, twice ÿ
        force=lambda t, multipliers: {"x": 2 * multipliers["holonomic"]},
    )
    rest = {"x": 0.0, "y": 0.0}
    found = jl.simulate(guided, rest, rest, np.array([0.0, 0.5, 1.0]))
    np.testing.assert_allclose(found.q["x"], [0.0, 2.0, 0.0], atol=1e-6)
    state = jl.System(T, states={"z": jl.State(lambda t: pulse(t))})
    np.testing.assert_allclose(jl.simulate(state, 0.0, 0.0, TS).states["z"][-1], 2 * MOVED, rtol=1e-7)


def test_what_hides_no_pulse_costs_nothing():
    """Neither does a system that time does not enter, nor one that waves or a ramp drive."""
    y = jnp.ones(2)
    rates = [lambda t, y: y**2, lambda t, y: y * jnp.sin(3 * t) + 2 * t**2, lambda t, y: y + jnp.sum(jnp.cos(np.arange(9) * t)) ** 2]
    assert all(time_functions(f, jnp.zeros(()), y) is None for f in rates)
    assert time_functions(lambda t, y: y * pulse(t), jnp.zeros(()), y) is not None
