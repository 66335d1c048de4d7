"""Constraints of every kind at work: closed mechanisms, rolling, prescribed motion; their forces, their power, their gradients."""

import functools
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import jaxlag as jl
from jaxlag._mechanics import constrained_acceleration
from jaxlag._model.flat import bind
from jaxlag.examples import pendulum, vehicle

g = 9.81
RTOL = 1e-10  # of the motions below
BALANCE = 10 * RTOL  # residual of the balance, of the energy turned over
SHORT = 10 * RTOL  # error of a motion over a few seconds: what some hundred steps leave
LONG = 100 * RTOL  # and over 100 s, which some thousand steps and their phase leave
ON = 1e-12  # how closely a constraint is kept
STATE = 1e-12  # forces and accelerations at one state: rounding


class Example(NamedTuple):
    system: jl.System
    q0: Any
    qdot0: Any
    params: dict
    end: float
    driven: tuple[str, ...] = ()  # constraints that move, and so do work


# N-four-bar mechanism: points B_0 … B_N over fixed A_j = (j, 0), uniform rods


def feet(q):
    return jnp.stack([jnp.arange(len(q), dtype=q.dtype), jnp.zeros(len(q), q.dtype)], axis=1)


def bars_lagrangian(q, qdot, m, M, g):
    def rods(m, a, b, u, v):
        return m / 6 * jnp.sum(u * u + u * v + v * v) - m * g / 2 * jnp.sum(a[:, 1] + b[:, 1])

    return rods(m, feet(q), q, jnp.zeros_like(q), qdot) + rods(M, q[:-1], q[1:], qdot[:-1], qdot[1:])


bars = jl.System(
    bars_lagrangian,
    holonomic={
        "cranks": lambda q, l: jnp.sum((q - feet(q)) ** 2, axis=1) - l**2,
        "couplers": lambda q: jnp.sum((q[1:] - q[:-1]) ** 2, axis=1) - 1,
    },
)
BARS = {"m": 1.0, "M": 1.0, "l": 1.0, "g": g}  # kg, a crank; kg, a coupler; m, a crank; m/s²


def bars_state(N, speed, l):
    """Upright."""
    up, across = jnp.array([0.0, 1.0]), jnp.array([1.0, 0.0])
    return feet(jnp.zeros((N + 1, 2))) + jnp.tile(l * up, (N + 1, 1)), jnp.tile(speed * across, (N + 1, 1))


def bars_stiffness(N, m, M, l):
    """k of θ'' = k sin θ, the one degree of freedom."""
    return g / l * (m * (N + 1) / 2 + M * N) / (m * (N + 1) / 3 + M * N)


# Thin disc that rolls on a plane: contact point x, y; yaw, lean, spin (Z-X-Y)


def disc_centre(q, r):
    yaw, lean = q["yaw"], q["lean"]
    up = jnp.stack([jnp.sin(yaw) * jnp.sin(lean), -jnp.cos(yaw) * jnp.sin(lean), jnp.cos(lean)])
    return jnp.stack([q["x"], q["y"], jnp.zeros_like(yaw)]) + r * up


def disc_lagrangian(t, q, qdot, params, m, r, g):
    v = jl.rate(disc_centre)(t, q, qdot, params)
    across = qdot["lean"] ** 2 + (qdot["yaw"] * jnp.cos(q["lean"])) ** 2
    along = (qdot["spin"] + qdot["yaw"] * jnp.sin(q["lean"])) ** 2
    return 0.5 * m * v @ v + 0.5 * m * r**2 * (across / 4 + along / 2) - m * g * r * jnp.cos(q["lean"])


def disc_rolls(q, qdot, r):
    along = r * qdot["spin"]
    return jnp.stack([qdot["x"] - along * jnp.cos(q["yaw"]), qdot["y"] - along * jnp.sin(q["yaw"])])


disc = jl.System(disc_lagrangian, nonholonomic={"rolling": disc_rolls})
UNITS = {"m": 1.0, "r": 1.0, "g": 1.0}


def disc_state(yaw, lean, yawdot, leandot, spindot, r=1.0):
    q = {"x": 0.0, "y": 0.0, "yaw": yaw, "lean": lean, "spin": 0.0}
    along = r * spindot
    return q, {"x": along * np.cos(yaw), "y": along * np.sin(yaw), "yaw": yawdot, "lean": leandot, "spin": spindot}


# Chaplygin's sleigh: knife edge at x, y; centre of mass a distance a before it


def sleigh_lagrangian(q, qdot, m, I, a):
    s, c = jnp.sin(q["phi"]), jnp.cos(q["phi"])
    u, v = qdot["x"] - a * qdot["phi"] * s, qdot["y"] + a * qdot["phi"] * c
    return 0.5 * m * (u**2 + v**2) + 0.5 * I * qdot["phi"] ** 2


sleigh = jl.System(sleigh_lagrangian, nonholonomic={"edge": lambda q, qdot: qdot["y"] * jnp.cos(q["phi"]) - qdot["x"] * jnp.sin(q["phi"])})


def sleigh_state(speed, rate):
    return {"x": 0.0, "y": 0.0, "phi": 0.0}, {"x": speed, "y": 0.0 * speed, "phi": rate}


# Homogeneous ball on a table that turns: centre r, orientation by a quaternion p, which has no inertia along itself


def spin_of_ball(q, qdot):
    (s, u), (sdot, udot) = (q["p"][0], q["p"][1:]), (qdot["p"][0], qdot["p"][1:])
    return 2 * (s * udot - sdot * u + jnp.cross(u, udot))


def ball_lagrangian(q, qdot, m, R):
    w = spin_of_ball(q, qdot)
    return 0.5 * m * qdot["r"] @ qdot["r"] + 0.5 * (2 / 5 * m * R**2) * w @ w


def ball_rolls(q, qdot, R, turn):
    """Velocity of the ball's lowest point minus that of the table under it."""
    w, (x, y) = spin_of_ball(q, qdot), q["r"]
    return qdot["r"] + R * jnp.stack([-w[1], w[0]]) - turn * jnp.stack([-y, x])


ball = jl.System(ball_lagrangian, holonomic={"unit": lambda q: q["p"] @ q["p"] - 1}, nonholonomic={"rolling": ball_rolls})
BALL = {"m": 0.3, "R": 0.2, "turn": 2.0}  # kg, m, rad/s


def ball_state(r, v, p):
    w = np.array([(p["turn"] * r[0] - v[1]) / p["R"], (v[0] + p["turn"] * r[1]) / p["R"], 0.5])
    return {"r": np.array(r), "p": np.array([1.0, 0, 0, 0])}, {"r": np.array(v), "p": np.array([0, *w / 2])}


# The multiplier collection


def atwood_lagrangian(q, qdot, m1, m2, M, g):
    kinetic = 0.5 * m1 * qdot["x1"] ** 2 + 0.5 * m2 * qdot["x2"] ** 2
    pulley = 0.5 * M * qdot["s"] ** 2 if "s" in q else 0.0  # s: length of rope that has gone over the pulley
    return kinetic + pulley + g * (m1 * q["x1"] + m2 * q["x2"])


atwood = jl.System(atwood_lagrangian, holonomic={"rope": lambda q: q["x1"] + q["x2"] - 2.0})
atwood_pulley = jl.System(
    atwood_lagrangian, holonomic={"left": lambda q: q["x1"] - 1.0 - q["s"], "right": lambda q: q["x2"] - 1.0 + q["s"]}
)
ATWOOD = {"m1": 3.0, "m2": 2.0, "M": 1.0, "g": g}

incline = jl.System(
    lambda q, qdot, m, R, k, alpha, g: 0.5 * m * (qdot["y"] ** 2 + k * R**2 * qdot["th"] ** 2) + m * g * jnp.sin(alpha) * q["y"],
    holonomic={"rolling": lambda q, R: q["y"] - R * q["th"]},
)
INCLINE = {"m": 2.0, "R": 0.5, "k": 0.5, "alpha": np.pi / 6, "g": g}

helix = jl.System(
    lambda q, qdot, m, g: 0.5 * m * qdot @ qdot - m * g * q[2],
    holonomic={"wire": lambda q, R, h: q[:2] - R * jnp.stack([jnp.cos(q[2] / h), jnp.sin(q[2] / h)])},
)
HELIX = {"m": 1.3, "R": 0.5, "h": 0.2, "g": g}


def helix_state(s, sdot, R=0.5, h=0.2):
    return np.array([R * np.cos(s), R * np.sin(s), h * s]), sdot * np.array([-R * np.sin(s), R * np.cos(s), h])


def ladder_lagrangian(q, qdot, m, b, g):
    return 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2) + m * b**2 / 6 * qdot["th"] ** 2 - m * g * q["y"]


ladder = jl.System(
    ladder_lagrangian,
    holonomic={"wall": lambda q, b: q["x"] - b * jnp.cos(q["th"]), "floor": lambda q, b: q["y"] - b * jnp.sin(q["th"])},
)
LADDER = {"m": 5.0, "b": 2.0, "g": g}


def ladder_state(th, thdot, b=2.0):
    s, c = np.sin(th), np.cos(th)
    return {"x": b * c, "y": b * s, "th": th}, {"x": -b * s * thdot, "y": b * c * thdot, "th": thdot}


wedge = jl.System(
    lambda q, qdot, m, M, g: 0.5 * M * qdot["X"] ** 2 + 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2) - m * g * q["y"],
    holonomic={"face": lambda q, alpha: (q["x"] - q["X"]) * jnp.sin(alpha) + q["y"] * jnp.cos(alpha)},
)
WEDGE = {"m": 2.0, "M": 3.0, "alpha": np.pi / 6, "g": g}

chain = jl.System(
    lambda q, qdot, rho, g: 0.5 * rho * (q["u"] * qdot["u"] ** 2 + q["x"] * qdot["x"] ** 2) + 0.5 * rho * g * q["x"] ** 2,
    holonomic={"length": lambda q, L: q["u"] + q["x"] - L},
)
CHAIN = {"rho": 1.5, "L": 2.0, "g": g}

turned_rod = jl.System(
    lambda q, qdot, m: 0.5 * m * (qdot["r"] ** 2 + q["r"] ** 2 * qdot["phi"] ** 2), holonomic={"drive": lambda t, q, w: q["phi"] - w * t}
)
ROD = {"m": 1.0, "w": 2.0}


def hoop_lagrangian(q, qdot, m, R, g):
    return 0.5 * m * R**2 * (qdot["th"] ** 2 + (jnp.sin(q["th"]) * qdot["phi"]) ** 2) + m * g * R * jnp.cos(q["th"])


hoop = jl.System(hoop_lagrangian, holonomic={"drive": lambda t, q, omega: q["phi"] - omega * t})
HOOP = {"m": 1.0, "R": 1.0, "omega": 5.0, "g": g}
HOOP_REST = 1.167556903805043  # acos(g / R ω²), of cf_bead_rotating_hoop

bob = jl.System(lambda q, qdot, m, g: 0.5 * m * qdot @ qdot - m * g * q[-1], holonomic={"rod": lambda q, l: jnp.sqrt(q @ q) - l})
BOB = {"m": 1.4, "l": 0.8, "g": g}


def conical_state(alpha, l):
    """On a circle at the angle α from the vertical: ω² = g / (l cos α)."""
    w = np.sqrt(g / (l * np.cos(alpha)))
    return l * np.array([np.sin(alpha), 0.0, -np.cos(alpha)]), np.array([0.0, w * l * np.sin(alpha), 0.0])


# A damped pendulum on a cart that is driven to and fro; a rigid beam on three parallel cranks, one more than it needs


def cart_lagrangian(q, qdot, mc, m, g):
    return 0.5 * mc * qdot["X"] ** 2 + 0.5 * m * qdot["r"] @ qdot["r"] - m * g * q["r"][1]


def cart_rod(q, l):
    x, y = q["r"]
    return (x - q["X"]) ** 2 + y**2 - l**2


cart = jl.System(
    cart_lagrangian,
    dissipation={"oil": lambda qdot, b: 0.5 * b * qdot["r"] @ qdot["r"]},
    holonomic={"rod": cart_rod, "drive": lambda t, q, A, w: q["X"] - A * jnp.sin(w * t)},
)
CART = {"mc": 2.0, "m": 0.7, "l": 0.9, "b": 0.3, "A": 0.2, "w": 3.0, "g": g}


def cart_state(phi, phidot, l, A, w):
    across = l * jnp.stack([jnp.cos(phi), jnp.sin(phi)]) * phidot
    return {"X": 0.0, "r": l * jnp.stack([jnp.sin(phi), -jnp.cos(phi)])}, {"X": A * w, "r": across + jnp.stack([A * w, 0.0 * w])}


def beam_lagrangian(q, qdot, m, c, g):
    return 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2 + qdot["phi"] ** 2 / 3) - m * g * q["y"] - 0.5 * c * q["x"] ** 2


def beam_cranks(q, l):
    along = jnp.array([-1.0, 0.0, 1.0])
    return (q["x"] + along * jnp.cos(q["phi"]) - along) ** 2 + (q["y"] + along * jnp.sin(q["phi"])) ** 2 - l**2


beam = jl.System(beam_lagrangian, holonomic={"cranks": beam_cranks})
BEAM = {"m": 1.7, "l": 0.8, "c": 6.0, "g": g}


def beam_state(th, thdot, l):
    s, c = jnp.sin(th), jnp.cos(th)
    return {"x": l * s, "y": -l * c, "phi": 0.0 * th}, {"x": l * c * thdot, "y": l * s * thdot, "phi": 0.0 * th}


EXAMPLES = {
    "two bars": Example(bars, *bars_state(2, 1.0, 1.0), BARS, 20.0),
    "five bars": Example(bars, *bars_state(5, 1.0, 1.0), BARS, 20.0),
    "disc": Example(disc, *disc_state(0.3, 0.2, 0.4, -0.1, 1.1), UNITS, 100.0),
    "sleigh": Example(sleigh, *sleigh_state(-1.0, 0.7), {"m": 2.0, "I": 0.3, "a": 0.4}, 100.0),
    "ball": Example(ball, *ball_state((0.5, 0.1), (-0.2, 0.4), BALL), BALL, 100.0, ("rolling",)),
    "ladder": Example(ladder, *ladder_state(1.2, -0.1), LADDER, 1.0),
    "chain": Example(chain, {"u": 1.6, "x": 0.4}, {"u": 0.0, "x": 0.0}, CHAIN, 0.9),
    "turned rod": Example(turned_rod, {"r": 0.3, "phi": 0.0}, {"r": 0.0, "phi": 2.0}, ROD, 1.0, ("drive",)),
    "hoop": Example(hoop, {"th": 0.8, "phi": 0.0}, {"th": 0.5, "phi": 5.0}, HOOP, 5.0, ("drive",)),
    "cart": Example(cart, *cart_state(0.5, 0.4, 0.9, 0.2, 3.0), CART, 10.0, ("drive",)),
    "beam": Example(beam, *beam_state(0.9, 0.5, 0.8), BEAM, 10.0),
    "polar pendulum": Example(pendulum.polar, *pendulum.polar_state(2.0, 0.3, 1.0), pendulum.params, 10.0),
    "cartesian pendulum": Example(pendulum.cartesian, *pendulum.cartesian_state(2.0, 0.3, 1.0), pendulum.params, 10.0),
    "vehicle": Example(vehicle.system, vehicle.q0, vehicle.qdot0, vehicle.params, 20.0),
}
CONSTRAINED = [name for name, x in EXAMPLES.items() if x.system.constraints]
TO_COMPILE = ("five bars", "two bars", "ladder", "cart", "disc")  # what takes long


def run(name, q0, qdot0, end, **changes):
    """201 samples with the works; other numbers than the example's cost no compilation."""
    x = EXAMPLES[name]
    ts = jnp.linspace(0, end, 201)
    return jl.simulate(x.system, q0, qdot0, ts, {**x.params, **changes}, rtol=RTOL, atol=1e-2 * RTOL, works=True)


@functools.cache
def motion_of(name):
    x = EXAMPLES[name]
    return run(name, x.q0, x.qdot0, x.end)


@functools.cache
def seen(name):
    """Energy, balance and, at the samples, residuals, G, forces and powers, compiled together."""
    x = EXAMPLES[name]

    def at(t, q, v):
        state = (x.system, q, v, x.params)
        return {
            "residual": jl.constraint_residual(*state, t=t),
            "jacobian": jl.constraint_jacobian(*state, t=t),
            "forces": jl.constraint_force(*state, t=t),
            "powers": jl.powers(*state, t=t),
        }

    @eqx.filter_jit
    def of(motion):
        return jax.vmap(at)(motion.ts, motion.q, motion.qdot) | {"energy": motion.energy(), "balance": motion.balance()}

    return jax.tree.map(np.asarray, of(motion_of(name)))


def flat(tree):
    """One row a sample."""
    return np.concatenate([np.reshape(leaf, (len(leaf), -1)) for leaf in jax.tree.leaves(tree)], axis=1)


# All motions


@pytest.mark.slow
@pytest.mark.parametrize("name", CONSTRAINED)
def test_constraints_are_kept(name):
    for residual in jax.tree.leaves(seen(name)["residual"]):
        np.testing.assert_allclose(residual, 0, rtol=0, atol=ON)


@pytest.mark.slow
@pytest.mark.parametrize("name", EXAMPLES)
def test_energy_balance(name):
    assert np.max(np.abs(seen(name)["balance"])) <= BALANCE


@pytest.mark.slow
@pytest.mark.parametrize("name", CONSTRAINED)
def test_constraint_forces_are_orthogonal_to_every_allowed_velocity(name):
    """Null space of G by NumPy's singular values; each force by itself, relative to the largest."""
    found = seen(name)
    forces = [flat(force) for force in found["forces"].values()]
    for i, G in enumerate(found["jacobian"]):
        _, s, vt = np.linalg.svd(G)
        allowed = vt[np.sum(s > 1e-10 * s[0]) :]
        largest = max(np.linalg.norm(force[i]) for force in forces)
        for force in forces:
            assert np.max(np.abs(allowed @ force[i]), initial=0.0) <= 1e-13 * largest


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.slow if name in TO_COMPILE else ()) for name in CONSTRAINED])
def test_constraints_at_rest_do_no_work_and_moving_ones_do(name):
    x, found, motion = EXAMPLES[name], seen(name), motion_of(name)
    speed = np.linalg.norm(flat(motion.qdot), axis=1)
    for constraint, force in found["forces"].items():
        share = np.max(np.abs(found["powers"][constraint])) / np.max(np.linalg.norm(flat(force), axis=1) * speed)
        assert share > 1e-3 if constraint in x.driven else share <= 1e-13


@pytest.mark.parametrize("error", [0.0, 0.01])
def test_balance_sees_a_wrong_gradient_of_the_dissipation(error, monkeypatch):
    """The equations of motion feel ∂D/∂q̇ too large by 1 %, the works do not: they miss 1 % of the heat."""
    right = constrained_acceleration.applied_force

    def spoiled(flat, t, q, v, multipliers):
        return right(flat, t, q, v, multipliers) * (1 + error)  # dissipation is all there is

    monkeypatch.setattr(constrained_acceleration, "applied_force", spoiled)
    system = jl.System(  # made here, so that nothing compiled before serves it
        lambda t, q, qdot, m, c: 0.5 * m * qdot**2 - 0.5 * c * (1 + 0.5 * jnp.sin(3 * t)) * q**2,
        dissipation={"oil": lambda qdot, b: 0.5 * b * qdot**2},
    )
    motion = jl.simulate(system, 1.0, 0.0, jnp.linspace(0, 2, 21), {"m": 1.0, "c": 4.0, "b": 0.5}, rtol=RTOL, atol=1e-2 * RTOL, works=True)
    scale = np.max(motion.qdot**2) + sum(np.max(np.abs(work)) for work in motion.work().values())  # m = 1: q̇ ∂L/∂q̇
    assert np.max(np.abs(motion.work()["time"])) > 0.1 * scale
    np.testing.assert_allclose(motion.balance(), error * motion.work()["oil"] / scale, rtol=0, atol=BALANCE)
    assert error == 0 or np.max(np.abs(motion.balance())) > 1e4 * BALANCE


# Closed mechanisms and rolling


@pytest.mark.slow
@pytest.mark.parametrize("N", [2, 5])
def test_bars_pass_their_singular_positions(N):
    """Ten turns, through two flat positions each, against θ'' = (m g/I) sin θ of the one degree of freedom."""
    motion = motion_of({2: "two bars", 5: "five bars"}[N])
    stiffness = bars_stiffness(N, 1.0, 1.0, 1.0)
    th = reduced(lambda t, y: [y[1], stiffness * np.sin(y[0])], [0.0, 1.0], motion.ts)[0]
    assert th[-1] > 10 * 2 * np.pi
    from_feet = np.asarray(motion.q) - np.stack([np.arange(N + 1.0), np.zeros(N + 1)], axis=1)
    expected = np.repeat(np.stack([np.sin(th), np.cos(th)], axis=1)[:, None], N + 1, axis=1)
    np.testing.assert_allclose(from_feet, expected, rtol=0, atol=1e-6)


def reduced(rates, y0, ts):
    """Equations of motion in as many coordinates as there are degrees of freedom, by SciPy."""
    return solve_ivp(rates, (0, ts[-1]), y0, method="DOP853", rtol=1e-13, atol=1e-13, t_eval=np.asarray(ts)).y


@pytest.mark.slow
@pytest.mark.parametrize("name", ["disc", "sleigh"])
def test_rolling_keeps_its_energy_for_100_seconds(name):
    energy = seen(name)["energy"]
    np.testing.assert_allclose(energy, energy[0], rtol=10 * RTOL)


@pytest.mark.slow
def test_ball_on_a_turntable_goes_in_a_circle():
    """r̈ = (2/7) Ω e_z × ṙ, whatever radius and mass; its energy in the lab is that of this motion."""
    x, motion = EXAMPLES["ball"], motion_of("ball")
    m, R, turn = (BALL[name] for name in ("m", "R", "turn"))
    w = 2 / 7 * turn
    s, c = np.sin(w * np.asarray(motion.ts)), np.cos(w * np.asarray(motion.ts))
    (x0, y0), (u0, v0) = x.q0["r"], x.qdot0["r"]
    u, v = c * u0 - s * v0, s * u0 + c * v0
    rx, ry = x0 + (v - v0) / w, y0 - (u - u0) / w
    np.testing.assert_allclose(motion.q["r"], np.stack([rx, ry], axis=1), rtol=0, atol=LONG)
    spin2 = ((u + turn * ry) ** 2 + (v - turn * rx) ** 2) / R**2 + 0.5**2
    np.testing.assert_allclose(seen("ball")["energy"], 0.5 * m * (u**2 + v**2) + 0.2 * m * R**2 * spin2, rtol=LONG)


def test_rolling_disc_has_the_exact_equations():
    """cf_rolling_disc (Neimark & Fufaev): thin disc, m = r = g = 1, at random states."""
    rng = np.random.default_rng(11)
    yaw, lean, yawdot, leandot, spindot = rng.uniform(-1.2, 1.2, (5, 30))
    q, qdot = disc_state(yaw, lean, yawdot, leandot, spindot)
    q = {name: np.broadcast_to(leaf, 30) for name, leaf in q.items()}
    found = jax.vmap(lambda q, v: jl.acceleration(disc, q, v, UNITS).qddot)(q, qdot)
    tilting = 0.8 * np.sin(lean) + 0.5 * np.sin(2 * lean) * yawdot**2 + 1.2 * np.cos(lean) * yawdot * spindot
    np.testing.assert_allclose(found["lean"], tilting, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(found["yaw"], -2 * spindot * leandot / np.cos(lean), rtol=1e-12, atol=1e-13)
    spinning = -5 / 3 * yawdot * leandot * np.cos(lean) + 2 * spindot * leandot * np.tan(lean)
    np.testing.assert_allclose(found["spin"], spinning, rtol=1e-12, atol=1e-13)


def test_rolling_disc_upright():
    """cf_rolling_disc: q2'' = 4/5 q2 + 6w/5 q1', q1'' = −2w q2'; the eigenvalue at w = 0.3 and the critical spin √(g/3r)."""

    @jax.jit
    @jax.vmap
    def matrix(w):
        def rates(y):
            q, qdot = disc_state(0.0, y[0], y[2], y[1], w)
            found = jl.acceleration(disc, q, qdot, UNITS).qddot
            return jnp.stack([y[1], found["lean"], found["yaw"]])

        return jax.jacfwd(rates)(jnp.zeros(3))

    slow, critical = np.asarray(matrix(jnp.array([0.3, 0.5773502691896257])))
    np.testing.assert_allclose(slow, [[0, 1, 0], [0.8, 0, 0.36], [0, -0.6, 0]], rtol=0, atol=1e-13)
    np.testing.assert_allclose(np.max(np.linalg.eigvals(slow).real), 0.764198926981712, rtol=1e-9)
    np.testing.assert_allclose(np.linalg.matrix_power(critical, 2)[1, 1], 0, rtol=0, atol=1e-12)  # λ² = 4g/5r − 12w²/5


@pytest.mark.slow
def test_a_disc_that_rolls_is_not_called_stiff():
    """Where it rolls to and turns to are double eigenvalues 0: no time constants, though rounding makes some 1e-8 of them."""
    found = jl.examine(disc, *disc_state(0.0, 0.1, 0.2, 0.0, 2.0), UNITS)
    assert found.time_constants[1] < 1e3 and not any("stiff" in finding for finding in found.findings)


def test_rolling_disc_turns_steadily():
    """cf_rolling_disc: lean −0.3, q1' = 0.5, q3' = 0.5355817522550558; and a fast one, which is stable, for 100 s."""
    state = disc_state(0.0, -0.3, 0.5, 0.0, 0.5355817522550558)
    np.testing.assert_allclose(jl.acceleration(disc, *state, UNITS).qddot["lean"], 0, rtol=0, atol=1e-13)
    yawdot = 0.2
    spindot = (0.8 * np.sin(0.3) + 0.5 * np.sin(0.6) * yawdot**2) / (1.2 * np.cos(0.3) * yawdot)
    motion = run("disc", *disc_state(0.0, -0.3, yawdot, 0.0, spindot), 100.0)
    np.testing.assert_allclose(motion.q["lean"], -0.3, rtol=LONG)
    np.testing.assert_allclose(motion.q["yaw"], yawdot * motion.ts, rtol=0, atol=LONG)
    radius = spindot / yawdot  # of the circle of the contact point
    np.testing.assert_allclose(np.hypot(motion.q["x"], motion.q["y"] - radius), radius, rtol=LONG)


# The multiplier collection: cf_multiplier_collection, textbook closed forms, to 1e-12 at one state


def test_atwood():
    found = jl.acceleration(atwood, {"x1": 0.7, "x2": 1.3}, {"x1": 0.4, "x2": -0.4}, ATWOOD)
    np.testing.assert_allclose([found.qddot["x1"], -found.multipliers["rope"]], [1.962, 23.544], rtol=STATE)
    found = jl.acceleration(atwood_pulley, {"x1": 0.7, "x2": 1.3, "s": -0.3}, {"x1": 0.4, "x2": -0.4, "s": 0.4}, ATWOOD)
    np.testing.assert_allclose(found.qddot["x1"], 1.635, rtol=STATE)
    ropes = [-found.multipliers["left"], -found.multipliers["right"]]  # m₁(g − a), m₂(g + a)
    np.testing.assert_allclose(ropes, [3 * (g - 1.635), 2 * (g + 1.635)], rtol=STATE)


@pytest.mark.parametrize("k, share, friction", [(1 / 2, 2 / 3, 1 / 3), (2 / 5, 5 / 7, 2 / 7), (1.0, 1 / 2, 1 / 2)])
def test_disc_sphere_and_hoop_on_an_incline(k, share, friction):
    """y'' and the friction as shares of g sin α and m g sin α: 3.27 and 3.5035714285714286 for the disc and the sphere."""
    found = jl.acceleration(incline, {"y": 0.5, "th": 1.0}, {"y": 0.1, "th": 0.2}, {**INCLINE, "k": k})
    np.testing.assert_allclose(found.qddot["y"], share * g * np.sin(np.pi / 6), rtol=STATE)
    np.testing.assert_allclose(-found.multipliers["rolling"], friction * INCLINE["m"] * g * np.sin(np.pi / 6), rtol=STATE)


@pytest.mark.parametrize("s, sdot", [(0.0, 0.0), (2.3, 1.7)])
def test_bead_on_a_helix(s, sdot):
    found = jl.acceleration(helix, *helix_state(s, sdot), HELIX)
    np.testing.assert_allclose(found.qddot[2] / HELIX["h"], -6.76551724137931, rtol=STATE)


def test_wedge():
    found = jl.acceleration(wedge, {"X": 0.3, "x": 0.3, "y": 0.0}, {"X": -0.2, "x": -0.2, "y": 0.0}, WEDGE)
    np.testing.assert_allclose([-found.qddot["X"], found.multipliers["face"]], [2.4273454888929553, 14.564072933357732], rtol=STATE)


def test_chain_slides_off_a_table():
    motion = motion_of("chain")
    w = np.sqrt(g / CHAIN["L"])
    cosh, sinh = 0.4 * np.cosh(w * np.asarray(motion.ts)), 0.4 * np.sinh(w * np.asarray(motion.ts))
    np.testing.assert_allclose(motion.q["x"], cosh, rtol=SHORT)
    # Of the equation of u: λ = −ρ u ẍ + ½ρẋ², the pull at the edge less the momentum that crosses it
    edge = -CHAIN["rho"] * ((CHAIN["L"] - cosh) * w**2 * cosh - 0.5 * (w * sinh) ** 2)
    off = SHORT * CHAIN["rho"] * (np.abs(CHAIN["L"] - 2 * cosh) * w**2 * cosh + (w * sinh) ** 2)  # what such errors of x and ẋ make of λ
    assert np.all(np.abs(motion.multipliers["length"] - edge) <= off)


@pytest.mark.slow
def test_ladder_leaves_the_wall():
    """At sin θ = ⅔ sin θ₀ from rest at θ₀: there the wall would have to pull."""
    th0, m, b = 1.2, LADDER["m"], LADDER["b"]
    fallen = lambda s: ladder_state(np.arcsin(s), -np.sqrt(1.5 * g / b * (np.sin(th0) - s)))
    wall = lambda s: jl.acceleration(ladder, *fallen(s), LADDER).multipliers["wall"]
    np.testing.assert_allclose(wall(2 / 3 * np.sin(th0)), 0, rtol=0, atol=STATE * m * g)
    motion = run("ladder", *ladder_state(th0, 0.0), 1.3)
    left = np.sin(th0) * 2 / 3 - np.sin(motion.q["th"])
    assert left[0] < 0 < left[-1]
    np.testing.assert_array_equal(np.sign(motion.multipliers["wall"]), -np.sign(left))
    end = lambda t: run("ladder", *ladder_state(th0, 0.0), t)
    leaving = brentq(lambda t: float(end(t).multipliers["wall"][-1]), 0.5, 1.3, xtol=1e-12)
    np.testing.assert_allclose(np.sin(end(leaving).q["th"][-1]) / np.sin(th0), 0.6666666666666666, rtol=SHORT)


# Prescribed motion: λ is the drive


def test_bead_on_a_turned_rod():
    """cf_multiplier_collection: r = r₀ cosh wt, torque m r₀² w² sinh 2wt, whose work is ½m r₀² w² (cosh 2wt − 1)."""
    r, rdot = 0.3 * np.cosh(2.0), 0.6 * np.sinh(2.0)
    found = jl.acceleration(turned_rod, {"r": r, "phi": 2.0}, {"r": rdot, "phi": 2.0}, ROD, t=1.0)
    np.testing.assert_allclose([r, found.multipliers["drive"]], [1.1286587073250893, 9.824370190965992], rtol=STATE)
    motion = motion_of("turned rod")
    ends = [motion.q["r"][-1], motion.multipliers["drive"][-1]]
    np.testing.assert_allclose(ends, [1.1286587073250893, 9.824370190965992], rtol=SHORT)
    work = 0.5 * 0.3**2 * 2.0**2 * (np.cosh(4 * np.asarray(motion.ts)) - 1)
    np.testing.assert_allclose(motion.work()["drive"], work, rtol=0, atol=2 * SHORT * work[-1])  # works do not set the steps


def test_bead_on_a_rotating_hoop():
    """cf_bead_rotating_hoop: rest at acos(g/Rω²), small oscillations about it, the drive's torque, Jacobi's integral."""
    still = run("hoop", {"th": HOOP_REST, "phi": 0.0}, {"th": 0.0, "phi": 5.0}, 5.0)
    np.testing.assert_allclose(still.q["th"], HOOP_REST, rtol=0, atol=1e-10)
    T = 2 * np.pi / 4.598973363697598
    small = run("hoop", {"th": HOOP_REST + 1e-4, "phi": 0.0}, {"th": 0.0, "phi": 5.0}, T)
    np.testing.assert_allclose(small.qdot["th"][-1] / small.qddot["th"][-1] / T, 0, rtol=0, atol=1e-6)  # Newton's step to θ̇ = 0
    motion = motion_of("hoop")
    th, thdot = np.asarray(motion.q["th"]), np.asarray(motion.qdot["th"])
    torque = 2 * 5.0 * np.sin(th) * np.cos(th) * thdot
    np.testing.assert_allclose(motion.multipliers["drive"], torque, rtol=0, atol=STATE * np.max(np.abs(torque)))
    jacobi = 0.5 * (thdot**2 - 25.0 * np.sin(th) ** 2) - g * np.cos(th)
    np.testing.assert_allclose(jacobi, jacobi[0], rtol=SHORT)
    turning = {**HOOP, "omega": 3.132091952673165}  # the critical one: no force to first order in θ
    slightly = jl.acceleration(hoop, {"th": 1e-4, "phi": 0.0}, {"th": 0.0, "phi": turning["omega"]}, turning)
    np.testing.assert_allclose(slightly.qddot["th"], -g / 2 * 1e-12, rtol=1e-2)


@pytest.mark.slow
def test_drive_of_a_cart_is_that_of_newton_and_euler():
    """F = mc Ẍ + m ẍ + b ẋ, with ẍ from the angle's own equation: m l φ̈ = −m g sin φ − m Ẍ cos φ − b (l φ̇ + Ẋ cos φ)."""
    motion, p = motion_of("cart"), CART
    t, (x, y), (xdot, ydot) = np.asarray(motion.ts), np.asarray(motion.q["r"]).T, np.asarray(motion.qdot["r"]).T
    X = p["A"] * np.sin(p["w"] * t)
    Xdot, Xddot = p["A"] * p["w"] * np.cos(p["w"] * t), -(p["w"] ** 2) * X
    s, c = (x - X) / p["l"], -y / p["l"]
    rate = (xdot - Xdot) * c / p["l"] + ydot * s / p["l"]
    bend = -(g * s + Xddot * c) / p["l"] - p["b"] / p["m"] * (rate + Xdot * c / p["l"])
    xddot = Xddot + p["l"] * (bend * c - rate**2 * s)
    force = p["mc"] * Xddot + p["m"] * xddot + p["b"] * xdot
    np.testing.assert_allclose(motion.multipliers["drive"], force, rtol=0, atol=STATE * np.max(np.abs(force)))


# Pendulums


def test_tension_of_a_spherical_pendulum():
    """T = m v²/l + m g cos α at random states; on the circle of the conical pendulum m g / cos α, and the height stays."""
    rng = np.random.default_rng(12)
    n, v = rng.normal(size=(2, 20, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    v -= np.sum(n * v, axis=1, keepdims=True) * n
    conical = conical_state(0.6, BOB["l"])
    q, v = np.concatenate([BOB["l"] * n, conical[0][None]]), np.concatenate([v, conical[1][None]])

    @jax.vmap
    def at(q, v):
        return jl.acceleration(bob, q, v, BOB), jl.constraint_force(bob, q, v, BOB, at=lambda q: q)["rod"]

    found, force = at(q, v)
    tension = BOB["m"] * (np.sum(v**2, axis=1) - g * q[:, 2]) / BOB["l"]
    np.testing.assert_allclose(-found.multipliers["rod"], tension, rtol=STATE, atol=STATE * BOB["m"] * g)
    np.testing.assert_allclose(force, -tension[:, None] * q / BOB["l"], rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(-found.multipliers["rod"][-1], BOB["m"] * g / np.cos(0.6), rtol=STATE)
    np.testing.assert_allclose(found.qddot[-1], -g / (BOB["l"] * np.cos(0.6)) * q[-1] * [1, 1, 0], rtol=0, atol=STATE * g)


squared = jl.System(lambda q, qdot, m, g: 0.5 * m * qdot @ qdot - m * g * q[1], holonomic={"rod": lambda q, l: q @ q - l**2})


@pytest.mark.slow
def test_simple_pendulum_of_iftomm():
    """IFToMM benchmark A01 (González et al. 2006): its rows, six digits, and the exact elliptic solution at these times."""
    ts = jnp.array([0, 0.5, 1, 10, 100, 1000, 2000])
    motion = jl.simulate(
        squared, np.array([-1.0, 0.0]), np.zeros(2), ts, {"m": 1.0, "g": g, "l": 1.0}, solver=diffrax.Dopri8(), rtol=1e-12, atol=1e-13
    )
    rows = [[-0.391049, -0.92037], [0.986292, -0.165011], [-0.275087, -0.961419], [-0.181513, -0.983388], [0.68323, -0.730203]]
    exact = [
        [-0.3910487915505463, -0.9203699487851923],
        [0.9862917511318754, -0.16501085312554079],
        [-0.27508746257611955, -0.9614192050991243],
        [-0.1815133514270043, -0.9833884803340625],
        [0.6832301885519686, -0.7302030604230864],
        [0.8146030685884941, -0.5800188278376912],
    ]
    np.testing.assert_allclose(motion.q[1:], [*rows, [0.814603, -0.580019]], rtol=0, atol=6e-7)
    np.testing.assert_allclose(motion.q[1:], exact, rtol=0, atol=1e-7)


# Gradients, with default settings, against differences of the reduced equations solved by SciPy


def differences(f, x, h=1e-3):
    """Central differences of fourth order, column by column."""
    columns = [(8 * (f(x + e) - f(x - e)) - f(x + 2 * e) + f(x - 2 * e)) / (12 * h) for e in h * np.eye(x.size)]
    return np.stack(columns, axis=-1)


TS = jnp.linspace(0, 2, 5)


def bars_end(x):
    speed, m, l = x
    return jl.simulate(bars, *bars_state(2, speed, l), TS, {**BARS, "m": m, "l": l}).q[-1, 0]


def bars_reduced(x):
    speed, m, l = x
    stiffness = bars_stiffness(2, m, 1.0, l)
    th = reduced(lambda t, y: [y[1], stiffness * np.sin(y[0])], [0.0, speed / l], TS[-1:])[0, -1]
    return np.array([l * np.sin(th), l * np.cos(th)])


def beam_end(x):
    th, m, l = x
    q = jl.simulate(beam, *beam_state(th, 0.5, l), TS, {**BEAM, "m": m, "l": l}).q
    return jnp.stack([q["x"][-1], q["y"][-1]])


def beam_reduced(x):
    th, m, l = x
    th = reduced(lambda t, y: [y[1], -np.sin(y[0]) * (g / l + BEAM["c"] / m * np.cos(y[0]))], [th, 0.5], TS[-1:])[0, -1]
    return np.array([l * np.sin(th), -l * np.cos(th)])


def cart_end(x):
    phi, m, l = x
    return jl.simulate(cart, *cart_state(phi, 0.4, l, CART["A"], CART["w"]), TS, {**CART, "m": m, "l": l}).q["r"][-1]


def cart_reduced(x):
    (phi, m, l), (A, w, b) = x, (CART[name] for name in ("A", "w", "b"))

    def rates(t, y):
        Xdot, Xddot = A * w * np.cos(w * t), -A * w**2 * np.sin(w * t)
        return [y[1], -(g * np.sin(y[0]) + Xddot * np.cos(y[0])) / l - b / m * (y[1] + Xdot * np.cos(y[0]) / l)]

    phi = reduced(rates, [phi, 0.4], TS[-1:])[0, -1]
    return np.array([A * np.sin(2 * w) + l * np.sin(phi), -l * np.cos(phi)])


def sleigh_end(x):
    speed, m, a = x
    q = jl.simulate(sleigh, *sleigh_state(speed, 0.7), TS, {"m": m, "I": 0.3, "a": a}).q
    return jnp.stack([q["x"][-1], q["y"][-1], q["phi"][-1]])


def sleigh_reduced(x):
    """Bloch, Nonholonomic Mechanics, section 1.7: u̇ = a ω², (I + m a²) ω̇ = −m a u ω."""
    speed, m, a = x

    def rates(t, y):
        _, _, phi, u, w = y
        return [u * np.cos(phi), u * np.sin(phi), w, a * w**2, -m * a * u * w / (0.3 + m * a**2)]

    return reduced(rates, [0.0, 0.0, 0.0, speed, 0.7], TS[-1:])[:3, -1]


@pytest.mark.slow
@pytest.mark.parametrize(
    "end, by_hand, x",
    [
        pytest.param(beam_end, beam_reduced, [0.9, 1.7, 0.8], id="redundant loop"),
        pytest.param(cart_end, cart_reduced, [0.5, 0.7, 0.9], id="prescribed motion"),
        pytest.param(sleigh_end, sleigh_reduced, [-1.0, 2.0, 0.4], id="nonholonomic"),
        pytest.param(bars_end, bars_reduced, [2.0, 1.3, 0.9], id="through singular positions"),
    ],
)
def test_gradients_with_respect_to_an_initial_value_a_mass_and_a_length(end, by_hand, x):
    expected = differences(by_hand, np.array(x))
    assert np.min(np.abs(expected)) > 1e-3
    both = jax.jit(lambda x: (jax.jacfwd(end)(x), jax.jacrev(end)(x)))  # together: half the time of compilation
    for found in both(jnp.array(x)):
        np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("x", [(3.0, 4.0), (0.5, -0.2)], ids=["on the circle", "far from it"])
def test_derivatives_of_a_consistent_state_of_every_order(x):
    """The nearest point of the circle |q| = l is l x/|x|, whether the search for it begins there or not."""
    circle = jl.System(lambda qdot: 0.5 * qdot @ qdot, holonomic=lambda q, l: q @ q - l**2)
    x = jnp.array([*x, 5.0])
    found = lambda x: jl.consistent_state(circle, x[:2], jnp.zeros(2), {"l": x[2]})[0]
    exact = lambda x: x[2] * x[:2] / jnp.linalg.norm(x[:2])
    for order in range(4):
        np.testing.assert_allclose(found(x), exact(x), rtol=1e-9, atol=1e-9, err_msg=f"order {order}")
        found, exact = jax.jacfwd(found), jax.jacfwd(exact)


def test_baumgartes_feedback_is_a_damped_oscillator():
    """What is off a constraint obeys g̈ + 2α ġ + β² g = 0, and ȧ + 2α a = 0 where velocities alone are held."""
    system = jl.System(
        lambda qdot: 0.5 * qdot @ qdot,
        holonomic={"wall": lambda t, q: 3.0 * q[0] - jnp.sin(2.0 * t)},
        nonholonomic={"edge": lambda t, qdot: qdot[1] - 5.0 * t},
    )
    q, v, t = jnp.array([0.4, 0.0]), jnp.array([0.7, -0.3]), 0.5
    feedback = jl.stabilisation.Baumgarte(alpha=3.0, beta=7.0).feedback()(bind(system, q, None), t, q, v)
    off, rate, a = 3.0 * 0.4 - np.sin(1.0), 3.0 * 0.7 - 2.0 * np.cos(1.0), -0.3 - 2.5
    np.testing.assert_allclose(feedback, [6.0 * rate + 49.0 * off, 6.0 * a], rtol=1e-14)
