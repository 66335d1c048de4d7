"""Angular velocities of rotations that are composed in every way, against RᵀṘ differentiated as a whole."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxlag import rigid
from jaxlag.rigid._vectors import skew

pytestmark = pytest.mark.fast
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


@pytest.mark.parametrize("seed", range(60))
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


@pytest.mark.parametrize("leaf", range(len(LEAVES)))
def test_of_each_rotation(leaf):
    q, qdot = jnp.asarray(np.random.default_rng(leaf).normal(size=(2, 4)))
    found, expected = rigid.angular_velocity(LEAVES[leaf])(q, qdot), as_a_whole(LEAVES[leaf], q, qdot)
    np.testing.assert_allclose(found, expected, atol=1e-14)


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
