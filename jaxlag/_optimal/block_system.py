r"""Positive definite systems of a chain of intervals with a border, by Cholesky's factors.

Interval k depends on the state in which it begins, x_{k-1}, on numbers of its own, whose last are the state x_k in which it ends, and on
the border p, whose first are the state at the very start. All but x_k of its own numbers occur nowhere else, so they go first, in all
intervals at once. What is left is block tridiagonal in the states, with a border, of the matrices K of the intervals without them:

    S_k = D_k - E_k S_{k-1}⁻¹ E_kᵀ,        R_k = B_k - E_k S_{k-1}⁻¹ R_{k-1}

Source: Golub & Van Loan, Matrix Computations, 4th ed., section 4.5; Steinbach, SIAM Journal on Optimization 4 (1994), "condensing".
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class Shape(NamedTuple):
    """How many intervals there are, numbers of a block, and of its state; of the border, of which the first are the state at the start."""

    intervals: int
    block: int
    state: int
    border: int

    @property
    def local(self) -> int:
        """How many numbers a function of one interval depends on: the state before, the block, the border."""
        return self.state + self.block + self.border

    def split(self, x: Array) -> tuple[Array, Array]:
        """w (N, block), and p."""
        return x[: self.intervals * self.block].reshape(self.intervals, self.block), x[self.intervals * self.block :]

    def gathered(self, x: Array) -> Array:
        """What each interval depends on, (N, local)."""
        w, p = self.split(x)
        before = jnp.concatenate([p[None, : self.state], w[:-1, self.block - self.state :]])
        return jnp.concatenate([before, w, jnp.broadcast_to(p[None], (self.intervals, self.border))], axis=1)

    def scattered(self, of_each: Array) -> Array:
        """The sum of what each interval contributes, (N, local), to each number: the transpose of `gathered`."""
        before, w, p = jnp.split(of_each, [self.state, self.state + self.block], axis=1)
        w = w.at[:-1, self.block - self.state :].add(before[1:])
        border = jnp.sum(p, axis=0).at[: self.state].add(before[0])
        return jnp.concatenate([w.ravel(), border])


class States(NamedTuple):
    """Of the chain of states: each S_k⁻¹, E_k, S_k⁻¹R_k, and Cholesky's factor of what is left of the border."""

    inverse: Float[Array, "N x x"]
    before: Float[Array, "N x x"]
    border: Float[Array, "N x p"]
    corner: Float[Array, "p p"]


class Factors(NamedTuple):
    """Cholesky's factors L of what each interval has alone, L⁻¹ of its columns of the states and the border; and what these leave."""

    own: Float[Array, "N i i"]
    others: Float[Array, "N i o"]
    states: States

    @property
    def is_positive(self) -> Array:
        """Whether the matrix is positive definite."""
        return jnp.all(jnp.isfinite(self.states.corner)) & jnp.all(jnp.isfinite(self.states.inverse))


def factors(shape: Shape, K: Float[Array, "N l l"], diagonal: Float[Array, " n"]) -> Factors:
    """Of the sum of the matrices K of all intervals, and of a diagonal. Where it is not positive, there is a NaN."""
    N, b, x, p = shape
    w, of_border = shape.split(diagonal)
    own, others = slice(x, b), _others(shape)
    L = jnp.linalg.cholesky(K[:, own, own] + jax.vmap(jnp.diag)(w[:, : b - x]))
    V = jax.lax.linalg.triangular_solve(L, K[:, own][:, :, others], left_side=True, lower=True)
    left = K[:, others][:, :, others] - jnp.einsum("kio,kij->koj", V, V)
    of_states = Shape(N, x, x, p), left, jnp.concatenate([w[:, b - x :].ravel(), of_border])
    return Factors(L, V, _of_states(*of_states))


def _others(shape: Shape) -> Array:
    """Where an interval has the states and the border."""
    _, b, x, p = shape
    return jnp.concatenate([jnp.arange(x), jnp.arange(b, x + b + p)])


def _of_states(shape: Shape, K: Array, diagonal: Array) -> States:
    _, x, _, p = shape
    first, own, last = slice(0, x), slice(x, 2 * x), slice(2 * x, None)
    w, of_border = shape.split(diagonal)
    D = K[:, own, own] + jax.vmap(jnp.diag)(w)
    D = D.at[:-1].add(K[1:, first, first])
    E = K[:, own, first].at[0].set(0)
    B = K[:, own, last].at[:-1].add(K[1:, first, last])
    B = B.at[0, :, :x].add(K[0, own, first])
    P = jnp.sum(K[:, last, last], axis=0) + jnp.diag(of_border)
    P = P.at[:x, :x].add(K[0, first, first]).at[:x].add(K[0, first, last]).at[:, :x].add(K[0, last, first])

    def step(before, of):
        inverse, R, left = before
        D, E, B = of
        F = E @ inverse
        S, R = D - F @ E.T, B - F @ R
        L = jnp.linalg.cholesky(S)
        half = jax.lax.linalg.triangular_solve(L, jnp.concatenate([jnp.eye(x, dtype=K.dtype), R], axis=1), left_side=True, lower=True)
        inverse, Z = half[:, :x].T @ half[:, :x], half[:, x:]
        return (inverse, R, left - Z.T @ Z), (inverse, inverse @ R)

    start = jnp.zeros((x, x), K.dtype), jnp.zeros((x, p), K.dtype), P
    (_, _, left), (inverse, R) = jax.lax.scan(step, start, (D, E, B))
    return States(inverse, E, R, jnp.linalg.cholesky(left))


def solved(shape: Shape, of: Factors, r: Float[Array, " n"]) -> Float[Array, " n"]:
    """The solution of K x = r."""
    N, b, x, p = shape
    w, of_border = shape.split(r)
    solve = lambda y, transposed: jax.lax.linalg.triangular_solve(of.own, y[..., None], left_side=True, lower=True, transpose_a=transposed)[
        ..., 0
    ]
    y = solve(w[:, : b - x], False)
    smaller = Shape(N, x, x, p)
    rest = jnp.concatenate([w[:, b - x :].ravel(), of_border]) - smaller.scattered(jnp.einsum("kio,ki->ko", of.others, y))
    rest = _solved_states(smaller, of.states, rest)
    y = solve(y - jnp.einsum("kio,ko->ki", of.others, smaller.gathered(rest)), True)
    w, of_border = smaller.split(rest)
    return jnp.concatenate([jnp.concatenate([y, w], axis=1).ravel(), of_border])


def _solved_states(shape: Shape, of: States, r: Array) -> Array:
    w, p = shape.split(r)

    def forwards(before, of):
        inverse, E, r = of
        rest = r - E @ before
        y = inverse @ rest
        return y, (rest, y)

    _, (rest, y) = jax.lax.scan(forwards, jnp.zeros(shape.state, r.dtype), (of.inverse, of.before, w))
    # the border: P - Σ RᵀS⁻¹R is factorised, and Rᵀ S⁻¹ r = (S⁻¹R)ᵀ r
    p = jax.scipy.linalg.cho_solve((of.corner, True), p - jnp.einsum("kbp,kb->p", of.border, rest))
    y = y - of.border @ p
    following = jnp.concatenate([jnp.swapaxes(of.before[1:], 1, 2), jnp.zeros_like(of.before[:1])])

    def backwards(after, of):
        coupling, y = of
        w = y - coupling @ after
        return w, w

    _, w = jax.lax.scan(backwards, jnp.zeros(shape.state, r.dtype), (of.inverse @ following, y), reverse=True)
    return jnp.concatenate([w.ravel(), p])
