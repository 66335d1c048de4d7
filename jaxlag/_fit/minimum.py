"""The minimum of a least-squares problem: what the statistics of a fit are computed from."""

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np

from .._program.jit import compiled
from .experiment import Experiment
from .levenberg_marquardt import Outcome
from .measurement import split_by_kind
from .multiple_shooting import Segments
from .noise import Channels
from .problem import LeastSquaresProblem, Linearisation


@dataclasses.dataclass(frozen=True, eq=False)
class Minimum:
    """A problem linearised at its minimum x.

    - `experiments`: recordings in time and tests, as given; `recordings`: the former.
    - `theta`, `slope`: the p parameters there, and dθ/dy. `found`: residuals and Jacobians.
    - `weighted`: (measured − predicted) / sigma for each batch, (segments, samples · channels), NaN where nothing was measured.
    """

    problem: LeastSquaresProblem
    experiments: tuple[Any, ...]
    segments: Segments
    outcome: Outcome
    x: np.ndarray
    found: Linearisation
    theta: np.ndarray
    slope: np.ndarray
    weighted: list[np.ndarray]

    @classmethod
    def of(cls, problem: LeastSquaresProblem, experiments: Sequence[Any], outcome: Outcome, segments: Segments) -> "Minimum":
        """At the best iterate of an outcome."""
        best = outcome.best
        theta, slope = map(np.asarray, _theta_and_slope(problem.free, np.asarray(best.y)[: problem.free.size]))
        weighted = list(weighted_residuals(problem, best.aux))
        return cls(problem, tuple(experiments), segments, outcome, np.asarray(best.y), best.aux, theta, slope, weighted)

    @functools.cached_property
    def channels(self) -> Channels:
        """What each channel has measured."""
        return Channels.of(self.problem)

    @functools.cached_property
    def residuals(self) -> dict[str, np.ndarray]:
        """What is left of it, by channel."""
        return self.channels.residuals(self.problem, self.found)

    @property
    def size(self) -> int:
        """p, the number of free parameters."""
        return self.problem.free.size

    @functools.cached_property
    def flat(self) -> np.ndarray:
        """All entries of `weighted`."""
        return np.concatenate([np.zeros(0), *(np.ravel(r) for r in self.weighted)])

    @functools.cached_property
    def recordings(self) -> tuple[Experiment, ...]:
        """The experiments that are recordings in time."""
        return split_by_kind(self.experiments)[0]

    @functools.cached_property
    def of_tests(self) -> np.ndarray:
        """Residuals of the tests, over sigma; 0 where nothing was measured."""
        return np.concatenate([np.zeros(0), *(np.asarray(test.residuals) for test in self.found.tests)])

    @functools.cached_property
    def measurements(self) -> int:
        """How many real numbers were measured."""
        return self.measured.size + sum(part.test.measurements for part in self.problem.tests)

    @functools.cached_property
    def measured(self) -> np.ndarray:
        """Those of them that were measured."""
        flat = self.flat
        return flat[np.isfinite(flat)]

    @functools.cached_property
    def absolute(self) -> bool:
        """Whether sigma was given."""
        return all(e.sigma is not None for e in self.recordings)

    @functools.cached_property
    def relative_size(self) -> float:
        """How many times as large as the measurements the residuals are."""
        squares = 0.0
        for batch in self.problem.batches:
            for z, s in zip(jax.tree.leaves(batch.values), jax.tree.leaves(batch.sigma), strict=True):
                squares += float(np.nansum((np.asarray(z) / np.asarray(s))[: len(batch.members)] ** 2))
        return float(np.linalg.norm(self.measured) / np.sqrt(squares)) if squares > 0 else 0.0

    @functools.cached_property
    def segments_of_each(self) -> list[list[tuple[int, int, int]]]:
        """For each experiment its segments: batch, row in the batch, and number of samples of its own."""
        samples = self.segments.samples or [e.ts.size for e in self.recordings]
        places = self.problem.places
        of_each: list[list[tuple[int, int, int]]] = [[] for _ in self.recordings]
        for j, (i, count) in enumerate(zip(self.segments.of, samples, strict=True)):
            of_each[i].append((*places[j], count))
        return of_each


@compiled
def _theta_and_slope(free, y):
    return free.theta(y), free.slope(y)


def weighted_residuals(problem: LeastSquaresProblem, found: Linearisation) -> Iterator[np.ndarray]:
    """(measured − predicted) / sigma for each batch, flat for each experiment; NaN where nothing was measured."""
    for batch, part in zip(problem.batches, found.batches, strict=True):
        yield (batch.flat(batch.values) - batch.flat(part.channels)) / batch.flat(batch.sigma)
