"""Identification: parameters of a real machine from recordings of its motion, with standard errors."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .._model.system import System
from .._motion.derivative_rule import FORWARD_LIMIT
from .._motion.progress import Steps
from .._program.jit import compiled
from .experiment import Experiment, measured
from .levenberg_marquardt import INTERRUPTED, MAX_STEPS, Iterate, Outcome, levenberg_marquardt
from .multiple_shooting import Pieces, cut, join
from .parameters import Free
from .problem import Problem, failure_of, linearise, linearise_each, linearise_starts, look
from .regress import regress
from .residuals import Huber, Model
from .result import Fit
from .statistics import report, robust_scale


def fit(
    system: System,
    experiments: Experiment | Sequence[Experiment],
    params: PyTree,
    *,
    free: Sequence[str],
    bounds: Mapping[str, Any] | None = None,
    priors: Mapping[str, Any] | None = None,
    loss: Huber | None = None,
    method: Any = None,
    starts: int = 1,
    pieces: int = 1,
    max_steps: int | None = None,
    tolerance: float = 1e-3,
    progress: bool = False,
    **numerics: Any,
) -> Fit:
    r"""Identifies parameters from recorded motions, by weighted least squares over the whole motion.

    $$ \min_{\theta, s} \tfrac12 \sum_{e, i} \left(\frac{z_{ei} - h(t_i, q(t_i; \theta, s_e), \dots)}{\sigma_{ei}}\right)^2
       + \tfrac12 \sum_j \left(\frac{\theta_j - \mu_j}{\varsigma_j}\right)^2 $$

    with the unknown starts s of the experiments; Levenberg–Marquardt with exact Jacobians.

    **Arguments:**

    - `experiments`: one `Experiment` or several, of any lengths.
    - `params`: all parameters, a mapping or any pytree with named parts; those in `free` are starting values. `jaxlag.regress` finds such.
    - `free`: names of the entries of `params` to be identified, or paths to parts of them, `"arm.length"`, `"joints[0]"`.
    - `bounds`: (lower, upper) by name, None for none: `{"b": (0, None)}` keeps b from being negative. An estimate
      may lie at its bound, and so may a start; a remark then says whether the measurements would have it cross.
    - `priors`: (mean, standard deviation) by name, of what is known beforehand; the experiments need their sigma then.
    - `loss`: `Huber()` where there are outliers.
    - `method`: an optimiser of optax in place of Levenberg–Marquardt, for thousands of parameters; it takes `max_steps` steps, each
      brought back within the bounds.
    - `starts`: how many starts are tried in one batch, the others at random within bounds, or within a factor of some two.
    - `pieces`: into how many pieces each record is cut, each with a start of its own (multiple shooting): for long or chaotic records.
    - `max_steps`: default 100, with `method` 1000. `tolerance`: the iteration ends when the next step would change no parameter by more
      than this part of its standard error.
    - `progress`: shows step, cost and time left while it runs, on standard error, in one line; in a log a line now and then.
    - `**numerics`: handed on to `simulate`: `solver`, `rtol`, `atol`, `stabilisation`, `friction`.

    Where residuals are correlated in time, the standard errors allow for it, and the card says so (`Fit`).

    Stopped by the keyboard, it returns the best so far and says so. Experiments run side by side, over several devices where there are.

    **Returns:** a `Fit`. Any consistent units.

    **Raises:** `ValueError` where `free` names no parameter, `observe` does not fit the measurements, a start is outside its bounds, or
    the motion at the start cannot be computed.

    **Source:** Ljung, System Identification, 2nd ed., sections 7.2 and 9.4; Nocedal & Wright, Numerical Optimization, section 10.3.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    ts = jnp.linspace(0.0, 3.0, 50)
    record = jl.Experiment(ts, jnp.cos(2.0 * ts), q0=1.0, qdot0=0.0, observe=lambda q: q)
    jl.fit(oscillator, record, {"c": 3.0}, free=("c",)).estimates["c"]  # 4.0
    ```
    """
    if (pieces > 1) + (method is not None) + (starts > 1) > 1:
        raise ValueError("`pieces`, `starts` and `method` must be used one at a time, but more than one was given. Leave the others out.")
    problem, experiments = _stated(system, experiments, params, free, bounds, priors, loss, method is None, numerics)
    steps = max_steps or (100 if method is None else 1000)
    line = Steps(steps) if progress else None
    more = {"freedom": _freedom(problem, experiments), "max_steps": steps, "tolerance": tolerance, "progress": line}
    whole = cut(problem, experiments, pieces) if pieces > 1 else Pieces(problem, tuple(range(len(experiments))), ())
    try:
        outcome, problem = _minimised(whole.problem, method, starts, more)
        for _ in range(SCALE_ROUNDS if loss is not None and not _absolute(experiments) else 0):
            if int(outcome.best.status) == INTERRUPTED:
                break
            problem = dataclasses.replace(whole.problem, scale=robust_scale(outcome.best.rest, problem))
            before = outcome
            outcome, problem = _minimised(problem, method, 1, more, before.best.y)
            outcome = outcome._replace(steps=before.steps + outcome.steps, costs=np.append(before.costs, outcome.costs))
    finally:
        if line:
            line.end()
    return report(problem, experiments, outcome, whole)


SCALE_ROUNDS = 3  # of a robust loss whose sigma is not known


def fit_each(
    system: System,
    experiments: Sequence[Experiment],
    params: PyTree,
    *,
    free: Sequence[str],
    bounds: Mapping[str, Any] | None = None,
    priors: Mapping[str, Any] | None = None,
    max_steps: int = 100,
    tolerance: float = 1e-3,
    progress: bool = False,
    **numerics: Any,
) -> list[Fit]:
    """A fit of its own for each experiment, all in one batch: a fleet of machines, or one machine measured again and again.

    **Arguments:** as `fit`; the experiments are of one kind: the same sensors and unknowns. Any consistent units.

    **Returns:** a list of `Fit`, one for each experiment.

    **Raises:** `ValueError` where the experiments are of different kinds, and as `fit`.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    ts = jnp.linspace(0.0, 3.0, 50)
    records = [jl.Experiment(ts, jnp.cos(w * ts), 1.0, 0.0) for w in (2.0, 2.1)]
    [fit.estimates["c"] for fit in jl.fit_each(oscillator, records, {"c": 3.0}, free=("c",))]  # 4.0 and 4.41
    ```
    """
    problem, experiments = _stated(system, experiments, params, free, bounds, priors, None, True, numerics, apart=True)
    if len(problem.stacks) > 1:
        raise ValueError("`experiments` must be of one kind, but differ in sensors, unknowns or shapes. Fit each kind by itself.")
    xs = jnp.zeros((len(experiments), problem.free.size + problem.stacks[0].unknowns))

    def seen(xs):
        rows = linearise_each(problem, xs)
        return rows.residuals, rows.jacobian, rows

    line = Steps(max_steps) if progress else None
    freedom = max(min(map(_measurements, experiments)) - xs.shape[1], 1)
    own = jnp.full(xs.shape[1] - problem.free.size, jnp.inf)
    lower, upper = problem.free.bounds
    limits = jnp.concatenate([lower, -own]), jnp.concatenate([upper, own])
    outcome = levenberg_marquardt(seen, xs, bounds=limits, freedom=freedom, max_steps=max_steps, tolerance=tolerance, progress=line)
    if line:
        line.end()
    best, stack = jax.tree.map(np.asarray, (outcome.best, problem.stacks[0]))  # slices of NumPy arrays cost nothing
    stack = dataclasses.replace(stack, members=(0,), mesh=None)
    fits = []
    for i, e in enumerate(experiments):
        alone = jax.tree.map(lambda leaf, i=i: leaf[i : i + 1] if eqx.is_array(leaf) else leaf, stack)
        mine = outcome._replace(best=jax.tree.map(lambda leaf, i=i: leaf[i], best), costs=outcome.costs[:, i])
        fits.append(report(dataclasses.replace(problem, stacks=(alone,)), (e,), mine, Pieces(problem, (0,), ())))
    return fits


def _stated(system, experiments, params, free, bounds, priors, loss, relative, numerics, apart=False):
    """The problem, checked; starting values that are NaN come from `regress`."""
    experiments, params = measured(experiments, params)
    if len({e.sigma is None for e in experiments}) > 1:
        raise ValueError("`experiments` must all have a `sigma` or none, but some have. Give each of them one.")
    named = Free.of(params, free, bounds, priors, relative)
    if priors and not _absolute(experiments):
        raise ValueError("`priors` must stand against noise that is known, but an experiment has no `sigma`. Give it.")
    unstated = np.isnan(named.start)
    if np.any(unstated):
        found = regress(system, experiments, params, free=free, bounds=bounds)
        start = Free.of(found.params, free, bounds).start
        named = Free.of(named.insert(jnp.where(unstated, start, named.start)), free, bounds, priors, relative)
    for name in named.names:
        if all(name in e.params for e in experiments):
            raise ValueError(f"`free` must name what experiments share, but each has a {name!r} of its own. Name it `unknown` there.")
    problem = Problem.of(Model(system, tuple(sorted(numerics.items())), loss), named, experiments)
    if problem.size == 0:
        raise ValueError("`free` must name at least one entry of params, but is empty. Say which parameters to identify.")
    known = int(np.sum(np.isfinite(named.spread)))
    most = min(map(_measurements, experiments)) if apart else sum(map(_measurements, experiments))
    unknown = named.size + problem.stacks[0].unknowns if apart else problem.size
    if most + known < unknown:
        raise ValueError(
            f"`free` must name no more than was measured, but {unknown} unknowns stand against {most} measurements. Free fewer."
        )
    return problem, experiments


def _measurements(e):
    return sum(int(np.sum(np.isfinite(leaf))) for leaf in jax.tree.leaves(e.values))


def _absolute(experiments):
    return all(e.sigma is not None for e in experiments)


def _freedom(problem, experiments):
    return max(sum(map(_measurements, experiments)) - problem.size, 1)


def _minimised(problem, method, starts, more, x=None):
    """The outcome of the method that was asked for, and the problem it belongs to."""
    x = jnp.zeros(problem.size) if x is None else x
    if method is not None:
        return _by_optax(problem, method, x, more), problem
    if problem.links is not None:
        return join(problem, x, **more)
    if starts > 1:
        return _from_many(problem, starts, more), problem
    return _from_one(problem, x, more), problem


def _from_one(problem, x, more):
    def seen(x):
        rows = linearise(problem, x)
        return rows.residuals, rows.jacobian, rows

    outcome = levenberg_marquardt(seen, x, bounds=problem.bounds, **more)
    reason = failure_of(outcome.best.rest)
    if reason:
        raise ValueError(f"{AT_THE_START}, but ended with: {reason} Start from other parameters.")
    return outcome


AT_THE_START = "the motion at the start must be computable"


def _from_many(problem, starts, more):
    """The best of several starts, of which the first is the one given."""
    ys = problem.free.anywhere(jax.random.key(0), starts).at[0].set(0)
    xs = jnp.concatenate([ys, jnp.zeros((starts, problem.size - problem.free.size))], axis=1)

    def seen(xs):
        rows = linearise_starts(problem, xs)
        return rows.residuals, rows.jacobian, rows

    outcome = levenberg_marquardt(seen, xs, bounds=problem.bounds, **more)
    cost = np.nan_to_num(outcome.costs[-1], nan=np.inf)
    if not np.isfinite(cost).any():
        raise ValueError("`starts` must have one whose motion can be computed, but none has. Narrow the bounds.")
    best = int(np.argmin(cost))
    chosen = jax.tree.map(lambda leaf: leaf[best], outcome.best)
    if np.any(outcome.best.status == INTERRUPTED):  # another start might have come to a better end
        chosen = chosen._replace(status=np.asarray(INTERRUPTED))
    return outcome._replace(best=chosen, costs=outcome.costs[:, best])


def _by_optax(problem, method, x, more):
    """Steps of an optimiser of optax; the best x is kept."""
    import optax  # where it is needed, for that takes a while

    method = optax.with_extra_args_support(method)
    state = method.init(x)
    lowest, best, costs, ended = np.inf, x, [], MAX_STEPS
    try:
        for step in range(1, more["max_steps"] + 1):
            cost, x_next, state = _optax_step(problem, method, x, state)
            costs.append(float(cost))
            if costs[-1] < lowest:
                lowest, best = costs[-1], x
            x = x_next
            if more["progress"]:
                more["progress"](step, costs[-1])
    except KeyboardInterrupt:
        ended = INTERRUPTED
    if not np.isfinite(lowest):
        raise ValueError(f"{AT_THE_START}, but was not. Start from other parameters.")
    rows = linearise(problem, best) if problem.size <= FORWARD_LIMIT else look(problem, best)
    none = jnp.zeros(0)
    return Outcome(Iterate(best, rows.residuals, rows.jacobian, rows, lowest, none, none, np.asarray(ended)), len(costs), np.array(costs))


@compiled
def _optax_step(problem, method, x, state):
    import optax

    cost, slope = jax.value_and_grad(problem.cost)(x)
    slope = jnp.where(jnp.isfinite(slope), slope, 0)
    updates, state = method.update(slope, state, x, value=cost, grad=slope, value_fn=problem.cost)
    return cost, jnp.clip(optax.apply_updates(x, updates), *problem.bounds), state
