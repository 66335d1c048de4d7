"""How a signal is interpolated between its samples: zero-order hold, linear, natural cubic spline."""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class AbstractInterpolation(eqx.Module):
    """How the values between two samples follow from the samples."""

    jumps: ClassVar[bool] = False  # at the samples
    is_nonsmooth: ClassVar[bool] = False  # there: it jumps or bends
    needs_second_derivatives: ClassVar[bool] = False

    @abc.abstractmethod
    def evaluate(self, signal: Any, ts: Float[Array, " T"], t: Float[Array, "*n"], i: Any) -> Float[Array, "..."]:
        """u(t), where `i` is the last sample not later than t, -1 before the first; `ts` are the sample times in the precision of t."""


class ZeroOrderHold(AbstractInterpolation):
    r"""Zero-order hold: each value holds until the next sample. An interpolation for `Signal`.

    $$ u(t) = u_i, \qquad t_i \le t < t_{i+1} $$

    For an input that enters as it is: a force, a brake, the speed of a belt. `simulate` ends a step at every sample.

    **Source:** Åström & Wittenmark, Computer-Controlled Systems, section 2.3.

    ```python
    import jaxlag as jl
    u = jl.Signal([0.0, 1.0, 2.0], [1.0, -1.0, 0.0], jl.interpolation.ZeroOrderHold())
    u(0.75)  # 1.0
    u(1.0)  # -1.0
    ```
    """

    jumps: ClassVar[bool] = True
    is_nonsmooth: ClassVar[bool] = True

    def evaluate(self, signal: Any, ts: Float[Array, " T"], t: Float[Array, "*n"], i: Any) -> Float[Array, "..."]:
        """The value of the latest sample; before the first sample, that of the first."""
        return signal.values[jnp.maximum(i, 0)]


class Linear(AbstractInterpolation):
    r"""Linear interpolation between the samples of a `Signal`.

    $$ u(t) = a\,u_i + b\,u_{i+1}, \qquad a = 1 - b, \quad b = \frac{t - t_i}{t_{i+1} - t_i} $$

    For an input that mechanics differentiates once: in a velocity constraint, or beside q̇ in L.

    **Source:** Press et al., Numerical Recipes, 3rd ed., section 3.1.

    ```python
    import jaxlag as jl
    u = jl.Signal([0.0, 1.0, 2.0], [1.0, -1.0, 0.0], jl.interpolation.Linear())
    u(0.75)  # -0.5
    ```
    """

    is_nonsmooth: ClassVar[bool] = True

    def evaluate(self, signal: Any, ts: Float[Array, " T"], t: Float[Array, "*n"], i: Any) -> Float[Array, "..."]:
        """The chord between two samples; the end value outside of them."""
        i, _, a, b = _weights(signal.values, ts, t, i)
        return a * signal.values[i] + b * signal.values[i + 1]


class Cubic(AbstractInterpolation):
    r"""Natural cubic spline through the samples of a `Signal`: u'' is continuous, and zero at both ends.

    $$ u(t) = a\,u_i + b\,u_{i+1} + \frac{h^2}{6}\left((a^3 - a)\,u''_i + (b^3 - b)\,u''_{i+1}\right), \qquad
       a = 1 - b, \quad b = \frac{t - t_i}{h}, \quad h = t_{i+1} - t_i $$

    For an input that mechanics differentiates twice: in a position constraint.

    **Source:** Press et al., Numerical Recipes, 3rd ed., section 3.3.

    ```python
    import jaxlag as jl
    u = jl.Signal([0.0, 1.0, 2.0], [1.0, -1.0, 0.0], jl.interpolation.Cubic())
    u(0.75)  # -0.7461
    ```
    """

    needs_second_derivatives: ClassVar[bool] = True

    def evaluate(self, signal: Any, ts: Float[Array, " T"], t: Float[Array, "*n"], i: Any) -> Float[Array, "..."]:
        """The chord and the cubic part."""
        i, h, a, b = _weights(signal.values, ts, t, i)
        chord = a * signal.values[i] + b * signal.values[i + 1]
        curvature = second_derivatives(signal.ts, signal.values) if signal.second_derivatives is None else signal.second_derivatives
        return chord + h**2 / 6 * ((a**3 - a) * curvature[i] + (b**3 - b) * curvature[i + 1])


def _weights(values, ts, t, i):
    """The interval of t, its length h, and the weights a and b of its two ends, shaped to multiply rows of `values`."""
    i = jnp.clip(i, 0, ts.size - 2)
    t = jnp.where(t < ts[0], ts[0], jnp.where(t > ts[-1], ts[-1], t))  # not `clip`, which halves the derivative at both ends
    as_rows = lambda x: x.astype(values.dtype).reshape(x.shape + (1,) * (values.ndim - 1))
    h = ts[i + 1] - ts[i]
    b = as_rows((t - ts[i]) / jnp.where(h > 0, h, 1))
    return i, as_rows(h), 1 - b, b


def second_derivatives(ts: Float[Array, " T"], values: Float[Array, "T ..."]) -> Float[Array, "T ..."]:
    """u'' of the natural spline: h₋ u''₋ + 2 (h₋ + h) u'' + h u''₊ = 6 (slope − slope₋), and zero at both ends."""
    h = jnp.diff(ts).astype(values.dtype)
    rise = jnp.diff(values.reshape(ts.size, -1), axis=0)
    slope = jnp.pad(rise / jnp.where(h > 0, h, 1)[:, None], ((1, 1), (0, 0)))
    before, after = jnp.pad(h, (1, 0)), jnp.pad(h, (0, 1))
    inner = (before > 0) & (after > 0)  # the others are ends, also where the last time is repeated
    lower, upper = jnp.where(inner, before, 0), jnp.where(inner, after, 0)
    diagonal = jnp.where(inner, 2 * (before + after), 1)
    right_side = jnp.where(inner[:, None], 6 * jnp.diff(slope, axis=0), 0)
    return jax.lax.linalg.tridiagonal_solve(lower, diagonal, upper, right_side).reshape(values.shape)
