"""Removal of eigenvalues that are zero for all parameter values, to tell them from an eigenvalue that comes to zero."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from .eigenvalues import balanced


class Core(NamedTuple):
    """The core of matrices that depend on parameters, in units in which rows and columns are about the same size: the states on which
    something depends, and the numbers of zero eigenvalues that all matrices then share.
    """

    scale: np.ndarray  # units of all states
    states: np.ndarray
    zeros: list[int]

    @classmethod
    def of(cls, matrices: Sequence[np.ndarray]) -> "Core":
        """The core, in the units of the largest entries."""
        scale = np.asarray(balanced(jnp.asarray(np.max(np.abs(matrices), axis=0)))[0])
        scaled = [A * scale[None, :] / scale[:, None] for A in matrices]
        states = _coupled(scaled)
        return cls(scale, states, _always_zero([A[np.ix_(states, states)] for A in scaled]))

    def taken(self, A: np.ndarray) -> np.ndarray:
        """A restricted to these states, in these units."""
        return (A * self.scale[None, :] / self.scale[:, None])[np.ix_(self.states, self.states)]

    def without_zeros(self, A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`taken(A)` in the quotient by its zeros, and a basis of the remainder as columns."""
        return _without_zeros(self.taken(A), self.zeros)

    def weights(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """W for which Σ W A is yᵀ A x of `taken(A)`."""
        weights = np.zeros((len(self.scale), len(self.scale)), complex)
        weights[np.ix_(self.states, self.states)] = np.outer(left, right)
        return weights * self.scale[None, :] / self.scale[:, None]


def _coupled(matrices: Sequence[np.ndarray]) -> np.ndarray:
    """The states on which something depends in at least one matrix; the others have zero eigenvalues."""
    sizes = np.max(np.abs(matrices), axis=0)
    dust = len(sizes) * np.finfo(sizes.dtype).eps * np.max(sizes, axis=1, keepdims=True, initial=0.0)
    matters, core = sizes > dust, np.arange(len(sizes))
    while not np.all(has_effect := matters[np.ix_(core, core)].any(axis=0)):
        core = core[has_effect]
    return core


def _always_zero(matrices: Sequence[np.ndarray]) -> list[int]:
    """The number of null vectors that all matrices have, then the number in the quotient by these, and so on."""
    counts = []
    while matrices[0].size:
        values = [np.linalg.svd(A, compute_uv=False) for A in matrices]
        count = min(int(np.sum(s <= 100 * len(s) * np.finfo(s.dtype).eps * s[0])) for s in values)
        if not count:
            break
        counts.append(count)
        matrices = [_without_zeros(A, [count])[0] for A in matrices]
    return counts


def _without_zeros(A: np.ndarray, counts: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """A in the quotient by its null space, repeatedly, with `counts` dimensions each, and a basis of the remainder as columns."""
    basis = np.eye(len(A))
    for count in counts:
        _, _, Vh = np.linalg.svd(A)
        P = Vh[: len(A) - count].T
        A, basis = P.T @ A @ P, basis @ P
    return A, basis
