"""The lecture's pendulum: the rod length l as a constraint, in polar and in Cartesian coordinates.

polar      L = ½m(ṙ² + r²φ̇²) + m g r cos φ,   g(r, φ) = r − l,        λ = −m l φ̇² − m g cos φ = −(tension)
Cartesian  L = ½m(ẋ² + ẏ²) − m g y,           g(x, y) = √(x² + y²) − l, with the same λ
"""

import jax.numpy as jnp

import jaxlag as jl


def polar_lagrangian(q, qdot, m, g):
    """L in r and φ, with φ from the vertical downwards."""
    return 0.5 * m * (qdot["r"] ** 2 + q["r"] ** 2 * qdot["phi"] ** 2) + m * g * q["r"] * jnp.cos(q["phi"])


def polar_rod(q, l):
    """g = r − l."""
    return q["r"] - l


def cartesian_lagrangian(q, qdot, m, g):
    """L in x and y, with y upwards."""
    return 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2) - m * g * q["y"]


def cartesian_rod(q, l):
    """g = √(x² + y²) − l."""
    return jnp.hypot(q["x"], q["y"]) - l


polar = jl.System(polar_lagrangian, holonomic={"rod": polar_rod})
cartesian = jl.System(cartesian_lagrangian, holonomic={"rod": cartesian_rod})

params = {"m": 1.0, "l": 1.0, "g": 9.81}  # kg, m, m/s²


def polar_state(phi, phidot, l):
    """q and q̇ at the angle φ with the angular velocity φ̇."""
    return {"r": l, "phi": phi}, {"r": 0.0 * l, "phi": phidot}


def cartesian_state(phi, phidot, l):
    """q and q̇ of that state in x and y."""
    s, c = jnp.sin(phi), jnp.cos(phi)
    return {"x": l * s, "y": -l * c}, {"x": l * c * phidot, "y": l * s * phidot}
