"""Responses of a linear system: to oscillations, steps, impulses and noise; and its zeros."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from .._model.numbers import numbers
from .._program.jit import compiled, is_concrete
from .eigenvalues import balanced


class Bode(NamedTuple):
    """`magnitude` |G| and `phase` in degrees, without jumps; each of shape (len(omega), outputs, inputs)."""

    magnitude: Float[Array, "w p m"]
    phase: Float[Array, "w p m"]


def frequencies(omega: Any) -> Array | np.ndarray:
    """Angular frequencies, checked."""
    omega = numbers(omega, "`omega`")
    if omega.ndim != 1:
        raise ValueError(f"`omega` must be a list of angular frequencies, but has shape {omega.shape}. Pass e.g. `jnp.geomspace(1, 100)`.")
    if is_concrete(omega) and not (np.all(np.isfinite(omega)) and np.all(np.asarray(omega) >= 0)):
        raise ValueError("`omega` must hold frequencies of 0 or more, but has a negative one or a NaN. That of −ω is the conjugate.")
    return omega


def frequency_response(A: Array, B: Array, C: Array, D: Array, omega: Any, sample_time: Any) -> Complex[Array, "w p m"]:
    """C (s − A)⁻¹ B + D + D₁ s + D₂ s² at s = iω; in discrete time, at z = exp(iωT) and with D alone."""

    response = _frequency_response(A, B, C, D, jnp.asarray(omega), sample_time)
    if is_concrete(response) and not np.all(np.isfinite(response)):
        worst = np.asarray(omega)[np.flatnonzero(~np.all(np.isfinite(np.asarray(response)), axis=(1, 2)))[0]]
        raise ValueError(
            f"`omega` must not hold an undamped eigenvalue, but does at {worst:g}, where the response is infinite. "
            "Leave it out, or add damping."
        )
    return response


@compiled
def _frequency_response(A, B, C, D, omega, sample_time):
    def at(w):
        s = 1j * w
        z = s if sample_time is None else jnp.exp(s * sample_time)
        held = C @ jnp.linalg.solve(z * jnp.eye(len(A)) - A, B.astype(s.dtype))
        return held + D[0] + s * D[1] + s**2 * D[2]

    return jax.vmap(at)(omega)


def bode(response: Complex[Array, "w p m"]) -> Bode:
    """Magnitude and phase."""
    return Bode(jnp.abs(response), jnp.rad2deg(jnp.unwrap(jnp.angle(response), axis=0)))


@compiled
def free_motion(A: Array, x0: Float[Array, "d k"], ts: Any) -> Float[Array, "t d k"]:
    """exp(A t) x₀ at increasing times, from t = 0."""
    units = balancing_units(A)
    balanced = A * units[None] / units[:, None]

    def step(x, dt):
        x = jax.scipy.linalg.expm(balanced * dt) @ x
        return x, x

    return units[None, :, None] * jax.lax.scan(step, x0 / units[:, None], jnp.diff(jnp.asarray(ts), prepend=0.0))[1]


@compiled
def held(A: Array, B: Array, T: Any) -> tuple[Float[Array, "d d"], Float[Array, "d m"]]:
    """exp(A T) and ∫ exp(A t) dt B over 0 … T, for inputs that are held: Van Loan, IEEE Trans. Autom. Control 23 (1978) 395."""
    d, m = B.shape
    both = jnp.block([[A, B], [jnp.zeros((m, d + m), A.dtype)]])
    units = balancing_units(both)
    after = jax.scipy.linalg.expm(both * units[None] / units[:, None] * T) * units[:, None] / units[None]
    return after[:d, :d], after[:d, d:]


SWEEPS = 20  # of balancing: each removes whole decades, and units of 1e-6 … 1e6 in a matrix of 8 rows are even after 5


def balancing_units(A: Array) -> Float[Array, " d"]:
    """Powers of two u for which rows and columns of A u/uᵀ have the same size: its exponential then loses no digits to units.

    Source: Parlett & Reinsch, Numerische Mathematik 13 (1969) 293-304.
    """
    size = jnp.abs(jax.lax.stop_gradient(A)) * (1 - jnp.eye(len(A), dtype=A.dtype))

    def turn(k, units):
        i = k % len(A)
        column, row = jnp.sum(size[:, i] / units) * units[i], jnp.sum(size[i] * units) / units[i]
        both = (column > 0) & (row > 0)
        power = jnp.round(0.5 * jnp.log2(jnp.where(both, row, 1) / jnp.where(both, column, 1)))
        return units.at[i].multiply(jnp.exp2(power))

    return jax.lax.fori_loop(0, SWEEPS * len(A), turn, jnp.ones(len(A), A.dtype))


def in_discrete_steps(A: Array, B: Array, C: Array, D: Array, steps: np.ndarray, x0: Array) -> Float[Array, "t p m"]:
    """y at the given sample numbers, for an input that is 1 from sample 0 on, or from x₀ if B and D are zero."""
    return jax.lax.scan(lambda x, _: (A @ x + B, C @ x + D), x0, length=int(np.max(steps)) + 1)[1][steps]


def spectral_density(given: Any, count: int, inputs: int) -> Complex[Array, "w m m"] | Float[Array, "w m m"]:
    """The spectral density of the inputs at each frequency, from one number or matrix, or one for each."""
    try:
        density = jnp.asarray(given)
    except (TypeError, ValueError):
        raise TypeError(f"`density` must be numbers, but is {given!r}. Pass one number or matrix, or one for each ω.") from None
    square = density if density.ndim >= 2 else density[..., None, None] * jnp.eye(inputs)[(None,) * density.ndim]
    if square.ndim > 3 or square.shape[-2:] != (inputs, inputs) or (square.ndim == 3 and len(square) != count):
        raise ValueError(f"`density` must be one number or matrix, or one for each ω, but has shape {density.shape}. Match its axes.")
    if is_concrete(density) and not np.all(np.diagonal(np.asarray(square), axis1=-2, axis2=-1).real >= 0):
        raise ValueError(
            "`density` must be zero or more for each input, but one is negative or NaN. It is a mean square for each frequency."
        )
    return jnp.broadcast_to(square, (count, inputs, inputs))


def zeros(A: Any, B: Any, C: Any, D: Any) -> np.ndarray:
    """Invariant zeros, at which [A − s, B; C, D] loses rank, by reduction to a system with the same zeros and a regular D.

    Source: Emami-Naeini & Van Dooren, Automatica 18 (1982) 415-430.
    """
    A, B, C, D = _in_units(*(np.asarray(x, float) for x in (A, B, C, D)))
    size = max(np.max(np.abs(np.block([[A, B], [C, D]])), initial=0.0), np.finfo(float).tiny)
    tolerance = 100 * sum(A.shape) * np.finfo(float).eps * size
    A, B, C, D = _with_full_rows(A, B, C, D, tolerance)
    A, C, B, D = (x.T for x in _with_full_rows(A.T, C.T, B.T, D.T, tolerance))  # of the dual system
    return np.linalg.eigvals(A - B @ np.linalg.solve(D, C)).astype(complex) if len(A) else np.zeros(0, complex)


def _in_units(A, B, C, D):
    """The system in units of states, inputs and outputs in which rows and columns are about the same size."""
    (n, m), p = B.shape, len(C)
    closed = np.block(
        [[A, B, np.zeros((n, p))], [np.zeros((m, n + m)), np.ones((m, p))], [C, D, np.zeros((p, p))]]
    )  # outputs lead to inputs
    units = np.asarray(balanced(jnp.asarray(closed))[0])
    closed = closed * units[None, :] / units[:, None]
    A, size = closed[:n, :n], np.max(np.abs(closed[:n, :n]), initial=0.0) or 1.0
    into, out_of = closed[np.r_[:n, n + m : n + m + p], n : n + m], closed[n + m :, :n]
    into = into * size / _or_one(np.max(np.abs(into), axis=0, keepdims=True, initial=0.0))
    both = np.concatenate([out_of, into[n:]], axis=1)
    both = both * size / _or_one(np.max(np.abs(both), axis=1, keepdims=True, initial=0.0))
    return A, into[:n], both[:, :n], both[:, n:]


def _or_one(x):
    return np.where(x > 0, x, 1)


def _with_full_rows(A, B, C, D, tolerance):
    """A system with the same zeros whose D has independent rows."""
    while len(C):
        U, s, _ = np.linalg.svd(D) if D.size else (np.eye(len(C)), np.zeros(0), None)
        rank = int(np.sum(s > tolerance))
        if rank == len(C):
            break
        C, D = U.T @ C, U.T @ D
        below = C[rank:]
        _, s, Vh = np.linalg.svd(below)
        seen = int(np.sum(s > tolerance))
        if not seen:
            C, D = C[:rank], D[:rank]
            break
        V = Vh[::-1].T  # states that the outputs below do not see come first
        A, B, C = V.T @ A @ V, V.T @ B, C @ V
        k = len(A) - seen
        C, D, A, B = (
            np.concatenate([A[k:, :k], C[:rank, :k]]),
            np.concatenate([B[k:], D[:rank]]),
            A[:k, :k],
            B[:k],
        )
    return A, B, C, D
