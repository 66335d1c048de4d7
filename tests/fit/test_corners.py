"""Corners of fits in which numbers came out wrong without a word: narrow valleys, units, channels without noise, few events, bounds."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optax
import oscillator as osc
import pytest
from oscillator import START, SYSTEM, TIMES, TRUE, noisy, position
from scipy.optimize import least_squares

import jaxlag as jl
from jaxlag._fit.parameters import Free

SIGMA = 0.01


@pytest.mark.parametrize("away", [3.0, 30.0])
def test_along_a_narrow_valley(away):
    """Two gains whose correlation is −1 + 4e-9, from beside their minimum: χ² is that of linear least squares."""
    system = jl.System(lambda qdot: 0.5 * qdot**2, force=lambda t, a, b: a + (1 + 1e-4 * t) * b)
    ts = np.linspace(0, 2, 40)
    z = 1.5 * ts**2 + 1e-3 * np.random.default_rng(0).standard_normal(40)
    A = np.stack([ts**2 / 2, ts**2 / 2 + 1e-4 * ts**3 / 6], axis=1) / 1e-3
    (best, squares, _, _), covariance = np.linalg.lstsq(A, z / 1e-3, rcond=None), np.linalg.inv(A.T @ A)
    values, directions = np.linalg.eigh(covariance)
    start = best + away * np.sqrt(values[-1]) * directions[:, -1]
    experiment = jl.Experiment(ts, z, 0.0, 0.0, sigma=1e-3)
    fit = jl.fit(system, experiment, {"a": start[0], "b": start[1]}, free=("a", "b"), rtol=1e-10, atol=1e-12)
    assert fit.converged
    np.testing.assert_allclose(2 * fit.cost, squares[0], rtol=1e-6)
    found = np.array([fit.estimates["a"], fit.estimates["b"]])
    assert np.linalg.norm((found - best) / np.sqrt(np.diag(covariance))) < 1e-2


@pytest.mark.parametrize("unit", [1.0, 1e9])
def test_an_unknown_start_in_any_units(unit):
    """Seconds and nanoseconds: as SciPy on the closed form."""
    z = noisy(0)
    expected = least_squares(lambda x: (position(TIMES, *x) - z) / SIGMA, [4.2, 0.3, 1.0, 0.0], xtol=1e-14, ftol=1e-14).x
    experiment = jl.Experiment(TIMES * unit, z, 1.0, 0.0, sigma=SIGMA, unknown=("q0", "qdot0"))
    start = {"m": 1.0, "c": 3.0 / unit**2, "b": 0.6 / unit}
    found = jl.fit(SYSTEM, experiment, start, free=("c", "b"), rtol=1e-9, atol=1e-12 / unit)
    assert found.converged
    np.testing.assert_allclose([found.estimates["c"] * unit**2, found.estimates["b"] * unit], expected[:2], rtol=1e-5)


@pytest.mark.parametrize("scale", [1.0, 1e11])
def test_a_parameter_that_starts_at_zero_in_any_units(scale):
    system = jl.System(
        lambda q, qdot, m, c: 0.5 * m * qdot**2 - 0.5 * c * q**2, dissipation=lambda qdot, b, scale: 0.5 * b * scale * qdot**2
    )
    z = noisy(1)
    expected = least_squares(lambda x: (position(TIMES, 4.0, *x) - z) / SIGMA, [0.3], xtol=1e-14, ftol=1e-14).x
    params = TRUE | {"b": 0.0, "scale": scale}
    found = jl.fit(system, jl.Experiment(TIMES, z, 1.0, 0.0, sigma=SIGMA), params, free=("b",), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.estimates["b"] * scale, expected, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 3])
def test_channels_that_are_predicted_exactly(count):
    """They say nothing of the noise of x: the standard error is that of x alone."""
    alone, quiet = jl.Experiment(TIMES, {"x": noisy(2)}, 1.0, 0.0, observe=lambda q: {"x": q}), np.zeros((len(TIMES), count))
    beside = jl.Experiment(TIMES, {"x": noisy(2), "y": quiet}, 1.0, 0.0, observe=lambda q: {"x": q, "y": jnp.zeros(count)})
    one, both = (jl.fit(SYSTEM, e, TRUE | {"c": 4.1}, free=("c",)) for e in (alone, beside))
    np.testing.assert_allclose(both.estimates["c"], one.estimates["c"], rtol=1e-6)
    np.testing.assert_allclose(both.standard_errors["c"], one.standard_errors["c"], rtol=1e-4)
    assert both.freedom == one.freedom
    assert any("predicted exactly" in remark for remark in both.remarks)


@pytest.mark.parametrize("upper", [1.0, 100.0, 1e6])
def test_profiles_between_wide_bounds(upper):
    """They are those without bounds."""
    experiment = jl.Experiment(TIMES, noisy(3), 1.0, 0.0, sigma=SIGMA)
    plain = jl.fit(SYSTEM, experiment, START, free=("c", "b"))
    bounded = jl.fit(SYSTEM, experiment, START, free=("c", "b"), bounds={"b": (0, upper), "c": (0, max(upper, 10))})
    for name in ("b", "c"):
        expected, found = (fit.interval(name, profile=True) for fit in (plain, bounded))
        np.testing.assert_allclose([found.lower, found.upper], [expected.lower, expected.upper], rtol=1e-4)


def test_the_profile_of_the_only_unknown():
    """Where S has risen by t²/2, by SciPy's closed form."""
    from scipy.optimize import brentq

    z = noisy(4)
    fit = jl.fit(SYSTEM, jl.Experiment(TIMES, z, 1.0, 0.0, sigma=SIGMA), START | {"b": 0.3}, free=("c",), rtol=1e-10, atol=1e-12)
    S = lambda c: 0.5 * np.sum(((position(TIMES, c) - z) / SIGMA) ** 2)
    at, t = float(fit.estimates["c"]), fit.quantile(0.95)
    scale = float(fit.standard_errors["c"] / fit.white_standard_errors["c"])
    ends = [brentq(lambda c: S(c) - S(at) - (t * scale) ** 2 / 2, *sorted((at, at + away))) for away in (-0.5, 0.5)]
    found = fit.interval("c", profile=True)
    np.testing.assert_allclose([found.lower, found.upper], ends, rtol=1e-5)


# Events

ringing = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2, events={"zero": jl.Event(lambda q: q)})


def heard(count=3):
    """Zeros of cos 2t."""
    return np.pi / 4 + np.pi / 2 * np.arange(count)


def listened(**more):
    ts = np.linspace(0, 5, 41)
    return jl.Experiment(
        ts, {"x": np.cos(2 * ts)}, 1.0, 0.0, observe=lambda q: {"x": q}, events={"zero": heard()}, sigma={"x": 0.01, "zero": 1e-3}
    )


@pytest.mark.slow
def test_predictions_of_events_have_their_errors():
    """Of t_k = (k + ½) π/√c: t/2c of that of c; of x, t sin(√c t)/2√c."""
    fit = jl.fit(ringing, listened(), {"c": 3.9}, free=("c",))
    found, error = fit.predict(listened()), float(fit.standard_errors["c"])
    np.testing.assert_allclose(found.standard_errors["zero"][:3], heard() / 8 * error, rtol=1e-3)
    np.testing.assert_allclose(found.standard_errors["x"][8], abs(np.sin(2.0) / 4) * error, rtol=1e-3)


@pytest.mark.slow
def test_a_start_with_too_few_events_is_refused():
    with pytest.raises(ValueError, match="fewer events happen than were measured"):
        jl.fit(ringing, listened(), {"c": 0.5}, free=("c",))


# Data and priors


def test_fits_of_other_data_are_not_compared():
    fits = {
        name: jl.fit(SYSTEM, jl.Experiment(TIMES, z, x0, 0.0), START, free=("c", "b"))
        for name, z, x0 in (("z", noisy(5), 1.0), ("−z", -noisy(5), -1.0))
    }
    with pytest.raises(ValueError, match="must be of the same measurements"):
        jl.compare(fits)


def test_priors_are_no_likelihood():
    """A prior ten of its deviations away made a difference of some hundred in AIC, "very strong", with the same data."""
    fit = lambda **how: jl.fit(SYSTEM, jl.Experiment(TIMES, noisy(5), 1.0, 0.0, sigma=0.01), START, free=("c", "b"), **how)
    plain = fit()
    c, error = float(plain.estimates["c"]), float(plain.standard_errors["c"])
    held = fit(priors={"c": (c + 1000 * error, 100 * error)})
    table = jl.compare({"plain": plain, "held": held})
    squares = lambda found: float(np.sum((np.asarray(noisy(5)) - found.predictions[0]) ** 2) / 0.01**2)
    np.testing.assert_allclose(table.aic["held"], squares(held) - squares(plain), atol=1e-6)
    assert table.aic["held"] < 1 and "'held' had priors on c" in repr(table) and table.priors == {"held": ("c",)}


def test_random_starts_keep_their_sign():
    """In 7 % of them an unbounded 0.3 had become negative."""
    free = Free.of({name: np.array(x) for name, x in (("a", 0.3), ("b", -2.0), ("c", 0.0))}, ("a", "b", "c"))
    starts = np.asarray(jax.vmap(free.theta)(free.random_starts(jax.random.key(0), 400)))
    assert np.all(starts[:, 0] > 0) and np.all(starts[:, 1] < 0) and 0.3 < np.mean(starts[:, 2] < 0) < 0.7
    np.testing.assert_allclose(np.median(starts[:, :2], axis=0), [0.3, -2.0], rtol=0.15)


def test_as_many_unknowns_as_measurements_are_said():
    found = jl.fit(SYSTEM, jl.Experiment(np.r_[0.0, TIMES[9:40:20]], np.r_[np.nan, noisy(5)[9:40:20]], 1.0, 0.0), START, free=("c", "b"))
    assert "is left over that could contradict" in repr(found) and "no measurement is left over" in repr(found) and "nan" not in repr(found)


@pytest.mark.parametrize("prior", [(np.nan, 1.0), (None, 1.0), (np.inf, 1.0)])
def test_priors_have_a_mean(prior):
    with pytest.raises(ValueError, match="`priors` of 'c' must have a finite mean"):
        jl.fit(SYSTEM, jl.Experiment(TIMES, noisy(6), 1.0, 0.0), START, free=("c",), priors={"c": prior})


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e3])
def test_a_start_at_rest_in_dry_friction(unit):
    """What sticks at the start has no velocity to be seen: "0 ± 0" stood there. The estimates against the numbers that made the record."""
    ts = np.linspace(0, 8, 200)
    params = {"m": 1.0, "c": 4.0, "F": 0.6 * unit, "A": 2.0 * unit}
    x = jl.simulate(STICKING, 0.05 * unit, 0.0, ts, params, rtol=1e-10).q
    record = jl.Experiment(ts, x + 1e-3 * unit * np.random.default_rng(0).standard_normal(200), 0.04 * unit, 0.0, unknown=("q0", "qdot0"))
    found = jl.fit(STICKING, record, params | {"m": 1.3, "c": 3.5, "F": 0.4 * unit}, free=("m", "c", "F"))
    assert found.converged and np.isinf(found.unknown_errors[0]["qdot0"]) and "± 0" not in repr(found).replace("± 0.", "")
    assert "qdot0  not determined by these measurements" in repr(found)
    for name in ("m", "c", "F"):
        assert abs(float(found.estimates[name]) - params[name]) < 4 * float(found.standard_errors[name])
    assert abs(float(found.unknowns[0]["q0"]) - 0.05 * unit) < 4 * float(found.unknown_errors[0]["q0"])


STICKING = jl.System(
    lambda q, qdot, m, c: 0.5 * m * qdot**2 - 0.5 * c * q**2,
    dissipation=lambda qdot, F: F * jnp.abs(qdot),
    force=lambda t, A: A * jnp.sin(2 * t) * jnp.minimum(t / 3, 1),
)


def test_an_impossible_trial_of_an_implicit_solver_is_no_crash():
    """Started far off, an implicit solver that is differentiated met numbers that are not finite: a raw error of a callback."""
    ts = np.linspace(0, 2, 40)
    record = jl.Experiment(ts, np.exp(-2 * ts) + 1e-3 * np.random.default_rng(0).standard_normal(40), 1.0, -2.0)
    damped = jl.System(lambda q, qdot, m, k: 0.5 * m * qdot**2 - 0.5 * k * q**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2)
    found = jl.fit(damped, record, {"m": 1.0, "k": 1.0, "b": 1.0}, free=("m", "k"), solver=diffrax.Kvaerno5())
    m, k = float(found.estimates["m"]), float(found.estimates["k"])
    assert not found.converged or abs(k - 2 + 4 * m) < 0.05  # m s² + s + k = 0 at s = −2


def test_a_network_may_have_more_weights_than_there_are_samples():
    """README's optimisers of optax were refused for a network of 65 weights and 40 samples: "must name no more than was measured"."""
    keys = jax.random.split(jax.random.key(0), 2)
    net = {
        "A": 0.3 * jax.random.normal(keys[0], (16, 2)),
        "a": jnp.zeros(16),
        "c": 0.1 * jax.random.normal(keys[1], (16,)),
        "d": jnp.zeros(1),
    }
    force = lambda q, qdot, net: net["c"] @ jnp.tanh(net["A"] @ jnp.array([q, qdot]) + net["a"]) + net["d"][0]
    record = jl.Experiment(np.linspace(0, 3, 40), np.exp(-0.2 * np.linspace(0, 3, 40)) * np.cos(2 * np.linspace(0, 3, 40)), 1.0, -0.2)
    pushed = jl.System(lambda q, qdot: 0.5 * qdot**2 - 2 * q**2, force=force)
    found = jl.fit(pushed, record, {"net": net}, free="net", method=optax.adam(1e-2), max_steps=60)
    assert found.costs[-1] < 0.3 * found.costs[0] and "nan" not in repr(found)
    with pytest.raises(ValueError, match="must name no more than was measured"):
        jl.fit(pushed, record, {"net": net}, free="net")


def test_the_interval_on_the_card_ends_at_a_bound():
    found = jl.fit(osc.SYSTEM, osc.record(0), osc.START | {"b": 0.31}, free=("c", "b"), bounds={"b": (0.2999, None)})
    (row,) = [line for line in repr(found).splitlines() if line.startswith("  b ")]
    assert found.standard_errors["b"] > 1e-3 and row.split("95 %: ")[1].startswith("0.2999 … ")


def test_starts_of_many_records_are_one_row_each():
    """The noise is 0.01, so that of 14 starts at rest all lie within some 3 standard errors."""
    records = [osc.record(seed, np.linspace(0.0, 6.0, 60), unknown=("q0", "qdot0")) for seed in range(14)]
    found = jl.fit(osc.SYSTEM, records, osc.START, free=("c", "b"))
    rows = [line for line in repr(found).splitlines() if "14 experiments: " in line]
    assert [row.split()[2] for row in rows] == ["q0", "qdot0"] and "experiment 3" not in repr(found)
    least, most = min(of["qdot0"] for of in found.unknowns), max(of["qdot0"] for of in found.unknowns)
    np.testing.assert_allclose([float(word) for word in rows[1].replace(",", "").split()[3:6:2]], [least, most], atol=6e-5)
    assert len(found.to_dict()["parameters"]) == 2 + 28
