"""First-order states beside the coordinates: motors with a lag, dampers, observers, against SciPy and matrix exponentials."""

import unicodedata

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import jaxlag as jl

SHARP = {"rtol": 1e-11, "atol": 1e-12}
mass = lambda qdot, m: 0.5 * m * qdot**2
oil = lambda qdot, b: 0.5 * b * qdot**2


def integrated(rate, ts, y0):
    """ẏ = rate(t, y) at the times, by SciPy, (states, times)."""
    return solve_ivp(rate, (ts[0], ts[-1]), y0, "DOP853", t_eval=ts, rtol=1e-12, atol=1e-13).y


# A motor with a lag


def lag(t, z, u, tau):
    return (u(t) - z) / tau


MOTOR = jl.System(mass, dissipation=oil, force={"motor": lambda z: z}, states={"z": jl.State(lag, start=lambda z0: z0)})
JUMPS, VALUES = np.array([0.0, 0.31, 0.7]), np.array([1.0, -2.0, 3.0])
PARAMS = {"m": 2.0, "b": 3.0, "tau": 0.2, "z0": 0.5, "u": jl.Signal(JUMPS, VALUES)}
TS = np.linspace(0, 1.5, 31)


def driven(ts=TS, m=2.0, b=3.0, tau=0.2, z0=0.5, **_):
    """q, q̇ and z of the motor under the held command: a matrix exponential from jump to jump."""
    A = np.array([[0, 1, 0, 0], [0, -b / m, 1 / m, 0], [0, 0, -1 / tau, 1 / tau], [0, 0, 0, 0]])
    y, now, found = np.array([0, 0, z0, 0]), ts[0], []
    for t in np.union1d(ts, JUMPS):
        y, now = expm(A * (t - now)) @ y, t
        y[3] = VALUES[np.searchsorted(JUMPS, t, side="right") - 1]
        if t in ts:
            found.append(y[:3])
    return np.transpose(found)


@pytest.mark.slow
def test_a_motor_with_a_lag_under_a_held_command():
    motion = jl.simulate(MOTOR, 0.0, 0.0, TS, PARAMS)
    q, v, z = driven()
    np.testing.assert_allclose(motion.q, q, rtol=0, atol=1e-8)
    np.testing.assert_allclose(motion.qdot, v, rtol=0, atol=1e-8)
    np.testing.assert_allclose(motion.states["z"], z, rtol=0, atol=1e-8)
    np.testing.assert_allclose(motion.qddot, (z - 3 * v) / 2, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_a_motor_with_a_lag_under_a_smooth_command():
    """At the default tolerances."""
    rate = lambda t, z, tau: (jnp.sin(20 * t) - z) / tau
    system = jl.System(mass, dissipation=oil, force=lambda z: z, states={"z": jl.State(rate)})
    ts = np.linspace(0.4, 3, 40)
    motion = jl.simulate(system, 0.1, -0.2, ts, {"m": 2.0, "b": 3.0, "tau": 0.05})
    expected = integrated(lambda t, y: [y[1], (y[2] - 3 * y[1]) / 2, (np.sin(20 * t) - y[2]) / 0.05], ts, [0.1, -0.2, 0.0])
    np.testing.assert_allclose((motion.q, motion.qdot, motion.states["z"]), expected, rtol=0, atol=1e-7)


@pytest.mark.slow
def test_a_motion_goes_on_from_one_of_its_samples():
    q, v, z = driven()
    rest = jl.simulate(MOTOR, q[12], v[12], TS[12:], PARAMS, states={"z": z[12]})
    np.testing.assert_allclose((rest.q, rest.qdot, rest.states["z"]), (q[12:], v[12:], z[12:]), rtol=0, atol=1e-8)


WEIGHTS = np.random.default_rng(1).normal(size=TS.size)
end = lambda p: WEIGHTS @ jl.simulate(MOTOR, 0.0, 0.0, TS, PARAMS | p, **SHARP).q
exact_end = lambda p: WEIGHTS @ driven(**p)[0]
AT = {"m": 2.0, "b": 3.0, "tau": 0.2, "z0": 0.5}


def differences(value, p, h=1e-5):
    return {name: (value(p | {name: x + h}) - value(p | {name: x - h})) / (2 * h) for name, x in p.items()}


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.grad])
def test_derivatives_in_the_lag_its_start_and_the_mass(derivative):
    found = derivative(end)(AT)
    for name, expected in differences(exact_end, AT).items():
        np.testing.assert_allclose(found[name], expected, rtol=1e-7, atol=1e-9, err_msg=name)


@pytest.mark.slow
def test_second_derivatives_in_the_lag_and_the_mass():
    found = jax.hessian(lambda x: end({"m": x[0], "tau": x[1]}))(jnp.array([2.0, 0.2]))
    slopes = lambda m, tau: differences(exact_end, {"m": m, "tau": tau}, 1e-4)
    for row, name in enumerate(("m", "tau")):
        h = 1e-4
        expected = (slopes(2 + h, 0.2)[name] - slopes(2 - h, 0.2)[name], slopes(2, 0.2 + h)[name] - slopes(2, 0.2 - h)[name])
        np.testing.assert_allclose(found[row], np.array(expected) / (2 * h), rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_many_motors():
    taus = jnp.array([0.05, 0.2, 0.8])
    expected = np.array([driven(tau=tau) for tau in taus])
    many = jl.simulate_many(MOTOR, 0.0, 0.0, TS, PARAMS | {"tau": taus}, over=("tau",))
    np.testing.assert_allclose(many.q, expected[:, 0], rtol=0, atol=1e-8)
    np.testing.assert_allclose(many.states["z"], expected[:, 2], rtol=0, atol=1e-8)
    every = jax.vmap(lambda tau: jl.simulate(MOTOR, 0.0, 0.0, TS, PARAMS | {"tau": tau}))(taus)
    np.testing.assert_allclose(every.states["z"], expected[:, 2], rtol=0, atol=1e-8)


@pytest.mark.slow
def test_single_precision():
    with jax.enable_x64(False):
        single = PARAMS | {"u": jl.Signal(JUMPS, VALUES)}
        motion = jl.simulate(MOTOR, np.float32(0), np.float32(0), TS, single)
        assert motion.q.dtype == motion.states["z"].dtype == jnp.float32
    np.testing.assert_allclose(motion.states["z"], driven()[2], rtol=0, atol=2e-4)
    np.testing.assert_allclose(motion.q, driven()[0], rtol=0, atol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("free, sees", [(("tau", "z0"), "z"), (("m", "b", "tau"), "both")])
def test_identification_of_the_lag(free, sees):
    """From noisy measurements of the state alone, or beside the position."""
    ts, sigma, rng = np.linspace(0, 1.5, 200), 1e-3, np.random.default_rng(2)
    q, _, z = driven(ts) + sigma * rng.normal(size=(3, ts.size))
    observe = {"z": lambda z: z, "both": lambda q, z: {"q": q, "z": z}}[sees]
    record = jl.Experiment(ts, z if sees == "z" else {"q": q, "z": z}, 0.0, 0.0, observe=observe, sigma=sigma)
    found = jl.fit(MOTOR, record, PARAMS | {name: 1.5 * AT[name] for name in free}, free=free)
    assert found.converged
    for name in free:
        assert abs(found.estimates[name] - AT[name]) < 3 * found.standard_errors[name] < 0.1 * AT[name], name


# Springs and dampers in series (Maxwell): the state is the extension of the damper

MAXWELL = {"m": 1.5, "k": 4.0, "c": 30.0, "d": 6.0}
stretch = {"z": jl.State(lambda q, z, c, d: c / d * (q - z), start=0.1)}
BY_FORCE = jl.System(
    lambda q, qdot, m, k: 0.5 * m * qdot**2 - 0.5 * k * q**2, force={"element": lambda q, z, c: -c * (q - z)}, states=stretch
)
BY_ENERGY = jl.System(lambda q, qdot, z, m, k, c: 0.5 * m * qdot**2 - 0.5 * k * q**2 - 0.5 * c * (q - z) ** 2, states=stretch)


def maxwell(ts, m, k, c, d):
    A = np.array([[0, 1, 0], [-(k + c) / m, 0, c / m], [c / d, 0, -c / d]])
    return np.array([expm(A * t) @ [0.5, 1.0, 0.1] for t in ts]).T


@pytest.mark.parametrize("system, does", [(BY_FORCE, "element"), (BY_ENERGY, "time")], ids=["force", "energy"])
def test_a_maxwell_element_and_its_energy(system, does):
    """As a force it takes all the work itself; as an energy that depends on the state, explicit time takes what the damper dissipates."""
    ts = np.linspace(0, 8, 50)
    motion = jl.simulate(system, 0.5, 1.0, ts, MAXWELL, works=True)
    q, v, z = maxwell(ts, **MAXWELL)
    np.testing.assert_allclose((motion.q, motion.qdot, motion.states["z"]), (q, v, z), rtol=0, atol=1e-7)
    energy = 0.5 * 1.5 * v**2 + 2 * q**2 + (does == "time") * 15 * (q - z) ** 2
    np.testing.assert_allclose(motion.energy(), energy, rtol=0, atol=1e-7)
    np.testing.assert_allclose(motion.work()[does], energy - energy[0], rtol=0, atol=1e-7)
    assert np.max(np.abs(motion.balance())) < 1e-7
    assert energy[-1] < 0.2 * energy[0]


def test_one_instant_of_a_maxwell_element():
    """With the state given, and without: then that of the start, 0.1."""
    for z, more in ((0.3, {"states": {"z": 0.3}}), (0.1, {})):
        for system in (BY_FORCE, BY_ENERGY):
            found = jl.acceleration(system, 0.5, 1.0, MAXWELL, **more).qddot
            np.testing.assert_allclose(found, (-4 * 0.5 - 30 * (0.5 - z)) / 1.5, rtol=1e-13)
        np.testing.assert_allclose(jl.energy(BY_ENERGY, 0.5, 1.0, MAXWELL, **more), 0.75 + 0.5 + 15 * (0.5 - z) ** 2, rtol=1e-13)
        powers = jl.powers(BY_ENERGY, 0.5, 1.0, MAXWELL, **more)
        np.testing.assert_allclose(powers["time"], -(30**2) / 6 * (0.5 - z) ** 2, rtol=1e-12)


@pytest.mark.parametrize("system", [BY_FORCE, BY_ENERGY], ids=["force", "energy"])
def test_a_maxwell_element_examined_and_on_paper(system):
    examined = jl.examine(system, 0.5, 1.0, MAXWELL)
    assert examined.findings == () and examined.degrees_of_freedom == 1
    assert "ż = " in unicodedata.normalize("NFC", str(jl.equations(system, 0.5, MAXWELL)))


# States in L, in constraints, and of any structure


def test_a_pendulum_whose_length_follows_a_winch():
    """Half the work is in d/dt ∂L/∂φ̇: φ̈ = −2 ż φ̇/z − g sin φ/z."""
    winch = jl.State(lambda t, z: 3 * (1 + 0.5 * jnp.sin(4 * t) - z), start=1.2)
    system = jl.System(lambda q, qdot, z, m, g: 0.5 * m * z**2 * qdot**2 + m * g * z * jnp.cos(q), states={"z": winch})
    rate = lambda t, z: 3 * (1 + 0.5 * np.sin(4 * t) - z)
    bent = lambda t, y: [y[1], (-2 * rate(t, y[2]) * y[1] - 9.81 * np.sin(y[0])) / y[2], rate(t, y[2])]
    ts, p = np.linspace(0, 5, 51), {"m": 0.7, "g": 9.81}
    motion = jl.simulate(system, 1.0, 0.5, ts, p, works=True, **SHARP)
    phi, phidot, z = integrated(bent, ts, [1.0, 0.5, 1.2])
    np.testing.assert_allclose((motion.q, motion.qdot, motion.states["z"]), (phi, phidot, z), rtol=0, atol=1e-9)
    np.testing.assert_allclose(motion.qddot, (-2 * rate(ts, z) * phidot - 9.81 * np.sin(phi)) / z, rtol=0, atol=1e-8)
    energy = 0.5 * 0.7 * z**2 * phidot**2 - 0.7 * 9.81 * z * np.cos(phi)
    np.testing.assert_allclose(motion.work()["time"], energy - energy[0], rtol=0, atol=1e-8)
    np.testing.assert_allclose(jl.momentum(system, 1.0, 0.5, p, states={"z": 2.0}), 0.7 * 4 * 0.5, rtol=1e-13)
    assert "+ 2 m z q̇ ż +" in unicodedata.normalize("NFC", str(jl.equations(system, 1.0, p)))
    assert np.ptp(energy) > 1


CARRIED = {"m": 2.0, "b": 3.0, "tau": 0.4, "goal": 1.5}
follower = {"z": jl.State(lambda z, tau, goal: (goal - z) / tau, start=0.2)}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["holonomic", "nonholonomic"])
def test_a_mass_that_is_carried_along_by_a_state(kind):
    """Its position, or its speed, is z = goal − (goal − z₀) exp(−t/τ); the multiplier is the force that this takes."""
    carried = {"holonomic": lambda q, z: q - z, "nonholonomic": lambda qdot, z: qdot - z}[kind]
    system = jl.System(mass, dissipation=oil, states=follower, **{kind: {"arm": carried}})
    ts = np.linspace(0, 2, 21)
    fall = 1.3 * np.exp(-ts / 0.4)
    z, rate, bent = 1.5 - fall, fall / 0.4, -fall / 0.4**2
    start = (0.2, rate[0]) if kind == "holonomic" else (0.0, 0.2)
    motion = jl.simulate(system, *start, ts, CARRIED, works=True, **SHARP)
    position = z if kind == "holonomic" else 1.5 * ts + 0.4 * (fall - 1.3)
    velocity, acceleration = (rate, bent) if kind == "holonomic" else (z, rate)
    force = 2 * acceleration + 3 * velocity
    np.testing.assert_allclose(motion.q, position, rtol=0, atol=1e-10)
    np.testing.assert_allclose(motion.qdot, velocity, rtol=0, atol=1e-10)
    np.testing.assert_allclose(motion.multipliers["arm"], force, rtol=0, atol=1e-9)
    energy = velocity**2
    np.testing.assert_allclose(sum(motion.work().values()), energy - energy[0], rtol=0, atol=1e-7)
    assert np.max(np.abs(motion.work()["projection"])) < 1e-7
    one = jl.acceleration(system, *start, CARRIED, states={"z": z[5]})
    expected = (bent[5], 2 * bent[5] + 3 * start[1]) if kind == "holonomic" else (rate[5], 2 * rate[5] + 3 * start[1])
    np.testing.assert_allclose((one.qddot, one.multipliers["arm"]), expected, rtol=1e-12)


@pytest.mark.slow
def test_a_start_off_the_constraint_is_put_on_the_state():
    """A state is driven and does not give way: the mass goes to z(0) = 0.2 and its rate."""
    system = jl.System(mass, dissipation=oil, holonomic={"arm": lambda q, z: q - z}, states=follower)
    motion = jl.simulate(system, 0.1, 0.0, [0.0, 1.0], CARRIED)
    np.testing.assert_allclose((motion.q[0], motion.qdot[0], motion.states["z"][0]), (0.2, 1.3 / 0.4, 0.2), rtol=0, atol=1e-12)


@pytest.mark.slow
def test_an_observer_in_the_loop():
    """Luenberger's, of an oscillator, fed back; a pytree that starts where a function of the start says; linear as a whole."""
    p = {"c": 9.0, "slow": 0.5, "l1": 12.0, "l2": 40.0, "k": 5.0}

    def observer(q, seen, actuator, c, l1, l2):
        off = q - seen["x"]
        return {"x": seen["v"][0] + l1 * off, "v": [-c * seen["x"] + actuator["F"] + l2 * off]}

    states = {
        "seen": jl.State(observer, start=lambda q, qdot, slow: {"x": 0, "v": [slow * qdot]}),
        "actuator": jl.State(lambda seen, actuator, k: {"F": 20 * (-k * seen["v"][0] - actuator["F"])}, start={"F": 1}),
    }
    system = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2, force=lambda actuator: actuator["F"], states=states)
    A = np.array([[0, 1, 0, 0, 0], [-9, 0, 0, 0, 1], [12, 0, -12, 1, 0], [40, 0, -49, 0, 1], [0, 0, 0, -100, -20]])
    ts = np.linspace(0, 2, 21)
    motion = jl.simulate(system, 1.0, -0.6, ts, p)
    expected = np.array([expm(A * t) @ [1.0, -0.6, 0.0, -0.3, 1.0] for t in ts]).T
    seen, F = motion.states["seen"], motion.states["actuator"]["F"]
    np.testing.assert_allclose((motion.q, motion.qdot, seen["x"], seen["v"][0], F), expected, rtol=0, atol=1e-7)
    slope = jax.grad(lambda slow: jl.simulate(system, 1.0, -0.6, ts, p | {"slow": slow}).q[-1])(0.5)
    np.testing.assert_allclose(slope, (expm(A * 2) @ [0, 0, 0, -0.6, 0])[0], rtol=1e-6)


@pytest.mark.slow
def test_on_paper_an_update_without_a_formula_is_left_out():
    """It reads a table; the mechanics does not depend on that. A program would not know u."""
    states = {"u": jl.Sampled(lambda t, q, goal: goal(t) - q, every=0.1), "w": jl.Sampled(lambda q: 2 * q, every=0.1)}
    table = jl.Signal([0.0, 1.0], [1.0, 2.0])
    for names, shown in (({"u": states["u"]}, False), ({"w": states["w"]}, True)):
        (name,) = names
        force = (lambda u: u) if name == "u" else (lambda w: w)
        on_paper = jl.equations(jl.System(lambda qdot, m: 0.5 * m * qdot**2, force=force, states=names), "x", {"m": 2.0, "goal": table})
        assert ("⁺" in str(on_paper)) == shown and "m ẍ" in unicodedata.normalize("NFC", str(on_paper))
        with pytest.raises(ValueError, match="states"):
            on_paper.to_python()
