"""Factorisations, solves and products of small matrices written out, beside those of LAPACK."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend import core

from jaxlag._program.whole_kernel import _lowered, in_whole_kernel
from jaxlag._program.without_libraries import LARGEST, is_scattered, without_libraries

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


I = np.array([4, 1, 1, 6, -1, 9])  # beyond the ends, too, and one of them twice
SCATTERED = {
    "entries": lambda x, v: x.at[I[:4], 0].add(v[0, :4]),
    "rows": lambda x, v: x.at[I].add(v.T @ np.ones((5, 6))),
    "columns": lambda x, v: x.at[:, np.array([2, 0])].set(jnp.tile(v[:1, :2], (7, 1))),
    "both": lambda x, v: x.at[np.array([[0], [3]]), np.array([2, 5])].set(v[:2, :2]),
    "dropped": lambda x, v: x.at[I, 1].set(v[0], mode="drop", unique_indices=True),
    "clipped": lambda x, v: x.at[np.array([3, 9, -20]), 1].add(v[1, :3], mode="clip"),
    "a gather's derivative": lambda x, v: jax.grad(lambda x: jnp.sum(x[I[:4]] ** 2))(x),
    "a batch": lambda x, v: jax.vmap(lambda x, i: x.at[i].set(7.0))(x, np.arange(14).reshape(7, 2) % 6),
    "a variation": lambda x, v: jax.jvp(lambda x: x.at[I[:4], 0].set(x[:4, 1] ** 2), (x,), (x,))[1],
}


@pytest.mark.parametrize("name", SCATTERED)
def test_entries_are_put_in_place_one_after_the_other(name):
    """As JAX puts them, in whatever number of dimensions; and within one kernel, in a program of the user's own too."""
    rng = np.random.default_rng(0)
    x, v = rng.normal(size=(7, 6)), rng.normal(size=(5, 6))
    function = SCATTERED[name]
    program = jax.make_jaxpr(function)(x, v)
    assert any(map(is_scattered, _lowered(program)))
    written = without_libraries(program)
    assert not any(map(is_scattered, _lowered(written)))
    run = lambda program: jax.jit(core.jaxpr_as_fun(program))(x, v)[0]
    np.testing.assert_array_equal(run(written), run(program))

    def repeated(given, result):
        again = lambda _, x: 0.5 * function(x.reshape(7, 6) + given[0], v).ravel()
        return jax.lax.fori_loop(0, 3, again, result)

    given = jnp.array([0.1])
    np.testing.assert_allclose(jax.jit(in_whole_kernel(repeated))(given, x.ravel()), repeated(given, x.ravel()), rtol=1e-14)


@pytest.mark.parametrize("emitters", [True, False], ids=["new", "old"])
def test_a_kernel_holds_all_that_it_is_said_to(emitters):
    """Functions of a loop in one kernel, of whichever kind its instructions are made: in a user's own program they are of the new one."""
    functions = [
        lambda x: x[np.array([3, 3, 0, 5, 1, 2])],
        lambda x: jnp.roll(x[::-1], 2),
        lambda x: jnp.pad(x, (1, 2))[1:7],
        lambda x: jnp.stack([x, 2 * x]).max(0) + jnp.argmax(x) + jnp.argmin(x),
        lambda x: jnp.concatenate([x[2:], x[:2]]),
        lambda x: jnp.outer(x, x) @ x + jnp.prod(1 + 1e-3 * x) + jnp.any(x > 0) * jnp.all(x < 9),
        lambda x: x - jnp.sum(x) + jnp.mean(x),
        lambda x: jax.lax.switch((x[0] > 0).astype(int), [jnp.sin, jnp.cos], x),
        lambda x: jax.lax.scan(lambda c, y: (c + y, c), 0.0, x)[1],
        lambda x: x.at[jnp.argmax(x)].set(0.3),
        lambda x: jnp.einsum("ij,j->i", jnp.eye(6), x) + jnp.linalg.solve(3 * jnp.eye(6) + jnp.outer(x, x), x),
        lambda x: jnp.interp(x, np.arange(-3.0, 4), np.arange(7.0) ** 2),
        lambda x: jnp.linalg.norm(x) + jnp.hypot(x, 1.0) + jnp.arctan2(x, 2.0) + jnp.clip(x, -1, 1) + jnp.sign(x) + x**3 + jnp.floor(x),
        lambda x: jax.scipy.special.erf(x) + jnp.logaddexp(x, 0.0) + jnp.cbrt(x) + jnp.sinh(x) + jnp.expm1(x) + jnp.nextafter(x, 1.0),
    ]
    x, given = jnp.linspace(-1, 1.5, 6), jnp.array([0.1])
    for function in functions:
        repeated = lambda given, x, f=function: jax.lax.fori_loop(0, 3, lambda _, x: 0.3 * f(x) + given[0], x)
        run = jax.jit(in_whole_kernel(repeated), compiler_options={"xla_cpu_use_fusion_emitters": emitters})
        np.testing.assert_allclose(run(given, x), repeated(given, x), rtol=1e-12)
