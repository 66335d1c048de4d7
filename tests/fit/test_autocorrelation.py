"""Autocorrelated residuals, against matrices written down from the noise itself."""

import bench_coverage
import numpy as np
import oscillator as osc
import pytest
from scipy import linalg, signal, stats

import jaxlag as jl
from jaxlag._fit.autocorrelation import autoregression, coloured_information, correlation_length, whiteness

T = 3000
SLOPES = np.stack([np.exp(-0.001 * np.arange(T)) * np.cos(0.02 * np.arange(T)), np.linspace(0, 1, T) * np.sin(0.05 * np.arange(T))], axis=1)


def noise(rho, seed=0, count=T):
    """r_t = ρ r_{t−1} + e_t, of variance one, stationary."""
    e = np.random.default_rng(seed).standard_normal(count + 3000)
    return signal.lfilter([np.sqrt(1 - rho**2)], [1.0, -rho], e)[3000:]


def exact(rho, J=SLOPES, at=None):
    """JᵀRJ with R_ij = ρ^|i − j|."""
    at = np.arange(len(J)) if at is None else at
    return J[at].T @ rho ** np.abs(at[:, None] - at) @ J[at]


@pytest.mark.fast
@pytest.mark.parametrize("rho, within", [(0.5, 0.1), (0.8, 0.1), (0.95, 0.15), (0.99, 0.35), (-0.5, 0.1)])
def test_the_information_is_that_of_the_noise(rho, within):
    """The mean of five recordings; what is estimated from one has an error of its own, the larger the longer the correlation."""
    found = [coloured_information(SLOPES[:, None], noise(rho, seed)[:, None], np.ones(1)) for seed in range(5)]
    np.testing.assert_allclose(np.diag(np.mean(found, axis=0)), np.diag(exact(rho)), rtol=within)
    known = np.log(0.1) / np.log(abs(rho))
    assert np.median([correlation_length(autoregression(noise(rho, seed)), T) for seed in range(5)]) == pytest.approx(known, rel=0.4, abs=1)


def test_white_residuals_leave_the_information_unchanged():
    r = noise(0.0)
    assert whiteness(r) > 0.01 and autoregression(r).size == 0 and correlation_length(autoregression(r), T) == 0
    found = coloured_information(SLOPES[:, None], r[:, None], np.ones(1))
    np.testing.assert_allclose(found, SLOPES.T @ SLOPES, rtol=1e-12)


@pytest.mark.fast
def test_the_model_of_a_resonance_is_found():
    """An autoregression of order two; its coefficients are known."""
    truth = np.array([2 * 0.9 * np.cos(0.3), -(0.9**2)])
    e = np.random.default_rng(4).standard_normal(T + 2000)
    np.testing.assert_allclose(autoregression(signal.lfilter([1.0], [1.0, *-truth], e)[2000:]), truth, atol=0.03)


def test_missing_samples_are_left_out():
    """Half of the samples are missing: every second one, so that the rest is noise of ρ², or at random."""
    every_second, at_random = np.arange(0, T, 2), np.flatnonzero(np.random.default_rng(1).random(T) < 0.5)
    for at, within in ((every_second, 0.2), (at_random, 0.3)):
        found = []
        for seed in range(5):
            r, J = np.full(T, np.nan), np.zeros_like(SLOPES)
            r[at], J[at] = noise(0.9, seed)[at], SLOPES[at]
            found.append(coloured_information(J[:, None], r[:, None], np.ones(1)))
        np.testing.assert_allclose(np.diag(np.mean(found, axis=0)), np.diag(exact(0.9, at=at)), rtol=within)


@pytest.mark.fast
def test_channels_that_share_their_noise():
    """Two sensors that see one disturbance twice know no more than one; where it has the other sign they know their sum exactly."""
    r = noise(0.9)
    once = coloured_information(SLOPES[:, None], r[:, None], np.ones(1))
    J = np.stack([SLOPES, SLOPES], axis=1)
    same, opposite = (coloured_information(J, np.stack([r, sign * r], axis=1), np.ones(2)) for sign in (1, -1))
    np.testing.assert_allclose(same, 4 * once, rtol=1e-9)
    np.testing.assert_allclose(opposite, 0 * once, atol=1e-9 * np.max(once))


@pytest.mark.fast
def test_two_different_channels_against_their_covariance():
    """Noise of ρ = 0.9 and 0.6 driven by shocks of correlation ½, channels of size 2 and 1; the covariance by its sum."""
    rng, rhos, sizes = np.random.default_rng(7), (0.9, 0.6), np.array([2.0, 1.0])
    share = linalg.cholesky(np.array([[1.0, 0.5], [0.5, 1.0]]), lower=True)
    J = np.stack([SLOPES, SLOPES[:, ::-1]], axis=1)[:800]
    responses = [np.sqrt(1 - rho**2) * rho ** np.arange(2000.0) for rho in rhos]
    lagged = [[np.correlate(a, b, "full") for b in responses] for a in responses]
    R = [[linalg.toeplitz(lagged[a][b][1999 : 1999 + 800], lagged[a][b][1999:1199:-1]) for b in range(2)] for a in range(2)]
    weights = np.outer(sizes, sizes) * np.array([[1.0, 0.5], [0.5, 1.0]])
    expected = sum(weights[a, b] * J[:, a].T @ R[a][b] @ J[:, b] for a in range(2) for b in range(2))
    found = []
    for _ in range(8):
        shocks = rng.standard_normal((800 + 500, 2)) @ share.T
        r = np.stack([signal.lfilter([np.sqrt(1 - rho**2)], [1, -rho], e)[500:] for rho, e in zip(rhos, shocks.T, strict=True)], axis=1)
        found.append(coloured_information(J, r, sizes))
    np.testing.assert_allclose(np.diag(np.mean(found, axis=0)), np.diag(expected), rtol=0.2)


FREE = ("c", "b")


def coloured(seed, rho=0.8, **more):
    """The oscillator's record with noise that is correlated."""
    return jl.Experiment(osc.TIMES, osc.position(osc.TIMES) + 0.01 * noise(rho, seed, 60), 1.0, 0.0, **more)


def fit(experiments, **more):
    return jl.fit(osc.SYSTEM, experiments, osc.START, free=FREE, **more)


def slopes(found, ts=osc.TIMES, **start):
    """∂x/∂(c, b) at the estimates, by differences of the closed form."""
    theta = np.array([float(found.estimates[name]) for name in FREE])
    at = lambda d: osc.position(ts, *(theta + d), **start)
    return np.stack([(at(d) - at(-d)) / 2e-5 for d in 1e-5 * np.eye(2)], axis=1)


@pytest.fixture(scope="module")
def one():
    return fit(coloured(1))


@pytest.mark.slow
def test_the_covariance_is_the_sandwich_and_all_that_is_made_of_it(one):
    """Where one coefficient does, R_ij = a^|i − j| with that of Yule and Walker, written down in full."""
    r, J = one.residuals[0], slopes(one)
    a = r[1:] @ r[:-1] / (r @ r)
    np.testing.assert_allclose(autoregression(r), [a], rtol=1e-12)
    P = np.linalg.inv(J.T @ J)
    white = P * (r @ r) / 58
    covariance = P @ exact(a, J) @ P * (r @ r) / 58
    np.testing.assert_allclose(one.covariance, covariance, rtol=1e-3)
    np.testing.assert_allclose(one.inflation, np.sqrt(np.diag(covariance) / np.diag(white)), rtol=1e-3)
    t = stats.t.ppf(0.975, 58)
    for i, name in enumerate(FREE):
        error, value = np.sqrt(covariance[i, i]), float(one.estimates[name])
        np.testing.assert_allclose(one.interval(name), [value - t * error, value + t * error], rtol=1e-3)
        np.testing.assert_allclose(one.interval(name, profile=True), one.interval(name), rtol=2e-2)
    spread = lambda J: np.sqrt(np.einsum("ti,ij,tj->t", J, covariance, J))
    np.testing.assert_allclose(one.band()[1] - one.predictions[0], t * spread(J), rtol=2e-3, atol=1e-8)
    other = one.predict(jl.Experiment(osc.TIMES, None, 0.0, 1.0))
    np.testing.assert_allclose(other.standard_errors, spread(slopes(one, x0=0.0, v0=1.0)), rtol=2e-3, atol=1e-8)


@pytest.mark.slow
def test_the_card_and_a_comparison_say_so(one):
    times = " to ".join(f"{x:.2g}" for x in sorted(one.inflation))
    assert one.correlation_length == one.channels[0].correlation_length > 2 and one.remarks == []
    said = (
        f"standard errors account for residuals correlated over {one.correlation_length} samples: {times} times those for white residuals"
    )
    assert said in repr(one)
    white = fit(osc.record(0))
    assert white.correlation_length == 0 and np.all(white.inflation == 1) and "correlated over" not in repr(white)
    assert f"overstated: residuals of 'a' are correlated over {one.correlation_length} samples" in repr(jl.compare({"a": one, "b": one}))
    assert "overstated" not in repr(jl.compare({"a": white, "b": white}))
    short = fit(osc.record(0), max_steps=1)
    assert not short.converged and "the fit of 'b' has not converged" in repr(jl.compare({"a": white, "b": short}))


@pytest.mark.slow
def test_two_recordings_missing_samples_sigma_and_segments(one):
    per_variance = one.covariance / one.sigma**2
    given = fit(coloured(1, sigma=0.02))
    np.testing.assert_allclose(given.covariance, 0.02**2 * per_variance, rtol=1e-4)
    twice = fit([coloured(1), coloured(1)])  # as far as one knows, two independent ones
    np.testing.assert_allclose(twice.covariance / twice.sigma**2, per_variance / 2, rtol=1e-4)
    in_segments = fit(coloured(1), segments=3)
    np.testing.assert_allclose(in_segments.covariance, one.covariance, rtol=1e-3)
    np.testing.assert_allclose(in_segments.inflation, one.inflation, rtol=1e-3)
    at = np.r_[3:7, 31]
    z = osc.with_nan(coloured(1).values, *at)
    gaps = fit(jl.Experiment(osc.TIMES, z, 1.0, 0.0))
    J, r = (np.delete(x, at, axis=0) for x in (slopes(gaps), gaps.residuals[0]))
    (a,) = autoregression(r)
    P = np.linalg.inv(J.T @ J)
    np.testing.assert_allclose(gaps.covariance, P @ exact(a, J) @ P * (r @ r) / 53, rtol=1e-3)


def test_a_prior_is_independent_of_the_noise(one):
    """JᵀRJ of the measurements and the precision of the prior add up in the middle of the sandwich."""
    prior = fit(coloured(1, sigma=0.01), priors={"b": (0.3, 1e-3)})
    J, r = slopes(prior) / 0.01, prior.residuals[0]
    (a,), precision = autoregression(r), np.diag([0, 1e6])
    P = np.linalg.inv(J.T @ J + precision)
    np.testing.assert_allclose(prior.covariance, P @ (exact(a, J) + precision) @ P, rtol=1e-3)


def test_a_robust_fit_allows_for_it(one):
    """Hardly any residual lies beyond five standard deviations: nothing is robust about it."""
    robust = fit(coloured(1), loss=jl.Huber(5.0))
    np.testing.assert_allclose(robust.inflation, one.inflation, rtol=1e-2)


@pytest.mark.slow
@pytest.mark.parametrize("rho", bench_coverage.RHOS)
def test_the_95_percent_intervals_hold_the_truth(rho):
    """60 recordings of 1000 samples; `bench_coverage` has 200. Errors are those that the true covariance of the noise gives."""
    fits = bench_coverage.fits_of(rho, 60)
    for name, (white, true), held in zip(
        FREE, np.transpose(bench_coverage.deviations(rho)), bench_coverage.coverage(fits).values(), strict=True
    ):
        assert all(f.converged for f in fits) and 0.88 <= held <= 1.0
        np.testing.assert_allclose(np.median([f.standard_errors[name] for f in fits]), true, rtol=0.12)
        assert rho == 0 or true > 2.5 * white


@pytest.mark.slow
@pytest.mark.parametrize("rho, within", [(0.0, 0.05), (0.95, 0.12)])
def test_the_95_percent_intervals_hold_the_truth_with_a_constraint(rho, within):
    """A pendulum in Cartesian coordinates, 60 recordings (seeds 0 to 59); 94 % of 200 at ρ = 0.95 by `bench_coverage`."""
    fits, true = bench_coverage.constrained_fits_of(rho, 60), bench_coverage.PENDULUM_TRUE
    exact = bench_coverage.deviations(rho, bench_coverage.bob, true)[1]
    for (name, held), deviation in zip(bench_coverage.coverage(fits, true).items(), exact, strict=True):
        assert all(f.converged for f in fits) and 0.87 <= held <= 1.0
        np.testing.assert_allclose(np.median([f.standard_errors[name] for f in fits]), deviation, rtol=within)


@pytest.mark.parametrize("at_random", [False, True])
def test_the_card_says_where_times_are_uneven(at_random):
    """Correlation is counted in samples, which say little of a time then."""
    fits = bench_coverage.in_the_corners(200, 1, at_random, rho=0.95, seeds=2)
    assert all(found.correlation_length and ("samples that are not evenly spaced in time" in repr(found)) == at_random for found in fits)
