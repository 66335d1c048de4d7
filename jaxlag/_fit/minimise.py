"""Minimises a least-squares problem: from one start or many, in segments, with a robust loss, or by an optimiser of optax."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._motion.derivative_rule import FORWARD_LIMIT
from .._program.jit import compiled
from .levenberg_marquardt import INTERRUPTED, STEP_LIMIT, Iterate, Outcome, levenberg_marquardt
from .minimum import robust_scale
from .multiple_shooting import join
from .problem import Problem, failure_of, linearise, linearise_starts, without_jacobian

SCALE_ROUNDS = 3  # of a robust loss with unknown sigma
AT_THE_START = "the motion at the start must be computable"


def minimise(problem: Problem, *, method: Any, starts: int, estimate_scale: bool, **limits: Any) -> tuple[Outcome, Problem]:
    """The outcome, and the problem it belongs to: with the scale of the noise and the continuity of the last round.

    `limits`: `freedom`, `max_steps`, `tolerance` and `progress` of `levenberg_marquardt`.
    """
    original = problem
    outcome, problem = _minimise(original, np.zeros(original.size, original.free.start.dtype), method, starts, limits)
    for _ in range(SCALE_ROUNDS if estimate_scale else 0):
        if int(outcome.best.status) == INTERRUPTED:
            break
        before = outcome
        rescaled = dataclasses.replace(original, scale=robust_scale(before.best.aux, problem))
        outcome, problem = _minimise(rescaled, before.best.y, method, 1, limits)
        outcome = outcome._replace(steps=before.steps + outcome.steps, costs=np.append(before.costs, outcome.costs))
    return outcome, problem


def _minimise(problem, x, method, starts, limits):
    if method is not None:
        return _by_optax(problem, method, x, limits), problem
    if problem.continuity is not None:
        return join(problem, x, **limits)
    if starts > 1:
        return _from_many_starts(problem, starts, limits), problem
    return _from_one_start(problem, x, limits), problem


def _from_one_start(problem, x, limits):
    def residuals(x):
        found = linearise(problem, x)
        return found.residuals, found.jacobian, found

    outcome = levenberg_marquardt(residuals, x, bounds=problem.bounds, **limits)
    reason = failure_of(outcome.best.aux)
    if reason:
        raise ValueError(f"{AT_THE_START}, but ended with: {reason} Start from other parameters.")
    return outcome


def _from_many_starts(problem, starts, limits):
    """The best of several starts, the first of which is the given one."""
    ys = problem.free.random_starts(jax.random.key(0), starts).at[0].set(0)
    xs = jnp.concatenate([ys, jnp.zeros((starts, problem.size - problem.free.size))], axis=1)

    def residuals(xs):
        found = linearise_starts(problem, xs)
        return found.residuals, found.jacobian, found

    outcome = levenberg_marquardt(residuals, xs, bounds=problem.bounds, **limits)
    cost = np.nan_to_num(outcome.costs[-1], nan=np.inf)
    if not np.isfinite(cost).any():
        raise ValueError("`starts` must include one whose motion can be computed, but none can. Narrow the bounds.")
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
        raise ValueError(f"{AT_THE_START}, but was not. Start from other parameters.")
    found = linearise(problem, best) if problem.size <= FORWARD_LIMIT else without_jacobian(problem, best)
    none = jnp.zeros(0)
    iterate = Iterate(best, found.residuals, found.jacobian, found, lowest, none, none, np.asarray(ended))
    return Outcome(iterate, len(costs), np.array(costs))


@compiled
def _optax_step(problem, method, x, state):
    import optax

    cost, gradient = jax.value_and_grad(problem.cost)(x)
    gradient = jnp.where(jnp.isfinite(gradient), gradient, 0)
    updates, state = method.update(gradient, state, x, value=cost, grad=gradient, value_fn=problem.cost)
    return cost, jnp.clip(optax.apply_updates(x, updates), *problem.bounds), state
