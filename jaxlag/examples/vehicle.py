"""The lecture's vehicle: a body on two wheels with spring-damper struts, a driven wheel, and wind.

Coordinates x, y, φ; wheels at x ± a, rolling: φ₂ = −(x − a)/r, φ₃ = −(x + a)/r; strut ends at y ∓ aφ:

    L = ½M(ẋ² + ẏ²) + ½Θ_s φ̇² + (m + Θ_r/r²)ẋ² − M g y − ½c(y − aφ − l)² − ½c(y + aφ − l)²
    D = ½b(ẏ − aφ̇)² + ½b(ẏ + aφ̇)² + ⅓k|ẋ + v|³
    δW = −M₀ δφ₃, so Q_x = M₀/r
"""

from pathlib import Path

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
    """⅓k|ẋ + v|³, against a head wind v."""
    return k * jnp.abs(qdot["x"] + v) ** 3 / 3


def drive(M0, r):
    """Generalized force of the wheel moment M₀."""
    return {"x": M0 / r}


system = jl.System(lagrangian, dissipation={"dampers": dampers, "air": air}, force={"drive": drive})

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
    """What the recording holds: heave, pitch and speed."""
    return {"y": q["y"], "phi": q["phi"], "xdot": qdot["x"]}
