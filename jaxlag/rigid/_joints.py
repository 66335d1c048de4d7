"""Joints between bodies, ropes and wheels, as functions that return what has to be zero: for `System(holonomic=..., nonholonomic=...)`.

A joint takes two frames, of which each sits on one body (or in space): the origins are its place on both, the z axes its own. Its
multipliers are the forces and moments of the joint on the first of both.
"""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._vectors import check_rotation, floating, one, vector


class Frame(NamedTuple):
    """A place and three axes: of a body as it moves, of a joint on a body, of a plane.

    - `origin`: in space, (3,).
    - `axes`: x, y and z as the columns of a rotation matrix, (3, 3).
    """

    origin: Float[Array, "3"]
    axes: Float[Array, "3 3"]

    def point(self, r: Any) -> Float[Array, "3"]:
        """The place in space of a point with the components `r` in these axes."""
        return self.origin + self.axes @ vector(r, "r")

    def direction(self, d: Any) -> Float[Array, "3"]:
        """A vector with the components `d` in these axes."""
        return self.axes @ vector(d, "d")

    def on(self, origin: Any = (0.0, 0.0, 0.0), axes: Any = None) -> "Frame":
        """A frame fixed to this one: a joint on a body. `origin` and `axes` are given in the axes of this frame; by default these axes."""
        return Frame(self.point(origin), self.axes if axes is None else self.axes @ check_rotation(axes, "`axes`"))


def frame(origin: Any = (0.0, 0.0, 0.0), axes: Any = None) -> Frame:
    """A frame, by default that of space.

    **Arguments:** `origin`: its place, (3,); `axes`: a rotation matrix, whose columns are its axes, (3, 3); by default those of space.

    **Returns:** a `Frame`, with `point(r)`, `direction(d)` and `on(origin, axes)`, a frame that is fixed to it.

    **Raises:** `ValueError` where `origin` is no vector or `axes` no rotation, as far as their numbers are known.

    ```python
    from jaxlag import rigid
    body = rigid.frame([1.0, 0.0, 0.0], rigid.rotation_z(0.3))
    body.on([0.0, 0.5, 0.0]).origin  # [1 − 0.5 sin 0.3, 0.5 cos 0.3, 0] = [0.8522, 0.4777, 0]
    ```
    """
    origin = vector(origin, "origin")
    return Frame(origin, one(origin) if axes is None else check_rotation(axes, "`axes`"))


def spherical(a: Frame, b: Frame) -> Float[Array, "3"]:
    """A ball joint: both origins at one place. Three conditions.

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
    """A hinge about the common z axis: five conditions.

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
    """A slide along the common z axis, without rotation: five conditions.

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
    """A slide along the common z axis and a rotation about it: four conditions.

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
    """A universal joint (Cardan's, Hooke's): one place, and the x axis of a, an arm of its cross, at a right angle to the y axis of b.

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
    """Two bodies as one: six conditions.

    **Arguments:** `a`, `b`: the frames of the joint on the two bodies. **Returns:** what has to be zero, (6,): `spherical` and `same_axes`.

    **Raises:** nothing.

    ```python
    from jaxlag import rigid
    rigid.fixed(rigid.frame(), rigid.frame())  # [0, 0, 0, 0, 0, 0]
    ```
    """
    return jnp.concatenate([spherical(a, b), same_axes(a, b)])


def same_axes(a: Frame, b: Frame) -> Float[Array, "3"]:
    """Zero where the axes of both frames agree: three conditions, the sine of the angle by which a is turned times its axis, in b.

    **Arguments:** `a`, `b`: frames on the two bodies. **Returns:** what has to be zero, (3,); its multipliers are the moment on `a` about
    the axes of b. At angles of π it is zero as well: start near the position meant.

    **Raises:** nothing.

    ```python
    from jaxlag import rigid
    rigid.same_axes(rigid.frame(axes=rigid.rotation_z(0.3)), rigid.frame())  # [0, 0, 0.2955]
    ```
    """
    turned = b.axes.T @ a.axes
    odd = 0.5 * (turned - turned.T)
    return jnp.stack([odd[2, 1], odd[0, 2], odd[1, 0]])


def on_plane(point: Any, plane: Frame) -> Float[Array, ""]:
    """The height of a point over a plane, the x and y axes of a frame: zero where it lies in it, a gap where it must not be below.

    **Arguments:** `point`: in space, (3,); `plane`: a `Frame`, whose z axis is the normal. **Returns:** a number.

    **Raises:** nothing.

    ```python
    from jaxlag import rigid
    rigid.on_plane([3.0, 4.0, 0.5], rigid.frame())  # 0.5
    ```
    """
    return (vector(point, "point") - plane.origin) @ plane.axes[:, 2]


def length(*points: Any) -> Float[Array, ""]:
    """The length of a line from point to point: of a rope over small pulleys, of a rod between two points.

    **Arguments:** `points`: two or more, each (3,). **Returns:** a number: `length(a, b) − l` as a constraint, `l − length(a, b)` as a gap.

    **Raises:** `ValueError` where there are fewer than two points.

    ```python
    from jaxlag import rigid
    rigid.length([0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [3.0, 4.0, 0.0])  # 7
    ```
    """
    if len(points) < 2:
        raise ValueError(f"`points` must be at least two, but there are {len(points)}. Give both ends.")
    places = [vector(point, "points") for point in points]
    return sum((jnp.linalg.norm(b - a) for a, b in itertools.pairwise(places)), start=jnp.zeros(()))


def wheel_height(wheel: Frame, radius: Any, plane: Frame | None = None) -> Float[Array, ""]:
    r"""The height of the lowest point of a thin wheel over a plane: zero where it stands on it.

    $$ g = h - r\sqrt{1 - (n\cdot e)^2} $$

    **Arguments:** `wheel`: a `Frame` at its centre, whose z axis e is its axle; `radius`: r; `plane`: a `Frame`, whose z axis is the normal
    n; by default the plane z = 0. **Returns:** a number. It has no derivative where the wheel lies flat.

    **Raises:** nothing.

    **Source:** Schwab & Meijaard, Multibody Syst. Dyn. 3 (1999) 217, on wheels as constraints.

    ```python
    from jaxlag import rigid
    rigid.wheel_height(rigid.frame([0.0, 0.0, 0.5], rigid.rotation_x(1.5707963)), 0.5)  # upright: 0
    ```
    """
    plane = frame() if plane is None else plane
    return on_plane(wheel.origin, plane) - radius * _slope(wheel, plane)


def rolling(wheel: Callable, radius: Any, plane: Frame | None = None) -> Callable:
    r"""The velocity of the point of a thin wheel that touches a plane, in two directions of the plane: zero where it rolls without slip.

    $$ a = \dot x + \omega\times\rho, \qquad \rho = -r\,\frac{n - (n\cdot e)\,e}{\sqrt{1 - (n\cdot e)^2}} $$

    **Arguments:** `wheel`: a function of q, whose value is the `Frame` of the wheel, which turns with it, its z axis the axle; `radius` and
    `plane`: as for `wheel_height`.

    **Returns:** a function of (q, qdot), whose value has to be zero, (2,): for `System(nonholonomic=...)`, beside `wheel_height` as a
    holonomic constraint. A ball rolls likewise where `radius` is that and ρ = −r n: `rolling_ball`.

    **Raises:** nothing.

    **Source:** Neimark & Fufaev, Dynamics of Nonholonomic Systems, section I.4.

    ```python
    from jaxlag import rigid
    wheel = lambda q: rigid.frame([q[0], 0.0, 0.5], rigid.rotation_x(-1.5707963) @ rigid.rotation_z(q[1]))
    rigid.rolling(wheel, 0.5)([0.0, 0.0], [1.0, 2.0])  # ẋ − r φ̇ and across = [0, 0]
    ```
    """
    ground = frame() if plane is None else plane

    def below(body: Frame) -> Array:
        n, axle = ground.axes[:, 2], body.axes[:, 2]
        return -radius * (n - (n @ axle) * axle) / _slope(body, ground)

    return _sliding(wheel, below, ground)


def rolling_ball(ball: Callable, radius: Any, plane: Frame | None = None) -> Callable:
    """The velocity of the point of a ball that touches a plane, in two directions of the plane: zero where it rolls without slip.

    **Arguments:** as for `rolling`; `ball`: a function of q, whose value is the `Frame` at its centre that turns with it.

    **Returns:** a function of (q, qdot), whose value has to be zero, (2,); the height, `on_plane(centre, plane) − radius`, is a constraint
    beside it. **Raises:** nothing. **Source:** Neimark & Fufaev, Dynamics of Nonholonomic Systems, section I.4.

    ```python
    from jaxlag import rigid
    ball = lambda q: rigid.frame([q[0], 0.0, 0.5], rigid.rotation_y(q[1]))
    rigid.rolling_ball(ball, 0.5)([0.0, 0.0], [1.0, 2.0])  # ẋ − r φ̇ and across = [0, 0]
    ```
    """
    ground = frame() if plane is None else plane
    return _sliding(ball, lambda body: -radius * ground.axes[:, 2], ground)


def _sliding(body: Callable, below: Callable, plane: Frame) -> Callable:
    """The velocity of the point of a body that is at `below(frame)` from its origin."""

    def velocity(q: Any, qdot: Any) -> Float[Array, "2"]:
        given = [jax.tree.map(floating, tree) for tree in (q, qdot)]
        here, rates = jax.jvp(body, given[:1], given[1:])
        fixed_to_it = here.axes.T @ below(here)  # as it moves on with the body
        return plane.axes[:, :2].T @ (rates.origin + rates.axes @ fixed_to_it)

    return velocity


def _parallel(a: Frame, b: Frame) -> Float[Array, "2"]:
    """The sines of the angles by which a is turned about x and y of b."""
    about_y, about_x = a.axes[:, :2].T @ b.axes[:, 2]
    return jnp.stack([about_x, -about_y])


def _on_axis(a: Frame, b: Frame) -> Float[Array, "2"]:
    return b.axes[:, :2].T @ (a.origin - b.origin)


def _slope(wheel: Frame, plane: Frame) -> Float[Array, ""]:
    """The sine of the angle between the axle and the normal of the plane."""
    return jnp.sqrt(1 - (plane.axes[:, 2] @ wheel.axes[:, 2]) ** 2)
