"""Frames: of a body as it moves, of a joint on it, of a plane."""

from typing import Any, NamedTuple

from jaxtyping import Array, Float

from ._vectors import check_rotation, one, vector


class Frame(NamedTuple):
    """An origin and three axes: of a moving body, of a joint on a body, of a plane.

    - `origin`: in space, (3,).
    - `axes`: x, y and z as the columns of a rotation matrix, (3, 3).
    """

    origin: Float[Array, "3"]
    axes: Float[Array, "3 3"]

    def point(self, r: Any) -> Float[Array, "3"]:
        """The position in space of a point with the components `r` in these axes."""
        return self.origin + self.axes @ vector(r, "r")

    def direction(self, d: Any) -> Float[Array, "3"]:
        """A vector with the components `d` in these axes."""
        return self.axes @ vector(d, "d")

    def on(self, origin: Any = None, axes: Any = None) -> "Frame":
        """A frame on this one: a joint on a body. `origin` and `axes` are given in the axes of this frame; by default they are its own."""
        return Frame(
            self.origin if origin is None else self.point(origin), self.axes if axes is None else self.axes @ check_rotation(axes, "`axes`")
        )


def frame(origin: Any = (0.0, 0.0, 0.0), axes: Any = None) -> Frame:
    """A frame, by default that of space.

    **Arguments:** `origin`: its position, (3,); `axes`: a rotation matrix, whose columns are its axes, (3, 3); by default those of space.

    **Returns:** a `Frame`, with `point(r)`, `direction(d)` and `on(origin, axes)`, a frame that is fixed to it.

    **Raises:** `ValueError` if `origin` is no vector or `axes` no rotation, as far as their numbers are known.

    ```python
    from jaxlag import rigid
    body = rigid.frame([1.0, 0.0, 0.0], rigid.rotation_z(0.3))
    body.on([0.0, 0.5, 0.0]).origin  # [1 − 0.5 sin 0.3, 0.5 cos 0.3, 0] = [0.8522, 0.4777, 0]
    ```
    """
    origin = vector(origin, "origin")
    return Frame(origin, one(origin) if axes is None else check_rotation(axes, "`axes`"))
