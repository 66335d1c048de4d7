"""Constrained solves of sparse rows beside a sparse mass matrix, as of rigid bodies and their joints: against dense ones in NumPy, their
derivatives against differences, and motions of a chain of bodies against the same in its angles.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlag._mechanics.saddle_point import is_determined, saddle_point, saddle_solver
from jaxlag._mechanics.structured_inertia import StructuredInertia, structured_inertia
from jaxlag._program.sparse_jacobian import jacobian
from jaxlag._program.sparse_matrix import SparseMatrix

BODIES = 30


def offset(m):
    """Bodies in the plane, the center of mass beside the point that x is of: kinetic energies of 3 numbers that are coupled."""

    def kinetic(x, v):
        across = jnp.stack([-jnp.sin(x[:, 2]), jnp.cos(x[:, 2])], axis=1)
        return 0.5 * jnp.sum(m * jnp.sum((v[:, :2] + 0.3 * v[:, 2:] * across) ** 2, axis=1) + 0.1 * m * v[:, 2] ** 2)

    return kinetic


def ends(x):
    return x[:, :2], x[:, :2] + jnp.stack([jnp.cos(x[:, 2]), jnp.sin(x[:, 2])], axis=1)


def chain(x):
    first, last = ends(x.reshape(-1, 3))
    return (first[1:] - last[:-1]).ravel()


def tree(x):
    """Each body hangs on one of those before it: the same for every size."""
    x = x.reshape(-1, 3)
    above = np.maximum(np.arange(1, len(x)) - np.random.default_rng(2).integers(1, 4, len(x) - 1), 0)
    first, last = ends(x)
    return (first[1:] - last[above]).ravel()


def units(x):
    """Joints in micrometers and in kilometers."""
    g = chain(x)
    return g * np.where(np.arange(len(g)) % 3 == 0, 1e6, 1e-3)


def repeated(x):
    """Every fifth row once more, in other units: rows that depend on each other."""
    g = chain(x)
    return jnp.concatenate([g, 7.0 * g[::5]])


def unit_vectors(m):
    """Points beside unit vectors of 3 numbers: what turns has no inertia along itself, and is held by its length alone."""

    def kinetic(x, v):
        turning = jnp.cross(x[:, 3:], v[:, 3:])
        return 0.5 * jnp.sum(m * jnp.sum(v[:, :3] ** 2, axis=1) + jnp.sum(turning**2, axis=1))

    return kinetic


def on_arms(x):
    x = x.reshape(-1, 6)
    ends = x[:, :3] + x[:, 3:]
    return jnp.concatenate([jnp.sum(x[:, 3:] ** 2, axis=1), (x[1:, :3] - ends[:-1]).ravel()])


SYSTEMS = {
    "chain": (offset, chain, 3),
    "tree": (offset, tree, 3),
    "units": (offset, units, 3),
    "repeated": (offset, repeated, 3),
    "no inertia along": (unit_vectors, on_arms, 6),
}


def problem(name, seed=0):
    *_, width = SYSTEMS[name]
    rng = np.random.default_rng(seed)
    x, m = rng.normal(size=(BODIES, width)), rng.uniform(0.2, 3.0, BODIES)
    if name == "no inertia along":
        x[:, 3:] /= np.linalg.norm(x[:, 3:], axis=1, keepdims=True)
    f, a = rng.normal(size=(2, x.size))
    return tuple(map(jnp.asarray, (x.ravel(), m, f, a)))


def matrices(name, x, m):
    kinetic, rows, width = SYSTEMS[name]
    of_bodies = lambda x: x.reshape(-1, width)
    return (lambda v: kinetic(m)(of_bodies(x), of_bodies(v))), rows


@functools.partial(jax.jit, static_argnums=0)
def solved(name, x, m, f, a):
    T, rows = matrices(name, x, m)
    M, (_, G) = structured_inertia(T, x), jacobian(rows, x)
    assert isinstance(M, StructuredInertia) and isinstance(G, SparseMatrix) and G.shape[0] > 16
    return saddle_point(M, G, f, G @ a)


def by_hand(name, x, m, f, a):
    """Least squares in NumPy: x, and the λ of least norm."""
    T, rows = matrices(name, x, m)
    M, G = np.asarray(jax.hessian(T)(jnp.zeros_like(x))), np.asarray(jax.jacrev(rows)(x))
    scale = np.linalg.norm(G, axis=1) if name == "units" else np.ones(len(G))  # of independent rows λ is unique
    G = G / scale[:, None]
    whole = np.block([[M, -G.T], [G, np.zeros((len(G), len(G)))]])
    found = np.linalg.lstsq(whole, np.concatenate([f, G @ np.asarray(a)]), rcond=1e-12)[0]
    return found[: x.size], found[x.size :] / scale


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
def test_as_by_dense_matrices(name):
    given = problem(name)
    found, (x, multipliers) = solved(name, *given), by_hand(name, *given)
    np.testing.assert_allclose(found.x, x, rtol=0, atol=1e-11 * np.abs(x).max())
    scale = np.abs(multipliers).max() if name != "units" else np.abs(multipliers)
    np.testing.assert_array_less(np.abs(found.multipliers - multipliers), (1e-9 if name == "repeated" else 1e-10) * scale)
    assert found.sound.determined and found.sound.satisfied


@pytest.mark.parametrize("aside", [0.0, 1e-17, 1e-9, 1e-4])
def test_next_to_no_inertia_sets_no_scale(aside):
    """Of unit vectors along an axis the first number has the inertia `aside`², and is held by their length alone."""
    x, m, f, a = problem("no inertia along")
    vectors = np.tile([1.0, aside, -aside], (BODIES, 1))
    x = x.reshape(-1, 6).at[:, 3:].set(vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).ravel()
    found, (expected, multipliers) = solved("no inertia along", x, m, f, a), by_hand("no inertia along", x, m, f, a)
    np.testing.assert_allclose(found.x, expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    np.testing.assert_allclose(found.multipliers, multipliers, rtol=0, atol=1e-10 * np.abs(multipliers).max())
    assert found.sound.determined and found.sound.satisfied


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
def test_derivatives_forward_and_reverse(name):
    x, m, f, a = problem(name)
    weights, size = np.random.default_rng(3).normal(size=2), np.abs(by_hand(name, x, m, f, a)[1]) if name == "units" else 1.0

    def value(x, m, f):
        found = solved(name, x, m, f, a)
        return weights[0] * jnp.sum(jnp.sin(found.x)) + weights[1] * jnp.sum(jnp.cos(found.multipliers / size))

    given = x, m, f
    along = tuple(jnp.asarray(np.random.default_rng(4).normal(size=z.shape)) for z in given)
    _, forward = jax.jvp(value, given, along)
    reverse = sum(jnp.sum(g * d) for g, d in zip(jax.grad(value, (0, 1, 2))(*given), along, strict=True))
    h = 1e-4
    moved = lambda s: value(*(z + s * h * d for z, d in zip(given, along, strict=True)))
    differences = (8 * (moved(1) - moved(-1)) - (moved(2) - moved(-2))) / (12 * h)
    np.testing.assert_allclose([forward, reverse], differences, rtol=2e-7)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["chain", "no inertia along"])
def test_second_derivatives(name):
    x, m, f, a = problem(name)
    d = jnp.asarray(np.random.default_rng(6).normal(size=x.shape))
    slope = lambda s: jax.grad(lambda s: jnp.sum(solved(name, x + s * d, m, f, a).multipliers ** 2))(s)
    h = 1e-5
    np.testing.assert_allclose(jax.jacfwd(slope)(0.0), (slope(h) - slope(-h)) / (2 * h), rtol=1e-6)


def of(name, x, m):
    T, rows = matrices(name, x, m)
    return structured_inertia(T, x), jacobian(rows, x)[1]


@pytest.mark.slow
def test_contradictions_are_said():
    x, m, f, _ = problem("repeated")
    M, G = jax.jit(lambda x, m: of("repeated", x, m))(x, m)
    assert not saddle_point(M, G, f, jnp.zeros(G.shape[0]).at[-1].set(1.0)).sound.satisfied


@pytest.mark.slow
def test_inertia_that_is_missing_or_negative_is_said():
    x, m, f, a = problem("chain")
    for mass in (0.0, -1.0):
        changed = m.at[-1].set(mass)  # of the free end: one between others would be held by these
        assert not solved("chain", x, changed, f, a).sound.determined
        assert not is_determined(*jax.jit(lambda x, m: of("chain", x, m))(x, changed))
    assert is_determined(*jax.jit(lambda x, m: of("no inertia along", x, m))(*problem("no inertia along")[:2]))


def test_many_at_once():
    x, *rest = problem("repeated")
    shifts = jnp.linspace(0.0, 0.1, 5)
    one = lambda s: solved("repeated", x + s * jnp.sin(3 * x), *rest)
    together = jax.vmap(one)(shifts)
    for k, s in enumerate(shifts):
        np.testing.assert_allclose(together.x[k], one(s).x, rtol=0, atol=1e-11 * float(jnp.abs(one(s).x).max()))


@pytest.mark.slow
def test_another_right_hand_side():
    x, m, f, a = problem("tree")
    M, G = jax.jit(lambda x, m: of("tree", x, m))(x, m)
    found = saddle_solver(M, G, f, G @ a)(2 * f, 3 * (G @ a))
    expected = saddle_point(M, G, 2 * f, 3 * (G @ a))
    np.testing.assert_allclose(found[0], expected.x, rtol=0, atol=1e-12 * float(jnp.abs(expected.x).max()))


@pytest.mark.slow
def test_in_single_precision(single_precision):
    jax.clear_caches()  # which know places as 64-bit integers
    given = [y.astype("float32") for y in problem("tree")]
    found = solved("tree", *given)
    assert found.x.dtype == found.multipliers.dtype == jnp.float32
    expected = by_hand("tree", *given)
    np.testing.assert_allclose(found.x, expected[0], rtol=0, atol=1e-4 * np.abs(expected[0]).max())
    assert found.sound.determined and found.sound.satisfied


def test_a_straight_chain_of_many_bodies_is_no_redundant_one():
    """Condition n²: λ of bodies that hang at rest is the weight below, exact."""
    n = 1000
    x = jnp.stack([jnp.zeros(n), -jnp.arange(0.0, n), jnp.full(n, -jnp.pi / 2)], axis=1)
    T = lambda v: offset(jnp.ones(n))(x, v.reshape(-1, 3))
    joints = lambda x: jnp.concatenate([x[:2], chain(x)])
    weight = jax.grad(lambda x: -jnp.sum(x[:, 1] + 0.3 * jnp.sin(x[:, 2])))(x).ravel()
    found = jax.jit(lambda x: saddle_point(structured_inertia(T, x), jacobian(joints, x)[1], weight, jnp.zeros(2 * n)))(x.ravel())
    assert found.sound.determined and found.sound.satisfied
    np.testing.assert_allclose(found.multipliers[1::2], np.arange(n, 0, -1.0), rtol=1e-9)
    np.testing.assert_allclose(found.x, 0, atol=1e-8)
