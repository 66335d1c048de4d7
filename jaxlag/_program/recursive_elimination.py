"""Quadratic forms of numbers x and running sums w of them, minimised one place after the other: n operations, whatever is full.

½ zᵀHz − fᵀx over z = (x, w), where w at one place is that at the place before and a sum of x beside it. From the last place on, the
smallest value of what follows is a quadratic form of the w before it: Riccati's recursion. For a chain of links in angles it is the
articulated body's inertia. Where there are no sums, it is the elimination of a block tridiagonal matrix.

Source: Featherstone, Int. J. Robotics Res. 2 (1983) 13; Rodriguez, IEEE J. Robotics Autom. 3 (1987) 624.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .chain_ordering import ChainOrdering
from .scalarise import scalarised

WRITTEN_OUT = 2000  # scalar operations of a turn: a loop of few numbers a turn is one kernel, at 10 ns for a link in the plane


class Factors(NamedTuple):
    """Of each block: the Cholesky factor of its own form of x, the coupling to what comes before, how what is handed on depends on x and
    on that; and the least pivot, by what it was before the elimination.
    """

    L: Float[Array, "b a a"]
    K: Float[Array, "b a c"]
    by_x: Float[Array, "b c a"]
    by_before: Float[Array, "b c c"]
    pivot: Float[Array, ""]


def factor(ordering: ChainOrdering, entries: Float[Array, " e"]) -> Factors:
    """The minimum over x of one block after the other, as a form of what comes before."""
    given = jnp.concatenate([entries, jnp.array([0, 1], entries.dtype)])[ordering.entry]
    P = jnp.zeros((ordering.handed.size, ordering.handed.size), entries.dtype)
    turn = scalarised(functools.partial(_eliminated, ordering), limit=WRITTEN_OUT)
    _, (L, K, pivots) = lax.scan(turn, (P, P[0]), given, reverse=True)
    by_x, by_before = jax.vmap(lambda given: _by_parts(ordering, _matrices(ordering, given)))(given)
    pivot = jnp.where(jnp.any(jnp.isnan(pivots)), jnp.nan, jnp.min(pivots))  # a minimum of thousands leaves NaN out on a CPU
    return Factors(L, K, by_x[:, ordering.handed], by_before[:, ordering.handed], pivot)


def _matrices(ordering: ChainOrdering, given: Float[Array, " g"]) -> list[Array]:
    numbers = jnp.concatenate([given, jnp.array([0, 1], given.dtype)])
    return [numbers[slots] for slots in ordering.slots]


def _by_parts(ordering: ChainOrdering, matrices: list[Array]) -> tuple[Float[Array, "p a"], Float[Array, "p c"]]:
    """How the numbers of a block depend on its x and on what is handed to it: each sum is one of what is before it."""
    _, _, within, before = matrices
    a = ordering.at.shape[1]
    by_x, by_before = [*jnp.eye(a, dtype=within.dtype)], [*jnp.zeros((a, ordering.handed.size), within.dtype)]
    for k, row in enumerate(ordering.slots[2]):
        of = [j for j in range(a + k) if row[j] != ordering.entry.shape[1]]
        by_x.append(sum((within[k, j] * by_x[j] for j in of), start=jnp.zeros_like(by_x[0])))
        by_before.append(sum((within[k, j] * by_before[j] for j in of if j >= a), start=before[k]))
    return jnp.stack(by_x), jnp.stack(by_before)


def _eliminated(ordering: ChainOrdering, carry: tuple[Array, Array], given: Float[Array, " g"]) -> tuple[tuple, tuple]:
    """A turn: P is the form of what follows in the numbers handed on, `root` the roots of its diagonal before the elimination."""
    (P, root), (H, beside, *sums) = carry, _matrices(ordering, given)
    X, B = _by_parts(ordering, [H, beside, *sums])
    X_on, B_on = X[ordering.handed], B[ordering.handed]
    pulled = H @ B + beside
    form = X.T @ H @ X + X_on.T @ P @ X_on
    L = jnp.linalg.cholesky(form)
    K = jax.scipy.linalg.solve_triangular(L, X.T @ pulled + X_on.T @ P @ B_on, lower=True)
    whole = B.T @ pulled + beside.T @ B + B_on.T @ P @ B_on
    size = jnp.sum(jnp.abs(X) * (jnp.abs(H) @ jnp.abs(X)), axis=0) + (jnp.abs(X_on).T @ root) ** 2
    return (whole - K.T @ K, jnp.sqrt(jnp.abs(jnp.diagonal(whole)))), (L, K, jnp.min(jnp.diagonal(L) ** 2 / size))


def by_root(ordering: ChainOrdering, factors: Factors, F: Float[Array, "n k"]) -> Float[Array, "b a k"]:
    """R⁻ᵀF where M = Rᵀ R is the matrix of the whole form in x."""

    @scalarised
    def turn(beta, given):
        (L, K, by_x, by_before), f = given
        e = jax.scipy.linalg.solve_triangular(L, f + by_x.T @ beta, lower=True)
        return by_before.T @ beta - K.T @ e, e

    def of_one(f):
        beta = jnp.zeros(ordering.handed.size, f.dtype)
        return lax.scan(turn, beta, (factors[:4], jnp.append(f, 0)[ordering.at]), reverse=True)[1]

    return of_columns(of_one, F)


def by_factor(ordering: ChainOrdering, factors: Factors, F: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """M⁻¹F: what makes the form least."""

    @scalarised
    def turn(handed, given):
        (L, K, by_x, by_before), e = given
        x = jax.scipy.linalg.solve_triangular(L, e - K @ handed, lower=True, trans=1)
        return by_x @ x + by_before @ handed, x

    def of_one(e):
        handed = jnp.zeros(ordering.handed.size, e.dtype)
        return lax.scan(turn, handed, (factors[:4], e))[1].ravel()[ordering.back]

    return of_columns(of_one, by_root(ordering, factors, F))


def of_columns(function: Callable, F: Float[Array, "*n k"]) -> Float[Array, "*m k"]:
    """A function of one column of each."""
    return function(F[..., 0])[..., None] if F.shape[-1] == 1 else jax.vmap(function, -1, -1)(F)
