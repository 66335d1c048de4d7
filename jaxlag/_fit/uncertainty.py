"""The covariance of all unknowns at the minimum, and how correlated residuals enlarge it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .arrow import Arrow, gathered, norms
from .autocorrelation import autoregression, coloured_information, correlation_length
from .identifiability import Determined, Undetermined, determined_by, undetermined
from .minimum import Minimum
from .problem import failure_of, linearise


class Uncertainty(NamedTuple):
    """What is determined, with the covariance over σ²; the Jacobian behind it, None where there are too many unknowns.

    `inflation`, (p,): the factor by which correlated residuals enlarge each standard error; `correlated`: over how many samples they are.
    """

    known: Determined
    jacobian: Arrow | None
    inflation: np.ndarray
    correlated: int


def uncertainty_of(minimum: Minimum) -> Uncertainty:
    """From the Jacobian at the minimum, without the weight of the gaps between segments."""
    p, size = minimum.size, minimum.x.size
    J = _jacobian(minimum)
    if J is None:
        known = Determined(np.full((size, size), np.nan), np.ones(size, bool), np.zeros((size, 0)))
        return Uncertainty(known, None, np.ones(p), 0)
    known = determined_by(gathered(J), np.asarray(minimum.found.gaps_jacobian))
    covariance, correlated = sandwich(minimum, J, known.covariance, _influences(minimum))
    np.fill_diagonal(covariance, np.maximum(np.diag(covariance), 0))  # where nothing is determined, rounding may leave less
    after, before = (np.diag(c)[:p] for c in (covariance, known.covariance))
    inflation = np.sqrt(np.where(before > 0, after / np.where(before > 0, before, 1), 1))
    return Uncertainty(known._replace(covariance=covariance), J, inflation, correlated)


def _jacobian(minimum):
    """Of priors, tests and residuals; those of a robust loss as if it were quadratic."""
    problem, found, loss = minimum.problem, minimum.found, minimum.problem.model.loss
    if found.jacobian is None:
        return None
    blocks = [np.asarray(part.jacobian).astype(float) for part in found.batches]
    if loss is not None:
        slopes = [loss.slope(np.nan_to_num(r) / problem.scale) for r in minimum.weighted]
        blocks = [J / np.asarray(slope)[:, :, None] for J, slope in zip(blocks, slopes, strict=True)]
    beside = found.jacobian.first if isinstance(found.jacobian, Arrow) else found.jacobian[: problem.beside]
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
    batches, segments_of_each = minimum.problem.batches, minimum.segments_of_each()
    series = [np.concatenate([_by_time(batches[k], weighted[k][row].astype(float), n) for k, row, n in of]) for of in segments_of_each]
    lengths = [correlation_length(autoregression(r[np.isfinite(r)]), len(r)) for rs in series for r in rs.T]
    if not any(lengths):
        return covariance, 0
    power = np.nanmean(np.concatenate([r.ravel() for r in series]) ** 2)
    middle = J.first.T @ J.first
    for segments, r in zip(segments_of_each, series, strict=True):
        sizes = np.ones(r.shape[1]) if minimum.absolute else np.sqrt(np.nanmean(r**2, axis=0) / power)
        columns, slopes = _of_experiment(batches, J, segments)
        middle[np.ix_(columns, columns)] += coloured_information(slopes, r, sizes)
    return covariance @ middle @ covariance, max(lengths)


def _of_experiment(batches, J, segments):
    """The columns on which an experiment depends, and its rows, those of its segments one after the other, (samples, channels, columns)."""
    columns = np.unique(np.concatenate([J.columns[k][row] for k, row, _ in segments]))
    rows = []
    for k, row, n in segments:
        own = _by_time(batches[k], J.blocks[k][row], n)
        wide = np.zeros((*own.shape[:2], columns.size))
        wide[:, :, np.searchsorted(columns, J.columns[k][row])] = own
        rows.append(wide)
    return columns, np.concatenate(rows)


def _by_time(batch, flat, samples):
    """Rows of one experiment, one channel after the other, as (samples, channels, ...)."""
    shapes = [leaf.shape[1:] for leaf in jax.tree.leaves(batch.values)]
    parts = np.split(flat, np.cumsum([int(np.prod(shape)) for shape in shapes])[:-1])
    by_time = [part.reshape(shape[0], -1, *flat.shape[1:]) for part, shape in zip(parts, shapes, strict=True)]
    return np.concatenate(by_time, axis=1)[:samples]


def undetermined_parameters(minimum: Minimum, uncertainty: Uncertainty) -> Undetermined | None:
    """Which parameters are not determined, if any; a second point tells products from sums."""
    free, p, null = minimum.problem.free, minimum.size, uncertainty.known.null
    if uncertainty.jacobian is None or not np.any(null[:p]):
        return None
    nulls, thetas = [minimum.slope[:, None] * null[:p]], [minimum.theta]
    elsewhere = jnp.asarray(minimum.x).at[:p].add(0.1 * jnp.cos(jnp.arange(p)))
    found = linearise(minimum.problem, elsewhere)
    if failure_of(found) is None:
        J = gathered(found.jacobian)
        there = determined_by(np.asarray(J)[: len(J) - len(found.gaps)], np.asarray(found.gaps_jacobian), hidden=null.shape[1])
        nulls.append(np.asarray(free.slope(elsewhere[:p]))[:, None] * there.null[:p])
        thetas.append(np.asarray(free.theta(elsewhere[:p])))
    idle = np.flatnonzero(norms(uncertainty.jacobian)[:p] == 0).tolist()
    return undetermined(minimum.theta, nulls, thetas, idle)
