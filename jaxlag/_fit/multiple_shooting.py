"""Multiple shooting: a long record is cut into segments, each with a start of its own, and the gaps between them are closed."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._mechanics.consistent_state import consistent_state
from .experiment import Experiment, with_own
from .levenberg_marquardt import DISCONTINUOUS, INTERRUPTED, STEP_LIMIT, Outcome, levenberg_marquardt
from .problem import Continuity, LeastSquaresProblem, NoMotion, linearise
from .smoothing_spline import smooth

FIRST_WEIGHT = 0.1  # of the gaps in the first round, relative to the residuals
GROWTH = 10.0  # of the weight from one round to the next
ROUGH = 0.1  # tolerance in standard errors, until the gaps are closed
LOST = 0.5  # a segment whose sum of squares falls below this part of it is restarted from the end of the one before
CLOSED = 1e-9  # gaps, relative to the size of the motion, that count as closed,
CLOSED_ULPS = 300  # or this many units in the last place, in single precision,
NEARLY_CLOSED = 1e-5  # or these, or rtol, where more weight does not reduce them: they are the error of the integration
FALLING = 0.5  # gaps are falling where they are at most this part of the gaps before
FEWEST = 3  # samples of a segment
PATIENCE = 3  # rounds without falling gaps, after which the iteration stops


class Segments(NamedTuple):
    """Experiments cut into segments: the `problem` of all segments; the experiment of each; how many samples are its own."""

    problem: LeastSquaresProblem
    of: tuple[int, ...]
    samples: tuple[int, ...]


def cut(problem: LeastSquaresProblem, experiments: Sequence[Experiment], count: int) -> Segments:
    """Each experiment in `count` segments, which start on splines through the measurements."""
    segments: list[Experiment] = []
    of, samples, pairs, starts = [], [], [], []
    if problem.model.system.states:
        raise ValueError("`segments` must be 1 where the system has states, whose values at the cuts are unknown, but is more. Omit it.")
    for i, e in enumerate(experiments):
        _check(e, count)
        motion = smooth(e, problem.free.params)
        cuts = np.linspace(0, e.ts.size, count + 1).astype(int)
        for k, (a, b) in enumerate(itertools.pairwise(cuts)):
            if k:
                pairs.append((len(segments) - 1, len(segments)))
            starts.append(np.concatenate([motion.q[a], motion.v[a]]))
            segments.append(_segment(problem, e, motion, a, b))
            of.append(i)
            samples.append(int(b - a))
    deviation = np.std(np.array(starts), axis=0)
    size = jnp.asarray(np.where(deviation > 0, deviation, 1.0))
    of_segments = LeastSquaresProblem.of(problem.model, problem.free, segments)
    gaps = sum(of_segments.batches[of_segments.places[b][0]].tangent_basis.shape[-1] for _, b in pairs)
    continuity = Continuity(jnp.asarray(0.0), jnp.zeros(gaps), size, tuple(pairs))
    of_segments = dataclasses.replace(of_segments, scale=problem.scale, continuity=continuity, tests=problem.tests)
    return Segments(of_segments, tuple(of), tuple(samples))


def can_be_cut(e: Experiment) -> bool:
    """Whether the segments of a record are determined by their starts and by parameters that all share."""
    return not (set(e.unknown) & set(e.params) or e.events or e.delay is not None)


def _check(e, count):
    if not can_be_cut(e):
        raise ValueError(
            "`segments` must be 1 where an experiment has unknown parameters of its own, events or a delay, but is more. "
            "Free parameters in `params`, and leave events and delays out."
        )
    if count > e.ts.size // FEWEST:
        raise ValueError(f"`segments` must leave three samples to each segment, but there are {count} for {e.ts.size} samples. Use fewer.")


def _segment(problem, e, motion, a, b):
    """Samples a … b − 1 of an experiment, and the time of sample b without its measurements."""
    end = min(b + 1, e.ts.size)
    own = jnp.arange(a, end) < b
    within = lambda x: x[a:end]
    masked = lambda v: jnp.where(jnp.expand_dims(own, tuple(range(1, v.ndim))), within(v), jnp.nan)
    q0, qdot0, unknown = e.q0, e.qdot0, e.unknown
    if a or unknown:
        _, unravel = ravel_pytree((e.q0, e.qdot0))
        q0, qdot0 = unravel(jnp.asarray(np.concatenate([motion.q[a], motion.v[a]])))
        if problem.model.system.constraints:
            q0, qdot0 = consistent_state(problem.model.system, q0, qdot0, with_own(problem.free.params, e.params), t=e.ts[a])
    if a:
        unknown = ("q0", "qdot0")
    sigma = None if e.sigma is None else jax.tree.map(within, e.sigma)
    planned = Experiment(e.ts[a:end], None, q0, qdot0, observe=e.observe, sigma=sigma, params=e.params, unknown=unknown)
    return eqx.tree_at(lambda one: one.values, planned, jax.tree.map(masked, e.values), is_leaf=lambda x: x is None)  # some may see nothing


def join(
    problem: LeastSquaresProblem, x: Any, *, max_steps: int, tolerance: float, freedom: int, progress: Any
) -> tuple[Outcome, LeastSquaresProblem]:
    """Fits the segments without continuity, then closes the gaps in rounds of growing weight; the outcome, and the last problem."""
    if not jnp.all(jnp.isfinite(linearise(problem, x).residuals)):
        raise NoMotion(
            "`params` must give a motion in each segment, but one could not be computed. Start from others, or use more segments."
        )
    continuity = problem.continuity
    assert continuity is not None
    steps, costs, weight = 0, np.zeros(0), 0.0
    closed, gap, stalled, last = False, np.inf, 0, None
    while True:
        problem = dataclasses.replace(problem, continuity=continuity)
        limits = {"freedom": freedom, "max_steps": max_steps - steps, "tolerance": tolerance if closed else ROUGH}
        outcome = _minimised(problem, x, limits, progress, steps)
        x, steps, costs = outcome.best.y, steps + outcome.steps, np.append(costs, outcome.costs)
        found, status = outcome.best.aux, int(outcome.best.status)
        if status == INTERRUPTED or steps >= max_steps or closed or stalled >= PATIENCE:
            ended = status if closed or status == INTERRUPTED else STEP_LIMIT if steps >= max_steps else DISCONTINUOUS
            return Outcome(outcome.best._replace(status=jnp.asarray(ended)), steps, costs), problem
        if weight == 0.0:
            x, restarted = _lost_segments_restarted(problem, x, found)
            if restarted:
                continue
        before, left = gap, float(jnp.max(jnp.abs(found.gaps)))
        gap, stalled = min(left, before), stalled + 1 if left > FALLING * before else 0
        if stalled and left < _nearly_closed(problem) and last is not None:  # the integration cannot do better: back to the last weight
            (x, continuity), closed = last, True
            continue
        last = (x, continuity) if weight else None
        closed = left < max(CLOSED, CLOSED_ULPS * float(jnp.finfo(x.dtype).eps))
        weight, continuity = _next_round(continuity, found, weight, closed)


def _minimised(problem, x, limits, progress, done):
    """One round; `done` steps were taken before."""

    def residuals(x):
        found = linearise(problem, x)
        return found.residuals, found.jacobian, found

    shown = None if progress is None else lambda step, cost: progress(done + step, cost)
    return levenberg_marquardt(residuals, x, bounds=problem.bounds, progress=shown, **limits)


def _nearly_closed(problem):
    return max(NEARLY_CLOSED, float(dict(problem.model.numerics).get("rtol") or 0))


def _next_round(continuity, found, before, closed):
    """The weight of the next round, and the continuity with the multipliers weight² · dual carried over to it."""
    weight = before * GROWTH or FIRST_WEIGHT * float(jnp.linalg.norm(found.residuals) / jnp.linalg.norm(found.gaps))
    weight = before if closed and before else weight
    dual = (continuity.dual + found.gaps) * (before / weight) ** 2
    return weight, dataclasses.replace(continuity, weight=jnp.asarray(weight), dual=dual)


def _lost_segments_restarted(problem, x, found):
    """x with segments that lost their measurements restarted where the one before ends; and whether there were any."""
    misfits = lambda found: np.concatenate([np.sum(np.asarray(part.residuals) ** 2, axis=1) for part in found.batches])
    order = [i for batch in problem.batches for i in batch.members]
    places = problem.places
    half = problem.continuity.size.size
    tried = np.array(x)
    for a, b in problem.continuity.pairs:
        (batch_a, row_a), (batch_b, row_b) = places[a], places[b]
        batch = problem.batches[batch_b]
        start, _ = ravel_pytree(jax.tree.map(lambda leaf, row=row_b: leaf[row], (batch.q0, batch.qdot0)))
        basis, end = np.asarray(batch.tangent_basis[row_b]), np.asarray(found.batches[batch_a].ends[row_a, half:])
        tried[problem.own_columns(batch_b, np.array([row_b]))[0]] = basis.T @ (end - np.asarray(start))
    now, then = misfits(found), misfits(linearise(problem, jnp.asarray(tried)))
    better = {order[j] for j in np.flatnonzero(then < LOST * now)}
    x = np.array(x)
    for i in better:
        k, row = places[i]
        columns = problem.own_columns(k, np.array([row]))[0]
        x[columns] = tried[columns]
    return jnp.asarray(x), bool(better)
