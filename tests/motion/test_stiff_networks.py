"""Networks of many stiff springs by an implicit scheme: against SciPy's Radau, finite differences and closed forms."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from program_size import largest_array_and_count
from scipy.integrate import solve_ivp
from scipy.sparse import bmat, diags, eye, kron

import jaxlag as jl

SPRINGS, GRAVITY = 100, 9.81
STIFF = diffrax.Kvaerno5()


def joined(x):
    return jnp.diff(jnp.concatenate([jnp.zeros((1, 2)), x]), axis=0)


def lagrangian(q, qdot, m, k, g):
    stretch = jnp.sqrt(jnp.sum(joined(q) ** 2, axis=1)) - 1
    return 0.5 * m * jnp.sum(qdot**2) - 0.5 * jnp.sum(k * stretch**2) - m * g * jnp.sum(q[:, 1])


def dampers(q, qdot, c):
    s = joined(q)
    return 0.5 * c * jnp.sum(jnp.sum(s * joined(qdot), axis=1) ** 2 / jnp.sum(s**2, axis=1))


CHAIN = jl.System(lagrangian, dissipation={"dampers": dampers})
PARAMS = {"m": 1.0, "k": 1e5, "g": GRAVITY, "c": 200.0}


def start(n):
    angles = np.linspace(0.3, 1.2, n)
    return np.cumsum(np.stack([np.sin(angles), -np.cos(angles)], axis=1), axis=0)


def simulated(n, ts, params=PARAMS, **options):
    q = start(n)
    return jl.simulate(CHAIN, q, jnp.zeros_like(q), ts, params, solver=STIFF, **options)


def by_radau(n, ts):
    """The chain by hand, with the sparsity of its Jacobian."""
    k, c, g = (PARAMS[name] for name in "kcg")

    def rates(t, y):
        q, v = y.reshape(2, n, 2)
        s, w = (np.diff(np.vstack([np.zeros(2), x]), axis=0) for x in (q, v))
        length = np.linalg.norm(s, axis=1)
        pull = ((k * (length - 1) + c * np.sum(s * w, axis=1) / length) / length)[:, None] * s
        return np.concatenate([v, np.vstack([pull[1:], np.zeros(2)]) - pull - [0, g]]).ravel()

    beside = kron(diags([1.0, 1.0, 1.0], [-1, 0, 1], (n, n)), np.ones((2, 2)))
    places = bmat([[None, eye(2 * n)], [beside, beside]])
    y0 = np.concatenate([start(n).ravel(), np.zeros(2 * n)])
    found = solve_ivp(rates, (ts[0], ts[-1]), y0, "Radau", ts, rtol=1e-9, atol=1e-9, jac_sparsity=places)
    return found.y.T.reshape(-1, 2, n, 2)


TS = np.linspace(0.0, 0.2, 3)


@pytest.mark.slow
def test_motion_is_that_of_scipy():
    found = simulated(SPRINGS, TS, rtol=1e-8, atol=1e-8, works=True)
    expected = by_radau(SPRINGS, TS)
    np.testing.assert_allclose(found.q, expected[:, 0], atol=1e-7)
    np.testing.assert_allclose(found.qdot, expected[:, 1], atol=1e-6)
    assert np.max(np.abs(found.balance())) < 1e-6
    assert found.stats["num_steps"] < 400


def end(stiffness, scales=None, n=40):
    """Where the sixth point is after a tenth of a second."""
    scales = jnp.ones(1) if scales is None else scales
    params = PARAMS | {"k": PARAMS["k"] * stiffness * scales[:n], "c": PARAMS["c"] * jnp.mean(scales)}
    return simulated(n, TS[:2], params, rtol=1e-9, atol=1e-9).q[-1, 5, 0]


def differences(function, h):
    return (8 * (function(h) - function(-h)) - (function(2 * h) - function(-2 * h))) / (12 * h)


@pytest.mark.slow
def test_derivative_in_the_stiffness():
    forward = jax.jacfwd(end)(1.0)
    np.testing.assert_allclose(forward, differences(lambda h: end(1.0 + h), 1e-3), rtol=1e-6)


@pytest.mark.slow
def test_derivatives_in_the_stiffness_of_each_spring():
    """More than can be pushed forward at once: in reverse, step by step."""
    n = 100
    along, ones = jnp.asarray(np.random.default_rng(0).normal(size=n)), jnp.ones(n)
    function = lambda scales: end(1.0, scales, n)
    gradient = jax.grad(function)(ones)
    np.testing.assert_allclose(gradient @ along, differences(lambda h: function(ones + h * along), 1e-4), rtol=1e-6)


def biggest_and_count(n):
    """Of the program of a motion, and how many coordinates it has."""
    program = jax.make_jaxpr(lambda k: simulated(n, TS, PARAMS | {"k": k}, throw=False).q)(1e5)
    return *largest_array_and_count(program), start(n).size


@pytest.mark.slow
def test_no_array_of_all_by_all_and_no_longer_programs():
    of_few, of_many = biggest_and_count(250), biggest_and_count(1000)
    assert of_many[0] < of_many[2] ** 2 / 16
    assert of_many[0] < 4.5 * of_few[0]
    assert of_many[1] == of_few[1]


@pytest.mark.slow
def test_what_couples_everything_is_solved_as_before():
    """n points that their mean pulls back, stiffly: the mean swings, and what differs from it is free."""
    n, stiffness = 64, 1e2
    system = jl.System(lambda q, qdot, k: 0.5 * jnp.sum(qdot**2) - 0.5 * k * n * jnp.mean(q) ** 2)
    q0 = np.linspace(0.5, 1.5, n)
    found = jl.simulate(system, q0, np.zeros(n), TS, {"k": stiffness}, solver=STIFF, rtol=1e-8, atol=1e-8)
    expected = q0 - 1 + np.cos(np.sqrt(stiffness) * TS)[:, None]
    np.testing.assert_allclose(found.q, expected, atol=1e-5)


@pytest.mark.slow
def test_single_precision_and_several_at_once():
    stiffness = np.array([5e4, 1e5, 2e5])
    q = start(40)
    many = jl.simulate_many(CHAIN, q, np.zeros_like(q), TS, PARAMS | {"k": stiffness}, over=("k",), solver=STIFF, rtol=1e-7, atol=1e-7)
    expected = by_radau(40, TS)
    np.testing.assert_allclose(many.q[1], expected[:, 0], atol=1e-5)
    single = jax.tree.map(lambda x: np.asarray(x, np.float32), (q, np.zeros_like(q), TS, PARAMS))
    found = jl.simulate(CHAIN, *single, solver=STIFF)
    assert found.q.dtype == np.float32
    np.testing.assert_allclose(found.q, expected[:, 0], atol=1e-2)


def test_many_free_points_of_unlike_masses():
    """Each moves by its own mass, a billionth of another's or not; one without any is named."""
    n = 64
    system = jl.System(lambda q, qdot, m: 0.5 * jnp.sum(m * qdot**2) - jnp.sum(jnp.cos(q)))
    m, q = np.geomspace(1e-9, 1.0, n), np.linspace(0.1, 1.0, n)
    np.testing.assert_allclose(jl.acceleration(system, q, 0 * q, {"m": m}).qddot, np.sin(q) / m, rtol=1e-13)
    m[3] = 0.0
    with pytest.raises(ValueError, match="mass matrix is singular"):
        jl.acceleration(system, q, 0 * q, {"m": m})


def test_works_beside_the_usual_tolerances():
    """Overdamped oscillators, each alone: by the two rates of each; the heat is the energy that is lost."""
    k, c, t = np.geomspace(1.0, 100.0, 64), 1e3, 1.0
    energy = lambda q, qdot, k: 0.5 * jnp.sum(qdot**2) - 0.5 * jnp.sum(k * q**2)
    system = jl.System(energy, dissipation={"oil": lambda qdot, c: 0.5 * c * jnp.sum(qdot**2)})
    found = jl.simulate(system, np.ones(64), np.zeros(64), [0.0, t], {"k": k, "c": c}, solver=STIFF, works=True)
    fast = -(c + np.sqrt(c**2 - 4 * k)) / 2
    slow = k / fast
    expected = (fast * np.exp(slow * t) - slow * np.exp(fast * t)) / (fast - slow)
    speed = fast * slow * (np.exp(slow * t) - np.exp(fast * t)) / (fast - slow)
    np.testing.assert_allclose(found.q[-1], expected, rtol=1e-7)
    np.testing.assert_allclose(found.work()["oil"][-1], 0.5 * np.sum(speed**2 + k * (expected**2 - 1)), rtol=1e-6)
    assert np.max(np.abs(found.balance())) < 1e-6
