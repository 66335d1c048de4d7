"""Known parameters are recovered as often as the intervals say: against closed forms of linear models, and by counting."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jaxlag as jl

pushed = jl.System(lambda q, qdot, m: 0.5 * m * qdot**2, force=lambda F: F)


def pushed_for(second, T=41, **options):
    """A mass of one, pushed by a constant force for a second; F is linear in what is measured."""
    ts = second * np.linspace(0.0, 1.0, T)
    return jl.Experiment(ts, None, q0=0.0, qdot0=0.0, sigma=0.01, **options), ts


@pytest.mark.slow
@pytest.mark.parametrize(("second", "seed"), [(1.0, 0), (1e-4, 1)])
def test_a_linear_model(second, seed):
    """se = σ/√Σ(t²/2)²; errors of 400 fits are normal, without bias, and as large as that, and intervals hold the truth."""
    plan, ts = pushed_for(second)
    truth = 3.0 / second**2
    found = jl.recover(
        pushed, plan, {"m": 1.0, "F": truth}, free=("F",), repeats=400, key=jax.random.key(seed), guess={"m": 1.0, "F": 0.1 * truth}
    )
    error = 0.01 / np.sqrt(np.sum((ts**2 / 2) ** 2))
    assert found.names == ("F",) and not found.failures
    np.testing.assert_allclose([found.truth[0], found.predicted[0]], [truth, error], rtol=1e-6)
    same = np.isclose(found.standard_errors[:, 0], error, rtol=1e-6)  # but where noise happens to look coloured
    assert np.mean(same) > 0.95
    assert stats.kstest((found.estimates[:, 0] - truth) / error, "norm").pvalue > 0.01
    assert abs(found.bias[0]) < 3 * found.bias_error[0]
    low, high = np.sqrt(stats.chi2.ppf([0.001, 0.999], 399) / 399)
    assert low < found.scatter[0] / error < high
    assert stats.binomtest(int(found.covered.sum()), 400, 0.95).pvalue > 0.001
    (row,) = found.table()
    assert row["name"] == "F" and row["coverage"] == found.coverage[0]
    assert "95 %" in str(found) and "400 fits" in str(found)


def test_missing_samples_stay_missing():
    plan, ts = pushed_for(1.0)
    values = np.where(ts < 0.5, 0.0, np.nan)
    gappy = jl.Experiment(ts, values, q0=0.0, qdot0=0.0, sigma=0.01)
    found = jl.recover(pushed, gappy, {"m": 1.0, "F": 3.0}, free=("F",), repeats=3)
    np.testing.assert_allclose(found.predicted, 0.01 / np.sqrt(np.sum((ts[ts < 0.5] ** 2 / 2) ** 2)), rtol=1e-6)
    np.testing.assert_allclose(found.standard_errors[:, 0], found.predicted[0], rtol=1e-6)


def test_several_experiments_are_fitted_together():
    plan, ts = pushed_for(1.0)
    found = jl.recover(pushed, [plan, pushed_for(2.0)[0]], {"m": 1.0, "F": 3.0}, free=("F",), repeats=3)
    np.testing.assert_allclose(found.predicted, 0.01 / np.sqrt(17 * np.sum((ts**2 / 2) ** 2)), rtol=1e-6)
    np.testing.assert_allclose(found.standard_errors[:, 0], found.predicted[0], rtol=1e-6)


def test_what_fails_is_counted_and_what_cannot_be_is_refused():
    plan, _ = pushed_for(1.0)
    params = {"m": 1.0, "F": 3.0}
    with pytest.raises(ValueError, match="must say how well they measure"):
        jl.recover(pushed, jl.Experiment(jnp.linspace(0, 1, 9), None, 0.0, 0.0), params, free=("F",))
    with pytest.raises(ValueError, match="`repeats` must"):
        jl.recover(pushed, plan, params, free=("F",), repeats=1)
    swing = jl.System(lambda q, qdot, w: 0.5 * qdot**2 + w**2 * jnp.cos(q))
    record = jl.Experiment(jnp.linspace(0, 30, 61), None, 2.5, 0.0, sigma=0.3)
    with pytest.raises(ValueError, match="at least two fits converge, but all fail: .* Start nearer: `guess`"):
        jl.recover(swing, record, {"w": 1.0}, free=("w",), guess={"w": 1.01}, repeats=3, max_steps=1)


@pytest.mark.slow
def test_with_friction_and_a_rod():
    """A pendulum in Cartesian coordinates with dry and viscous friction in its pivot, in millimetres: ± and scatter within 15 %."""
    mm = 1e3

    def energy(q, qdot, g):
        return 0.5 * qdot @ qdot - mm * g * q[1]

    rate = lambda q, qdot, l: (q[0] * qdot[1] - q[1] * qdot[0]) / (mm * l) ** 2
    friction = {
        "viscous": lambda q, qdot, b, l: 0.5 * b * mm**2 * rate(q, qdot, l) ** 2,
        "dry": lambda q, qdot, F, l: F * mm**2 * jnp.abs(rate(q, qdot, l)),
    }
    pendulum = jl.System(energy, dissipation=friction, holonomic=lambda q, l: jnp.hypot(q[0], q[1]) - mm * l)
    truth = {"g": 9.81, "l": 0.3, "b": 0.008, "F": 0.02}
    q0 = mm * 0.3 * np.array([np.sin(1.0), -np.cos(1.0)])
    plan = jl.Experiment(jnp.linspace(0.0, 5.0, 101), None, q0, np.zeros(2), sigma=1.0, unknown=("q0",))
    found = jl.recover(pendulum, plan, truth, free=("g", "b", "F"), repeats=200, key=jax.random.key(3))
    assert len(found.failures) < 10
    np.testing.assert_allclose(found.scatter, found.predicted, rtol=0.15)
    assert np.all(np.abs(found.bias) < 4 * found.bias_error)
    assert all(stats.binomtest(int(n), 200 - len(found.failures), 0.95).pvalue > 1e-3 for n in found.covered.sum(axis=0))


def test_the_picture(tmp_path):
    plt = pytest.importorskip("matplotlib.pyplot")
    plan, _ = pushed_for(1.0)
    found = jl.recover(pushed, plan, {"m": 1.0, "F": 3.0}, free=("F",), repeats=30)
    (ax,) = found.plot()
    assert "F" in ax.get_title() and len(ax.patches) == 18
    with pytest.raises(ValueError, match="`names`"):
        found.plot(names=["m"])
    plt.close("all")
