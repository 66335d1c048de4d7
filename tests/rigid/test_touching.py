"""Gaps and slips of bodies that touch, against points that are searched for and moved by hand; and motions with closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxlag as jl
from jaxlag import rigid

RNG = np.random.default_rng(3)


def body(q):
    return rigid.frame(q[:3], rigid.rotation_vector(q[3:6]))


def ramp(q):
    return rigid.frame(q[6:9], rigid.rotation_vector(q[9:12]))


Q, QDOT = RNG.normal(size=(2, 12))
KINDS = {
    "ball": rigid.sphere_plane(body, 0.4, ramp),
    "box": rigid.box_plane(body, [0.2, 0.5, 0.9], ramp),
    "capsule": rigid.capsule_plane(body, 0.8, 0.3, ramp),
    "ellipsoid": rigid.ellipsoid_plane(body, [0.2, 0.5, 0.9], ramp),
    "balls": rigid.sphere_sphere(body, ramp, [0.3, 0.2]),
}


def surface(kind):
    """Points of the body's surface in its own axes: those of each gap."""
    directions = RNG.normal(size=(400_000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    if kind == "ball":
        return [0.4 * directions]
    if kind == "box":
        return [np.array([[x, y, z]]) for x in (-0.1, 0.1) for y in (-0.25, 0.25) for z in (-0.45, 0.45)]
    if kind == "capsule":
        return [np.array([0, 0, end]) + 0.3 * directions for end in (-0.4, 0.4)]
    return [directions * [0.2, 0.5, 0.9]]


@pytest.mark.parametrize("kind", ["ball", "box", "capsule", "ellipsoid"])
def test_gaps_are_the_least_heights(kind):
    """Of many points of the surface, in the axes that SciPy turns."""
    turned, (tilt, origin) = Rotation.from_rotvec(Q[3:6]), (Rotation.from_rotvec(Q[9:12]), Q[6:9])
    heights = [np.min((Q[:3] + turned.apply(points) - origin) @ tilt.as_matrix()[:, 2]) for points in surface(kind)]
    np.testing.assert_allclose(np.ravel(KINDS[kind].gap(Q)), heights, atol=2e-5)  # of as many points
    assert np.all(np.ravel(KINDS[kind].gap(Q)) <= np.array(heights) + 1e-12)


def test_balls_are_apart():
    assert KINDS["balls"].gap(Q) == pytest.approx(np.linalg.norm(Q[6:9] - Q[:3]) - 0.5)


@pytest.mark.parametrize("kind", KINDS)
def test_slip_and_rate_of_the_gap_are_those_of_points(kind):
    """Of the points that touch, held fast on each body: the rate of the gap along the normal, and the slip across it."""
    h = 1e-6

    def placed(q, first):
        return q[:3] if first else q[6:9], Rotation.from_rotvec(q[3:6] if first else q[9:12])

    n = Rotation.from_rotvec(Q[9:12]).as_matrix()[:, 2]
    if kind == "balls":
        n = -(Q[6:9] - Q[:3]) / np.linalg.norm(Q[6:9] - Q[:3])
    slips = np.reshape(KINDS[kind].slip(Q, QDOT), (-1, 2))
    rates = np.ravel(jax.jvp(KINDS[kind].gap, (Q,), (QDOT,))[1])
    centre, turned = placed(Q, True)
    squares = np.array([0.2, 0.5, 0.9]) ** 2
    along = turned.inv().apply(n)
    points = {
        "ball": [centre - 0.4 * n],
        "box": [centre + turned.apply(points[0]) for points in surface("box")],
        "capsule": [centre + turned.apply([0, 0, end]) - 0.3 * n for end in (-0.4, 0.4)],
        "ellipsoid": [centre - turned.apply(squares * along) / np.sqrt(squares @ along**2)],
        "balls": [centre - 0.3 * n],
    }[kind]
    for slip, rate, point in zip(slips, rates, points, strict=True):
        velocity = []
        for first, at in ((True, point), (False, Q[6:9] + 0.2 * n if kind == "balls" else point)):
            x, R = placed(Q, first)
            own = R.inv().apply(at - x)
            ends = [y + S.apply(own) for y, S in (placed(Q + sign * h * QDOT, first) for sign in (1, -1))]
            velocity.append((ends[0] - ends[1]) / (2 * h))
        against = velocity[0] - velocity[1]
        assert np.linalg.norm(slip) == pytest.approx(np.linalg.norm(against - n * (n @ against)), rel=1e-7)
        assert rate == pytest.approx(n @ against, abs=1e-7)
    if kind != "balls":  # along x and y of the plane
        axes = Rotation.from_rotvec(Q[9:12]).as_matrix()
        np.testing.assert_allclose(slips[-1], against @ axes[:, :2], atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_of_gaps_and_slips(kind):
    """Forward and reverse, against differences."""
    of = lambda q: jnp.sum(KINDS[kind].gap(q) ** 2) + jnp.sum(KINDS[kind].slip(q, QDOT) ** 2)
    reverse, forward = jax.grad(of)(Q), jax.jacfwd(of)(Q)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-9)
    one = np.eye(12) * 1e-6
    differences = [(of(Q + d) - of(Q - d)) / 2e-6 for d in one]
    np.testing.assert_allclose(forward, differences, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("n", [*np.eye(3), *-np.eye(3)])
def test_balls_one_above_the_other_or_side_by_side(n):
    """Along the axes, where a pair of directions across might have its jump: r₁ ω₁ and r₂ ω₂ across n add up, and nothing is NaN."""
    spins, h = RNG.normal(size=(2, 3)), 1e-6
    at = lambda x, i: lambda q: rigid.frame(x, rigid.rotation_vector(q[3 * i : 3 * i + 3]))
    touch = rigid.sphere_sphere(at(np.zeros(3), 0), at(0.5 * n, 1), [0.3, 0.2])
    slip = lambda spins: touch.slip(np.zeros(6), spins)
    across = np.cross(spins[0], 0.3 * n) - np.cross(spins[1], -0.2 * n)
    np.testing.assert_allclose(np.linalg.norm(slip(spins.ravel())), np.linalg.norm(across), rtol=1e-12)
    along = RNG.normal(size=6)
    differences = (slip(spins.ravel() + h * along) - slip(spins.ravel() - h * along)) / (2 * h)
    np.testing.assert_allclose(jax.jvp(slip, (spins.ravel(),), (along,))[1], differences, atol=1e-8)


@pytest.mark.parametrize("metre", [1.0, 1e-6])
def test_two_balls_collide(metre):
    """A central impact, oblique to the axes, of restitution e: velocities along the line by Newton's law, none across."""
    m, e, r = np.array([2.0, 0.5]), 0.6, 0.1 * metre
    n = np.array([1.0, 2.0, -2.0]) / 3
    at = lambda name: lambda q: rigid.frame(q[name])
    touch = rigid.sphere_sphere(at("a"), at("b"), [r, r])
    system = jl.System(
        lambda qdot: 0.5 * m[0] * qdot["a"] @ qdot["a"] + 0.5 * m[1] * qdot["b"] @ qdot["b"],
        unilateral={"balls": jl.Contact(touch.gap, restitution=e)},
    )
    start = {"a": np.zeros(3), "b": 1.2 * metre * n}, {"a": 3 * metre * n, "b": np.zeros(3)}
    motion = jl.simulate(system, *start, jnp.linspace(0, 1, 3), {})
    v = 3 * metre * (m[0] - e * m[1]) / m.sum(), 3 * metre * (1 + e) * m[0] / m.sum()
    for name, speed in zip("ab", v, strict=True):
        np.testing.assert_allclose(motion.qdot[name][-1], speed * n, atol=1e-9 * metre)
    np.testing.assert_allclose(motion.contacts["balls"].changed[-1], 1.0 / 3, rtol=1e-9)


@pytest.mark.slow
def test_a_ball_on_a_belt():
    """A ball that is put on a belt of speed u slips until 2 u/(7 μ g), and rolls on at 2 u/7; the belt is a plane that moves."""
    m, r, mu, u = 0.3, 0.05, 0.2, 1.5
    ball = lambda q: rigid.frame(jnp.stack([q["x"], jnp.zeros(()), q["y"]]), rigid.rotation_y(q["phi"]))
    belt = lambda q: rigid.frame(jnp.stack([q["belt"], jnp.zeros(()), jnp.zeros(())]))
    touch = rigid.sphere_plane(ball, r, belt)

    def rubbing(q, qdot, multipliers, mu):
        return mu * multipliers["belt"] * jnp.abs(touch.slip(q, qdot)[0])

    system = jl.System(
        lambda q, qdot, g: (
            0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2 + 0.4 * r**2 * qdot["phi"] ** 2) + 0.5 * qdot["belt"] ** 2 - m * g * q["y"]
        ),
        dissipation={"rub": rubbing},
        unilateral={"belt": touch.gap},
        nonholonomic={"driven": lambda qdot: qdot["belt"] - u},
    )
    q0, qdot0 = {"x": 0.0, "y": r, "phi": 0.0, "belt": 0.0}, {"x": 0.0, "y": 0.0, "phi": 0.0, "belt": u}
    until = 2 * u / (7 * mu * 9.81)
    motion = jl.simulate(system, q0, qdot0, jnp.array([0.0, 0.5 * until, 1.01 * until, 3 * until]), {"g": 9.81, "mu": mu})
    np.testing.assert_allclose(motion.qdot["x"], [0, u / 7, 2 * u / 7, 2 * u / 7], atol=1e-8)
    np.testing.assert_allclose(motion.qdot["phi"][-1], -(u - 2 * u / 7) / r, rtol=1e-8)
    np.testing.assert_array_equal(motion.friction["rub"].sticking, [False, False, True, True])


def test_what_is_no_shape():
    for make in (
        lambda: rigid.box_plane(body, 1.0),
        lambda: rigid.ellipsoid_plane(body, [1.0]),
        lambda: rigid.sphere_sphere(body, ramp, 1.0),
    ):
        with pytest.raises(ValueError, match="must be . numbers"):
            make()
    for make in (lambda: rigid.sphere_plane(body(Q), 0.4), lambda: rigid.sphere_sphere(body, ramp(Q), [1.0, 1.0])):
        with pytest.raises(TypeError, match="must be a function of q, whose value is a `Frame`"):
            make()
