"""Measured inputs: what was sampled at some times, as a function of all times."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._program.jit import is_concrete
from .numbers import numbers

KINDS = ("hold", "linear", "cubic")


class Signal(eqx.Module):
    r"""A measured input u(t): an entry of `params`, called as `u(t)` in the functions of a system.

    $$ u(t) = \begin{cases} u_i & \text{hold} \\ a\,u_i + b\,u_{i+1} & \text{linear} \\
       a\,u_i + b\,u_{i+1} + \frac{h^2}{6}\left((a^3 - a)\,u''_i + (b^3 - b)\,u''_{i+1}\right) & \text{cubic} \end{cases}
       \qquad a = 1 - b, \quad b = \frac{t - t_i}{h}, \quad h = t_{i+1} - t_i $$

    for t_i ≤ t < t_{i+1}; outside its times the end value is held. A cubic signal is the natural spline: u'' is continuous, and zero at
    both ends.

    **Which kind:** held where u stands by itself: a force, a brake, the speed of a belt; its derivative by t is zero. Linear where
    mechanics differentiates it once: in a velocity constraint, where each jump of a held signal is an impulse, and beside q̇ in L, where
    such impulses are left out. Cubic where twice: in a position constraint.

    **Steps:** `simulate` ends a step at each time of a held signal in `params` and begins the next one behind it, so leave out times at
    which nothing changes. Under the other kinds the tolerances alone set the steps, and a short pulse after a long rest may fall between
    two of them: take a held signal there.

    **Arguments:**

    - `ts`: the times, increasing, at least two, shape (T,). Under `vmap` a shorter signal is filled up with its last time and value.
    - `values`: one scalar, vector or array for each time, shape (T, ...); u(t) has their precision. Any consistent units.
    - `kind`: `"hold"`, `"linear"` or `"cubic"`.

    Differentiable in the values, exactly, and in t and the times of linear and cubic signals. The derivative by the times at which a
    held signal jumps is not computed, and counts as zero.

    **Raises:** `ValueError` or `TypeError` where times or values are not real, missing, or do not fit each other.

    **Source:** Press et al., Numerical Recipes, 3rd ed., section 3.3; Åström & Wittenmark, Computer-Controlled Systems, section 2.3 (hold).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    cart = jl.System(lambda qdot: 0.5 * qdot**2, force=lambda t, u: u(t))
    push = jl.Signal([0.0, 1.0, 2.0], [1.0, -1.0, 0.0])  # forwards for a second, back for another
    jl.simulate(cart, 0.0, 0.0, [0.0, 1.0, 2.0, 3.0], {"u": push}).q  # 0, 1/2, 1, 1
    ```
    """

    ts: Float[Array, " T"]
    values: Float[Array, "T ..."]
    bends: Float[Array, "T ..."] | None  # u'' at the times, where `solved` has them at hand
    kind: str = eqx.field(static=True)

    def __init__(self, ts: Any, values: Any, kind: str = "hold"):
        if kind not in KINDS:
            raise ValueError(f"`kind` must be one of {', '.join(map(repr, KINDS))}, but is {kind!r}. Take 'hold' if in doubt.")
        self.ts, self.values, self.bends, self.kind = numbers(ts, "`ts`"), numbers(values, "`values`"), None, kind
        _check(self.ts, self.values)

    def __call__(self, t: Any) -> Float[Array, "..."]:
        """u(t); of several times, one row for each."""
        t = 1.0 * jnp.asarray(t)
        ts = self.ts.astype(t.dtype)  # jumps are where the integrator, which counts its time in this precision, steps on them
        i = jnp.searchsorted(ts, t, side="right") - 1
        if self.kind == "hold":
            return self.values[jnp.maximum(i, 0)]
        i = jnp.clip(i, 0, ts.size - 2)
        t = jnp.where(t < ts[0], ts[0], jnp.where(t > ts[-1], ts[-1], t))  # not `clip`, which halves the derivative at both ends
        over = lambda x: x.astype(self.values.dtype).reshape(x.shape + (1,) * (self.values.ndim - 1))
        h = ts[i + 1] - ts[i]
        b = over((t - ts[i]) / jnp.where(h > 0, h, 1))
        a = 1 - b
        chord = a * self.values[i] + b * self.values[i + 1]
        if self.kind == "linear":
            return chord
        bends = _bends(self.ts, self.values) if self.bends is None else self.bends
        return chord + over(h) ** 2 / 6 * ((a**3 - a) * bends[i] + (b**3 - b) * bends[i + 1])


def _bends(ts, values):
    """u'' of the natural spline: h₋ u''₋ + 2 (h₋ + h) u'' + h u''₊ = 6 (slope − slope₋), and zero at both ends."""
    h = jnp.diff(ts).astype(values.dtype)
    rise = jnp.diff(values.reshape(ts.size, -1), axis=0)
    slope = jnp.pad(rise / jnp.where(h > 0, h, 1)[:, None], ((1, 1), (0, 0)))
    before, after = jnp.pad(h, (1, 0)), jnp.pad(h, (0, 1))
    inner = (before > 0) & (after > 0)  # the others are ends, also where the last time is repeated
    lower, upper = jnp.where(inner, before, 0), jnp.where(inner, after, 0)
    diagonal = jnp.where(inner, 2 * (before + after), 1)
    bend = jnp.where(inner[:, None], 6 * jnp.diff(slope, axis=0), 0)
    return jax.lax.linalg.tridiagonal_solve(lower, diagonal, upper, bend).reshape(values.shape)


def solved(params: PyTree) -> PyTree:
    """`params` with the u'' of its cubic signals, so that these are solved for once a motion and not once a step."""

    def with_bends(node):
        if not (is_signal(node) and node.kind == "cubic"):
            return node
        return eqx.tree_at(lambda signal: signal.bends, node, _bends(node.ts, node.values), is_leaf=lambda x: x is None)

    return jax.tree.map(with_bends, params, is_leaf=is_signal)


def jump_times(params: PyTree, dtype: Any) -> Float[Array, " jumps"] | None:
    """Where the held signals in `params` jump, not differentiated; None where there are no such signals."""
    held = [leaf for leaf in jax.tree.leaves(params, is_leaf=is_signal) if is_signal(leaf) and leaf.kind == "hold"]
    return jax.lax.stop_gradient(jnp.concatenate([signal.ts[1:] for signal in held]).astype(dtype)) if held else None


def least_spacing(params: PyTree, dtype: Any) -> Float[Array, ""]:
    """The shortest time between two samples of a signal in `params`; infinite without signals."""
    signals = [leaf for leaf in jax.tree.leaves(params, is_leaf=is_signal) if is_signal(leaf)]
    apart = jnp.concatenate([jnp.zeros(0, dtype), *(jnp.diff(signal.ts.astype(dtype)) for signal in signals)])
    return jnp.min(jnp.where(apart > 0, apart, jnp.inf), initial=jnp.inf)


def moves_smoothly(moving: PyTree, params: PyTree) -> bool:
    """Whether no signal in `params` is among what moves, and none jumps."""
    signals = [leaf for leaf in jax.tree.leaves(moving, is_leaf=is_signal) if is_signal(leaf)]
    return not jax.tree.leaves(signals) and jump_times(params, float) is None


def delayed(params: PyTree, by: Float[Array, ""]) -> PyTree:
    """`params` with the held signals as they were a time ago."""
    return jax.tree.map(lambda node: _Delayed(node, by) if is_signal(node) and node.kind == "hold" else node, params, is_leaf=is_signal)


class _Delayed(eqx.Module):
    signal: Signal
    by: Float[Array, ""]

    def __call__(self, t):
        return self.signal(t - self.by)


def is_signal(node: Any) -> bool:
    """Whether a node of a pytree is a `Signal`."""
    return isinstance(node, Signal)


def _check(ts, values):
    if ts.ndim != 1 or ts.size < 2:
        raise ValueError(f"`ts` must be a list of at least two times, but has shape {ts.shape}. Give a constant as a plain parameter.")
    if values.shape[:1] != ts.shape:
        raise ValueError(f"`values` must have one row for each of the {ts.size} times, but has shape {values.shape}. Put the times first.")
    for name, array in (("ts", ts), ("values", values)):
        if is_concrete(array) and not np.all(np.isfinite(array)):
            missing = int(np.sum(~np.isfinite(np.asarray(array)).reshape(ts.size, -1).all(axis=1)))
            raise ValueError(f"`{name}` must be finite, but has {missing} missing samples. Leave these times out.")
    if is_concrete(ts) and np.any(np.diff(ts) <= 0):
        i = int(np.argmax(np.diff(ts) <= 0))
        raise ValueError(
            f"`ts` must increase, but ts[{i}] = {ts[i]:g} is followed by ts[{i + 1}] = {ts[i + 1]:g}. "
            "Sort the times, drop repeated ones, and count large ones from the start of the recording."
        )
