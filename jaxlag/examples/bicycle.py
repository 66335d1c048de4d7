"""The Whipple bicycle: two frames that a steering hinge joins, on two thin wheels that roll without slip.

x forward, y to the right, z down; the centre (x, y, z) of the rear wheel, yaw, roll and pitch of the rear frame, the steering angle and the
rotations of the wheels are nine coordinates. `bodies` gives the frames of the four parts as functions of these, from which `rigid` makes

    T = Σ ½m ẋ·ẋ + ½ω·Iω,   g = h − r √(1 − (n·e)²),   a = ẋ + ω × ρ along the road,   ρ = −r (n − (n·e) e)/√(1 − (n·e)²)

with n, the normal of the road, and e, the axle of a wheel: two holonomic and four nonholonomic constraints. Nothing is linearised here.

The parameters have the names and the values of the benchmark of Meijaard, Papadopoulos, Ruina & Schwab, Linearized dynamics equations for
the balance and steer of a bicycle: a benchmark and review, Proc. R. Soc. A 463 (2007) 1955-1982, table 1. Positions and moments of inertia
are those of the upright bicycle, with the origin at the rear contact. Between 4.29 and 6.02 m/s it stays upright by itself.
"""

import jax.numpy as jnp
import numpy as np

import jaxlag as jl
from jaxlag import rigid

COORDINATES = ("x", "y", "z", "yaw", "roll", "pitch", "steer", "rear", "front")
AXLE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # axes of a wheel: the third, its axle, to the right
UP = np.diag([1.0, -1.0, -1.0])  # axes of the road: the third up


def bodies(q, p):
    """Frames at the centres of mass of the rear wheel, the rear frame with the rider, the front frame, the front wheel."""
    rear = rigid.frame([q["x"], q["y"], q["z"]], rigid.euler("zxy")([q["yaw"], q["roll"], q["pitch"]]))
    hinge = [jnp.sin(p["lambda_"]), 0.0, jnp.cos(p["lambda_"])]
    front = rear.on([p["w"] + p["c"], 0.0, p["r_R"]], rigid.rotation(hinge, q["steer"]))
    return {
        "R": rear.on(axes=AXLE).on(axes=rigid.rotation_z(q["rear"])),
        "B": rear.on([p["x_B"], 0.0, p["z_B"] + p["r_R"]]),
        "H": front.on([p["x_H"] - p["w"] - p["c"], 0.0, p["z_H"]]),
        "F": front.on([-p["c"], 0.0, -p["r_F"]], AXLE).on(axes=rigid.rotation_z(q["front"])),
    }


def inertias(p):
    """Moments of inertia about the centres of mass; for a wheel, about two diameters and its axle."""
    I = lambda part: jnp.array([[p[f"I_{part}xx"], 0, p[f"I_{part}xz"]], [0, p[f"I_{part}yy"], 0], [p[f"I_{part}xz"], 0, p[f"I_{part}zz"]]])
    wheel = lambda part: [p[f"I_{part}xx"], p[f"I_{part}xx"], p[f"I_{part}yy"]]
    return {"R": wheel("R"), "B": I("B"), "H": I("H"), "F": wheel("F")}


def lagrangian(q, qdot, params):
    """T − V of the four parts."""
    m = {part: params[f"m_{part}"] for part in "RBHF"}
    T = rigid.kinetic_energy(m, inertias(params), lambda q: bodies(q, params))(q, qdot)
    return T + params["g"] * sum(m[part] * body.origin[2] for part, body in bodies(q, params).items())


def contacts(q, params):
    """Heights of the wheels over the road, g."""
    at, road = bodies(q, params), rigid.frame(axes=UP)
    return {"rear": rigid.wheel_height(at["R"], params["r_R"], road), "front": rigid.wheel_height(at["F"], params["r_F"], road)}


def slip(q, qdot, params):
    """Velocities a, along the road, of the wheels' points that touch it."""
    wheel = lambda part: rigid.rolling(lambda q: bodies(q, params)[part], params[f"r_{part}"], rigid.frame(axes=UP))
    return {"rear": wheel("R")(q, qdot), "front": wheel("F")(q, qdot)}


system = jl.System(lagrangian, holonomic={"contact": contacts}, nonholonomic={"rolling": slip})

params = {
    "w": 1.02,  # m, wheelbase
    "c": 0.08,  # m, trail
    "lambda_": np.pi / 10,  # rad, tilt of the steering axis
    "g": 9.81,  # m/s²
    "v": 5.0,  # m/s, forward speed
    "r_R": 0.3,  # m, rear wheel
    "m_R": 2.0,  # kg
    "I_Rxx": 0.0603,  # kg m²
    "I_Ryy": 0.12,
    "x_B": 0.3,  # m, rear frame and rider
    "z_B": -0.9,
    "m_B": 85.0,  # kg
    "I_Bxx": 9.2,  # kg m²
    "I_Byy": 11.0,
    "I_Bzz": 2.8,
    "I_Bxz": 2.4,
    "x_H": 0.9,  # m, front frame: fork and handlebar
    "z_H": -0.7,
    "m_H": 4.0,  # kg
    "I_Hxx": 0.05892,  # kg m²
    "I_Hyy": 0.06,
    "I_Hzz": 0.00708,
    "I_Hxz": -0.00756,
    "r_F": 0.35,  # m, front wheel
    "m_F": 3.0,  # kg
    "I_Fxx": 0.1405,  # kg m²
    "I_Fyy": 0.28,
}


def upright(r_R):
    """q of the upright bicycle that heads along x."""
    return dict.fromkeys(COORDINATES, 0.0 * r_R) | {"z": -r_R}


def rolling(v, r_R, r_F):
    """q̇ of the bicycle that rolls straight on at the speed v."""
    return dict.fromkeys(COORDINATES, 0.0 * v) | {"x": v, "rear": -v / r_R, "front": -v / r_F}


def state(v, r_R, r_F):
    """q and q̇ of the upright bicycle that rolls straight on at the speed v."""
    return upright(r_R), rolling(v, r_R, r_F)
