"""The constrained solve: redundant rows, singular mass matrices, published accelerations."""

import functools

import jax
import jax.numpy as jnp
import lineax as lx
import mpmath
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._mechanics.pseudo_inverse import _left_singular_vectors, pseudo_inverse
from jaxlag._mechanics.saddle_point import saddle_point
from jaxlag.examples import pendulum


@functools.partial(jax.jit, static_argnums=4)
def _solved(M, G, f, c, form=lx.MatrixLinearOperator):
    return saddle_point(form(M), G, f, c)


def random_problem(rng, n, m, rank=None):
    A = rng.normal(size=(n, n))
    G = rng.normal(size=(m, rank or m)) @ rng.normal(size=(rank or m, n))
    return A @ A.T + 0.1 * np.eye(n), G, rng.normal(size=n), G @ rng.normal(size=n)


@pytest.mark.parametrize("n, m, rank", [(1, 0, None), (3, 1, None), (5, 3, None), (5, 4, 2), (6, 6, 3), (8, 5, 1)])
def test_solution_and_least_norm_multipliers(n, m, rank):
    """Against NumPy: x by the null-space method, λ by lstsq, which gives the least norm."""
    rng = np.random.default_rng(n + 10 * m)
    for _ in range(5):
        M, G, f, c = random_problem(rng, n, m, rank)
        found = saddle_point(lx.MatrixLinearOperator(jnp.asarray(M)), *map(jnp.asarray, (G, f, c)))
        u, s, vt = np.linalg.svd(G)
        N = vt[(s > 1e-10).sum() :].T
        particular = np.linalg.lstsq(G, c, rcond=1e-10)[0] if m else np.zeros(n)
        x = particular + N @ np.linalg.solve(N.T @ M @ N, N.T @ (f - M @ particular))
        multipliers = np.linalg.lstsq(G.T, M @ x - f, rcond=1e-10)[0]
        np.testing.assert_allclose(found.x, x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found.multipliers, multipliers, rtol=1e-8, atol=1e-8)
        assert found.sound.determined


def test_pseudo_inverse_of_rows_in_different_units():
    rng = np.random.default_rng(3)
    rows = np.array([1.0, 1e-3, 1e3, 1.0])[:, None] * rng.normal(size=(4, 2)) @ rng.normal(size=(2, 6))
    S = rows @ rows.T
    np.testing.assert_allclose(pseudo_inverse(jnp.asarray(S)), np.linalg.pinv(S, rcond=1e-13, hermitian=True), rtol=1e-5)


@pytest.mark.parametrize("seed", range(6))
def test_rows_stated_twice_whose_units_are_far_apart(seed):
    """Ten decades: x as of each row once, in one unit, by NumPy."""
    rng = np.random.default_rng(seed)
    M, G, f, c = random_problem(rng, 12, 8)
    units = 10.0 ** rng.uniform(-5, 5, 8)
    more, asked = np.vstack([units[:, None] * G, 2 * units[:3, None] * G[:3]]), np.append(units * c, 2 * units[:3] * c[:3])
    found = saddle_point(lx.MatrixLinearOperator(jnp.asarray(M)), *map(jnp.asarray, (more, f, asked)))
    whole = np.block([[M, -G.T], [G, np.zeros((8, 8))]])
    np.testing.assert_allclose(found.x, np.linalg.solve(whole, np.append(f, c))[:12], rtol=1e-9, atol=1e-9)
    assert found.sound.determined and found.sound.satisfied


@pytest.mark.slow
def test_pseudo_inverse_derivatives_at_constant_rank():
    """Directions within the matrices of rank 2, against central differences of NumPy's pinv; second order too."""
    rng = np.random.default_rng(4)
    B, dB = rng.normal(size=(2, 4, 2))
    curve = lambda s: (B + s * dB) @ (B + s * dB).T
    P = lambda s: np.linalg.pinv(curve(s), rcond=1e-10, hermitian=True)
    h = 1e-4
    first = jax.jvp(lambda s: pseudo_inverse(curve(s)), (0.0,), (1.0,))[1]
    np.testing.assert_allclose(first, (P(h) - P(-h)) / (2 * h), rtol=1e-5, atol=1e-5)
    second = jax.jacfwd(jax.jacfwd(lambda s: pseudo_inverse(curve(s))))(0.0)
    np.testing.assert_allclose(second, (P(h) - 2 * P(0) + P(-h)) / h**2, rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_second_derivatives_where_rows_depend_on_each_other():
    """Along a curve of constant rank, forward over forward and reverse over forward, against central differences of NumPy's solution."""
    rng = np.random.default_rng(5)
    M, f = np.diag(rng.uniform(1, 2, 6)), rng.normal(size=6)
    A, B, dB = rng.normal(size=(4, 2)), *rng.normal(size=(2, 2, 6))
    rows = lambda s: A @ (B + s * dB)

    def solution(s):
        x = saddle_point(lx.MatrixLinearOperator(jnp.asarray(M)), rows(s), jnp.asarray(f), jnp.zeros(4))
        return jnp.concatenate([x.x, x.multipliers])

    def expected(s):
        G = rows(s)
        multipliers = -np.linalg.pinv(G @ np.linalg.solve(M, G.T), rcond=1e-10, hermitian=True) @ G @ np.linalg.solve(M, f)
        return np.r_[np.linalg.solve(M, f + G.T @ multipliers), multipliers]

    h = 1e-3
    second = (-expected(2 * h) + 16 * expected(h) - 30 * expected(0.0) + 16 * expected(-h) - expected(-2 * h)) / (12 * h**2)
    for outer in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(outer(jax.jacfwd(solution))(0.0), second, rtol=1e-5, atol=1e-5)


def test_a_constraint_written_twice():
    state = pendulum.cartesian_state(0.7, 1.3, 1.0)
    rod = pendulum.cartesian_rod
    twice = jl.System(pendulum.cartesian_lagrangian, holonomic={"rod": rod, "again": rod, "scaled": lambda q, l: 3 * rod(q, l)})
    once = jl.acceleration(pendulum.cartesian, *state, pendulum.params)
    found = jl.acceleration(twice, *state, pendulum.params)
    for name in ("x", "y"):
        np.testing.assert_allclose(found.qddot[name], once.qddot[name], rtol=1e-10)
    forces = jl.constraint_force(twice, *state, pendulum.params)
    single = jl.constraint_force(pendulum.cartesian, *state, pendulum.params)["rod"]
    total = {name: sum(force[name] for force in forces.values()) for name in single}
    for name in single:
        np.testing.assert_allclose(total[name], single[name], rtol=1e-10)
    # least norm: λ proportional to the rows, (1, 1, 3) / 11
    multipliers = [found.multipliers[name] for name in ("rod", "again", "scaled")]
    np.testing.assert_allclose(multipliers, np.array([1, 1, 3]) / 11 * once.multipliers["rod"], rtol=1e-9)


@pytest.mark.slow
def test_gradients_with_a_constraint_written_twice():
    rod = pendulum.cartesian_rod
    twice = jl.System(pendulum.cartesian_lagrangian, holonomic={"rod": rod, "again": rod})

    def outcome(system):
        def number(m, l, x):
            q, v = pendulum.cartesian_state(0.7, 1.3, 1.0)
            out = jl.acceleration(system, {**q, "x": q["x"] + x}, v, {"m": m, "l": l, "g": 9.81})
            return out.qddot["x"] + sum(out.multipliers.values())

        return number

    expected = jax.grad(outcome(pendulum.cartesian), (0, 1, 2))(1.0, 1.0, 0.0)
    for derivative in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(derivative(outcome(twice), (0, 1, 2))(1.0, 1.0, 0.0), expected, rtol=1e-9, atol=1e-10)
    bent = jax.hessian(outcome(twice), (0, 1, 2))(1.0, 1.0, 0.0)
    assert np.all(np.isfinite(bent))


def test_coordinates_without_inertia_that_a_constraint_holds():
    """A massless strut end s = y between spring and body: (m ÿ = −c y − m g)."""
    system = jl.System(
        lambda q, qdot, m, c, g: 0.5 * m * qdot["y"] ** 2 - m * g * q["y"] - 0.5 * c * q["s"] ** 2,
        holonomic={"strut": lambda q: q["s"] - q["y"]},
    )
    p = {"m": 2.0, "c": 50.0, "g": 9.81}
    found = jl.acceleration(system, {"y": 0.3, "s": 0.3}, {"y": 0.0, "s": 0.0}, p)
    np.testing.assert_allclose(found.qddot["y"], -50 * 0.3 / 2 - 9.81, rtol=1e-13)
    np.testing.assert_allclose(found.multipliers["strut"], 50 * 0.3, rtol=1e-12)


def test_a_direction_without_inertia_is_refused():
    system = jl.System(lambda q, qdot: 0.5 * (qdot["x"] + qdot["y"]) ** 2 - q["x"])
    with pytest.raises(ValueError, match="every direction inertia that no constraint holds"):
        jl.acceleration(system, {"x": 0.0, "y": 0.0}, {"x": 0.0, "y": 0.0})
    held = jl.System(lambda q, qdot: 0.5 * (qdot["x"] + qdot["y"]) ** 2 - q["x"], holonomic=lambda q: q["x"] - q["y"])
    np.testing.assert_allclose(jl.acceleration(held, {"x": 0.0, "y": 0.0}, {"x": 0.0, "y": 0.0}).qddot["x"], -0.25, rtol=1e-13)


def four_bar_lagrangian(qdot, q, l, rho):
    """Uniform rods 2, 3, 4 of the chain; rod 1 is the base."""
    angle, rate = jnp.cumsum(q), jnp.cumsum(qdot)
    velocity, kinetic = jnp.zeros(2), 0.0
    for i in range(3):
        along = jnp.array([-jnp.sin(angle[i]), jnp.cos(angle[i])]) * rate[i] * l[i + 1]
        centre = velocity + along / 2
        m = rho * l[i + 1]
        kinetic += 0.5 * m * centre @ centre + 0.5 * m * l[i + 1] ** 2 / 12 * rate[i] ** 2
        velocity = velocity + along
    return kinetic


def four_bar_closure(q, l):
    angle = jnp.cumsum(q)
    end = jnp.stack([jnp.sum(l[1:] * jnp.cos(angle)), jnp.sum(l[1:] * jnp.sin(angle))])
    return end + jnp.stack([l[0], 0.0 * l[0]])


def test_four_bar_of_sympy():
    """sympy/physics/mechanics/tests/test_jointsmethod.py (BSD-3), test_four_bar_linkage_with_manual_constraints, at numbers."""
    system = jl.System(four_bar_lagrangian, holonomic={"closure": four_bar_closure})
    q = jnp.array([2.1, 0.6655470375077588, 2.527408138024188])
    v = jnp.array([0.2, -0.17963733938852067, 0.1309060540601612])
    found = jl.acceleration(system, q, v, {"l": np.array([0.13, 0.24, 0.21, 0.34]), "rho": 997.0})
    np.testing.assert_allclose(found.qddot, [0.004875813576771052, -0.019901808571750258, 0.012180573114075468], atol=1e-10)


def test_cart_pendulum_of_sympy():
    """sympy/physics/mechanics/tests/test_system_class.py (BSD-3), test_cart_pendulum_lagrange, at numbers; our sign of λ."""

    def lagrangian(q, qdot, mc, mp, l, g, k):
        cart, pole = qdot["c"], qdot["p"]
        kinetic = 0.5 * (mc + mp) * cart**2 + mp * l * jnp.cos(q["p"]) * pole * cart + 0.5 * mp * l**2 * pole**2
        return kinetic + mp * g * l * jnp.cos(q["p"]) + 0.5 * k * q["p"] ** 2

    system = jl.System(lagrangian, force=lambda F: {"c": F}, holonomic={"line": lambda q, l: q["c"] + l * jnp.sin(q["p"])})
    p = {"g": 9.81, "l": 0.7, "mc": 1.4, "mp": 0.6, "k": 2.3, "F": 0.9}
    found = jl.acceleration(system, {"p": 0.5, "c": -0.3355978770229421}, {"p": -0.8, "c": 0.49144623465860876}, p)
    np.testing.assert_allclose(found.qddot["p"], -2.1356831606160864, atol=1e-12)
    np.testing.assert_allclose(abs(found.multipliers["line"]), 1.237449231302558, atol=1e-12)


def disc_spin(q, qdot):
    """Angular velocity in the lean frame of a disc with yaw q1, lean q2, spin q3 (Z-X-Y)."""
    yaw, lean, spin = qdot[:3]
    return jnp.stack([lean, spin + yaw * jnp.sin(q[1]), yaw * jnp.cos(q[1])])


def disc_axes(q):
    """Columns: axes of the lean frame."""
    (c1, s1), (c2, s2) = (jnp.cos(q[0]), jnp.sin(q[0])), (jnp.cos(q[1]), jnp.sin(q[1]))
    zero = jnp.zeros_like(c1)
    return jnp.array([[c1, -s1 * c2, s1 * s2], [s1, c1 * c2, -c1 * s2], [zero, s2, c2]])


def disc_centre(q, r):
    return jnp.array([q[3], q[4], 0.0]) + r * disc_axes(q)[:, 2]


def disc_velocity(q, qdot, r):
    return jax.jvp(lambda q: disc_centre(q, r), (q,), (qdot,))[1]


def disc_lagrangian(q, qdot, m, r, g):
    w, v = disc_spin(q, qdot), disc_velocity(q, qdot, r)
    inertia = m * r**2 / 4 * jnp.array([1.0, 2.0, 1.0])
    return 0.5 * m * v @ v + 0.5 * inertia @ w**2 - m * g * r * jnp.cos(q[1])


def disc_rolls(q, qdot, r):
    """Velocity of the centre minus ω × r; its vertical part vanishes identically, which makes a redundant row."""
    axes = disc_axes(q)
    return disc_velocity(q, qdot, r) - axes @ jnp.cross(disc_spin(q, qdot), jnp.array([0.0, 0.0, 1.0]) * r)


rolling_disc = jl.System(disc_lagrangian, nonholonomic={"rolling": disc_rolls})
# sympy/physics/mechanics/tests/test_kane5.py (BSD-3), TestKane5: q, qdot, qddot
KANE5 = [
    (
        [0.3, 0.1, 1.97, -0.35, 2.27],
        [0.126603940595934, 0.21594257160166, 1.28736069604936, 0.319764288376543, 0.0989146857254898],
        [-0.5587835488228831, 3.2096303049762653, 0.010447606711792075, -0.009927934217545205, 0.041286163482917235],
    ),
    (
        [3.97, -0.28, 8.2, -0.35, 2.27],
        [0.0259159090798597, 0.668041660387416, -2.19283799213811, 0.385441810852219, 0.420109283790573],
        [3.0485382524933056, -8.407406775934694, 0.8147496603401003, -0.1540985426321738, -0.14610266441000944],
    ),
]


@pytest.mark.parametrize("q, qdot, qddot", KANE5)
def test_rolling_disc_of_sympy(q, qdot, qddot):
    params = {"g": 9.81, "r": 0.26, "m": 3.43}
    found = jl.acceleration(rolling_disc, np.array(q), np.array(qdot), params)
    np.testing.assert_allclose(found.qddot, qddot, atol=1e-10)
    residual = jl.constraint_residual(rolling_disc, np.array(q), np.array(qdot), params).velocity["rolling"]
    np.testing.assert_allclose(residual, 0, atol=1e-13)


def test_friction_that_depends_on_the_constraint_force():
    """A block that slides down an incline, N = |λ| of the plane: ẍ = g (sin α − μ cos α)."""
    system = jl.System(
        lambda q, qdot, m, g, alpha: 0.5 * m * qdot @ qdot + m * g * (jnp.sin(alpha) * q[0] - jnp.cos(alpha) * q[1]),
        dissipation=lambda qdot, multipliers, mu: mu * jnp.abs(multipliers["plane"]) * jnp.abs(qdot[0]),
        holonomic={"plane": lambda q: q[1]},
    )
    p = {"m": 3.0, "g": 9.81, "alpha": 0.6, "mu": 0.3}
    found = jl.acceleration(system, jnp.zeros(2), jnp.array([0.5, 0.0]), p)
    np.testing.assert_allclose(found.qddot[0], 9.81 * (np.sin(0.6) - 0.3 * np.cos(0.6)), rtol=1e-12)
    np.testing.assert_allclose(found.multipliers["plane"], 3 * 9.81 * np.cos(0.6), rtol=1e-12)


def test_a_reaction_and_the_friction_it_brings_about_push_each_other():
    """Rod against a rough wall: λ stands in its own equation. m ẍ = λ (1 − μ s), closed form by hand."""
    system = jl.System(
        lambda q, qdot, m: 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2),
        force=lambda multipliers, F, mu: {"x": -F, "y": -mu * multipliers["rail"]},
        holonomic={"rail": lambda q: q["x"] - q["y"]},
    )
    p = {"m": 2.0, "F": 10.0, "mu": 0.4}
    found = jl.acceleration(system, {"x": 0.0, "y": 0.0}, {"x": 0.0, "y": 0.0}, p)
    # m a = −F + λ, m a = −μλ − λ  →  λ = F / (2 + μ)
    np.testing.assert_allclose(found.multipliers["rail"], 10 / 2.4, rtol=1e-12)
    slope = jax.grad(lambda mu: jl.acceleration(system, {"x": 0.0, "y": 0.0}, {"x": 0.0, "y": 0.0}, {**p, "mu": mu}).multipliers["rail"])(
        0.4
    )
    np.testing.assert_allclose(slope, -10 / 2.4**2, rtol=1e-10)


falling = jl.System(
    lambda q, qdot, s: 0.5 * qdot @ qdot + s * qdot[0] * qdot[1] - 9.81 * q[1], holonomic=lambda q, e: jnp.stack([q[0], q[0] + e * q[1]])
)


@pytest.mark.parametrize("e", [1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9])
@pytest.mark.parametrize("s", [0.0, 0.3])
def test_rows_that_are_nearly_the_same_hold_all_the_same(e, s):
    """q₀ = 0 and q₀ + e q₁ = 0 hold both coordinates: λ₁ = g / e = −λ₀, whatever the inertia."""
    found = jl.acceleration(falling, jnp.zeros(2), jnp.zeros(2), {"e": e, "s": s})
    np.testing.assert_allclose(found.qddot, 0, rtol=0, atol=2e-14 / e + 1e-9)  # rounding of forces of the size of λ
    np.testing.assert_allclose(found.multipliers["holonomic"], np.array([-9.81, 9.81]) / e, rtol=1e-6)


def test_rows_that_are_the_same_to_rounding_count_once():
    found = jl.acceleration(falling, jnp.zeros(2), jnp.zeros(2), {"e": 1e-14, "s": 0.0})
    np.testing.assert_allclose(found.qddot, [0, -9.81], rtol=0, atol=1e-12)


CONTRADICTORY = {
    "apart": lambda t, q: jnp.stack([q[0], q[0] - t**2]),
    "nearly the same": lambda t, q: jnp.stack([q[0] - t**2, q[0] - t**2 + 1e-6 * q[1] - t**3 - t**2]),
    "of nothing": lambda t, q: jnp.stack([q[0], t**2]),
}


@pytest.mark.parametrize("case", CONTRADICTORY)
@pytest.mark.parametrize("function", [jl.acceleration, jl.constraint_force])
def test_constraints_that_contradict_each_other_have_no_acceleration(case, function):
    system = jl.System(lambda qdot: 0.5 * qdot @ qdot, holonomic=CONTRADICTORY[case])
    with pytest.raises(ValueError, match="`holonomic` and `nonholonomic` must not contradict each other"):
        function(system, jnp.zeros(2), jnp.zeros(2))
    inside = jax.jit(lambda q: function(system, q, jnp.zeros(2)))(jnp.zeros(2))
    assert all(np.all(np.isnan(leaf)) for leaf in jax.tree.leaves(inside))


SPHERE = {"sphere": lambda q: q @ q - 5.0}
ROWS = {
    "none": {},
    "one row": SPHERE,
    "two rows": SPHERE | {"saddle": lambda q: q[0] * q[1] - q[2]},
    "redundant rows": SPHERE | {"again": lambda q: 2 * (q @ q) - 10.0},
}


@pytest.mark.slow
@pytest.mark.parametrize("rows", ROWS)
def test_second_derivatives_of_an_acceleration_in_every_mode(rows):
    """Forward over reverse differentiates the linear maps of reverse mode, whose matrices move, too; by differences in forward mode."""

    def lagrangian(q, qdot):
        turning = 0.5 * qdot[2] ** 2 * (2 + jnp.sin(q[1]))
        return 0.5 * qdot @ qdot * (1 + q[0] ** 2) + q[0] * qdot[0] * qdot[1] + turning - q[2] * q[0]

    system = jl.System(lagrangian, holonomic=ROWS[rows])
    x, h = jnp.array([1.0, 1.5, 0.8, 0.3, 0.7, -0.2]), 1e-4
    found = lambda x: jl.acceleration(system, x[:3], x[3:]).qddot
    slope = jax.jacfwd(found)
    expected = jnp.stack([(slope(x + h * e) - slope(x - h * e)) / (2 * h) for e in jnp.eye(6)], axis=-1)
    for outer in (jax.jacfwd, jax.jacrev):
        for inner in (jax.jacfwd, jax.jacrev):
            np.testing.assert_allclose(outer(inner(found))(x), expected, rtol=1e-6, atol=1e-7)


def test_singular_values_of_two_rows():
    """Against LAPACK: random rows, nearly dependent ones, equal ones, and one of zeros."""
    rng, found = np.random.default_rng(0), jax.jit(_left_singular_vectors)
    for kind in range(400):
        rows = rng.normal(size=(2, 3))
        if kind % 4:
            rows[1] = rng.normal() * rows[0] * (kind % 4 < 3) + 10.0 ** -rng.integers(0, 17) * rng.normal(size=3) * (kind % 4 == 1)
        U, values = map(np.asarray, found(rows))
        a, b = U.T @ rows
        largest = np.linalg.norm(rows, 2)
        np.testing.assert_allclose(values, np.linalg.svd(rows, compute_uv=False), rtol=0, atol=4e-15 * largest)
        np.testing.assert_allclose(U @ U.T, np.eye(2), rtol=0, atol=4e-15)
        assert abs(a @ b) <= 4e-15 * largest**2


@pytest.mark.parametrize("seed", range(8))
def test_rows_of_zeros_among_rows_that_depend_on_each_other(seed):
    """As of friction that slips, or a contact that is open, beside redundant constraints. Rounding must not mix their null directions."""
    rng, worst = np.random.default_rng(seed), 0.0
    for _ in range(50):
        root, B, x0 = rng.normal(size=(4, 4)), rng.normal(size=(2, 4)), rng.normal(size=4)
        M, f = np.eye(4) + 0.2 * root @ root.T, rng.normal(size=4)
        G = np.stack([B[0], B[1], rng.normal(size=2) @ B, 0 * B[0], rng.integers(2) * rng.normal(size=4)])[rng.permutation(5)]
        found = _solved(M, G, f, G @ x0)
        whole = np.block([[M, -G.T], [G, np.zeros((5, 5))]])
        x = np.linalg.lstsq(whole, np.concatenate([f, G @ x0]), rcond=1e-10)[0][:4]
        multipliers = np.linalg.pinv(G.T, rcond=1e-10) @ (M @ x - f)
        worst = max(worst, np.max(np.abs(found[0] - x)), np.max(np.abs(found[1] - multipliers)))
    assert worst < 1e-10


# In any units, beside anything


def exactly(M, G, f, c):
    """x and λ in a hundred digits."""
    n, m = len(f), len(c)
    K = mpmath.matrix(np.block([[M, -G.T], [G, np.zeros((m, m))]]).tolist())
    with mpmath.workdps(100):
        found = mpmath.lu_solve(K, mpmath.matrix([*f, *c]))
    return np.array([float(x) for x in found[:n]]), np.array([float(x) for x in found[n:]])


def drawn_in_units(rng, kind, n, m):
    """A problem whose numbers are near one, and the units (of coordinates, rows, and mass) in which it is stated."""
    root, G = rng.normal(size=(n, n)), rng.normal(size=(m, n))
    M, f, c, hidden = root @ root.T + 0.3 * np.eye(n), rng.normal(size=n), rng.normal(size=m), np.ones(n)
    if kind == "diagonal":
        M = np.diag(np.diag(M))
    if kind == "light and heavy":  # some tied to others a million times as heavy
        hidden = 10.0 ** rng.uniform(-3, 3, n)
    if kind == "beside":  # two systems that nothing couples, one of them 1e±9 times as heavy
        M[: n // 2, n // 2 :], M[n // 2 :, : n // 2], G[0, n // 2 :], G[1:, : n // 2] = 0, 0, 0, 0
        heavy = 10.0 ** rng.uniform(-9, 9)
        M[: n // 2, : n // 2], f[: n // 2] = heavy * M[: n // 2, : n // 2], heavy * f[: n // 2]
    if kind == "without mass":
        M[-m:], M[:, -m:] = 0, 0
    units = 10.0 ** rng.uniform(-9, 9, n), 10.0 ** rng.uniform(-3, 3, m), 10.0 ** rng.uniform(-9, 9)
    return M * np.outer(hidden, hidden), G, f, c, units


@pytest.mark.parametrize("kind", ["full", "diagonal", "light and heavy", "beside", "without mass"])
def test_any_units_of_coordinates_rows_and_mass(kind):
    """Against mpmath, each number beside the sum of what makes it (Skeel's condition): a coordinate in its own unit."""
    rng, worst = np.random.default_rng(0), 0.0
    form = lx.DiagonalLinearOperator if kind == "diagonal" else lx.MatrixLinearOperator
    for _ in range(40):
        M, G, f, c, (s, r, mass) = drawn_in_units(rng, kind, 6, 3)
        stated = mass * M * np.outer(s, s), r[:, None] * G * s, mass * s * f, r * c
        found = _solved(stated[0].diagonal() if kind == "diagonal" else stated[0], *stated[1:], form)
        assert found.sound.determined and found.sound.satisfied
        exact = np.concatenate([s, r / mass]) * np.concatenate(exactly(*stated))
        K, given = np.block([[M, -G.T], [G, np.zeros((3, 3))]]), np.append(f, c)
        size = np.abs(np.linalg.inv(K)) @ (np.abs(K) @ np.abs(exact) + np.abs(given))
        worst = max(worst, np.max(np.abs(np.concatenate([s * found.x, r / mass * found.multipliers]) - exact) / size))
    assert worst < 1e-10


beside = jl.System(
    lambda q, qdot, M, J: 0.5 * M * qdot["X"] ** 2 + J * (0.5 * (qdot["a"] ** 2 + 2 * qdot["b"] ** 2) - q["a"]),
    holonomic={"pair": lambda q: q["a"] - q["b"]},
)


@pytest.mark.parametrize("M", [1.0, 1e3, 1e6, 2e6, 1e9, 1e15])
def test_a_light_pair_beside_a_mass(M):
    """φ̈ = −1/3 whatever the mass: it was off by 1.4e-3 at 1e6, and refused at 1e9."""
    at = {"X": 0.0, "a": 0.0, "b": 0.0}
    found = jl.acceleration(beside, at, at, {"M": M, "J": 1e-9})
    np.testing.assert_allclose([found.qddot[name] for name in "Xab"], [0, -1 / 3, -1 / 3], rtol=1e-14, atol=1e-300)
    np.testing.assert_allclose(found.multipliers["pair"], 2e-9 / 3, rtol=1e-13)
    assert not jl.examine(beside, at, at, {"M": M, "J": 1e-9}).findings


crossing = jl.System(
    lambda q, qdot, s: 0.5 * qdot["x"] ** 2 + 0.5 * (s * qdot["y"]) ** 2 - s * q["y"],
    holonomic={"rows": lambda q, s, e: jnp.stack([q["x"] + e * s * q["y"], q["x"] - e * s * q["y"]])},
)


@pytest.mark.parametrize("s", [1e-9, 1.0, 1e6])
def test_the_rank_of_rows_in_any_units(s):
    """x ± 1e-6 y = 0 are two rows in metres and in micrometres, as in the motion; x ± 1e-12 y, one."""
    at = {"x": 0.0, "y": 0.0}
    for e, rank in ((1e-6, 2), (1e-12, 1)):
        assert jl.examine(crossing, at, at, {"s": s, "e": e}).rank == rank
    np.testing.assert_allclose(s * jl.acceleration(crossing, at, at, {"s": s, "e": 1e-6}).qddot["y"], 0, atol=1e-9)


def test_derivatives_where_rows_turn():
    """A block on a slope that a parameter tilts: q̈ = −g sin α (cos α, sin α), λ = −g cos α."""
    slope = jl.System(
        lambda q, qdot: 0.5 * qdot @ qdot - 9.81 * q[1], holonomic={"slope": lambda q, a: jnp.sin(a) * q[0] - jnp.cos(a) * q[1]}
    )

    def found(a):
        motion = jl.acceleration(slope, jnp.zeros(2), jnp.zeros(2), {"a": a})
        return jnp.append(motion.qddot, motion.multipliers["slope"])

    by_hand = lambda a: -9.81 * jnp.stack([jnp.sin(a) * jnp.cos(a), jnp.sin(a) ** 2, jnp.cos(a)])
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(found)(0.4), jax.jacfwd(by_hand)(0.4), rtol=1e-13)


STATED = jl.System(
    lambda qdot, M: 0.5 * jnp.sum(M * qdot**2), force=lambda f: f, holonomic={"rows": lambda t, q, G, w: G @ q - w * t**2 / 2}
)


@pytest.mark.parametrize("d", [1e-1, 1e-2, 1e-3, 5e-5])
def test_rows_that_are_almost_parallel(d):
    """(1, 0, a) and (1, d, a): what the second has beside the first holds f₂, and both together hold f₁ and f₃. Moved, the second takes
    q₂ along by w/d, far as that may be.
    """
    a, M, f, w = 0.3, np.array([1.0, 2.0, 3.0]), np.array([0.7, -0.2, 1.1]), np.array([0.0, 5.0])
    params = {"G": np.array([[1.0, 0.0, a], [1.0, d, a]]), "M": M, "f": f}
    held = jl.acceleration(STATED, np.zeros(3), np.zeros(3), params | {"w": 0 * w}).multipliers["rows"]
    both = -(f[0] / M[0] + a * f[2] / M[2]) / (1 / M[0] + a**2 / M[2])
    np.testing.assert_allclose(held, [both + f[1] / d, -f[1] / d], rtol=5e-16 / d)
    moved = jl.acceleration(STATED, np.zeros(3), np.zeros(3), params | {"w": w, "f": 0 * f}).qddot
    np.testing.assert_allclose(moved, [0.0, 5.0 / d, 0.0], rtol=1e-13 / d, atol=1e-13 / d**2)
