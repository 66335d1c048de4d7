"""A slender rod on a rough floor, Painlevé's: impacts and sliding against the laws of contact and friction, each case tried by hand."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxlag as jl
from jaxlag._motion.results import names_of

G, MASS = 9.81, np.array([1.0, 1.0, 1 / 3])  # of length 2 and mass 1: x, y, and the angle φ from the vertical
EACH = 200  # rods that strike, and as many that slide
FLIGHT, UNTIL = 1e-3, 0.05

rod = jl.System(
    lambda q, qdot, g: 0.5 * (qdot[0] ** 2 + qdot[1] ** 2 + qdot[2] ** 2 / 3) - g * q[1],
    dissipation={"rub": lambda q, qdot, multipliers, mu: mu * multipliers["floor"] * jnp.abs(qdot[0] + jnp.cos(q[2]) * qdot[2])},
    unilateral={"floor": jl.Contact(lambda q: q[1] - jnp.cos(q[2]), restitution=lambda e: e)},
)


def rows(phi):
    """Of the gap and of the slip, by q̇."""
    return np.array([[0.0, 1.0, np.sin(phi)], [1.0, 0.0, np.cos(phi)]])


def compliance(phi):
    """The matrix from normal and tangential impulses to the changes of ġ and of the slip."""
    return rows(phi) / MASS @ rows(phi).T


def energy(u):
    return 0.5 * MASS @ u**2


def after_impact(phi, u, e, mu):
    """All q̇ behind an impact that fulfil ġ⁺ = −e ġ⁻ and Coulomb's law: it sticks, or slips one way or the other."""
    (nn, nt), (_, tt) = W = compliance(phi)
    down, slip = rows(phi) @ u
    normal, tangential = np.linalg.solve(W, [-(1 + e) * down, -slip])
    found = [(normal, tangential)] if normal >= 0 and abs(tangential) <= mu * normal else []
    for way in (1, -1):
        normal = -(1 + e) * down / (nn - way * mu * nt)
        if normal >= 0 and way * (slip + nt * normal - way * mu * tt * normal) > 0:
            found.append((normal, -way * mu * normal))
    return [u + rows(phi).T @ impulse / MASS for impulse in found]


def sliding(phi, rate, slip, mu):
    """ġ̇ without a force, and what a normal force adds to it while friction opposes the slip."""
    (nn, nt), _ = compliance(phi)
    return np.cos(phi) * rate**2 - G, nn - np.sign(slip) * mu * nt


def normal_forces(phi, rate, slip, mu):
    """All λ that fulfil the laws of contact while the rod slides: none, one, or two (open, and pressed)."""
    free, gain = sliding(phi, rate, slip, mu)
    return ([0.0] if free >= 0 else []) + ([-free / gain] if -free / gain > 0 else [])


def first_end(phi, rate, slip, mu):
    """Of a rod that slides, the time of its first end, what it is, and y = (q, q̇) there; or at UNTIL."""
    names, events = ["lift-off", "rest", "paradox"], []
    at = lambda y: (y[2], y[5], y[3] + np.cos(y[2]) * y[5], mu)
    way = np.sign(slip)
    pressing = lambda y: (lambda free, gain: -free / gain)(*sliding(y[2], y[5], way, mu))
    for margin in (
        lambda t, y: -sliding(*at(y)[:2], way, mu)[0],
        lambda t, y: way * at(y)[2],
        lambda t, y: sliding(*at(y)[:2], way, mu)[1] - 1e-3,
    ):
        margin.terminal, margin.direction = True, -1
        events.append(margin)
    rates = lambda t, y: np.concatenate([y[3:], [0, -G, 0] + rows(y[2]).T @ [pressing(y), -way * mu * pressing(y)] / MASS])
    start = [0.0, np.cos(phi), phi, slip - np.cos(phi) * rate, -np.sin(phi) * rate, rate]
    part = solve_ivp(rates, (0, UNTIL), start, "DOP853", events=events, rtol=1e-12, atol=1e-13, max_step=2e-3)
    which = [name for name, found in zip(names, part.t_events, strict=True) if found.size]
    return part.t[-1], which[0] if which else None, part.y[:, -1]


@pytest.fixture(scope="module")
def rods():
    """At random angles, velocities and μ, in Painlevé's region (μ > 4/3) and out of it: first those that strike without gravity after a
    short flight, then those that slide.
    """
    rng = np.random.default_rng(0)
    phi, mu, e = rng.uniform(-1.4, 1.4, 2 * EACH), rng.uniform(0.2, 3, 2 * EACH), rng.uniform(0.05, 0.9, 2 * EACH)
    u = rng.standard_normal((EACH, 3))
    u *= -np.sign(u[:, 1] + np.sin(phi[:EACH]) * u[:, 2])[:, None]  # they approach
    rate, slip = rng.uniform(-6, 6, EACH), rng.uniform(-2, 2, EACH)
    slides = np.stack([slip - np.cos(phi[EACH:]) * rate, -np.sin(phi[EACH:]) * rate, rate], axis=1)
    q = np.stack([0 * phi, np.cos(phi), phi], axis=1)
    q[:EACH] -= FLIGHT * u
    params = {"mu": mu, "e": np.where(np.arange(2 * EACH) < EACH, e, 0), "g": np.where(np.arange(2 * EACH) < EACH, 0, G)}
    ts = jnp.array([0.0, 2 * FLIGHT, UNTIL])
    over = ("q0", "qdot0", "mu", "e", "g")
    motions = jl.simulate_many(rod, q, np.concatenate([u, slides]), ts, params, over=over, throw=False, rtol=1e-10, atol=1e-12)
    return motions, phi, mu, e, u, rate, slip


@pytest.mark.slow
def test_impacts_of_a_rod(rods):
    """In all of them the laws have one solution, also in Painlevé's region, and it is taken; where it gains energy, that is the reason."""
    motions, phi, mu, e, u, *_ = rods
    gains, named = 0, names_of(motions.result)
    for i in range(EACH):
        (after,) = after_impact(phi[i], u[i], e[i], mu[i])
        if energy(after) > energy(u[i]):
            gains += 1
            assert named[i] == "energy_gained"
        else:
            np.testing.assert_allclose(motions.qdot[i, 1], after, atol=1e-12)
            assert energy(np.asarray(motions.qdot[i, 1])) <= energy(u[i])
    assert 0 < gains < 20 and np.sum(mu[:EACH] > 4 / 3) > 100


@pytest.mark.slow
def test_a_sliding_rod(rods):
    """One normal force, or none or two of them, which is Painlevé's paradox and is named."""
    motions, phi, mu, _, _, rate, slip = rods
    solutions, named = np.zeros(3, int), names_of(motions.result)
    for i in range(EACH):
        forces = normal_forces(phi[EACH + i], rate[i], slip[i], mu[EACH + i])
        solutions[len(forces)] += 1
        if len(forces) == 1:
            np.testing.assert_allclose(motions.multipliers["floor"][EACH + i, 0], forces[0], rtol=1e-11, atol=1e-11)
        else:
            assert named[EACH + i] == "no_friction"
    assert np.all(solutions >= 5)


@pytest.mark.slow
def test_how_sliding_ends(rods):
    """Lift-off when the force has gone, rest of the sliding end, or a force without bounds, with a name: against SciPy's events."""
    motions, phi, mu, _, _, rate, slip = rods
    ends, named, floor = [], names_of(motions.result), motions.contacts["floor"]
    states = np.concatenate([motions.q[EACH:, -1], motions.qdot[EACH:, -1]], axis=1)
    for i in range(EACH):
        given, j = (phi[EACH + i], rate[i], slip[i], mu[EACH + i]), EACH + i
        free, gain = sliding(*given)
        if free >= 0 or gain <= 1e-3:
            continue
        time, end, y = first_end(*given)
        ends.append(end)
        if end == "paradox":
            # a force without bounds: no step is short enough, or it overflows first
            assert named[j] in ("no_friction", "beyond_reach", "undefined")
            assert abs(motions.stats["reached"][j] - time) < 1e-3
            continue
        assert named[j] == "successful"
        if end == "lift-off" and floor.impacts[j, -1] == 0:
            np.testing.assert_allclose(floor.changed[j, -1], time, rtol=1e-9)
            since = UNTIL - time
            y = np.concatenate([y[:3] + since * y[3:], y[3:]]) + G * np.array([0, -(since**2) / 2, 0, 0, -since, 0])
        if end != "rest":
            np.testing.assert_allclose(states[i], y, atol=1e-10)
    assert all(ends.count(end) >= least for end, least in (("rest", 20), (None, 50), ("lift-off", 2), ("paradox", 1)))
