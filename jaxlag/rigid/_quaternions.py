"""Quaternions: their rotation matrices, rates and length."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from ._rates import turning
from ._vectors import check_rotation, floating, one, skew, vector


def quaternion(q: Any) -> Float[Array, "3 3"]:
    r"""Rotation of a quaternion (w, x, y, z), w = cos(α/2) first.

    $$ R = \frac{(w^2 - v\cdot v)\,1 + 2\,v v^T + 2 w\,[v]_\times}{w^2 + v\cdot v}, \qquad v = (x, y, z) $$

    A rotation for every q ≠ 0: the length of q does not matter, and nothing changes it. State it as a constraint, `holonomic={"unit":
    rigid.unit}`; a start of another length is projected onto it.

    **Arguments:** `q`: four numbers. **Returns:** a rotation matrix, (3, 3).

    **Raises:** `ValueError` if `q` has another shape.

    **Source:** Shuster, A survey of attitude representations, J. Astronaut. Sci. 41 (1993) 439, with Hamilton's product.

    ```python
    import jax.numpy as jnp
    from jaxlag import rigid
    rigid.quaternion([jnp.cos(0.1), 0.0, 0.0, jnp.sin(0.1)])[0, 1]  # −sin 0.2 = −0.1987
    ```
    """
    return _of_quaternion(vector(q, "q", 4))


def _rate_of_quaternion(numbers: Any, rates: Any) -> Float[Array, "3"]:
    """2 (w v̇ − ẇ v − v × v̇)/(q · q)."""
    (q,), (rate,) = numbers, rates
    return 2 * (q[0] * rate[1:] - rate[0] * q[1:] - jnp.cross(q[1:], rate[1:])) / (q @ q)


@turning(_rate_of_quaternion)
def _of_quaternion(q):
    w, v = q[0], q[1:]
    return ((w**2 - v @ v) * one(v) + 2 * jnp.outer(v, v) + 2 * w * skew(v)) / (q @ q)


def to_quaternion(R: Any) -> Float[Array, "4"]:
    """The unit quaternion (w, x, y, z) of a rotation, with w ≥ 0: for a start that is given by angles.

    **Arguments:** `R`: a rotation matrix, (3, 3). **Returns:** (4,). At angles of π the sign is arbitrary.

    **Raises:** `ValueError` if `R` is no rotation, as far as its numbers are known.

    **Source:** Shepperd, Quaternion from rotation matrix, J. Guid. Control 1 (1978) 223.

    ```python
    from jaxlag import rigid
    rigid.to_quaternion(rigid.rotation_z(0.2))  # [0.995, 0.0, 0.0, 0.0998]
    ```
    """
    R = check_rotation(R, "`R`")
    odd, even = R - R.T, R + R.T
    diagonal = jnp.diagonal(R)
    first = jnp.concatenate([1 + jnp.trace(R)[None], jnp.stack([odd[2, 1], odd[0, 2], odd[1, 0]])])
    others = even + jnp.diag(1 - jnp.trace(R) * jnp.ones_like(diagonal))
    products = jnp.concatenate([first[None], jnp.concatenate([first[1:, None], others], axis=1)])  # 4 q qᵀ
    q = products[jnp.argmax(jnp.diagonal(products))]  # the row of the largest component
    return q * jnp.where(q[0] < 0, -1, 1) / jnp.linalg.norm(q)


def quaternion_rate(q: Any, omega: Any) -> Float[Array, "4"]:
    r"""The rate of a quaternion at a given angular velocity, for the q̇ of a start.

    $$ \dot q = \tfrac12\, q \circ (0, \omega) $$

    **Arguments:** `q`: (w, x, y, z); `omega`: the angular velocity in the axes of the body, (3,).

    **Returns:** (4,), orthogonal to q. **Raises:** `ValueError` if `q` or `omega` has another shape.

    **Source:** Shuster, A survey of attitude representations, J. Astronaut. Sci. 41 (1993) 439.

    ```python
    from jaxlag import rigid
    rigid.quaternion_rate([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 3.0])  # [0, 0, 0, 1.5]
    ```
    """
    q, omega = vector(q, "q", 4), vector(omega, "omega")
    w, v = q[0], q[1:]
    return 0.5 * jnp.concatenate([-(v @ omega)[None], w * omega + jnp.cross(v, omega)])


def unit(q: Any) -> Float[Array, ""]:
    """q · q − 1, which is zero for a quaternion of length 1: its constraint, for `System(holonomic=...)`.

    **Arguments:** `q`: a quaternion, (4,), or any vector. **Returns:** a number.

    **Raises:** nothing.

    ```python
    from jaxlag import rigid
    rigid.unit([1.0, 0.0, 0.0, 0.0])  # 0
    ```
    """
    q = floating(q)
    return q @ q - 1
