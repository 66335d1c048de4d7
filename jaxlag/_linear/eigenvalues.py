"""Eigenvalues and eigenvectors, differentiable to any order; repeated ones are treated as one."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

POINTS = 32  # of an integral around an eigenvalue
TURNS = 60  # of the scaling of a matrix


class Eigen(NamedTuple):
    """Eigenvalues, and eigenvectors as columns, each with largest entry 1."""

    values: Complex[Array, " d"]
    vectors: Complex[Array, "d d"]


@jax.custom_jvp
def eigen(A: Float[Array, "d d"]) -> Eigen:
    """Eigenvalues and eigenvectors of A, sorted by |λ|. If A is block triangular to rounding, as with coordinates on which nothing depends,
    it is made so exactly.

    Derivatives of repeated eigenvalues are those of their mean, which alone is smooth.

    Source: Golub & Van Loan, Matrix Computations, 4th ed., sections 7.2.2 (derivatives) and 7.5.7 (balancing).
    """
    if not len(A):
        return Eigen(jnp.zeros(0, _complex(A)), jnp.zeros((0, 0), _complex(A)))
    scale, size = balanced(A)
    scaled = A * scale[None, :] / scale[:, None]
    values, vectors = jnp.linalg.eig(jnp.where(jnp.abs(scaled) <= len(A) * jnp.finfo(A.dtype).eps * size, 0, scaled))
    vectors = scale[:, None] * vectors
    values = jnp.where(jnp.abs(values) <= rounding(A, vectors), 0, values)
    order = jnp.lexsort((values.imag, jnp.abs(values)))
    values, vectors = values[order], vectors[:, order]
    return Eigen(values, vectors / jnp.take_along_axis(vectors, _largest(vectors), axis=0))


@eigen.defjvp
def _eigen_rule(primals: Any, tangents: Any) -> Any:
    """dλ = tr(P dA)/k for the k eigenvalues equal to λ, and dx = Q dA x, normalised so that the largest entry of x stays 1.

    P projects onto the eigenspace of λ, and Q is (λ − A)⁻¹ on all others: integrals of (z − A)⁻¹ around λ, which exist even if there are
    too few eigenvectors. Source: Kato, Perturbation Theory for Linear Operators, sections II.1.4 and II.2.
    """
    (A,), (dA,) = primals, tangents
    found = values, vectors = eigen(A)
    if not len(A):
        return found, found
    fixed = jax.lax.stop_gradient(values)
    same = are_repeated(fixed, rounding(A, vectors))
    gap = jnp.min(jnp.where(same, jnp.inf, jnp.abs(fixed[None, :] - fixed[:, None])), axis=1)
    radius = jnp.where(jnp.isfinite(gap), gap / 3, 1 + jnp.abs(fixed))  # an eigenvalue three radii away contributes 3⁻³² of itself
    circle = jnp.exp(2j * jnp.pi * (np.arange(POINTS) + 0.5) / POINTS).astype(values.dtype)

    def of(one):
        value, center, radius, x, count = one
        z = center + radius * circle
        resolvents = jnp.linalg.inv(z[:, None, None] * jnp.eye(len(A), dtype=z.dtype)[None] - A[None])
        P = jnp.mean((z - center)[:, None, None] * resolvents, axis=0)
        Q = jnp.mean(((z - center) / (z - value))[:, None, None] * resolvents, axis=0)
        return jnp.sum(P.T * dA) / count, Q @ (dA @ x)

    d_values, moved = jax.lax.map(of, (values, fixed, radius, vectors.T, jnp.sum(same, axis=1).astype(values.dtype)))
    return found, Eigen(d_values, moved.T - vectors * jnp.take_along_axis(moved.T, _largest(vectors), axis=0))


@jax.custom_jvp
def symmetric_eigen(A: Float[Array, "d d"]) -> tuple[Float[Array, " d"], Float[Array, "d d"]]:
    """Eigenvalues of a symmetric matrix, ascending, and orthonormal eigenvectors whose largest entry is positive."""
    values, vectors = jnp.linalg.eigh(A)
    values = jnp.where(jnp.abs(values) <= _symmetric_rounding(A), 0, values)
    return values, vectors * jnp.sign(jnp.take_along_axis(vectors, _largest(vectors), axis=0)) if len(A) else vectors


@symmetric_eigen.defjvp
def _symmetric_rule(primals: Any, tangents: Any) -> Any:
    (A,), (dA,) = primals, tangents
    found = values, vectors = symmetric_eigen(A)
    rates, same = vectors.T @ dA @ vectors, are_repeated(values, _symmetric_rounding(A))
    others = jnp.where(same, 0, 1 / jnp.where(same, 1, values[None, :] - values[:, None]))
    return found, (same @ jnp.diagonal(rates) / jnp.sum(same, axis=1), vectors @ (others * rates))


def are_repeated(values: Array, bound: Array) -> Array:
    """Mask of pairs of eigenvalues that are equal to rounding."""
    return jnp.abs(values[None, :] - values[:, None]) <= 2 * jnp.minimum(bound[None, :], bound[:, None])


def rounding(A: Float[Array, "d d"], vectors: Complex[Array, "d d"]) -> Float[Array, " d"]:
    """The rounding error of each eigenvalue: the rounding error of A times the sensitivity of the eigenvalue, ‖y‖ ‖x‖/|yᴴx|."""
    A, vectors = jax.lax.stop_gradient((A, vectors))
    scale, size = balanced(A)
    vectors = vectors / scale[:, None]
    vectors = vectors / jnp.linalg.norm(vectors, axis=0, keepdims=True)
    U, s, Vh = jnp.linalg.svd(vectors)
    left = (Vh.conj().T / jnp.maximum(s, jnp.finfo(s.dtype).eps)[None, :]) @ U.conj().T
    sensitivity = jnp.minimum(jnp.linalg.norm(left, axis=1), jnp.finfo(s.dtype).eps ** -0.5)  # as for a double one with one eigenvector
    return 10 * len(A) * jnp.finfo(A.dtype).eps * size * sensitivity


def _symmetric_rounding(A):
    size = jnp.max(jnp.abs(jax.lax.stop_gradient(A)), initial=0.0)
    return jnp.full(len(A), 10 * len(A) * jnp.finfo(A.dtype).eps * size)


def _largest(vectors):
    """The row of the largest entry in each column; the first of several."""
    size = jnp.abs(vectors)
    return jnp.argmax(size >= (1 - 1e-6) * jnp.max(size, axis=0, keepdims=True), axis=0)[None, :]


def balanced(A: Float[Array, "d d"]) -> tuple[Float[Array, " d"], Float[Array, ""]]:
    """A diagonal scaling D, in powers of two, for which rows and columns of D⁻¹AD have about the same size, and the largest entry.

    Sizes include the diagonal: a one-way coupling could be scaled down for ever, but is only scaled until it is no larger than the
    diagonal.
    """
    A = jnp.abs(jax.lax.stop_gradient(A))

    def turn(_, scale):
        scaled = A * scale[None, :] / scale[:, None]
        row, column = jnp.sum(scaled, axis=1), jnp.sum(scaled, axis=0)
        known = (row > 0) & (column > 0)
        ratio = jnp.where(known, row, 1) / jnp.where(known, column, 1)
        return scale * jnp.exp2(jnp.round(jnp.log2(ratio) / 4))

    scale = jax.lax.fori_loop(0, TURNS, turn, jnp.ones(len(A), A.dtype))
    return scale, jnp.max(A * scale[None, :] / scale[:, None])


def _complex(A):
    return np.result_type(A.dtype, np.complex64)
