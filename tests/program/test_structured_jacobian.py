"""Jacobians as sums of products of diagonal matrices and matrices of numbers, against JAX's own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._program.structured_jacobian import structured_jacobian

rng = np.random.default_rng(0)
A, W = rng.normal(size=(5, 6)), rng.normal(size=(6, 6))
X, C = jnp.asarray(rng.uniform(0.5, 1.5, 6)), jnp.asarray(rng.uniform(0.5, 1.5, 6))

PROGRAMS = {
    "elementwise": lambda x, c: jnp.sin(x) * x**2 / (1 + x),
    "cumulative sums": lambda x, c: jnp.cumsum(jnp.cumsum(x * c)[::-1] * jnp.cos(c)),
    "a known matrix": lambda x, c: (A @ (x * c)) * (A @ c),
    "a matrix that varies": lambda x, c: jnp.outer(c, c) @ (jnp.sin(x) * c),
    "a matrix from the right": lambda x, c: 0.5 * (x @ jnp.outer(c, jnp.cos(c))) + x,
    "columns of a matrix that varies": lambda x, c: jnp.ravel(jnp.diag(c) @ x.reshape(6, 1)) * c,
    "rows times a matrix that varies": lambda x, c: jnp.ravel(x.reshape(2, 3) @ jnp.diag(c[:3])),
    "a call": lambda x, c: jax.checkpoint(lambda x: jnp.cumsum(c * x))(x),
    "parts put together": lambda x, c: jnp.concatenate([x[1:4] * c[:3], jnp.zeros(2), x[:2] - x[4:]]),
    "sums of several": lambda x, c: jnp.cumsum(x) * c + jnp.cumsum(x * c) - 2 * x + jnp.sum(x),
    "two axes": lambda x, c: jnp.ravel(jnp.cumsum(x.reshape(2, 3) * c.reshape(2, 3), axis=1).T),
    "parts of two": lambda x, c: jnp.where(np.arange(6) > 2, x**2, jnp.cumsum(x)),
    "a constant": lambda x, c: jnp.ones(3),
    "a part of x": lambda x, c: x[2:3],
    "a quotient by x": lambda x, c: c / x,
}


NOT_COVERED = {
    "a network": lambda x: jnp.tanh(W @ jnp.tanh(W @ x)),
    "a loop": lambda x: jax.lax.fori_loop(0, 3, lambda i, x: jnp.sin(x) + x[::-1], x),
    "a choice": lambda x: jax.lax.cond(x[0] > 0, jnp.sin, jnp.cos, x * C),
    "a choice for each entry": lambda x: jnp.where(x > 1, x**2, jnp.cumsum(x)),
    "a linear solve": lambda x: jnp.linalg.solve(jnp.eye(6) * 3 + jnp.outer(x, C), x),
    "a draw": lambda x: x * jax.random.normal(jax.random.key(0), 6),
    "scalar code": lambda x: jnp.stack([sum(jnp.sin(x[i] * x[j]) for i in range(6)) for j in range(6)]),
}


@pytest.mark.parametrize("name", PROGRAMS)
def test_the_jacobian_is_that_of_jax(name):
    """With c a vector of numbers, and one that varies."""
    function = PROGRAMS[name]
    found, expected = lambda x, c: structured_jacobian(lambda x: function(x, c), x), jax.jacfwd(function)
    np.testing.assert_allclose(found(X, C), expected(X, C), rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(jax.jit(found)(X, C), expected(X, C), rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(jax.vmap(found)(X[None], C[None])[0], expected(X, C), rtol=1e-13, atol=1e-13)
    for derivative in (jax.jacfwd, jax.jacrev):
        for a, b in zip(*(derivative(of, argnums=(0, 1))(X, C) for of in (found, expected)), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", NOT_COVERED)
def test_other_programs_are_left_to_jax(name):
    found = []
    jax.make_jaxpr(lambda x: found.append(structured_jacobian(NOT_COVERED[name], x)))(X)
    assert found == [None]


def chain(q, qdot, l, m):
    vx, vy = jnp.cumsum(l * jnp.cos(q) * qdot), jnp.cumsum(l * jnp.sin(q) * qdot)
    return 0.5 * jnp.sum(m * (vx**2 + vy**2))


@pytest.mark.parametrize("n", [9, 16])
def test_a_chain_takes_no_sums_over_columns(n):
    """M_ij = l_i l_j cos(φ_i − φ_j) Σ_{k ≥ max(i, j)} m_k; with known masses, a few operations on n × n numbers."""
    q, l, m = rng.uniform(-1, 1, n), rng.uniform(0.5, 1.5, n), rng.uniform(0.5, 1.5, n)
    hung = np.cumsum(m[::-1])[::-1]
    expected = np.outer(l, l) * np.cos(np.subtract.outer(q, q)) * hung[np.maximum.outer(np.arange(n), np.arange(n))]
    for masses in ({}, {"m": m}):
        lagrangian = chain if masses else lambda q, qdot, l: chain(q, qdot, l, m)
        system = jl.System(lagrangian)
        M = lambda q, params, system=system: jl.mass_matrix(system, q, 0 * q, params)
        np.testing.assert_allclose(M(q, {"l": l} | masses), expected, rtol=1e-13, atol=1e-14)
    text = jax.jit(lambda q: jl.mass_matrix(jl.System(lambda q, qdot: chain(q, qdot, l, m)), q, 0 * q)).lower(q).compile().as_text()
    assert f"f64[{n},{n}]" in text and "reduce-window" not in text and " dot(" not in text


@pytest.mark.fast
def test_single_precision_stays_single(single_precision):
    q, m = np.linspace(-1, 1, 9, dtype=np.float32), np.ones(9, np.float32)
    found = jl.mass_matrix(jl.System(lambda q, qdot, l: chain(q, qdot, l, m)), q, 0 * q, {"l": 0.5})
    expected = 0.25 * np.cos(np.subtract.outer(q, q)) * (9 - np.maximum.outer(np.arange(9), np.arange(9)))
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, expected, rtol=1e-5)
