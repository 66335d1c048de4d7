"""Sweeps: parameters recovered from amplitudes and phases of closed forms and of SciPy's motions, over jumps, with their errors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import chi2

import jaxlag as jl

oscillator = jl.System(
    lambda q, qdot, m, c: 0.5 * m * qdot**2 - 0.5 * c * q**2,
    dissipation=lambda qdot, b: 0.5 * b * qdot**2,
    force=lambda t, w, P: P * jnp.cos(w * t),
)
period = lambda w: 2 * jnp.pi / w


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_amplitudes_and_phases_of_a_closed_form(unit):
    """A linear oscillator, at rest at first, also of micrometres: x = Re P exp(iωt)/(c − m ω² + i b ω)."""
    w = np.array([0.5, 1.0, 1.8, 2.2, 3.0])
    x = unit / (4.0 - w**2 + 0.3j * w)
    given = dict(over="w", period=period, sigma=1e-4 * unit, phase_sigma=1e-4, params={"P": unit})
    start = {"m": 1.0, "c": 3.0, "b": 0.5, "w": 1.0, "P": 0.0}
    test = jl.ResponseCurveTest(w, np.abs(x), 0.0, 0.0, phase=np.angle(x) + 2 * np.pi, **given)
    found = jl.fit(oscillator, test, start, free=("m", "c", "b"))
    np.testing.assert_allclose([found.estimates[name] for name in "mcb"], [1.0, 4.0, 0.3], rtol=1e-6)
    cov = np.linalg.inv(sum(_information(w, unit)))
    np.testing.assert_allclose(found.standard_errors["b"], np.sqrt(cov[2, 2]), rtol=1e-5)
    one = jl.ResponseCurveTest(w, np.abs(x), 0.0, 0.0, harmonic=1, over="w", period=period, sigma=1e-4 * unit, params={"P": unit})
    np.testing.assert_allclose(jl.fit(oscillator, one, start, free=("c", "b")).estimates["c"], 4.0, rtol=1e-6)


def _information(w, unit):
    """Of m, c, b, from log x = log P − log(c − m ω² + i b ω): amplitudes and phases."""
    by = np.stack([-(w**2), np.ones_like(w), 1j * w]) / (4.0 - w**2 + 0.3j * w)
    size = unit / np.abs(4.0 - w**2 + 0.3j * w)
    rows = [-by.real * size / (1e-4 * unit), -by.imag / 1e-4]
    return [row @ row.T for row in rows]


duffing = jl.System(
    lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * q**2 - 0.25 * c * q**4,
    dissipation={"air": lambda qdot, b: 0.5 * b * qdot**2, "dry": lambda qdot, F: F * jnp.abs(qdot)},
    force=lambda t, w: 0.3 * jnp.cos(w * t),
)


def settled(w, c, b, start, periods=150):
    """The state after many periods, and half the distance of its extremes then, by SciPy."""
    T = 2 * np.pi / w
    rates = lambda t, y: [y[1], 0.3 * np.cos(w * t) - b * y[1] - y[0] - c * y[0] ** 3]
    before = solve_ivp(rates, (0, periods * T), start, "DOP853", rtol=1e-10, atol=1e-12).y[:, -1]
    last = solve_ivp(rates, (0, T), before, "DOP853", rtol=1e-10, atol=1e-12, t_eval=np.linspace(0, T, 4001)).y
    return before, (last[0].max() - last[0].min()) / 2


@pytest.mark.slow
def test_a_sweep_that_jumps():
    """Downward through the fold at 1.32, SciPy's motion jumps to the upper branch; so does the prediction, from another start."""
    w = np.array([1.6, 1.5, 1.42, 1.37, 1.28, 1.2, 1.1])
    start, amplitudes = [-0.19, 0.03], []
    for value in w:
        start, amplitude = settled(value, 1.0, 0.1, start)
        amplitudes.append(amplitude)
    assert amplitudes[3] < 0.7 < 0.9 < amplitudes[4]
    test = jl.ResponseCurveTest(w, amplitudes, -0.19, 0.03, over="w", period=period, sigma=1e-4)
    found = jl.fit(duffing, test, {"c": 0.95, "b": 0.12, "F": 0.0, "w": 1.0}, free=("c", "b"))
    np.testing.assert_allclose([found.estimates["c"], found.estimates["b"]], [1.0, 0.1], rtol=1e-5)


@pytest.mark.slow
def test_stiffness_damping_and_dry_friction_with_their_errors():
    """c₃, b and F of 20 noisy curves: the squares of the errors, weighted by the covariance that is stated, are of χ²."""
    true = {"c": 1.0, "b": 0.08, "F": 0.02}
    w = np.linspace(0.6, 1.8, 12)
    orbit = jl.periodic(duffing, 0.4, 0.0, {**true, "w": 0.6}, section=jl.Every(period))
    curve = jl.response_curve(orbit, over="w", values=(0.5, 1.9))
    exact = []
    for value in w:
        q = curve.at(float(value))[0].motion(4001).q
        exact.append(float(jnp.max(q) - jnp.min(q)) / 2)
    random, total, count = np.random.default_rng(5), 0.0, 20
    for _ in range(count):
        noisy = np.array(exact) + 0.0005 * random.standard_normal(len(w))
        test = jl.ResponseCurveTest(w, noisy, orbit.q, orbit.qdot, over="w", period=period, sigma=0.0005)
        found = jl.fit(duffing, test, {"c": 1.05, "b": 0.07, "F": 0.015, "w": 1.0}, free=("c", "b", "F"))
        off = np.array([float(found.estimates[name] - true[name]) for name in ("c", "b", "F")])
        total += off @ np.linalg.solve(np.asarray(found.covariance), off)
    assert chi2.ppf(0.001, 3 * count) < total < chi2.ppf(0.999, 3 * count)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"values": [[1.0]]}, "`values` must be a list"),
        ({"amplitude": [1.0]}, "`amplitude` must be 2 finite numbers"),
        ({"phase": [0.1, 0.2]}, "`phase` and `phase_sigma` must come together"),
        ({"of": "y"}, "`of` must be a function, or name a coordinate"),
        ({"period": 3.0}, "`period` must be a function"),
        ({"harmonic": 99}, "`harmonic` must be at most 8"),
        ({"sigma": -1.0}, "`sigma` and `phase_sigma` must be positive"),
    ],
)
def test_wrong_arguments(change, said):
    given = {"values": [1.0, 2.0], "amplitude": [0.1, 0.2], "over": "w", "period": period, "sigma": 0.1} | change
    with pytest.raises((ValueError, TypeError), match=said):
        jl.ResponseCurveTest(given.pop("values"), given.pop("amplitude"), 0.0, 0.0, **given)


def test_a_parameter_that_is_not_there():
    test = jl.ResponseCurveTest([1.0], [0.1], 0.0, 0.0, over="omega", period=period, sigma=0.1)
    with pytest.raises(ValueError, match="`over` must name one number"):
        jl.fit(oscillator, test, {"m": 1.0, "c": 3.0, "b": 0.5, "w": 1.0, "P": 1.0}, free=("c",))
    assert jax.tree.leaves(test.values)


def test_pictures_and_report(tmp_path):
    """Measured and fitted over the parameter of the sweep, and the page for a colleague; of a measurement alone, too."""
    import matplotlib as mpl
    import matplotlib.pyplot as plt

    mpl.use("Agg")
    w = np.array([0.5, 1.0, 1.8, 2.2, 3.0])
    amplitude = np.abs(1 / (4.0 - w**2 + 0.3j * w))
    test = jl.ResponseCurveTest(w, amplitude, 0.0, 0.0, over="w", period=period, sigma=1e-3)
    start = {"m": 1.0, "c": 3.0, "b": 0.5, "w": 1.0, "P": 1.0}
    found = jl.fit(oscillator, test, start, free=("c", "b"))
    axes = found.plot()
    assert axes.shape == (2, 1) and axes[1, 0].get_xlabel() == "w" and axes[0, 0].get_ylabel() == "amplitude"
    np.testing.assert_allclose(axes[0, 0].get_lines()[1].get_data(), [w, amplitude], rtol=1e-5)
    plt.close(axes[0, 0].figure)
    found.report(tmp_path / "sweep.html")
    assert "measured and fitted" in (tmp_path / "sweep.html").read_text()
    weighed = jl.fit(oscillator, jl.Measurement([2.0], lambda m: m, sigma=0.1), start, free=("m",))
    weighed.report(tmp_path / "weight.html")
    assert (tmp_path / "weight.html").stat().st_size > 1000
