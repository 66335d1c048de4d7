"""Digital controllers in the loop, with and without dry friction, against NumPy's exact solution from tick to tick."""

import jax
import jax.numpy as jnp
import make_linear_drive as drive
import numpy as np
import pytest
from scipy.linalg import expm

import jaxlag as jl

PLANT = {"M": 95.0, "Fv": 200.0, "Fc": 60.0, "offset": -3.0}
PARAMS = PLANT | {"kp": 40.0, "kv": 120.0, "limit": 4.5, "period": 1e-3, "seen": 0.00095}
FREE_PARAMS = PARAMS | {"Fc": 0.0}
START = 0.001, 0.05
SHARP = {"rtol": 1e-10, "atol": 1e-12}


def goal(t, xp=jnp):
    return 0.05 * xp.sin(2.5 * t)


def pd(t, q, control, kp, kv, limit, period, xp=jnp):
    """Position feedback and the difference of two positions, within the limits of the amplifier."""
    rate = (q - control["seen"]) / period
    return {"u": xp.clip(kv * (kp * (goal(t, xp) - q) - rate), -limit, limit), "seen": q}


OIL = {"oil": lambda qdot, Fv: 0.5 * Fv * qdot**2}
DRY = OIL | {"rail": lambda qdot, Fc: Fc * jnp.abs(qdot)}
PD = jl.Sampled(pd, every=lambda period: period, start=lambda seen: {"u": 0.0, "seen": seen})
inertia = lambda qdot, M: 0.5 * M * qdot**2
motor = lambda control, offset: drive.K * control["u"] - offset
FREE, RUBBING = (jl.System(inertia, dissipation=D, force=motor, states={"control": PD}) for D in (OIL, DRY))
MACHINES = {"free": (FREE, FREE_PARAMS), "rubbing": (RUBBING, PARAMS)}


def in_the_loop(ts, controllers, effort, plant, q, v):
    """q, q̇ and the controllers' states at the times: what is due at one instant sees what was before it, a sample what is after."""
    states, ticks = {name: start for name, (_, _, start) in controllers.items()}, dict.fromkeys(controllers, 0)
    now, found = ts[0], []
    for t in ts:
        while True:
            times = {name: ts[0] + ticks[name] * every for name, (_, every, _) in controllers.items()}
            tick = min(times.values())
            if tick > t + 1e-12:
                break
            q, v = drive.held(q, v, effort(states), tick - now, **plant)
            due, now = [name for name in times if times[name] <= tick + 1e-12], tick
            states = states | {name: controllers[name][0](tick, q, v, states) for name in due}
            ticks |= {name: ticks[name] + 1 for name in due}
        q, v = drive.held(q, v, effort(states), t - now, **plant)
        now = max(t, now)
        found.append((q, v, states))
    return np.array([q for q, _, _ in found]), np.array([v for _, v, _ in found]), [states for _, _, states in found]


def exactly(ts, p, q=START[0], v=START[1]):
    update = lambda t, q, v, states: pd(t, q, states["control"], p["kp"], p["kv"], p["limit"], p["period"], np)
    controllers = {"control": (update, p["period"], {"u": 0.0, "seen": p["seen"]})}
    return in_the_loop(ts, controllers, lambda states: drive.K * states["control"]["u"], {name: p[name] for name in PLANT}, q, v)


SAMPLES = {
    "at the ticks": np.linspace(0, 0.199, 200),
    "seven a tick": np.linspace(0, 0.199, 200) / 0.7,
    "some at ticks": np.linspace(0, 2.5e-3 * 199, 200),
    "never at a tick": 0.017 + 1e-3 * np.array([0, *(12 * k + 0.4 + 0.2 * np.sin(k) for k in range(199))]),
}
AWAY = SAMPLES["never at a tick"]


@pytest.mark.parametrize("ts", SAMPLES.values(), ids=SAMPLES)
@pytest.mark.parametrize("system, params", MACHINES.values(), ids=MACHINES)
def test_a_controller_with_memory_and_saturation_against_the_exact_motion(system, params, ts):
    motion = jl.simulate(system, *START, ts, params, **SHARP)
    q, v, states = exactly(ts, params)
    np.testing.assert_allclose(motion.q, q, rtol=0, atol=1e-10)
    np.testing.assert_allclose(motion.qdot, v, rtol=0, atol=1e-10)
    commands = np.array([state["control"]["u"] for state in states])
    assert np.any(np.abs(commands) == params["limit"]) and np.any(np.abs(commands) < params["limit"])
    np.testing.assert_allclose(motion.states["control"]["u"], commands, rtol=0, atol=1e-5)
    np.testing.assert_allclose(motion.states["control"]["seen"], [state["control"]["seen"] for state in states], rtol=0, atol=1e-10)


def test_the_drive_sticks_and_slips_when_the_exact_one_does():
    """Also between ticks; and friction at rest balances the held command."""
    motion, (_, v, states) = jl.simulate(RUBBING, *START, AWAY, PARAMS, **SHARP), exactly(AWAY, PARAMS)
    rail = motion.friction["rail"]
    np.testing.assert_array_equal(rail.sticking, v == 0)
    assert motion.stats["transitions"][-1] == 4
    force = np.array([drive.K * state["control"]["u"] - PARAMS["offset"] for state in states])
    np.testing.assert_allclose(rail.force[v == 0], -force[v == 0], rtol=1e-8)


def weighted(q):
    return np.random.default_rng(3).normal(size=200) @ q


FREE_OF = ("M", "Fv", "offset", "kp", "kv", "limit", "period", "seen", "x0", "v0")
SENSITIVE = {"free": FREE_OF, "rubbing": (*FREE_OF, "Fc")}


def moved(p):
    """A number of the exact motion, of which x0 and v0 are the start."""
    return weighted(exactly(AWAY, p, p["x0"], p["v0"])[0])


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.grad])
@pytest.mark.parametrize("machine", MACHINES)
def test_derivatives_in_gains_plant_period_and_start(machine, derivative):
    """By the logarithm of each, so that they compare; `seen` is the memory with which the controller starts."""
    (system, params), names = MACHINES[machine], SENSITIVE[machine]
    everything = params | {"x0": START[0], "v0": START[1]}
    value = lambda p: weighted(jl.simulate(system, p["x0"], p["v0"], AWAY, p, **SHARP).q)
    found = derivative(value)(everything)
    for name in names:
        h = 1e-6 * everything[name]
        up, down = (moved(everything | {name: everything[name] + step}) for step in (h, -h))
        np.testing.assert_allclose(found[name] * everything[name], (up - down) / 2e-6, rtol=1e-5, atol=2e-9, err_msg=name)


@pytest.mark.slow
def test_second_derivatives_in_a_gain_and_the_mass():
    """Within the limits of the amplifier, so that differences of the second order hold."""
    scaled = lambda x: FREE_PARAMS | {"limit": 100.0, "kp": FREE_PARAMS["kp"] * x[0], "M": FREE_PARAMS["M"] * x[1]}
    found = jax.hessian(lambda x: weighted(jl.simulate(FREE, *START, AWAY, scaled(x), **SHARP).q))(jnp.ones(2))
    value = lambda *x: weighted(exactly(AWAY, scaled(x))[0])
    h = 1e-3
    corner = sum(a * b * value(1 + a * h, 1 + b * h) for a in (1, -1) for b in (1, -1)) / (4 * h**2)
    sides = [(value(*(1 + h * e)) - 2 * value(1, 1) + value(*(1 - h * e))) / h**2 for e in np.eye(2)]
    np.testing.assert_allclose(found, [[sides[0], corner], [corner, sides[1]]], rtol=1e-4)


def speed_loop(qdot, speed, w, ki, limit, xp=jnp):
    """Proportional and integral, 2 ms."""
    error = w - qdot
    total = speed["sum"] + 2e-3 * ki * error
    return {"u": xp.clip(100.0 * error + total, -limit, limit), "sum": total}


def position_loop(t, q, speed, w, kp, xp=jnp):
    """5 ms; softer where the amplifier is at work, and smoothed."""
    return 0.5 * w + 0.5 * (kp * (goal(t, xp) - q) - 0.003 * speed["u"])


@pytest.mark.slow
def test_two_controllers_of_different_periods_that_read_each_other():
    """Every 10 ms both are due, and neither sees yet what the other has just computed; ticks count from ts[0]."""
    loops = {
        "w": jl.Sampled(position_loop, every=5e-3, start=0.05),
        "speed": jl.Sampled(speed_loop, every=2e-3, start={"u": 0.0, "sum": 0.1}),
    }
    system = jl.System(inertia, dissipation=DRY, force=lambda speed, offset: drive.K * speed["u"] - offset, states=loops)
    p = PLANT | {"kp": 30.0, "ki": 400.0, "limit": 6.0}
    updates = {
        "w": (lambda t, q, v, s: position_loop(t, q, s["speed"], s["w"], p["kp"], np), 5e-3, 0.05),
        "speed": (lambda t, q, v, s: speed_loop(v, s["speed"], s["w"], p["ki"], p["limit"], np), 2e-3, {"u": 0.0, "sum": 0.1}),
    }
    for ts in (SAMPLES["some at ticks"], AWAY):
        motion = jl.simulate(system, *START, ts, p, **SHARP)
        q, v, states = in_the_loop(ts, updates, lambda states: drive.K * states["speed"]["u"], PLANT, *START)
        np.testing.assert_allclose(motion.q, q, rtol=0, atol=1e-10)
        np.testing.assert_allclose(motion.qdot, v, rtol=0, atol=1e-10)
        np.testing.assert_allclose(motion.states["w"], [s["w"] for s in states], rtol=0, atol=1e-8)
        np.testing.assert_allclose(motion.states["speed"]["sum"], [s["speed"]["sum"] for s in states], rtol=0, atol=1e-8)
        np.testing.assert_allclose(motion.states["speed"]["u"], [s["speed"]["u"] for s in states], rtol=0, atol=1e-6)


@pytest.mark.parametrize("start, every", [(0.0, 0.1), (0.3, 0.1), (1000.0, 1 / 3)])
def test_no_tick_is_lost_or_counted_twice(start, every):
    """A counter at sample times that are its ticks but for rounding."""
    idle = jl.System(lambda qdot: 0.5 * qdot**2, states={"n": jl.Sampled(lambda n: n + 1, every=lambda every: every, start=0)})
    ts = np.linspace(start, start + 1000 * every, 1001)
    motion = jl.simulate(idle, 0.0, 1.0, ts, {"every": every})
    np.testing.assert_array_equal(motion.states["n"], np.arange(1, 1002))
    np.testing.assert_allclose(motion.q, ts - start, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_a_controller_sees_the_sample_of_its_reference_that_comes_at_its_tick():
    """A table at 1 kHz, with times as a file has them, and a controller at 1 kHz: k·0.001 is not always the number printed as 0.00k."""
    times = np.array([float(f"{k / 1000:.3f}") for k in range(400)])
    values = np.random.default_rng(5).normal(size=400)
    follow = jl.Sampled(lambda t, r: r(t), every=1e-3)
    system = jl.System(lambda qdot: 0.5 * qdot**2, force=lambda u: u, states={"u": follow})
    motion = jl.simulate(system, 0.0, 0.0, times, {"r": jl.Signal(times, values)})
    np.testing.assert_array_equal(motion.states["u"], values)
    np.testing.assert_allclose(motion.qdot[1:], 1e-3 * np.cumsum(values[:-1]), rtol=0, atol=1e-12)


@pytest.mark.slow
def test_a_slow_actuator_under_a_controller():
    """A first-order state and a sampled one: linear from tick to tick, so a power of two matrices."""
    m, b, tau, every = 2.0, 3.0, 4e-3, 1e-2
    states = {
        "z": jl.State(lambda z, u, tau: (u - z) / tau, start=0.4),
        "u": jl.Sampled(lambda q, qdot, z: 40 * (1 - q) - 6 * qdot - 0.2 * z, every=every, start=5.0),
    }
    system = jl.System(lambda qdot, m: 0.5 * m * qdot**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2, force=lambda z: z, states=states)
    A = np.array([[0, 1, 0, 0], [0, -b / m, 1 / m, 0], [0, 0, -1 / tau, 1 / tau], [0, 0, 0, 0]])
    y, expected = np.array([0.0, 0.0, 0.4, 5.0]), []
    for _ in range(100):
        y[3] = 40 * (1 - y[0]) - 6 * y[1] - 0.2 * y[2]
        for step in (0.3, 0.7):
            expected.append(y)
            y = expm(A * step * every) @ y
    ts = every * np.ravel([(k, k + 0.3) for k in range(100)])
    motion = jl.simulate(system, 0.0, 0.0, ts, {"m": m, "b": b, "tau": tau}, **SHARP)
    found = np.stack([motion.q, motion.qdot, motion.states["z"], motion.states["u"]], axis=1)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_the_gradient_in_a_table_of_commands():
    """More numbers than a forward pass takes; q(T) = Σ u_k h (T − t_k − h/2), linear in each."""
    states = {"n": jl.Sampled(lambda n: n + 1, every=0.01), "u": jl.Sampled(lambda n, table: table[n.astype(int)], every=0.01)}
    system = jl.System(lambda qdot: 0.5 * qdot**2, force=lambda u: u, states=states)
    end = lambda table: jl.simulate(system, 0.0, 0.0, [0.0, 1.0], {"table": table}).q[-1]
    table = np.random.default_rng(4).normal(size=100)
    each = 0.01 * (1 - 0.01 * np.arange(100) - 0.005)
    np.testing.assert_allclose(end(table), table @ each, rtol=1e-10)
    np.testing.assert_allclose(jax.grad(end)(jnp.asarray(table)), each, rtol=1e-9)


@pytest.mark.slow
def test_a_spring_whose_end_a_controller_moves():
    """L depends on the sampled state, and explicit time does the work of its steps."""
    move = jl.Sampled(lambda t: jnp.sin(9 * t), every=0.25, start=0.5)
    system = jl.System(lambda q, qdot, u: 0.5 * qdot**2 - 2 * (q - u) ** 2, states={"u": move})
    ts = np.linspace(0, 2, 41)  # every fifth is a tick
    motion = jl.simulate(system, 1.0, 0.0, ts, works=True, **SHARP)
    y, expected, wave = np.array([1.0, 0.0]), [], expm(0.05 * np.array([[0, 1], [-4, 0]]))
    for k in range(41):
        u = np.sin(9 * ts[k - k % 5])
        expected.append((*y, u))
        y = wave @ (y - [u, 0]) + [u, 0]
    q, v, u = np.transpose(expected)
    np.testing.assert_allclose((motion.q, motion.qdot, motion.states["u"]), (q, v, u), rtol=0, atol=1e-10)
    energy = 0.5 * v**2 + 2 * (q - u) ** 2
    np.testing.assert_allclose(motion.work()["time"], energy - energy[0], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_controller_that_sets_a_speed():
    """A velocity constraint that jumps at each tick, also at the first: an impulse, which counts from the start."""
    states = {"u": jl.Sampled(lambda t: jnp.cos(9 * t), every=0.25)}
    belt = jl.System(lambda qdot: qdot**2, nonholonomic={"belt": lambda qdot, u: qdot - u}, states=states)
    ts = np.linspace(0, 1, 11)
    motion = jl.simulate(belt, 0.0, 0.0, ts, works=True)
    speed = np.cos(9 * 0.25 * np.floor(4 * ts + 1e-9))
    np.testing.assert_allclose(motion.qdot, speed, rtol=0, atol=1e-12)
    np.testing.assert_allclose(sum(motion.work().values()), speed**2 - speed[0] ** 2, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_many_machines_with_gains_and_periods_of_their_own():
    kp, period = jnp.array([80.0, 120.0, 160.0]), jnp.array([1e-3, 1.7e-3, 2.3e-3])
    expected = [exactly(AWAY, FREE_PARAMS | {"kp": k, "period": T})[0] for k, T in zip(kp, period, strict=True)]
    p = FREE_PARAMS | {"kp": kp, "period": period}
    many = jl.simulate_many(FREE, *START, AWAY, p, over=("kp", "period"), **SHARP)
    np.testing.assert_allclose(many.q, expected, rtol=0, atol=1e-10)
    assert many.states["control"]["u"].shape == (3, 200)
    one = lambda kp, period: jl.simulate(FREE, *START, AWAY, FREE_PARAMS | {"kp": kp, "period": period}, **SHARP).q
    np.testing.assert_allclose(jax.jit(jax.vmap(one))(kp, period), expected, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_single_precision():
    with jax.enable_x64(False):
        motion = jl.simulate(FREE, *map(np.float32, START), SAMPLES["some at ticks"], PARAMS)
        assert motion.q.dtype == motion.states["control"]["u"].dtype == jnp.float32
    np.testing.assert_allclose(motion.q, exactly(SAMPLES["some at ticks"], FREE_PARAMS)[0], rtol=0, atol=2e-5)


@pytest.mark.slow
@pytest.mark.parametrize("system, params", MACHINES.values(), ids=MACHINES)
def test_the_energy_balance_of_the_loop(system, params):
    motion = jl.simulate(system, *START, AWAY, params, works=True, **SHARP)
    _, v, states = exactly(AWAY, params)
    energy = 0.5 * params["M"] * v**2
    np.testing.assert_allclose(sum(motion.work().values()), energy - energy[0], rtol=0, atol=1e-8)
    assert np.max(np.abs(motion.balance())) < 1e-9
    by_hand = drive.K * states[50]["control"]["u"] - params["offset"]
    named = jl.powers(system, motion.q[50], motion.qdot[50], params, t=AWAY[50], states={"control": states[50]["control"]})
    np.testing.assert_allclose(named["force"], by_hand * v[50], rtol=1e-8)


def test_the_acceleration_under_a_given_command_and_under_that_of_the_start():
    given = jl.acceleration(FREE, 0.1, 0.3, PARAMS, states={"control": {"u": 2.0, "seen": 0.1}})
    np.testing.assert_allclose(given.qddot, (drive.K * 2 - 200 * 0.3 + 3) / 95, rtol=1e-12)
    np.testing.assert_allclose(jl.acceleration(FREE, 0.1, 0.3, PARAMS).qddot, (-200 * 0.3 + 3) / 95, rtol=1e-12)
    motion = jl.simulate(FREE, *START, AWAY, FREE_PARAMS)
    expected = (drive.K * motion.states["control"]["u"] - 200 * motion.qdot + 3) / 95
    np.testing.assert_allclose(motion.qddot, expected, rtol=1e-10)


@pytest.mark.slow
def test_identification_in_the_loop():
    """Mass, oil and friction from noisy positions of a machine that its controller drives, from half as much and more."""
    names, ts, sigma = ("M", "Fv", "Fc"), AWAY, 2e-5
    measured = exactly(ts, PARAMS)[0] + sigma * np.random.default_rng(11).normal(size=ts.size)
    record = jl.Experiment(ts, {"q": measured}, *START, observe=lambda q: {"q": q})
    start = PARAMS | {"M": 60.0, "Fv": 300.0, "Fc": 10.0}
    found = jl.fit(RUBBING, record, start, free=names)
    assert found.converged
    for name in names:
        assert abs(found.estimates[name] - PARAMS[name]) < 3 * found.standard_errors[name] < 0.2 * PARAMS[name], name
