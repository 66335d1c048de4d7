"""The answer of an identification, with its quality."""

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from .._model.paths import entry_names, is_within
from .._motion.export import frame_of, jsonable, write_json
from .._motion.trajectory import Trajectory
from .._program.jit import compiled
from .autocorrelation import COLOURED
from .experiment import Experiment
from .identifiability import Channel
from .levenberg_marquardt import levenberg_marquardt
from .problem import Problem, blank, failure_of, linearise


class Interval(NamedTuple):
    """A confidence interval; an end is infinite where the measurements set no limit."""

    lower: float
    upper: float


class Prediction(NamedTuple):
    """What an experiment should show.

    - `values`: structured like the experiment's; `standard_errors` of them, from the uncertainty of the parameters.
    - `lower`, `upper`: the confidence band. `motion`: the `Trajectory` behind it.
    """

    values: PyTree
    standard_errors: PyTree
    lower: PyTree
    upper: PyTree
    motion: Trajectory


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Fit:
    r"""Identified parameters with their quality; printed, a table for a report.

    $$ \mathrm{cov}\,\hat\theta = \hat\sigma^2 (J^T J)^{-1}, \qquad \hat\sigma^2 = \frac{\sum r_i^2}{N - p} $$

    σ̂ is 1 where every experiment came with its sigma. Where residuals are correlated in time, which `whiteness` of a channel says, all
    errors, intervals and bands are those of the sandwich, with R the correlation that an autoregression finds in the residuals:

    $$ \mathrm{cov}\,\hat\theta = \hat\sigma^2 (J^T J)^{-1} J^T R J (J^T J)^{-1} $$

    - `params`: all parameters, the free ones at their estimate; `estimates`: the free ones alone, by name.
    - `standard_errors`: like `estimates`; infinite where the measurements do not determine a parameter; `remarks` then say in words
      what they do determine. `covariance`, `correlation`: in the flat order whose entries `names` names.
    - `experiments`: what was fitted, with estimated starts put in; `unknowns` and `unknown_errors`: for each experiment its own
      estimates, `"q0"`, `"qdot0"` and parameters, with standard errors.
    - `predictions`, `residuals` (measured minus predicted): per experiment, structured like its values. `prediction_errors`: standard
      errors of the predictions, NaN where nothing was measured. `channels`: how well each is predicted. `sigma`: σ̂, in units of the
      sigma given, which is 1 where none was.
    - `correlated`: over how many samples residuals are, 0 where they are white; `inflation`: how many times larger the standard errors
      of `names` are for that.
    - `converged`, `reason`, `steps`, `costs` (after each step), `cost` (half the sum of squares).

    **Source:** Ljung, System Identification, 2nd ed., sections 7.2, 9.2 to 9.4 and 16; Seber & Wild, Nonlinear Regression (1989),
    chapter 5; Newey & West, Econometrica 55 (1987) 703.
    """

    experiments: tuple[Experiment, ...]
    params: PyTree
    estimates: dict[str, PyTree]
    standard_errors: dict[str, PyTree]
    covariance: np.ndarray
    correlation: np.ndarray
    unknowns: list[dict[str, PyTree]]
    unknown_errors: list[dict[str, PyTree]]
    residuals: list[PyTree]
    predictions: list[PyTree]
    prediction_errors: list[PyTree]
    channels: list[Channel]
    sigma: float
    cost: float
    names: tuple[str, ...]
    remarks: list[str]
    converged: bool
    reason: str
    steps: int
    costs: np.ndarray
    measurements: int
    absolute: bool  # whether sigma was given
    problem: Problem
    unknown_count: int
    x: np.ndarray  # the unknowns at the minimum, as the problem takes them
    x_covariance: np.ndarray  # over σ̂²
    inflation: np.ndarray  # of each standard error by the residuals' correlation in time
    correlated: int  # over how many samples they are; 0 where they are white

    @property
    def freedom(self) -> int:
        """Measurements less determined unknowns."""
        return max(self.measurements - self.unknown_count, 0)

    @property
    def misfit(self) -> float:
        """−2 log likelihood, up to a constant that the data alone set."""
        squares = 2 * self.cost
        return squares if self.absolute else self.measurements * float(np.log(squares / self.measurements))

    @property
    def aic(self) -> float:
        """Akaike's criterion; of two models of the same data the smaller is the better one. It takes residuals as independent."""
        return self.misfit + 2 * (self.unknown_count + (not self.absolute))

    @property
    def bic(self) -> float:
        """Schwarz's criterion, stricter with parameters than Akaike's; it takes residuals as independent, too."""
        return self.misfit + float(np.log(self.measurements)) * (self.unknown_count + (not self.absolute))

    def interval(self, name: str, level: float = 0.95, *, profile: bool = False) -> Interval:
        """The confidence interval of one parameter, an entry of `names`.

        Linearised: θ̂ ± t · standard error, with Student's t. With `profile=True` by the likelihood: the other parameters are fitted
        anew along the way, to where the cost says no; it need not be symmetric. Correlated residuals make both wider by the same factor.

        **Source:** Bates & Watts, Nonlinear Regression Analysis and Its Applications (1988), section 6.1.
        """
        if name not in self.names:
            raise ValueError(f"`name` must be a fitted parameter, but is {name!r}. There are {', '.join(self.names)}.")
        i, t = self.names.index(name), self._quantile(level)
        theta = float(self.problem.free.theta(jnp.asarray(self.x[: len(self.names)]))[i])
        error = float(np.sqrt(self.covariance[i, i]))
        if not profile:
            lower, upper = (float(bound[i]) for bound in (self.problem.free.lower, self.problem.free.upper))
            return Interval(max(theta - t * error, lower), min(theta + t * error, upper))
        if self.problem.model.loss is not None:
            raise ValueError("`profile` must be of a plain least-squares fit, but this one has a loss of its own. Take `profile=False`.")
        return Interval(*(self._profile_end(i, side, t) if np.isfinite(error) else side * np.inf for side in (-1, 1)))

    def band(self, number: int = 0, level: float = 0.95) -> tuple[PyTree, PyTree]:
        """The ends of the confidence band of what was fitted, from the uncertainty of all unknowns, those of the experiment included.

        **Source:** Seber & Wild, Nonlinear Regression (1989), section 5.1.
        """
        t = self._quantile(level)
        lower, upper = (
            jax.tree.map(lambda p, e, s=s: p + s * t * e, self.predictions[number], self.prediction_errors[number]) for s in (-1, 1)
        )
        return lower, upper

    def predict(self, experiment: Experiment, *, level: float = 0.95) -> Prediction:
        """What an experiment should show at the estimates, with the confidence band that their uncertainty makes.

        The experiment starts where it says, without error; its `values` may be None. Where its sensors are late, `motion` has one more
        sample, the first at the start.
        """
        free = self.problem.free
        model = dataclasses.replace(self.problem.model, loss=None)
        aside = Problem.of(model, free, [blank(model, free, experiment)])
        y = jnp.asarray(self.x[: free.size])
        rows = linearise(aside, jnp.concatenate([y, jnp.zeros(aside.size - free.size)]))
        reason = failure_of(rows)
        if reason:
            raise ValueError(f"`experiment` must have a motion at the estimates, but it ended with: {reason}")
        part = rows.of_stacks[0]
        J = np.asarray(part.jacobian[0][:, : free.size])
        spread = self.sigma_scale * np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", J, self.x_covariance[: free.size, : free.size], J), 0))
        values = jax.tree.map(lambda x: x[0], part.channels)
        errors = ravel_pytree(values)[1](jnp.asarray(spread))
        t = self._quantile(level)
        lower, upper = (jax.tree.map(lambda v, e, s=s: v + s * t * e, values, errors) for s in (-1, 1))
        one = jax.tree.map(lambda x: x[0] if eqx.is_array(x) else x, aside.stacks[0])
        motion = _motion(aside.model, free.insert(free.theta(y)), one)
        return Prediction(values, errors, lower, upper, motion)

    def to_dict(self, *, level: float = 0.95) -> dict[str, Any]:
        """What the fit says, ready for `json.dumps`: `"parameters"`, a row for each with its name, value, standard error and the ends of
        its confidence interval, those that experiments have of their own behind them; `"params"` as nested dicts; correlation, remarks,
        channels and how it converged. None is a number that there is not: the error of what is not determined, an end without limit.
        """
        said = ("names", "correlation", "covariance", "remarks", "sigma", "absolute", "cost", "costs", "aic", "bic", "measurements")
        parts = {name: getattr(self, name) for name in (*said, "freedom", "converged", "reason", "steps", "params")}
        rows, channels = list(self._rows(level)), [channel._asdict() for channel in self.channels]
        return jsonable({"parameters": rows, "level": level} | parts | {"channels": channels})

    def to_dataframe(self, frame: Callable | None = None, *, level: float = 0.95) -> Any:
        """A table with a row for each parameter: name, value, standard_error, lower, upper. `frame` as for `Trajectory.to_dataframe`."""
        rows = list(self._rows(level))
        return frame_of({column: [row[column] for row in rows] for column in rows[0]}, frame)

    def save(self, file: str | Path, *, level: float = 0.95) -> None:
        """Writes `to_dict` and the card as JSON. `jl.load` reads it, as any other program does; no function of the system is needed."""
        write_json(file, "Fit", {"card": str(self)} | self.to_dict(level=level))

    def _rows(self, level):
        t = self._quantile(level)
        for _, group in self._groups():
            for name, value, error in group:
                ends = self.interval(name, level) if name in self.names else (value - t * error, value + t * error)
                row = (name, value, error, *ends)
                yield dict(zip(("name", "value", "standard_error", "lower", "upper"), (name, *map(float, row[1:])), strict=True))

    @property
    def sigma_scale(self) -> float:
        """What standard errors are multiplied with: σ̂, or 1 where sigma was given."""
        return 1.0 if self.absolute and self.problem.model.loss is None else self.sigma

    def _quantile(self, level):
        if not 0 < level < 1:
            raise ValueError(f"`level` must lie between 0 and 1, but is {level:g}. Take 0.95.")
        from scipy import special

        return float(special.ndtri(0.5 + level / 2) if self.absolute else special.stdtrit(max(self.freedom, 1), 0.5 + level / 2))

    def _profile_end(self, i, side, t):
        """Where the root of twice the rise of the cost, refitted with y_i held, is t: nearly a straight line."""
        from scipy import optimize

        free, kept = self.problem.free, np.delete(np.arange(self.x.size), i)
        others, least = self.x[kept], float(jnp.sum(linearise(self.problem, jnp.asarray(self.x)).residuals ** 2) / 2)
        unit, bounds = self.sigma_scale * float(self.inflation[i]), tuple(bound[kept] for bound in self.problem.bounds)

        def excess(away):
            nonlocal others
            held = jnp.asarray(self.x).at[i].add(away)

            def seen(rest):
                rows = linearise(self.problem, held.at[kept].set(rest))
                return rows.residuals, rows.jacobian[:, kept], rows

            limits = {"freedom": self.freedom, "max_steps": 50, "tolerance": 1e-4, "bounds": bounds}
            best = levenberg_marquardt(seen, jnp.asarray(others), **limits).best
            rise = float(jnp.sum(best.residuals**2) / 2) - least
            others = np.asarray(best.y) if np.isfinite(rise) else others
            return min(np.sqrt(max(2 * rise, 0)) / unit, FAR * t) - t

        first = side * t * self.sigma_scale * float(np.sqrt(self.x_covariance[i, i]))
        limit = float(self.problem.bounds[side > 0][i]) - self.x[i]
        if np.isfinite(limit):
            if limit == 0 or excess(limit) <= 0:
                return float((free.lower if side < 0 else free.upper)[i])
            found = optimize.root_scalar(excess, bracket=(0.0, limit), method="brentq", rtol=1e-4)
        else:
            found = optimize.root_scalar(excess, x0=0.0, x1=first, method="secant", rtol=1e-4, maxiter=20)
        if not (found.converged and 0 < found.root * side < FAR * abs(first)):  # no rise that says no, as far as one can see
            return float((free.lower if side < 0 else free.upper)[i])
        return float(free.theta(jnp.asarray(self.x).at[i].add(found.root)[: free.size])[i])

    def __repr__(self) -> str:
        count = len(self.names)
        outcome = f"converged after {self.steps} steps" if self.converged else f"not converged after {self.steps} steps: {self.reason}"
        rows = [f"Fit: {count} parameter{'s' if count != 1 else ''}, {self.measurements} measurements, {outcome}"]
        rows += [*self._parameter_rows(), *self._correlation_rows(), *self._inflation_rows(), *(f"  ! {remark}" for remark in self.remarks)]
        rows += channel_rows(self.channels)
        return "\n".join([*rows, f"  residual sigma  {self.sigma:.4g}{'  (1 where the noise is as said)' if self.absolute else ''}"])

    def _groups(self) -> Iterator[tuple[str, list[tuple[str, float, float]]]]:
        """Estimates and their errors, by the name they belong to: of the parameters, then of each experiment."""
        theta = np.asarray(self.problem.free.theta(jnp.asarray(self.x[: len(self.names)])))
        triples = list(zip(self.names, theta, np.sqrt(np.diag(self.covariance)), strict=True))
        yield from ((name, [triple for triple in triples if is_within(triple[0], name)]) for name in self.estimates)
        for k, unknowns in enumerate(self.unknowns):
            for which, tree in unknowns.items():
                label = f"experiment {k}: {which}"
                entries = [f"{label}{'.' if name[:1].isalpha() else ''}{name}" for name in entry_names(tree)]
                values, errors = (np.asarray(ravel_pytree(x)[0]) for x in (tree, self.unknown_errors[k][which]))
                yield label, list(zip(entries, values, errors, strict=True))

    def _parameter_rows(self):
        """Estimates, errors and intervals; many numbers of one name in one row."""
        groups = list(self._groups())
        named = [(name, self._spoken(v, e)) for _, group in groups if len(group) <= MANY for name, v, e in group]
        named += [(name, _counted(group)) for name, group in groups if len(group) > MANY]
        width = max((len(name) for name, _ in named[:SHOWN]), default=0)
        rows = [f"  {name:<{width}}  {said}" for name, said in named[:SHOWN]]
        return rows + ([f"  … and {len(named) - SHOWN} more"] if len(named) > SHOWN else [])

    def _spoken(self, value, error):
        if not np.isfinite(error):
            return "not determined by these measurements" if np.isinf(error) else f"{value:.6g}"
        t = self._quantile(0.95)
        return f"{plus_minus(value, error):<24} 95 %: {rounded(value - t * error, error)} … {rounded(value + t * error, error)}"

    def _correlation_rows(self):
        pairs = itertools.combinations(range(min(len(self.names), SHOWN)), 2)
        strong = sorted((pair for pair in pairs if abs(self.correlation[pair]) > 0.5), key=lambda pair: -abs(self.correlation[pair]))
        shown = [f"{self.names[i]}, {self.names[j]}: {self.correlation[i, j]:+.2f}" for i, j in strong[:STRONGEST]]
        more = [f"{len(strong) - STRONGEST} more above 0.5"] if len(strong) > STRONGEST else []
        return [f"  correlation  {'; '.join([*shown, *more])}"] if strong else []

    def _inflation_rows(self):
        if not self.correlated:
            return []
        times = dict.fromkeys(f"{x:.2g}" for x in (np.min(self.inflation, initial=np.inf), np.max(self.inflation, initial=0)))
        larger = f": {' to '.join(times)} times those of white ones" if self.names else ""
        return [f"  standard errors allow for the residuals' correlation over {self.correlated} samples{larger}"]


@compiled
def _motion(model, params, e):
    return model.predicted(params, e, jnp.zeros(e.unknowns))[1]


FAR = 50  # times the linearised interval, within which an end is looked for
SHOWN = 40  # rows of a table at most
STRONGEST = 6  # correlations on the card
MANY = 16  # numbers of one name, beyond which they are counted only


def _counted(group):
    errors = np.array([error for _, _, error in group])
    known = "" if np.all(np.isnan(errors)) else f", {np.count_nonzero(np.isfinite(errors))} of them determined one by one"
    return f"{len(group)} numbers{known}"


def _colour(p):
    if np.isnan(p):
        return ""
    return "white" if p >= COLOURED else f"not white (p = {p:.1g})"


def channel_rows(channels: Sequence[Channel]) -> list[str]:
    """The table of channels."""
    several = len({channel.experiment for channel in channels}) > 1
    label = lambda c: f"{c.experiment}: {c.name}" if several else c.name
    shown = channels[:SHOWN]
    width = max((len(label(c)) for c in shown), default=0)
    rows = [
        f"  {label(c):<{width}}  fit {_short(c.fit_percent, '6.2f')} %   R² {_short(c.r_squared, '.5f')}   rms {c.rms:.3g}   "
        + _colour(c.whiteness)
        for c in shown
    ]
    return rows + ([f"  … and {len(channels) - SHOWN} more channels"] if len(channels) > SHOWN else [])


def _short(x, digits):
    return f"{x:{digits}}" if abs(x) < 1e4 else f"{x:.1e}"


def plus_minus(value: float, error: float) -> str:
    """`value ± error` with two digits of the error."""
    if error > 1e3 * abs(value):
        return f"{value:.3g} ± {error:.2g}"
    if error == 0:
        return f"{value:.6g} ± 0"
    if error < 1e-7 or abs(value) >= 1e7:
        return f"{value:.8g} ± {error:.2g}"
    return f"{rounded(value, error)} ± {rounded(error, error)}"


def rounded(x: float, error: float) -> str:
    """`x` to the second digit of an error; of an error that is too small for that, as it is."""
    if error < 1e-7:
        return f"{x:.6g}"
    digits = 1 - int(np.floor(np.log10(error)))
    return f"{round(x, digits) + 0.0:.{max(digits, 0)}f}"
