"""Minima of a potential of many coordinates, each coupled to a few, and the number of descending directions at a point."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from .._program.block_tridiagonal import Factors, factorised, positive_eigenvalues, solution
from .._program.conditions import halved, repeated, zeros_like
from .._program.sparse_matrix import SparseMatrix, row_sums
from .descent import STEPS, far_down

FIRST = 1e-6  # of the largest row of the curvature: the smallest shift added to it
PROBES = 3  # random vectors on which factors are tested
SAFETY = 10  # times the observed error of factors
WEAKER = 16  # factor by which the shift shrinks from step to step, if possible


def sparse_minimum_near(V: Callable, slope_and_curvature: Callable, q: Float[Array, " n"], units: Float[Array, " n"]) -> Float[Array, " n"]:
    """A minimum of V, accurate to some digits; `slope_and_curvature(q)` is −∂V/∂q and −∂²V/∂q². Everything is measured in `units`.

    Newton's step with a shift that makes the curvature positive; from a saddle or a maximum, a step along a descending direction. A step is
    halved until V is lower. A chain of 1000 springs of k = 1e5, started unstretched as an arc, takes 10 steps.

    Source: Nocedal & Wright, Numerical Optimization, 2nd ed., section 3.4.
    """
    eps = jnp.finfo(q.dtype).eps
    anywhere = jnp.asarray(np.random.default_rng(0).normal(size=q.size), q.dtype)

    def turn(carry):
        x, added, _, i = carry
        slope, K = slope_and_curvature(units * x)
        slope, K = units * slope, SparseMatrix(K.values * units[K.pattern.rows] * units[K.pattern.columns], K.pattern)
        largest = jnp.max(row_sums(K))
        added, factors = _made_definite(K, jnp.where(added > FIRST * largest, added / WEAKER, 0))
        step = -solution(K.pattern, factors, slope)
        longest = jnp.max(jnp.abs(step))
        reach = jnp.max(jnp.maximum(jnp.abs(x), jnp.abs(q / units)))
        reach = jnp.where(reach > 0, reach, longest)
        flat, falls = longest <= eps**0.5 * reach, added > 0
        downhill = solution(K.pattern, factors, anywhere)
        downhill = downhill / jnp.max(jnp.abs(downhill))
        step = jnp.where(flat & falls, downhill * far_down(lambda h: V(units * (x + h * downhill)), 0.1 * reach), step)
        longest = jnp.max(jnp.abs(step))
        step = step * jnp.where((reach > 0) & (longest > 0.5 * reach), 0.5 * reach / jnp.where(longest > 0, longest, 1), 1)
        is_lower = lambda part: V(units * (x + part * step)) < V(units * x)
        part, lower = halved(is_lower, eps, q.dtype)
        return jnp.where(lower, x + part * step, x), added, lower & ~(flat & ~falls), i + 1

    start = q / units, jnp.zeros((), q.dtype), jnp.array(True), jnp.array(0)
    return units * lax.while_loop(lambda carry: carry[2] & (carry[3] < STEPS), turn, start)[0]


def _made_definite(K: SparseMatrix, added: Array) -> tuple[Array, Factors]:
    """The shift σ, and the factors of K − σ, which is negative definite."""
    largest = jnp.max(row_sums(K))
    factors_with = lambda added: factorised(K.plus_diagonal(jnp.full(K.shape[0], -added)))

    def attempt(carry):
        *_, following = carry
        return following, factors_with(following), jnp.maximum(4 * following, FIRST * largest)

    def is_indefinite(carry):
        added, factors, _ = carry
        positive, _ = positive_eigenvalues(K.plus_diagonal(jnp.full(K.shape[0], -added)), factors)
        sound = jnp.all(jnp.isfinite(factors.inverse)) & (positive == 0)
        return ~sound & (added < 8 * largest)

    nothing = zeros_like(jax.eval_shape(factors_with, added))
    added, factors, _ = repeated(attempt, (added, nothing, added), is_indefinite)
    return added, factors


def eigenvalues_below(J: SparseMatrix, scale: Float[Array, " n"], bound: Array) -> tuple[Int[Array, ""], Float[Array, ""]]:
    """The number of directions x on the constraints with xᵀK x < `bound` · xᵀ diag(`scale`) x, where J = [−K Gᵀ; G 0]; and the uncertainty
    of the bound, from how well the factors reproduce J.

    Source: Gould, Math. Programming 32 (1985) 90: J has the inertia of −K on the null space of G, plus one of each sign per row.
    """
    n, pattern = scale.size, J.pattern
    of_q = np.arange(J.shape[0]) < n
    unit = jnp.append(lax.rsqrt(scale), jnp.ones(J.shape[0] - n, scale.dtype))
    values, within = J.values * unit[pattern.rows] * unit[pattern.columns], of_q[pattern.columns] & of_q[pattern.rows]
    stiffest = jnp.max(jnp.where(within, jnp.abs(values), 0), initial=0.0)
    stiffest = jnp.where(stiffest > 0, stiffest, 1)  # in these units no number is far from one, like the numbers next to blocks
    row = jax.ops.segment_max(jnp.abs(values), pattern.rows, J.shape[0], indices_are_sorted=True)
    unit = jnp.where(of_q | (row <= 0), lax.rsqrt(stiffest), jnp.sqrt(stiffest) / jnp.where(row > 0, row, 1))
    A = SparseMatrix(values * unit[pattern.rows] * unit[pattern.columns], pattern).plus_diagonal(jnp.where(of_q, bound / stiffest, 0))
    factors = factorised(A)
    count, sound = positive_eigenvalues(A, factors)
    error = jnp.zeros((), scale.dtype)
    for signs in np.random.default_rng(0).choice([-1.0, 1.0], (PROBES, J.shape[0])):
        x = jnp.asarray(signs, scale.dtype)
        error = jnp.maximum(error, jnp.max(jnp.abs(A @ (solution(pattern, factors, A @ x) - x))))
    return count - (J.shape[0] - n), jnp.where(sound, SAFETY * error * stiffest, jnp.inf)
