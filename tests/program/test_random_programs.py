"""The rewritten program equals the user's: random programs over the operations of `jax.lax`, every dtype, and what stays plain JAX.

The programs are those of `programs.py`, which can be run by hand over as many seeds as there is time for.
"""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from operations import NOT_COVERED, OPERATIONS
from programs import FORMS, compared, random_program, run_plain, run_rewritten

import jaxlag as jl
from jaxlag._program.interpreter import Interpreter, evaluate
from jaxlag._program.scalar_graph import SIMPLIFICATIONS, ScalarGraph
from jaxlag._program.scalarise import JAX_ALGEBRA, scalarised
from jaxlag._program.signed_zeros import equations_with_signed_zeros
from jaxlag._program.sparsity import sparsity_pattern
from jaxlag._program.structured_jacobian import structured_jacobian

SEEDS, BLOCKS = 320, 4
Q, V = np.array([0.3, 0.5, -0.2]), np.array([1.0, -0.5, 0.2])
rng = np.random.default_rng(0)
Z = rng.normal(size=(3, 3)) + 1j * rng.normal(size=(3, 3))
H, F = Z + Z.conj().T, np.exp(-2j * np.pi * np.outer(range(3), range(3)) / 3)


@pytest.mark.slow
@pytest.mark.parametrize("block", range(BLOCKS))
def test_random_programs_are_the_plain_ones(block):
    with jax.numpy_rank_promotion("allow"):  # as a user's program may do
        results = [compared(seed) for seed in range(block, SEEDS, BLOCKS)]
    assert [(seed, form, error) for seed, (form, _, error, _) in zip(range(block, SEEDS, BLOCKS), results, strict=True) if error] == []
    assert sum(other for _, other, _, _ in results) > len(results) / 2  # most were rewritten: the rest is what stays plain


@pytest.mark.slow
@pytest.mark.parametrize("seed", [18])
def test_accelerations_and_reactions_of_random_energies(seed):
    """With a constraint and dissipation, compiled, and their derivatives, against a dense solve in plain JAX."""
    run, x, v = random_program(seed)
    wave = lambda q, v: 0.1 * jnp.sin(run.scalar(q, v) / 10)
    L, D = lambda q, qdot: qdot @ qdot + wave(q, qdot), lambda q, qdot: 0.5 * (1 + wave(q, q)) * qdot @ qdot
    g = lambda q: q @ q + wave(q, q)

    def solved(q, v):
        p, rate = jax.grad(L, 1), lambda q: jax.jvp(g, (q,), (v,))[1]
        f = jax.grad(L)(q, v) - jax.jvp(lambda q: p(q, v), (q,), (v,))[1] - jax.grad(D, 1)(q, v)
        M, G, gamma = jax.jacfwd(p, 1)(q, v), jax.grad(g)(q)[None], jax.jvp(rate, (q,), (v,))[1][None]
        z = jnp.linalg.solve(jnp.block([[M, -G.T], [G, jnp.zeros((1, 1))]]), jnp.concatenate([f, -gamma]))
        return z[:3], z[3] * G[0]

    system = jl.System(L, dissipation=D, holonomic={"g": g})
    found = lambda q, v: (jl.acceleration(system, q, v).qddot, jl.constraint_force(system, q, v)["g"])
    both = lambda f: jax.jit(lambda q, v: (f(q, v), jax.jacfwd(f, (0, 1))(q, v)))(x, v)
    for a, b in zip(jax.tree.leaves(both(found)), jax.tree.leaves(both(solved)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10)


def test_every_documented_operation_is_covered_or_excluded_with_a_reason():
    public = {
        name for name, f in inspect.getmembers(lax, callable) if name.islower() and not name.startswith("_") and not name.endswith("_p")
    }
    left_out = {name for names in NOT_COVERED.values() for name in names.split()}
    assert public <= {name for name, _, _ in OPERATIONS} | left_out
    assert left_out.isdisjoint(name for name, _, _ in OPERATIONS)
    assert len(FORMS) > 5


# Complex numbers, half precision, and where NumPy and XLA differ.


POTENTIALS = {
    "a Hermitian form": lambda q: jnp.real(jnp.conj(q * (1 + 1j)) @ H @ (q + 1j * q[::-1])),
    "spectrum by a matrix": lambda q: jnp.sum(np.array([1.0, 2.0, 3.0]) * jnp.abs(F @ q) ** 2),
    "spectrum by FFT": lambda q: jnp.sum(np.array([1.0, 2.0, 3.0]) * jnp.abs(jnp.fft.fft(q)) ** 2),
    "quotient": lambda q: jnp.sum(jnp.real(1 / ((3 - 1j) * (q + 2 + 1j * q)))),
    "power": lambda q: jnp.sum(jnp.imag((q + 1j * q[::-1]) ** -2)),
    "sums": lambda q: jnp.real(jnp.einsum("i,ij,j->", jnp.conj(q * (1 + 1j)), H, q * (2 - 1j))),
    "parts": lambda q: jnp.sum(jnp.abs((q + 0j).at[0].add(2j * q[1])) ** 2),
    "triangle": lambda q: jnp.sum(jnp.abs(jax.scipy.linalg.solve_triangular(H + 3 * jnp.diag(q + 0j), q + 0j, trans=2)) ** 2),
}
HALF = {"half precision": lambda q: jnp.sum((q.astype(jnp.bfloat16) * q.astype(jnp.float16)).astype(float))}


@pytest.mark.slow
def test_complex_numbers_are_those_of_jax():
    """Accelerations −∂V/∂q and their derivatives, all in one program."""
    every = lambda q: jnp.stack([V(q) for V in POTENTIALS.values()])
    system = jl.System(lambda q, qdot, weights: 0.5 * jnp.sum(qdot**2) - weights @ every(q))
    weights = np.eye(len(POTENTIALS))
    found = jax.jit(jax.vmap(lambda w: jl.acceleration(system, Q, V, {"weights": w}).qddot))(weights)
    np.testing.assert_allclose(found, -jax.jacfwd(every)(Q), rtol=1e-10, atol=1e-12)
    curvature = jax.jit(jax.jacfwd(lambda q: jl.acceleration(system, q, V, {"weights": weights.sum(0)}).qddot))
    np.testing.assert_allclose(curvature(Q), -jax.hessian(lambda q: jnp.sum(every(q)))(Q), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("name", POTENTIALS | HALF)
def test_programs_with_other_numbers_are_left_to_jax(name):
    potential = (POTENTIALS | HALF)[name]
    programs = [jax.make_jaxpr(f)(Q).jaxpr for f in (scalarised(potential), jax.jit(potential))]
    rewritten, plain = (program.eqns[0].params["jaxpr"].jaxpr for program in programs)
    assert [e.primitive.name for e in rewritten.eqns] == [e.primitive.name for e in plain.eqns]
    assert sparsity_pattern(lambda q: jnp.stack([potential(q)]), jnp.asarray(Q)).all()
    gradient = jax.grad(potential)
    columns = structured_jacobian(gradient, jnp.asarray(Q))
    assert columns is None or np.allclose(columns, jax.jacfwd(gradient)(Q), rtol=1e-12)


EQUAL = np.array([1.0, -1.0, 1.0])
EXACT = {  # at each of the arguments, and equation by equation: XLA merges factors as well
    "a function of an element in place": (lambda x: x.at[np.array([0, 2])].apply(jnp.negative), [Q]),
    "an angle to the left": (lambda x: jnp.arctan2(x[2] - x[0], x[1]), [np.array([1.0, -1.0, 1.0]), np.array([0.0, -2.0, 0.0])]),
    "an angle of a negated difference": (lambda x: jnp.arctan2(-(x[2] - x[0]), x[1]), [np.array([1.0, -1.0, 1.0])]),
    "an angle from nothing": (lambda x: jnp.arctan2(0 - x[2], x[1]), [np.array([1.0, -1.0, 0.0])]),
    "a slope": (lambda x: jnp.arctan(x[1] / (x[2] - x[0])), [EQUAL]),
    "a slope the other way": (lambda x: jnp.arctan(x[1] / (x[0] - x[2])) + jnp.arctan(x[1] / (x[2] - x[0])), [EQUAL, Q]),
    "a slope downwards": (lambda x: jnp.arctan(-x[1] / -(2 * (x[2] - x[0]))), [EQUAL]),
    "a slope of a sum": (lambda x: jnp.arctan(x[1] / -(x[1] + x[2] - x[0] - x[1])), [EQUAL]),
    "inverse powers": (lambda x: (x[2] - x[0]) ** -3 + lax.rsqrt(x[2] - x[0]) + (x[2] - x[0]) ** -1.0, [EQUAL]),
    "within a choice": (lambda x: lax.cond(x[1] < 0, lambda d: x[1] / d, lambda d: d, x[2] - x[0]), [EQUAL]),
    "within a loop": (lambda x: lax.fori_loop(0, 2, lambda i, c: (x[2] - x[0], 1 / c[0]), (x[1], x[1]))[1], [EQUAL]),
    "within a function with a rule": (lambda x: jax.nn.relu(1 / (x[2] - x[0])) - jax.nn.relu(-1 / (x[2] - x[0])), [EQUAL]),
    "a sign as bits": (lambda x: jnp.copysign(x[1], x[2] - x[0]), [EQUAL]),
    "factors far from 1": (lambda x: (1e200 * x) * (1e200 * x) * 1e-100, [np.full(3, 1e-180)]),
    "a factor that vanishes": (lambda x: (x * 1e-200) * 1e-200 * 1e300, [np.full(3, 1e120)]),
    "whole numbers that wrap around": (lambda x: x * x * x - 7 * x, [np.array([2**30, -(2**31), 5], np.int32)]),
    "without a sign": (lambda x: (-x + 1) * x - x // 3, [np.array([0, 200, 255], np.uint8)]),
    "the least whole number": (lambda x: jnp.int32(-(2**31)) * x + x - jnp.int32(-(2**31)), [np.array([1, -1, 3], np.int32)]),
    "division by zero": (lambda x: lax.div(x, jnp.array([0, 3, 0])) + lax.rem(x, jnp.array([0, 3, 0])), [np.array([7, -7, 0])]),
    "a choice beyond the last": (lambda x: lax.select_n(jnp.array([5, -1, 1]), x, 2 * x, 3 * x), [Q]),
}


@pytest.mark.parametrize("name", EXACT)
def test_it_is_exact_where_jax_is(name):
    function, arguments = EXACT[name]
    for x in arguments:
        closed = jax.make_jaxpr(function)(jnp.asarray(x))
        (expected,), (found,) = run_plain(closed, x), run_rewritten(closed, x)[0]
        np.testing.assert_array_equal(found, expected)
        np.testing.assert_array_equal(evaluate(closed, JAX_ALGEBRA, x)[0], expected)  # of numbers


def test_differences_share_a_node_where_no_sign_of_a_zero_matters():
    """Divisors that are not zero, squares and norms ask for none, so that mechanical systems lose nothing."""

    def signed(function):
        closed = jax.make_jaxpr(function)(1.0, 1.0)
        found = equations_with_signed_zeros(closed)
        return [equation.primitive.name for equation in closed.jaxpr.eqns if id(equation) in found and equation.primitive.name == "sub"]

    assert not signed(lambda x, y: (x - y) * (y - x) / jnp.where(x - y > 0, x, 1) / jnp.where(x > 0, x, 1) / (x * x))
    assert not signed(lambda x, y: 1 / jnp.sqrt((x - y) ** 2 + 1) + 1 / jnp.abs(y - x))
    assert len(signed(lambda x, y: 1 / (x - y) + (y - x))) == 1


def test_the_largest_of_equal_ones_shares_its_derivative():
    for function in (jnp.max, jnp.min, lambda x: jnp.sum(lax.cummax(x) * np.arange(1.0, 4.0))):
        np.testing.assert_array_equal(jax.jacfwd(scalarised(function))(jnp.ones(3)), jax.jacfwd(function)(jnp.ones(3)))


def test_numbers_out_of_range_become_whole_as_in_jax():
    given = jnp.array([np.nan, np.inf, -np.inf, 1e30, -1.0, 300.7])
    for dtype in (np.int32, np.uint8, np.int64):
        np.testing.assert_array_equal(scalarised(lambda x, dtype=dtype: (x * 1, given.astype(dtype)))(Q)[1], given.astype(dtype))


# Numbers are folded at once, and long programs are given up soon.


K, TABLE = rng.normal(size=(150, 150)), jnp.asarray(rng.normal(size=100_000))
INDICES = rng.integers(0, 100_000, 100_000)
LONG_PROGRAMS = {  # as Python objects, the first of each kind took 9, 14, 5 and 5 s
    "a trace": lambda x: jnp.trace(K @ K.T) * x,
    "a loop": lambda x: lax.fori_loop(0, 100_000, lambda i, c: c * 0.99999, 1.0) * x,
    "a loop until": lambda x: lax.while_loop(lambda c: c < 1e5, lambda c: c + 1.0, 0.0) * x,
    "a table": lambda x: jnp.sum(TABLE[INDICES]) * x,
    "sums into a table": lambda x: jnp.sum(TABLE.at[INDICES].add(1.0)) * x,
    "a margin": lambda x: jnp.sum(jnp.pad(jnp.ones((400, 400)), 1)) * x,
    "a factor": lambda x: jnp.sum(jnp.linalg.cholesky(K @ K.T)) * x,
    "a loop beside x": lambda x: lax.fori_loop(0, 100_000, lambda i, c: (c[0] * 0.99999, c[1]), (1.0, x))[1],
    "zeros of x": lambda x: jnp.sum(jnp.zeros((3000, 3000)) @ jnp.concatenate([x, jnp.zeros(2997)])) * x,
}


@pytest.mark.parametrize("name", LONG_PROGRAMS)
def test_numbers_take_no_longer_than_in_jax(name, monkeypatch):
    """Few steps are done in Python, where the trace once took three million multiplications: JAX computes what is known."""
    done = []
    for step in ("apply", "equation"):
        counted = lambda *given, step=getattr(Interpreter, step), **named: done.append(step) or step(*given, **named)
        monkeypatch.setattr(Interpreter, step, counted)
    closed = jax.make_jaxpr(scalarised(LONG_PROGRAMS[name]))(Q)
    assert 0 < len(done) < 15_000
    np.testing.assert_allclose(jax.jit(jax.extend.core.jaxpr_as_fun(closed))(Q)[0], jax.jit(LONG_PROGRAMS[name])(Q), rtol=1e-10)


# Where the rewritten program differs, `examine` says so.


def test_examine_compares_with_plain_jax(monkeypatch):
    energy = lambda q, qdot: 0.5 * (1 + q[0] ** 2) * qdot[0] ** 2 + 0.5 * qdot[1] ** 2 - jnp.cos(3 * q[0] - q[1])
    examined = lambda L: jl.examine(jl.System(L, holonomic=lambda q: q[0] * q[1] - 0.12), np.array([0.3, 0.4]), np.array([0.3, -0.4]))
    assert examined(lambda q, qdot: energy(q, qdot)).findings == ()
    monkeypatch.setattr(ScalarGraph, "power", lambda graph, x, n: x)
    monkeypatch.setitem(SIMPLIFICATIONS, "mul", lambda graph, x, y: ScalarGraph.mul(graph, x, y) if x is not y else x)
    assert "miss Lagrange's equations" in examined(lambda q, qdot: energy(q, qdot)).findings[0]


# JAX's own checks.


@pytest.mark.slow
def test_nothing_traced_is_left_behind():
    """Derivative rules once held the scalars they were made from."""
    rod = jl.System(
        lambda qdot: 0.5 * qdot @ qdot, holonomic=lambda q: q @ q - 1, dissipation=lambda qdot: 0.5 * jnp.sum(jax.nn.relu(qdot) ** 2)
    )
    with jax.check_tracer_leaks():
        jl.acceleration(rod, np.array([0.6, 0.8]), np.array([0.8, -0.6]))
    function = lambda x: jnp.linalg.solve(jnp.eye(3) + jnp.outer(x, x), jax.nn.silu(x))
    with jax.check_tracer_leaks():
        jax.jvp(scalarised(function), (jnp.asarray(Q),), (jnp.asarray(V),))


@pytest.mark.parametrize(
    "slots", [{}, {"holonomic": lambda q: jnp.stack([q[0], 2.0 * q[0]])}, {"dissipation": lambda qdot: jnp.sum(jnp.abs(qdot))}]
)
def test_strict_promotion(slots):
    system = jl.System(lambda qdot: 0.5 * qdot @ qdot, **slots)
    with jax.numpy_dtype_promotion("strict"):
        found = jl.acceleration(system, np.array([0.0, 1.0]), np.array([0.0, 2.0])).qddot
    np.testing.assert_allclose(found, [0.0, -1.0 if "dissipation" in slots else 0.0], atol=1e-12)
