"""Measured inputs: samples at some times, as a function of all times."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from .._program.jit import is_concrete
from .numbers import number, numbers
from .signal_interpolation import AbstractInterpolation, ZeroOrderHold, second_derivatives
from .states import Flowing


class Signal(eqx.Module):
    r"""A measured input u(t): an entry of `params`, called as `u(t)` in the functions of a system.

    $$ u(t) = u_i \ \text{(zero-order hold)}, \qquad u(t) = a\,u_i + b\,u_{i+1} \ \text{(linear)}, \qquad
       a = 1 - b, \quad b = \frac{t - t_i}{t_{i+1} - t_i} $$

    for t_i ≤ t < t_{i+1}, or a cubic spline (see `Cubic`); before the first and after the last sample u keeps the end value.

    **Choice of interpolation:** `ZeroOrderHold` if u enters as it is: a force, a brake, the speed of a belt; its derivative with respect to
    t is zero. `Linear` if mechanics differentiates u once: in a velocity constraint, where each jump of a zero-order hold is an impulse,
    and together with q̇ in L, where such impulses are ignored. `Cubic` if mechanics differentiates u twice: in a position constraint.

    **Steps:** `simulate` ends a step at each sample of a zero-order hold or a linear signal in `params`, so leave out samples at which
    nothing changes. With cubic signals the tolerances alone set the steps, and error is checked between any two samples. Give a delay as
    `delay`, not as `u(t - late)`, whose jumps are not located.

    **Arguments:**

    - `ts`: the sample times, increasing, at least two, shape (T,). Under `vmap` pad a shorter signal with its last time and value.
    - `values`: one scalar, vector or array for each time, shape (T, ...); u(t) has their precision. Any consistent units.
    - `delay`: the time by which u lags behind its samples, u(t) = u_i for t_i ≤ t − delay; may be free in a fit.
    - `interpolation`: `jaxlag.interpolation.ZeroOrderHold()`, the default, `Linear()` or `Cubic()`.

    **Fields:** `ts`, `values`, `delay` and `interpolation` as given; `times`: `ts` with the delay; `second_derivatives`: u'' at the samples
    of a cubic signal, shape (T, ...), which `simulate` computes once per motion; otherwise None.

    **Returns:** when called with t, a scalar or an array of shape S: u(t), of shape S + (...). Differentiable in the values, exactly, and
    in t and the times of linear and cubic signals. With respect to the times at which a zero-order hold jumps, the derivative of u(t) is
    zero, but that of a motion is exact, because its steps end there.

    **Raises:** `ValueError` or `TypeError` if times or values are not real, are missing, or do not match in number; `TypeError` if
    `interpolation` is none of the three.

    **Source:** Press et al., Numerical Recipes, 3rd ed., section 3.3; Åström & Wittenmark, Computer-Controlled Systems, section 2.3 (hold).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    cart = jl.System(lambda qdot: 0.5 * qdot**2, force=lambda t, u: u(t))
    push = jl.Signal([0.0, 1.0, 2.0], [1.0, -1.0, 0.0])  # forwards for a second, backwards for another
    jl.simulate(cart, 0.0, 0.0, [0.0, 1.0, 2.0, 3.0], {"u": push}).q  # 0.0, 0.5, 1.0, 1.0
    ```
    """

    ts: Float[Array, " T"]
    values: Float[Array, "T ..."]
    second_derivatives: Float[Array, "T ..."] | None  # u'' at the samples, where `with_second_derivatives` has computed them
    delay: Float[Array, ""]
    interpolation: AbstractInterpolation = eqx.field(static=True)

    def __init__(
        self,
        ts: Any,
        values: Any,
        interpolation: Any = ZeroOrderHold(),  # an `AbstractInterpolation`: `_interpolation` checks it
        *,
        delay: Any = 0.0,
    ):
        ts, values = numbers(ts, "`ts`"), numbers(values, "`values`")
        self.interpolation = _interpolation(interpolation)
        _check(ts, values)
        self.ts, self.values, self.second_derivatives = jnp.asarray(ts), jnp.asarray(values), None
        self.delay = jnp.asarray(number(delay, "`delay`", ts.dtype, cure="Give one time, by which all samples are later."))

    def __call__(self, t: ArrayLike) -> Float[Array, "..."]:
        """u(t); of several times, one row for each."""
        t = 1.0 * jnp.asarray(t)
        ts = self.times.astype(t.dtype)  # jumps are where the integrator, which counts its time in this precision, steps on them
        return self.interpolation.evaluate(self, ts, t, jnp.searchsorted(ts, t, side="right") - 1)

    @property
    def times(self) -> Float[Array, " T"]:
        """The times at which u has its values: the sample times plus the delay."""
        return self.ts + self.delay


def _interpolation(given: Any) -> AbstractInterpolation:
    """An interpolation."""
    if not isinstance(given, AbstractInterpolation):
        raise TypeError(
            f"`interpolation` must be one of `jaxlag.interpolation`, but is {given!r}. If in doubt, take its `ZeroOrderHold()`."
        )
    return given


def with_second_derivatives(params: PyTree) -> PyTree:
    """`params` with the u'' of its cubic signals, so that the spline is solved for once a motion and not once a step."""

    def prepared(node: Any) -> Any:
        if not (is_signal(node) and node.interpolation.needs_second_derivatives):
            return node
        return eqx.tree_at(
            lambda signal: signal.second_derivatives, node, second_derivatives(node.ts, node.values), is_leaf=lambda x: x is None
        )

    return jax.tree.map(prepared, params, is_leaf=is_signal)


def jump_times(params: PyTree, dtype: Any) -> Float[Array, " jumps"] | None:
    """Where the zero-order holds in `params` jump, not differentiated; None where there are none."""
    held = [leaf for leaf in jax.tree.leaves(params, is_leaf=is_signal) if is_signal(leaf) and leaf.interpolation.jumps]
    return jax.lax.stop_gradient(jnp.concatenate([signal.times[1:] for signal in held]).astype(dtype)) if held else None


def least_spacing(params: PyTree, dtype: Any) -> Float[Array, ""]:
    """The shortest time between two samples of a signal in `params`; infinite where there are no signals."""
    signals = [leaf for leaf in jax.tree.leaves(params, is_leaf=is_signal) if is_signal(leaf)]
    apart = jnp.concatenate([jnp.zeros(0, dtype), *(jnp.diff(signal.ts.astype(dtype)) for signal in signals)])
    return jnp.min(jnp.where(apart > 0, apart, jnp.inf), initial=jnp.inf)


class Piece(eqx.Module):
    """A signal between two of its samples: called with the time `now`, it need not look for them. Its samples are at `elapsed` times."""

    ts: Float[Array, "2"]
    values: Float[Array, "2 ..."]
    interpolation: AbstractInterpolation = eqx.field(static=True)
    number: int = eqx.field(static=True)
    now: Any = None
    elapsed: Any = None  # this time on the clock of the samples

    def __call__(self, t: ArrayLike) -> Float[Array, "..."]:
        """u(now)."""
        if t is not self.now:
            raise CalledElsewhere(self.number)
        assert isinstance(self.elapsed, jax.Array)
        return self.interpolation.evaluate(self, self.ts.astype(self.elapsed.dtype), self.elapsed, 0)


class CalledElsewhere(Exception):
    """A function asks for a signal at another time than now, as one that delays it does."""


def is_nonsmooth(node: Any) -> bool:
    """Whether a node of a pytree is a signal that jumps or bends at its samples."""
    return is_signal(node) and node.interpolation.is_nonsmooth


def nonsmooth_signals(params: PyTree) -> list[Signal]:
    """Those in `params`, in order."""
    return [leaf for leaf in jax.tree.leaves(params, is_leaf=is_signal) if is_nonsmooth(leaf)]


class SinceOrigin(eqx.Module):
    """`params` on a clock that counts from an `origin`, t = origin + τ: samples of signals are at times τ, functions are handed t.

    However late a motion is, what is computed in τ keeps its digits, differences of times above all.
    """

    params: PyTree
    origin: Float[Array, ""] | None  # None of directions, along which it stays

    @classmethod
    def of(cls, params: PyTree, origin: Float[Array, ""]) -> "SinceOrigin":
        """Those of `params` whose signals count as the user does."""
        earlier = lambda node: eqx.tree_at(lambda signal: signal.ts, node, (node.ts - origin).astype(node.ts.dtype))
        return cls(jax.tree.map(lambda node: earlier(node) if is_signal(node) else node, params, is_leaf=is_signal), origin)


class SignalSinceOrigin(eqx.Module):
    """A signal whose samples count from an origin, called with times that do not."""

    counted: Signal
    origin: Float[Array, ""]
    now: Any
    elapsed: Any  # this time since the origin, which has more digits

    def __call__(self, t: ArrayLike) -> Float[Array, "..."]:
        """u(t)."""
        return self.counted(self.elapsed if t is self.now else t - self.origin)

    @property
    def ts(self) -> Float[Array, " T"]:
        """The sample times as given."""
        return self.counted.ts + self.origin

    @property
    def values(self) -> Float[Array, "T ..."]:
        """One for each time."""
        return self.counted.values


def origin_of(params: PyTree) -> Any:
    """Where the clock of `params` begins."""
    return params.origin if isinstance(params, SinceOrigin) else 0


def at_time(params: PyTree, t: Any) -> tuple[PyTree, Any]:
    """`params` and the time as the user's functions are handed them, at the time t of the clock: each signal, and each entry that flows."""
    is_counted = isinstance(params, SinceOrigin)
    given, now = (params.params, params.origin + t) if is_counted else (params, t)
    moves = lambda node: isinstance(node, (Piece, Flowing)) or (is_counted and is_signal(node))
    if not any(map(moves, jax.tree.leaves(given, is_leaf=moves))):
        return given, now

    def of(node):
        if isinstance(node, Piece):
            return dataclasses.replace(node, now=now, elapsed=t)
        if isinstance(node, Flowing):
            return node(t)
        return SignalSinceOrigin(node, params.origin, now, t) if moves(node) else node

    return jax.tree.map(of, given, is_leaf=moves), now


def moves_smoothly(moving: PyTree, params: PyTree) -> bool:
    """Whether no signal in `params` jumps, and none is among what moves."""
    signals = [leaf for leaf in jax.tree.leaves(moving, is_leaf=is_signal) if is_signal(leaf)]
    return not jax.tree.leaves(signals) and jump_times(params, float) is None


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
