"""Windows along a record, and the smooth test functions on them."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

POWER = 4  # of the test functions: three derivatives vanish at the ends of a window
APART = 0.25  # half windows from one window to the next


class Windows(NamedTuple):
    r"""K windows of half width h, with $\varphi(t) = (1 - s^2)^4$, $s = (t - t_k)/h$, as sums over the N nodes of a quadrature.

    `value` (K, N) integrates against φ, `rate` against φ̇; sparse. `near_rest`, (K,): the part of ∫φ dt in which friction may stick.
    """

    half: float
    value: Any
    rate: Any
    near_rest: np.ndarray

    @classmethod
    def along(cls, nodes: np.ndarray, quadrature: np.ndarray, moves: np.ndarray, span: tuple[float, float], half: float) -> "Windows":
        """As many as fit into the record, symmetric about its middle; `moves`, (N,), is False where friction may stick."""
        from scipy import sparse  # SciPy is a dependency of JAX; imported here because that takes a while

        begin, end = span
        count = int((end - begin - 2 * half) / (APART * half) * (1 + 1e-9)) + 1 if end - begin >= 2 * half else 0
        centres = (begin + end) / 2 + APART * half * (np.arange(count) - (count - 1) / 2)
        first, last = (np.searchsorted(nodes, centres + side) for side in (-half, half))
        row = np.repeat(np.arange(count), last - first)
        node = np.arange(row.size) + np.repeat(first - np.cumsum(last - first) + last - first, last - first)
        s = (nodes[node] - centres[row]) / half
        bump = np.maximum(1 - s**2, 0)
        matrix = lambda x: sparse.csr_matrix((x * quadrature[node], (row, node)), shape=(count, nodes.size))
        value, rate = matrix(bump**POWER), matrix(-2 * POWER * s * bump ** (POWER - 1) / half)
        return cls(half, value, rate, value @ (~moves).astype(float) / np.maximum(value.sum(axis=1).A1, 1e-300))

    def without_sums(self) -> "Windows":
        """The same, to be kept where all integrals are known."""
        return self._replace(value=None, rate=None)

    def integrals(self, momentum: np.ndarray, force: np.ndarray, constraints: np.ndarray) -> np.ndarray:
        """∫φ̇ p + φ F dt, and the means of the constraints: (K, n + m, ...), from values at the nodes, (N, n or m, ...)."""
        against = lambda A, x: (A @ x.reshape(len(x), int(np.prod(x.shape[1:])))).reshape(A.shape[0], *x.shape[1:])
        size = np.maximum(self.value.sum(axis=1).A1, 1e-300).reshape(-1, *[1] * (constraints.ndim - 1))
        moved = against(self.rate, momentum) + against(self.value, force)
        return np.concatenate([moved, against(self.value, constraints) / size], axis=1)


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
