"""A separate fit for each of many recordings."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from jaxtyping import PyTree

from .._model.system import System
from .._motion.progress import Steps, compiling
from .experiment import Experiment, validate_inputs
from .fit import absolute, checked_problem, count_measured, fit
from .measurement import Test, split_by_kind
from .minimise import minimise_each, split_by_experiment
from .multiple_shooting import Segments
from .result import Fit
from .robust_loss import Huber
from .starts import without_unknown
from .statistics import report


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
