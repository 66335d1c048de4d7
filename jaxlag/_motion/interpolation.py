r"""A motion between its samples, by polynomials with the right values at both ends of an interval of length h:

    q  of degree 5, by q, q̇ and q̈      error  h⁶/46080 |q⁽⁶⁾|
    q̇  of degree 3, by q̇ and q̈         error  h⁴/384 |q⁽⁵⁾|
    q̈  the slope of the latter          error  √3 h³/216 |q⁽⁵⁾|

Where a velocity jumps within the interval, at a known time, each side is the polynomial of second degree by q, q̇ and q̈ of its own end:

    q  error  h³/6 |q⁽³⁾|        q̇  error  h²/2 |q⁽³⁾|        q̈  error  h |q⁽³⁾|

The slope of the first would have one order more, and the errors of q divided by h: with samples close together these count.
Source: Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, section II.6 (Hermite interpolation).
"""

from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .moments import ContactState, EventState


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


class Jumps(NamedTuple):
    """Of each interval between samples, whether velocities jump in it, and when at first and at last."""

    there: Bool[Array, " T-1"]
    first: Float[Array, " T-1"]
    last: Float[Array, " T-1"]

    def joined(self, other: "Jumps") -> "Jumps":
        """Those of both."""
        return Jumps(self.there | other.there, jnp.minimum(self.first, other.first), jnp.maximum(self.last, other.last))


def jumps(ts: Float[Array, " T"], contacts: Iterable[ContactState], events: Iterable[EventState]) -> Jumps:
    """At impacts, of which the last of each contact is known, and at events, all of which are."""
    found, inside = Jumps(jnp.zeros(ts.size - 1, bool), ts[1:], ts[:-1]), lambda t: jnp.clip(t, ts[:-1], ts[1:])
    of = lambda there, first, last: Jumps(there, jnp.where(there, inside(first), ts[1:]), jnp.where(there, inside(last), ts[:-1]))
    of_gaps = [x for contact in contacts for x in zip(*(x.reshape(ts.size, -1).T for x in (contact.impacts, contact.changed)), strict=True)]
    for impacts, changed in of_gaps:
        many, last = jnp.diff(impacts), changed[1:]
        found = found.joined(of(many != 0, jnp.where(many == 1, last, ts[:-1]), last))
    for event in events:
        count = event.count.astype(int)
        found = found.joined(of(count[1:] > count[:-1], event.ts[jnp.minimum(count[:-1], event.ts.size - 1)], event.ts[count[1:] - 1]))
    return found


def between(ts: Float[Array, " T"], samples: Moving, at: Float[Array, " k"], jumps: Jumps) -> tuple[Moving, Moving]:
    """The motion at times between the samples, and how far q and q̇ may be off; NaN outside, and from the first jump in an interval to
    the last.
    """
    k = jnp.clip(jnp.searchsorted(ts, at, side="right") - 1, 0, ts.size - 2)
    h, start, end = (ts[k + 1] - ts[k])[:, None], samples.rows(k), samples.rows(k + 1)
    smooth = hermite(start, end, h, (at - ts[k])[:, None] / h)
    sides = parabola(start, (at - ts[k])[:, None]), parabola(end, (at - ts[k + 1])[:, None])
    there, is_before = (jumps.there[k])[:, None], (at <= jumps.first[k])[:, None]
    found = jax.tree.map(lambda x, y, z: jnp.where(there, jnp.where(is_before, y, z), x), smooth, *sides)
    rounding = 4 * jnp.finfo(ts.dtype).eps * jnp.max(jnp.abs(ts))
    inside = (at >= ts[0] - rounding) & (at <= ts[-1] + rounding) & ((at <= jumps.first[k]) | (at >= jumps.last[k]))
    known = lambda part: Moving(*(jnp.where(inside[:, None], x, jnp.nan) for x in part))
    return known(found), known(jax.lax.stop_gradient(missed(ts, samples, jumps.there)).rows(k))


def parabola(end: Moving, t: Float[Array, "k 1"]) -> Moving:
    """The motion some time after or before one end of an interval."""
    q, v, a = end
    return Moving(q + t * (v + t * a / 2), v + t * a, a)


def missed(ts: Float[Array, " T"], samples: Moving, jumps: Bool[Array, " T-1"]) -> Moving:
    """For each interval, how far q and q̇ may be off: by what the samples at its ends are missed where interpolation leaves them out.

    It has then two intervals to go, and is off by 64 times as much in q, and 16 times in q̇, where the motion is smooth; where the
    acceleration jumps, by about as much. But a jump in the middle of an interval leaves q̇ right at its end: so the difference from the
    slope of q is added. Of two samples there is none that could be left out, and nothing is known. Where velocities jump, the slope of
    q̈ in the intervals beside says how far a parabola may be off.
    """
    if ts.size < 3:
        return jax.tree.map(lambda x: jnp.full_like(x[1:], jnp.nan), samples)
    h, two = jnp.diff(ts)[:, None], (ts[2:] - ts[:-2])[:, None]
    over = hermite(samples.rows(slice(-2)), samples.rows(slice(2, None)), two, h[:-1] / two)

    def worse(off, left_out):
        """The larger of what is known at the two ends of each interval."""
        known, unknown = jnp.where(left_out[:, None], -jnp.inf, off), jnp.full_like(off[:1], -jnp.inf)
        found = jnp.maximum(jnp.concatenate([unknown, known]), jnp.concatenate([known, unknown]))
        return jnp.where(found >= 0, found, jnp.nan)

    off = jax.tree.map(lambda over, here: worse(jnp.abs(over - here[1:-1]), jumps[:-1] | jumps[1:]), over, samples)
    (q0, v0, a0), (q1, v1, a1) = samples.rows(slice(-1)), samples.rows(slice(1, None))
    apart = 15 / 8 * jnp.abs((q1 - q0) / h - (v0 + v1) / 2 + h * (a1 - a0) / 12)  # of both, in the middle
    slope, unknown = jnp.where(jumps[:, None], -jnp.inf, jnp.abs(a1 - a0) / h), jnp.full_like(h[:1] * a0[:1], -jnp.inf)
    beside = jnp.maximum(jnp.concatenate([unknown, slope[:-1]]), jnp.concatenate([slope[1:], unknown]))
    third = jnp.where(beside >= 0, beside, jnp.nan)
    of_parabola = off._replace(q=h**3 / 6 * third, v=h**2 / 2 * third)
    return jax.tree.map(lambda x, y: jnp.where(jumps[:, None], y, x), off._replace(v=off.v + 2 * apart), of_parabola)
