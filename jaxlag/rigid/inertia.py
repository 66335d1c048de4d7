"""Moments of inertia about the centre of mass, in the axes of the body; of bodies of uniform density, from their mass and lengths.

Θ is a matrix (3, 3); the formulas give the three moments about principal axes, (3,), which every function of `rigid` takes as well. Any
consistent units. `physical` makes of ten free numbers the mass, the centre and the inertia of a body that can exist: for fits.

Source of the formulas: Meriam & Kraige, Engineering Mechanics: Dynamics, table D/4.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._vectors import floating, known, one, vector

__all__ = [
    "Body",
    "Principal",
    "box",
    "cylinder",
    "ellipsoid",
    "hollow_cylinder",
    "hollow_sphere",
    "log_cholesky",
    "matrix",
    "physical",
    "principal_axes",
    "rotated",
    "sphere",
    "steiner",
]


def box(m: Any, a: Any, b: Any, c: Any) -> Float[Array, "3"]:
    """Moments of inertia of a box with edges a, b, c along x, y, z: m/12 (b² + c²) and so on.

    **Arguments:** `m`: its mass; `a`, `b`, `c`: its edges. **Returns:** the moments, (3,).

    **Raises:** nothing.

    ```python
    from jaxlag import rigid
    rigid.inertia.box(12.0, 1.0, 2.0, 3.0)  # [13, 10, 5]
    ```
    """
    return m / 12 * jnp.stack([floating(b**2 + c**2), floating(a**2 + c**2), floating(a**2 + b**2)])


def cylinder(m: Any, r: Any, h: Any) -> Float[Array, "3"]:
    """Moments of inertia of a cylinder about x, y and its axis z: m (3 r² + h²)/12 twice, ½ m r². With h = 0 a disc, with r = 0 a rod.

    **Arguments:** `m`: its mass; `r`: its radius; `h`: its height along z. **Returns:** the moments, (3,).

    **Raises:** nothing.

    ```python
    from jaxlag import rigid
    rigid.inertia.cylinder(12.0, 1.0, 2.0)  # [7, 7, 6]
    ```
    """
    return hollow_cylinder(m, r, 0.0, h)


def hollow_cylinder(m: Any, R: Any, r: Any, h: Any) -> Float[Array, "3"]:
    """Moments of inertia of a tube about x, y and its axis z: m (3 (R² + r²) + h²)/12 twice, ½ m (R² + r²). With r = R a hoop.

    **Arguments:** `m`: its mass; `R`, `r`: its outer and inner radius; `h`: its height along z. **Returns:** the moments, (3,).

    **Raises:** nothing.

    ```python
    from jaxlag import rigid
    rigid.inertia.hollow_cylinder(12.0, 2.0, 1.0, 3.0)  # [24, 24, 30]
    ```
    """
    across = floating(m * (3 * (R**2 + r**2) + h**2) / 12)
    return jnp.stack([across, across, floating(m * (R**2 + r**2) / 2)])


def sphere(m: Any, r: Any) -> Float[Array, "3"]:
    """Moments of inertia of a ball: ⅖ m r² about every axis.

    **Arguments:** `m`: its mass; `r`: its radius. **Returns:** the moments, (3,).

    **Raises:** nothing.

    ```python
    from jaxlag import rigid
    rigid.inertia.sphere(5.0, 2.0)  # [8, 8, 8]
    ```
    """
    return jnp.full(3, floating(0.4 * m * r**2))


def hollow_sphere(m: Any, R: Any, r: Any) -> Float[Array, "3"]:
    """Moments of inertia of a hollow ball: ⅖ m (R⁵ − r⁵)/(R³ − r³) about every axis, ⅔ m R² where it is thin; r = R included.

    **Arguments:** `m`: its mass; `R`, `r`: its outer and inner radius. **Returns:** the moments, (3,).

    **Raises:** nothing.

    ```python
    from jaxlag import rigid
    rigid.inertia.hollow_sphere(7.0, 2.0, 1.0)  # ⅖ · 31 = [12.4, 12.4, 12.4]
    ```
    """
    fifth = R**4 + R**3 * r + R**2 * r**2 + R * r**3 + r**4  # (R⁵ − r⁵)/(R − r)
    return jnp.full(3, floating(0.4 * m * fifth / (R**2 + R * r + r**2)))


def ellipsoid(m: Any, a: Any, b: Any, c: Any) -> Float[Array, "3"]:
    """Moments of inertia of an ellipsoid with semi-axes a, b, c along x, y, z: m/5 (b² + c²) and so on.

    **Arguments:** `m`: its mass; `a`, `b`, `c`: its semi-axes. **Returns:** the moments, (3,).

    **Raises:** nothing.

    ```python
    from jaxlag import rigid
    rigid.inertia.ellipsoid(5.0, 1.0, 2.0, 3.0)  # [13, 10, 5]
    ```
    """
    return 2.4 * box(m, a, b, c)


def steiner(Theta: Any, m: Any, r: Any) -> Float[Array, "3 3"]:
    r"""Inertia about another point than the centre of mass: Θ + m (r·r 1 − r rᵀ).

    **Arguments:** `Theta`: about the centre of mass, (3, 3) or (3,); `m`: the mass; `r`: from one point to the other, (3,).

    **Returns:** a matrix, (3, 3), in the same axes. **Raises:** `ValueError` if Θ is that of no body, or r is no vector.

    **Source:** Goldstein, Classical Mechanics, 3rd ed., section 5.3 (the parallel axis theorem).

    ```python
    from jaxlag import rigid
    rigid.inertia.steiner([1.0, 2.0, 2.5], 3.0, [0.0, 0.0, 2.0])  # [[13, 0, 0], [0, 14, 0], [0, 0, 2.5]]
    ```
    """
    r = vector(r, "r")
    return matrix(Theta) + m * ((r @ r) * one(r) - jnp.outer(r, r))


def rotated(Theta: Any, R: Any) -> Float[Array, "3 3"]:
    """Inertia in other axes, R Θ Rᵀ.

    **Arguments:** `Theta`: (3, 3) or (3,) in the axes of a part; `R`: turns components in these into those wanted, (3, 3).

    **Returns:** a matrix, (3, 3). Those of parts about one point in the same axes add up.

    **Raises:** `ValueError` if Θ is that of no body.

    ```python
    import jax.numpy as jnp
    from jaxlag import rigid
    rigid.inertia.rotated([1.0, 2.0, 2.5], rigid.rotation_z(jnp.pi / 2))  # [[2, 0, 0], [0, 1, 0], [0, 0, 2.5]]
    ```
    """
    return R @ matrix(Theta) @ R.T


class Principal(NamedTuple):
    """The principal `moments` of an inertia, (3,), the least first, and its principal `axes`, the columns of a rotation, (3, 3)."""

    moments: Float[Array, "3"]
    axes: Float[Array, "3 3"]


def principal_axes(Theta: Any) -> Principal:
    """Principal moments and axes: Θ = A diag(moments) Aᵀ.

    **Arguments:** `Theta`: (3, 3) or (3,).

    **Returns:** `Principal(moments, axes)`. Derivatives of the axes exist where no two moments are equal.

    **Raises:** `ValueError` if Θ is that of no body. **Source:** Goldstein, Classical Mechanics, 3rd ed., section 5.4.

    ```python
    from jaxlag import rigid
    rigid.inertia.principal_axes([2.0, 1.0, 2.5]).moments  # [1, 2, 2.5]
    ```
    """
    moments, axes = jnp.linalg.eigh(matrix(Theta))
    return Principal(moments, axes * jnp.where(jnp.linalg.det(axes) < 0, -1, 1))


class Body(NamedTuple):
    """Mass `m`, centre of mass `c`, (3,), and inertia `Theta` about it, (3, 3), in the axes of the body."""

    m: Float[Array, ""]
    c: Float[Array, "3"]
    Theta: Float[Array, "3 3"]


def physical(x: Any) -> Body:
    r"""Mass, centre of mass and inertia of ten numbers: each set of them is a body that can exist, and each body one set.

    $$ U = e^\alpha \begin{pmatrix} e^{d_1} & s_{12} & s_{13} & t_1 \\ & e^{d_2} & s_{23} & t_2 \\ & & e^{d_3} & t_3 \\ & & & 1
       \end{pmatrix}, \qquad U U^T = \begin{pmatrix} \Sigma & m c \\ m c^T & m \end{pmatrix}, \qquad
       \Theta = \mathrm{tr}(\Sigma_c)\,1 - \Sigma_c, \quad \Sigma_c = \Sigma - m c c^T $$

    An entry of params for fits: no step makes a mass negative, or a moment of inertia greater than the sum of the others.

    **Arguments:** `x`: (α, d₁, d₂, d₃, s₁₂, s₂₃, s₁₃, t₁, t₂, t₃), as `log_cholesky` makes them.

    **Returns:** `Body(m, c, Theta)`. **Raises:** `ValueError` if `x` is not ten numbers.

    **Source:** Rucker & Wensing, Smooth parameterization of rigid-body inertia, IEEE Robot. Autom. Lett. 7 (2022) 2771, eq. 9.

    ```python
    import jax.numpy as jnp
    from jaxlag import rigid
    rigid.inertia.physical(jnp.zeros(10)).Theta  # [[2, 0, 0], [0, 2, 0], [0, 0, 2]]
    ```
    """
    alpha, d1, d2, d3, s12, s23, s13, *t = vector(x, "x", 10)
    zero = jnp.zeros_like(alpha)
    L = jnp.stack([jnp.stack([jnp.exp(d1), s12, s13]), jnp.stack([zero, jnp.exp(d2), s23]), jnp.stack([zero, zero, jnp.exp(d3)])])
    m = jnp.exp(2 * alpha)
    spread = m * L @ L.T
    return Body(m, jnp.stack(t), jnp.trace(spread) * one(spread) - spread)


def log_cholesky(m: Any, c: Any, Theta: Any) -> Float[Array, "10"]:
    """The ten numbers of a body, from which `physical` makes it again: a guess for a fit.

    **Arguments:** `m`: its mass; `c`: its centre of mass, (3,); `Theta`: its inertia about it, (3, 3) or (3,).

    **Returns:** (10,). **Raises:** `ValueError` if no body has this inertia, or only one without thickness.

    **Source:** Rucker & Wensing, Smooth parameterization of rigid-body inertia, IEEE Robot. Autom. Lett. 7 (2022) 2771, eq. 9.

    ```python
    from jaxlag import rigid
    x = rigid.inertia.log_cholesky(2.0, [0.1, 0.0, 0.0], rigid.inertia.box(2.0, 0.1, 0.2, 0.3))
    rigid.inertia.physical(x).m  # 2
    ```
    """
    c, Theta = vector(c, "c"), matrix(Theta)
    spread = (0.5 * jnp.trace(Theta) * one(Theta) - Theta) / m
    turned = jnp.linalg.cholesky(spread[::-1, ::-1])
    seen = known(turned)
    if seen is not None and not np.all(np.isfinite(seen)):
        raise ValueError("`Theta` must be the inertia of a body with some thickness in every direction, but is not. Add a little of it.")
    L = turned[::-1, ::-1]
    (d1, s12, s13), (_, d2, s23), (_, _, d3) = L
    return jnp.concatenate([jnp.stack([0.5 * jnp.log(m), jnp.log(d1), jnp.log(d2), jnp.log(d3), s12, s23, s13]), c])


def matrix(Theta: Any) -> Float[Array, "3 3"]:
    """An inertia as a matrix, (3, 3), from that or from its principal moments, (3,).

    **Arguments:** `Theta`: (3, 3) or (3,). **Returns:** (3, 3). **Raises:** `ValueError` if no body has it, as far as its numbers are
    known.

    ```python
    from jaxlag import rigid
    rigid.inertia.matrix([1.0, 2.0, 2.5])  # [[1, 0, 0], [0, 2, 0], [0, 0, 2.5]]
    ```
    """
    Theta = check_inertia(Theta, "`Theta`")
    return Theta if Theta.ndim == 2 else jnp.diag(Theta)


def check_inertia(Theta: Any, name: str) -> Array:
    """An inertia as an array, checked that a body can have it, as far as its numbers are known."""
    seen, Theta = known(Theta), floating(Theta)
    if Theta.shape not in ((3,), (3, 3)):
        raise ValueError(f"{name} must be three moments of inertia or a matrix (3, 3), but has shape {Theta.shape}. Write [A, B, C].")
    if seen is None:
        return Theta
    rounding = 1e2 * float(jnp.finfo(Theta.dtype).eps) * np.max(np.abs(seen))
    if Theta.ndim == 2 and np.max(np.abs(seen - seen.T)) > rounding:
        raise ValueError(
            f"{name} must be symmetric, but is not. Products of inertia stand on both sides of the diagonal, with a minus sign."
        )
    least, middle, most = np.linalg.eigvalsh(seen) if Theta.ndim == 2 else np.sort(seen)
    if not (least >= -rounding and most <= least + middle + rounding):
        raise ValueError(
            f"{name} must have moments of which none is negative or more than the sum of the others, but has {least:g}, {middle:g} and "
            f"{most:g}: no body has these. Look for a factor, or for an inertia about another point than the centre of mass."
        )
    return Theta
