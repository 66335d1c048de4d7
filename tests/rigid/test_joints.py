"""Joints: their freedoms, and their forces on a body that an external force and moment load where the joint holds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag import rigid

SPIN = rigid.angular_velocity(lambda q: rigid.rotation_vector(q["r"]), "world")
AT, TURNED = np.array([0.3, -0.2, 0.5]), np.array([0.4, 0.1, -0.7])  # of the joint on the body
PLACE, TURN = np.array([1.0, 2.0, -1.0]), np.array([0.5, -0.8, 0.3])  # of the body
ONE, NONE = np.eye(3), np.zeros((0, 3))
JOINTS = {  # the directions in which each joint can push and turn, in the axes of its second frame
    "spherical": (rigid.spherical, None, NONE),
    "revolute": (rigid.revolute, None, ONE[:2]),
    "prismatic": (rigid.prismatic, ONE[:2], ONE),
    "cylindrical": (rigid.cylindrical, ONE[:2], ONE[:2]),
    "universal": (rigid.universal, None, ONE[2:]),
    "fixed": (rigid.fixed, None, ONE),
}


def body(q):
    return rigid.frame(q["x"], rigid.rotation_vector(q["r"]))


@pytest.mark.slow
@pytest.mark.parametrize("name", JOINTS)
def test_forces_of_a_joint_on_a_body_at_rest(name):
    """External force F at the centre and moment N:  f + F = 0,  μ + N + a × f = 0,  with a from the centre to the joint."""
    joint, pushes, turns = JOINTS[name]
    pose = {"x": jnp.array(PLACE), "r": jnp.array(TURN)}
    seat = body(pose).on(AT, rigid.rotation_vector(TURNED))
    rows = joint(body(pose).on(AT, rigid.rotation_vector(TURNED)), seat)
    np.testing.assert_allclose(rows, 0, atol=1e-15)
    assert rows.size == (3 if pushes is None else len(pushes)) + len(turns)

    rng, axes = np.random.default_rng(6), np.array(seat.axes)
    directions = ONE if pushes is None else pushes @ axes.T  # of a joint that holds a point, in space
    f, mu = rng.normal(size=len(directions)), rng.normal(size=len(turns))
    force, moment = f @ directions, mu @ turns @ axes.T
    outer = -force, -(moment + np.cross(np.array(seat.origin) - PLACE, force))

    def load(q, qdot):
        return jax.grad(lambda v: outer[0] @ v["x"] + outer[1] @ SPIN(q, v))(qdot)

    def lagrangian(q, qdot):
        return rigid.kinetic_energy(2.0, [0.3, 0.4, 0.5], lambda q: q["x"], lambda q: rigid.rotation_vector(q["r"]))(q, qdot)

    held = lambda q: joint(body(q).on(AT, rigid.rotation_vector(TURNED)), seat)
    system = jl.System(lagrangian, force={"load": load}, holonomic={"joint": held})
    found = jl.acceleration(system, pose, jax.tree.map(jnp.zeros_like, pose))
    np.testing.assert_allclose(found.multipliers["joint"], [*f, *mu], rtol=1e-11, atol=1e-11)
    for part in found.qddot.values():
        np.testing.assert_allclose(part, 0, atol=1e-11)


FREE = {  # motions that a joint leaves free, by an amount
    "spherical": [rigid.rotation_x, rigid.rotation_y, rigid.rotation_z],
    "revolute": [rigid.rotation_z],
    "prismatic": [],
    "cylindrical": [rigid.rotation_z],
    "universal": [rigid.rotation_x, rigid.rotation_y],
    "fixed": [],
}


@pytest.mark.fast
@pytest.mark.parametrize("name", JOINTS)
def test_a_joint_leaves_its_freedoms(name):
    """Also by large amounts; and no others."""
    joint, seat = JOINTS[name][0], rigid.frame(PLACE, rigid.rotation_vector(TURN))
    for turn in FREE[name]:
        np.testing.assert_allclose(joint(seat.on(axes=turn(1.1)), seat), 0, atol=1e-15)
    if name in ("prismatic", "cylindrical"):
        np.testing.assert_allclose(joint(seat.on([0.0, 0.0, 2.0]), seat), 0, atol=1e-15)
    moved = lambda x: joint(seat.on(x[:3], rigid.rotation_vector(x[3:])), seat)
    G = jax.jacfwd(moved)(jnp.zeros(6))
    assert np.linalg.matrix_rank(G) == len(G) == 6 - len(FREE[name]) - (name in ("prismatic", "cylindrical"))


@pytest.mark.fast
def test_the_length_of_a_rope_over_a_pulley_and_heights():
    np.testing.assert_allclose(rigid.length([0.0, 0.0, 0.0], [3.0, 4.0, 0.0], [3.0, 4.0, 2.0]), 7.0)
    slope = rigid.frame([0.0, 0.0, 1.0], rigid.rotation_y(0.3))
    np.testing.assert_allclose(rigid.on_plane([0.0, 0.0, 3.0], slope), 2 * np.cos(0.3))
    np.testing.assert_allclose(rigid.on_plane(slope.point([5.0, -3.0, 0.0]), slope), 0, atol=1e-15)


@pytest.mark.fast
def test_a_wheel_on_a_slope_rolls():
    """An upright wheel whose axle is horizontal runs down by r φ; a tilted one stands on its lowest point, by search along the rim."""
    slope = rigid.frame([0.0, 0.0, 1.0], rigid.rotation_y(0.3))
    upright = lambda q: slope.on([q[0], 0.0, 0.5], rigid.rotation_x(-np.pi / 2) @ rigid.rotation_z(q[1]))
    np.testing.assert_allclose(rigid.wheel_height(upright([2.0, 1.0]), 0.5, slope), 0, atol=1e-15)
    np.testing.assert_allclose(rigid.rolling(upright, 0.5, slope)([2.0, 1.0], [1.0, 2.0]), 0, atol=1e-15)
    wheel = rigid.frame([0.1, 0.2, 0.9], rigid.rotation_vector([1.0, 0.4, -0.3]))
    angles = np.linspace(0, 2 * np.pi, 100_001)
    heights = 0.9 + 0.5 * (np.cos(angles) * float(wheel.axes[2, 0]) + np.sin(angles) * float(wheel.axes[2, 1]))
    np.testing.assert_allclose(rigid.wheel_height(wheel, 0.5), np.min(heights), atol=1e-9)
