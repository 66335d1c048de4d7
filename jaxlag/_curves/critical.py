"""Where periodic motions change: a multiplier at 1, at −1, or a pair of them on the unit circle.

Source: Kuznetsov, Elements of Applied Bifurcation Theory, section 10.2.2 (bordered matrices, bialternate products).
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

FOLD, FLIP, TORUS = "fold", "flip", "torus"


def critical_matrix(kind: str, change: Array | np.ndarray) -> Array | np.ndarray:
    """The matrix that is singular at a special point; `change` is the Jacobian of P(x) − x."""
    xp = np if isinstance(change, np.ndarray) else jnp
    k = change.shape[0]
    P = change + xp.eye(k)
    if kind == TORUS:
        i, j = np.triu_indices(k, 1)
        return P[np.ix_(i, i)] * P[np.ix_(j, j)] - P[np.ix_(i, j)] * P[np.ix_(j, i)] - xp.eye(len(i))
    return P + xp.eye(k) if kind == FLIP else change


def borders_of(A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vectors b, c for which [[A, b], [cᵀ, 0]] is regular, at a matrix that is nearly singular."""
    u, _, v = np.linalg.svd(A)
    return u[:, -1], v[-1]


def crossing(J: np.ndarray) -> np.ndarray:
    """The direction of another curve where two cross: of the two in which the Jacobian is singular, the one with less of the parameter."""
    return min(np.linalg.svd(J)[2][-2:], key=lambda free: abs(free[-1]))


def critical(kind: str, change: Array | np.ndarray, b: Array | np.ndarray, c: Array | np.ndarray) -> Any:
    """A smooth function that is zero where the critical matrix is singular."""
    xp = np if isinstance(change, np.ndarray) else jnp
    A = critical_matrix(kind, change)
    whole = xp.concatenate([xp.concatenate([A, b[:, None]], 1), xp.append(c, 0.0)[None]])
    return xp.linalg.solve(whole, xp.append(xp.zeros_like(b), 1.0))[-1]
