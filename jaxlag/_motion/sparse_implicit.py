"""Diagonally implicit Runge–Kutta schemes for many coordinates, where each force and each constraint depends on a few of them.

A stage is an equation for its accelerations and multipliers: with V = v* + γh A and Q = q* + γh V,

    r = M A − f − Gᵀλ = 0,               [M + γh ∂r/∂v + (γh)² ∂r/∂q    −Gᵀ]
    s = G A + γ = 0,     Newton's matrix [G + γh ∂s/∂v + (γh)² ∂s/∂q      0]

which is as sparse as these are, and q̈ = M⁻¹(f + Gᵀλ) is not: a few directional derivatives make it, and it is factorised once a step, in
blocks, each multiplier behind all that its row holds. Errors are judged in positions and velocities: in rates, as diffrax does, a stiff
spring asks for positions to rounding (128 springs of k = 1e6 over 1 s at rtol 1e-5: 803 steps, half of them refused, in place of 110).

Source: Hairer & Wanner, Solving Ordinary Differential Equations II, sections IV.6 and IV.8.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .._mechanics.lagrange import imbalance
from .._program.conditions import repeated
from .._program.jit import jitted
from .._program.sparse_jacobian import MANY
from .._program.sparse_matrix import SparsityPattern
from .._program.sparse_newton import NewtonFactors, by_factors, factors_along, linear_solution, newton_pattern
from .batch import BatchedEquations
from .first_order import EquationsOfMotion
from .protocol import Arguments, AugmentedSystem, FirstOrderSystem
from .runge_kutta import as_rows, weighted, with_row


class Iteration(NamedTuple):
    """Newton's iteration for the accelerations and multipliers of a stage, with the sizes of its last change and of the one before, in
    tolerances.
    """

    u: Array
    size: Float[Array, ""]
    before: Float[Array, ""]
    count: Any

    @property
    def rate(self) -> Float[Array, ""]:
        """By which its changes shrink."""
        return self.size / self.before

    def has_converged(self, kappa: float) -> Bool[Array, ""]:
        """Whether what is left of the error is below κ."""
        tiny = self.size < 100 * jnp.finfo(self.u.dtype).eps
        return (self.count > 1) & (tiny | ((self.rate < 1) & (self.size * self.rate < kappa * (1 - self.rate))))

    def goes_on(self, kappa: float, most: int) -> Bool[Array, ""]:
        """Whether another change may help."""
        hopeful = jnp.isfinite(self.size) & ((self.count < 2) | (self.rate < 2))
        return ~self.has_converged(kappa) & hopeful & (self.count < most)


class SparseImplicit(dfx.AbstractImplicitSolver, dfx.AbstractAdaptiveSolver):
    """The scheme of a solver of diffrax, its stages solved in the structure of the equations; from step to step λ is handed on."""

    scheme: type[dfx.AbstractESDIRK] = eqx.field(static=True)
    equations: Any = eqx.field(static=True)
    pattern: SparsityPattern = eqx.field(static=True)  # of Newton's matrix
    root_finder: Any  # diffrax's, with its tolerances
    root_find_max_steps: int
    term_structure = dfx.AbstractTerm

    @property
    def interpolation_cls(self):
        return self.scheme.interpolation_cls

    def order(self, terms):
        return self.scheme().order(terms)

    def init(self, terms, t0, t1, y0, args):
        n = self.pattern.last
        return terms.vf(t0, y0, args), jnp.zeros((self.pattern.shape[0] - n, *y0.shape[1:]), y0.dtype)

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        tableau, h, n = self.scheme.tableau, t1 - t0, self.pattern.last
        gamma_h = float(tableau.a_diagonal[-1]) * h
        first, multipliers = solver_state
        if made_jump is not False:
            first = lax.cond(made_jump, lambda: terms.vf(t0, y0, args), lambda: first)

        def state(u, base):
            V = base[n : 2 * n] + gamma_h * u[:n]
            return jnp.concatenate([base[:n] + gamma_h * V, V, base[2 * n :]])

        def residual(u, t, base):
            return stage_imbalance(self.equations, t, (state(u, base), u), args)

        at_start = jnp.concatenate([y0[:n] - gamma_h * y0[n : 2 * n], y0[n : 2 * n] - gamma_h * first[n : 2 * n], y0[2 * n :]])
        u0 = jnp.concatenate([first[n : 2 * n], multipliers])
        _, push = jax.linearize(lambda u: residual(u, t0, at_start), u0)
        factors = factors_along(push, self.pattern, u0)

        def stage(carry, row):
            f, multipliers, solved = carry
            i, c, weights, predicting = row
            t, base = jnp.where(c == 1, t1, t0 + c * h), y0 + h * weighted(weights, f)
            guess = jnp.concatenate([weighted(predicting, f)[n : 2 * n], multipliers])
            u, converged = self._root(lambda u: residual(u, t, base), guess, base, state, factors)
            end = state(u, base)
            rates = jnp.concatenate([end[n : 2 * n], u[:n]])
            if len(y0) > 2 * n:
                rates = jnp.concatenate([rates, terms.vf(t, end, args)[2 * n :]])
            return (with_row(f, rates, i), u[n:], solved & converged), None

        size, dtype = len(tableau.b_sol), y0.dtype
        lower, predictor = (as_rows(rows, size, dtype) for rows in (tableau.a_lower, tableau.a_predictor))
        rows = np.arange(1, size), np.asarray(tableau.c, dtype), lower, predictor
        start = jnp.concatenate([first[None], jnp.zeros((size - 1, *y0.shape), dtype)])
        (f, multipliers, solved), _ = lax.scan(stage, (start, multipliers, jnp.array(True)), rows)
        y1, error = y0 + h * weighted(tableau.b_sol.astype(dtype), f), h * weighted(tableau.b_error.astype(dtype), f)
        result = dfx.RESULTS.where(solved, dfx.RESULTS.successful, dfx.RESULTS.nonlinear_divergence)
        return y1, jnp.where(solved, error, jnp.inf), {"y0": y0, "y1": y1, "k": h * f}, (f[-1], multipliers), result

    def _root(self, residual: Callable, guess, base, state: Callable, factors: NewtonFactors):
        """Where the residual is zero, with the derivative of what that says; and whether it was found."""
        finder, n = self.root_finder, self.pattern.last

        def iterated(residual, guess):
            def changed(iteration):
                u = iteration.u - by_factors(self.pattern, factors, residual(iteration.u))
                of_both = (state(u, base) - state(iteration.u, base))[: 2 * n]
                scale = (finder.atol + finder.rtol * jnp.abs(state(u, base)))[: 2 * n]
                return Iteration(u, finder.norm(of_both / scale), iteration.size, iteration.count + 1)

            one = jnp.ones((), guess.dtype)
            start = Iteration(guess, one, one, 0)
            end = repeated(changed, start, lambda it: it.goes_on(finder.kappa, self.root_find_max_steps))
            return end.u, end.has_converged(finder.kappa).astype(guess.dtype)  # a number: JAX wants its derivative, too

        u, converged = lax.custom_root(residual, guess, iterated, lambda push, b: linear_solution(push, self.pattern, b), has_aux=True)
        return u, converged > 0


@jitted
def stage_imbalance(equations: FirstOrderSystem, t, state, args: Arguments) -> Array:
    """Of y and (q̈, λ): M q̈ − f − Gᵀλ and G q̈ + γ, which are zero in motion."""
    if isinstance(equations, AugmentedSystem):
        return equations.along_axis(functools.partial(stage_imbalance, equations.equations), t, state, args)
    assert isinstance(equations, EquationsOfMotion)  # or it would be solved as it is
    (y, u), n = state, equations.size
    parts = equations.parts(y)
    _, mode, _ = equations.mode(t, parts, args)
    left, rates = imbalance(mode, t, parts.q, parts.v, u[:n], u[n:])
    feedback = equations.formulation.stabilisation.feedback()
    return jnp.concatenate([left, rates if feedback is None else rates + feedback(mode, t, parts.q, parts.v)])


def _pattern(equations: EquationsOfMotion, t, y, args: Arguments) -> SparsityPattern | None:
    """The pattern of the derivatives of the imbalance by q̈ and λ where q̇, and q, move with q̈; None where a dense matrix serves better."""
    n, rows = equations.size, equations.flat_at(args.params, equations.states_of(t, equations.parts(y))).rows

    def left(x):
        q, v, u = jnp.split(x, [n, 2 * n])
        return stage_imbalance(equations, t, (jnp.concatenate([q, v, y[2 * n :]]), u), args)

    return newton_pattern(left, jnp.concatenate([y[: 2 * n], jnp.zeros(n + rows, y.dtype)]), n)


def in_structure(solver: Any, equations: FirstOrderSystem, t0, y0, args: Arguments) -> Any:
    """A diagonally implicit solver that solves in the structure of the equations, where these are many and sparse; otherwise as it is.

    As it is, too, where the user has chosen how its equations are solved. y0 may have more axes, as variations and batches do.
    """
    params, alone = args.params, equations
    if isinstance(equations, BatchedEquations):
        params, alone = eqx.combine(params, jax.tree.map(lambda leaf: leaf[..., 0], args.own)), equations.equations
    if not (isinstance(solver, dfx.AbstractESDIRK) and isinstance(alone, EquationsOfMotion)) or alone.size < MANY:
        return solver
    chosen = solver.root_finder != type(solver)().root_finder
    if chosen or alone.modes or alone.light or alone.states.size:
        return solver
    y, args = y0[(..., *[0] * (y0.ndim - 1))], Arguments(params, args.scales)
    pattern = _pattern(alone, t0, y, args)
    return solver if pattern is None else SparseImplicit(type(solver), equations, pattern, solver.root_finder, solver.root_find_max_steps)
