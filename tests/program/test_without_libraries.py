"""Factorisations, solves and products of small matrices written out, beside those of LAPACK."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend import core

from jaxlag._program.whole_kernel import _lowered
from jaxlag._program.without_libraries import LARGEST, without_libraries

LIBRARIES = {"cholesky", "triangular_solve", "lu", "svd"}


def agree(function, *given):
    program = jax.make_jaxpr(function)(*given)
    written = without_libraries(program)
    assert LIBRARIES.isdisjoint(e.primitive.name for e in _lowered(written))
    run = lambda program: jax.jit(core.jaxpr_as_fun(program))(*given)
    for found, expected in zip(run(written), run(program), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("batch", [(), (2, 3)], ids=["alone", "batch"])
@pytest.mark.parametrize("n", [1, 2, 3, 4, 7, LARGEST])
def test_they_agree_with_lapack(n, batch):
    rng = np.random.default_rng(n)
    A, B = rng.normal(size=(*batch, n, n)), rng.normal(size=(*batch, n, 3))
    S = A @ A.swapaxes(-1, -2) + 0.1 * np.eye(n)
    agree(jnp.linalg.cholesky, S)
    agree(lambda S, B: jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(S), True), B), S, B)
    agree(jnp.linalg.solve, A, B)
    agree(jax.scipy.linalg.lu_factor, A)
    dominant = A + 3 * np.eye(n)
    for left, lower, transposed, unit in itertools.product([True, False], repeat=4):
        kind = {"left_side": left, "lower": lower, "transpose_a": transposed, "unit_diagonal": unit}
        agree(lambda A, B, kind=kind: jax.lax.linalg.triangular_solve(A, B, **kind), dominant, B if left else B.swapaxes(-1, -2))


@pytest.mark.parametrize("batch", [(), (3,)], ids=["alone", "batch"])
@pytest.mark.parametrize("shape", [(2, 2), (3, 7), (5, 5), (6, 40)])
def test_singular_values_and_pseudo_inverse(shape, batch):
    """Also of rows that repeat each other, and of rows of unlike sizes, whose smallest values come out as accurate as the largest."""
    rng = np.random.default_rng(shape[0])
    A = rng.normal(size=(*batch, *shape))
    repeated = A.copy()
    repeated[..., -1, :] = 2 * repeated[..., 0, :]
    for matrix in (A, repeated, np.zeros_like(A)):
        agree(lambda A: jnp.linalg.pinv(A, rtol=1e-10), matrix)
        agree(lambda A: jnp.linalg.svd(A, full_matrices=False)[1], matrix)
    unlike = np.diag(10.0 ** -np.arange(0, 3 * shape[0], 3)) @ np.linalg.qr(rng.normal(size=shape[::-1]))[0].T
    program = without_libraries(jax.make_jaxpr(lambda A: jnp.linalg.svd(A, full_matrices=False))(unlike))
    U, values, Vt = core.jaxpr_as_fun(program)(unlike)
    np.testing.assert_allclose(values, 10.0 ** -np.arange(0, 3 * shape[0], 3), rtol=1e-12)
    np.testing.assert_allclose(U.T @ U, np.eye(shape[0]), atol=1e-14)
    np.testing.assert_allclose(U @ np.diag(values) @ Vt, unlike, atol=1e-15)


def test_products_of_several_axes():
    rng = np.random.default_rng(0)
    agree(lambda A, B: jnp.einsum("bijk,bkl->blij", A, B), rng.normal(size=(2, 3, 4, 5)), rng.normal(size=(2, 5, 6)))
    agree(lambda A, B: A @ B, rng.normal(size=(16, 17)), rng.normal(size=(17, 18)))
    agree(lambda A, B: jnp.tensordot(A, B, 2), rng.normal(size=(3, 4, 5)), rng.normal(size=(4, 5, 2)))


def test_long_sums():
    x = np.random.default_rng(0).normal(size=(16, 17, 18))
    for axes in (0, 1, (0, 2), None):
        agree(lambda x, axes=axes: jnp.sum(x, axis=axes), x)


def test_what_is_not_positive_definite_has_no_factor():
    program = without_libraries(jax.make_jaxpr(jnp.linalg.cholesky)(np.eye(3)))
    for S in (np.diag([1.0, -1.0, 2.0]), np.ones((3, 3)) - 2 * np.eye(3), np.zeros((3, 3))):
        (L,) = core.jaxpr_as_fun(program)(S)
        assert np.all(np.isnan(np.diagonal(L)))


def test_large_matrices_stay_with_a_library():
    program = jax.make_jaxpr(jnp.linalg.cholesky)(np.eye(LARGEST + 1))
    assert "cholesky" in {e.primitive.name for e in _lowered(without_libraries(program))}
