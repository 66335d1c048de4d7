"""Residuals that hang together in time, against matrices written down from the noise itself."""

import numpy as np
import pytest
from scipy import linalg, signal

from jaxlag._autocorrelation import autoregression, coloured_information, reach, whiteness

T = 3000
SLOPES = np.stack([np.exp(-0.001 * np.arange(T)) * np.cos(0.02 * np.arange(T)), np.linspace(0, 1, T) * np.sin(0.05 * np.arange(T))], axis=1)


def noise(rho, seed=0, count=T):
    """r_t = ρ r_{t−1} + e_t, of variance one, begun long ago."""
    e = np.random.default_rng(seed).standard_normal(count + 3000)
    return signal.lfilter([np.sqrt(1 - rho**2)], [1.0, -rho], e)[3000:]


def exact(rho, J=SLOPES, at=None):
    """JᵀRJ with R_ij = ρ^|i − j|."""
    at = np.arange(len(J)) if at is None else at
    return J[at].T @ rho ** np.abs(at[:, None] - at) @ J[at]


@pytest.mark.parametrize("rho, within", [(0.5, 0.1), (0.8, 0.1), (0.95, 0.15), (0.99, 0.35), (-0.5, 0.1)])
def test_the_information_is_that_of_the_noise(rho, within):
    """The mean of five recordings; what is estimated from one has an error of its own, the larger the longer the correlation."""
    found = [coloured_information(SLOPES[:, None], noise(rho, seed)[:, None], np.ones(1)) for seed in range(5)]
    np.testing.assert_allclose(np.diag(np.mean(found, axis=0)), np.diag(exact(rho)), rtol=within)
    known = np.log(0.1) / np.log(abs(rho))
    assert np.median([reach(autoregression(noise(rho, seed)), T) for seed in range(5)]) == pytest.approx(known, rel=0.4, abs=1)


def test_white_residuals_leave_the_information_as_it_is():
    r = noise(0.0)
    assert whiteness(r) > 0.01 and autoregression(r).size == 0 and reach(autoregression(r), T) == 0
    found = coloured_information(SLOPES[:, None], r[:, None], np.ones(1))
    np.testing.assert_allclose(found, SLOPES.T @ SLOPES, rtol=1e-12)


def test_the_model_of_a_resonance_is_found():
    """An autoregression of order two; its coefficients are known."""
    truth = np.array([2 * 0.9 * np.cos(0.3), -(0.9**2)])
    e = np.random.default_rng(4).standard_normal(T + 2000)
    np.testing.assert_allclose(autoregression(signal.lfilter([1.0], [1.0, *-truth], e)[2000:]), truth, atol=0.03)


def test_missing_samples_are_passed_over():
    """Half of the samples are missing: every second one, so that the rest is noise of ρ², or at random."""
    every_second, at_random = np.arange(0, T, 2), np.flatnonzero(np.random.default_rng(1).random(T) < 0.5)
    for at, within in ((every_second, 0.2), (at_random, 0.3)):
        found = []
        for seed in range(5):
            r, J = np.full(T, np.nan), np.zeros_like(SLOPES)
            r[at], J[at] = noise(0.9, seed)[at], SLOPES[at]
            found.append(coloured_information(J[:, None], r[:, None], np.ones(1)))
        np.testing.assert_allclose(np.diag(np.mean(found, axis=0)), np.diag(exact(0.9, at=at)), rtol=within)


def test_channels_that_share_their_noise():
    """Two sensors that see one disturbance twice know no more than one; where it has the other sign they know their sum exactly."""
    r = noise(0.9)
    once = coloured_information(SLOPES[:, None], r[:, None], np.ones(1))
    J = np.stack([SLOPES, SLOPES], axis=1)
    same, opposite = (coloured_information(J, np.stack([r, sign * r], axis=1), np.ones(2)) for sign in (1, -1))
    np.testing.assert_allclose(same, 4 * once, rtol=1e-9)
    np.testing.assert_allclose(opposite, 0 * once, atol=1e-9 * np.max(once))


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
