r"""Minima of sums over a chain of intervals, with equations and bounds, by an interior-point method.

    min Σ f_k(ζ_k)   such that   c_k(ζ_k) = 0,   l ≤ x ≤ u,        ζ_k = what interval k depends on

Newton's method on the equations of a minimum of f - μ Σ ln(x - l) - μ Σ ln(u - x), with μ → 0. The symmetric system is solved by the
positive definite matrix W + JᵀJ/δ of the chain, refined until it is that of J alone: so constraints may be redundant. Where it is not
positive, W is raised. Steps are taken back until a filter of violation and cost accepts them, or corrected first where equations bend;
where none is accepted, the violation alone is made smaller, by Levenberg and Marquardt's method.

Source: Wächter & Biegler, Mathematical Programming 106 (2006) 25-57 (its numbers in brackets); Nocedal & Wright, Numerical Optimization,
2nd ed., chapter 19; Friedlander & Orban, Math. Prog. Comp. 4 (2012) 71-107 (the regularised system).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .block_system import factors, solved
from .chain import Chain, Linearised

FIRST, LAST = 0.1, 0.1  # μ at first; at last, over the tolerance
FALL, FASTER = 0.2, 1.5  # of μ, when its minimum is near: to a part, or to a power (7)
NEAR = 10.0  # of μ, an error at which its minimum counts as near
INSIDE = 1e-2  # how far a start is moved off its bounds, over its size and the width
TO_BOUND = 0.99  # of the way to a bound that a step may take, at least (8)
RAISED, MORE, LESS, MOST = 1e-4, 4.0, 1 / 3, 1e12  # W at first, then times, where it is not positive, and what is left of it for next time
SHORT = 0.3  # share of a step of restoration, of which the next is damped more
REFINED = 3  # solutions of what is left
LARGEST, SMALLEST = 2.0, 1e-4  # of violations, over those at the start (21)
MARGIN, ARMIJO = 1e-5, 1e-4  # by which a step must be better (18, 20)
BENT = 0.99  # of the violation before, which a correction of a step leaves at most for another to follow
SHARES = 30  # of a step, each half of the one before
KEPT = 60  # points in the filter
ACCEPTABLE = 4 / 7  # power of the tolerance, an error at which a search that comes no further has found a minimum: 5e-7
SPREAD = 1e10  # by which a multiplier of a bound may differ from μ over the distance (16)
CONVERGED, STEP_LIMIT, INFEASIBLE, STUCK, LEAPING = 0, 1, 2, 3, 4  # the last is for others to say, of points that satisfy the equations


class Point(NamedTuple):
    """x; multipliers y of the equations, and those of the bounds."""

    x: Float[Array, " n"]
    y: Float[Array, "N m"]
    below: Float[Array, " n"]
    above: Float[Array, " n"]


class Found(NamedTuple):
    """Where an iteration ended, with f there; the largest error, of the equations alone, and the steps."""

    point: Point
    f: Float[Array, ""]
    error: Float[Array, ""]
    violation: Float[Array, ""]
    steps: Int[Array, ""]
    status: Int[Array, ""]


class _State(NamedTuple):
    point: Point
    mu: Array
    filter: Array  # (KEPT, 2): violations and costs that must not come back
    raised: Array  # of W at the last step
    damping: Array  # of steps of restoration
    restoring: Bool[Array, ""]
    before: Array  # the violation when restoration began
    limits: Array  # of violations
    steps: Array
    status: Array
    error: Array


def minimum(chain: Chain, start: Float[Array, " n"], *, tolerance: float, steps: int, corrections: int = 0) -> Found:
    """The minimum near a start; steps that violate more than before are corrected so often at most."""
    x = _inside(chain, start)
    _, c = chain.values(x)
    finite = lambda bound, value: jnp.where(jnp.isfinite(bound), value, 0.0)
    point = Point(x, jnp.zeros_like(c), finite(chain.lower, 1.0), finite(chain.upper, 1.0))
    theta = jnp.sum(jnp.abs(c))
    limits = jnp.stack([LARGEST * jnp.maximum(1, theta), SMALLEST * jnp.maximum(1, theta)])
    zero, count = jnp.zeros((), x.dtype), jnp.zeros((), int)
    state = _State(
        point, zero + FIRST, _empty(x.dtype), zero, zero + RAISED, jnp.array(False), zero, limits, count, count - 1, zero + jnp.inf
    )
    state = jax.lax.while_loop(lambda s: (s.status < 0) & (s.steps < steps), lambda s: _step(chain, s, tolerance, corrections), state)
    f, c = chain.values(state.point.x)
    status = jnp.where(state.status < 0, STEP_LIMIT, state.status)
    nearly = (state.error <= tolerance**ACCEPTABLE) & (status != INFEASIBLE)
    status = jnp.where(nearly, CONVERGED, status)
    return Found(state.point, f, state.error, jnp.max(jnp.abs(c)), state.steps, status)


def best_of(every: Found) -> Int[Array, ""]:
    """Which of several minima is the best: of those that were found the least, or what comes closest to one."""
    converged = every.status == CONVERGED
    rank = jnp.where(jnp.any(converged), jnp.where(converged, every.f, jnp.inf), every.violation)
    return jnp.argmin(jnp.where(jnp.isnan(rank), jnp.inf, rank))


def _inside(chain, x):
    """Moved off the bounds (3.6)."""
    width = jnp.where(jnp.isfinite(chain.upper - chain.lower), chain.upper - chain.lower, jnp.inf)
    off = lambda bound: jnp.minimum(INSIDE * jnp.maximum(1, jnp.abs(bound)), INSIDE * width)
    x = jnp.where(jnp.isfinite(chain.lower), jnp.maximum(x, chain.lower + off(chain.lower)), x)
    return jnp.where(jnp.isfinite(chain.upper), jnp.minimum(x, chain.upper - off(chain.upper)), x)


def _empty(dtype):
    return jnp.full((KEPT, 2), jnp.inf, dtype)


def _distances(chain, x):
    """To the bounds, infinite where there are none."""
    return x - chain.lower, chain.upper - x


def _barrier(chain, x, f, mu):
    below, above = _distances(chain, x)
    logs = lambda gap: jnp.sum(jnp.where(jnp.isfinite(gap), jnp.log(jnp.where(jnp.isfinite(gap), gap, 1)), 0))
    return f - mu * (logs(below) + logs(above))


def _error(chain, point, c, gradient, mu):
    """How far a point is from the minimum of a barrier (5), with what multipliers are large divided out."""
    below, above = _distances(chain, point.x)
    sizes = jnp.sum(jnp.abs(point.below)) + jnp.sum(jnp.abs(point.above))
    count = max(2 * point.x.size, 1)
    dual = jnp.maximum(100, (jnp.sum(jnp.abs(point.y)) + sizes) / (point.y.size + count)) / 100
    product = lambda gap, z: jnp.max(jnp.where(jnp.isfinite(gap), jnp.abs(jnp.where(jnp.isfinite(gap), gap, 0) * z - mu), 0))
    slope = jnp.max(jnp.abs(gradient - point.below + point.above))
    complementary = jnp.maximum(product(below, point.below), product(above, point.above))
    return jnp.maximum(jnp.maximum(slope, complementary) / dual, jnp.max(jnp.abs(c), initial=0.0))


def _step(chain: Chain, s: _State, tolerance: float, corrections: int) -> _State:
    of = chain.linearised(s.point.x, s.point.y)
    gradient = of.gradient + of.backwards(s.point.y)
    s = s._replace(error=_error(chain, s.point, of.c, gradient, 0.0))
    found = s._replace(status=jnp.full_like(s.status, CONVERGED))
    return jax.lax.cond(s.error <= tolerance, lambda: found, lambda: _moved(chain, s, of, gradient, tolerance, corrections))


def _moved(chain: Chain, s: _State, of: Linearised, gradient: Array, tolerance: float, corrections: int) -> _State:
    (x, y, _, _), f, c = s.point, of.f, of.c
    mu = _barrier_now(chain, s, c, gradient, tolerance)
    kept = jnp.where(mu < s.mu, _empty(x.dtype), s.filter)
    below, above = _distances(chain, x)
    of_barrier = mu * (1 / above - 1 / below)  # where there is no bound, 1/∞
    phi, theta = _barrier(chain, x, f, mu), jnp.sum(jnp.abs(c))
    most = jnp.maximum(TO_BOUND, 1 - mu)
    share = lambda dx: jnp.minimum(_way(below, dx, most), _way(above, -dx, most))
    of_step = lambda dx: jnp.sum((of.gradient + of_barrier) * dx)
    trials = _Trials(chain, x, mu, theta, phi, of_step, share, kept, s.limits, corrections)
    (alpha, dx, dy, new_x, accepted, of_cost), raised, left = _step_taken(chain, s, of, gradient + of_barrier, trials)
    zl, zu = _multipliers_of_bounds(chain, s.point, dx, new_x, mu, most)
    point = Point(new_x, jnp.where(s.restoring, jnp.where(left, 0.0, y), y + alpha * dy), zl, zu)
    begins = ~accepted & ~s.restoring
    entry = jnp.stack([(1 - MARGIN) * theta, phi - MARGIN * theta])
    enters = (accepted & ~of_cost & ~s.restoring) | begins
    kept = jnp.where(enters, kept.at[jnp.argmax(kept[:, 0])].set(entry), kept)  # in an empty place
    stuck = begins & (theta <= tolerance * y.size)
    status = jnp.where(stuck, STUCK, jnp.where(~accepted & s.restoring, INFEASIBLE, -1))
    damping = jnp.where(alpha < SHORT, MORE * s.damping, jnp.where(alpha > 1 - SHORT, s.damping / MORE, s.damping))
    return _State(
        jax.tree.map(lambda new, old: jnp.where(accepted, new, old), point, s.point),
        mu,
        kept,
        raised=jnp.where(raised > 0, raised, s.raised),
        damping=jnp.where(s.restoring, jnp.maximum(damping, RAISED**2), RAISED),
        restoring=begins | (s.restoring & ~left),
        before=jnp.where(begins, theta, s.before),
        limits=s.limits,
        steps=s.steps + 1,
        status=status,
        error=s.error,
    )


def _barrier_now(chain, s, c, gradient, tolerance):
    """μ, lower where its minimum is near (7)."""

    def lower(mu):
        return jnp.maximum(LAST * tolerance, jnp.minimum(FALL * mu, mu**FASTER))

    near = lambda mu: (_error(chain, s.point, c, gradient, mu) <= NEAR * mu) & (mu > LAST * tolerance) & ~s.restoring
    return jax.lax.while_loop(near, lower, s.mu)


def _step_taken(chain, s, of, slope, trials):
    """A step, by how much W was raised, and whether a restoration has ended: Newton's; or Levenberg and Marquardt's to satisfy the
    equations alone, short where a bound is near.
    """
    below, above = _distances(chain, s.point.x)

    def newton():
        kkt, raised = factorised(of, s.point.below / below + s.point.above / above, s.raised)
        return trials.searched(lambda c: kkt(-slope, -c), of.c), raised, jnp.array(False)

    def to_equations():
        damped = factors(of.chain.shape, of.matrix(of.squares(), 1.0), s.damping * (1 + 1 / below**2 + 1 / above**2))
        taken, left = trials.restored(solved(of.chain.shape, damped, -of.backwards(of.c)), of.c, s.before)
        return taken, s.raised, left

    return jax.lax.cond(s.restoring, to_equations, newton)


def _multipliers_of_bounds(chain, point, dx, new_x, mu, most):
    """Those after a step."""
    below, above = _distances(chain, point.x)
    dzl, dzu = (mu - point.below * dx) / below - point.below, (mu + point.above * dx) / above - point.above
    alpha = jnp.minimum(_way(point.below, dzl, most), _way(point.above, dzu, most))
    gaps = _distances(chain, new_x)
    return tuple(_near_mu(z + alpha * dz, mu, gap) for z, dz, gap in zip((point.below, point.above), (dzl, dzu), gaps, strict=True))


def _near_mu(z, mu, gap):
    """A multiplier of a bound, as μ over the distance has it, within wide limits."""
    return jnp.where(jnp.isfinite(gap), jnp.clip(z, mu / (SPREAD * gap), SPREAD * mu / gap), 0.0)


def _way(gap, change, most):
    """The share of a step after which a positive gap is nearly used up."""
    shrinks = jnp.isfinite(gap) & (change < 0)
    return jnp.min(jnp.where(shrinks, -most * gap / jnp.where(shrinks, change, -1), 1.0), initial=1.0)


def factorised(of: Linearised, sigma: Array, raised: Array) -> tuple[Callable, Array]:
    """The solution of the symmetric system as a function of its right-hand sides, and by how much W was raised."""
    eps = jnp.finfo(sigma.dtype).eps
    small = eps**0.4
    K = of.matrix(of.H + of.squares() / small, 1 / small)

    def attempt(state):
        count, now, _ = state
        second = jnp.where(raised > 0, jnp.maximum(LESS * raised, eps), RAISED)
        now = jnp.where(count == 0, 0.0, jnp.where(count == 1, second, MORE * now))
        return count + 1, now, factors(of.chain.shape, K, sigma + now + small)

    unknown = jax.tree.map(
        lambda x: jnp.full(x.shape, jnp.nan, x.dtype), jax.eval_shape(lambda K, sigma: factors(of.chain.shape, K, sigma), K, sigma)
    )
    start = jnp.zeros((), int), jnp.zeros_like(raised), unknown
    _, raised, found = jax.lax.while_loop(lambda s: ~s[2].is_positive & (s[1] < MOST), attempt, start)

    def product(step):
        dx, dy = step
        return of.curved(dx) + (sigma + raised) * dx + of.backwards(dy), of.forwards(dx)

    def once(r1, r2):
        dx = solved(of.chain.shape, found, r1 + of.backwards(r2) / small)
        return dx, (of.forwards(dx) - r2) / small

    def refined(state):
        count, step, right, _ = state
        more = once(*jax.tree.map(jnp.subtract, right, product(step)))
        largest = lambda x: jnp.max(jnp.abs(x), initial=0.0)
        off = [largest(x) > jnp.sqrt(eps) * largest(y) for x, y in zip(more, step, strict=True)]
        return count + 1, jax.tree.map(jnp.add, step, more), right, off[0] | off[1]

    def solve(_, right):
        start = jnp.zeros((), int), once(*right), right, jnp.array(True)
        return jax.lax.while_loop(lambda s: s[3] & (s[0] < REFINED), refined, start)[1]

    return lambda *right: jax.lax.custom_linear_solve(product, right, solve, symmetric=True), raised


class _Taken(NamedTuple):
    """The share of a step that was taken, the step of x and y, x there; whether it was accepted, and whether the cost decided that."""

    alpha: Array
    dx: Array
    dy: Array
    x: Array
    accepted: Bool[Array, ""]
    of_cost: Bool[Array, ""]


class _Whole(NamedTuple):
    """A step of x and y, the share of it up to a bound, and the slope of φ along it."""

    dx: Array
    dy: Array
    most: Array
    slope: Array


class _Trials(NamedTuple):
    """What a step from x may lead to: shares of it, one half of the other, until one is accepted."""

    chain: Chain
    x: Array
    mu: Array
    theta: Array
    phi: Array
    slope: Callable  # of φ along a step
    share: Callable  # of a step, up to a bound
    filter: Array
    limits: Array
    corrections: int

    def _looked_at(self, x):
        f, c = self.chain.values(x)
        return jnp.sum(jnp.abs(c)), _barrier(self.chain, x, f, self.mu), c

    def _is_better(self, theta, phi, alpha, slope):
        """Whether the filter accepts, and whether the cost was what decided (19, 20)."""
        finite = jnp.isfinite(theta) & jnp.isfinite(phi)
        rounding = 10 * jnp.finfo(self.x.dtype).eps * jnp.abs(self.phi)
        falls = (slope < 0) & (alpha * jnp.abs(slope) ** 2.3 > self.theta**1.1)
        by_cost = falls & (self.theta <= self.limits[1])
        armijo = phi - self.phi - rounding <= ARMIJO * alpha * slope
        either = (theta <= (1 - MARGIN) * self.theta) | (phi - rounding <= self.phi - MARGIN * self.theta)
        outside = jnp.all((theta < self.filter[:, 0]) | (phi - rounding < self.filter[:, 1])) & (theta <= self.limits[0])
        return finite & outside & jnp.where(by_cost, armijo, either), by_cost

    def searched(self, solve: Callable, c: Array) -> _Taken:
        """The step `solve(c)`, or the first of its halves that is accepted."""
        if self.corrections:
            halvings, (whole, taken) = 1, self._corrected(solve, c)
        else:
            halvings, whole, no = 0, self._whole(*solve(c)), jnp.array(False)
            taken = _Taken(whole.most, whole.dx, whole.dy, self.x, no, no)

        def half(state):
            count, _ = state
            alpha = whole.most / 2.0**count
            return count + 1, self._tried(alpha, whole.dx, whole.dy, alpha, whole.slope)[0]

        return jax.lax.while_loop(lambda s: ~s[1].accepted & (s[0] <= SHARES), half, (jnp.array(halvings), taken))[1]

    def _whole(self, dx, dy):
        return _Whole(dx, dy, self.share(dx), self.slope(dx))

    def _tried(self, alpha, dx, dy, least, slope):
        x = self.x + alpha * dx
        theta, phi, there = self._looked_at(x)
        return _Taken(alpha, dx, dy, x, *self._is_better(theta, phi, least, slope)), theta, there

    def _corrected(self, solve, c):
        """The step, and the whole of it; where that violates more than before, as equations that bend do, with what is violated at its end
        asked for as well (section 2.4).
        """

        def once(state):
            count, whole, taken, asked, before, _ = state
            step = self._whole(*solve(asked))
            whole = jax.tree.map(lambda new, old: jnp.where(count == 0, new, old), step, whole)
            taken, theta, there = self._tried(step.most, step.dx, step.dy, whole.most, whole.slope)
            bends = jnp.where(count == 0, theta >= self.theta, theta <= BENT * before) & jnp.isfinite(theta)
            return count + 1, whole, taken, step.most * asked + there, theta, bends & ~taken.accepted

        no, zero = jnp.array(False), jnp.zeros_like(self.theta)
        nothing = _Whole(jnp.zeros_like(self.x), jnp.zeros_like(c), zero, zero)
        start = jnp.zeros((), int), nothing, _Taken(zero, nothing.dx, nothing.dy, self.x, no, no), c, zero, ~no
        _, whole, taken, *_ = jax.lax.while_loop(lambda s: s[5] & (s[0] <= self.corrections), once, start)
        return whole, taken

    def restored(self, dx: Array, c: Array, before: Array) -> tuple[_Taken, Array]:
        """The same of a step dx in which violations alone must fall; and whether they did by enough."""

        def half(state):
            count, alpha, *_ = state
            alpha = jnp.where(count == 0, alpha, alpha / 2)
            x = self.x + alpha * dx
            theta, phi, c_there = self._looked_at(x)
            falls = jnp.sum(c_there**2) <= (1 - ARMIJO * alpha) * jnp.sum(c**2)
            return count + 1, alpha, x, jnp.isfinite(theta) & falls, theta, phi

        start = jnp.zeros((), int), self.share(dx), self.x, jnp.array(False), self.theta, self.phi
        _, alpha, x, good, theta, phi = jax.lax.while_loop(lambda s: ~s[3] & (s[0] <= SHARES), half, start)
        outside = jnp.all((theta < self.filter[:, 0]) | (phi < self.filter[:, 1]))
        return _Taken(alpha, dx, jnp.zeros_like(c), x, good, jnp.array(False)), good & outside & (theta <= 0.9 * before)
