"""Tops, free bodies, coins and linkages in space: motions in closed form, and one motion in two sets of coordinates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ellipj, ellipk, elliprf, elliprj

import jaxlag as jl
from jaxlag import rigid

EULER = rigid.euler("zxz")
HEIGHT, MOMENTS, PARAMS = 0.1, np.array([2e-3, 2e-3, 8e-4]), {"m": 0.5, "g": 9.81}  # a top on its tip; moments about its centre


def top(rotation):
    """L of a body whose point (0, 0, −HEIGHT) stays at the origin."""
    position = lambda q: rotation(q) @ jnp.array([0.0, 0.0, HEIGHT])
    T = lambda q, qdot, m: rigid.kinetic_energy(m, MOMENTS, position, rotation)(q, qdot)
    return lambda q, qdot, m, g: T(q, qdot, m) - m * g * position(q)[2]


BY_ANGLES = jl.System(top(EULER))
BY_QUATERNION = jl.System(top(rigid.quaternion), holonomic={"unit": rigid.unit})
ANGLES, RATES = np.array([0.2, 0.6, -0.3]), np.array([0.0, 0.0, 90.0])  # released with a spin: the tip of its axis draws cusps


def as_quaternion(angles, rates):
    """The same start, by a quaternion."""
    q = rigid.to_quaternion(EULER(angles))
    return q, rigid.quaternion_rate(q, rigid.angular_velocity(EULER)(angles, rates))


def third_kind(n, amplitude, k2):
    """∫dα/((1 − n sin²α) √(1 − k² sin²α)) from 0 to an amplitude, of any number of turns (DLMF 19.25.14)."""
    turns = np.round(amplitude / np.pi)

    def within(alpha):
        s, c = np.sin(alpha), np.cos(alpha)
        given = c**2, 1 - k2 * s**2, 1.0
        return s * elliprf(*given) + n / 3 * s**3 * elliprj(*given, 1 - n * s**2)

    return within(amplitude - turns * np.pi) + 2 * turns * within(np.pi / 2)


@pytest.mark.slow
def test_a_heavy_top_by_angles_and_by_a_quaternion():
    """The same motion over 20 s, some 290 turns; and its nutation and precession by elliptic functions (Goldstein, section 5.7).

    u = cos θ moves between two zeros of u̇² = f(u), cubic, as u₁ + (u₂ − u₁) sn²(½√(β(u₃ − u₁)) (t − t₀)), and φ̇ = (b − au)/(1 − u²).
    """
    ts = np.linspace(0, 20, 401)
    tight = {"rtol": 1e-12, "atol": 1e-13}
    angles = jl.simulate(BY_ANGLES, ANGLES, RATES, ts, PARAMS, **tight)
    turned = jl.simulate(BY_QUATERNION, *as_quaternion(ANGLES, RATES), ts, PARAMS, **tight)
    axes = jax.vmap(EULER)(angles.q)
    np.testing.assert_allclose(axes, jax.vmap(rigid.quaternion)(turned.q), atol=1e-8)  # the spin, 1800 rad, included

    A, C, weight = MOMENTS[0] + 0.5 * HEIGHT**2, MOMENTS[2], 0.5 * 9.81 * HEIGHT
    u0, spin = np.cos(0.6), 90.0
    a, b, beta = C * spin / A, C * spin * u0 / A, 2 * weight / A
    alpha = beta * u0  # θ̇ = φ̇ = 0 at the start
    f = np.polynomial.Polynomial([alpha - b**2, 2 * a * b - beta, -alpha - a**2, beta])  # (1 − u²)(α − βu) − (b − au)²
    u1, u2, u3 = np.sort(f.roots().real)
    k2, rate = (u2 - u1) / (u3 - u1), 0.5 * np.sqrt(beta * (u3 - u1))
    np.testing.assert_allclose(u2, u0, rtol=1e-12)  # it falls from its highest point
    sn, _, _, amplitude = ellipj(rate * ts + ellipk(k2), k2)
    np.testing.assert_allclose(axes[:, 2, 2], u1 + (u2 - u1) * sn**2, atol=1e-8)
    parts = [(b - s * a) / 2 / (1 - s * u1) * third_kind(s * (u2 - u1) / (1 - s * u1), amplitude, k2) for s in (1, -1)]
    np.testing.assert_allclose(angles.q[:, 0] - ANGLES[0], (sum(parts) - sum(parts)[0]) / rate, atol=1e-8)

    phi_dot, theta_dot, _ = np.array(angles.qdot).T
    u, in_body = axes[:, 2, 2], np.array(jax.vmap(rigid.angular_velocity(rigid.quaternion))(turned.q, turned.qdot))
    np.testing.assert_allclose(A * (1 - u**2) * phi_dot + C * spin * u, C * spin * u0, rtol=1e-9)  # angular momentum about the vertical
    np.testing.assert_allclose(in_body[:, 2], spin, rtol=1e-9)  # and about the axis of the top
    energy = 0.5 * A * ((1 - u**2) * phi_dot**2 + theta_dot**2) + weight * u
    np.testing.assert_allclose(energy, weight * u0, rtol=1e-9)


@pytest.mark.slow
def test_the_card_says_where_angles_come_near_their_singularity():
    """φ and ψ turn about the same axis where θ = 0."""
    near, far = (jl.examine(BY_ANGLES, np.array([0.2, theta, 0.3]), RATES, PARAMS).findings for theta in (0.005, 0.2))
    (found,) = [finding for finding in near if "singularity" in finding]
    assert "'q[0]', 'q[2]'" in found and "quaternion" in found
    assert not any("singularity" in finding for finding in far)


@pytest.mark.slow
def test_a_spinning_wing_nut_turns_over_and_over():
    """Dzhanibekov's flips: ω in the axes of the body by Jacobi's functions (Landau & Lifshitz, Mechanics, section 37), I₁ < I₂ < I₃."""
    I = np.array([1.0, 2.0, 2.5])
    free = jl.System(lambda q, qdot: rigid.kinetic_energy(1.0, I, lambda q: jnp.zeros(3), rigid.quaternion)(q, qdot), holonomic=rigid.unit)
    w0 = np.array([0.05, 2.0, 0.0])
    q0 = np.array([1.0, 0.0, 0.0, 0.0])
    ts = np.linspace(0, 30, 301)
    motion = jl.simulate(free, q0, rigid.quaternion_rate(q0, w0), ts, rtol=1e-11, atol=1e-12)
    w = np.array(jax.vmap(rigid.angular_velocity(rigid.quaternion))(motion.q, motion.qdot))

    E2, M2 = I @ w0**2, I**2 @ w0**2  # 2E and M²
    assert E2 * I[1] > M2  # so that the roles of 1 and 3 are exchanged, and ω₁ keeps its sign
    k2 = (I[2] - I[1]) * (M2 - E2 * I[0]) / ((I[1] - I[0]) * (E2 * I[2] - M2))
    rate = np.sqrt((I[1] - I[0]) * (E2 * I[2] - M2) / np.prod(I))
    first, third = (np.sqrt(x / y) for x, y in ((E2 * I[2] - M2, I[0] * (I[2] - I[0])), (M2 - E2 * I[0], I[2] * (I[2] - I[0]))))
    second = np.sqrt((M2 - E2 * I[0]) / (I[1] * (I[1] - I[0])))
    sn, cn, dn, _ = ellipj(rate * ts + ellipk(k2), k2)  # ω₂ is greatest at the start
    expected = np.stack([first * dn, second * sn, third * cn], axis=1)
    np.testing.assert_allclose(w, expected, atol=1e-8)
    assert np.sum(np.diff(np.sign(w[:, 1])) != 0) >= 3  # it turns over
    L = np.einsum("tij,tj->ti", jax.vmap(rigid.quaternion)(motion.q), I * w)
    np.testing.assert_allclose(L, np.broadcast_to(I * w0, L.shape), atol=1e-9)


def disc(q):
    """A coin of zxz angles, its axle the z axis of the body."""
    return rigid.frame(q["x"], EULER(q["angles"]))


COIN = jl.System(
    lambda q, qdot, m, g, r: (
        rigid.kinetic_energy(m, rigid.inertia.cylinder(m, r, 0.0), lambda q: q["x"], lambda q: EULER(q["angles"]))(q, qdot)
        - m * g * q["x"][2]
    ),
    holonomic={"stands": lambda q, r: rigid.wheel_height(disc(q), r)},
    nonholonomic={"rolls": lambda q, qdot, r: rigid.rolling(disc, r)(q, qdot)},
)


@pytest.mark.slow
@pytest.mark.parametrize("theta", [1.2, 0.5])
def test_a_rolling_coin_runs_in_a_circle(theta):
    """(C + m r²) n Ω sin θ − A Ω² sin θ cos θ + m g r cos θ = 0, n the spin about its axle (Neimark & Fufaev, section II.2): as it begins,
    so it goes on, and its centre stays on a circle.
    """
    m, g, r, Omega = 0.3, 9.81, 0.1, 3.0
    A, C, s, c = m * r**2 / 4, m * r**2 / 2, np.sin(theta), np.cos(theta)
    n = (A * Omega**2 * s * c - m * g * r * c) / ((C + m * r**2) * Omega * s)
    angles, rates = np.array([0.0, theta, 0.0]), np.array([Omega, 0.0, n - Omega * c])
    x = np.array([0.0, 0.0, r * s])
    # rolling gives the centre its velocity: the point below is at rest
    still = jl.consistent_state(
        COIN, {"x": x, "angles": angles}, {"x": np.zeros(3), "angles": rates}, {"m": m, "g": g, "r": r}, fixed=["angles"]
    )
    ts = np.linspace(0, 4, 41)
    motion = jl.simulate(COIN, *still, ts, {"m": m, "g": g, "r": r}, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(motion.q["angles"][:, 1], theta, atol=1e-7)
    np.testing.assert_allclose(motion.qdot["angles"], np.broadcast_to(rates, (41, 3)), atol=1e-6)
    v = np.array(motion.qdot["x"])
    radius = np.linalg.norm(v[0]) / Omega
    centre = np.array(motion.q["x"][0]) + np.cross([0.0, 0.0, 1.0], v[0]) / Omega
    np.testing.assert_allclose(np.linalg.norm(np.array(motion.q["x"]) - centre, axis=1), radius, atol=1e-7)
    np.testing.assert_allclose(motion.multipliers["stands"], m * g, rtol=1e-6)


@pytest.mark.slow
def test_a_gradient_through_flips():
    """Of ω after 5 s by ω₂ at the start, which is rotation about the unstable axis, against differences of Jacobi's functions."""
    I, q0 = np.array([1.0, 2.0, 2.5]), jnp.array([1.0, 0.0, 0.0, 0.0])
    free = jl.System(lambda q, qdot: rigid.kinetic_energy(1.0, I, lambda q: jnp.zeros(3), rigid.quaternion)(q, qdot), holonomic=rigid.unit)

    def later(w2):
        start = rigid.quaternion_rate(q0, jnp.stack([0.05 + 0 * w2, w2, 0 * w2]))
        motion = jl.simulate(free, q0, start, [0.0, 5.0], rtol=1e-11, atol=1e-12)
        return rigid.angular_velocity(rigid.quaternion)(motion.q[-1], motion.qdot[-1])

    def by_jacobi(w2):
        w0 = np.array([0.05, w2, 0.0])
        E2, M2 = I @ w0**2, I**2 @ w0**2
        k2 = (I[2] - I[1]) * (M2 - E2 * I[0]) / ((I[1] - I[0]) * (E2 * I[2] - M2))
        sn, cn, dn, _ = ellipj(np.sqrt((I[1] - I[0]) * (E2 * I[2] - M2) / np.prod(I)) * 5.0 + ellipk(k2), k2)
        first, third = np.sqrt((E2 * I[2] - M2) / (I[0] * (I[2] - I[0]))), np.sqrt((M2 - E2 * I[0]) / (I[2] * (I[2] - I[0])))
        return np.array([first * dn, np.sqrt((M2 - E2 * I[0]) / (I[1] * (I[1] - I[0]))) * sn, third * cn])

    h = 1e-4
    expected = (8 * (by_jacobi(2 + h) - by_jacobi(2 - h)) - (by_jacobi(2 + 2 * h) - by_jacobi(2 - 2 * h))) / (12 * h)
    for derivative in (jax.jacfwd(later)(2.0), jax.jacrev(later)(2.0)):
        np.testing.assert_allclose(derivative, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


@pytest.mark.slow
def test_a_gradient_through_a_rolling_coin():
    """Of where it lies after half a second by its radius, forward and reverse, against differences."""
    angles, rates = jnp.array([0.0, 1.1, 0.0]), jnp.array([2.0, 0.3, 5.0])

    def later(r):
        given = {"m": 0.3, "g": 9.81, "r": r}
        start = {"x": jnp.stack([0 * r, 0 * r, r * jnp.sin(1.1)]), "angles": angles}, {"x": jnp.zeros(3), "angles": rates}
        still = jl.consistent_state(COIN, *start, given, fixed=["angles"])
        return jl.simulate(COIN, *still, [0.0, 0.5], given, rtol=1e-10, atol=1e-10).q["x"][-1]

    expected = (later(0.1001) - later(0.0999)) / 2e-4
    for derivative in (jax.jacfwd(later)(0.1), jax.jacrev(later)(0.1)):
        np.testing.assert_allclose(derivative, expected, rtol=0, atol=1e-5 * np.abs(expected).max())


@pytest.mark.slow
def test_a_gradient_through_a_top():
    """Of where it points after half a second by its mass, forward and reverse, against differences."""
    axis = lambda m: jl.simulate(BY_QUATERNION, *as_quaternion(ANGLES, RATES), [0.0, 0.5], {"m": m, "g": 9.81}).q[-1]
    expected = (axis(0.5001) - axis(0.4999)) / 2e-4
    found = jax.jit(lambda m: (jax.jacfwd(axis)(m), jax.jacrev(axis)(m)))(0.5)
    for derivative in found:
        np.testing.assert_allclose(derivative, expected, atol=1e-5)


def ball(q):
    return rigid.frame(q["x"], rigid.quaternion(q["p"]))


BALL = jl.System(
    lambda q, qdot, m, r, g, tilt: (
        rigid.kinetic_energy(m, rigid.inertia.sphere(m, r), lambda q: q["x"], lambda q: rigid.quaternion(q["p"]))(q, qdot)
        + m * g * (jnp.sin(tilt) * q["x"][0] - jnp.cos(tilt) * q["x"][2])
    ),
    holonomic={"unit": lambda q: rigid.unit(q["p"]), "stands": lambda q, r: rigid.on_plane(q["x"], rigid.frame()) - r},
    nonholonomic={"rolls": lambda q, qdot, r: rigid.rolling_ball(ball, r)(q, qdot)},
)


@pytest.mark.slow
def test_a_ball_rolls_down_a_slope():
    """Its centre falls with 5/7 g sin tilt, however it spins; the friction is 2/7 m g sin tilt (Goldstein, section 2.4, for a ball)."""
    m, g, r, tilt, spin = 0.5, 9.81, 0.1, 0.2, np.array([3.0, -2.0, 5.0])
    q0 = {"x": np.array([0.0, 0.0, r]), "p": np.array([1.0, 0.0, 0.0, 0.0])}
    qdot0 = {"x": np.cross(spin, [0.0, 0.0, r]), "p": rigid.quaternion_rate(q0["p"], spin)}
    ts = np.linspace(0, 2, 11)

    def run(tilt):
        motion = jl.simulate(BALL, q0, qdot0, ts, {"m": m, "g": g, "r": r, "tilt": tilt}, rtol=1e-10, atol=1e-12)
        return motion.q["x"][-1], (motion.q["x"], motion.multipliers)

    slope, (x, multipliers) = jax.jit(jax.jacfwd(run, has_aux=True))(tilt)
    way = qdot0["x"] * ts[:, None] + 5 / 14 * g * np.sin(tilt) * ts[:, None] ** 2 * np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(x, way + q0["x"], atol=1e-9)
    np.testing.assert_allclose(slope, [5 / 14 * g * np.cos(tilt) * 4, 0, 0], atol=1e-8)
    np.testing.assert_allclose(multipliers["rolls"], np.tile([-2 / 7 * m * g * np.sin(tilt), 0], (11, 1)), atol=1e-9)
    np.testing.assert_allclose(multipliers["stands"], m * g * np.cos(tilt), rtol=1e-9)
