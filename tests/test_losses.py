"""Losses of gears, ropes, belts and joints by the forces in them, against Modelica's reference, closed forms and SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import jaxlag as jl
from jaxlag import elements

UNITS = [1.0, 1e-9, 1e6]


def two(x):
    return {"1": x, "2": x}


LOSSY_GEAR = jl.System(  # LossyGearDemo1 of the Modelica Standard Library 4.0: a gear of ratio 2 that sticks and slips both ways
    lambda qdot, J_1, J_2: 0.5 * J_1 * qdot["1"] ** 2 + 0.5 * J_2 * qdot["2"] ** 2,
    force=lambda t, M, load: {"1": M * jnp.sin(2 * jnp.pi * t), "2": -load + 2.5 * t},
    dissipation=lambda qdot, multipliers, eta, back: elements.gear(qdot["1"], multipliers["mesh"], eta, back),
    holonomic={"mesh": lambda q: q["1"] - 2 * q["2"]},
)
DEMO = {"J_1": 1.0, "J_2": 1.5, "M": 10.0, "load": 10.0, "eta": 0.5, "back": 0.5}


def angle(params):
    return jl.simulate(LOSSY_GEAR, two(0.0), two(0.0), np.array([0.0, 1.0]), params, rtol=1e-11, atol=1e-13).q["1"][-1]


@pytest.mark.slow
def test_the_lossy_gear_of_modelica():
    np.testing.assert_allclose(angle(DEMO), -0.9056530023, atol=2e-9)


@pytest.mark.slow
def test_derivatives_of_the_lossy_gear():
    """That by η₁ as a solver of Modelica finds it by differences; that by η₂ as a code of events in SciPy does; others by differences."""
    slopes = jax.grad(angle)(DEMO)
    np.testing.assert_allclose(slopes["eta"], 0.16014471, atol=1e-7)
    np.testing.assert_allclose(slopes["back"], -0.233292, atol=2e-5)
    for name in ("J_1", "J_2", "M", "load"):
        h = 1e-5 * DEMO[name]
        by_differences = (angle({**DEMO, name: DEMO[name] + h}) - angle({**DEMO, name: DEMO[name] - h})) / (2 * h)
        np.testing.assert_allclose(slopes[name], by_differences, rtol=1e-6)


WORM = jl.System(
    lambda qdot, J_1, J_2: 0.5 * J_1 * qdot["1"] ** 2 + 0.5 * J_2 * qdot["2"] ** 2,
    force=lambda M, load: {"1": M, "2": -load},
    dissipation=lambda qdot, multipliers, eta, back: elements.gear(qdot["1"], multipliers["mesh"], eta, back),
    holonomic={"mesh": lambda q: q["1"] - 20 * q["2"]},
)


@pytest.mark.parametrize("unit", UNITS)
def test_a_worm_locks_itself(unit):
    """η₂ = 2 − 1/η₁ < 0: the load stays, however large, until the worm drives it, up at η₁, and down against the mesh."""
    eta, J_1, J_2, load = 0.4, 0.01, 0.5, 6.0
    back = 2 - 1 / eta

    def after(M, load):
        params = {"J_1": J_1, "J_2": J_2, "M": M * unit, "load": load * unit, "eta": eta, "back": back}
        motion = jl.simulate(WORM, two(0.0), two(0.0), np.array([0.0, 1.0, 2.0]), params)
        return motion.q["1"][-1] / (2.0 * unit)

    assert after(0.0, load) == after(0.0, -1e4 * load) == after(0.7, load) == after(-0.1, load) == 0
    up = (0.8 - load / (20 * eta)) / (J_1 + J_2 / (20**2 * eta))  # M₁ = η₁ i M₁
    np.testing.assert_allclose(after(0.8, load), up, rtol=1e-9)
    down = (-0.6 - back * load / 20) / (J_1 + back * J_2 / 20**2)  # the load drives: M₁ = η₂ M₂/i, which is against it
    np.testing.assert_allclose(after(-0.6, load), down, rtol=1e-9)


ROPE = jl.System(
    lambda q, qdot, m_1, m_2, g: 0.5 * (m_1 * qdot["1"] ** 2 + m_2 * qdot["2"] ** 2) + g * (m_1 * q["1"] + m_2 * q["2"]),
    dissipation=lambda qdot, multipliers, mu: elements.rope_over_pulley(qdot["1"], -multipliers["rope"], mu, jnp.pi),
    holonomic={"rope": lambda q: q["1"] + q["2"]},
)


def fallen(m_1, m_2, mu, unit=1.0):
    params = {"m_1": m_1, "m_2": m_2, "g": 9.81 * unit, "mu": mu}
    return jl.simulate(ROPE, two(0.0), two(0.0), np.array([0.0, 2.0]), params).q["1"][-1] / (2 * unit)


def acceleration_on_a_bollard(m_1, m_2, mu):
    e = np.exp(mu * np.pi)
    return 9.81 * (m_1 - m_2 * e) / (m_1 + m_2 * e)


@pytest.mark.parametrize("unit", UNITS)
def test_two_masses_on_a_rope_over_a_bollard(unit):
    assert fallen(2.0, 1.0, 0.25, unit) == fallen(1.0, 2.0, 0.25, unit) == 0  # e^(π/4) = 2.19
    expected = acceleration_on_a_bollard(3.0, 1.0, 0.25)
    np.testing.assert_allclose(fallen(3.0, 1.0, 0.25, unit), expected, rtol=1e-9)
    np.testing.assert_allclose(fallen(1.0, 3.0, 0.25, unit), -expected, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.grad, jax.jacfwd])
def test_derivatives_on_a_bollard(derivative):
    h = 1e-6
    slope = (acceleration_on_a_bollard(3.0, 1.0, 0.25 + h) - acceleration_on_a_bollard(3.0, 1.0, 0.25 - h)) / (2 * h)
    np.testing.assert_allclose(derivative(fallen, argnums=2)(3.0, 1.0, 0.25), slope, rtol=1e-7)
    assert derivative(fallen, argnums=2)(2.0, 1.0, 0.25) == 0


def test_a_belt_slips_beyond_what_it_can_pass_on():
    system = jl.System(
        lambda qdot, J: 0.5 * J * (qdot["1"] ** 2 + qdot["2"] ** 2),
        force=lambda t, M: {"1": M * t, "2": 0.0},
        dissipation=lambda qdot, r_1, r_2, T_0, mu: elements.belt(r_1 * qdot["1"] - r_2 * qdot["2"], T_0, mu, jnp.pi),
    )
    params = {"J": 0.02, "M": 6.0, "r_1": 0.05, "r_2": 0.1, "T_0": 40.0, "mu": 0.3}
    tight, slack = params["T_0"] * 2 * np.exp(0.3 * np.pi) / (1 + np.exp(0.3 * np.pi)), 2 * params["T_0"] / (1 + np.exp(0.3 * np.pi))
    F = tight - slack
    np.testing.assert_allclose(elements.belt(-0.5, 40.0, 0.3, np.pi), 0.5 * F)
    together = params["M"] / (params["J"] * (1 + 0.25))  # of pulley 1, per time; the other turns half as fast
    slips = F * 0.1 / (params["J"] * together / 2)  # the driven pulley needs J ω̇₂ = r₂ F
    end = slips + 0.3
    motion = jl.simulate(system, two(0.0), two(0.0), np.array([0.0, slips, end]), params, rtol=1e-10)
    np.testing.assert_allclose(motion.qdot["1"][1], together * slips**2 / 2, rtol=1e-8)
    np.testing.assert_allclose(motion.qdot["2"][-1], together * slips**2 / 4 + F * 0.1 / 0.02 * 0.3, rtol=1e-8)
    expected = together * slips**2 / 2 + (3.0 * (end**2 - slips**2) - F * 0.05 * 0.3) / 0.02
    np.testing.assert_allclose(motion.qdot["1"][-1], expected, rtol=1e-8)


def pendulum(loss):
    return jl.System(
        lambda q, qdot, m, J, g: 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2) + 0.5 * J * qdot["phi"] ** 2 - m * g * q["y"],
        dissipation=loss,
        holonomic={"pin": lambda q, l: jnp.stack([q["x"] - l * jnp.sin(q["phi"]), q["y"] + l * jnp.cos(q["phi"])])},
    )


PENDULUM = pendulum(lambda qdot, multipliers, mu, r: elements.lossy_joint(qdot["phi"], multipliers["pin"], mu, r))
BODY = {"m": 2.0, "J": 0.1, "g": 9.81, "l": 0.3, "mu": 0.3, "r": 0.05}


def swung(phi, T, unit=1.0, **changed):
    lengths = {name: BODY[name] * unit for name in ("l", "r", "g")}
    q0 = {"x": 0.3 * unit * np.sin(phi), "y": -0.3 * unit * np.cos(phi), "phi": phi}
    still = {"x": 0.0, "y": 0.0, "phi": 0.0}
    params = {**BODY, "J": BODY["J"] * unit**2, **lengths, **changed}
    return jl.simulate(PENDULUM, q0, still, np.array([0.0, T]), params, rtol=1e-10, atol=1e-12 * unit).q["phi"][-1]


def swung_by_hand(phi, T):
    """φ after a time of swinging to the left, the force in the pin solved for with the acceleration."""
    m, J, g, l, mu, r = (BODY[name] for name in ("m", "J", "g", "l", "mu", "r"))

    def acceleration(phi, omega):
        along = m * g * np.cos(phi) + m * l * omega**2
        left = lambda a: (J + m * l**2) * a + m * g * l * np.sin(phi) - mu * r * np.hypot(along, m * (l * a + g * np.sin(phi)))
        return brentq(left, -200, 200, xtol=1e-14)

    return solve_ivp(lambda t, y: [y[1], acceleration(*y)], [0, T], [phi, 0.0], rtol=1e-11, atol=1e-13).y[0, -1]


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_a_pin_that_rubs(unit):
    """At rest within the friction circle, l sin φ < μ r, and not without; and on the way."""
    edge = np.arcsin(BODY["mu"] * BODY["r"] / BODY["l"])
    assert swung(0.999 * edge, 5.0, unit) == 0.999 * edge
    assert swung(1.001 * edge, 5.0, unit) < 1.001 * edge
    np.testing.assert_allclose(swung(0.8, 0.3, unit), swung_by_hand(0.8, 0.3), rtol=1e-8)


@pytest.mark.slow
def test_derivatives_of_a_pin_that_rubs():
    of = lambda mu: swung(0.8, 1.4, mu=mu)  # with two reversals
    np.testing.assert_allclose(jax.grad(of)(0.3), (of(0.3 + 1e-5) - of(0.3 - 1e-5)) / 2e-5, rtol=1e-6)
    np.testing.assert_allclose(jax.jacfwd(of)(0.3), jax.grad(of)(0.3), rtol=1e-9)


@pytest.mark.slow
def test_any_norm_of_multipliers_is_solved_for():
    """That of NumPy has no slope where λ = 0, from where it is searched for."""
    plain = pendulum(lambda qdot, multipliers, mu, r: mu * r * jnp.linalg.norm(multipliers["pin"]) * jnp.abs(qdot["phi"]))
    q, qdot = {"x": 0.3 * np.sin(0.8), "y": -0.3 * np.cos(0.8), "phi": 0.8}, {"x": 0.3 * np.cos(0.8), "y": 0.3 * np.sin(0.8), "phi": 1.0}
    at = [jl.acceleration(of, q, qdot, BODY).qddot["phi"] for of in (plain, PENDULUM)]
    np.testing.assert_allclose(at[0], at[1], rtol=1e-12)
