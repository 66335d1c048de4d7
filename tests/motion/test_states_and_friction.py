"""States in dry friction and against it: bristles (LuGre), integrators that hunt, against SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxlag as jl


def integrated(rate, ts, y0):
    """ẏ = rate(t, y) at the times, by SciPy, (states, times)."""
    return solve_ivp(rate, (ts[0], ts[-1]), y0, "LSODA", t_eval=ts, rtol=1e-11, atol=1e-13).y


def steady(v, F_c, F_s, v_s, xp=jnp):
    """Stribeck's curve."""
    return F_c + (F_s - F_c) * xp.exp(-((v / v_s) ** 2))


def bend(qdot, z, s0, F_c, F_s, v_s, xp=jnp):
    return qdot - s0 * xp.abs(qdot) / steady(qdot, F_c, F_s, v_s, xp) * z


@pytest.mark.slow
def test_a_mass_on_bristles_pulled_by_a_spring():
    """Canudas de Wit, Olsson, Åström & Lischinsky, IEEE Trans. Automatic Control 40 (1995) 419, figure 3, with softer bristles."""
    p = {"s0": 1e3, "s1": 30.0, "s2": 0.4, "F_c": 1.0, "F_s": 1.5, "v_s": 0.02}

    def bristles(qdot, z, s0, s1, s2, F_c, F_s, v_s):
        return -(s0 * z + s1 * bend(qdot, z, s0, F_c, F_s, v_s) + s2 * qdot)

    system = jl.System(lambda t, q, qdot: 0.5 * qdot**2 - (q - 0.1 * t) ** 2, force={"bristles": bristles}, states={"z": jl.State(bend)})
    curve = [p[name] for name in ("F_c", "F_s", "v_s")]

    def rate(t, y):
        zdot = bend(y[1], y[2], p["s0"], *curve, np)
        return [y[1], 2 * (0.1 * t - y[0]) - p["s0"] * y[2] - p["s1"] * zdot - p["s2"] * y[1], zdot]

    ts = np.linspace(0, 20, 81)
    motion = jl.simulate(system, 0.0, 0.0, ts, p, rtol=1e-10, atol=1e-12)
    expected = integrated(rate, ts, [0.0, 0.0, 0.0])
    assert np.mean(expected[1] < 1e-3) > 0.3 and np.max(expected[1]) > 0.2  # it sticks and slips
    np.testing.assert_allclose((motion.q, motion.qdot, motion.states["z"]), expected, rtol=0, atol=1e-8)


CURVE = {"F_c": 3.0, "F_s": 5.0, "v_s": 0.1}
GAINS = {"kp": 60.0, "kd": 10.0, "ki": 200.0}
feedback = lambda q, qdot, w, kp, kd, ki: kp * (1 - q) - kd * qdot + ki * w
integrator = {"w": jl.State(lambda q: 1 - q)}


@pytest.mark.slow
def test_a_cart_with_an_integrator_and_smoothed_stribeck_friction():
    def friction(qdot, F_c, F_s, v_s):
        s = jnp.sqrt(qdot**2 + 0.02**2)
        return F_c * s + (F_s - F_c) * v_s * np.sqrt(np.pi) / 2 * jax.scipy.special.erf(s / v_s)

    system = jl.System(lambda qdot: qdot**2, dissipation=friction, force=feedback, states=integrator)

    def rate(_, y):
        s = np.hypot(y[1], 0.02)
        return [y[1], (feedback(*y, **GAINS) - steady(s, **CURVE, xp=np) * y[1] / s) / 2, 1 - y[0]]

    ts = np.linspace(0, 6, 61)
    motion = jl.simulate(system, 0.0, 0.0, ts, CURVE | GAINS, rtol=1e-9)
    np.testing.assert_allclose((motion.q, motion.qdot, motion.states["w"]), integrated(rate, ts, [0.0, 0.0, 0.0]), rtol=0, atol=1e-7)


def hunting(ts):
    """The same cart with exact friction: it sticks until the integrator breaks it loose, overshoots, and sticks again."""
    force = lambda y: feedback(*y, **GAINS)
    y, t, found, stuck = np.zeros(3), 0.0, {0.0: (0.0, 0.0, 0.0)}, False
    while t < ts[-1]:
        ahead = ts[ts > t]
        if stuck:
            ramp = GAINS["ki"] * (1 - y[0])
            loose = (CURVE["F_s"] * np.sign(ramp) - force(y)) / ramp
            until = min(t + loose, ts[-1])
            found |= {s: (y[0], 0.0, y[2] + (1 - y[0]) * (s - t)) for s in ahead[ahead <= until]}
            y, t, stuck = np.array([y[0], 0.0, y[2] + (1 - y[0]) * (until - t)]), until, False
            continue
        way = np.sign(y[1] if y[1] else force(y))
        rate = lambda t, y, way=way: [y[1], (force(y) - way * steady(y[1], **CURVE, xp=np)) / 2, 1 - y[0]]
        rest = lambda t, y, way=way, start=t: way * y[1] if t > start + 1e-6 else 1.0
        rest.terminal = True
        run = solve_ivp(rate, (t, ts[-1]), y, "DOP853", events=rest, dense_output=True, rtol=1e-12, atol=1e-13, max_step=0.05)
        t = run.t[-1]
        found |= {s: tuple(run.sol(s)) for s in ahead[ahead <= t]}
        y, stuck = run.sol(t) * [1, 0, 1], abs(force(run.sol(t) * [1, 0, 1])) <= CURVE["F_s"]
    return np.transpose([found[s] for s in ts])


@pytest.mark.slow
def test_a_cart_with_an_integrator_and_dry_friction_hunts():
    rail = lambda qdot, F_c, F_s, v_s: jl.dissipation.stribeck(qdot, F_c, F_s, v_s)
    system = jl.System(lambda qdot: qdot**2, dissipation={"rail": rail}, force=feedback, states=integrator)
    ts = np.linspace(0, 20, 101)
    motion = jl.simulate(system, 0.0, 0.0, ts, CURVE | GAINS)
    expected = hunting(ts)
    assert np.count_nonzero(np.diff(np.sign(expected[0] - 1))) > 10
    np.testing.assert_allclose((motion.q, motion.qdot, motion.states["w"]), expected, rtol=0, atol=1e-7)
