"""Factors of sparse unsymmetric matrices by blocks, against NumPy's dense solve."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse

from jaxlag._program.block_tridiagonal_lu import factorised, order, solution, transposed
from jaxlag._program.sparse_matrix import Places, SparseMatrix

RNG = np.random.default_rng(3)


def banded(n, width):
    """A band with zeros on half of its diagonal, its rows and columns shuffled alike."""
    A = np.zeros((n, n))
    for i, j in np.ndindex(n, n):
        if abs(i - j) <= width:
            A[i, j] = RNG.normal()
    A[np.arange(0, n, 2), np.arange(0, n, 2)] = 0
    shuffled = RNG.permutation(n)
    return A[np.ix_(shuffled, shuffled)]


def sparse(A, dtype=float):
    places = Places.of(scipy.sparse.csr_matrix(A != 0))
    return SparseMatrix(jnp.asarray(A[places.rows, places.columns], dtype), places)


@pytest.mark.parametrize(("n", "width"), [pytest.param(50, 2, marks=pytest.mark.fast), (64, 7), (41, 12), (4, 1)])
def test_solution_and_that_of_the_transpose(n, width):
    A, b = banded(n, width), RNG.normal(size=n)
    matrix = sparse(A)
    assert order(matrix.places).size <= max(8, 2 * width)  # the shuffled band is found again, or nearly
    factors = factorised(matrix)
    scale = np.linalg.cond(A) * np.finfo(float).eps * 100
    np.testing.assert_allclose(A @ solution(matrix.places, factors, jnp.asarray(b)), b, atol=scale)
    np.testing.assert_allclose(A.T @ solution(matrix.places, transposed(factors), jnp.asarray(b)), b, atol=scale)


def test_a_block_without_inverse_is_seen():
    A = np.diag(np.arange(20.0))
    A[0, 1] = A[1, 0] = 1e-300  # in its places
    A[0, 0] = 0.0
    A[1, 1] = 0.0
    matrix = sparse(A + 1e-300 * np.eye(20))
    assert not np.all(np.isfinite(solution(matrix.places, factorised(matrix), jnp.ones(20))))


def test_single_precision():
    A, b = banded(60, 3) + 4 * np.eye(60), RNG.normal(size=60)
    matrix = sparse(A, np.float32)
    x = solution(matrix.places, factorised(matrix), jnp.asarray(b, np.float32))
    assert x.dtype == np.float32
    np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=0, atol=1e-4 * np.abs(x).max())


def test_programs_do_not_grow():
    places = {n: sparse(scipy.sparse.diags([1.0, 2.0, 1.0], [-1, 0, 1], (n, n)).toarray()) for n in (40, 400)}
    count = lambda n: len(jax.make_jaxpr(lambda v: factorised(SparseMatrix(v, places[n].places)))(places[n].values).jaxpr.eqns)
    assert count(40) == count(400)
