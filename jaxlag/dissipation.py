"""Dissipation potentials D(v) of a relative velocity v: friction, dampers, drag.

    force −∂D/∂v,    power −v · ∂D/∂v,    v · ∂D/∂v = n D where D is homogeneous of degree n (Euler)

v is a scalar or a vector, in which case D depends on its Euclidean norm ‖v‖. Any consistent units. Terms of D add up, so a damper with
dry friction is `viscous(v, b) + sliding(v, mu, N)`. Every potential has finite first and second derivatives at rest, v = 0. Where D is
nonsmooth there, it contains ‖v‖ once, as `speed(v)`, and its slope at rest is that of `speed`.
"""

import math
from collections.abc import Mapping
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Real

Velocity = Any  # a number, a vector or a list of numbers: `_velocity` checks it
Number: TypeAlias = Real[ArrayLike, ""]


def speed(v: Velocity) -> Float[Array, ""]:
    r"""Speed ‖v‖ whose derivatives at rest are 0, where those of `jnp.linalg.norm` are NaN.

    $$ s = \lVert v\rVert = \sqrt{v\cdot v}, \qquad \frac{\partial s}{\partial v} = \frac{v}{\lVert v\rVert}, \quad 0 \text{ at } v = 0 $$

    For a scalar it is `jnp.abs(v)`, whose slope at 0 JAX takes from the right: 1, not 0.

    **Arguments:** `v`, a scalar or a vector of shape (n,). Any consistent units. A vector counts as at rest if ‖v‖² underflows (‖v‖ below
    1.5e-154 in double, 1.1e-19 in single precision).

    **Returns:** a scalar.

    **Raises:** `ValueError` or `TypeError` if `v` is neither a scalar nor a vector.

    **Source:** Rockafellar, Convex Analysis, section 23: at 0 the subgradients of ‖v‖ form the unit ball; zero has the least norm.

    ```python
    import jax
    import jax.numpy as jnp
    from jaxlag import dissipation
    dissipation.speed(jnp.array([3.0, -4.0]))  # 5.0
    jax.grad(dissipation.speed)(jnp.zeros(2))  # [0.0, 0.0]
    ```
    """
    v = _velocity(v)
    return _norm(v) if v.ndim else jnp.abs(v)


def sliding(v: Velocity, mu: Number, N: Number) -> Float[Array, ""]:
    r"""Dry (Coulomb) friction: a force of constant magnitude μN against the motion.

    $$ D = \mu N \lVert v\rVert, \qquad -\frac{\partial D}{\partial v} = -\mu N \frac{v}{\lVert v\rVert}, \qquad
       \text{power } -\mu N \lVert v\rVert = -D $$

    Homogeneous of degree 1. D is nonsmooth at rest, where the force may have any magnitude up to μN. Autodiff of D returns one such
    force, 0 for a vector and −μN for a scalar (see `speed`), and 0 for the Hessian.

    **Arguments:**

    - `v`: slip velocity, a scalar or of shape (n,).
    - `mu`: coefficient of friction, dimensionless, a scalar.
    - `N`: normal force, a scalar, not negative; of a multiplier take `jnp.abs`.

    Any consistent units.

    **Returns:** a scalar, power.

    **Raises:** as `speed`.

    **Source:** Lurie, Analytical Mechanics (Springer 2002), for dissipation functions other than Rayleigh's.

    ```python
    from jaxlag import dissipation
    dissipation.sliding(-2.0, 0.3, 10.0)  # 6.0
    ```
    """
    return mu * N * speed(v)


def viscous(v: Velocity, b: ArrayLike) -> Float[Array, ""]:
    r"""Linear damper: Rayleigh's dissipation function, half the dissipated power.

    $$ D = \tfrac12 b\, v\cdot v, \qquad -\frac{\partial D}{\partial v} = -b\,v, \qquad \text{power } -b\,v\cdot v = -2D $$

    and with a matrix $D = \tfrac12 v^T B v$, whose force is $-\tfrac12(B + B^T) v$: only the symmetric part of B enters, since the
    antisymmetric part does no work (a gyroscopic force belongs in L). Homogeneous of degree 2; smooth at rest.

    **Arguments:**

    - `v`: relative velocity, a scalar or of shape (n,).
    - `b`: damping, force per velocity: a scalar, or a matrix of shape (n, n), which dissipates if its symmetric part is positive
      semidefinite.

    Any consistent units.

    **Returns:** a scalar, half the dissipated power.

    **Raises:** as `speed`; `ValueError` if `b` has another shape.

    **Source:** Goldstein, Classical Mechanics, 3rd ed., section 1.5; Rayleigh, The Theory of Sound, vol. I, section 81.

    ```python
    import jax.numpy as jnp
    from jaxlag import dissipation
    dissipation.viscous(2.0, 3.0)  # 6.0
    dissipation.viscous(jnp.array([1.0, 2.0]), jnp.array([[4.0, 1.0], [1.0, 2.0]]))  # 8.0
    ```
    """
    v, b = _velocity(v), jnp.asarray(b)
    if b.shape not in ((), v.shape * 2):
        raise ValueError(
            f"`b` must be a scalar or, for a vector `v`, a square matrix of its size, but has shape {b.shape} where `v` has {v.shape}. "
            "For one damping coefficient per component, pass `jnp.diag(b)`."
        )
    return 0.5 * _dot(v, b @ v if b.ndim else b * v)


def drag(v: Velocity, k: Number) -> Float[Array, ""]:
    r"""Quadratic drag of a body in a turbulent fluid.

    $$ D = \tfrac13 k \lVert v\rVert^3, \qquad -\frac{\partial D}{\partial v} = -k \lVert v\rVert v, \qquad
       \text{power } -k \lVert v\rVert^3 = -3D $$

    Homogeneous of degree 3. Twice differentiable at rest, with gradient and Hessian 0.

    **Arguments:**

    - `v`: velocity relative to the fluid, a scalar or of shape (n,).
    - `k`: force per velocity squared, a scalar: ½ρ c_w A for a body of area A and drag coefficient c_w in a fluid of density ρ.

    Any consistent units.

    **Returns:** a scalar, a third of the dissipated power.

    **Raises:** as `speed`.

    **Source:** Taylor, Classical Mechanics, section 2.4 (force); for dissipation functions other than Rayleigh's, Lurie, Analytical
    Mechanics (Springer 2002).

    ```python
    from jaxlag import dissipation
    dissipation.drag(-3.0, 0.5)  # 4.5
    ```
    """
    return k * speed(v) ** 3 / 3


def power_law(v: Velocity, c: Number, n: Number) -> Float[Array, ""]:
    r"""Damper whose force is a power n of the speed: 0 dry friction, 1 linear, 2 quadratic; fluid dampers in buildings 0.3 to 1.

    $$ D = \frac{c}{n+1} \lVert v\rVert^{n+1}, \qquad -\frac{\partial D}{\partial v} = -c \lVert v\rVert^{n-1} v, \qquad
       \text{power } -c \lVert v\rVert^{n+1} = -(n+1)D $$

    Homogeneous of degree n + 1. For n = 0 D is nonsmooth at rest, as `sliding` is. For 0 < n < 1 its second derivative is unbounded
    towards rest; at rest itself the value returned is 0. For n = 1 the Hessian at rest is c times the identity, for n > 1 it is 0.

    **Arguments:**

    - `v`: relative velocity, a scalar or of shape (n,).
    - `c`: force at unit speed, a scalar; its unit depends on n: force per velocity to the power n.
    - `n`: exponent of the force, a real scalar, not negative; may be a parameter, and D is differentiable in it. For dry friction use
      `sliding`, or write the literal 0: dry friction is not recognised in a parameter that happens to be 0, and a motion with it fails
      with a message that says so.

    Any consistent units.

    **Returns:** a scalar, the dissipated power divided by n + 1.

    **Raises:** as `speed`.

    **Source:** Soong & Dargush, Passive Energy Dissipation Systems in Structural Engineering (Wiley 1997), fluid dampers.

    ```python
    from jaxlag import dissipation
    dissipation.power_law(4.0, 3.0, 0.5)  # 16.0
    ```
    """
    v = _velocity(v)
    s, n = speed(v), jnp.asarray(n, v.dtype)
    # The zero slope of `speed` at rest hides from autodiff that s² = v · v has the Hessian 2 there. Elsewhere the difference is zero.
    hessian_at_rest = jnp.where(n == 1, _dot(v, v) - s**2, 0)
    return c * (_power(s, n + 1) + hessian_at_rest) / (n + 1)


def stribeck(v: Velocity, F_c: Number, F_s: Number, v_s: Number, delta: Number = 2) -> Float[Array, ""]:
    r"""Dry friction that falls from F_s at rest to F_c at high speed (Stribeck's curve).

    $$ D = \int_0^s F\,ds, \qquad F = F_c + (F_s - F_c)\, e^{-(s/v_s)^\delta}, \qquad s = \lVert v\rVert, \qquad
       -\frac{\partial D}{\partial v} = -F \frac{v}{s}, \qquad \text{power } -F s $$

    $$ D = F_c s + (F_s - F_c)\, v_s \tfrac{\sqrt\pi}{2} \operatorname{erf}(s/v_s) \quad (\delta = 2), \qquad
       D = F_c s + (F_s - F_c)\, v_s \left(1 - e^{-s/v_s}\right) \quad (\delta = 1) $$

    Not homogeneous: Euler's identity does not hold, and D is not a fixed fraction of the power. Where the force falls, which is everywhere
    if F_s > F_c, D is not convex: friction grows as a body slows down, and a spring that pulls it slowly makes it stick and slip. D is
    nonsmooth at rest, as `sliding` is, with the bound F_s. Viscous friction is a separate term: add `viscous(v, b)`.

    **Arguments:**

    - `v`: slip velocity, a scalar or of shape (n,).
    - `F_c`, `F_s`: Coulomb and static friction force, scalars, not negative; with a normal force, μ_c N and μ_s N.
    - `v_s`: Stribeck velocity, a positive scalar.
    - `delta`: shape of the fall, 2 (Gaussian) or 1 (exponential); written into the call, not a parameter.

    Any consistent units.

    **Returns:** a scalar, power.

    **Raises:** as `speed`; `ValueError` if `delta` is neither 1 nor 2.

    **Source:** Armstrong-Hélouvry, Dupont & Canudas de Wit, Automatica 30 (1994) 1083–1138 (force).

    ```python
    from jaxlag import dissipation
    dissipation.stribeck(0.1, 2.0, 3.0, 0.1)  # 0.2746824132812427
    ```
    """
    if isinstance(delta, jax.Array) or delta not in (1, 2):
        raise ValueError(
            f"`delta` must be 1 or 2, but is {delta}. Write the number into the call, not into params; "
            "for another curve, write D with `jaxlag.dissipation.speed(v)`."
        )
    s = speed(v)
    x = s / v_s
    fall = 0.5 * math.sqrt(math.pi) * jax.scipy.special.erf(x) if delta == 2 else -jnp.expm1(-x)
    return F_c * s + (F_s - F_c) * v_s * fall


def _velocity(v: Any) -> Float[Array, "*n"]:
    if isinstance(v, Mapping):
        raise TypeError(
            f"`v` must be a scalar or a vector, but is a {type(v).__name__}. Pass one relative velocity, e.g. an entry `qdot['x']`."
        )
    v = jnp.asarray(v)
    if v.ndim > 1:
        raise ValueError(f"`v` must be a scalar or a vector, but has shape {v.shape}. Pass one relative velocity; for many use `jax.vmap`.")
    return v.astype(float) if jnp.issubdtype(v.dtype, jnp.integer) else v


def _dot(u: Float[Array, "*n"], v: Float[Array, "*n"]) -> Float[Array, ""]:
    return u @ v if v.ndim else u * v


def _at_rest(s: Float[Array, ""]) -> Bool[Array, ""]:
    return s**2 < jnp.finfo(s.dtype).tiny  # not s == 0, because 1/s² in second derivatives must not overflow; NaN is not rest


@jax.custom_jvp
def _norm(v: Float[Array, " n"]) -> Float[Array, ""]:
    return jnp.linalg.norm(v)


@_norm.defjvp
def _norm_jvp(primals, tangents):
    (v,), (dv,) = primals, tangents
    s = _norm(v)
    still = _at_rest(s)
    direction = jnp.where(still, 0, v) / jnp.where(still, 1, s)
    return s, direction @ dv


@jax.custom_jvp
def _power(s: Float[Array, ""], p: Float[Array, ""]) -> Float[Array, ""]:
    """s^p for s ≥ 0 and real p, with 0 in place of an infinite power of zero: autodiff multiplies it by zero, which must not give NaN."""
    return jnp.where((s < jnp.finfo(s.dtype).tiny) & (p < 0), 0, s**p)


@_power.defjvp
def _power_jvp(primals, tangents):
    (s, p), (ds, dp) = primals, tangents
    out = _power(s, p)
    log = jnp.log(jnp.where(s == 0, 1, s))
    return out, p * _power(s, p - 1) * ds + log * out * dp
