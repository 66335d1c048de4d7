"""Motions of chains in joint angles, in which every number of M is there, against SciPy and closed forms by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxlag as jl

LINKS, GRAVITY = 80, 9.81
RNG = np.random.default_rng(5)
PARAMS = {"m": RNG.uniform(0.5, 2.0, LINKS), "l": RNG.uniform(0.8, 1.2, LINKS), "b": 0.4, "g": GRAVITY}
START = np.linspace(0.3, 1.4, LINKS)
TS = np.linspace(0.0, 1.0, 6)


def lagrangian(q, qdot, m, l, g):
    vx, vy = jnp.cumsum(l * jnp.cos(q) * qdot), jnp.cumsum(l * jnp.sin(q) * qdot)
    return jnp.sum(0.5 * m * (vx**2 + vy**2) + m * g * jnp.cumsum(l * jnp.cos(q)))


CHAIN = jl.System(lagrangian, dissipation={"joints": lambda qdot, b: 0.5 * b * jnp.sum(jnp.diff(qdot) ** 2)})


def by_hand(q, v, given):
    """q̈ by M of m_ij l_i l_j cos(φ_i − φ_j), m_ij the mass beyond both links."""
    m, l, b = given["m"], given["l"], given["b"]
    beyond, i = np.cumsum(m[::-1])[::-1], np.arange(q.size)
    shared, turn = beyond[np.maximum(i[:, None], i)] * np.outer(l, l), q[:, None] - q
    between = b * np.diff(v, prepend=v[0], append=v[-1])
    force = -(shared * np.sin(turn)) @ v**2 - beyond * l * given["g"] * np.sin(q) + between[1:] - between[:-1]
    return np.linalg.solve(shared * np.cos(turn), force)


@pytest.fixture(scope="module")
def motion():
    return jl.simulate(CHAIN, START, np.zeros(LINKS), TS, PARAMS, rtol=1e-9, atol=1e-9, works=True)


@pytest.mark.slow
def test_motion_is_that_of_scipy(motion):
    field = lambda t, y: np.append(y[LINKS:], by_hand(y[:LINKS], y[LINKS:], PARAMS))
    expected = solve_ivp(field, (0, 1), np.append(START, np.zeros(LINKS)), "DOP853", TS, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(np.asarray(motion.q), expected.y.T[:, :LINKS], atol=2e-7)
    np.testing.assert_allclose(motion.qddot[-1], by_hand(*np.split(expected.y[:, -1], 2), PARAMS), atol=1e-4)


@pytest.mark.slow
def test_energy_is_accounted_for(motion):
    assert np.max(np.abs(motion.balance())) < 1e-8


@pytest.mark.slow
def test_derivatives_in_each_link():
    """Reverse gives 2 n derivatives at once; forward and differences along one direction of all of them."""
    params = jax.tree.map(jnp.asarray, PARAMS)
    along = {"m": RNG.normal(size=LINKS), "l": 0.1 * RNG.normal(size=LINKS), "b": 0.2, "g": 1.0}
    end = lambda params: jl.simulate(CHAIN, START, np.zeros(LINKS), TS[:3], params, rtol=1e-9, atol=1e-9).q[-1, -1]
    moved = lambda h: end(jax.tree.map(lambda x, d: x + h * d, params, along))
    forward, gradient = jax.jvp(end, (params,), (jax.tree.map(jnp.asarray, along),))[1], jax.grad(end)(params)
    reverse = sum(jnp.sum(gradient[name] * along[name]) for name in along)
    h = 1e-4
    differences = (8 * (moved(h) - moved(-h)) - (moved(2 * h) - moved(-2 * h))) / (12 * h)
    np.testing.assert_allclose([forward, reverse], differences, rtol=1e-5)


@pytest.mark.slow
def test_a_chain_between_two_hooks_in_angles():
    """Its end held: off the hook by a tenth of a link at first, put on it, and there to rounding ever after."""
    end = lambda q, l: jnp.stack([jnp.sum(l * jnp.sin(q)), -jnp.sum(l * jnp.cos(q))]) - jnp.array([17.3, -36.3])
    held = jl.System(lagrangian, holonomic={"hook": end})
    given = {name: PARAMS[name] for name in "mlg"}
    angles = np.linspace(-1.4, 2.3, LINKS)
    q, v = jl.consistent_state(held, angles, np.zeros(LINKS), given)
    l = PARAMS["l"]
    np.testing.assert_allclose([l @ np.sin(q), -l @ np.cos(q)], [17.3, -36.3], atol=1e-10)
    found = jl.simulate(held, q, v, TS[:3], given, rtol=1e-9, atol=1e-9, works=True)
    q = np.asarray(found.q)
    np.testing.assert_allclose(np.stack([np.sin(q) @ l, -np.cos(q) @ l], axis=1), [[17.3, -36.3]] * 3, atol=1e-10)
    assert np.max(np.abs(found.balance())) < 1e-7
    np.testing.assert_allclose(held_by_hand(q[-1], np.asarray(found.qdot[-1]), given), found.qddot[-1], atol=1e-6)


def held_by_hand(q, v, given):
    l, m, i = given["l"], given["m"], np.arange(LINKS)
    free = by_hand(q, v, given | {"b": 0.0})
    beyond = np.cumsum(m[::-1])[::-1]
    M = beyond[np.maximum(i[:, None], i)] * np.outer(l, l) * np.cos(q[:, None] - q)
    G, gamma = np.stack([l * np.cos(q), l * np.sin(q)]), np.stack([-l * np.sin(q), l * np.cos(q)]) @ v**2
    pulled = np.linalg.solve(M, G.T)
    return free - pulled @ np.linalg.solve(G @ pulled, gamma + G @ free)


@pytest.mark.slow
def test_several_chains_at_once(motion):
    dampings = np.array([0.1, PARAMS["b"], 0.9])
    found = jl.simulate_many(CHAIN, START, np.zeros(LINKS), TS, PARAMS | {"b": dampings}, over=("b",), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.q[1], motion.q, atol=1e-8)
    alone = jl.simulate(CHAIN, START, np.zeros(LINKS), TS, PARAMS | {"b": 0.9}, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.q[2], alone.q, atol=1e-8)


@pytest.mark.slow
def test_what_is_identified_from_three_links():
    """From a motion by hand with noise: within four standard errors, those of differences between motions."""
    ts, seen, noise = np.linspace(0, 1, 21), np.array([9, 39, 79]), 1e-3
    field = lambda t, y: np.append(y[LINKS:], by_hand(y[:LINKS], y[LINKS:], PARAMS))
    y = solve_ivp(field, (0, 1), np.append(START, np.zeros(LINKS)), "DOP853", ts, rtol=1e-9, atol=1e-9).y[seen].T
    measured = y + noise * np.random.default_rng(6).normal(size=y.shape)
    record = jl.Experiment(ts, {"angles": measured}, START, np.zeros(LINKS), sigma={"angles": noise}, observe=lambda q: {"angles": q[seen]})
    fit = jl.fit(CHAIN, record, PARAMS | {"b": 0.8, "g": 9.0}, free=("b", "g"))
    errors = np.sqrt(np.diag(fit.covariance))
    best = np.array([fit.params["b"], fit.params["g"]])
    assert np.all(np.abs(best - [PARAMS["b"], GRAVITY]) < 4 * errors)

    def angles(x):
        motion = jl.simulate(CHAIN, START, np.zeros(LINKS), ts, PARAMS | {"b": x[0], "g": x[1]})
        return np.asarray(motion.q)[:, seen].ravel()

    steps = 1e-3 * best
    J = np.stack([(angles(best + h) - angles(best - h)) / (2 * np.max(h)) for h in np.diag(steps)], axis=1)
    np.testing.assert_allclose(fit.covariance, noise**2 * np.linalg.inv(J.T @ J), rtol=1e-3)
