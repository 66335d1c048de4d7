"""Nonlinear least squares, from residuals and Jacobians that come together, one problem or a batch of them."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx

from ._compiled import compiled

RUNNING, CONVERGED, STALLED, MAX_STEPS, INTERRUPTED, FAILED = range(6)
REASONS = (
    "still running",
    "converged",
    "no step lowers the cost any more, though it is not flat",
    "`max_steps` was reached",
    "interrupted by the keyboard; these are the best parameters so far",
    "the motion at the start could not be computed",
)


class Iterate(NamedTuple):
    """Where the iteration stands; with a batch, each array has it as its first axis."""

    y: Any
    residuals: Any
    jacobian: Any
    rest: Any
    cost: Any  # ½|r|²
    damping: Any
    scale: Any  # largest norm each column of the Jacobian has had
    status: Any


class Outcome(NamedTuple):
    """The best iterate, the steps it took, and the cost after each of them."""

    best: Iterate
    steps: int
    costs: np.ndarray


def levenberg_marquardt(
    linearise: Callable[[Any], tuple[Any, Any, Any]],
    y: Any,
    *,
    freedom: int,
    max_steps: int,
    tolerance: float,
    progress: Callable[[int, float], None] | None = None,
) -> Outcome:
    """Minimises ½|r(y)|². `linearise(y)` returns r, its Jacobian, and whatever else is wanted of the best y.

    Ends where the next step would change no parameter by more than `tolerance` of its standard error: |J Δy| ≤ tolerance · σ̂, with
    σ̂² = |r|² / `freedom`. Where y has a batch axis, `linearise` and all that is returned have it too.

    **Source:** Moré, The Levenberg-Marquardt algorithm, Lecture Notes in Mathematics 630 (1978); Madsen, Nielsen & Tingleff,
    Methods for Non-Linear Least Squares Problems (2004), section 3.2.
    """
    begin, advance = ONE if y.ndim == 1 else MANY
    now, trial, predicted = begin(y, linearise(y))
    costs = [now.cost]
    step, limits = 0, (jnp.full(y.shape[:-1], tolerance, y.dtype), jnp.full(y.shape[:-1], freedom, y.dtype))
    try:
        for step in range(1, max_steps + 1):
            now, trial, predicted = advance(now, trial, predicted, linearise(trial), *limits)
            costs.append(now.cost)
            if progress:
                progress(step, float(np.min(now.cost)))
            if np.all(np.asarray(now.status) != RUNNING):
                break
        ended = MAX_STEPS
    except KeyboardInterrupt:
        ended = INTERRUPTED
    status = np.asarray(now.status)
    return Outcome(now._replace(status=np.where(status == RUNNING, ended, status)), step, np.array(costs))


def _cost(r):
    return 0.5 * jnp.sum(r**2, axis=-1)


def _norms(J):
    return jnp.linalg.norm(J, axis=0)


def _begin(y, first):
    r, J, rest = first
    now = Iterate(y, r, J, rest, _cost(r), jnp.asarray(1e-2, y.dtype), _norms(J), jnp.asarray(RUNNING))
    return now, *_propose(now)


def _propose(now):
    """The damped Gauss–Newton step, in columns of norm one."""
    scale = jnp.where(now.scale > 0, now.scale, 1)
    J = lx.MatrixLinearOperator(now.jacobian / scale[None, :])
    info = optx.FunctionInfo.ResidualJac(now.residuals, J)
    descent = optx.DampedNewtonDescent()
    step, _ = descent.step(1 / now.damping, descent.query(now.y, info, None))  # type: ignore[arg-type]
    return now.y + step / scale, J.mv(step)


def _advance(now, trial, predicted, seen, tolerance, freedom):
    """Takes the trial where it is better, sets the damping by how much it is, and proposes the next."""
    r, J, rest = seen
    before, after = now.cost, _cost(r)
    # What was expected of the step: ½|r|² − ½|r + J step|². Too little to be seen above the rounding of what is integrated, it is trusted.
    expected = -predicted @ now.residuals - 0.5 * predicted @ predicted
    newton_like, unseen = now.damping < 0.5, jnp.finfo(r.dtype).eps ** 0.5 * before
    better = after <= before
    taken = better | (newton_like & (expected <= unseen) & (after - before <= unseen))
    took = lambda new, old: jax.tree.map(lambda a, b: jnp.where(taken, a, b), new, old)
    well = (before - after) > 0.25 * expected
    damping = now.damping * jnp.where(better, jnp.where(well, 0.1, 1.0), 10.0)
    damping = jnp.clip(damping, 1e-14, 1e14)
    least = jnp.finfo(r.dtype).eps ** 0.625 * jnp.max(now.scale)  # below the rounding of what is integrated
    short = predicted @ predicted <= jnp.maximum(tolerance**2 * 2 * before / jnp.maximum(freedom, 1), least**2)
    flat = jnp.linalg.norm(jnp.where(now.scale > 0, now.residuals @ now.jacobian / now.scale, 0)) <= 1e-4 * jnp.sqrt(2 * before)
    status = jnp.where((short & newton_like) | (before == 0), CONVERGED, RUNNING)
    status = jnp.where(~taken & (now.damping >= 1e8), jnp.where(flat, CONVERGED, STALLED), status)
    status = jnp.where(jnp.isfinite(before), status, FAILED)
    status = jnp.where(now.status == RUNNING, status, now.status)
    done = now.status != RUNNING
    chosen = Iterate(*took((trial, r, J, rest, after), now[:5]), damping, jnp.maximum(now.scale, _norms(jnp.where(taken, J, 0))), status)
    now = jax.tree.map(lambda a, b: jnp.where(done, b, a), chosen, now)
    return now, *_propose(now)


ONE = tuple(compiled(f) for f in (_begin, _advance))
MANY = tuple(compiled(jax.vmap(f)) for f in (_begin, _advance))
