"""Gears: friction that grows with the force that the teeth transmit, and play between them, against formulas derived by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

PARAMS = {"J": 4e-4, "m": 50.0, "r": 0.1, "n": 60.0, "g": 9.81, "mu": 0.4}  # SI; J n²/(m r²) = 2.88
KAPPA = 2.88
REST = {"phi": 0.0, "y": 0.0}, {"phi": 0.0, "y": 0.0}


def lagrangian(q, qdot, J, m, g):
    return 0.5 * J * qdot["phi"] ** 2 + 0.5 * m * qdot["y"] ** 2 - m * g * q["y"]


def worm(qdot, multipliers, mu):
    return mu * jnp.abs(multipliers["gear"]) * jnp.abs(qdot["phi"])


def gear(q, r, n):
    return q["phi"] - n * q["y"] / r


winch = jl.System(lagrangian, dissipation={"worm": worm}, holonomic={"gear": gear})


def falls_with(mu):
    return jl.acceleration(winch, *REST, PARAMS | {"mu": mu}).qddot["y"]


def test_a_load_drives_its_worm_gear_backwards_or_is_locked():
    """m ÿ = −m g + λ n/r and J φ̈ = −(1 − μ) λ: ÿ = −g/(1 + κ/(1 − μ)), and none from μ = 1 on."""
    mu = np.array([0.0, 0.2, 0.4, 0.8, 0.99, 1.01, 1.5])
    by_hand = np.where(mu < 1, -9.81 / (1 + KAPPA / np.where(mu < 1, 1 - mu, 1)), 0.0)
    np.testing.assert_allclose(jax.vmap(falls_with)(mu), by_hand, rtol=1e-12, atol=1e-13)
    slope = np.where(mu < 1, 9.81 * KAPPA / (1 - mu + KAPPA) ** 2, 0.0)
    for mode in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(jax.vmap(mode(falls_with))(mu), slope, rtol=1e-11, atol=1e-13)


driven = jl.System(lagrangian, dissipation={"worm": worm}, holonomic={"gear": gear, "motor": lambda t, q, W: q["phi"] - W * t})


def test_a_worm_gear_on_paper():
    """The moment of the motor has a formula, |λ| and the sign of the rate in it."""
    params = PARAMS | {"W": -10.0}
    e = jl.equations(driven, {"phi", "y"}, params)
    at = {e.params[name]: value for name, value in params.items()}
    np.testing.assert_allclose(float(e.multipliers["motor"].subs(at)), (1 - 0.4) * 50.0 * 9.81 * 0.1 / 60, rtol=1e-14)


@pytest.mark.slow
def test_efficiency_of_a_worm_gear():
    """The motor supplies (1 ± μ) m g r/n, up and down; from μ = 1 on it pushes downwards, too."""
    for mu in (0.4, 1.2):
        for W in (10.0, -10.0):
            motion = jl.simulate(driven, *REST, jnp.array([0.0, 2.0]), PARAMS | {"mu": mu, "W": W}, works=True)
            moment = (1 + mu * np.sign(W)) * 50.0 * 9.81 * 0.1 / 60
            np.testing.assert_allclose(motion.multipliers["motor"], moment, rtol=1e-9)
            np.testing.assert_allclose(motion.work()["motor"][-1], moment * W * 2.0, rtol=1e-9)
            np.testing.assert_allclose(motion.work()["worm"][-1], -mu * 50.0 * 9.81 * 0.1 / 60 * 20.0, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("metre", "second", "kilogram", "t0"), [(1.0, 1.0, 1.0, 0.0), (1e9, 1e-6, 1e3, 1e9), (1e-3, 1e3, 1e-6, 0.0)])
def test_a_locked_worm_holds_its_load(metre, second, kilogram, t0):
    """In any units, from a height that is not zero; and that its friction did no work balances."""
    units = {"J": kilogram * metre**2, "m": kilogram, "r": metre, "g": metre / second**2, "n": 1.0, "mu": 1.0}
    params = {name: value * units[name] for name, value in (PARAMS | {"mu": 1.1}).items()}
    start = {"phi": 60.0, "y": 0.1 * metre}, REST[1]
    motion = jl.simulate(winch, *start, t0 + jnp.array([0.0, 1.0, 3600.0]) * second, params, works=True)
    assert np.all(motion.friction["worm"].sticking)
    np.testing.assert_allclose(motion.q["y"], 0.1 * metre, rtol=1e-14)
    assert np.max(np.abs(motion.balance())) < 1e-3  # of the rounding of its energy


def together_and_apart(times, J, I, play, e, u):
    """The motor's angle: with the load until 0.2, flights between impacts while it reverses, and with the load on the other flank."""
    angle = 0.5 * u / (J + I) * times**2
    t, phi, rate, w, gap = 0.2, 0.5 * u / (J + I) * 0.04, u / (J + I) * 0.2, 0.0, play
    for _ in range(60):
        arrives = np.sqrt(w**2 + 2 * u / J * gap)
        flight = (w + arrives) * J / u
        angle = np.where(times >= t, phi + rate * (times - t) - 0.5 * u / J * (times - t) ** 2, angle)
        phi, rate = phi + rate * flight - 0.5 * u / J * flight**2, rate - u / J * flight + (1 + e) * arrives * I / (J + I)
        t, w, gap = t + flight, e * arrives, 0.0
    return np.where(times >= t, phi + rate * (times - t) - 0.5 * u / (J + I) * (times - t) ** 2, angle)


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1.0, 1e-9])
def test_a_reversal_through_the_play_of_a_gear(unit):
    """Infinitely many impacts end at t₁ (1 + e)/(1 − e), t₁ = √(2 β J/u); angles in any `unit`."""
    flanks = {
        "front": jl.Contact(lambda q: q[1] - q[0], restitution=lambda e: e),
        "back": jl.Contact(lambda q, play: play + q[0] - q[1], restitution=lambda e: e),
    }
    drive = jl.System(
        lambda qdot, J, I: 0.5 * J * qdot[0] ** 2 + 0.5 * I * qdot[1] ** 2,
        force=lambda t, u: jnp.stack([u(t), 0.0]),
        unilateral=flanks,
    )
    params = {"J": 2e-3, "I": 6e-3, "play": 0.02 * unit, "e": 0.4, "u": jl.Signal([0.0, 0.2], np.array([0.1, -0.1]) * unit)}
    ts = jnp.linspace(0.0, 0.4, 41)

    def after(play):
        return jl.simulate(drive, np.zeros(2), np.zeros(2), ts, params | {"play": play})

    motion = after(0.02 * unit)
    np.testing.assert_allclose(motion.q[:, 0], together_and_apart(np.asarray(ts), 2e-3, 6e-3, 0.02, 0.4, 0.1) * unit, atol=1e-12 * unit)
    ends = np.sqrt(2 * 0.02 * 2e-3 / 0.1) * 1.4 / 0.6
    np.testing.assert_allclose(motion.contacts["back"].changed[-1], 0.2 + ends, rtol=1e-10)
    slope = jax.grad(lambda play: after(play).contacts["back"].changed[-1])(0.02 * unit)
    np.testing.assert_allclose(slope, ends / (2 * 0.02 * unit), rtol=1e-8)
