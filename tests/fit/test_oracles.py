"""Estimates and standard errors on twenty problems: those of SciPy, of statsmodels and of formulas, which know nothing of jaxlag.

Each problem is stated twice: as a system with measurements, and as NumPy's formula of what is measured, whose derivatives are taken by a
complex step. SciPy's `leastsq` of MINPACK finds the minimum of the formula; statsmodels finds the errors there, and for noise that is
correlated the order and the coefficients of its autoregression and the covariance that they mean.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
import oscillator as osc
import pytest
import statsmodels.api as sm
from scipy import integrate, linalg, optimize, signal
from statsmodels.stats.diagnostic import acorr_ljungbox
from statsmodels.tsa.arima_process import arma_acovf
from statsmodels.tsa.stattools import acovf, levinson_durbin

import jaxlag as jl

OF_AN_ERROR, OF_ITS_SIZE = 1e-6, 1e-5  # how near estimates and standard errors are
EXACT = {"tolerance": 1e-8, "rtol": 1e-10, "atol": 1e-12}
TS = osc.TIMES


@dataclasses.dataclass(frozen=True)
class Problem:
    """What jaxlag is given; and `model`, which predicts `measured` from x: the numbers in `true`, of which those that `params` lacks are
    unknown starts. `known`: parameters that are not free. `sigma`: None if it is to be estimated.
    """

    system: jl.System
    experiments: Any
    true: Mapping[str, float]
    model: Callable[[np.ndarray], np.ndarray]
    measured: np.ndarray
    sigma: Any = None
    known: Mapping[str, float] = dataclasses.field(default_factory=dict)
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    coloured: bool = False


def noise(size, seed, count=TS.size, rho=0.0):
    """Of an autoregression of first order, in its stationary state."""
    e = np.random.default_rng(seed).standard_normal(count + 1000)
    return size * signal.lfilter([np.sqrt(1 - rho**2)], [1.0, -rho], e)[1000:]


def integrated(rate, start, ts=TS):
    """The motion by SciPy, (states, T); complex, so that derivatives by the parameters are its imaginary part."""
    return integrate.solve_ivp(rate, (0.0, ts[-1]), np.asarray(start, complex), "DOP853", ts, rtol=1e-12, atol=1e-14).y


def swing(x, ts=TS, m=1.0, x0=1.0, v0=0.0):
    """The position of the oscillator with x = (c, b)."""
    return osc.position(ts, x[0] / m, x[1] / m, x0, v0)


SWING = {"c": 4.0, "b": 0.3}


def swung(sigma=None, unit=1.0, gaps=(), options=None, rho=0.0, seed=0):
    """A free oscillation, of whose force this is the unit; some samples are missing."""
    measured = osc.with_nan(swing([4.0, 0.3]) + noise(0.02, seed, rho=rho), *gaps)
    return Problem(
        osc.SYSTEM,
        jl.Experiment(TS, measured, 1.0, 0.0, sigma=sigma),
        {name: unit * value for name, value in SWING.items()},
        lambda x: swing(x, m=unit),
        measured,
        sigma,
        {"m": unit},
        options or {},
        rho > 0,
    )


def several_records():
    ts, starts = np.linspace(0.0, 6.0, 40), [(1.0, 0.0), (0.0, 2.0), (-0.7, 1.0)]
    model = lambda x: np.concatenate([swing(x, ts, 1.0, *start) for start in starts])
    measured = model([4.0, 0.3]) + noise(0.02, 1, 120)
    records = [jl.Experiment(ts, z, *start) for z, start in zip(np.split(measured, 3), starts, strict=True)]
    return Problem(osc.SYSTEM, records, SWING, model, measured, None, {"m": 1.0})


def unknown_start():
    true, measured = SWING | {"q0": 0.8, "qdot0": -0.5}, swing([4.0, 0.3], x0=0.8, v0=-0.5) + noise(0.02, 2)
    record = jl.Experiment(TS, measured, 1.0, 0.0, unknown=("q0", "qdot0"))
    return Problem(osc.SYSTEM, record, true, lambda x: swing(x, x0=x[2], v0=x[3]), measured, None, {"m": 1.0})


def two_channels():
    def model(x):
        w = np.sqrt(x[0] - x[1] ** 2 / 4)
        return np.append(swing(x), -x[0] / w * np.exp(-x[1] * TS / 2) * np.sin(w * TS))

    sigma = np.repeat([0.02, 0.1], TS.size)
    measured = model([4.0, 0.3]) + sigma * noise(1.0, 3, 2 * TS.size)
    values, sizes = dict(zip("xv", np.split(measured, 2), strict=True)), {"x": 0.02, "v": 0.1}
    record = jl.Experiment(TS, values, 1.0, 0.0, sigma=sizes, observe=lambda q, qdot: {"x": q, "v": qdot})
    return Problem(osc.SYSTEM, record, SWING, model, measured, sigma, {"m": 1.0})


def recording_and_deflections(unit=1e-9):
    """Of which the recording tells c/m alone; masses and forces in this unit."""
    loads, sigma = unit * np.array([1.0, 2.0, 3.0]), np.append(np.full(TS.size, 0.02), np.full(3, 0.01))
    model = lambda x: np.append(np.cos(np.sqrt(x[1] / x[0]) * TS), loads / x[1])
    true = {"m": 0.5 * unit, "c": 2.0 * unit}
    measured = model(list(true.values())) + sigma * noise(1.0, 4, TS.size + 3)
    hung = jl.Measurement({"deflection": measured[TS.size :]}, lambda c: {"deflection": loads / c}, sigma=0.01)
    record = jl.Experiment(TS, measured[: TS.size], 1.0, 0.0, sigma=0.02)
    return Problem(osc.SYSTEM, [record, hung], true, model, measured, sigma, {"b": 0.0})


def driven():
    """From rest by F cos 1.5 t, seen by an accelerometer."""

    def model(x):
        rate = lambda t, s: [s[1], x[2] * np.cos(1.5 * t) - x[0] * s[0] - x[1] * s[1]]
        return np.array([rate(t, s)[1] for t, s in zip(TS, integrated(rate, [0.0, 0.0]).T, strict=True)])

    measured = model([4.0, 0.3, 2.0]).real + noise(0.1, 5)
    system = jl.System(
        lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2,
        dissipation=lambda qdot, b: 0.5 * b * qdot**2,
        force=lambda t, F: F * jnp.cos(1.5 * t),
    )
    record = jl.Experiment(TS, measured, 0.0, 0.0, observe=lambda qddot: qddot)
    return Problem(system, record, SWING | {"F": 2.0}, model, measured)


def cubic_spring():
    model = lambda x: integrated(lambda t, s: [s[1], -x[0] * s[0] - x[1] * s[0] ** 3], [1.0, 0.0])[0]
    measured = model([1.0, 3.0]).real + noise(0.02, 6)
    system = jl.System(lambda q, qdot, c, k: 0.5 * qdot**2 - 0.5 * c * q**2 - 0.25 * k * q**4)
    return Problem(system, jl.Experiment(TS, measured, 1.0, 0.0), {"c": 1.0, "k": 3.0}, model, measured)


def pendulum():
    model = lambda x: integrated(lambda t, s: [s[1], -9.81 / x[0] * np.sin(s[0]) - x[1] * s[1]], [2.0, 0.0])[0]
    measured = model([5.0, 0.2]).real + noise(0.02, 7)
    system = jl.System(lambda q, qdot, l: 0.5 * qdot**2 + 9.81 / l * jnp.cos(q), dissipation=lambda qdot, d: 0.5 * d * qdot**2)
    return Problem(system, jl.Experiment(TS, measured, 2.0, 0.0), {"l": 5.0, "d": 0.2}, model, measured)


def chain():
    """Two masses on three springs, by the exponential of a matrix."""

    def model(x):
        c, k = x
        A = np.block([[np.zeros((2, 2)), np.eye(2)], [np.array([[-c - k, k], [k, -c - k]]), np.zeros((2, 2))]])
        flow, states = linalg.expm(A * TS[1]), [np.array([1.0, 0.0, 0.0, 0.0])]
        for _ in TS[1:]:
            states.append(flow @ states[-1])
        return np.ravel(np.array(states)[:, :2])

    sigma = np.full(2 * TS.size, 0.02)
    measured = model([3.0, 0.5]) + noise(0.02, 8, 2 * TS.size)
    system = jl.System(lambda q, qdot, c, k: 0.5 * qdot @ qdot - 0.5 * c * q @ q - 0.5 * k * (q[1] - q[0]) ** 2)
    record = jl.Experiment(TS, measured.reshape(-1, 2), np.array([1.0, 0.0]), np.zeros(2), sigma=0.02)
    return Problem(system, record, {"c": 3.0, "k": 0.5}, model, measured, sigma)


def sliding():
    """A body that dry friction and drag slow down; it still slides at the end."""
    ts = np.linspace(0.0, 2.0, 50)
    model = lambda x: (3.0 + x[0] / x[1]) * (1 - np.exp(-x[1] * ts)) / x[1] - x[0] * ts / x[1]
    measured = model(np.array([0.8, 0.4])) + noise(0.01, 9, 50)
    system = jl.System(lambda qdot: 0.5 * qdot**2, dissipation=lambda qdot, F, b: F * jnp.abs(qdot) + 0.5 * b * qdot**2)
    return Problem(system, jl.Experiment(ts, measured, 0.0, 3.0), {"F": 0.8, "b": 0.4}, model, measured)


def cooling():
    """q̇ = k (T − q) from an unknown start: no inertia."""
    model = lambda x: x[1] + (x[2] - x[1]) * np.exp(-x[0] * TS)
    measured = model(np.array([0.5, 20.0, 90.0])) + noise(0.5, 10)
    system = jl.System(lambda q: 0.0 * q, dissipation=lambda qdot: 0.5 * qdot**2, force=lambda q, k, T: k * (T - q))
    record = jl.Experiment(TS, measured, 80.0, 0.0, unknown=("q0",))
    return Problem(system, record, {"k": 0.5, "T": 20.0, "q0": 90.0}, model, measured)


def reaction():
    """A → B → C, of which A and B are seen."""
    of_b = lambda j, k: j / (k - j) * (np.exp(-j * TS) - np.exp(-k * TS))
    model = lambda x: np.append(np.exp(-x[0] * TS), of_b(*x))
    sigma = np.repeat([0.02, 0.01], TS.size)
    measured = model(np.array([0.6, 0.25])) + sigma * noise(1.0, 11, 2 * TS.size)
    system = jl.System(
        lambda q: 0.0 * q["a"],
        dissipation=lambda qdot: 0.5 * (qdot["a"] ** 2 + qdot["b"] ** 2),
        force=lambda q, j, k: {"a": -j * q["a"], "b": j * q["a"] - k * q["b"]},
    )
    values, still = dict(zip("ab", np.split(measured, 2), strict=True)), {"a": 0.0, "b": 0.0}
    record = jl.Experiment(TS, values, {"a": 1.0, "b": 0.0}, still, sigma={"a": 0.02, "b": 0.01})
    return Problem(system, record, {"j": 0.6, "k": 0.25}, model, measured, sigma)


def measurement(formula, true, sigma, seed, **options):
    """Numbers that a formula predicts: with NumPy's functions, and with those of JAX."""
    x = np.array(list(true.values()))
    measured = formula(x, np) + sigma * noise(1.0, seed, np.size(formula(x, np)))
    predict = lambda params: formula([params[name] for name in true], jnp)
    part = jl.Measurement(measured, predict, sigma=sigma)
    return Problem(osc.SYSTEM, part, true, lambda x: formula(x, np), measured, sigma, {}, options)


AT = np.linspace(0.5, 10.0, 20)
PROBLEMS = {
    "damped oscillator": lambda: swung(),
    "missing samples": lambda: swung(gaps=(3, 4, 5, 17, 40)),
    "a sigma for each sample": lambda: swung(sigma=np.linspace(0.01, 0.03, TS.size)),
    "a prior": lambda: swung(sigma=0.02, options={"priors": {"b": (0.25, 0.01)}}),
    "bounds that are inactive": lambda: swung(options={"bounds": {"c": (0, 10), "b": (0, None)}}),
    "parameters of 1e-9": lambda: swung(unit=1e-9),
    "parameters of 1e9": lambda: swung(unit=1e9),
    "correlated noise": lambda: swung(rho=0.8, seed=1),
    "correlated noise of known size": lambda: swung(sigma=0.02, rho=0.9, seed=2, gaps=(3, 4, 5, 31)),
    "several records": several_records,
    "unknown start": unknown_start,
    "two channels": two_channels,
    "a recording and deflections": recording_and_deflections,
    "driven oscillator": driven,
    "cubic spring": cubic_spring,
    "pendulum": pendulum,
    "chain of two masses": chain,
    "sliding in dry friction": sliding,
    "cooling": cooling,
    "reaction": reaction,
    "Michaelis and Menten": lambda: measurement(lambda x, xp: x[0] * AT / (x[1] + AT), {"V": 2.0, "K": 1.5}, 0.02, 12),
    "logistic growth": lambda: measurement(
        lambda x, xp: x[0] / (1 + xp.exp(x[1] - x[2] * AT)), {"top": 5.0, "shift": 4.0, "rate": 1.1}, np.linspace(0.02, 0.1, 20), 13
    ),
    "polynomial": lambda: measurement(lambda x, xp: x[0] + x[1] * AT + x[2] * AT**2, {"a": 1.0, "b": -0.5, "c": 0.1}, 0.1, 14),
    "periods of a pendulum": lambda: measurement(
        lambda x, xp: 2 * np.pi * xp.sqrt((AT + x[1]) / x[0]), {"g": 9.81, "offset": 0.05}, 0.002, 15
    ),
}


SLOW = recording_and_deflections, driven, cubic_spring, chain, sliding, cooling, reaction
MARKED = [pytest.param(name, marks=pytest.mark.slow) if make in SLOW else name for name, make in PROBLEMS.items()]


def slopes(problem, x):
    """The Jacobian of the model by complex steps: exact but for rounding."""
    steps = 1e-30 * np.abs(x)
    return np.stack([np.imag(problem.model(x + 1j * h * unit)) / h for h, unit in zip(steps, np.eye(x.size), strict=True)], axis=1)


def weighted(problem, x, f):
    """Residuals and their Jacobian with f = (predictions, slopes), over sigma; then the rows of the priors."""
    there = np.isfinite(problem.measured)
    sigma = np.broadcast_to(1.0 if problem.sigma is None else problem.sigma, there.shape)[there]
    r, J = (problem.measured - f[0])[there] / sigma, f[1][there] / sigma[:, None]
    for name, (mean, deviation) in problem.options.get("priors", {}).items():
        i = list(problem.true).index(name)
        r, J = np.append(r, (mean - x[i]) / deviation), np.append(J, np.eye(x.size)[[i]] / deviation, axis=0)
    return r, J


def by_scipy(problem):
    """x at the minimum, with weighted residuals and Jacobian there; the iteration counts x in what it truly is."""
    true = np.array(list(problem.true.values()))
    at = lambda x: weighted(problem, x, (np.real(problem.model(x)), slopes(problem, x)))
    tight = dict.fromkeys(("xtol", "ftol", "gtol"), 1e-15)
    y = optimize.least_squares(lambda y: -at(y * true)[0], np.ones(true.size), lambda y: at(y * true)[1] * true, method="lm", **tight).x
    return y * true, *at(y * true)


def correlated_errors(r, J):
    """Over σ̂: the sandwich for residuals whose autoregression is that of Yule and Walker, of the order with the least BIC."""
    n = r.size
    assert acorr_ljungbox(r, lags=[20])["lb_pvalue"].item() < 0.01
    most = min(n // 5, int(10 * np.log10(n)))
    _, _, _, powers, coefficients = levinson_durbin(acovf(r, demean=False, nlag=most, fft=False), nlags=most, isacov=True)
    order = 1 + int(np.argmin(n * np.log(powers[1:]) + np.arange(1, most + 1) * np.log(n)))
    gamma = arma_acovf(np.append(1.0, -coefficients[1 : order + 1, order]), [1.0], nobs=n)
    P = np.linalg.inv(J.T @ J)
    return np.sqrt(np.diag(P @ J.T @ linalg.toeplitz(gamma / gamma[0]) @ J @ P))


@pytest.mark.parametrize("name", MARKED)
def test_estimates_and_errors_are_those_of_scipy_and_statsmodels(name):
    problem = PROBLEMS[name]()
    x, r, J = by_scipy(problem)
    known, n = problem.sigma is not None, np.sum(np.isfinite(problem.measured))
    linear = sm.WLS(r + J @ x, J).fit(cov_type="fixed scale" if known else "nonrobust")
    errors = linear.bse if not problem.coloured else correlated_errors(r, J) * (1.0 if known else np.sqrt(r @ r / (n - x.size)))
    free = tuple(entry for entry in problem.true if entry not in ("q0", "qdot0"))
    start = dict(problem.known) | {entry: 1.35 * problem.true[entry] for entry in free}
    found = jl.fit(problem.system, problem.experiments, start, free=free, **EXACT, **problem.options)
    assert found.converged and (found.correlation_length > 0) == problem.coloured
    all_of = lambda named, own: np.array([named[entry] if entry in free else own[0][entry] for entry in problem.true])
    estimates = all_of(found.estimates, found.unknowns)
    np.testing.assert_allclose((estimates - x) / errors, 0.0, atol=OF_AN_ERROR)
    np.testing.assert_allclose((estimates - linear.params) / errors, 0.0, atol=OF_AN_ERROR)
    np.testing.assert_allclose(all_of(found.standard_errors, found.unknown_errors), errors, rtol=OF_ITS_SIZE)
