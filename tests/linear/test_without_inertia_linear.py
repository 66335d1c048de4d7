"""A driven mass on a Maxwell element: responses, periodic motions, regression and printed equations where a coordinate has no inertia."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

P = {"m": 2.0, "k": 5.0, "c": 3.0, "b": 0.7}
OMEGA = 1.3
START = {"x": 1.0, "z": 0.0}, {"x": 0.0, "z": 0.0}
ENERGY = {
    "mass": lambda q, qdot, m, k: 0.5 * m * qdot["x"] ** 2 - 0.5 * k * q["x"] ** 2,
    "spring": lambda q, c: -0.5 * c * (q["x"] - q["z"]) ** 2,
}
DASHPOT = {"dashpot": lambda qdot, b: 0.5 * b * qdot["z"] ** 2}
DRIVEN = jl.System(ENERGY, dissipation=DASHPOT, force={"push": lambda f: {"x": f}})


def receptance(omega):
    """x̂/f̂ = 1/(k − m ω² + c i ω b/(c + i ω b)), the element's complex stiffness in it; and ẑ/x̂ = c/(c + i ω b)."""
    s = 1j * omega
    return 1 / (P["k"] + P["m"] * s**2 + P["c"] * s * P["b"] / (P["c"] + s * P["b"])), P["c"] / (P["c"] + s * P["b"])


@pytest.mark.slow
def test_frequency_response():
    at = {"x": 0.0, "z": 0.0}
    linear = jl.linearise(DRIVEN, at, params=P | {"f": 0.0}, inputs=("f",), outputs=lambda q: {"x": q["x"], "z": q["z"]})
    omega = np.array([0.3, 1.0, 4.0, 30.0])
    x, ratio = receptance(omega)
    np.testing.assert_allclose(np.reshape(linear.frequency_response(omega), (4, 2)), np.stack([x, x * ratio], axis=1), rtol=1e-10)
    exact = np.roots([P["m"] * P["b"], P["m"] * P["c"], (P["k"] + P["c"]) * P["b"], P["k"] * P["c"]])
    np.testing.assert_allclose(np.sort_complex(linear.eigenvalues), np.sort_complex(exact), rtol=1e-10)


@pytest.mark.slow
def test_a_forced_vibration_and_its_multipliers():
    """x = Re x̂ exp(iωt); a Floquet multiplier exp(sT) for each of three eigenvalues: ż is no part of the state."""
    pushed = jl.System(ENERGY, dissipation=DASHPOT, force={"push": lambda t, w: {"x": jnp.cos(w * t)}})
    orbit = jl.periodic(pushed, *START, P | {"w": OMEGA}, section=jl.Every(lambda w: 2 * jnp.pi / w))
    x, ratio = receptance(OMEGA)
    rates = [orbit.qdot["x"], orbit.qdot["z"]]
    np.testing.assert_allclose([orbit.q["x"], orbit.q["z"]], [x.real, (x * ratio).real], rtol=1e-8)
    np.testing.assert_allclose(rates, [(1j * OMEGA * x).real, (1j * OMEGA * x * ratio).real], rtol=1e-7)
    s = np.roots([P["m"] * P["b"], P["m"] * P["c"], (P["k"] + P["c"]) * P["b"], P["k"] * P["c"]])
    exact = np.exp(s * 2 * np.pi / OMEGA)
    found = np.asarray(orbit.multipliers)
    np.testing.assert_allclose(np.sort_complex(found[np.argsort(-abs(found))][:3]), np.sort_complex(exact), atol=1e-9)
    assert orbit.is_stable


@pytest.mark.slow
def test_regression_of_stiffness_and_damping():
    """From the motion alone, in the weak form: the node's equation has no acceleration to miss."""
    ts = np.linspace(0, 10, 1001)
    motion = jl.simulate(DRIVEN, *START, ts, P | {"f": 0.0}, rtol=1e-10, atol=1e-12)
    found = jl.regress(DRIVEN, jl.Experiment(ts, motion.q, *START), P | {"f": 0.0, "c": 2.0, "b": 1.0}, free=("c", "b"))
    np.testing.assert_allclose([found.params["c"], found.params["b"]], [P["c"], P["b"]], rtol=1e-8)


def test_linear_equations_on_paper():
    equations = jl.equations(DRIVEN, START[0], P | {"f": 0.0}, linearised_at={"x": 0, "z": 0, "f": 0}, inputs=("f",))
    assert "m δẍ + (k + c) δx − c δz = δf\nb δż − c δx + c δz = 0" in str(equations)
