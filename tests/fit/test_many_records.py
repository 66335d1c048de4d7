"""Many records with unknown starts of their own: Jacobians without their zeros say what whole ones do; against SciPy and NumPy."""

import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import oscillator as osc
import pytest
from scipy.optimize import least_squares

import jaxlag as jl
from jaxlag._fit import arrow, levenberg_marquardt, problem

FREE = ("c", "b")
START = {"m": 1.0, "c": 4.6, "b": 0.4}
TS = np.linspace(0.0, 6.0, 40)


def swing(ts, c, b, q0, v0):
    """In closed form."""
    w = np.sqrt(c - b**2 / 4)
    return np.exp(-b * ts / 2) * (q0 * np.cos(w * ts) + (v0 + b * q0 / 2) / w * np.sin(w * ts))


def records(count, padding=0, rho=0.0, seed=0):
    """Oscillations with noise of this correlation; a number of samples at the end is missing."""
    random, made = np.random.default_rng(seed), []
    ts = np.append(TS, TS[-1] + 0.1 * np.arange(1, padding + 1))
    for k in range(count):
        e = random.standard_normal(TS.size)
        for i in range(1, TS.size):
            e[i] = rho * e[i - 1] + np.sqrt(1 - rho**2) * e[i]
        z = swing(TS, 4.0, 0.3, 1.0 + 0.05 * k, 0.1 * k) + 0.01 * e
        made.append(jl.Experiment(ts, np.append(z, np.full(padding, np.nan)), 1.0, 0.0, unknown=("q0", "qdot0")))
    return made


@pytest.fixture
def without_zeros(monkeypatch):
    monkeypatch.setattr(problem, "WIDE", 0)


def test_products_and_triangles_are_those_of_the_whole_matrix():
    random = np.random.default_rng(3)
    first, blocks, last = random.standard_normal((2, 8)), random.standard_normal((3, 5, 4)), random.standard_normal((1, 8))
    columns = np.array([[0, 1, 2, 3], [0, 1, 4, 5], [0, 1, 6, 7]])
    J = arrow.Arrow(first, (blocks,), (columns,), last)
    whole = np.zeros((3, 5, 8))
    for of, block, at in zip(whole, blocks, columns, strict=True):
        of[:, at] = block
    whole = np.concatenate([first, whole.reshape(15, 8), last])
    x, r = random.standard_normal(8), random.standard_normal(18)
    for of in (J, arrow.Arrow(*map(jnp.asarray, (first,)), (jnp.asarray(blocks),), (columns,), jnp.asarray(last))):
        np.testing.assert_allclose(arrow.times(of, x), whole @ x, atol=1e-13)
        np.testing.assert_allclose(arrow.transposed(of, r), whole.T @ r, atol=1e-13)
        np.testing.assert_allclose(arrow.norms(of), np.linalg.norm(whole, axis=0), atol=1e-13)
        np.testing.assert_allclose(arrow.times(arrow.over(of, 1 + x**2), x), whole / (1 + x**2) @ x, atol=1e-13)
        R, along = arrow.triangular(of, r)
        np.testing.assert_allclose([*(R.T @ R), R.T @ along], [*(whole.T @ whole), whole.T @ r], atol=1e-12)
        np.testing.assert_allclose(arrow.whole(of), whole, atol=1e-15)
        np.testing.assert_allclose(arrow.gathered(of).T @ arrow.gathered(of), whole.T @ whole, atol=1e-12)
        np.testing.assert_allclose(arrow.times(arrow.without(of, 1), x[1:]), np.delete(whole, 1, axis=1) @ x[1:], atol=1e-13)


def test_estimates_and_errors_are_those_of_scipy(without_zeros):
    made = records(6)
    found = jl.fit(osc.SYSTEM, made, START, free=FREE, tolerance=1e-6, rtol=1e-10, atol=1e-12)
    measured = np.concatenate([e.values for e in made])
    predicted = lambda x: np.concatenate([swing(TS, *x[:2], *own) for own in x[2:].reshape(-1, 2)])
    by_scipy = least_squares(lambda x: predicted(x) - measured, np.append([4.0, 0.3], np.tile([1.0, 0.1], 6)), "3-point", xtol=1e-15)
    covariance = np.linalg.inv(by_scipy.jac.T @ by_scipy.jac) * 2 * by_scipy.cost / (measured.size - 14)
    errors = np.sqrt(np.diag(covariance))
    ours = np.array([found.estimates["c"], found.estimates["b"], *(of[which] for of in found.unknowns for which in ("q0", "qdot0"))])
    theirs = np.array([*map(float, found.standard_errors.values()), *(of[w] for of in found.unknown_errors for w in ("q0", "qdot0"))])
    assert found.converged and isinstance(found.problem.linearise(jnp.asarray(found.x)).jacobian, arrow.Arrow)
    np.testing.assert_allclose((ours - by_scipy.x) / errors, 0, atol=1e-5)
    np.testing.assert_allclose(theirs, errors, rtol=1e-5)


OPTIONS = {
    "correlated noise": (0.9, {}),
    "outliers": (0.0, {"loss": jl.Huber()}),
    "a bound": (0.0, {"bounds": {"b": (0.305, None)}}),
    "segments": (0.0, {"segments": 2}),
}


@pytest.mark.parametrize("case", ["correlated noise", *(pytest.param(case, marks=pytest.mark.slow) for case in list(OPTIONS)[1:])])
def test_all_statistics_are_those_of_the_whole_matrix(case, monkeypatch):
    """Of which the records have a sample more, that is missing."""
    rho, options = OPTIONS[case]
    whole = jl.fit(osc.SYSTEM, records(5, padding=1, rho=rho), START, free=FREE, **options)
    monkeypatch.setattr(problem, "WIDE", 0)
    found = jl.fit(osc.SYSTEM, records(5, rho=rho), START, free=FREE, **options)
    assert found.remarks == whole.remarks and found.correlation_length == whole.correlation_length and found.converged == whole.converged
    np.testing.assert_allclose([*found.estimates.values()], [*whole.estimates.values()], rtol=1e-6)
    np.testing.assert_allclose(found.covariance, whole.covariance, rtol=2e-4)
    np.testing.assert_allclose([found.sigma, found.neg2_log_likelihood], [whole.sigma, whole.neg2_log_likelihood], rtol=1e-5)
    if not options:
        assert found.correlation_length
        np.testing.assert_allclose(found.interval("c", profile=True), whole.interval("c", profile=True), rtol=1e-6)
        np.testing.assert_allclose(found.prediction_errors[2], whole.prediction_errors[2][:-1], rtol=1e-3)


@pytest.mark.slow
def test_many_starts_of_many_records(without_zeros):
    """And a parameter that starts at zero."""
    one = jl.fit(osc.SYSTEM, records(4), START | {"c": 6.0}, free=FREE, start=jl.MultiStart(4))
    other = jl.fit(osc.SYSTEM, records(4), START | {"b": 0.0}, free=FREE)
    assert one.converged and other.converged
    np.testing.assert_allclose([*one.estimates.values()], [*other.estimates.values()], rtol=1e-6)
    assert abs(one.estimates["c"] - 4.0) < 4 * one.standard_errors["c"] and abs(one.estimates["b"] - 0.3) < 4 * one.standard_errors["b"]


def test_a_singular_value_decomposition_that_fails_is_no_convergence(monkeypatch):
    """As that of 802 columns did, which was taken for a step of length zero. What counts is then found from the squares."""
    svd = lambda R, full_matrices: tuple(x * jnp.nan for x in np.linalg.svd(np.eye(R.shape[1])))
    monkeypatch.setattr(levenberg_marquardt.jnp.linalg, "svd", svd)
    record = records(1, padding=3)[0]
    found = jl.fit(osc.SYSTEM, record, START, free=FREE, tolerance=1e-6)
    monkeypatch.undo()
    usual = jl.fit(osc.SYSTEM, records(1, padding=4)[0], START, free=FREE, tolerance=1e-6)
    assert found.converged and found.steps == usual.steps > 3
    np.testing.assert_allclose([*found.estimates.values()], [*usual.estimates.values()], rtol=1e-7)


@pytest.mark.slow
def test_four_hundred_records_take_little_memory(tmp_path):
    """Of 1000 samples and two unknowns each: a whole Jacobian would have 2.6 GB, and as much in each of several copies; those of the
    records together have 13 MB. Most of what is left is the motions.
    """
    program = """
import resource, sys
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
import jaxlag as jl
system = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2)
ts, random = np.linspace(0.0, 20.0, 1000), np.random.default_rng(0)
clean = np.exp(-0.15 * ts) * np.cos(np.sqrt(4 - 0.0225) * ts)
made = [jl.Experiment(ts, clean + 0.01 * random.standard_normal(1000), 1.0, 0.0, unknown=("q0", "qdot0")) for _ in range(400)]
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
jl.fit(system, made[0], {"c": 3.8, "b": 0.4}, free=("c", "b"))
before = peak()
found = jl.fit(system, made, {"c": 3.8, "b": 0.4}, free=("c", "b"))
print(peak() - before, found.converged, found.estimates["c"], found.standard_errors["c"])
"""
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=tmp_path)
    megabytes, converged, c, error = run.stdout.split()
    assert converged == "True" and abs(float(c) - 4) < 4 * float(error)
    assert float(megabytes) < 700
