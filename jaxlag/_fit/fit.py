"""Identification: parameters of a real machine from recordings of its motion, with standard errors."""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from .._model.numbers import count
from .._model.system import System
from .._model.validation import without_contacts, without_events
from .._motion.progress import Steps, compiling
from .experiment import Experiment, validate_inputs
from .measurement import Test, split_by_kind
from .minimise import minimise, minimise_each, split_by_experiment
from .multiple_shooting import Segments, cut
from .parameters import Free
from .problem import LeastSquaresProblem
from .residuals import Model
from .result import Fit
from .robust_loss import Huber
from .starts import MultiStart, Regress, explains_too_little, from_better_start, without_unknown
from .statistics import report


def fit(
    system: System,
    experiments: Experiment | Test | Sequence[Experiment | Test],
    params: PyTree,
    *,
    free: str | Sequence[str],
    bounds: Mapping[str, Any] | None = None,
    priors: Mapping[str, Any] | None = None,
    loss: Huber | None = None,
    method: Any = None,
    segments: int = 1,
    start: Any = "auto",
    max_steps: int | None = None,
    tolerance: float = 1e-3,
    progress: bool = False,
    **numerics: Any,
) -> Fit:
    r"""Identifies parameters from recorded motions, by weighted least squares between measured and simulated motion.

    $$ \min_{\theta, s} \tfrac12 \sum_{e, i} \left(\frac{z_{ei} - h(t_i, q(t_i; \theta, s_e), \dots)}{\sigma_{ei}}\right)^2
       + \tfrac12 \sum_j \left(\frac{\theta_j - \mu_j}{\varsigma_j}\right)^2 $$

    with the unknown initial states s of the experiments; Levenberg–Marquardt with exact Jacobians.

    **Arguments:**

    - `experiments`: one `Experiment` or several, with T samples each; T may differ. `ModalTest`s, `FrequencyResponseTest`s
      and `Measurement`s may be added or stand alone: their weighted squares are added, and recordings then need a `sigma`.
    - `params`: all parameters, a mapping or any pytree with named parts, of numbers and arrays of any shape. Those in `free` are starting
      values; `jaxlag.regress` replaces a NaN, and an estimate at its bound is moved inside.
    - `free`: name or names of the entries of `params` to be identified, or paths to parts of them, `"arm.length"`, `"joints[0]"`.
    - `bounds`: (lower, upper) by name, None where there is none: `{"b": (0, None)}` keeps b from being negative. Estimates and starting
      values may lie on a bound. If an estimate does, a remark says whether the measurements favour values beyond it.
    - `priors`: (mean, standard deviation) by name, for prior knowledge; the experiments need their `sigma` then.
    - `loss`: `Huber()` limits the influence of outliers.
    - `method`: an optax optimiser instead of Levenberg–Marquardt, for thousands of parameters; it takes `max_steps` steps, each projected
      onto the bounds.
    - `segments`: number of segments that each record is cut into (multiple shooting), for long or chaotic records.
    - `start`: what to do about a poor start. `jaxlag.Regress()` finds a better one, by `regress`, and by segments if that is not enough;
      `jaxlag.MultiStart(16)` tries several in one batch. By default `regress` helps where `params` do not lead to a fit that explains
      the measurements, unless it is impossible or `max_steps` given. None: `params` alone.
    - `max_steps`: step limit, by default 100, or 1000 with `method`; 0 reports the start.
    - `tolerance`: the iteration ends when the next step would change no parameter by more than this part of its standard error.
    - `progress`: shows step, cost and remaining time on standard error (one line on a terminal, otherwise a line now and then), and what is
      being compiled if that takes more than two seconds.
    - `**numerics`: passed on to `simulate`: `solver`, `rtol`, `atol`, `stabilisation`, `friction`.

    Units are any consistent set. Without a sigma, that of each channel is estimated along with the parameters, by maximum likelihood;
    experiments share it. Standard errors account for residuals that are correlated in time, and the card then says so (`Fit`). Interrupted
    with Ctrl-C, it returns the best parameters so far. Experiments of one kind run as a batch, on all devices of all processes.

    **Returns:** a `Fit`.

    **Raises:** `ValueError` if `free` names no parameter, there are fewer measurements than unknowns, `observe` does not fit the
    measurements, a start is outside its bounds, options exclude each other, or the motion at the start cannot be computed.

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
    segments = count(segments, "`segments`", cure="Use 1 for single shooting, some tens for a long or chaotic record.")
    automatic, start = start == "auto" and max_steps is None, None if start == "auto" else start
    if (segments > 1) + (method is not None) + (start is not None) > 1:
        raise ValueError("`segments`, `start` and `method` must be used one at a time, but more than one was given. Omit the others.")
    starts, start = (start.count, None) if isinstance(start, MultiStart) else (1, start)
    experiments, params = validate_inputs(experiments, params, tests=(Test,))
    recordings, tests = split_by_kind(experiments)
    if tests:
        _check_options(recordings, loss, segments, start)
    common: dict[str, Any] = {"free": free, "bounds": bounds}
    steps = (100 if method is None else 1000) if max_steps is None else max_steps
    fit_from = partial(fit, system, priors=priors, loss=loss, tolerance=tolerance, progress=progress, start=None, **common, **numerics)
    if start is not None:
        return from_better_start(fit_from, system, experiments, params, start, steps, **common)
    params, done = without_unknown(system, experiments, params, **common)
    problem, experiments = checked_problem(system, experiments, params, free, bounds, priors, loss, method is None, numerics)
    line = Steps(steps) if progress else None
    if segments > 1:
        without_contacts(system, "`fit` with `segments`")
        without_events(system, "`fit` with `segments`")
    of_segments = cut(problem, recordings, segments) if segments > 1 else Segments(problem, tuple(range(len(recordings))), ())
    with compiling("the fit", progress):
        try:
            outcome, problem = minimise(
                of_segments.problem,
                method=method,
                starts=starts,
                estimate_sigma=not absolute(experiments),
                freedom=max(sum(map(count_measured, experiments)) - problem.size, 1),
                max_steps=steps,
                tolerance=tolerance,
                progress=line,
            )
        finally:
            if line:
                line.end()
        found = dataclasses.replace(report(problem, experiments, outcome, of_segments), start_log=done)
    if automatic and method is None and segments == starts == 1 and not tests and explains_too_little(found):
        with contextlib.suppress(ValueError):  # of what has no regression, or none from which a motion can be computed
            return from_better_start(fit_from, system, experiments, params, Regress(), steps, first=found, **common)
    return found


def _check_options(recordings, loss, segments, start):
    """Refuses what says something of recordings in time, where there are tests."""
    if start is not None:
        raise ValueError(
            "`start` must be None where modes or frequency responses are fitted, which need one, but is not. "
            "Start from `regress(...).params` of the recordings."
        )
    if loss is not None:
        raise ValueError(
            "`loss` must be None where modes or frequency responses are fitted, among which it finds no outliers, but is not. "
            "Leave it out, and set their outliers to NaN."
        )
    if segments > 1 and not recordings:
        raise ValueError("`segments` must be 1 where nothing was recorded in time, but is more. Leave it out.")


def checked_problem(
    system: System,
    experiments: Any,
    params: PyTree,
    free: str | Sequence[str],
    bounds: Mapping[str, Any] | None,
    priors: Mapping[str, Any] | None,
    loss: Huber | None,
    relative: bool,
    numerics: Mapping[str, Any],
    alone: bool = False,
) -> tuple[LeastSquaresProblem, tuple[Any, ...]]:
    """The problem after all checks of the arguments, and the experiments."""
    experiments, params = validate_inputs(experiments, params, tests=(Test,))
    if len({e.sigma is None for e in experiments}) > 1:
        raise ValueError("`experiments` must all have a `sigma` or none, but only some have. Give each of them one.")
    chosen = Free.of(params, free, bounds, priors, relative)
    if priors and not absolute(experiments):
        raise ValueError("`priors` must be weighed against known noise, but an experiment has no `sigma`. Give it.")
    for name in chosen.names:
        if all(name in e.params for e in experiments):
            raise ValueError(
                f"`free` must name parameters that experiments share, but each has a {name!r} of its own. Name it `unknown` there."
            )
    problem = LeastSquaresProblem.of(Model.of(system, numerics, loss), chosen, *split_by_kind(experiments))
    if problem.size == 0:
        raise ValueError("`free` must name at least one entry of params, but is empty. Say which parameters to identify.")
    if relative:  # optimisers of optax, which stop early, are for networks, which have more weights than there are samples
        _check_enough_measured(problem, experiments, alone)
    return problem, experiments


def _check_enough_measured(problem, experiments, alone):
    """No more unknowns than measurements and priors; in each experiment, where each is fitted `alone`."""
    counts = [count_measured(e) for e in experiments]
    priors = int(np.sum(np.isfinite(problem.free.prior_deviation)))
    measurements = min(counts) if alone else sum(counts)
    unknown = problem.free.size + problem.batches[0].unknowns if alone else problem.size
    if measurements + priors < unknown:
        raise ValueError(
            f"`free` must name no more than was measured, but there are {unknown} unknowns and {measurements} measurements. Free fewer."
        )


def count_measured(e: Any) -> int:
    """How many numbers an experiment or a test has measured."""
    return sum(int(np.sum(np.isfinite(leaf))) for leaf in jax.tree.leaves(e.values)) if isinstance(e, Experiment) else e.measurements


def absolute(experiments: Sequence[Any]) -> bool:
    """Whether the noise of all is known."""
    return all(e.sigma is not None for e in experiments)


def fit_each(
    system: System,
    experiments: Sequence[Experiment],
    params: PyTree,
    *,
    free: str | Sequence[str],
    bounds: Mapping[str, Any] | None = None,
    priors: Mapping[str, Any] | None = None,
    loss: Huber | None = None,
    method: Any = None,
    segments: int = 1,
    start: Any = None,
    max_steps: int | None = None,
    tolerance: float = 1e-3,
    progress: bool = False,
    **numerics: Any,
) -> list[Fit]:
    r"""A separate fit for each experiment, all in one batch: a fleet of machines, or one machine measured again and again.

    $$ \min_{\theta_e, s_e} \tfrac12 \sum_i \left(\frac{z_{ei} - h(t_i, q(t_i; \theta_e, s_e), \dots)}{\sigma_{ei}}\right)^2
       \quad \text{for each } e $$

    **Arguments:** as for `fit`. The E experiments are of one kind, with the same sensors and unknowns; the number of samples may differ.
    With `method`, `segments` or `start`, `fit` is called for one after the other, and they may be of several kinds. Units are any
    consistent set.

    **Returns:** a list of E `Fit`s, in the order of the experiments.

    **Raises:** `ValueError` if the experiments are of different kinds, and as `fit`. In a batch, a motion that cannot be computed raises
    nothing: that fit has `converged` False, and its `reason` says so.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    ts = jnp.linspace(0.0, 3.0, 50)
    records = [jl.Experiment(ts, jnp.cos(w * ts), 1.0, 0.0) for w in (2.0, 2.1)]
    [fit.estimates["c"] for fit in jl.fit_each(oscillator, records, {"c": 3.0}, free=("c",))]  # [4.0, 4.41]
    ```
    """
    experiments, params = validate_inputs(experiments, params, tests=(Test,))
    if split_by_kind(experiments)[1]:
        raise ValueError("`experiments` must be recordings in time, to be fitted in a batch, but some are tests. Call `fit` for each.")
    if start is not None or method is not None or segments != 1:
        how = {"free": free, "bounds": bounds, "priors": priors, "loss": loss, "method": method, "segments": segments, "start": start}
        how |= {"max_steps": max_steps, "tolerance": tolerance, "progress": progress, **numerics}
        return [fit(system, e, params, **how) for e in experiments]
    params, done = without_unknown(system, experiments, params, free, bounds)
    problem, experiments = checked_problem(system, experiments, params, free, bounds, priors, loss, True, numerics, alone=True)
    if len(problem.batches) > 1:
        raise ValueError("`experiments` must be of one kind, but differ in sensors, unknowns or shapes. Fit each kind by itself.")
    (batch,) = problem.batches
    steps = 100 if max_steps is None else max_steps
    line = Steps(steps) if progress else None
    with compiling("the fits", progress):
        try:
            outcome, problem = minimise_each(
                problem,
                estimate_sigma=not absolute(experiments),
                freedom=max(min(map(count_measured, experiments)) - problem.free.size - batch.unknowns, 1),
                max_steps=steps,
                tolerance=tolerance,
                progress=line,
            )
        finally:
            if line:
                line.end()
        ends = split_by_experiment(problem, outcome)
        fits = [report(one, (e,), end, Segments(one, (0,), ())) for e, (one, end) in zip(experiments, ends, strict=True)]
    return [dataclasses.replace(found, start_log=done) for found in fits]
