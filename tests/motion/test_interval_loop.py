"""The loop around the steps: one kernel, with samples from the dense output, against diffrax's own loop around the same steps."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

TS = np.linspace(0, 4, 41)
START, PARAMS = (np.array([1.5, 0.0]), np.zeros(2)), {"m": 2.0, "l": 1.5, "g": 9.81, "b": 0.1, "F": 2.0}


def lagrangian(q, qdot, m, g):
    return 0.5 * m * qdot @ qdot - m * g * q[1]


def rod(q, l):
    return jnp.hypot(q[0], q[1]) - l


SMOOTH = jl.System(lagrangian, dissipation={"air": lambda qdot, b: 0.5 * b * qdot @ qdot}, holonomic={"rod": rod})
DRY = jl.System(lagrangian, dissipation={"joint": lambda q, qdot, F, l: F * jnp.abs(q[0] * qdot[1] - q[1] * qdot[0]) / l}, holonomic=rod)
IMPLICIT = diffrax.Kvaerno5(root_finder=diffrax.VeryChord(rtol=1e-8, atol=1e-10))


@pytest.mark.slow
@pytest.mark.parametrize("case", [(SMOOTH, jl.Dop853()), (SMOOTH, IMPLICIT), (DRY, jl.Dop853())], ids=["smooth", "implicit", "dry"])
def test_steps_and_samples_are_those_of_diffrax(case):
    """The same steps, kept and refused, and what their dense output says: equal to rounding.

    The equations of the implicit stages are solved to tolerances that are given: ours follow the size of the motion so far, which diffrax's
    loop does not know.
    """
    system, solver = case
    found = jl.simulate(system, *START, TS, PARAMS, solver=solver)
    expected = jl.simulate(system, *START, TS, PARAMS, solver=solver, adjoint=diffrax.ForwardMode())
    for name in ("num_accepted_steps", "num_rejected_steps"):
        assert found.stats[name] == expected.stats[name]
    for got, wanted in zip(*map(jax.tree.leaves, ((found.q, found.qdot), (expected.q, expected.qdot))), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-13 * np.max(np.abs(wanted)))


@pytest.mark.slow
@pytest.mark.parametrize("system", [SMOOTH, DRY], ids=["smooth", "dry"])
def test_derivatives_are_those_of_diffrax(system):
    """Of a position between two steps, by the length of the rod, which moves the start as well, and by the damping or friction.

    Ours are by steps that resolve the variations too, and are nearer at the same tolerance.
    """

    def end(x, **how):
        found = jl.simulate(system, *START, TS, PARAMS | {"l": x[0], "b": x[1], "F": 20 * x[1]}, **how)
        return jnp.concatenate([found.q[-1], found.qdot[17]])

    x = jnp.array([1.5, 0.1])
    of_diffrax = lambda **how: jax.jacfwd(lambda x: end(x, adjoint=diffrax.ForwardMode(), **how))(x)
    expected = of_diffrax(rtol=1e-11)
    np.testing.assert_allclose(jax.jacrev(lambda x: end(x, rtol=1e-11))(x), expected, rtol=1e-9, atol=1e-9)
    off = lambda found: np.max(np.abs(found - expected))
    assert off(jax.jacrev(end)(x)) < min(2e-8, off(of_diffrax()))


@pytest.mark.slow
def test_samples_beyond_the_end_of_a_motion_are_not_made_up():
    """Three steps do not reach the end: samples within them are there, the others are not."""
    found = jl.simulate(SMOOTH, *START, TS, PARAMS, max_steps=7, throw=False)
    there = np.isfinite(np.asarray(found.q[:, 0]))
    assert found.stats["num_accepted_steps"] <= 7 and 1 < there.sum() < TS.size
    np.testing.assert_array_equal(there, TS[there][-1] >= TS)
    whole = jl.simulate(SMOOTH, *START, TS, PARAMS)
    np.testing.assert_allclose(found.q[there], whole.q[there], rtol=0, atol=1e-14)


HELD = jl.System(lagrangian, force={"wind": lambda t, u: jnp.array([1.0, 0.0]) * u(t)}, holonomic={"rod": rod})
STEPPED = PARAMS | {"u": jl.Signal(np.linspace(0, 4, 9), np.arange(9.0) - 4, jl.interpolation.ZeroOrderHold())}


@pytest.mark.slow
@pytest.mark.parametrize("case", [(SMOOTH, PARAMS), (DRY, PARAMS), (HELD, STEPPED)], ids=["smooth", "dry", "input"])
def test_first_and_last_times_may_be_repeated_inside_a_program(case):
    """As the delay of a sensor has it, and padding: they show the same state."""
    system, params = case
    ts = jnp.array([0.0, 0.0, 0.0, 0.3, 1.1, 2.0, 2.0])
    found = jax.jit(lambda ts: jl.simulate(system, *START, ts, params).q)(ts)
    expected = jl.simulate(system, *START, ts[2:-1], params).q
    np.testing.assert_allclose(found, expected[jnp.array([0, 0, 0, 1, 2, 3, 3])], rtol=0, atol=1e-9)
