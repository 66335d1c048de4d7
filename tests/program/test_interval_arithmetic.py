"""Bounds over intervals of time contain all values between, whatever operations a load uses, and are close where the interval is short."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlag import Signal
from jaxlag._program.time_bounds import time_dependence
from jaxlag.interpolation import Cubic, Linear, ZeroOrderHold

rng = np.random.default_rng(5)
TS = np.sort(rng.uniform(-3, 3, 40))
VALUES = rng.normal(size=40)
A = rng.normal(size=(3, 3))

LOADS = {
    "a polynomial": lambda t: t**3 - 2 * t**2 + (1 - t) ** 4,
    "waves": lambda t: jnp.sin(7 * t) + jnp.cos(3 * t) ** 2,
    "a pulse": lambda t: 8 * jnp.exp(-(((t - 0.4) / 0.3) ** 2)),
    "a bell": lambda t: 1 / jnp.cosh(5 * t) ** 2 + jnp.tanh(t),
    "a tangent": lambda t: jnp.tan(t),
    "a quotient": lambda t: (1 + t) / (2 + jnp.sin(t)),
    "a pole": lambda t: 1 / t,
    "a saw": lambda t: t - jnp.floor(t / 0.7) * 0.7,
    "a remainder": lambda t: jax.lax.rem(t, 0.7),
    "another remainder": lambda t: t % 0.7,
    "steps": lambda t: jnp.round(2 * t) + jnp.sign(t - 0.2) + jnp.ceil(t),
    "a switch": lambda t: jnp.where(t > 0.3, jnp.sin(t), 2.0) + (t < -1) * 3.0,
    "a truth value": lambda t: 1.0 * ((2 * t).astype(int) == 3) + jnp.isfinite(jnp.log(t)),
    "a branch": lambda t: jax.lax.cond(t > 0.5, jnp.cos, lambda t: 2 * t, t),
    "branches": lambda t: jax.lax.switch(jnp.floor(t).astype(int), [jnp.sin, jnp.cos, lambda t: t], t),
    "a loop": lambda t: jax.lax.scan(lambda s, k: (s * t / 3 + k, None), 0.0, jnp.arange(6.0))[0],
    "a long loop": lambda t: jax.lax.fori_loop(0, 1000, lambda i, s: s * t / 3 + 1, 0.0),
    "powers": lambda t: jnp.abs(t) ** 1.5 + (t**2 + 0.1) ** t,
    "a root": lambda t: jnp.sqrt(jnp.maximum(t, 0)) + jnp.cbrt(t),
    "small integers": lambda t: (100 * t).astype(jnp.int8) * 1.0,
    "integers that wrap around": lambda t: ((1000 * t).astype(jnp.int32).astype(jnp.int8) * jnp.int8(3)) * 1.0,
    "natural numbers": lambda t: ((10 * jnp.abs(t)).astype(jnp.uint8) - jnp.uint8(7)) // jnp.uint8(3) * 1.0,
    "a held signal": lambda t: Signal(TS, VALUES)(t),
    "a linear signal": lambda t: Signal(TS, VALUES, Linear())(t),
    "a cubic signal": lambda t: Signal(TS, VALUES, Cubic())(t),
    "a table": lambda t: jnp.interp(t, TS, VALUES),
    "a table of one's own": lambda t: jnp.asarray(VALUES)[jnp.floor(4 * t).astype(int) % 7],
    "a search": lambda t: jnp.searchsorted(jnp.asarray(TS), t) * 1.0,
    "rows of a table": lambda t: jnp.sum(jnp.asarray(A)[jnp.clip(t, 0, 2).astype(int)] * t),
    "a slice": lambda t: jax.lax.dynamic_slice(jnp.asarray(VALUES), (jnp.floor(3 * t).astype(int),), (3,)) @ jnp.ones(3),
    "matrices": lambda t: jnp.sum(jnp.asarray(A) @ jnp.stack([t, t**2, jnp.sin(t)]) ** 2),
    "matrices of integers": lambda t: jnp.sum(jnp.arange(6).reshape(2, 3) @ (jnp.stack([3 * t, -t, 5 * t]).astype(int))) * 1.0,
    "sums": lambda t: jnp.cumsum(jnp.stack([t, -t, t**2]))[1] + jnp.zeros(3).at[jnp.array([0, 2, 0])].add(t)[0],
    "a sort": lambda t: jnp.sort(jnp.stack([t, 1 - t, t**2]))[1],
    "an angle": lambda t: jnp.arctan2(t, 1 - t),
}


@pytest.mark.parametrize("load", LOADS.values(), ids=LOADS)
def test_values_between_are_within_the_bounds(load):
    a = rng.uniform(-3, 3, 400)
    b = a + 10 ** rng.uniform(-5, 0.5, 400)
    ts = a + (b - a) * np.linspace(0, 1, 60)[:, None]

    @jax.jit
    def both(a, b, ts):
        parted = time_dependence(lambda t, y: load(t) * y[0], a[0], jnp.ones(2))
        return jax.vmap(parted.bounds)(a, b), jax.vmap(jax.vmap(parted.phi))(ts)

    (bounds, phi), found = jax.tree.map(np.asarray, both(a, b, ts)), []
    for (low, high), between in zip(bounds, phi, strict=True):
        assert np.all((low <= high) | np.isnan(between).any(0))
        rounding = 1e-13 * (1 + np.nan_to_num(np.maximum(np.abs(low), np.abs(high)), posinf=0))
        assert np.all(np.isnan(between) | (between >= low - rounding) & (between <= high + rounding))
        found.append(np.isfinite(low) & np.isfinite(high))
    assert load in map(LOADS.get, ("a sort", "an angle", "a long loop")) or np.mean(found[-1][b - a < 1e-3]) > 0.95


@pytest.mark.parametrize("interpolation, wider", [(ZeroOrderHold(), 0.0), (Linear(), 0.5)])
def test_bounds_of_signals_are_close(interpolation, wider):
    """Within one interval of a signal, its own range; twice as wide where the time enters twice."""
    signal = Signal(TS, VALUES, interpolation)
    bounds = time_dependence(lambda t, y: signal(t) * y[0], jnp.zeros(()), jnp.ones(2)).bounds
    ((low, high),) = jax.jit(jax.vmap(bounds))(TS[:-1] + 1e-12, TS[1:] - 1e-12)
    ts = TS[:-1] + np.diff(TS) * np.linspace(1e-9, 1 - 1e-9, 100)[:, None]
    least, most = np.min(jax.vmap(signal)(ts), axis=0), np.max(jax.vmap(signal)(ts), axis=0)
    wider *= np.abs(VALUES[1:]) + np.abs(VALUES[:-1])
    assert np.all(low >= least - wider - 1e-9) and np.all(high <= most + wider + 1e-9)
