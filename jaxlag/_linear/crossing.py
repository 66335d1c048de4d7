"""Crossings of the imaginary axis: the value of the parameter to rounding, and its derivative with respect to all others."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from .._model.system import System
from .._program.jit import compiled
from .branches import Transition
from .matrices import Choice, matrices
from .zero_eigenvalues import Core

STEPS = 5  # of Newton's method, from a bracketed crossing down to rounding
MEET = 1e-5  # yᴴx of unit vectors below which two eigenvalues meet in one eigenvector
FEW = 256  # most variables for which A is differentiated in forward mode; with more, in reverse mode


class Crossing(eqx.Module):
    """Where a branch crosses the imaginary axis: the `value` of the parameter, the `frequency` |Im λ| in rad/time, its `kind`, "flutter" (a
    pair that oscillates) or "divergence" (λ = 0), and the `direction`: whether increasing the parameter "destabilises" or "stabilises".
    """

    value: Float[Array, ""]
    frequency: float = eqx.field(static=True)
    kind: str = eqx.field(static=True)
    direction: str = eqx.field(static=True)


def located(matrix: Callable[[float], np.ndarray], transition: Transition) -> tuple[float, complex]:
    """The parameter p at a transition and the eigenvalue there: Newton's method on Re(yᴴ A(p) x/yᴴx).

    Bracketing ends when Re λ is within rounding of zero. The error of the quotient is quadratic in the errors of x and y, so a hundredth of
    this or less remains. Where two eigenvalues meet in one eigenvector, the quotient is not smooth, and the bracket is the result.
    """
    at, value = transition.at, transition.eigenvalue
    for _ in range(STEPS):
        A, h = matrix(at), np.finfo(matrix(at).dtype).eps ** 0.25 * (transition.far - at)
        y, x = _eigenvectors(A, value)
        if abs(y @ x) < MEET:
            break
        found = y @ A @ x / (y @ x)
        slope = np.real(y @ (matrix(at + h) - A) @ x / (y @ x)) / h
        step = -found.real / slope if slope else np.inf
        if not abs(at + step - transition.at) <= 0.01 * abs(transition.far - transition.at):
            return transition.at, transition.eigenvalue
        at, value = at + step, 1j * found.imag
        if abs(step) <= np.finfo(float).eps * abs(at):
            break
    return at, value


def _eigenvectors(A: np.ndarray, value: complex) -> tuple[np.ndarray, np.ndarray]:
    """Left and right unit eigenvectors yᴴ and x of the eigenvalue nearest to a value."""
    import scipy.linalg  # imported here because that takes a while

    values, left, right = scipy.linalg.eig(A, left=True, right=True)
    i = int(np.argmin(np.abs(values - value)))
    return left[:, i].conj(), right[:, i]


def moving(
    point: Float[Array, ""],
    A: np.ndarray,
    core: Core,
    value: complex,
    of: tuple[Choice, System, Any],
    state: Callable[[Any], PyTree],
    moved: PyTree,
) -> Float[Array, ""]:
    """The parameter at a crossing, differentiable once in `moved`, on which A depends; `state` gives the state as a function of the
    parameter alone.

    dp = −Re(yᴴ dA x/yᴴx)/Re(yᴴ A' x/yᴴx). Where two eigenvalues meet in one eigenvector, yᴴx = 0, and yᴴ (dA + A' dp) x = 0 keeps them
    together.
    """
    y, x = _eigenvectors(core.taken(A), value)
    weights = core.weights(y, x)
    known, along = jax.jvp(state, (point,), (jnp.ones_like(point),))
    parts = _projected(np.stack([weights.real, weights.imag]).astype(A.dtype), *of, known)
    slopes = [np.asarray(part[0]) + 1j * np.asarray(part[1]) for part in parts]
    slope = sum(np.sum(part * np.asarray(d)) for part, d in zip(slopes, _numbers(along), strict=True))
    scale = slope if abs(y @ x) < MEET else np.real(slope / (y @ x)) * (y @ x)
    gradient = [jnp.asarray(-np.real(part / scale)) for part in slopes]
    return _moving(point, gradient, _numbers(moved))


@compiled
def _projected(weights: Float[Array, "k d d"], choice: Choice, system: System, t: Any, state: PyTree) -> list[Float[Array, "k ..."]]:
    """Derivatives of Σ W A for each W with respect to each array of a state; A itself needs no compilation of its own."""
    leaves, structure = jax.tree.flatten(state)
    moves = [_is_number(leaf) for leaf in leaves]
    flat, unravel = ravel_pytree(_numbers(state))

    def sums(flat):
        numbers = iter(unravel(flat))
        at = jax.tree.unflatten(structure, [next(numbers) if moved else leaf for moved, leaf in zip(moves, leaves, strict=True)])
        return jnp.einsum("kij,ij->k", weights, matrices(choice, system, t, *at).rates.by_state)

    rows = (jax.jacfwd if flat.size <= FEW else jax.jacrev)(sums)(flat)
    return jax.vmap(unravel)(rows)


def _is_number(leaf):
    return jnp.issubdtype(jnp.result_type(leaf), jnp.inexact)


def _numbers(tree: PyTree) -> Sequence[Any]:
    """The arrays that can vary."""
    return [leaf for leaf in jax.tree.leaves(tree) if _is_number(leaf)]


@jax.custom_jvp
def _moving(at, gradient, numbers):
    """The value at a crossing, differentiable once in `numbers`."""
    return at


@_moving.defjvp
def _moving_rule(primals, tangents):
    (at, gradient, numbers), (_, _, d_numbers) = primals, tangents
    parts = [jnp.sum(part * d) for part, d in zip(_once(gradient, numbers), d_numbers, strict=True)]
    return _moving(at, gradient, numbers), sum(parts, start=jnp.zeros_like(at))


@jax.custom_jvp
def _once(gradient, numbers):
    return gradient


@_once.defjvp
def _once_rule(primals, tangents):
    raise NotImplementedError("the value at a crossing must be differentiated once only, but is twice. Take differences of its gradient.")
