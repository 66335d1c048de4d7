"""Least squares in the equations of motion, integrated over windows of one width."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from .identifiability import determined_by
from .levenberg_marquardt import levenberg_marquardt
from .parameters import Free
from .weak_form import Record
from .window_scatter import COLOUR, OVERLAP, scatter
from .windows import APART

TINY = 1e-20  # of a term: its variation counts as none
CANCELLED = 1e4  # roundings of terms that are subtracted, integrated over windows in which they cancel
ROUNDING = 1e-9  # of the terms of an equation, what is left of them
ROUNDS = 3  # of weighting the equations by their residuals


class Estimate(NamedTuple):
    """y from so many `windows`, and its standard errors: infinite where y is not determined.

    `spare`: how many windows could be left out if none overlapped and y were to be determined still. `explained`: the logarithm of
    how much larger the variations of the known terms are than the residuals, on average over the equations.
    """

    half: float
    near_rest: float  # the largest part of a window that was near rest
    y: np.ndarray
    errors: np.ndarray
    windows: int
    spare: float
    explained: float

    @property
    def intervals(self) -> np.ndarray:
        """Half the lengths of the 95 % intervals, by the distribution of Student: long where there are few windows."""
        from scipy import special  # SciPy is a dependency of JAX; imported here because that takes a while

        return special.stdtrit(self.spare, 0.975) * self.errors


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """Records and the free parameters; `terms` of a record at y, with their Jacobian; whether they are `linear` in y."""

    records: Sequence[Record]
    free: Free
    linear: bool
    terms: Sequence[Callable[[Any], tuple[np.ndarray, np.ndarray]]]

    @classmethod
    def of(cls, records: Sequence[Record], free: Free, linear: bool) -> "Problem":
        """Where they are linear, the records are evaluated once."""
        return cls(records, free, linear, [_terms(record, free, linear) for record in records])

    def estimate(self, half: float, near_rest: float, y: np.ndarray) -> Estimate | None:
        """From windows of this half width, of which no larger part is near rest; None where there are fewer than parameters."""
        windows = [record.windows(half) for record in self.records]
        used = [w.near_rest <= near_rest for w in windows]
        residuals = self._integrated(windows, used)
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
        errors = self._errors(parts, weights, windows, used)
        return Estimate(half, near_rest, y, errors, count, spare, self._explained(parts, weights, y) + np.log(spare / (APART * count)))

    def _integrated(self, windows, used):
        """The residuals of the windows that are used, (K, n + m) for each record, and their Jacobian, as a function of y."""

        def at(y):
            return [
                tuple(w.integrals(*record.parts(x))[u] for x in terms(y))
                for record, terms, w, u in zip(self.records, self.terms, windows, used, strict=True)
            ]

        if not self.linear:
            return at
        origin = at(np.zeros(self.free.size))
        return lambda y: [(r + J @ y, J) for r, J in origin]

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
        return np.asarray(self.free.theta(jnp.asarray(y)) / self.free.slope(jnp.asarray(y)))

    def _explained(self, parts, weights, y):
        """Terms without a free parameter against the residuals, whose size is one over the weight."""
        here = self._from_zero(y)
        known = [(r - J @ here) * w for (r, J), w in zip(parts, weights, strict=True)]
        varies = np.mean([np.var(x, axis=0) for x in known if len(x)], axis=0)
        there = varies > TINY * np.mean([np.mean(x**2, axis=0) for x in known if len(x)], axis=0)
        return float(np.mean(np.log(varies[there]))) if there.any() else 0.0

    def _errors(self, parts, weights, windows, used):
        """Standard errors by the scatter of the windows."""
        known = determined_by(_stacked(parts, weights)[1], np.zeros((0, self.free.size)))
        spread, lags = [], []
        for (r, J), weight, record, w, u in zip(parts, weights, self.records, windows, used, strict=True):
            all_r, all_J = np.zeros((u.size, *r.shape[1:])), np.zeros((u.size, *J.shape[1:]))
            all_r[u], all_J[u] = r * weight, J * weight[:, None]
            spread.append((all_r, all_J))
            correlated = max(OVERLAP * w.half, COLOUR * (record.span[1] - record.span[0]))
            lags.append(1 + int(np.ceil(correlated / (APART * w.half))))
        return np.where(known.determined, np.sqrt(np.diag(scatter(known.covariance, spread, lags))), np.inf)


def _terms(record, free, linear):
    if not linear:
        return lambda y: record.form.linearised(free, jnp.asarray(y))
    value, J = record.form.linearised(free, jnp.zeros(free.size))
    return lambda y: (value + J @ y, J)


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
