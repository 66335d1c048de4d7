"""Directions for which a system cannot be solved, and how a failure names the coordinates concerned."""

import enum
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
from .augmented_inertia import unit_lengths, units_alike
from .lagrange import constraint_rows, inertia
from .massless import first_order, with_masses
from .pseudo_inverse import CLEAR
from .self_consistent import NOT_CONSISTENT

LOOKS, BESIDE, FROM_REST = 7, 3, 12  # at a constraint, in so many decades relative to the velocities that there are, or that have inertia 1


class Failure(enum.Enum):
    """Why a state cannot be moved on from, or is not found; a motion ends for a result of the same name."""

    undefined = (
        "the functions of the system must return finite numbers, but one returns a NaN or an infinity there. Look for what is undefined, "
        "such as the root of a negative number or 0/0, for missing values, and for a motion that grows without bounds."
    )
    no_inertia = (
        "`lagrangian` must give every direction inertia that no constraint holds, but the mass matrix is singular "
        "(or not positive) on the null space of the constraints. Add the missing mass (a small one with a solver for stiff systems, "
        "`solver=diffrax.Kvaerno5()`), a constraint that holds it, or a dissipation function of its velocity: a coordinate that is not in "
        "the kinetic energy at all may move by that alone, where it resists at every velocity and constraints on it are stated once. Or "
        "leave the coordinate out."
    )
    not_affine = (
        "`nonholonomic` must be affine in qdot, but one is not. Write it as a sum of velocities with coefficients that depend on t and q: "
        "its derivative with respect to time, or a root of it."
    )
    impossible_start = (
        "`holonomic` and `nonholonomic` must be satisfied by some state near the start, but none was found. "
        "Start nearer, fix fewer coordinates, or look for constraints that contradict each other, or of which one is lost in the rounding "
        "of another."
    )
    no_multipliers = NOT_CONSISTENT


def explained(failure: Failure, system: System, q: PyTree, qdot: PyTree, params: PyTree, t: Any, states: PyTree = None) -> str:
    """The reason, and the coordinates concerned, where there are any and the numbers are known; or that numbers are undefined."""
    if failure in (Failure.undefined, Failure.impossible_start) or not is_concrete(q, qdot, params, t):
        return failure.value
    found = jax.tree.map(np.asarray, at_state(_matrices, system, q, qdot, params, t, states))
    if not is_defined(found):
        return Failure.undefined.value
    says, concerned = CONCERNED.get(failure, ("", lambda found: []))
    names = entry_names(coordinates(q, "q"), "q")
    listed = [repr(names[i]) for i in concerned(found)]
    return f"{failure.value} {says}: {', '.join(listed)}." if listed else failure.value


def tangent_basis(G: np.ndarray, eps: float, least: float | None = None) -> np.ndarray:
    """A basis of the motions that the constraints allow, as columns: the null space of G, its rows scaled to unit length. Singular values
    below the `least` relative to the largest count as zero.
    """
    size = np.linalg.norm(G, axis=1, keepdims=True)
    if not G.shape[0]:
        return np.eye(G.shape[1])
    _, s, Vt = np.linalg.svd(G / np.where(size > 0, size, 1))
    return Vt[int(np.sum(s > (eps**CLEAR if least is None else least) * np.max(s, initial=eps))) :].T


def massless_coordinates(M: np.ndarray, G: np.ndarray, units: np.ndarray) -> list[int]:
    """Coordinates that take part in a direction that G allows and to which M gives no inertia, in `units` in which each has about one."""
    eps = float(np.finfo(M.dtype).eps)
    N, M = tangent_basis(G * units, eps), M * np.outer(units, units)
    if not N.size:
        return []
    inertias, directions = np.linalg.eigh(N.T @ M @ N)
    free = np.abs(N @ directions[:, inertias <= 100 * len(M) * eps * np.max(np.abs(M), initial=0.0)])
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
    """Coordinates that nothing decides; where that is none, D does not resist at this velocity, and all are named."""
    G = found["G"]
    return massless_coordinates(found["with_masses"], G, found["units_with_masses"]) or massless_coordinates(found["M"], G, found["units"])


def _nonaffine(found):
    return np.flatnonzero(found["not_affine_in"])


CONCERNED = {
    Failure.no_inertia: ("Without inertia and unconstrained here", _without_inertia),
    Failure.not_affine: ("It is not affine in the velocity of", _nonaffine),
}


def _matrices(flat: Flat, t, q, v):
    decided, G = first_order(flat).coordinates, constraint_rows(flat, t, q, v)[1]
    M, with_all = (inertia(of, t, q, v).as_matrix() for of in (flat, with_masses(flat, decided) if decided.size else flat))
    return {
        "M": M,
        "with_masses": with_all,
        "G": G,
        "units": unit_lengths(M, G),
        "units_with_masses": unit_lengths(with_all, G),
        "not_affine_in": not_affine_in(flat, t, q, v),
    }


def not_affine_in(flat: Flat, t, q, v) -> Bool[Array, " n"]:
    """In which velocities a nonholonomic constraint is not affine: ∂a/∂q̇ must be the same at all of them.

    It is looked at where velocities are of the size that they have, smaller and larger; of what rests, in many decades. Costs nothing
    where the program of ∂a/∂q̇ does not use q̇, as where a is written in sums and products.
    """
    slope = jax.jacfwd(flat.nonholonomic, argnums=2)
    t, q, v = jax.lax.stop_gradient((t, q, v))
    if flat.nonholonomic(t, q, v).size == 0 or not used_arguments(slope, t, q, v)[2]:
        return jnp.zeros(v.size, bool)
    units = units_alike(inertia(flat, t, q, v), [slope(t, q, v)])
    fastest = jnp.max(jnp.abs(v) / jnp.where(units > 0, units, jnp.inf))
    sizes = jnp.where(fastest > 0, fastest, 1) * 10.0 ** (jnp.where(fastest > 0, BESIDE, FROM_REST) * np.linspace(-1, 1, LOOKS))
    units = jnp.where(units > 0, units, 1)
    aside = units * (1 + np.arange(v.size, dtype=v.dtype) / v.size)
    in_units = lambda v: units[None] * slope(t, q, v)
    here, there = in_units(v)[None], jax.vmap(lambda size: in_units(v + size * aside))(sizes.astype(v.dtype))
    largest = jnp.max(jnp.abs(here) + jnp.abs(there), axis=2, keepdims=True)
    return jnp.any(jnp.abs(here - there) > jnp.finfo(v.dtype).eps ** 0.5 * largest, axis=(0, 1))
