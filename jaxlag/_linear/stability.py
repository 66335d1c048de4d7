"""What kind of equilibrium it is: by the second variation of the potential energy on the constraints."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from .._mechanics.singular_directions import tangent_basis
from .._model.system import System
from .rest import Curvature, Rest

ELSEWHERE = "by the eigenvalues of `linearise`"


def stability(system: System, found: Rest) -> tuple[Array | None, str]:
    """The second variation, relative to M where it can be, and what it says; None where the forces at rest have no potential."""
    if np.any(ravel_pytree(found.qdot)[0]):
        return None, ELSEWHERE
    if system.nonholonomic or system.states:
        return None, f"{ELSEWHERE}: there are states or nonholonomic constraints"
    if found.slips:
        return None, f"{ELSEWHERE}: friction slips"
    if any(np.any(force) for force, _ in found.friction.values()):
        return None, "held by friction"
    if isinstance(found.slopes, Curvature):
        return None, _by_inertia(found.slopes)
    M, by_q = found.slopes
    n, eps = len(M), float(np.finfo(M.dtype).eps)
    K, G = -by_q[:n], by_q[n:]
    N = tangent_basis(G[np.any(G, axis=1)], eps)
    K, M = N.T @ K @ N, N.T @ M @ N
    if np.max(np.abs(K - K.T), initial=0.0) > eps**0.5 * np.max(np.abs(K), initial=0.0):
        return None, f"{ELSEWHERE}: its forces have no potential"
    values, directions = np.linalg.eigh((M + M.T) / 2)
    if np.all(values > 100 * n * eps * np.max(values, initial=0.0)):
        root = directions / np.sqrt(values)
        K = root.T @ K @ root
    stiffness = np.linalg.eigvalsh((K + K.T) / 2)
    dust = eps**0.625 * np.max(np.abs(stiffness), initial=0.0)
    kind = "unstable" if np.any(stiffness < -dust) else "neutral" if np.any(stiffness <= dust) else "stable"
    return jnp.asarray(stiffness), kind


def _by_inertia(found: Curvature) -> str:
    """What the signs of the pivots say."""
    if not found.symmetric:
        return f"{ELSEWHERE}: its forces have no potential"
    if not found.certain:
        return "not judged: the pivots of so many coordinates are within rounding, as where constraints depend on each other"
    return "unstable" if found.falling > 0 else "neutral" if found.not_rising > 0 else "stable"


def undecided(found: Rest, names: Sequence[str]) -> tuple[str, ...]:
    """Coordinates on which nothing depends."""
    if any(np.any(force) for force, _ in found.friction.values()):
        return ()
    if isinstance(found.slopes, Curvature):
        return tuple(name for name, alone in zip(names, found.slopes.undecided, strict=True) if alone)
    size = np.max(np.abs(found.slopes.by_q), axis=0, initial=0.0)
    dust = 100 * len(size) * np.finfo(size.dtype).eps * np.max(size, initial=0.0)
    return tuple(name for name, x in zip(names, size, strict=True) if x <= dust)
