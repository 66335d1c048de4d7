"""Windows along a record, and the smooth test functions on them."""

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
