"""Nonlinear least squares, from residuals and Jacobians that come together, one problem or a batch of them."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx

from .._program.jit import compiled

RUNNING, CONVERGED, STALLED, MAX_STEPS, INTERRUPTED, FAILED, ASTRAY, APART = range(8)
REASONS = (
    "still running",
    "converged",
    "no step lowers the cost any more, though it is not flat",
    "`max_steps` was reached",
    "interrupted by the keyboard; these are the best parameters so far",
    "the motion at the start could not be computed",
    "no step lowers the cost any more, but the predictions have nothing to do with the measurements",
    "the pieces' ends do not meet, however much it weighs; take more pieces, or start from other parameters",
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


class Proposal(NamedTuple):
    """Where to look next, what is expected of it, and how far one would go if no more bounds were met."""

    y: Any
    change: Any  # J Δy of the step to y
    reach: Any  # |J Δy|² of the step that only the bounds hold back which the slope leans on
    held: Any  # where these are


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
    bounds: tuple[Any, Any] | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Outcome:
    """Minimises ½|r(y)|² within `bounds`. `linearise(y)` returns r, its Jacobian, and whatever else is wanted of the best y.

    Ends where the next step would change no parameter by more than `tolerance` of its standard error: |J Δy| ≤ tolerance · σ̂, with
    σ̂² = |r|² / `freedom`. Where y has a batch axis, `linearise` and all that is returned have it too.

    **Source:** Moré, The Levenberg-Marquardt algorithm, Lecture Notes in Mathematics 630 (1978); Madsen, Nielsen & Tingleff,
    Methods for Non-Linear Least Squares Problems (2004), section 3.2; for the bounds Bertsekas, SIAM J. Control Optim. 20 (1982) 221.
    """
    begin, advance = ONE if y.ndim == 1 else MANY
    box = [jnp.broadcast_to(jnp.asarray(bound, y.dtype), y.shape) for bound in bounds or (-jnp.inf, jnp.inf)]
    now, trial = begin(y, linearise(y), box)
    costs = [now.cost]
    step, limits = 0, (jnp.full(y.shape[:-1], tolerance, y.dtype), jnp.full(y.shape[:-1], freedom, y.dtype))
    try:
        for step in range(1, max_steps + 1):
            now, trial = advance(now, trial, linearise(trial.y), box, *limits)
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


def _begin(y, first, bounds):
    r, J, rest = first
    now = Iterate(y, r, J, rest, _cost(r), jnp.asarray(1e-2, y.dtype), _norms(J), jnp.asarray(RUNNING))
    return now, _propose(now, bounds)


def _propose(now, bounds):
    """The damped Gauss–Newton step, in columns of norm one. What would cross a bound stops at it, and the others step anew."""
    scale = jnp.where(now.scale > 0, now.scale, 1)
    lower, upper = ((bound - now.y) * scale for bound in bounds)
    J, slope = now.jacobian / scale[None, :], now.residuals @ now.jacobian
    leaning = ((lower >= 0) & (slope > 0)) | ((upper <= 0) & (slope < 0))
    descent = optx.DampedNewtonDescent()

    def step_anew(last):
        step, held, _, reach = last
        step = jnp.where(held, step, 0)
        info = optx.FunctionInfo.ResidualJac(now.residuals + J @ step, lx.MatrixLinearOperator(jnp.where(held[None], 0, J)))
        others, _ = descent.step(1 / now.damping, descent.query(now.y, info, None))  # type: ignore[arg-type]
        step = jnp.where(held, step, others)
        crossing = (step < lower) | (step > upper)
        reach = jnp.where(jnp.isnan(reach), jnp.sum((J @ step) ** 2), reach)  # of the first
        return jnp.clip(step, lower, upper), held | crossing, jnp.any(crossing), reach

    first = jnp.zeros_like(now.y), leaning, jnp.asarray(True), jnp.full_like(now.cost, jnp.nan)
    step, _, _, reach = jax.lax.while_loop(lambda last: last[2], step_anew, first)
    return Proposal(jnp.clip(now.y + step / scale, *bounds), J @ step, reach, leaning)


def _advance(now, trial, seen, bounds, tolerance, freedom):
    """Takes the trial where it is better, sets the damping by how much it is, and proposes the next."""
    r, J, rest = seen
    before, after = now.cost, _cost(r)
    # What was expected of the step: ½|r|² − ½|r + J step|². Too little to be seen above the rounding of what is integrated, it is trusted.
    expected = -trial.change @ now.residuals - 0.5 * trial.change @ trial.change
    newton_like, unseen = now.damping < 0.5, jnp.finfo(r.dtype).eps ** 0.5 * before
    better = after <= before
    taken = better | (newton_like & (expected <= unseen) & (after - before <= unseen))
    took = lambda new, old: jax.tree.map(lambda a, b: jnp.where(taken, a, b), new, old)
    well = (before - after) > 0.25 * expected
    damping = now.damping * jnp.where(better, jnp.where(well, 0.1, 1.0), 10.0)
    damping = jnp.clip(damping, 1e-14, 1e14)
    norms = _norms(now.jacobian)  # here, for those of the start may be larger by many powers of ten
    least = jnp.finfo(r.dtype).eps ** 0.625 * jnp.max(norms)  # below the rounding of what is integrated
    short = trial.reach <= jnp.maximum(tolerance**2 * 2 * before / jnp.maximum(freedom, 1), least**2)
    cosines = jnp.where((norms > 0) & ~trial.held, now.residuals @ now.jacobian / jnp.where(norms > 0, norms, 1), 0)
    flat = jnp.linalg.norm(cosines) <= 1e-4 * jnp.sqrt(2 * before)
    status = jnp.where((short & newton_like) | (before == 0), CONVERGED, RUNNING)
    status = jnp.where(~taken & (now.damping >= 1e8), jnp.where(flat, CONVERGED, STALLED), status)
    status = jnp.where(jnp.isfinite(before), status, FAILED)
    status = jnp.where(now.status == RUNNING, status, now.status)
    done = now.status != RUNNING
    chosen = Iterate(*took((trial.y, r, J, rest, after), now[:5]), damping, jnp.maximum(now.scale, _norms(jnp.where(taken, J, 0))), status)
    now = jax.tree.map(lambda a, b: jnp.where(done, b, a), chosen, now)
    return now, _propose(now, bounds)


ONE = tuple(compiled(f) for f in (_begin, _advance))
MANY = tuple(compiled(jax.vmap(f)) for f in (_begin, _advance))
