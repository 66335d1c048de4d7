"""A laser that lags beside an accelerometer that does not: estimates, errors and predictions by SciPy on the closed form."""

import jax.numpy as jnp
import numpy as np
import optax
import oscillator as osc
import pytest
from scipy import integrate, optimize

import jaxlag as jl

TS = np.linspace(0.0, 5.0, 80)
LAG = 0.13
NOISE = {"laser": 10.0, "acceleration": 0.05}  # micrometres, and m/s²


def velocity(ts, c, b):
    """ẋ(t) from rest at x = 1."""
    w = np.sqrt(c - b**2 / 4)
    return -c / w * np.exp(-b / 2 * ts) * np.sin(w * ts)


def seen(c, b, lag, ts=TS):
    """The laser in millimetres times a thousand, and the acceleration."""
    late = np.maximum(ts - lag, 0)
    return {"laser": 1e3 * osc.position(late, c, b), "acceleration": -c * osc.position(ts, c, b) - b * velocity(ts, c, b)}


def sensors(q, qddot):
    return {"laser": 1e3 * q, "acceleration": qddot}


def lag(lag):
    return lag


TRUTH = (4.0, 0.3, LAG)
RNG = np.random.default_rng(2)
MEASURED = {name: z + NOISE[name] * RNG.standard_normal(len(TS)) for name, z in seen(*TRUTH).items()}
FREE = ("c", "b", "lag")
PARAMS = {"m": 1.0, "c": 3.0, "b": 0.5, "lag": 0.05}


def weighted(p):
    return np.concatenate([(z - MEASURED[name]) / NOISE[name] for name, z in seen(*p).items()])


def errors_of(p, J):
    return np.sqrt(np.diag(np.linalg.inv(J.T @ J)))


@pytest.fixture(scope="module")
def expected():
    found = optimize.least_squares(weighted, TRUTH, jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return found.x, errors_of(found.x, found.jac)


def record(values, delay, **more):
    return jl.Experiment(TS, values, 1.0, 0.0, observe=sensors, delay=delay, sigma=NOISE, **more)


@pytest.fixture(scope="module")
def fitted():
    return jl.fit(osc.SYSTEM, record(MEASURED, {"laser": lag}), PARAMS, free=FREE)


def test_a_lag_of_one_channel_is_identified(fitted, expected):
    theta, errors = expected
    np.testing.assert_allclose([fitted.estimates[name] for name in FREE], theta, rtol=1e-5)
    np.testing.assert_allclose([fitted.white_standard_errors[name] for name in FREE], errors, rtol=1e-3)


def test_what_is_to_be_expected_of_a_lag_of_one_channel(fitted):
    """Information, and predictions at the estimates, of which the accelerometer shows no lag."""
    planned = jl.information(osc.SYSTEM, record(None, {"laser": lag}), {"m": 1.0} | dict(zip(FREE, TRUTH, strict=True)), free=FREE)
    J = optimize.least_squares(weighted, TRUTH, jac="3-point", max_nfev=1).jac
    np.testing.assert_allclose([planned.standard_errors[name] for name in FREE], errors_of(TRUTH, J), rtol=1e-3)
    shown = fitted.predict(record(None, {"laser": lag})).values
    for name, z in seen(*(fitted.estimates[name] for name in FREE)).items():
        np.testing.assert_allclose(shown[name], z, atol=1e-5 * np.max(np.abs(z)))


@pytest.mark.slow
def test_lags_by_channel_that_are_numbers_make_one_kind(fitted):
    """In either order; a validation finds residuals like the noise, and where the lag is left out ten times as large ones."""
    lags = {"laser": LAG, "acceleration": 0.0}
    both = [record(MEASURED, lags), record(MEASURED, dict(reversed(lags.items())))]
    assert both[0].delay == both[1].delay and hash(both[0].delay) == hash(both[1].delay)
    rms = lambda e: {channel.name: channel.rms for channel in jl.validate(fitted, e).channels}
    laser = rms(both[0])["laser"]
    assert 8 < laser < 12 and rms(record(MEASURED, None))["laser"] > 10 * laser


@pytest.mark.slow
def test_a_lag_of_one_channel_by_reverse_mode(expected):
    found = jl.fit(osc.SYSTEM, record(MEASURED, {"laser": lag}), PARAMS | {"lag": 0.12}, free=FREE, method=optax.lbfgs(), max_steps=60)
    np.testing.assert_allclose([found.estimates[name] for name in FREE], expected[0], rtol=1e-3)


@pytest.mark.slow
def test_the_unknown_start_of_a_record_with_a_lag():
    own = record(MEASURED, {"laser": lag}, unknown=("q0",))
    found = jl.fit(osc.SYSTEM, own, PARAMS, free=FREE)
    assert abs(found.unknowns[0]["q0"] - 1.0) < 4 * found.unknown_errors[0]["q0"]
    for name, truth in zip(FREE, TRUTH, strict=True):
        assert abs(found.estimates[name] - truth) < 4 * found.standard_errors[name]


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (
            lambda: record(MEASURED, {"lasr": 0.1}),
            "`delay` must name channels of `values`, but holds 'lasr'. There are acceleration, laser.",
        ),
        (lambda: jl.Experiment(TS, TS, 1.0, 0.0, delay={"q": 0.1}), "holds 'q'. There are none that have names."),
        (lambda: record(MEASURED, {"laser": np.nan}), r"`delay\['laser'\]` must be finite, but is nan"),
        (
            lambda: jl.information(osc.SYSTEM, record(None, {"lasr": 0.1}), PARAMS, free="c"),
            "`delay` must name channels of `values`, but holds 'lasr'. There are acceleration, laser.",
        ),
    ],
)
def test_lags_of_what_is_no_channel_are_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()


@pytest.mark.parametrize("second", [1.0, 1e-3])  # in the unit of time
def test_regression_knows_of_lags(second):
    """A mass on a spring, driven from rest, late on the clock; the sensor of its position lags, that of its velocity lags more."""
    m, c, b, w = 2.0, 50.0, 3.0, 4.0
    forced = jl.System(
        lambda q, qdot, m, c: 0.5 * m * qdot**2 - 0.5 * c * q**2,
        dissipation=lambda qdot, b: 0.5 * b * qdot**2,
        force=lambda t, w, begin: jnp.sin(w * (t - begin)),
    )
    begin, ts = 1e5 * second, np.linspace(0.0, 8.0, 801)
    rates = lambda t, s: [s[1], (np.sin(w * t) - c * s[0] - b * s[1]) / m]
    moved = integrate.solve_ivp(rates, (0, 8), [0.0, 0.0], "DOP853", rtol=1e-11, atol=1e-13, dense_output=True).sol
    late = lambda i, lag: moved(np.maximum(ts - lag, 0))[i]
    values = {"position": late(0, 0.31), "speed": late(1, 0.52) / second}
    record = jl.Experiment(
        begin + ts * second,
        values,
        0.0,
        0.0,
        observe=lambda q, qdot: {"position": q, "speed": qdot},
        delay={"position": lambda lag: lag, "speed": 0.52 * second},
        params={"begin": begin},
    )
    params = {"m": m * second**2, "c": np.nan, "b": np.nan, "w": w / second, "lag": 0.31 * second}
    found = jl.regress(forced, record, params, free=("c", "b"))
    np.testing.assert_allclose([found.estimates["c"], found.estimates["b"]], [c, b * second], rtol=2e-3)
    unknown = jl.regress(forced, record, params, free=("c", "b", "lag"))
    assert np.isinf(unknown.standard_errors["lag"])
    with pytest.raises(ValueError, match="`delay` must be known where the motion is read off the measurements, but is NaN"):
        jl.regress(forced, record, params | {"lag": np.nan}, free=("c", "b", "lag"))
