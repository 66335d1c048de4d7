"""The lecture's vehicle: a body on two wheels with spring-damper struts, a driven wheel, and wind.

Coordinates x, y, φ; wheels at x ± a, rolling: φ₂ = −(x − a)/r, φ₃ = −(x + a)/r; strut ends at y ∓ aφ:

    L = ½M(ẋ² + ẏ²) + ½Θ_s φ̇² + (m + Θ_r/r²)ẋ² − M g y − ½c(y − aφ − l)² − ½c(y + aφ − l)²
    D = ½b(ẏ − aφ̇)² + ½b(ẏ + aφ̇)² + ⅓k|ẋ + v|³
    δW = −M₀ δφ₃, so Q_x = M₀/r

Three ways to the same motion: `system` is that reduced form; `substituted` is the full Lagrangian in the body's x, y, φ, the
wheels' x₂, φ₂, x₃, φ₃ and the strut ends' y₂, y₃, with six of them expressed by the others; `first_kind` keeps all nine
coordinates and treats the six equations as constraints, whose multipliers are the forces between the parts.
"""

from pathlib import Path
from typing import Any

import jax.numpy as jnp

import jaxlag as jl


def lagrangian(q, qdot, M, m, Theta_s, Theta_r, r, a, c, l, g):
    """T − V of body, wheels and springs."""
    body = 0.5 * M * (qdot["x"] ** 2 + qdot["y"] ** 2) + 0.5 * Theta_s * qdot["phi"] ** 2 - M * g * q["y"]
    wheels = (m + Theta_r / r**2) * qdot["x"] ** 2
    rear, front = q["y"] - a * q["phi"] - l, q["y"] + a * q["phi"] - l
    return body + wheels - 0.5 * c * rear**2 - 0.5 * c * front**2


def dampers(qdot, b, a):
    """½b v² of both struts."""
    return 0.5 * b * (qdot["y"] - a * qdot["phi"]) ** 2 + 0.5 * b * (qdot["y"] + a * qdot["phi"]) ** 2


def air(qdot, k, v):
    """⅓k|ẋ + v|³, with a head wind v."""
    return k * jnp.abs(qdot["x"] + v) ** 3 / 3


def drive(M0, r):
    """Generalized force of the wheel moment M₀."""
    return {"x": M0 / r}


system = jl.System(lagrangian, dissipation={"dampers": dampers, "air": air}, force={"drive": drive})


def full_lagrangian(q, qdot, M, m, Theta_s, Theta_r, c, l, g):
    """T − V of the separate parts; the strut ends y₂, y₃ are massless."""
    body = 0.5 * M * (qdot["x"] ** 2 + qdot["y"] ** 2) + 0.5 * Theta_s * qdot["phi"] ** 2 - M * g * q["y"]
    rear = 0.5 * m * qdot["x2"] ** 2 + 0.5 * Theta_r * qdot["phi2"] ** 2 - 0.5 * c * (q["y2"] - l) ** 2
    front = 0.5 * m * qdot["x3"] ** 2 + 0.5 * Theta_r * qdot["phi3"] ** 2 - 0.5 * c * (q["y3"] - l) ** 2
    return body + rear + front


def full_dampers(qdot, b):
    """½b v² of both struts."""
    return 0.5 * b * qdot["y2"] ** 2 + 0.5 * b * qdot["y3"] ** 2


def parts(q, r, a):
    """The full coordinates from x, y, φ: the constraint equations between the parts (Bindungsgleichungen), solved."""
    x2, x3 = q["x"] - a, q["x"] + a
    struts = {"y2": q["y"] - a * q["phi"], "y3": q["y"] + a * q["phi"]}
    return {**q, **struts, "x2": x2, "x3": x3, "phi2": -x2 / r, "phi3": -x3 / r}


drive_moment = jl.virtual_work(lambda q: q["phi3"], lambda M0: -M0)  # δW = −M₀ δφ₃
bindings = {
    "rear axle": lambda q, a: q["x2"] - q["x"] + a,
    "front axle": lambda q, a: q["x3"] - q["x"] - a,
    "rear strut": lambda q, a: q["y2"] - q["y"] + a * q["phi"],
    "front strut": lambda q, a: q["y3"] - q["y"] - a * q["phi"],
    "rear rolling": lambda q, r: q["phi2"] + q["x2"] / r,
    "front rolling": lambda q, r: q["phi3"] + q["x3"] / r,
}
full_terms: dict[str, Any] = {"dissipation": {"dampers": full_dampers, "air": air}, "force": {"drive": drive_moment}}
substituted = jl.substitute(jl.System(full_lagrangian, **full_terms), parts)
first_kind = jl.System(full_lagrangian, **full_terms, holonomic=bindings)

params = {
    "M": 1000.0,  # kg, body
    "m": 30.0,  # kg, a wheel
    "Theta_s": 1500.0,  # kg m², body about its centre
    "Theta_r": 1.0,  # kg m², a wheel about its axle
    "r": 0.3,  # m, wheel radius
    "a": 1.3,  # m, half the wheelbase
    "c": 40000.0,  # N/m, a spring
    "b": 3000.0,  # N s/m, a damper
    "k": 0.6,  # kg/m, air drag
    "l": 0.5,  # m, free length of a spring
    "v": 5.0,  # m/s, head wind
    "M0": 300.0,  # N m, moment on the driven wheel
    "g": 9.81,  # m/s²
}
q0 = {"x": 0.0, "y": 0.55, "phi": 0.05}  # m, m, rad
qdot0 = {"x": 0.0, "y": 0.0, "phi": 0.0}

# A recorded drive: t, y, phi, xdot with noise 1e-3, made by SciPy from the equations derived by hand (tests/data/make_drive.py).
recording = Path(__file__).with_name("vehicle_drive.csv")


def observe(q, qdot):
    """The measured channels: heave, pitch and speed."""
    return {"y": q["y"], "phi": q["phi"], "xdot": qdot["x"]}
