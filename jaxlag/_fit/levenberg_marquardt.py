"""Nonlinear least squares within bounds, from residuals and Jacobians that come together; one problem, or a batch of them."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx

from .._program.implicit import undifferentiated
from .._program.jit import compiled
from .arrow import norms, over, times, transposed, triangular

RUNNING, CONVERGED, STALLED, STEP_LIMIT, INTERRUPTED, FAILED, UNRELATED, DISCONTINUOUS, KINKED = range(9)
REASONS = (
    "still running",
    "converged",
    "no step lowers the cost any more, though its gradient is not zero",
    "`max_steps` was reached",
    "interrupted (Ctrl-C); these are the best parameters so far",
    "the motion at the start could not be computed",
    "the predictions are unrelated to the measurements, and no step brings them near",
    "the segments do not join, however heavily the gaps are weighted; use more segments, or start from other parameters",
    "the cost has a kink here, as where dry friction comes to stick or begins to slip, and steps along it lower it by next to nothing; "
    "the standard errors hold on one side of the kink; see whether `start=jl.MultiStart()` or a model that misses less finds a lower cost",
)
FIRST_DAMPING = 1e-2
DAMPING_LIMITS = 1e-14, 1e14
NEWTON_LIKE = 0.5  # damping below which a step is close to that of Gauss and Newton
HALVINGS = 60  # of the interval in which the logarithm of the damping is searched
ENOUGH, WELL = 0.25, 0.75  # parts of the expected decrease, from which the region of trust stays as it is, and from which it grows
GROWTH, SHRINKAGE = 2, 4  # of its radius, from the length of the last step
CLOSE = 10  # tolerances; so short a step is trusted where the cost rises by no more than one of that length could lower it
HOPELESS = 1e8  # damping from which on no step is expected to lower the cost
SHORT = 0.3  # standard errors; the cost of so short a step is as expected, unless there is a kink
SLIGHT = 0.1  # standard errors; a cost that falls less than by such a step has not fallen
WIDER = 8  # times the radius when the cost last fell
PATIENCE = 5  # short damped steps without such a fall, after which the iteration ends
CLEAR = 0.375  # exponent of eps (1.3e-6 in double precision): singular values of the Jacobian, its columns of norm one, that count
FLAT = 1e-4  # cosine of residuals and columns of the Jacobian below which the gradient counts as zero, or that of a `SLIGHT` step


class Iterate(NamedTuple):
    """The state of the iteration; in a batch each array has it as its first axis."""

    y: Any
    residuals: Any
    jacobian: Any
    aux: Any
    cost: Any  # ½|r|²
    radius: Any  # of the region in which the linear model is trusted, in columns scaled to norm one
    scale: Any  # largest norm that each column of the Jacobian has had
    across: Any  # the Jacobian beyond a kink, where there is one; otherwise the same
    mark: Any  # the cost when it last fell by what counts
    reach: Any  # the radius then
    slow: Any  # short damped steps since then
    status: Any


class Trial(NamedTuple):
    """The next y to be tried, and what is expected of it."""

    y: Any
    change: Any  # J Δy of the step to y
    length: Any  # of the step, in columns scaled to norm one
    damping: Any  # that makes the step so short
    free_change: Any  # |J Δy|² of the undamped step that is held back only by the active bounds
    active: Any  # bounds at which y lies and towards which the cost falls


class Outcome(NamedTuple):
    """The best iterate, the number of steps, and the cost at the start and after each step."""

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
    size: Any = np.inf,
    noise: float = 0.0,
    found: tuple[Any, Any, Any] | None = None,
) -> Outcome:
    """Minimises ½|r(y)|² within `bounds`. `linearise(y)` returns r, its Jacobian, and anything else that is wanted at the best y; `found`:
    what it returns at the first y, where that is known.

    Ends where the next step of Gauss and Newton would change no parameter by more than `tolerance` of its standard error: |J Δy| ≤
    tolerance · σ̂, with σ̂² = |r|² / `freedom`; or by no more than rounding, a part of the `size` of what r is a difference of. `noise`: the
    part of the cost that is due to the errors of what is integrated; a step that promises no more, and fails, is the last. Where y has a
    batch axis, so has all that `linearise` takes and returns.

    **Source:** Moré, The Levenberg-Marquardt algorithm, Lecture Notes in Mathematics 630 (1978); Madsen, Nielsen & Tingleff,
    Methods for Non-Linear Least Squares Problems (2004), section 3.2; for the bounds Bertsekas, SIAM J. Control Optim. 20 (1982) 221.
    """
    initialise, update = SINGLE if y.ndim == 1 else BATCHED
    box = [_in_shape(bound, y, y.shape) for bound in bounds or (-np.inf, np.inf)]
    now, trial = initialise(y, found or linearise(y), box)
    costs = [now.cost]
    step, limits = 0, [_in_shape(limit, y, y.shape[:-1]) for limit in (tolerance, freedom, size, noise)]
    try:
        for step in range(1, max_steps + 1):
            now, trial = update(now, trial, _tried(linearise, trial.y, now), box, *limits)
            costs.append(now.cost)
            if progress:
                progress(step, float(np.min(now.cost)))
            if np.all(np.asarray(now.status) != RUNNING):
                break
        unfinished = STEP_LIMIT
    except KeyboardInterrupt:
        unfinished = INTERRUPTED
    status = np.asarray(now.status)
    status = np.where(status == RUNNING, unfinished, status)
    return Outcome(now._replace(status=status), step, np.stack([np.asarray(cost) for cost in costs]))


def _in_shape(x, like, shape):
    x = np.asarray(x, like.dtype)
    return x if x.shape == shape else np.broadcast_to(x, shape)


def _tried(linearise, y, now):
    """What `linearise` returns; NaN where it fails, as an implicit solver does that is differentiated at numbers that are not finite."""
    try:
        found = linearise(y)
        jax.block_until_ready(found[0])
    except jax.errors.JaxRuntimeError:
        none = lambda leaf: leaf * jnp.nan if eqx.is_inexact_array(leaf) else leaf
        return jax.tree.map(none, (now.residuals, now.jacobian, now.aux))
    return found


def _cost(r):
    return 0.5 * jnp.sum(r**2, axis=-1)


def _where(condition, a, b):
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), a, b)


@compiled
def _initialise(y, linearised, bounds):
    r, J, aux = linearised
    cost, first, infinite = _cost(r), jnp.asarray(jnp.nan, y.dtype), jnp.asarray(jnp.inf, y.dtype)
    now = Iterate(y, r, J, aux, cost, first, norms(J), J, cost, infinite, jnp.asarray(0), jnp.asarray(RUNNING))
    return now, _propose(now, bounds)


def _across_the_kink(now):
    """The convex combination of the Jacobians on both sides of a kink with the smallest gradient: steps along the kink.

    **Source:** Burke, Lewis & Overton, SIAM J. Optim. 15 (2005) 751 (gradient sampling), for two samples.
    """
    scale = jnp.where(now.scale > 0, now.scale, 1)
    here, there = (transposed(J, now.residuals) / scale for J in (now.jacobian, now.across))
    apart = jnp.sum((here - there) ** 2)
    share = jnp.clip(here @ (here - there) / jnp.where(apart > 0, apart, 1), 0, 1)
    between = lambda a, b: a + share * (b - a) if jnp.issubdtype(a.dtype, jnp.inexact) else a
    return jax.tree.map(between, now.jacobian, now.across)


def _propose(now, bounds):
    """The damped Gauss–Newton step, in columns scaled to norm one. Entries that would cross a bound stop there."""
    scale = jnp.where(now.scale > 0, now.scale, 1)
    lower, upper = ((bound - now.y) * scale for bound in bounds)
    J, slope = over(_across_the_kink(now), scale), transposed(now.jacobian, now.residuals)
    active = ((lower >= 0) & (slope > 0)) | ((upper <= 0) & (slope < 0))
    step, damping, free_change = undifferentiated(_damped, in_turn=True)(*triangular(J, now.residuals), now.radius, active, lower, upper)
    return Trial(jnp.clip(now.y + step / scale, *bounds), times(J, step), jnp.linalg.norm(step), damping, free_change, active)


def _damped(R, r, radius, active, lower, upper):
    """The damped step within the bounds, and the square of the part of r that R can take away without the `active` columns."""
    descent = optx.DampedNewtonDescent()
    values, along = _singular(jnp.where(active[None], 0, R), r)
    damping = _damping_within(radius, values, along)

    def solve_anew(last):
        step, fixed, _ = last
        step = jnp.where(fixed, step, 0)
        info = optx.FunctionInfo.ResidualJac(r + R @ step, lx.MatrixLinearOperator(jnp.where(fixed[None], 0, R)))
        others, _ = descent.step(1 / damping, descent.query(lower, info, None))  # type: ignore[arg-type]
        step = jnp.where(fixed, step, others)
        crossing = (step < lower) | (step > upper)
        return jnp.clip(step, lower, upper), fixed | crossing, jnp.any(crossing)

    step, _, _ = jax.lax.while_loop(lambda last: last[2], solve_anew, (jnp.zeros_like(lower), active, jnp.asarray(True)))
    clear = values > jnp.finfo(r.dtype).eps ** CLEAR * jnp.max(values, initial=0.0)
    return step, damping, jnp.sum(jnp.where(clear, along, 0) ** 2)  # however slowly a damped step takes it away along a valley of the cost


def _singular(R, r):
    """The singular values s of R = U S Vᵀ, and Uᵀr: by RᵀR where LAPACK's divide and conquer has failed, as it may for hundreds of columns
    that are much alike.
    """
    U, values, _ = jnp.linalg.svd(R, full_matrices=False)

    def by_squares():
        squares, V = jnp.linalg.eigh(R.T @ R)
        values = jnp.sqrt(jnp.maximum(squares, 0))
        seen = values > jnp.finfo(R.dtype).eps ** 0.5 * jnp.max(values, initial=0.0)
        return values, jnp.where(seen, (R @ V).T @ r / jnp.where(seen, values, 1), 0)

    return jax.lax.cond(jnp.all(jnp.isfinite(values)), lambda: (values, r @ U), by_squares)


def _damping_within(radius, values, along):
    """The least damping λ with |p(λ)| ≤ radius, p_i = s_i g_i / (s_i² + λ); at the start, where there is no radius, the first one."""
    least, most = jnp.log(jnp.asarray(DAMPING_LIMITS, values.dtype))

    def halved(_, ends):
        low, high = ends
        middle = (low + high) / 2
        is_long = jnp.sum((values * along / (values**2 + jnp.exp(middle))) ** 2) > radius**2
        return jnp.where(is_long, middle, low), jnp.where(is_long, high, middle)

    low, high = jax.lax.fori_loop(0, HALVINGS, halved, (least, most))
    return jnp.where(jnp.isnan(radius), FIRST_DAMPING, jnp.exp(high))


@compiled
def _update(now, trial, linearised, bounds, tolerance, freedom, size, noise):
    """Takes the trial where it is better, adapts the region of trust, and proposes the next."""
    r, J, aux = linearised
    before, after = now.cost, _cost(r)
    # Expected decrease: ½|r|² − ½|r + J step|². Where it is below the rounding of what is integrated, the step is trusted.
    expected = -trial.change @ now.residuals - 0.5 * trial.change @ trial.change
    newton_like, rounding = trial.damping < NEWTON_LIKE, jnp.maximum(jnp.finfo(r.dtype).eps ** 0.5, noise) * before
    better = after <= before
    per_error = 2 * before / jnp.maximum(freedom, 1)  # σ̂²: the |J Δy|² of a step by one standard error
    last = (CLOSE * tolerance) ** 2 * per_error  # within this, the cost changes with the steps of the motion too
    trusted = (expected <= rounding) & (after - before <= rounding)
    trusted |= (jnp.sum(trial.change**2) <= last) & (after - before <= last / 2)
    taken = better | (newton_like & trusted)
    as_expected = (before - after) > ENOUGH * expected
    well = (before - after) > WELL * expected
    radius = jnp.where(jnp.isnan(now.radius), trial.length, now.radius)
    larger = jnp.where(well, jnp.maximum(radius, GROWTH * trial.length), radius)
    radius = jnp.where(better & as_expected, larger, trial.length / SHRINKAGE)
    status = _status(now, trial, taken, newton_like, tolerance, freedom, size)
    drowned = ~better & newton_like & (trial.free_change <= 2 * rounding)  # in the errors of what is integrated
    status = jnp.where((status == RUNNING) & drowned, CONVERGED, status)
    short = (jnp.sum(trial.change**2) <= SHORT**2 * per_error) & jnp.isfinite(after)
    across = _where(taken, _where(short & ~as_expected, now.jacobian, J), _where(short, J, now.across))
    fell = now.mark - jnp.where(taken, after, before) > SLIGHT**2 / 2 * per_error
    fell |= radius > WIDER * now.reach  # in a curved valley, which has no kink, steps become longer and longer
    slow = jnp.where(fell, 0, now.slow + (taken & ~newton_like))
    within = trial.free_change <= last  # no kink that matters: the last of the steps are rounding of the motion
    status = jnp.where((status == RUNNING) & (slow >= PATIENCE), jnp.where(within, CONVERGED, KINKED), status)
    mark = jnp.where(fell, jnp.where(taken, after, before), now.mark)
    reach = jnp.where(fell | jnp.isinf(now.reach), radius, now.reach)
    chosen = _where(taken, (trial.y, r, J, aux, after), tuple(now[:5]))
    scale = jnp.maximum(now.scale, jnp.where(taken, norms(J), 0))
    chosen = Iterate(*chosen, radius, scale, across, mark, reach, slow, status)
    now = _where(now.status != RUNNING, now, chosen)
    return now, _propose(now, bounds)


def _status(now, trial, taken, newton_like, tolerance, freedom, size):
    """Whether the iteration goes on, judged by the step that was tried from `now`."""
    sizes = norms(now.jacobian)  # the present ones: those at the start may be larger by many powers of ten
    largest = jnp.minimum(jnp.max(sizes, initial=0.0), size)
    least = jnp.finfo(now.residuals.dtype).eps ** 0.625 * largest  # below the rounding of what is integrated
    short = trial.free_change <= jnp.maximum(tolerance**2 * 2 * now.cost / jnp.maximum(freedom, 1), least**2)
    cosines = jnp.where((sizes > 0) & ~trial.active, transposed(now.jacobian, now.residuals) / jnp.where(sizes > 0, sizes, 1), 0)
    flat = jnp.linalg.norm(cosines) <= jnp.maximum(FLAT, SLIGHT / jnp.sqrt(jnp.maximum(freedom, 1))) * jnp.sqrt(2 * now.cost)
    status = jnp.where((short & newton_like) | (now.cost == 0), CONVERGED, RUNNING)
    status = jnp.where(~taken & (trial.damping >= HOPELESS), jnp.where(flat, CONVERGED, STALLED), status)
    status = jnp.where(jnp.isfinite(now.cost), status, FAILED)
    return jnp.where(now.status == RUNNING, status, now.status)


SINGLE = _initialise, _update
BATCHED = tuple(compiled(jax.vmap(f)) for f in SINGLE)
