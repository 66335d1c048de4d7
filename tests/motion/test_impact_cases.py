"""Impacts of many contacts at once and of contacts with friction, against event codes in NumPy and SciPy: a chain, a woodpecker."""

import itertools

import chain_by_hand
import jax.numpy as jnp
import numpy as np
import pytest
import woodpecker_by_hand as by_hand

import jaxlag as jl

G, LINK, UNTIL = 9.81, 0.1, 0.6

chain = jl.System(  # unit masses at q[:, i], joined by rods
    lambda q, qdot: 0.5 * jnp.sum(qdot**2) - G * jnp.sum(q[1]),
    holonomic={"rods": lambda q, l: (jnp.sum((q[:, 1:] - q[:, :-1]) ** 2, axis=0) - l**2) / (2 * l)},
    unilateral={f"{i}": lambda q, i=i: q[1, i] for i in range(11)},
)


@pytest.mark.slow
def test_a_chain_falls_on_a_table():
    """Ten links, bent, on an inelastic table: against the principles of Gauss and Moreau; with balances of momentum and energy."""
    angles = np.linspace(-1.2, 1.0, 10)
    start = np.concatenate([[0.0, 0.0], angles])
    by_angles = chain_by_hand.Chain(start, LINK)
    start[1] = 0.15 - np.min(by_angles.places(start)[1])
    changes = [t for t, _ in by_angles.simulated(start, np.zeros(12), [0.0, UNTIL])[1]]
    edges = np.append(changes, UNTIL)
    nodes, weights = np.polynomial.legendre.leggauss(10)
    ts = np.concatenate([edges[:1], *(low + (high - low) * (1 + nodes) / 2 for low, high in itertools.pairwise(edges)), edges[-1:]])
    (q, v, impacts, impulse), _ = by_angles.simulated(start, np.zeros(12), ts)
    motion = jl.simulate(chain, q[0], 0 * q[0], ts, {"l": LINK}, rtol=1e-10, atol=1e-12)
    of = lambda field: np.stack([getattr(motion.contacts[f"{i}"], field) for i in range(11)], axis=1)

    np.testing.assert_array_equal(of("impacts"), impacts)
    assert np.sum(impacts[-1]) > 20 and np.all(of("closed")[-1])
    np.testing.assert_allclose(motion.q, q, atol=1e-11)
    np.testing.assert_allclose(np.reshape(motion.qdot, v.shape), v, atol=1e-10)
    np.testing.assert_allclose(np.sum(of("impulse"), axis=1), impulse, atol=1e-10)

    forces = sum(np.asarray(motion.multipliers[f"{i}"]) for i in range(11))[1:-1].reshape(len(changes), 10)
    pressed = np.sum(np.diff(edges)[:, None] / 2 * weights * forces)
    gained = np.sum(motion.qdot[-1, 1]) - np.sum(motion.qdot[0, 1])
    np.testing.assert_allclose(np.sum(of("impulse")[-1]) + pressed, gained + 11 * G * UNTIL, rtol=1e-11)
    energy = np.asarray(motion.energy())
    assert np.max(np.diff(energy)) < 1e-12 * energy[0] and abs(energy[-1]) < 1e-12 * energy[0]


def lagrangian(q, qdot):
    (y, sleeve, bird), (v, a, b) = q, qdot
    head, mM, mS = v + by_hand.L_M * a + by_hand.L_G * b, by_hand.M_M, by_hand.M_S
    kinetic = mM * v**2 + mS * head**2 + by_hand.J_M * a**2 + by_hand.J_S * b**2
    weight = by_hand.G * (mM * y + mS * (y + by_hand.L_M * sleeve + by_hand.L_G * bird))
    return 0.5 * kinetic - weight - 0.5 * by_hand.C * (sleeve - bird) ** 2


def rub(qdot, multipliers):
    v, a, b = qdot
    beak, sleeve = jnp.abs(v + by_hand.L_M * a + (by_hand.L_G - by_hand.L_S) * b), jnp.abs(v + by_hand.R_M * a)
    return by_hand.MU * (multipliers["beak"] * beak + (multipliers["lower"] + multipliers["upper"]) * sleeve)


PLAY = by_hand.R_M - by_hand.R0
woodpecker = jl.System(
    lagrangian,
    dissipation={"rub": rub},
    unilateral={
        "beak": jl.Contact(lambda q: by_hand.L_M + by_hand.L_G - by_hand.L_S - by_hand.R0 - by_hand.H_S * q[2], restitution=0.5),
        "lower": lambda q: PLAY + by_hand.H_M * q[1],
        "upper": lambda q: PLAY - by_hand.H_M * q[1],
    },
)


@pytest.mark.slow
def test_the_woodpecker_against_events():
    """A whole cycle: it slides, sticks and hangs free; the sleeve strikes above, the beak, the sleeve above again, and below twice."""
    times = [t for t, *_ in by_hand.simulated(0.15, [])[1]]
    ts = np.sort(np.concatenate([np.linspace(0, 0.15, 301), np.add.outer(times, [-1e-7, 1e-7]).ravel()]))
    states, impacts, course = by_hand.simulated(0.15, ts)
    motion = jl.simulate(woodpecker, *by_hand.START, ts)
    found, size = np.concatenate([motion.q, motion.qdot], axis=1), np.max(np.abs(states), axis=0)
    np.testing.assert_allclose(found / size, states / size, atol=1e-10)

    assert [by_hand.NAMES[int(np.argmax(hits))] for _, hits, *_ in impacts] == ["upper", "beak", "upper", "lower", "lower"]
    assert len({modes for _, modes in course}) >= 4
    behind = np.searchsorted(ts, times)
    for i, name in enumerate(by_hand.NAMES):
        contact, struck = motion.contacts[name], np.array([hits[i] for _, hits, *_ in impacts])
        np.testing.assert_array_equal(contact.impacts, np.searchsorted(np.array(times)[struck], ts))
        np.testing.assert_allclose(contact.changed[behind[struck]], np.array(times)[struck], rtol=1e-11)
        np.testing.assert_allclose(contact.impulse[behind], np.cumsum([impulses[i] for *_, impulses in impacts]), rtol=1e-9, atol=1e-15)
    bearing = np.array([next(modes for since, modes in reversed(course) if since <= t)[1] for t in ts])
    np.testing.assert_array_equal(motion.contacts["lower"].closed, bearing != by_hand.OPEN)


@pytest.mark.slow
def test_the_cycle_of_the_woodpecker():
    """Its period, how far it falls in it, and what is left of a deviation after it (a Floquet multiplier): it is stable."""
    turns = jl.Event(lambda qdot: qdot[2], direction=jl.direction.Rising())  # of the bird
    orbit = jl.periodic(woodpecker, *by_hand.START, section=turns, longest=0.6, cyclic=["q[0]"])
    near = orbit.period + np.linspace(-2e-4, 2e-4, 9)

    def returned(deviation):
        """The state by hand where the bird turns again."""
        start = np.asarray(orbit.q) + np.array([0, 0, deviation]), np.asarray(orbit.qdot)
        states = np.asarray(by_hand.simulated(near[-1], near, start)[0])
        when = np.polyfit(states[:, 5], near - orbit.period, 5)[-1]
        return when, [np.polyfit(near - orbit.period, states[:, i], 5) @ when ** np.arange(5, -1, -1) for i in range(3)]

    (when, there), (_, above), (_, below) = (returned(d) for d in (0.0, 1e-5, -1e-5))
    np.testing.assert_allclose(when, 0, atol=1e-9)
    np.testing.assert_allclose(there, orbit.q + orbit.drift, atol=1e-8)
    np.testing.assert_allclose(orbit.multipliers[0], (above[2] - below[2]) / 2e-5, rtol=1e-4)
    np.testing.assert_allclose(orbit.multipliers[1:], 0, atol=1e-6)
    np.testing.assert_allclose([orbit.period, orbit.drift[0]], [0.146, -19.5e-3], rtol=4e-3)  # Glocker's digits
    assert orbit.is_stable
