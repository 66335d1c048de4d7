"""Whether a state is steady: nothing accelerates there, and the linear system does not change along the motion."""

from collections.abc import Callable, Sequence

import jax
import numpy as np

from .._program.jit import is_concrete
from .matrices import Matrices

CURE = "Look for a steady state by `equilibrium` or `steady`, or take it all the same: `frozen=True`."


def refuse_unsteady(found: Matrices, later: Callable[[float], Matrices], names: Sequence[str]) -> None:
    """Raises if q̈ or ż is not zero, or A changes a little later; `names`: the coordinates and states."""
    if is_concrete(found) and (reason := why_unsteady(found, later, names)):
        raise ValueError(f"{reason} {CURE if is_determined(found) else DEFINED}")


def is_determined(found: Matrices) -> bool:
    """Whether the motion and its derivatives are."""
    numbers = np.asarray(found.steadiness.left), np.asarray(found.rates.by_state)
    return bool(found.steadiness.determined) and all(np.all(np.isfinite(x)) for x in numbers)


def why_unsteady(found: Matrices, later: Callable[[float], Matrices], names: Sequence[str]) -> str:
    """A sentence that says what is not steady; empty if everything is."""
    left, allowed, A = (np.asarray(x) for x in (found.steadiness.left, found.steadiness.allowed, found.rates.by_state))
    if not is_determined(found):
        return UNDEFINED
    if np.any(np.abs(left) > allowed):
        i = int(np.argmax(np.abs(left) / np.where(allowed > 0, allowed, np.finfo(A.dtype).tiny)))
        return f"`q` and `qdot` must be a steady state, but {names[i]!r} accelerates or changes by {left[i]:.4g}."
    then = np.asarray(later(a_little(A)).rates.by_state)
    tolerance = np.finfo(A.dtype).eps ** 0.375 * np.max(np.abs(A), axis=1, keepdims=True, initial=0.0)
    changed = np.abs(then - A) > tolerance + np.finfo(A.dtype).eps ** 0.5 * np.max(np.abs(A), initial=0.0)
    return "`q` and `qdot` must be a motion along which nothing changes, but what the system does near it does." if np.any(changed) else ""


def a_little(A: np.ndarray) -> float:
    """A time that is short for the fastest motion of the system."""
    fastest = float(np.max(np.abs(np.linalg.eigvals(A)), initial=0.0)) if np.all(np.isfinite(A)) else 0.0
    return 0.1 / fastest if fastest > 0 else 1.0


UNDEFINED = "`q` and `qdot` must be a state at which the motion and its derivatives are finite and determined, but they are not."
DEFINED = "`examine` says which coordinate is without inertia or which function is not finite."


def moved_on(at, step):
    """The state a little later in a steady motion."""
    t, q, qdot, states = at
    return t + step, jax.tree.map(lambda x, v: x + step * v, q, qdot), qdot, states
