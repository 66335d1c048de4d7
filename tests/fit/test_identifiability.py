"""The answer with its quality: errors that hold, what is not determined in words, prediction, comparison, robust and other methods."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import optax
import oscillator as osc
import pytest
from scipy import optimize, stats
from scipy.integrate import solve_ivp

import jaxlag as jl
from jaxlag._fit import base_parameters, identifiability, levenberg_marquardt
from jaxlag._fit.rounding import plus_minus
from jaxlag._fit.undetermined import on_undetermined

FREE = ("c", "b")


def fit(experiments, params=osc.START, free=FREE, **more):
    return jl.fit(osc.SYSTEM, experiments, params, free=free, **more)


@pytest.fixture(scope="module")
def plain():
    return fit(osc.record(0))


def by_scipy(z, ts=osc.TIMES, **more):
    return optimize.least_squares(lambda p: osc.position(ts, *p) - z, [3.0, 0.6], xtol=1e-15, ftol=1e-15, gtol=1e-15, **more)


def test_estimates_and_errors_are_those_of_scipy(plain):
    found = by_scipy(osc.noisy(0), jac="3-point")
    np.testing.assert_allclose([plain.estimates[name] for name in FREE], found.x, rtol=1e-6)
    covariance = np.linalg.inv(found.jac.T @ found.jac) * 2 * found.cost / 58
    np.testing.assert_allclose(plain.covariance, covariance, rtol=1e-4)
    np.testing.assert_allclose(plain.cost, found.cost, rtol=1e-6)
    t = stats.t.ppf(0.95, 58)
    low, high = plain.interval("c", 0.9)
    np.testing.assert_allclose([low, high], found.x[0] + t * np.sqrt(covariance[0, 0]) * np.array([-1, 1]), rtol=1e-5)


@pytest.mark.slow
def test_the_95_percent_intervals_hold_the_truth_in_95_percent():
    """400 recordings with new noise, fitted in one batch; also σ̂ is right."""
    fits = jl.fit_each(osc.SYSTEM, [osc.record(seed) for seed in range(400)], osc.START, free=FREE)
    assert all(f.converged for f in fits)
    for name in FREE:
        inside = [f.interval(name).lower < osc.TRUE[name] < f.interval(name).upper for f in fits]
        assert 0.92 <= np.mean(inside) <= 0.98
    np.testing.assert_allclose(np.mean([f.sigma for f in fits]), 0.01, rtol=0.02)


def test_a_fit_of_each_is_the_fit_of_each(plain):
    pair = jl.fit_each(osc.SYSTEM, [osc.record(0), osc.record(1)], osc.START, free=FREE)
    np.testing.assert_allclose(pair[0].covariance, plain.covariance, rtol=1e-5)
    np.testing.assert_allclose(pair[0].residuals[0], plain.residuals[0], atol=1e-7)
    assert pair[0].estimates["c"] != pair[1].estimates["c"]


@pytest.mark.slow
def test_profile_likelihood_against_scipy():
    """Few samples and much noise: the interval is not symmetric."""
    ts = osc.TIMES[::4]
    z = osc.noisy(3, ts, sigma=0.3)
    found = fit(jl.Experiment(ts, z, 1.0, 0.0), bounds={"b": (0, None)})
    best, t = by_scipy(z, ts), stats.t.ppf(0.975, len(ts) - 2)
    limit = best.cost + t**2 * best.cost / (len(ts) - 2)

    def rise(b):
        return (
            optimize.minimize_scalar(lambda c: 0.5 * np.sum((osc.position(ts, c, b) - z) ** 2), bounds=(2, 6), method="bounded").fun - limit
        )

    upper = optimize.brentq(rise, best.x[1], 3.0)
    profile, linear = found.interval("b", profile=True), found.interval("b")
    np.testing.assert_allclose(profile.upper, upper, rtol=2e-2)
    assert abs(profile.upper - linear.upper) > 0.02 * (linear.upper - linear.lower)  # linearised is something else here


@pytest.mark.slow
def test_ratios_are_named_where_only_they_are_determined(plain):
    """With values and errors of b and c where m = 1."""
    found = fit(osc.record(0), osc.START | {"m": 1.3}, free=("b", "c", "m"))
    b, c = (plus_minus(float(plain.estimates[name]), float(plain.standard_errors[name])) for name in ("b", "c"))
    assert found.remarks == [f"only b/m = {b} and c/m = {c} are determined; their common factor is not"]
    assert all(np.isinf(found.standard_errors[name]) for name in ("b", "c", "m"))
    np.testing.assert_allclose(found.estimates["c"] / found.estimates["m"], by_scipy(osc.noisy(0)).x[0], rtol=1e-4)
    assert f"! only b/m = {b} and c/m = {c} are determined" in repr(found)
    assert repr(found).count("not determined by these measurements") == 3


@pytest.mark.slow
def test_sums_and_idle_parameters_are_named(plain):
    system = jl.System(
        lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2, dissipation=lambda qdot, b1, b2, idle: 0.5 * (b1 + 2 * b2) * qdot**2 + 0 * idle
    )
    found = jl.fit(system, osc.record(0), {"c": 3.0, "b1": 0.2, "b2": 0.1, "idle": 2.0}, free=("c", "b1", "b2", "idle"))
    assert found.remarks[0] == "idle has no influence on these measurements"
    b = plus_minus(float(plain.estimates["b"]), float(plain.standard_errors["b"]))
    assert found.remarks[1] == f"only b1 + 2 b2 = {b} is determined; b1 and b2 individually are not"
    assert np.isfinite(found.standard_errors["c"]) and np.isinf(found.standard_errors["b1"])


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda a, b, c: (a**2 / b) + 0 * c, "only a/b^(1/2) = 1.1547 ± 0 is determined"),
        (lambda a, b, c: (a - b / 2) * c, "only a c - 1/2 b c = 2.5 ± 0 is determined"),
        (lambda a, b, c: a + b * jnp.exp(c), None),
    ],
)
def test_other_combinations(change, said):
    """In closed form: what does not show are the changes along which a function of the parameters is constant."""

    def null(theta):
        slope = np.array(jax.grad(lambda t: change(*t))(jnp.asarray(theta)))[None, :]
        return np.linalg.svd(slope)[2][1:].T

    theta, free = np.array([2.0, 3.0, 5.0]), np.full(3, np.inf)
    idle = [2] if said and "^" in said else []
    places = ((p, null(p)) for p in (theta, *base_parameters.nearby(theta, -free, free)))
    found = identifiability.undetermined(places, idle=idle)
    words = on_undetermined(("a", "b", "c"), found, [c.estimate(theta, np.zeros((3, 3))) for c in found.combinations], {})
    if said:
        names = "a and b" if idle else "a, b and c"
        assert words == [*(["c has no influence on these measurements"] if idle else []), f"{said}; {names} individually are not"]
    else:
        assert "a, b and c are not determined individually: they can change together without visible effect" in words[0]


def test_bounds_hold_and_the_inside_is_unchanged(plain):
    inside = fit(osc.record(0), bounds={"c": (0, 100), "b": (0, None)})
    np.testing.assert_allclose(inside.covariance, plain.covariance, rtol=1e-4)
    np.testing.assert_allclose(inside.estimates["b"], plain.estimates["b"], rtol=1e-6)
    held = fit(osc.record(0), bounds={"c": (None, 3.9)}, max_steps=30)
    assert held.estimates["c"] == 3.9


def test_a_prior_is_one_more_measurement(plain):
    """Linear theory: the precision adds up, the estimate is the weighted mean."""
    sigma = 0.01
    weak = fit(osc.record(0, sigma=sigma))
    prior = fit(osc.record(0, sigma=sigma), priors={"b": (0.303, 0.003)})
    information = np.linalg.inv(weak.covariance) + np.diag([0, 0.003**-2])
    np.testing.assert_allclose(prior.covariance, np.linalg.inv(information), rtol=0.05)
    step = np.linalg.solve(information, [0, (0.303 - float(weak.estimates["b"])) / 0.003**2])
    np.testing.assert_allclose(float(prior.estimates["b"] - weak.estimates["b"]), step[1], rtol=0.05)


def test_outliers_do_not_rule_a_robust_fit():
    z = osc.noisy(2)
    z[::7] += 0.5
    robust = fit(jl.Experiment(osc.TIMES, z, 1.0, 0.0, sigma=0.01), loss=jl.Huber(1.345))
    found = optimize.least_squares(
        lambda p: (osc.position(osc.TIMES, *p) - z) / 0.01, [3.9, 0.35], loss="huber", f_scale=1.345, xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    np.testing.assert_allclose([robust.estimates[name] for name in FREE], found.x, rtol=1e-5)
    by_itself = fit(jl.Experiment(osc.TIMES, z, 1.0, 0.0), loss=jl.Huber())
    for name in FREE:
        assert abs(by_itself.estimates[name] - osc.TRUE[name]) < 4 * by_itself.standard_errors[name]
    assert 0.005 < by_itself.sigma < 0.03 < fit(jl.Experiment(osc.TIMES, z, 1.0, 0.0)).sigma


@pytest.mark.slow
def test_prediction_with_a_band_and_validation(plain):
    """The band against the closed form of the derivatives, the new start against exact data."""
    ts = np.linspace(0, 5, 30)
    plan = jl.Experiment(ts, None, 0.0, 1.0)
    seen = plain.predict(plan)
    theta = np.array([plain.estimates[name] for name in FREE])
    at = lambda c, b: osc.position(ts, c, b, 0.0, 1.0)
    J = np.stack([(at(*(theta + d)) - at(*(theta - d))) / 2e-6 for d in 1e-6 * np.eye(2)], axis=1)
    np.testing.assert_allclose(seen.values, at(*theta), atol=1e-7)
    np.testing.assert_allclose(seen.standard_errors, np.sqrt(np.diag(J @ plain.covariance @ J.T)), atol=1e-8)
    assert np.all((seen.lower <= seen.values) & (seen.values <= seen.upper)) and seen.motion.succeeded

    other = jl.Experiment(ts, osc.position(ts, x0=0.4, v0=-1.0), 0.3, 0.0, unknown=("q0", "qdot0"))
    checked = jl.validate(plain, other)
    assert checked.channels[0].fit_percent > 98 and "Validation" in repr(checked)
    wrong = jl.validate(plain, jl.Experiment(ts, osc.position(ts, c=9.0), 1.0, 0.0))
    assert wrong.channels[0].fit_percent < 50 and wrong.channels[0].whiteness < 1e-6


@pytest.mark.slow
def test_is_there_really_a_damper():
    undamped, damped = osc.noisy(5, b=1e-12), osc.noisy(5)
    for z, best in ((undamped, "without"), (damped, "with")):
        e = jl.Experiment(osc.TIMES, z, 1.0, 0.0)
        models = {"with": fit(e), "without": fit(e, osc.START | {"b": 0.0}, free=("c",))}
        table = jl.compare(models)
        assert table.names[0] == best
    squares = [2 * models[name].cost for name in ("without", "with")]
    np.testing.assert_allclose(table.aic["without"], 60 * np.log(squares[0] / squares[1]) - 2, rtol=1e-8)
    np.testing.assert_allclose(table.bic["without"], 60 * np.log(squares[0] / squares[1]) - np.log(60), rtol=1e-8)
    assert "very strong" in repr(table)
    with pytest.raises(ValueError, match="must be of the same measurements"):
        jl.compare({"a": models["with"], "b": fit(osc.record(6))})


@pytest.mark.slow
def test_information_is_what_a_fit_then_has():
    plan = jl.Experiment(osc.TIMES, None, 1.0, 0.0, sigma=0.01)
    expected = jl.information(osc.SYSTEM, plan, osc.TRUE, free=FREE)
    h = 1e-6
    J = np.stack(
        [
            (osc.position(osc.TIMES, 4 + h) - osc.position(osc.TIMES, 4 - h)),
            (osc.position(osc.TIMES, b=0.3 + h) - osc.position(osc.TIMES, b=0.3 - h)),
        ],
        axis=1,
    )
    J /= 2 * h * 0.01
    np.testing.assert_allclose(expected.matrix, J.T @ J, rtol=1e-5)
    np.testing.assert_allclose([expected.standard_errors[name] for name in FREE], np.sqrt(np.diag(np.linalg.inv(J.T @ J))), rtol=1e-5)
    unsure = jl.information(osc.SYSTEM, jl.Experiment(osc.TIMES, None, 1.0, 0.0, sigma=0.01, unknown=("q0", "qdot0")), osc.TRUE, free=FREE)
    assert unsure.standard_errors["b"] > expected.standard_errors["b"]
    np.testing.assert_allclose(np.linalg.inv(unsure.matrix), unsure.covariance, rtol=1e-6)
    assert "not determined" in repr(jl.information(osc.SYSTEM, plan, osc.TRUE, free=("b", "c", "m")))
    with pytest.raises(ValueError, match="has no `sigma`"):
        jl.information(osc.SYSTEM, jl.Experiment(osc.TIMES, None, 1.0, 0.0), osc.TRUE, free=FREE)


@pytest.mark.slow
def test_many_starts_find_what_one_does_not():
    """A frequency three times off leads nowhere, where damping cannot make the motion small on the way."""
    far = osc.START | {"c": 30.0}
    bounds = {"c": (1.0, 60.0), "b": (0.01, 0.6)}
    alone, many = (fit(osc.record(0), far, bounds=bounds, start=start) for start in (None, jl.MultiStart(24)))
    assert abs(alone.estimates["c"] - 4) > 1
    np.testing.assert_allclose(many.estimates["c"], by_scipy(osc.noisy(0)).x[0], rtol=1e-5)


@pytest.mark.slow
def test_starts_that_cannot_be_simulated_do_no_harm():
    """Without a bound on c some of the motions explode within the steps allowed."""
    found = fit(osc.record(0), osc.START | {"c": 0.5}, start=jl.MultiStart(8), max_steps=60)
    np.testing.assert_allclose(found.estimates["c"], by_scipy(osc.noisy(0)).x[0], rtol=1e-4)


@pytest.mark.parametrize("start", [0.0, 1e-12, 0.6])
def test_a_start_at_or_near_its_bound_moves(plain, start):
    found = fit(osc.record(0), osc.START | {"b": start}, bounds={"b": (0, None)})
    assert found.converged and found.remarks == []
    np.testing.assert_allclose([found.estimates[name] for name in FREE], [plain.estimates[name] for name in FREE], rtol=1e-5)
    np.testing.assert_allclose(found.covariance, plain.covariance, rtol=1e-4)
    np.testing.assert_allclose(found.interval("b"), plain.interval("b"), rtol=1e-4)


def test_bounds_of_a_fit_of_each():
    """One record would have b below its bound, the other not; by SciPy, within bounds."""
    zs = [osc.noisy(0), osc.noisy(1, b=0.2)]
    fits = jl.fit_each(
        osc.SYSTEM, [jl.Experiment(osc.TIMES, z, 1.0, 0.0) for z in zs], osc.START | {"b": 0.25}, free=FREE, bounds={"b": (0.25, 1.0)}
    )
    for found, z in zip(fits, zs, strict=True):
        expected = optimize.least_squares(
            lambda p, z=z: osc.position(osc.TIMES, *p) - z, [3.0, 0.6], bounds=([0, 0.25], [9, 1]), xtol=1e-15, ftol=1e-15, gtol=1e-15
        )
        assert found.converged
        np.testing.assert_allclose([found.estimates[name] for name in FREE], expected.x, rtol=1e-5)
    assert [len(found.remarks) for found in fits] == [0, 1] and fits[1].estimates["b"] == 0.25


def test_a_step_that_would_cross_a_bound_stops_at_it_and_the_others_step_anew():
    """Linear least squares with strongly correlated columns, from all corners of the box; by SciPy."""
    rng = np.random.default_rng(3)
    A = rng.standard_normal((30, 4)) @ (np.eye(4) + 3 * np.ones((4, 4)))
    z = A @ np.array([0.6, -2.0, 1.5, 3.0]) + rng.standard_normal(30)
    lower, upper = np.full(4, -1.0), np.array([0.5, 1.0, 2.0, 1.0])
    expected = optimize.lsq_linear(A, z, (lower, upper), tol=1e-15, lsmr_tol="auto").x
    seen = lambda y: (jnp.asarray(A) @ y - z, jnp.asarray(A), None)
    for corner in np.ndindex(2, 2, 2, 2):
        start = jnp.asarray(np.where(corner, upper, lower))
        found = levenberg_marquardt.levenberg_marquardt(seen, start, freedom=26, max_steps=60, tolerance=1e-8, bounds=(lower, upper))
        assert int(found.best.status) == levenberg_marquardt.CONVERGED
        np.testing.assert_allclose(found.best.y, expected, atol=1e-6)


def test_a_profile_ends_at_a_bound():
    """So little damping that none at all is as likely."""
    found = fit(jl.Experiment(osc.TIMES, osc.noisy(1, b=0.01, sigma=0.3), 1.0, 0.0), osc.START | {"b": 0.1}, bounds={"b": (0, None)})
    profile = found.interval("b", profile=True)
    assert profile.lower == 0 == found.interval("b").lower
    np.testing.assert_allclose(profile.upper, found.interval("b").upper, rtol=0.3)


def test_a_hopeless_end_is_not_called_converged():
    """A start from which the motion explodes, and a record in other units than the model's."""
    exploding = fit(osc.record(0, ts=osc.TIMES / 4), osc.START | {"c": -1e4}, start=None)
    assert not exploding.converged and any("times as large as the measurements: check the units" in said for said in exploding.remarks)
    assert max(len(line) for line in repr(exploding).splitlines()) < 180
    other_units = fit(jl.Experiment(osc.TIMES, 1e-3 * osc.noisy(0), 1.0, 0.0), start=None)
    assert not other_units.converged and "unrelated to the measurements" in other_units.reason


@pytest.mark.slow
def test_optimisers_of_optax(plain):
    method = optax.lbfgs()
    found = fit(osc.record(0), method=method, max_steps=40)
    np.testing.assert_allclose([found.estimates[name] for name in FREE], [plain.estimates[name] for name in FREE], rtol=1e-5)
    at_bound = fit(osc.record(0), osc.START | {"b": 0.0}, method=method, max_steps=60, bounds={"b": (0, None), "c": (None, 3.9)})
    held = fit(osc.record(0), bounds={"c": (None, 3.9)})
    np.testing.assert_allclose([at_bound.estimates[name] for name in FREE], [held.estimates[name] for name in FREE], rtol=1e-3)
    np.testing.assert_allclose(found.covariance, plain.covariance, rtol=1e-3)
    assert found.costs[-1] < found.costs[0] and found.steps == 40


def test_an_interrupted_fit_returns_the_best_so_far(monkeypatch):
    calls = []
    original = levenberg_marquardt.SINGLE[1]

    def interrupting(*args):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return original(*args)

    monkeypatch.setattr(levenberg_marquardt, "SINGLE", (levenberg_marquardt.SINGLE[0], interrupting))
    found = fit(osc.record(0))
    assert not found.converged and "interrupted (Ctrl-C)" in found.reason and "interrupted" in repr(found)
    assert found.cost < found.costs[0]


@pytest.mark.slow
def test_interrupted_starts_are_not_called_converged(monkeypatch):
    """Though the best of them had converged by then."""
    original, calls = levenberg_marquardt.BATCHED[1], []

    def interrupting(*args):
        now, trial = original(*args)
        if np.any(now.status == levenberg_marquardt.CONVERGED):
            assert np.any(now.status == levenberg_marquardt.RUNNING)
            calls.append("converged")
        if calls.count("converged") == 2:
            raise KeyboardInterrupt
        return now, trial

    monkeypatch.setattr(levenberg_marquardt, "BATCHED", (levenberg_marquardt.BATCHED[0], interrupting))
    found = fit(osc.record(0), osc.START | {"c": 3.5}, bounds={"c": (1.0, 60.0), "b": (0.01, 0.6)}, start=jl.MultiStart(24))
    assert calls.count("converged") == 2 and not found.converged and "interrupted (Ctrl-C)" in found.reason


def test_a_start_without_a_motion_is_refused():
    system = jl.System(lambda q, qdot, c: 0.5 * qdot**2 + 0.25 * c * q**4)
    e = jl.Experiment(osc.TIMES, osc.position(osc.TIMES), 1.0, 0.0)
    with pytest.raises(ValueError, match="the motion at the start must be computable, but ended with"):
        jl.fit(system, e, {"c": 5.0}, free=("c",), max_steps=5)


@pytest.mark.slow
def test_paths_vectors_and_payloads():
    """A parameter deep in the tree; two machines of one spring with payloads of their own, one of them unknown."""
    system = jl.System(lambda q, qdot, body, load: 0.5 * (body["m"] + load) * qdot**2 - 0.5 * body["c"] @ jnp.ones(2) * q**2)
    ts = osc.TIMES
    e1, e2 = (
        jl.Experiment(ts, np.cos(np.sqrt(4 / m) * ts), 1.0, 0.0, params={"load": load}, unknown=unknown, sigma=1e-3)
        for m, load, unknown in ((1.0, 0.0, ()), (1.5, 0.4, ("load",)))
    )
    params = {"body": {"m": 1.0, "c": np.array([1.5, 2.0])}}
    found = jl.fit(system, [e1, e2], params, free=("body.c",), priors={"body.c[0]": (1.6, 1e-6)})
    np.testing.assert_allclose(found.estimates["body.c"], [1.6, 2.4], rtol=1e-5)
    np.testing.assert_allclose(found.unknowns[1]["load"], 0.5, rtol=1e-5)
    assert found.names == ("body.c[0]", "body.c[1]") and found.unknowns[0] == {}
    assert np.isfinite(found.unknown_errors[1]["load"]) and "experiment 1: load" in repr(found)
    np.testing.assert_allclose(found.experiments[1].params["load"], 0.5, rtol=1e-5)


@pytest.mark.slow
def test_gain_offset_and_delay_of_a_sensor():
    ts = osc.TIMES + 0.0
    true = {"gain": 2.5, "offset": -0.3, "lag": 0.05}
    seen = true["gain"] * np.where(ts > true["lag"], osc.position(np.maximum(ts - true["lag"], 0)), 1.0) + true["offset"]
    e = jl.Experiment(ts, seen, 1.0, 0.0, observe=lambda q, gain, offset: gain * q + offset, delay=lambda lag: lag)
    found = fit(e, osc.START | {"gain": 2.0, "offset": 0.0, "lag": 0.02}, free=(*FREE, "gain", "offset", "lag"))
    np.testing.assert_allclose([found.estimates[name] for name in ("c", "b", *true)], [4.0, 0.3, *true.values()], rtol=1e-5)
    fixed = fit(jl.Experiment(ts, seen, 1.0, 0.0, observe=lambda q: 2.5 * q - 0.3, delay=0.05))
    np.testing.assert_allclose(fixed.estimates["c"], 4.0, rtol=1e-6)


@pytest.mark.slow
def test_single_precision(single_precision):
    found = fit(osc.record(0))
    assert found.estimates["c"].dtype == jnp.float32
    np.testing.assert_allclose([found.estimates[name] for name in FREE], by_scipy(osc.noisy(0)).x, rtol=2e-3)


@pytest.mark.slow
def test_a_robust_fit_in_segments_is_the_robust_fit():
    z = osc.noisy(2)
    z[::7] += 0.5
    e = jl.Experiment(osc.TIMES, z, 1.0, 0.0)
    whole, segments = (fit(e, loss=jl.Huber(), segments=n) for n in (1, 3))
    np.testing.assert_allclose([segments.estimates[name] for name in FREE], [whole.estimates[name] for name in FREE], rtol=1e-3)


def test_an_estimate_at_a_bound_is_remarked():
    found = fit(osc.record(0), bounds={"c": (None, 3.5)})
    assert found.remarks == ["c is at its bound 3.5; the measurements favour values beyond it"]
    assert found.interval("c").upper <= 3.5


def test_a_model_that_does_not_explain_the_data_is_remarked():
    """Without the damper: residuals of some twenty times the noise. With it there is nothing to say."""
    record = osc.record(0, sigma=0.01)
    without = jl.fit(osc.SYSTEM, record, osc.START | {"b": 0.0}, free=("c",))
    assert without.sigma > 10 and "does not explain the measurements" in repr(without)
    assert not any("explain" in remark for remark in jl.fit(osc.SYSTEM, record, osc.START, free=("c", "b")).remarks)
    (said,) = jl.fit(osc.SYSTEM, osc.record(0), osc.START | {"b": 0.0}, free=("c",)).remarks  # nor where sigma is not known
    assert re.fullmatch("the model misses something, or the noise is not white: residuals of z are correlated over \\d+ samples", said)
    assert fit(osc.record(0)).remarks == []


@pytest.mark.slow
def test_what_trades_with_the_unknown_start_is_said():
    """A sliding mass whose sensor has an offset: only offset + x₀ shows."""
    system = jl.System(lambda qdot: 0.5 * qdot**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2)
    ts = osc.TIMES
    e = jl.Experiment(ts, (1 - np.exp(-0.4 * ts)) / 0.4, 0.0, 1.0, observe=lambda q, offset: q + offset, unknown=("q0",))
    found = jl.fit(system, e, {"b": 0.5, "offset": 0.1}, free=("b", "offset"))
    assert found.remarks == ["offset cannot be distinguished from the unknown starts"]
    np.testing.assert_allclose(found.estimates["b"], 0.4, rtol=1e-6)


@pytest.mark.slow
def test_one_of_many_without_a_motion_is_marked():
    system = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2 + 0.25 * q**4)
    good = jl.Experiment(osc.TIMES, np.cos(osc.TIMES), 0.5, 0.0, observe=lambda q: q)
    bad = jl.Experiment(osc.TIMES, np.cos(osc.TIMES), 5.0, 0.0, observe=good.observe)
    fits = jl.fit_each(system, [good, bad], {"c": 3.0}, free=("c",), max_steps=10)
    assert not fits[1].converged and "could not be computed" in fits[1].reason
    assert fits[0].reason != fits[1].reason
    with pytest.raises(ValueError, match="must have a motion at the estimates, but it ended with"):
        fits[0].predict(bad)


def test_prediction_with_a_delayed_sensor(plain):
    shown = plain.predict(jl.Experiment(osc.TIMES, None, 1.0, 0.0, delay=0.5))
    theta = [plain.estimates[name] for name in FREE]
    np.testing.assert_allclose(
        shown.values, np.where(osc.TIMES > 0.5, osc.position(np.maximum(osc.TIMES - 0.5, 0), *theta), 1.0), atol=1e-6
    )


MORE_BAD = {
    "a prior against unknown noise": (
        lambda: fit(osc.record(0), priors={"b": (0.3, 0.1)}),
        "`priors` must be weighed against known noise",
    ),
    "sigma of some only": (lambda: fit([osc.record(0), osc.record(1, sigma=0.01)]), "must all have a `sigma` or none"),
    "segments and an optimiser": (lambda: fit(osc.record(0), segments=3, method=optax.lbfgs()), "must be used one at a time"),
    "NaN where it is not free": (lambda: fit(osc.record(0), osc.START | {"m": np.nan}), "'m' is NaN. Give it a value, or free it."),
    "a parameter of each one's own": (lambda: fit(osc.record(0, params={"b": 0.3})), "each has a 'b' of its own"),
    "everything free, with bounds": (
        lambda: jl.regress(osc.SYSTEM, osc.record(0), osc.START, free=("m", "c", "b"), bounds={"c": (0, None)}),
        "only their ratios are determined",
    ),
    "a regression of nothing": (lambda: jl.regress(osc.SYSTEM, [], osc.START, free=FREE), "`experiments` must be an `Experiment`"),
    "a regression with nothing free": (lambda: jl.regress(osc.SYSTEM, osc.record(0), osc.START, free=()), "at least one entry"),
    "a time that is missing": (lambda: jl.Experiment([0.0, 0.1, np.nan], np.ones(3), 1.0, 0.0), "`ts` must be finite"),
    "a start that is missing": (lambda: jl.Experiment([0.0, 0.1], np.ones(2), np.nan, 0.0), "`q0` must be finite"),
}


@pytest.mark.parametrize("case", MORE_BAD)
def test_what_would_give_wrong_numbers_is_refused(case):
    make, said = MORE_BAD[case]
    with pytest.raises(ValueError) as error:
        make()
    assert said in str(error.value) and str(error.value).endswith(".")


def test_an_unknown_start_is_found_within_its_bounds():
    found = fit(osc.record(0), osc.START | {"b": np.nan}, bounds={"b": (0, 0.5)})
    np.testing.assert_allclose(found.estimates["b"], by_scipy(osc.noisy(0)).x[1], rtol=1e-4)


@pytest.mark.slow
def test_ratios_are_named_in_single_precision(single_precision):
    found = fit(osc.record(0), osc.START | {"m": 1.3}, free=("b", "c", "m"))
    (said,) = found.remarks
    assert re.fullmatch(r"only b/m = 0\.\d+ ± 0\.\d+ and c/m = \d\.\d+ ± 0\.\d+ are determined; their common factor is not", said)
    with pytest.raises(ValueError, match="`free` must leave a known term in the equations of motion"):
        jl.regress(osc.SYSTEM, osc.record(0), osc.START | {"m": 1.3}, free=("b", "c", "m"))


def test_a_direction_that_is_known_to_be_hidden_is_found_beneath_the_error_of_integration():
    """b, c and M act as b/M and c/M: an integration at its limit of stability leaves 5e-9 where the Jacobian is zero."""
    rng = np.random.default_rng(1)
    hidden = np.array([0.3, 0.4, 0.5])
    J = rng.standard_normal((50, 3))
    J -= np.outer(J @ hidden, hidden) / (hidden @ hidden) * (1 - 5e-9)
    assert identifiability.determined_by(J, np.zeros((0, 3))).null.shape == (3, 0)
    (direction,) = identifiability.determined_by(J, np.zeros((0, 3)), hidden=1).null.T
    np.testing.assert_allclose(direction / direction[0], hidden / hidden[0], rtol=1e-6)


@pytest.mark.slow
def test_the_delay_and_the_gain_of_an_actuator():
    """They are parameters like others: k u(t − τ) of an input that is linear between its samples; against SciPy."""
    ts = np.linspace(0.0, 10.0, 201)
    u = np.sin(1.3 * ts) + 0.5 * np.sin(3.1 * ts)
    rates = lambda t, s: [s[1], -4.0 * s[0] - 0.3 * s[1] + 1.7 * np.interp(t - 0.23, ts, u)]
    x = solve_ivp(rates, (0.0, 10.0), [0.0, 0.0], t_eval=ts, rtol=1e-9, atol=1e-11, max_step=0.01).y[0]
    record = jl.Experiment(ts, x + 1e-3 * np.random.default_rng(0).standard_normal(201), 0.0, 0.0)
    system = jl.System(
        lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2,
        dissipation=lambda qdot, b: 0.5 * b * qdot**2,
        force=lambda t, u, k, tau: k * u(t - tau),
    )
    truth = {"c": 4.0, "b": 0.3, "k": 1.7, "tau": 0.23}
    start = {"c": 4.5, "b": 0.2, "k": 1.2, "tau": 0.1, "u": jl.Signal(ts, u, jl.interpolation.Linear())}
    found = jl.fit(system, record, start, free=tuple(truth))
    assert found.converged and found.standard_errors["tau"] < 2e-4
    for name, value in truth.items():
        assert abs(found.estimates[name] - value) < 3.5 * found.standard_errors[name], name
