"""Equilibria and linear systems on contacts that are closed, against closed forms and against quadratic programs solved by SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

import jaxlag as jl

UNITS = [(1.0, 1.0, 1.0), (1e6, 1e3, 1e9), (1e-3, 1e-3, 1e-6)]  # lengths, times and masses in these, in metres, seconds and kilograms


def falls(q, qdot, m, g):
    return 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2) - m * g * q["y"]


def valley(q, k, h):
    return q["y"] - h - 0.5 * k * q["x"] ** 2


bead = jl.System(falls, unilateral={"valley": valley})


@pytest.mark.slow
@pytest.mark.parametrize(("length", "time", "mass"), UNITS)
def test_a_bead_in_a_valley(length, time, mass):
    """ω = √(g k) where it lies, though it may depart; and its derivatives by all parameters, forward and reverse."""
    params = {"m": 2.0 * mass, "g": 9.81 * length / time**2, "k": 3.0 / length, "h": 0.7 * length}

    def frequency(params):
        at = jl.equilibrium(bead, {"x": 0.01 * length, "y": 1.3 * length}, params)  # above it
        return jl.linearise(bead, at, params=params).modes().angular_frequency[0]

    expected = np.sqrt(9.81 * 3.0) / time
    np.testing.assert_allclose(frequency(params), expected, rtol=1e-12)
    by = {"m": 0.0, "g": expected / (2 * params["g"]), "k": expected / (2 * params["k"]), "h": 0.0}
    for derivative in (jax.jacfwd, jax.jacrev):
        found = derivative(frequency)(params)
        for name, value in by.items():
            np.testing.assert_allclose(found[name] * params[name] / expected, value * params[name] / expected, atol=1e-12)
    given = lambda params: jl.linearise(bead, {"x": 0.0, "y": 0.7 * length}, params=params).A  # numbers, which follow the contact
    np.testing.assert_allclose(jax.jacfwd(given)(params)["k"][1, 0], -params["g"], rtol=1e-12)
    np.testing.assert_allclose(jax.jacfwd(given)(params)["h"] * length * time**2, 0, atol=1e-11)


@pytest.mark.slow
def test_half_a_disc_rocks():
    """It rolls on its round side: ω² = g d/(k² + (R − d)²), where its centre of mass is d = 4 R/(3π) below that of the circle."""
    R = 0.3
    d = 4 * R / (3 * np.pi)
    k2 = R**2 / 2 - d**2

    def energy(q, qdot, m, g):
        return 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2 + k2 * qdot["phi"] ** 2) - m * g * q["y"]

    def rolling(q, qdot):  # of the centre of the circle, which is above the centre of mass
        return qdot["x"] - d * jnp.cos(q["phi"]) * qdot["phi"] + R * qdot["phi"]

    disc = jl.System(energy, unilateral={"floor": lambda q: q["y"] + d * jnp.cos(q["phi"]) - R}, nonholonomic={"rolling": rolling})
    params = {"m": 1.7, "g": 9.81}
    at = jl.equilibrium(disc, {"x": 0.0, "y": 0.2, "phi": 0.05}, params)
    linear = jl.linearise(disc, at, params=params)
    frequencies = linear.modes().angular_frequency
    np.testing.assert_allclose(frequencies[np.argmax(frequencies)], np.sqrt(9.81 * d / (k2 + (R - d) ** 2)), rtol=1e-9)
    np.testing.assert_allclose(at.multipliers["floor"], 1.7 * 9.81, rtol=1e-12)


@pytest.mark.slow
def test_a_floor_that_is_shaken():
    """What stands on it, and carries a mass on a spring: ω₀²/(ω₀² − ω²); and the force in the contact."""

    def energy(q, qdot, m, M, c, g):
        return (
            0.5 * m * qdot["top"] ** 2
            + 0.5 * M * qdot["foot"] ** 2
            - g * (m * q["top"] + M * q["foot"])
            - c / 2 * (q["top"] - q["foot"]) ** 2
        )

    params = {"m": 2.0, "M": 5.0, "c": 800.0, "g": 9.81}
    tower = jl.System(energy, unilateral={"floor": lambda q: q["foot"]})
    at = jl.equilibrium(tower, {"top": 0.0, "foot": 0.1}, params)
    outputs = lambda q, multipliers: {"top": q["top"], "force": multipliers["floor"]}
    linear = jl.linearise(tower, at, params=params, inputs=["floor"], outputs=outputs)
    omega, square = np.array([3.0, 11.0, 31.0]), 400.0
    force, top = np.moveaxis(np.asarray(linear.frequency_response(omega))[..., 0], -1, 0)
    response = square / (square - omega**2)
    np.testing.assert_allclose(top, response, rtol=1e-10)
    np.testing.assert_allclose(force, -(omega**2) * (5.0 + 2.0 * response), rtol=1e-10)


@pytest.mark.slow
def test_what_falls_goes_through_no_wall():
    """A mass on a spring beside a wall, x = min(a, wall) and λ = max(0, c (a − wall)); one program for starts and springs on both sides."""
    system = jl.System(lambda q, qdot, c, a: 0.5 * qdot**2 - 0.5 * c * (q - a) ** 2, unilateral={"wall": lambda q, wall: wall - q})
    a, start = np.linspace(-2.0, 5.0, 8), np.array([-1.0, 0.5, 2.0])
    rest = lambda q, a: jl.equilibrium(system, q, {"c": 30.0, "a": a, "wall": 1.2})
    found = jax.vmap(jax.vmap(rest, (None, 0)), (0, None))(start, a)
    np.testing.assert_allclose(found.q, np.broadcast_to(np.minimum(a, 1.2), (3, 8)), rtol=1e-12)
    np.testing.assert_allclose(found.multipliers["wall"], np.broadcast_to(np.maximum(30.0 * (a - 1.2), 0), (3, 8)), rtol=1e-12)
    force = lambda params: jl.equilibrium(system, 0.0, params).multipliers["wall"]
    slopes = jax.grad(force)({"c": 30.0, "a": 3.0, "wall": 1.2})
    np.testing.assert_allclose([slopes["c"], slopes["a"], slopes["wall"]], [1.8, 30.0, -30.0], rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("length", "mass"), [(1.0, 1.0), (1e6, 1e-3), (1e-6, 1e3)])
def test_a_table_on_four_feet(length, mass):
    """Forces of the feet of least norm where all press, and of three of them where one would pull; nothing holds what tips."""
    feet = length * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1.0]])

    def energy(q, qdot, m, centre):
        turns = 0.5 * m * (qdot["z"] ** 2 + length**2 * (qdot["a"] ** 2 + qdot["b"] ** 2))
        return turns - 9.81 * m * (q["z"] + centre[0] * q["a"] + centre[1] * q["b"])

    table = jl.System(energy, unilateral={"feet": lambda q: q["z"] + feet[:, 0] * q["a"] + feet[:, 1] * q["b"] - 0.5 * length})
    start = {"z": 0.7 * length, "a": 0.1, "b": 0.05}
    for centre in ((0.0, 0.0), (0.2, 0.1), (0.6, 0.3), (0.7, 0.6)):
        params = {"m": 3.0 * mass, "centre": length * np.array(centre)}
        at = jl.equilibrium(table, start, params)
        weight = 3.0 * mass * 9.81
        forces = at.multipliers["feet"]
        np.testing.assert_allclose([forces.sum(), *(forces @ feet / length)], weight * np.array([1, *centre]), atol=1e-10 * weight)
        assert np.all(forces >= 0) and at.stability == "stable"
        if sum(centre) < 1:
            np.testing.assert_allclose(forces, weight * (1 + feet @ centre / length) / 4, rtol=1e-13)
    rng = np.random.default_rng(0)
    starts = {"z": rng.uniform(0.5, 1, 100) * length, "a": rng.uniform(-0.2, 0.2, 100), "b": rng.uniform(-0.2, 0.2, 100)}
    centres = rng.uniform(-0.45, 0.45, (100, 2))
    found = jax.vmap(lambda start, centre: jl.equilibrium(table, start, {"m": 3.0 * mass, "centre": centre}))(starts, length * centres)
    np.testing.assert_allclose(found.multipliers["feet"], weight * (1 + centres @ feet.T / length) / 4, rtol=1e-13)
    with pytest.raises(ValueError, match="none was found: a force"):
        jl.equilibrium(table, start, {"m": 3.0 * mass, "centre": length * np.array([1.3, 0.0])})
    with pytest.raises(ValueError, match="`stable` must be False where there are contacts"):
        jl.equilibrium(table, start, {"m": 3.0 * mass, "centre": np.zeros(2)}, stable=True)


@pytest.mark.parametrize("scale", [1.0, 1e-6])
def test_random_springs_between_walls(scale):
    """Where the potential is convex there is one equilibrium: that of a quadratic program, whose dual SciPy solves by NNLS."""
    n, c = 4, 6

    def energy(q, qdot, K, f, N, w):
        return 0.5 * qdot @ qdot - 0.5 * q @ K @ q + f @ q

    system = jl.System(energy, unilateral={"walls": lambda q, N, w: N @ q + w})
    rest = jax.jit(lambda q, params: jl.equilibrium(system, q, params))
    rng, counts = np.random.default_rng(5), []
    for _ in range(100):
        A = rng.normal(size=(n, n))
        K, f, N = A @ A.T + 0.1 * np.eye(n), rng.normal(size=n), rng.normal(size=(c, n))
        inside = rng.normal(size=n)
        w = rng.uniform(0, 1, size=c) - N @ inside  # all gaps are open there
        # min ½ qᵀK q − fᵀq, N q + w ≥ 0: with K = L Lᵀ and x = Lᵀq − L⁻¹f the point of least norm where G x ≥ h (Lawson & Hanson, ch. 23)
        L = np.linalg.cholesky(K)
        G = np.linalg.solve(L, N.T).T
        h = -w - N @ np.linalg.solve(K, f)
        E = np.vstack([G.T, h])
        u, _ = optimize.nnls(E, np.append(np.zeros(n), 1.0))
        r = E @ u - np.append(np.zeros(n), 1.0)
        q = np.linalg.solve(L.T, -r[:n] / r[n] + np.linalg.solve(L, f))
        found = rest(scale * inside, {"K": K, "f": scale * f, "N": N, "w": scale * w})
        np.testing.assert_allclose(found.q / scale, q, rtol=1e-7, atol=1e-9)
        forces = found.multipliers["walls"] / scale
        assert np.all(forces >= 0) and np.all(N @ q + w > -1e-9)
        np.testing.assert_allclose(K @ q - f, N.T @ forces, rtol=1e-6, atol=1e-8)
        counts.append(int(np.sum(forces > 1e-9)))
    assert set(counts) >= {0, 1, 2, 3}


@pytest.mark.slow
def test_a_block_on_a_slope_is_held_by_friction():
    """As long as μ > tan α; put beside the slope, it comes down to it."""

    def energy(q, qdot, m, alpha):
        return falls(q, qdot, m, 0.0) - m * 9.81 * (q["y"] * jnp.cos(alpha) + q["x"] * jnp.sin(alpha))

    rub = lambda qdot, multipliers, mu: mu * multipliers["slope"] * jnp.abs(qdot["x"])
    block = jl.System(energy, dissipation={"rub": rub}, unilateral={"slope": lambda q: q["y"], "wall": lambda q: 9.0 - q["x"]})
    params = {"m": 2.0, "alpha": 0.2, "mu": 0.3}
    for y in (0.0, 0.4):
        at = jl.equilibrium(block, {"x": 1.0, "y": y}, params)
        np.testing.assert_allclose([at.q["x"], at.q["y"]], [1.0, 0.0], atol=1e-12)
        (force,), (bound,) = at.friction["rub"]
        np.testing.assert_allclose([abs(force), bound], 2.0 * 9.81 * np.array([np.sin(0.2), 0.3 * np.cos(0.2)]), rtol=1e-10)
        np.testing.assert_array_equal(jl.linearise(block, at, params=params).A, [[0]])  # x may be anywhere and cannot move
    with pytest.raises(ValueError, match="'rub' would have to hold 3.898 and holds 1.923"):
        jl.equilibrium(block, {"x": 1.0, "y": 0.0}, params | {"mu": 0.1})


def test_where_a_contact_is_not_pressed():
    """The motion is another one on either side; hidden by `jit`, nothing is known there."""
    params = {"m": 2.0, "g": 0.0, "k": 3.0, "h": 0.7}
    start = {"x": 0.0, "y": 0.7}
    with pytest.raises(ValueError, match="'valley' touches and nothing presses it"):
        jl.linearise(bead, start, params=params)
    near = jl.linearise(bead, start, params=params | {"g": 9.81})
    matrix = jax.jit(lambda g: jl.linearise(bead, start, params=params | {"g": g}, independent=near).A)
    assert np.all(np.isnan(matrix(0.0)))
    np.testing.assert_allclose(matrix(9.81), near.A)
    free = jl.linearise(bead, {"x": 0.0, "y": 1.0}, params=params)  # open, it has no part
    np.testing.assert_array_equal(free.A[2:], 0)


@pytest.mark.slow
def test_along_a_motion():
    """Of a bead that falls onto a valley and stays: a part on which nothing opens or closes."""
    params = {"m": 2.0, "g": 9.81, "k": 3.0, "h": 0.7}
    motion = jl.simulate(bead, {"x": 0.1, "y": 0.9}, {"x": 0.0, "y": 0.0}, jnp.linspace(0.0, 0.6, 13), params)
    assert not motion.contacts["valley"].closed[0] and motion.contacts["valley"].closed[-1]
    with pytest.raises(ValueError, match="along which contacts stay open or closed, but 'valley' changes"):
        jl.linearise(bead, motion, params=params)
    linear = jl.linearise(bead, motion[-3:], params=params)
    assert linear.A.shape == (3, 2, 2)


@pytest.mark.slow
def test_branches_of_eigenvalues_over_a_parameter():
    """The valley becomes a hill at k = 0; a spring lets go of its wall at a = 0, where the branches end."""
    params = {"m": 2.0, "g": 9.81, "k": 3.0, "h": 0.7}
    locus = jl.root_locus(bead, {"x": 0.0, "y": 0.7}, params=params, over="k", values=np.linspace(-1, 2, 7))
    np.testing.assert_allclose([c.value for c in locus.crossings], [0.0], atol=1e-10)
    np.testing.assert_allclose(np.sort(locus.eigenvalues[0].real), np.sqrt(9.81) * np.array([-1, 1]), rtol=1e-10)
    spring = jl.System(lambda q, qdot, a: 0.5 * qdot**2 - 0.5 * (q - a) ** 2, unilateral={"wall": lambda q: q})
    with pytest.raises(ValueError, match=r"`values` must be those at which contacts stay open or closed, but at a = 0\."):
        jl.root_locus(spring, 1.0, params={"a": 1.0}, over="a", values=np.linspace(-1, 2, 7))
