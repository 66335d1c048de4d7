"""Modes near a shift, with sparse matrices: Arnoldi's method, and the inertia of the matrices as proof that none is left out.

Source: Lehoucq, Sorensen & Yang, ARPACK Users' Guide, SIAM 1998, section 3.2; Tisseur & Meerbergen, SIAM Review 43 (2001) 235.
"""

import contextlib
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Complex, Float

from .._program.jit import compiled
from .._program.sparse_matrix import SparseMatrix
from .pencil import CURE, Pencil
from .sparse_descent import eigenvalues_below

NOTHING = 1e-10  # of the square of a row: largest remainder of a row that follows from others
EQUAL = 0.625  # exponent of eps: values with a smaller relative difference are equal
BESIDE = 4  # modes sought in addition to those asked for
ATTEMPTS = 12  # to find the lowest modes, if some lie far below the first ones found


class Matrices(NamedTuple):
    """A `Pencil` of n coordinates, also as SciPy matrices. Constraints that follow from others are left out: their multipliers are zero and
    stand alone. These constraints, −G x = 0, are kept apart.
    """

    pencil: Pencil
    K: scipy.sparse.csc_matrix
    C: scipy.sparse.csc_matrix
    M: scipy.sparse.csc_matrix
    n: int
    left_out: np.ndarray
    rows_left_out: scipy.sparse.csc_matrix

    @classmethod
    def of(cls, given: Pencil, n: int) -> "Matrices":
        K = _scipy(given.stiffness)
        left_out = n + following_rows(K[n:, :n])
        if left_out.size:
            given = _without(given, left_out)
        return cls(given, _scipy(given.stiffness), _scipy(given.damping), _scipy(given.mass), n, left_out, K[left_out, :n].tocsc())

    @property
    def freedoms(self) -> int:
        """Degrees of freedom."""
        return 2 * self.n - self.K.shape[0] + len(self.left_out)

    @property
    def equal(self) -> float:
        """The relative difference up to which two values are equal."""
        return float(np.finfo(self.pencil.left.dtype).eps ** EQUAL)

    @property
    def rounding(self) -> float:
        """The rounding error of squared natural frequencies, from the largest of them."""
        units = scipy.sparse.diags(self.units)
        return 10 * float(np.finfo(self.pencil.left.dtype).eps) * float(abs(units @ self.K[: self.n, : self.n] @ units).sum(axis=1).max())

    @property
    def units(self) -> np.ndarray:
        """Units of the coordinates in which the mass of each is 1; 0 for coordinates without mass."""
        masses = self.M.diagonal()[: self.n]
        return np.where(masses > 0, 1 / np.sqrt(np.where(masses > 0, masses, 1)), 0)

    def at(self, value: complex) -> scipy.sparse.csc_matrix:
        """[P(λ) −Gᵀ; −G 0]."""
        return (self.K + value * self.C + value**2 * self.M).tocsc()

    def nearest(self, f: Float[np.ndarray, "n k"], c: Float[np.ndarray, "m k"]) -> Float[np.ndarray, "w k"]:
        """(x, λ) with x = f + Gᵀλ and −G x = c."""
        from scipy.sparse.linalg import splu  # imported here because that takes a while

        one = scipy.sparse.diags(np.r_[np.ones(self.n), np.zeros(len(c))])
        size = np.sqrt(np.asarray(self.K[self.n :].multiply(self.K[self.n :]).sum(axis=1)).ravel())
        of_q = scipy.sparse.diags(np.r_[np.zeros(self.n), 1 / np.where(size > 0, size, 1)])  # rows of length 1, in any unit
        unit = np.where(np.arange(self.n + len(c)) < self.n, 1, of_q.diagonal())[:, None]
        with searching():
            return unit * splu((one + of_q @ self.K + self.K @ of_q).tocsc()).solve(unit * np.concatenate([f, c]))

    def shared(self, multipliers: Float[np.ndarray, "m *k"]) -> Float[np.ndarray, "m *k"]:  # noqa: F821
        """The multipliers of least norm with the same Gᵀλ, in the range of G: constraints that follow from others share their load."""
        if not self.left_out.size:
            return multipliers
        rows, out = self.rows_left_out.toarray(), self.left_out - self.n
        size = np.linalg.norm(rows, axis=1, keepdims=True)
        T = self.nearest(rows.T / np.where(size > 0, size, 1).T, np.zeros((len(multipliers), len(rows))))[self.n :].T  # in the other rows
        others = np.setdiff1d(np.flatnonzero(np.any(np.abs(T) > NOTHING * np.max(np.abs(T), axis=1, keepdims=True), axis=0)), out)
        which = np.r_[others, out]
        T = np.r_[np.eye(others.size), size * T[:, others]]
        Q, _ = np.linalg.qr(T / np.linalg.norm(T, axis=0))
        found = multipliers.copy()
        found[which] = Q @ (Q.T @ multipliers[which])
        return found


def _scipy(A: SparseMatrix) -> scipy.sparse.csc_matrix:
    return scipy.sparse.csc_matrix((np.asarray(A.values, float), (A.pattern.rows, A.pattern.columns)), A.shape)


def following_rows(G: scipy.sparse.csc_matrix) -> np.ndarray:
    """Indices of rows that follow from others: with rows of length 1, a pivot of G Gᵀ is the squared remainder of a row after its
    predecessors.
    """
    from scipy.sparse.linalg import splu  # imported here because that takes a while

    if not G.shape[0]:
        return np.zeros(0, int)
    size = np.sqrt(np.asarray(G.multiply(G).sum(axis=1)).ravel())
    unit = scipy.sparse.diags(1 / np.where(size > 0, size, 1)) @ G
    squares = unit @ unit.T + NOTHING**1.5 * scipy.sparse.identity(len(size))  # no pivot is zero
    factors = splu(squares.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return np.flatnonzero(np.abs(factors.U.diagonal())[factors.perm_c] <= NOTHING)


def _without(given: Pencil, left_out: np.ndarray) -> Pencil:
    """The pencil without some of the constraints: −d μ = 0 replaces each, with d as large as its row."""
    pattern, values = given.stiffness.pattern, np.asarray(given.stiffness.values)
    is_out = np.isin(np.arange(pattern.shape[0]), left_out)
    taken = is_out[pattern.rows] | is_out[pattern.columns]
    size = np.zeros(pattern.shape[0], values.dtype)
    np.maximum.at(size, pattern.rows, np.abs(values))
    on_diagonal = pattern.rows == pattern.columns
    values = np.where(taken, np.where(on_diagonal, -np.where(size > 0, size, 1)[pattern.rows], 0), values)
    return given._replace(stiffness=SparseMatrix(jnp.asarray(values), pattern))


class Found(NamedTuple):
    """Eigenvalues λ; (x, μ) of each, and y of the transposed pencil, scaled so that dλ = −yᵀ dP x (without damping, dλ² = −yᵀ dP x); which
    eigenvalues are equal; whether damping is absent.
    """

    values: Complex[np.ndarray, " k"]
    vectors: Complex[np.ndarray, "w k"]
    left: Complex[np.ndarray, "w k"]
    same: np.ndarray
    conservative: bool


def modes_near(matrices: Matrices, count: int, shift: float) -> Found:
    if 2 * count >= matrices.freedoms:
        raise ValueError(f"`count` must be less than half the degrees of freedom, {matrices.freedoms}, but is {count}. {CURE}")
    symmetric = bool(abs(matrices.K - matrices.K.T).max() <= matrices.equal * abs(matrices.K).max())
    if symmetric and not matrices.C.count_nonzero():
        return _undamped(matrices, count, shift)
    return _damped(matrices, count, shift, symmetric and not (matrices.C - matrices.C.T).count_nonzero())


@contextlib.contextmanager
def searching() -> Iterator[None]:
    """Raises `ValueError` if SciPy cannot factorise a matrix or find modes."""
    try:
        yield
    except RuntimeError as error:
        raise ValueError(
            f"`shift` must make K + shift C + shift² M regular on the constraints, but modes were not found: {error}. "
            "Give another one, such as a tenth of the lowest frequency, and state each constraint once."
        ) from None


def _undamped(matrices: Matrices, count: int, shift: float) -> Found:
    """Modes of K x = ω² M x + Gᵀμ: as many as asked for, including any that lie lower still."""
    from scipy.sparse.linalg import eigsh  # imported here because that takes a while

    sigma, k, most = -(shift**2), count + BESIDE, matrices.freedoms - 1
    for attempt in range(ATTEMPTS):
        start = np.random.default_rng(attempt).normal(size=matrices.K.shape[0])
        with searching():
            squares, vectors = eigsh(
                matrices.K, min(k, most), matrices.M, sigma=sigma, v0=start, ncv=_basis(min(k, most), matrices.freedoms)
            )
        order = np.argsort(squares, kind="stable")
        squares, vectors = squares[order], vectors[:, order]
        if not _left_out(matrices, squares, count):
            break
        sigma, k = min(sigma, 4 * squares[0]), k + 2  # modes left out lie far below, or were missed
    else:
        raise ValueError(f"`shift` must be such that the lowest modes are found, but from {shift} lower ones are left out. Give another.")
    squares, vectors = squares[:count], vectors[:, :count]
    _refuse_unsolved(matrices.K @ vectors - matrices.M @ vectors * squares, abs(matrices.K) @ np.abs(vectors), vectors, matrices)
    squares = np.where(np.abs(squares) <= matrices.equal * shift**2, 0, squares)
    with searching():
        if np.any((squares != 0) & (np.abs(squares) <= matrices.rounding)):
            raise RuntimeError("some are zero within rounding, and whether they are stable is not known")
    size = np.einsum("ik,ik->k", vectors, matrices.M @ vectors)
    same = np.abs(squares[:, None] - squares[None, :]) <= matrices.equal * np.abs(squares)[:, None]
    omega = np.sqrt(np.abs(squares))
    values = np.where(squares < 0, omega, 1j * omega)
    return Found(values, vectors + 0j, (vectors / size) + 0j, same, True)


def _basis(k: int, most: int) -> int:
    """The number of vectors that Arnoldi's method keeps, at most the number that exist if constraints leave few degrees of freedom."""
    return min(max(2 * k + 1, 20), most)


def _left_out(matrices: Matrices, squares: np.ndarray, count: int) -> bool:
    """Whether modes below the widest gap after the first `count` are missing from these, by Sylvester's law of inertia."""
    gaps = np.diff(squares[count - 1 :])
    i = count - 1 + int(np.argmax(gaps))
    middle = (squares[i] + squares[i + 1]) / 2
    given = matrices.pencil
    shifted = given.stiffness.values - middle * given.mass.values
    masses = np.asarray(matrices.M.diagonal()[: matrices.n])
    scale = jnp.asarray(np.where(masses > 0, masses, 1), shifted.dtype)
    below, within = compiled(eigenvalues_below)(SparseMatrix(-shifted, given.stiffness.pattern), scale, jnp.zeros((), shifted.dtype))
    is_certain = bool(within <= np.max(gaps) / 2)
    if not is_certain:
        warnings.warn("whether a lower mode was left out is not certain: factors of the matrix are too inexact", UserWarning, stacklevel=5)
    return is_certain and int(below) > i + 1


def _refuse_unsolved(left: np.ndarray, terms: np.ndarray, vectors: np.ndarray, matrices: Matrices) -> None:
    """Raises if the residual `left` of the equations of a mode exceeds the rounding error of their terms, as with rows that nearly follow
    from others.
    """
    rows, x = matrices.rows_left_out, vectors[: matrices.n]
    left, terms = np.concatenate([left, rows @ x]), np.concatenate([terms, abs(rows) @ np.abs(x)])
    with searching():
        if not np.all(np.max(np.abs(left), axis=0) <= matrices.equal * np.max(terms, axis=0)):
            raise RuntimeError("they do not solve their equations")


def _damped(matrices: Matrices, count: int, shift: float, symmetric: bool) -> Found:
    """Modes of the linear pencil of (x, λx, μ), twice as large: A z = λ B z; from two starts, which must agree."""
    from scipy.sparse.linalg import eigs, splu

    (_, K, C, M, n, *_), block = matrices, scipy.sparse.block_array
    one, rows = scipy.sparse.identity(n), K.shape[0] - n
    blocks: Any = [[None, one, None], [-K[:n, :n], -C[:n, :n], -K[:n, n:]], [-K[n:, :n], None, -K[n:, n:]]]
    A: Any = block(blocks).tocsc()
    B = scipy.sparse.block_diag([one, M[:n, :n], scipy.sparse.csc_matrix((rows, rows))]).tocsc()
    of_modes, k = np.r_[:n, 2 * n : 2 * n + rows], min(2 * count + BESIDE, 2 * matrices.freedoms - 2)
    found = []
    for seed in range(2):
        start = np.random.default_rng(seed).normal(size=A.shape[0])
        with searching():
            values, z = eigs(A, k, B, sigma=shift, v0=start, ncv=_basis(k, 2 * matrices.freedoms))
        upper = np.flatnonzero(values.imag >= -matrices.equal * np.abs(values))
        order = upper[np.argsort(np.abs(values[upper] - shift), kind="stable")][:count]
        found.append((values[order], z[np.ix_(of_modes, order)]))
    (values, vectors), (others, _) = found
    if len(values) < count or len(others) < count or np.any(np.abs(np.abs(values) - np.abs(others)) > 1e-6 * np.abs(values)):
        raise ValueError(f"`count` must be a number of modes that lie apart from others, but two searches differ. Try {count + 2}.")
    dust = np.abs(values.real) <= matrices.equal * np.abs(values)
    values = np.where(dust, 1j * values.imag, values)
    terms = abs(K) @ np.abs(vectors) + np.abs(values) * (abs(C) @ np.abs(vectors)) + np.abs(values) ** 2 * (abs(M) @ np.abs(vectors))
    _refuse_unsolved(K @ vectors + values * (C @ vectors) + values**2 * (M @ vectors), terms, vectors, matrices)
    with searching():
        left = vectors if symmetric else np.stack([_left_vector(matrices, value, splu) for value in values], axis=1)
    size = np.einsum("ik,ik->k", left, C @ vectors + 2 * values * (M @ vectors))
    same = np.abs(values[:, None] - values[None, :]) <= matrices.equal * np.abs(values)[:, None]
    return Found(values, vectors, left / size, same, False)


def _left_vector(matrices: Matrices, value: complex, splu: Callable) -> Complex[np.ndarray, " w"]:
    """y with yᵀ [P(λ) −Gᵀ; −G 0] = 0, by inverse iteration."""
    near = splu(matrices.at(value * (1 + 1e-9)))
    y = np.random.default_rng(0).normal(size=matrices.K.shape[0]) + 0j
    for _ in range(3):
        y = near.solve(y, trans="T")
        y /= np.max(np.abs(y))
    return y
