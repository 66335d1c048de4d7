"""Constrained solves of sparse rows beside a diagonal mass matrix: against dense ones in NumPy, their derivatives against differences."""

import functools

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest

from jaxlag._mechanics.saddle_point import saddle_point, saddle_solver
from jaxlag._program.sparse_jacobian import jacobian
from jaxlag._program.sparse_matrix import SparseMatrix, colors

LINKS = 40


def chain(x):
    return jnp.sum(jnp.diff(x.reshape(-1, 2), axis=0) ** 2, axis=1)


def tree(x):
    """Each point hangs on one of those before it: the same for every size."""
    x = x.reshape(-1, 3)
    above = np.random.default_rng(2).integers(0, np.arange(1, len(x)))
    return jnp.sum((x[1:] - x[above]) ** 2, axis=1)


def strip(x):
    """Two rows of points, with a brace in each cell."""
    x = x.reshape(-1, 2, 2)
    along = jnp.sum(jnp.diff(x, axis=0) ** 2, axis=2).ravel()
    return jnp.concatenate([along, jnp.sum((x[:, 0] - x[:, 1]) ** 2, axis=1), jnp.sum((x[1:, 0] - x[:-1, 1]) ** 2, axis=1)])


def repeated(x):
    """Rods of a chain, and every fifth of them once more in other units: rows that depend on each other."""
    g = chain(x)
    return jnp.concatenate([g, 7.0 * g[::5]])


SYSTEMS = {"chain": (chain, 2 * LINKS), "tree": (tree, 3 * LINKS), "strip": (strip, 4 * LINKS), "repeated": (repeated, 2 * LINKS)}


def problem(name, seed=0):
    function, n = SYSTEMS[name]
    rng = np.random.default_rng(seed)
    x, masses, f = rng.normal(size=n), rng.uniform(0.2, 3.0, n), rng.normal(size=n)
    if name == "strip":  # near a regular one: a truss at random multiplies forces from cell to cell
        x = (np.stack(np.meshgrid(np.arange(n // 4), np.arange(2), indexing="ij"), axis=2) + 0.05 * x.reshape(-1, 2, 2)).ravel()
    return function, *map(jnp.asarray, (x, masses, f, rng.normal(size=n)))


def by_hand(G, masses, f, c):
    """Least squares in NumPy: x, and the λ of least norm."""
    rows = G / np.sqrt(masses)
    multipliers = np.linalg.lstsq(rows.T, np.linalg.lstsq(rows, c - G @ (f / masses), rcond=1e-12)[0], rcond=1e-12)[0]
    return (f + G.T @ multipliers) / masses, multipliers


@functools.partial(jax.jit, static_argnums=0)
def solved(rows, x, masses, f, a):
    _, G = jacobian(rows, x)
    assert isinstance(G, SparseMatrix)
    return saddle_point(lx.DiagonalLinearOperator(masses), G, f, G @ a)


@jax.jit
def solved_in_units(x, units, masses, f, a):
    """Rods of a chain in units of their own, and ten of them twice."""
    _, G = jacobian(lambda x: jnp.concatenate([units * chain(x), 2 * units[:10] * chain(x)[:10]]), x)
    return saddle_point(lx.DiagonalLinearOperator(masses), G, f, G @ a)


@pytest.mark.parametrize("name", SYSTEMS)
def test_as_by_dense_matrices(name):
    function, x, masses, f, a = problem(name)
    found = solved(function, x, masses, f, a)
    G = np.asarray(jax.jacrev(function)(x))
    expected = by_hand(G, np.asarray(masses), np.asarray(f), G @ np.asarray(a))
    scale = np.abs(expected[1]).max()
    np.testing.assert_allclose(found.x, expected[0], rtol=0, atol=1e-10 * np.abs(expected[0]).max())
    np.testing.assert_allclose(found.multipliers, expected[1], rtol=0, atol=(1e-9 if name == "repeated" else 1e-10) * scale)
    assert found.sound.determined and found.sound.satisfied


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
def test_derivatives_forward_and_reverse(name):
    function, x, masses, f, a = problem(name)
    weights = np.random.default_rng(3).normal(size=2)

    def value(x, masses, f):
        found = solved(function, x, masses, f, a)
        return weights[0] * jnp.sum(jnp.sin(found.x)) + weights[1] * jnp.sum(jnp.cos(found.multipliers))

    given = x, masses, f
    along = tuple(jnp.asarray(np.random.default_rng(4).normal(size=z.shape)) for z in given)
    _, forward = jax.jvp(value, given, along)
    reverse = sum(jnp.sum(g * d) for g, d in zip(jax.grad(value, (0, 1, 2))(*given), along, strict=True))
    h = 1e-4
    moved = lambda s: value(*(z + s * h * d for z, d in zip(given, along, strict=True)))
    differences = (8 * (moved(1) - moved(-1)) - (moved(2) - moved(-2))) / (12 * h)
    np.testing.assert_allclose([forward, reverse], differences, rtol=2e-7)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["chain", "tree"])
def test_second_derivatives(name):
    function, x, masses, f, a = problem(name)
    d = jnp.asarray(np.random.default_rng(6).normal(size=x.shape))
    slope = lambda s: jax.grad(lambda s: jnp.sum(solved(function, x + s * d, masses, f, a).multipliers ** 2))(s)
    h = 1e-5
    np.testing.assert_allclose(jax.jacfwd(slope)(0.0), (slope(h) - slope(-h)) / (2 * h), rtol=1e-6)


def test_contradictions_are_said():
    function, x, masses, f, _ = problem("repeated")
    _, G = jax.jit(lambda x: jacobian(function, x))(x)
    c = jnp.zeros(G.shape[0]).at[-1].set(1.0)
    assert not saddle_point(lx.DiagonalLinearOperator(masses), G, f, c).sound.satisfied


@pytest.mark.parametrize("asked, satisfied", [(0.0, True), (1.0, False)])
def test_rows_of_zeros_ask_for_nothing(asked, satisfied):
    """As of a contact that is open, or of g = x² at x = 0, which no acceleration changes."""
    function, x, masses, f, _ = problem("chain")
    _, G = jax.jit(lambda x: jacobian(lambda x: jnp.append(function(x), x[5] ** 2), x))(x.at[5].set(0.0))
    found = saddle_point(lx.DiagonalLinearOperator(masses), G, f, jnp.zeros(G.shape[0]).at[-1].set(asked))
    assert found.sound.satisfied == satisfied and found.multipliers[-1] == 0


def test_directions_without_mass_are_said():
    function, x, masses, f, a = problem("chain")
    assert not solved(function, x, masses.at[5].set(0.0), f, a).sound.determined


def test_many_at_once():
    function, x, masses, f, a = problem("strip")
    shifts = jnp.linspace(0.0, 0.1, 5)
    one = lambda s: solved(function, x + s * jnp.sin(3 * x), masses, f, a)
    together = jax.vmap(one)(shifts)
    for k, s in enumerate(shifts):
        np.testing.assert_allclose(together.x[k], one(s).x, rtol=0, atol=1e-11 * float(jnp.abs(one(s).x).max()))


@pytest.mark.slow
def test_another_right_hand_side():
    function, x, masses, f, a = problem("tree")
    _, G = jacobian(function, x)
    M = lx.DiagonalLinearOperator(masses)
    found = saddle_solver(M, G, f, G @ a)(2 * f, 3 * (G @ a))
    expected = saddle_point(M, G, 2 * f, 3 * (G @ a))
    np.testing.assert_allclose(found[0], expected.x, rtol=0, atol=1e-12 * float(jnp.abs(expected.x).max()))


def test_a_straight_chain_of_many_links_is_no_redundant_one():
    """Condition n²: λ of a chain that hangs at rest is the weight below, exact."""
    n = 4000
    x = jnp.stack([jnp.zeros(n), -jnp.arange(1.0, n + 1)], axis=1).ravel()
    rods = lambda x: chain(jnp.concatenate([jnp.zeros(2), x]))
    weight = jnp.tile(jnp.array([0.0, -1.0]), n)
    found = jax.jit(lambda x: saddle_point(lx.DiagonalLinearOperator(jnp.ones(2 * n)), jacobian(rods, x)[1], weight, jnp.zeros(n)))(x)
    assert found.sound.satisfied
    np.testing.assert_allclose(-2 * found.multipliers, np.arange(n, 0, -1.0), rtol=1e-9)
    np.testing.assert_allclose(found.x, 0, atol=1e-8)


@pytest.mark.parametrize("decades", [0, 2, 4, 5])
def test_rods_stated_twice_whose_units_are_far_apart(decades):
    """It is right, or it is said that it is not."""
    for seed in range(50):
        function, x, masses, f, a = problem("chain", seed)
        units = 10 ** jnp.asarray(np.random.default_rng(seed).uniform(-decades, decades, LINKS - 1))
        found = solved_in_units(x, units, masses, f, a)
        G = np.asarray(jax.jacobian(function)(x))
        expected = by_hand(G, masses, f, G @ a)[0]
        assert decades or found.sound.satisfied
        if found.sound.satisfied:
            np.testing.assert_allclose(found.x, expected, rtol=0, atol=1e-7 * np.abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize("links", [1000, 10_000])
def test_a_straight_chain_of_many_links_with_some_stated_twice(links):
    """S of a straight chain is all but singular itself. Of a thousand links, each of two equal rods has half the force of one stated once;
    of ten thousand it is said that none is found.
    """
    x = jnp.ravel(jnp.outer(jnp.arange(1.0, links + 1), jnp.array([np.sin(0.3), -np.cos(0.3)])))
    rods = lambda x: jnp.sum(jnp.diff(x.reshape(-1, 2), axis=0, prepend=0) ** 2, axis=1)
    twice = lambda x: jnp.concatenate([rods(x), rods(x)[3:40]])
    M, f = lx.DiagonalLinearOperator(jnp.ones(x.size)), jnp.tile(jnp.array([0.0, -9.81]), links)
    (_, once), (_, more) = jacobian(rods, x), jacobian(twice, x)
    plain = saddle_point(M, once, f, jnp.zeros(links))
    found = jax.jit(lambda f: saddle_point(M, more, f, jnp.zeros(links + 37)))(f)
    assert found.sound.satisfied == (links == 1000)
    if links > 1000:
        return
    np.testing.assert_allclose(found.x, plain.x, rtol=0, atol=1e-10 * np.abs(plain.multipliers).max())
    size = np.abs(plain.multipliers).max()
    np.testing.assert_allclose(found.multipliers[links:], found.multipliers[3:40], rtol=0, atol=1e-8 * size)
    shared = found.multipliers[:links].at[3:40].add(found.multipliers[links:])
    np.testing.assert_allclose(shared, plain.multipliers, rtol=0, atol=1e-8 * size)


@pytest.mark.slow
def test_in_single_precision(single_precision):
    jax.clear_caches()  # which know places as 64-bit integers
    function, x, masses, f, a = (y if callable(y) else y.astype("float32") for y in problem("tree"))
    found = solved(function, x, masses, f, a)
    assert found.x.dtype == found.multipliers.dtype == jnp.float32
    G = np.asarray(jax.jacrev(function)(x), float)
    expected = by_hand(G, *(np.asarray(y, float) for y in (masses, f)), G @ np.asarray(a, float))
    np.testing.assert_allclose(found.x, expected[0], rtol=0, atol=1e-4 * np.abs(expected[0]).max())
    assert found.sound.determined and found.sound.satisfied


def test_sparse_matrices_are_those_of_numpy():
    rng = np.random.default_rng(8)
    function = lambda x: jnp.append(jnp.diff(x) ** 2 * x[1:], jnp.sum(x[:30] ** 3))  # and one longer row
    x = jnp.asarray(rng.normal(size=300))
    y, J = jax.jit(lambda x: jacobian(function, x))(x)
    expected = np.asarray(jax.jacrev(function)(x))
    assert isinstance(J, SparseMatrix) and J.shape == (300, 300)
    np.testing.assert_allclose(y, function(x), rtol=1e-15)
    np.testing.assert_allclose(J.as_matrix(), expected, rtol=1e-14)
    v, B = rng.normal(size=300), rng.normal(size=(300, 3))
    np.testing.assert_allclose(J @ jnp.asarray(v), expected @ v, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(J.T @ jnp.asarray(v), expected.T @ v, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(J.T @ jnp.asarray(B), expected.T @ B, rtol=1e-11, atol=1e-12)
    np.testing.assert_array_equal((-J).T.as_matrix(), -J.as_matrix().T)


def test_columns_of_one_color_share_no_row():
    pattern = np.random.default_rng(9).random((200, 150)) < 0.02
    color = colors(pattern)
    for c in range(color.max() + 1):
        assert pattern[:, color == c].sum(axis=1).max() <= 1
