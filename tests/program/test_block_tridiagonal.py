"""Factors of sparse unsymmetric matrices by blocks, against NumPy's dense solve."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse

from jaxlag._program.block_tridiagonal import blocks, factorised, solution, transposed
from jaxlag._program.sparse_matrix import SparseMatrix, SparsityPattern, elimination_order

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
    pattern = SparsityPattern.of(scipy.sparse.csr_matrix(A != 0))
    return SparseMatrix(jnp.asarray(A[pattern.rows, pattern.columns], dtype), pattern)


@pytest.mark.parametrize(("n", "width"), [pytest.param(50, 2, marks=pytest.mark.fast), (64, 7), (41, 12), (4, 1)])
def test_solution_and_that_of_the_transpose(n, width):
    A, b = banded(n, width), RNG.normal(size=n)
    matrix = sparse(A)
    assert blocks(matrix.pattern).size <= max(8, 2 * width)  # the shuffled band is found again, or nearly
    factors = factorised(matrix)
    scale = np.linalg.cond(A) * np.finfo(float).eps * 100
    np.testing.assert_allclose(A @ solution(matrix.pattern, factors, jnp.asarray(b)), b, atol=scale)
    np.testing.assert_allclose(A.T @ solution(matrix.pattern, transposed(factors), jnp.asarray(b)), b, atol=scale)


def test_rows_that_come_last_stand_behind_all_that_they_are_coupled_with():
    """As multipliers behind the masses of their rods; behind all masses, they would make the band as wide as there are masses."""
    n, m = 60, 59
    G = scipy.sparse.diags([1.0, -1.0], [0, 1], (m, n))
    K = scipy.sparse.bmat([[scipy.sparse.identity(n), G.T], [G, scipy.sparse.identity(m)]])
    order = elimination_order(K, n)
    rank = np.argsort(order)
    np.testing.assert_array_equal(np.sort(order), np.arange(n + m))
    assert all(rank[n + k] > max(rank[k], rank[k + 1]) for k in range(m))
    assert max(abs(rank[i] - rank[j]) for i, j in zip(*K.nonzero(), strict=True)) < 8


def test_a_block_without_inverse_is_seen():
    A = np.diag(np.arange(20.0))
    A[0, 1] = A[1, 0] = 1e-300  # in its pattern
    A[0, 0] = 0.0
    A[1, 1] = 0.0
    matrix = sparse(A + 1e-300 * np.eye(20))
    assert not np.all(np.isfinite(solution(matrix.pattern, factorised(matrix), jnp.ones(20))))


def test_single_precision():
    A, b = banded(60, 3) + 4 * np.eye(60), RNG.normal(size=60)
    matrix = sparse(A, np.float32)
    x = solution(matrix.pattern, factorised(matrix), jnp.asarray(b, np.float32))
    assert x.dtype == np.float32
    np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=0, atol=1e-4 * np.abs(x).max())


def test_programs_do_not_grow():
    pattern = {n: sparse(scipy.sparse.diags([1.0, 2.0, 1.0], [-1, 0, 1], (n, n)).toarray()) for n in (40, 400)}
    count = lambda n: len(jax.make_jaxpr(lambda v: factorised(SparseMatrix(v, pattern[n].pattern)))(pattern[n].values).jaxpr.eqns)
    assert count(40) == count(400)
