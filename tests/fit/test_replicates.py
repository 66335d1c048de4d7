"""What was measured several times at one time: as least squares of SciPy has it, or as the mean with its smaller error."""

import numpy as np
import oscillator as osc
import pytest
from scipy import optimize

import jaxlag as jl

FREE = ("c", "b")
COUNTS = 1 + np.arange(60) % 3  # the first time once, the last three times
TS = np.repeat(osc.TIMES, COUNTS)
Z = 1e3 * osc.noisy(5, TS)
SIGMA = 10.0  # micrometres, of a motion in millimetres


def micrometres(q):
    return 1e3 * q


def record(values, **more):
    return jl.Experiment(TS, values, 1.0, 0.0, observe=micrometres, sigma=SIGMA, **more)


@pytest.fixture(scope="module")
def fitted():
    return jl.fit(osc.SYSTEM, record(Z), osc.START, free=FREE)


def of_means(p):
    """Residuals of the mean at each time, whose error is σ/√count."""
    means = np.bincount(np.repeat(np.arange(60), COUNTS), Z) / COUNTS
    return (1e3 * osc.position(osc.TIMES, *p) - means) / (SIGMA / np.sqrt(COUNTS))


@pytest.fixture(scope="module")
def expected():
    return optimize.least_squares(of_means, [4.0, 0.3], jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15)


def errors_of(J):
    return np.sqrt(np.diag(np.linalg.inv(J.T @ J)))


def numbers(by_name):
    return [by_name[name] for name in FREE]


def test_replicates_count_as_their_mean(fitted, expected):
    assert fitted.measurements == len(TS) > 60
    np.testing.assert_allclose(numbers(fitted.estimates), expected.x, rtol=1e-6)
    np.testing.assert_allclose(numbers(fitted.white_standard_errors), errors_of(expected.jac), rtol=1e-4)


def test_replicates_in_plans_predictions_and_validations(fitted, expected):
    planned = jl.information(osc.SYSTEM, record(None), osc.TRUE, free=FREE)
    J = optimize.least_squares(of_means, [4.0, 0.3], jac="3-point", max_nfev=1).jac
    np.testing.assert_allclose(numbers(planned.standard_errors), errors_of(J), rtol=1e-4)
    shown = 1e3 * osc.position(TS, *numbers(fitted.estimates))
    np.testing.assert_allclose(fitted.predict(record(None)).values, shown, atol=1e-3)
    np.testing.assert_allclose(jl.validate(fitted, record(Z)).residuals, Z - shown, atol=1e-3)


@pytest.mark.slow
def test_replicates_in_segments_and_regressions(expected):
    found = jl.fit(osc.SYSTEM, record(Z), osc.START, free=FREE, segments=5)
    np.testing.assert_allclose(numbers(found.estimates), expected.x, rtol=1e-5)
    rough = jl.regress(osc.SYSTEM, record(Z), osc.START, free=FREE)
    for name in FREE:
        assert abs(rough.estimates[name] - osc.TRUE[name]) < 4 * rough.standard_errors[name] < 0.4 * osc.TRUE[name]


def test_times_in_disorder_are_refused():
    said = r"`ts` must increase, but ts\[1\] = {} is followed by ts\[2\] = {}. Sort the times, of which two must differ."
    with pytest.raises(ValueError, match=said.format(1, 0.5)):
        jl.Experiment([0.0, 1.0, 0.5], np.ones(3), 1.0, 0.0)
    with pytest.raises(ValueError, match=r"ts\[0\] = 2 is followed by ts\[1\] = 2. Sort the times, of which two must differ."):
        jl.Experiment([2.0, 2.0], np.ones(2), 1.0, 0.0)
    with pytest.raises(ValueError, match="Sort the times and drop repeated ones."):
        jl.simulate(osc.SYSTEM, 1.0, 0.0, [0.0, 1.0, 1.0], osc.TRUE)
