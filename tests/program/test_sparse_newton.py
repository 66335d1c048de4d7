"""Sparse saddle points [A −Gᵀ; H 0] by a few directions, against NumPy's least squares: units, zeros in place of A, rows twice."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse

from jaxlag._program.sparse_newton import linear_solution, square_pattern

SIZE = 60


def saddle(kind, rng):
    """The matrix of a chain: each unknown beside its neighbours, each row between two of them."""
    beside = lambda rows: np.eye(rows, SIZE) * rng.uniform(1, 2, (rows, 1)) + np.eye(rows, SIZE, k=1) * rng.uniform(-0.5, 0.5, (rows, 1))
    rows = {"nothing in place of A": SIZE, "rows twice": 40}.get(kind, 30)
    G = beside(rows)
    A = np.zeros((SIZE, SIZE)) if kind == "nothing in place of A" else beside(SIZE) + beside(SIZE).T + 2 * np.eye(SIZE)
    if kind == "units":
        scale = 10.0 ** rng.uniform(-4, 4, SIZE)
        A, G = A * scale * scale[:, None], G * scale * 10.0 ** rng.uniform(-4, 4, (rows, 1))
    H = G if kind == "rows twice" else G * rng.uniform(0.9, 1.1, G.shape)
    if kind == "rows twice":
        G = H = np.concatenate([G[:20], 3 * G[:20]])
    return np.block([[A, -G.T], [H, np.zeros((len(G), len(G)))]])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["plain", "units", "nothing in place of A", "rows twice"])
def test_solution_and_its_transpose(kind):
    rng = np.random.default_rng(4)
    K = saddle(kind, rng)
    pattern = square_pattern(scipy.sparse.csr_matrix(K != 0), last=SIZE, sparse=1)
    push = lambda x: jnp.asarray(K) @ x
    solve = lambda b: linear_solution(push, pattern, b)
    b, c = K @ rng.normal(size=len(K)), K.T @ rng.normal(size=len(K))
    found, pull = jax.vjp(solve, jnp.asarray(b))
    for x, matrix, right in ((found, K, b), (pull(jnp.asarray(c))[0], K.T, c)):
        size = np.abs(matrix) @ np.abs(x) + np.abs(right)
        np.testing.assert_allclose((matrix @ x - right) / size, 0, atol=1e-11)
        if kind != "units":
            np.testing.assert_allclose(x[:SIZE], np.linalg.lstsq(matrix, right)[0][:SIZE], atol=1e-7)
    several = linear_solution(lambda X: jnp.asarray(K) @ X, pattern, jnp.stack([b, 2 * b], axis=1))
    np.testing.assert_allclose(several, np.stack([found, 2 * found], axis=1), rtol=1e-6, atol=1e-7 * np.abs(found).max())
