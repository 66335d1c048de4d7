"""The result of an identification: estimates, their uncertainty, and predictions."""

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PyTree

from .._motion.export import frame_of, jsonable, write_json
from .channels import Channel
from .experiment import Experiment
from .fit_card import card, estimates_by_name, unit_of
from .identifiability import Determined
from .measurement import Test
from .noise import sigmas_of
from .prediction import Prediction, predicted, predicted_test
from .problem import LeastSquaresProblem
from .profile_likelihood import profile_end


class Interval(NamedTuple):
    """A confidence interval, as `Fit.interval` returns it.

    - `lower`, `upper`: the ends, in the unit of the parameter; infinite where the measurements set no limit.

    ```python
    import jaxlag as jl
    interval = jl.results.Interval(lower=3.9, upper=4.1)
    interval.upper  # 4.1
    ```
    """

    lower: float
    upper: float


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Fit:
    r"""Identified parameters with their uncertainty; prints as a card for a report.

    $$ \mathrm{cov}\,\hat\theta = \hat\sigma^2 (J^T J)^{-1}, \qquad \hat\sigma^2 = \frac{\sum r_i^2}{N - p} $$

    If every experiment has a sigma, σ̂ is replaced by 1 in the covariance. Otherwise each channel has its own sigma: r is measured minus
    predicted, divided by the most likely sigma of the channel relative to σ̂, which is found together with θ̂; profile likelihoods keep it.
    If residuals are correlated in time (tested by `whiteness` of a channel), all errors, intervals and bands come from the sandwich
    formula, where R is the correlation of each channel and experiment according to an autoregression of its residuals:

    $$ \mathrm{cov}\,\hat\theta = \hat\sigma^2 (J^T J)^{-1} J^T R J (J^T J)^{-1} $$

    Parameters (p numbers):

    - `params`: all parameters, the free ones at their estimate; `estimates`: the free ones only, by name.
    - `standard_errors`: structured like `estimates`; infinite where the measurements do not determine a parameter. `white_standard_errors`:
      what they would be if residuals were white. `remarks`: sentences about what the measurements do not determine, about bounds, and about
      a model that does not explain the measurements.
    - `names`: the p numbers, in the order of `covariance` (p, p), `correlation` (p, p), and `inflation` (p,), the factors by which
      correlated residuals enlarge the standard errors. `correlation_length`: the number of samples over which they are correlated, 0 if
      they are white.

    Experiments (lists with one entry for each of the E experiments):

    - `experiments`: with estimated starts and parameters filled in; `unknowns`: these estimates by name, `"q0"`, `"qdot0"` and parameters;
      `unknown_errors`: their standard errors.
    - `predictions`, `residuals` (measured minus predicted): structured like the values of the experiment, leaves (T, ...).
      `prediction_errors`: standard errors of the predictions, also where nothing was measured.
    - `channels`: a flat list of how well each `Channel` is predicted.

    The values of a `ModalTest` have the names `"frequency"` and `"damping_ratio"`; those of a `FrequencyResponseTest` are complex, and so
    are their errors: one part for the real, one for the imaginary part.

    Noise and iteration:

    - `sigma`: σ̂, in units of the given sigma; if none was given, the geometric mean of those of the channels, in units of the
      measurements. `sigmas`: for each experiment, one for each channel, estimated or given; structured like a row of its values.
      `absolute`: whether sigma was given.
    - `neg2_log_likelihood`: −2 ln L of the data, up to a constant; priors are no part of it. `cost`: ½ Σ r² at the estimates.
    - `measurements`: N; `unknown_count`: the number of determined unknowns, of parameters and experiments; `noise_free_count`: that of
      measurements in channels that are predicted exactly; `freedom_of_channels`: the degrees of freedom of intervals where channels have
      sigmas of their own.
    - `converged`; `reason`: why the iteration ended; `steps`: the number of steps; `costs`: the cost at the start and after each step.
    - `start_log`: the steps by which the start was found, if it was not `params` (`Regress`).
    - `problem`, `x`, `known`: the least-squares problem, all its unknowns at the minimum, their covariance divided by σ̂², and the
      directions in which they are not determined.

    Quantities have the units of the parameters and measurements, any consistent set. `fit.plot()` draws it, with all that `plot.fit` takes;
    `fit.report("report.html")` writes it as one page for a colleague.

    **Source:** Ljung, System Identification, 2nd ed., sections 7.2, 9.2 to 9.4 and 16; Seber & Wild, Nonlinear Regression (1989),
    chapter 5; Newey & West, Econometrica 55 (1987) 703.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    ts = jnp.linspace(0.0, 3.0, 50)
    fit = jl.fit(oscillator, jl.Experiment(ts, jnp.cos(2.0 * ts), 1.0, 0.0), {"c": 3.0}, free=("c",))
    fit.estimates["c"]  # 4.0
    fit.covariance.shape  # (1, 1)
    ```
    """

    experiments: tuple[Experiment | Test, ...]
    params: PyTree
    estimates: dict[str, PyTree]
    standard_errors: dict[str, PyTree]
    covariance: Float[np.ndarray, "p p"]
    correlation: Float[np.ndarray, "p p"]
    unknowns: list[dict[str, PyTree]]
    unknown_errors: list[dict[str, PyTree]]
    residuals: list[PyTree]
    predictions: list[PyTree]
    prediction_errors: list[PyTree]
    channels: list[Channel]
    sigma: float
    sigmas: list[PyTree]
    cost: float
    names: tuple[str, ...]
    remarks: list[str]
    converged: bool
    reason: str
    steps: int
    costs: Float[np.ndarray, " n"]
    measurements: int
    absolute: bool
    problem: LeastSquaresProblem
    unknown_count: int
    x: Float[np.ndarray, " x"]
    known: Determined
    inflation: Float[np.ndarray, " p"]
    correlation_length: int
    start_log: tuple[str, ...] = ()
    neg2_log_likelihood: float = np.nan
    noise_free_count: int = 0
    freedom_of_channels: float = np.inf

    if TYPE_CHECKING:  # put here by `jaxlag.plot`
        plot: ClassVar[Callable[..., Any]]
        report: ClassVar[Callable[..., None]]

    @property
    def units(self) -> tuple[tuple[str, str], ...]:
        """The units that the system states, as (name, unit)."""
        return self.problem.model.system.units

    @property
    def freedom(self) -> int:
        """Degrees of freedom: measurements minus determined unknowns, and minus those of channels that are predicted exactly."""
        return max(self.measurements - self.noise_free_count - self.unknown_count, 0)

    @property
    def white_standard_errors(self) -> dict[str, PyTree]:
        """The standard errors as if residuals were white, structured like `estimates`."""
        return self.problem.free.by_name(np.sqrt(np.diag(self.covariance)) / self.inflation)

    @property
    def aic(self) -> float:
        """Akaike's criterion; of two models of the same data the one with the smaller value is better. Assumes independent residuals."""
        return self.neg2_log_likelihood + 2 * self._fitted

    @property
    def bic(self) -> float:
        """Schwarz's criterion, which penalises parameters more than Akaike's. Assumes independent residuals."""
        return self.neg2_log_likelihood + float(np.log(self.measurements)) * self._fitted

    @property
    def _fitted(self) -> int:
        """The number of unknowns, estimated sigmas among them."""
        return self.unknown_count + (0 if self.absolute else max(len(sigmas_of(self.problem)), 1))

    @property
    def sigma_scale(self) -> float:
        """The factor of all standard errors: σ̂, or 1 if sigma was given."""
        return 1.0 if self.absolute and self.problem.model.loss is None else self.sigma

    def quantile(self, level: float) -> float:
        """t of the interval θ̂ ± t · standard error at this `level`: of the normal distribution if sigma was given, otherwise Student's."""
        if not 0 < level < 1:
            raise ValueError(f"`level` must lie between 0 and 1, but is {level:g}. Use e.g. 0.95.")
        from scipy import special

        if self.absolute:
            return float(special.ndtri(0.5 + level / 2))
        return float(special.stdtrit(max(min(self.freedom, self.freedom_of_channels), 1), 0.5 + level / 2))

    def interval(self, name: str, level: float = 0.95, *, profile: bool = False) -> Interval:
        """The confidence interval of one parameter.

        **Arguments:** `name`: an entry of `names`; `level`: between 0 and 1. `profile`: False for the linearised interval, θ̂ ± t ·
        standard error. True for that of the profile likelihood, which refits all other unknowns for each value of the parameter and need
        not be symmetric. Correlated residuals widen both by the same factor.

        **Returns:** an `Interval`.

        **Raises:** `ValueError` if `name` is not a fitted parameter, `level` is out of range, or a robust loss is profiled.

        **Source:** Bates & Watts, Nonlinear Regression Analysis and Its Applications (1988), section 6.1.
        """
        if name not in self.names:
            raise ValueError(f"`name` must be a fitted parameter, but is {name!r}. There are {', '.join(self.names)}.")
        i, t = self.names.index(name), self.quantile(level)
        theta = float(self.problem.free.theta(jnp.asarray(self.x[: len(self.names)]))[i])
        error = float(np.sqrt(self.covariance[i, i]))
        if not profile:
            lower, upper = (float(bound[i]) for bound in (self.problem.free.lower, self.problem.free.upper))
            return Interval(max(theta - t * error, lower), min(theta + t * error, upper))
        if self.problem.model.loss is not None:
            raise ValueError("`profile` must be False for a fit with a robust loss, but is True. Use `profile=False`.")
        if not np.isfinite(error):
            return Interval(-np.inf, np.inf)
        deviation, inflation = float(np.sqrt(self.known.covariance[i, i])), float(self.inflation[i])
        scales = {"quantile": t, "sigma": self.sigma_scale, "inflation": inflation, "deviation": deviation}
        ends = (profile_end(self.problem, self.x, i, side=side, freedom=self.freedom, **scales) for side in (-1, 1))
        return Interval(*ends)

    def band(self, number: int = 0, level: float = 0.95) -> tuple[PyTree, PyTree]:
        """The confidence band of the predictions of a fitted experiment, from the uncertainty of all unknowns, including its start.

        **Arguments:** `number`: of the experiment; `level`: between 0 and 1. **Returns:** the lower and the upper end, each structured
        like the values of the experiment. **Raises:** `ValueError` if `level` is out of range.

        **Source:** Seber & Wild, Nonlinear Regression (1989), section 5.1.
        """
        t = self.quantile(level)
        lower, upper = (
            jax.tree.map(lambda p, e, s=s: p + s * t * e, self.predictions[number], self.prediction_errors[number]) for s in (-1, 1)
        )
        return lower, upper

    def predict(self, experiment: Experiment | Test, *, level: float = 0.95) -> Prediction:
        """What another experiment should show, with the confidence band due to the uncertainty of the parameters.

        **Arguments:** `experiment`: its start is taken as exact; its `values` may be None. Or a `ModalTest` or `FrequencyResponseTest`.
        `level`: of the band, between 0 and 1.

        **Returns:** a `Prediction`. If the sensors have a delay, its `motion` has one more sample, the first one at the start.

        **Raises:** `ValueError` if the motion cannot be computed, or `level` is out of range.
        """
        of = predicted_test if isinstance(experiment, Test) else predicted
        return of(self.problem, self.x, self.known, self.sigma_scale, experiment, self.quantile(level))  # type: ignore[operator]

    def to_dict(self, *, level: float = 0.95) -> dict[str, Any]:
        """The fit as plain data for `json.dumps`. None stands for a number that does not exist, such as the error of an undetermined
        parameter.

        - `"parameters"`: a row for each number, of the parameters and then of each experiment's unknowns, with `"name"`, `"value"`,
          `"standard_error"`, `"lower"` and `"upper"` at the confidence `level`, and its `"unit"` if the system states units. `"params"`:
          all parameters as nested dicts.
        - `"channels"`, and the fields and properties of `Fit` that are numbers or text, under their names.
        """
        copied = ("names", "correlation", "covariance", "remarks", "sigma", "absolute", "cost", "costs", "aic", "bic", "measurements")
        parts = {name: getattr(self, name) for name in (*copied, "freedom", "converged", "reason", "steps", "start_log", "params")}
        rows, channels = list(self._rows(level)), [channel._asdict() for channel in self.channels]
        return jsonable({"parameters": rows, "level": level} | parts | {"channels": channels})

    def to_dataframe(self, frame: Callable | None = None, *, level: float = 0.95) -> Any:
        """A table with a row for each number: name, value, standard_error, lower, upper, and unit if the system states units.

        **Arguments:** `frame`: the class of data frames, as for `Trajectory.to_dataframe`; `level`: of the intervals.

        **Returns:** a `frame`.

        **Raises:** `ImportError` if no `frame` is given and neither pandas nor polars is installed.
        """
        rows = list(self._rows(level))
        return frame_of({column: [row[column] for row in rows] for column in rows[0]}, frame)

    def save(self, file: str | Path, *, level: float = 0.95) -> None:
        """Writes `to_dict(level=level)` and the card to a JSON `file`, which `jl.load` and other programs read without the system."""
        write_json(file, "Fit", {"card": str(self)} | self.to_dict(level=level))

    def _rows(self, level: float) -> Iterator[dict[str, Any]]:
        t, units = self.quantile(level), dict(self.units)
        for whose, group in estimates_by_name(self):
            for name, value, error in group:
                lower, upper = self.interval(name, level) if name in self.names else (value - t * error, value + t * error)
                numbers = {"value": value, "standard_error": error, "lower": lower, "upper": upper}
                unit = {"unit": unit_of(name, whose, units)} if units else {}
                yield {"name": name} | {column: float(number) for column, number in numbers.items()} | unit

    def __repr__(self) -> str:
        return card(self)
