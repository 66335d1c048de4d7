"""Contact: impacts, rest after infinitely many of them, lift-off; against closed forms and SciPy's events."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import jaxlag as jl

H, G, E = 1.3, 9.81, 0.8

ball = jl.System(
    lambda q, qdot, m, g: 0.5 * m * qdot**2 - m * g * q,
    unilateral={"floor": jl.Contact(lambda q: q, restitution=lambda e: e)},
)
post = jl.System(
    lambda q, qdot: 0.5 * (qdot @ qdot) - G * q[1],
    unilateral={"post": jl.Contact(lambda q, w: q[1] - jnp.exp(-(((q[0] - 5) / w) ** 2)), restitution=0.5)},
)
walls = jl.System(
    lambda q, qdot, M, K: 0.5 * qdot @ M @ qdot - 0.5 * q @ K @ q,
    unilateral={f"{i}": jl.Contact(lambda q, n, d, i=i: n[i] @ q + d[i], restitution=lambda e, i=i: e[i]) for i in range(4)},
)
shelf = jl.System(
    lambda q, qdot, m, g: 0.5 * m * qdot**2 - m * g * q, unilateral={"shelf": jl.Contact(lambda q, y: q - y, restitution=lambda e: e)}
)
PARAMS = {"m": 0.7, "g": G, "e": E}


def bounce(h, e, g, T, dtype=float):
    """A ball from rest at the height h, up to the time T."""
    return jl.simulate(ball, jnp.asarray(h, dtype), jnp.asarray(0.0, dtype), jnp.asarray([0.0, T], dtype), PARAMS | {"e": e, "g": g})


def impact_time(h, e, g, n):
    """Of the n-th impact: t₁ (1 + 2 e (1 − eⁿ⁻¹)/(1 − e))."""
    return jnp.sqrt(2 * h / g) * (1 + 2 * e * (1 - e ** (n - 1)) / (1 - e))


def last(h, e, g, T=1000.0):
    """When the ball came to rest."""
    return bounce(h, e, g, T).contacts["floor"].changed[-1]


def end_of_bouncing(h, e, g):
    """t∞ = √(2h/g) (1 + e)/(1 − e)"""
    return jnp.sqrt(2 * h / g) * (1 + e) / (1 - e)


@functools.cache
def bouncing():
    """Over many impacts, and long after the last of them."""
    return jl.simulate(ball, H, 0.0, jnp.concatenate([jnp.linspace(0, 4.0, 401), jnp.array([500.0, 1000.0])]), PARAMS, works=True)


def test_impacts_of_a_bouncing_ball():
    """Their number, times and impulses, and the flights between them."""
    motion = bouncing()[:401]
    ts, times = np.asarray(motion.ts), np.array([impact_time(H, E, G, n) for n in range(1, 60)])
    count = np.searchsorted(times, ts)
    floor = motion.contacts["floor"]
    np.testing.assert_array_equal(floor.impacts, count)
    np.testing.assert_allclose(floor.changed[count > 0], times[count[count > 0] - 1], rtol=1e-12)
    hits = np.sqrt(2 * G * H) * E ** np.arange(60)
    np.testing.assert_allclose(floor.impulse, 0.7 * (1 + E) * np.concatenate([[0], np.cumsum(hits)])[count], rtol=1e-11)
    since = ts - np.concatenate([[0.0], times])[count]
    q = np.where(count > 0, E * hits[count - 1] * since - G * since**2 / 2, H - G * since**2 / 2)
    np.testing.assert_allclose(motion.q, q, atol=1e-10)
    assert not np.any(floor.closed) and not np.any(motion.multipliers["floor"])
    left = np.concatenate([[G * H], (E * hits) ** 2 / 2])[count]
    np.testing.assert_allclose(motion.work()["floor"], 0.7 * (left - G * H), atol=1e-9)


def test_rest_after_infinitely_many_impacts():
    """At t∞, on the floor for a thousand seconds, which then bears the weight."""
    motion = bouncing()[401:]
    floor = motion.contacts["floor"]
    np.testing.assert_allclose(floor.changed, end_of_bouncing(H, E, G), rtol=1e-9)
    assert np.all(floor.closed) and floor.impacts[-1] > 60
    assert np.max(np.abs(motion.q)) < 1e-12 and np.max(np.abs(motion.qdot)) < 1e-12
    np.testing.assert_allclose(motion.multipliers["floor"], 0.7 * G, rtol=1e-12)
    np.testing.assert_allclose(floor.impulse[-1], 0.7 * np.sqrt(2 * G * H) * (1 + E) / (1 - E), rtol=1e-8)  # Σ eⁿ


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1.0, 1e-9])
def test_a_step_ends_before_a_second_impact(unit):
    """None is refused for it, so that there are little more steps than impacts, however their intervals shrink."""
    height, g = H * unit, G * unit
    motion = jl.simulate(ball, height, 0.0, jnp.array([0.0, 1000.0]), PARAMS | {"e": 0.5, "g": g})
    impacts = int(motion.contacts["floor"].impacts[-1])
    assert motion.stats["num_rejected_steps"] == 0 and impacts < motion.stats["num_steps"] < impacts + 20
    np.testing.assert_allclose(motion.contacts["floor"].changed[-1], end_of_bouncing(height, 0.5, g), rtol=1e-9)


@pytest.mark.slow
def test_derivatives_of_the_end_of_bouncing():
    """By h, e, g; forward, reverse and of second order."""
    at, together = jnp.array([H, E, G]), lambda function: lambda at: function(*at)
    expected = jax.grad(together(end_of_bouncing))(at)
    np.testing.assert_allclose(jax.jacfwd(together(last))(at), expected, rtol=1e-9)
    np.testing.assert_allclose(jax.grad(together(last))(at), expected, rtol=1e-9)
    for e, rtol in ((0.5, 2e-6), (E, 1e-5)):  # the last flights take 1e-7 s; of more impacts their rounding counts more
        there = jnp.array([H, e, G])
        found, curvature = (jax.jacfwd(jax.jacfwd(together(function)))(there) for function in (last, end_of_bouncing))
        np.testing.assert_allclose(found, curvature, rtol=rtol, atol=1e-7)


@pytest.mark.parametrize("derivative", [jax.jacfwd, pytest.param(jax.jacrev, marks=pytest.mark.slow)])
def test_derivatives_amid_the_impacts(derivative):
    """After 16 impacts: the place and the velocity."""
    T = float(impact_time(H, E, G, 16.4))

    def state(h, e):
        motion = bounce(h, e, G, T)
        return jnp.stack([motion.q[-1], motion.qdot[-1]])

    def by_hand(h, e):
        since, v = T - impact_time(h, e, G, 16), e**16 * jnp.sqrt(2 * G * h)
        return jnp.stack([v * since - G * since**2 / 2, v - G * since])

    expected = jax.jacfwd(by_hand, (0, 1))(H, E)
    np.testing.assert_allclose(derivative(state, (0, 1))(H, E), expected, rtol=1e-8, atol=1e-9)


@pytest.mark.slow
def test_many_balls():
    """Members of a batch hit at different times."""
    rng = np.random.default_rng(1)
    h, e = rng.uniform(0.2, 3, 1000), rng.uniform(0.3, 0.9, 1000)
    motions = jl.simulate_many(ball, h, jnp.zeros(1000), jnp.array([0.0, 2.0]), PARAMS | {"e": e}, over=("q0", "qdot0", "e"))
    times = np.stack([impact_time(h, e, G, n) for n in range(1, 40)])
    n = np.sum(times < 2.0, axis=0)
    clear = np.array([np.all(np.abs(times[:, i] - 2.0) > 1e-6) for i in range(1000)]) & (end_of_bouncing(h, e, G) > 2.01)
    np.testing.assert_array_equal(motions.contacts["floor"].impacts[clear, -1], n[clear])
    np.testing.assert_allclose(motions.contacts["floor"].changed[clear, -1], times[n[clear] - 1, np.flatnonzero(clear)], rtol=1e-10)
    resting = end_of_bouncing(h, e, G) < 1.99
    assert np.all(motions.contacts["floor"].closed[resting, -1]) and np.sum(resting) > 100 and np.sum(clear) > 100


@pytest.mark.slow
def test_single_precision():
    motion = bounce(H, E, G, 2.0, jnp.float32)
    n = 3
    assert motion.q.dtype == jnp.float32 and motion.contacts["floor"].impacts[-1] == n
    np.testing.assert_allclose(motion.contacts["floor"].changed[-1], impact_time(H, E, G, n), rtol=1e-5)


@pytest.mark.slow
def test_a_fit_of_the_restitution_and_the_height():
    """From a recording with noise."""
    ts = jnp.linspace(0, 2.5, 251)
    truth = jl.simulate(ball, H, 0.0, ts, PARAMS)
    measured = truth.q + 1e-3 * np.random.default_rng(0).standard_normal(ts.size)
    start = PARAMS | {"e": 0.78, "g": 9.7}
    found = jl.fit(ball, jl.Experiment(ts, measured, H, 0.0, sigma=1e-3), start, free=("e", "g"))
    assert found.converged
    for name in ("e", "g"):
        assert abs(found.params[name] - PARAMS[name]) < 4 * found.standard_errors[name] < 1e-2


@pytest.mark.slow
def test_a_table_that_shakes():
    """The 1:1 motion: an impact each period at one phase, with g T/2 = ω a cos φ (1 − e)/(1 + e)."""
    table = jl.System(
        lambda q, qdot, g: 0.5 * qdot**2 - g * q,
        unilateral={"table": jl.Contact(lambda t, q, a, omega: q - a * jnp.sin(omega * t), restitution=lambda e: e)},
    )
    omega, e, a = 30.0, 0.5, 0.02
    T = 2 * np.pi / omega
    phase = np.arccos(G * T / 2 * (1 - e) / (1 + e) / (a * omega))
    start = phase / omega
    v = G * T / 2  # up, at the impact, and down again a period later
    params = {"g": G, "a": a, "omega": omega, "e": e}
    ts = start + T * jnp.arange(0, 8.5, 0.5)
    motion = jl.simulate(table, a * np.sin(phase) + 1e-13, v, ts, params)
    np.testing.assert_array_equal(motion.contacts["table"].impacts[1::2], np.arange(8))
    np.testing.assert_allclose(motion.contacts["table"].changed[3::2], start + T * np.arange(1, 8), rtol=1e-9)
    np.testing.assert_allclose(motion.q[1::2], a * np.sin(phase) + v * T / 2 - G * T**2 / 8, rtol=1e-8)


@pytest.mark.slow
def test_a_pendulum_against_a_wall():
    """Against SciPy's events, with the work that the wall takes."""
    pendulum = jl.System(
        lambda q, qdot: 0.5 * qdot**2 + jnp.cos(q),
        dissipation={"air": lambda qdot: 0.05 * qdot**2},
        unilateral={"wall": jl.Contact(lambda q: q + 0.3, restitution=lambda speed: 0.9 - 0.1 * speed)},
    )
    ts = np.linspace(0, 20, 41)
    motion = jl.simulate(pendulum, 1.2, 0.0, ts, works=True, rtol=1e-10, atol=1e-12)

    def hit(t, y):
        return y[0] + 0.3

    hit.terminal, hit.direction = True, -1
    t, y, found, impacts, lost = 0.0, np.array([1.2, 0.0]), [], [], 0.0
    while t < 20:
        part = solve_ivp(
            lambda t, y: [y[1], -np.sin(y[0]) - 0.1 * y[1]], (t, 20), y, "DOP853", events=hit, rtol=1e-12, atol=1e-13, dense_output=True
        )
        found += [part.sol(s) for s in ts if t <= s < part.t[-1] or s == part.t[-1] == 20]
        t, y = part.t[-1], part.y[:, -1].copy()
        if part.status == 1:
            impacts.append(t)
            after = -(0.9 - 0.1 * abs(y[1])) * y[1]
            lost += (y[1] ** 2 - after**2) / 2
            y[1] = after
    np.testing.assert_array_equal(motion.contacts["wall"].impacts[-1], len(impacts))
    np.testing.assert_allclose(motion.contacts["wall"].changed[-1], impacts[-1], rtol=1e-9)
    np.testing.assert_allclose(np.stack([motion.q, motion.qdot], axis=1), found, atol=1e-8)
    np.testing.assert_allclose(motion.work()["wall"][-1], -lost, rtol=1e-8)
    assert np.max(np.abs(motion.balance())) < 1e-9


@pytest.mark.slow
def test_a_mass_on_a_string():
    """It flies, the string goes tight at once, it swings: a contact that pulls the mass inwards."""
    string = jl.System(lambda q, qdot: 0.5 * (qdot @ qdot) - 9.81 * q[1], unilateral={"string": lambda q, l: l - jnp.linalg.norm(q)})
    x, l = 0.6, 1.0
    motion = jl.simulate(string, jnp.array([x, 0.0]), jnp.zeros(2), jnp.linspace(0, 1.0, 101), {"l": l})
    tight = np.sqrt(2 * np.sqrt(l**2 - x**2) / 9.81)
    held = motion.contacts["string"].closed
    np.testing.assert_allclose(motion.contacts["string"].changed[-1], tight, rtol=1e-12)
    np.testing.assert_array_equal(held, motion.ts > tight)
    phi, v = np.arcsin(x), -9.81 * tight
    part = solve_ivp(
        lambda t, y: [y[1], -9.81 * np.sin(y[0])], (tight, 1), [phi, v * np.sin(phi)], "DOP853", rtol=1e-11, atol=1e-12, dense_output=True
    )
    angle, rate = part.sol(np.asarray(motion.ts[held]))
    np.testing.assert_allclose(motion.q[held], np.stack([np.sin(angle), -np.cos(angle)], axis=1), atol=1e-7)
    np.testing.assert_allclose(motion.multipliers["string"][held], rate**2 + 9.81 * np.cos(angle), rtol=1e-6)


@pytest.mark.slow
def test_a_particle_leaves_a_sphere():
    """At cos φ = 2/3, which is differentiated by how it began."""
    sphere = jl.System(lambda q, qdot: 0.5 * (qdot @ qdot) - q[1], unilateral={"sphere": lambda q: jnp.linalg.norm(q) - 1})

    def leaves(v):
        motion = jl.simulate(sphere, jnp.array([0.0, 1.0]), jnp.stack([v, 0.0 * v]), jnp.array([0.0, 0.5, 3.0]), rtol=1e-11, atol=1e-12)
        return motion.contacts["sphere"].changed[-1]

    def by_hand(v):
        energy = lambda phi: np.sqrt(v**2 + 2 - 2 * np.cos(phi))
        end = np.arccos((2 + v**2) / 3)
        return solve_ivp(lambda phi, t: 1 / energy(phi), (0, end), [0.0], "DOP853", rtol=1e-12, atol=1e-13).y[0, -1]

    v = 0.4
    np.testing.assert_allclose(leaves(jnp.array(v)), by_hand(v), rtol=1e-9)
    difference = (by_hand(v + 1e-4) - by_hand(v - 1e-4)) / 2e-4
    np.testing.assert_allclose(jax.grad(leaves)(jnp.array(v)), difference, rtol=1e-6)
    np.testing.assert_allclose(jax.jacfwd(leaves)(jnp.array(v)), difference, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("width", [0.3, 0.01, 3e-4])
def test_a_post_narrower_than_a_step(width):
    """Nothing passes through it: the gap is bounded along the path, and not looked at here and there."""
    ts = jnp.array([0.0, 1.05])
    motion = jl.simulate(post, jnp.array([0.0, 0.5]), jnp.array([5.0, 4.2]), ts, {"w": width})
    gap = lambda t: 0.5 + 4.2 * t - G * t**2 / 2 - np.exp(-(((5 * t - 5) / width) ** 2))
    grid = np.linspace(0, 1.05, 2_000_001)
    first = grid[np.argmax(gap(grid) < 0)]
    time = brentq(gap, first - grid[1], first, xtol=1e-15)
    found = jl.simulate(post, jnp.array([0.0, 0.5]), jnp.array([5.0, 4.2]), jnp.array([0.0, time + 1e-9]), {"w": width})
    assert found.contacts["post"].impacts[-1] == 1 and motion.contacts["post"].impacts[-1] >= 1
    np.testing.assert_allclose(found.contacts["post"].changed[-1], time, rtol=1e-11)


def by_events(M, K, n, d, e, q, v, ts):
    """States and numbers of impacts of the `walls` at some times, by SciPy's events; as far as impacts lie apart from each other."""
    W = np.linalg.inv(M)
    rates = lambda t, y: np.concatenate([y[3:], -W @ K @ y[:3]])
    events = [lambda t, y, i=i: n[i] @ y[:3] + d[i] for i in range(4)]
    for event in events:
        event.terminal, event.direction = True, -1
    t, y, count, rows = ts[0], np.concatenate([q, v]), np.zeros(4), [np.concatenate([q, v, np.zeros(4)])]
    while len(rows) < len(ts):
        part = solve_ivp(rates, (t, ts[-1]), y, "DOP853", events=events, rtol=1e-12, atol=1e-13, dense_output=True, max_step=3e-3)
        rows += [np.concatenate([part.sol(s), count]) for s in ts[len(rows) :] if s <= part.t[-1]]
        if part.status != 1 or part.t[-1] - t < 1e-2:  # it is coming to rest
            break
        t, y = part.t[-1], part.y[:, -1].copy()
        i = int(np.argmin([abs(event(t, y)) for event in events]))
        count = count + (np.arange(4) == i)
        y[3:] -= (1 + e[i]) * (n[i] @ y[3:]) / (n[i] @ W @ n[i]) * (W @ n[i])
    return np.array(rows)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2, 3, 4, 5, 6, 7, 8, 10, 11, 12, 13])  # in 1 and 9 it rests before the first sample
def test_random_walls(seed):
    """A mass on springs between slanted walls, in any units, against SciPy's events."""
    rng = np.random.default_rng(seed)
    units = 10.0 ** rng.uniform(-3, 3, 3)
    A, C, n = rng.standard_normal((3, 3)), rng.standard_normal((3, 3)), rng.standard_normal((4, 3))
    M, K = A @ A.T + np.eye(3), C @ C.T + 0.3 * np.eye(3)
    d, e = rng.uniform(0.2, 1.0, 4), rng.uniform(0.3, 1.0, 4)
    q, v, ts = np.zeros(3), 2 * rng.standard_normal(3), np.linspace(0, 6, 13)
    expected = by_events(M, K, n, d, e, q, v, ts)
    scaled = lambda x: x / units[:, None] / units[None]  # coordinates q·units
    params = {"M": scaled(M), "K": scaled(K), "n": n / units, "d": d, "e": e}
    motion = jl.simulate(walls, q * units, v * units, ts, params, rtol=1e-10, atol=1e-13 * float(np.min(units)))
    k = len(expected)
    assert k > 3 and np.sum(expected[-1, 6:]) >= 3
    found = np.concatenate([np.asarray(motion.q[:k]) / units, np.asarray(motion.qdot[:k]) / units], axis=1)
    np.testing.assert_array_equal(np.stack([motion.contacts[f"{i}"].impacts[:k] for i in range(4)], axis=1), expected[:, 6:])
    np.testing.assert_allclose(found, expected[:, :6], atol=2e-7 * np.max(np.abs(expected[:, :6])))


@pytest.mark.slow
def test_rest_on_floors_anywhere():
    """Where rounding of the coordinate is larger than the last flights are high, these are summed up before; differentiable in e."""
    rng = np.random.default_rng(0)
    e, y, h = rng.uniform(0.3, 0.98, 200), 10 ** rng.uniform(-3, 2, 200), 10 ** rng.uniform(-2, 1, 200)
    params = PARAMS | {"e": e, "y": y}
    motions = jl.simulate_many(shelf, y + h, jnp.zeros(200), jnp.array([0.0, 300.0]), params, over=("q0", "qdot0", "e", "y"))
    end, last_flight = end_of_bouncing(h, e, G), np.sqrt(8 * 10 * np.finfo(float).eps ** 0.75 * y / G)  # ten roundings high
    assert np.all(motions.contacts["shelf"].closed[:, -1])
    assert np.all(np.abs(motions.contacts["shelf"].changed[:, -1] - end) < 1e-9 * end + 1e-3 * last_flight / (1 - e))
    np.testing.assert_allclose(motions.q[:, -1], y, rtol=1e-15)

    def end(e):
        motion = jl.simulate(shelf, 3.0 + H, 0.0, jnp.array([0.0, 60.0]), PARAMS | {"e": e, "y": 3.0})
        return motion.contacts["shelf"].changed[-1]

    for at in (0.5, 0.8, 0.97):
        np.testing.assert_allclose(end(at), end_of_bouncing(H, at, G), rtol=2e-9)
        np.testing.assert_allclose(jax.jacfwd(end)(at), jax.grad(end_of_bouncing, 1)(H, at, G), rtol=1e-8)


@pytest.mark.slow
def test_a_held_force_lifts_it_off():
    """A force that jumps opens the contact at its time; and closes another flight with an impact."""
    lifted = jl.System(
        lambda q, qdot, m: 0.5 * m * qdot**2 - m * G * q,
        force=lambda t, F: F(t),
        unilateral={"floor": jl.Contact(lambda q: q, restitution=0.5)},
    )
    F = jl.Signal(jnp.array([0.0, 1.0, 1.5]), jnp.array([0.0, 3 * 2.0 * G, 0.0]), jl.interpolation.ZeroOrderHold())
    ts = np.linspace(0, 4, 17)
    motion = jl.simulate(lifted, 0.0, 0.0, ts, {"m": 2.0, "F": F}, works=True)
    up, free = np.clip(ts - 1, 0, 0.5), np.clip(ts - 1.5, 0, None)
    flight = G * up**2 + G * free - G * free**2 / 2  # twice g upwards for half a second, and then free
    hit = 1.5 + 1 + np.sqrt(1.5)
    np.testing.assert_allclose(motion.q[ts < hit], flight[ts < hit], atol=1e-12)
    np.testing.assert_array_equal(motion.contacts["floor"].closed, ts < 1)
    np.testing.assert_allclose(motion.contacts["floor"].changed[-1], hit, rtol=1e-12)
    assert np.max(np.abs(motion.balance())) < 1e-12
