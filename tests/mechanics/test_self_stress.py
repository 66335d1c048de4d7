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


def wedge_energy(q, qdot, m, M):
    pushed, lifted = qdot["X"] ** 2 + qdot["Y"] ** 2, qdot["x"] ** 2 + qdot["y"] ** 2
    return 0.5 * (M * pushed + m * lifted) - G * (M * q["Y"] + m * q["y"])


def on_the_face(qdot, multipliers, mu, slope):
    x, y = qdot["x"] - qdot["X"], qdot["y"] - qdot["Y"]
    return mu * jnp.abs(multipliers["face"]) * jnp.abs(x * jnp.cos(slope) - y * jnp.sin(slope))


wedge = jl.System(
    wedge_energy,
    dissipation={
        "on the floor": lambda qdot, multipliers, mu: mu * jnp.abs(multipliers["floor"]) * jnp.abs(qdot["X"]),
        "at the wall": lambda qdot, multipliers, mu: mu * jnp.abs(multipliers["wall"]) * jnp.abs(qdot["y"]),
        "on the face": on_the_face,
    },
    force=lambda t, rate, begin: {"X": rate * (t - begin)},
    holonomic={
        "floor": lambda q: q["Y"],
        "wall": lambda q: q["x"],
        "face": lambda q, slope: (q["x"] - q["X"]) * jnp.sin(slope) + (q["y"] - q["Y"]) * jnp.cos(slope),
    },
)


@pytest.mark.slow
def test_a_wedge_lifts_a_load():
    """From μ M g + m g tan(α + 2φ) on, μ = tan φ, and then with ẍ = (P − P₀) / (M + m tan α tan(α + 2φ)); a steep one is driven out below
    m g tan(α − 2φ) − μ M g. The clock is late.
    """
    m, M, slope, rate, begin = 3.0, 2.0, 0.2, 10.0, 1e6
    still = dict.fromkeys("XYxy", 0.0)
    numbers = {"m": m, "M": M, "slope": slope, "rate": rate, "begin": begin}
    lifts = lambda mu: mu * M * G + m * G * jnp.tan(slope + 2 * jnp.arctan(mu))
    falls = lambda mu: m * G * jnp.tan(slope - 2 * jnp.arctan(mu)) - mu * M * G

    def x_at(mu, P):
        return float(jl.acceleration(wedge, still, still, numbers | {"mu": mu}, t=begin + P / rate).qddot["X"])

    for mu in (0.05, 0.2):
        assert x_at(mu, lifts(mu) - 1e-3) < 1e-9 < x_at(mu, lifts(mu) + 1e-3)
    assert x_at(0.05, falls(0.05) - 1e-3) < -1e-9 < x_at(0.05, falls(0.05) + 1e-3)

    def exact(mu):
        late = 5.0 - lifts(mu) / rate
        return rate * late**3 / 6 / (M + m * jnp.tan(slope) * jnp.tan(slope + 2 * jnp.arctan(mu)))

    lifted = lambda mu: jl.simulate(wedge, still, still, begin + np.array([0.0, 5.0]), numbers | {"mu": mu}).q["X"][-1]
    height, slope_of = jax.value_and_grad(lifted)(0.2)
    np.testing.assert_allclose(height, exact(0.2), rtol=1e-8)
    np.testing.assert_allclose(slope_of, jax.grad(exact)(0.2), rtol=1e-7)


def beside(side, name):
    return lambda qdot, multipliers, mu, wide: mu * jnp.abs(multipliers[name]) * jnp.abs(qdot["x"] - side * wide * qdot["phi"])


drawer = jl.System(
    lambda qdot, m, J: 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2) + 0.5 * J * qdot["phi"] ** 2,
    dissipation={"beside the front": beside(1.0, "front"), "beside the rear": beside(-1.0, "rear")},
    force=lambda t, rate, begin, e: {"x": rate * (t - begin), "phi": -rate * (t - begin) * e},
    holonomic={
        "front": lambda q, long: q["y"] + long / 2 * q["phi"],
        "rear": lambda q, long: q["y"] - long / 2 * q["phi"],
    },
)


@pytest.mark.slow
def test_a_drawer_jams():
    """Pulled so far beside its middle that 2 μ e > l, whatever the force: it stays, and stops where it was in motion. In millimetres."""
    mu, m, rate, long, begin, end = 0.3, 4.0, 5.0, 500.0, 1e6, 3.0
    numbers = {"m": m, "J": 2e5, "wide": 400.0, "rate": rate, "long": long, "begin": begin}
    still = {"x": 0.0, "y": 0.0, "phi": 0.0}

    def x(mu, e, v=0.0, end=end):
        given = numbers | {"mu": mu, "e": e}
        return jl.simulate(drawer, still, still | {"x": v}, begin + np.array([0.0, end]), given).q["x"][-1]

    np.testing.assert_allclose(x(mu, 700.0), rate * (1 - 2 * mu * 700 / long) / m * end**3 / 6, rtol=1e-9)
    np.testing.assert_allclose(x(mu, 850.0), 0, atol=1e-9)
    stops = lambda mu, e, v: 2 / 3 * v * jnp.sqrt(2 * v * m / (rate * (2 * mu * e / long - 1)))  # after √(2 v m / rate (2 μ e / l − 1))
    far, slope_of = jax.value_and_grad(x)(0.4, 900.0, 2.0)
    np.testing.assert_allclose(far, stops(0.4, 900.0, 2.0), rtol=1e-8)
    np.testing.assert_allclose(slope_of, jax.grad(stops)(0.4, 900.0, 2.0), rtol=1e-7)


def face(side, name):
    def D(qdot, multipliers, mu, slope):
        slip = jnp.stack([qdot["x"], qdot["y"] * jnp.cos(slope) - side * qdot["z"] * jnp.sin(slope)])
        return mu * jnp.abs(multipliers[name]) * jl.dissipation.speed(slip)

    return D


trough = jl.System(
    lambda q, qdot, m: 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2 + qdot["z"] ** 2) - m * G * q["z"],
    dissipation={"on the left": face(1.0, "left"), "on the right": face(-1.0, "right")},
    force=lambda t, rate: {"x": rate * t},
    holonomic={
        "left": lambda q, slope: q["y"] * jnp.sin(slope) + q["z"] * jnp.cos(slope),
        "right": lambda q, slope: q["z"] * jnp.cos(slope) - q["y"] * jnp.sin(slope),
    },
)


@pytest.mark.slow
def test_a_block_in_a_trough():
    """Planar friction of both sides, whose normal forces decide it: pulled along, it moves from P = μ m g / cos α on. It was said that its
    constraints contradict each other: across the trough they hold it alone, and what rounding left there counted as a contradiction.
    """
    m, mu, slope, rate, end = 2.0, 0.4, 0.6, 5.0, 3.0
    still, numbers = dict.fromkeys("xyz", 0.0), {"m": m, "slope": slope, "rate": rate}
    limit = lambda mu: mu * m * G / np.cos(slope)
    for P in (0.0, limit(mu) - 1e-6):
        assert abs(jl.acceleration(trough, still, still, numbers | {"mu": mu}, t=P / rate).qddot["x"]) < 1e-12
    along = lambda mu: jl.simulate(trough, still, still, np.array([0.0, end]), numbers | {"mu": mu}).q["x"][-1]
    exact = lambda mu: rate * (end - limit(mu) / rate) ** 3 / 6 / m
    far, slope_of = jax.value_and_grad(along)(mu)
    np.testing.assert_allclose(far, exact(mu), rtol=1e-8)
    np.testing.assert_allclose(slope_of, jax.grad(exact)(mu), rtol=1e-7)


@pytest.mark.slow
def test_grasps_of_a_batch_are_those_of_each():
    """A thousand loads at a time: on a CPU one after the other, on threads that do not wait for each other."""
    normal, tangential, _, mu = grasp(np.random.default_rng(3))
    elements, k = FrictionElements(lambda t, q, v: v, {}, np.arange(len(mu)), {}), len(mu)
    effect, there = jnp.concatenate([normal, tangential]), jnp.ones(2 * k, bool)
    share = lambda given: best_share(elements, effect, given, lambda x: mu * x[:k], there, 4)
    given = np.random.default_rng(4).normal(size=(1000, 2 * k))
    for of_batch, of_each in zip(jax.jit(jax.vmap(share))(given), jax.lax.map(share, given), strict=True):
        np.testing.assert_allclose(of_batch, of_each, rtol=1e-9, atol=1e-9)
