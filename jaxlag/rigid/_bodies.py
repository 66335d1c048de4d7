"""The motion of rigid bodies, from their position and rotation as functions of q alone."""

from collections.abc import Callable
from typing import Any

import jax
from jaxtyping import Array, Float

from ._rates import body_rate
from ._vectors import floating, moving, vector
from .inertia import check_inertia


def angular_velocity(rotation: Callable, axes: str = "body") -> Callable:
    r"""Angular velocity of a body, from its rotation matrix as a function of q alone.

    $$ [\omega]_\times = R^T \dot R \text{ in the axes of the body}, \qquad \dot R R^T \text{ in those of space}, \qquad
       \dot R = \frac{\partial R}{\partial q}\,\dot q $$

    **Arguments:** `rotation`: R(q), which turns components in the axes of the body into those in space; q is any pytree. `axes`: "body"
    or "world", those in which ω is given. R must not depend on the time but through q: a driven angle is a coordinate with a constraint.

    **Returns:** a function of (q, qdot), whose value is ω, of shape (3,).

    **Raises:** `ValueError` where `axes` is neither, or R is no rotation (as far as its numbers are known).

    **Source:** Murray, Li & Sastry, A Mathematical Introduction to Robotic Manipulation, eqs. 2.48 and 2.49.

    ```python
    from jaxlag import rigid
    top = rigid.euler("zxz")
    rigid.angular_velocity(top)([0.0, 0.5, 0.0], [2.0, 0.0, 1.0])  # [0.0, 0.9589, 2.755]
    ```
    """
    if axes not in ("body", "world"):
        raise ValueError(f"`axes` must be 'body' or 'world', but is {axes!r}. The body's make its inertia constant.")

    def velocity(q: Any, qdot: Any) -> Float[Array, "3"]:
        omega = body_rate(rotation, q, qdot)
        return omega if axes == "body" else rotation(jax.tree.map(floating, q)) @ omega

    return velocity


def kinetic_energy(m: Any, Theta: Any, position: Callable, rotation: Callable) -> Callable:
    r"""Kinetic energy of a rigid body.

    $$ T = \tfrac12 m\,\dot x\cdot\dot x + \tfrac12\,\omega\cdot\Theta\,\omega $$

    **Arguments:**

    - `m`: its mass.
    - `Theta`: Θ, its inertia about the centre of mass in the axes of the body, (3, 3), or (3,) about principal axes; `rigid.inertia` has
      those of many bodies.
    - `position`: x(q), the centre of mass, (3,).
    - `rotation`: R(q), which turns components in the axes of the body into those in space.

    **Returns:** a function of (q, qdot), to be added to a Lagrangian. Any consistent units.

    **Raises:** `ValueError` where the inertia is that of no body, or R is no rotation (as far as their numbers are known).

    **Source:** Goldstein, Classical Mechanics, 3rd ed., eqs. 5.1 and 5.19 (König's theorem).

    ```python
    import jaxlag as jl
    from jaxlag import rigid

    def lagrangian(q, qdot, m, g):
        body = rigid.kinetic_energy(m, [0.1, 0.2, 0.3], lambda q: q["x"], lambda q: rigid.quaternion(q["p"]))
        return body(q, qdot) - m * g * q["x"][2]

    stone = jl.System(lagrangian, holonomic={"unit": lambda q: rigid.unit(q["p"])})
    ```
    """
    Theta = check_inertia(Theta, "`Theta`")
    omega = angular_velocity(rotation)

    def energy(q: Any, qdot: Any) -> Float[Array, ""]:
        _, v = moving(lambda q: vector(position(q), "position"), q, qdot)
        w = omega(q, qdot)
        return 0.5 * m * (v @ v) + 0.5 * w @ (Theta @ w if Theta.ndim == 2 else Theta * w)

    return energy
