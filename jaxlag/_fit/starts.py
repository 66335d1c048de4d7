"""Leading a fit in from a poor start: regression on the equations of motion, then segments, then the whole motion."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .._model.numbers import count
from .._model.system import System
from .experiment import Experiment, validate_inputs
from .levenberg_marquardt import INTERRUPTED, REASONS, STEP_LIMIT
from .measurement import split_by_kind
from .multiple_shooting import FEWEST, can_be_cut
from .parameters import Free, is_unknown
from .problem import NoMotion
from .regress import Regression, regress
from .remarks import UNEXPLAINED, unexplained
from .result import Fit

FIRST_STEPS = 30  # of the whole motion from the start of `regress`; those that do not converge are long in vain
EXPLAINED = 0.75  # mean R² of the channels from which on a fit needs no segments; noise alone may make that of one small
SAMPLES = 10  # in a segment at least, where their number is not given,
SEGMENTS = 20  # and as many of them at most
AT_BOUND = 0.01  # margins from its bound; an estimate that is closer is moved inside
MARGIN = 0.1  # of the distance between the bounds, or of the size of the parameter: how far inside at most, or where no error is known
ALIKE = 1e-3  # of -2 log likelihood: fits that differ by less say the same, and the last is one of whole motions


@dataclasses.dataclass(frozen=True)
class Regress:
    """Finds a start for a fit (`start=`) that has a poor one: by `regress`, which needs none; then by fitting the whole motion; and, if
    that does not explain the measurements, by segments (multiple shooting) and the whole motion from there.

    The most likely of these fits is returned, and its card says what was done. An estimate of `regress` at a bound is moved inside by its
    standard error.

    Where the motion from there does not explain the measurements, the given start is tried, too.

    - `segments`: the number of segments of each record; by default 20, or fewer if they would have less than ten samples.
    - `width`: of the windows of `regress`, a time in the unit of the samples; by default chosen from the data.

    **Raises:** `ValueError` if `segments` is not a whole number from 2 on.

    **Source:** Bock, Recent advances in parameter identification techniques for o.d.e. (1983).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    ts = jnp.linspace(0.0, 30.0, 300)
    record = jl.Experiment(ts, jnp.cos(2.0 * ts), q0=1.0, qdot0=0.0)
    jl.fit(oscillator, record, {"c": 30.0}, free=("c",), start=jl.Regress()).estimates["c"]  # 4.0
    ```
    """

    segments: int | None = None
    width: float | None = None

    def __post_init__(self) -> None:
        if self.segments is not None:
            count(self.segments, "`segments`", least=2, cure="Use some tens for a long or chaotic record.")


@dataclasses.dataclass(frozen=True)
class MultiStart:
    """Several starts for a fit (`start=`), tried in one batch: the given one and random ones.

    They are uniform between two bounds; without both, they are typically a factor of two away and keep their sign. The fit with the lowest
    cost is returned.

    - `count`: how many, the given one among them.

    **Raises:** `ValueError` if `count` is not a whole number from 2 on.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    ts = jnp.linspace(0.0, 3.0, 50)
    record = jl.Experiment(ts, jnp.cos(2.0 * ts), q0=1.0, qdot0=0.0)
    jl.fit(oscillator, record, {"c": 30.0}, free=("c",), bounds={"c": (0, 60)}, start=jl.MultiStart(16)).estimates["c"]  # 4.0
    ```
    """

    count: int = 16

    def __post_init__(self) -> None:
        count(self.count, "`count`", least=2, cure="Use some tens for a poor initial guess.")


@dataclasses.dataclass
class Escalation:
    """The fits on the way from a poor start, and the log of what was done.

    `fit_from(experiments, params, max_steps, segments)` is a fit.
    """

    fit_from: Callable[..., Fit]
    log: list[str] = dataclasses.field(default_factory=list)
    fits: list[Fit] = dataclasses.field(default_factory=list)

    def attempt(self, name: str, *where: Any, **more: Any) -> Fit | None:
        """One more fit, unless there is no motion from there."""
        try:
            found = self.fit_from(*where, **more)
        except NoMotion:
            self.log.append(f"{name}: could not be computed")
            return None
        self.log.append(f"{name}: {found.steps} steps{'' if found.converged else ', not converged'}")
        self.fits.append(found)
        return found

    def best(self) -> Fit:
        """The most likely of them, with the log."""
        if not self.fits:
            raise NoMotion("`start` must lead to a motion that can be computed, but none could. Give other `params`, or more segments.")
        misfits = [np.nan_to_num(fit.neg2_log_likelihood, nan=np.inf) for fit in self.fits]
        best = [fit for fit, misfit in zip(self.fits, misfits, strict=True) if misfit <= min(misfits) + ALIKE][-1]
        chosen = [] if best is self.fits[-1] else [f"the best of them is number {self.fits.index(best) + 1}"]
        return dataclasses.replace(best, start_log=(*self.log, *chosen))


def _segments(start, system, experiments):
    """Their number; 1 where the records are too short, or cannot be cut."""
    if system.states or system.events or system.unilateral or not all(map(can_be_cut, experiments)):
        return 1
    shortest = min(e.ts.size for e in experiments)
    count = start.segments or min(SEGMENTS, shortest // SAMPLES)
    return count if count <= shortest // FEWEST else 1


def _through_segments(way, segments, experiments, params, given, most):
    """The whole motion from `params`, the estimates of a regression, and from those `given`; then segments, and the whole motion again."""
    found = way.attempt("whole motion", experiments, params, max_steps=min(most, FIRST_STEPS))
    if not (found and _explains(found)):
        other = way.attempt("whole motion from the given start", experiments, given, max_steps=min(most, FIRST_STEPS))
        found = other if other and _explains(other) else found
    if segments > 1 and not (found and _explains(found)):
        found = way.attempt(f"{segments} segments", experiments, params, max_steps=most, segments=segments)
        if found:
            way.attempt("whole motion", found.experiments, found.params, max_steps=most)
    else:
        _on(way, found, most)


def _on(way, found, most):
    """The rest of the steps, where the first ones did not suffice."""
    if found and found.reason == REASONS[STEP_LIMIT] and most > FIRST_STEPS:
        way.attempt("whole motion", found.experiments, found.params, max_steps=most - FIRST_STEPS)


def _explains(fit):
    return np.mean([channel.r_squared for channel in fit.channels]) >= EXPLAINED


def inside_bounds(found: Regression, free: str | Sequence[str], bounds: Any) -> tuple[PyTree, str]:
    """The parameters found, those at a bound moved inside; and words for what was done."""
    chosen = Free.of(found.params, free, bounds)
    flat = lambda tree: np.concatenate([np.ravel(np.asarray(x)) for name in chosen.names for x in jax.tree.leaves(tree[name])])
    errors, theta, moves = flat(found.standard_errors), np.array(chosen.start), []
    for i, name in enumerate(chosen.entries):
        lower, upper = float(chosen.lower[i]), float(chosen.upper[i])
        most = MARGIN * min(upper - lower, max(abs(theta[i]), 1.0)) if np.isinf(errors[i]) else MARGIN * (upper - lower)
        margin = min(errors[i], most) or MARGIN
        moved = np.clip(theta[i], lower + AT_BOUND * margin, upper - AT_BOUND * margin)
        if moved != theta[i]:
            bound = lower if moved > theta[i] else upper
            theta[i] = bound + np.copysign(margin, moved - theta[i])
            moves.append(f"{name} moved inside from its bound {bound:g} to {theta[i]:.3g}")
    moved_inside = f" ({'; '.join(moves)})" if moves else ""
    return chosen.insert(np.asarray(theta, chosen.start.dtype)), f"regress{moved_inside}"


def from_better_start(
    fit_from: Callable[..., Fit],
    system: System,
    experiments: Sequence[Experiment],
    params: PyTree,
    start: Any,
    max_steps: int,
    first: Fit | None = None,
    **common: Any,
) -> Fit:
    """The fit that `start` leads to. `fit_from(experiments, params, max_steps, segments, **common)` is one from parameters alone; `first`:
    that from the given ones, if there is one already.
    """
    if not isinstance(start, Regress):
        raise ValueError(f"`start` must be `Regress()`, `MultiStart()`, 'auto' or None, but is {start!r}. Write `start=jl.Regress()`.")
    experiments, params = validate_inputs(experiments, params)
    found = regress(system, experiments, params, width=start.width, **common)
    inside, done = inside_bounds(found, **common)
    way = Escalation(fit_from)
    if first is not None:  # segments may take long: only where asked for
        way = Escalation(fit_from, [f"whole motion from the given start: {first.steps} steps, explaining too little", done], [first])
        _on(way, way.attempt("whole motion", experiments, inside, max_steps=min(max_steps, FIRST_STEPS)), max_steps)
        return way.best()
    way.log.append(done)
    chosen = Free.of(params, **common)
    given = chosen.insert(jnp.where(np.isnan(chosen.start), Free.of(inside, **common).start, chosen.start))
    _through_segments(way, _segments(start, system, experiments), experiments, inside, given, max_steps)
    return way.best()


def without_unknown(
    system: System, experiments: Sequence[Any], params: PyTree, free: str | Sequence[str], bounds: Mapping[str, Any] | None
) -> tuple[PyTree, tuple[str, ...]]:
    """The parameters, where free ones that are NaN come from `regress`; and what was done."""
    if not any(map(is_unknown, jax.tree.leaves(params))):
        return params, ()
    chosen = Free.of(params, free, bounds)
    unknown = np.isnan(chosen.start)
    if not np.any(unknown):
        return params, ()
    if split_by_kind(experiments)[1]:
        name = chosen.entries[int(np.argmax(unknown))]
        raise ValueError(
            f"`params` must have a start for each free entry where modes or frequency responses are fitted, but {name!r} is NaN. "
            "Give a guess, or take it from `regress` with the recordings."
        )
    found = regress(system, experiments, params, free=free, bounds=bounds)
    inside, done = inside_bounds(found, free, bounds)
    return chosen.insert(jnp.where(unknown, Free.of(inside, free).start, chosen.start)), (done,)


def explains_too_little(found: Fit) -> bool:
    """Whether a fit is hardly one: at its minimum the model explains nothing, or little where the iteration did not find a minimum."""
    if (found.absolute and found.sigma <= UNEXPLAINED) or found.reason == REASONS[INTERRUPTED]:
        return False
    return bool(unexplained(found.channels)) or not (found.converged or _explains(found))
