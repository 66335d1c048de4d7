"""Joints between bodies, as functions whose value has to be zero: for `System(holonomic=...)`.

A joint takes two frames, each fixed to one body (or in space): the origins are its place on both, the z axes its own axis. Its multipliers
are the forces and moments of the joint on the first body.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ._frames import Frame


def spherical(a: Frame, b: Frame) -> Float[Array, "3"]:
    r"""A ball joint: the origins coincide. Three conditions.

    $$ x_a - x_b = 0 $$

    **Arguments:** `a`, `b`: the frames of the joint on the two bodies. **Returns:** what has to be zero, (3,); its multipliers are the
    force of the joint on `a` in space. **Raises:** nothing.

    **Source:** Haug, Computer Aided Kinematics and Dynamics, section 9.4, as for all joints here.

    ```python
    from jaxlag import rigid
    rigid.spherical(rigid.frame([1.0, 0.0, 0.0]), rigid.frame())  # [1, 0, 0]
    ```
    """
    return a.origin - b.origin


def revolute(a: Frame, b: Frame) -> Float[Array, "5"]:
    r"""A hinge about the common z axis: five conditions.

    $$ x_a - x_b = 0, \qquad y_a\cdot z_b = 0, \quad -x_a\cdot z_b = 0 \text{ (of the axes)} $$

    **Arguments:** `a`, `b`: the frames of the joint on the two bodies. **Returns:** what has to be zero, (5,): the three of `spherical`,
    and two of direction, whose multipliers are the moment on `a` about x and y of b.

    **Raises:** nothing.

    ```python
    from jaxlag import rigid
    rigid.revolute(rigid.frame(axes=rigid.rotation_z(0.3)), rigid.frame())  # [0, 0, 0, 0, 0]
    ```
    """
    return jnp.concatenate([spherical(a, b), _parallel(a, b)])


def prismatic(a: Frame, b: Frame) -> Float[Array, "5"]:
    r"""A slide along the common z axis, without rotation: five conditions.

    $$ R_b^T (x_a - x_b) = 0 \text{ in x and y}, \qquad R_b^T R_a = 1 $$

    **Arguments:** `a`, `b`: the frames of the joint on the two bodies. **Returns:** what has to be zero, (5,): two of place, whose
    multipliers are the force on `a` along x and y of b, and the three of `same_axes`.

    **Raises:** nothing.

    ```python
    from jaxlag import rigid
    rigid.prismatic(rigid.frame([0.0, 0.0, 2.0]), rigid.frame())  # [0, 0, 0, 0, 0]
    ```
    """
    return jnp.concatenate([_on_axis(a, b), same_axes(a, b)])


def cylindrical(a: Frame, b: Frame) -> Float[Array, "4"]:
    r"""A slide along the common z axis and a rotation about it: four conditions.

    $$ R_b^T (x_a - x_b) = 0 \text{ in x and y}, \qquad y_a\cdot z_b = 0, \quad -x_a\cdot z_b = 0 $$

    **Arguments:** `a`, `b`: the frames of the joint on the two bodies. **Returns:** what has to be zero, (4,): two of place as of
    `prismatic`, two of direction as of `revolute`.

    **Raises:** nothing.

    ```python
    from jaxlag import rigid
    rigid.cylindrical(rigid.frame([0.0, 0.0, 2.0], rigid.rotation_z(0.3)), rigid.frame())  # [0, 0, 0, 0]
    ```
    """
    return jnp.concatenate([_on_axis(a, b), _parallel(a, b)])


def universal(a: Frame, b: Frame) -> Float[Array, "4"]:
    r"""A universal joint (Cardan's, Hooke's): the origins coincide, and the x axis of a, an arm of its cross, is orthogonal to the y axis
    of b.

    $$ x_a - x_b = 0, \qquad x_a\cdot y_b = 0 \text{ (of the axes)} $$

    **Arguments:** `a`, `b`: the frames of the joint on the two bodies. **Returns:** what has to be zero, (4,): the three of `spherical`,
    and one whose multiplier is the moment on `a` about the third direction.

    **Raises:** nothing.

    ```python
    from jaxlag import rigid
    rigid.universal(rigid.frame(axes=rigid.rotation_x(0.3)), rigid.frame(axes=rigid.rotation_y(0.2)))  # [0, 0, 0, 0]
    ```
    """
    return jnp.concatenate([spherical(a, b), (a.axes[:, 0] @ b.axes[:, 1])[None]])


def fixed(a: Frame, b: Frame) -> Float[Array, "6"]:
    r"""Two bodies as one: six conditions.

    $$ x_a - x_b = 0, \qquad R_b^T R_a = 1 $$

    **Arguments:** `a`, `b`: the frames of the joint on the two bodies. **Returns:** what has to be zero, (6,): `spherical` and `same_axes`.

    **Raises:** nothing.

    ```python
    from jaxlag import rigid
    rigid.fixed(rigid.frame(), rigid.frame())  # [0, 0, 0, 0, 0, 0]
    ```
    """
    return jnp.concatenate([spherical(a, b), same_axes(a, b)])


def same_axes(a: Frame, b: Frame) -> Float[Array, "3"]:
    r"""Zero if the axes of both frames agree: three conditions, the axis about which a is turned times the sine of the angle, in b.

    $$ \tfrac12 (T - T^T)^\vee = e \sin\alpha = 0, \qquad T = R_b^T R_a $$

    **Arguments:** `a`, `b`: frames on the two bodies. **Returns:** what has to be zero, (3,); its multipliers are the moment on `a` about
    the axes of b. At angles of π it is zero as well: start near the intended position.

    **Raises:** nothing.

    ```python
    from jaxlag import rigid
    rigid.same_axes(rigid.frame(axes=rigid.rotation_z(0.3)), rigid.frame())  # [0, 0, 0.2955]
    ```
    """
    turned = b.axes.T @ a.axes
    odd = 0.5 * (turned - turned.T)
    return jnp.stack([odd[2, 1], odd[0, 2], odd[1, 0]])


def _parallel(a: Frame, b: Frame) -> Float[Array, "2"]:
    """The sines of the angles by which a is turned about x and y of b."""
    about_y, about_x = a.axes[:, :2].T @ b.axes[:, 2]
    return jnp.stack([about_x, -about_y])


def _on_axis(a: Frame, b: Frame) -> Float[Array, "2"]:
    return b.axes[:, :2].T @ (a.origin - b.origin)
