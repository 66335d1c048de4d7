"""What is measured of a periodic motion: the greatest and the least value of a function in a period, and its harmonics."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Complex, Float, PyTree

from .._model.injection import call, check_function
from .._model.paths import entry_names
from .._motion.trajectory import Trajectory

PASSES = 4  # each looks for an extremum between the neighbours of the best sample of the one before
SAMPLES = 65  # of a pass; an extremum is located to 64 · 32⁻⁴ of a period at least
TOUCHES = 1e-5  # of a period: an extremum so near to an impact happens at it


class Measure(NamedTuple):
    """A function of a motion by the argument rule, or this entry of q."""

    name: str
    function: Callable | None
    entry: int = 0

    def at(self, params: PyTree, t: Any, q: Any, qdot: Any, qddot: Any, multipliers: Any, states: Any) -> Array:
        """Its value at one instant."""
        if self.function is None:
            return ravel_pytree(q)[0][self.entry]
        state = {"t": t, "q": q, "qdot": qdot, "qddot": qddot, "multipliers": multipliers, "states": states}
        value = jnp.asarray(call(self.function, f"`of` {self.name!r}", params, **state))
        if value.ndim:
            raise ValueError(f"`of` {self.name!r} must return one number, but returned an array of shape {value.shape}. Name its entries.")
        return value


class Measured(NamedTuple):
    """The greatest and the least value in a period, `highest` and `lowest`, and `harmonics` (9), c₀ the mean: f = Re Σ cₙ exp(2π i n t/T).
    Of many motions, each has them as its first axis.
    """

    highest: Float[Array, "..."]
    lowest: Float[Array, "..."]
    harmonics: Complex[Array, "... h"]


def measures_of(of: Any, q: PyTree) -> tuple[Measure, ...]:
    """What is to be measured: functions by name, one function, or all coordinates."""
    if of is None:
        return tuple(Measure(name, None, i) for i, name in enumerate(entry_names(q, "q")))
    given = dict(of) if isinstance(of, dict) else {"response": of}
    if not given:
        raise ValueError("`of` must be functions by name, but is empty. Write e.g. `{'tip': lambda q: q['x']}`, or leave it out.")
    for name, function in given.items():
        check_function(function, f"`of` {name!r}")
    return tuple(Measure(name, function) for name, function in given.items())


def values_of(measures: tuple[Measure, ...], motion: Trajectory, params: PyTree) -> tuple[Float[Array, "f T"], Float[Array, "f T"]]:
    """The values at the samples of a motion, and their rates as far as they come of t, q and q̇."""
    along = motion.ts, motion.q, motion.qdot
    rates = jnp.ones_like(motion.ts), motion.qdot, motion.qddot
    beside = motion.qddot, motion.multipliers, motion.states

    def of_one(measure):
        def at(moving, moves, others):
            return jax.jvp(lambda *moving: measure.at(params, *moving, *others), moving, moves)

        return jax.vmap(at)(along, rates, beside)

    values, slopes = zip(*map(of_one, measures), strict=True)
    return jnp.stack(values), jnp.stack(slopes)


def extrema(values_at: Callable[[Array], Array], size: int, start: Any, period: Any) -> Float[Array, "2 f"]:
    """The instants of the greatest and the least of each of `size` values; `values_at` gives them, (f, T), at any times."""
    sign, own = jnp.array([1.0, -1.0])[:, None, None], np.arange(size)
    parts = jnp.linspace(0, 1, SAMPLES)[None, None]

    def closer(bracket, _):
        low, high, _ = bracket
        ts = low[..., None] + (high - low)[..., None] * parts
        values = values_at(ts.ravel()).reshape(size, *ts.shape)[own, :, own].swapaxes(0, 1)
        best = jnp.argmax(sign * values, axis=-1)
        at = lambda i: jnp.take_along_axis(ts, jnp.clip(i, 0, SAMPLES - 1)[..., None], axis=-1)[..., 0]
        return (at(best - 1), at(best + 1), at(best)), None

    shape = (2, size)
    whole = jnp.broadcast_to(start, shape), jnp.broadcast_to(start + period, shape), jnp.broadcast_to(start, shape)
    (_, _, best), _ = jax.lax.scan(closer, whole, length=PASSES)
    return best


def harmonics_of(values: Float[Array, "f N"], ts: Float[Array, " N"], period: Any, most: int) -> Complex[Array, "f h"]:
    """The Fourier coefficients of values at N equidistant times of one period: the mean, and c_n for n to `most`."""
    n = np.arange(most + 1)
    turning = jnp.exp(-2j * jnp.pi * n[:, None] * (ts / period)[None, :])
    return np.where(n > 0, 2, 1)[None] * (values.astype(turning.dtype) @ turning.T) / values.shape[1]


def moved_by_impacts(motion: Trajectory, at: Array, period: Any, rates: Float[Array, "f T"]) -> Float[Array, "f a"]:
    """What values at samples `at`, so near to an impact that they are meant to be those at it, change until then."""
    moved, times = jnp.zeros((rates.shape[0], at.size), rates.dtype), jax.lax.stop_gradient(motion.ts[at])
    for contact in motion.contacts.values():
        changed = contact.changed.reshape(motion.ts.size, -1)
        before, behind = (changed[i] - times[:, None] for i in (at, jnp.minimum(at + 1, motion.ts.size - 1)))
        is_near = lambda until: jnp.abs(until) < TOUCHES * period
        until = jnp.where(is_near(before), before, jnp.where(is_near(behind), behind, 0))
        moved += rates[:, at] * jnp.sum(until, axis=1)[None]
    return moved
