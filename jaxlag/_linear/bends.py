"""States at which a function of the system bends or jumps, where the linear system is another one on either side."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from .._mechanics.surfaces import bends, surface_values, surfaces
from .._model.flat import Flat
from .._model.system import System
from .._model.validation import at_state
from .._program.jit import seen
from .._program.size_of_terms import size_of_terms
from .matrices import Matrices

ROUNDING = 64  # eps of the terms that cancel in a surface
OTHER = 1e-6  # of an entry of A or a rate, from which on it is another one


def refuse_bends(system: System, flat: Flat, at: tuple[Any, PyTree, PyTree, PyTree], params: PyTree, of: Callable[..., Matrices]) -> None:
    """Raises where a surface is met and A, or a rate, is another one behind it; `of(t, q, qdot, states)` are the matrices."""
    t, q, qdot, states = at
    if not bends(flat) or seen((at, params)) is None:
        return
    values, slopes, sizes = (np.asarray(x) for x in at_state(_surfaces_at, system, q, qdot, params, t, states))
    n = slopes.shape[1]
    for value, slope, size in zip(values, slopes, sizes, strict=True):
        x, unravel = ravel_pytree(q)
        reach = np.abs(slope) * np.abs(np.asarray(x))
        little = ROUNDING * np.finfo(x.dtype).eps * (size + np.sum(reach))
        if abs(value) > little or not np.any(slope):
            continue
        j = int(np.argmax(np.where(slope != 0, reach, -1)))
        by = (2 * little or np.finfo(x.dtype).tiny ** 0.5) / slope[j]
        beside = [of(t, unravel(x + side * by * (np.arange(n) == j)), qdot, states) for side in (1, -1)]
        (A, rates, rounding), (B, others, _) = ([np.asarray(x) for x in (one.rates.by_state, *one.steadiness[:2])] for one in beside)
        slowly = rounding + 4 * np.max(np.abs(A), initial=0.0) * abs(by)  # by what a rate changes where nothing bends
        dust = np.finfo(A.dtype).eps ** 0.5 * np.max(np.abs(A), axis=1, keepdims=True, initial=0.0)
        if _differ(A, B, dust) or _differ(rates, others, slowly):
            raise ValueError(_said(system, q, qdot, params, t, states))


def _differ(a: np.ndarray, b: np.ndarray, little: Any) -> bool:
    return bool(np.any(np.abs(a - b) > OTHER * np.maximum(np.abs(a), np.abs(b)) + little))


def _said(system: System, q: PyTree, qdot: PyTree, params: PyTree, t: Any, states: PyTree) -> str:
    of = next(iter(surfaces(system, q, qdot, params, t, states)), None)
    found = "a function does there" if of is None else f"`{of.what}` of {of.function}, {of.line}, bends or jumps there"
    return (
        f"`q` must be on one side of what bends or jumps, but {found}: the motion is another one on either side. "
        "Move q a little to the side that is meant."
    )


def _surfaces_at(flat: Flat, t: Any, q: Array, v: Array) -> tuple[Array, Array, Array]:
    """The functions that are zero on surfaces, their slopes by q, and the size of the terms that cancel in them."""
    of = lambda q: surface_values(flat, t, q, v)
    return of(q), jax.jacfwd(of)(q), size_of_terms(of, q)
