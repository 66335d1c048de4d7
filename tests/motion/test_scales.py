"""Motions and their derivatives do not depend on the units of their coordinates and of their clock."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate

import jaxlag as jl

UNITS = [(1.0, 1.0), (1e-12, 1.0), (1e9, 1e6), (1e-9, 1e-6), (1e-9, 1e6)]  # of length and of time

CIRCUIT = jl.System(lambda q, V, C: V * q - 0.5 * q**2 / C, dissipation=lambda qdot, R: 0.5 * R * qdot**2)
OSCILLATOR = jl.System(lambda q, qdot, w: 0.5 * qdot**2 - 0.5 * w**2 * q**2)
SLIDER = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2, dissipation=lambda qdot, F: F * jnp.abs(qdot))
BALL = jl.System(lambda q, qdot, g: 0.5 * qdot**2 - g * q, unilateral={"floor": jl.Contact(lambda q: q, restitution=0.5)})
AROUND = {"rod": lambda q, l: q @ q - l**2}
AGAIN = {"again": lambda q, l: (2 + jnp.cos(q[0] / l)) * (q @ q - l**2) / l}
ONCE, TWICE = (jl.System(lambda q, qdot, g: 0.5 * qdot @ qdot - g * q[1], holonomic=rows) for rows in (AROUND, AROUND | AGAIN))


@pytest.mark.slow
def test_a_circuit_of_small_charges():
    """q = V C (1 − exp(−t/RC)), of 1e-10 C: with an absolute tolerance of 1e-10 it was 87 % off."""
    ts = np.linspace(0, 5e-4, 51)
    charge = jl.simulate(CIRCUIT, 0.0, 0.0, ts, {"V": 1.0, "C": 1e-10, "R": 1e6}).q
    np.testing.assert_allclose(charge, -1e-10 * np.expm1(-ts / 1e-4), rtol=1e-7, atol=1e-25)


@pytest.mark.parametrize("length, time", UNITS)
def test_an_oscillator(length, time):
    ts = np.linspace(0, 20, 41)
    motion = jl.simulate(OSCILLATOR, length, 0.0, ts * time, {"w": 2 / time})
    np.testing.assert_allclose(motion.q / length, np.cos(2 * ts), atol=1e-7)
    assert motion.stats["num_steps"] == jl.simulate(OSCILLATOR, 1.0, 0.0, ts, {"w": 2.0}).stats["num_steps"]


@pytest.mark.parametrize("length, time", UNITS)
def test_dry_friction(length, time):
    """An oscillator (c = 4) loses 2 F/c of its amplitude each half a period, and rests where |c x| ≤ F: from 1, F = 0.3, at 0.1."""
    motion = jl.simulate(SLIDER, length, 0.0, np.array([0.0, 20.0]) * time, {"c": 4 / time**2, "F": 0.3 * length / time**2})
    left = 1.0
    while left * 4 > 0.3:
        left = abs(left - 0.15) if left > 0.075 else left
    np.testing.assert_allclose(abs(motion.q[-1]) / length, left, rtol=1e-7)


@pytest.mark.parametrize("length, time", UNITS)
def test_a_bouncing_ball(length, time):
    """From 1 with g = 10 and e = ½ it rests after √(2h/g) (1 + e)/(1 − e) = 3 √0.2."""
    motion = jl.simulate(BALL, length, 0.0, np.array([0.0, 1.0, 5.0]) * time, {"g": 10 * length / time**2})
    np.testing.assert_allclose(motion.contacts["floor"].changed[-1] / time, 3 * np.sqrt(0.2), rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("length, time", UNITS)
def test_a_rod_stated_twice_by_different_equations(length, time):
    """Off the rod, as within a step, they ask for two things: q̇ was off by up to a tenth, and some twenty times the steps were taken."""
    ts, start, params = np.linspace(0, 20, 11), np.array([np.sin(1.0), -np.cos(1.0)]), {"g": 10 * length / time**2, "l": length}
    rates = lambda t, s: [s[1], -10 * np.sin(s[0])]
    angle, rate = integrate.solve_ivp(rates, (0, ts[-1]), [1.0, 0.0], "DOP853", ts, rtol=1e-12, atol=1e-12).y
    motion = jl.simulate(TWICE, length * start, np.zeros(2), (ts + 300) * time, params)
    np.testing.assert_allclose(motion.q / length, np.stack([np.sin(angle), -np.cos(angle)], axis=1), atol=1e-6)
    np.testing.assert_allclose(motion.qdot * time / length, np.stack([rate * np.cos(angle), rate * np.sin(angle)], axis=1), atol=1e-6)
    once = jl.simulate(ONCE, length * start, np.zeros(2), (ts + 300) * time, params)
    assert motion.stats["num_steps"] <= 1.1 * once.stats["num_steps"]


@pytest.mark.slow
def test_a_chain_named_mass_by_mass():
    """The last of twelve masses moves by coupling alone, at first like t²⁴: it has no scale then, and is compared with none."""

    def energy(q, qdot):
        x = [q[f"x{i}"] for i in range(12)]
        springs = sum((b - a) ** 2 for a, b in zip([0.0, *x], [*x, 0.0], strict=True))
        return 0.5 * sum(v**2 for v in qdot.values()) - 0.5 * springs

    q0 = {f"x{i}": 1e-6 * (i == 0) for i in range(12)}
    motion = jl.simulate(jl.System(energy), q0, dict.fromkeys(q0, 0.0), [0.0, 5.0, 20.0])
    K = 2 * np.eye(12) - np.eye(12, k=1) - np.eye(12, k=-1)
    w2, modes = np.linalg.eigh(K)
    exact = 1e-6 * modes @ (modes[0][:, None] * np.cos(np.sqrt(w2)[:, None] * np.array([5.0, 20.0])))
    found = np.array([motion.q[f"x{i}"][1:] for i in range(12)])
    np.testing.assert_allclose(found, exact, atol=1e-13)


CHAIN = jl.System(
    lambda q, qdot: 0.5 * qdot @ qdot - 0.5 * jnp.sum(jnp.diff(q, prepend=0, append=0) ** 2),
    force=lambda t, q: jnp.zeros_like(q).at[0].set(jnp.sin(t)),
)


@pytest.mark.slow
def test_a_chain_that_is_shaken_at_one_end():
    """From rest at zero: the motion of its masses grows like t³, t⁵, …, t⁸¹. What is yet to be moved does not set the steps."""
    run = lambda **given: jl.simulate(CHAIN, np.zeros(40), np.zeros(40), [0.0, 20.0, 60.0], **given)
    motion, coarse = run(), run(atol=1e-10)
    assert motion.stats["num_steps"] < 3 * coarse.stats["num_steps"]
    batch = jl.simulate_many(CHAIN, np.zeros((2, 40)), np.zeros(40), [0.0, 20.0, 60.0], over=("q0",), common_steps=True)
    assert np.all(batch.stats["num_steps"] < 1.2 * motion.stats["num_steps"])
    w2, modes = np.linalg.eigh(2 * np.eye(40) - np.eye(40, k=1) - np.eye(40, k=-1))
    w, t = np.sqrt(w2), np.array([[20.0], [60.0]])
    exact = (modes[0] * (np.sin(t) - np.sin(w * t) / w) / (w2 - 1)) @ modes.T
    np.testing.assert_allclose(motion.q[1:], exact, atol=1e-7)


def net(q, l):
    return [jnp.linalg.norm(jnp.diff(q, axis=side), axis=-1) - l for side in (0, 1)]


NET = jl.System(
    lambda q, qdot, l: 0.5 * 0.025 * jnp.sum(qdot**2) - 0.025 * 9.81 * jnp.sum(q[..., 2]) - 1e3 * sum(jnp.sum(s**2) for s in net(q, l)),
    holonomic={"left": lambda q, origin: q[0, 0] - origin, "right": lambda q, origin: q[-1, 0, 1:] - origin},
)


@pytest.mark.slow
def test_a_net_that_begins_to_hang():
    """Springs of 0.1 m cancel but for rounding in coordinates that are zero, or held by a hook: it does not matter where the origin is."""
    flat = 0.1 * np.stack(np.meshgrid(np.arange(3), np.arange(3), [0.0], indexing="ij"), axis=-1)[:, :, 0]

    def run(origin):
        motion = jl.simulate(NET, flat + origin, np.zeros((3, 3, 3)), np.linspace(0, 0.5, 6), {"l": 0.1, "origin": origin})
        return motion.q - origin, int(motion.stats["num_steps"])

    (here, steps), (there, of_there) = run(0.0), run(3.0)
    assert steps < 1.5 * of_there
    np.testing.assert_allclose(here, there, atol=1e-6)


@pytest.mark.slow
def test_a_slow_slider_beside_a_fast_rotor():
    """Each is compared with its own scale: 1e-6 beside 1e4."""
    system = jl.System(lambda q, qdot: 0.5 * qdot["x"] ** 2 - 0.5 * q["x"] ** 2 + 0.5 * qdot["phi"] ** 2)
    motion = jl.simulate(system, {"x": 1e-6, "phi": 0.0}, {"x": 0.0, "phi": 1e4}, [0.0, 10.0])
    np.testing.assert_allclose(motion.q["x"][-1], 1e-6 * np.cos(10.0), rtol=1e-6)


@pytest.mark.slow
def test_a_given_absolute_tolerance_is_taken_as_given():
    steps = lambda **given: int(jl.simulate(OSCILLATOR, 1e-9, 0.0, [0.0, 20.0], {"w": 2.0}, **given).stats["num_steps"])
    assert steps(atol=1e-10) < steps(atol=1e-18) <= steps(atol=1e-19)
    each = jl.System(lambda q, qdot: sum(0.5 * qdot[k] ** 2 - 2 * q[k] ** 2 for k in "xy"))
    run = lambda atol: jl.simulate(each, {"x": 1e-9, "y": 1e-9}, {"x": 0.0, "y": 0.0}, [0.0, 20.0], atol=atol).stats["num_steps"]
    assert run({"x": 1e-3, "y": 1e-18}) > run({"x": 1e-3, "y": 1e-3})


@pytest.mark.slow
def test_a_circuit_that_is_fitted():
    """RC from charges of 1e-10 C: 1.31 in place of 1.023 before."""
    ts, noise = np.linspace(0, 5e-4, 51), np.random.default_rng(0).normal(size=51)
    charge = -1e-10 * np.expm1(-ts / 1.023e-4) + 1e-12 * noise
    record = jl.Experiment(ts, {"q": charge}, 0.0, 0.0, observe=lambda q: {"q": q}, sigma={"q": 1e-12})
    fit = jl.fit(CIRCUIT, record, {"V": 1.0, "C": 1e-10, "R": 0.7e6}, free=("R",))
    slope = 1e-10 * (-ts / 1.023e-4) * np.exp(-ts / 1.023e-4) / 1.023e6  # dq/dR
    sigma = 1e-12 / np.sqrt(np.sum(slope**2))
    np.testing.assert_allclose(fit.params["R"], 1.023e6, atol=4 * sigma)
    np.testing.assert_allclose(fit.standard_errors["R"], sigma, rtol=0.05)


@pytest.mark.slow
def test_single_precision(single_precision):
    ts = np.linspace(0, 20, 11)
    for length in (1.0, 1e-9):
        motion = jl.simulate(OSCILLATOR, length, 0.0, ts, {"w": 2.0})
        np.testing.assert_allclose(np.asarray(motion.q) / length, np.cos(2 * ts), atol=2e-3)


LED = jl.System(
    lambda q, qdot, L: 0.5 * jnp.sum((qdot / L) ** 2) - 2.0 * ((q[1] - q[0]) / L) ** 2,
    holonomic=lambda t, q, a, L, t0: q[0] - a * L * jnp.sin(t - t0) ** 2,
)


@pytest.mark.parametrize(("L", "t0", "atol"), [(1.0, 0.0, 1e-7), (1e-9, 1e6, 1e-7), (1e9, 1e9, 1e-5)])
@pytest.mark.parametrize("a", [1.0, 0.0])
def test_a_mass_that_is_led_from_rest_in_resonance(L, t0, atol, a):
    """x = a/2 (1 − cos 2t − t sin 2t) behind a spring whose end is led as a sin² t; and its derivative by a."""
    ts = np.linspace(0.0, 5.0, 6)
    run = lambda a: jl.simulate(LED, jnp.zeros(2), jnp.zeros(2), t0 + ts, {"a": a, "L": L, "t0": t0}, throw=False).q[:, 1] / L
    by_hand = (1 - np.cos(2 * ts) - ts * np.sin(2 * ts)) / 2
    np.testing.assert_allclose(run(a), a * by_hand, atol=atol)
    np.testing.assert_allclose(jax.jacfwd(run)(a), by_hand, atol=atol)


LEAD = jl.System(
    lambda qdot: 0.5 * qdot**2,
    dissipation=lambda qdot, b: 0.5 * b * qdot**2,
    holonomic={"drive": lambda t, q, L, T, t0: q - L * jnp.sin((t - t0) / T)},
)


@pytest.mark.slow
@pytest.mark.parametrize(("L", "T", "t0"), [(1.0, 1.0, 0.0), (1e-9, 1e6, 1e9)])
@pytest.mark.parametrize(("a", "b"), [(1.0, 0.3), (1.0, 0.0), (0.0, 0.3)])
def test_the_work_of_a_drive_that_gives_the_only_coordinate(L, T, t0, a, b):
    """q = a L sin(t/T): with nothing to integrate, steps are as long as the works allow; off by 5e-3 where they followed q alone.

    And the derivatives by a and b, also at zero.
    """
    ts, path = np.linspace(0.0, 16.0, 33), np.linspace(0.0, 8.0, 33) + np.sin(np.linspace(0.0, 32.0, 33)) / 4

    def run(x):
        params = {"L": x[0] * L, "T": T, "t0": t0, "b": x[1] / T}
        motion = jl.simulate(LEAD, 0.0, x[0] * L / T, t0 + T * ts, params, works=True)
        return jnp.stack([motion.work()["drive"], motion.work()["dissipation"]]) * (T / L) ** 2, motion.balance()

    x, swing = jnp.array([a, b]), np.sin(ts) ** 2 / 2
    works, balance = run(x)
    np.testing.assert_allclose(works, a**2 * np.stack([b * path - swing, -b * path]), atol=1e-6)
    np.testing.assert_allclose(balance, 0, atol=1e-6)
    by_hand = [np.stack([2 * a * (b * path - swing), a**2 * path], 1), np.stack([-2 * a * b * path, -(a**2) * path], 1)]
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(lambda x: run(x)[0])(x), by_hand, atol=2e-6)


@pytest.mark.slow
def test_works_of_a_net_that_hooks_hold():
    """What a constraint holds does no work: with works along the motion takes no more steps (20 times as many where the hooks set them)."""
    flat = np.stack(np.meshgrid(*2 * [0.1 * np.arange(20)], [0.0], indexing="ij"), axis=-1)[:, :, 0]
    stretched = lambda q: [jnp.linalg.norm(jnp.diff(q, axis=side), axis=-1) - 0.1 for side in (0, 1)]

    def lagrangian(q, qdot):
        return 0.0125 * jnp.sum(qdot**2) - 0.025 * 9.81 * jnp.sum(q[..., 2]) - 1000.0 * sum(jnp.sum(s**2) for s in stretched(q))

    def damping(q, qdot):
        return sum(0.5 * jnp.sum(rate**2) for rate in jax.jvp(stretched, (q,), (qdot,))[1]) + 0.015 * jnp.sum(qdot**2)

    hooks = {"left": lambda q: q[0, 0] - flat[0, 0], "right": lambda q: q[-1, 0] - flat[-1, 0]}
    net = jl.System(lagrangian, dissipation=damping, holonomic=hooks)
    run = lambda works: jl.simulate(net, flat, np.zeros_like(flat), np.linspace(0.0, 0.6, 7), works=works, throw=False, max_steps=3000)
    plain, audited = run(False), run(True)
    assert audited.succeeded and audited.stats["num_steps"] <= 1.1 * plain.stats["num_steps"]
    np.testing.assert_allclose(audited.balance(), 0, atol=1e-7)
