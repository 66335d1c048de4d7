"""Friction and constraints that share directions: vector friction on tables, slopes, rods and curves, and slip that is prescribed.

Each against a closed form, or against the same machine in the coordinate along the constraint, solved by SciPy from stop to stop.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp

import jaxlag as jl
from jaxlag import dissipation
from jaxlag._mechanics.constrained_slip import _onto_range

G, ANGLE = 9.81, 0.3
UP = np.array([np.cos(ANGLE), np.sin(ANGLE)])


def plane(q, qdot, m):
    return 0.5 * m * qdot @ qdot - m * G * q[1]


NORMS = {
    "speed": lambda s: dissipation.speed(s),
    "norm": lambda s: jnp.linalg.norm(s),
    "hypot": lambda s: jnp.hypot(s[0], s[1]),
}


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.slow) for name in NORMS])
def test_a_block_slides_on_a_table_and_stops(name):
    size = NORMS[name]
    table = jl.System(plane, dissipation=lambda qdot, m, mu: mu * m * G * size(qdot), holonomic={"table": lambda q: q[1]})
    stop = 3 / (0.3 * G)
    motion = jl.simulate(table, jnp.zeros(2), jnp.array([3.0, 0.0]), jnp.linspace(0, 2, 21), {"m": 2.0, "mu": 0.3})
    expected = np.where(motion.ts < stop, 3 * motion.ts - 0.5 * 0.3 * G * motion.ts**2, 1.5 * stop)
    np.testing.assert_allclose(motion.q[:, 0], expected, rtol=1e-12)
    np.testing.assert_allclose(motion.multipliers["table"], 2 * G, rtol=1e-12)
    assert motion.stats["transitions"][-1] == 1 and motion.qdot[-1, 0] == 0
    np.testing.assert_allclose(motion.stats["time_stuck"][-1], 2 - stop, rtol=1e-9)


def sledge(q0, qdot0, ts, mu, unit=1.0):
    """Along a slope, with its normal force a multiplier; lengths in `unit`s of a metre."""
    slope = jl.System(
        lambda q, qdot, m, g: 0.5 * m * qdot @ qdot - m * g * q[1],
        dissipation={"rub": lambda qdot, multipliers, mu: mu * jnp.abs(multipliers["slope"]) * dissipation.speed(qdot)},
        holonomic={"slope": lambda q: q @ jnp.array([-UP[1], UP[0]])},
    )
    return jl.simulate(slope, q0 / unit, qdot0 / unit, ts, {"m": 2.0, "mu": mu, "g": G / unit})


@pytest.mark.slow
def test_a_sledge_stops_on_a_slope_that_holds_it():
    """Its normal force is what friction follows, and is not shared with friction while it sticks."""
    ts, mu = jnp.linspace(0, 3, 31), 0.5
    along = lambda mu: sledge(jnp.zeros(2), jnp.asarray(3 * UP), ts, mu).q[-1] @ UP
    motion, (rise, slope) = sledge(jnp.zeros(2), jnp.asarray(3 * UP), ts, mu), jax.value_and_grad(along)(mu)
    braking = G * (UP[1] + mu * UP[0])
    np.testing.assert_allclose([rise, slope], [4.5 / braking, -4.5 / braking**2 * G * UP[0]], rtol=1e-12)
    np.testing.assert_allclose(motion.multipliers["slope"], 2 * G * UP[0], rtol=1e-12)
    np.testing.assert_allclose(motion.friction["rub"].force[-1], 2 * G * UP[1] * UP, rtol=1e-12)  # holds what gravity pulls
    assert motion.stats["transitions"][-1] == 1


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.filterwarnings("ignore:jaxlag runs in single precision")
def test_a_block_crosses_a_table_in_space(dtype):
    """On a straight line over x and y, with what presses it on the table, a multiplier, as normal force; s(μ) = v²/2μg."""
    table = jl.System(
        lambda q, qdot, m: 0.5 * m * qdot @ qdot - m * G * q[2],
        dissipation=lambda qdot, multipliers, mu: mu * jnp.abs(multipliers["table"]) * dissipation.speed(qdot),
        holonomic={"table": lambda q: q[2]},
    )
    start = jnp.zeros(3, dtype), jnp.array([1.8, 2.4, 0.0], dtype), jnp.linspace(0, 2, 11, dtype=dtype)
    slide = lambda mu: jl.simulate(table, *start, {"m": jnp.asarray(2.0, dtype), "mu": mu})
    motion, along, far = slide(jnp.asarray(0.3, dtype)), np.array([0.6, 0.8, 0]), 4.5 / (0.3 * G)
    rtol = 1e-10 if dtype == jnp.float64 else 1e-4
    np.testing.assert_allclose(motion.q[-1], far * along, rtol=rtol, atol=rtol)
    np.testing.assert_allclose(jax.jacfwd(lambda mu: slide(mu).q[-1])(jnp.asarray(0.3, dtype)), -far / 0.3 * along, rtol=rtol, atol=rtol)
    assert motion.q.dtype == dtype and motion.stats["transitions"][-1] == 1 and not np.any(motion.qdot[-1])


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.filterwarnings("ignore:jaxlag runs in single precision")
def test_a_block_on_a_moving_belt_slides_sticks_and_slides(dtype):
    """Closed form: from rest it swings about x₀ = μmg/c till it is as fast as the belt, is carried to x₀ and swings on from there."""
    m, c, mu = (jnp.asarray(x, dtype) for x in (2.0, 8.0, 0.3))
    belt = jl.System(
        lambda q, qdot, m, c: plane(q, qdot, m) - 0.5 * c * q[0] ** 2,
        dissipation=lambda qdot, m, mu, V: mu * m * G * dissipation.speed(qdot - jnp.stack([V, 0.0 * V])),
        holonomic={"belt": lambda q: q[1]},
    )
    ts = jnp.linspace(0, 3, 31, dtype=dtype)
    ride = lambda V: jl.simulate(belt, jnp.zeros(2, dtype), jnp.zeros(2, dtype), ts, {"m": m, "c": c, "mu": mu, "V": V})

    def closed_form(V):
        rest, w = mu * m * G / c, jnp.sqrt(c / m)
        sticks = jnp.arcsin(V / (rest * w)) / w
        there = rest * (1 - jnp.cos(w * sticks))
        slips = sticks + (rest - there) / V
        carried = jnp.where(ts < slips, there + V * (ts - sticks), rest + V / w * jnp.sin(w * (ts - slips)))
        return jnp.where(ts < sticks, rest * (1 - jnp.cos(w * ts)), carried)

    V, rtol = jnp.asarray(0.7, dtype), 1e-6 if dtype == jnp.float64 else 1e-3
    motion = ride(V)
    np.testing.assert_allclose(motion.q[:, 0], closed_form(V), atol=rtol)
    np.testing.assert_allclose(jax.jacfwd(lambda V: ride(V).q[:, 0])(V), jax.jacfwd(closed_form)(V), atol=10 * rtol)
    assert motion.q.dtype == dtype and motion.stats["transitions"][-1] == 2


def bead_by_scipy(F, until):
    """On y = x², from stop to stop: x at the end, and how often it turned."""
    arc = lambda x: np.sqrt(1 + 4 * x**2)
    rate = lambda t, y, way: [y[1], (-4 * y[0] * y[1] ** 2 - 2 * G * y[0] - way * F * arc(y[0])) / arc(y[0]) ** 2]
    stops = lambda t, y, way: y[1]
    t, x, turns = 0.0, 1.0, 0
    while t < until and (turns == 0 or 2 * G * abs(x) > F * arc(x)):
        way = -1 if x > 0 else 1
        stops.terminal, stops.direction = True, -way
        leg = solve_ivp(rate, (t, until), [x, way * 1e-300], "DOP853", events=stops, rtol=1e-12, atol=1e-13, args=(way,))
        t, x, turns = leg.t[-1], leg.y[0, -1], turns + (leg.status == 1)
    return x, turns


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:jaxlag runs in single precision")
def test_a_bead_on_a_parabola_turns_and_stops_as_in_its_abscissa():
    """It rests after some half-swings; where it rests depends on F through all of them."""
    wire = jl.System(
        lambda q, qdot: plane(q, qdot, 1.0),
        dissipation=lambda qdot, F: F * dissipation.speed(qdot),
        holonomic=lambda q: q[1] - q[0] ** 2,
    )
    x, turns = bead_by_scipy(1.0, 12.0)
    by_scipy = (bead_by_scipy(1 + 1e-4, 12.0)[0] - bead_by_scipy(1 - 1e-4, 12.0)[0]) / 2e-4
    for dtype, atol, rtol in ((jnp.float64, 1e-7, 1e-5), (jnp.float32, 2e-3, 2e-2)):
        start = jnp.ones(2, dtype), jnp.zeros(2, dtype), jnp.linspace(0, 12, 7, dtype=dtype)

        def slide(F, start=start):
            motion = jl.simulate(wire, *start, {"F": F})
            return motion.q[-1, 0], motion

        slope, motion = jax.jacfwd(slide, has_aux=True)(jnp.asarray(1.0, dtype))
        np.testing.assert_allclose(motion.q[-1], [x, x**2], atol=atol)
        assert motion.q.dtype == dtype and motion.stats["transitions"][-1] == turns > 3 and not np.any(motion.qdot[-1])
        np.testing.assert_allclose(slope, by_scipy, rtol=rtol)


def pendulum_by_scipy(F, until):
    """From stop to stop: the angle from the horizontal of a rod of length 1 with F‖q̇‖ at its end; and how often it turned."""
    swing, stops = lambda t, y, way: [y[1], -G * np.cos(y[0]) - way * F], lambda t, y, way: y[1]
    t, phi, turns = 0.0, 0.0, 0
    while t < until:
        way = 1 if -G * np.cos(phi) > 0 else -1
        stops.terminal, stops.direction = True, -way
        leg = solve_ivp(swing, (t, until), [phi, way * 1e-300], "DOP853", events=stops, rtol=1e-12, atol=1e-13, args=(way,))
        t, phi = leg.t[-1], leg.y[0, -1]
        if leg.status == 1:
            turns += 1
            if abs(G * np.cos(phi)) <= F:
                break
    return phi, turns


rod = jl.System(
    lambda q, qdot, g: 0.5 * qdot @ qdot - g * q[1],
    dissipation=lambda qdot, F: F * dissipation.speed(qdot),
    holonomic=lambda q: q @ q - 1,
)


def swing(F, dtype=jnp.float64):
    given = (jnp.array(x, dtype) for x in ([1.0, 0.0], [0.0, 0.0], np.linspace(0, 20, 11)))
    return jl.simulate(rod, *given, {"F": jnp.asarray(F, dtype), "g": jnp.asarray(G, dtype)})


@pytest.mark.slow
@pytest.mark.parametrize("F", [0.1, 1.0])
def test_a_rod_pendulum_in_cartesian_coordinates_turns_and_stops_as_in_its_angle(F):
    """F = 0.1 swings on, F = 1 rests after seven half-swings; d x(20 s)/dF by differences of SciPy's solutions."""
    motion, (phi, turns) = swing(F), pendulum_by_scipy(F, 20.0)
    np.testing.assert_allclose(motion.q[-1], [np.cos(phi), np.sin(phi)], atol=2e-7)
    assert motion.stats["transitions"][-1] == turns
    by_scipy = (np.cos(pendulum_by_scipy(F + 1e-4, 20.0)[0]) - np.cos(pendulum_by_scipy(F - 1e-4, 20.0)[0])) / 2e-4
    np.testing.assert_allclose(jax.jacfwd(lambda F: swing(F).q[-1, 0])(F), by_scipy, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("F", [0.1, 1.0])
@pytest.mark.filterwarnings("ignore:jaxlag runs in single precision")
def test_a_rod_pendulum_in_cartesian_coordinates_in_single_precision(F):
    motion, (phi, turns) = swing(F, jnp.float32), pendulum_by_scipy(F, 20.0)
    assert motion.q.dtype == jnp.float32 and motion.stats["transitions"][-1] == turns
    np.testing.assert_allclose(motion.q[-1], [np.cos(phi), np.sin(phi)], atol=2e-3)  # rtol = 1e-4, over fourteen half-swings


def rotor_driven(angle):
    return jl.System(
        lambda qdot, J: 0.5 * J * qdot**2,
        dissipation={"rub": lambda qdot, F: F * jnp.abs(qdot)},
        holonomic={"drive": lambda t, q, a: q - angle(t, a)},
    )


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1.0, 1e-9, 1e9])
def test_the_torque_that_drives_a_rotor_with_dry_friction(unit):
    """λ = J q̈ + F sign q̇, F switching its sign where the drive turns."""
    rotor = rotor_driven(lambda t, a: a * jnp.sin(t))
    ts = jnp.linspace(0, 10, 101)
    params = {"J": 1.0 / unit**2, "F": 3.0 / unit, "a": 0.3 * unit}
    motion = jl.simulate(rotor, 0.0, 0.3 * unit, ts, params, atol=1e-10 * unit)
    expected = -0.3 * np.sin(ts) + 3 * np.sign(np.cos(ts))
    np.testing.assert_allclose(motion.multipliers["drive"] * unit, expected, rtol=1e-9)
    assert motion.stats["transitions"][-1] == 3


@pytest.mark.slow
def test_a_drive_that_dwells_carries_no_friction_and_goes_on():
    """Where slip is prescribed to be zero, any force within the bound would do; none is taken. Then it slips again, the other way."""
    dwell = rotor_driven(lambda t, a: jnp.where(t < 1, a * (1 - (1 - t) ** 2), jnp.where(t < 2, a, a - a * (t - 2) ** 2)))
    motion = jl.simulate(dwell, 0.0, 2.0, jnp.array([0.0, 0.5, 1.5, 2.5, 3.0]), {"J": 1.0, "F": 3.0, "a": 1.0}, rtol=1e-9)
    np.testing.assert_allclose(motion.multipliers["drive"], [1.0, 1.0, 0.0, -5.0, -5.0], atol=1e-9)
    assert list(np.asarray(motion.friction["rub"].sticking)) == [False, False, True, False, False]


@pytest.mark.slow
def test_the_drive_torque_of_a_crank_with_friction_at_its_slider():
    """By the power theorem: τ φ̇ = dT/dt + F|ẋ|, through four dead centres, of which the first is the start."""
    r, length, m, J, F, speed = 0.3, 1.0, 2.0, 0.04, 5.0, 2.0
    loop = lambda q: jnp.stack(
        [q["x"] - r * jnp.cos(q["phi"]) - length * jnp.cos(q["psi"]), r * jnp.sin(q["phi"]) - length * jnp.sin(q["psi"])]
    )
    crank = jl.System(
        lambda qdot: 0.5 * m * qdot["x"] ** 2 + 0.5 * J * (qdot["phi"] ** 2 + qdot["psi"] ** 2),
        dissipation={"slider": lambda qdot: F * jnp.abs(qdot["x"])},
        holonomic={"loop": loop, "drive": lambda t, q: q["phi"] - speed * t},
    )
    motion = jl.simulate(
        crank, {"phi": 0.0, "psi": 0.0, "x": r + length}, {"phi": speed, "psi": speed * r / length, "x": 0.0}, jnp.linspace(0, 5, 41)
    )
    t = sp.symbols("t")
    psi = sp.asin(r * sp.sin(speed * t) / length)
    x = r * sp.cos(speed * t) + length * sp.cos(psi)
    torque = (m * x.diff(t) * x.diff(t, 2) + J * psi.diff(t) * psi.diff(t, 2) + F * sp.Abs(sp.expand(x.diff(t)))) / speed
    expected = sp.lambdify(t, torque.subs(sp.Derivative, 0), "numpy")(np.asarray(motion.ts))
    np.testing.assert_allclose(motion.multipliers["drive"], expected, atol=1e-7)
    assert motion.stats["num_steps"] < 100


@pytest.mark.slow
def test_the_projector_onto_the_range_of_a_matrix_of_any_rank():
    rng = np.random.default_rng(0)
    for size in (1, 2, 3, 4):
        for rank in range(size + 1):
            Q = np.linalg.qr(rng.normal(size=(size, size)))[0][:, :rank]
            P, found = _onto_range(jnp.asarray(Q * rng.uniform(1, 3, rank) @ Q.T))
            np.testing.assert_allclose(P, Q @ Q.T, atol=1e-13)
            assert found == rank
