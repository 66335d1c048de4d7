"""The covariance of all unknowns at the minimum, and how correlated residuals enlarge it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .arrow import Arrow, gathered, norms
from .autocorrelation import autoregression, coloured_information, correlation_length
from .base_parameters import nearby
from .experiment_batch import of_events
from .identifiability import Determined, Undetermined, determined_by, undetermined
from .minimum import Minimum
from .noise import by_sigma
from .problem import failure_of, linearise


class Uncertainty(NamedTuple):
    """What is determined, with the covariance over σ²; the Jacobian behind it, None where there are too many unknowns.

    `inflation`, (p,): the factor by which correlated residuals enlarge each standard error; `correlation_length`: over how many
    samples they are.
    """

    known: Determined
    jacobian: Arrow | None
    inflation: np.ndarray
    correlation_length: int


def uncertainty_of(minimum: Minimum) -> Uncertainty:
    """From the Jacobian at the minimum, without the weight of the gaps between segments."""
    p, size = minimum.size, minimum.x.size
    J = _jacobian(minimum)
    small = None if J is None else gathered(J)
    if small is None or not np.all(np.isfinite(small)):  # there is no motion to differentiate, or it ended on the way
        known = Determined(np.full((size, size), np.nan), np.ones(size, bool), np.zeros((size, 0)))
        return Uncertainty(known, None, np.ones(p), 0)
    known = determined_by(small, np.asarray(minimum.found.gaps_jacobian), precision=minimum.x.dtype)
    covariance, correlated = sandwich(minimum, J, known.covariance, _influences(minimum))
    np.fill_diagonal(covariance, np.maximum(np.diag(covariance), 0))  # where nothing is determined, rounding may leave less
    after, before = (np.diag(c)[:p] for c in (covariance, known.covariance))
    inflation = np.sqrt(np.where(before > 0, after / np.where(before > 0, before, 1), 1))
    return Uncertainty(known._replace(covariance=covariance), J, inflation, correlated)


def _jacobian(minimum):
    """Of priors, tests and residuals; those of a robust loss as if it were quadratic."""
    problem, found = minimum.problem, minimum.found
    if found.jacobian is None:
        return None
    blocks = [by_sigma(batch, part) for batch, part in zip(problem.batches, found.batches, strict=True)]
    beside = found.jacobian.first if isinstance(found.jacobian, Arrow) else np.asarray(found.jacobian)[: problem.first_recorded]
    columns = tuple(problem.columns(k) for k in range(len(blocks)))
    return Arrow(np.asarray(beside).astype(float), tuple(blocks), columns, np.zeros((0, minimum.x.size)))


def _influences(minimum):
    """The weighted residuals of each batch, limited by a robust loss."""
    loss = minimum.problem.model.loss
    return minimum.weighted if loss is None else [np.asarray(loss.influence(r / minimum.problem.scale)) for r in minimum.weighted]


def sandwich(minimum: Minimum, J: Arrow, covariance: np.ndarray, weighted: list[np.ndarray]) -> tuple[np.ndarray, int]:
    """The covariance over σ² of what the columns of J belong to, with the sandwich where residuals are correlated; and over how many
    samples they are. `weighted`: the residuals of each batch, like those of the minimum; `covariance`: as if they were white.
    """
    batches, segments_of_each = minimum.problem.batches, minimum.segments_of_each
    together = lambda parts: [np.concatenate(of) for of in zip(*parts, strict=True)]
    series = [together([_by_time(batches[k], weighted[k][row].astype(float), n) for k, row, n in of]) for of in segments_of_each]
    lengths = [correlation_length(autoregression(r[np.isfinite(r)]), len(r)) for of in series for rs in of for r in rs.T]
    if not any(lengths):
        return covariance, 0
    power = np.nanmean(np.concatenate([r.ravel() for of in series for r in of]) ** 2)
    middle = J.first.T @ J.first
    for segments, of in zip(segments_of_each, series, strict=True):
        columns, slopes = _of_experiment(batches, J, segments)
        for r, J_r in zip(of, slopes, strict=True):
            sizes = np.ones(r.shape[1]) if minimum.absolute else np.sqrt(np.nanmean(r**2, axis=0) / power)
            middle[np.ix_(columns, columns)] += coloured_information(J_r, r, sizes)
    return covariance @ middle @ covariance, max(lengths)


def _of_experiment(batches, J, segments):
    """The columns on which an experiment depends, and its series, of one segment after the other, (samples, channels, columns)."""
    columns = np.unique(np.concatenate([J.columns[k][row] for k, row, _ in segments]))
    rows = []
    for k, row, n in segments:
        wide = np.zeros((len(J.blocks[k][row]), columns.size))
        wide[:, np.searchsorted(columns, J.columns[k][row])] = J.blocks[k][row]
        rows.append(_by_time(batches[k], wide, n))
    return columns, [np.concatenate(of) for of in zip(*rows, strict=True)]


def _by_time(batch, flat, samples):
    """Rows of one experiment, one channel after the other, as series in time (samples, channels, ...): one of all that is sampled, and
    one of the times of each event, whose noise has nothing to do with others.
    """
    shapes = [leaf.shape[1:] for leaf in jax.tree.leaves(batch.values)]
    parts = np.split(flat, np.cumsum([int(np.prod(shape)) for shape in shapes])[:-1])
    by_time = [part.reshape(shape[0], -1, *flat.shape[1:]) for part, shape in zip(parts, shapes, strict=True)]
    kinds = of_events(batch)
    sampled = [part[:samples] for part, of_event in zip(by_time, kinds, strict=True) if not of_event]
    together = [np.concatenate(sampled, axis=1)] if sampled else []
    return together + [part for part, of_event in zip(by_time, kinds, strict=True) if of_event]


def undetermined_parameters(minimum: Minimum, uncertainty: Uncertainty) -> Undetermined | None:
    """Which parameters are not determined, if any; other points tell which combinations are."""
    p, known = minimum.size, uncertainty.known
    if uncertainty.jacobian is None or not np.any(known.null[:p]):
        return None
    idle = np.flatnonzero(norms(uncertainty.jacobian)[:p] == 0).tolist()
    return undetermined(_points(minimum, known), np.flatnonzero(known.determined[:p]).tolist(), idle, known.noise)


def _points(minimum, known):
    """θ and the changes that do not show, at the estimate, then around it wherever there is a motion."""
    free, p = minimum.problem.free, minimum.size
    yield minimum.theta, minimum.slope[:, None] * known.null[:p]
    for theta in nearby(minimum.theta, np.asarray(free.lower), np.asarray(free.upper)):
        y = jnp.asarray((theta - free.start) / free.scale, minimum.x.dtype)
        found = linearise(minimum.problem, jnp.asarray(minimum.x).at[:p].set(y))
        J = np.asarray(gathered(found.jacobian))
        if failure_of(found) is None and np.all(np.isfinite(J)):
            there = determined_by(J[: len(J) - len(found.gaps)], np.asarray(found.gaps_jacobian), hidden=known.null.shape[1])
            yield np.asarray(free.theta(y), float), np.asarray(free.slope(y))[:, None] * there.null[:p]
