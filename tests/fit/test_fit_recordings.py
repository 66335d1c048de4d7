"""Fits to recordings of machines: thousands of samples under an input that is held from one to the next."""

from pathlib import Path

import jax.numpy as jnp
import make_linear_drive as drive
import numpy as np
import pytest

import jaxlag as jl

DATA = Path(__file__).parents[1] / "data"
pytestmark = pytest.mark.slow


def test_a_drive_at_1_khz_from_twice_the_truth():
    """24 841 samples, exact but for their quantum of 1 µm, with friction that sticks a quarter of the time."""
    ts, q, _, u = drive.recording()
    system = jl.System(
        lambda qdot, M: 0.5 * M * qdot**2,
        dissipation=lambda qdot, Fv, Fc: 0.5 * Fv * qdot**2 + Fc * jnp.abs(qdot),
        force=lambda t, u, offset: drive.K * u(t) - offset,
    )
    record = jl.Experiment(ts, q, 0.0, 0.0, params={"u": jl.Signal(ts, u)})
    twice = {name: 2 * true for name, true in drive.TRUE.items()}
    found = jl.fit(system, record, twice, free=tuple(drive.TRUE), solver=jl.Dopri5())
    assert found.converged
    for name, true in drive.TRUE.items():
        np.testing.assert_allclose(found.estimates[name], true, rtol=1e-5, err_msg=name)


def test_a_driven_pendulum_from_its_regression():
    """Source and what is known of it: tests/data/README.md. For a point mass J/(m l) is the length of the rod, 0.5 m."""
    t, angle, rate, torque = np.loadtxt(DATA / "driven_pendulum.csv", delimiter=",", skiprows=1).T
    system = jl.System(
        lambda q, qdot, J, ml: 0.5 * J * qdot**2 + ml * 9.81 * jnp.cos(q),
        dissipation={"oil": lambda qdot, b: 0.5 * b * qdot**2, "dry": lambda qdot, F: F * jnp.abs(qdot)},
        force=lambda t, u, offset: u(t) + offset,
    )
    record = jl.Experiment(t, angle, angle[0], rate[0], params={"u": jl.Signal(t, torque)})
    names = ("J", "ml", "b", "F", "offset")
    bounds = {"b": (0, None), "F": (0, None)}
    found = jl.fit(system, record, dict.fromkeys(names, np.nan), free=names, start=jl.Regress(), bounds=bounds, solver=jl.Dopri5())
    assert found.converged and found.led_in[0] == "regress"
    assert 0.48 < found.estimates["J"] / found.estimates["ml"] < 0.52
    assert 0.12 < found.estimates["J"] < 0.18
