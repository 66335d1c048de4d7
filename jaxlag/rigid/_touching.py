"""Contact of bodies in space: gaps in closed form, and the slip where they touch."""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._frames import Frame, frame
from ._ground import turning_axes
from ._rates import rates
from ._vectors import floating, skew, vector

CORNERS = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))  # of a box of sides 1
LINE, ACROSS = np.array([12, 9, 20]) / 25, np.array([[15, -20, 0], [16, 12, -15]]) / 25  # a unit vector, and two across it


class Touching(NamedTuple):
    """A contact of two bodies, as functions of q, for `System(unilateral=...)` and for dissipation functions.

    - `gap(q)`: the distance, negative inside; of several points that may touch an array.
    - `slip(q, qdot)`: of the point of the first body against that of the second, in two directions along their surfaces, (…, 2).
    """

    gap: Callable[[Any], Array]
    slip: Callable[[Any, Any], Array]


def sphere_plane(sphere: Any, radius: Any, plane: Callable | Frame | None = None) -> Touching:
    r"""A ball above a plane.

    $$ g = (x - x_0)\cdot n - r $$

    **Arguments:** `sphere`: a function of q, whose value is the `Frame` at its centre, which turns with it; `radius`: r; `plane`: a
    `Frame` whose z axis is the normal n, or a function of q whose value it is, of one that moves; by default the plane z = 0.

    **Returns:** a `Touching` of one gap. **Raises:** `TypeError` if `sphere` is no function. Any consistent units.

    **Source:** Pfeiffer & Glocker, Multibody Dynamics with Unilateral Contacts, section 4.2 (gaps and relative velocities).

    ```python
    from jaxlag import rigid
    ball = rigid.sphere_plane(lambda q: rigid.frame([q[0], 0.0, q[1]], rigid.rotation_y(q[2])), 0.5)
    ball.gap([0.0, 0.7, 0.0])  # 0.2
    ball.slip([0.0, 0.5, 0.0], [1.0, 0.0, 2.0])  # ẋ − r φ̇ and across = [0, 0]
    ```
    """
    return _above("sphere", sphere, plane, lambda body, n: body.origin - radius * n)


def box_plane(box: Any, sides: Any, plane: Callable | Frame | None = None) -> Touching:
    r"""The eight corners of a box above a plane.

    $$ g_i = (x + R\,c_i - x_0)\cdot n $$

    **Arguments:** `box`: a function of q, whose value is the `Frame` at its centre; `sides`: along its axes, (3,); `plane`: as for
    `sphere_plane`.

    **Returns:** a `Touching` of eight gaps, in the order of (−, −, −), (−, −, +), …, (+, +, +). **Raises:** `TypeError` if `box` is no
    function, `ValueError` if `sides` are not three numbers. Any consistent units. **Source:** as for `sphere_plane`.

    ```python
    from jaxlag import rigid
    cube = rigid.box_plane(lambda q: rigid.frame([0.0, 0.0, q], rigid.rotation_x(0.0)), [2.0, 2.0, 2.0])
    cube.gap(1.0)  # four on the plane, four two above it: [0, 2, 0, 2, 0, 2, 0, 2]
    ```
    """
    corners = CORNERS * vector(sides, "sides")[None]
    return _above("box", box, plane, lambda body, n: body.origin[None] + corners @ body.axes.T)


def capsule_plane(capsule: Any, length: Any, radius: Any, plane: Callable | Frame | None = None) -> Touching:
    r"""The two ends of a capsule, a rod with half balls at its ends, above a plane.

    $$ g_\pm = (x \pm \tfrac{l}{2}\,e_z - x_0)\cdot n - r $$

    **Arguments:** `capsule`: a function of q, whose value is the `Frame` at its centre, z along its axis; `length`: l, between the centres
    of the half balls; `radius`: r; `plane`: as for `sphere_plane`.

    **Returns:** a `Touching` of two gaps, that at −l/2 first. **Raises:** `TypeError` if `capsule` is no function. Any consistent units.
    **Source:** as for `sphere_plane`.

    ```python
    from jaxlag import rigid
    pill = rigid.capsule_plane(lambda q: rigid.frame([0.0, 0.0, q], rigid.rotation_x(0.0)), 2.0, 0.5)
    pill.gap(2.0)  # upright: [0.5, 2.5]
    ```
    """
    ends = jnp.stack([-jnp.asarray(length) / 2, jnp.asarray(length) / 2])
    return _above("capsule", capsule, plane, lambda body, n: (body.origin - radius * n)[None] + ends[:, None] * body.axes[:, 2][None])


def ellipsoid_plane(ellipsoid: Any, half_axes: Any, plane: Callable | Frame | None = None) -> Touching:
    r"""An ellipsoid above a plane.

    $$ g = (x - x_0)\cdot n - \sqrt{\textstyle\sum_i (a_i\,e_i\cdot n)^2} $$

    **Arguments:** `ellipsoid`: a function of q, whose value is the `Frame` at its centre; `half_axes`: a₁, a₂, a₃ along its axes, (3,);
    `plane`: as for `sphere_plane`.

    **Returns:** a `Touching` of one gap. **Raises:** `TypeError` if `ellipsoid` is no function, `ValueError` if
    `half_axes` are not three numbers. Any consistent units.

    **Source:** as for `sphere_plane`; the root is the support function of an ellipsoid (Boyd & Vandenberghe, Convex Optimization, section
    2.5).

    ```python
    from jaxlag import rigid
    egg = rigid.ellipsoid_plane(lambda q: rigid.frame([0.0, 0.0, q], rigid.rotation_x(0.0)), [1.0, 1.0, 2.0])
    egg.gap(2.5)  # 0.5
    ```
    """
    squares = vector(half_axes, "half_axes") ** 2

    def lowest(body: Frame, n: Array) -> Array:
        along = n @ body.axes
        return body.origin - body.axes @ (squares * along) / jnp.sqrt(squares @ along**2)

    return _above("ellipsoid", ellipsoid, plane, lowest)


def sphere_sphere(one: Any, other: Any, radii: Any) -> Touching:
    r"""Two balls.

    $$ g = |x_2 - x_1| - r_1 - r_2 $$

    **Arguments:** `one`, `other`: functions of q, whose values are the `Frame`s at their centres, which turn with them; `radii`: r₁, r₂.

    **Returns:** a `Touching` of one gap, without a derivative where the centres coincide. Its slip is that of the first ball's point
    against the second's, in two directions across the line of centres, which turn with it. No such pair exists for all lines without a
    jump: along −(12, 9, 20), which is unlikely to be met, the slip is NaN.

    **Raises:** `TypeError` if `one` or `other` is no function, `ValueError` if `radii` are not two numbers. Any consistent units.

    **Source:** as for `sphere_plane`; Frisvad, Building an orthonormal basis from a 3D unit vector without normalization, J. Graphics
    Tools 16 (2012) 151, from another line than z.

    ```python
    from jaxlag import rigid
    at = lambda x: rigid.frame([x, 0.0, 0.0])
    rigid.sphere_sphere(lambda q: at(q[0]), lambda q: at(q[1]), [0.5, 1.0]).gap([0.0, 2.0])  # 0.5
    ```
    """
    _check_moves("one", one)
    _check_moves("other", other)
    radii = vector(radii, "radii", 2)
    apart = lambda q: other(q).origin - one(q).origin

    def slip(q: Any, qdot: Any) -> Array:
        n = apart(q) / jnp.linalg.norm(apart(q))
        along = ACROSS - jnp.outer(ACROSS @ n, LINE + n) / (1 + LINE @ n)  # turned as LINE is to n
        first, second = (_velocity(body, q, qdot, body(q).origin + lever * n) for body, lever in ((one, radii[0]), (other, -radii[1])))
        return along @ (first - second)

    return Touching(lambda q: jnp.linalg.norm(apart(q)) - jnp.sum(radii), slip)


def _above(name: str, body: Any, plane: Callable | Frame | None, lowest: Callable) -> Touching:
    """Points of a body, `lowest(frame, normal)`, (…, 3), above a plane."""
    _check_moves(name, body)
    ground = plane if callable(plane) else lambda q: frame() if plane is None else plane

    def gap(q: Any) -> Array:
        on = ground(q)
        n = on.axes[:, 2]
        return lowest(body(q), n) @ n - on.origin @ n

    def slip(q: Any, qdot: Any) -> Array:
        on = ground(q)
        points = lowest(body(q), on.axes[:, 2])
        against = _velocity(plane, q, qdot, points) if ground is plane else jnp.zeros_like(points)
        return (_velocity(body, q, qdot, points) - against) @ on.axes[:, :2]

    return Touching(gap, slip)


def _check_moves(name: str, body: Any) -> None:
    if not callable(body):
        raise TypeError(f"`{name}` must be a function of q, whose value is a `Frame`, but is {body!r}. Write `lambda q: rigid.frame(...)`.")


def _velocity(body: Callable, q: Any, qdot: Any, points: Float[Array, "*k 3"]) -> Float[Array, "*k 3"]:
    """Of the points of a body that are at these places."""
    ((v, (_, omega)),) = rates(lambda q: [body(q)], q, qdot, turning_axes)
    x = floating(body(q).origin)
    from_centre = points - jnp.broadcast_to(x, points.shape)
    return jnp.broadcast_to(v, points.shape) + from_centre @ skew(omega).T
