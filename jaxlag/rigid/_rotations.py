"""Rotation matrices from coordinates: R turns the components of a vector in the axes of a body into those in space."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._rates import turning
from ._vectors import floating, known, one, skew, vector

SERIES = 12  # terms of a power series that is used up to an angle of 1: the last is below 1e-23


def rotation(axis: Any, angle: Any) -> Float[Array, "3 3"]:
    r"""Rotation about an axis.

    $$ R = 1 + \sin\alpha\,[a]_\times + (1 - \cos\alpha)\,[a]_\times^2 $$

    **Arguments:** `axis`: a, a vector of shape (3,), which is normalised; `angle`: α in rad, counted by the right-hand rule.

    **Returns:** a rotation matrix, (3, 3).

    **Raises:** `ValueError` if `axis` is no vector of three numbers, or is zero.

    **Source:** Goldstein, Classical Mechanics, 3rd ed., eq. 4.62 (the active rotation).

    ```python
    import jax.numpy as jnp
    from jaxlag import rigid
    rigid.rotation([0, 0, 2.0], jnp.pi / 2) @ jnp.array([1.0, 0.0, 0.0])  # [0, 1, 0]
    ```
    """
    a, seen = vector(axis, "axis"), known(axis)
    if seen is not None and not np.any(seen):
        raise ValueError("`axis` must point somewhere, but is zero. Give a direction, such as [0, 0, 1].")
    return _about(a / jnp.linalg.norm(a), floating(angle))


def _rate_about(numbers: Any, rates: Any) -> Float[Array, "3"]:
    """α̇ a + sin α ȧ − (1 − cos α) a × ȧ."""
    (a, angle), (a_dot, rate) = numbers, rates
    return rate * a + jnp.sin(angle) * a_dot - (1 - jnp.cos(angle)) * jnp.cross(a, a_dot)


@turning(_rate_about)
def _about(a, angle):
    K = skew(a)
    return one(a) + jnp.sin(angle) * K + (1 - jnp.cos(angle)) * (K @ K)


def rotation_x(angle: Any) -> Float[Array, "3 3"]:
    """Rotation about the x axis by an angle in rad: y turns towards z.

    **Arguments:** `angle`: a number. **Returns:** a rotation matrix, (3, 3). **Raises:** nothing.

    **Source:** Goldstein, 3rd ed., section 4.4.

    ```python
    from jaxlag import rigid
    rigid.rotation_x(0.3)[1, 2]  # −sin 0.3 = −0.2955
    ```
    """
    return _about_x(floating(angle))


def rotation_y(angle: Any) -> Float[Array, "3 3"]:
    """Rotation about the y axis by an angle in rad: z turns towards x.

    **Arguments:** `angle`: a number. **Returns:** a rotation matrix, (3, 3). **Raises:** nothing.

    **Source:** Goldstein, 3rd ed., section 4.4.

    ```python
    from jaxlag import rigid
    rigid.rotation_y(0.3)[0, 2]  # sin 0.3 = 0.2955
    ```
    """
    return _about_y(floating(angle))


def rotation_z(angle: Any) -> Float[Array, "3 3"]:
    """Rotation about the z axis by an angle in rad: x turns towards y.

    **Arguments:** `angle`: a number. **Returns:** a rotation matrix, (3, 3). **Raises:** nothing.

    **Source:** Goldstein, 3rd ed., section 4.4.

    ```python
    from jaxlag import rigid
    rigid.rotation_z(0.3)[0, 1]  # −sin 0.3 = −0.2955
    ```
    """
    return _about_z(floating(angle))


@turning(lambda numbers, rates: _along(rates[0], 0))
def _about_x(angle):
    return _about_axis(0, angle)


@turning(lambda numbers, rates: _along(rates[0], 1))
def _about_y(angle):
    return _about_axis(1, angle)


@turning(lambda numbers, rates: _along(rates[0], 2))
def _about_z(angle):
    return _about_axis(2, angle)


def _about_axis(axis: int, angle: Any) -> Float[Array, "3 3"]:
    """Rotation about one of the axes, with two products fewer than Rodrigues' formula."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    full, zero = jnp.ones_like(c), jnp.zeros_like(c)
    rows = [[full, zero, zero], [zero, c, -s], [zero, s, c]]
    return jnp.stack([jnp.stack([rows[(i - axis) % 3][(j - axis) % 3] for j in range(3)]) for i in range(3)])


def _along(x: Float[Array, ""], axis: int) -> Float[Array, "3"]:
    return jnp.stack([x if i == axis else jnp.zeros_like(x) for i in range(3)])


@dataclasses.dataclass(frozen=True)
class Euler:
    """Three successive rotations, each about an axis that the previous ones have turned; made by `euler`.

    - `sequence`: the axes, such as "zxz".
    """

    sequence: str

    def __call__(self, angles: Any) -> Float[Array, "3 3"]:
        """The rotation matrix of three `angles` in rad."""
        about = {"x": rotation_x, "y": rotation_y, "z": rotation_z}
        first, second, third = (about[axis](angle) for axis, angle in zip(self.sequence, _three(angles), strict=True))
        return first @ second @ third

    def margin(self, angles: Any) -> Float[Array, ""]:
        """How far the `angles` are from their singularity, where the first and third axes coincide: 1 at best, 0 at the singularity.

        |sin β| where first and third axis have the same name, |cos β| otherwise; rates of the angles grow by its inverse.
        """
        _, beta, _ = _three(angles)
        return jnp.abs(jnp.sin(beta) if self.sequence[0] == self.sequence[2] else jnp.cos(beta))


def euler(sequence: str) -> Euler:
    r"""Three successive rotations, each about an axis that the previous ones have turned.

    $$ R = R_a(\alpha)\, R_b(\beta)\, R_c(\gamma) \text{ for the sequence } abc $$

    "zxz": precession, nutation and spin of a top; "zyx": yaw, pitch and roll; "zxy": yaw, roll and pitch of a bicycle.

    **Arguments:** `sequence`: three of the letters x, y, z, no two neighbours alike.

    **Returns:** a function of three angles in rad (an array, a sequence, or a dict of three in this order), whose value is a rotation
    matrix; its method `margin(angles)` says how far they are from their singularity, from 1 to 0. At 0 the mass matrix is singular and
    steps become small: let an event end the motion before, or use quaternions.

    **Raises:** `ValueError` if the sequence is none, or repeats an axis.

    **Source:** Goldstein, Classical Mechanics, 3rd ed., section 4.4 and appendix A.

    ```python
    import jaxlag as jl
    top = jl.rigid.euler("zxz")
    top([0.1, 0.2, 0.3])[2, 2]  # cos 0.2 = 0.9801
    jl.Event(when=lambda q: top.margin([q["phi"], q["theta"], q["psi"]]) - 1e-3, stop=True)  # before the singularity
    ```
    """
    if not (isinstance(sequence, str) and len(sequence) == 3 and set(sequence) <= set("xyz")):
        raise ValueError(f"`sequence` must be three of the letters x, y, z, but is {sequence!r}. Write e.g. 'zxz'.")
    if sequence[0] == sequence[1] or sequence[1] == sequence[2]:
        raise ValueError(f"`sequence` must not turn twice about the same axis in a row, but is {sequence!r}. Write e.g. 'zxz' or 'zyx'.")
    return Euler(sequence)


def rotation_vector(r: Any) -> Float[Array, "3 3"]:
    r"""Rotation about a vector by its length in rad, the exponential map.

    $$ R = 1 + \frac{\sin\alpha}{\alpha}[r]_\times + \frac{1 - \cos\alpha}{\alpha^2}[r]_\times^2, \qquad \alpha = |r| $$

    Smooth at r = 0. It is singular at angles of 2π.

    **Arguments:** `r`: three numbers. **Returns:** a rotation matrix, (3, 3).

    **Raises:** `ValueError` if `r` has another shape.

    **Source:** Murray, Li & Sastry, A Mathematical Introduction to Robotic Manipulation, eq. 2.14.

    ```python
    from jaxlag import rigid
    rigid.rotation_vector([0.0, 0.0, 0.3])[0, 1]  # −sin 0.3 = −0.2955
    ```
    """
    r = vector(r, "r")
    K, square = skew(r), r @ r
    return one(r) + _ratio(square, 1, jnp.sin, lambda a: a) * K + _ratio(square, 2, lambda a: 1 - jnp.cos(a), jnp.square) * (K @ K)


def _ratio(square: Array, first: int, above: Callable, below: Callable) -> Array:
    """sin α/α or (1 − cos α)/α² as a function of α², by its series for small angles, so that all derivatives are right there, too."""
    small = square < 1
    terms = [(-1) ** k / math.factorial(2 * k + first) for k in range(SERIES)]
    series = jnp.polyval(jnp.array(terms[::-1], square.dtype), jnp.where(small, square, 0))
    angle = jnp.sqrt(jnp.where(small, 1, square))
    return jnp.where(small, series, above(angle) / below(angle))


def _three(angles: Any) -> tuple:
    """Three angles from an array, a sequence or a dict."""
    given = tuple(angles.values()) if isinstance(angles, dict) else tuple(angles)
    if len(given) != 3:
        raise ValueError(f"`angles` must be three numbers, but are {len(given)}. Give one for each letter of the sequence.")
    return given
