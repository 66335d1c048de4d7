"""Roots of equations that are, in each step of Newton's method, a constrained solve."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float

from .._program.implicit import implicit_root, open_function
from .._program.sparse_matrix import SparseMatrix
from .pseudo_inverse import Constraints
from .saddle_point import Rows, SaddlePoint, saddle_point, saddle_solver
from .structured_inertia import StructuredInertia

REFINEMENTS = 200  # of the derivative of a root, where curvature is left out of the step: each takes away a part


class Linear(NamedTuple):
    """The linear equations M x = f + Gᵀλ, G x = c of a step, and its reach."""

    M: lx.AbstractLinearOperator
    G: Rows
    f: Float[Array, " k"]
    c: Float[Array, " m"]
    reach: Float[Array, " k"] | None = None

    def solution(self, near: Constraints | None = None) -> SaddlePoint:
        """x and λ, of a state `near` the constraints."""
        return saddle_point(self.M, self.G, self.f, self.c, self.reach, near)

    def change(self, residual: Float[Array, " w"]) -> Float[Array, " w"]:
        """What (x, λ) change where this is added to the left-hand sides; the rank is that of the step."""
        solve = saddle_solver(self.M, self.G, self.f, self.c, self.reach)
        return -jnp.concatenate(solve(*jnp.split(residual, [self.f.size])))


def is_without_curvature(M: Any, G: Any) -> bool:
    """Whether the curvature of constraints is left out of a step: with it, M would lose its structure."""
    return isinstance(M, StructuredInertia) or (isinstance(G, SparseMatrix) and isinstance(M, lx.DiagonalLinearOperator))


def root_of(residual: Callable, linear: Callable, search: Callable, args: tuple, like: Float[Array, " w"]) -> tuple[Array, Any]:
    """w with residual(args, w) = 0, as `search(linear, args)` finds it, and what else that says; linear(args, w) is the slope there."""
    residual, of_residual = open_function(residual, args, like)
    linear, of_linear = open_function(linear, args, like)
    fixed, within = jax.lax.stop_gradient((args, of_linear))
    step_at = lambda args, w, within: jax.tree.map(jnp.asarray, linear(args, w, *within))  # JAX may hand numbers on as NumPy's arrays
    w, aux = search(lambda args, w: step_at(args, w, within), fixed)
    of_all = lambda everything, w: residual(everything[0], w, *everything[1])

    def change(everything, w, R):
        step = step_at(everything[0], w, everything[2])
        if not is_without_curvature(step.M, step.G):
            return step.change(R)
        return _refined(lambda dw: jax.jvp(lambda w: of_all(everything, w), (w,), (dw,))[1], step, R)

    return implicit_root(of_all, change, (args, of_residual, of_linear), jax.lax.stop_gradient(w)), aux


def _refined(slope: Callable, step: Linear, residual: Float[Array, " w"]) -> Float[Array, " w"]:
    """−slope⁻¹ residual by a step whose M is not the whole slope, again and again; NaN where that does not converge."""
    signs = jnp.concatenate([jnp.ones_like(step.f), -jnp.ones_like(step.c)])  # with which the slope is symmetric

    def solve(matvec, b):
        enough = 100 * jnp.finfo(b.dtype).eps

        def refine(carry):
            dw, _, i = carry
            added = step.change(signs * (matvec(dw) - b))
            return dw + added, jnp.max(jnp.abs(added)) / jnp.max(jnp.abs(dw + added)), i + 1

        going_on = lambda carry: (carry[1] > enough) & (carry[2] < REFINEMENTS)
        dw, left, _ = jax.lax.while_loop(going_on, refine, (jnp.zeros_like(b), jnp.ones((), b.dtype), 0))
        return jnp.where(left < jnp.finfo(b.dtype).eps ** 0.5, dw, jnp.where(jnp.any(b != 0), jnp.nan, 0))

    return jax.lax.custom_linear_solve(lambda dw: signs * slope(dw), -signs * residual, solve, symmetric=True)
