"""Errors of predictions: where nothing was measured, where what they depend on is not determined, and with noise of several kinds."""

import jax.numpy as jnp
import numpy as np
import oscillator as osc
import pytest

import jaxlag as jl

FREE = ("c", "b")


def derivatives(theta, ts=osc.TIMES):
    """Of the position by c and b, in closed form."""
    at = lambda c, b: osc.position(ts, c, b)
    return np.stack([(at(*(theta + d)) - at(*(theta - d))) / 2e-6 for d in 1e-6 * np.eye(2)], axis=1)


@pytest.mark.parametrize("loss", [None, jl.Huber()])
def test_missing_samples_have_errors_too(loss):
    """A sensor that failed for half of the record: the band there is that of the closed form."""
    z = np.where(np.abs(np.arange(osc.TIMES.size) - 30) < 15, np.nan, osc.noisy(0))
    found = jl.fit(osc.SYSTEM, jl.Experiment(osc.TIMES, z, 1.0, 0.0), osc.START, free=FREE, loss=loss)
    J = derivatives(np.array([found.estimates[name] for name in FREE]))
    by_hand = np.sqrt(np.einsum("ti,ij,tj->t", J, found.covariance, J))
    np.testing.assert_allclose(found.prediction_errors[0], by_hand, rtol=1e-4, atol=1e-9)
    lower, upper = found.band()
    np.testing.assert_allclose(upper - lower, 2 * found.quantile(0.95) * by_hand, rtol=1e-4, atol=1e-8)


@pytest.mark.slow
def test_what_depends_on_what_is_not_determined_has_no_finite_error():
    """A swing tells c/m alone: another swing has a finite band, the force of the spring, in N and in nN, has none."""
    system = jl.System(lambda q, qdot, m, c: 0.5 * m * qdot**2 - 0.5 * c * q**2)
    swing = jl.Experiment(osc.TIMES, osc.noisy(0, b=1e-12), 1.0, 0.0)
    found = jl.fit(system, swing, {"m": 1.0, "c": 3.9}, free=("m", "c"))
    alone = jl.fit(system, swing, {"m": 1.0, "c": 3.9}, free="c")
    ts = np.linspace(0.1, 3.0, 20)
    planned = lambda observe: jl.Experiment(np.append(0.0, ts), None, 0.0, 2.0, observe=observe)
    shown = [fit.predict(planned(lambda q: q)).standard_errors for fit in (found, alone)]
    np.testing.assert_allclose(*shown, rtol=1e-3, atol=1e-12)
    for unit in (1.0, 1e-9):
        force = found.predict(planned(lambda q, c, unit=unit: c * q * unit))
        assert np.all(np.isinf(np.asarray(force.standard_errors)[1:]))


@pytest.mark.slow
def test_noise_of_clicks_has_nothing_to_do_with_that_of_samples():
    """The covariance of correlated samples and of twelve clicks is the same whether one record holds both or each has its own."""
    heard = jl.System(
        lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2,
        dissipation=lambda qdot, b: 0.5 * b * qdot**2,
        events={"click": jl.Event(lambda q: q)},
    )
    rng, ts = np.random.default_rng(3), np.linspace(0.0, 20.0, 400)
    noise = [0.0]
    for shock in 0.01 * rng.standard_normal(ts.size - 1):
        noise.append(0.9 * noise[-1] + shock)
    w = np.sqrt(4.0 - 0.15**2)
    clicks = (np.arange(12) * np.pi + np.pi - np.arctan2(w, 0.15)) / w
    clicks = clicks + 3e-3 * np.array([np.sin(0.8 * k) for k in range(12)])  # slow, as if correlated
    samples = {"values": {"x": osc.position(ts) + noise}, "sigma": {"x": 0.02}}
    sound = {"events": {"click": clicks}, "sigma": {"click": 3e-3}}
    observe = {"observe": lambda q: {"x": q}}
    both = jl.Experiment(ts, samples["values"], 1.0, 0.0, **observe, events=sound["events"], sigma=samples["sigma"] | sound["sigma"])
    apart = [
        jl.Experiment(ts, samples["values"], 1.0, 0.0, **observe, sigma=samples["sigma"]),
        jl.Experiment(ts, None, 1.0, 0.0, **sound),
    ]
    one, two = (jl.fit(heard, e, {"m": 1.0, "c": 3.98, "b": 0.32}, free=FREE, start=None) for e in (both, apart))
    assert one.correlation_length > 10
    np.testing.assert_allclose(one.covariance, two.covariance, rtol=1e-5)
    np.testing.assert_allclose(jnp.array([one.estimates[name] - two.estimates[name] for name in FREE]), 0, atol=1e-6)
