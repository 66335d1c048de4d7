"""Options of fits, alone and of many records: they mean the same wherever they can be given. Data in closed form, results by SciPy."""

import numpy as np
import oscillator as osc
import pytest
from scipy import optimize

import jaxlag as jl

FREE = ("c", "b")
SHORT = osc.TIMES[:45]


def with_outliers(seed, ts, scale=1.0, sigma=0.01):
    z = scale * osc.noisy(seed, ts, sigma)
    z[[7, 20]] += scale * np.array([0.5, -0.8])
    return z


def test_fits_of_each_with_a_robust_loss():
    """With known noise as by SciPy, record by record, of two lengths."""
    zs = [with_outliers(0, osc.TIMES), with_outliers(1, SHORT)]
    records = [jl.Experiment(ts, z, 1.0, 0.0, sigma=0.01) for ts, z in zip((osc.TIMES, SHORT), zs, strict=True)]
    fits = jl.fit_each(osc.SYSTEM, records, osc.START, free=FREE, loss=jl.Huber())
    for found, e, z in zip(fits, records, zs, strict=True):
        expected = optimize.least_squares(
            lambda p, e=e, z=z: (osc.position(e.ts, *p) - z) / 0.01, [3.0, 0.6], loss="huber", f_scale=1.345, xtol=1e-15, gtol=1e-15
        )
        assert found.converged
        np.testing.assert_allclose([found.estimates[name] for name in FREE], expected.x, rtol=1e-5)


def test_fits_of_each_estimate_the_noise_of_each_where_a_loss_is_robust():
    """One record in millimetres with ten times the noise: each as by `fit` alone, and its sigma near the true one."""
    observe = lambda q, gain: gain * q
    records = [
        jl.Experiment(ts, with_outliers(1, ts, 1e3, sigma), 1.0, 0.0, observe=observe, params={"gain": 1e3})
        for sigma, ts in ((0.01, osc.TIMES), (0.1, SHORT))
    ]
    fits = jl.fit_each(osc.SYSTEM, records, osc.START, free=FREE, loss=jl.Huber())
    for found, e in zip(fits, records, strict=True):
        alone = jl.fit(osc.SYSTEM, e, osc.START, free=FREE, loss=jl.Huber())
        for part in ("estimates", "standard_errors"):
            ours, its = (np.array(list(getattr(one, part).values())) for one in (found, alone))
            np.testing.assert_allclose(ours, its, rtol=1e-3)
        np.testing.assert_allclose([found.sigma, found.cost], [alone.sigma, alone.cost], rtol=1e-3)
    assert 7 < fits[0].sigma < 15 and 50 < fits[1].sigma < 150


@pytest.mark.slow
@pytest.mark.parametrize("start", [jl.MultiStart(16), pytest.param(jl.Regress(), marks=pytest.mark.slow)])
def test_fits_of_each_from_a_poor_start(start):
    """c of 4 and 9 from 30, from where neither is found."""
    records = [jl.Experiment(osc.TIMES, osc.noisy(seed, c=c), 1.0, 0.0) for seed, c in ((0, 4.0), (1, 9.0))]
    given = {"m": 1.0, "c": 30.0, "b": 0.3}
    fits = jl.fit_each(osc.SYSTEM, records, given, free="c", bounds={"c": (0, 31)}, start=start)
    for found, truth in zip(fits, (4.0, 9.0), strict=True):
        assert found.converged and abs(found.estimates["c"] - truth) < 4 * found.standard_errors["c"]


@pytest.mark.slow
def test_fits_of_each_in_segments():
    records = [osc.record(seed) for seed in (0, 1)]
    fits = jl.fit_each(osc.SYSTEM, records, osc.START, free=FREE, segments=3)
    for found, z in zip(fits, (osc.noisy(0), osc.noisy(1)), strict=True):
        expected = optimize.least_squares(lambda p, z=z: osc.position(osc.TIMES, *p) - z, [3.0, 0.6], xtol=1e-15, gtol=1e-15).x
        np.testing.assert_allclose([found.estimates[name] for name in FREE], expected, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [{"x": 0.01, "speed": 2.0}, None])
def test_segments_with_a_slow_channel(sigma):
    """A speed in cm/s at every fiftieth sample, which most of the segments do not see; by SciPy on the whole record."""
    ts = np.linspace(0.0, 10.0, 200)
    x = osc.noisy(0, ts)
    speed = lambda c, b: -100 * c / np.sqrt(c - b**2 / 4) * np.exp(-b / 2 * ts) * np.sin(np.sqrt(c - b**2 / 4) * ts)
    slow = np.where(np.arange(200) % 50 == 20, speed(4.0, 0.3) + 2.0 * np.random.default_rng(1).standard_normal(200), np.nan)
    sensors = lambda q, qdot: {"x": q, "speed": 100 * qdot}
    e = jl.Experiment(ts, {"x": x, "speed": slow}, 1.0, 0.0, observe=sensors, sigma=sigma)
    found = jl.fit(osc.SYSTEM, e, osc.START, free=FREE, segments=10)
    sizes = found.sigmas[0]

    def weighted(p):
        return np.concatenate([(osc.position(ts, *p) - x) / sizes["x"], ((speed(*p) - slow) / sizes["speed"])[20::50]])

    expected = optimize.least_squares(weighted, [3.0, 0.6], jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert found.converged
    np.testing.assert_allclose([found.estimates[name] for name in FREE], expected.x, rtol=1e-4)
    if sigma:
        errors = np.sqrt(np.diag(np.linalg.inv(expected.jac.T @ expected.jac)))
        np.testing.assert_allclose([found.white_standard_errors[name] for name in FREE], errors, rtol=1e-3)


@pytest.mark.parametrize("call", ["fit", "fit_each", "information"])
def test_an_unknown_option_is_refused_by_name(call):
    records = [osc.record(0, sigma=0.01)]
    with pytest.raises(TypeError, match="`segmnts` must be an argument of this function or an option of `simulate`, but is neither. Such"):
        getattr(jl, call)(osc.SYSTEM, records, osc.START, free=FREE, segmnts=3)


def test_priors_add_to_the_information_of_a_plan():
    """F = JᵀJ/σ² + 1/ς², by differences of the closed form."""
    plan = jl.Experiment(osc.TIMES, None, 1.0, 0.0, sigma=0.01)
    found = jl.information(osc.SYSTEM, plan, osc.TRUE, free=FREE, priors={"b": (0.3, 2e-3)}, bounds={"b": (0, None)})
    h, at = 1e-5, np.array([4.0, 0.3])
    J = np.stack([(osc.position(osc.TIMES, *(at + h * e)) - osc.position(osc.TIMES, *(at - h * e))) / (2 * h) for e in np.eye(2)], axis=1)
    F = J.T @ J / 0.01**2 + np.diag([0, 2e-3**-2])
    np.testing.assert_allclose(found.matrix, F, rtol=1e-5)
    np.testing.assert_allclose([found.standard_errors[name] for name in FREE], np.sqrt(np.diag(np.linalg.inv(F))), rtol=1e-5)


@pytest.mark.slow
def test_a_validation_finds_the_start_with_the_loss_of_the_fit():
    """The start of another record with outliers, by SciPy with Huber's loss."""
    found = jl.fit(osc.SYSTEM, osc.record(0, sigma=0.01), osc.START, free=FREE, loss=jl.Huber())
    z, theta = with_outliers(3, osc.TIMES), [found.estimates[name] for name in FREE]
    other = jl.Experiment(osc.TIMES, z, 0.8, 0.0, sigma=0.01, unknown="q0")
    residuals = lambda x: (osc.position(osc.TIMES, *theta, x0=x[0]) - z) / 0.01
    x = optimize.least_squares(residuals, [0.8], loss="huber", f_scale=1.345, xtol=1e-15, gtol=1e-15).x
    shown = jl.validate(found, other).prediction.values
    np.testing.assert_allclose(shown, osc.position(osc.TIMES, *theta, x0=x[0]), atol=1e-5)
    assert abs(x[0] - optimize.least_squares(residuals, [0.8]).x[0]) > 1e-3


def test_a_bare_string_is_one_name():
    q = {"theta": 0.0, "phi": 0.0}
    test = jl.FrequencyResponseTest([1.0], [1j], q, inputs="theta", fixed="phi", fixed_rates="theta", sigma=1.0)
    assert (test.inputs, test.fixed, test.fixed_rates) == (("theta",), ("phi",), ("theta",))
    assert jl.ModalTest([1.0], q, sigma=0.1, fixed="phi").fixed == ("phi",)
    system = jl.System(lambda q, qdot: 0.5 * (qdot["theta"] ** 2 + qdot["phi"] ** 2), holonomic={"gear": lambda q: q["theta"] - q["phi"]})
    moved, _ = jl.consistent_state(system, {"theta": 2.0, "phi": 0.0}, {"theta": 0.0, "phi": 0.0}, fixed="theta")
    np.testing.assert_allclose([moved["theta"], moved["phi"]], [2.0, 2.0])
