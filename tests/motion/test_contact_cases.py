"""Contact against closed forms, quadrature and exact return maps: a ball on a table that shakes, a bead that leaves a circle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

import jaxlag as jl

G, OMEGA, E = 9.81, 30.0, 0.5
PERIOD = 2 * np.pi / OMEGA

table = jl.System(
    lambda q, qdot, g: 0.5 * qdot**2 - g * q,
    unilateral={"table": jl.Contact(lambda t, q, a, omega: q - a * jnp.sin(omega * t), restitution=lambda e: e)},
)
circle = jl.System(  # side +1: the bead is outside of it, −1: inside
    lambda q, qdot, g: 0.5 * (qdot @ qdot) - g * q[1],
    unilateral={"circle": lambda q, r, side: side * (jnp.linalg.norm(q) - r)},
)


def next_impact(t, v, a):
    """The flight after an impact at t with q̇⁺ = v: the first time at which it meets the table again, and q̇⁺ there."""
    height = lambda s: a * np.sin(OMEGA * t) + v * (s - t) - G * (s - t) ** 2 / 2 - a * np.sin(OMEGA * s)
    grid = t + np.linspace(1e-3, 3, 30_000) * PERIOD
    first = np.argmax(height(grid) < 0)
    assert first > 0
    end = brentq(height, grid[first - 1], grid[first], xtol=1e-15, rtol=1e-15)
    return end, (1 + E) * a * OMEGA * np.cos(OMEGA * end) - E * (v - G * (end - t))


def slope_of_map(t, v, a, s=None):
    """The derivative of `next_impact` by t and v, from that of the flight's equation; given a time s in the flight, by q and q̇ there."""
    end, _ = next_impact(t, v, a)
    flight = end - (t if s is None else s)
    before, w = v - G * (end - t), lambda s: a * OMEGA * np.cos(OMEGA * s)
    lift = np.array([w(t) - v + G * flight, flight] if s is None else [1.0, flight])  # the derivative of the height at the end,
    later = np.array([G, 1.0] if s is None else [0.0, 1.0])  # and of the velocity
    d_end = -lift / (before - w(end))
    d_v = (-(1 + E) * a * OMEGA**2 * np.sin(OMEGA * end) + E * G) * d_end - E * later
    return np.stack([d_end, d_v])


def periodic(a, n):
    """The motion with an impact each n periods of the table, at one phase: its time and q̇⁺. g n T/2 = a ω cos φ (1 + e)/(1 − e)."""
    v = G * n * PERIOD / 2
    return np.arccos(v * (1 - E) / (1 + E) / (a * OMEGA)) / OMEGA, v


def middle_of_a_flight(t, v, a):
    """The time, q and q̇ in the middle of the flight that begins at t with q̇⁺ = v."""
    flight = (next_impact(t, v, a)[0] - t) / 2
    return t + flight, a * np.sin(OMEGA * t) + v * flight - G * flight**2 / 2, v - G * flight


def bounced(q, v, ts, a):
    """Of the impact before each sample but the first, the time and q̇⁺; and how many impacts there were."""
    motion = jl.simulate(table, q, v, ts, {"g": G, "a": a, "omega": OMEGA, "e": E}, rtol=1e-10, atol=1e-13)
    times = motion.contacts["table"].changed[1:]
    return jnp.stack([times, motion.qdot[1:] + G * (ts[1:] - times)], axis=1), motion.contacts["table"].impacts


def along(t, v, a, impacts):
    """Expected times and q̇⁺ of the impacts after that at t, and samples in the middles of the flights."""
    course = [(t, v)]
    for _ in range(impacts):
        course.append(next_impact(*course[-1], a))
    return np.array(course[1:]), np.array([middle_of_a_flight(*at, a)[0] for at in course])


@pytest.mark.slow
@pytest.mark.parametrize(("a", "n"), [(0.014, 1), (0.024, 2)])
def test_a_periodic_motion_on_a_shaking_table(a, n):
    """Holmes (1982): stable where the eigenvalues of its return map are; after 20 impacts the ball is still on it."""
    t, v = periodic(a, n)
    assert np.max(np.abs(np.linalg.eigvals(slope_of_map(t, v, a)))) < 1
    np.testing.assert_allclose(next_impact(t, v, a), [t + n * PERIOD, v], rtol=1e-12)
    start, q, rate = middle_of_a_flight(t, v, a)
    found, impacts = bounced(q, rate, start + n * PERIOD * np.arange(21), a)
    np.testing.assert_array_equal(impacts, np.arange(21))
    np.testing.assert_allclose(found[:, 0], t + n * PERIOD * np.arange(1, 21), rtol=1e-10)
    np.testing.assert_allclose(found[:, 1], v, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("a", "n"), [(0.018, 1), (0.026, 2)])
def test_a_motion_of_twice_the_period(a, n):
    """What the period doubles to when that of one impact has become unstable: the return map is iterated till it repeats itself."""
    t, v = periodic(a, n)
    assert np.max(np.abs(np.linalg.eigvals(slope_of_map(t, v, a)))) > 1
    t += 1e-3
    for _ in range(400):
        t, v = next_impact(t % PERIOD, v, a)
    expected, ts = along(t, v, a, 20)
    assert abs(expected[0, 1] - v) > 0.1 and np.max(np.abs(slope_of_map(t, v, a))) > 1
    np.testing.assert_allclose(expected[1], [t + 2 * n * PERIOD, v], rtol=1e-10)
    found, impacts = bounced(*middle_of_a_flight(t, v, a)[1:], ts, a)
    np.testing.assert_array_equal(impacts, np.arange(21))
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.slow
def test_derivatives_of_an_impact_on_a_shaking_table():
    """Of the 20th impact by the start, in a motion that forgets it, and of the third: products of the return map's derivatives."""
    a = 0.018
    t, v = periodic(a, 1)
    expected, ts = along(t + 1e-3, v, a, 20)
    s, q, rate = middle_of_a_flight(t + 1e-3, v, a)
    slope, slopes = slope_of_map(t + 1e-3, v, a, s), []
    for at in expected:
        slopes.append(slope)
        slope = slope_of_map(*at, a) @ slope
    found = jax.jacfwd(lambda start: bounced(*start, ts, a)[0])(jnp.array([q, rate]))
    for i in (0, 2, 19):
        np.testing.assert_allclose(found[i], slopes[i], rtol=1e-7, atol=1e-9)
    reverse = jax.jacrev(lambda start: bounced(*start, ts, a)[0][2])(jnp.array([q, rate]))
    np.testing.assert_allclose(reverse, slopes[2], rtol=1e-7)


def left(v, r, side, below, T):
    """Of a bead that starts at the top or the bottom of a circle with the velocity v: when and where it leaves it."""
    start = jnp.stack([0.0 * r, -r if below else r]), jnp.stack([v, 0.0 * v])
    motion = jl.simulate(circle, *start, jnp.array([0.0, T]), {"g": G, "r": r, "side": side}, rtol=1e-10, atol=1e-12)
    time = motion.contacts["circle"].changed[-1]
    since = T - time
    x, y = motion.q[-1] - motion.qdot[-1] * since  # along the parabola, back
    return jnp.stack([time, x / r, (y - G * since**2 / 2) / r])


def leaving(v, r, below):
    """The height over r at which it leaves, in closed form."""
    return v**2 / (3 * G * r) + (-2 / 3 if below else 2 / 3)


def sliding(v, r, below):
    """The time until it leaves, and its derivatives by v and r, by quadrature over the angle that it slides through."""
    rise = -1 if below else 1
    height = leaving(v, r, below)
    end = np.arccos(rise * height)
    squared = lambda phi: v**2 + 2 * G * r * rise * (1 - np.cos(phi))
    slope = lambda phi: np.array([v, G * rise * (1 - np.cos(phi))])  # half of that of the squared velocity
    at_end = np.array([2 * v / (3 * G * r), -(v**2) / (3 * G * r**2)]) * -rise / np.sqrt(1 - height**2)  # of the angle
    integral = lambda f: quad(f, 0, end, epsabs=1e-14, epsrel=1e-13)[0]
    time = integral(lambda phi: r / np.sqrt(squared(phi)))
    direct = [integral(lambda phi, i=i: -r * slope(phi)[i] / squared(phi) ** 1.5) for i in (0, 1)]
    return time, np.array(direct) + np.array([0.0, time / r]) + at_end * r / np.sqrt(squared(end))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("v", "r", "below", "T"),
    [(0.1, 0.4, False, 1.0), (1.1, 0.4, False, 0.5), (3.4, 0.4, True, 0.6), (4.2, 0.4, True, 0.5)],
    ids=["sphere, slow", "sphere", "loop, slow", "loop"],
)
def test_a_bead_leaves_a_circle(v, r, below, T):
    """A sphere at cos θ = 2/3 + v²/(3 g r); the inside of a loop at sin α = (v²/(g r) − 2)/3 above its centre. With derivatives."""
    side = -1.0 if below else 1.0
    where = leaving(v, r, below)
    at = jnp.array([v, r])
    found = lambda at: left(at[0], at[1], side, below, T)
    time, slope = sliding(v, r, below)
    slopes, value = jax.jacfwd(lambda at: (found(at), found(at)), has_aux=True)(at)
    np.testing.assert_allclose(value, [time, np.sqrt(1 - where**2), where], rtol=1e-9)
    d_where = np.array([2 * v / (3 * G * r), -(v**2) / (3 * G * r**2)])
    d_across = -where / np.sqrt(1 - where**2) * d_where
    expected = np.stack([slope, d_across, d_where])
    np.testing.assert_allclose(slopes, expected, rtol=1e-7)
    np.testing.assert_allclose(jax.grad(lambda at: found(at)[2])(at), expected[2], rtol=1e-7)
