"""A chain of many bodies, by the joints between them, against the same chain in its angles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

BODIES, OFFSET, LENGTH, INERTIA = 40, 0.3, 0.5, 0.02
TS = np.linspace(0.0, 0.5, 11)
PARAMS = {"m": 1.3, "g": 9.81, "b": 0.02}
ANGLES, RATES = 0.4 * np.sin(np.arange(BODIES)), np.cos(np.arange(BODIES))


def across(phi):
    return jnp.stack([-jnp.sin(phi), jnp.cos(phi)], axis=1)


def along(phi):
    return jnp.stack([jnp.cos(phi), jnp.sin(phi)], axis=1)


def energies(r, v, phi, omega, m, g):
    """T − V of bodies whose center of mass lies beside their joint at r."""
    center = v + OFFSET * omega[:, None] * across(phi)
    heights = r[:, 1] + OFFSET * jnp.sin(phi)
    return 0.5 * m * jnp.sum(center**2) + 0.5 * INERTIA * jnp.sum(omega**2) - m * g * jnp.sum(heights)


def joints_of(phi):
    return LENGTH * (jnp.cumsum(along(phi), axis=0) - along(phi))


def in_angles(q, qdot, m, g):
    r, v = jax.jvp(joints_of, (q["phi"],), (qdot["phi"],))
    return energies(r, v, q["phi"], qdot["phi"], m, g)


def in_places(q, qdot, m, g):
    return energies(q["r"], qdot["r"], q["phi"], qdot["phi"], m, g)


def gaps(q):
    ends = q["r"] + LENGTH * along(q["phi"])
    return q["r"] - jnp.concatenate([jnp.zeros((1, 2)), ends[:-1]])


friction = lambda qdot, b: 0.5 * b * jnp.sum(jnp.diff(qdot["phi"]) ** 2)
BY_ANGLES = jl.System(in_angles, dissipation={"bearings": friction})
BY_JOINTS = jl.System(in_places, dissipation={"bearings": friction}, holonomic={"joints": gaps})
PLACES = {"r": np.asarray(joints_of(ANGLES)), "phi": ANGLES}
VELOCITIES = {"r": np.asarray(jax.jvp(joints_of, (jnp.asarray(ANGLES),), (jnp.asarray(RATES),))[1]), "phi": RATES}


def by_joints(**changed):
    return jl.simulate(BY_JOINTS, PLACES, VELOCITIES, TS, PARAMS | changed, works=True)


def by_angles(**changed):
    return jl.simulate(BY_ANGLES, {"phi": ANGLES}, {"phi": RATES}, TS, PARAMS | changed)


@pytest.fixture(scope="module")
def motion():
    return by_joints()


@pytest.mark.slow
def test_the_motion_is_that_of_its_angles(motion):
    expected = by_angles()
    np.testing.assert_allclose(motion.q["phi"], expected.q["phi"], rtol=0, atol=1e-6)
    np.testing.assert_allclose(motion.qddot["phi"], expected.qddot["phi"], rtol=0, atol=1e-5 * np.abs(expected.qddot["phi"]).max())
    assert np.abs(jax.vmap(gaps)(motion.q)).max() < 1e-10
    assert np.abs(motion.balance()).max() < 1e-7


@pytest.mark.slow
def test_the_force_at_the_top_carries_the_chain(motion):
    """λ of the first joint is the force on all bodies together: their momentum changes by it and by their weights."""
    center = lambda q, a, v: a["r"] + OFFSET * (a["phi"][:, None] * across(q["phi"]) - v["phi"][:, None] ** 2 * along(q["phi"]))
    accelerations = jax.vmap(center)(motion.q, motion.qddot, motion.qdot)
    expected = PARAMS["m"] * (jnp.sum(accelerations, axis=1) + BODIES * np.array([[0.0, PARAMS["g"]]]))
    np.testing.assert_allclose(motion.multipliers["joints"][:, 0], expected, rtol=0, atol=1e-8 * np.abs(expected).max())


@pytest.mark.slow
def test_derivatives():
    end = lambda motion: jnp.sum(jnp.sin(motion.q["phi"][-1]))
    g = PARAMS["g"]
    of_joints, of_angles = (lambda g, of=of: end(of(g=g)) for of in (by_joints, by_angles))
    expected = (of_angles(g + 1e-4) - of_angles(g - 1e-4)) / 2e-4
    np.testing.assert_allclose([jax.grad(of_joints)(g), jax.jvp(of_joints, (g,), (1.0,))[1]], expected, rtol=1e-5)


@pytest.mark.slow
def test_many_at_once_and_a_fit(motion):
    masses = np.array([0.7, 1.3, 2.0])
    together = jl.simulate_many(BY_JOINTS, PLACES, VELOCITIES, TS, PARAMS | {"m": masses}, over=("m",))
    np.testing.assert_allclose(together.q["phi"][1], motion.q["phi"], rtol=0, atol=1e-7)
    experiment = jl.Experiment(TS, {"phi": motion.q["phi"]}, PLACES, VELOCITIES)
    found = jl.fit(BY_JOINTS, experiment, PARAMS | {"b": 0.04}, free=["b"])
    np.testing.assert_allclose(found.params["b"], PARAMS["b"], rtol=1e-6)
