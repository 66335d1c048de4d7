"""Least squares in the equations of motion, integrated over windows of one width."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from .._model.numbers import number
from .identifiability import determined_by
from .levenberg_marquardt import levenberg_marquardt
from .parameters import Free
from .weak_form import Record
from .windows import APART, COLOUR, OVERLAP, scatter

CANCELLED = 1e4  # roundings of terms that are subtracted, integrated over windows in which they cancel
ROUNDING = 1e-9  # of the terms of an equation, what is left of them
ROUNDS = 3  # of weighting the equations by their residuals
ENOUGH = 1000  # windows of a record, by which an estimate is judged


class Estimate(NamedTuple):
    """y from so many `windows`, its covariance, and its standard errors: infinite where y is not determined.

    `null`: the changes of y that do not show, (p, k), with an error `noise`. `spare`: how many windows could be left out if none overlapped
    and y were to be determined still. `as_good`: estimates from other windows that predict as well.
    """

    half: float
    near_rest: float  # the largest part of a window that was near rest
    y: np.ndarray
    covariance: np.ndarray
    errors: np.ndarray
    null: np.ndarray
    noise: float
    windows: int
    spare: float
    as_good: tuple["Estimate", ...] = ()


@dataclasses.dataclass(frozen=True, eq=False)
class WeakFormProblem:
    """Records and the free parameters; `terms` of a record at y, with their Jacobian; whether they are `linear` in y; what is `kept` of
    the windows of each width.
    """

    records: Sequence[Record]
    free: Free
    linear: bool
    terms: Sequence[Callable[[Any], tuple[np.ndarray, np.ndarray]]]
    kept: dict[float, tuple] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(cls, records: Sequence[Record], free: Free, linear: bool) -> "WeakFormProblem":
        """Where they are linear, the records are evaluated once."""
        return cls(records, free, linear, [_terms(record, free, linear) for record in records])

    def estimate(self, half: float, near_rest: float, y: np.ndarray) -> Estimate | None:
        """From windows of this half width, of which no larger part is near rest; None where there are fewer than parameters."""
        windows, used, residuals = self._integrated(half, near_rest)
        parts = residuals(y)
        count, equations = sum(len(r) for r, _ in parts), self.records[0].form.motion[0].shape[1]
        spare = max(APART * count - self.free.size / equations, APART)
        if sum(r.size for r, _ in parts) < self.free.size:
            return None
        sizes = [self._sizes(r, J, y) for r, J in parts]
        weights = [_one_over(size, size) for size in sizes]
        for _ in range(ROUNDS):
            y = (self._solve_linear if self.linear else self._solve_nonlinear)(residuals, weights, y)
            parts = residuals(y)
            weights = [_one_over(_rms(r), size) for (r, _), size in zip(parts, sizes, strict=True)]
        known = self._known(parts, weights, windows, used)
        errors = np.where(known.determined, np.sqrt(np.maximum(np.diag(known.covariance), 0)), np.inf)
        return Estimate(half, near_rest, y, known.covariance, errors, known.null, known.noise, count, spare)

    def unexplained(self, half: float, near_rest: float, found: Estimate) -> np.ndarray:
        """For each equation the mean square of its residuals with an estimate from windows of any width, and the variance by the error
        of the estimate, over the mean square of its terms, (n + m,).
        """
        parts = [tuple(x[:: max(len(x) // ENOUGH, 1)] for x in part) for part in self._integrated(half, near_rest)[2](found.y)]
        r, J = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
        variance = np.einsum("kcp,pq,kcq->c", J, found.covariance, J, optimize=True) / len(J)
        size = self._sizes(r, J, found.y)
        return (_rms(r) ** 2 + variance) / np.where(size > 0, size, 1) ** 2

    def blocks(self, found: Estimate, count: int) -> list[tuple[np.ndarray, np.ndarray, float]]:
        """JᵀJ, Jᵀr and rᵀr of so many parts of the records, in the windows of an estimate; J by the free parameters, r where they are 0.

        Equations count by the size of their terms: by their residuals, one that has none but free terms would have them all zero.
        """
        nothing, scale, blocks = -np.asarray(self.free.start / self.free.scale), np.asarray(self.free.scale), []
        for r, J in self._integrated(found.half, found.near_rest)[2](nothing):
            n, size = self.records[0].form.motion[0].shape[1], self._sizes(r, J, nothing)
            weight = _one_over(size, size)[:n]  # of the equations of motion; those of constraints know no forces
            rows, slopes = r[:, :n] * weight, J[:, :n] * weight[:, None] / scale
            for part in np.array_split(np.arange(len(r)), -(-count // len(self.records))):
                A, b = slopes[part].reshape(-1, J.shape[2]), rows[part].ravel()
                blocks.append((A.T @ A, A.T @ b, float(b @ b)))
        return blocks

    def jacobian(self, y: np.ndarray, found: Estimate) -> np.ndarray:
        """Of the residuals at y in the windows of an estimate, over the size of their terms."""
        parts = self._integrated(found.half, found.near_rest)[2](y)
        sizes = [self._sizes(r, J, y) for r, J in parts]
        return _stacked(parts, [_one_over(size, size) for size in sizes])[1]

    def _integrated(self, half, near_rest):
        """The windows of each record; which of them are used; their residuals, (K, n + m) for each record, and the Jacobian of these, as
        a function of y.
        """
        if half not in self.kept:
            self.kept[half] = self._of_all_windows(half)
        windows, residuals = self.kept[half]
        used = [w.near_rest <= near_rest for w in windows]
        return windows, used, lambda y: [(r[u], J[u]) for (r, J), u in zip(residuals(y), used, strict=True)]

    def _of_all_windows(self, half):
        """Of linear equations the integrals are kept, and not the sums by which they are found."""
        windows = [record.windows(half) for record in self.records]

        def at(y):
            along = zip(self.records, self.terms, windows, strict=True)
            return [tuple(w.integrals(*record.parts(x)) for x in terms(y)) for record, terms, w in along]

        if self.linear:
            origin = at(np.zeros(self.free.size))
            return [w.without_sums() for w in windows], lambda y: [(r + J @ y, J) for r, J in origin]
        begin = self._scales(np.zeros(self.free.size), half)[0]
        return windows, lambda y: [_over(begin, *self._scales(y, half), *part) for part in at(y)]

    def _solve_linear(self, residuals, weights, y):
        """In one step; what is not determined keeps its value."""
        from scipy import optimize  # SciPy is a dependency of JAX; imported here because that takes a while

        r, J = _compressed(residuals(y), weights)
        size = np.linalg.norm(J, axis=0)
        scale = np.where(size > 0, 1 / np.where(size > 0, size, 1), 1)
        step = scale * np.linalg.lstsq(J * scale, -r, rcond=1e-9)[0]
        lower, upper = (np.asarray(bound) for bound in self.free.bounds)
        if np.all((lower <= y + step) & (y + step <= upper)):
            return y + step
        bounded = optimize.lsq_linear(J * scale, -r, ((lower - y) / scale, (upper - y) / scale), method="bvls")
        return np.clip(y + scale * bounded.x, lower, upper)

    def _solve_nonlinear(self, residuals, weights, y):
        linearise = lambda y: (*map(jnp.asarray, _compressed(residuals(np.asarray(y)), weights)), ())
        freedom = sum(int(np.prod(r.shape)) for r, _ in residuals(y))
        found = levenberg_marquardt(linearise, jnp.asarray(y), freedom=freedom, max_steps=100, tolerance=1e-3, bounds=self.free.bounds)
        return np.asarray(found.best.y)

    def _scales(self, y, half):
        """The size of the terms of each equation of motion, of momentum over half a window and force, (n,), and its slope, (n, p)."""
        square, slope = 0.0, 0.0
        for record, terms in zip(self.records, self.terms, strict=True):
            value, J = terms(y)
            for x, dx, unit in zip(record.parts(value)[:2], record.parts(J)[:2], (half, 1.0), strict=True):
                square = square + np.mean(x**2, axis=0) / unit**2
                slope = slope + np.mean(x[:, :, None] * dx, axis=0) / unit**2
        size = np.sqrt(np.where(square > 0, square, 1))
        return size, slope / size[:, None]

    def _sizes(self, r, J, y):
        """Of the terms of each equation, (n + m,), in its unit. Where the equations are linear, of those without a free parameter, and of
        the others with parameters as large as they can be beside these: a start, which may be 1 in any unit, has no part in it.
        """
        if not self.linear:
            return _rms(np.abs(r) + np.linalg.norm(J, axis=2))
        here, slopes = self._from_zero(y), _rms(J)
        size = _rms(r - J @ here)
        eps = np.finfo(self.records[0].form.nodes.dtype).eps
        size = np.where(size > CANCELLED * eps * (slopes @ np.abs(here)), size, 0)  # rounding is no term
        for _ in range(self.free.size):
            ratio = np.where((size[:, None] > 0) & (slopes > 0), size[:, None] / np.where(slopes > 0, slopes, 1), np.inf)
            most = np.min(ratio, axis=0, initial=np.inf)
            size = np.where(size > 0, size, np.max(slopes * np.where(np.isfinite(most), most, 0), axis=1, initial=0.0))
        return size

    def _from_zero(self, y):
        """y as counted from where all free parameters are zero."""
        return np.asarray(self.free.start / self.free.scale) + y

    def _known(self, parts, weights, windows, used):
        """What is determined, with a covariance by the scatter of the windows."""
        known = determined_by(_stacked(parts, weights)[1], np.zeros((0, self.free.size)))
        spread, lags = [], []
        for (r, J), weight, record, w, u in zip(parts, weights, self.records, windows, used, strict=True):
            all_r, all_J = np.zeros((u.size, *r.shape[1:])), np.zeros((u.size, *J.shape[1:]))
            all_r[u], all_J[u] = r * weight, J * weight[:, None]
            spread.append((all_r, all_J))
            correlated = max(OVERLAP * w.half, COLOUR * (record.span[1] - record.span[0]))
            lags.append(1 + int(np.ceil(correlated / (APART * w.half))))
        return known._replace(covariance=scatter(known.covariance, spread, lags))


def _terms(record, free, linear):
    if not linear:
        last: dict[bytes, tuple] = {}

        def at(y):
            key = np.asarray(y).tobytes()
            if key not in last:
                last.clear()
                last[key] = record.form.linearised(free, jnp.asarray(y))
            return last[key]

        return at
    value, J = record.form.linearised(free, jnp.zeros(free.size))
    return lambda y: (value + J @ y, J)


def _over(begin, size, slope, r, J):
    """Residuals over the size of the terms, in units of that at the start: parameters for which all terms vanish solve no equation."""
    n = len(size)
    ratio, falls = np.ones(r.shape[1]), np.zeros(J.shape[1:])
    ratio[:n], falls[:n] = begin / size, slope / size[:, None]
    return r * ratio, (J - r[:, :, None] * falls) * ratio[:, None]


def _rms(x):
    """Over the windows; zero of none."""
    return np.sqrt(np.mean(x**2, axis=0)) if len(x) else np.zeros(x.shape[1:])


def _one_over(rms, size):
    """For each equation, (n + m,); residuals of next to nothing of its terms are rounding."""
    least = np.maximum(rms, ROUNDING * size)
    return 1 / np.where(least > 0, least, 1)


def _stacked(parts, weights):
    """All weighted residuals, and their Jacobian."""
    r = np.concatenate([(r * w).ravel() for (r, _), w in zip(parts, weights, strict=True)])
    J = np.concatenate([(J * w[:, None]).reshape(-1, J.shape[2]) for (_, J), w in zip(parts, weights, strict=True)])
    return r, J


def _compressed(parts, weights):
    """Residuals of the same size and slope, in at most p + 1 rows: the shape does not depend on the number of windows."""
    r, J = _stacked(parts, weights)
    p = J.shape[1]
    R = np.zeros((p + 1, p + 1))
    found = np.linalg.qr(np.column_stack([J, r]), mode="r")
    R[: len(found)] = found
    return R[:, p], R[:, :p]


GROWTH = 1.4  # from one width to the next that is tried
WIDEST = 0.25  # half a window, as a part of the longest record
NARROWEST = 2.0  # intervals between samples in half a window
SPARE = 3  # windows that do not overlap, beyond those needed, from which on standard errors can be trusted
SLIDING, REVERSING = 0.0, 0.4  # the largest part of a window near rest: where friction slides, and where it may reverse
NEGLIGIBLE = 0.003  # of the size of an equation's terms: residuals below it count as that
EQUAL = 0.999  # of the signal-to-noise ratio of the best: estimates that predict the same, among which standard errors decide
ALIKE = 0.8  # of the signal-to-noise ratio of the best: estimates that predict as well, whose scatter is part of its error


def best_estimate(problem: WeakFormProblem, halves: np.ndarray) -> Estimate | None:
    """The best estimate from windows of these half widths, the widest first; None where windows are too few.

    In narrow windows the noise is large, in windows of many oscillations the terms average to nothing; in both cases noise in the motion
    draws estimates towards zero. In windows of steady motion some terms do not vary. In those where friction sticks its force is
    unknown. Standard errors of one width know nothing of all that, but windows of other widths contradict it. So the best estimate is
    the one with the largest ratio of signal to noise on average over all widths: of the terms of the equations to what is left of them,
    to which the error of the prediction is added; of those that predict the same, the one with the smallest standard errors. Where
    estimates that are as good scatter by more than their standard errors allow, as they do where the model misses something, the error
    grows by that scatter.

    **Source:** Stone, J. R. Stat. Soc. B 36 (1974) 111 (choice by prediction); Hausman, Econometrica 46 (1978) 1251 (the variance of the
    difference of two estimates).
    """
    slides = all(np.all(record.moves) for record in problem.records)
    tried: list[Estimate] = []
    for near_rest in (SLIDING,) if slides else (SLIDING, REVERSING):
        y = tried[-1].y if tried else np.zeros(problem.free.size)
        for half in halves:
            found = problem.estimate(half, near_rest, y)
            if found is not None:
                y = found.y
                tried.append(found)
    sure = [found for found in tried if found.spare >= SPARE]
    if not sure:
        return tried[-1] if tried else None
    fewest = min(_undetermined(found) for found in sure)
    sure = [found for found in sure if _undetermined(found) == fewest]
    windows = [(found.half, found.near_rest) for found in sure]
    ratios = np.array([_signal_to_noise(problem, found, windows) for found in sure])
    equal = [found for found, ratio in zip(sure, ratios, strict=True) if ratio >= EQUAL * np.max(ratios)]
    best = min(equal, key=_volume)
    as_good = [found for found, ratio in zip(sure, ratios, strict=True) if ratio >= ALIKE * np.max(ratios)]
    return best._replace(errors=with_scatter(best.y, best.errors, [(one.y, one.errors) for one in as_good]), as_good=tuple(as_good))


def half_widths(records: Sequence[Record], width: float | None = None) -> np.ndarray:
    """Half widths that are tried, the widest first: half of the given one, where there is one."""
    longest = max(float(record.span[1] - record.span[0]) for record in records)
    if width is not None:
        width = float(number(width, "`width`", cure="Give the width of the windows, a time."))
        if not 0 < width <= longest:
            raise ValueError(
                f"`width` must be positive and at most the length of the longest record, {longest:g}, but is {width:g}. "
                "Give the width of the windows, a time, or leave it out."
            )
        return np.array([width / 2])
    shortest = NARROWEST * min(record.interval for record in records)
    count = max(int(np.log(WIDEST * longest / shortest) / np.log(GROWTH)) + 1, 1)
    return WIDEST * longest / GROWTH ** np.arange(count)


def _volume(found):
    """Of the errors of what is determined, as a logarithm: any unit does."""
    return float(np.sum(np.log(np.maximum(found.errors[np.isfinite(found.errors)], np.finfo(float).tiny))))


def _undetermined(found):
    return int(np.sum(np.isinf(found.errors)))


def _signal_to_noise(problem, found, windows):
    """On average over all windows and the equations; of those in which nothing is explained it is one."""
    left = np.array([problem.unexplained(*which, found) for which in windows])
    return float(np.mean(1 / np.sqrt(np.minimum(left, 1) + NEGLIGIBLE**2)))


def with_scatter(value: Any, error: Any, others: Sequence[tuple[Any, Any]]) -> Any:
    """The standard error, with the median square by which others, (value, error), differ beyond the difference of their variances."""
    known = np.isfinite(error)
    square = lambda error: np.where(known, error, 0) ** 2
    excess = [np.maximum((other - value) ** 2 - np.abs(square(its_error) - square(error)), 0) for other, its_error in others]
    return np.sqrt(error**2 + np.where(known, np.median(excess, axis=0), 0)) if others else error
