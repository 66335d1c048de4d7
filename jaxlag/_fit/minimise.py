"""Minimises a least-squares problem: from one start or many, in segments, with a robust loss, or by an optimiser of optax."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._motion.derivative_rule import FORWARD_LIMIT
from .._program.jit import compiled
from .experiment_batch import with_sigma
from .levenberg_marquardt import INTERRUPTED, STEP_LIMIT, Iterate, Outcome, levenberg_marquardt
from .multiple_shooting import join
from .noise import Channels, sigmas_of, weighted_by_residuals, weighted_by_spread
from .problem import (
    LeastSquaresProblem,
    NoMotion,
    failure_of,
    held_by_jax,
    linearise,
    linearise_each,
    linearise_starts,
    reweighted,
    size_of,
    sizes_of_each,
    without_jacobian,
)

SIGMA_ROUNDS = 10  # at most, of estimating sigma and the unknowns in turn,
ROBUST_ROUNDS = 3  # with a robust loss, whose sigma need not settle,
OPTAX_ROUNDS = 1  # or with an optimiser of optax, which takes long
SETTLED = 1e-4  # relative change of a sigma from one round to the next that counts as zero
AT_THE_START = "the motion at the start must be computable"


def minimise(
    problem: LeastSquaresProblem, *, method: Any, starts: int, estimate_sigma: bool, **limits: Any
) -> tuple[Outcome, LeastSquaresProblem]:
    """The outcome, and the problem it belongs to: with the sigmas of the channels and the continuity of the last round.

    `limits`: `freedom`, `max_steps`, `tolerance` and `progress` of `levenberg_marquardt`.
    """
    if estimate_sigma:
        channels = Channels.of(problem)
        problem = weighted_by_spread(problem, channels)
    apart = problem.continuity  # the weight of the gaps grows anew in each round
    outcome, problem = _minimise(problem, problem.begin, method, starts, limits)
    for _ in range(_rounds(problem, method) if estimate_sigma else 0):
        if int(outcome.best.status) in (INTERRUPTED, STEP_LIMIT) and method is None:
            break
        before, (anew, change) = outcome, weighted_by_residuals(problem, channels, outcome.best.aux)
        if change < SETTLED:
            break
        anew = dataclasses.replace(anew, continuity=apart)
        outcome, problem = _minimise(anew, before.best.y, method, 1, limits, before.best.aux)
        outcome = outcome._replace(steps=before.steps + outcome.steps, costs=np.append(before.costs, outcome.costs))
    return outcome, problem


def _rounds(problem, method):
    """How often the sigmas are estimated; never where there is one for all, of which the estimates do not depend."""
    if problem.model.loss is None and len(sigmas_of(problem)) == 1:
        return 0
    return SIGMA_ROUNDS if method is None and problem.model.loss is None else ROBUST_ROUNDS if method is None else OPTAX_ROUNDS


def minimise_each(problem: LeastSquaresProblem, *, estimate_sigma: bool, **limits: Any) -> tuple[Outcome, LeastSquaresProblem]:
    """Each experiment of a problem with one batch by itself, with sigmas of its own; `limits` as for `minimise`."""
    (batch,) = problem.batches
    count = len(batch.members)
    own = np.full(batch.unknowns, np.inf)
    bounds = tuple(np.concatenate([bound, sign * own]) for bound, sign in zip(problem.free.bounds, (-1, 1), strict=True))

    def minimised(problem, xs):
        sizes = np.sqrt(sum(part**2 for part in sizes_of_each(problem.batches[0])))
        more = {"bounds": bounds, "size": sizes, "noise": _noise_of(problem)}
        return _with_all_parts(levenberg_marquardt(lambda xs: _parts(linearise_each(problem, xs)), xs, **more, **limits))

    if estimate_sigma:
        channels = [Channels.of(one) for one, _ in split_by_experiment(problem)]
        problem = _each_weighted(
            problem, [weighted_by_spread(one, of) for (one, _), of in zip(split_by_experiment(problem), channels, strict=True)]
        )
    outcome = minimised(problem, jnp.zeros((count, problem.free.size + batch.unknowns)))
    for _ in range(_rounds(problem, None) if estimate_sigma else 0):
        apart = [(one, of, end.best) for (one, end), of in zip(split_by_experiment(problem, outcome), channels, strict=True)]
        found = [weighted_by_residuals(one, of, best.aux) if np.isfinite(best.cost) else (one, 0.0) for one, of, best in apart]
        if max(change for _, change in found) < SETTLED or np.any(outcome.best.status == INTERRUPTED):
            break
        before, problem = outcome, _each_weighted(problem, [one for one, _ in found])
        outcome = minimised(problem, before.best.y)
        outcome = outcome._replace(steps=before.steps + outcome.steps, costs=np.concatenate([before.costs, outcome.costs]))
    return outcome, problem


def split_by_experiment(problem: LeastSquaresProblem, outcome: Outcome | None = None) -> list[tuple[LeastSquaresProblem, Any]]:
    """Each experiment of a problem with one batch as a problem by itself, with its part of the outcome."""
    batch, best = jax.tree.map(np.asarray, (problem.batches[0], outcome and outcome.best))  # slices of NumPy arrays cost nothing
    batch = dataclasses.replace(batch, members=(0,), mesh=None)
    apart = []
    for i in range(len(problem.batches[0].members)):
        one = jax.tree.map(lambda leaf, i=i: leaf[i : i + 1] if eqx.is_array(leaf) else leaf, batch)
        end = outcome and outcome._replace(best=jax.tree.map(lambda leaf, i=i: leaf[i], best), costs=outcome.costs[:, i])
        scale = np.broadcast_to(problem.scale, len(problem.batches[0].members))[i]
        apart.append((dataclasses.replace(problem, batches=(one,), scale=np.asarray(scale)), end))
    return apart


def _each_weighted(problem, apart):
    """The problem with the sigmas, and the scales, of the problems that are its experiments."""
    (batch,) = problem.batches
    copies = len(batch.ts) - len(apart)  # of the last one
    sigmas = [one.batches[0].sigma for one in [*apart, *apart[-1:] * copies]]
    together = jax.tree.map(lambda *leaves: np.concatenate(leaves), *sigmas)
    return dataclasses.replace(problem, batches=(with_sigma(batch, together),), scale=np.stack([one.scale for one in apart]))


def _minimise(problem, x, method, starts, limits, before=None):
    """From x, where `before` was found with other weights."""
    if method is not None:
        return _by_optax(problem, method, x, limits), problem
    if problem.continuity is not None:
        return join(problem, x, **limits)
    if starts > 1:
        return _from_many_starts(problem, starts, limits), problem
    return _from_one_start(problem, x, limits, before), problem


def _noise_of(problem):
    """The part of the cost that is due to the errors of the motion: its tolerance, where one was asked for."""
    tolerance = dict(problem.model.numerics).get("rtol")
    return 0.0 if tolerance is None else float(tolerance)


def _parts(found):
    """Residuals, their Jacobian, and what else there is at a point, which is kept without these."""
    return found.residuals, found.jacobian, found._replace(residuals=None, jacobian=None)


def _with_all_parts(outcome):
    best = outcome.best
    return outcome._replace(best=best._replace(aux=best.aux._replace(residuals=best.residuals, jacobian=best.jacobian)))


def _from_one_start(problem, x, limits, before):
    held = held_by_jax(problem)
    first = None if before is None else _parts(reweighted(held, x, before))
    more = {"bounds": problem.bounds, "size": size_of(problem), "noise": _noise_of(problem), "found": first}
    outcome = _with_all_parts(levenberg_marquardt(lambda x: _parts(linearise(held, x)), x, **more, **limits))
    reason = failure_of(outcome.best.aux)
    if reason:
        raise NoMotion(f"{AT_THE_START}, but ended with: {reason} Start from other parameters.")
    return outcome


def _from_many_starts(problem, starts, limits):
    """The best of several starts, the first of which is the given one."""
    ys = problem.free.random_starts(jax.random.key(0), starts).at[0].set(0)
    xs = jnp.concatenate([ys, jnp.zeros((starts, problem.size - problem.free.size))], axis=1)

    more = {"bounds": problem.bounds, "size": size_of(problem), "noise": _noise_of(problem)}
    outcome = _with_all_parts(levenberg_marquardt(lambda xs: _parts(linearise_starts(problem, xs)), xs, **more, **limits))
    cost = np.nan_to_num(outcome.costs[-1], nan=np.inf)
    if not np.isfinite(cost).any():
        raise NoMotion("`start` must include one whose motion can be computed, but none can. Narrow the bounds.")
    best = int(np.argmin(cost))
    chosen = jax.tree.map(lambda leaf: leaf[best], outcome.best)
    if np.any(outcome.best.status == INTERRUPTED):  # another start might have come to a better end
        chosen = chosen._replace(status=np.asarray(INTERRUPTED))
    return outcome._replace(best=chosen, costs=outcome.costs[:, best])


def _by_optax(problem, method, x, limits):
    """Steps of an optimiser of optax; the best x is returned."""
    import optax  # imported here because that takes a while

    method = optax.with_extra_args_support(method)
    state = method.init(x)
    lowest, best, costs, ended = np.inf, x, [], STEP_LIMIT
    try:
        for step in range(1, limits["max_steps"] + 1):
            cost, x_next, state = _optax_step(problem, method, x, state)
            costs.append(float(cost))
            if costs[-1] < lowest:
                lowest, best = costs[-1], x
            x = x_next
            if limits["progress"]:
                limits["progress"](step, costs[-1])
    except KeyboardInterrupt:
        ended = INTERRUPTED
    if not np.isfinite(lowest):
        raise NoMotion(f"{AT_THE_START}, but was not. Start from other parameters.")
    found = linearise(problem, best) if problem.size <= FORWARD_LIMIT else without_jacobian(problem, best)
    none = jnp.zeros(0)
    iterate = Iterate(best, found.residuals, found.jacobian, found, lowest, *[none] * 6, np.asarray(ended))
    return Outcome(iterate, len(costs), np.array(costs))


@compiled
def _optax_step(problem, method, x, state):
    import optax

    cost, gradient = jax.value_and_grad(problem.cost)(x)
    gradient = jnp.where(jnp.isfinite(gradient), gradient, 0)
    updates, state = method.update(gradient, state, x, value=cost, grad=gradient, value_fn=problem.cost)
    return cost, jnp.clip(optax.apply_updates(x, updates), *problem.bounds), state
