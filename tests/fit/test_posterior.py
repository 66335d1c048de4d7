"""Posterior densities of linear models against closed forms, by quadrature and by draws; derivatives, and where there is no motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

import jaxlag as jl

pushed = jl.System(lambda q, qdot, m: 0.5 * m * qdot**2, force=lambda F, d: F + 0.0 * d)
UNITS = [1.0, 1e-6]


def record(unit=1.0, sigma=0.01, seed=0, T=41, gaps=False):
    """A mass of one, pushed for a second: q = F t²/2 + noise, linear in F."""
    rng, ts = np.random.default_rng(seed), np.linspace(0.0, 1.0, T)
    if gaps:
        ts = np.sort(np.append(rng.uniform(0, 1, T - 1), 0.0))
    values = unit * (3.0 * ts**2 / 2 + 0.01 * rng.normal(size=T))
    if gaps:
        values[5:8] = np.nan
    return jl.Experiment(ts, values, q0=0.0, qdot0=0.0, sigma=None if sigma is None else sigma * unit), ts, values


PARAMS = {"m": 1.0, "F": 1.0, "d": 0.0}


def given(unit):
    return PARAMS | {"F": 2.0 * unit}


@pytest.mark.slow
@pytest.mark.parametrize("unit", UNITS)
def test_a_linear_model_with_known_noise(unit):
    """A normal density, with the mean and the deviation of the fit; a prior adds its own."""
    e, ts, values = record(unit)
    x = ts**2 / 2
    for prior in (None, (2.9 * unit, 0.02 * unit)):
        density = jl.log_density(pushed, e, given(unit), free=("F",), priors=None if prior is None else {"F": prior})
        weight, total = x @ x / (0.01 * unit) ** 2, x @ values / (0.01 * unit) ** 2
        if prior is not None:
            weight, total = weight + 1 / prior[1] ** 2, total + prior[0] / prior[1] ** 2
        mean, deviation = total / weight, weight**-0.5
        np.testing.assert_allclose(density.to_params(density.start)["F"], mean, rtol=1e-6)
        u = density.start[None] + jnp.linspace(-4, 4, 9)[:, None] / np.sqrt(density.metric[0, 0])
        theta = jax.vmap(density.to_params)(u)["F"]
        found = jax.vmap(density)(u)
        expected = stats.norm.logpdf(theta, mean, deviation)
        np.testing.assert_allclose(found - found[4], expected - expected[4], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose((theta[8] - theta[0]) / 8, deviation, rtol=1e-4)  # of the metric


@pytest.mark.parametrize(("bounds", "kind"), [((None, 2.95), "above"), ((2.95, None), "below"), ((2.9, 2.97), "both")])
def test_bounds(bounds, kind):
    """The density of numbers without bounds is that of a truncated normal: its mean by quadrature."""
    e, ts, values = record()
    x = ts**2 / 2
    mean, deviation = x @ values / (x @ x), 0.01 / np.sqrt(x @ x)
    density = jl.log_density(pushed, e, PARAMS | {"F": 2.96 if kind == "below" else 2.93}, free=("F",), bounds={"F": bounds})
    u = jnp.linspace(-40, 40, 20001)[:, None] + density.start[None]
    p = np.asarray(jax.vmap(density)(u))
    p = np.exp(p - p.max())
    theta = np.asarray(jax.vmap(lambda u: density.to_params(u)["F"])(u))
    lower, upper = (-np.inf if bounds[0] is None else bounds[0]), (np.inf if bounds[1] is None else bounds[1])
    ends = (lower - mean) / deviation, (upper - mean) / deviation
    expected = stats.truncnorm(*ends, loc=mean, scale=deviation)
    found = integrate.trapezoid(theta * p, u[:, 0]) / integrate.trapezoid(p, u[:, 0])
    np.testing.assert_allclose(found, expected.mean(), rtol=1e-6)
    assert np.all((lower <= theta) & (theta <= upper))


@pytest.mark.parametrize("unit", UNITS)
def test_unknown_noise(unit):
    """With a prior 1/σ, what is left of F is Student's t with N − 1 degrees of freedom."""
    e, ts, values = record(unit, sigma=None)
    x = ts**2 / 2
    density = jl.log_density(pushed, e, given(unit), free=("F",))
    assert density.names == ("F", "log sigma")
    F = x @ values / (x @ x)
    s = np.sqrt(np.sum((values - F * x) ** 2) / (len(x) - 1))
    w = np.linspace(-5, 5, 7) / np.sqrt(density.metric[0, 0])
    log_sigma = np.log(s) + np.linspace(-1.5, 1.5, 601)
    every = jax.vmap(jax.vmap(lambda w, a: density(jnp.stack([density.start[0] + w, a])), (None, 0)), (0, None))(w, log_sigma)
    marginal = np.log(integrate.trapezoid(np.exp(every - np.max(every)), log_sigma, axis=1))
    theta = np.asarray(jax.vmap(lambda w: density.to_params(jnp.stack([density.start[0] + w, 0.0]))["F"])(w))
    expected = stats.t.logpdf((theta - F) / (s / np.sqrt(x @ x)), len(x) - 1)
    np.testing.assert_allclose(marginal - marginal[3], expected - expected[3], rtol=1e-6, atol=1e-6)


def test_coloured_noise():
    """At any times, and with missing samples: a normal density with the covariance σ² e^(−|Δt|/τ)."""
    e, ts, values = record(sigma=None, gaps=True)
    density = jl.log_density(pushed, e, PARAMS | {"F": 2.0}, free=("F",), coloured=True)
    assert density.names == ("F", "log sigma", "log tau")
    there = np.isfinite(values)
    gap = np.abs(ts[there][:, None] - ts[there])
    rng, found, expected = np.random.default_rng(1), [], []
    for _ in range(6):
        w, log_sigma, log_tau = rng.normal(size=3) * [0.01, 0.5, 0.5] + [0, np.log(0.01), np.log(0.1)]
        u = jnp.array([density.start[0] + w, log_sigma, log_tau])
        F = float(density.to_params(u)["F"])
        found.append(float(density(u)))
        left = values[there] - F * ts[there] ** 2 / 2
        expected.append(stats.multivariate_normal.logpdf(left, cov=np.exp(2 * log_sigma - gap / np.exp(log_tau))))
    np.testing.assert_allclose(np.array(found) - found[0], np.array(expected) - expected[0], rtol=1e-7, atol=1e-7)


rubbed = jl.System(
    lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2,
    dissipation={"viscous": lambda qdot, b: 0.5 * b * qdot**2, "dry": lambda qdot, F: F * jnp.abs(qdot)},
)


@pytest.mark.slow
def test_derivatives_and_where_there_is_no_motion():
    """Slopes are those of differences, with friction and an unknown start; −∞ and a slope of zero where friction is negative."""
    truth, ts = {"c": 4.0, "b": 0.05, "F": 0.08}, jnp.linspace(0.0, 6.0, 61)
    motion = jl.simulate(rubbed, 1.0, 0.0, ts, truth)
    noise = 0.01 * np.random.default_rng(0).normal(size=61)
    e = jl.Experiment(ts, np.asarray(motion.q) + noise, 1.0, 0.0, sigma=0.01, unknown=("q0",))
    density = jl.log_density(rubbed, e, truth, free=("c", "b", "F"))
    assert density.names == ("c", "b", "F", "unknown 0")
    root = np.linalg.inv(np.linalg.cholesky(density.metric)).T
    of = jax.jit(lambda v: density(density.start + root @ v))
    v, h = 0.3 * np.ones(4), 1e-4
    by_differences = [(of(v + h * d) - of(v - h * d)) / (2 * h) for d in np.eye(4)]
    for slope in (jax.grad(of), jax.jacfwd(of)):
        np.testing.assert_allclose(slope(v), by_differences, rtol=1e-4, atol=1e-4)
    u = jnp.asarray(density.start).at[2].set(-3.0)  # F = F₀ (1 − 3)
    value, slope = jax.value_and_grad(density)(u)
    assert value == -np.inf and np.all(np.isfinite(slope))
    np.testing.assert_allclose(jax.vmap(density)(jnp.stack([u, density.start]))[1], density(density.start), rtol=1e-12)


@pytest.mark.slow
def test_draws():
    """Four chains agree, with mean and deviation as the closed form has them, and bands of predictions; bounds are kept."""
    pytest.importorskip("blackjax")
    e, ts, values = record()
    x = ts**2 / 2
    posterior = jl.log_density(pushed, e, PARAMS, free=("F",)).sample(jax.random.key(0), 1000, chains=4)
    mean, deviation = x @ values / (x @ x), 0.01 / np.sqrt(x @ x)
    error = deviation / np.sqrt(posterior.effective["F"])
    assert posterior.r_hat["F"] < 1.01 and posterior.divergences == 0 and posterior.draws["F"].shape == (4, 1000)
    assert abs(np.mean(posterior.draws["F"]) - mean) < 4 * error
    np.testing.assert_allclose(np.std(posterior.draws["F"]), deviation, rtol=0.08)
    interval = posterior.interval("F")
    np.testing.assert_allclose([interval.lower, interval.upper], mean + deviation * np.array([-1.96, 1.96]), atol=0.25 * deviation)
    low, middle, high = posterior.bands(e)
    np.testing.assert_allclose(middle, mean * x, atol=0.5 * deviation)
    np.testing.assert_allclose(high - low, 2 * 1.96 * deviation * x, rtol=0.25, atol=1e-12)
    assert "4 chains of 1000 draws" in str(posterior) and "R̂" in str(posterior)
    with pytest.raises(ValueError, match="`name` must be one of the draws"):
        posterior.interval("m")


@pytest.mark.slow
def test_draws_with_friction():
    """Dry and viscous friction of an oscillator with unknown noise: chains agree, and intervals hold the truth."""
    pytest.importorskip("blackjax")
    truth, ts = {"c": 4.0, "b": 0.05, "F": 0.08}, jnp.linspace(0.0, 6.0, 61)
    motion = jl.simulate(rubbed, 1.0, 0.0, ts, truth)
    e = jl.Experiment(ts, np.asarray(motion.q) + 0.01 * np.random.default_rng(3).normal(size=61), 1.0, 0.0)
    density = jl.log_density(rubbed, e, truth, free=("c", "b", "F"), bounds={"b": (0, None), "F": (0, None)})
    posterior = density.sample(jax.random.key(1), 500, chains=4, warmup=300)
    assert max(posterior.r_hat.values()) < 1.03
    for name in truth:
        interval = posterior.interval(name, 0.99)
        assert interval.lower < truth[name] < interval.upper
    assert np.all(posterior.draws["F"] > 0) and np.all(posterior.draws["sigma"] > 0)


@pytest.mark.slow
@pytest.mark.parametrize("unit", UNITS)
def test_bands_of_forces_and_of_the_instant_of_sticking(unit):
    """A block that friction F stops after v₀/F, and holds with what pushes it; a quantile of a function that rises is that of F."""
    pytest.importorskip("blackjax")
    pushed = jl.System(
        lambda qdot: 0.5 * (qdot["x"] ** 2 + qdot["z"] ** 2),
        force=lambda t, P: {"x": P * (t - 2.0) * (t > 2.0), "z": 0.0},
        dissipation={"dry": lambda qdot, F: F * jnp.abs(qdot["x"])},
        holonomic={"floor": lambda q: q["z"]},
    )
    ts, start = np.linspace(0.0, 3.0, 61), ({"x": 0.0, "z": 0.0}, {"x": 3.0 * unit, "z": 0.0})
    params = {"F": 2.0 * unit, "P": unit}
    x = np.where(ts < 1.5, 3.0 * ts - ts**2, 2.25) * unit + 0.05 * unit * np.random.default_rng(2).normal(size=61)
    record = jl.Experiment(ts, {"x": x}, *start, sigma=0.05 * unit, observe=lambda q: {"x": q["x"]})
    posterior = jl.log_density(pushed, record, params, free=("F",)).sample(jax.random.key(0), 100, chains=2, warmup=100)

    def seen(motion):
        return {"stopped": 3.0 - motion.stats["time_stuck"][-1, 0], "force": motion.friction["dry"].force, "at": motion.q["x"][-1]}

    low, middle, high = posterior.bands(record, seen)
    quantiles = np.quantile(posterior.draws["F"], [0.025, 0.5, 0.975])
    np.testing.assert_allclose([high["stopped"], middle["stopped"], low["stopped"]], 3.0 * unit / quantiles, rtol=1e-4)
    np.testing.assert_allclose([high["at"], middle["at"], low["at"]], 4.5 * unit**2 / quantiles, rtol=1e-4)
    np.testing.assert_allclose(low["force"][-1], -unit, rtol=1e-8)  # it sticks, so that F is not to be seen
    np.testing.assert_allclose(-high["force"][10], quantiles[0], rtol=1e-4)
    with pytest.raises(TypeError, match="`of` must be a function of a motion"):
        posterior.bands(record, "q")
