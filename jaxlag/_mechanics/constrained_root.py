"""Roots of equations that are, in each step of Newton's method, a constrained solve."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float

from .._program.implicit import implicit_root
from .saddle_point import SaddlePoint, saddle_point, saddle_solver


class Linear(NamedTuple):
    """The linear equations M x = f + Gᵀλ, G x = c of a step, and its reach."""

    M: Float[Array, "k k"]
    G: Float[Array, "m k"]
    f: Float[Array, " k"]
    c: Float[Array, " m"]
    reach: Float[Array, " k"] | None = None

    def solution(self) -> SaddlePoint:
        """x and λ."""
        return saddle_point(lx.MatrixLinearOperator(self.M), self.G, self.f, self.c, self.reach)

    def change(self, residual: Float[Array, " w"]) -> Float[Array, " w"]:
        """What (x, λ) change where this is added to the left-hand sides; the rank is that of the step."""
        solve = saddle_solver(lx.MatrixLinearOperator(self.M), self.G, self.f, self.c, self.reach)
        return -jnp.concatenate(solve(*jnp.split(residual, [self.f.size])))


def root_of(residual: Callable, linear: Callable, search: Callable, args: tuple, like: Float[Array, " w"]) -> tuple[Array, Any]:
    """w with residual(args, w) = 0, as `search(linear, args)` finds it, and what else that says; linear(args, w) is the slope there."""
    residual, of_residual = jax.closure_convert(residual, args, like)
    linear, of_linear = jax.closure_convert(linear, args, like)
    fixed, within = jax.lax.stop_gradient((args, of_linear))
    w, aux = search(lambda args, w: linear(args, w, *within), fixed)
    of_all = lambda everything, w: residual(everything[0], w, *everything[1])
    change = lambda everything, w, R: linear(everything[0], w, *everything[2]).change(R)
    return implicit_root(of_all, change, (args, of_residual, of_linear), jax.lax.stop_gradient(w)), aux
