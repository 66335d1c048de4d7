"""Predicted measurements of an experiment, their residuals, and the Jacobians of these."""

import dataclasses
import inspect
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from .._model.injection import call
from .._model.recorded import refuse_unknown
from .._model.system import System
from .._motion.results import RESULTS
from .._motion.simulate import simulate
from .._motion.trajectory import Trajectory
from .experiment import with_own
from .experiment_batch import ExperimentBatch, map_batch
from .parameters import Free
from .robust_loss import Huber

NUMERICS = tuple(name for name, p in inspect.signature(simulate).parameters.items() if p.kind is p.KEYWORD_ONLY)
OPTIONS = "Such options are `solver`, `rtol`, `atol`, `stabilisation` and `friction`."


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Model:
    """How measurements are predicted. Models with equal fields are equal, so that they share one compiled program."""

    system: System = dataclasses.field(metadata={"static": True})
    numerics: tuple[tuple[str, Any], ...] = dataclasses.field(metadata={"static": True})
    loss: Huber | None = dataclasses.field(metadata={"static": True})

    @classmethod
    def of(cls, system: System, numerics: Mapping[str, Any], loss: Huber | None = None) -> "Model":
        """With options of `simulate`; all others are refused."""
        for name in sorted(set(numerics) - set(NUMERICS)):
            raise TypeError(f"`{name}` must be an argument of this function or an option of `simulate`, but is neither. {OPTIONS}")
        return cls(system, tuple(sorted(numerics.items())), loss)

    def predicted(self, params: PyTree, e: ExperimentBatch, z: Any) -> tuple[PyTree, Trajectory]:
        """The predicted measurements of one experiment, and the motion behind them."""
        q0, qdot0, own = e.start(z)
        params = with_own(params, own)
        late = delays_of(e, params)
        ts, rows = _sampled(e.ts, late)
        motion = simulate(self.system, q0, qdot0, ts, params, **{**dict(self.numerics), "throw": False})

        def seen(t, q, qdot, qddot, multipliers, states):
            state = dict(t=t, q=q, qdot=qdot, qddot=qddot, multipliers=multipliers)
            return call(e.observe, "`observe`", params, **state, **states, states=states)

        channels = jax.vmap(seen)(motion.ts, motion.q, motion.qdot, motion.qddot, motion.multipliers, motion.states)
        if isinstance(e.delay, tuple):
            refuse_unknown(late, {**channels, **dict.fromkeys(e.events)} if isinstance(channels, Mapping) else channels)
            channels = {name: x[rows[name if name in late else ALL]] for name, x in channels.items()}
        elif late:
            channels = jax.tree.map(lambda x: x[rows[ALL]], channels)
        return (channels | _times(e, motion, late) if e.events else channels), motion


ALL = ""  # stands for all channels that have no delay of their own


def delays_of(e: Any, params: PyTree) -> dict[str, Any]:
    """The delays by channel of an experiment or a batch."""
    given = e.delay if isinstance(e.delay, tuple) else () if e.delay is None else ((ALL, e.delay),)
    return {name: call(delay, "`delay`", params) if callable(delay) else delay for name, delay in given}


def _sampled(ts, late):
    """The times, in order, at which the motion is wanted, and by channel those of them that are its samples."""
    if not late:
        return ts, {}
    delayed = [ts - jnp.asarray(delay, ts.dtype) for delay in ({ALL: 0.0} | late).values()]
    times = jnp.concatenate([ts[:1], *(jnp.where(one > ts[0], one, ts[0]) for one in delayed)])
    order = jnp.argsort(times)
    places = jnp.argsort(order)[1:].reshape(-1, ts.size)
    return times[order], dict(zip({ALL: 0.0} | late, places, strict=True))


def _times(e, motion, late):
    """When events happen, as many as were observed; NaN beyond the last."""
    for name in e.events:
        if name not in motion.events:
            there = ", ".join(motion.events) or "none"
            raise ValueError(f"`events` must name events of the system, but holds {name!r}. There are {there}.")
    counts = {name: e.values[name].size for name in e.events}
    times = {name: motion.events[name].ts[:count] + late.get(name, 0.0) for name, count in counts.items()}
    return {name: jnp.concatenate([ts, jnp.full(counts[name] - ts.size, jnp.nan, ts.dtype)]) for name, ts in times.items()}


class Predictions(NamedTuple):
    """Experiments at given unknowns: their weighted residuals, first and last state as (q, q̇, q, q̇), predictions, and how the motion
    ended; ends and predictions with their Jacobians with respect to (y, z), or None. Experiments are the first axis.
    """

    residuals: Any
    ends: Any
    ends_jacobian: Any
    channels: PyTree
    channels_jacobian: Any
    result: RESULTS


def _predicted(model, free, e, y, z):
    """Of one experiment at the scaled free parameters y and its own unknowns z: flat predictions, ends, predictions, how it ended."""
    channels, motion = model.predicted(free.insert(free.theta(y)), e, z)
    _check(e, channels)
    ends = ravel_pytree([jax.tree.map(lambda x, i=i: x[i], (motion.q, motion.qdot)) for i in (0, -1)])[0]
    return ravel_pytree(channels)[0], ends, channels, motion.result


def weighted(loss: Huber | None, batch: ExperimentBatch, found: Predictions, scale: Any = 1.0) -> tuple[Predictions, Any]:
    """Predictions with their residuals over sigma, as the loss counts them, and the Jacobian of these; zero where nothing was measured, and
    infinite residuals where there is no motion. Takes no motion.
    """

    def of_one(measured, sigma, predicted, J, result):
        measured, sigma, predicted = (ravel_pytree(tree)[0] for tree in (measured, sigma, predicted))
        there = jnp.isfinite(measured)
        r = jnp.where(there, (jnp.where(there, predicted, 0) - jnp.where(there, measured, 0)) / sigma, 0)
        slopes = jnp.where(there, 1 / sigma, 0)
        r, slopes = (r, slopes) if loss is None else (scale * loss.root(r / scale), slopes * loss.slope(r / scale))
        J = None if J is None else jnp.where(slopes[:, None] > 0, slopes[:, None] * J, 0)
        finite = (result == RESULTS.successful) & (True if J is None else jnp.all(jnp.isfinite(r)) & jnp.all(jnp.isfinite(J)))
        return jnp.where(finite, r, jnp.inf), None if J is None else jnp.where(finite, J, 0)

    measured, sigma = (jax.tree.map(lambda x: x[: len(batch.members)], tree) for tree in (batch.values, batch.sigma))
    residuals, J = jax.vmap(of_one)(measured, sigma, found.channels, found.channels_jacobian, found.result)
    return found._replace(residuals=residuals), J


def _check(e, channels):
    """Refuses an `observe` that does not return what was measured. Only shapes are compared, during tracing."""
    of = f"`observe` of experiment {e.members[0]}"
    if jax.tree.structure(channels) != jax.tree.structure(e.values):
        raise ValueError(
            f"{of} must return what `values` holds, {jax.tree.structure(e.values)}, but returns {jax.tree.structure(channels)}. "
            "Give both the same names."
        )
    for (path, seen), v in zip(jax.tree_util.tree_flatten_with_path(channels)[0], jax.tree.leaves(e.values), strict=True):
        if seen.shape != v.shape or not jnp.issubdtype(seen.dtype, jnp.floating):
            raise ValueError(
                f"{of} must return real numbers of shape {v.shape[1:]} for `values{jax.tree_util.keystr(path)}`, "
                f"but returns shape {seen.shape[1:]} and dtype {seen.dtype}. Return one sample, structured like one row of `values`."
            )


def predict_batch(model: Model, free: Free, batch: ExperimentBatch, y: Any, z: Any) -> Predictions:
    """The experiments of a batch at y and z (experiments, unknowns), without Jacobians or residuals."""

    def of_one(e, z, y, free):
        _, ends, channels, result = _predicted(model, free, e, y, z)
        return Predictions(None, ends, None, channels, None, result)

    return map_batch(of_one, batch, z, y, free)


def linearise_batch(model: Model, free: Free, batch: ExperimentBatch, y: Any, z: Any) -> Predictions:
    """The same with their Jacobians, in one forward pass."""

    def of_one(e, z, y, free):
        def channels_and_ends(x):
            flat, ends, *rest = _predicted(model, free, e, x[: y.size], x[y.size :])
            return (flat, ends), (ends, *rest)

        (channels_J, ends_J), (ends, channels, result) = jax.jacfwd(channels_and_ends, has_aux=True)(jnp.concatenate([y, z]))
        return Predictions(None, ends, ends_J, channels, channels_J, result)

    return map_batch(of_one, batch, z, y, free)
