"""Ready parts of machines whose forces jump or bend: springs with play, end stops, dead zones, saturation, curves from a table.

Potentials V(x) are subtracted in L, forces are returned by functions of `force`. Where they jump or bend is located (`jl.surfaces`), so
that the motion, and its derivatives by where that is, are exact. Any consistent units.
"""

from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Real

Number: TypeAlias = Real[ArrayLike, "..."]
Value: TypeAlias = Float[Array, "..."]


def gap_spring(x: Number, c: Number, play: Number) -> Value:
    r"""Potential of a spring with play, as between the flanks of a gear or in a worn joint.

    $$ V = \tfrac12 c\, \max(|x| - \tfrac12 s, 0)^2 $$

        force            /
                        /
              _________/        no force in the gap of width s
             /
            /            x

    **Arguments:** `x`, displacement; `c`, stiffness; `play`, the whole width s. Arrays are taken element by element.

    **Returns:** the potential energy; subtract it in L.

    **Source:** Nordin & Gutman, Controlling mechanical systems with backlash: a survey, Automatica 38 (2002) 1633-1649.

    ```python
    from jaxlag import elements
    elements.gap_spring(0.3, c=100.0, play=0.2)  # ½ · 100 · 0.2² = 2.0
    ```
    """
    return 0.5 * c * dead_zone(x, jnp.asarray(play) / 2) ** 2


def end_stop(x: Number, v: Number, c: Number, d: Number = 0.0) -> Value:
    r"""Force on what has run into an elastic, damped stop, which pushes and never pulls.

    $$ F = -\max(c\,x + d\,\dot x,\ 0) \quad \text{where } x > 0, \qquad 0 \text{ elsewhere} $$

    **Arguments:** `x`, how far it has run into the stop; `v`, its velocity, positive into the stop; `c`, stiffness; `d`, damping, which
    makes the force jump at first touch. Arrays are taken element by element. For a stop that is met at x = a from below, pass x − a.

    **Returns:** the force along x.

    **Source:** Gilardi & Sharf, Literature survey of contact dynamics modelling, Mech. Mach. Theory 37 (2002) 1213-1239, section 4.

    ```python
    from jaxlag import elements
    elements.end_stop(0.01, 1.0, c=1000.0, d=5.0)  # −15
    elements.end_stop(0.01, -3.0, c=1000.0, d=5.0)  # 0: it does not pull
    ```
    """
    return jnp.where(jnp.asarray(x) > 0, -_pushing(c * x + d * v), 0.0)


def hunt_crossley(x: Number, v: Number, c: Number, lam: Number = 0.0, n: Number = 1.5) -> Value:
    r"""Force of a contact that is soft and lossy, without a jump at first touch.

    $$ F = -\max(c\,x^n (1 + \lambda \dot x),\ 0) \quad \text{where } x > 0, \qquad 0 \text{ elsewhere} $$

    For slow impacts the coefficient of restitution is e ≈ 1 − ⅔ λ v, with v the speed of approach.

    **Arguments:** `x` and `v` as of `end_stop`; `c`, of unit force per lengthⁿ; `lam`, λ, an inverse speed; `n`, 3/2 for spheres (Hertz).

    **Returns:** the force along x.

    **Source:** Hunt & Crossley, Coefficient of restitution interpreted as damping in vibroimpact, J. Appl. Mech. 42 (1975) 440-445.

    ```python
    from jaxlag import elements
    elements.hunt_crossley(0.01, 1.0, c=1e6, lam=0.2)  # −1000 · 1.2
    ```
    """
    inside = jnp.asarray(x) > 0
    depth = jnp.where(inside, x, 1.0)  # so that no power of a negative number is differentiated
    return jnp.where(inside, -_pushing(c * depth**n * (1 + lam * v)), 0.0)


def preload(x: Number, c: Number, F: Number) -> Value:
    r"""Potential of a spring that is preloaded in both directions: it gives way only under more than F.

    $$ V = F |x| + \tfrac12 c\,x^2 $$

    The force jumps from −F to F at x = 0. A motion that comes to rest there ends with a reason: where that may happen, let the force bend
    over a short distance, as `saturation` does.

    **Arguments:** `x`, displacement; `c`, stiffness beyond the preload; `F`, preload, not negative.

    **Returns:** the potential energy; subtract it in L.

    **Source:** Thomson & Dahleh, Theory of Vibration with Applications, 5th ed., chapter 14 (piecewise linear springs).

    ```python
    from jaxlag import elements
    elements.preload(-0.1, c=10.0, F=2.0)  # 0.2 + 0.05
    ```
    """
    return F * jnp.abs(jnp.asarray(x)) + 0.5 * c * jnp.asarray(x) ** 2


def bilinear(x: Number, c_1: Number, c_2: Number, edge: Number = 0.0) -> Value:
    r"""Potential of a spring of stiffness c₁ up to an edge, and c₂ beyond.

    $$ V = \tfrac12 c_1 x^2 + \tfrac12 (c_2 - c_1) \max(x - a, 0)^2 $$

    With the edge at 0, the frequency of a mass on it is 2 ω₁ω₂/(ω₁ + ω₂), at every amplitude.

    **Arguments:** `x`, displacement; `c_1`, `c_2`, stiffnesses; `edge`, a.

    **Returns:** the potential energy; subtract it in L.

    **Source:** Shaw & Holmes, A periodically forced piecewise linear oscillator, J. Sound Vib. 90 (1983) 129-155.

    ```python
    from jaxlag import elements
    elements.bilinear(2.0, c_1=1.0, c_2=3.0, edge=1.0)  # 2 + 1
    ```
    """
    return 0.5 * c_1 * jnp.asarray(x) ** 2 + 0.5 * (c_2 - c_1) * jnp.maximum(x - edge, 0.0) ** 2


def dead_zone(x: Number, width: Number) -> Value:
    """What of x lies outside of ±width: x − width, 0, x + width.

    **Arguments:** `x`, of any unit, and `width`, of the same, not negative.

    **Returns:** a number of that unit.

    **Source:** Khalil, Nonlinear Systems, 3rd ed., section 1.2.7.

    ```python
    from jaxlag import elements
    elements.dead_zone(-0.5, 0.2)  # −0.3
    ```
    """
    return jnp.maximum(x - width, 0.0) + jnp.minimum(x + width, 0.0)  # two terms, so that a width of zero has a slope


def saturation(x: Number, limit: Number) -> Value:
    """x, but no more than ±limit: the force of a drive, or what a controller can ask for.

    **Arguments:** `x`, of any unit, and `limit`, of the same, not negative. In `force`, x may depend on velocities and states.

    **Returns:** a number of that unit.

    **Source:** Khalil, Nonlinear Systems, 3rd ed., section 1.2.7.

    ```python
    from jaxlag import elements
    elements.saturation(-5.0, 2.0)  # −2
    ```
    """
    return x - dead_zone(x, limit)


def table(x: Number, xs: Any, ys: Any) -> Value:
    """A curve of straight pieces through measured points, constant beyond its ends: a force, a stiffness, a torque over an angle.

    **Arguments:** `x`, where it is asked for; `xs`, increasing, and `ys`, of shape (n,), n ≥ 2, which may be parameters.

    **Returns:** y at x, shaped like x.

    **Raises:** `ValueError` if `xs` and `ys` are not of one length of two or more, or `xs` are known and do not increase.

    **Source:** as `numpy.interp`.

    ```python
    import numpy as np
    from jaxlag import elements
    elements.table(0.25, np.array([0.0, 0.5, 1.0]), np.array([0.0, 2.0, 3.0]))  # 1.0
    ```
    """
    xs, ys = _points(xs, ys)
    return jnp.interp(jnp.asarray(x, xs.dtype), xs, ys)


def table_integral(x: Number, xs: Any, ys: Any) -> Value:
    r"""The integral of a `table` from its first point on: the potential of a spring whose force was measured.

    $$ V(x) = \int_{x_1}^{x} y(\xi)\,d\xi $$

    **Arguments:** as of `table`.

    **Returns:** V; subtract it in L, where y is the force that the spring takes.

    **Raises:** as `table`.

    ```python
    import numpy as np
    from jaxlag import elements
    elements.table_integral(1.0, np.array([0.0, 0.5, 1.0]), np.array([0.0, 2.0, 3.0]))  # 0.5 + 1.25
    ```
    """
    xs, ys = _points(xs, ys)
    x = jnp.asarray(x, xs.dtype)
    widths, slopes = jnp.diff(xs), jnp.diff(ys) / jnp.diff(xs)
    before = jnp.concatenate([jnp.zeros(1, xs.dtype), jnp.cumsum(widths * (ys[1:] + ys[:-1]) / 2)])
    i = jnp.searchsorted(xs, x, side="right")  # 0 before the first, n behind the last
    left, inside = jnp.maximum(i - 1, 0), (i > 0) & (i < xs.size)
    s = x - xs[left]
    return before[left] + s * ys[left] + jnp.where(inside, slopes[jnp.minimum(left, xs.size - 2)], 0.0) * s**2 / 2


def _pushing(force: Any) -> Array:
    """A force that pushes, or none; where it is zero, its slopes are those of the force, so that parameters may be zero."""
    return force + jax.nn.relu(-force)


def _points(xs: Any, ys: Any) -> tuple[Array, Array]:
    """Those of a table, checked."""
    xs, ys = jnp.asarray(xs), jnp.asarray(ys)
    if xs.ndim != 1 or xs.shape != ys.shape or xs.size < 2:
        raise ValueError(f"`xs` and `ys` must be of one length, two or more, but have the shapes {xs.shape} and {ys.shape}. Give pairs.")
    try:
        increases = bool(jnp.all(jnp.diff(xs) > 0))
    except jax.errors.TracerBoolConversionError:
        increases = True  # parameters are not known here
    if not increases:
        raise ValueError(f"`xs` must increase, but {xs} do not. Sort them with their `ys`, and name each once.")
    dtype = jnp.result_type(xs, ys, float)
    return xs.astype(dtype), ys.astype(dtype)
