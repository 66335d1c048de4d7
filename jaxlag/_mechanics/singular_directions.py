"""Directions for which a system cannot be solved, and how a failure names the coordinates concerned."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, PyTree

from .._model.flat import Flat
from .._model.paths import entry_names
from .._model.system import System
from .._model.validation import at_state, coordinates
from .._program.jit import is_concrete
from .._program.walker import used_arguments
from .lagrange import constraint_rows, inertia
from .massless import first_order, with_masses
from .saddle_point import NO_INERTIA

UNDEFINED = (
    "the functions of the system must return finite numbers, but one returns a NaN or an infinity there. Look for what is undefined, such "
    "as the root of a negative number or 0/0, for missing values, and for a motion that grows without bounds."
)
NOT_AFFINE = (
    "`nonholonomic` must be affine in qdot, but one is not. Write it as a sum of velocities with coefficients that depend on t and q: its "
    "derivative with respect to time, or a root of it."
)


def explained(reason: str, system: System, q: PyTree, qdot: PyTree, params: PyTree, t: Any, states: PyTree = None) -> str:
    """The reason, and the coordinates concerned, where there are any and the numbers are known; or that numbers are undefined."""
    about = {NO_INERTIA: _without_inertia, NOT_AFFINE: _nonaffine}.get(reason)
    if about is None or not is_concrete(q, qdot, params, t):
        return reason
    found = jax.tree.map(np.asarray, at_state(_matrices, system, q, qdot, params, t, states))
    if not is_defined(found):
        return UNDEFINED
    names = entry_names(coordinates(q, "q"), "q")
    listed = [repr(names[i]) for i in about(found)]
    says = {NO_INERTIA: "Without inertia and unconstrained here: ", NOT_AFFINE: "It is not affine in the velocity of: "}[reason]
    return f"{reason} {says}{', '.join(listed)}." if listed else reason


def tangent_basis(G: np.ndarray, eps: float) -> np.ndarray:
    """A basis of the motions that the constraints allow, as columns: the null space of G, its rows scaled to unit length."""
    size = np.linalg.norm(G, axis=1, keepdims=True)
    if not G.shape[0]:
        return np.eye(G.shape[1])
    _, s, Vt = np.linalg.svd(G / np.where(size > 0, size, 1))
    return Vt[int(np.sum(s > eps**0.3125 * max(s[0], eps))) :].T


def own_units(M: np.ndarray, G: np.ndarray) -> np.ndarray:
    """Units of the coordinates in which the inertia of each is 1, and what has none counts in no row of G for more than the others."""
    mass = np.diagonal(M)
    units = np.where(mass > 0, 1 / np.sqrt(np.where(mass > 0, mass, 1)), 0)
    rows, size = np.max(np.abs(G) * units, axis=1, keepdims=True, initial=0.0), np.abs(G)
    tied = (rows > 0) & (size > 0)
    beside = np.min(np.where(tied, rows / np.where(tied, size, 1), np.inf), axis=0, initial=np.inf)
    return np.where(mass > 0, units, np.where(np.isfinite(beside), beside, 1))


def massless_coordinates(M: np.ndarray, G: np.ndarray) -> list[int]:
    """Coordinates that take part in a direction that G allows and to which M gives no inertia."""
    eps, units = float(np.finfo(M.dtype).eps), own_units(M, G)
    N = tangent_basis(G * units, eps)
    if not N.size:
        return []
    inertias, directions = np.linalg.eigh(N.T @ (M * np.outer(units, units)) @ N)
    free = np.abs(N @ directions[:, inertias <= 100 * len(M) * eps])
    return [i for i, moves in enumerate(free) if np.any(moves > 1e-6)]


def faint_direction(M: np.ndarray, G: np.ndarray) -> tuple[float, list[int]]:
    """The least inertia in a direction that G allows, where each coordinate alone has 1, and the coordinates that take part in it."""
    size = np.sqrt(np.diagonal(M))
    if not np.all(size > 0):
        return 1.0, []
    N = tangent_basis(G / size, float(np.finfo(M.dtype).eps))
    inertias, directions = np.linalg.eigh(N.T @ (M / np.outer(size, size)) @ N)
    return (float(inertias[0]), [int(i) for i in np.flatnonzero(np.abs(N @ directions[:, 0]) > 0.3)]) if inertias.size else (1.0, [])


def is_defined(found: dict) -> bool:
    """Whether M, G and, where present, the residuals of the constraints are finite."""
    named = [found["M"], found["G"], *found.get("position", {}).values(), *found.get("velocity", {}).values()]
    return all(np.all(np.isfinite(x)) for x in named)


def _without_inertia(found):
    """Those that nothing decides; where that is none, D does not resist at this velocity, and all are named."""
    return massless_coordinates(found["with_masses"], found["G"]) or massless_coordinates(found["M"], found["G"])


def _nonaffine(found):
    return np.flatnonzero(found["not_affine_in"])


def _matrices(flat: Flat, t, q, v):
    decided = first_order(flat, t, q, v).coordinates
    return {
        "M": inertia(flat, t, q, v)[0].as_matrix(),
        "with_masses": inertia(with_masses(flat, decided, t, q, v) if decided.size else flat, t, q, v)[0].as_matrix(),
        "G": constraint_rows(flat, t, q, v)[1],
        "not_affine_in": not_affine_in(flat, t, q, v),
    }


def not_affine_in(flat: Flat, t, q, v) -> Bool[Array, " n"]:
    """In which velocities a nonholonomic constraint is not affine: ∂a/∂q̇ must be the same at two of them.

    Costs nothing where the program of ∂a/∂q̇ does not use q̇, as where a is written in sums and products.
    """
    slope = jax.jacfwd(flat.nonholonomic, argnums=2)
    t, q, v = jax.lax.stop_gradient((t, q, v))
    if flat.nonholonomic(t, q, v).size == 0 or not used_arguments(slope, t, q, v)[2]:
        return jnp.zeros(v.size, bool)
    here, there = slope(t, q, v), slope(t, q, v + (1 + jnp.abs(v)) * (1 + np.arange(v.size, dtype=v.dtype) / v.size))
    uneven = jnp.abs(here - there) > jnp.finfo(v.dtype).eps ** 0.5 * jnp.max(jnp.abs(here) + jnp.abs(there))
    return jnp.any(uneven, axis=0)
