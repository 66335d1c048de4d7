"""The Whipple bicycle: two frames that a steering hinge joins, on two thin wheels that roll without slip.

x forward, y to the right, z down; the centre (x, y, z) of the rear wheel, yaw, roll and pitch of the rear frame, the steering angle and
the rotations of the wheels are nine coordinates. With the rotation matrices of the rear frame (B and the rider) and the front frame (H)

    R_B = R_z(yaw) R_x(roll) R_y(pitch),   R_H = R_B R_y(λ) R_z(steer) R_y(−λ),   ω = (Rᵀ Ṙ)^∨

each part has T = ½m ẋ·ẋ + ½ω·Iω and V = −m g z. A wheel with its centre at x_W and its axle n touches the ground with its lowest point,

    g = z_W + r √(1 − n_z²),   a = ẋ_W + ω_W × ρ in x and y,   ρ = r (e_z − n_z n)/√(1 − n_z²)

which makes two holonomic and four nonholonomic constraints. Nothing is linearised here.

The parameters have the names and the values of the benchmark of Meijaard, Papadopoulos, Ruina & Schwab, Linearized dynamics equations for
the balance and steer of a bicycle: a benchmark and review, Proc. R. Soc. A 463 (2007) 1955-1982, table 1. Positions and moments of inertia
are those of the upright bicycle, with the origin at the rear contact. Between 4.29 and 6.02 m/s it stays upright by itself.
"""

import jax.numpy as jnp
import numpy as np

import jaxlag as jl
from jaxlag import rigid

COORDINATES = ("x", "y", "z", "yaw", "roll", "pitch", "steer", "rear", "front")
AXLE = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # axes of a wheel, the third to the right
ROAD = rigid.frame(axes=np.diag([1.0, -1, -1]))  # z = 0, the third axis up


def bodies(q, p):
    """Frames at the centres of mass: of the rear wheel, the rear frame, the front frame, the front wheel."""
    rear = rigid.frame([q["x"], q["y"], q["z"]], rigid.euler("zxy")([q["yaw"], q["roll"], q["pitch"]]))
    tilt = rigid.rotation_y(p["lambda_"])
    front = rear.on([p["w"] + p["c"], 0.0, p["r_R"]], tilt @ rigid.rotation_z(q["steer"]) @ tilt.T)
    return {
        "R": rear.on(axes=AXLE).on(axes=rigid.rotation_z(q["rear"])),
        "B": rear.on([p["x_B"], 0.0, p["z_B"] + p["r_R"]]),
        "H": front.on([p["x_H"] - p["w"] - p["c"], 0.0, p["z_H"]]),
        "F": front.on([-p["c"], 0.0, -p["r_F"]], AXLE).on(axes=rigid.rotation_z(q["front"])),
    }


def inertia(part, p):
    """Moments of inertia about the centre of mass."""
    if part in "RF":
        return jnp.stack([p[f"I_{part}{axes}"] for axes in ("xx", "xx", "yy")])
    xx, yy, zz, xz = (p[f"I_{part}{axes}"] for axes in ("xx", "yy", "zz", "xz"))
    return jnp.array([[xx, 0.0, xz], [0.0, yy, 0.0], [xz, 0.0, zz]])


def lagrangian(q, qdot, params):
    m, Theta = ({part: of(part) for part in "RBHF"} for of in (lambda part: params[f"m_{part}"], lambda part: inertia(part, params)))
    T = rigid.kinetic_energy(m, Theta, lambda q: bodies(q, params))(q, qdot)
    return T + params["g"] * sum(m[part] * frame.origin[2] for part, frame in bodies(q, params).items())


def contacts(q, params):
    at = bodies(q, params)
    return {name: rigid.wheel_height(at[part], params[f"r_{part}"], ROAD) for name, part in (("rear", "R"), ("front", "F"))}


def slip(q, qdot, params):
    wheel = lambda part: rigid.rolling(lambda q: bodies(q, params)[part], params[f"r_{part}"], ROAD)(q, qdot)
    return {"rear": wheel("R"), "front": wheel("F")}


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
