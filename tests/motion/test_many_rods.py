"""Chains and nets of many rods: motions, forces, derivatives, fits and starts, against banded and sparse solves of SciPy by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import solveh_banded
from scipy.optimize import brentq
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu
from scipy.special import roots_laguerre

import jaxlag as jl

LINKS, GRAVITY = 80, 9.81


def lagrangian(q, qdot, m, g):
    return jnp.sum(0.5 * m * jnp.sum(qdot**2, axis=1) - m * g * q[:, 1])


def rods(q, l):
    points = jnp.concatenate([jnp.zeros((1, 2)), q])
    return jnp.sum(jnp.diff(points, axis=0) ** 2, axis=1) - l**2


def drag(qdot, b):
    return 0.5 * b * jnp.sum(qdot**2)


CHAIN = jl.System(lagrangian, dissipation={"air": drag}, holonomic={"rods": rods})
RNG = np.random.default_rng(1)
PARAMS = {"m": RNG.uniform(0.5, 2.0, LINKS), "l": RNG.uniform(0.8, 1.2, LINKS), "b": 0.3, "g": GRAVITY}
ANGLES = np.linspace(0.3, 1.4, LINKS)
Q0 = np.cumsum(PARAMS["l"][:, None] * np.stack([np.sin(ANGLES), -np.cos(ANGLES)], axis=1), axis=0)
TS = np.linspace(0.0, 1.0, 6)


def by_hand(q, v, m=PARAMS["m"], b=PARAMS["b"], g=GRAVITY):
    """q̈ and λ of the chain: S of the rods has three diagonals."""
    s = np.diff(np.vstack([np.zeros(2), q]), axis=0)
    w = np.diff(np.vstack([np.zeros(2), v]), axis=0)
    force = -b * v - np.outer(m * g, [0, 1])
    free = np.vstack([np.zeros(2), force / m[:, None]])
    inverse = np.append(0, 1 / m)
    on = 4 * np.sum(s**2, axis=1) * (inverse[1:] + inverse[:-1])
    beside = -4 * np.sum(s[1:] * s[:-1], axis=1) * inverse[1:-1]
    right = -2 * np.sum(w**2, axis=1) - 2 * np.sum(s * np.diff(free, axis=0), axis=1)
    multipliers = solveh_banded(np.vstack([np.append(0, beside), on]), right)
    pull = 2 * multipliers[:, None] * s
    return (force + pull - np.vstack([pull[1:], np.zeros(2)])) / m[:, None], multipliers


@pytest.fixture(scope="module")
def motion():
    return jl.simulate(CHAIN, Q0, np.zeros_like(Q0), params=PARAMS, ts=TS, rtol=1e-9, atol=1e-9, works=True)


def test_acceleration_and_rod_forces():
    q, v = Q0, np.cross(np.array([0, 0, 0.7]), np.pad(Q0, ((0, 0), (0, 1))))[:, :2]
    found = jl.acceleration(CHAIN, q, v, PARAMS)
    qddot, multipliers = by_hand(q, v)
    np.testing.assert_allclose(found.qddot, qddot, rtol=0, atol=1e-10 * np.abs(qddot).max())
    np.testing.assert_allclose(found.multipliers["rods"], multipliers, rtol=0, atol=1e-11 * np.abs(multipliers).max())


@pytest.mark.slow
def test_motion_is_that_of_scipy(motion):
    def field(t, y):
        q, v = y.reshape(2, LINKS, 2)
        return np.concatenate([v.ravel(), by_hand(q, v)[0].ravel()])

    expected = solve_ivp(field, (0, 1), np.concatenate([Q0.ravel(), np.zeros(2 * LINKS)]), "DOP853", TS, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(np.asarray(motion.q), expected.y.T[:, : 2 * LINKS].reshape(-1, LINKS, 2), atol=2e-7)


@pytest.mark.slow
def test_energy_is_accounted_for_and_rods_keep_their_length(motion):
    lengths = np.linalg.norm(np.diff(np.concatenate([np.zeros((TS.size, 1, 2)), motion.q], axis=1), axis=1), axis=2)
    np.testing.assert_allclose(lengths, np.broadcast_to(PARAMS["l"], lengths.shape), rtol=1e-12)
    assert np.max(np.abs(motion.balance())) < 1e-7


def end(params):
    """Where the last link is, and the force in the first rod, after half a second."""
    found = jl.simulate(CHAIN, Q0, jnp.zeros_like(Q0), TS[:3], params, rtol=1e-9, atol=1e-9)
    return found.q[-1, -1, 0] + 0.01 * found.multipliers["rods"][-1, 0]


@pytest.mark.slow
def test_derivatives_in_each_link_and_in_all():
    """Reverse gives each of the 2 n + 2 derivatives at once; forward and differences along one direction of all of them."""
    params = jax.tree.map(jnp.asarray, PARAMS)
    along = {
        "m": jnp.asarray(RNG.normal(size=LINKS)),
        "l": 0.1 * jnp.asarray(RNG.normal(size=LINKS)),
        "b": jnp.array(0.2),
        "g": jnp.array(1.0),
    }
    moved = lambda h: end(jax.tree.map(lambda x, d: x + h * d, params, along))
    forward = jax.jvp(end, (params,), (along,))[1]
    gradient = jax.grad(end)(params)
    reverse = sum(jnp.sum(gradient[name] * along[name]) for name in along)
    h = 1e-4
    differences = (8 * (moved(h) - moved(-h)) - (moved(2 * h) - moved(-2 * h))) / (12 * h)
    np.testing.assert_allclose([forward, reverse], differences, rtol=1e-5)


@pytest.mark.slow
def test_a_start_beside_its_rods_is_put_on_them():
    q, v = jl.consistent_state(CHAIN, Q0 + 0.002 * RNG.normal(size=Q0.shape), RNG.normal(size=Q0.shape), PARAMS)
    s, w = np.diff(np.vstack([np.zeros(2), q]), axis=0), np.diff(np.vstack([np.zeros(2), v]), axis=0)
    np.testing.assert_allclose(np.linalg.norm(s, axis=1), PARAMS["l"], rtol=1e-12)
    np.testing.assert_allclose(np.sum(s * w, axis=1), 0, atol=1e-12)


def nearest(shift):
    q, v = jl.consistent_state(CHAIN, jnp.asarray(Q0) + shift * jnp.sin(jnp.asarray(Q0)), jnp.cos(jnp.asarray(Q0)), PARAMS)
    return jnp.sum(jnp.sin(q) + v**2)


@pytest.mark.slow
def test_a_start_is_differentiated():
    """Off the rods by some per cent, where curvature counts."""
    h = 1e-4
    moved = [nearest(0.02 + k * h) for k in (-2, -1, 1, 2)]
    differences = np.dot([1, -8, 8, -1], moved) / (12 * h)
    np.testing.assert_allclose([jax.grad(nearest)(0.02), jax.jacfwd(nearest)(0.02)], differences, rtol=1e-7)


def test_a_start_in_the_metric_of_inertia():
    """M (q − q0) = Gᵀλ, and with M for the velocities: what is left of both beside the rows of G."""
    q0, v0 = Q0 + 0.02 * np.cos(Q0), np.sin(Q0)
    q, v = (np.asarray(x) for x in jl.consistent_state(CHAIN, q0, v0, PARAMS))
    s = np.diff(np.vstack([np.zeros(2), q]), axis=0)
    G = np.zeros((LINKS, LINKS, 2))
    i = np.arange(LINKS)
    G[i, i] = s
    G[i[1:], i[:-1]] = -s[1:]
    for pushed in (PARAMS["m"][:, None] * (q - q0), PARAMS["m"][:, None] * (v - v0)):
        left = pushed.ravel() - G.reshape(LINKS, -1).T @ np.linalg.lstsq(G.reshape(LINKS, -1).T, pushed.ravel(), rcond=None)[0]
        assert np.abs(left).max() < 1e-10


@pytest.mark.slow
def test_drag_is_found_by_a_fit(motion):
    recorded = motion.q[:, -1]
    experiment = jl.Experiment(TS, recorded, Q0, np.zeros_like(Q0), observe=lambda q: q[-1])
    guess = PARAMS | {"b": 0.5, "g": 8.0}
    found = jl.fit(CHAIN, experiment, guess, free=("b", "g"))
    np.testing.assert_allclose([found.params["b"], found.params["g"]], [PARAMS["b"], GRAVITY], rtol=1e-5)


@pytest.mark.slow
def test_twenty_masses_of_a_chain_of_two_hundred_are_found():
    """Each of ten links; the drag is known, without which the masses have a common factor."""
    chain = jl.System(lambda q, qdot, m, g: lagrangian(q, qdot, jnp.repeat(m, 10), g), dissipation={"air": drag}, holonomic={"rods": rods})
    angles = np.linspace(0.3, 1.4, 200)
    start = np.cumsum(np.stack([np.sin(angles), -np.cos(angles)], axis=1), axis=0)
    at_rest, ts = np.zeros_like(start), np.linspace(0.0, 2.0, 21)
    params = {"m": np.random.default_rng(5).uniform(0.5, 2.0, 20), "l": 1.0, "b": 0.3, "g": GRAVITY}
    recorded = jl.simulate(chain, start, at_rest, ts, params).q[:, 9::10]
    experiment = jl.Experiment(ts, recorded, start, at_rest, observe=lambda q: q[9::10])
    guess = params | {"m": params["m"] * np.tile([0.7, 1.3], 10)}
    found = jl.fit(chain, experiment, guess, free=("m",))
    np.testing.assert_allclose(found.params["m"], params["m"], rtol=1e-4)


@pytest.mark.slow
def test_several_chains_at_once():
    drags = jnp.array([0.1, 0.3, 1.0])
    found = jl.simulate_many(CHAIN, Q0, np.zeros_like(Q0), TS[:3], PARAMS | {"b": drags}, over=("b",), rtol=1e-9, atol=1e-9)
    alone = jl.simulate(CHAIN, Q0, np.zeros_like(Q0), TS[:3], PARAMS, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.q[1], alone.q, atol=1e-7)


def test_powers():
    v = RNG.normal(size=Q0.shape)
    found = jl.powers(CHAIN, Q0, v, PARAMS)
    np.testing.assert_allclose(found["air"], -PARAMS["b"] * np.sum(v**2), rtol=1e-13)


KNOTS = 12


def net(rows=KNOTS):
    """A net that hangs on two corners, one rod between neighbours: as many rods as would leave it no room, were it not for the third
    direction.
    """
    place = np.stack([*np.meshgrid(np.arange(rows), np.arange(rows), indexing="ij"), np.zeros((rows, rows))], axis=2)
    corners = place[0, [0, -1]]

    def lengths(q):
        points = jnp.concatenate([corners[:1], q[: rows - 2], corners[1:], q[rows - 2 :]]).reshape(rows, rows, 3)
        squares = [jnp.sum(jnp.diff(points, axis=axis) ** 2, axis=2).ravel() for axis in (0, 1)]
        return jnp.concatenate(squares)

    def drawn(place):
        return np.delete(place.reshape(-1, 3), [0, rows - 1], axis=0)

    bulge = place + 0.3 * np.stack(
        [0 * place[..., 0], 0 * place[..., 0], np.sin(2.1 * place[..., 0] + 0.5) * np.cos(1.3 * place[..., 1])], axis=2
    )
    q = drawn(bulge)
    start = np.asarray(lengths(jnp.asarray(q)))
    weight = lambda q, qdot, m: 0.5 * m * jnp.sum(qdot**2) - m * GRAVITY * jnp.sum(q[:, 2])
    return jl.System(weight, holonomic={"rods": lambda q: lengths(q) - start}), q, lengths


@pytest.mark.slow
def test_a_net_against_a_sparse_factorisation():
    """q̈ and the forces in 264 rods between 142 knots by SciPy's `splu` of the whole saddle point."""
    system, q, lengths = net()
    v = 0.1 * np.sin(3 * q + np.arange(3))
    G = np.asarray(jax.jacrev(lengths)(jnp.asarray(q))).reshape(-1, q.size)
    gamma = np.asarray(jax.jvp(lambda q: jax.jvp(lengths, (q,), (jnp.asarray(v),))[1], (jnp.asarray(q),), (jnp.asarray(v),))[1])
    m = 0.2
    whole = np.block([[m * np.eye(q.size), -G.T], [G, np.zeros((len(G), len(G)))]])
    right = np.concatenate([np.tile([0, 0, -m * GRAVITY], len(q)), -gamma])
    x = splu(csc_matrix(whole)).solve(right)
    x += splu(csc_matrix(whole)).solve(right - whole @ x)
    found = jl.acceleration(system, q, v, {"m": m})
    scale = np.abs(x[q.size :]).max()
    np.testing.assert_allclose(np.ravel(found.qddot), x[: q.size], rtol=0, atol=1e-8 * np.abs(x[: q.size]).max())
    np.testing.assert_allclose(found.multipliers["rods"], x[q.size :], rtol=0, atol=1e-8 * scale)


EVEN = {"m": 1.0, "l": 1.0, "b": 0.0, "g": GRAVITY}


@pytest.mark.slow
def test_a_hanging_rope_swings_as_laguerre_says():
    """Frequencies ω² = g ξ/l with Lₙ(ξ) = 0 (Rouse–Laguerre), from the state in which it rests."""
    hanging = np.stack([np.zeros(LINKS), -np.arange(1.0, LINKS + 1)], axis=1)
    at = jl.equilibrium(CHAIN, hanging + 0.01 * np.sin(hanging), EVEN)
    np.testing.assert_allclose(at.q, hanging, atol=1e-10)
    np.testing.assert_allclose(at.multipliers["rods"], -0.5 * GRAVITY * np.arange(LINKS, 0, -1.0), rtol=1e-10)
    found = jl.linearise(CHAIN, at.q, np.zeros_like(Q0), EVEN).modes().eigenvalues
    frequencies = np.sort(np.abs(found.imag))
    np.testing.assert_allclose(frequencies, np.sqrt(GRAVITY * roots_laguerre(LINKS)[0]), rtol=1e-8)


@pytest.mark.slow
def test_a_chain_between_two_hooks():
    """Of each link the slope is the weight that it carries beside the lowest point over the horizontal force, which SciPy finds."""
    hook = np.array([30.0, 0.0])

    def lengths(q):
        return jnp.sum(jnp.diff(jnp.concatenate([jnp.zeros((1, 2)), q, hook[None]]), axis=0) ** 2, axis=1) - 1

    hanging = jl.System(lambda q, qdot: 0.5 * jnp.sum(qdot**2) - jnp.sum(q[:, 1]), holonomic={"links": lengths})
    n = LINKS
    carried = np.arange(n + 1) - n / 2
    links = lambda H: np.stack([H, carried], axis=1) / np.hypot(H, carried)[:, None] if np.ndim(H) else links(np.full(n + 1, H))
    H = brentq(lambda H: np.sum(links(H)[:, 0]) - hook[0], 0.1, 100.0, xtol=1e-14)
    at_rest = np.cumsum(links(H), axis=0)[:-1]
    found = jl.acceleration(hanging, at_rest, np.zeros_like(at_rest))
    np.testing.assert_allclose(found.qddot, 0, atol=1e-10)
    np.testing.assert_allclose(-2 * found.multipliers["links"], np.hypot(H, carried), rtol=1e-10)
