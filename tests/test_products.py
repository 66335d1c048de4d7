"""Jacobians read as products of diagonal matrices and matrices of numbers, against JAX's own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._products import matrix

rng = np.random.default_rng(0)
A, W = rng.normal(size=(5, 6)), rng.normal(size=(6, 6))
X, C = jnp.asarray(rng.uniform(0.5, 1.5, 6)), jnp.asarray(rng.uniform(0.5, 1.5, 6))

PROGRAMS = {
    "elementwise": lambda x: jnp.sin(x) * x**2 / (1 + x),
    "cumulative sums": lambda x: jnp.cumsum(jnp.cumsum(x * C)[::-1] * jnp.cos(C)),
    "a known matrix": lambda x: (A @ (x * C)) * (A @ C),
    "a matrix of numbers that vary": lambda x: jnp.outer(C, C) @ jnp.sin(x),
    "parts put together": lambda x: jnp.concatenate([x[1:4] * C[:3], jnp.zeros(2), x[:2] - x[4:]]),
    "sums of several": lambda x: jnp.cumsum(x) * C + jnp.cumsum(x * C) - 2 * x + jnp.sum(x),
    "two axes": lambda x: jnp.ravel(jnp.cumsum(x.reshape(2, 3) * C.reshape(2, 3), axis=1).T),
    "parts of two": lambda x: jnp.where(np.arange(6) > 2, x**2, jnp.cumsum(x)),
    "a constant": lambda x: jnp.ones(3),
    "a part of x": lambda x: x[2:3],
    "a quotient by x": lambda x: C / x,
}


UNREAD = {
    "a network": lambda x: jnp.tanh(W @ jnp.tanh(W @ x)),
    "a loop": lambda x: jax.lax.fori_loop(0, 3, lambda i, x: jnp.sin(x) + x[::-1], x),
    "a choice": lambda x: jax.lax.cond(x[0] > 0, jnp.sin, jnp.cos, x * C),
    "a choice for each entry": lambda x: jnp.where(x > 1, x**2, jnp.cumsum(x)),
    "a linear solve": lambda x: jnp.linalg.solve(jnp.eye(6) * 3 + jnp.outer(x, C), x),
    "a draw": lambda x: x * jax.random.normal(jax.random.key(0), 6),
    "scalar code": lambda x: jnp.stack([sum(jnp.sin(x[i] * x[j]) for i in range(6)) for j in range(6)]),
}


@pytest.mark.parametrize("name", PROGRAMS)
def test_the_matrix_is_jaxs(name):
    function = PROGRAMS[name]
    expected = jax.jacfwd(function)(X)
    np.testing.assert_allclose(matrix(function, X), expected, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(jax.jit(lambda x: matrix(function, x))(X), expected, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(jax.vmap(lambda x: matrix(function, x))(X[None])[0], expected, rtol=1e-13, atol=1e-13)
    both = [jax.jacfwd(of)(X) for of in (lambda x: matrix(function, x), jax.jacfwd(function))]
    np.testing.assert_allclose(*both, rtol=1e-12, atol=1e-12)
    both = [jax.jacrev(of)(X) for of in (lambda x: matrix(function, x), jax.jacfwd(function))]
    np.testing.assert_allclose(*both, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", UNREAD)
def test_what_is_no_product_is_left_to_jax(name):
    found = []
    jax.make_jaxpr(lambda x: found.append(matrix(UNREAD[name], x)))(X)
    assert found == [None]


def chain(q, qdot, l, m):
    vx, vy = jnp.cumsum(l * jnp.cos(q) * qdot), jnp.cumsum(l * jnp.sin(q) * qdot)
    return 0.5 * jnp.sum(m * (vx**2 + vy**2))


@pytest.mark.parametrize("n", [9, 16])
def test_a_chain_takes_no_sums_over_columns(n):
    """M_ij = l_i l_j cos(φ_i − φ_j) Σ_{k ≥ max(i, j)} m_k; with known masses a few operations on n × n numbers."""
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


def test_single_precision_stays_single(single_precision):
    q, m = np.linspace(-1, 1, 9, dtype=np.float32), np.ones(9, np.float32)
    found = jl.mass_matrix(jl.System(lambda q, qdot, l: chain(q, qdot, l, m)), q, 0 * q, {"l": 0.5})
    expected = 0.25 * np.cos(np.subtract.outer(q, q)) * (9 - np.maximum.outer(np.arange(9), np.arange(9)))
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, expected, rtol=1e-5)
