r"""A motion between its samples, by polynomials with the right values at both ends of an interval of length h:

    q  of degree 5, by q, q̇ and q̈      error  h⁶/46080 |q⁽⁶⁾|
    q̇  of degree 3, by q̇ and q̈         error  h⁴/384 |q⁽⁵⁾|
    q̈  the slope of the latter          error  √3 h³/216 |q⁽⁵⁾|

The slope of the first would have one order more, and the errors of q divided by h: with samples close together these count.
Source: Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, section II.6 (Hermite interpolation).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class Moving(NamedTuple):
    """Position, velocity and acceleration, with one row for each time."""

    q: Float[Array, "T n"]
    v: Float[Array, "T n"]
    a: Float[Array, "T n"]

    def rows(self, which) -> "Moving":
        """Those of some times."""
        return Moving(self.q[which], self.v[which], self.a[which])


def hermite(start: Moving, end: Moving, h: Float[Array, "T 1"], s: Float[Array, "T 1"]) -> Moving:
    """The motion at the fraction s of intervals of length h."""
    q, v, a = start
    dq, dv, da = end.q - q - h * (v + h * a / 2), h * (end.v - v - h * a), h**2 * (end.a - a)
    position = 10 * dq - 4 * dv + da / 2 + s * (-15 * dq + 7 * dv - da + s * (6 * dq - 3 * dv + da / 2))
    return Moving(
        q=q + s * h * (v + s * h * a / 2) + s**3 * position,
        v=v + s * (h * a + s * (3 * dv - da + s * (da - 2 * dv)) / h),
        a=a + s * (2 * (3 * dv - da) + 3 * s * (da - 2 * dv)) / h**2,
    )


def between(ts: Float[Array, " T"], samples: Moving, at: Float[Array, " k"]) -> tuple[Moving, Moving]:
    """The motion at times between the samples, and how far q and q̇ may be off; NaN outside."""
    k = jnp.clip(jnp.searchsorted(ts, at, side="right") - 1, 0, ts.size - 2)
    h = (ts[k + 1] - ts[k])[:, None]
    found = hermite(samples.rows(k), samples.rows(k + 1), h, (at - ts[k])[:, None] / h)
    rounding = 4 * jnp.finfo(ts.dtype).eps * jnp.max(jnp.abs(ts))
    inside = ((at >= ts[0] - rounding) & (at <= ts[-1] + rounding))[:, None]
    known = lambda part: Moving(*(jnp.where(inside, x, jnp.nan) for x in part))
    return known(found), known(jax.lax.stop_gradient(missed(ts, samples)).rows(k))


def missed(ts: Float[Array, " T"], samples: Moving) -> Moving:
    """For each interval, how far q and q̇ may be off: by what the samples at its ends are missed where interpolation leaves them out.

    It has then two intervals to go, and is off by 64 times as much in q, and 16 times in q̇, where the motion is smooth; where the
    acceleration jumps, by about as much. But a jump in the middle of an interval leaves q̇ right at its end: so the difference from the
    slope of q is added. Of two samples there is none that could be left out, and nothing is known.
    """
    if ts.size < 3:
        return jax.tree.map(lambda x: jnp.full_like(x[1:], jnp.nan), samples)
    h, two = jnp.diff(ts)[:, None], (ts[2:] - ts[:-2])[:, None]
    over = hermite(samples.rows(slice(-2)), samples.rows(slice(2, None)), two, h[:-1] / two)

    def worse(over, here):
        off = jnp.abs(over - here[1:-1])
        return jnp.maximum(jnp.concatenate([off[:1], off]), jnp.concatenate([off, off[-1:]]))

    off = jax.tree.map(worse, over, samples)
    (q0, v0, a0), (q1, v1, a1) = samples.rows(slice(-1)), samples.rows(slice(1, None))
    apart = 15 / 8 * jnp.abs((q1 - q0) / h - (v0 + v1) / 2 + h * (a1 - a0) / 12)  # of both, in the middle
    return off._replace(v=off.v + 2 * apart)
