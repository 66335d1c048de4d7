"""Energy, power and work; the pre-flight check."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag.examples import pendulum, vehicle


def test_powers_add_up_to_the_rate_of_the_energy():
    """A charged bead with drag on a moving wall, L with explicit time: dh/dt by differences along the motion."""
    system = jl.System(
        lambda t, q, qdot, m: 0.5 * m * qdot @ qdot - jnp.cos(2 * t) * q[0] ** 2 - q[1],
        dissipation={"oil": lambda qdot, b: 0.5 * b * qdot @ qdot, "air": lambda qdot: jnp.abs(qdot[1]) ** 3},
        force={"push": lambda t: jnp.stack([jnp.sin(t), 0.0 * t, 0.3 + 0 * t])},
        holonomic={"wall": lambda t, q: q[2] - q[0] - jnp.sin(3 * t)},
    )
    p = {"m": 1.7, "b": 0.4}
    ts = jnp.array([0.0, 0.499, 0.5, 0.501])
    motion = jl.simulate(system, jnp.array([0.3, 0.1, 0.3]), jnp.array([1.0, -0.5, 4.0]), ts, p, rtol=1e-11, atol=1e-12, works=True)
    named = jl.powers(system, motion.q[2], motion.qdot[2], p, t=0.5)
    assert set(named) == {"oil", "air", "push", "wall", "time"}
    energy = motion.energy()
    np.testing.assert_allclose(sum(named.values()), (energy[3] - energy[1]) / 0.002, rtol=1e-5)
    np.testing.assert_allclose(energy[2], jl.energy(system, motion.q[2], motion.qdot[2], p, t=0.5), rtol=1e-14)
    for name, power in named.items():
        work = motion.work()[name]
        np.testing.assert_allclose(power, (work[3] - work[1]) / 0.002, rtol=1e-5, atol=1e-7)
    assert np.max(np.abs(motion.balance())) < 1e-10


def test_works_of_the_vehicle_in_closed_form():
    """The drive does M₀ x/r, whatever else happens; dampers take what the springs and the body lose."""
    ts, p = jnp.linspace(0, 20, 101), vehicle.params
    motion = jl.simulate(vehicle.system, vehicle.q0, vehicle.qdot0, ts, p, works=True)
    np.testing.assert_allclose(motion.work()["drive"], p["M0"] / p["r"] * motion.q["x"], rtol=1e-8, atol=1e-6)
    assert np.max(np.abs(motion.balance())) < 1e-8
    assert "energy balance" in repr(motion) and "off by" in repr(motion)
    heave = lambda y, phi: p["M"] * p["g"] * y + p["c"] * ((y - p["l"]) ** 2 + (p["a"] * phi) ** 2)
    lost = heave(0.55, 0.05) - heave(motion.q["y"][-1], motion.q["phi"][-1])
    np.testing.assert_allclose(motion.work()["dampers"][-1], -lost, rtol=1e-6)


@pytest.mark.slow
def test_the_work_of_projection_is_listed_apart():
    ts, p = jnp.linspace(0, 10, 51), pendulum.params
    run = lambda how: jl.simulate(
        pendulum.cartesian, *pendulum.cartesian_state(2.0, 0.0, 1.0), ts, p, rtol=1e-5, atol=1e-7, works=True, stabilisation=how
    )
    projected, drifting = run(jl.stabilisation.Projection()), run(jl.stabilisation.NoStabilisation())
    assert set(projected.work()) == {"rod", "time", "projection"}
    assert np.abs(projected.work()["projection"][-1]) > 1e-8
    assert np.all(drifting.work()["projection"] == 0)
    assert np.max(np.abs(projected.balance())) < 1e-4


def test_works_that_were_not_asked_for():
    motion = jl.simulate(pendulum.polar, *pendulum.polar_state(1.0, 0.0, 1.0), [0, 1.0], pendulum.params)
    with pytest.raises(ValueError, match=r"must be computed with its works, but was computed without.*works=True"):
        motion.work()
    np.testing.assert_allclose(motion.energy(), -9.81 * np.cos(1.0), rtol=1e-7)


@pytest.mark.slow
def test_gradient_of_a_work():
    """Work of a damper on a decaying oscillator, against finite differences, forward and reverse."""
    system = jl.System(lambda q, qdot: 0.5 * qdot**2 - 2 * q**2, dissipation={"oil": lambda qdot, b: 0.5 * b * qdot**2})
    lost = lambda b: jl.simulate(system, 1.0, 0.0, jnp.linspace(0, 2, 5), {"b": b}, rtol=1e-11, atol=1e-12, works=True).work()["oil"][-1]
    h = 1e-3
    expected = (8 * (lost(0.3 + h) - lost(0.3 - h)) - lost(0.3 + 2 * h) + lost(0.3 - 2 * h)) / (12 * h)
    np.testing.assert_allclose([jax.grad(lost)(0.3), jax.jacfwd(lost)(0.3)], expected, rtol=1e-8)


def test_names_are_one_name_each():
    with pytest.raises(ValueError, match="terms must have different names, but two are called 'air'"):
        jl.System(lambda qdot: 0.5 * qdot**2, dissipation={"air": lambda qdot: qdot**2}, force={"air": lambda: 1.0})


def test_a_check_up_that_finds_nothing():
    found = jl.examine(pendulum.polar, *pendulum.polar_state(0.3, 0.0, 1.0), pendulum.params)
    assert (found.degrees_of_freedom, found.rank, found.rows, found.redundant, found.findings) == (1, 1, 1, {}, ())
    # linearised about φ = 0.3: ω² = (g/l) cos φ
    np.testing.assert_allclose(found.time_constants, 1 / np.sqrt(9.81 * np.cos(0.3)), rtol=1e-10)
    assert "no issues found" in repr(found) and "phi, r" in repr(found)


@pytest.mark.slow
def test_a_check_up_that_finds_everything():
    rod = pendulum.cartesian_rod
    sick = jl.System(
        pendulum.cartesian_lagrangian,
        holonomic={"rod": rod, "again": lambda q, l: jnp.stack([rod(q, l), q["x"] * 0])},
        dissipation={"wrong": lambda qdot: -0.5 * qdot["x"] ** 2, "stiff": lambda qdot: 0.5e6 * qdot["y"] ** 2},
    )
    found = jl.examine(sick, {"x": 0.8, "y": -0.9}, {"x": 0.0, "y": 0.2}, pendulum.params)
    assert found.redundant == {"again": 2} and found.degrees_of_freedom == 1
    np.testing.assert_allclose(found.off_position["rod"], np.hypot(0.8, 0.9) - 1, rtol=1e-12)
    assert found.dissipated["wrong"] < 0 <= found.dissipated["stiff"]
    said = " ".join(found.findings)
    for finding in (
        "of constraint 'again' 2 of the rows follow from those before",
        "the position is off constraint 'rod'",
        "the velocity is off constraint 'rod'",
        "dissipation 'wrong' adds energy",
        "the motion is stiff",
    ):
        assert finding in said, finding


@pytest.mark.slow
def test_a_check_up_without_inertia_and_without_freedom():
    massless = jl.System(lambda q, qdot: 0.5 * qdot["x"] ** 2 - q["y"] ** 2)
    found = jl.examine(massless, {"x": 0.0, "y": 0.0}, {"x": 0.0, "y": 0.0})
    assert "has no inertia" in " ".join(found.findings) and found.smallest_inertia == 0
    held = jl.System(lambda qdot: 0.5 * qdot**2, holonomic=lambda q: q)
    assert "no degree of freedom" in " ".join(jl.examine(held, 0.0, 0.0).findings)
    rubbing = jl.System(lambda qdot: 0.5 * qdot**2, dissipation={"rub": lambda qdot: jnp.abs(qdot)}, holonomic=lambda t, q: q - t)
    assert "of dissipation 'rub' only λ tells" in " ".join(jl.examine(rubbing, 0.0, 1.0).findings)
