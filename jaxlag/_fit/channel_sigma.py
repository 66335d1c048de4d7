"""The standard deviation of each channel's noise, estimated along with the parameters where it is not given."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from .arrow import gathered
from .channels import channel_names
from .experiment_batch import ExperimentBatch, with_sigma
from .problem import Linearisation, Problem

FLOOR = 1e-12  # of a channel's spread; smaller residuals are rounding
NORMAL = 1.4826  # standard deviation of normal noise over the median of its size

ByChannel = dict[str, Any]


def too_short(problem: Problem) -> list[str]:
    """Of several channels those with no more measurements than there are unknowns: these could fit them exactly, with a sigma of zero."""
    if _is_alone(problem):
        return []
    measured = _by_channel(problem, lambda batch, _: batch.values)
    gaps = 0 if problem.continuity is None else problem.continuity.dual.size
    return [name for name, z in measured.items() if z.size <= problem.size - gaps] if len(measured) > 1 else []


def predicted_exactly(problem: Problem, found: Linearisation) -> dict[str, int]:
    """Of several channels those without noise, but not all, with the number of their measurements: none speaks of the noise of others."""
    measured = _by_channel(problem, lambda batch, _: batch.values)
    residuals = _by_channel(problem, lambda batch, k: jax.tree.map(_left, batch.values, found.batches[k].channels))
    exact = {name: r.size for name, r in residuals.items() if r.size and np.sqrt(np.mean(r**2)) <= FLOOR * _spread(measured[name])}
    return exact if len(exact) < len(residuals) else {}


def weighted_by_spread(problem: Problem) -> Problem:
    """The problem with each channel divided by the spread of its measurements, so that its minimum does not depend on units."""
    if _is_alone(problem):
        return problem
    measured = _by_channel(problem, lambda batch, _: batch.values)
    relative, _ = _relative_to_mean({name: _spread(z) for name, z in measured.items()}, measured)
    return _with(problem, relative)


def weighted_by_residuals(problem: Problem, found: Linearisation) -> tuple[Problem, float]:
    r"""The problem with the most likely sigmas of its channels for the residuals found; and the largest relative change of a sigma.

    $$ \hat\sigma_c^2 = \frac{1}{N_c - h_c} \sum_{i \in c} r_i^2, \qquad h_c = \mathrm{tr}\, J_c (J^T J)^{-1} J_c^T $$

    where h_c is the part of the unknowns that the channel decides (restricted likelihood); or, with a robust loss, the standard deviation
    of normal noise whose residuals have this median. Experiments share the sigma of a channel of the same name. Their geometric mean over
    all measurements is kept apart, in `Fit.sigma`, or with a robust loss in `Problem.scale`.

    **Source:** Seber & Wild, Nonlinear Regression (1989), section 11.2; Patterson & Thompson, Biometrika 58 (1971) 545 (restricted
    likelihood); Huber, Robust Statistics (1981), section 5.1.
    """
    robust, before = problem.model.loss is not None, sigmas_of(problem)
    size = lambda r, decided=0.0: NORMAL * np.median(np.abs(r)) if robust else np.sqrt(r @ r / max(r.size - decided, 1))
    decided = {} if robust or found.jacobian is None else {name: np.sum(h) for name, h in _leverages(problem, found).items()}
    measured = _by_channel(problem, lambda batch, _: batch.values)
    residuals = _by_channel(problem, lambda batch, k: jax.tree.map(_left, batch.values, found.batches[k].channels))
    if too_short(problem):
        after, scale = before, size(np.concatenate([r / before[name] for name, r in residuals.items()]))
    else:
        sigmas = {name: max(size(r, decided.get(name, 0.0)), FLOOR * _spread(measured[name])) for name, r in residuals.items()}
        after, scale = _relative_to_mean(sigmas, measured)
    scale = np.asarray(scale if robust else 1.0, problem.scale.dtype)
    changes = [abs(np.log(after[name] * scale / (before[name] * problem.scale))) for name in after]
    return dataclasses.replace(_with(problem, after), scale=scale), float(np.max(changes))


def neg2_log_likelihood(problem: Problem, found: Linearisation) -> float:
    """Of the data alone, Σ N ln (S/N) with the sum of squares S of the N residuals of each channel: −2 ln L up to a constant."""
    measured = _by_channel(problem, lambda batch, _: batch.values)
    residuals = _by_channel(problem, lambda batch, k: jax.tree.map(_left, batch.values, found.batches[k].channels))
    squares = {name: max(np.mean(r**2), (FLOOR * _spread(measured[name])) ** 2) for name, r in residuals.items() if r.size}
    return float(sum(residuals[name].size * np.log(square) for name, square in squares.items()))


def freedom_of_channels(problem: Problem, found: Linearisation) -> float:
    r"""The degrees of freedom of Student's distribution where channels have sigmas of their own, from their N and the part h of the
    unknowns that each decides:

    $$ \nu = \frac{(\sum_c h_c)^2}{\sum_c h_c^2/(N_c - h_c)} $$

    **Source:** Satterthwaite, Biometrics Bull. 2 (1946) 110.
    """
    h = {name: np.sum(decided) for name, decided in _leverages(problem, found).items()}
    counts = {name: z.size for name, z in _by_channel(problem, lambda batch, _: batch.values).items()}
    terms = [h[name] ** 2 / max(counts[name] - h[name], 1) for name in h]
    return float(sum(h.values()) ** 2 / sum(terms)) if sum(terms) > 0 else float(sum(counts.values()))


def _leverages(problem, found):
    """By channel how much each measurement decides of its own prediction."""
    J = np.asarray(gathered(found.jacobian))
    size = np.linalg.norm(J, axis=0)
    size = np.where(size > 0, size, 1)
    covariance = np.linalg.pinv((J / size).T @ (J / size), hermitian=True) / np.outer(size, size)

    def of_batch(batch, k):
        J = np.asarray(found.batches[k].jacobian)
        at = problem.columns(k)
        h = np.array([np.sum(rows @ covariance[np.ix_(columns, columns)] * rows, axis=1) for rows, columns in zip(J, at, strict=True)])
        leaves, structure = jax.tree.flatten(batch.values)
        ends = np.cumsum([int(np.prod(leaf.shape[1:])) for leaf in leaves])
        return structure.unflatten([x.reshape(len(J), *z.shape[1:]) for x, z in zip(np.split(h, ends[:-1], axis=1), leaves, strict=True)])

    return _by_channel(problem, of_batch)


def _is_alone(problem: Problem) -> bool:
    """Whether there is one channel, whose sigma is the mean of all."""
    shapes = [leaf.shape for batch in problem.batches for leaf in jax.tree.leaves(batch.values)]
    return len(shapes) == 1 and math.prod(shapes[0][2:]) == 1


def sigmas_of(problem: Problem) -> ByChannel:
    """The sigma of each channel over their geometric mean."""
    first = lambda batch, _: jax.tree.map(lambda s: s[:1, :1], batch.sigma)
    return {name: float(s[0]) for name, s in _by_channel(problem, first).items()}


def _left(z, seen):
    """What is left of the measurements; copies of the last experiment may follow."""
    return np.asarray(z)[: len(seen)] - np.asarray(seen)


def _spread(z):
    """Standard deviation of the measurements, or their size where they are constant."""
    sizes = np.std(z), np.sqrt(np.mean(z**2)), 1.0
    return next(size for size in sizes if size > 0)


def _relative_to_mean(sigmas, measured):
    """Each sigma over their geometric mean, and this mean; each counts as often as its channel was measured."""
    counts = [measured[name].size for name in sigmas]
    mean = float(np.exp(np.average(np.log(list(sigmas.values())), weights=counts)))
    return {name: sigma / mean for name, sigma in sigmas.items()}, mean


def _by_channel(problem: Problem, tree_of: Callable[[ExperimentBatch, int], PyTree]) -> dict[str, np.ndarray]:
    """What there is of each channel in all experiments, flat, from a tree like the values of each batch."""
    parts: dict[str, list[np.ndarray]] = {}
    for k, batch in enumerate(problem.batches):
        leaves = jax.tree.leaves(tree_of(batch, k))
        count = len(batch.members)  # copies of the last one may follow
        flat = np.concatenate([np.reshape(np.asarray(x)[:count], (-1, int(np.prod(x.shape[2:])))) for x in leaves], axis=1)
        for name, column in zip(channel_names(jax.tree.map(lambda x: x[0], batch.values)), flat.T, strict=True):
            parts.setdefault(name, []).append(column[np.isfinite(column)])
    return {name: np.concatenate(columns) for name, columns in parts.items()}


def _with(problem, sigmas):
    """The problem with these sigmas of its channels."""
    batches = tuple(with_sigma(batch, _of_batch(batch, sigmas)) for batch in problem.batches)
    return dataclasses.replace(problem, batches=batches)


def _of_batch(batch, sigmas):
    """The sigmas of channels as a tree like the values of a batch."""
    names = channel_names(jax.tree.map(lambda x: x[0], batch.values))
    leaves, structure = jax.tree.flatten(batch.sigma)
    ends = np.cumsum([int(np.prod(leaf.shape[2:])) for leaf in leaves])
    of_leaves = np.split(np.array([sigmas[name] for name in names]), ends[:-1])
    return structure.unflatten(
        [np.broadcast_to(own.reshape(leaf.shape[2:]).astype(leaf.dtype), leaf.shape) for own, leaf in zip(of_leaves, leaves, strict=True)]
    )
