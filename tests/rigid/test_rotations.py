"""Rotations against SciPy's, and their derivatives against those of the matrix exponential."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxlag as jl
from jaxlag import rigid

SEQUENCES = [a + b + c for a in "xyz" for b in "xyz" for c in "xyz" if a != b != c]


@pytest.mark.parametrize("sequence", SEQUENCES)
def test_euler_angles(sequence):
    """SciPy writes axes that turn with the body in capitals."""
    angles = np.random.default_rng(1).uniform(-3, 3, (20, 3))
    expected = Rotation.from_euler(sequence.upper(), angles).as_matrix()
    np.testing.assert_allclose(jax.vmap(rigid.euler(sequence))(angles), expected, atol=1e-14)


@pytest.mark.fast
def test_other_rotations():
    rng = np.random.default_rng(2)
    q, r = rng.normal(size=(20, 4)), rng.normal(size=(20, 3)) * rng.uniform(0, 3, (20, 1))
    np.testing.assert_allclose(jax.vmap(rigid.quaternion)(q), Rotation.from_quat(np.roll(q, -1, axis=1)).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(jax.vmap(rigid.rotation_vector)(r), Rotation.from_rotvec(r).as_matrix(), atol=1e-14)
    lengths = np.linalg.norm(r, axis=1)
    np.testing.assert_allclose(jax.vmap(rigid.rotation)(5 * r, lengths), Rotation.from_rotvec(r).as_matrix(), atol=1e-14)
    for axis, single in zip("xyz", (rigid.rotation_x, rigid.rotation_y, rigid.rotation_z), strict=True):
        np.testing.assert_allclose(single(0.7), Rotation.from_euler(axis, 0.7).as_matrix(), atol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.0, 1e-9, 0.5, 1 - 1e-9, 1 + 1e-9, 3.0])
def test_rotation_vectors_have_the_derivatives_of_the_exponential(size):
    """At rest, and where the series ends; of three orders, against JAX's expm."""
    along, across = jnp.array([0.6, -0.48, 0.64]), jnp.array([0.3, 0.5, -0.2])

    def of(matrix):
        return lambda s: matrix((size + s) * along + s**2 * across)

    def skew(r):
        return jnp.array([[0, -r[2], r[1]], [r[2], 0, -r[0]], [-r[1], r[0], 0]])

    found, expected = of(rigid.rotation_vector), of(lambda r: jax.scipy.linalg.expm(skew(r)))
    for _ in range(3):
        found, expected = jax.jacfwd(found), jax.jacfwd(expected)
        np.testing.assert_allclose(found(0.0), expected(0.0), atol=1e-12)


def test_the_margin_of_euler_angles_is_the_inverse_of_the_largest_rate_they_take():
    """The least singular value of ∂ω/∂(rates of the angles) is zero where the margin is."""
    for sequence in ("zxz", "zyx"):
        rotation = rigid.euler(sequence)
        for beta in (0.0, 0.4, np.pi / 2, 2.5):
            angles = jnp.array([0.3, beta, 1.0])
            J = jax.jacfwd(lambda rates, rotation=rotation, angles=angles: rigid.angular_velocity(rotation)(angles, rates))(jnp.zeros(3))
            np.testing.assert_allclose(abs(np.linalg.det(J)), rotation.margin(angles), atol=1e-14)


@pytest.mark.fast
def test_quaternions_of_rotations_and_their_rates():
    """Also where w is next to nothing; the rate by its angular velocity."""
    rng = np.random.default_rng(7)
    for angle in (*rng.uniform(0, np.pi, 20), np.pi - 1e-9):
        axis = rng.normal(size=3)
        R, omega = rigid.rotation(axis, angle), rng.normal(size=3)
        q = rigid.to_quaternion(R)
        assert q[0] >= 0
        np.testing.assert_allclose(q @ q, 1.0, rtol=1e-15)
        np.testing.assert_allclose(rigid.quaternion(q), R, atol=1e-15)
        rate = rigid.quaternion_rate(q, omega)
        np.testing.assert_allclose(rigid.angular_velocity(rigid.quaternion)(q, rate), omega, atol=1e-14)
        np.testing.assert_allclose(q @ rate, 0, atol=1e-15)
    turned = jax.jacfwd(lambda a: rigid.to_quaternion(rigid.rotation_x(a)))(0.4)
    np.testing.assert_allclose(turned, [-np.sin(0.2) / 2, np.cos(0.2) / 2, 0, 0], atol=1e-15)


@pytest.mark.fast
def test_single_precision_stays():
    q = jnp.array([1.0, 0.1, 0.2, 0.3], jnp.float32)
    for value in (
        rigid.quaternion(q),
        rigid.rotation_vector(q[1:]),
        rigid.euler("zxz")(q[1:]),
        rigid.rotation(q[1:], q[0]),
        rigid.unit(q),
        rigid.inertia.sphere(q[0], q[1]),
    ):
        assert value.dtype == jnp.float32


BAD = {
    "repeated axis": (lambda: rigid.euler("zzx"), "must not turn twice about the same axis"),
    "no axis": (lambda: rigid.euler("abc"), "three of the letters x, y, z"),
    "four angles": (lambda: rigid.euler("zxz")([1.0, 2.0, 3.0, 4.0]), "must be three numbers"),
    "zero axis": (lambda: rigid.rotation([0.0, 0.0, 0.0], 1.0), "must point somewhere"),
    "short quaternion": (lambda: rigid.quaternion([1.0, 0.0, 0.0]), "must be 4 numbers"),
    "reflection": (lambda: rigid.frame(axes=np.diag([1.0, 1.0, -1.0])), "is a reflection"),
    "stretched": (lambda: rigid.frame(axes=1.01 * np.eye(3)), "off orthogonal unit vectors by 0.02"),
    "no matrix": (lambda: rigid.frame(axes=np.ones(3)), r"shape (3, 3)"),
    "no rotation of a body": (lambda: rigid.angular_velocity(lambda q: q * jnp.eye(3))(2.0, 1.0), "must be a rotation"),
    "no axes": (lambda: rigid.angular_velocity(rigid.quaternion, "space"), "'body' or 'world'"),
    "one point": (lambda: rigid.length([0.0, 0.0, 0.0]), "at least two"),
    "triangle": (lambda: rigid.inertia.matrix([1.0, 1.0, 2.1]), "more than the sum of the others"),
    "negative": (lambda: rigid.kinetic_energy(1.0, [-1.0, 1.0, 1.0], rigid.unit, rigid.unit), "none is negative"),
    "skew inertia": (lambda: rigid.inertia.matrix(np.triu(np.ones((3, 3)))), "must be symmetric"),
    "flat body": (lambda: rigid.inertia.log_cholesky(1.0, np.zeros(3), [1.0, 1.0, 2.0]), "some thickness"),
}


@pytest.mark.fast
@pytest.mark.parametrize("case", BAD)
def test_what_is_no_rotation_or_no_body_is_refused_with_the_cure(case):
    make, said = BAD[case]
    with pytest.raises(ValueError) as error:
        make()
    assert said in str(error.value) and str(error.value).endswith(".")


@pytest.mark.slow
def test_a_quaternion_of_another_length_is_put_on_its_constraint_and_that_is_said():
    system = jl.System(
        lambda q, qdot: rigid.kinetic_energy(1.0, [1.0, 2.0, 2.5], lambda q: jnp.zeros(3), rigid.quaternion)(q, qdot), holonomic=rigid.unit
    )
    motion = jl.simulate(system, np.array([2.0, 0.0, 0.0, 0.0]), np.zeros(4), np.linspace(0, 1, 3))
    np.testing.assert_allclose(motion.q[0], [1.0, 0.0, 0.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(motion.stats["start_moved"], 1.0, rtol=1e-15)
