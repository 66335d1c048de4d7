"""Angular velocities of rotations that are composed in every way, against RᵀṘ differentiated as a whole."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxlag import rigid
from jaxlag.rigid._vectors import skew

CONSTANT = Rotation.from_euler("xyz", [0.3, -0.8, 1.1]).as_matrix()
STRETCH = np.array([[2.0, 0.3, 0.0], [0.1, 0.5, 0.0], [0.0, 0.2, 1.0]])  # turns by no rotation: a factor that is none
cayley = lambda q: jnp.linalg.inv(jnp.eye(3) - skew(q[:3])) @ (jnp.eye(3) + skew(q[:3]))  # of two factors that are none
LEAVES = [
    lambda q: rigid.rotation_x(q[0]),
    lambda q: rigid.rotation_y(q[1] * q[2]),
    lambda q: rigid.rotation_z(jnp.sin(q[3])),
    lambda q: rigid.rotation_z(0.4),
    lambda q: rigid.rotation(q[:3], q[3]),
    lambda q: rigid.rotation([1.0, 2.0, -1.0], q[1]),
    lambda q: rigid.quaternion(q),
    lambda q: rigid.quaternion([0.5, 0.1, -0.2, 0.3]),
    lambda q: rigid.rotation_vector(q[1:]),
    lambda q: rigid.euler("zxz")(q[1:]),
    lambda q: CONSTANT,
    cayley,
    jax.jit(lambda q: rigid.rotation_x(q[2]) @ rigid.rotation_y(q[0])),
]
JOINS = [
    lambda A, B: lambda q: A(q) @ B(q),
    lambda A, B: lambda q: A(q).T @ B(q),
    lambda A, B: lambda q: jnp.dot(A(q), jnp.transpose(B(q))),
    lambda A, B: lambda q: jnp.einsum("ij,kj->ik", A(q), B(q)),
    lambda A, B: lambda q: jnp.linalg.multi_dot([A(q), B(q), jnp.asarray(A(q)).T]),
    lambda A, B: lambda q: (A(q) @ STRETCH) @ (jnp.linalg.inv(STRETCH) @ B(q)),
    lambda A, B: lambda q: jnp.stack([jnp.asarray(A(q))[:, i] for i in range(3)], axis=1) @ B(q),
]


def composed(rng, depth):
    """A rotation of four numbers, of as many as 2^depth factors."""
    if depth == 0:
        return LEAVES[rng.integers(len(LEAVES))]
    return JOINS[rng.integers(len(JOINS))](composed(rng, depth - 1), composed(rng, depth - 1))


def as_a_whole(rotation, q, qdot):
    R, rate = jax.jvp(lambda q: jnp.asarray(rotation(q)), (q,), (qdot,))
    return jnp.stack([R[:, 2] @ rate[:, 1], R[:, 0] @ rate[:, 2], R[:, 1] @ rate[:, 0]])


@pytest.mark.parametrize("seed", [*range(12), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(12, 60))])
def test_of_factors_as_of_the_whole(seed):
    rng = np.random.default_rng(seed)
    rotation, (q, qdot) = composed(rng, seed % 3), jnp.asarray(rng.normal(size=(2, 4)))
    omega = rigid.angular_velocity(rotation)
    np.testing.assert_allclose(omega(q, qdot), as_a_whole(rotation, q, qdot), atol=1e-12)
    np.testing.assert_allclose(rigid.angular_velocity(rotation, "world")(q, qdot), rotation(q) @ omega(q, qdot), atol=1e-12)
    if seed % 6 == 5:  # both derivatives of a product of four
        for derivative in (jax.jacfwd, jax.jacrev):
            found, expected = (derivative(f, argnums=(0, 1))(q, qdot) for f in (omega, lambda *x: as_a_whole(rotation, *x)))
            np.testing.assert_allclose(found, expected, atol=1e-11)


@pytest.mark.fast
@pytest.mark.parametrize("leaf", range(len(LEAVES)))
def test_of_each_rotation(leaf):
    q, qdot = jnp.asarray(np.random.default_rng(leaf).normal(size=(2, 4)))
    found, expected = rigid.angular_velocity(LEAVES[leaf])(q, qdot), as_a_whole(LEAVES[leaf], q, qdot)
    np.testing.assert_allclose(found, expected, atol=1e-14)


def by_koenig(m, Theta, position, rotation, q, qdot):
    """½ m v² + ½ ω·Θω, with R differentiated as a whole."""
    v, w = jax.jvp(position, (q,), (qdot,))[1], as_a_whole(rotation, q, qdot)
    return 0.5 * m * (v @ v) + 0.5 * w @ (jnp.diag(Theta) if jnp.ndim(Theta) == 1 else Theta) @ w


@pytest.mark.parametrize("seed", range(8))
def test_of_several_bodies_of_which_one_carries_another(seed):
    """In a dict and in a list, from one program, whatever their rotations have in common."""
    rng = np.random.default_rng(seed)
    leaf = lambda: LEAVES[rng.integers(len(LEAVES))]
    first, second, third = leaf(), leaf(), leaf()

    def arms(q):
        arm = rigid.frame(q[:3], first(q))
        tool = arm.on([0.0, q[1], 0.5], second(q))
        return {"arm": arm, "wheel": tool.on([1.0, 0.0, 0.0]).on(axes=third(q)).on(axes=rigid.rotation_z(q[3])), "tool": tool}

    m, Theta = {"arm": 2.0, "tool": 0.5, "wheel": 1.5}, {"arm": [1.0, 2.0, 2.5], "tool": CONSTANT @ np.diag([3.0, 4, 5]) @ CONSTANT.T}
    Theta |= {"wheel": [1.0, 1.0, 1.8]}
    q, qdot = jnp.asarray(rng.normal(size=(2, 4)))
    part = lambda name: (lambda q: arms(q)[name].origin, lambda q: arms(q)[name].axes)
    expected = sum(by_koenig(m[name], jnp.asarray(Theta[name]), *part(name), q, qdot) for name in m)
    np.testing.assert_allclose(rigid.kinetic_energy(m, Theta, arms)(q, qdot), expected, rtol=1e-12)
    in_order = lambda bodies: [bodies[name] for name in m]
    listed = rigid.kinetic_energy(in_order(m), in_order(Theta), lambda q: in_order(arms(q)))(q, qdot)
    np.testing.assert_allclose(listed, expected, rtol=1e-12)
    alone = rigid.kinetic_energy(1.5, Theta["wheel"], lambda q: arms(q)["wheel"])(q, qdot)
    np.testing.assert_allclose(alone, by_koenig(1.5, jnp.array(Theta["wheel"]), *part("wheel"), q, qdot), rtol=1e-12)


@pytest.mark.parametrize("axis", range(3))
def test_how_far_a_wheel_has_turned_does_not_matter(axis):
    """Where two moments are one number, be it known or traced: T does not depend on the last angle, and its derivatives are right."""
    last = (rigid.rotation_x, rigid.rotation_y, rigid.rotation_z)[axis]
    turned = lambda q: rigid.rotation_vector(q[:3]) @ last(q[3])
    position = lambda q: q[:3]
    q, qdot = jnp.asarray(np.random.default_rng(axis).normal(size=(2, 4)))
    Theta = lambda A, C: [C if i == axis else A for i in range(3)]
    T = lambda q, A, C: rigid.kinetic_energy(2.0, Theta(A, C), position, turned)(q, qdot)
    whole = lambda q, A, C: by_koenig(2.0, jnp.stack(Theta(A, C)), position, turned, q, qdot)
    A, C = jnp.array(1.2), jnp.array(0.8)
    found, expected = (jax.grad(f, argnums=(0, 1, 2))(q, A, C) for f in (T, whole))
    for have, want in zip(found, expected, strict=True):
        np.testing.assert_allclose(have, want, atol=1e-12)
    assert found[0][3] == 0
    np.testing.assert_allclose(T(q, 1.2, 0.8), whole(q, A, C), rtol=1e-12)
    np.testing.assert_allclose(T(q, 1.2, 1.2), whole(q, A, A), rtol=1e-12)


def test_a_wheel_that_is_none_keeps_its_angle():
    """Two moments that are equal only by their values of now, inside a program; a matrix; a rotation about another axis."""
    turned = lambda q: rigid.rotation_vector(q[:3]) @ rigid.rotation_z(q[3])
    q, qdot = jnp.asarray(np.random.default_rng(5).normal(size=(2, 4)))
    still = lambda q: jnp.zeros(3)
    T = lambda Theta: rigid.kinetic_energy(2.0, Theta, still, turned)(q, qdot)
    whole = lambda Theta: by_koenig(2.0, Theta, still, turned, q, qdot)
    for given in (jnp.array([1.0, 1.0, 0.5]), jnp.diag(jnp.array([1.0, 1.0, 0.5])), jnp.array([0.5, 1.0, 1.0])):
        np.testing.assert_allclose(jax.grad(T)(given), jax.grad(whole)(given), atol=1e-12)
        np.testing.assert_allclose(T(given), whole(given), rtol=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_a_wheel_slips_as_the_point_that_touches(seed):
    """The velocity of a point that is fixed to the wheel, by differentiating its place."""
    rng = np.random.default_rng(seed)
    turned = composed(rng, seed % 3)
    wheel = lambda q: rigid.frame(q[1:], turned(q)).on(axes=rigid.rotation_z(q[0]))
    plane = rigid.frame([0.1, 0.2, 0.3], Rotation.from_euler("xyz", rng.normal(size=3)).as_matrix())
    q, qdot = jnp.asarray(rng.normal(size=(2, 4)))
    n, e = np.array(plane.axes[:, 2]), np.array(wheel(q).axes[:, 2])
    down = -0.4 * (n - (n @ e) * e) / np.linalg.norm(n - (n @ e) * e)
    for rolls, rho in ((rigid.rolling, down), (rigid.rolling_ball, -0.4 * n)):
        touching = wheel(q).axes.T @ rho
        velocity = jax.jvp(lambda q, at=touching: wheel(q).point(at), (q,), (qdot,))[1]
        np.testing.assert_allclose(rolls(wheel, 0.4, plane)(q, qdot), plane.axes[:, :2].T @ velocity, atol=1e-12)


NOT_THE_SAME = {
    "one_inertia": (dict(m={"a": 1.0, "b": 1.0}, Theta=[1.0, 1.0, 1.0]), "`Theta` must have an entry for each of 'a', 'b', .* has 0, 1, 2"),
    "one_frame": (dict(m=[1.0], Theta=[[1.0, 1.0, 1.0]]), "`position` must have an entry for each of 0, .* is one. Name the same"),
    "no_frame": (dict(m=1.0, Theta=[1.0, 1.0, 1.0], position=lambda q: q), r"`position` must return a `Frame`.*Give `rotation`"),
    "no_body": (dict(m={"a": 1.0}, Theta={"a": [1.0, 1.0, 3.0]}), r"`Theta\['a'\]` must have moments"),
}


@pytest.mark.parametrize("name", NOT_THE_SAME)
def test_bodies_that_do_not_fit_together_are_refused(name):
    given, message = NOT_THE_SAME[name]
    with pytest.raises(ValueError, match=message):
        rigid.kinetic_energy(**({"position": lambda q: rigid.frame()} | given))(jnp.zeros(3), jnp.zeros(3))


def test_the_kinetic_energy_is_a_short_program():
    """By hand ω has 26 operations for Euler angles; RᵀṘ of their product has hundreds."""
    T = rigid.kinetic_energy(1.0, [1.0, 2.0, 2.5], lambda q: jnp.zeros(3), rigid.euler("zxz"))
    cost = jax.jit(T).lower(jnp.ones(3), jnp.ones(3)).compile().cost_analysis()
    assert cost["flops"] < 120, cost["flops"]


def test_a_function_with_the_name_of_a_rotation_is_none():
    @jax.jit
    def _about_x(angle):
        return rigid.rotation_z(2 * angle)

    np.testing.assert_allclose(rigid.angular_velocity(_about_x)(0.3, 1.0), [0.0, 0.0, 2.0], atol=1e-15)


def test_an_array_beside_q_and_batches():
    """A rotation that the parameters turn, inside `vmap` and `jit`."""

    def omega(offset, angle, rate):
        return rigid.angular_velocity(lambda q: rigid.rotation_vector(offset) @ rigid.rotation_x(q) @ CONSTANT)(angle, rate)

    offsets, angles = np.random.default_rng(0).normal(size=(5, 3)), np.arange(5.0)
    found = jax.jit(jax.vmap(omega))(offsets, angles, angles)
    np.testing.assert_allclose(found, angles[:, None] * CONSTANT[0], atol=1e-14)
