"""Measurements that a function of the parameters predicts, beside recordings; by hand. By SciPy: `test_oracles`."""

import inspect  # `unwrap`: without the hook of these tests, which refuses wrong types before

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

OSCILLATOR = jl.System(lambda q, qdot, m, c: 0.5 * m * qdot**2 - 0.5 * c * q**2)
FORCES = np.array([4.0, 8.0])


def deflections(c):
    return {"deflection": FORCES / c}


def test_a_measurement_alone_of_an_equilibrium_that_moves():
    """A weight on a spring of its own system: x = m g/c, and with a mass of 0.5 kg on it (m + 0.5) g/c. Derivatives go through the rest."""
    hanging = jl.System(lambda q, qdot, m, c, g: 0.5 * m * qdot**2 - 0.5 * c * q**2 + m * g * q)

    def rest(params):
        return jl.equilibrium(hanging, 0.0, params).q

    known, seen = {"g": 9.81}, (0.1962, 0.2452)
    parts = [
        jl.Measurement(seen[0], rest, sigma=1e-4),
        jl.Measurement(seen[1], lambda params: rest({**params, "m": params["m"] + 0.5}), sigma=1e-4),
    ]
    found = jl.fit(hanging, parts, known | {"m": 1.5, "c": 90.0}, free=("m", "c"))
    c = 0.5 * 9.81 / (seen[1] - seen[0])
    np.testing.assert_allclose([found.estimates["c"], found.estimates["m"]], [c, c * seen[0] / 9.81], rtol=1e-8)
    J = np.array([[9.81 / c, -seen[0] / c], [9.81 / c, -seen[1] / c]]) / 1e-4
    expected = np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
    np.testing.assert_allclose([found.standard_errors["m"], found.standard_errors["c"]], expected, rtol=1e-6)


def test_what_is_planned_predicted_and_validated():
    weighed = jl.Measurement({"deflection": FORCES / 8.0}, deflections, sigma=0.01)
    params = {"m": 2.0, "c": 8.0}
    error = 0.01 / np.linalg.norm(FORCES / 64.0)
    assert jl.information(OSCILLATOR, weighed, params, free=("c",)).standard_errors["c"] == pytest.approx(error, rel=1e-9)
    found = jl.fit(OSCILLATOR, weighed, params | {"c": 7.0}, free="c")
    other = jl.Measurement([16.5, np.nan], lambda c: jnp.stack([2 * c, c**2]), sigma=[1.0, 2.0], params={"m": 1.0})
    predicted = found.predict(other)
    np.testing.assert_allclose(predicted.values, [16.0, 64.0], rtol=1e-9)
    np.testing.assert_allclose(predicted.standard_errors[0], 2 * error, rtol=1e-6)
    assert jl.validate(found, other).residuals[0] == pytest.approx(0.5) and "z  rms 0.5" in repr(jl.validate(found, other))
    slope = jax.grad(lambda c: jl.information(OSCILLATOR, weighed, params | {"c": 8.0}, free="c").matrix[0, 0] * c)(2.0)
    assert slope == pytest.approx(1 / error**2)


def test_many_starts_and_a_profile():
    """4/c = 0.5 has one solution, and so has its profile: c of a deflection ± 1.96 σ."""
    weighed = jl.Measurement(0.5, lambda c: 4.0 / c, sigma=0.01)
    found = jl.fit(OSCILLATOR, weighed, {"m": 1.0, "c": 100.0}, free="c", start=jl.MultiStart(8), tolerance=1e-8)
    assert found.estimates["c"] == pytest.approx(8.0)
    np.testing.assert_allclose(found.interval("c", profile=True), [4 / (0.5 + 0.0195996), 4 / (0.5 - 0.0195996)], rtol=1e-5)


WRONG = {
    "text": (lambda make: make("a", lambda c: c, sigma=1.0), "`values` must be an array of real numbers"),
    "table": (lambda make: make(np.ones((2, 2)), lambda c: c, sigma=1.0), "`values` must be finite numbers or lists of them"),
    "sigma": (lambda make: make([1.0, 2.0], lambda c: c, sigma=[1.0, -1.0]), "`sigma` must be a number or structured like `values`"),
    "predict": (lambda make: make(1.0, 3.0, sigma=1.0), "`predict` must be a function, but is 3.0"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_measurement_is_refused(case):
    call, said = WRONG[case]

    class Unchecked(jl.Measurement):
        __init__ = inspect.unwrap(jl.Measurement.__init__)

    with pytest.raises((TypeError, ValueError), match=said):
        call(Unchecked)


@pytest.mark.parametrize(
    ("predict", "said"),
    [
        (lambda c: jnp.ones(2) * c, r"`predict` must return what `values` holds"),
        (lambda k: k, "`predict` must name arguments that exist, but it names 'k'"),
        (lambda c: jnp.log(-c), "what `predict` returns is not finite"),
    ],
)
def test_what_cannot_be_predicted_is_refused(predict, said):
    with pytest.raises((TypeError, ValueError), match=said):
        jl.fit(OSCILLATOR, jl.Measurement(1.0, predict, sigma=1.0), {"m": 1.0, "c": 6.0}, free="c")


def test_regress_needs_recordings():
    with pytest.raises(ValueError, match="`experiments` must be an `Experiment` or a list of them"):
        inspect.unwrap(jl.regress)(OSCILLATOR, jl.Measurement(1.0, lambda c: c, sigma=1.0), {"m": 1.0, "c": 6.0}, free="c")
