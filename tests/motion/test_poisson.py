"""Poisson's law of restitution against complementarity by enumeration: rods that strike with one end, with friction; coupled contacts."""

import itertools
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

MEMBERS, LENGTH = 300, 0.8  # of rods


def rod(q, qdot):
    return 0.5 * (qdot[0] ** 2 + qdot[1] ** 2 + LENGTH**2 / 12 * qdot[2] ** 2)


def height(q):
    return q[1] - LENGTH / 2 * jnp.sin(q[2])


def rub(qdot, q, multipliers, mu):
    return mu * multipliers["floor"] * jnp.abs(qdot[0] + LENGTH / 2 * jnp.sin(q[2]) * qdot[2])


def restitution(e):
    return e


rods = {
    law: jl.System(rod, dissipation={"floor rubs": rub}, unilateral={"floor": jl.Contact(height, restitution, law)})
    for law in (jl.NewtonRestitution(), jl.PoissonRestitution())
}


def solutions(A, u, mu, least, returned):
    """Impulses (normal, tangential) that the laws of contact and friction allow: u⁺ = u + A Λ, with Λₙ ≥ `least`."""
    found = []
    for separates, slides in itertools.product((True, False), (0, 1, -1)):
        rows = [[1.0, 0.0] if separates else A[0], A[1] if slides == 0 else [slides * mu, 1.0]]
        right = [least if separates else -u[0] - returned, -u[1] if slides == 0 else 0.0]
        if abs(np.linalg.det(rows)) < 1e-9:
            continue
        impulse = np.linalg.solve(rows, right)
        after = u + A @ impulse
        fine = impulse[0] >= least - 1e-12 and after[0] + returned >= -1e-12
        fine &= abs(impulse[1]) <= mu * impulse[0] + 1e-12 if slides == 0 else slides * after[1] >= -1e-12
        if fine and not any(np.allclose(impulse, other, atol=1e-9) for other in found):
            found.append(impulse)
    return found


def by_enumeration(law, angle, v, mu, e):
    """Velocities after the impact of a rod, where each phase has one solution; None elsewhere."""
    normal = np.array([0.0, 1.0, -LENGTH / 2 * np.cos(angle)])
    along = np.array([1.0, 0.0, LENGTH / 2 * np.sin(angle)])
    J, inverse = np.stack([normal, along]), np.diag([1.0, 1.0, 12 / LENGTH**2])
    A = J @ inverse @ J.T
    phases = [(0.0, e * min(normal @ v, 0))] if law == jl.NewtonRestitution() else [(0.0, 0.0), (e, 0.0)]
    compression = 0.0
    for part, returned in phases:
        found = solutions(A, J @ v, mu, part * compression, returned)
        if len(found) != 1:
            return None
        (impulse,) = found
        v, compression = v + inverse @ J.T @ impulse, impulse[0]
    return v


@pytest.mark.slow
@pytest.mark.parametrize("law", [jl.NewtonRestitution(), jl.PoissonRestitution()], ids=["Newton", "Poisson"])
def test_rods_that_strike_the_floor(law):
    """At random: angle, velocities, friction, restitution. By Poisson's law no energy is gained, by Newton's it may be (Kane)."""
    rng = np.random.default_rng(8)
    angle, mu, e = rng.uniform(0.1, 3.0, MEMBERS), rng.uniform(0, 1.0, MEMBERS), rng.uniform(0, 1, MEMBERS)
    v = rng.uniform(-2, 2, (MEMBERS, 3))
    lever = LENGTH / 2 * np.cos(angle)
    v[:, 1] = lever * v[:, 2] - rng.uniform(0.1, 2.0, MEMBERS)
    q = np.stack([np.zeros(MEMBERS), LENGTH / 2 * np.sin(angle), angle], axis=1)
    params = {"mu": jnp.asarray(mu), "e": jnp.asarray(e)}
    motions = jl.simulate_many(
        rods[law], jnp.asarray(q), jnp.asarray(v), jnp.array([0.0, 1e-3]), params, over=("q0", "qdot0", "mu", "e"), throw=False
    )
    expected = [by_enumeration(law, *given) for given in zip(angle, v, mu, e, strict=True)]
    energy = lambda v: v**2 @ [0.5, 0.5, LENGTH**2 / 24]
    compared, gaining = 0, 0
    for i, after in enumerate(expected):
        if after is None:
            continue
        if energy(after) > energy(v[i]) + 1e-9:
            assert law == jl.NewtonRestitution() and not np.isfinite(motions.qdot[i, 1]).any()
            gaining += 1
            continue
        np.testing.assert_allclose(motions.qdot[i, 0], after, atol=1e-9)
        compared += 1
    assert compared > 250 and (gaining > 0) == (law == jl.NewtonRestitution())


@pytest.mark.slow
def test_derivatives():
    """Of the velocity after an impact with friction, forward and reverse, in e, mu and the velocity before; against differences by hand."""
    angle, v = 1.1, np.array([0.7, -1.0, 0.4])
    q = jnp.array([0.0, LENGTH / 2 * np.sin(angle), angle])

    def after(x):
        ts = jnp.array([0.0, 1e-3])
        return jl.simulate(rods[jl.PoissonRestitution()], q, jnp.concatenate([x[2:], v[2:]]), ts, {"mu": x[0], "e": x[1]}).qdot[0]

    x, h = np.array([0.2, 0.6, 0.7, -1.0]), 1e-6
    by_hand = lambda x: by_enumeration(jl.PoissonRestitution(), angle, np.array([*x[2:], v[2]]), *x[:2])
    expected = np.stack([(by_hand(x + h * unit) - by_hand(x - h * unit)) / (2 * h) for unit in np.eye(4)], axis=1)
    np.testing.assert_allclose(jax.jacfwd(after)(jnp.asarray(x)), expected, atol=1e-8)
    np.testing.assert_allclose(jax.jacrev(after)(jnp.asarray(x)), expected, atol=1e-8)


@pytest.mark.slow
def test_balls_in_contact():
    """Three equal balls in a row, the first strikes; only the last contact gives anything back. By Newton's law nothing, for it did not
    approach; by Poisson's the third of the momentum that it has passed on in the compression, and then the first two meet again.
    """
    after = {}
    for law in (jl.NewtonRestitution(), jl.PoissonRestitution()):
        contacts = {f"{i}": jl.Contact(lambda q, i=i: q[i + 1] - q[i], float(i), law) for i in range(2)}
        row = jl.System(lambda q, qdot: 0.5 * jnp.sum(qdot**2), unilateral=contacts)
        motion = jl.simulate(row, jnp.zeros(3), jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 1.0]), works=True)
        after[law] = motion.qdot[0]
        np.testing.assert_allclose(motion.balance(), 0, atol=1e-12)
    np.testing.assert_allclose(after[jl.NewtonRestitution()], [1 / 3, 1 / 3, 1 / 3], atol=1e-12)
    np.testing.assert_allclose(after[jl.PoissonRestitution()], [1 / 6, 1 / 6, 2 / 3], atol=1e-12)


def test_the_law_is_kept_and_checked():
    system = rods[jl.PoissonRestitution()]
    assert pickle.loads(pickle.dumps(system)) == system != rods[jl.NewtonRestitution()]
    moved = jl.substitute(system, lambda p: p)
    assert dict(moved.laws) == {"floor": jl.PoissonRestitution()}
    with pytest.raises(TypeError, match="`law` must be `NewtonRestitution.* or `PoissonRestitution"):
        jl.Contact(height, 0.5, "poisson")


def test_one_ball_comes_back_as_by_newtons_law():
    system = jl.System(
        lambda q, qdot: 0.5 * qdot**2 - 9.81 * q, unilateral={"floor": jl.Contact(lambda q: q, restitution, jl.PoissonRestitution())}
    )
    motion = jl.simulate(system, 1.0, 0.0, jnp.array([0.0, 0.6]), {"e": 0.7})
    fall = np.sqrt(2 / 9.81)
    since, back = 0.6 - fall, 0.7 * 9.81 * fall
    np.testing.assert_allclose([motion.q[-1], motion.qdot[-1]], [back * since - 9.81 * since**2 / 2, back - 9.81 * since], rtol=1e-10)
