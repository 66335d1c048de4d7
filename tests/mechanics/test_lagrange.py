"""Lagrange's equations against equations derived by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import jaxlag as jl
from jaxlag.examples import pendulum, vehicle


def vehicle_by_hand(q, qdot, p):
    """The lecture's three equations of motion, solved for the accelerations."""
    wind = qdot["x"] + p["v"]
    return {
        "x": (p["M0"] / p["r"] - p["k"] * abs(wind) * wind) / (p["M"] + 2 * p["m"] + 2 * p["Theta_r"] / p["r"] ** 2),
        "y": -p["g"] - (2 * p["c"] * (q["y"] - p["l"]) + 2 * p["b"] * qdot["y"]) / p["M"],
        "phi": -(2 * p["c"] * p["a"] ** 2 * q["phi"] + 2 * p["b"] * p["a"] ** 2 * qdot["phi"]) / p["Theta_s"],
    }


@pytest.mark.fast
def test_vehicle_has_the_equations_of_the_lecture():
    rng = np.random.default_rng(1)
    draw = lambda size: {k: rng.normal(0, size, 1000) for k in ("x", "y", "phi")}
    q, qdot = draw(1.0), draw(10.0)
    params = {k: v * rng.uniform(0.5, 2, 1000) for k, v in vehicle.params.items()}
    found = jax.vmap(lambda q, v, p: jl.acceleration(vehicle.system, q, v, p).qddot)(q, qdot, params)
    expected = vehicle_by_hand(q, qdot, params)
    for name in expected:
        scale = np.max(np.abs(expected[name]))
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-12, atol=1e-12 * scale)


@pytest.mark.fast
def test_pendulum_has_the_equations_of_the_lecture():
    rng = np.random.default_rng(2)
    for _ in range(20):
        p = {"m": rng.uniform(0.5, 2), "l": rng.uniform(0.5, 2), "g": 9.81}
        phi, phidot = rng.normal(0, 2, 2)
        qddot, multipliers = jl.acceleration(pendulum.polar, *pendulum.polar_state(phi, phidot, p["l"]), p)
        rod_force = -p["m"] * p["l"] * phidot**2 - p["m"] * p["g"] * np.cos(phi)
        np.testing.assert_allclose(qddot["phi"], -p["g"] / p["l"] * np.sin(phi), rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(qddot["r"], 0, atol=1e-12)
        np.testing.assert_allclose(multipliers["rod"], rod_force, rtol=1e-12)
        in_xy = jl.acceleration(pendulum.cartesian, *pendulum.cartesian_state(phi, phidot, p["l"]), p)
        np.testing.assert_allclose(in_xy.multipliers["rod"], rod_force, rtol=1e-12)


def moving_charge(t, q, qdot, m, B):
    """A particle in a magnetic field and on a table that is shaken: gyroscopic terms and explicit time."""
    x, y = q["r"]
    vx, vy = qdot["r"]
    return 0.5 * m * (1 + t**2) * (vx**2 + vy**2) + 0.5 * B * (x * vy - y * vx) + jnp.cos(3 * t) * x * vx + 0.25 * m * qdot["s"] ** 2


@pytest.mark.fast
def test_every_term_of_the_force_against_a_derivation_by_hand():
    t, m, B = 0.7, 1.3, 2.1
    q, qdot = {"r": jnp.array([0.4, -0.8]), "s": jnp.array(0.1)}, {"r": jnp.array([1.5, 0.3]), "s": jnp.array(-2.0)}
    system = jl.System(
        moving_charge,
        dissipation=lambda t, q, qdot, b: 0.5 * b * (1 + q["s"] ** 2) * jnp.sum(qdot["r"] ** 2) * t,
        force={"push": lambda t: {"s": jnp.sin(t)}, "pull": lambda q: {"r": -q["r"]}},
    )
    params = {"m": m, "B": B, "b": 0.4}
    (x, y), (vx, vy) = q["r"], qdot["r"]
    M, damping = m * (1 + t**2), 0.4 * (1 + 0.01) * t
    shake = -3 * np.sin(3 * t) * x  # d/dt(cos(3t) x) − cos(3t) ẋ
    fx = B * vy - 2 * m * t * vx - shake - damping * vx - x
    fy = -B * vx - 2 * m * t * vy - damping * vy - y
    found = jl.acceleration(system, q, qdot, params, t=t).qddot
    np.testing.assert_allclose(found["r"], [fx / M, fy / M], rtol=1e-13)
    np.testing.assert_allclose(found["s"], np.sin(t) / (0.5 * m), rtol=1e-13)


@pytest.mark.fast
def test_mass_matrix_momentum_and_energy():
    q, qdot = pendulum.polar_state(0.4, 1.7, 0.8)
    p = {"m": 1.5, "l": 0.8, "g": 9.81}
    np.testing.assert_allclose(jl.mass_matrix(pendulum.polar, q, qdot, p), np.diag([1.5 * 0.64, 1.5]), rtol=1e-14)  # order: phi, r
    assert ravel_pytree(q)[0][0] == q["phi"]
    np.testing.assert_allclose(jl.momentum(pendulum.polar, q, qdot, p)["phi"], 1.5 * 0.64 * 1.7, rtol=1e-14)
    by_hand = 0.5 * 1.5 * 0.64 * 1.7**2 - 1.5 * 9.81 * 0.8 * np.cos(0.4)
    np.testing.assert_allclose(jl.energy(pendulum.polar, q, qdot, p), by_hand, rtol=1e-14)


@pytest.mark.fast
def test_constraint_functions_of_moving_and_rolling_constraints():
    system = jl.System(
        lambda qdot: 0.5 * qdot @ qdot,
        holonomic={"wall": lambda t, q: q[0] - jnp.sin(t), "rod": lambda q: jnp.stack([q @ q - 1])},
        nonholonomic={"edge": lambda t, q, qdot: qdot[0] * q[1] - t * qdot[1] + 2.0},
    )
    q, v, t = jnp.array([0.6, 0.9]), jnp.array([0.2, -0.5]), 0.3
    np.testing.assert_allclose(jl.constraint_jacobian(system, q, v, t=t), [[1, 0], [1.2, 1.8], [0.9, -0.3]], rtol=1e-14)
    position, velocity = jl.constraint_residual(system, q, v, t=t)
    np.testing.assert_allclose(position["wall"], 0.6 - np.sin(0.3), rtol=1e-14)
    np.testing.assert_allclose(position["rod"], [0.36 + 0.81 - 1], rtol=1e-13)
    assert set(position) == {"wall", "rod"}
    np.testing.assert_allclose(velocity["wall"], 0.2 - np.cos(0.3), rtol=1e-14)
    np.testing.assert_allclose(velocity["rod"], [2 * (0.6 * 0.2 - 0.9 * 0.5)], rtol=1e-14)
    np.testing.assert_allclose(velocity["edge"], 0.2 * 0.9 + 0.3 * 0.5 + 2, rtol=1e-14)


@pytest.mark.fast
def test_drive_force_of_a_prescribed_motion():
    """m ẍ = λ with x = sin(3t): the multiplier is the drive force −9 m sin(3t)."""
    system = jl.System(lambda qdot, m: 0.5 * m * qdot**2, holonomic={"drive": lambda t, q: q - jnp.sin(3 * t)})
    for t in (0.0, 0.4, 1.3):
        found = jl.acceleration(system, np.sin(3 * t), 3 * np.cos(3 * t), {"m": 2.0}, t=t)
        np.testing.assert_allclose(found.multipliers["drive"], -18 * np.sin(3 * t), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("function", [jl.mass_matrix, jl.momentum, jl.energy, jl.acceleration, jl.constraint_residual, jl.constraint_force])
def test_functions_of_a_state_have_right_gradients(function):
    q, qdot = pendulum.cartesian_state(0.5, 1.2, 1.1)

    def number(x):
        state = {"x": q["x"] + x[0], "y": q["y"]}, {"x": qdot["x"] + x[1], "y": qdot["y"]}
        out = function(pendulum.cartesian, *state, {"m": 1.0 + x[2], "l": 1.1 + x[3], "g": 9.81 + x[4]})
        return jnp.sum(jnp.stack([jnp.sum(leaf * (i + 1)) for i, leaf in enumerate(jax.tree.leaves(out))]))

    x, h = jnp.zeros(5), 1e-5
    forward, reverse = jax.jacfwd(number)(x), jax.grad(number)(x)
    differences = [(number(x.at[i].set(h)) - number(x.at[i].set(-h))) / (2 * h) for i in range(5)]
    np.testing.assert_allclose(forward, differences, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(reverse, forward, rtol=1e-12, atol=1e-12)
