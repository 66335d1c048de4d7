"""The covariance of a regression by the scatter of overlapping windows."""

from collections.abc import Sequence

import numpy as np

from .windows import APART

NEIGHBOURS = round(1 / APART)  # on each side, whose residuals fit the same noise
OVERLAP = 2.0  # half widths up to which windows have samples in common
COLOUR = 0.1  # of a record, over which residuals count as correlated at least
MOST_LEVERAGE = 0.9
MANY = 50  # parameters, from which on leverage is not computed


def scatter(covariance: np.ndarray, parts: Sequence[tuple], lags: Sequence[int]) -> np.ndarray:
    r"""The sandwich $(J^T J)^{-1} S (J^T J)^{-1}$, with S from the products of the scores $J_k^T r_k$ of windows up to some lags apart.

    **Arguments:** `covariance`: (JᵀJ)⁻¹, (p, p). `parts`: of each record the weighted residuals r (K, C) and J (K, C, p) of its windows
    in order, zero where a window is left out. `lags`: of each record.

    Residuals are smaller than the noise where few windows decide. So each score is divided by one minus the part that its neighbours have
    in what is known, as the jackknife does that leaves them out.

    **Source:** Newey & West, Econometrica 55 (1987) 703; Bell & McCaffrey, Survey Methodology 28 (2002) 169 (leverage of clusters).
    """
    size = np.sqrt(np.diag(covariance))
    size = np.where(size > 0, size, 1)
    values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    root = size[:, None] * vectors * np.sqrt(np.maximum(values, 0))
    S = np.zeros_like(covariance)
    for (r, J), count in zip(parts, lags, strict=True):
        U = J @ root
        S += _long_run(_without_leverage(np.einsum("kcp,kc->kp", U, r), U), count)
    return root @ S @ root.T


def _without_leverage(scores, U):
    K, p = scores.shape
    if p > MANY:
        return scores
    totals = np.concatenate([np.zeros((1, p, p)), np.cumsum(np.einsum("kcp,kcq->kpq", U, U), axis=0)])
    k = np.arange(K)
    near = totals[np.minimum(k + NEIGHBOURS + 1, K)] - totals[np.maximum(k - NEIGHBOURS, 0)]
    leverage, directions = np.linalg.eigh(near)
    along = np.einsum("kpd,kp->kd", directions, scores) / (1 - np.clip(leverage, 0, MOST_LEVERAGE))
    return np.einsum("kpd,kd->kp", directions, along)


def _long_run(scores, lags):
    """Σ_k (1 − |k|/lags) Σ_t s_t s_{t+k}ᵀ, |k| < lags: the mean product of the sums of `lags` neighbours with themselves."""
    K, p = scores.shape
    totals = np.cumsum(np.concatenate([np.zeros((lags, p)), scores, np.zeros((lags - 1, p))]), axis=0)
    sums = totals[lags:] - totals[:-lags]
    return sums.T @ sums / lags
