"""A known truth, simulated, with noise added, and fitted many times: what a plan of measurements and a fit are worth."""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from .._model.numbers import count
from .._model.recorded import deviations
from .._model.system import System
from .experiment import Experiment, validate_inputs
from .fit import fit, fit_each
from .information import information
from .parameters import Free
from .problem import LeastSquaresProblem, failure_of, linearise, with_zero_values
from .residuals import Model
from .result import Fit


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Recovery:
    """How well known parameters are recovered from noisy measurements, as `recover` returns it; prints as a table.

    - `names`: the p numbers, in flat order; `truth`: (p,). `estimates`, `standard_errors`: those of each of the R fits, (R, p); NaN of one
      that failed. `covered`: whether the interval of a fit holds the truth, (R, p); `level`: of the intervals.
    - `predicted`: the standard errors that `information` predicts, (p,).
    - `bias`: the mean error of the estimates, and `bias_error`, what it may be by chance; `scatter`: their standard deviation; `coverage`:
      the share of intervals that hold the truth; each (p,), of the fits that did not fail.
    - `failures`: the number of a fit, and why it failed.

    Units are those of the parameters. `recovery.plot()` draws it.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    plan = jl.Experiment(jnp.linspace(0.0, 3.0, 50), None, q0=1.0, qdot0=0.0, sigma=1e-2)
    found = jl.recover(oscillator, plan, {"c": 4.0}, free=("c",), repeats=20)
    found.estimates.shape  # (20, 1)
    ```
    """

    names: tuple[str, ...]
    truth: Float[np.ndarray, " p"]
    estimates: Float[np.ndarray, "R p"]
    standard_errors: Float[np.ndarray, "R p"]
    covered: Bool[np.ndarray, "R p"]
    predicted: Float[np.ndarray, " p"]
    failures: dict[int, str]
    level: float

    @property
    def bias(self) -> Float[np.ndarray, " p"]:
        """The mean error of the estimates."""
        return np.mean(self._found(self.estimates), axis=0) - self.truth

    @property
    def bias_error(self) -> Float[np.ndarray, " p"]:
        """The standard error of `bias`."""
        return self.scatter / np.sqrt(len(self.estimates) - len(self.failures))

    @property
    def scatter(self) -> Float[np.ndarray, " p"]:
        """The standard deviation of the estimates."""
        return np.std(self._found(self.estimates), axis=0, ddof=1)

    @property
    def coverage(self) -> Float[np.ndarray, " p"]:
        """The share of intervals that hold the truth."""
        return np.mean(self._found(self.covered), axis=0)

    def table(self) -> list[dict[str, Any]]:
        """A row for each number: name, truth, bias, bias_error, scatter, predicted, coverage. `pandas.DataFrame` takes it."""
        columns = {name: getattr(self, name) for name in ("truth", "bias", "bias_error", "scatter", "predicted", "coverage")}
        return [{"name": name} | {key: float(x[i]) for key, x in columns.items()} for i, name in enumerate(self.names)]

    def __repr__(self) -> str:
        rows = [["", "truth", "bias", "scatter", "predicted", f"coverage of {100 * self.level:g} %"]]
        for row in self.table():
            bias = f"{row['bias']:+.2g} ± {row['bias_error']:.1g}"
            numbers = f"{row['truth']:.6g}", bias, f"{row['scatter']:.3g}", f"{row['predicted']:.3g}", f"{100 * row['coverage']:.0f} %"
            rows.append([row["name"], *numbers])
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ["  " + "   ".join(x.ljust(width) for x, width in zip(row, widths, strict=True)).rstrip() for row in rows]
        failed = [f"  ! {len(self.failures)} failed: {next(iter(self.failures.values()))}"] if self.failures else []
        return "\n".join([f"Recovery: {len(self.estimates)} fits", *lines, *failed])

    def _found(self, x: np.ndarray) -> np.ndarray:
        return np.delete(x, list(self.failures), axis=0)


def recover(
    system: System,
    plan: Experiment | Sequence[Experiment],
    params: PyTree,
    *,
    free: str | Sequence[str],
    repeats: int = 100,
    key: Array | None = None,
    guess: PyTree = None,
    bounds: Mapping[str, Any] | None = None,
    priors: Mapping[str, Any] | None = None,
    level: float = 0.95,
    **options: Any,
) -> Recovery:
    r"""Fits a known truth again and again, each time with other noise: bias, scatter and coverage before anything is measured.

    $$ z^{(r)}_i = h(t_i, q(t_i; \theta), \dots) + \sigma_i e^{(r)}_i, \qquad \hat\theta^{(r)} = \arg\min \sum_i
       \left(\frac{z^{(r)}_i - h_i}{\sigma_i}\right)^2, \qquad r = 1, \dots, R $$

    What `information` predicts from slopes at the truth, this tries: whether fits find it from the `guess`, whether they are biased, and
    whether their intervals hold it as often as they say.

    **Arguments:**

    - `plan`: one `Experiment` or several that are fitted together, with `sigma`; their `values` may be None, and samples that are NaN stay
      missing. An unknown start is fitted, too, from the one that is given.
    - `params`: the truth. `free`, `bounds`, `priors`: as for `fit`. `guess`: where the fits start; by default the truth.
    - `repeats`: R, the number of fits. `key`: of the noise, a `jax.random.key`. `level`: of the intervals whose coverage is counted.
    - `**options`: passed on to `fit`.

    Units are any consistent set.

    **Returns:** a `Recovery`. The fits of one experiment run as one batch.

    **Raises:** `ValueError` if an experiment has no sigma, or the motion cannot be computed at the truth. A fit that fails is counted.

    **Source:** Bates & Watts, Nonlinear Regression Analysis and Its Applications (1988), section 6.1; Press et al., Numerical Recipes,
    section 15.6 (Monte Carlo simulation of synthetic data sets).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    plan = jl.Experiment(jnp.linspace(0.0, 3.0, 50), None, q0=1.0, qdot0=0.0, sigma=1e-2)
    print(jl.recover(oscillator, plan, {"c": 4.0}, free=("c",), repeats=50))
    ```
    """
    repeats = count(repeats, "`repeats`", least=2, cure="A hundred tell the scatter to 7 %.")
    numerics = {name: value for name, value in options.items() if name not in FIT}
    expected = information(system, plan, params, free=free, bounds=bounds, priors=priors, **numerics)
    plans, params = validate_inputs(plan, params, planned=True)
    chosen, model = Free.of(params, free, bounds, priors), Model.of(system, numerics)
    clean = [_with_values(model, chosen, e) for e in plans]
    keys = jax.random.split(jax.random.key(0) if key is None else key, (repeats, len(clean)))
    records = [[_noisy(e, key) for e, key in zip(clean, of_one, strict=True)] for of_one in keys]
    how = {"free": free, "bounds": bounds, "priors": priors} | options
    fits = _fitted(system, records, params if guess is None else guess, how)
    truth = np.asarray(chosen.theta(jnp.zeros(chosen.size)), float)
    return _recovery(expected.names, truth, np.sqrt(np.diag(expected.covariance)), fits, level)


FIT = ("loss", "method", "segments", "start", "max_steps", "tolerance", "progress")  # options of `fit`; all others are of `simulate`


def _with_values(model: Model, free: Free, e: Experiment) -> Experiment:
    """What the experiment would show without noise."""
    empty = with_zero_values(model, free, e) if e.values is None else e
    problem = LeastSquaresProblem.of(model, free, [empty])
    found = linearise(problem, jnp.zeros(problem.size))
    if reason := failure_of(found):
        raise ValueError(f"`params` must give a motion, but it ended with: {reason} Try other values.")
    shown = jax.tree.map(lambda x: x[0], found.batches[0].channels)
    measured = lambda z, h: jnp.where(jnp.isnan(z), jnp.nan, h)
    values = jax.tree.map(measured, empty.values, shown)
    return eqx.tree_at(lambda e: (e.values, e.sigma), e, (values, deviations(e.sigma, values)), is_leaf=lambda x: x is None)


def _noisy(e: Experiment, key: Array) -> Experiment:
    """With noise of its sigma."""
    sigma, unravel = ravel_pytree(jax.tree.map(lambda z, s: jnp.broadcast_to(s, z.shape), e.values, e.sigma))
    noise = unravel(sigma * jax.random.normal(key, sigma.shape, sigma.dtype))
    return eqx.tree_at(lambda e: e.values, e, jax.tree.map(jnp.add, e.values, noise))


def _fitted(system: System, records: list[list[Experiment]], guess: PyTree, how: dict[str, Any]) -> list[Fit | str]:
    """The fits, or why one failed."""
    if len(records[0]) == 1:
        with contextlib.suppress(ValueError):
            return list(fit_each(system, [one for (one,) in records], guess, **how))
    fits: list[Fit | str] = []
    for together in records:
        try:
            fits.append(fit(system, together, guess, **how))
        except ValueError as error:
            fits.append(str(error))
    return fits


def _recovery(names: tuple[str, ...], truth: np.ndarray, predicted: np.ndarray, fits: list[Fit | str], level: float) -> Recovery:
    """What all fits found."""
    estimates, errors = np.full((2, len(fits), len(names)), np.nan)
    covered, failures = np.zeros(estimates.shape, bool), {}
    for i, found in enumerate(fits):
        if isinstance(found, str) or not found.converged:
            failures[i] = found if isinstance(found, str) else found.reason
            continue
        errors[i] = np.sqrt(np.diag(found.covariance))
        for j, name in enumerate(names):
            ends = found.interval(name, level)
            covered[i, j] = ends.lower <= truth[j] <= ends.upper
        estimates[i] = np.asarray(found.problem.free.theta(jnp.asarray(found.x[: len(names)])))
    if len(failures) > len(fits) - 2:
        raise ValueError(
            f"`plan` must let at least two fits converge, but all fail: {next(iter(failures.values()))} Start nearer: `guess`."
        )
    return Recovery(names, truth, estimates, errors, covered, predicted, failures, level)
