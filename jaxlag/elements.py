"""Ready parts of machines whose forces jump or bend: springs with play, end stops, dead zones, saturation, curves from a table; and
what is lost in gears, belts, ropes and joints by the forces in them.

Potentials V(x) are subtracted in L, forces are returned by functions of `force`. Where they jump or bend is located (`jl.surfaces`), so
that the motion, and its derivatives by where that is, are exact. Losses D are terms of `dissipation`; they are exact dry friction, which
sticks. Any consistent units.
"""

from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Real

from .dissipation import speed

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


def gear(v: Number, force: Number, efficiency: Number, back: Number) -> Value:
    r"""Loss of a gear, a screw or a worm, by the force that it transmits: one efficiency where it drives, another where it is driven back.

    $$ D = \mu_1 |\lambda v| \ \text{ where } \lambda v < 0, \qquad \mu_2 |\lambda v| \ \text{ where } \lambda v > 0, \qquad
    \mu_1 = \tfrac{1}{\eta_1} - 1,\quad \mu_2 = 1 - \eta_2 $$

           M₁ →  (q₁)==mesh: q₁ − i q₂ = 0==(q₂)  → M₂        drives:       M₂ = η₁ i M₁
                      force on q₁: λ                           driven back:  M₁ = η₂ M₂ / i,  0 where η₂ ≤ 0

    The ratio i stands in a constraint, the inertias in L. With η₂ ≤ 0 the gear locks itself: no load moves it, however large. Of a worm
    with friction alone η₂ = 2 − 1/η₁.

    **Arguments:** `v`, velocity of the driving side; `force`, λ, of the mesh on the driving side, positive along v: the multiplier of
    q₁ − i q₂ = 0; `efficiency`, η₁, in (0, 1]; `back`, η₂, at most 1.

    **Returns:** a term of `dissipation`, by which the mesh sticks, too.

    **Source:** Pelchen, Schweiger & Otter, Modeling and simulating the efficiency of gearboxes and of planetary gearboxes, 2nd Modelica
    Conference (2002) 257-266.

    ```python
    import jaxlag as jl
    from jaxlag import elements
    hoist = jl.System(
        lambda qdot, J_1, J_2: 0.5 * J_1 * qdot["motor"] ** 2 + 0.5 * J_2 * qdot["drum"] ** 2,
        force=lambda t, M, load: {"motor": M, "drum": -load},
        dissipation=lambda qdot, multipliers, eta, back: elements.gear(qdot["motor"], multipliers["mesh"], eta, back),
        holonomic={"mesh": lambda q, i: q["motor"] - i * q["drum"]},
    )
    ```
    """
    driving, driven = 1 / jnp.asarray(efficiency) - 1, 1 - jnp.asarray(back)
    return 0.5 * (driving + driven) * jnp.abs(force) * jnp.abs(v) - 0.5 * (driving - driven) * force * v


def rope_over_pulley(v: Number, tension: Number, mu: Number, angle: Number) -> Value:
    r"""Loss of a rope that slides over a fixed drum, a bollard or a pulley that is stuck (Euler and Eytelwein).

    $$ T_1 = T_2\, e^{\mu\alpha} \ \text{ where } v > 0, \qquad T_1 = T_2\, e^{-\mu\alpha} \ \text{ where } v < 0 $$

              ___
             /   \        α, angle of wrap
            |     |
        v ↓ |T₁   | T₂

    **Arguments:** `v`, velocity of the rope, positive towards the end 1; `tension`, T₂ ≥ 0, at the other end: minus the multiplier of
    y₁ + y₂ = ℓ for two ends that hang; `mu`, μ; `angle`, α in radians.

    **Returns:** a term of `dissipation`, by which the rope sticks as long as T₁ and T₂ differ by less.

    **Source:** Euler, Remarques sur l'effet du frottement dans l'équilibre (1769); Popov, Contact Mechanics and Friction, section 10.

    ```python
    import numpy as np
    import jaxlag as jl
    from jaxlag import elements
    rope = jl.System(
        lambda q, qdot, m_1, m_2, g: 0.5 * (m_1 * qdot["1"] ** 2 + m_2 * qdot["2"] ** 2) + g * (m_1 * q["1"] + m_2 * q["2"]),
        dissipation=lambda qdot, multipliers, mu: elements.rope_over_pulley(qdot["1"], -multipliers["rope"], mu, np.pi),
        holonomic={"rope": lambda q: q["1"] + q["2"]},
    )
    ```
    """
    passed = jnp.exp(-jnp.asarray(mu) * angle)
    return gear(v, -jnp.asarray(tension), passed, passed)


def belt(slip: Number, T_0: Number, mu: Number, angle: Number) -> Value:
    r"""Loss of a belt that slips on its pulley: it passes on what two strands of the same pretension can differ by.

    $$ D = 2 T_0 \tanh\!\left(\tfrac12 \mu\alpha\right) |s| $$

    **Arguments:** `slip`, s = r₁ω₁ − r₂ω₂; `T_0`, pretension, half the sum of the tensions of both strands, not negative; `mu`, μ;
    `angle`, α of the smaller wrap, in radians. Elastic creep is left out: until it slips, the belt is a constraint.

    **Returns:** a term of `dissipation`.

    **Source:** Shigley's Mechanical Engineering Design, 10th ed., section 17-2; T₁ + T₂ = 2 T₀ and T₁ = T₂ exp(μα).

    ```python
    import numpy as np
    from jaxlag import elements
    elements.belt(-0.5, T_0=100.0, mu=0.3, angle=np.pi)  # 2 · 100 · tanh(0.471) · 0.5 = 43.9
    ```
    """
    return 2 * jnp.asarray(T_0) * jnp.tanh(0.5 * jnp.asarray(mu) * angle) * jnp.abs(jnp.asarray(slip))


def lossy_joint(omega: Number, force: Number, mu: Number, r: Number) -> Float[Array, ""]:
    r"""Loss of a pin that rubs in its bearing, by the force that the joint carries.

    $$ D = \mu\, r\, \|\lambda\|\, |\omega| $$

    It stays where the line of the load passes the centre within the friction circle, of radius μ r.

    **Arguments:** `omega`, ω, the angular velocity between both links; `force`, λ, the multipliers of the joint: one number, or an array of
    those along all directions; `mu`, μ; `r`, radius of the pin.

    **Returns:** a term of `dissipation`.

    **Source:** Shigley & Uicker, Theory of Machines and Mechanisms, section 14.9 (friction circle), with μ for sin(arctan μ).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    from jaxlag import elements
    pendulum = jl.System(
        lambda q, qdot, m, J, g: 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2) + 0.5 * J * qdot["phi"] ** 2 - m * g * q["y"],
        dissipation=lambda qdot, multipliers, mu, r: elements.lossy_joint(qdot["phi"], multipliers["pin"], mu, r),
        holonomic={"pin": lambda q, l: jnp.stack([q["x"] - l * jnp.sin(q["phi"]), q["y"] + l * jnp.cos(q["phi"])])},
    )
    ```
    """
    return mu * r * speed(jnp.atleast_1d(jnp.asarray(force))) * jnp.abs(jnp.asarray(omega))


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
