"""Before and after a fit: what an experiment will tell, whether a model holds on other data, which of two models to believe."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .._model.system import System
from .experiment import Experiment, measured
from .fit import fit
from .identifiability import Channel, channels_of, correlation_of, determined_by
from .parameters import Free
from .problem import Problem, blank, failure_of, linearise
from .residuals import Model
from .result import Fit, Prediction, channel_rows


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Information:
    """What a planned experiment will tell of the parameters.

    - `matrix`: Fisher's information JᵀJ, in the flat order of `names`; `covariance`: its inverse; `correlation`.
    - `standard_errors`: expected of a fit, by the names of `free`; infinite where the experiment determines nothing.
    """

    names: tuple[str, ...]
    matrix: np.ndarray
    covariance: np.ndarray
    correlation: np.ndarray
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
    system: System, experiments: Experiment | Sequence[Experiment], params: PyTree, free: Sequence[str], **numerics: Any
) -> Information:
    r"""Fisher's information of planned experiments, and the standard errors a fit will have, before anybody measures.

    $$ F = \sum_i \frac{1}{\sigma_i^2} \left(\frac{\partial h_i}{\partial \theta}\right)^T \frac{\partial h_i}{\partial \theta},
       \qquad \mathrm{cov}\,\hat\theta \approx F^{-1} $$

    Unknown starts of the experiments cost information, and are taken into account.

    **Arguments:** as `fit`; `experiments` need no `values`, but their `sigma`: a number, or one like the values. Where there are values,
    samples missing there are missing here. `params` are where the information is wanted. Any consistent units.

    **Returns:** an `Information`. **Raises:** `ValueError` where sigma is missing or the motion cannot be computed.

    **Source:** Walter & Pronzato, Identification of Parametric Models (1997), section 6.1.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    plan = jl.Experiment(jnp.linspace(0.0, 3.0, 50), None, q0=1.0, qdot0=0.0, sigma=1e-3)
    jl.information(oscillator, plan, {"c": 4.0}, free=("c",)).standard_errors["c"]
    ```
    """
    experiments, params = measured(experiments, params, planned=True)
    for e in experiments:
        if e.sigma is None:
            raise ValueError("`experiments` must say how well they measure, but one has no `sigma`. Give that of the noise.")
    named = Free.of(params, free)
    model = Model(system, tuple(sorted(numerics.items())), None)
    planned = [_planned(model, named, e) for e in experiments]
    problem = Problem.of(model, named, planned)
    rows = linearise(problem, jnp.zeros(problem.size))
    reason = failure_of(rows)
    if reason:
        raise ValueError(f"`params` must give a motion, but it ended with: {reason} Take other ones.")
    J, p = np.asarray(rows.jacobian)[named.size :], named.size
    known, slope = determined_by(J, np.zeros((0, problem.size))), np.asarray(named.slope(jnp.zeros(p)))
    covariance = known.covariance[:p, :p] * np.outer(slope, slope)
    covariance[np.diag_indices(p)] = np.where(known.determined[:p], np.diag(covariance), np.inf)
    # What the unknown starts leave of the information: the Schur complement.
    F, own = J.T @ J, slice(p, None)
    F = (F[:p, :p] - F[:p, own] @ np.linalg.pinv(F[own, own], hermitian=True) @ F[own, :p]) / np.outer(slope, slope)
    errors = np.sqrt(np.diag(covariance))
    by_name = lambda flat: named.by_name(jnp.asarray(flat))
    return Information(named.entries, F, covariance, correlation_of(covariance), by_name(errors), by_name(named.start))


def _planned(model, free, e):
    """The experiment with zeros for values, where it has none."""
    if e.values is not None:
        return e
    zeros = blank(model, free, e).values
    bare = jax.tree.map(np.asarray, (e.q0, e.qdot0))
    return Experiment(e.ts, zeros, *bare, observe=e.observe, sigma=e.sigma, params=e.params, unknown=e.unknown, delay=e.delay)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Validation:
    """How a fitted model does on data it has not seen: `channels`, `residuals`, and the `prediction` with its band."""

    channels: list[Channel]
    residuals: Any
    prediction: Prediction

    def __repr__(self) -> str:
        return "\n".join(["Validation: prediction of other data", *channel_rows(self.channels)])


def validate(fit: Fit, experiment: Experiment, *, level: float = 0.95) -> Validation:
    """Predicts another experiment with fitted parameters and compares. What is unknown of the experiment's own, its start for instance,
    is estimated from it; the fitted parameters are not touched.

    **Arguments:** `level` of the confidence band. **Returns:** a `Validation`. Any consistent units.

    **Source:** Ljung, System Identification, 2nd ed., section 16.4 (cross validation).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    ts = jnp.linspace(0.0, 3.0, 50)
    fit = jl.fit(oscillator, jl.Experiment(ts, jnp.cos(2.0 * ts), 1.0, 0.0), {"c": 3.0}, free=("c",))
    jl.validate(fit, jl.Experiment(ts, jnp.sin(2.0 * ts), 0.0, 2.0)).channels[0].fit_percent  # 100
    ```
    """
    if experiment.values is None:
        raise ValueError("`experiment` must have been measured, but has no values. Use `fit.predict` for what it should show.")
    if experiment.unknown:
        model = fit.problem.model
        own = _settle(model.system, experiment, fit.params, dict(model.numerics))
        experiment = own.experiments[0]
    prediction = fit.predict(experiment, level=level)
    residuals = jax.tree.map(lambda z, p: np.asarray(z - p), experiment.values, prediction.values)
    return Validation(channels_of(0, experiment.values, residuals), residuals, prediction)


def _settle(system, experiment, params, numerics):
    """The experiment's own unknowns, with all parameters held."""
    return fit(system, experiment, params, free=(), **numerics)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """Models of the same data, the best first by Schwarz's criterion: `names`, and differences of `aic` and `bic` to the best one.

    Both criteria take residuals as independent; `correlated`: over how many samples those of the best model are, 0 where they are white.
    """

    names: tuple[str, ...]
    aic: dict[str, float]
    bic: dict[str, float]
    parameters: dict[str, int]
    correlated: int

    def __repr__(self) -> str:
        width = max(map(len, self.names))
        rows = [
            f"  {name:<{width}}  {self.parameters[name]:3d} parameters   ΔAIC {self.aic[name]:10.2f}   ΔBIC {self.bic[name]:10.2f}"
            for name in self.names
        ]
        best, second = self.names[:2]
        strength = next(word for limit, word in EVIDENCE if self.bic[second] >= limit)
        said = [f"  evidence for {best!r} against {second!r}: {strength}"]
        if self.correlated:
            said.append(f"  ! overstated: residuals of {best!r} are correlated over {self.correlated} samples")
        return "\n".join(["Comparison: the smaller the better", *rows, *said])


EVIDENCE = ((10, "very strong"), (6, "strong"), (2, "positive"), (0, "none worth a mention"))


def compare(fits: Mapping[str, Fit]) -> Comparison:
    r"""Which of several models of the same data to believe: is there really a k?

    $$ \mathrm{AIC} = -2 \ln L + 2 p, \qquad \mathrm{BIC} = -2 \ln L + p \ln N $$

    **Arguments:** `fits`: at least two, by name, of the same measurements. **Returns:** a `Comparison`.

    **Raises:** `ValueError` where the fits are of different data.

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
    jl.compare(fits).names[0]
    ```
    """
    if len(fits) < 2:
        raise ValueError(f"`fits` must be at least two, but there are {len(fits)}. Fit another model to the same data.")
    of = {name: (f.measurements, f.absolute, _fingerprint(f)) for name, f in fits.items()}
    if len(set(of.values())) > 1:
        raise ValueError("`fits` must be of the same measurements with the same sigma and loss, but differ. Fit all models to one set.")
    names = tuple(sorted(fits, key=lambda name: fits[name].bic))
    least = {which: min(getattr(f, which) for f in fits.values()) for which in ("aic", "bic")}
    off = lambda which: {name: getattr(fits[name], which) - least[which] for name in names}
    return Comparison(names, off("aic"), off("bic"), {name: fits[name].unknown_count for name in names}, fits[names[0]].correlated)


def _fingerprint(f):
    total = lambda which: float(sum(np.nansum(np.asarray(leaf)) for e in f.experiments for leaf in jax.tree.leaves(getattr(e, which))))
    return total("values"), total("sigma"), f.problem.model.loss
