"""Zeros of Jacobians read from programs, and constrained solves with a mass matrix recognised as diagonal, against dense ones and NumPy."""

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._mechanics.pseudo_inverse import everywhere
from jaxlag._mechanics.saddle_point import saddle_point
from jaxlag._program.sparse_jacobian import jacobian
from jaxlag._program.sparse_matrix import SparseMatrix, dense
from jaxlag._program.sparsity import sparsity_pattern

G = 9.81


def squares(x):
    """Neighbours in a ring, and one element that depends on nothing."""
    return jnp.append((x - jnp.roll(x, 1)) ** 2 * jnp.sin(x), 3.0)


def test_the_pattern_of_a_ring():
    n = 30
    x = jnp.asarray(np.random.default_rng(0).normal(size=n))
    expected = np.vstack([np.eye(n) + np.roll(np.eye(n), -1, axis=1), np.zeros(n)]) > 0
    np.testing.assert_array_equal(sparsity_pattern(squares, x), expected)


def test_terms_that_cancel_are_no_dependence():
    x = jnp.arange(20.0)
    np.testing.assert_array_equal(sparsity_pattern(lambda x: x + (jnp.sum(x) - jnp.sum(x[::-1][::-1])), x), np.eye(20))


@pytest.mark.parametrize("function", [lambda x: jnp.linalg.solve(jnp.eye(x.size) + jnp.outer(x, x), x), lambda x: jax.lax.sort(x)])
def test_an_equation_kept_whole_depends_on_all(function):
    assert sparsity_pattern(function, jnp.arange(14.0)).all()


def test_a_program_too_long_depends_on_all():
    assert sparsity_pattern(lambda x: jax.lax.fori_loop(0, 3000, lambda _, x: jnp.sin(x), x), jnp.arange(14.0)).all()


@pytest.mark.parametrize("n", [2, 30, 300])
def test_jacobian_is_that_of_all_columns(n):
    x = jnp.asarray(np.random.default_rng(1).normal(size=n))
    y, J = jax.jit(lambda x: jacobian(squares, x))(x)
    np.testing.assert_allclose(y, squares(x), rtol=1e-15)
    J = dense(J) if isinstance(J, SparseMatrix) else J.as_matrix()
    np.testing.assert_allclose(J, jax.jacrev(squares)(x), rtol=1e-14, atol=1e-14)


def test_columns_that_share_no_row_share_a_direction():
    """Of 30 columns in a ring each shares a row with its two neighbours: two directions are enough in place of 30."""
    program = jax.make_jaxpr(lambda x: jacobian(lambda x: x * jnp.roll(x, 1), x)[1].as_matrix())(jnp.arange(30.0))
    assert {v.aval.size for eqn in program.jaxpr.eqns if eqn.primitive.name == "mul" for v in eqn.outvars} == {30, 60}


@pytest.mark.parametrize("function, diagonal", [(jnp.sin, True), (squares, False), (lambda x: x[::-1], False), (lambda x: 0 * x, False)])
def test_a_diagonal_is_recognised(function, diagonal):
    _, J = jacobian(function, jnp.linspace(0.1, 1.0, 20))
    assert isinstance(J, lx.DiagonalLinearOperator) == diagonal


def two_ways(masses, seed=0):
    """The same constrained solve with a diagonal and with a full matrix."""
    rng, n = np.random.default_rng(seed), len(masses)
    rows, f, c = (jnp.asarray(x) for x in (rng.normal(size=(4, n)), rng.normal(size=n), rng.normal(size=4)))
    diagonal = lambda m, rows=rows, f=f: saddle_point(lx.DiagonalLinearOperator(m), rows, f, c)
    full = lambda m, rows=rows, f=f: saddle_point(lx.MatrixLinearOperator(jnp.diag(m)), rows, f, c)
    return diagonal, full, rows, f


@pytest.mark.slow
@pytest.mark.parametrize("massless", [0, 2])
def test_diagonal_and_full_inertia_agree(massless):
    """Also where masses are zero and constraints hold the massless coordinates; with all derivatives."""
    masses = jnp.asarray(np.r_[np.zeros(massless), np.linspace(0.5, 3.0, 14 - massless)])
    diagonal, full, rows, f = two_ways(masses)
    for one, other in zip(diagonal(masses), full(masses), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)
    value = lambda solve: lambda *given: jnp.concatenate([*solve(*given)[:2]])
    for differentiate in (jax.jacfwd, jax.jacrev):
        slopes = [differentiate(value(solve), argnums=(0, 1, 2))(masses, rows, f) for solve in (diagonal, full)]
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-7), *slopes)


@pytest.mark.slow
def test_members_of_a_batch_choose_together():
    """One member without a mass sends all to the full solve, which is right for all."""
    masses = jnp.asarray(np.random.default_rng(3).uniform(0.5, 2.0, (5, 14))).at[2, 0].set(0.0)
    diagonal, full, *_ = two_ways(masses[0])
    found, expected = jax.jit(jax.vmap(diagonal))(masses), jax.vmap(full)(masses)
    np.testing.assert_allclose(found.x, expected.x, rtol=1e-9, atol=1e-9)
    assert jax.vmap(everywhere)(jnp.array([True, False])).tolist() == [False, False]


@pytest.mark.fast
def test_no_branch_is_taken_twice_in_a_batch():
    """A `cond` on what holds everywhere stays a `cond` in a batch."""
    function = lambda x: jax.lax.cond(everywhere(x > 0), lambda: jnp.sqrt(x), lambda: x)
    assert "cond" in str(jax.make_jaxpr(jax.vmap(jax.vmap(function)))(jnp.ones((3, 2))))


def chain(n):
    """n rods of ½ m with points of mass m_k; L and g."""
    lagrangian = lambda q, qdot, m: 0.5 * jnp.sum(m[:, None] * qdot**2) - G * jnp.sum(m * q[:, 1])
    rods = lambda q: jnp.sum(jnp.diff(q, axis=0, prepend=0.0) ** 2, axis=1) - 0.25
    return jl.System(lagrangian, holonomic={"rods": rods})


@pytest.mark.slow
@pytest.mark.parametrize("n", [2, 6, 20])
def test_a_chain_in_cartesian_coordinates_is_one_in_angles(n):
    """Accelerations against Lagrange's equations in angles, without constraints: written out, in scalars and in arrays."""
    rng = np.random.default_rng(n)
    phi, omega, m = rng.uniform(-1, 1, n), rng.uniform(-1, 1, n), rng.uniform(0.5, 2.0, n)
    place = lambda phi: jnp.cumsum(0.5 * jnp.stack([jnp.sin(phi), -jnp.cos(phi)], axis=1), axis=0)
    velocity = lambda phi, omega: jax.jvp(place, (phi,), (omega,))[1]
    in_angles = jl.System(lambda q, qdot, m: 0.5 * jnp.sum(m[:, None] * velocity(q, qdot) ** 2) - G * jnp.sum(m * place(q)[:, 1]))
    alpha = jl.acceleration(in_angles, phi, omega, {"m": m}).qddot
    expected = jax.jvp(lambda phi, omega: velocity(phi, omega), (phi, omega), (omega, alpha))[1]
    found = jl.acceleration(chain(n), place(phi), velocity(phi, omega), {"m": m}).qddot
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8)


@pytest.mark.slow
def test_a_joint_without_mass_in_a_long_chain():
    """Two rods that meet at an angle cannot pull at a point without mass: the chain beyond it falls freely."""
    n, k = 12, 5
    turns = 0.4 + 0.2 * (np.arange(n) > k)
    start = np.cumsum(0.5 * np.stack([np.sin(turns), -np.cos(turns)], axis=1), axis=0)
    found = jl.acceleration(chain(n), start, np.zeros((n, 2)), {"m": np.r_[np.ones(k), 0.0, np.ones(n - k - 1)]})
    above = jl.acceleration(chain(k), start[:k], np.zeros((k, 2)), {"m": np.ones(k)}).qddot
    np.testing.assert_allclose(found.qddot[:k], above, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(found.qddot[k + 1 :], np.tile([0.0, -G], (n - k - 1, 1)), rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(found.multipliers["rods"][k:], 0.0, atol=1e-8)
