"""Programs as scalar code: every kind of primitive against plain evaluation, derivatives, constant folding, what stays whole."""

import operator
import re

import jax
import jax.numpy as jnp
import jax.scipy
import numpy as np
import pytest
from jax import lax
from operations import doubled_slope, tripled_slope

import jaxlag as jl
from jaxlag._mechanics.constrained_acceleration import constrained_acceleration
from jaxlag._model.flat import bind
from jaxlag._program import constants
from jaxlag._program.constants import folded
from jaxlag._program.expressions import Algebra, TooLong, UnknownPrimitive, filled
from jaxlag._program.interpreter import evaluate
from jaxlag._program.scalarise import JAX_ALGEBRA, _scalars, scalarised
from jaxlag.examples import pendulum, vehicle

ROUNDING = 1e-12  # relative: sums are taken in another order, nothing else differs


def close(got, want, tolerance=ROUNDING):
    assert jax.tree.structure(got) == jax.tree.structure(want)
    for g, w in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        assert (g.shape, g.dtype) == (w.shape, w.dtype)
        np.testing.assert_allclose(g, w, rtol=tolerance, atol=tolerance)


def operations(function, *arguments):
    """Names of the equations of a traced function, in all of its jaxprs."""

    def names(jaxpr):
        for equation in jaxpr.eqns:
            bodies = [getattr(p, "jaxpr", p) for p in equation.params.values() if hasattr(getattr(p, "jaxpr", p), "eqns")]
            yield from [equation.primitive.name] if not bodies else [name for body in bodies for name in names(body)]

    return list(names(jax.make_jaxpr(function)(*arguments).jaxpr))


def on_scalars(function, *arguments):
    """Whether the function was taken apart, down to scalars, also within its solves."""
    moving = {"reshape", "split", "concatenate", "slice", "squeeze", "broadcast_in_dim", "transpose", "custom_linear_solve"}

    def apart(jaxpr):
        for e in jaxpr.eqns:
            bodies = e.params["jaxprs"] if e.primitive.name == "custom_linear_solve" else ()
            yield all(apart_wholly(body.jaxpr) for body in bodies if body is not None)
            yield e.primitive.name in moving or all(v.aval.shape == () for v in e.outvars)

    apart_wholly = lambda jaxpr: all(apart(jaxpr))
    return apart_wholly(jax.make_jaxpr(scalarised(function))(*arguments).jaxpr.eqns[0].params["jaxpr"].jaxpr)


def compiled_operations(function, *arguments):
    """Names of the operations that are left in the compiled program."""
    text = jax.jit(function).lower(*arguments).compile().as_text()
    return re.findall(r"^\s+(?:ROOT )?%?[\w.-]+ = \S+ ([\w-]+)\(", text, re.M)


x = jnp.asarray(np.random.default_rng(0).uniform(0.2, 0.8, (3, 4)))  # inside the domain of every function below
y = jnp.asarray(np.random.default_rng(1).uniform(0.2, 0.8, (3, 4)))
v = x[0]
spd = x @ x.T + jnp.eye(3)
i, j = np.array([2, 0, 2]), np.array([1, 3, 1])

UNARY = (
    *(jnp.negative, jnp.sign, jnp.abs, jnp.sqrt, lax.rsqrt, jnp.cbrt, jnp.exp, jnp.exp2, jnp.log, jnp.log1p, jnp.expm1, jnp.sin, jnp.cos),
    *(jnp.tan, jnp.arcsin, jnp.arccos, jnp.arctan, jnp.sinh, jnp.cosh, jnp.tanh, jnp.arcsinh, lambda x: jnp.arccosh(1 + x), jnp.arctanh),
    *(jnp.square, jnp.floor, jnp.ceil, lambda x: jnp.round(3 * x), lax.erf, lax.erfc, lax.erf_inv, lax.logistic, lax.lgamma, lax.digamma),
    *(jnp.isfinite, lambda x: ~(x > 0.5), lambda x: x**3, lambda x: x**-2, lambda x: x**0.5, lambda x: x**1.5, lambda x: x**2.0),
    *(lambda x: lax.integer_pow(x, 0), lambda x: x.astype(int), lambda x: x.astype(jnp.float32), lax.stop_gradient, jnp.negative),
    *(lambda x: 0 * x + 1 * x - 0, lambda x: x / 4 - x / 3, lambda x: 1 / x, lambda x: jnp.sin(-2 * x) + jnp.cos(-x), jnp.copy),
)
BINARY = (
    *(jnp.add, jnp.subtract, jnp.multiply, jnp.divide, jnp.power, jnp.arctan2, jnp.maximum, jnp.minimum, lax.rem, jnp.mod, jnp.hypot),
    *(operator.eq, operator.ne, operator.lt, operator.le, operator.gt, operator.ge, jnp.floor_divide, lambda x, y: x - y + (y - x)),
    *(lambda x, y: (x > 0.5) & (y > 0.5), lambda x, y: (x > 0.5) | True, lambda x, y: (x > 0.5) ^ (y > 0.5), lambda x, y: x * y - y * x),
    *(lambda x, y: jnp.where(x > y, x, 2 * y), lambda x, y: jnp.clip(x, 0.3, y), lambda x, y: lax.select_n(x > y, x, y), jnp.logaddexp),
    *(lambda x, y: (-x) * (-y) / (-x), lambda x, y: (2 * x) * (3 * y) - 6 * (x * y), lambda x, y: jnp.sqrt(x) * jnp.sqrt(x) * y),
)
MOVING = (
    *(lambda x: x.reshape(2, 6), jnp.ravel, jnp.transpose, lambda x: x[:, None], lambda x: x[1], lambda x: x[1, 2], lambda x: x[-1, ::2]),
    *(
        lambda x: x[::-1],
        lambda x: x[i],
        lambda x: x[i, j],
        lambda x: x[:, j],
        lambda x: x[i][:, j],
        lambda x: jnp.take(x, 7),
        jnp.diagonal,
    ),
    *(
        lambda x: x.at[1].add(x[0]),
        lambda x: x.at[i, j].add(1.0),
        lambda x: x.at[np.array([2, 0, 1])].set(2 * x),
        lambda x: x.at[:, 1].multiply(x[:, 0]),
    ),
    *(lambda x: x.at[0, 1].set(5.0), lambda x: x.at[7].set(0.0, mode="drop"), lambda x: x.at[np.array([0, 9])].get(mode="clip")),
    *(lambda x: jnp.concatenate([x, jnp.zeros((1, 4)), 2 * x]), lambda x: jnp.stack([x, -x], 1), jnp.vstack, jnp.flip, jnp.rot90),
    *(lambda x: jnp.pad(x, ((1, 2), (0, 1)), constant_values=3.0), lambda x: lax.pad(x, 0.0, ((-1, 1, 0), (2, -1, 2))), jnp.tril),
    *(lambda x: jnp.roll(x, 1, 0), lambda x: jnp.repeat(x, 2, 1), lambda x: jnp.tile(x, (2, 1)), lambda x: jnp.split(x, 2, 1), jnp.unstack),
    *(
        lambda x: jnp.broadcast_to(x, (2, 3, 4)),
        lambda x: jnp.squeeze(x[:1]),
        lambda x: lax.dynamic_slice(x, (1, 5), (2, 2)),
        jnp.atleast_3d,
    ),
    *(lambda x: lax.dynamic_update_slice(x, 2 * x[:2, :2], (0, 1)), lambda x: x + jnp.arange(4.0)[None] + lax.iota(float, 3)[:, None]),
    *(lambda x: jax.vmap(lambda r, k: r[k])(x, i), lambda x: jax.vmap(lambda r, k: r.at[k].add(1.0))(x, i), lambda x: x[0:0], jnp.fliplr),
)
REDUCING = (
    *(
        jnp.sum,
        jnp.prod,
        jnp.max,
        jnp.min,
        lambda x: jnp.sum(x, 0),
        lambda x: jnp.sum(x[:, :0], 1),
        lambda x: jnp.prod(x, (0, 1)),
        jnp.mean,
    ),
    *(
        lambda x: jnp.all(x > 0.3),
        lambda x: jnp.any(x > 0.3, 1),
        lambda x: jnp.cumsum(x, 0),
        lambda x: jnp.cumprod(x, 1),
        jnp.trace,
        jnp.var,
    ),
    *(lambda x: lax.cummax(x, 1), lambda x: lax.cummin(x, 0), lambda x: lax.cumsum(x, 1, reverse=True), lambda x: x @ x.T, lambda x: x @ v),
    *(lambda x: jnp.einsum("ij,kj->ikj", x, x), lambda x: jnp.einsum("bij,bjk->bik", x[None], x.T[None]), lambda x: jnp.tensordot(x, x)),
    *(lambda x: x[:, :0] @ x[:, :0].T, lambda x: jnp.outer(x, x), lambda x: jnp.cross(x[0, :3], x[1, :3]), lambda x: jnp.diff(x, axis=1)),
)
CALLING = (
    *(jax.jit(lambda x: jax.jit(jnp.sin)(x) + 1), jax.checkpoint(jnp.tanh), jax.nn.relu, jax.nn.softplus, jax.nn.silu, jnp.linalg.norm),
    *(lambda x: jnp.linalg.norm(x, axis=1), jax.scipy.special.logsumexp, lambda x: jnp.interp(0.4, jnp.arange(4.0), x[0]), jnp.sinc),
    *(lambda x: lax.scan(lambda c, r: (c + r, c * r), x[0], x), lambda x: lax.scan(lambda c, r: (c + r, c), x[0], x, reverse=True)),
    *(
        lambda x: lax.fori_loop(0, 3, lambda k, y: y + x[k], v),
        lambda x: lax.map(jnp.sum, x),
        lambda x: lax.cond(True, jnp.sin, jnp.cos, x),
    ),
    *(lambda x: lax.while_loop(lambda s: s[0] < 3, lambda s: (s[0] + 1, s[1] * 2), (0, x)), lambda x: lax.switch(2, [jnp.sin] * 2, x)),
    *(
        lambda x: {"a": (x, jnp.float64(1.0)), "b": jnp.zeros(3)},
        lambda x: jnp.polyval(jnp.array([1.0, 2.0, 3.0]), x),
        lambda x: jnp.ones(2),
    ),
)
SOLVING = (
    *(jnp.linalg.cholesky, lambda a: lax.linalg.cholesky(jnp.stack([a, 2 * a]), symmetrize_input=False), jnp.linalg.inv, jnp.linalg.det),
    *(
        lambda a: jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(a), a[0]),
        lambda a: jnp.linalg.solve(a, a[:, 1]),
        jnp.linalg.eigvalsh,
    ),
    *(lambda a: jax.scipy.linalg.solve_triangular(a, a[:2].T, lower=True), lambda a: jax.scipy.linalg.solve_triangular(a, a[0], trans=1)),
    *(lambda a: lax.linalg.triangular_solve(a, a[:2], left_side=False, lower=True, transpose_a=True, unit_diagonal=True), jnp.linalg.pinv),
    *(lambda a: lax.linalg.triangular_solve(a, a[:2], left_side=False, lower=False), jax.scipy.linalg.expm, jnp.linalg.eigh),
    *(lambda a: jax.scipy.linalg.solve(a, a[0], assume_a="pos"), lambda a: jnp.linalg.solve(jnp.eye(3) + 0 * a, a), jnp.linalg.slogdet),
)


class Scalars(Algebra):
    """NumPy scalars, which cost no compilation: what is tested is the rules."""

    def function(self, primitive, params, dtype):
        if primitive.name == "convert_element_type":
            return lambda x: np.asarray(np.asarray(x).astype(dtype))
        return lambda *numbers: np.asarray(folded(primitive, params, dtype, *numbers))


def taken_apart(function, *arguments):
    """The values of a function whose arguments are unknown to the interpreter."""
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
    unknown = [filled(np.shape(a), map(np.asarray, np.ravel(a))) for a in arguments]
    outputs = evaluate(closed, Scalars(), *unknown)
    arrays = [np.array(array.tolist(), aval.dtype).reshape(aval.shape) for array, aval in zip(outputs, closed.out_avals, strict=True)]
    return jax.tree.unflatten(jax.tree.structure(shape), arrays)


@pytest.mark.parametrize("function", [*UNARY, *MOVING, *REDUCING, *CALLING])
def test_a_function_of_an_array_is_taken_apart(function):
    close(taken_apart(function, x), jax.tree.map(np.asarray, function(x)))


@pytest.mark.parametrize("function", BINARY)
def test_a_function_of_two_arrays_is_taken_apart(function):
    close(taken_apart(function, x, y), np.asarray(function(x, y)))
    close(taken_apart(lambda x: function(x, y), x), np.asarray(function(x, y)))


@pytest.mark.parametrize("functions", [UNARY, MOVING, REDUCING, CALLING], ids=["unary", "moving", "reducing", "calling"])
def test_functions_of_an_array(functions):
    every = lambda x: [function(x) for function in functions]  # one program: compilation is what takes time
    part = x[:1] if functions is UNARY else x
    close(scalarised(every, limit=100_000)(part), every(part))


def test_functions_of_two_arrays():
    every = lambda x, y: [function(x, y) for function in BINARY]
    close(scalarised(every, limit=100_000)(x[:1], y[:1]), every(x[:1], y[:1]))


@pytest.mark.slow
def test_linear_algebra():
    every = lambda a: [function(a) for function in SOLVING]
    close(scalarised(every, limit=100_000)(spd), every(spd), 1e-11)


@pytest.mark.parametrize("function", [*UNARY, *MOVING, *REDUCING, *CALLING])
def test_numbers_are_folded_as_jax_computes_them(function):
    closed, shape = jax.make_jaxpr(function, return_shape=True)(x)
    folded = evaluate(closed, JAX_ALGEBRA, np.asarray(x))
    assert all(array.dtype != object for array in folded)
    close(jax.tree.unflatten(jax.tree.structure(shape), folded), jax.tree.map(np.asarray, function(x)))


@pytest.mark.fast
@pytest.mark.parametrize(
    "function", [jnp.add, jnp.subtract, jnp.multiply, lax.div, lax.rem, jnp.maximum, lambda k, n: k**3 - n, operator.and_]
)
def test_whole_numbers(function):
    k, n = np.array([7, -7, 5]), np.array([2, 2, -3])
    want = np.asarray(function(jnp.asarray(k), jnp.asarray(n)))
    close(scalarised(function)(k, n), want)
    close(evaluate(jax.make_jaxpr(function)(k, n), JAX_ALGEBRA, k, n)[0], want)


def test_infinities_among_numbers_give_no_warning():
    f = lambda x: jax.jit(lambda y: x + jnp.where(x > 0, 1 / y[0], (y[1] - y[1]) / 0 * y[1]))(jnp.array([0.0, jnp.inf]))
    closed = jax.make_jaxpr(lambda y: jax.jit(lambda y: 1 / y * y - jnp.log(y))(y))(jnp.zeros(2))
    close(evaluate(closed, JAX_ALGEBRA, np.array([0.0, np.inf]))[0], np.array([np.nan, np.nan]))
    close(scalarised(f)(x), f(x))


@pytest.mark.fast
def test_single_precision_stays_single():
    f = lambda x: jnp.linalg.norm(0.5 * x**2 + jnp.arange(4, dtype=jnp.float32)[None]) / 3
    close(scalarised(f)(x.astype(np.float32)), f(jnp.asarray(x, jnp.float32)), 1e-6)


# Derivatives.


def held_factor(x):
    """A solve with a constant factor: without the rule of `custom_linear_solve` its derivative would be wrong."""
    A = x @ x.T + jnp.eye(len(x))
    factor = jnp.linalg.cholesky(lax.stop_gradient(A))
    solve = lambda _, b: jax.scipy.linalg.cho_solve((factor, True), b)
    return lax.custom_linear_solve(lambda y: A @ y, x[:, :2], solve, symmetric=True)


DIFFERENTIATED = {
    "elementary": lambda x: jnp.sin(x @ x.T) * jnp.exp(x[0, 0]) - jnp.sum(x**3),
    "own rule": lambda x: doubled_slope(x) @ doubled_slope(x[0]),
    "held factor": held_factor,
    "held": lambda x: x * lax.stop_gradient(x),
    "solve": lambda x: jnp.linalg.solve(x[:, :2] + 2 * jnp.eye(2), x[:, 2]),
    "Cholesky": lambda x: jnp.linalg.cholesky(x @ x.T + jnp.eye(len(x))),
    "eigenvalues": lambda x: jnp.linalg.eigvalsh(x @ x.T),
    "branches": lambda x: jnp.where(x > 0.5, x**2, jnp.abs(x - 0.5) ** 3),
    "loop of unknown length": lambda x: lax.while_loop(lambda s: s[0, 0] < 5, lambda s: s * (1 + x), x),
}


@pytest.mark.parametrize("name", DIFFERENTIATED)
def test_derivatives_and_batches_are_the_plain_ones(name):
    plain, z = DIFFERENTIATED[name], x[:2, :3]
    many = jnp.asarray(np.random.default_rng(2).uniform(0.2, 0.8, (5, *z.shape)))
    value = lambda f: lambda x: jnp.sum(jnp.cos(f(x)))
    transforms = [lambda f: lambda _: jax.vmap(jax.jacfwd(f), out_axes=-1)(many), lambda f: jax.jacfwd(jax.jacfwd(value(f)))]
    if name != "loop of unknown length":
        transforms[1] = lambda f: jax.jacfwd(jax.grad(value(f)))
    if "rule" in name:
        transforms += [lambda f: jax.jacfwd(jax.jacfwd(value(f))), lambda f: jax.jacrev(jax.grad(value(f)))]
    every = lambda f: jax.jit(lambda x: [transform(f)(x) for transform in transforms])
    close(every(scalarised(plain))(z), every(plain)(z), 1e-10)


def test_a_reverse_rule_is_kept():
    slope = lambda f: jax.grad(lambda x: jnp.sum(f(x)))(v)
    close(slope(scalarised(lambda x: tripled_slope(x) * x)), slope(lambda x: tripled_slope(x) * x))


def test_what_the_function_closes_over_may_be_traced():
    f = lambda a, x: scalarised(lambda x: a * jnp.sin(a[0] * x))(x)
    close(jax.jit(jax.jacfwd(f))(v, x[1]), jax.jacfwd(lambda a, x: a * jnp.sin(a[0] * x))(v, x[1]))


# Mechanics.


def chain(q, qdot):
    vx, vy = jnp.cumsum(jnp.cos(q) * qdot), jnp.cumsum(jnp.sin(q) * qdot)
    return 0.5 * (vx @ vx + vy @ vy) + 9.81 * jnp.sum(jnp.cumsum(jnp.cos(q)))


SYSTEMS = {
    "vehicle": (vehicle.system, vehicle.q0, vehicle.params),
    "polar pendulum": (pendulum.polar, {"r": 1.0, "phi": 0.3}, pendulum.params),
    "Cartesian pendulum": (pendulum.cartesian, {"x": 0.3, "y": -0.8}, pendulum.params),
    "3 links": (jl.System(chain), np.zeros(3), {}),
    "two rods": (
        jl.System(
            lambda q, qdot: 0.5 * jnp.sum(qdot**2) - 9.81 * jnp.sum(q[:, 1]),
            holonomic=lambda q: jnp.array([q[0] @ q[0], (q[1] - q[0]) @ (q[1] - q[0])]) - 1,
        ),
        np.array([[0.6, 0.8], [1.2, 1.6]]),
        {},
    ),
}


@pytest.fixture(params=list(SYSTEMS))
def mechanics(request):
    system, q0, params = SYSTEMS[request.param]
    like, params = jax.tree.map(jnp.asarray, (q0, params))
    flat, _ = jax.flatten_util.ravel_pytree(like)
    rng = np.random.default_rng(4)
    state = jnp.asarray(0.3), flat + rng.normal(size=flat.shape) / 10, jnp.asarray(rng.normal(size=flat.shape))
    return lambda t, q, v, params: constrained_acceleration(bind(system, like, params), t, q, v)[:2], (*state, params)


def test_accelerations_and_multipliers_with_derivatives(mechanics):
    plain, (t, q, v, params) = mechanics
    slope = lambda f: jax.jacfwd(lambda q, v, params: f(t, q, v, params)[0], (0, 1, 2) if params else (0, 1))
    every = lambda f: jax.jit(lambda q, v, params: (f(t, q, v, params), slope(f)(q, v, params)))
    close(every(scalarised(plain))(q, v, params), every(plain)(q, v, params), 1e-10)


# What is folded, and what is left.


def test_structural_zeros_are_dropped():
    diagonal = lambda q: jnp.linalg.cholesky(jnp.diag(jnp.exp(q))) @ q
    names = operations(scalarised(diagonal), v)
    assert {name: names.count(name) for name in ("exp", "sqrt", "mul", "add", "div")} == {"exp": 4, "sqrt": 4, "mul": 4, "add": 0, "div": 0}


@pytest.mark.fast
@pytest.mark.skipif(jax.default_backend() != "cpu", reason="counts what is compiled for a CPU")
def test_the_mass_matrix_of_the_vehicle_is_seen_to_be_diagonal():
    system, q0, params = SYSTEMS["vehicle"]
    like, params = jax.tree.map(jnp.asarray, (q0, params))
    acceleration = lambda q, v, p: constrained_acceleration(bind(system, like, p), jnp.zeros(()), q, v).x
    names = compiled_operations(scalarised(acceleration), v[:3], v[:3], params)
    assert sum(map(names.count, ("divide", "rsqrt"))) <= 5 and len(names) < 120  # one for each coordinate, M₀/r and Θ_r/r²
    assert "custom-call" not in names and "custom-call" in compiled_operations(acceleration, v[:3], v[:3], params)  # of LAPACK


def test_zeros_pass_through_a_solve():
    solve = lambda a: jax.scipy.linalg.solve(jnp.diag(a), jnp.array([1.0, 0.0, 0.0, 2.0]), assume_a="pos")
    names = compiled_operations(scalarised(lambda a: jnp.sum(held_diagonal(a) ** 3)), v)
    assert 1 <= sum(map(names.count, ("divide", "rsqrt"))) <= 2
    close(jax.jacfwd(scalarised(held_diagonal))(v), jax.jacfwd(solve)(v))


def held_diagonal(a):
    factor = jnp.sqrt(lax.stop_gradient(a))
    solve = lambda _, b: jax.scipy.linalg.cho_solve((jnp.diag(factor), True), b)
    return lax.custom_linear_solve(lambda y: a * y, jnp.array([1.0, 0.0, 0.0, 2.0]), solve, symmetric=True)


def test_the_same_operation_is_made_once():
    names = operations(scalarised(lambda x: jnp.cos(x[0] - x[1]) * jnp.cos(x[1] - x[0]) + (jnp.sin(x[0] - x[1]) + jnp.sin(x[1] - x[0]))), v)
    assert {name: names.count(name) for name in ("sub", "cos", "sin")} == {"sub": 1, "cos": 1, "sin": 0}


def test_numbers_are_computed_without_being_compiled(monkeypatch):
    """Also those of a function with a derivative rule of its own, which numbers do not need."""
    cube = jax.custom_jvp(lambda x: x**3)
    cube.defjvp(lambda primals, tangents: (cube(*primals), 3 * primals[0] ** 2 * tangents[0]))
    scaled = lambda x: lax.optimization_barrier(x) * jnp.sqrt(cube(jnp.arange(1.0, 5.0)))
    with monkeypatch.context() as patched:
        patched.setattr(constants, "as_function", None)
        names = operations(scalarised(scaled), v)
    assert {name: names.count(name) for name in ("mul", "sqrt", "integer_pow")} == {"mul": 3, "sqrt": 0, "integer_pow": 0}
    close(scalarised(scaled)(v), scaled(v))


@pytest.mark.parametrize("mechanics", ["vehicle", "polar pendulum", "Cartesian pendulum", "3 links"], indirect=True)
def test_the_acceleration_is_scalar_code_throughout(mechanics):
    function, state = mechanics
    assert on_scalars(function, *state)


def test_a_batch_of_accelerations_is_one_kernel():
    """It includes the check for missing inertia, which would otherwise split it and take twice the time."""
    double = jl.System(
        lambda q, qdot: 0.5 * jnp.sum(jnp.cumsum(jnp.cos(q) * qdot) ** 2 + jnp.cumsum(jnp.sin(q) * qdot) ** 2) + jnp.sum(jnp.cos(q))
    )
    batch = jnp.linspace(0.1, 1.0, 2 * 64).reshape(64, 2)
    program = jax.jit(jax.vmap(lambda q, v: jl.acceleration(double, q, v).qddot)).lower(batch, batch).compile().as_text()
    main = program[program.index("ENTRY") :]
    assert main.count(" fusion(") == 1 and "custom-call" not in main


def test_above_the_limit_the_function_stays_as_it_is():
    f = lambda x: jnp.sin(x) @ x.T
    assert "dot_general" in operations(scalarised(f, limit=20), x)
    assert "dot_general" not in operations(scalarised(f), x)
    close(scalarised(f, limit=20)(x), f(x))
    with pytest.raises(TooLong):
        evaluate(jax.make_jaxpr(f)(x), JAX_ALGEBRA, *[_scalars(jnp.asarray(x))], limit=20)


def test_effects_and_keys_stay_as_they_are(capfd):
    def told(x):
        jax.debug.print("x = {}", x[0, 0])
        return x + jax.random.normal(jax.random.key(0), x.shape)

    close(scalarised(told)(x), x + jax.random.normal(jax.random.key(0), x.shape))
    assert "x = " in capfd.readouterr().out
    draw = lambda key: jax.random.normal(key, (2,))
    close(scalarised(draw)(jax.random.key(1)), draw(jax.random.key(1)))


def test_an_unknown_primitive_is_named_with_its_line():
    def energy(x):
        return jnp.sum(jnp.linalg.eigvalsh(x))  # the line in question

    line = energy.__code__.co_firstlineno + 1
    message = rf"must use known operations only, but uses `eigh` at .*test_interpreter\.py:{line}\b.*Write it in elementary"
    with pytest.raises(UnknownPrimitive, match=re.compile(message)):
        taken_apart(energy, spd)
