"""Systems nobody designed: random polynomial L, D, Q and g against SymPy's derivation, and in other coordinates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy as sp
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import jaxlag as jl

EXACT = 1e-10  # of the largest entry, against rational arithmetic
MOTION = {"rtol": 1e-10, "atol": 1e-12}
SAME = 1e-8  # of two motions at these tolerances over a second
few = settings(derandomize=True, database=None, deadline=None, max_examples=10)


# Polynomials written once, for JAX's numbers and for SymPy's symbols in object arrays. p holds the coefficients.


def lagrangian(t, q, qdot, params):
    """½ q̇ᵀM(q)q̇ with M ≥ 1, terms linear in q̇, explicit time, and a potential that is bounded below."""
    p, v = params, qdot
    kinetic = v @ v + ((p["A"] @ v) ** 2).sum() + ((p["B"] @ q) ** 2 * (p["C"] @ v) ** 2).sum()
    gyroscopic = v @ p["E"] @ q + t * (p["e"] @ v) + (p["e"] @ q) ** 2 * (p["f"] @ v)
    potential = (q**4).sum() / 4 + ((p["K"] @ q) ** 2).sum() / 2 + (p["f"] @ q) ** 3 / 12 + t * (p["e"] @ q)
    return kinetic / 2 + gyroscopic - potential


def dissipation(q, qdot, params):
    p, v = params, qdot
    return (1 + (p["f"] @ q) ** 2) * ((p["C"] @ v) ** 2).sum() / 4 + ((p["A"] @ v) ** 4).sum() / 16


def force(t, q, params):
    return params["E"] @ q + t * params["f"]


def constraint(t, q, params):
    """As many as g0 has entries, and so many rows of H; with the first coordinates in front, so that G keeps its rank near q = 0."""
    p = params
    m = len(p["g0"])
    return 3 * q[:m] + p["G"] @ q / 2 + (p["H"] @ q) ** 2 / 4 + t * p["G"] @ p["e"] / 4 - p["g0"]


system = jl.System(lagrangian, dissipation=dissipation, force=force, holonomic=constraint)
SLOTS = {"dissipation": dissipation, "force": force}
free = jl.System(lagrangian, **SLOTS)


@st.composite
def problems(draw, n, m):
    """Coefficients, and a state: small halves, which both algebras hold exactly."""
    halves = lambda *shape: draw(arrays(np.int64, shape, elements=st.integers(-2, 2))) / 2
    p = {name: halves(n, n) for name in "ABCEK"} | {name: halves(n) for name in "ef"}
    p |= {"G": halves(m, n), "H": halves(m, n), "g0": np.zeros(m)}
    return p, halves(n), halves(n)


def rational(array):
    return np.vectorize(sp.Rational, otypes=[object])(array)


def by_sympy(p, q, v, t):
    """M, f, G, q̈ and λ at the state, in rational arithmetic: M q̈ = f + Gᵀλ, G q̈ = −γ."""
    n, m = len(q), len(p["g0"])
    p = {name: rational(leaf) if leaf.size else np.zeros(leaf.shape, object) for name, leaf in p.items()}
    T, Q, V = sp.Symbol("t"), np.array(sp.symbols(f"q:{n}")), np.array(sp.symbols(f"v:{n}"))
    L, D, F, g = lagrangian(T, Q, V, p), dissipation(Q, V, p), force(T, Q, p), constraint(T, Q, p)
    rate = lambda e: sp.diff(e, T) + sum(sp.diff(e, x) * xdot for x, xdot in zip(Q, V, strict=True))  # with q̈ = 0
    here = dict(zip([T, *Q, *V], [*rational([t]), *rational(q), *rational(v)], strict=True))
    at = lambda rows, shape: sp.Matrix(*shape, [sp.sympify(e).subs(here) for e in rows])
    momenta = [sp.diff(L, xdot) for xdot in V]
    M = at([sp.diff(momentum, xdot) for momentum in momenta for xdot in V], (n, n))
    f = at([sp.diff(L, x) - rate(momentum) - sp.diff(D, xdot) + Fx for x, xdot, momentum, Fx in zip(Q, V, momenta, F, strict=True)], (n, 1))
    G = at([sp.diff(row, x) for row in g for x in Q], (m, n))
    gamma = at([rate(rate(row)) for row in g], (m, 1))
    assume(G.rank() == m)
    solution = sp.Matrix(sp.BlockMatrix([[M, -G.T], [G, sp.zeros(m, m)]])).LUsolve(sp.Matrix([f, -gamma]))
    return [np.array(x.tolist(), float).reshape(x.shape) for x in (M, f, G, solution[:n, :], solution[n:, :])]


def close(found, expected, tolerance):
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * max(1.0, np.max(np.abs(expected), initial=0.0)))


@pytest.mark.slow
@pytest.mark.parametrize("n, m", [(2, 1), (3, 1), (4, 2), (6, 2)])
@few
@given(data=st.data())
def test_equations_against_sympy(n, m, data):
    p, q, v = data.draw(problems(n, m))
    M, f, G, qddot, multipliers = by_sympy(p, q, v, 0.5)
    close(jl.mass_matrix(system, q, v, p, t=0.5), M, EXACT)
    close(jl.constraint_jacobian(system, q, v, p, t=0.5), G, EXACT)
    unbound = jl.acceleration(free, q, v, p, t=0.5).qddot
    close(M @ unbound, f[:, 0], EXACT)
    found = jl.acceleration(system, q, v, p, t=0.5)
    close(found.qddot, qddot[:, 0], EXACT)
    close(found.multipliers["holonomic"], multipliers[:, 0], EXACT)


# Motions, all over one second from a start that `simulate` puts on the constraints, the nearest in the metric of M


TS = jnp.linspace(0, 1, 11)


def with_a_start_on_the_constraints(data, n, m):
    p, q0, v0 = data.draw(problems(n, m))
    q0 = q0 / 4
    return {**p, "g0": np.zeros(m)} | {"g0": constraint(0.0, q0, p)}, q0, v0


def simulated(system, q0, v0, params):
    motion = jl.simulate(system, q0, v0, TS, params, **MOTION)
    return np.asarray(motion.q), np.asarray(motion.qdot), {name: np.asarray(leaf) for name, leaf in motion.multipliers.items()}


turned = jl.substitute(system, lambda q, T: T @ q)


@pytest.mark.slow
@pytest.mark.parametrize("n, m", [(2, 1), (4, 2)])
@few
@given(data=st.data())
def test_motion_in_linearly_changed_coordinates(n, m, data):
    """x = T y with T of determinant 1: the same motion, and the same λ."""
    p, x0, v0 = with_a_start_on_the_constraints(data, n, m)
    lower, upper = (data.draw(arrays(np.int64, (n, n), elements=st.integers(-1, 1))) / 2 for _ in range(2))
    T = (np.eye(n) + np.tril(lower, -1)) @ (np.eye(n) + np.triu(upper, 1))
    x, xdot, multipliers = simulated(system, x0, v0, p)
    y, ydot, the_same = simulated(turned, np.linalg.solve(T, x0), np.linalg.solve(T, v0), {**p, "T": T})
    close(y @ T.T, x, SAME)
    close(ydot @ T.T, xdot, SAME)
    close(the_same["holonomic"], multipliers["holonomic"], SAME)


def solved(t, q, params):
    """The last m coordinates, as polynomials of the others."""
    p = params
    m = len(p["g0"])
    z = p["G"][:, :-m] @ q
    return z / 2 + (p["H"][:, :-m] @ q) ** 2 / 4 + t * p["G"] @ p["e"] / 4


def all_coordinates(t, q, params):
    return jnp.concatenate([q, solved(t, q, params)])


def unsolved(t, q, params):
    m = len(params["g0"])
    return q[-m:] - solved(t, q[:-m], params)


first_kind = jl.System(lagrangian, **SLOTS, holonomic={"solved": unsolved})
second_kind = jl.substitute(free, all_coordinates)


@pytest.mark.slow
@pytest.mark.parametrize("n, m", [(3, 1), (4, 2)])
@few
@given(data=st.data())
def test_first_kind_and_solved_constraints_are_the_same_motion(n, m, data):
    p, q0, v0 = data.draw(problems(n, m))
    q0, v0 = q0[:-m] / 4, v0[:-m]
    start, velocity = jax.jvp(lambda t, q: all_coordinates(t, q, p), (0.0, jnp.asarray(q0)), (1.0, jnp.asarray(v0)))
    reduced, reduced_rate, _ = simulated(second_kind, q0, v0, p)
    q, qdot, _ = simulated(first_kind, start, velocity, p)
    close(q[:, :-m], reduced, SAME)
    close(qdot[:, :-m], reduced_rate, SAME)
    close(q[:, -m:], np.stack([solved(t, x, p) for t, x in zip(TS, reduced, strict=True)]), SAME)
