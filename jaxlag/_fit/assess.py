"""Before and after a fit: the information of a planned experiment, validation on other data, comparison of models."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PyTree

from .._model.system import System
from .channels import Channel, channels_of
from .experiment import Experiment, measured
from .fit import fit
from .fit_card import channel_rows
from .identifiability import correlation_of, determined_by
from .linear_test import LinearTest, apart
from .linear_test_statistics import channels_of_test
from .parameters import Free
from .problem import Problem, failure_of, linearise, with_zero_values
from .residuals import Model
from .result import Fit, Prediction


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Information:
    """What planned experiments will reveal about the parameters, as `information` returns it; prints as a table.

    - `names`: the p numbers, in flat order, as in `matrix` (p, p), the Fisher information JᵀJ; `covariance` (p, p), its inverse; and
      `correlation` (p, p).
    - `standard_errors`: those to expect of a fit, by the names of `free`; infinite for a parameter that the experiments do not determine.
    - `estimates`: the values where the information was computed, by the names of `free`.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    plan = jl.Experiment(jnp.linspace(0.0, 3.0, 50), None, q0=1.0, qdot0=0.0, sigma=1e-3)
    found = jl.information(oscillator, plan, {"c": 4.0}, free=("c",))
    found.matrix.shape  # (1, 1)
    ```
    """

    names: tuple[str, ...]
    matrix: Float[np.ndarray, "p p"]
    covariance: Float[np.ndarray, "p p"]
    correlation: Float[np.ndarray, "p p"]
    standard_errors: dict[str, Any]
    estimates: dict[str, Any]

    def __repr__(self) -> str:
        theta = np.concatenate([np.ravel(x) for name in self.estimates for x in jax.tree.leaves(self.estimates[name])])
        width = max(map(len, self.names))
        rows = [
            f"  {name:<{width}}  {value:.6g} ± {error:.2g}" + (f"   ({100 * error / abs(value):.2g} %)" if value else "")
            if np.isfinite(error)
            else f"  {name:<{width}}  not determined"
            for name, value, error in zip(self.names, theta, np.sqrt(np.diag(self.covariance)), strict=True)
        ]
        return "\n".join(["Information: expected standard errors", *rows])


def information(
    system: System,
    experiments: Experiment | LinearTest | Sequence[Experiment | LinearTest],
    params: PyTree,
    free: str | Sequence[str],
    **numerics: Any,
) -> Information:
    r"""The Fisher information of planned experiments, and the standard errors that a fit of them will have.

    $$ F = \sum_i \frac{1}{\sigma_i^2} \left(\frac{\partial h_i}{\partial \theta}\right)^T \frac{\partial h_i}{\partial \theta},
       \qquad \mathrm{cov}\,\hat\theta \approx F^{-1} $$

    Unknown starts of the experiments reduce the information; this is taken into account.

    **Arguments:**

    - `experiments`: one or several, with `sigma`. Their `values` may be None; samples that are NaN do not count. `ModalTest`s and
      `FrequencyResponseTest`s need expected values.
    - `params`: where the information is computed, as for `fit`. `free`: names of the p numbers that will be identified.
    - `**numerics`: passed on to `simulate`.

    Units are any consistent set.

    **Returns:** an `Information`.

    **Raises:** `ValueError` if an experiment has no sigma, or the motion cannot be computed.

    **Source:** Walter & Pronzato, Identification of Parametric Models (1997), section 6.1.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    plan = jl.Experiment(jnp.linspace(0.0, 3.0, 50), None, q0=1.0, qdot0=0.0, sigma=1e-3)
    jl.information(oscillator, plan, {"c": 4.0}, free=("c",)).standard_errors["c"]
    ```
    """
    experiments, params = measured(experiments, params, planned=True, tests=(LinearTest,))
    for e in experiments:
        if e.sigma is None:
            raise ValueError(
                "`experiments` must say how well they measure, but one has no `sigma`. Give the standard deviation of the noise."
            )
    chosen = Free.of(params, free)
    model = Model(system, tuple(sorted(numerics.items())), None)
    recordings, tests = apart(experiments)
    problem = Problem.of(model, chosen, [_with_values(model, chosen, e) for e in recordings], tests)
    found = linearise(problem, jnp.zeros(problem.size))
    reason = failure_of(found)
    if reason:
        raise ValueError(f"`params` must give a motion, but it ended with: {reason} Try other values.")
    J, p = np.asarray(found.jacobian)[chosen.size :], chosen.size
    known, slope = determined_by(J, np.zeros((0, problem.size))), np.asarray(chosen.slope(jnp.zeros(p)))
    covariance = known.covariance[:p, :p] * np.outer(slope, slope)
    covariance[np.diag_indices(p)] = np.where(known.determined[:p], np.diag(covariance), np.inf)
    # The information that is left beside the unknown starts: the Schur complement.
    F, own = J.T @ J, slice(p, None)
    F = (F[:p, :p] - F[:p, own] @ np.linalg.pinv(F[own, own], hermitian=True) @ F[own, :p]) / np.outer(slope, slope)
    errors = np.sqrt(np.diag(covariance))
    by_name = lambda flat: chosen.by_name(jnp.asarray(flat))
    return Information(chosen.entries, F, covariance, correlation_of(covariance), by_name(errors), by_name(chosen.start))


def _with_values(model, free, e):
    """The experiment with zeros for values, where it has none."""
    if e.values is not None:
        return e
    zeros = with_zero_values(model, free, e).values
    start = jax.tree.map(np.asarray, (e.q0, e.qdot0))
    return Experiment(e.ts, zeros, *start, observe=e.observe, sigma=e.sigma, params=e.params, unknown=e.unknown, delay=e.delay)


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


def validate(fit: Fit, experiment: Experiment | LinearTest, *, level: float = 0.95) -> Validation:
    r"""Predicts another experiment with the fitted parameters, and compares the prediction with its measurements.

    $$ r_i = z_i - h(t_i, q(t_i; \hat\theta), \dots) $$

    The experiment's own unknowns, such as its start, are estimated from its measurements; the fitted parameters stay fixed.

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
    if isinstance(experiment, LinearTest):
        return _validated_test(fit, experiment, level)
    if experiment.unknown:
        model = fit.problem.model
        experiment = _with_own_estimates(model.system, experiment, fit.params, dict(model.numerics))
    prediction = fit.predict(experiment, level=level)
    residuals = jax.tree.map(lambda z, p: np.asarray(z - p), experiment.values, prediction.values)
    return Validation(channels_of(0, experiment.values, residuals), residuals, prediction)


def _validated_test(fit, test, level):
    prediction = fit.predict(test, level=level)
    residuals = jax.tree.map(np.subtract, test.values, prediction.values)
    return Validation(channels_of_test(0, test, prediction.motion, residuals), residuals, prediction)


def _with_own_estimates(system, experiment, params, numerics):
    """The experiment with its own unknowns estimated, with all parameters fixed."""
    return fit(system, experiment, params, free=(), **numerics).experiments[0]


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """Models of the same data, as `compare` returns them; prints as a table.

    - `names`: the models, best first by Schwarz's criterion.
    - `aic`, `bic`: by name, the differences from the smallest value of each criterion; dimensionless.
    - `parameters`: by name, the number of unknowns.
    - `correlated`: the number of samples over which the residuals of the best model are correlated, 0 if they are white. Both criteria
      assume independent residuals, and otherwise overstate the evidence.
    - `unconverged`: names of the models whose fits have not converged, which may be better than they look.
    - `priors`: by name of a model, the numbers on which its fit had priors; they are no part of the likelihood.

    ```python
    import jaxlag as jl
    table = jl.results.Comparison(("a", "b"), {"a": 0.0, "b": 9.0}, {"a": 0.0, "b": 7.0}, {"a": 1, "b": 2}, 0)
    table.names[0]  # a
    ```
    """

    names: tuple[str, ...]
    aic: dict[str, float]
    bic: dict[str, float]
    parameters: dict[str, int]
    correlated: int
    unconverged: tuple[str, ...] = ()
    priors: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)

    def __repr__(self) -> str:
        width = max(map(len, self.names))
        rows = [
            f"  {name:<{width}}  {self.parameters[name]:3d} parameters   ΔAIC {self.aic[name]:10.2f}   ΔBIC {self.bic[name]:10.2f}"
            for name in self.names
        ]
        best, second = self.names[:2]
        strength = next(word for limit, word in EVIDENCE if self.bic[second] >= limit)
        if {best, second} & set(self.unconverged):
            strength = "none, until both fits have converged"
        evidence = [f"  evidence for {best!r} against {second!r}: {strength}"]
        if self.correlated:
            evidence.append(f"  ! overstated: residuals of {best!r} are correlated over {self.correlated} samples")
        evidence += [f"  ! the fit of {name!r} has not converged: the model may be better than it looks" for name in self.unconverged]
        evidence += [f"  {name!r} had priors on {', '.join(numbers)}; only data count here" for name, numbers in self.priors.items()]
        return "\n".join(["Comparison: smaller is better", *rows, *evidence])


DATA = "ts", "values", "sigma"
EVIDENCE = ((10, "very strong"), (6, "strong"), (2, "positive"), (0, "not worth more than a bare mention"))  # by ΔBIC


def compare(fits: Mapping[str, Fit]) -> Comparison:
    r"""Compares models of the same data by their misfit and number of parameters: does the machine really have a damper?

    $$ \mathrm{AIC} = -2 \ln L + 2 p, \qquad \mathrm{BIC} = -2 \ln L + p \ln N $$

    with the likelihood L of the data alone, p unknowns and N measurements; all dimensionless.

    **Arguments:** `fits`: at least two, by name, of the same measurements. **Returns:** a `Comparison`.

    **Raises:** `ValueError` if there are fewer than two fits, or they are of different data.

    **Source:** Burnham & Anderson, Model Selection and Multimodel Inference (2002), section 2.2; the words for ΔBIC: Kass & Raftery,
    J. Am. Stat. Assoc. 90 (1995) 773.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2)
    ts = jnp.linspace(0.0, 3.0, 50)
    record = jl.Experiment(ts, jnp.cos(2.0 * ts) + 0.01 * jnp.sin(999.0 * ts), q0=1.0, qdot0=0.0)
    params = {"c": 3.0, "b": 0.0}
    fits = {"undamped": jl.fit(oscillator, record, params, free=("c",)), "damped": jl.fit(oscillator, record, params, free=("c", "b"))}
    jl.compare(fits).names[0]  # undamped
    ```
    """
    if len(fits) < 2:
        raise ValueError(f"`fits` must be at least two, but there are {len(fits)}. Fit another model to the same data.")
    if len({(f.measurements, f.absolute, _fingerprint(f)) for f in fits.values()}) > 1:
        raise ValueError("`fits` must be of the same measurements with the same sigma and loss, but differ. Fit all models to one set.")
    names = tuple(sorted(fits, key=lambda name: fits[name].bic))
    least = {which: min(getattr(f, which) for f in fits.values()) for which in ("aic", "bic")}
    above = lambda which: {name: getattr(fits[name], which) - least[which] for name in names}
    counts, unconverged = {name: fits[name].unknown_count for name in names}, tuple(name for name in names if not fits[name].converged)
    known = lambda f: [n for n, s in zip(f.names, np.asarray(f.problem.free.prior_deviation), strict=True) if np.isfinite(s)]
    priors = {name: tuple(known(fits[name])) for name in names if known(fits[name])}
    return Comparison(names, above("aic"), above("bic"), counts, fits[names[0]].correlated, unconverged, priors)


def _fingerprint(f):
    """Numbers that are equal for fits of the same data."""
    numbers = [np.asarray(leaf).tobytes() for e in f.experiments for which in DATA for leaf in jax.tree.leaves(getattr(e, which, None))]
    return hash(tuple(numbers)), f.problem.model.loss
