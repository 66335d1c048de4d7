"""Multiple shooting: a long record in pieces, each with a start of its own, whose ends must meet."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._mechanics.projection import consistent_state
from .experiment import Experiment, with_own
from .levenberg_marquardt import APART, INTERRUPTED, MAX_STEPS, Outcome, levenberg_marquardt
from .problem import Links, Problem, linearise
from .smoothing_spline import smooth

FIRST = 0.1  # of what the residuals weigh, the gaps do when they are first looked at
TIGHTER = 10.0  # the weight of the gaps from one round to the next
ROUGH = 0.1  # of a standard error, the tolerance until the gaps are closed
LOST = 0.5  # of its misfit that a piece has to gain to begin where the one before ends
CLOSED = 1e-9  # gaps that are left, in units of the motion,
ROUNDINGS = 300  # or so many units in the last place, in single precision,
CLOSE = 1e-5  # or these, or rtol, where more weight does not make them smaller: they are the integration's error
FALLING = 0.5  # of the gaps before, or less, are gaps that fall
PATIENCE = 3  # rounds in which they do not, until it is given up


class Pieces(NamedTuple):
    """The pieces of some experiments: the `problem` of them all; of which experiment each is; how many samples are its own."""

    problem: Problem
    of: tuple[int, ...]
    samples: tuple[int, ...]


def cut(problem: Problem, experiments: Sequence[Experiment], count: int) -> Pieces:
    """Each experiment in `count` pieces, that start where splines through the measurements are."""
    pieces: list[Experiment] = []
    of, samples, pairs, states = [], [], [], []
    for i, e in enumerate(experiments):
        if set(e.unknown) & set(e.params) or e.delay is not None:
            raise ValueError(
                "`pieces` must be 1 where an experiment has unknown parameters of its own or a delay, but is more. Free them in `params`."
            )
        if count > e.ts.size // 3:
            raise ValueError(f"`pieces` must leave three samples to each piece, but there are {count} for {e.ts.size} samples. Take fewer.")
        motion = smooth(e, problem.free.params)
        cuts = np.linspace(0, e.ts.size, count + 1).astype(int)
        for k, (a, b) in enumerate(itertools.pairwise(cuts)):
            if k:
                pairs.append((len(pieces) - 1, len(pieces)))
            states.append(np.concatenate([motion.q[a], motion.v[a]]))
            pieces.append(_piece(problem, e, motion, a, b))
            of.append(i)
            samples.append(b - a)
    spread = np.std(np.array(states), axis=0)
    size = jnp.asarray(np.where(spread > 0, spread, 1.0))
    apart = Problem.of(problem.model, problem.free, pieces)
    apart = dataclasses.replace(apart, scale=problem.scale)
    rows = sum(apart.stacks[k].ways.shape[-1] for k, row in _places(apart, [b for _, b in pairs]))
    links = Links(jnp.asarray(0.0), jnp.zeros(rows), size, tuple(pairs))
    return Pieces(dataclasses.replace(apart, links=links), tuple(of), tuple(samples))


def _places(problem, which):
    place = {i: (k, row) for k, stack in enumerate(problem.stacks) for row, i in enumerate(stack.members)}
    return [place[i] for i in which]


def _piece(problem, e, motion, a, b):
    """Samples a … b − 1 of an experiment, and the time of the next, where nothing is measured any more."""
    end = min(b + 1, e.ts.size)
    own = jnp.arange(a, end) < b
    within = lambda x: x[a:end]
    missing = lambda v: jnp.where(jnp.expand_dims(own, tuple(range(1, v.ndim))), within(v), jnp.nan)
    q0, qdot0, unknown = e.q0, e.qdot0, e.unknown
    if a or unknown:
        _, unravel = ravel_pytree((e.q0, e.qdot0))
        q0, qdot0 = unravel(jnp.asarray(np.concatenate([motion.q[a], motion.v[a]])))
        if problem.model.system.constraints:
            q0, qdot0 = consistent_state(problem.model.system, q0, qdot0, with_own(problem.free.params, e.params), t=e.ts[a])
    if a:
        unknown = ("q0", "qdot0")
    return Experiment(
        e.ts[a:end],
        jax.tree.map(missing, e.values),
        q0,
        qdot0,
        observe=e.observe,
        sigma=None if e.sigma is None else jax.tree.map(within, e.sigma),
        params=e.params,
        unknown=unknown,
    )


def join(problem: Problem, x: Any, *, max_steps: int, tolerance: float, freedom: int, progress: Any) -> tuple[Outcome, Problem]:
    """First the pieces each by itself, with the parameters in common; then the gaps are closed, in rounds of growing weight."""
    if not jnp.all(jnp.isfinite(linearise(problem, x).residuals)):
        raise ValueError(
            "`params` must give a motion in each piece, but one could not be computed. Start from others, or take more pieces."
        )
    links = problem.links
    assert links is not None
    steps, costs, weight, bounds = 0, np.zeros(0), 0.0, problem.bounds
    closed, gap, rounds, last = False, np.inf, 0, None
    close = max(CLOSE, float(dict(problem.model.numerics).get("rtol") or 0))
    while True:
        problem = dataclasses.replace(problem, links=links)

        def seen(x, problem=problem):
            rows = linearise(problem, x)
            return rows.residuals, rows.jacobian, rows

        more = None if progress is None else lambda step, cost, done=steps: progress(done + step, cost)
        exactness = tolerance if closed else ROUGH
        outcome = levenberg_marquardt(
            seen, x, bounds=bounds, freedom=freedom, max_steps=max_steps - steps, tolerance=exactness, progress=more
        )
        x, steps, costs = outcome.best.y, steps + outcome.steps, np.append(costs, outcome.costs)
        rows, status = outcome.best.rest, int(outcome.best.status)
        apart = rounds >= PATIENCE
        if status == INTERRUPTED or steps >= max_steps or closed or apart:
            ended = status if closed or status == INTERRUPTED else MAX_STEPS if steps >= max_steps else APART
            return Outcome(outcome.best._replace(status=jnp.asarray(ended)), steps, costs), problem
        if weight == 0.0:
            x, lost = _begun_anew(problem, x, rows)
            if lost:
                continue
        before, left = gap, float(jnp.max(jnp.abs(rows.gaps)))
        gap, rounds = min(left, before), rounds + 1 if left > FALLING * before else 0
        if rounds and left < close and last is not None:  # the integration cannot do better: back to the last weight that helped
            (x, links), closed = last, True
            continue
        last = (x, links) if weight else None
        closed = left < max(CLOSED, ROUNDINGS * float(jnp.finfo(x.dtype).eps))
        before, weight = weight, weight * TIGHTER or FIRST * float(jnp.linalg.norm(rows.residuals) / jnp.linalg.norm(rows.gaps))
        weight = before if closed and before else weight
        dual = (links.dual + rows.gaps) * (before / weight) ** 2  # weight² dual are the multipliers of the gaps, which go on
        links = dataclasses.replace(links, weight=jnp.asarray(weight), dual=dual)


def _begun_anew(problem, x, rows):
    """x with pieces that have lost their measurements begun where the piece before ends; and whether there were such."""
    misfits = lambda rows: np.concatenate([np.sum(np.asarray(part.residuals) ** 2, axis=1) for part in rows.of_stacks])
    order = [i for stack in problem.stacks for i in stack.members]
    places = {i: (k, row) for k, stack in enumerate(problem.stacks) for row, i in enumerate(stack.members)}
    half = problem.links.size.size
    tried = np.array(x)
    for a, b in problem.links.pairs:
        (ka, ra), (kb, rb) = places[a], places[b]
        start, _ = ravel_pytree(jax.tree.map(lambda leaf, rb=rb: leaf[rb], (problem.stacks[kb].q0, problem.stacks[kb].qdot0)))
        way = np.asarray(problem.stacks[kb].ways[rb])
        tried[problem.own_columns(kb, np.array([rb]))[0]] = way.T @ (np.asarray(rows.of_stacks[ka].ends[ra, half:]) - np.asarray(start))
    now, then = misfits(rows), misfits(linearise(problem, jnp.asarray(tried)))
    better = {order[j] for j in np.flatnonzero(then < LOST * now)}
    x = np.array(x)
    for i in better:
        columns = problem.own_columns(places[i][0], np.array([places[i][1]]))[0]
        x[columns] = tried[columns]
    return jnp.asarray(x), bool(better)
