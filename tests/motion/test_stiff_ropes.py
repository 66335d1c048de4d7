"""Stiff systems of many constraints by an implicit scheme: a rope of rods that resists bending, against SciPy in angles."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from program_size import largest_array_and_count
from scipy.integrate import solve_ivp

import jaxlag as jl

STIFF = diffrax.Kvaerno5()
PARAMS = {"m": 0.8, "g": 9.81, "l": 1.0, "B": 1e5, "c": 100.0, "b": 0.1}
TS = np.linspace(0.0, 0.2, 3)
RODS = 40


def joined(x):
    return jnp.diff(jnp.concatenate([jnp.zeros((1, 2)), x]), axis=0)


def rods(q, l):
    return jnp.sum(joined(q) ** 2, axis=1) - l**2


def cross(a, b):
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def lagrangian(q, qdot, m, g, B):
    """A joint resists by its stiffness B and the sine of its angle."""
    s = joined(q)
    return 0.5 * m * jnp.sum(qdot**2) - m * g * jnp.sum(q[:, 1]) - 0.5 * jnp.sum(B * cross(s[:-1], s[1:]) ** 2)


def losses(q, qdot, b, c):
    s, w = joined(q), joined(qdot)
    return 0.5 * b * jnp.sum(qdot**2) + 0.5 * c * jnp.sum((cross(s[:-1], w[1:]) + cross(w[:-1], s[1:])) ** 2)


ROPE = jl.System(lagrangian, dissipation={"losses": losses}, holonomic={"rods": rods})


def start(n):
    angles = np.linspace(0.3, 1.2, n)
    return np.cumsum(np.stack([np.sin(angles), -np.cos(angles)], axis=1), axis=0)


def simulated(n=RODS, params=PARAMS, system=ROPE, **options):
    q = start(n) * params["l"]
    return jl.simulate(system, q, jnp.zeros_like(q), TS, params, **({"solver": STIFF, "rtol": 1e-8, "atol": 1e-8} | options))


def by_radau(n):
    """The places of the points, from Lagrange's equations of the second kind in the angles of the rods, by hand."""
    m, g, l, B, c, b = (PARAMS[name] for name in "mglBcb")
    below = n - np.maximum.outer(np.arange(n), np.arange(n))  # points that both of two rods carry

    def rates(t, y):
        phi, omega = y.reshape(2, n)
        apart, turn, rate = phi[:, None] - phi, np.diff(phi), np.diff(omega)
        M = below * np.cos(apart)
        bending = (B * np.sin(turn) * np.cos(turn) + c * np.cos(turn) ** 2 * rate) * l**4
        f = np.append(bending, 0) - np.append(0, bending) - m * g * l * below.diagonal() * np.sin(phi)
        f = f - m * l**2 * (below * np.sin(apart)) @ omega**2 - b * l**2 * M @ omega
        return np.concatenate([omega, np.linalg.solve(m * l**2 * M, f)])

    y0 = np.concatenate([np.linspace(0.3, 1.2, n), np.zeros(n)])
    phi = solve_ivp(rates, (TS[0], TS[-1]), y0, "Radau", TS, rtol=1e-9, atol=1e-10).y[:n].T
    return l * np.cumsum(np.stack([np.sin(phi), -np.cos(phi)], axis=2), axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("more", [{}, {"works": True}, {"stabilisation": jl.stabilisation.Baumgarte(20.0, 20.0)}], ids=str)
def test_motion_is_that_of_scipy(more):
    found = simulated(**more)
    np.testing.assert_allclose(found.q, by_radau(RODS), atol=1e-7)
    assert found.stats["num_steps"] < 300
    residual = jax.vmap(lambda q: rods(q, 1.0))(found.q)
    assert np.max(np.abs(residual)) < (1e-10 if "stabilisation" not in more else 1e-6)
    if "works" in more:
        assert np.max(np.abs(found.balance())) < 1e-6


@pytest.mark.slow
def test_rods_twice_move_alike_and_share_the_force():
    """A rod that is stated again, three times as strictly, takes nine tenths of the force where λ is of least norm."""
    twice = jl.System(lagrangian, dissipation={"losses": losses}, holonomic={"rods": rods, "again": lambda q, l: 3 * rods(q, l)})
    once, again = simulated(), simulated(system=twice)
    np.testing.assert_allclose(again.q, once.q, atol=1e-8)
    np.testing.assert_allclose(again.multipliers["rods"], 0.1 * once.multipliers["rods"], rtol=1e-4, atol=1e-3)


def end(x, **how):
    """Where the sixth point is, by the stiffness and the length in parts of theirs."""
    params = PARAMS | {"B": PARAMS["B"] * x[0], "l": PARAMS["l"] * x[1]}
    return simulated(params=params, **({"rtol": 1e-9, "atol": 1e-9} | how)).q[-1, 5, 0]


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.grad])
def test_derivatives_are_those_of_an_explicit_scheme(derivative):
    """Which takes thousands of steps."""
    x = jnp.ones(2)
    exact = jax.jacfwd(lambda x: end(x, solver=None, rtol=1e-11, atol=1e-12))(x)
    np.testing.assert_allclose(derivative(end)(x), exact, rtol=2e-6)


@pytest.mark.slow
def test_derivatives_in_each_of_many_stiffnesses():
    """In reverse, step by step, against the same along a direction at random, by the variational equations of the explicit scheme."""
    n = 110
    along, ones = jnp.asarray(np.random.default_rng(0).normal(size=n - 1)), jnp.ones(n - 1)
    place = lambda x, **how: simulated(n, PARAMS | {"B": PARAMS["B"] * x}, **({"rtol": 1e-9, "atol": 1e-9} | how)).q[-1, 5, 0]
    exact = jax.jacfwd(lambda h: place(1 + h * along, solver=None, rtol=1e-10, atol=1e-11))(0.0)
    np.testing.assert_allclose(jax.grad(place)(ones) @ along, exact, rtol=1e-5)


@pytest.mark.slow
def test_several_at_once_and_single_precision():
    stiffness = np.array([5e4, 1e5, 2e5])
    q, options = start(RODS), {"solver": STIFF, "rtol": 1e-8, "atol": 1e-8}
    many = jl.simulate_many(ROPE, q, np.zeros_like(q), TS, PARAMS | {"B": stiffness}, over=("B",), **options)
    np.testing.assert_allclose(many.q[1], by_radau(RODS), atol=1e-7)
    single = jax.tree.map(lambda x: np.asarray(x, np.float32), (q, np.zeros_like(q), TS, PARAMS))
    found = jl.simulate(ROPE, *single, solver=STIFF)
    assert found.q.dtype == np.float32
    np.testing.assert_allclose(found.q, by_radau(RODS), atol=1e-3)


@pytest.mark.slow
def test_programs_do_not_grow_and_hold_no_matrix_of_all_by_all():
    programs = [jax.make_jaxpr(lambda B, n=n: simulated(n, PARAMS | {"B": B}, throw=False).q)(1e5) for n in (250, 1000)]
    of_few, of_many = map(largest_array_and_count, programs)
    assert of_many[0] < 2000**2 / 16 and of_many[0] < 4.5 * of_few[0]
    assert of_many[1] == of_few[1]
