"""The oscillator m ẍ + b ẋ + c x = 0 in closed form, the data of many tests of identification."""

import jax.numpy as jnp
import numpy as np

import jaxlag as jl

SYSTEM = jl.System(lambda q, qdot, m, c: 0.5 * m * qdot**2 - 0.5 * c * q**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2)
TRUE = {"m": 1.0, "c": 4.0, "b": 0.3}
START = {"m": 1.0, "c": 3.0, "b": 0.6}
TIMES = np.linspace(0.0, 10.0, 60)


def position(ts, c=4.0, b=0.3, x0=1.0, v0=0.0):
    """x(t), for m = 1."""
    decay = b / 2
    w = np.sqrt(c - decay**2)
    return np.exp(-decay * ts) * (x0 * np.cos(w * ts) + (v0 + decay * x0) / w * np.sin(w * ts))


def noisy(seed, ts=TIMES, sigma=0.01, **motion):
    """Measured positions."""
    return position(ts, **motion) + sigma * np.random.default_rng(seed).standard_normal(len(ts))


def record(seed, ts=TIMES, **more):
    """An experiment."""
    return jl.Experiment(ts, noisy(seed, ts), 1.0, 0.0, **more)


def with_nan(values, *at):
    """The values with some of them missing."""
    values = np.array(values)
    values[list(at)] = jnp.nan
    return values
