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

COORDINATES = ("x", "y", "z", "yaw", "roll", "pitch", "steer", "rear", "front")
X, Y, Z = ONE = np.eye(3)
CROSS = np.cross(ONE[:, None], ONE).transpose(2, 1, 0)  # CROSS @ a is the matrix [a]× of the cross product a × …


def rotation(axis, angle):
    """Rodrigues' formula: 1 + sin α [a]× + (1 − cos α) [a]×²."""
    K = CROSS @ axis
    return ONE + jnp.sin(angle) * K + (1 - jnp.cos(angle)) * (K @ K)


def parts(q, params):
    """Frames R_B and R_H, and the centres of mass of the rear wheel, the rear frame, the front frame and the front wheel."""
    p = params
    R_B = rotation(Z, q["yaw"]) @ rotation(X, q["roll"]) @ rotation(Y, q["pitch"])
    R_H = R_B @ rotation(jnp.sin(p["lambda_"]) * X + jnp.cos(p["lambda_"]) * Z, q["steer"])
    R = q["x"] * X + q["y"] * Y + q["z"] * Z
    B = R + R_B @ (p["x_B"] * X + (p["z_B"] + p["r_R"]) * Z)
    hinge = R + R_B @ ((p["w"] + p["c"]) * X + p["r_R"] * Z)  # where the steering axis would meet the ground
    H = hinge + R_H @ ((p["x_H"] - p["w"] - p["c"]) * X + p["z_H"] * Z)
    F = hinge - R_H @ (p["c"] * X + p["r_F"] * Z)
    return (R_B, R_H), (R, B, H, F)


def angular_velocity(R, Rdot):
    """ω in the axes of the frame R: [ω]× = Rᵀ Ṙ."""
    return 0.5 * jnp.einsum("ijk,ij", CROSS, R.T @ Rdot)


def lagrangian(q, qdot, params):
    """T − V of the four parts; the inertia of a wheel in the axes of its frame stays the same as it turns."""
    p, (frames, centres), (rates, velocities) = params, parts(q, params), jl.rate(parts)(0.0, q, qdot, params)
    w_B, w_H = map(angular_velocity, frames, rates)
    spins = w_B + qdot["rear"] * Y, w_B, w_H, w_H + qdot["front"] * Y
    L = 0.0
    for part, x, v, w in zip("RBHF", centres, velocities, spins, strict=True):
        m, I = p[f"m_{part}"], inertia(part, p)
        L += 0.5 * m * v @ v + 0.5 * w @ I @ w + m * p["g"] * x @ Z
    return L


def inertia(part, p):
    """Moments of inertia about the centre of mass; a wheel has I_zz = I_xx and I_xz = 0."""
    I = lambda axes, otherwise: p.get(f"I_{part}{axes}", otherwise)
    xx, xz = I("xx", None), I("xz", 0.0)
    return xx * np.outer(X, X) + I("yy", None) * np.outer(Y, Y) + I("zz", xx) * np.outer(Z, Z) + xz * (np.outer(X, Z) + np.outer(Z, X))


def wheels(q, params):
    """Of both wheels, the centre, the frame, and ρ from the centre to the lowest point."""
    (R_B, R_H), (R, _, _, F) = parts(q, params)
    for x, frame, r in ((R, R_B, params["r_R"]), (F, R_H, params["r_F"])):
        n = frame @ Y
        across = Z - (n @ Z) * n
        yield x, frame, r * across / jnp.sqrt(across @ across)


def contacts(q, params):
    """Heights of the lowest points of the wheels below the ground, g."""
    (R, _, rear), (F, _, front) = wheels(q, params)
    return {"rear": Z @ (R + rear), "front": Z @ (F + front)}


def slip(q, qdot, params):
    """Velocities along the ground of the material points that touch it, a."""
    rates, (R, _, _, F) = jl.rate(parts)(0.0, q, qdot, params)
    along = {}
    names = zip(("rear", "front"), wheels(q, params), rates, (R, F), strict=True)
    for name, (_, frame, down), rate, v in names:
        w = frame @ (angular_velocity(frame, rate) + qdot[name] * Y)
        along[name] = ONE[:2] @ (v + (CROSS @ w) @ down)
    return along


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
