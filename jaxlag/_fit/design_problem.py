"""A design as a problem of optimisation: a cost and margins of limits, as functions of scaled numbers that are chosen."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._model.injection import check_function
from .._model.paths import is_within
from .constrained_minimum import KEPT
from .design_criteria import Criterion, OverSamples, total
from .design_plan import Planned, along_the_motion, informed, of_parameters
from .parameters import Free

FAINT = 1e-10  # of the information that makes a relative error of one: what keeps log det finite where nothing is determined
CLOSE = 1e-13  # to one, as a correlation of two parameters may come: rounding
SHARPNESS, SHARP = (10.0, 1e3, 1e5), 1e12  # of edges of a criterion, one search after the other; and of none
SPREAD = 0.5  # of further starts, in units of what is chosen
ALONG = 201  # times at which limits are kept in the search
NEAR = 1e-3  # of its size, at which a limit binds


@dataclasses.dataclass(frozen=True)
class Limit:
    """Of what a function says along all motions: an upper limit, or with a `sign` of −1 a lower one; `size`: what an excess is counted in,
    or None, where that is what is said.
    """

    name: str
    function: Callable
    sign: float
    bound: float
    size: float | None

    def __str__(self) -> str:
        return f"{self.name} ({'upper' if self.sign > 0 else 'lower'})"

    def margins(self, said: Float[np.ndarray, "S k"], slopes: Float[np.ndarray, "S k m"]) -> tuple[np.ndarray, np.ndarray]:
        """By how much it is kept, over its size, with derivatives."""
        size = self.size or np.nanmax(np.abs(said), initial=0.0) or 1.0
        peak, slope = _peaks(self.sign * said, self.sign * slopes)
        return (self.sign * self.bound - peak).ravel() / size, -slope.reshape(-1, slope.shape[-1]) / size


@dataclasses.dataclass(frozen=True)
class Sample:
    """Parameters as they may be, and the information about them without what is planned."""

    free: Free
    background: np.ndarray


@dataclasses.dataclass(frozen=True)
class DesignProblem:
    """The cost and the margins, as functions of y of all measurements; `unit` of the parameters, in which the information is counted;
    `moved`: by how much each limit is moved inwards.
    """

    parts: tuple[Planned, ...]
    samples: tuple[Sample, ...]
    unit: np.ndarray
    criterion: Criterion
    limits: tuple[Limit, ...]
    moved: np.ndarray

    @classmethod
    def of(cls, parts: Sequence[Planned], samples: Sequence[Sample], criterion: Criterion, limits: tuple[Limit, ...]) -> "DesignProblem":
        """In units of parameters that are zero, and of what is chosen and has none, as the plan and the slopes of the cost have them."""
        unsized = [np.isnan(part.chosen.scale) for part in parts]
        parts = [_sized(part, np.where(nan, 1.0, part.chosen.scale)) for part, nan in zip(parts, unsized, strict=True)]
        start = np.asarray(samples[0].free.start)
        problem = cls(tuple(parts), tuple(samples), np.ones(start.size), criterion, limits, np.zeros(len(limits)))
        y = np.zeros(problem.size)
        F = np.diag(problem.information(samples[0], y)[0])
        is_new = (start == 0) & (F > 2 * FAINT)
        problem = dataclasses.replace(problem, unit=np.where(is_new, 1 / np.sqrt(np.where(is_new, F, 1)), 1))
        if not any(map(np.any, unsized)):
            return problem
        steep = np.abs(problem.cost(y, SHARPNESS[0])[1])
        size = problem.split(np.where(np.isfinite(steep) & (steep > 0), 1 / np.where(steep > 0, steep, 1), 1))
        scales = [np.where(nan, new, part.chosen.scale) for part, nan, new in zip(parts, unsized, size, strict=True)]
        return dataclasses.replace(problem, parts=tuple(map(_sized, parts, scales)))

    @property
    def size(self) -> int:
        """How many numbers are chosen."""
        return sum(part.size for part in self.parts)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Of y."""
        lower, upper = zip(*(part.chosen.bounds for part in self.parts), strict=True)
        return np.concatenate(list(map(np.asarray, lower))), np.concatenate(list(map(np.asarray, upper)))

    def split(self, y: np.ndarray) -> list[np.ndarray]:
        """y of each measurement."""
        return np.split(y, np.cumsum([part.size for part in self.parts])[:-1])

    def _wide(self, i: int, slopes: np.ndarray) -> np.ndarray:
        """Derivatives by y of one measurement, as such by all of y."""
        wide = np.zeros((*slopes.shape[:-1], self.size))
        begin = sum(part.size for part in self.parts[:i])
        wide[..., begin : begin + self.parts[i].size] = slopes
        return wide

    def information(self, sample: Sample, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """F in units of the parameters, and its derivatives by y."""
        p = len(self.unit)
        F, dF = sample.background.copy(), np.zeros((p, p, self.size))
        for i, (part, own) in enumerate(zip(self.parts, self.split(y), strict=True)):
            of = dataclasses.replace(part, problem=dataclasses.replace(part.problem, free=sample.free))
            whole, slopes = map(np.asarray, informed(of, jnp.asarray(own)))
            one, slope = of_parameters(whole, slopes, p)
            F, dF = F + one, dF + self._wide(i, slope)
        diagonal, scale = np.arange(p), np.outer(self.unit, self.unit)
        F[diagonal, diagonal] += FAINT + CLOSE * F[diagonal, diagonal]
        dF[diagonal, diagonal] *= 1 + CLOSE
        return F * scale, dF * scale[..., None]

    def cost(self, y: np.ndarray, sharpness: float = SHARP) -> tuple[float, np.ndarray]:
        """The criterion, and its derivatives; NaN where there is no motion."""
        found = [self.information(sample, y) for sample in self.samples]
        if not all(np.all(np.isfinite(F)) and np.all(np.isfinite(dF)) for F, dF in found):
            return np.nan, np.full(y.size, np.nan)
        return total(self.criterion, found, self.samples[0].free.entries, sharpness)

    def of_limits(self, y: np.ndarray, finer: int = 1) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Of each limit its margins over all motions, their derivatives, and their times."""
        found: list[list[tuple[np.ndarray, np.ndarray, np.ndarray]]] = [[] for _ in self.limits]
        functions = tuple({limit.name: limit.function for limit in self.limits}.items())
        for i, (part, own) in enumerate(zip(self.parts, self.split(y), strict=True)):
            if part.batch is None or not self.limits:
                continue
            shares, said, slopes = _along(part, own, functions, finer)
            begin, *_, end = np.asarray(part.batch.ts[0])
            for of_limit, limit in zip(found, self.limits, strict=True):
                margin, slope = limit.margins(said[limit.name], slopes[limit.name])
                of_limit.append((margin, self._wide(i, slope), np.repeat(begin + shares * (end - begin), said[limit.name].shape[1])))
        return [tuple(map(np.concatenate, zip(*of_limit, strict=True))) for of_limit in found]  # type: ignore[misc]

    def margins(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """By how much limits are kept, over their sizes, and times are in order; with derivatives."""
        values, slopes = [], []
        for (value, slope, _), moved in zip(self.of_limits(y), self.moved, strict=True):
            values.append(value - moved)
            slopes.append(slope)
        for i, (part, own) in enumerate(zip(self.parts, self.split(y), strict=True)):
            A, b = part.pauses()
            values.append(A @ own + b)
            slopes.append(self._wide(i, A))
        return np.concatenate(values), np.vstack(slopes)

    def starts(self, count: int, key: Array) -> list[np.ndarray]:
        """y of each search: zero, and beside it."""
        lower, upper = self.bounds
        both = np.isfinite(lower) & np.isfinite(upper)
        found = [np.zeros(self.size)]
        for one in jax.random.split(key, count)[1:]:
            normal = np.clip(SPREAD * np.asarray(jax.random.normal(one, (self.size,))), lower, upper)
            share = np.asarray(jax.random.uniform(one, (self.size,)))
            y = np.where(both, np.where(both, lower, 0) + share * np.where(both, upper - lower, 1), normal)
            found.append(np.concatenate([part.in_order(own) for part, own in zip(self.parts, self.split(y), strict=True)]))
        return found

    def binding(self, y: np.ndarray) -> dict[str, float]:
        """Limits that are touched, and when; and bounds, at no time."""
        limits = zip(self.limits, self.of_limits(y), strict=True)
        near = {str(limit): float(times[np.argmin(margins)]) for limit, (margins, _, times) in limits if np.min(margins) < NEAR}
        for part, own in zip(self.parts, self.split(y), strict=True):
            for entry, value, *pair in zip(part.chosen.entries, own, *map(np.asarray, part.chosen.bounds), strict=True):
                if not is_within(entry, "ts") and np.min(np.abs(np.array(pair) - value)) < KEPT:
                    near[f"bound of {entry}"] = np.nan
        return near


def samples_of(criterion: Criterion, params: PyTree) -> list[PyTree]:
    """The parameters, or those of each sample of a criterion."""
    if not isinstance(criterion, OverSamples):
        return [params]
    entries = Free.of(params, tuple(criterion.samples))
    rows = [np.asarray(x, float) for x in criterion.samples.values()]
    return [entries.insert(jnp.asarray(np.concatenate([np.ravel(row[k]) for row in rows]))) for k in range(len(rows[0]))]


def limits_of(within: Mapping[str, Any] | None, parts: Sequence[Planned]) -> tuple[Limit, ...]:
    """From (function, lower, upper) by name, checked."""
    limits = []
    for name, given in (within or {}).items():
        try:
            function, lower, upper = given
            ends = -np.inf if lower is None else float(lower), np.inf if upper is None else float(upper)
        except (TypeError, ValueError):
            raise ValueError(f"`within[{name!r}]` must be (function, lower, upper), but is {given!r}. None is no limit.") from None
        check_function(function, f"`within[{name!r}]`")
        if not ends[0] < ends[1]:
            raise ValueError(f"`within[{name!r}]` must be in order, but is ({ends[0]:g}, {ends[1]:g}). Put the lower one first.")
        both = np.isfinite(ends[0]) and np.isfinite(ends[1])
        for sign, bound in zip((-1.0, 1.0), ends, strict=True):
            if np.isfinite(bound):
                limits.append(Limit(str(name), function, sign, bound, ends[1] - ends[0] if both else abs(bound) or None))
    if limits and all(part.batch is None for part in parts):
        raise ValueError("`within` must limit motions, but the plan has no `Experiment`. Use `bounds`.")
    return tuple(limits)


def _along(part: Planned, y: np.ndarray, functions: tuple[tuple[str, Callable], ...], finer: int) -> tuple[np.ndarray, Any, Any]:
    """Shares of the time, what functions say there and its derivatives; finer by further motions with as many samples: one program."""
    coarse = np.linspace(0.0, 1.0, ALONG)
    found = [(coarse, *along_the_motion(part, jnp.asarray(y), functions, coarse))]
    for k in range(1, finer):
        shares = np.append(0.0, coarse[:-1] + k / finer * coarse[1])  # a motion begins at its start
        found.append(jax.tree.map(lambda x: x[1:], (shares, *along_the_motion(part, jnp.asarray(y), functions, shares))))
    shares, said, slopes = jax.tree.map(lambda *x: np.concatenate(x), *found)
    order = np.argsort(shares)
    return jax.tree.map(lambda x: x[order], (shares, said, slopes))


def _sized(part: Planned, scale: Any) -> Planned:
    """With these units of what is chosen."""
    return dataclasses.replace(part, chosen=dataclasses.replace(part.chosen, scale=scale))


def _peaks(v: Float[np.ndarray, "S k"], slopes: Float[np.ndarray, "S k m"]) -> tuple[np.ndarray, np.ndarray]:
    """Values along a motion, those at peaks raised to the top of the parabola through three of them; with derivatives."""
    a, b, c = v[:-2], v[1:-1], v[2:]
    da, db, dc = slopes[:-2], slopes[1:-1], slopes[2:]
    bend, lean = 2 * b - a - c, c - a
    peak = (b >= a) & (b >= c) & (bend > 0)
    bend = np.where(peak, bend, 1.0)
    top = np.where(peak, b + lean**2 / (8 * bend), b)
    ratio = (lean / bend)[..., None]
    d_top = np.where(peak[..., None], db + ratio * (dc - da) / 4 - ratio**2 * (2 * db - da - dc) / 8, db)
    return np.concatenate([v[:1], top, v[-1:]]), np.concatenate([slopes[:1], d_top, slopes[-1:]])
