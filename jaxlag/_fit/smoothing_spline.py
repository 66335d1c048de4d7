"""The motion behind a recording, without the equations of motion: splines laid through what the sensors saw."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._model.injection import call
from .._model.paths import is_within
from .._program.jit import jitted
from .experiment import Experiment, start_entries, with_own

DEGREE = 5  # accelerations are twice differentiable
GROWTH = 1.4  # from one number of pieces to the next that is tried
ITERATIONS = 8  # where what is seen is not linear in the motion


class Smooth(NamedTuple):
    """A motion at some times, flat: (T, n) each."""

    ts: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray


def smooth(experiment: Experiment, params: Any, *, between: bool = False) -> Smooth:
    """The motion at the samples or, `between` them, in the middle, where an input that is held does not jump.

    Splines of degree five, least squares in what the sensors saw, with as many pieces as generalized cross-validation likes best.

    Where the start is known it is kept; what no sensor sees is as straight as can be.

    **Source:** Craven & Wahba, Numer. Math. 31 (1979) 377-403; de Boor, A Practical Guide to Splines, chapter XIV.
    """
    e = experiment
    if e.delay is not None:
        raise ValueError("`delay` must be none where the motion is read off the measurements, but there is one. Shift `ts` by it.")
    ts = np.asarray(e.ts)
    at = (ts[1:] + ts[:-1]) / 2 if between else ts
    seen = _Sensors(e, with_own(params, e.params))
    measured = int(np.sum(np.isfinite(seen.measured)))
    best, most = None, max(4, min(len(ts) // 2, measured // (2 * seen.n), 600))
    pieces = 4.0
    while pieces <= most:
        found, squares, coefficients = _fitted(seen, ts, int(pieces))
        if coefficients < 0.7 * measured:
            score = squares * measured / (measured - coefficients) ** 2
            if best is None or score < best[0]:
                best = score, found
        pieces *= GROWTH
    if best is None:
        best = 0.0, _fitted(seen, ts, 1)[0]
    knots, C = best[1]
    return Smooth(at, *(_basis(knots, at, d) @ C for d in range(3)))


class _Sensors:
    """What is seen, flat: channels h(t, q, v, a) with weights, and rows that hold the known start."""

    def __init__(self, e, params):
        q0, unravel = ravel_pytree(e.q0)
        v0 = ravel_pytree(e.qdot0)[0]
        self.e, self.n = e, q0.size
        entries = start_entries(e)
        known = np.array([not any(is_within(entry, name) for name in e.unknown) for entry in entries])
        self.start, self.known = np.concatenate([q0, v0]), known
        flat = lambda tree: np.concatenate([np.reshape(x, (e.ts.size, -1)) for x in jax.tree.leaves(tree)], axis=1).astype(float)
        self.measured = flat(e.values)
        self.weights = 1 / flat(e.sigma) if e.sigma is not None else np.ones_like(self.measured)

        def channels(t, x):
            q, v, a = (unravel(part) for part in jnp.split(x, 3))
            nothing = _Unseen()
            return ravel_pytree(call(e.observe, "`observe`", params, t=t, q=q, qdot=v, qddot=a, multipliers=nothing))[0]

        both = lambda t, x: (channels(t, x), jax.jacfwd(channels, argnums=1)(t, x))
        self.of_motion = jitted(jax.vmap(both))


class _Unseen(dict):
    """Constraint forces, of which a spline knows nothing: a channel that asks for them counts as missing."""

    def __missing__(self, name):
        return jnp.nan


def _fitted(seen, ts, pieces):
    """Knots and coefficients of the motion with so many pieces, its sum of squares, and the number of coefficients."""
    from scipy import sparse  # SciPy comes with JAX; imported where it is needed, for that takes a while

    knots = np.quantile(ts, np.linspace(0, 1, pieces + 1))
    knots = np.concatenate([np.full(DEGREE, knots[0]), knots, np.full(DEGREE, knots[-1])])
    count = len(knots) - DEGREE - 1
    length = (ts[-1] - ts[0]) / pieces
    bases = [_basis(knots, ts, d) for d in range(3)]
    C = np.zeros((count, seen.n))
    C[:] = seen.start[: seen.n]
    first = [b[0] for b in bases[:2]]
    for iteration in range(ITERATIONS):
        motion = [b @ C for b in bases]
        h, J = (np.asarray(x) for x in seen.of_motion(jnp.asarray(ts), jnp.asarray(np.concatenate(motion, axis=1))))
        there = np.isfinite(seen.measured) & np.isfinite(h)
        weights = np.where(there, seen.weights, 0)
        r = np.where(there, seen.measured - h, 0) * weights
        if not there.any():
            raise ValueError(
                "`observe` must see positions, velocities or accelerations, but sees none. Measure some, or simulate by `fit`."
            )
        if iteration and np.sum(r**2) > (1 - 1e-6) * squares:  # noqa: F821
            break
        squares, kept = np.sum(r**2), C.copy()
        J = np.where(there[:, :, None], J, 0) * weights[:, :, None]
        A = _rows(knots, ts, np.split(J, 3, axis=2), bases)
        size = np.sqrt(A.multiply(A).sum() / max(count * seen.n, 1))
        hold, off = [], []
        for i in np.flatnonzero(seen.known):
            d, j = divmod(i, seen.n)
            unit = np.zeros((seen.n,))
            unit[j] = 1e3 * size * length**d
            hold.append(np.outer(first[d], unit).ravel())
            off.append(1e3 * size * length**d * (seen.start[i] - first[d] @ C[:, j]))
        bend = sparse.kron(sparse.csr_matrix(np.diff(np.eye(count), 3, axis=0)), sparse.eye(seen.n)) * (1e-6 * size)
        held = sparse.csr_matrix(np.array(hold).reshape(-1, count * seen.n))
        right = A.T @ r.ravel() + held.T @ np.array(off) - bend.T @ (bend @ C.ravel())
        C = C + sparse.linalg.spsolve(A.T @ A + held.T @ held + bend.T @ bend, right).reshape(count, seen.n)
    else:
        kept = C
    return (knots, kept), squares, count * seen.n


def _basis(knots, ts, derivative):
    """Values of the splines, or of their derivatives, at the times."""
    from scipy.interpolate import BSpline

    spline = BSpline(knots, np.eye(len(knots) - DEGREE - 1), DEGREE)
    return (spline.derivative(derivative) if derivative else spline)(ts)


def _rows(knots, ts, Js, bases):
    """Σ J_d ⊗ B_d, a row for each sample and channel, over coefficients (piece, coordinate): of each only the six that are not zero."""
    from scipy import sparse

    (T, channels, n), count = Js[0].shape, bases[0].shape[1]
    first = np.clip(np.searchsorted(knots, ts, side="right") - 1 - DEGREE, 0, count - DEGREE - 1)
    near = first[:, None] + np.arange(DEGREE + 1)
    entries = sum(J[:, :, None, :] * np.take_along_axis(B, near, axis=1)[:, None, :, None] for J, B in zip(Js, bases, strict=True))
    row = np.arange(T * channels).reshape(T, channels, 1, 1)
    column = (near[:, :, None] * n + np.arange(n))[:, None]
    row, column = (np.broadcast_to(index, entries.shape).ravel() for index in (row, column))
    return sparse.csr_matrix((entries.ravel(), (row, column)), shape=(T * channels, count * n))
