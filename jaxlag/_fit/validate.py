"""After a fit: how well it predicts other data."""

import dataclasses
from typing import Any

import jax
import numpy as np

from .channels import Channel, channels_of
from .experiment import Experiment
from .fit import fit
from .fit_card import channel_rows
from .linear_test_statistics import channels_of_test
from .measurement import Test
from .result import Fit, Prediction


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Validation:
    """How well a fitted model predicts data that were not fitted, as `validate` returns it; prints as a table.

    - `channels`: a `Channel` for each scalar channel. `residuals`: measured minus predicted, structured like the values; leaves (T, ...).
    - `prediction`: the `Prediction`, with its confidence band.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    ts = jnp.linspace(0.0, 3.0, 50)
    fit = jl.fit(oscillator, jl.Experiment(ts, jnp.cos(2.0 * ts), 1.0, 0.0), {"c": 3.0}, free=("c",))
    validation = jl.validate(fit, jl.Experiment(ts, jnp.sin(2.0 * ts), 0.0, 2.0))
    validation.residuals.shape  # (50,)
    ```
    """

    channels: list[Channel]
    residuals: Any
    prediction: Prediction

    def __repr__(self) -> str:
        return "\n".join(["Validation: prediction of other data", *channel_rows(self.channels)])


def validate(fit: Fit, experiment: Experiment | Test, *, level: float = 0.95) -> Validation:
    r"""Predicts another experiment with the fitted parameters, and compares the prediction with its measurements.

    $$ r_i = z_i - h(t_i, q(t_i; \hat\theta), \dots) $$

    The experiment's own unknowns, such as its start, are estimated from its measurements, with the loss of the fit; the fitted parameters
    stay fixed.

    **Arguments:** `fit`: what `jaxlag.fit` returned; `experiment`: with T measured samples, or a `ModalTest` or `FrequencyResponseTest`;
    `level` of the confidence band, between 0 and 1. Units are any consistent set.

    **Returns:** a `Validation`.

    **Raises:** `ValueError` if the experiment has no values, or its motion cannot be computed.

    **Source:** Ljung, System Identification, 2nd ed., section 16.4 (cross validation).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    ts = jnp.linspace(0.0, 3.0, 50)
    fit = jl.fit(oscillator, jl.Experiment(ts, jnp.cos(2.0 * ts), 1.0, 0.0), {"c": 3.0}, free=("c",))
    jl.validate(fit, jl.Experiment(ts, jnp.sin(2.0 * ts), 0.0, 2.0)).channels[0].fit_percent  # 100.0
    ```
    """
    if experiment.values is None:
        raise ValueError("`experiment` must have been measured, but has no values. Use `fit.predict` for what it should show.")
    if isinstance(experiment, Test):
        return _validated_test(fit, experiment, level)
    if experiment.unknown:
        model = fit.problem.model
        experiment = _with_own_estimates(model.system, experiment, fit.params, model.loss, dict(model.numerics))
    prediction = fit.predict(experiment, level=level)
    residuals = jax.tree.map(lambda z, p: np.asarray(z - p), experiment.values, prediction.values)
    return Validation(channels_of(0, experiment.values, residuals), residuals, prediction)


def _validated_test(fit, test, level):
    prediction = fit.predict(test, level=level)
    residuals = jax.tree.map(np.subtract, test.values, prediction.values)
    return Validation(channels_of_test(0, test, prediction.motion, residuals), residuals, prediction)


def _with_own_estimates(system, experiment, params, loss, numerics):
    """The experiment with its own unknowns estimated, with all parameters fixed."""
    return fit(system, experiment, params, free=(), loss=loss, start=None, **numerics).experiments[0]
