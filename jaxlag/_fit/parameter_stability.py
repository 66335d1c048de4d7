"""Whether the two halves of a record want the same parameters: they do not where the model misses something."""

from typing import NamedTuple

import jax
import numpy as np

from .arrow import Arrow, gathered, times, transposed
from .autocorrelation import independent_samples
from .identifiability import MANY, determined_by
from .minimum import Minimum
from .uncertainty import Uncertainty, sandwich

DIFFERENT = 1e-4  # p-value below which the halves differ


class Halves(NamedTuple):
    """The parameter that differs most: its index, and (estimate, standard error) from the first and the second half."""

    parameter: int
    first: tuple[float, float]
    second: tuple[float, float]


def different_halves(minimum: Minimum, uncertainty: Uncertainty) -> Halves | None:
    r"""The parameter that differs most between the halves of the records, where they differ at all.

    Each half has its own parameters, θ and θ + δ, in the model linearised at its minimum. With the covariance C of δ, the sandwich where
    what is then left of the residuals is correlated, $\delta^T C^{-1} \delta / p$ has the F distribution where the model is right; the
    residuals count as `independent_samples`. Of random records of 200 and 1000 samples, one in 200 or fewer was reported to differ, for
    noise of any correlation, and of 60 samples none, for white noise (tests/benchmarks/bench_coverage.py counts them).

    **Source:** Chow, Econometrica 28 (1960) 591; Andrews & Fair, Rev. Econ. Stud. 55 (1988) 615.
    """
    from scipy import special

    p, beside, J = minimum.size, minimum.problem.first_recorded, uncertainty.jacobian
    if J is None or not 0 < p <= MANY or minimum.problem.model.loss is not None or minimum.measured.size < 4 * J.size:
        return None
    both = _with_changes(J, p, _second_halves(minimum))
    gaps = np.asarray(minimum.found.gaps_jacobian)
    known = determined_by(gathered(both), np.hstack([gaps, np.zeros((len(gaps), p))]), precision=minimum.x.dtype)
    own = np.flatnonzero(known.determined[-p:]) + J.size
    r = np.concatenate([-np.asarray(minimum.found.residuals)[:beside], np.nan_to_num(minimum.flat)])
    found = known.covariance @ transposed(both, r)
    left = r - times(both, found)
    weighted = [part + 0 * measured for part, measured in zip(both.split(left)[1], minimum.weighted, strict=True)]
    covariance, correlated = sandwich(minimum, both, known.covariance, weighted)
    covariance = covariance * (left @ left) / max(minimum.measured.size - both.size, 1)
    deviation = np.sqrt(np.diag(covariance)[own])
    if not own.size or not np.all(deviation > 0):
        return None
    F = found[own] @ np.linalg.lstsq(covariance[np.ix_(own, own)], found[own], rcond=None)[0] / own.size
    if special.fdtrc(own.size, independent_samples(minimum.measured.size, correlated), F) >= DIFFERENT:
        return None
    i = int(own[np.argmax(np.abs(found[own]) / deviation)] - J.size)
    return Halves(i, *_estimates(minimum, i, J.size + i, found, covariance))


def _with_changes(J, p, late):
    """With p columns more, for the change of the parameters from the first half to the second."""
    changes = J.size + np.arange(p)
    blocks = tuple(np.concatenate([block, block[..., :p] * of[..., None]], axis=2) for block, of in zip(J.blocks, late, strict=True))
    columns = tuple(np.hstack([columns, np.tile(changes, (len(columns), 1))]) for columns in J.columns)
    wider = lambda rows: np.hstack([rows, np.zeros((len(rows), p))])
    return Arrow(wider(J.first), blocks, columns, wider(J.last))


def _estimates(minimum, i, j, found, covariance):
    """Parameter i of the first half, and with its change j of the second, each with its standard error."""
    first, change = minimum.slope[i] * found[i], minimum.slope[i] * found[j]
    variance = covariance[i, i], covariance[i, i] + 2 * covariance[i, j] + covariance[j, j]
    errors = minimum.slope[i] * np.sqrt(np.maximum(variance, 0))
    theta = minimum.theta[i] + first
    return (float(theta), float(errors[0])), (float(theta + change), float(errors[1]))


def _second_halves(minimum):
    """For each batch, which of its residuals are in the second half of their record, shaped like them."""
    halves = [np.zeros(part.shape, bool) for part in minimum.weighted]
    for e, segments in zip(minimum.recordings, minimum.segments_of_each, strict=True):
        ts = np.asarray(e.ts)  # with arrays of JAX this took a tenth of a fit
        middle = (ts[0] + ts[-1]) / 2
        for k, row, _ in segments:
            leaves, times = jax.tree.leaves(minimum.problem.batches[k].values), minimum.problem.batches[k].times
            late = [np.repeat(np.asarray(ts)[row] >= middle, int(np.prod(z.shape[2:]))) for z, ts in zip(leaves, times, strict=True)]
            halves[k][row] = np.concatenate(late)
    return halves
