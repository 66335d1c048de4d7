"""Machines: those of `jaxlag.examples` and of the notebooks, as cases whose numbers are those of their makers."""

import inspect
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from generate import Case, Term

from jaxlag import dissipation, rigid
from jaxlag.examples import bicycle, pendulum, stribeck, vehicle


def _flat(x):
    return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(x)]) if isinstance(x, dict) else x


def term(f: Callable, coordinates: tuple[str, ...], is_force: bool = False) -> Term:
    """A function of q and q̇ by the names of coordinates and of parameters, as one of flat ones."""
    asked = list(inspect.signature(f).parameters)

    def flat(t, q, v, p):
        named = lambda x: None if x is None else {name: x[i] for i, name in enumerate(coordinates)}
        given = {"t": t, "q": named(q), "qdot": named(v), "params": p}
        found = f(*(given[name] if name in given else p[name] for name in asked))
        if is_force:
            return jnp.stack([jnp.asarray(found.get(name, 0.0), q.dtype) for name in coordinates])
        return _flat(found)

    return Term(flat)


def machine(name, coordinates, q0, qdot0, params, lagrangian, *, seconds=4.0, restitution=None, **slots) -> Case:
    """A case of functions by name, and of states by coordinate, for some seconds."""
    energies = {"lagrangian": {"energy": lagrangian}}
    terms = {
        slot: {key: term(f, coordinates, slot == "force") for key, f in named.items()} for slot, named in {**energies, **slots}.items()
    }
    at = lambda state: np.array([float(state[c]) for c in coordinates])
    return Case(name, terms, at(q0), at(qdot0), params, restitution=restitution, ts=np.arange(17) * seconds / 16)


# Those of `jaxlag.examples`


def polar_pendulum():
    return machine(
        "polar pendulum", ("r", "phi"), *pendulum.polar_state(1.0, 0.5, 1.0), pendulum.params, pendulum.polar_lagrangian,
        holonomic={"rod": pendulum.polar_rod},
    )  # fmt: skip


def cartesian_pendulum():
    return machine(
        "Cartesian pendulum", ("x", "y"), *pendulum.cartesian_state(1.0, 0.5, 1.0), pendulum.params, pendulum.cartesian_lagrangian,
        holonomic={"rod": pendulum.cartesian_rod},
    )  # fmt: skip


WITH_AIR = {"dampers": vehicle.dampers, "air": vehicle.air}


def the_vehicle():
    return machine(
        "vehicle", ("x", "y", "phi"), vehicle.q0, vehicle.qdot0, vehicle.params, vehicle.lagrangian, dissipation=WITH_AIR,
        force={"drive": vehicle.drive},
    )  # fmt: skip


PARTS = ("x", "y", "phi", "x2", "phi2", "x3", "phi3", "y2", "y3")


def bindings(q, r, a):
    """All of them as one vector."""
    return jnp.stack([f(q, r if name.endswith("rolling") else a) for name, f in vehicle.bindings.items()])


def vehicle_in_parts():
    """With the forces between the parts."""
    p = vehicle.params
    all_parts = vehicle.parts(vehicle.q0, p["r"], p["a"])
    return machine(
        "vehicle in parts", PARTS, all_parts, dict.fromkeys(PARTS, 0.0), p, vehicle.full_lagrangian,
        dissipation={"dampers": vehicle.full_dampers, "air": vehicle.air}, force={"drive": lambda M0: {"phi3": -M0}},
        holonomic={"bindings": bindings},
    )  # fmt: skip


def the_bicycle():
    q, v = bicycle.state(bicycle.params["v"], bicycle.params["r_R"], bicycle.params["r_F"])
    return machine(
        "bicycle", bicycle.COORDINATES, q, v | {"roll": 0.3, "y": 0.09}, bicycle.params, bicycle.lagrangian, seconds=2.0,
        holonomic={"contact": bicycle.contacts}, nonholonomic={"rolling": bicycle.slip},
    )  # fmt: skip


def stribeck_drive():
    """With the curve that the recording was made of, as a force."""
    friction = lambda qdot: {"x": -stribeck.true_friction(qdot["x"])}
    params = {"m": 2.0, "A": np.array([5.0, 2.5]), "T": np.array([2.0, 0.7])}
    return machine(
        "Stribeck drive", ("x",), {"x": 0.0}, {"x": 0.0}, params, lambda qdot, m: 0.5 * m * qdot["x"] ** 2,
        force={"drive": lambda t, A, T: {"x": stribeck.drive(t, A, T)}, "friction": friction},
    )  # fmt: skip


# Those of the notebooks


def coin():
    """Notebook 7: it rolls on a table, upright or leaning."""
    spin = lambda q, qdot: qdot["phi"] + qdot["psi"] * jnp.sin(q["theta"])

    def energy(q, qdot, m, r, g):
        fall = r * jnp.sin(q["theta"]) * qdot["theta"]
        turning = qdot["theta"] ** 2 / 4 + (qdot["psi"] * jnp.cos(q["theta"])) ** 2 / 4 + spin(q, qdot) ** 2 / 2
        return 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2 + fall**2 + r**2 * turning) - m * g * r * jnp.cos(q["theta"])

    def ground(q, qdot, r):
        c, s, fall = jnp.cos(q["psi"]), jnp.sin(q["psi"]), qdot["theta"] * jnp.cos(q["theta"])
        forward, sideways = r * spin(q, qdot), r * fall
        return jnp.stack([qdot["x"] - forward * c - sideways * s, qdot["y"] - forward * s + sideways * c])

    names = ("psi", "theta", "phi", "x", "y")
    q0, v0 = dict.fromkeys(names, 0.0) | {"theta": 0.2}, dict.fromkeys(names, 0.0) | {"phi": 25.0, "x": 0.5}
    params = {"m": 0.01, "r": 0.02, "g": 9.81}
    return machine("coin", names, q0, v0, params, energy, seconds=1.0, nonholonomic={"ground": ground})


def follower_column():
    """Notebook 14: two rods under a force that follows the upper one."""

    def energy(q, qdot, m, l, k):
        turning = 2 * qdot["a"] ** 2 + qdot["b"] ** 2 + 2 * qdot["a"] * qdot["b"] * jnp.cos(q["a"] - q["b"])
        return 0.5 * m * l**2 * (turning + qdot["a"] ** 2) - 0.5 * k * (q["a"] ** 2 + (q["b"] - q["a"]) ** 2)

    dampers = lambda qdot, b1, b2: 0.5 * b1 * qdot["a"] ** 2 + 0.5 * b2 * (qdot["b"] - qdot["a"]) ** 2
    load = lambda q, P, l: {"a": P * l * jnp.sin(q["a"] - q["b"])}
    params = {"m": 1.0, "l": 1.0, "k": 1.0, "b1": 0.1, "b2": 0.1, "P": 1.0}
    start = {"a": 0.1, "b": -0.05}, {"a": 0.0, "b": 0.1}
    return machine("follower column", ("a", "b"), *start, params, energy, dissipation={"dampers": dampers}, force={"load": load})


def viscoelastic():
    """Notebook 16: a Zener solid that carries a mass; z has no inertia."""
    energy = lambda q, qdot, m, E, c: 0.5 * m * qdot["x"] ** 2 - 0.5 * E * q["x"] ** 2 - 0.5 * c * (q["x"] - q["z"]) ** 2
    dashpot = lambda qdot, b: 0.5 * b * qdot["z"] ** 2
    start = {"x": 0.1, "z": 0.05}, {"x": 0.0, "z": 80 * 0.05 / 60}
    return machine(
        "Zener solid", ("x", "z"), *start, {"m": 3.0, "E": 120.0, "c": 80.0, "b": 60.0}, energy, dissipation={"dashpot": dashpot}
    )


def belt():
    """Notebook 6: an oscillator on a belt whose friction falls with the speed."""
    energy = lambda q, qdot, m, c: 0.5 * m * qdot["x"] ** 2 - 0.5 * c * q["x"] ** 2
    rubbing = lambda qdot, v_b, F_c, F_s, v_s: dissipation.stribeck(qdot["x"] - v_b, F_c, F_s, v_s)
    params = {"m": 1.0, "c": 50.0, "v_b": 0.2, "F_c": 2.0, "F_s": 3.0, "v_s": 0.05}
    return machine("belt", ("x",), {"x": 0.0}, {"x": 0.1}, params, energy, dissipation={"belt": rubbing})


def ball():
    """Notebook 15: it bounces, in still air."""
    energy = lambda q, qdot, m, g: 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2) - m * g * q["y"]
    air = lambda qdot, k: 0.5 * k * (qdot["x"] ** 2 + qdot["y"] ** 2)
    params = {"m": 0.1, "g": 9.81, "restitution": 0.8, "k": 0.01}
    return machine(
        "ball", ("x", "y"), {"x": 0.0, "y": 1.0}, {"x": 0.5, "y": 0.0}, params, energy, seconds=2.0, dissipation={"air": air},
        unilateral={"floor": lambda q: q["y"]}, restitution="restitution",
    )  # fmt: skip


def gyroscope():
    """Notebook 17: a heavy top, in Euler angles."""
    turned = lambda q: rigid.euler("zxz")([q["psi"], q["theta"], q["phi"]])

    def energy(q, qdot, m, g, l, A, C):
        centre = lambda q: l * turned(q)[:, 2]
        return rigid.kinetic_energy(m, [A, A, C], centre, turned)(q, qdot) - m * g * centre(q)[2]

    params = {"m": 0.5, "g": 9.81, "l": 0.08, "A": 4.5e-4, "C": 9e-4}
    start = {"psi": 0.1, "theta": 1.0, "phi": 0.2}, {"psi": 0.0, "theta": 0.0, "phi": 100.0}
    return machine("gyroscope", ("psi", "theta", "phi"), *start, params, energy, seconds=0.5)


def gyroscope_in_quaternions():
    """The same top at the same state, in the four numbers of a quaternion."""
    angles, names = gyroscope(), ("w", "x", "y", "z")
    place = rigid.to_quaternion(rigid.euler("zxz")(list(angles.q0)))
    rate = rigid.quaternion_rate(place, rigid.angular_velocity(rigid.euler("zxz"))(list(angles.q0), list(angles.qdot0)))
    numbers = lambda q: jnp.stack([q[name] for name in names])
    turned = lambda q: rigid.quaternion(numbers(q))

    def energy(q, qdot, m, g, l, A, C):
        centre = lambda q: l * turned(q)[:, 2]
        return rigid.kinetic_energy(m, [A, A, C], centre, turned)(q, qdot) - m * g * centre(q)[2]

    start = (dict(zip(names, np.asarray(x), strict=True)) for x in (place, rate))
    length = {"length": lambda q: rigid.unit(numbers(q))}
    return machine("gyroscope in quaternions", names, *start, angles.params, energy, seconds=0.5, holonomic=length)


def four_bar():
    """Notebook 5: three bars in a loop."""
    e = lambda angle: jnp.stack([jnp.cos(angle), jnp.sin(angle)])

    def energy(q, qdot, a, b, c, rho):
        turn = lambda name: qdot[name] * jnp.stack([-jnp.sin(q[name]), jnp.cos(q[name])])
        rates = [a / 2 * turn("alpha"), a * turn("alpha") + b / 2 * turn("beta"), c / 2 * turn("gamma")]
        bars = zip((a, b, c), rates, ("alpha", "beta", "gamma"), strict=True)
        return 0.5 * rho * sum(l * (v @ v + (l * qdot[name]) ** 2 / 12) for l, v, name in bars)

    loop = lambda q, a, b, c, d: a * e(q["alpha"]) + b * e(q["beta"]) - c * e(q["gamma"]) - d * e(0.0)
    a, b, c, d = 1.0, 3.0, 2.5, 3.0
    alpha, x = 1.0, np.array([d, 0.0]) - a * np.array([np.cos(1.0), np.sin(1.0)])
    r = np.hypot(*x)  # from the crank's end to the fixed joint: b and c meet over it
    beta = np.arctan2(x[1], x[0]) + np.arccos((r**2 + b**2 - c**2) / (2 * r * b))
    tip = b * np.array([np.cos(beta), np.sin(beta)]) - x
    start = {"alpha": alpha, "beta": beta, "gamma": np.arctan2(tip[1], tip[0])}
    params = {"a": a, "b": b, "c": c, "d": d, "rho": 1.0}
    return machine(
        "four-bar linkage", ("alpha", "beta", "gamma"), start, {"alpha": 3.0, "beta": 0.0, "gamma": 0.0}, params, energy,
        holonomic={"loop": loop},
    )  # fmt: skip


MACHINES = {
    make().kind: make
    for make in (
        polar_pendulum, cartesian_pendulum, the_vehicle, vehicle_in_parts, the_bicycle, stribeck_drive, coin, follower_column,
        viscoelastic, belt, ball, gyroscope, gyroscope_in_quaternions, four_bar,
    )
}  # fmt: skip
