"""What real actuators and sensors add: a dead zone, saturation, backlash, a delay and a scale, against NumPy."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

M, B = 2.0, 3.0
TICK = 0.01
TIMES = np.arange(0, 300) * TICK
COMMANDS = 6 * np.sin(3 * TIMES) + 2 * np.sin(17 * TIMES)


def deadened(u, zone, limit, xp=jnp):
    return xp.clip(u - xp.clip(u, -zone, zone), -limit, limit)


def moved(ts, forces, times):
    """Position and velocity of m v̇ + b v = F with a force that is held, exactly."""
    q, v, now, found = 0.0, 0.0, ts[0], []
    for t in ts:
        for end in [*times[(times > now) & (times < t)], t]:
            final = forces[np.searchsorted(times, (now + end) / 2, side="right") - 1] / B
            decay = np.exp(-B / M * (end - now))
            q, v = q + final * (end - now) + (v - final) * M / B * (1 - decay), final + (v - final) * decay
            now = end
        found.append((q, v))
    return np.transpose(found)


def test_a_dead_zone_and_saturation_in_the_command():
    """As a sampled state, so that its value is there to be seen."""
    amplifier = jl.Sampled(lambda t, u, zone, limit: deadened(u(t), zone, limit), every=TICK)
    cart = jl.System(lambda qdot: 0.5 * M * qdot**2, dissipation=lambda qdot: 0.5 * B * qdot**2, force=lambda F: F, states={"F": amplifier})
    motion = jl.simulate(cart, 0.0, 0.0, TIMES, {"u": jl.Signal(TIMES, COMMANDS), "zone": 1.0, "limit": 4.0})
    forces = deadened(COMMANDS, 1.0, 4.0, np)
    assert np.any(forces == 0) and np.any(forces == 4.0)
    np.testing.assert_allclose(motion.states["F"], forces, atol=1e-13)
    np.testing.assert_allclose((motion.q, motion.qdot), moved(TIMES, forces, TIMES), atol=1e-11)


@pytest.mark.slow
def test_backlash_between_a_machine_and_its_sensor():
    """The play operator: the sensor follows only where the machine pushes it; observed, and identified with its width."""
    play = jl.Sampled(lambda q, x, w: jnp.clip(x, q - w, q + w), every=TICK)
    states = {"x": play}
    cart = jl.System(lambda qdot, m: 0.5 * m * qdot**2, dissipation=lambda qdot: 0.5 * B * qdot**2, force=lambda t, u: u(t), states=states)
    params = {"m": M, "w": 0.05, "u": jl.Signal(TIMES, COMMANDS)}
    motion = jl.simulate(cart, 0.0, 0.0, TIMES, params)
    q, _ = moved(TIMES, COMMANDS, TIMES)
    x, seen = 0.0, []
    for position in q:
        x = np.clip(x, position - 0.05, position + 0.05)
        seen.append(x)
    assert np.ptp(np.sign(q - seen)) == 2  # on both sides of its play
    np.testing.assert_allclose(motion.states["x"], seen, atol=1e-11)
    noise = 1e-3 * np.random.default_rng(0).normal(size=TIMES.size)
    record = jl.Experiment(TIMES, np.array(seen) + noise, 0.0, 0.0, params={"u": params["u"]}, observe=lambda x: x)
    found = jl.fit(cart, record, {"m": 1.5, "w": 0.03}, free=("m", "w"))
    for name in ("m", "w"):
        assert abs(found.estimates[name] - params[name]) < 3 * found.standard_errors[name] < 0.02 * params[name]


@pytest.mark.slow
def test_a_delay_and_a_scale_of_an_input_beside_the_mechanics():
    """Found together with the damping, from noisy positions; the delay is no multiple of the samples."""
    late, scale = 0.0237, 1.3
    cart = jl.System(lambda qdot: 0.5 * M * qdot**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2, force=lambda t, u, k: k * u(t))
    q, _ = moved(TIMES, np.concatenate([COMMANDS[:1], COMMANDS]) * scale, np.concatenate([[-1.0], TIMES + late]))
    noise = 1e-3 * np.random.default_rng(1).normal(size=TIMES.size)
    record = jl.Experiment(TIMES, q + noise, 0.0, 0.0)
    start = {"b": 2.0, "k": 1.0, "u": jl.Signal(TIMES, COMMANDS)}
    found = jl.fit(cart, record, start, free=("b", "k", "u.delay"))
    for name, true in (("b", B), ("k", scale), ("u.delay", late)):
        assert abs(found.estimates[name] - true) < 3 * found.standard_errors[name] < 0.05 * true, name
