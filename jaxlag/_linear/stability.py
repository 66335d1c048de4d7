"""The kind of an equilibrium, by the second variation of the potential energy on the constraints."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from .._mechanics.singular_directions import tangent_basis
from .._model.system import System
from .rest import Curvature, Rest

ELSEWHERE = "by the eigenvalues of `linearise`"
NOISE = 0.75  # exponent of eps (1.8e-12 in double precision): a stiffness is zero below this part of the largest, in units of inertia 1
TURNS = 30  # each halves the remaining scaling, in decades


def stability(system: System, found: Rest) -> tuple[Array | None, str]:
    """The second variation, relative to M if possible, and the kind of equilibrium; None if the forces at rest have no potential."""
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
    G, units = G[np.any(G, axis=1)], _units(M, K)
    in_units = lambda A: A * units[:, None] * units[None, :]
    N, plain = tangent_basis(G * units, eps), tangent_basis(G, eps)
    along = lambda A: N.T @ in_units(A) @ N
    if np.max(np.abs(along(K - K.T)), initial=0.0) > eps**0.5 * np.max(np.abs(along(K)), initial=0.0):
        return None, f"{ELSEWHERE}: its forces have no potential"
    inertias, directions = np.linalg.eigh(along(M + M.T) / 2)
    if np.all(inertias > 100 * n * eps * np.max(inertias, initial=0.0)):
        root = directions / np.sqrt(inertias)
        stiffness = np.linalg.eigvalsh(root.T @ along(K + K.T) @ root / 2)
    else:
        stiffness = np.linalg.eigvalsh(plain.T @ (K + K.T) @ plain / 2)
    return jnp.asarray(stiffness), _kind(in_units(K + K.T) / 2, G * units, eps)


def _units(M: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Units of the coordinates in which each inertia is 1, and the stiffness of coordinates without inertia is as large as the largest."""
    mass = np.diagonal(M)
    has_mass = mass > 0
    squares = np.abs(np.diagonal(K))[has_mass] / mass[has_mass]
    largest, units = np.max(squares, initial=0.0) or 1.0, 1 / np.sqrt(np.where(has_mass, mass, 1))
    for _ in range(TURNS):  # a coupling between coordinates with and without inertia has the units of both
        size = np.max(np.abs(K * np.outer(units, units)), axis=1, initial=0.0)
        units = np.where(has_mass | (size == 0), units, units * np.sqrt(largest / np.where(size > 0, size, 1)))
    return units


def _kind(K: np.ndarray, G: np.ndarray, eps: float) -> str:
    """The kind of equilibrium, by the signs of K on the null space of G. They do not depend on units: a soft coordinate next to a stiff one
    has its own.
    """
    K = np.where(np.abs(K) <= eps**NOISE * np.max(np.abs(K), initial=0.0), 0, K)
    units = _equilibrating(K)
    N = tangent_basis(G * units, eps)
    K = N.T @ (K * np.outer(units, units)) @ N
    units = _equilibrating(K)
    values = np.linalg.eigvalsh(K * np.outer(units, units))
    dust = eps**0.625 * np.max(np.abs(values), initial=0.0)
    return "unstable" if np.any(values < -dust) else "neutral" if np.any(values <= dust) else "stable"


def _equilibrating(K: np.ndarray) -> np.ndarray:
    """D for which the largest entry in each row of D K D is one, or zero.

    Source: Ruiz, A scaling algorithm to equilibrate both rows and columns norms in matrices, RAL-TR-2001-034.
    """
    units = np.ones(len(K))
    for _ in range(TURNS):
        size = np.max(np.abs(K * np.outer(units, units)), axis=1, initial=0.0)
        units = units / np.sqrt(np.where(size > 0, size, 1))
    return units


def _by_inertia(found: Curvature) -> str:
    """The kind of equilibrium, by the signs of the pivots."""
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
    M, by_q = found.slopes
    units, n = _units(M, by_q[: len(M)]), len(M)
    forces, rows = np.abs(by_q[:n] * np.outer(units, units)), np.abs(by_q[n:] * units)
    largest = np.max(forces, initial=0.0) or 1.0, np.max(rows, axis=1, keepdims=True, initial=0.0)
    size = np.max(np.concatenate([forces / largest[0], rows / np.where(largest[1] > 0, largest[1], 1)]), axis=0, initial=0.0)
    dust = 100 * n * np.finfo(size.dtype).eps
    return tuple(name for name, x in zip(names, size, strict=True) if x <= dust)
