r"""Positive definite systems of a chain of blocks with a border, by Cholesky's factors.

Block k holds w_k. A function of one interval depends on the last entries of w_{k-1}, the state in which it begins, on w_k, and on the
border p, which holds the state at the very start. So a matrix that is a sum over intervals is block tridiagonal with a border:

    S_k = D_k - E_k (S_{k-1}^{-1})_{xx} E_kᵀ,        R_k = B_k - E_k (S_{k-1}^{-1} R_{k-1})_x

Source: Golub & Van Loan, Matrix Computations, 4th ed., section 4.5.
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


class Factors(NamedTuple):
    """Cholesky's factors of each S_k, E_k, S_k⁻¹R_k with the border as R, and of what is left of the border."""

    chain: Float[Array, "N b b"]
    before: Float[Array, "N b x"]
    border: Float[Array, "N b p"]
    corner: Float[Array, "p p"]


def factors(shape: Shape, K: Float[Array, "N l l"], diagonal: Float[Array, " n"]) -> Factors:
    """Of the sum of the matrices K of all intervals, and of a diagonal. Where it is not positive, there is a NaN."""
    N, b, x, p = shape
    first, last = slice(0, x), slice(x + b, None)
    own = slice(x, x + b)
    w, of_border = shape.split(diagonal)
    D = K[:, own, own] + jax.vmap(jnp.diag)(w)
    D = D.at[:-1, b - x :, b - x :].add(K[1:, first, first])
    E = K[:, own, first].at[0].set(0)
    B = K[:, own, last].at[:-1, b - x :].add(K[1:, first, last])
    B = B.at[0, :, :x].add(K[0, own, first])
    P = jnp.sum(K[:, last, last], axis=0) + jnp.diag(of_border)
    P = P.at[:x, :x].add(K[0, first, first]).at[:x].add(K[0, first, last]).at[:, :x].add(K[0, last, first])

    def step(before, of):
        S_xx, R_x, left = before
        D, E, B = of
        S, R = D - E @ S_xx @ E.T, B - E @ R_x
        L = jnp.linalg.cholesky(S)
        wide = jnp.concatenate([jnp.eye(b, x, x - b, dtype=K.dtype), R], axis=1)
        solved = jax.scipy.linalg.cho_solve((L, True), wide)
        return (solved[b - x :, :x], solved[b - x :, x:], left - R.T @ solved[:, x:]), (L, solved[:, x:])

    start = jnp.zeros((x, x), K.dtype), jnp.zeros((x, p), K.dtype), P
    (_, _, left), (L, R) = jax.lax.scan(step, start, (D, E, B))
    return Factors(L, E, R, jnp.linalg.cholesky(left))


def solved(shape: Shape, of: Factors, r: Float[Array, " n"]) -> Float[Array, " n"]:
    """The solution of K x = r."""
    b, x = shape.block, shape.state
    w, p = shape.split(r)

    def forwards(before, of):
        L, E, r = of
        y = jax.scipy.linalg.cho_solve((L, True), r - E @ before)
        return y[b - x :], (r - E @ before, y)

    _, (rest, y) = jax.lax.scan(forwards, jnp.zeros(x, r.dtype), (of.chain, of.before, w))
    # the border: P - Σ RᵀS⁻¹R is factorised, and Rᵀ S⁻¹ r = (S⁻¹R)ᵀ r
    p = jax.scipy.linalg.cho_solve((of.corner, True), p - jnp.einsum("kbp,kb->p", of.border, rest))

    def backwards(after, of):
        L, E_next, y, R = of
        w = y - R @ p - jax.scipy.linalg.cho_solve((L, True), jnp.zeros(b, r.dtype).at[b - x :].set(E_next.T @ after))
        return w, w

    following = jnp.concatenate([of.before[1:], jnp.zeros_like(of.before[:1])])
    _, w = jax.lax.scan(backwards, jnp.zeros(b, r.dtype), (of.chain, following, y, of.border), reverse=True)
    return jnp.concatenate([w.ravel(), p])
