"""The motion behind a recording without the equations of motion: splines fitted to what the sensors saw."""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._model.injection import call
from .._model.paths import is_within
from .._program.jit import jitted
from .experiment import Experiment, start_entries, with_own
from .residuals import ALL, delays_of

DEGREE = 5  # accelerations are twice differentiable
MOST_INTERVALS = 0.65  # of the samples
MOST_COEFFICIENTS = 0.7  # of the measurements
ITERATIONS = 8  # of Gauss and Newton, where sensors are not linear in the motion
START_WEIGHT = 1e3  # of the known start, relative to the sensors
REWEIGHTED = 2  # times, where channels have no sigma
KINKED = 2  # times, where the acceleration may jump: at kinks of the motion found without them, and of that with them
RESOLVED = 1e-6  # of the spread of a channel: no sensor is trusted more
PENALTY = 1e-6  # of differences of third order, relative to the sensors: decides only where nothing is measured


class Smooth(NamedTuple):
    """A motion at T times: positions, velocities and accelerations, flat, (T, n) each."""

    ts: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray


def smooth(
    experiment: Experiment, params: Any, at: np.ndarray | None = None, kinks_of: Callable[[Smooth], np.ndarray] | None = None
) -> Smooth:
    """The motion at the times `at`, by default at the samples.

    Splines of degree five, fitted by least squares to what the sensors saw. Generalised cross-validation chooses how many intervals
    between knots there are. Channels without `sigma` are weighted by their residuals. A known start is kept; where no sensor tells, the
    splines are as smooth as possible. `kinks_of` a motion are the times at which its acceleration may jump; if splines that can do so
    have the better score, they are taken.

    **Source:** Craven & Wahba, Numer. Math. 31 (1979) 377-403; de Boor, A Practical Guide to Splines, chapter XIV.
    """
    ts = np.asarray(experiment.ts)
    sensors = _Sensors(experiment, with_own(params, experiment.params))
    score, splines, C = _cross_validated(sensors, ts)
    for _ in range(REWEIGHTED if experiment.sigma is None and sensors.channels > 1 else 0):
        if not sensors.weigh(splines, C):
            break
        score, splines, C = _cross_validated(sensors, ts)
    at = ts if at is None else at
    motion = lambda splines, C: Smooth(at, *(splines.motion(at, C, d) for d in range(3)))
    for _ in range(KINKED):
        kinks = np.zeros(0) if kinks_of is None else kinks_of(motion(splines, C))
        other = _cross_validated(sensors, ts, kinks) if kinks.size else (np.inf, splines, C)
        if other[0] >= score:
            break
        score, splines, C = other
    return motion(splines, C)


def without_delay(e: Experiment, params: Any) -> Experiment:
    """The same measurements at the times of what they show, those of one delay after those of another; without the ones that show the
    start only because the delay had not passed.
    """
    late = {name: float(delay) for name, delay in delays_of(e, with_own(params, e.params)).items()}
    if not late:
        return e
    if not np.all(np.isfinite(list(late.values()))):
        raise ValueError("`delay` must be known where the motion is read off the measurements, but is NaN. Give its parameters a value.")
    ts, paths = np.asarray(e.ts), jax.tree_util.tree_flatten_with_path(e.values)[0]
    by_leaf = [late[ALL] if ALL in late else late.get(path[0].key, 0.0) for path, _ in paths]
    shifts = sorted(set(by_leaf))
    times = np.concatenate([ts[:1], *(ts - shift for shift in shifts)])
    order = np.argsort(np.where(times >= ts[0], times, np.inf), kind="stable")[: np.count_nonzero(times >= ts[0])]

    def moved(x, shift, padding):
        rows = [np.full((1, *x.shape[1:]), padding)] + [np.asarray(x) if shift == one else np.full(x.shape, padding) for one in shifts]
        return np.concatenate(rows)[order]

    of_leaves = lambda tree, padding: jax.tree.unflatten(
        jax.tree.structure(e.values), [moved(x, shift, padding) for x, shift in zip(jax.tree.leaves(tree), by_leaf, strict=True)]
    )
    sigma = None if e.sigma is None else of_leaves(e.sigma, 1.0)
    values = of_leaves(e.values, np.nan)
    return Experiment(times[order], values, e.q0, e.qdot0, observe=e.observe, sigma=sigma, params=e.params, unknown=e.unknown)


def _cross_validated(sensors, ts, kinks=()):
    """The least score, the splines that have it, and their coefficients."""
    measured = int(np.sum(np.isfinite(sensors.measured)))
    most = max(4, int(MOST_INTERVALS * min(len(np.unique(ts)), measured / sensors.n)))
    found = {}

    def attempt(intervals):
        splines = _Splines(ts, intervals, kinks)
        C, squares = _fitted(sensors, splines)
        if C.size < MOST_COEFFICIENTS * measured:
            found[squares * measured / (measured - C.size) ** 2] = splines, C

    for doubled in range(2, int(np.log2(most)) + 1):
        attempt(2**doubled)
    if not found:
        splines = _Splines(ts, 1)
        return np.inf, splines, _fitted(sensors, splines)[0]
    best = found[min(found)][0].intervals
    for between in (best / 2**0.5, min(best * 2**0.5, most)):
        if 4 <= between <= most:
            attempt(int(between))
    return min(found), *found[min(found)]


class _Sensors:
    """What is measured, flat: channels h(t, q, v, a) with weights, and the known part of the start."""

    def __init__(self, e, params):
        q0, unravel = ravel_pytree(e.q0)
        v0 = ravel_pytree(e.qdot0)[0]
        self.n = q0.size
        entries = start_entries(e)
        self.start = np.concatenate([q0, v0])
        self.known = np.array([not any(is_within(entry, name) for name in e.unknown) for entry in entries])
        flat = lambda tree: np.concatenate([np.reshape(x, (e.ts.size, -1)) for x in jax.tree.leaves(tree)], axis=1).astype(float)
        self.measured = flat(e.values)
        self.channels = self.measured.shape[1]
        self.weights = 1 / (flat(e.sigma) if e.sigma is not None else _spread(self.measured))

        def channels(t, x):
            q, v, a = (unravel(part) for part in jnp.split(x, 3))
            return ravel_pytree(call(e.observe, "`observe`", params, t=t, q=q, qdot=v, qddot=a, multipliers=_UnknownForces()))[0]

        both = lambda t, x: (channels(t, x), jax.jacfwd(channels, argnums=1)(t, x))
        self._linearised = jitted(jax.vmap(both))

    def residuals(self, ts, motion):
        """Weighted residuals (T, channels) and the Jacobian of what is seen in (q, v, a); zero where nothing was measured."""
        h, J = (np.asarray(x) for x in self._linearised(jnp.asarray(ts), jnp.asarray(np.concatenate(motion, axis=1))))
        there = np.isfinite(self.measured) & np.isfinite(h)
        if not there.any():
            raise ValueError(
                "`observe` must see positions, velocities or accelerations, but sees none. Measure some, or simulate by `fit`."
            )
        weights = np.where(there, self.weights, 0)
        r = np.where(there, self.measured - h, 0) * weights
        return r, np.where(there[:, :, None], J, 0) * weights[:, :, None]

    def weigh(self, splines, C):
        """Weighs each channel by one over the size of its residuals; whether that changed their ratios by more than a tenth."""
        h, _ = self._linearised(jnp.asarray(splines.ts), jnp.asarray(np.concatenate(splines.motions(C), axis=1)))
        off = self.measured - np.asarray(h)
        rms = lambda x: np.sqrt(_mean(np.where(np.isfinite(off), x, np.nan) ** 2))
        rounding = np.finfo(off.dtype).eps * rms(self.measured)
        size = np.maximum(rms(off), np.maximum(RESOLVED * _deviation(self.measured), rounding))
        change = self.weights[0] * np.where(size > 0, size, 1)
        self.weights = self.weights / change
        return np.max(change) > 1.1 * np.min(change)


def _spread(measured):
    """The standard deviation of each channel, in its unit; one where nothing changes."""
    deviation = _deviation(measured)
    return np.broadcast_to(np.where(deviation > 0, deviation, 1), measured.shape)


def _deviation(measured):
    return np.sqrt(_mean((measured - _mean(measured)) ** 2))


def _mean(x):
    """Of each channel, of what was measured."""
    there = np.isfinite(x)
    return np.sum(np.where(there, x, 0), axis=0) / np.maximum(np.sum(there, axis=0), 1)


class _UnknownForces(dict):
    """Constraint forces, which a spline does not know: a channel that uses them counts as missing."""

    def __missing__(self, name):
        return jnp.nan


class _Splines:
    """A basis of splines whose knots are quantiles of the times; values and derivatives are B_d C with coefficients C (splines, n).

    At a kink there are so many knots that the second derivative may jump; in between they are equally spaced.
    """

    def __init__(self, ts, intervals, kinks=()):
        times = np.unique(ts)
        ends = _apart(np.interp(kinks, times, np.linspace(0, 1, times.size)), 1 / intervals)
        pieces = [np.linspace(*piece, max(round(intervals * (piece[1] - piece[0])), 1) + 1) for piece in itertools.pairwise(ends)]
        levels = np.concatenate([ends[:1], *(piece[1:] for piece in pieces), np.repeat(ends[1:-1], DEGREE - 2)])
        knots = np.quantile(times, np.sort(levels))
        self.ts, self.intervals, self.interval = ts, intervals, (ts[-1] - ts[0]) / intervals
        self.knots = np.concatenate([np.full(DEGREE, knots[0]), knots, np.full(DEGREE, knots[-1])])
        self.count = len(self.knots) - DEGREE - 1
        self.first = np.clip(np.searchsorted(self.knots, ts, side="right") - 1 - DEGREE, 0, self.count - DEGREE - 1)
        self.near = self.first[:, None] + np.arange(DEGREE + 1)  # only six splines overlap at a time
        self.values = [self._values(d) for d in range(3)]

    def motion(self, ts, C, derivative):
        """The derivative of the splines with these coefficients: (times, n)."""
        from scipy.interpolate import BSpline  # SciPy is a dependency of JAX; imported here because that takes a while

        spline = BSpline(self.knots, C, DEGREE)
        return (spline.derivative(derivative) if derivative else spline)(ts)

    def motions(self, C):
        """Positions, velocities and accelerations at the samples."""
        return [np.einsum("tk,tkn->tn", B, C[self.near]) for B in self.values]

    def _values(self, derivative):
        """Of the splines `near` each sample, (T, 6): every sixth spline may share a coefficient."""
        every_sixth = np.eye(DEGREE + 1)[np.arange(self.count) % (DEGREE + 1)]
        return np.take_along_axis(self.motion(self.ts, every_sixth, derivative), self.near % (DEGREE + 1), axis=1)

    def jacobian(self, J):
        """Σ J_d ⊗ B_d: a row for each sample and channel, a column for each (spline, coordinate)."""
        from scipy import sparse

        Js = np.split(J, 3, axis=2)
        T, channels, n = Js[0].shape
        entries = sum(J[:, :, None, :] * B[:, None, :, None] for J, B in zip(Js, self.values, strict=True))
        row = np.arange(T * channels).reshape(T, channels, 1, 1)
        column = (self.near[:, :, None] * n + np.arange(n))[:, None]
        row, column = (np.broadcast_to(index, entries.shape).ravel() for index in (row, column))
        return sparse.csr_matrix((entries.ravel(), (row, column)), shape=(T * channels, self.count * n))


def _apart(levels, least):
    """0, those of the levels that are at least so far from the ends and from the one before, and 1."""
    ends = [0.0]
    for level in levels:
        if least <= level - ends[-1] and level <= 1 - least:
            ends.append(level)
    return np.array([*ends, 1.0])


def _fitted(sensors, splines):
    """Coefficients of the motion (splines, n) by Gauss and Newton, and the sum of squares: one step where sensors are linear."""
    C = np.zeros((splines.count, sensors.n))
    C[:] = sensors.start[: sensors.n]
    best, squares, before = C, np.inf, None
    for _ in range(ITERATIONS):
        r, J = sensors.residuals(splines.ts, splines.motions(C))
        if before is not None and np.sum(r**2) > (1 - 1e-6) * squares:
            return best, squares
        best, squares = C, np.sum(r**2)
        if before is not None and np.array_equal(J, before):
            return best, squares
        before, C = J, C + _step(sensors, splines, C, r, splines.jacobian(J))
    return best, squares


def _step(sensors, splines, C, r, A):
    """The step of Gauss and Newton, with the known start kept and the third differences penalised."""
    from scipy import sparse

    squares = np.asarray(A.multiply(A).sum(axis=0)).reshape(C.shape).mean(axis=0)
    size = np.sqrt(np.where(squares > 0, squares, 1))  # of what is seen of each coordinate, in one over its unit
    S, off = _known_start(sensors, splines, C, START_WEIGHT * size)
    S = sparse.csr_matrix(S.reshape(-1, C.size))
    third = sparse.diags([-1.0, 3.0, -3.0, 1.0], [0, 1, 2, 3], shape=(splines.count - 3, splines.count))
    P = sparse.kron(third, sparse.diags(PENALTY * size))
    right = A.T @ r.ravel() + S.T @ off - P.T @ (P @ C.ravel())
    return sparse.linalg.spsolve(A.T @ A + S.T @ S + P.T @ P, right).reshape(C.shape)


def _known_start(sensors, splines, C, weight):
    """Weighted rows of the known start over the coefficients, a `weight` for each coordinate, and how far the start is off."""
    rows, off = [], []
    for i in np.flatnonzero(sensors.known):
        d, j = divmod(i, sensors.n)
        first = np.zeros(splines.count)
        first[splines.near[0]] = splines.values[d][0]
        unit = np.zeros(sensors.n)
        unit[j] = weight[j] * splines.interval**d
        rows.append(np.outer(first, unit).ravel())
        off.append(unit[j] * (sensors.start[i] - first @ C[:, j]))
    return np.array(rows), np.array(off)
