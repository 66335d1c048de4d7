"""Statistics that belong to each experiment: its own estimates, its predictions and residuals, with their errors."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from .._mechanics.surfaces import surfaces
from .._model.paths import is_within
from .._model.signal import is_signal
from .experiment import Experiment, start_entries, with_own
from .identifiability import Determined
from .minimum import Minimum


def own_estimates(minimum: Minimum, known: Determined, scale: float) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """For each experiment its unknowns and their standard errors, by name."""
    firsts = (segments[0] for segments in minimum.segments_of_each)
    return [_own_estimates(minimum, k, row, e, known, scale) for (k, row, _), e in zip(firsts, minimum.recordings, strict=True)]


def _own_estimates(minimum, k, row, e, known, scale):
    if not e.unknown:
        return {}, {}
    batch, part, p = minimum.problem.batches[k], minimum.found.batches[k], minimum.size
    own_columns = minimum.problem.own_columns(k, np.array([row]))[0]
    z, columns = minimum.x[own_columns], np.r_[0:p, own_columns]

    errors = lambda J: scale * known.deviations(J, columns)
    one = jax.tree.map(lambda leaf: leaf[row] if eqx.is_array(leaf) else leaf, batch)
    own_params = lambda z: ravel_pytree({name: one.start(z)[2][name] for name in batch.own})
    own, unravel_own = own_params(jnp.asarray(z))
    own_J = jax.jacfwd(lambda z: own_params(z)[0])(jnp.asarray(z))
    values, deviations = unravel_own(own), unravel_own(jnp.asarray(errors(np.hstack([np.zeros((own.size, p)), own_J]))))

    unravel = ravel_pytree((e.q0, e.qdot0))[1]
    half = part.ends.shape[1] // 2
    start = unravel(jnp.asarray(part.ends[row, :half]))
    if part.ends_jacobian is None:
        start_errors = jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), start)
    else:
        J = np.asarray(part.ends_jacobian[row, :half])
        unseen = (
            ~np.any(J, axis=1) & (not minimum.problem.model.system.constraints) & _is_named(e)
        )  # as a velocity at which friction sticks
        start_errors = unravel(jnp.asarray(np.where(unseen, np.inf, errors(J))))
    for which, value, error in zip(("q0", "qdot0"), start, start_errors, strict=True):
        if any(is_within(name, which) for name in e.unknown):
            values[which], deviations[which] = value, error
    return values, deviations


def _is_named(e):
    """Which numbers of the start are unknown."""
    return np.array([any(is_within(entry, name) for name in e.unknown) for entry in start_entries(e)])


def with_estimates(e: Any, own: dict[str, Any]) -> Any:
    """The experiment with its estimates put in; a test, which has none, as it is."""
    if not own:
        return e
    params = e.params | {name: value for name, value in own.items() if name in e.params}
    return eqx.tree_at(lambda e: (e.q0, e.qdot0, e.params), e, (own.get("q0", e.q0), own.get("qdot0", e.qdot0), params))


class Predicted(NamedTuple):
    """One experiment: measured − predicted, the predictions, and their standard errors over σ̂."""

    residuals: PyTree
    predictions: PyTree
    deviations: PyTree


def predictions_of(minimum: Minimum, known: Determined) -> list[Predicted]:
    """For each experiment, its segments put together."""
    found = []
    for e, segments in zip(minimum.recordings, minimum.segments_of_each, strict=True):
        parts = [jax.tree.map(lambda x, row=row: np.asarray(x)[row], minimum.found.batches[k].channels) for k, row, _ in segments]
        counts = [n for *_, n in segments] if len(segments) > 1 else [None]
        predictions = _joined(e.values, parts, counts)
        deviations = _joined(e.values, [_deviations(minimum, k, row, known) for k, row, _ in segments], counts)
        found.append(Predicted(jax.tree.map(lambda z, p: np.asarray(z) - p, e.values, predictions), predictions, deviations))
    return found


def _joined(values, parts, counts):
    """The parts of an experiment, each with so many samples of its own, or None for all; beyond its `values` there may be padding."""
    return jax.tree.map(lambda z, *xs: np.concatenate([x[:n] for x, n in zip(xs, counts, strict=True)])[: len(z)], values, *parts)


def _deviations(minimum, k, row, known):
    """√(J cov Jᵀ) of the predictions of one experiment, also of those that were not measured."""
    leaves, structure = jax.tree.flatten(jax.tree.map(lambda z: z[row], minimum.problem.batches[k].values))
    J = minimum.found.batches[k].channels_jacobian
    if J is None:
        return jax.tree.unflatten(structure, [np.full(leaf.shape, np.nan) for leaf in leaves])
    deviations = known.deviations(np.asarray(J)[row], minimum.problem.columns(k)[row])
    parts = np.split(deviations, np.cumsum([leaf.size for leaf in leaves])[:-1])
    return jax.tree.unflatten(structure, [part.reshape(leaf.shape) for part, leaf in zip(parts, leaves, strict=True)])


def deciding(minimum: Minimum) -> dict[str, str]:
    """By leaf of params, the line of the user's code where it decides, with the position or the time, what a function of the system is,
    and steps do not end.
    """
    found: dict[str, str] = {}
    for e in minimum.recordings:
        system, params = minimum.problem.model.system, with_own(minimum.problem.free.params, e.params)
        for surface in surfaces(system, e.q0, e.qdot0, params, e.ts[0], {}):
            found |= {} if surface.located else dict.fromkeys(surface.params, surface.line)
    return found


def ended_inputs(experiments: Sequence[Experiment], params: PyTree) -> dict[str, tuple[float, float]]:
    """Signals whose last sample comes more than a spacing of their samples before that of a record: its time, and that of the record."""
    found = {}
    for e in experiments:
        own = with_own(params, e.params)
        if not any(map(is_signal, jax.tree.leaves(own, is_leaf=is_signal))):
            continue
        last = float(e.ts[-1])
        for path, signal in jax.tree_util.tree_flatten_with_path(own, is_leaf=is_signal)[0]:
            if is_signal(signal):
                times = np.asarray(signal.times)
                if times[-1] + 1.5 * np.max(np.diff(times)) < last:
                    found[jax.tree_util.keystr(path, simple=True, separator=".")] = float(times[-1]), last
    return found
