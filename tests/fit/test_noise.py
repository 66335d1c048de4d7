"""Channels without a stated sigma: each has its own, the most likely one, whatever the units; against SciPy and NumPy."""

import dataclasses
import itertools

import bench_coverage
import numpy as np
import oscillator as osc
import pytest
from scipy import optimize

import jaxlag as jl
from jaxlag._fit import minimise
from jaxlag._fit.problem import linearise, reweighted

FREE = ("c", "b")
SIZES = {"x": 0.02, "v": 0.3}


def velocity(ts, c=4.0, b=0.3):
    h = 1e-6
    return (osc.position(ts + h, c, b) - osc.position(ts - h, c, b)) / (2 * h)


def observe(q, qdot):
    return {"x": q, "v": qdot}


def in_millimetres(q, qdot):
    return {"x": 1e3 * q, "v": qdot}


def values(seed, ts=osc.TIMES):
    x, v = np.random.default_rng(seed).standard_normal((2, len(ts)))
    return {"x": osc.position(ts) + SIZES["x"] * x, "v": velocity(ts) + SIZES["v"] * v}


def record(seed, observe=observe, ts=osc.TIMES, **changed):
    return jl.Experiment(ts, values(seed, ts) | changed, 1.0, 0.0, observe=observe)


def fit(experiments, **more):
    return jl.fit(osc.SYSTEM, experiments, osc.START, free=FREE, **more)


def slopes(theta, ts, model):
    return np.stack([(model(ts, *(theta + d)) - model(ts, *(theta - d))) / 2e-5 for d in 1e-5 * np.eye(2)], axis=1)


def by_scipy(*records):
    """SciPy's weighted least squares and σ_c² = S_c/(N_c − h_c) in turn, with the part h_c of the unknowns that a channel decides
    (Patterson & Thompson, 1971); −2 ln L = Σ N_c ln S_c/N_c there, and σ_c.
    """
    theta, sigmas, models = np.array([osc.TRUE[name] for name in FREE]), dict.fromkeys("xv", 1.0), {"x": osc.position, "v": velocity}
    seen = {name: [(np.asarray(e.ts), np.asarray(e.values[name])) for e in records if name in e.values] for name in models}

    def of_channel(name, theta):
        parts = [(z - models[name](ts, *theta), slopes(theta, ts, models[name])) for ts, z in seen[name]]
        r, J = (np.concatenate(part) for part in zip(*parts, strict=True))
        return r[np.isfinite(r)], J[np.isfinite(r)]

    for _ in range(30):
        weighted = lambda theta, sigmas: np.concatenate([of_channel(name, theta)[0] / sigmas[name] for name in models])
        theta = optimize.least_squares(weighted, theta, args=(sigmas,), xtol=1e-14, ftol=1e-14, gtol=1e-14).x
        at = {name: of_channel(name, theta) for name in models}
        information = {name: J.T @ J / sigmas[name] ** 2 for name, (_, J) in at.items()}
        decided = {name: np.trace(part @ np.linalg.inv(sum(information.values()))) for name, part in information.items()}
        sigmas = {name: np.sqrt(r @ r / (r.size - decided[name])) for name, (r, _) in at.items()}
    return theta, sum(r.size * np.log(np.mean(r**2)) for r, _ in at.values()), sigmas


def estimates(found):
    return [float(found.estimates[name]) for name in FREE]


@pytest.fixture(scope="module")
def one():
    return fit(record(0))


@pytest.mark.slow
def test_the_estimates_are_the_most_likely_ones(one):
    theta, least, _ = by_scipy(record(0))
    errors = np.array([float(one.standard_errors[name]) for name in FREE])
    np.testing.assert_allclose((estimates(one) - theta) / errors, 0.0, atol=2e-3)
    np.testing.assert_allclose(one.neg2_log_likelihood, least, atol=1e-4)
    np.testing.assert_allclose([one.aic, one.bic], [least + 2 * 4, least + np.log(120) * 4], atol=1e-4)
    np.testing.assert_allclose(one.sigma, np.exp(np.mean(np.log(list(one.sigmas[0].values())))), rtol=1e-9)


def test_each_channel_is_weighted_by_its_own_sigma(one):
    """As SciPy finds it; the covariance is that of the weighted slopes."""
    theta, _, sigmas = by_scipy(record(0))
    information = np.zeros((2, 2))
    for name, model in {"x": osc.position, "v": velocity}.items():
        np.testing.assert_allclose(one.sigmas[0][name], sigmas[name], rtol=1e-3)
        J = slopes(theta, osc.TIMES, model) / sigmas[name]
        information += J.T @ J
    np.testing.assert_allclose(one.covariance, np.linalg.inv(information), rtol=2e-3)
    np.testing.assert_allclose(one.interval("b", profile=True), one.interval("b"), atol=0.05 * one.standard_errors["b"])
    assert f"residual sigma  v {one.sigmas[0]['v']:.4g}, x {one.sigmas[0]['x']:.4g}" in repr(one)


def test_units_make_no_difference(one):
    changed = fit(record(0, in_millimetres, x=1e3 * values(0)["x"]))
    np.testing.assert_allclose(estimates(changed), estimates(one), rtol=1e-7)
    np.testing.assert_allclose(changed.covariance, one.covariance, rtol=1e-5)
    np.testing.assert_allclose(changed.sigmas[0]["x"], 1e3 * one.sigmas[0]["x"], rtol=1e-5)
    np.testing.assert_allclose(changed.bic - one.bic, 60 * np.log(1e6), rtol=1e-6)  # as the density of x is per millimetre


@pytest.mark.slow
def test_experiments_share_the_sigma_of_a_channel():
    """Of different kinds and lengths, with missing samples."""
    short = np.linspace(0.0, 6.0, 40)
    gaps = {"x": osc.with_nan(values(1)["x"], 3, 4, 9)}
    pair = [record(1, **gaps), jl.Experiment(short, {"v": values(2, short)["v"]}, 1.0, 0.0, observe=lambda qdot: {"v": qdot})]
    both = fit(pair)
    theta, least, _ = by_scipy(*pair)
    errors = np.array([float(both.standard_errors[name]) for name in FREE])
    np.testing.assert_allclose((estimates(both) - theta) / errors, 0.0, atol=2e-3)
    np.testing.assert_allclose(both.neg2_log_likelihood, least, atol=1e-4)
    assert both.sigmas[0]["v"] == both.sigmas[1]["v"] and both.aic == pytest.approx(least + 2 * 4, abs=1e-4)


@pytest.mark.slow
def test_segments_and_fits_in_a_batch_agree(one):
    in_segments = fit(record(0), segments=3)
    a, b = jl.fit_each(osc.SYSTEM, [record(0), record(7)], osc.START, free=FREE)
    for found in (in_segments, a):
        np.testing.assert_allclose(estimates(found), estimates(one), atol=0.02 * one.standard_errors["b"])
        np.testing.assert_allclose(found.covariance, one.covariance, rtol=1e-3)
        np.testing.assert_allclose(found.neg2_log_likelihood, one.neg2_log_likelihood, rtol=1e-5)
    alone = fit(record(7))
    np.testing.assert_allclose(estimates(b), estimates(alone), rtol=1e-5)
    np.testing.assert_allclose(b.sigmas[0]["v"], alone.sigmas[0]["v"], rtol=1e-4)


def test_a_robust_loss_has_the_scale_of_each_channel():
    """A tenth of x lies far off; the standard deviation of normal noise is 1.4826 times the median of its size."""
    x = values(3)["x"]
    x[::10] += 5.0
    robust = fit(record(3, x=x), loss=jl.Huber())
    np.testing.assert_allclose(estimates(robust), [4.0, 0.3], atol=4 * float(robust.standard_errors["c"]))
    ratio = robust.sigmas[0]["v"] / robust.sigmas[0]["x"]
    medians = [np.median(np.abs(robust.residuals[0][name])) for name in ("v", "x")]
    np.testing.assert_allclose(ratio, medians[0] / medians[1], rtol=0.02)


def test_a_channel_with_too_few_measurements_is_weighted_by_its_spread():
    few = osc.with_nan(values(4)["v"], *range(2, 60))
    found = fit(record(4, v=few))
    said = "v has too few measurements for a sigma of its own: each channel is weighted by its spread; give `sigma`"
    assert said in found.remarks and found.converged
    np.testing.assert_allclose(found.sigmas[0]["x"] / found.sigmas[0]["v"], np.std(values(4)["x"]) / np.std(few[:2]), rtol=1e-9)


def test_a_channel_without_noise_is_fitted_exactly():
    exact = fit(record(5, x=osc.position(osc.TIMES)), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(estimates(exact), [4.0, 0.3], rtol=1e-8)
    noise = values(5)["v"] - velocity(osc.TIMES)
    np.testing.assert_allclose(exact.sigmas[0]["v"], np.sqrt(np.mean(noise**2)), rtol=1e-4)  # x decides all


@pytest.mark.slow
def test_the_95_percent_intervals_hold_the_truth():
    """300 recordings of x and v with seeds 0 to 299; of as many, 95 % is within ± 3 standard deviations of 3.8 %."""
    fits = jl.fit_each(osc.SYSTEM, [record(seed) for seed in range(300)], osc.START, free=FREE)
    held = {n: np.mean([f.interval(n).lower < osc.TRUE[n] < f.interval(n).upper for f in fits]) for n in FREE}
    assert all(f.converged for f in fits) and all(0.91 <= part <= 0.99 for part in held.values()), held


@pytest.mark.slow
@pytest.mark.parametrize(("samples", "sensors", "at_random"), list(itertools.product((8, 20, 200), (1, 2), (False, True))))
def test_intervals_of_few_samples_hold_the_truth(samples, sensors, at_random):
    """400 recordings; sensors of unknown noise share the unknowns, by their restricted likelihood. Likelihood alone gave 89 % for two."""
    held = bench_coverage.coverage(bench_coverage.in_the_corners(samples, sensors, at_random))
    assert all(0.92 <= part <= 0.975 for part in held.values()), held


@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.5, 0.8, 0.95])
def test_intervals_hold_the_truth_at_times_at_random(rho):
    """400 recordings of 200 samples, whose noise is correlated in time."""
    held = bench_coverage.coverage(bench_coverage.in_the_corners(200, 1, True, rho))
    assert all(0.90 <= part <= 0.98 for part in held.values()), held


def test_other_weights_take_no_motion(monkeypatch):
    points = []
    linearise = minimise.linearise
    monkeypatch.setattr(minimise, "linearise", lambda problem, x: points.append(x) or linearise(problem, x))
    found = fit(record(3))
    assert found.converged and found.problem.batches[0].sigma["x"][0, 0] != 1  # sigmas were estimated, in rounds
    assert len(points) == found.steps + 1


@pytest.mark.parametrize("loss", [None, jl.Huber()])
def test_residuals_of_other_weights_are_those_of_a_motion_with_them(loss):
    found = fit(record(3, x=np.where(np.arange(len(osc.TIMES)) % 7 == 0, np.nan, values(3)["x"])), loss=loss)
    heavier = [dataclasses.replace(b, sigma={"x": 3.0 * b.sigma["x"], "v": 0.1 * b.sigma["v"]}) for b in found.problem.batches]
    anew = dataclasses.replace(found.problem, batches=tuple(heavier), scale=np.asarray(0.7))
    before, after = reweighted(anew, found.x, linearise(found.problem, found.x)), linearise(anew, found.x)
    np.testing.assert_allclose(before.residuals, after.residuals, rtol=1e-12)
    np.testing.assert_allclose(before.jacobian, after.jacobian, rtol=1e-12)
    assert not np.allclose(before.residuals, linearise(found.problem, found.x).residuals)
