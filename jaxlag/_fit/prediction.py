"""What an experiment should show according to a fit."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from .._linear.linear_system import LinearSystem
from .._motion.trajectory import Trajectory
from .._program.jit import compiled
from .experiment import Experiment
from .identifiability import Determined
from .measurement import Test, deviations
from .problem import LeastSquaresProblem, failure_of, linearise, with_zero_values


class Prediction(NamedTuple):
    """What an experiment should show according to a fit, as `Fit.predict` returns it.

    - `values`: structured like the experiment's `values`; leaves (T, ...) in the units of the channels.
    - `standard_errors`: of `values`, from the uncertainty of the parameters; structured like them.
    - `lower`, `upper`: the confidence band; structured like `values`.
    - `motion`: the `Trajectory` behind them; for a `ModalTest` or `FrequencyResponseTest`, the `LinearSystem`; of a `Measurement`, None.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    ts = jnp.linspace(0.0, 3.0, 50)
    fit = jl.fit(oscillator, jl.Experiment(ts, jnp.cos(2.0 * ts), 1.0, 0.0), {"c": 3.0}, free=("c",))
    prediction = fit.predict(jl.Experiment(ts, None, 0.0, 2.0))
    prediction.values.shape  # (50,)
    ```
    """

    values: PyTree
    standard_errors: PyTree
    lower: PyTree
    upper: PyTree
    motion: Trajectory | LinearSystem | None


def predicted(problem: LeastSquaresProblem, x: np.ndarray, known: Determined, scale: float, experiment: Experiment, t: float) -> Prediction:
    """What the experiment should show at the unknowns x; `scale` of all errors, `t` of the ends θ̂ ± t · standard error."""
    free = problem.free
    model = dataclasses.replace(problem.model, loss=None)
    y = jnp.asarray(x[: free.size])
    single = LeastSquaresProblem.of(model, free, [with_zero_values(model, free, experiment, y)])
    found = linearise(single, jnp.concatenate([y, jnp.zeros(single.size - free.size)]))
    reason = failure_of(found)
    if reason:
        raise ValueError(f"`experiment` must have a motion at the estimates, but it ended with: {reason}")
    part = found.batches[0]
    J = np.asarray(part.channels_jacobian[0][:, : free.size])
    errors = scale * known.deviations(J, np.arange(free.size))
    values = jax.tree.map(lambda x: x[0], part.channels)
    standard_errors = ravel_pytree(values)[1](jnp.asarray(errors))
    lower, upper = (jax.tree.map(lambda v, e, s=s: v + s * t * e, values, standard_errors) for s in (-1, 1))
    one = jax.tree.map(lambda x: x[0] if eqx.is_array(x) else x, single.batches[0])
    return Prediction(values, standard_errors, lower, upper, _motion(single.model, free.insert(free.theta(y)), one))


def predicted_test(problem: LeastSquaresProblem, x: np.ndarray, known: Determined, scale: float, test: Test, t: float) -> Prediction:
    """The same of a test; of complex values the ends are those of both parts."""
    free = problem.free
    y = jnp.asarray(x[: free.size])
    at_estimates = dataclasses.replace(free, params=free.insert(np.asarray(free.theta(y))))
    single = LeastSquaresProblem.of(dataclasses.replace(problem.model, loss=None), at_estimates, [], [test])
    found = linearise(single, y)
    values = found.tests[0].predictions
    errors = jax.tree.map(lambda deviation: scale * deviation, deviations(test, found.tests[0], known))
    lower, upper = (jax.tree.map(lambda v, e, s=s: v + s * t * e, values, errors) for s in (-1, 1))
    return Prediction(values, errors, lower, upper, single.tests[0].near)


@compiled
def _motion(model, params, e):
    return model.predicted(params, e, jnp.zeros(e.unknowns))[1]
