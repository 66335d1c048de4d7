"""Constraints that depend on each other where they hold, and nowhere else; and states that no search brings onto constraints."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl


def circle(q, unit):
    return q @ q / unit**2 - 1


def again(q, unit):
    return (2 + jnp.cos(q[0] / unit)) * circle(q, unit)


twice = jl.System(lambda qdot: 0.5 * qdot @ qdot, holonomic={"circle": circle, "again": again})
once = jl.System(lambda qdot: 0.5 * qdot @ qdot, holonomic=circle)
UNITS = [1.0, 1e9, 1e-9]
STARTS = [(0.7, 0.8), (-0.4, 0.5)]


def nearest(q, unit):
    return jl.consistent_state(twice, q, unit * jnp.array([1.0, 2.0]), {"unit": unit})


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("start", STARTS)
def test_nearest_state_where_rows_depend_on_each_other_on_the_constraint_alone(start, unit):
    """Beside the circle, g = 0 and (2 + cos x) g = 0 hold both coordinates; on it, they are one condition, and nearest is q/|q|."""
    n = np.array(start) / np.hypot(*start)
    q, qdot = nearest(unit * np.array(start), unit)
    np.testing.assert_allclose(q / unit, n, rtol=0, atol=1e-13)
    np.testing.assert_allclose(qdot / unit, (np.eye(2) - np.outer(n, n)) @ [1.0, 2.0], rtol=0, atol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivative_of_the_nearest_state_there(mode):
    """∂(q/|q|)/∂q = (1 − n nᵀ)/|q|."""
    derivative = jax.jit(mode(lambda q, unit: nearest(q, unit)[0]))
    for unit in UNITS:
        for start in STARTS:
            r, n = np.hypot(*start), np.array(start) / np.hypot(*start)
            np.testing.assert_allclose(derivative(unit * np.array(start), unit), (np.eye(2) - np.outer(n, n)) / r, rtol=0, atol=1e-9)


@pytest.mark.parametrize("unit", UNITS)
def test_a_state_that_is_off_the_constraints_is_not_given_in_any_unit(unit):
    """x = 1.3 is held beside a circle of radius 1: no y leads onto it."""
    with pytest.raises(ValueError, match="none was found"):
        jl.consistent_state(once, jnp.array([1.3, -0.2]) * unit, jnp.zeros(2), {"unit": unit}, fixed=(0,))


def test_derivative_of_the_nearest_velocity_in_the_masses():
    """v = v₀ − M⁻¹Gᵀ (G M⁻¹ Gᵀ)⁻¹ G v₀."""
    system = jl.System(lambda qdot, M: 0.5 * jnp.sum(M * qdot**2), nonholonomic=lambda qdot: qdot[0] + 2.0 * qdot[1] - qdot[2])
    v0, G = jnp.array([0.7, -0.2, 0.4]), jnp.array([1.0, 2.0, -1.0])
    nearest = lambda M: jl.consistent_state(system, jnp.zeros(3), v0, {"M": M})[1]
    by_hand = lambda M: v0 - G / M * (G @ v0) / (G @ (G / M))
    M = jnp.array([1.0, 3.0, 0.5])
    np.testing.assert_allclose(nearest(M), by_hand(M), rtol=1e-14)
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(nearest)(M), jax.jacfwd(by_hand)(M), rtol=1e-12, atol=1e-14)


TWICE = jl.System(
    lambda q, qdot: 0.5 * jnp.sum(qdot**2) - 9.81 * jnp.sum(q[:, 1]),
    holonomic={"rods": lambda q: jnp.sum(q**2, axis=1) - 1, "again": lambda q: 3 * (q[0] @ q[0] - 1)},
)


@pytest.mark.parametrize("off", [0.0, 1e-9, 1e-6, 1e-3, 1e-2, 0.1, 0.5, 1.0, 9.0])
def test_an_acceleration_however_far_off_the_constraints(off):
    """Two rods, one of them given twice: q·q̈ = −v·v at any q, with q̈ = −g e_y + λ q."""
    q, v = (1 + off) * np.array([[0.6, 0.8], [-1.0, 0.0]]), np.array([[0.3, -0.5], [0.2, 0.9]])
    down = np.array([0.0, -9.81])
    expected = [down - (w @ w + down @ x) / (x @ x) * x for x, w in zip(q, v, strict=True)]
    np.testing.assert_allclose(jl.acceleration(TWICE, jnp.asarray(q), jnp.asarray(v)).qddot, expected, rtol=1e-12, atol=1e-12)
