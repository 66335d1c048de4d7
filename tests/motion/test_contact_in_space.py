"""Friction of contacts in two directions: impacts against laws and solvers of NumPy and SciPy, balls and discs against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq

import jaxlag as jl

UNITS = [1.0, 1e-9, 1e6]


def touching(count):
    """A body of six coordinates with linear gaps G q and slips T q̇."""

    def rubs(k):
        return lambda qdot, multipliers, T, mu: mu[k] * jnp.abs(multipliers[f"corner {k}"]) * jl.dissipation.speed(T[k] @ qdot)

    return jl.System(
        lambda qdot, M: 0.5 * qdot @ (M * qdot),
        dissipation={f"rubbing {k}": rubs(k) for k in range(count)},
        unilateral={f"corner {k}": jl.Contact(lambda q, G, k=k: G[k] @ q, restitution=lambda e: e) for k in range(count)},
    )


ONE, TWO = touching(1), touching(2)


def drawn(count, rng, unit=1.0):
    """Points of a rigid body, as they strike a plane."""
    mass, turn = rng.uniform(0.5, 2), np.linalg.qr(rng.normal(size=(3, 3)))[0]
    moving = lambda direction, at: np.concatenate([direction, unit * turn @ np.cross(at, direction)])
    points, axes = rng.uniform(-1, 1, size=(count, 3)), np.eye(3)
    velocity = rng.normal(size=6) * np.repeat([unit, 1.0], 3)
    params = {
        "M": mass * np.concatenate([np.ones(3), unit**2 * rng.uniform(0.07, 0.33, size=3)]),
        "G": np.stack([moving(axes[2], at) for at in points]),
        "T": np.stack([np.stack([moving(axis, at) for axis in axes[:2]]) for at in points]),
        "mu": rng.uniform(0.05, 1.0, size=count),
        "e": rng.choice([0.0, rng.uniform(0, 0.8)]),
    }
    return params, -velocity if np.all(params["G"] @ velocity >= 0) else velocity


def coupled(rng):
    """Two contacts of machines with eight coordinates, so that velocities tell all impulses."""
    rows = rng.normal(size=(2, 3, 8))
    params = {"M": rng.uniform(0.5, 2, size=8), "G": rows[:, 0], "T": rows[:, 1:], "mu": rng.uniform(0.05, 1.0, size=2)}
    params["e"] = rng.uniform(0.05, 0.8)
    velocity = rng.normal(size=8)
    return params, -velocity if np.all(params["G"] @ velocity >= 0) else velocity


def behind(system, params, velocity):
    """Velocities behind the impact, or the reason why there are none."""
    motion = jl.simulate(system, np.zeros(len(velocity)), velocity, np.array([0.0, 1e-6]), params, throw=False)
    return np.asarray(motion.qdot[-1]), str(motion.result)


def by_angle(params, v):
    """All impacts of one contact: those that stick, and those whose slip has a direction that friction is against."""
    A = np.vstack([params["G"][0], params["T"][0]])
    mobility = A.T / params["M"][:, None]
    W, u, mu = A @ mobility, A @ v, params["mu"][0]
    target = np.array([-params["e"] * min(u[0], 0.0), 0.0, 0.0])
    stick, found = np.linalg.solve(W, target - u), []
    if np.hypot(*stick[1:]) <= mu * stick[0]:
        found.append(stick)

    def times(angle):
        """Slip and impulses times what the normal impulse is divided by."""
        along = np.array([1.0, -mu * np.cos(angle), -mu * np.sin(angle)])
        by, impulse = W[0] @ along, (target[0] - u[0]) * along
        return u * by + W @ impulse, impulse, by

    def across(angle):
        _, s, t = times(angle)[0]
        return t * np.cos(angle) - s * np.sin(angle)

    angles = np.linspace(0, 2 * np.pi, 721)
    changes = np.flatnonzero(np.diff(np.sign([across(a) for a in angles])))
    for a, b in zip(angles[changes], angles[changes + 1], strict=True):
        angle = brentq(across, a, b, xtol=1e-15)
        (_, s, t), impulse, by = times(angle)
        if by > 0 and s * np.cos(angle) + t * np.sin(angle) > 0:
            found.append(impulse / by)
    return [v + mobility @ one for one in found]


@pytest.mark.parametrize("unit", UNITS)
def test_random_impacts_of_one_contact(unit):
    rng, gained, size = np.random.default_rng(int(abs(np.log10(unit)))), 0, np.repeat([unit, 1.0], 3)
    for _ in range(100):
        params, v = drawn(1, rng, unit)
        expected = by_angle(params, v)
        after, result = behind(ONE, params, v)
        if "gained energy" in result:  # Kane's paradox
            assert min(w @ (params["M"] * w) for w in expected) > v @ (params["M"] * v)
            gained += 1
            continue
        assert len(expected) == 1, result
        np.testing.assert_allclose(after / size, expected[0] / size, rtol=1e-10, atol=1e-11 * np.max(np.abs(expected[0] / size)))
    assert gained < 10


def laws(params, before, after):
    """By how much the impulses that velocities tell break the laws of impact and friction."""
    count = len(params["mu"])
    A = np.concatenate([np.vstack([params["G"][k], params["T"][k]]) for k in range(count)])
    jump = params["M"] * (after - before)
    impulses = np.linalg.lstsq(A.T, jump, rcond=None)[0]
    behind, approach, off = (A @ after).reshape(-1, 3), (A @ before).reshape(-1, 3)[:, 0], [np.abs(A.T @ impulses - jump).max()]
    for k, (normal, *tangential) in enumerate(impulses.reshape(-1, 3)):
        departs, slip, bound = behind[k, 0] + params["e"] * min(approach[k], 0.0), behind[k, 1:], params["mu"][k] * normal
        off += [max(-normal, 0.0), max(-departs, 0.0), min(abs(normal), abs(departs)), max(np.hypot(*tangential) - bound, 0.0)]
        sticks = np.hypot(*slip) < 1e-9
        off.append(0.0 if sticks else np.abs(np.array(tangential) + bound * slip / np.hypot(*slip)).max())
    return max(off)


@pytest.mark.slow
def test_random_impacts_of_two_contacts():
    """The laws hold, to rounding, whatever sticks, slides and opens."""
    rng, kinds = np.random.default_rng(0), set()
    for _ in range(200):
        params, v = coupled(rng)
        after, result = behind(TWO, params, v)
        if "gained energy" in result:
            continue
        assert "successful" in result
        assert laws(params, v, after) < 1e-9
        kinds.add(tuple(np.abs(params["G"] @ after + params["e"] * np.minimum(params["G"] @ v, 0)) < 1e-9))
    assert len(kinds) >= 3  # either of both, or both at once


def ball(law=jl.NewtonRestitution()):
    """A ball with spin, in quasi-coordinates: its inertia is the same about all axes, so that angles by rates will do."""
    slip = lambda qdot, R: jnp.stack([qdot["x"][0] - R * qdot["turn"][1], qdot["x"][1] + R * qdot["turn"][0]])
    return jl.System(
        lambda q, qdot, m, g, R: 0.5 * m * qdot["x"] @ qdot["x"] + 0.2 * m * R**2 * qdot["turn"] @ qdot["turn"] - m * g * q["x"][2],
        dissipation=lambda qdot, multipliers, mu, R: mu * jnp.abs(multipliers["floor"]) * jl.dissipation.speed(slip(qdot, R)),
        unilateral={"floor": jl.Contact(lambda q, R: q["x"][2] - R, restitution=lambda e: e, law=law)},
    )


BALL, OF_POISSON = ball(), ball(jl.PoissonRestitution())
PARAMS = {"m": 0.05, "g": 9.81, "R": 0.02, "mu": 0.2, "e": 0.6}
SPIN = np.array([10.0, 80.0, -30.0])


def thrown(mu, T, unit=1.0, system=BALL, velocity=(1.0, 0.5, -1.0), spin=SPIN, **options):
    params = {**PARAMS, "g": 9.81 * unit, "R": 0.02 * unit, "mu": mu}
    q0 = {"x": unit * np.array([0.0, 0.0, 0.5]), "turn": np.zeros(3)}
    motion = jl.simulate(system, q0, {"x": unit * jnp.asarray(velocity), "turn": spin}, np.array([0.0, T]), params, **options)
    x, v = (jnp.asarray(of["x"][-1]) / unit for of in (motion.q, motion.qdot))
    return jnp.concatenate([x, v, jnp.asarray(motion.qdot["turn"][-1])])


def thrown_by_hand(mu, T, velocity=(1.0, 0.5, -1.0), spin=SPIN):
    """One bounce: the slip at the floor gets 7/2 of what the ball gets, and stops, or goes on as it went (Garwin, Am. J. Phys. 37, 88)."""
    (vx, vy, vz), (wx, wy, wz), g, R, e = np.array(velocity), np.array(spin), 9.81, 0.02, 0.6
    down = -np.sqrt(vz**2 + 2 * g * (0.5 - R))
    t = (-vz - np.sqrt(vz**2 + 2 * g * (0.5 - R))) / -g
    slip = np.array([vx - R * wy, vy + R * wx])
    size = np.hypot(*slip)
    kick = -slip / size * min(mu * (1 + e) * -down, 2 / 7 * size)
    after = np.array([vx, vy]) + kick
    turn = np.array([wx, wy, wz]) + 5 / (2 * R) * np.array([kick[1], -kick[0], 0])
    rest = T - t
    x = np.array([*(np.array([vx, vy]) * t + after * rest), R - e * down * rest - g * rest**2 / 2])
    return np.concatenate([x, after, [-e * down - g * rest], turn])


@pytest.mark.slow
@pytest.mark.parametrize("unit", UNITS)
def test_a_ball_with_spin(unit):
    """It slides through the first bounce with μ = 0.02, and grips with 0.2; by Poisson's law nothing else, for nothing is coupled."""
    for mu in (0.02, 0.2):
        np.testing.assert_allclose(thrown(mu, 0.5, unit), thrown_by_hand(mu, 0.5), rtol=1e-7, atol=1e-9)
    if unit == 1.0:
        np.testing.assert_allclose(thrown(0.02, 0.5, system=OF_POISSON), thrown_by_hand(0.02, 0.5), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("unit", UNITS)
def test_a_ball_that_bounces_to_rest_rolls_on(unit):
    """With (5 v + 2 R ω)/7 of the start, after impacts without end, as all of them leave angular momentum about the floor."""
    late = thrown(0.2, 20.0, unit)
    np.testing.assert_allclose(late[3:6], [(5 * 1.0 + 2 * 0.02 * 80) / 7, (5 * 0.5 - 2 * 0.02 * 10) / 7, 0.0], rtol=1e-12)
    np.testing.assert_allclose(late[2], 0.02, rtol=1e-12)
    np.testing.assert_allclose([late[3] - 0.02 * late[7], late[4] + 0.02 * late[6]], 0, atol=1e-14)


def changed(x, mu):
    """μ, velocity and spin at the start by three numbers, which are zero."""
    return mu + x[0], (1.0 + x[1], 0.5, -1.0), SPIN * jnp.array([1.0, 1.0 + x[2], 1.0])


def thrown_by(x, mu, unit):
    mu, velocity, spin = changed(x, mu)
    return thrown(mu, 0.5, unit, velocity=velocity, spin=spin, rtol=1e-10)


def slopes_by_hand(mu):
    by_hand = lambda x: (lambda mu, *start: thrown_by_hand(mu, 0.5, *start))(*changed(x, mu))
    return np.stack([(by_hand(h) - by_hand(-h)) / 2e-6 for h in 1e-6 * np.eye(3)], axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("mu", [0.0, 0.02, 0.2])
def test_derivatives_of_a_bounce(mu):
    """Friction turns with the slip behind the impact, and derivatives know: forward and reverse, in any unit, and where there is none."""
    expected = slopes_by_hand(mu)
    found = [jax.jacfwd(thrown_by)(jnp.zeros(3), mu, unit) for unit in UNITS]
    for slopes in found:
        np.testing.assert_allclose(slopes, expected, rtol=1e-6, atol=1e-7)
    reverse = jax.grad(lambda x: thrown_by(x, mu, 1.0)[0])(jnp.zeros(3))
    np.testing.assert_allclose(reverse, found[0][0], rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_derivatives_of_coupled_impacts():
    """Of two contacts at once, against differences, where one sticks and where both slide."""
    rng = np.random.default_rng(5)
    for _ in range(6):
        params, v = coupled(rng)
        along = {name: rng.normal(size=np.shape(x)) * np.abs(x) for name, x in params.items()}
        after = lambda h, params=params, along=along, v=v: jl.simulate(
            TWO, jnp.zeros(8), v * (1 + 0.3 * h), np.array([0.0, 1e-6]), {name: x + h * along[name] for name, x in params.items()}
        ).qdot[-1]
        h = 1e-6
        by_differences = (after(h) - after(-h)) / (2 * h)
        found = jax.jvp(after, (0.0,), (1.0,))[1]
        np.testing.assert_allclose(found, by_differences, rtol=1e-5, atol=1e-6 * np.max(np.abs(by_differences)))


@pytest.mark.slow
def test_a_disc_that_slides_and_spins_on_three_points():
    """Sliding and spinning end at the same time, whatever they began with (Farkas et al., Phys. Rev. Lett. 90 (2003) 248302)."""
    points = np.stack([np.cos(2 * np.pi * np.arange(3) / 3), np.sin(2 * np.pi * np.arange(3) / 3)], axis=1)

    def slip(q, qdot, k):
        c, s = jnp.cos(q["turn"]), jnp.sin(q["turn"])
        x, y = points[k] @ jnp.array([[1.0, 0.0], [0.0, 1.0]])
        return qdot["x"][:2] + qdot["turn"] * jnp.stack([-s * x - c * y, c * x - s * y])

    rubs = lambda k: lambda q, qdot, multipliers, mu: mu * jnp.abs(multipliers[f"foot {k}"]) * jl.dissipation.speed(slip(q, qdot, k))
    height = lambda k: lambda q: q["x"][2] + points[k][0] * q["tilt"][0] + points[k][1] * q["tilt"][1]
    disc = jl.System(  # thin: its mass is as high as its feet, whose loads are the same at any time
        lambda q, qdot, g: 0.5 * qdot["x"] @ qdot["x"] + 0.25 * qdot["turn"] ** 2 + 0.125 * qdot["tilt"] @ qdot["tilt"] - g * q["x"][2],
        dissipation={f"rubbing {k}": rubs(k) for k in range(3)},
        unilateral={f"foot {k}": height(k) for k in range(3)},
    )
    q0 = {"x": np.zeros(3), "turn": 0.0, "tilt": np.zeros(2)}
    v0 = {"x": np.array([1.0, 0.3, 0.0]), "turn": 2.0, "tilt": np.zeros(2)}
    g, mu = 9.81, 0.3

    def rates(t, y):
        c, s = np.cos(y[2]), np.sin(y[2])
        at = points @ np.array([[c, s], [-s, c]])
        slips = y[3:5] + y[5] * np.stack([-at[:, 1], at[:, 0]], axis=1)
        force = -mu * g / 3 * slips / np.hypot(*slips.T)[:, None]
        return [*y[3:], *force.sum(axis=0), np.sum(at[:, 0] * force[:, 1] - at[:, 1] * force[:, 0]) / 0.5]

    expected = solve_ivp(rates, [0, 0.3], [0, 0, 0, 1.0, 0.3, 2.0], rtol=1e-11, atol=1e-13, method="DOP853").y[:, -1]
    motion = jl.simulate(disc, q0, v0, np.array([0.0, 0.3, 2.0]), {"g": g, "mu": mu}, rtol=1e-10, atol=1e-12)
    found = [*motion.q["x"][1][:2], motion.q["turn"][1], *motion.qdot["x"][1][:2], motion.qdot["turn"][1]]
    np.testing.assert_allclose(found, expected, rtol=1e-7)
    np.testing.assert_allclose(motion.qdot["x"][2], 0, atol=1e-12)
    np.testing.assert_allclose(motion.qdot["turn"][2], 0, atol=1e-12)
    assert all(np.all(of.sticking[2]) for of in motion.friction.values())


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1.0, 1e6])
def test_painleves_rod_in_space(unit):
    """It slides in its plane, where no force of the floor is admissible, or aside as well, which turns friction out of that plane: there it
    goes on, with λ = −a/(n n − μ n t cos β) for an acceleration a without it and slip at an angle β.
    """
    slip = lambda q, qdot: jnp.stack([qdot[0] + unit * jnp.cos(q[3]) * qdot[3], qdot[2]])
    rod = jl.System(
        lambda q, qdot, g: 0.5 * qdot[:3] @ qdot[:3] + unit**2 * qdot[3] ** 2 / 6 - g * q[1],
        dissipation=lambda q, qdot, multipliers, mu: mu * jnp.abs(multipliers["floor"]) * jl.dissipation.speed(slip(q, qdot)),
        unilateral={"floor": lambda q: q[1] - unit * jnp.cos(q[3])},
    )
    mu, phi, rate, g = 2.5, 0.6, -0.5, 9.81
    nn, nt = 1 + 3 * np.sin(phi) ** 2, 3 * np.sin(phi) * np.cos(phi)  # of a rod of length 2 and mass 1
    free = np.cos(phi) * rate**2 - g
    seen = []
    for aside in (0.0, 0.1, 2.0, 5.0):
        along = 1.0
        velocity = np.array([along - np.cos(phi) * rate, -np.sin(phi) * rate, aside, rate])
        q0 = unit * np.array([0.0, np.cos(phi), 0.0, phi / unit])
        v0 = unit * np.array([*velocity[:3], velocity[3] / unit])
        motion = jl.simulate(rod, q0, v0, np.array([0.0, 1e-6]), {"mu": mu, "g": unit * g}, throw=False)
        gain = nn - mu * nt * along / np.hypot(along, aside)
        seen.append(gain > 0)
        if gain > 0:
            np.testing.assert_allclose(motion.multipliers["floor"][0] / unit, -free / gain, rtol=1e-9)
        else:
            assert "Painlevé" in str(motion.result)
    assert seen == [False, False, True, True]


@pytest.mark.slow
def test_a_ring_that_slides_and_spins():
    """On 64 points, whose sum is as good as Coulomb and Contensou's integral over the ring while none is at rest: by SciPy's quadrature."""
    at = np.stack([np.cos(2 * np.pi * np.arange(64) / 64), np.sin(2 * np.pi * np.arange(64) / 64)], axis=1)

    def slip(q, qdot):
        c, s = jnp.cos(q["turn"]), jnp.sin(q["turn"])
        x, y = c * at[:, 0] - s * at[:, 1], s * at[:, 0] + c * at[:, 1]
        return qdot["x"][None] + qdot["turn"] * jnp.stack([-y, x], axis=1)

    ring = jl.System(
        lambda qdot: 0.5 * qdot["x"] @ qdot["x"] + 0.5 * qdot["turn"] ** 2,
        dissipation=lambda q, qdot, N: jnp.sum(N / 64 * jnp.linalg.norm(slip(q, qdot), axis=1)),
    )
    N, v0 = 3.0, np.array([1.0, 0.3, 2.5])

    def rates(t, y):
        size, spin = np.hypot(*y[3:5]), y[5]
        slips = lambda angle: np.sqrt(size**2 + spin**2 - 2 * size * spin * np.sin(angle))
        mean = lambda of: quad(of, 0, 2 * np.pi, epsabs=1e-12, epsrel=1e-12)[0] / (2 * np.pi)
        along = mean(lambda angle: (size - spin * np.sin(angle)) / slips(angle))  # of the angle from the velocity
        about = mean(lambda angle: (spin - size * np.sin(angle)) / slips(angle))
        return [*y[3:], *(-N * along * y[3:5] / size), -N * about]

    T = 0.25
    expected = solve_ivp(rates, [0, T], [0, 0, 0, *v0], rtol=1e-10, atol=1e-12, method="DOP853").y[:, -1]
    start = {"x": np.zeros(2), "turn": 0.0}, {"x": v0[:2], "turn": v0[2]}
    motion = jl.simulate(ring, *start, np.array([0.0, T]), {"N": N}, rtol=1e-9, atol=1e-11)
    found = [*motion.q["x"][-1], motion.q["turn"][-1], *motion.qdot["x"][-1], motion.qdot["turn"][-1]]
    np.testing.assert_allclose(found, expected, rtol=1e-7)
