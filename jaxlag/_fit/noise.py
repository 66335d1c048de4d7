"""The noise of each channel: its standard deviation, estimated along with the parameters where it is not given, and the likelihood."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from .arrow import gathered
from .channels import channel_names
from .experiment_batch import ExperimentBatch, with_sigma
from .problem import LeastSquaresProblem, Linearisation
from .residuals import Predictions

FLOOR = 1e-12  # of a channel's spread; smaller residuals are rounding
NORMAL = 1.4826  # standard deviation of normal noise over the median of its size

ByChannel = dict[str, Any]


class Channels(NamedTuple):
    """What was measured by each channel of the recordings; those of one name are one channel, whatever experiment they belong to.

    `places`: by name, for each batch that has the channel, where its measurements stand among the flat values of all experiments.
    """

    places: dict[str, list[tuple[int, np.ndarray]]]
    measured: dict[str, np.ndarray]

    @classmethod
    def of(cls, problem: LeastSquaresProblem) -> "Channels":
        """Those of a problem, whatever its sigmas are."""
        places: dict[str, list[tuple[int, np.ndarray]]] = {}
        values = [batch.flat(batch.values) for batch in problem.batches]
        for k, (batch, flat) in enumerate(zip(problem.batches, values, strict=True)):
            names, end = iter(_names(batch)), 0
            for leaf in jax.tree.leaves(batch.values):
                begin, end = end, end + int(np.prod(leaf.shape[1:]))
                width = int(np.prod(leaf.shape[2:]))
                for first in range(begin, begin + width):
                    at = (np.arange(len(flat))[:, None] * flat.shape[1] + np.arange(first, end, width)).ravel()
                    places.setdefault(next(names), []).append((k, at[np.isfinite(flat.ravel()[at])]))
        return cls(places, _gathered(places, values))

    def residuals(self, problem: LeastSquaresProblem, found: Linearisation) -> ByChannel:
        """What is left of the measurements, by name."""
        pairs = zip(problem.batches, found.batches, strict=True)
        left = self.split([batch.flat(batch.values) - batch.flat(part.channels) for batch, part in pairs])
        return {name: r[np.isfinite(r)] for name, r in left.items()}

    def split(self, flat: Sequence[np.ndarray]) -> ByChannel:
        """A number for each of the flat values of each batch, (experiments, N), by name."""
        return _gathered(self.places, flat)

    @property
    def spreads(self) -> ByChannel:
        """Standard deviation of the measurements, or their size where they are constant."""
        sizes = lambda z: (np.std(z), np.sqrt(np.mean(z**2)), 1.0)
        return {name: next(size for size in sizes(z) if size > 0) for name, z in self.measured.items()}

    @property
    def is_one(self) -> bool:
        """Whether there is no other, so that its sigma is the mean of all."""
        return len(self.measured) == 1


def _gathered(places, flat):
    return {name: np.concatenate([flat[k].ravel()[at] for k, at in parts]) for name, parts in places.items()}


def _names(batch):
    return channel_names(jax.tree.map(lambda x: x[0], batch.values))


def too_short(problem: LeastSquaresProblem, channels: Channels) -> list[str]:
    """Of several channels those with no more measurements than there are unknowns: these could fit them exactly, with a sigma of zero."""
    gaps = 0 if problem.continuity is None else problem.continuity.dual.size
    return [] if channels.is_one else [name for name, z in channels.measured.items() if z.size <= problem.size - gaps]


def noise_free(channels: Channels, residuals: ByChannel) -> dict[str, int]:
    """Of several channels those without noise, but not all, with the number of their measurements: none speaks of the noise of others."""
    spreads = channels.spreads
    exact = {name: r.size for name, r in residuals.items() if r.size and np.sqrt(np.mean(r**2)) <= FLOOR * spreads[name]}
    return exact if len(exact) < len(residuals) else {}


def weighted_by_spread(problem: LeastSquaresProblem, channels: Channels) -> LeastSquaresProblem:
    """The problem with each channel divided by the spread of its measurements, so that its minimum does not depend on units."""
    return problem if channels.is_one else _with(problem, _relative_to_mean(channels.spreads, channels)[0])


def weighted_by_residuals(problem: LeastSquaresProblem, channels: Channels, found: Linearisation) -> tuple[LeastSquaresProblem, float]:
    r"""The problem with the most likely sigmas of its channels for the residuals found; and the largest relative change of a sigma.

    $$ \hat\sigma_c^2 = \frac{1}{N_c - h_c} \sum_{i \in c} r_i^2, \qquad h_c = \mathrm{tr}\, J_c (J^T J)^{-1} J_c^T $$

    where h_c is the part of the unknowns that the channel decides (restricted likelihood); or, with a robust loss, the standard deviation
    of normal noise whose residuals have this median. Experiments share the sigma of a channel of the same name. Their geometric mean over
    all measurements is kept apart, in `Fit.sigma`, or with a robust loss in `LeastSquaresProblem.scale`.

    **Source:** Seber & Wild, Nonlinear Regression (1989), section 11.2; Patterson & Thompson, Biometrika 58 (1971) 545 (restricted
    likelihood); Huber, Robust Statistics (1981), section 5.1.
    """
    robust, before = problem.model.loss is not None, sigmas_of(problem)
    size = lambda r, decided=0.0: NORMAL * np.median(np.abs(r)) if robust else np.sqrt(r @ r / max(r.size - decided, 1))
    decided = {} if robust or found.jacobian is None else _decided(problem, channels, found)
    residuals, spreads = channels.residuals(problem, found), channels.spreads
    if too_short(problem, channels):
        after, scale = before, size(np.concatenate([r / before[name] for name, r in residuals.items()]))
    else:
        sigmas = {name: max(size(r, decided.get(name, 0.0)), FLOOR * spreads[name]) for name, r in residuals.items()}
        after, scale = _relative_to_mean(sigmas, channels)
    scale = np.asarray(scale if robust else 1.0, problem.scale.dtype)
    changes = [abs(np.log(after[name] * scale / (before[name] * problem.scale))) for name in after]
    return dataclasses.replace(_with(problem, after), scale=scale), float(np.max(changes))


def neg2_log_likelihood(channels: Channels, residuals: ByChannel) -> float:
    """Of the data alone, Σ N ln (S/N) with the sum of squares S of the N residuals of each channel: −2 ln L up to a constant."""
    spreads = channels.spreads
    squares = {name: max(np.mean(r**2), (FLOOR * spreads[name]) ** 2) for name, r in residuals.items() if r.size}
    return float(sum(residuals[name].size * np.log(square) for name, square in squares.items()))


def freedom_of_channels(problem: LeastSquaresProblem, channels: Channels, found: Linearisation) -> float:
    r"""The degrees of freedom of Student's distribution where channels have sigmas of their own, from their N and the part h of the
    unknowns that each decides:

    $$ \nu = \frac{(\sum_c h_c)^2}{\sum_c h_c^2/(N_c - h_c)} $$

    **Source:** Satterthwaite, Biometrics Bull. 2 (1946) 110.
    """
    h, counts = _decided(problem, channels, found), {name: z.size for name, z in channels.measured.items()}
    terms = [h[name] ** 2 / max(counts[name] - h[name], 1) for name in h]
    return float(sum(h.values()) ** 2 / sum(terms)) if sum(terms) > 0 else float(sum(counts.values()))


def _decided(problem, channels, found):
    """By channel how many of the unknowns it decides: the sum of the leverages of its measurements."""
    J = np.asarray(gathered(found.jacobian))
    size = np.linalg.norm(J, axis=0)
    size = np.where(size > 0, size, 1)
    covariance = np.linalg.pinv((J / size).T @ (J / size), hermitian=True) / np.outer(size, size)

    def leverages(k, J):
        at = problem.columns(k)
        return np.array([np.sum(rows @ covariance[np.ix_(columns, columns)] * rows, axis=1) for rows, columns in zip(J, at, strict=True)])

    blocks = [by_sigma(batch, part) for batch, part in zip(problem.batches, found.batches, strict=True)]
    return {name: np.sum(h) for name, h in channels.split([leverages(k, J) for k, J in enumerate(blocks)]).items()}


def by_sigma(batch: ExperimentBatch, part: Predictions) -> np.ndarray:
    """The Jacobian of what was predicted of each experiment, over sigma; zero where nothing was measured."""
    there = np.isfinite(batch.flat(batch.values))[..., None]
    return np.where(there, np.where(there, np.asarray(part.channels_jacobian, float), 0) / batch.flat(batch.sigma)[..., None], 0)


def sigmas_of(problem: LeastSquaresProblem) -> ByChannel:
    """The sigma of each channel over their geometric mean."""
    found: ByChannel = {}
    for batch in problem.batches:
        firsts = np.concatenate([np.ravel(np.asarray(s)[0, 0]) for s in jax.tree.leaves(batch.sigma)])
        found = dict(zip(_names(batch), map(float, firsts), strict=True)) | found
    return found


def _relative_to_mean(sigmas, channels):
    """Each sigma over their geometric mean, and this mean; each counts as often as its channel was measured."""
    counts = [channels.measured[name].size for name in sigmas]
    mean = float(np.exp(np.average(np.log(list(sigmas.values())), weights=counts)))
    return {name: sigma / mean for name, sigma in sigmas.items()}, mean


def _with(problem, sigmas):
    """The problem with these sigmas of its channels."""
    batches = tuple(with_sigma(batch, _of_batch(batch, sigmas)) for batch in problem.batches)
    return dataclasses.replace(problem, batches=batches)


def _of_batch(batch, sigmas):
    """The sigmas of channels as a tree like the values of a batch."""
    own, (leaves, structure) = iter([sigmas[name] for name in _names(batch)]), jax.tree.flatten(batch.sigma)
    of_leaf = lambda leaf: np.array([next(own) for _ in range(int(np.prod(leaf.shape[2:])))], leaf.dtype).reshape(leaf.shape[2:])
    return structure.unflatten([np.broadcast_to(of_leaf(leaf), leaf.shape) for leaf in leaves])
