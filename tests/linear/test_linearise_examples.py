"""A, B and Λ near the rest or the steady motion of the examples, and A along motions of those that have none, against `simulate`.

The examples are those of README, of the notebooks (by number) and of docstrings. Without a steady motion are, and along a motion are tried:
a block that slides or that the air brakes (1: at rest, its drag has a kink), a crank that turns (5), a coin that leans (7: its place runs
in circles), a drive by sines with a learnt friction (8), a pendulum under a measured torque (11), a free fall and a cart under a signal
(docstrings). Left out are the slider that a motor moves (5), for nothing of it is free; an oscillator that sticks to its belt (6), which
neither rests nor stays in one mode, but whose slip is here; and drag at rest (1, 10), whose second derivative jumps there: a deviation ε
of v changes its force by kε², so that differences agree with A to ε alone.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.linalg import expm

import jaxlag as jl
from jaxlag.examples import bicycle, pendulum, vehicle

g = 9.81
SHARP = {"rtol": 1e-11, "atol": 1e-13}
SMALL = 1e-4  # deviations of motions: their squares and the errors of the motions, over them, are below SHOWN
SHOWN = 1e-6
DUST = 1e-9  # the errors of the motions, SHARP, over SMALL, where nothing else is expected


class Steady(NamedTuple):
    """A system, a guess of its rest or of its steady motion, and for how long it is simulated from beside it."""

    system: jl.System
    q: Any
    params: dict
    time: float
    qdot: Any = None  # where some coordinates run
    fixed: tuple[str, ...] = ()  # coordinates, or in a steady motion velocities
    states: Any = None
    moved: str | None = None  # an input among the params that forces depend on, and no constraint


# Oscillators and pendulums: README, docstrings, 9, 10, 12, 14

OSCILLATOR = jl.System(lambda q, qdot, m, c: 0.5 * m * qdot**2 - 0.5 * c * q**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2)


def storeys():
    system = jl.System(
        lambda q, qdot, m, c: 0.5 * m * jnp.sum(qdot**2) - 0.5 * jnp.sum(c * jnp.diff(q, prepend=0.0) ** 2),
        dissipation=lambda qdot, b: 0.5 * b * jnp.sum(jnp.diff(qdot, prepend=0.0) ** 2),
    )
    return Steady(system, np.zeros(3), {"m": 20.0, "c": np.array([4e4, 3e4, 4e4]), "b": 120.0}, 0.05)


def absorber():
    def lagrangian(q, qdot, m1, m2, c1, c2):
        kinetic = 0.5 * m1 * qdot["x1"] ** 2 + 0.5 * m2 * qdot["x2"] ** 2
        return kinetic - 0.5 * c1 * q["x1"] ** 2 - 0.5 * c2 * (q["x2"] - q["x1"]) ** 2

    system = jl.System(lagrangian, dissipation=lambda qdot, b: 0.5 * b * (qdot["x2"] - qdot["x1"]) ** 2)
    return Steady(system, {"x1": 0.3, "x2": 0.1}, {"m1": 1.0, "c1": 1.0, "m2": 0.2, "c2": 0.2, "b": 0.02}, 1.0)


def in_air():
    """README: in Cartesian coordinates."""
    air = lambda qdot, b: 0.5 * b * (qdot["x"] ** 2 + qdot["y"] ** 2)
    system = jl.System(pendulum.cartesian_lagrangian, dissipation=air, holonomic={"rod": pendulum.cartesian_rod})
    return Steady(system, {"x": 0.1, "y": -1.4}, {"m": 2.0, "l": 1.5, "g": g, "b": 0.1}, 0.5)


def in_polar_coordinates():
    return Steady(pendulum.polar, {"r": 1.0, "phi": 0.2}, pendulum.params, 0.5)


def upright():
    return Steady(pendulum.polar, {"r": 1.0, "phi": 3.0}, pendulum.params, 0.2)


def on_a_square():
    """The docstring of `linearise`: g = q·q − l²."""
    system = jl.System(lambda q, qdot, m, g: 0.5 * m * qdot @ qdot - m * g * q[1], holonomic=lambda q, l: q @ q - l**2)
    return Steady(system, np.array([0.1, -2.0]), {"m": 3.0, "g": g, "l": 2.0}, 0.5)


def substituted():
    mass = jl.System(lambda q, qdot, m, g: 0.5 * m * qdot @ qdot - m * g * q[1])
    system = jl.substitute(mass, lambda q, l: l * jnp.stack([jnp.sin(q), -jnp.cos(q)]))
    return Steady(system, 0.1, {"m": 1.0, "g": g, "l": 2.0}, 0.5)


def double_pendulum():
    ends = lambda q, l: jnp.cumsum(l * jnp.stack([jnp.sin(q), -jnp.cos(q)], axis=1), axis=0)

    def lagrangian(t, q, qdot, params, m, g):
        return 0.5 * m * jnp.sum(jl.rate(ends)(t, q, qdot, params) ** 2) - m * g * jnp.sum(ends(q, params["l"])[:, 1])

    return Steady(jl.System(lagrangian), np.array([0.1, 0.1]), {"m": 1.0, "g": g, "l": 0.5}, 0.3)


def column():
    """14: two rods on springs under a load that follows."""
    along = lambda angle: jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    ends = lambda q, l: (l * along(q["phi1"]), l * along(q["phi1"]) + l * along(q["phi2"]))

    def lagrangian(t, q, qdot, params, m, k):
        lower, upper = jl.rate(ends)(t, q, qdot, params)
        return m * lower @ lower + 0.5 * m * upper @ upper - 0.5 * k * (q["phi1"] ** 2 + (q["phi2"] - q["phi1"]) ** 2)

    dampers = lambda qdot, b1, b2: 0.5 * b1 * qdot["phi1"] ** 2 + 0.5 * b2 * (qdot["phi2"] - qdot["phi1"]) ** 2
    load = jl.virtual_work(lambda q, l: ends(q, l)[1], lambda q, P, eta: -P * along(eta * q["phi2"]))
    params = {"m": 1.0, "l": 1.0, "k": 1.0, "b1": 0.1, "b2": 0.1, "P": 1.8, "eta": 0.7}
    return Steady(jl.System(lagrangian, dissipation=dampers, force=load), {"phi1": 0.1, "phi2": 0.1}, params, 1.0)


def half_car():
    """12: rest on tyres and struts; the road lifts."""
    deflections = lambda q, a, l: q["y"] + a * jnp.array([-1.0, 1.0]) * q["phi"] - q["wheels"] - l

    def lagrangian(q, qdot, params, M, m, Theta_s, c, k, g, road):
        kinetic = 0.5 * M * qdot["y"] ** 2 + 0.5 * Theta_s * qdot["phi"] ** 2 + 0.5 * m * jnp.sum(qdot["wheels"] ** 2)
        springs = 0.5 * c * jnp.sum(deflections(q, params["a"], params["l"]) ** 2) + 0.5 * k * jnp.sum((q["wheels"] - road) ** 2)
        return kinetic - springs - M * g * q["y"] - m * g * jnp.sum(q["wheels"])

    dampers = lambda t, q, qdot, params, b: 0.5 * b * jnp.sum(jl.rate(deflections)(t, q, qdot, params) ** 2)
    params = {"M": 1e3, "m": 30.0, "Theta_s": 1.5e3, "a": 1.3, "c": 4e4, "k": 2e5, "b": 3e3, "l": 0.5, "g": g, "road": 0.0}
    q = {"y": 0.5, "phi": 0.0, "wheels": np.zeros(2)}
    return Steady(jl.System(lagrangian, dissipation=dampers), q, params, 0.05, moved="road")


def learnt_potential():
    net = jl.learnt.Potential(0.1, energy=5.0, key=jax.random.key(0))
    system = jl.System(lambda q, qdot, m, c, net: 0.5 * m * qdot**2 - net(q) - 0.5 * c * q**2)
    return Steady(system, 0.0, {"m": 2.0, "c": 400.0, "net": net}, 0.05)


def learnt_dissipation():
    """8, with a drive that stands still."""
    net = jl.learnt.PassiveDissipation(scale=0.1, power=0.5, width=8, depth=1, key=jax.random.key(0))
    system = jl.System(lambda qdot, m: 0.5 * m * qdot**2, dissipation=lambda qdot, net: net(qdot), force=lambda F: F)
    return Steady(system, 0.0, {"m": 2.0, "net": net, "F": 0.0}, 0.05, moved="F")


# Dry friction: README, 1, 6, 10, 11

DRY = {"dry": lambda qdot, F: F * jnp.abs(qdot)}


def stuck_oscillator():
    """README: where it comes to rest, away from the middle."""
    system = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2, dissipation=DRY)
    return Steady(system, 0.05, {"c": 4.0, "F": 0.3}, 1.0, moved="c")


def block():
    system = jl.System(lambda qdot, m: 0.5 * m * qdot["x"] ** 2, dissipation={"plane": lambda qdot, mu, m: mu * m * g * jnp.abs(qdot["x"])})
    return Steady(system, {"x": 0.0}, {"m": 1.0, "mu": 0.2}, 1.0)


def slipping_oscillator():
    """6: on its belt, whose friction falls with the speed of slip."""
    system = jl.System(
        lambda q, qdot, m, c: 0.5 * m * qdot["x"] ** 2 - 0.5 * c * q["x"] ** 2,
        dissipation={"belt": lambda qdot, v_b, F_c, F_s, v_s: jl.dissipation.stribeck(qdot["x"] - v_b, F_c, F_s, v_s)},
    )
    params = {"m": 1.0, "c": 50.0, "v_b": 0.2, "F_c": 2.0, "F_s": 3.0, "v_s": 0.4}
    return Steady(system, {"x": 0.04}, params, 0.1, moved="F_c")


def measured_pendulum():
    """11, at rest under a constant torque that a signal holds: its bearing sticks."""
    return Steady(MEASURED, 0.1, MEASURED_PARAMS | {"u": jl.Signal([0.0, 9.0], [0.1, 0.1])}, 0.5, moved="u0")


def swinging(q, qdot, J, ml):
    return 0.5 * J * qdot**2 + ml * g * jnp.cos(q)


def motor(t, u, u0):
    return u(t) + u0


VISCOUS = {"viscous": lambda qdot, b: 0.5 * b * qdot**2}
MEASURED = jl.System(swinging, dissipation=VISCOUS | DRY, force=motor)
MEASURED_PARAMS = {"J": 0.16, "ml": 0.32, "b": 0.05, "F": 0.1, "u0": 0.02}


def without_dry_friction():
    """11, its bearing viscous."""
    return measured_pendulum()._replace(system=jl.System(swinging, dissipation=VISCOUS, force=motor))


# States and controllers: README and docstrings


def servo():
    """A pendulum held by a motor with a lag and an integrating controller."""
    lag = lambda M, q, qdot, total, tau: (8.0 * (0.6 - q) - 1.0 * qdot + total - M) / tau
    system = jl.System(
        lambda q, qdot, m, l: 0.5 * m * (l * qdot) ** 2 + m * g * l * jnp.cos(q),
        force=lambda M, push: M + push,
        states={"M": jl.State(lag, start=0.0), "total": jl.State(lambda q: 5.0 * (0.6 - q), start=0.0)},
    )
    return Steady(system, 0.5, {"m": 0.5, "l": 0.4, "tau": 0.05, "push": 0.0}, 0.5, moved="push")


def spring_and_damper_in_series():
    joint = jl.State(lambda q, x, c, d: c / d * (q - x), start=0.0)
    system = jl.System(lambda q, qdot, m: 0.5 * m * qdot**2, force=lambda q, x, c, F: F - c * (q - x), states={"x": joint})
    return Steady(system, 0.2, {"m": 2.0, "c": 30.0, "d": 4.0, "F": 0.0}, 0.5, moved="F", fixed=("q",))


def lagging_motor():
    motor = jl.State(lambda z, command, tau: (command - z) / tau, start=0.0)
    cart = jl.System(lambda qdot, m: 0.5 * m * qdot**2, force=lambda z: z, states={"z": motor})
    return Steady(cart, 0.0, {"m": 2.0, "command": 0.0, "tau": 0.5}, 0.5, moved="command")


def digital_servo(dissipation=None, moved="load"):
    """README, without friction: a sampled controller, a motor with a lag, in discrete time."""
    controller = lambda q, qdot, u, goal: jnp.clip(40.0 * (goal - q) - 8.0 * qdot, -5.0, 5.0)
    beside = {"u": jl.Sampled(controller, every=0.01, start=0.0), "z": jl.State(lambda z, u, tau: (u - z) / tau, start=0.0)}
    system = jl.System(lambda qdot, m: 0.5 * m * qdot**2, dissipation=dissipation, force=lambda z, load: z + load, states=beside)
    return Steady(system, 1.0, {"m": 2.0, "tau": 0.02, "goal": 1.0, "load": 0.0, "F": 0.5}, 0.05, moved=moved)


def sampled_cart():
    controller = jl.Sampled(lambda q, qdot, goal: 9.0 * (goal - q) - 3.0 * qdot, every=0.01, start=0.0)
    cart = jl.System(lambda qdot: 0.5 * qdot**2, force=lambda u: u, states={"u": controller})
    return Steady(cart, 1.0, {"goal": 2.0}, 0.05, moved="goal")


# Constraints: 5, 7, 13, docstrings


def four_bar():
    """5, hanging: three uniform bars between two bearings, as symmetric as they are."""
    loop = lambda q, a, b, c: a * e(q["alpha"]) + b * e(q["beta"]) - c * e(q["gamma"]) - e(0.0)
    system = jl.System(lambda t, q, qdot, params: bars(t, q, qdot, params) - heights(q, params), holonomic={"loop": loop})
    params = {"a": 0.8, "b": 0.6, "c": 0.8, "rho": 1.0}
    return Steady(system, {"alpha": -1.3, "beta": 0.0, "gamma": -1.8}, params, 0.5)


def e(angle):
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def centres(q, a, b, c):
    return jnp.stack([a / 2 * e(q["alpha"]), a * e(q["alpha"]) + b / 2 * e(q["beta"]), c / 2 * e(q["gamma"])])


def bars(t, q, qdot, params):
    lengths = jnp.stack([params[name] for name in "abc"])
    turning = lengths * jnp.stack([qdot[name] for name in ("alpha", "beta", "gamma")])
    return 0.5 * params["rho"] * lengths @ (jnp.sum(jl.rate(centres)(t, q, qdot, params) ** 2, axis=1) + turning**2 / 12)


def heights(q, params):
    lengths = [params[name] for name in "abc"]
    return params["rho"] * g * jnp.stack(lengths) @ centres(q, *lengths)[:, 1]


def platform():
    """5: on three parallel arms, of which one is redundant; it leans under a force."""

    def arms(q, l):
        at = jnp.array([-1.0, 0.0, 1.0])
        return jnp.hypot(q["x"] + at * jnp.cos(q["psi"]) - at, q["y"] + at * jnp.sin(q["psi"])) - l

    kinetic = lambda q, qdot, m: 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2 + qdot["psi"] ** 2 / 3) - m * g * q["y"]
    system = jl.System(kinetic, holonomic={"arms": arms}, force=lambda F: {"x": F})
    q = {"x": 1.5 * np.sin(0.3), "y": -1.5 * np.cos(0.3), "psi": 0.0}
    return Steady(system, q, {"m": 2.0, "l": 1.5, "F": 3.0}, 0.5, moved="F")


def on_the_floor():
    system = jl.System(lambda q, qdot, m: 0.5 * m * qdot @ qdot - m * g * q[1], holonomic={"floor": lambda q: 2 * q[1]})
    return Steady(system, np.zeros(2), {"m": 2.0}, 0.5)


def free_on_a_circle():
    rod = jl.System(lambda qdot: 0.5 * qdot @ qdot, holonomic=lambda q, l: q @ q - l**2)
    return Steady(rod, np.array([3.0, 4.0]), {"l": 5.0}, 0.5)


def geared():
    """A wheel that a spring turns back through a rack without mass, which its teeth move as the wheel turns."""
    system = jl.System(
        lambda q, qdot, J, c: 0.5 * J * qdot["phi"] ** 2 - 0.5 * c * q["s"] ** 2,
        dissipation=lambda qdot, b: 0.5 * b * qdot["s"] ** 2,
        nonholonomic={"teeth": lambda qdot, r: qdot["s"] - r * qdot["phi"]},
        force=lambda M: {"phi": M},
    )
    return Steady(system, {"phi": 0.4, "s": 0.0}, {"J": 0.2, "c": 50.0, "b": 1.0, "r": 0.3, "M": 0.0}, 0.5, moved="M")


def massless_joint():
    """Two springs in a row whose joint has no mass, but a constraint."""
    system = jl.System(
        lambda q, qdot, m, c: 0.5 * m * qdot["x"] ** 2 - 0.5 * c * (q["joint"] ** 2 + (q["x"] - q["joint"]) ** 2),
        holonomic={"balance": lambda q: 2 * q["joint"] - q["x"]},
        force=lambda F: {"x": F},
    )
    return Steady(system, {"x": 0.1, "joint": 0.0}, {"m": 2.0, "c": 30.0, "F": 1.0}, 0.5, moved="F")


# Steady motions: docstrings, 2, 7, 13


def driven_vehicle():
    p = vehicle.params
    return Steady(vehicle.system, vehicle.q0, p, 0.3, {"x": 20.0, "y": 0.0, "phi": 0.0}, moved="M0")


def bead():
    """On a hoop that turns freely, away from its lowest point: φ runs uniformly; gravity and centrifugal force are in balance."""
    system = jl.System(
        lambda q, qdot, R, I: (
            0.5 * R**2 * (qdot["theta"] ** 2 + (qdot["phi"] * jnp.sin(q["theta"])) ** 2)
            + 0.5 * I * qdot["phi"] ** 2
            + g * R * jnp.cos(q["theta"])
        ),
        force=lambda M: {"phi": M},
    )
    params = {"R": 0.2, "I": 0.01, "M": 0.0}
    return Steady(system, {"theta": 1.0, "phi": 0.3}, params, 0.4, {"theta": 0.0, "phi": 9.0}, ("phi",), moved="M")


def bead_on_a_turned_hoop():
    """README."""
    system = jl.System(
        lambda q, qdot, m, R, W: 0.5 * m * R**2 * (qdot**2 + (W * jnp.sin(q)) ** 2) + m * g * R * jnp.cos(q),
        dissipation=lambda qdot, b: 0.5 * b * qdot**2,
    )
    return Steady(system, 1.0, {"m": 0.1, "R": 0.5, "W": 6.0, "b": 0.01}, 0.5, moved="W")


def rolling_coin():
    """7: upright, straight on and fast enough."""
    return Steady(COIN, COIN_AT | {"theta": 0.0}, COIN_PARAMS, 0.1, ROLLING, ("phi",))


def spin(q, qdot):
    return qdot["phi"] + qdot["psi"] * jnp.sin(q["theta"])


def coin(q, qdot, m, r):
    fall = r * jnp.sin(q["theta"]) * qdot["theta"]
    turning = qdot["theta"] ** 2 / 4 + (qdot["psi"] * jnp.cos(q["theta"])) ** 2 / 4 + spin(q, qdot) ** 2 / 2
    return 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2 + fall**2 + r**2 * turning) - m * g * r * jnp.cos(q["theta"])


def ground(q, qdot, r):
    c, s, fall = jnp.cos(q["psi"]), jnp.sin(q["psi"]), qdot["theta"] * jnp.cos(q["theta"])
    forward, sideways = r * spin(q, qdot), r * fall
    return {"x": qdot["x"] - forward * c - sideways * s, "y": qdot["y"] - forward * s + sideways * c}


COIN, COIN_PARAMS = jl.System(coin, nonholonomic={"ground": ground}), {"m": 0.01, "r": 0.02}
ROLLING = {"psi": 0.0, "theta": 0.0, "phi": 25.0, "x": 0.5, "y": 0.0}
COIN_AT = {"psi": 0.0, "theta": 0.3, "phi": 0.0, "x": 0.0, "y": 0.0}


def rolling_bicycle():
    p = bicycle.params
    q, qdot = bicycle.state(p["v"], p["r_R"], p["r_F"])
    return Steady(bicycle.system, q, p, 0.1, qdot, ("x",))


EXAMPLES = {
    "an oscillator": lambda: Steady(OSCILLATOR, 0.1, {"m": 2.0, "c": 8.0, "b": 0.4}, 1.0),
    "a mass that springs hold against gravity": lambda: Steady(
        jl.System(lambda q, qdot, m, c, g: 0.5 * m * qdot**2 - 0.5 * c * q**2 + m * g * q),
        0.0,
        {"m": 2.0, "c": 100.0, "g": g},
        0.3,
        moved="g",
    ),
    "a rod on a spring under a weight": lambda: Steady(
        jl.System(lambda q, qdot, c, p: 0.5 * qdot**2 - 0.5 * (c - p) * q**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2),
        0.0,
        {"c": 4.0, "p": 5.0, "b": 0.3},
        0.5,
    ),
    "a free mass": lambda: Steady(jl.System(lambda qdot, m: 0.5 * m * qdot**2), 0.0, {"m": 3.0}, 1.0),
    "polar coordinates without a force": lambda: Steady(
        jl.System(lambda q, qdot, m: 0.5 * m * (qdot["x"] ** 2 + q["x"] ** 2 * qdot["phi"] ** 2)), {"x": 2.0, "phi": 0.0}, {"m": 3.0}, 0.5
    ),
    "a car in oil": lambda: Steady(
        jl.System(lambda qdot, m: 0.5 * m * qdot**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2, force=lambda F: F),
        0.0,
        {"m": 1.0, "b": 3.0, "F": 5.0},
        0.5,
        1.0,
        moved="F",
    ),
    "a car on wheels": lambda: Steady(
        jl.System(lambda qdot, m: 0.5 * m * qdot["x"] ** 2, force=jl.virtual_work(lambda q, r: -q["x"] / r, lambda M0: -M0)),
        {"x": 0.0},
        {"m": 10.0, "r": 0.5, "M0": 0.0},
        0.5,
        moved="M0",
    ),
    "storeys": storeys,
    "an absorber": absorber,
    "a pendulum in air": in_air,
    "a pendulum in polar coordinates": in_polar_coordinates,
    "a pendulum upright": upright,
    "a pendulum on a square constraint": on_a_square,
    "a pendulum by substitution": substituted,
    "a double pendulum": double_pendulum,
    "a column": column,
    "half a car": half_car,
    "a learnt potential": learnt_potential,
    "a learnt dissipation": learnt_dissipation,
    "an oscillator that sticks": stuck_oscillator,
    "a block that sticks": block,
    "an oscillator that slips": slipping_oscillator,
    "a pendulum that sticks": measured_pendulum,
    "a pendulum under a signal": without_dry_friction,
    "states": servo,
    "a spring and a damper in series": spring_and_damper_in_series,
    "a motor with a lag": lagging_motor,
    "a digital servo": digital_servo,
    "a digital servo that sticks": lambda: digital_servo(DRY, "goal"),
    "a cart with a controller": sampled_cart,
    "four bars": four_bar,
    "a platform on redundant arms": platform,
    "a block on the floor": on_the_floor,
    "a mass on a circle": free_on_a_circle,
    "a rack without mass": geared,
    "a joint without mass": massless_joint,
    "the vehicle": driven_vehicle,
    "a bead": bead,
    "a bead on a turned hoop": bead_on_a_turned_hoop,
    "a rolling coin": rolling_coin,
    "the bicycle": rolling_bicycle,
}
SLOW = ("four bars", "a platform on redundant arms", "a rolling coin", "the bicycle")
SLOW_MOVING = ("a block that slides", "a crank", "a coin that leans", "a pendulum under a torque")


def flat(*trees):
    return np.asarray(ravel_pytree(trees)[0], float)


def steady_state(example: Steady):
    system, q, params = example[:3]
    if example.qdot is None:
        return jl.equilibrium(system, q, params, states=example.states, fixed=example.fixed)
    return jl.steady(system, q, example.qdot, params, states=example.states, fixed_rates=example.fixed)


def simulated_from(example: Steady, at, of_first_order, time) -> Callable:
    """(q, q̇, z, sampled states, λ) at the end of a motion that begins beside a steady state."""
    pick = lambda states, first: {name: value for name, value in states.items() if (name in of_first_order) == first}
    whole, unravel = ravel_pytree((at.q, at.qdot, pick(at.states, True), pick(at.states, False)))

    def end(step, u=0.0):
        q, qdot, z, sampled = unravel(whole + step)
        params = example.params | ({} if example.moved is None else {example.moved: example.params[example.moved] + u})
        motion = jl.simulate(example.system, q, qdot, np.array([0.0, time]), params, states=z | sampled, **SHARP)
        last = jax.tree.map(lambda x: x[-1], (motion.q, motion.qdot, motion.states, motion.multipliers))
        states = last[2] or {}
        return flat(*last[:2], pick(states, True)), flat(pick(states, False)), flat(last[3])

    return end


def differences(end, directions):
    """Of what is at the end, by each of the starts: one column each."""
    pairs = [(end(SMALL * step, SMALL * u), end(-SMALL * step, -SMALL * u)) for step, u in directions]
    return [np.stack([(more[i] - less[i]) / (2 * SMALL) for more, less in pairs], axis=1) for i in range(3)]


def predicted(linear, time):
    """x after some time, and after one sample more, by x and by an input of 1 at the start."""
    A, B = np.asarray(linear.A), np.asarray(linear.B)
    both = np.block([[A, B], [np.zeros((B.shape[1], len(A))), np.eye(B.shape[1]) if linear.sample_time else np.zeros(2 * B.shape[1:])]])
    if linear.sample_time is None:
        after = expm(both * time)
        return after[: len(A)], after[: len(A)]
    steps = round(time / float(linear.sample_time))
    return tuple(np.linalg.matrix_power(both, k)[: len(A)] for k in (steps, steps + 1))


def compare(example: Steady):
    """What `linearise` predicts and what differences of motions show, as pairs."""
    at = steady_state(example)
    inputs = () if example.moved is None else (example.moved,)
    linear = jl.linearise(example.system, at, params=example.params, inputs=inputs)
    first = [name for name, state in example.system.states if isinstance(state, jl.State)]
    basis, forces = np.asarray(linear.basis), np.asarray(linear.constraint_forces)
    held = flat({name: value for name, value in at.states.items() if name not in first})
    x, then = predicted(linear, example.time)
    d = len(linear.A) - held.size  # of these the last are sampled states
    starts = np.block([[basis[:, :d], np.zeros((len(basis), held.size))], [np.zeros((held.size, d)), np.eye(held.size)]])
    directions = [(column, 0.0) for column in starts.T] + [(np.zeros(len(starts)), 1.0)] * len(inputs)
    whole, sampled, multipliers = differences(simulated_from(example, at, first, example.time), directions)
    by_state = slice(0, len(linear.A))  # λ may depend on an input directly, which Λ does not say
    return {
        "state": (whole, basis @ x),
        "sampled": (sampled, then[d:]),
        "multipliers": (multipliers[:, by_state], (forces @ x)[:, by_state]),
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in EXAMPLES])
def test_motions_beside_the_steady_one(name):
    """Each independent coordinate, velocity and state is moved a little, an input too, and the full system simulated from there."""
    for what, (seen, expected) in compare(EXAMPLES[name]()).items():
        np.testing.assert_allclose(seen, expected, rtol=0, atol=SHOWN * np.abs(expected).max(initial=0.0) + DUST, err_msg=what)


# Motions that are not steady: δ = T(t) x, ẋ = A(t) x


class Moving(NamedTuple):
    """A system, the start of a motion, and how long it takes."""

    system: jl.System
    q: Any
    qdot: Any
    params: dict
    time: float


def block_that(dissipation):
    system = jl.System(lambda qdot, m: 0.5 * m * qdot["x"] ** 2, dissipation=dissipation)
    return Moving(system, {"x": 0.0}, {"x": 4.0}, {"m": 2.0, "mu": 0.2, "k": 0.8}, 0.5)


def turning_crank():
    loop = lambda q, a, b, c, d: a * e(q["alpha"]) + b * e(q["beta"]) - d * e(0.0) - c * e(q["gamma"])
    system, params = jl.System(bars, holonomic={"loop": loop}), {"a": 1.0, "b": 3.0, "c": 2.5, "d": 3.0, "rho": 1.0}
    guess, turning = {"alpha": 0.0, "beta": 1.0, "gamma": 2.0}, {"alpha": 5.0, "beta": 0.0, "gamma": 0.0}
    return Moving(system, *jl.consistent_state(system, guess, turning, params, fixed=("alpha",)), params, 0.2)


def leaning_coin():
    return Moving(COIN, *jl.consistent_state(COIN, COIN_AT, ROLLING, COIN_PARAMS, fixed=("phi",)), COIN_PARAMS, 0.05)


def driven_by_sines():
    drive = lambda t, A, T: A @ jnp.sin(2 * jnp.pi * t / T)
    net = jl.learnt.PassiveDissipation(scale=0.1, power=0.5, width=8, depth=1, key=jax.random.key(0))
    system = jl.System(lambda qdot, m: 0.5 * m * qdot**2, dissipation=lambda qdot, net: net(qdot), force=drive)
    return Moving(system, 0.0, 0.5, {"m": 2.0, "A": np.array([5.0, 2.5]), "T": np.array([2.0, 0.7]), "net": net}, 0.05)


def driven_pendulum():
    torque = jl.Signal(np.linspace(0.0, 1.0, 11), np.sin(5 * np.linspace(0.0, 1.0, 11)), jl.interpolation.Cubic())
    return Moving(MEASURED, 1.0, 3.0, MEASURED_PARAMS | {"u": torque}, 0.1)


def pushed_cart():
    push = jl.Signal([0.0, 1.0, 2.0], [1.0, -1.0, 0.0])
    return Moving(jl.System(lambda qdot: 0.5 * qdot**2, force=lambda t, u: u(t)), 0.0, 0.0, {"u": push}, 1.5)


MOVING = {
    "a block that slides": lambda: block_that({"plane": lambda qdot, mu, m: mu * m * g * jnp.abs(qdot["x"])}),
    "a block in air": lambda: block_that({"air": lambda qdot, k: k * jnp.abs(qdot["x"]) ** 3 / 3}),
    "a crank": turning_crank,
    "a coin that leans": leaning_coin,
    "a drive by sines": driven_by_sines,
    "a pendulum under a torque": driven_pendulum,
    "a fall": lambda: Moving(jl.System(lambda q, qdot: 0.5 * qdot**2 - g * q), 0.0, 0.0, {}, 1.0),
    "a cart under a signal": pushed_cart,
}


def carried_along(A, h):
    """Φ of ẋ = A(t) x over equal steps of 2h by Runge and Kutta's scheme, of which each needs three samples of A."""
    Phi = np.eye(A.shape[1])
    for first, middle, last in zip(A[:-1:2], A[1::2], A[2::2], strict=True):
        k1 = first @ Phi
        k2 = middle @ (Phi + h * k1)
        k3 = middle @ (Phi + h * k2)
        k4 = last @ (Phi + 2 * h * k3)
        Phi = Phi + h / 3 * (k1 + 2 * k2 + 2 * k3 + k4)
    return Phi


def compare_along(example: Moving):
    system, q, qdot, params, time = example
    ts = np.linspace(0.0, time, 401)
    motion = jl.simulate(system, q, qdot, ts, params, **SHARP)
    linear = jl.linearise(system, motion, params=params)
    start, unravel = ravel_pytree(jax.tree.map(lambda x: x[0], (motion.q, motion.qdot)))

    def end(step):
        seen = jl.simulate(system, *unravel(start + step), ts[[0, -1]], params, **SHARP)
        return flat(jax.tree.map(lambda x: x[-1], (seen.q, seen.qdot)))

    T = np.asarray(linear.basis)
    seen = np.stack([(end(SMALL * column) - end(-SMALL * column)) / (2 * SMALL) for column in T[0].T], axis=1)
    return seen, T[-1] @ carried_along(np.asarray(linear.A), time / 400)


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW_MOVING)) for name in MOVING])
def test_motions_beside_one_that_is_not_steady(name):
    """What is moved at the start arrives as A says along the motion."""
    seen, expected = compare_along(MOVING[name]())
    np.testing.assert_allclose(seen, expected, rtol=0, atol=SHOWN * np.abs(expected).max())
