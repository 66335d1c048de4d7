"""Eigenvalues that are zero whatever a parameter is: taken out, so that one that comes to zero is told from them."""

from collections.abc import Sequence

import numpy as np


def coupled(matrices: Sequence[np.ndarray]) -> np.ndarray:
    """The states on which something depends in one of the matrices: the others have eigenvalues of zero."""
    sizes = np.max(np.abs(matrices), axis=0)
    dust = len(sizes) * np.finfo(sizes.dtype).eps * np.max(sizes, axis=1, keepdims=True, initial=0.0)
    matters, core = sizes > dust, np.arange(len(sizes))
    while not np.all(has_effect := matters[np.ix_(core, core)].any(axis=0)):
        core = core[has_effect]
    return core


def always_zero(matrices: Sequence[np.ndarray]) -> list[int]:
    """How many eigenvectors of zero all matrices have; how many then, in the quotient by these; and so on."""
    counts = []
    while matrices[0].size:
        values = [np.linalg.svd(A, compute_uv=False) for A in matrices]
        count = min(int(np.sum(s <= 100 * len(s) * np.finfo(s.dtype).eps * s[0])) for s in values)
        if not count:
            break
        counts.append(count)
        matrices = [without_zeros(A, [count])[0] for A in matrices]
    return counts


def without_zeros(A: np.ndarray, counts: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """A in the quotient by its null space, again and again, with so many dimensions each; and a basis of what is left, as columns."""
    basis = np.eye(len(A))
    for count in counts:
        _, _, Vh = np.linalg.svd(A)
        P = Vh[: len(A) - count].T
        A, basis = P.T @ A @ P, basis @ P
    return A, basis
