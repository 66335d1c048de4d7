"""S⁺ of S = G M⁻¹ Gᵀ, whose rank is judged: rows of G may repeat each other, and nearly so.

Differentiated at constant rank. Source: Golub & Pereyra, SIAM J. Numer. Anal. 10 (1973) 413.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._program.conditions import everywhere
from .._program.shifted_factors import inverse_lengths

# Exponents of eps (1.3e-5, 1.6e-10, 1.8e-12, 1.3e-6 and 1.1e-2 in double precision) and a factor, with which ranks are judged
CLEAR, SEEN, NOISE, FOLLOWS, FAR, FARTHER = 0.3125, 0.625, 0.75, 0.375, 0.125, 2
MAY_BE = 3  # times as large as to first order


class Constraints(NamedTuple):
    """By how much a state is `off` each of them, and what their `rows` are at δq from it."""

    off: Callable[[], Float[Array, " m"]]
    rows: Callable[[Float[Array, " n"]], Float[Array, "m n"]]


class Beside(NamedTuple):
    """A state beside its constraints: by how much it is `off` each, and what rows `change` by, in the metric of M, at q + M⁻¹Gᵀy."""

    off: Float[Array, " m"]
    change: Callable[[Float[Array, " m"]], Float[Array, "m n"]]


class Reach(NamedTuple):
    """How far what each row sees may go, or each coordinate, in directions that are barely held; and where that `counts`, if not always."""

    sizes: Float[Array, " m"]
    counts: Any = None


class Request(NamedTuple):
    """Of a constrained solve, in the metric of M: the `rows` of G, what is asked of them, the `free` motion without them, and, where
    that is given, how far what each row sees may `reach`, and where the state is `beside` them.
    """

    rows: Float[Array, "m n"]
    c: Float[Array, "m k"]
    free: Float[Array, "n k"]
    reach: Reach | None
    beside: Beside | None


class Inverse(NamedTuple):
    """S⁺, of an S with rows of length 1/D: by the Cholesky factor of D S D where S is `regular`, else as root rootᵀ; of one row, D."""

    regular: Bool[Array, ""]
    D: Float[Array, " m"]
    factor: Float[Array, "m m"]
    root: Float[Array, "m m"]


def inverse_of(S: Float[Array, "m m"], c: Float[Array, "m k"], singular: Callable) -> tuple[Inverse, Bool[Array, ""]]:
    """S⁺ on the directions that are held, and whether what c asks of the others follows from these; `singular(D)` says so where the rank
    is in question.

    All is judged with rows scaled to unit length in the metric of M, so that it does not depend on the units of the constraints. Where
    S − m √eps 1 has a Cholesky factorisation, that of S serves: no eigenvalue is below √eps of the largest, which is at most m.
    """
    m, eps, size = S.shape[0], jnp.finfo(S.dtype).eps, jnp.diagonal(S)
    if m < 2:
        D = jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1), 0)
        return Inverse(jnp.array(True), D, S, S), jnp.all((size > 0)[:, None] | (c == 0))
    D, there = inverse_lengths(size)  # what is less may be nothing but rounding, and is refused
    nearly_zero = jnp.abs(c) <= eps**FOLLOWS * jnp.max(jnp.abs(c), axis=0, keepdims=True)
    follows = jnp.all(there[:, None] | (nearly_zero & (size == 0)[:, None]))
    one, nothing = jnp.eye(m, dtype=S.dtype), jnp.zeros_like(S)
    scaled = S * jnp.outer(D, D) + jnp.diag(~there).astype(S.dtype)
    regular = everywhere(jnp.all(jnp.diagonal(jnp.linalg.cholesky(scaled - m * eps**0.5 * one)) > 0))
    root, others_follow = jax.lax.cond(regular, lambda: (nothing, jnp.array(True)), lambda: singular(D))
    return Inverse(regular, D, jnp.linalg.cholesky(jnp.where(regular, scaled, one)), root), follows & others_follow


def by_rows(asked: Request, D) -> tuple[Float[Array, "m m"], Bool[Array, ""]]:
    """A root of S⁺ by the singular values of the rows themselves, of which S holds the squares: rounding hides those below √eps there.

    Values above `CLEAR` of the largest count. Those down to `SEEN` count where what they ask for is no more than `FARTHER` times all the
    rest, or `reach`. Others are left out: below `NOISE`, where dependent rows have them by rounding, for good; above it, unsatisfied.
    Left out for good is too what rows that depend on each other on the constraints alone ask of a state `beside` them, but not `FAR` off.
    """
    eps, rows = jnp.finfo(D.dtype).eps, D[:, None] * asked.rows
    U, values = _left_singular_vectors(jnp.concatenate([rows, _absent(D)], axis=1))
    wanted, rest = D[:, None] * asked.c, U.T @ (D[:, None] * asked.c - rows @ asked.free)
    clear, seen = values > eps**CLEAR * values[0], values > eps**SEEN * values[0]
    step = rest / jnp.where(seen, values, 1)[:, None]
    of_rows = lambda sizes: jnp.abs(U.T) @ sizes  # of what the rows in a direction have, so that what these do not touch has no say
    length = lambda x: of_rows(jnp.sqrt((rows != 0).astype(x.dtype) @ x**2))
    moved = rows.T @ (U @ (jnp.where(clear[:, None], step, 0) / jnp.where(clear, values, 1)[:, None]))
    bound = FARTHER * (length(asked.free) + length(moved))
    if (reach := asked.reach) is not None:
        within = of_rows(reach.sizes)[:, None]
        bound = within if reach.counts is None else jnp.where(reach.counts, within, bound)
    bound = bound / jnp.max(jnp.abs(U), axis=0)[:, None]  # a direction of many rows goes as far as what all of them touch
    blur = jnp.zeros_like(values) if asked.beside is None else _blur(asked.beside, D, U, values, clear)
    held = (clear | (seen & jnp.all(jnp.abs(step) <= bound, axis=1))) & (values > blur)
    of_each = jnp.abs(wanted) + jnp.sqrt((rows != 0).astype(rest.dtype) @ asked.free**2)  # what each row asks for, and sees move
    rounding = 10 * len(D) * eps * jnp.max(of_each, axis=0, keepdims=True)  # U errs by eps in every row, if it has a part in it or not
    slight = eps**FOLLOWS + MAY_BE * blur / jnp.where(values[0] > 0, values[0], 1)
    contradicts = jnp.abs(rest) > slight[:, None] * (jnp.abs(U.T) @ of_each) + rounding
    satisfied = ~jnp.any(~held & ((values > jnp.maximum(eps**NOISE * values[0], blur)) | jnp.any(contradicts, axis=1)))
    return _by_values(values**2, U, held, D), satisfied


def _blur(beside, D, U, values, clear):
    """What values rows may have but for the state being off: those of their changes on the way back to the constraints; from far away,
    where these are as large as the rows, they say nothing.
    """
    back = D * (U @ (jnp.where(clear, U.T @ (D * -beside.off), 0) / jnp.where(clear, values, 1) ** 2))
    blur = MAY_BE * jnp.linalg.norm(U.T @ (D[:, None] * beside.change(back)), axis=1)
    return jnp.where(blur < jnp.finfo(D.dtype).eps ** FAR * values[0], blur, 0)


def _absent(D):
    """A direction of its own for each row of zeros: among those that are not held, rounding would mix it with others."""
    return jnp.diag(D == 0).astype(D.dtype)


def _left_singular_vectors(rows: Float[Array, "m n"]) -> tuple[Float[Array, "m m"], Float[Array, " m"]]:
    """U and the singular values, the largest first. Of two rows by the one rotation that makes them orthogonal, in few operations.

    Source: Golub & Van Loan, Matrix Computations, 4th ed., section 8.6.3 (one-sided Jacobi).
    """
    if len(rows) != 2:
        U, values, _ = jnp.linalg.svd(rows, full_matrices=False)  # no more rows than columns, with those that are absent
        return U, values
    a, b = rows
    product = a @ b
    zeta = (b @ b - a @ a) / jnp.where(product == 0, 1, 2 * product)
    tangent = jnp.where(product == 0, 0, jnp.where(zeta < 0, -1, 1) / (jnp.abs(zeta) + jnp.sqrt(1 + zeta**2)))
    c = jax.lax.rsqrt(1 + tangent**2)
    s = c * tangent
    U = jnp.stack([jnp.stack([c, s]), jnp.stack([-s, c])])
    values = jnp.sqrt(jnp.sum((U.T @ rows) ** 2, axis=1))
    ordered = values[0] >= values[1]
    return jnp.where(ordered, U, U[:, ::-1]), jnp.where(ordered, values, values[::-1])


def _by_values(values, U, held, D):
    """R with R Rᵀ = (D⁻¹ A D⁻¹)⁺, for A = U diag(values) Uᵀ with what is not held taken out."""
    size = jnp.where(held, jax.lax.rsqrt(jnp.where(held, values, 1)), 0)
    # Least norm in the units given: take out of range and domain what lies in the null space of S, spanned by V.
    V = jnp.where(held[None, :], 0, D[:, None] * U)
    out = jnp.eye(len(D), dtype=D.dtype) - V @ _inverse_of_columns(V)
    return out @ (D[:, None] * U * size[None, :])


def _inverse_of_columns(V):
    """V⁺. Of two columns, one of them zero, by their squares; of more, these could lie so near one another that squares hide it."""
    if len(V) > 2:
        return jnp.linalg.pinv(V)
    squares = jnp.sum(V**2, axis=0)
    gram = jnp.linalg.cholesky(V.T @ V + jnp.diag(squares == 0).astype(V.dtype))
    return jax.scipy.linalg.cho_solve((gram, True), V.T)


@jax.custom_jvp
def applied(S: Float[Array, "m m"], inverse: Inverse, R: Float[Array, "m k"]) -> Float[Array, "m k"]:
    """S⁺R; differentiated at constant rank."""
    regular, D, factor, root = inverse
    if len(D) < 2:
        size = jnp.diagonal(S)[:, None]
        return jnp.where(size > 0, R / jnp.where(size > 0, size, 1), 0)
    solve = lambda _, R: D[:, None] * jax.scipy.linalg.cho_solve((factor, True), D[:, None] * R)
    # A forward pass over a reverse one differentiates this body, not its rule: S⁺ is a solve with S that moves, or, where S is singular,
    # has terms that change nothing but the derivative by S.
    by_factor = lambda S, R: jax.lax.custom_linear_solve(lambda X: S @ X, R, solve, symmetric=True)

    def by_root(S, R):
        fixed = jax.lax.stop_gradient(S)
        P = lambda X: root @ (root.T @ X)  # by parts: the product has lost the smaller values
        N, change, X = lambda X: X - fixed @ P(X), S - fixed, P(R)
        return X - P(change @ X) + N(change @ P(X)) + P(P(change @ N(R)))

    return jnp.where(regular, by_factor(S, R), by_root(S, R))


@applied.defjvp
def _applied_jvp(primals, tangents):
    # Golub & Pereyra 1973, eq. 4.12, for constant rank: P = S⁺ turns with its null space, that of N = 1 − S P.
    (S, inverse, R), (dS, _, dR) = primals, tangents
    P = lambda X: applied(S, inverse, X)
    N = lambda X: X - S @ P(X)
    X = P(R)
    return X, P(dR - dS @ X) + N(dS @ P(X)) + P(P(dS @ N(R)))


def pseudo_inverse(S: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """Moore–Penrose inverse of a symmetric positive semidefinite S."""

    def singular(D):
        D = jax.lax.stop_gradient(D)
        values, U = jnp.linalg.eigh(jax.lax.stop_gradient(S) * jnp.outer(D, D) + _absent(D))
        return _by_values(values, U, values > jnp.finfo(D.dtype).eps ** (2 * CLEAR) * values[-1], D), jnp.array(True)

    one = jnp.eye(len(S), dtype=S.dtype)
    return applied(S, inverse_of(S, jnp.zeros_like(S), singular)[0], one)
