"""Functions of arrays as formulas: their values, exact numbers, structure, and what has no formula."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from jax import lax
from sympy import Rational, cos, sqrt, symbols

import jaxlag as jl
from jaxlag import dissipation

x, y, z = symbols("x y z", real=True)
i, j = np.array([1, 0]), np.array([0, 1])
FUNCTIONS = (
    *(jnp.negative, jnp.sign, jnp.abs, jnp.sqrt, lax.rsqrt, jnp.cbrt, jnp.exp, jnp.exp2, jnp.log, jnp.log1p, jnp.expm1, jnp.square),
    *(jnp.sin, jnp.cos, jnp.tan, jnp.arcsin, jnp.arccos, jnp.arctan, jnp.sinh, jnp.cosh, jnp.tanh, jnp.arcsinh, jnp.arctanh),
    *(lambda v: jnp.arccosh(1 + v), lax.erf, lax.erfc, lax.erf_inv, lax.lgamma, lax.digamma, lax.logistic, jnp.floor, jnp.ceil),
    *(lambda v: v**3, lambda v: v**-2, lambda v: v**1.5, lambda v: 2.0**v, lambda v: v / 3 - 0.1, jax.nn.relu, jax.nn.softplus, jnp.sinc),
    *(
        lambda v: jnp.where(v > 0.5, v, 2 * v),
        lambda v: jnp.where((v > 0.5) ^ (v < 0.7) | ~(v < 0.1), v, 1.0),
        lambda v: jnp.clip(v, 0.3, 0.6),
    ),
    *(lambda v: lax.select_n((3 * v).astype(int), v, 2 * v, 3 * v), lambda v: (v > 0.5) * v, lambda v: (10 * v).astype(int) * v),
    *(lambda v: v[0] * v[1] + jnp.maximum(v[0], v[1]) - jnp.minimum(*v), lambda v: jnp.arctan2(*v), lambda v: lax.rem(v[0], v[1]), jnp.sum),
    *(
        jnp.prod,
        jnp.max,
        jnp.min,
        jnp.cumsum,
        jnp.cumprod,
        jnp.mean,
        jnp.linalg.norm,
        lambda v: jnp.hypot(*v),
        lambda v: jnp.mod(3 * v, 2.0),
    ),
    *(
        lambda v: v @ v,
        lambda v: jnp.outer(v, v) @ v,
        lambda v: jnp.outer(v, v).T[:, 0],
        lambda v: v[::-1],
        lambda v: v[i],
        lambda v: v.at[i].add(v),
    ),
    *(
        lambda v: jnp.concatenate([v, 2 * v]),
        lambda v: jnp.stack([v, v])[i, j],
        lambda v: jnp.broadcast_to(v, (2, 2)) * v[:, None],
        jnp.diff,
    ),
    *(
        lambda v: lax.scan(lambda c, k: (c * v[0] + k, c), 1.0, v),
        lambda v: lax.fori_loop(0, 3, lambda k, c: c + v[k % 2], v),
        jax.jit(jnp.cos),
    ),
    *(
        lambda v: jnp.linalg.solve(jnp.outer(v, v) + jnp.eye(2), v),
        lambda v: jnp.linalg.det(jnp.outer(v, v) + jnp.eye(2)),
        jax.checkpoint(jnp.sin),
    ),
    *(
        lambda v: jnp.linalg.det(jnp.diag(jnp.arange(4.0)) + v[0] * jnp.ones((4, 4))),
        lambda v: jnp.linalg.inv(jnp.outer(v, v) + jnp.eye(2)),
    ),
    *(
        lambda v: jnp.linalg.solve(jnp.array([[0.0, 1.0], [1.0, 0.0]]) * v[None], v),
        jax.grad(lambda v: jnp.sin(v[0] * v[1])),
        jax.jacfwd(lambda v: v**3),
    ),
    *(lambda v: jax.scipy.special.logsumexp(v), lambda v: dissipation.drag(v, 2.0), lambda v: dissipation.stribeck(v[0], 1.0, 2.0, 0.3)),
    *(
        lambda v: lax.cond(True, jnp.sin, jnp.cos, v),
        lambda v: jnp.sum(jnp.eye(2) * v[None]) * jnp.array([True, False]),
        lambda v: v.astype(jnp.float32),
    ),
    *(
        lambda v: jnp.interp(v, jnp.array([0.0, 0.5, 0.7]), jnp.array([1.0, 3.0, 2.0])),
        lambda v: jnp.interp(v[0], 0.5 * jnp.arange(3.0), v[1] * jnp.arange(3.0) ** 2, left=1, right=7.0),
        lambda v: jnp.interp(5 * v - 2, jnp.array([0.0, 1.0, 1.0, 2.0]), jnp.array([1.0, 3.0, 5.0, 4.0])),
    ),
)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_formulas_have_the_values_of_the_function(function):
    at = np.array([0.37, 0.61])
    point = {x: sympy.Float(at[0], 30), y: sympy.Float(at[1], 30)}
    formulas, want = jl.to_sympy(function, [x, y]), function(jnp.asarray(at))
    assert jax.tree.structure(formulas) == jax.tree.structure(want)
    for formula, value in zip(jax.tree.leaves(formulas), jax.tree.leaves(want), strict=True):
        assert np.shape(formula) == value.shape
        got = [complex(entry.xreplace(point).doit()) for entry in np.ravel(formula)]
        np.testing.assert_allclose(got, np.ravel(value), rtol=1e-7 if value.dtype == np.float32 else 1e-13)


@pytest.mark.fast
@pytest.mark.parametrize(
    "number, exact",
    [
        (0.5, Rational(1, 2)),
        (1 / 3, Rational(1, 3)),
        (0.1, Rational(1, 10)),
        (9.81, Rational(981, 100)),
        (-7 / 12, -Rational(7, 12)),
        (2.0, 2),
        (np.pi, sympy.pi),
        (np.pi / 3, sympy.pi / 3),
        (-(2**0.5), -sqrt(2)),
        (0.75**0.5, sqrt(3) / 2),
        (9.80665, sympy.Float(9.80665)),
        (6.674e-11, sympy.Float(6.674e-11)),
        (np.float32(9.81), Rational(981, 100)),
    ],
)
def test_numbers_are_exact_where_they_were_meant_to_be(number, exact):
    formula = jl.to_sympy(lambda v: number * v, x)
    assert formula == exact * x and formula.atoms(sympy.Float) == sympy.sympify(exact).atoms(sympy.Float)


@pytest.mark.fast
def test_arithmetic_of_numbers_is_exact():
    assert jl.to_sympy(lambda v: v / 3 + v * jnp.asarray(0.1) * 3 + jnp.sqrt(2.0) ** 2 * v, x) == Rational(79, 30) * x
    assert jl.to_sympy(lambda v: jnp.cos(jnp.asarray(0.3)) * v, x) == cos(Rational(3, 10)) * x
    assert jl.to_sympy(lambda v: jnp.where(v**2 < jnp.finfo(float).tiny, 0.0, 1 / v), x) == 1 / x  # a guard against 0/0


def test_what_goes_in_and_comes_out_may_be_structured():
    energy = lambda q, m: {"T": 0.5 * m * q["v"] ** 2, "all": jnp.stack([m, m * q["v"]])}
    formulas = jl.to_sympy(energy, {"v": x}, 2)
    assert formulas["T"] == x**2 and list(formulas["all"]) == [2, 2 * x]
    assert jl.to_sympy(lambda A, n: A @ A[0] + n, sympy.Matrix([[x, y], [0, 1]]), np.arange(2.0))[1] == y + 1
    with pytest.raises(TypeError, match="`arguments` must hold expressions and numbers, but hold 'x'. Make symbols by `sympy.Symbol`."):
        jl.to_sympy(jnp.sin, "x")


def test_an_operation_without_a_formula_is_named_with_its_line():
    def potential(q):
        return jnp.sum(jnp.sort(q))  # the line in question

    where = rf"must use known operations only, but uses `sort` at .*test_to_sympy\.py:{potential.__code__.co_firstlineno + 1}\b"
    with pytest.raises(NotImplementedError, match=where):
        jl.to_sympy(potential, [x, y])
    system = jl.System(lambda q, qdot: 0.5 * qdot @ qdot - potential(q))
    with pytest.raises(NotImplementedError, match=where):
        jl.equations(system, np.zeros(2))
    with pytest.raises(NotImplementedError, match="uses `div`"):
        jl.to_sympy(lambda v: v.astype(int) // 2, x)
