"""Roots by Newton's method where the Jacobian may be singular or not square, with derivatives by the implicit function theorem."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Bool, Float

from .._program.implicit import implicit_root
from .._program.sparse_matrix import SparseMatrix

ITERATIONS = 100
Residual = Callable[[Any, Float[Array, " u"]], Float[Array, " r"]]  # R(args, w)


class Root(NamedTuple):
    """w with R(w) = 0, and whether it is one."""

    w: Float[Array, " u"]
    found: Bool[Array, ""]


def root_near(residual: Residual, args: Any, guess: Float[Array, " u"], ease: Float[Array, " u"] | float = 1.0) -> Root:
    """The root that Newton's method finds from a guess; of several that nothing decides between, the nearest, where to move one unknown
    costs less the greater its `ease`.
    """
    fixed = jax.lax.stop_gradient(args)
    slope = lambda w: jax.jacfwd(residual, 1)(fixed, w)

    def changes(w):
        J = slope(w)
        return lambda w: -least_change(J, residual(fixed, w), ease * (1 + jnp.abs(w)))

    w = newton(changes, jax.lax.stop_gradient(guess))
    return Root(differentiable_root(residual, args, w), is_root(slope(w), residual(fixed, w), w))


def newton(changes: Callable[[Array], Callable[[Array], Array]], guess: Float[Array, " u"]) -> Float[Array, " u"]:
    """Where Newton's method comes to rest; `changes(w)` is w' ↦ −J(w)⁻¹ R(w').

    A step is halved until the step that would follow it is shorter: a test that does not depend on the units of R or w.

    Source: Deuflhard, Newton Methods for Nonlinear Problems, section 3.3.2 (natural monotonicity test).
    """
    eps = jnp.finfo(guess.dtype).eps
    length = lambda step, w: jnp.max(jnp.abs(step) / (1 + jnp.abs(w)), initial=0.0)

    def turn(carry):
        w, _, i = carry
        change = changes(w)
        step = change(w)

        def is_shorter(part):
            after = length(change(w + part * step), w)
            return jnp.isfinite(after) & (after <= (1 - part / 4) * length(step, w))

        part = jax.lax.while_loop(lambda part: (part > 1e-3) & ~is_shorter(part), lambda part: part / 2, jnp.ones((), w.dtype))
        near = length(step, w) <= eps**0.5  # where rounding decides what is shorter
        return w + jnp.where(near, 1.0, part) * step, length(step, w) <= 8 * eps, i + 1

    def is_on_its_way(carry):
        w, done, i = carry
        return (i < ITERATIONS) & ~done & jnp.all(jnp.isfinite(w))

    w, _, _ = jax.lax.while_loop(is_on_its_way, turn, (guess, jnp.array(False), jnp.array(0)))
    return w


def is_root(J: Array | SparseMatrix, R: Array, w: Array) -> Bool[Array, ""]:
    """Whether a residual is zero: a change of w by rounding would bring as much about."""
    allowed = jnp.finfo(w.dtype).eps ** 0.5 * (abs(J) @ (1 + jnp.abs(w)))
    return jnp.all(jnp.isfinite(w)) & jnp.all(jnp.abs(R) <= allowed)


def differentiable_root(residual: Residual, args: Any, w: Float[Array, " u"]) -> Float[Array, " u"]:
    """w, which depends on args as R(args, w) = 0 says; of several ways to change with them, by the shortest."""
    return implicit_root(residual, functools.partial(_change, residual), args, w)


def _change(residual, args, w, R):
    return -least_change(jax.jacfwd(residual, 1)(args, w), R, 1 + jnp.abs(jax.lax.stop_gradient(w)))


def least_change(J: Float[Array, "r u"], R: Float[Array, " r"], scale: Any) -> Float[Array, " u"]:
    """The least x with J x = R, x in units of `scale`, and each row of J in its own."""
    scale = jnp.broadcast_to(jnp.asarray(scale, J.dtype), J.shape[1:])
    scaled = J * scale[None, :]
    size = jnp.max(jnp.abs(jax.lax.stop_gradient(scaled)), axis=1, initial=0.0)
    rows = jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1), 1)
    solver = lx.SVD(rcond=float(jnp.finfo(J.dtype).eps) ** 0.625)
    return scale * lx.linear_solve(lx.MatrixLinearOperator(rows[:, None] * scaled), rows * R, solver, throw=False).value
