"""Planes, ropes and wheels, as functions whose value has to be zero or must not be negative."""

import itertools
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from ._frames import Frame, frame
from ._rates import AngularVelocities, rates
from ._vectors import vector


def on_plane(point: Any, plane: Frame) -> Float[Array, ""]:
    r"""The height of a point above the plane of a frame's x and y axes: zero if it lies in the plane, a gap if it must stay above.

    $$ h = (x - x_0)\cdot n $$

    **Arguments:** `point`: in space, (3,); `plane`: a `Frame`, whose z axis is the normal. **Returns:** a number.

    **Raises:** `ValueError` if `point` is not three numbers.

    ```python
    from jaxlag import rigid
    rigid.on_plane([3.0, 4.0, 0.5], rigid.frame())  # 0.5
    ```
    """
    return (vector(point, "point") - plane.origin) @ plane.axes[:, 2]


def length(*points: Any) -> Float[Array, ""]:
    r"""The length of a line from point to point: of a rope over small pulleys, of a rod between two points.

    $$ l = \sum_i |x_{i+1} - x_i| $$

    **Arguments:** `points`: two or more, each (3,). **Returns:** a number: `length(a, b) − l` as a constraint, `l − length(a, b)` as a gap.

    **Raises:** `ValueError` if there are fewer than two points.

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
    r"""The height of the lowest point of a thin wheel above a plane: zero if the wheel stands on it.

    $$ g = h - r\sqrt{1 - (n\cdot e)^2} $$

    **Arguments:** `wheel`: a `Frame` at its centre, whose z axis e is its axle; `radius`: r; `plane`: a `Frame`, whose z axis is the normal
    n; by default the plane z = 0. **Returns:** a number. It has no derivative when the wheel lies flat.

    **Raises:** nothing.

    **Source:** Schwab & Meijaard, Multibody Syst. Dyn. 3 (1999) 217, on wheels as constraints.

    ```python
    from jaxlag import rigid
    rigid.wheel_height(rigid.frame([0.0, 0.0, 0.5], rigid.rotation_x(1.5707963)), 0.5)  # upright: 0
    ```
    """
    plane = frame() if plane is None else plane
    return on_plane(wheel.origin, plane) - radius * _slope(wheel.axes[:, 2], plane)


def rolling(wheel: Callable, radius: Any, plane: Frame | None = None) -> Callable:
    r"""The velocity of the point of a thin wheel that touches a plane, in two directions of the plane: zero if it rolls without slipping.

    $$ a = \dot x + \omega\times\rho, \qquad \rho = -r\,\frac{n - (n\cdot e)\,e}{\sqrt{1 - (n\cdot e)^2}} $$

    **Arguments:** `wheel`: a function of q, whose value is the `Frame` of the wheel, which turns with it, its z axis the axle; `radius` and
    `plane`: as for `wheel_height`.

    **Returns:** a function of (q, qdot), whose value has to be zero, (2,): for `System(nonholonomic=...)`, together with `wheel_height` as
    a holonomic constraint. For a ball, take `rolling_ball`.

    **Raises:** nothing.

    **Source:** Neimark & Fufaev, Dynamics of Nonholonomic Systems, section I.4.

    ```python
    from jaxlag import rigid
    wheel = lambda q: rigid.frame([q[0], 0.0, 0.5], rigid.rotation_x(-1.5707963) @ rigid.rotation_z(q[1]))
    rigid.rolling(wheel, 0.5)([0.0, 0.0], [1.0, 2.0])  # ẋ − r φ̇ and across = [0, 0]
    ```
    """
    ground = frame() if plane is None else plane

    return _sliding(wheel, lambda axle: _lowest(axle, radius, ground), ground)


def rolling_ball(ball: Callable, radius: Any, plane: Frame | None = None) -> Callable:
    r"""The velocity of the point of a ball that touches a plane, in two directions of the plane: zero if it rolls without slipping.

    $$ a = \dot x + \omega\times\rho, \qquad \rho = -r\,n $$

    **Arguments:** as for `rolling`; `ball`: a function of q, whose value is the `Frame` at its centre that turns with it.

    **Returns:** a function of (q, qdot), whose value has to be zero, (2,); the height, `on_plane(centre, plane) − radius`, is a second
    constraint. **Raises:** nothing. **Source:** Neimark & Fufaev, Dynamics of Nonholonomic Systems, section I.4.

    ```python
    from jaxlag import rigid
    ball = lambda q: rigid.frame([q[0], 0.0, 0.5], rigid.rotation_y(q[1]))
    rigid.rolling_ball(ball, 0.5)([0.0, 0.0], [1.0, 2.0])  # ẋ − r φ̇ and across = [0, 0]
    ```
    """
    ground = frame() if plane is None else plane
    return _sliding(ball, lambda axle: -radius * ground.axes[:, 2], ground)


def _sliding(body: Callable, below: Callable, plane: Frame) -> Callable:
    """The velocity of a body's point at `below(its z axis)` from its origin."""

    def velocity(q: Any, qdot: Any) -> Float[Array, "2"]:
        ((v, (axes, omega)),) = rates(lambda q: [body(q)], q, qdot, turning_axes)
        return plane.axes[:, :2].T @ (v + jnp.cross(omega, below(axes[:, 2])))

    return velocity


def turning_axes(of: AngularVelocities, R: Any) -> Callable:
    """The axes of a frame, and its angular velocity in space."""
    axes, omega = of.number(R), of.world(R)
    return lambda: (axes()[0], omega())


def _lowest(axle: Array, radius: Any, plane: Frame) -> Float[Array, "3"]:
    """The vector ρ from the centre of a thin wheel to its point nearest to a plane."""
    n = plane.axes[:, 2]
    return -radius * (n - (n @ axle) * axle) / _slope(axle, plane)


def _slope(axle: Array, plane: Frame) -> Float[Array, ""]:
    """The sine of the angle between the axle and the normal of the plane."""
    return jnp.sqrt(1 - (plane.axes[:, 2] @ axle) ** 2)
