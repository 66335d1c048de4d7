"""Rest where normal forces and friction hold each other: which shares of a load are admissible, against statics and linear programs."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

import jaxlag as jl
from jaxlag._mechanics.friction_elements import FrictionElements
from jaxlag._mechanics.load_sharing import best_share

G = 9.81
MOST = 4  # contacts of a grasp


def grasp(rng):
    """A body in the plane held at some points: rows of normal and of friction forces, a load, coefficients of friction."""
    k = rng.integers(2, MOST + 1)
    p, angle = rng.uniform(-1, 1, (k, 2)), rng.uniform(0, 2 * np.pi, k)
    n = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rows = lambda d: np.concatenate([d, (p[:, 0] * d[:, 1] - p[:, 1] * d[:, 0])[:, None]], axis=1)
    return rows(n), rows(np.stack([-n[:, 1], n[:, 0]], axis=1)), rng.normal(size=3), rng.uniform(0.05, 1, k)


def most_left(normal, tangential, load, mu, signs):
    """max s, at most 1, such that |τ| ≤ μ σ N − s and σ N ≥ 0 hold the load, for one of the signs σ; None where it cannot be held."""
    k, best = len(mu), None
    of_N, of_tau, one = np.eye(2 * k)[:k], np.eye(2 * k)[k:], np.ones((k, 1))
    for sign in signs:
        rows = [np.concatenate([-mu[:, None] * np.array(sign)[:, None] * of_N + side * of_tau, one], axis=1) for side in (1, -1)]
        held = np.concatenate([np.concatenate([normal, tangential]).T, np.zeros((3, 1))], axis=1)
        found = linprog(
            np.eye(2 * k + 1)[-1] * -1, np.concatenate(rows), np.zeros(2 * k), held, -load, [(None, None)] * 2 * k + [(-1e9, 1)]
        )
        best = best if found.status else max(-np.inf if best is None else best, -found.fun)
    return best


@pytest.mark.parametrize("pushes", [True, False])
def test_random_grasps_hold_where_a_linear_program_finds_a_share(pushes):
    """Contacts that push, and rails that push and pull, whose bounds μ|N| are not concave: all signs are tried."""
    bounds = lambda N, mu: mu * (N if pushes else jnp.abs(N))
    elements = FrictionElements(lambda t, q, v: v, {}, np.arange(MOST), {})

    @jax.jit
    def share(effect, given, mu):
        there = jnp.concatenate([jnp.full(MOST, pushes), jnp.ones(MOST, bool)])
        return best_share(elements, effect, given, lambda x: bounds(x[:MOST], mu), there, 4).multipliers

    rng, verdicts = np.random.default_rng(1), []
    padded = lambda *parts: np.concatenate([np.pad(x, [(0, MOST - len(x))] + [(0, 0)] * (x.ndim - 1)) for x in parts])
    for _ in range(60):
        normal, tangential, load, mu = grasp(rng)
        k = len(mu)
        left = most_left(normal, tangential, load, mu, [(1,) * k] if pushes else itertools.product((1, -1), repeat=k))
        if left is None or abs(left) < 1e-6:
            continue
        effect = padded(normal, tangential)
        given = np.linalg.lstsq(np.concatenate([normal, tangential]).T, -load, rcond=None)[0]
        found = np.asarray(share(effect, padded(given[:k], given[k:]), padded(mu)))
        np.testing.assert_allclose(effect.T @ found, -load, atol=1e-9)
        N, tau = np.split(found, 2)
        admissible = np.all(np.abs(tau) <= bounds(N, padded(mu)) + 1e-9) and (not pushes or np.min(N) > -1e-9)
        assert admissible == (left > 0)
        verdicts.append(admissible)
    assert 15 < sum(verdicts) < len(verdicts) - 5


def ladder_energy(q, qdot):
    return 0.5 * (qdot["x"] ** 2 + qdot["y"] ** 2 + qdot["phi"] ** 2 / 3) - G * q["y"]


ladder = jl.System(
    ladder_energy,
    dissipation={
        "on the floor": lambda q, qdot, multipliers, mu: (
            mu * jnp.abs(multipliers["floor"]) * jnp.abs(qdot["x"] - jnp.sin(q["phi"]) * qdot["phi"])
        ),
        "at the wall": lambda q, qdot, multipliers, mu: (
            mu * jnp.abs(multipliers["wall"]) * jnp.abs(qdot["y"] + jnp.cos(q["phi"]) * qdot["phi"])
        ),
    },
    holonomic={"floor": lambda q: q["y"] - jnp.sin(q["phi"]), "wall": lambda q: q["x"] - jnp.cos(q["phi"])},
)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_ladder_stands_where_statics_lets_it(dtype):
    """Between a rough floor and a rough wall, as steep as tan φ ≥ (1 − μ²)/2μ. It was Painlevé's paradox at every angle."""
    mu = 0.3
    limit = np.arctan((1 - mu**2) / (2 * mu))
    zero = {"x": dtype(0), "y": dtype(0), "phi": dtype(0)}
    for phi, stands in ((limit + 1e-3, True), (limit + 0.2, True), (limit - 1e-3, False)):
        q = {"x": dtype(np.cos(phi)), "y": dtype(np.sin(phi)), "phi": dtype(phi)}
        found = jl.acceleration(ladder, q, zero, {"mu": dtype(mu)})
        assert (abs(float(found.qddot["phi"])) < 1e-5) == stands


def groove_wall(side):
    return lambda q, slope: side * q["x"] * jnp.sin(slope) + q["y"] * jnp.cos(slope) - 1


def rubbing(side, name):
    def D(qdot, multipliers, mu, slope):
        return mu * jnp.abs(multipliers[name]) * jnp.abs(qdot["x"] * jnp.cos(slope) - side * qdot["y"] * jnp.sin(slope) + qdot["phi"])

    return D


disc = jl.System(
    lambda q, qdot: 0.5 * (qdot["x"] ** 2 + qdot["y"] ** 2 + 0.5 * qdot["phi"] ** 2) - G * q["y"],
    dissipation={"rubbing left": rubbing(1.0, "left"), "rubbing right": rubbing(-1.0, "right")},
    force=lambda t, torque: {"phi": torque * t},
    holonomic={"left": groove_wall(1.0), "right": groove_wall(-1.0)},
)


@pytest.mark.slow
def test_a_disc_in_a_rough_groove():
    """It breaks away at the torque T₁ = μ m g / ((1 + μ²) cos α), from the centre of a groove of slope α, and stops where it spun down.

    Both walls then rub: φ = T (t − t₁)³ / 6J. All of it was Painlevé's paradox; the gradient by closed form.
    """
    mu, slope, rate, end = 0.3, 0.7, 2.0, 2.5
    q0, still = {"x": 0.0, "y": 1 / np.cos(slope), "phi": 0.0}, {"x": 0.0, "y": 0.0, "phi": 0.0}
    limit = lambda mu: mu * G / ((1 + mu**2) * np.cos(slope))
    exact = lambda mu: rate / 0.5 * (end - limit(mu) / rate) ** 3 / 6
    at_end = lambda mu: jl.simulate(disc, q0, still, [0.0, end], {"mu": mu, "slope": slope, "torque": rate}).q["phi"][-1]
    np.testing.assert_allclose(at_end(mu), exact(mu), rtol=1e-7)
    slope_of = (exact(mu + 1e-5) - exact(mu - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.grad(at_end)(mu), slope_of, rtol=1e-6)
    np.testing.assert_allclose(jax.jvp(at_end, (mu,), (1.0,))[1], slope_of, rtol=1e-6)
    spun = jl.simulate(disc, q0, still | {"phi": 3.0}, [0.0, 5.0], {"mu": mu, "slope": slope, "torque": 0.0})
    np.testing.assert_allclose(spun.q["phi"][-1], 3.0**2 * 0.5 / (2 * limit(mu)), rtol=1e-8)


ANGLES = 2 * np.pi * np.arange(12) / 12
RING = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)


def ring_slips(q, qdot):
    c, s = jnp.cos(q[2]), jnp.sin(q[2])
    x, y = c * RING[:, 0] - s * RING[:, 1], s * RING[:, 0] + c * RING[:, 1]
    return jnp.stack([qdot[0] - qdot[2] * y, qdot[1] + qdot[2] * x], axis=1)


ring = jl.System(lambda qdot: 0.5 * qdot @ qdot, dissipation=lambda q, qdot: 0.1 * jnp.sum(jnp.linalg.norm(ring_slips(q, qdot), axis=1)))


@pytest.mark.slow
@pytest.mark.parametrize("speed", [[0.0, 0.0, 3.0], [1.0, 0.0, 0.0]])
def test_a_ring_of_twelve_points_stops_with_all_of_them(speed):
    """After v²/2a, a = 12 · 0.1. What is left of the velocities when all stop was taken for belts that move apart: Painlevé's paradox."""
    motion = jl.simulate(ring, np.zeros(3), np.array(speed), [0.0, 5.0])
    np.testing.assert_allclose(motion.q[-1], np.array(speed) ** 2 / 2.4, rtol=1e-7, atol=1e-12)


def test_grasps_of_a_batch_are_those_of_each():
    """A thousand loads at a time: on a CPU one after the other, on threads that do not wait for each other."""
    normal, tangential, _, mu = grasp(np.random.default_rng(3))
    elements, k = FrictionElements(lambda t, q, v: v, {}, np.arange(len(mu)), {}), len(mu)
    effect, there = jnp.concatenate([normal, tangential]), jnp.ones(2 * k, bool)
    share = lambda given: best_share(elements, effect, given, lambda x: mu * x[:k], there, 4)
    given = np.random.default_rng(4).normal(size=(1000, 2 * k))
    for of_batch, of_each in zip(jax.jit(jax.vmap(share))(given), jax.lax.map(share, given), strict=True):
        np.testing.assert_allclose(of_batch, of_each, rtol=1e-9, atol=1e-9)
