"""What the model misses is said, with and without a sigma, and not where nothing is missing; against NumPy and SciPy."""

import functools

import numpy as np
import oscillator as osc
import pytest
from scipy import signal
from scipy.integrate import solve_ivp

import jaxlag as jl

FREE = ("c", "b")
SAID = "the model misses something, and the errors above do not account for that"


@functools.cache
def with_cubic_drag(end=10.0, samples=500, k=0.05):
    """ẍ + 0.1 ẋ + k ẋ³ + 4 x = 0 from rest at 1, by SciPy."""
    ts = np.linspace(0.0, end, samples)
    rates = lambda t, s: [s[1], -4.0 * s[0] - 0.1 * s[1] - k * s[1] ** 3]
    return ts, solve_ivp(rates, (0.0, end), [1.0, 0.0], "DOP853", ts, rtol=1e-11, atol=1e-12).y[0]


def fit_without_drag(seed=1, sigma=0.01, stated=None, samples=500):
    ts, x = with_cubic_drag(samples=samples)
    z = x + sigma * np.random.default_rng(seed).standard_normal(samples)
    return jl.fit(osc.SYSTEM, jl.Experiment(ts, z, 1.0, 0.0, sigma=stated), osc.START, free=FREE)


@pytest.fixture(scope="module")
def missing():
    return fit_without_drag()


@pytest.mark.slow
def test_a_missing_cubic_drag_is_said_with_and_without_sigma(missing):
    """The damping b = 0.1 comes out near 0.18, and that with a small error: but the halves of the record contradict each other."""
    assert missing.estimates["b"] > 0.1 + 20 * missing.standard_errors["b"] and missing.converged
    for found in (missing, fit_without_drag(stated=0.01)):
        remark = found.remarks[0]
        assert remark.startswith("b would be 0.20") and SAID in remark and remark in repr(found)


def test_the_halves_are_those_of_two_fits_in_numpy(missing):
    """Least squares in the slopes, rows of the second half for a change of both parameters."""
    ts, theta = with_cubic_drag()[0], np.array([float(missing.estimates[name]) for name in FREE])
    slope = lambda d: (osc.position(ts, *(theta + d)) - osc.position(ts, *(theta - d))) / 2e-5
    J = np.stack([slope(d) for d in 1e-5 * np.eye(2)], axis=1)
    r = np.asarray(missing.residuals[0])
    late = ts >= 5.0
    first, second = (theta + np.linalg.lstsq(J[at], r[at], rcond=None)[0] for at in (~late, late))
    words = missing.remarks[0].split()
    np.testing.assert_allclose([float(words[3]), float(words[14])], [first[1], second[1]], atol=6e-5)


@pytest.mark.parametrize("rho", [0.0, 0.8])
def test_hardly_a_false_alarm(rho):
    """100 records of a model that misses nothing, seeds 0 to 99, 200 samples each."""
    ts = np.linspace(0.0, 10.0, 200)
    e = np.random.default_rng(0).standard_normal((100, 3200))
    noise = 0.02 * signal.lfilter([np.sqrt(1 - rho**2)], [1.0, -rho], e, axis=1)[:, 3000:]
    records = [jl.Experiment(ts, osc.position(ts) + one, 1.0, 0.0) for one in noise]
    fits = jl.fit_each(osc.SYSTEM, records, osc.START, free=FREE)
    assert sum(any(SAID in remark for remark in found.remarks) for found in fits) <= (0 if rho == 0 else 2)
    assert sum(bool(found.remarks) for found in fits) <= (1 if rho == 0 else 4)


@pytest.mark.parametrize("stated, alarms", [(0.01, 0), (0.009, 0), (0.006, 8)])
def test_noise_that_is_larger_than_stated_is_said(stated, alarms):
    """Its standard deviation is 0.01; the remark gives the ratio, from the residuals of a fit in NumPy."""
    for seed in range(8):
        found = jl.fit(osc.SYSTEM, osc.record(seed, sigma=stated), osc.START, free=FREE)
        ratio = np.sqrt(np.sum(np.asarray(found.residuals[0]) ** 2) / 58) / stated
        said = f"the residuals are {ratio:.2g} times the noise that `sigma` states: it is larger, or the model misses something; "
        assert found.remarks == [said + "the errors above take `sigma` as it is"] * (seed < alarms)


def test_the_errors_for_white_residuals_remain(missing):
    ts, theta = with_cubic_drag()[0], np.array([float(missing.estimates[name]) for name in FREE])
    slope = lambda d: (osc.position(ts, *(theta + d)) - osc.position(ts, *(theta - d))) / 2e-5
    J = np.stack([slope(d) for d in 1e-5 * np.eye(2)], axis=1)
    r = np.asarray(missing.residuals[0])
    white = np.sqrt(np.diag(np.linalg.inv(J.T @ J)) * (r @ r) / 498)
    np.testing.assert_allclose([float(missing.white_standard_errors[name]) for name in FREE], white, rtol=1e-4)
    assert all(missing.standard_errors[name] > 2 * missing.white_standard_errors[name] for name in FREE)
