"""Before a fit: the information of planned experiments."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PyTree

from .._model.system import System
from .arrow import gathered
from .experiment import Experiment, validate_inputs
from .identifiability import correlation_of, determined_by
from .measurement import Test, split_by_kind
from .parameters import Free
from .problem import LeastSquaresProblem, failure_of, linearise, with_expected_zeros
from .residuals import Model


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
    experiments: Experiment | Test | Sequence[Experiment | Test],
    params: PyTree,
    *,
    free: str | Sequence[str],
    bounds: Mapping[str, Any] | None = None,
    priors: Mapping[str, Any] | None = None,
    **numerics: Any,
) -> Information:
    r"""The Fisher information of planned experiments, and the standard errors that a fit of them will have.

    $$ F = \sum_i \frac{1}{\sigma_i^2} \left(\frac{\partial h_i}{\partial \theta}\right)^T \frac{\partial h_i}{\partial \theta}
       + \mathrm{diag}\frac{1}{\varsigma_j^2}, \qquad \mathrm{cov}\,\hat\theta \approx F^{-1} $$

    Unknown starts of the experiments reduce the information; this is taken into account.

    **Arguments:**

    - `experiments`: one or several, with `sigma`. Their `values` may be None; samples that are NaN do not count. `ModalTest`s and
      `FrequencyResponseTest`s need expected values, and `events` expected times.
    - `params`: where the information is computed, as for `fit`. `free`: name or names of the p numbers that will be identified.
    - `priors`: (mean, standard deviation ς) by name, as for `fit`; they add to the information. `bounds`: as for `fit`; what is computed
      holds between them, where `params` have to lie.
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
    experiments, params = planned(experiments, params)
    chosen = Free.of(params, free, bounds, priors)
    model = Model.of(system, numerics)
    recordings, tests = split_by_kind(experiments)
    problem = LeastSquaresProblem.of(model, chosen, [with_expected_zeros(model, chosen, e) for e in recordings], tests)
    found = linearise(problem, jnp.zeros(problem.size))
    reason = failure_of(found)
    if reason:
        raise ValueError(f"`params` must give a motion, but it ended with: {reason} Try other values.")
    J, p = np.asarray(gathered(found.jacobian)), chosen.size
    known, slope = determined_by(J, np.zeros((0, problem.size))), np.asarray(chosen.slope(jnp.zeros(p)))
    covariance = known.covariance[:p, :p] * np.outer(slope, slope)
    covariance[np.diag_indices(p)] = np.where(known.determined[:p], np.diag(covariance), np.inf)
    # The information that is left beside the unknown starts: the Schur complement.
    F, own = J.T @ J, slice(p, None)
    F = (F[:p, :p] - F[:p, own] @ np.linalg.pinv(F[own, own], hermitian=True) @ F[own, :p]) / np.outer(slope, slope)
    errors = np.sqrt(np.diag(covariance))
    by_name = lambda flat: chosen.by_name(jnp.asarray(flat))
    return Information(chosen.entries, F, covariance, correlation_of(covariance), by_name(errors), by_name(chosen.start))


def planned(experiments: Any, params: PyTree) -> tuple[tuple[Any, ...], PyTree]:
    """Planned measurements as a tuple, and `params` as arrays, both checked."""
    experiments, params = validate_inputs(experiments, params, planned=True, tests=(Test,))
    for i, e in enumerate(experiments):
        if e.sigma is None:
            raise ValueError(
                "`experiments` must say how well they measure, but one has no `sigma`. Give the standard deviation of the noise."
            )
        for name in e.events if isinstance(e, Experiment) else ():
            if np.all(np.isnan(e.values[name])):
                raise ValueError(
                    f"`events[{name!r}]` of experiment {i} must hold the times that are expected, but all are missing. "
                    "Take them from `simulate`."
                )
    return experiments, params
