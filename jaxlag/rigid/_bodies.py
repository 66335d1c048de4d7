"""The motion of rigid bodies, from their position and rotation as functions of q alone."""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._frames import Frame
from ._rates import body_rate, rates
from ._vectors import floating, known, vector
from .inertia import check_inertia


def angular_velocity(rotation: Callable, axes: str = "body") -> Callable:
    r"""Angular velocity of a body, from its rotation matrix as a function of q alone.

    $$ [\omega]_\times = R^T \dot R \text{ in the axes of the body}, \qquad \dot R R^T \text{ in those of space}, \qquad
       \dot R = \frac{\partial R}{\partial q}\,\dot q $$

    **Arguments:** `rotation`: R(q), which turns components in the axes of the body into those in space; q is any pytree. `axes`: "body" or
    "world", those in which ω is given. R may depend on time only through q: a driven angle is a coordinate with a constraint.

    **Returns:** a function of (q, qdot), whose value is ω, of shape (3,).

    **Raises:** `ValueError` if `axes` is neither, or R is no rotation (as far as its numbers are known).

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


def kinetic_energy(m: Any, Theta: Any, position: Callable, rotation: Callable | None = None) -> Callable:
    r"""Kinetic energy of a rigid body, or of several.

    $$ T = \tfrac12 m\,\dot x\cdot\dot x + \tfrac12\,\omega\cdot\Theta\,\omega $$

    **Arguments:**

    - `m`: its mass.
    - `Theta`: Θ, its inertia about the centre of mass in the axes of the body, (3, 3), or (3,) about principal axes; `rigid.inertia` has
      those of many bodies.
    - `position`: x(q), the centre of mass, (3,).
    - `rotation`: R(q), which turns components in the axes of the body into those in space. Without it, `position` returns both, as a
      `Frame` at the centre of mass; or a dict or a sequence of frames, for several bodies that carry one another: `m` and `Theta` are then
      dicts or sequences as well.

    **Returns:** a function of (q, qdot), to be added to a Lagrangian. Any consistent units. If two of the three moments are one and the
    same number, as for a wheel, the angle about the third axis drops out of T, provided that R ends with that rotation: `[A, A, C]` and `…
    @ rigid.rotation_z(spin)`.

    **Raises:** `ValueError` if the inertia is that of no body, R is no rotation (as far as their numbers are known), or masses,
    inertias and frames are not those of the same bodies.

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
    several = isinstance(m, (Mapping, list, tuple))
    masses, inertias = _as_dict(m) if several else {0: m}, _same_bodies(Theta, m, "Theta") if several else {0: Theta}
    spins = [_axis_of_revolution(Theta) for Theta in inertias.values()]
    in_axes = [lambda of, R, axis=axis: of.body(R) if axis is None else of.unspun(R, axis) for axis in spins]
    inertias = {name: check_inertia(Theta, f"`Theta[{name!r}]`" if several else "`Theta`") for name, Theta in inertias.items()}

    def bodies(q: Any) -> list[tuple[Array, Array]]:
        if rotation is not None:
            return [(vector(position(q), "position"), rotation(q))]
        frames = _same_bodies(position(q), m, "position") if several else {0: position(q)}
        return [_checked(frames[name]) for name in masses]

    def energy(q: Any, qdot: Any) -> Float[Array, ""]:
        parts = zip(masses.values(), inertias.values(), rates(bodies, q, qdot, *in_axes), strict=True)
        T = [0.5 * m * (v @ v) + 0.5 * w @ (Theta @ w if Theta.ndim == 2 else Theta * w) for m, Theta, (v, w) in parts]
        return functools.reduce(jnp.add, T)

    return energy


def _axis_of_revolution(Theta: Any) -> int | None:
    """The axis of revolution: the moments about the other two axes are one and the same number."""
    seen = known(Theta)
    if (seen is None and not isinstance(Theta, (list, tuple))) or len(Theta) != 3 or np.ndim(Theta[0]):
        return None
    same = (lambda i, j: seen[i] == seen[j]) if seen is not None else (lambda i, j: Theta[i] is Theta[j])
    return next((axis for axis in (2, 1, 0) if same((axis + 1) % 3, (axis + 2) % 3)), None)


def _as_dict(bodies: Any) -> dict:
    """The entries for several bodies, by name or number."""
    return dict(bodies) if isinstance(bodies, Mapping) else dict(enumerate(bodies))


def _same_bodies(given: Any, m: Any, name: str) -> dict:
    """The entries for several bodies, if these are the bodies that have a mass."""
    names = list(_as_dict(m))
    one_for_all = isinstance(given, Frame) or not isinstance(given, (Mapping, list, tuple))
    if one_for_all or set(_as_dict(given)) != set(names):
        found = "is one" if one_for_all else f"has {', '.join(map(repr, _as_dict(given)))}"
        raise ValueError(
            f"`{name}` must have an entry for each of {', '.join(map(repr, names))}, as `m` has, but {found}. Name the same bodies."
        )
    return _as_dict(given)


def _checked(frame: Any) -> tuple[Array, Array]:
    """The origin and the axes of a frame."""
    if not isinstance(frame, Frame):
        raise ValueError(
            f"`position` must return a `Frame` where no `rotation` is given, but returned {type(frame).__name__}. Give `rotation`, "
            "or return `rigid.frame(place, axes)`."
        )
    return vector(frame.origin, "origin"), frame.axes
