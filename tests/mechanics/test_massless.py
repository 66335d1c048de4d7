"""Coordinates without inertia at one state: against the linear equations written out in NumPy, and closed forms of convex D."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import jaxlag as jl
from jaxlag._program.sparse_jacobian import underdetermined

RANDOM = np.random.default_rng(5)
HEAVY, LIGHT = slice(0, 3), slice(3, 6)


def lagrangian(q, qdot, M, C):
    return 0.5 * qdot[HEAVY] @ M @ qdot[HEAVY] - 0.5 * q @ C @ q


NETWORK = jl.System(
    lagrangian,
    dissipation=lambda qdot, B: 0.5 * qdot @ B @ qdot,
    force=lambda f, t: f * jnp.cos(t),
    holonomic={
        "light": lambda t, q, a: a[LIGHT] @ q[LIGHT] - jnp.sin(t),
        "both": lambda q, b: b @ q,
        "heavy": lambda q, c: c[HEAVY] @ q[HEAVY],
    },
)


def definite(n):
    A = RANDOM.normal(size=(n, n))
    return A @ A.T + np.eye(n)


def drawn():
    """Masses, stiffnesses and dampings of a random network, its constraints, and a state on them."""
    params = {"M": definite(3), "C": definite(6), "B": definite(6), "f": RANDOM.normal(size=6), "a": 0, "b": 0, "c": 0}
    return params | {name: RANDOM.normal(size=6) for name in "abc"}


def by_hand(p, t, q, v):
    """(q̈, ż, λ, z̈) of  M ẍ = f_x + Gᵀλ,  0 = f_z + Gᵀλ,  rows with z on velocities, the other row on accelerations."""
    z, x = np.arange(3, 6), np.arange(3)
    A = np.array([np.r_[np.zeros(3), p["a"][3:]], p["b"], np.r_[p["c"][:3], np.zeros(3)]])

    def solved(q, v, t):
        """Unknown: ẍ, ż, λ."""
        S, right = np.zeros((9, 9)), np.zeros(9)
        S[:3, :3], S[:6, 3:6], S[:6, 6:] = p["M"], p["B"][:, z], -A.T
        S[6:8, 3:6], S[8, :3] = A[:2][:, z], A[2, x]
        right[:6] = -p["C"] @ q - p["B"][:, x] @ v[x] + p["f"] * np.cos(t)
        right[6:8] = np.array([np.cos(t), 0]) - A[:2][:, x] @ v[x]
        return np.linalg.solve(S, right)

    xdd, zd, multipliers = np.split(solved(q, v, t), [3, 6])
    h, rate = 1e-5, np.r_[v[x], zd]  # everything is linear but for the time
    later, sooner = (solved(q + s * rate, v + s * np.r_[xdd, np.zeros(3)], t + s) for s in (h, -h))
    return xdd, zd, multipliers, (later - sooner)[3:6] / (2 * h)


@pytest.mark.slow
def test_random_networks_with_constraints_of_every_kind():
    solve = jax.vmap(lambda p, t, q, v: (jl.acceleration(NETWORK, q, v, p, t=t), jl.powers(NETWORK, q, v, p, t=t)))
    given = [(drawn(), RANDOM.uniform(0, 6), RANDOM.normal(size=6), RANDOM.normal(size=6)) for _ in range(100)]
    found, powers = solve(*jax.tree.map(lambda *leaves: np.stack(leaves), *given))
    for i, (p, t, q, v) in enumerate(given):
        xdd, zd, multipliers, zdd = by_hand(p, t, q, v)
        scale = np.max(np.abs(np.r_[xdd, zd, multipliers, zdd]))
        np.testing.assert_allclose(found.qddot[i][HEAVY], xdd, rtol=0, atol=1e-9 * scale)
        np.testing.assert_allclose([found.multipliers[name][i] for name in NETWORK.constraints], multipliers, rtol=0, atol=1e-9 * scale)
        np.testing.assert_allclose(found.qddot[i][LIGHT], zdd, rtol=0, atol=1e-7 * scale)
        rate = np.r_[v[HEAVY], zd]
        np.testing.assert_allclose(powers["dissipation"][i], -rate @ p["B"] @ rate, rtol=1e-9)
        assert abs(powers["both"][i]) < 1e-9 * scale**2  # a constraint at rest does no work


@pytest.mark.slow
def test_a_state_is_completed_by_the_velocities_that_dissipation_decides():
    p, q, v = drawn(), jnp.zeros(6), RANDOM.normal(size=6)
    v[HEAVY] -= p["c"][HEAVY] * (p["c"][HEAVY] @ v[HEAVY]) / (p["c"][HEAVY] @ p["c"][HEAVY])
    _, found = jl.consistent_state(NETWORK, q, v, p)
    np.testing.assert_allclose(found[HEAVY], v[HEAVY], rtol=1e-12)
    np.testing.assert_allclose(found[LIGHT], by_hand(p, 0.0, np.zeros(6), np.asarray(found))[1], rtol=1e-9)
    residual = jl.constraint_residual(NETWORK, q, found, p).velocity
    assert max(abs(of) for of in residual.values()) < 1e-12


# Convex dissipation

POWER = jl.System(lambda q, F: F * q, dissipation=lambda qdot, k, p: k * jnp.abs(qdot) ** p / p)


@pytest.mark.parametrize("p", [1.5, 2.0, 2.5, 3.0, 6.0])
def test_powers_of_the_velocity_from_any_guess(p):
    """k |ż|ᵖ⁻¹ = |F|, over 24 orders of magnitude of F and of the guess."""
    F = np.concatenate([s * 10.0 ** np.arange(-12, 13) for s in (1, -1)])
    guess = 10.0 ** RANDOM.uniform(-12, 12, F.size) * RANDOM.choice([-1, 0, 1], F.size)
    power = jax.vmap(lambda F, v: jl.powers(POWER, 0.0, v, {"F": F, "k": 0.7, "p": p})["dissipation"])
    np.testing.assert_allclose(power(F, guess), -np.abs(F) * (np.abs(F) / 0.7) ** (1 / (p - 1)), rtol=1e-9)


@pytest.mark.slow
def test_rest_under_no_force_and_its_derivative():
    rate = lambda F, p: jl.consistent_state(POWER, 0.0, 0.0, {"F": F, "k": 0.7, "p": p})[1]
    assert rate(0.0, 3.0) == 0 and rate(0.0, 1.5) == 0
    np.testing.assert_allclose(jax.grad(rate)(0.5, 3.0), 0.5 / np.sqrt(0.7 * 0.5), rtol=1e-9)
    np.testing.assert_allclose(jax.jacfwd(rate)(0.5, 1.5), 2 * 0.5 / 0.7**2, rtol=1e-9)
    np.testing.assert_allclose(jax.grad(jax.grad(rate))(0.5, 1.5), 2 / 0.7**2, rtol=1e-9)


PIECEWISE = {  # force, and the rate at which D balances it
    "unlike dampers": (lambda qdot: jnp.where(qdot > 0, 2.0, 1.0) * qdot**2 / 2, lambda F: np.where(F > 0, F / 2, F)),
    "dead zone": (lambda qdot: jnp.maximum(jnp.abs(qdot) - 0.5, 0) ** 2, lambda F: np.sign(F) * (0.5 + np.abs(F) / 2)),
    "Huber": (
        lambda qdot: jnp.where(jnp.abs(qdot) < 1, qdot**2 / 2, jnp.abs(qdot) - 0.5) + qdot**2 / 2,
        lambda F: np.where(np.abs(F) < 2, F / 2, F - np.sign(F)),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PIECEWISE)
def test_quadratic_pieces(name):
    """Of which the slope of the force is a number here and another there: they were taken for linear, with the number at rest."""
    D, exact = PIECEWISE[name]
    F, guess = np.array([3.0, 1.0, 1e-3, -1e-3, -1.0, -3.0]), np.array([0.0, 2.0, -2.0])
    rate = jax.vmap(lambda F, v: jl.consistent_state(jl.System(lambda q, F: F * q, dissipation=D), 0.0, v, {"F": F})[1])
    for start in guess:
        np.testing.assert_allclose(rate(F, np.full(6, start)), exact(F), rtol=1e-12)


def test_drag_in_the_plane_and_a_slope_that_differs_by_direction():
    """D = k|ż|³/3 + ½ b ż₁²: the balance k|ż|ż + b ż₁ = F, put in."""
    drag = jl.System(lambda q, F: F @ q, dissipation=lambda qdot, k, b: k * (qdot @ qdot + 1e-300) ** 1.5 / 3 + b * qdot[0] ** 2 / 2)
    rates = RANDOM.normal(size=(20, 2)) * 10.0 ** RANDOM.uniform(-3, 3, (20, 1))
    F = 0.3 * np.linalg.norm(rates, axis=1, keepdims=True) * rates + rates * [2.0, 0.0]
    solve = jax.vmap(lambda F: jl.consistent_state(drag, jnp.zeros(2), jnp.ones(2), {"F": F, "k": 0.3, "b": 2.0})[1])
    np.testing.assert_allclose(solve(F), rates, rtol=1e-8)


@pytest.mark.slow
def test_drag_beside_a_constraint_that_moves():
    """k|ẋ|ẋ = 2 + λ and b ẏ = −y + 2λ with ẋ + 2ẏ = cos t: one equation for ẋ by bisection."""
    bar = jl.System(
        lambda q: 2.0 * q["x"] - 0.5 * q["y"] ** 2,
        dissipation=lambda qdot, k, b: k * jnp.abs(qdot["x"]) ** 3 / 3 + 0.5 * b * qdot["y"] ** 2,
        holonomic={"bar": lambda t, q: q["x"] + 2 * q["y"] - jnp.sin(t)},
    )
    x = brentq(lambda x: 2 * (0.7 * abs(x) * x - 2) - 0.3 - 0.4 * (1 - x) / 2, -10, 10, xtol=1e-14)
    start = {"x": -0.6, "y": 0.3}, {"x": 0.0, "y": 0.0}, {"k": 0.7, "b": 0.4}
    _, rates = jl.consistent_state(bar, *start)
    np.testing.assert_allclose([rates["x"], rates["y"]], [x, (1 - x) / 2], rtol=1e-12)
    np.testing.assert_allclose(jl.acceleration(bar, *start).multipliers["bar"], 0.7 * abs(x) * x - 2, rtol=1e-11)


# What is not decided, or not covered


def refused(system, *state):
    state = state or ({"x": 1.0, "z": 0.0, "y": 0.0},) * 2
    return lambda: jl.acceleration(system, *state)


spring = lambda q, qdot: 0.5 * qdot["x"] ** 2 - 0.5 * (q["x"] - q["z"]) ** 2 - 0.5 * (q["z"] - q["y"]) ** 2
REFUSED = {
    "nothing": (jl.System(spring, dissipation=lambda qdot: qdot["z"] ** 2), r"every direction inertia.*here: 'y'\."),
    "no slope": (
        jl.System(spring, dissipation=lambda qdot: qdot["z"] ** 2 + jnp.maximum(jnp.abs(qdot["y"]) - 1e3, 0) ** 2),
        "every direction inertia",
    ),
    "gyroscopic": (
        jl.System(lambda q, qdot: spring(q, qdot) + q["z"] * qdot["y"], dissipation=lambda qdot: qdot["z"] ** 2 + qdot["y"] ** 2),
        "must not couple the velocities of coordinates without inertia",
    ),
    "by multipliers": (
        jl.System(
            spring,
            dissipation=lambda qdot, multipliers: (1 + multipliers["rod"]) * qdot["z"] ** 2 + qdot["y"] ** 2,
            holonomic={"rod": lambda q: q["x"] - q["z"]},
        ),
        "must not depend on `multipliers`",
    ),
    "slip between two": (
        jl.System(spring, dissipation=lambda qdot: jnp.abs(qdot["z"] - qdot["y"])),
        "one dry friction on one slip velocity",
    ),
    "contact": (
        jl.System(spring, dissipation=lambda qdot: qdot["z"] ** 2 + qdot["y"] ** 2, unilateral={"floor": lambda q: 5 + q["z"]}),
        "must not touch coordinates without inertia",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused_with_a_sentence(name):
    system, match = REFUSED[name]
    with pytest.raises(ValueError, match=match):
        refused(system)()


def test_what_constraints_hold_is_left_to_them():
    """A crank without mass, y = z², has the reaction that its dashpot asks for, and the second derivative that the constraint says."""
    crank = jl.System(
        lambda qdot: 0.5 * qdot["z"] ** 2, dissipation=lambda qdot: 0.5 * qdot["y"] ** 2, holonomic={"rod": lambda q: q["y"] - q["z"] ** 2}
    )
    found = jl.acceleration(crank, {"z": 2.0, "y": 4.0}, {"z": 1.0, "y": 4.0})
    np.testing.assert_allclose([found.multipliers["rod"], found.qddot["z"]], [4.0, -16.0], rtol=1e-12)
    np.testing.assert_allclose(found.qddot["y"], 2 + 2 * 2 * -16.0, rtol=1e-12)


def of_points(v):
    return 0.5 * jnp.sum(v[:-1] ** 2)


def of_coupled_points(v):
    return 0.5 * jnp.sum(v[:-1] ** 2) + 0.25 * jnp.sum(jnp.diff(v[:-1]) ** 2)


@pytest.mark.parametrize("kinetic", [of_points, of_coupled_points])
@pytest.mark.parametrize("wheels", [1, 20])
def test_many_coordinates_of_which_constraints_hold_one_without_mass(kinetic, wheels):
    """Gears along a row of points, the last without mass: against NumPy on the whole saddle point."""
    n = 72
    lagrangian = lambda q, qdot: kinetic(qdot) - 0.5 * jnp.sum(jnp.diff(q) ** 2)
    gears = lambda q, qdot: qdot[-wheels:] - (1 + q[-wheels:] ** 2) * qdot[-wheels - 1 : -1]
    q = jnp.asarray(np.random.default_rng(0).uniform(0, 1, n))
    found = jl.acceleration(jl.System(lagrangian, nonholonomic={"gears": gears}), q, jnp.zeros(n))
    M, G = jax.hessian(kinetic)(q), jax.jacobian(gears, 1)(q, jnp.zeros(n))
    whole = np.block([[M, -G.T], [G, np.zeros((wheels, wheels))]])
    expected = np.linalg.solve(whole, np.append(jax.grad(lagrangian)(q, jnp.zeros(n)), np.zeros(wheels)))
    np.testing.assert_allclose(np.append(found.qddot, found.multipliers["gears"]), expected, rtol=0, atol=1e-12)


# Seen in the program


def of_differences(qdot, units, linear):
    a, b = units * qdot
    return (a - b) ** 4 / 4 + linear * (a - b) ** 2 / 2 + a**2 / 2


DIFFERENCES = jl.System(lambda q, units: units[1] * q[1], dissipation=of_differences)


@pytest.mark.parametrize("linear", [0.1, 0.0])
@pytest.mark.parametrize("units", [[1.0, 1.0], [1e9, 1e-9], [1e-9, 1e9]])
def test_dissipation_by_differences_of_velocities(units, linear):
    """x³ + linear x = 1 for x = ḃ − ȧ, and ȧ = 1, in any units of a and b: along velocities that are all alike D looked linear."""
    root = brentq(lambda x: x**3 + linear * x - 1, 0, 2, xtol=1e-15)
    for guess in (np.zeros(2), np.array([1.0, -1.0])):
        _, found = jl.consistent_state(DIFFERENCES, np.zeros(2), guess, {"units": np.array(units), "linear": linear})
        np.testing.assert_allclose(found * np.array(units), [1, 1 + root], rtol=1e-14)


@pytest.mark.slow
def test_flat_pieces_are_seen_in_any_unit():
    """Inside a dead zone of 0.5, in units from 1e-9 to 1e9, nothing decides the velocity of what nothing pushes."""
    zone = jl.System(lambda q, F: F * q, dissipation=lambda qdot, u: jnp.maximum(jnp.abs(u * qdot) - 0.5, 0) ** 2)
    for u in (1e-9, 1.0, 1e9):
        _, found = jl.consistent_state(zone, 0.0, 0.0, {"F": 2.0 * u, "u": u})
        np.testing.assert_allclose(found * u, 1.5, rtol=1e-14)
        with pytest.raises(ValueError, match="inertia"):
            jl.acceleration(zone, 0.0, 0.0, {"F": 0.0, "u": u})


def test_long_chains_of_equations_that_determine_each_other():
    """Each equation holds two neighbours. With one unknown too many, none is determined; where an end is known, all are."""
    n = 3000
    pairs = np.eye(n, n + 1, dtype=bool) | np.eye(n, n + 1, 1, dtype=bool)
    assert np.all(underdetermined(pairs)) and not np.any(underdetermined(pairs[:, 1:]))


def test_two_nodes_that_are_moved_together_pull_by_their_dashpots():
    """Nodes without mass, b + c = sin 2t, b behind a dashpot d on a mass and c behind e on a wall: λ = d (ḃ − ȧ) = e ċ, m ä = λ."""
    system = jl.System(
        lambda qdot: 0.5 * 3.0 * qdot["a"] ** 2,
        dissipation=lambda qdot, d, e: 0.5 * d * (qdot["a"] - qdot["b"]) ** 2 + 0.5 * e * qdot["c"] ** 2,
        holonomic={"hand": lambda t, q: q["b"] + q["c"] - jnp.sin(2 * t)},
    )
    t, rate, d, e = 0.3, 2 * np.cos(0.6), 1.5, 0.4
    q, params = {"a": 0.0, "b": np.sin(0.6), "c": 0.0}, {"d": d, "e": e}
    force = (rate - 0.5) / (1 / d + 1 / e)
    state = jl.consistent_state(system, q, {"a": 0.5, "b": 0.0, "c": 0.0}, params, t=t)
    np.testing.assert_allclose([state[1]["b"], state[1]["c"]], [0.5 + force / d, force / e], rtol=1e-12)
    found = jl.acceleration(system, *state, params, t=t)
    np.testing.assert_allclose([found.multipliers["hand"], found.qddot["a"]], [force, force / 3.0], rtol=1e-12)
