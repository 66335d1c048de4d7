"""Identification from data that jaxlag did not make, from starts that are far off."""

import re

import jax.numpy as jnp
import make_drive
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import curve_fit, least_squares

import jaxlag as jl
from jaxlag._fit.levenberg_marquardt import CONVERGED, levenberg_marquardt
from jaxlag._fit.rounding import plus_minus
from jaxlag.examples import vehicle

GUESS = vehicle.params | {"b": 6000.0, "c": 20000.0, "k": 0.3}


def drive(seed, samples=300, noise=1e-3):
    """A recorded drive by SciPy."""
    ts = np.linspace(0, 20, samples)
    x, y, phi, vx, vy, w = make_drive.motion(ts)
    e = noise * np.random.default_rng(seed).standard_normal((3, samples))
    return ts, {"y": y + e[0], "phi": phi + e[1], "xdot": vx + e[2]}


def experiment(seed, **more):
    return jl.Experiment(*drive(seed, **more), vehicle.q0, vehicle.qdot0, observe=vehicle.observe)


@pytest.mark.fast
def test_the_shipped_recording_is_what_its_script_makes(tmp_path, monkeypatch):
    monkeypatch.setattr(make_drive, "FILE", tmp_path / "again.csv")
    make_drive.main()
    again, shipped = (np.loadtxt(file, delimiter=",", skiprows=1) for file in (tmp_path / "again.csv", vehicle.recording))
    np.testing.assert_allclose(again, shipped, atol=1.1e-6)


@pytest.mark.slow
def test_without_noise_the_truth_comes_back():
    fit = jl.fit(vehicle.system, experiment(0, noise=0.0), GUESS, free=("b", "c", "k"), rtol=1e-10, atol=1e-12)
    for name in ("b", "c", "k"):
        np.testing.assert_allclose(fit.estimates[name], vehicle.params[name], rtol=1e-7)
    assert fit.converged


def by_scipy(seed):
    """curve_fit over the equations of the lecture, in turns with the root mean square of each channel's residuals."""
    ts, values = drive(seed)
    measured = np.concatenate([values[name] for name in ("y", "phi", "xdot")])

    def model(_, b, c, k):
        old = make_drive.b, make_drive.c, make_drive.k
        make_drive.b, make_drive.c, make_drive.k = b, c, k
        try:
            x, y, phi, vx, vy, w = make_drive.motion(ts)
        finally:
            make_drive.b, make_drive.c, make_drive.k = old
        return np.concatenate([y, phi, vx])

    def slope(_, *p):
        steps = [1e-5 * value * e for value, e in zip(p, np.eye(3), strict=True)]
        return np.stack([(model(_, *(p + h)) - model(_, *(p - h))) / (2 * np.max(h)) for h in steps], axis=1)

    found, sigmas = [6000.0, 20000.0, 0.3], np.ones(3)
    for _ in range(4):
        weights = np.repeat(sigmas, len(ts))
        found, covariance = curve_fit(model, ts, measured, p0=found, jac=slope, sigma=weights, xtol=1e-12, ftol=1e-14)
        Q = np.linalg.qr(slope(ts, *found) / weights[:, None])[0]
        decided = np.sum(np.reshape(Q**2, (3, -1)), axis=1)  # of the three parameters, by each channel
        sigmas = np.sqrt(np.sum(np.reshape(measured - model(ts, *found), (3, -1)) ** 2, axis=1) / (len(ts) - decided))
    return found, covariance, sigmas


def test_estimates_and_errors_are_those_of_scipy():
    fit = jl.fit(vehicle.system, experiment(3), GUESS, free=("b", "c", "k"), rtol=1e-10, atol=1e-12)
    estimates, covariance, sigmas = by_scipy(3)
    order = [fit.names.index(name) for name in ("b", "c", "k")]
    np.testing.assert_allclose([fit.estimates[name] for name in ("b", "c", "k")], estimates, rtol=1e-6)
    errors = np.sqrt(np.diag(fit.covariance))[order]
    np.testing.assert_allclose(errors, np.sqrt(np.diag(covariance)), rtol=1e-4)
    np.testing.assert_allclose([fit.sigmas[0][name] for name in ("y", "phi", "xdot")], sigmas, rtol=1e-4)
    np.testing.assert_allclose(fit.correlation[1, 0], covariance[1, 0] / np.sqrt(covariance[0, 0] * covariance[1, 1]), atol=1e-3)


def test_a_given_sigma_gives_absolute_errors():
    free = ("b", "c", "k")
    estimated = jl.fit(vehicle.system, experiment(4), GUESS, free=free)
    twice = {name: 2 * sigma for name, sigma in estimated.sigmas[0].items()}
    with_sigma = jl.Experiment(*drive(4), vehicle.q0, vehicle.qdot0, observe=vehicle.observe, sigma=twice)
    given = jl.fit(vehicle.system, with_sigma, GUESS, free=free)
    np.testing.assert_allclose(given.estimates["c"], estimated.estimates["c"], rtol=1e-6)
    np.testing.assert_allclose(given.sigma, 0.5, rtol=0.1)  # the noise is half of what was said
    np.testing.assert_allclose(given.standard_errors["c"] * given.sigma, estimated.standard_errors["c"], rtol=1e-4)


@pytest.mark.slow
def test_several_experiments_and_the_card():
    pair = [experiment(5), experiment(6, samples=200)]
    fit = jl.fit(vehicle.system, pair, GUESS, free=("b", "c", "k"))
    for name in ("b", "c", "k"):
        assert abs(fit.estimates[name] - vehicle.params[name]) < 3.5 * fit.standard_errors[name]
    card = repr(fit)
    assert "Fit: 3 parameters, 1500 measurements, converged after" in card
    for name in ("b", "c", "k"):
        assert f"  {name}  {plus_minus(float(fit.estimates[name]), float(fit.standard_errors[name]))}" in card
    assert fit.residuals[1]["y"].shape == (200,) and fit.predictions[0]["xdot"].shape == (300,)
    np.testing.assert_allclose(fit.predictions[1]["y"] + fit.residuals[1]["y"], pair[1].values["y"])


@pytest.mark.slow
def test_a_vector_of_parameters_and_what_is_seen_of_accelerations():
    """Two springs in one parameter; an accelerometer and the force in a rod are the sensors."""
    from jaxlag.examples import pendulum

    system = jl.System(lambda q, qdot, c: 0.5 * qdot @ qdot - 0.5 * c @ q**2)
    ts = np.linspace(0, 3, 50)
    data = -np.stack([2 * np.cos(np.sqrt(2) * ts), 5 * np.cos(np.sqrt(5) * ts)], axis=1)
    fit = jl.fit(
        system,
        jl.Experiment(ts, {"accelerometer": data}, np.ones(2), np.zeros(2), observe=lambda qddot: {"accelerometer": qddot}),
        {"c": np.array([3.0, 3.0])},
        free=("c",),
    )
    np.testing.assert_allclose(fit.estimates["c"], [2.0, 5.0], rtol=1e-5)
    assert fit.names == ("c[0]", "c[1]")

    ts = np.linspace(0, 2, 40)
    truth = solve_ivp(lambda t, s: [s[1], -9.81 / 0.8 * np.sin(s[0])], (0, 2), [1.0, 0.0], t_eval=ts, rtol=1e-11, atol=1e-12).y
    tension = 1.7 * 0.8 * truth[1] ** 2 + 1.7 * 9.81 * np.cos(truth[0])
    observe = lambda multipliers: -multipliers["rod"]
    start = {"r": 0.8, "phi": 1.0}, {"r": 0.0, "phi": 0.0}
    found = jl.fit(pendulum.polar, jl.Experiment(ts, tension, *start, observe=observe), {"m": 1.0, "g": 9.81, "l": 1.2}, free=("m", "l"))
    np.testing.assert_allclose([found.estimates["m"], found.estimates["l"]], [1.7, 0.8], rtol=1e-5)


@pytest.mark.slow
def test_progress_is_shown(capfd):
    jl.fit(vehicle.system, experiment(7), GUESS, free=("b", "k"), progress=True)
    *_, last = capfd.readouterr().err.splitlines()  # no terminal: the last state alone, and what takes long before it
    assert re.fullmatch(r"step +\d+   cost \S+   \d+\.\d s", last)


@pytest.mark.slow
def test_a_second_fit_traces_nothing(monkeypatch):
    from jaxlag._motion import solution_map

    fit = lambda seed: jl.fit(vehicle.system, experiment(seed), GUESS, free=("b", "k"))
    fit(8)
    traces = []
    check = solution_map.check
    monkeypatch.setattr(solution_map, "check", lambda *args: traces.append(1) or check(*args))
    fit(9)
    assert traces == []


@pytest.mark.fast
@pytest.mark.parametrize(
    "value, error, said",
    [
        (2998.4, 12.3, "2998 ± 12"),
        (0.600029, 2.1e-5, "0.600029 ± 0.000021"),
        (41234.0, 310.0, "41230 ± 310"),
        (1.0000000123, 2e-9, "1.0000000123 ± 2e-09"),
        (-3.4567e-12, 2.1e-15, "-3.4567e-12 ± 2.1e-15"),
        (123456789.0, 12.0, "123456789 ± 12"),
        (1e-9, 0.5, "0.00 ± 0.50"),
    ],
)
def test_plus_minus(value, error, said):
    assert plus_minus(value, error) == said


@pytest.mark.fast
def test_a_step_too_small_to_be_seen_is_taken():
    """Where each look at the residuals adds 1e-9 of them, no last step lowers the cost. It ends all the same; against SciPy."""
    ts, looks = np.linspace(0.0, 1.0, 50), []
    data = np.exp(-1.3 * ts) + 0.01 * np.sin(40 * ts)

    def linearise(y):
        looks.append(1)
        model = jnp.exp(-y[0] * ts)
        return (model - data) * (1 + 1e-9 * len(looks)), (-ts * model)[:, None], None

    outcome = levenberg_marquardt(linearise, jnp.array([3.0]), freedom=49, max_steps=50, tolerance=1e-6)
    expected = least_squares(lambda y: np.exp(-y[0] * ts) - data, [3.0], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    error = np.sqrt(2 * expected.cost / 49 / (expected.jac.T @ expected.jac)[0, 0])
    assert int(outcome.best.status) == CONVERGED and len(looks) <= 9
    np.testing.assert_allclose(outcome.best.y[0], expected.x[0], atol=1e-4 * error)


@pytest.mark.slow
def test_an_input_that_ends_before_the_record_is_remarked():
    cart = jl.System(lambda qdot, m: 0.5 * m * qdot**2, force=lambda t, u: u(t))
    ts = np.linspace(0.0, 2.0, 21)
    short, whole = (jl.Signal(np.linspace(0.0, end, 6), np.ones(6), jl.interpolation.Linear()) for end in (1.0, 1.8))
    for push, remarked in ((short, True), (whole, False)):
        fit = jl.fit(cart, jl.Experiment(ts, ts**2 / 4, 0.0, 0.0, params={"u": push}), {"m": 1.0}, free=("m",))
        np.testing.assert_allclose(fit.estimates["m"], 2.0, rtol=1e-6)
        assert (fit.remarks == ["u ends at t = 1 and keeps its value to the end of the record at 2"]) == remarked


def test_one_name_is_one_name():
    """`free="damping"` as `free=("damping",)`, in all that fits."""
    ts = np.linspace(0, 3, 60)
    damped = jl.System(lambda q, qdot: 0.5 * qdot**2 - 2 * q**2, dissipation=lambda qdot, damping: 0.5 * damping * qdot**2)
    w = np.sqrt(4 - 0.1**2)
    record = jl.Experiment(ts, np.exp(-0.1 * ts) * (np.cos(w * ts) + 0.1 / w * np.sin(w * ts)), 1.0, 0.0, sigma=1e-3)
    params = {"damping": 0.4}
    for find in (jl.fit, jl.regress, lambda *given, **how: jl.fit_each(given[0], [given[1]], given[2], **how)[0]):
        np.testing.assert_allclose(find(damped, record, params, free="damping").estimates["damping"], 0.2, rtol=1e-3)
    led_in = jl.fit(damped, record, params, free="damping", start=jl.Regress())
    np.testing.assert_allclose(led_in.estimates["damping"], 0.2, rtol=1e-3)
    assert set(jl.information(damped, record, params, free="damping").standard_errors) == {"damping"}
