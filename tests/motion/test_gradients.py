"""Gradients of whole motions, with default settings, against finite differences and closed forms."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.special import ellipj

import jaxlag as jl
from jaxlag._motion import derivative_rule, solution_map
from jaxlag._motion.variational import jvp_along
from jaxlag.examples import pendulum, vehicle

TS = jnp.linspace(0, 2, 41)


def vehicle_outcome(inputs, **numerics):
    """A few numbers of the motion that depend on everything."""
    q0, qdot0, params = inputs
    motion = jl.simulate(vehicle.system, q0, qdot0, TS, params, **numerics)
    weights = jnp.cos(3 * TS)
    return jnp.stack([weights @ motion.q[name] for name in ("x", "y", "phi")] + [weights @ motion.qddot["x"]])


def differences(f, x, h):
    """Central differences of fourth order, column by column."""
    columns = []
    for i in range(x.size):
        e = jnp.zeros_like(x).at[i].set(h[i])
        columns.append((8 * (f(x + e) - f(x - e)) - f(x + 2 * e) + f(x - 2 * e)) / (12 * h[i]))
    return jnp.stack(columns, axis=-1)


@pytest.mark.parametrize("number", [1, 2])
def test_derivatives_along_directions(number):
    """Of sin(x₀) x₁, with x as something else; along one direction without the operations of a batch."""
    function = lambda x: (jnp.sin(x[0]) * x[1], x)
    x, directions = jnp.array([0.3, 0.7]), jnp.array([[1.0, -2.0], [4.0, 3.0]])[:, :number]
    y, dy, aux = jvp_along(function, x, directions)
    np.testing.assert_allclose(y, np.sin(0.3) * 0.7, rtol=1e-15)
    np.testing.assert_allclose(dy, np.array([np.cos(0.3) * 0.7, np.sin(0.3)]) @ directions, rtol=1e-15)
    assert np.array_equal(aux, x)
    products = [e for e in jax.make_jaxpr(lambda dx: jvp_along(function, x, dx))(directions).eqns if e.primitive.name == "mul"]
    assert {e.outvars[0].aval.shape for e in products} == ({()} if number == 1 else {(), (number,)})


@pytest.mark.slow
def test_vehicle_with_respect_to_every_parameter_and_initial_value():
    inputs = (vehicle.q0, vehicle.qdot0, vehicle.params)
    x, unravel = ravel_pytree(jax.tree.map(jnp.asarray, inputs))
    default = lambda x: vehicle_outcome(unravel(x))
    sharp = jax.jit(lambda x: vehicle_outcome(unravel(x), solver=diffrax.Dopri8(), rtol=1e-12, atol=1e-13))
    scale = jnp.maximum(jnp.abs(x), 0.1)
    expected = differences(sharp, x, 2e-3 * scale) * scale[None]
    size = np.max(np.abs(expected), axis=1, keepdims=True)
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(default)(x) * scale[None] / size, expected / size, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("solver", "coordinates"), [(diffrax.Tsit5(), "polar"), (jl.Dop853(), "cartesian")])
def test_variational_equations_give_what_the_integrator_would_differentiated(monkeypatch, solver, coordinates):
    """A scheme for ẏ = f, differentiated, is that scheme for δẏ = ∂f δy, with the same steps: equal to rounding."""
    system, state = (getattr(pendulum, f"{coordinates}{part}") for part in ("", "_state"))

    def motion(x):
        return ravel_pytree(jl.simulate(system, *state(x[0], 0.5, x[2]), TS, {"m": 1.0, "g": x[1], "l": x[2]}, solver=solver).q)[0]

    x = jnp.array([0.6, 9.81, 1.0])
    varied = jax.jacfwd(motion)(x)
    monkeypatch.setattr(solution_map, "is_variational", lambda *_: False)
    jax.clear_caches()
    np.testing.assert_allclose(varied, jax.jacfwd(motion)(x), rtol=1e-10, atol=1e-10)


@pytest.mark.slow
def test_second_variations_give_what_the_integrator_would_differentiated_twice(monkeypatch):
    """Of multipliers, accelerations and states, by the start, parameters and both; with the same steps, equal to rounding."""

    def motion(x):
        found = jl.simulate(pendulum.cartesian, *pendulum.cartesian_state(x[0], 0.5, x[1]), TS[:9], {"m": 1.0, "g": x[2], "l": x[1]})
        return ravel_pytree((found.q, found.qddot, found.multipliers))[0]

    x = jnp.array([0.6, 1.0, 9.81])
    varied = jax.hessian(motion)(x)
    np.testing.assert_allclose(varied, varied.swapaxes(1, 2), rtol=1e-9, atol=1e-8)
    monkeypatch.setattr(solution_map, "is_variational", lambda *_: False)
    jax.clear_caches()
    np.testing.assert_allclose(varied, jax.hessian(motion)(x), rtol=1e-9, atol=1e-8)


@pytest.mark.slow
def test_vehicle_gradient_in_closed_form():
    """Heave without drag is a linear oscillator: y(t) = l − Mg/2c + A(t)(y₀ − l + Mg/2c), so dy(t)/dM₀ = 0 and dy(t)/dy₀ = A(t)."""
    p = vehicle.params
    delta, w0 = p["b"] / p["M"], np.sqrt(2 * p["c"] / p["M"])
    w = np.sqrt(w0**2 - delta**2)
    A = np.exp(-delta * 2.0) * (np.cos(w * 2.0) + delta / w * np.sin(w * 2.0))
    last = lambda y0, M0: jl.simulate(vehicle.system, {**vehicle.q0, "y": y0}, vehicle.qdot0, TS, {**p, "M0": M0}).q["y"][-1]
    slopes = jax.grad(last, (0, 1))(0.55, 300.0)
    np.testing.assert_allclose(slopes, [A, 0.0], atol=1e-8)


ROD = jl.System(lambda q, qdot, m, g: 0.5 * m * qdot @ qdot - m * g * q[1], holonomic={"rod": lambda q, l: q @ q - l**2})


def cartesian_end(l):
    """x(5 s) of the Cartesian pendulum from a start that does not move with l: the projection has to carry the derivative."""
    start = jnp.array([1.0, 0.0]), jnp.zeros(2)
    return jl.simulate(ROD, *start, jnp.linspace(0, 5, 11), {"m": 1.0, "g": 9.81, "l": l}, rtol=1e-10, atol=1e-12).q[-1, 0]


@pytest.mark.slow
def test_rod_length_that_stands_in_a_constraint_alone():
    """dx(5 s)/dl against the angle form, where l is a plain parameter, in closed form with elliptic functions, and differences."""

    def exact(l):
        sn, cn, dn, _ = ellipj(np.sqrt(9.81 / l) * 5, 0.5)
        return l * np.sin(2 * np.arcsin(np.sqrt(0.5) * cn / dn))

    h = 1e-4
    expected = (8 * (exact(1 + h) - exact(1 - h)) - exact(1 + 2 * h) + exact(1 - 2 * h)) / (12 * h)
    by_differences = (8 * (cartesian_end(1 + h) - cartesian_end(1 - h)) - cartesian_end(1 + 2 * h) + cartesian_end(1 - 2 * h)) / (12 * h)
    np.testing.assert_allclose(by_differences, expected, rtol=1e-5)
    for derivative in (jax.grad, jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(cartesian_end)(1.0), expected, rtol=1e-6)
    np.testing.assert_allclose(jax.jvp(cartesian_end, (1.0,), (2.0,))[1], 2 * expected, rtol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.grad(cartesian_end))(1.0), expected, rtol=1e-6)


OSCILLATOR = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)


def oscillator_end(x0, v0, c, end):
    return jl.simulate(OSCILLATOR, x0, v0, jnp.stack([0.0 * end, end / 2, end]), {"c": c}, rtol=1e-10, atol=1e-12).q[-1]


def oscillator_exact(x0, v0, c, end):
    w = jnp.sqrt(c)
    return x0 * jnp.cos(w * end) + v0 / w * jnp.sin(w * end)


AT = (1.2, 0.4, 5.0, 2.5)


@pytest.mark.slow
@pytest.mark.parametrize(
    "derivative", [jax.hessian, lambda f, a: jax.jacrev(jax.jacrev(f, a), a), lambda f, a: jax.jacfwd(jax.jacfwd(f, a), a)]
)
def test_second_derivatives_of_every_mode(derivative):
    """All of start, parameter and final time against the closed form."""
    every = (0, 1, 2, 3)
    np.testing.assert_allclose(derivative(oscillator_end, every)(*AT), derivative(oscillator_exact, every)(*AT), rtol=1e-6, atol=1e-7)


@pytest.mark.slow
def test_third_derivative():
    third = lambda f: jax.grad(jax.grad(jax.grad(lambda c: f(1.2, 0.4, c, 2.5))))(5.0)
    np.testing.assert_allclose(third(oscillator_end), third(oscillator_exact), rtol=1e-5)


def test_sample_times_and_start_time():
    """A shift of all times changes nothing in a system without time; one sample time moves its own sample by q̇."""
    system = jl.System(lambda q, qdot: 0.5 * qdot**2 - 2 * q**2)
    ts = jnp.array([0.3, 0.9, 1.7])
    q = lambda ts: jl.simulate(system, 1.0, 0.5, ts, rtol=1e-10, atol=1e-12).q
    motion = jl.simulate(system, 1.0, 0.5, ts, rtol=1e-10, atol=1e-12)
    for derivative in (jax.jacfwd, jax.jacrev):
        J = derivative(q)(ts)
        np.testing.assert_allclose(J.sum(axis=1), 0, atol=1e-7)
        np.testing.assert_allclose(J[1:, 1:], np.diag(motion.qdot[1:]), atol=1e-7)


def test_vmap_of_gradients_and_gradients_of_vmap():
    ends = lambda c: oscillator_end(1.0, 0.0, c, 2.0)
    c = jnp.array([3.0, 4.0, 5.0])
    expected = jax.vmap(jax.grad(lambda c: oscillator_exact(1.0, 0.0, c, 2.0)))(c)
    np.testing.assert_allclose(jax.vmap(jax.grad(ends))(c), expected, rtol=1e-7)
    np.testing.assert_allclose(jax.grad(lambda c: jnp.sum(jax.vmap(ends)(c)))(c), expected, rtol=1e-7)
    np.testing.assert_allclose(jax.vmap(jax.jacfwd(ends))(c), expected, rtol=1e-7)


@pytest.mark.slow
def test_many_parameters_take_the_other_road(monkeypatch):
    """With more inputs than the limit a cotangent is pulled back alone; value and both modes stay the same."""
    outcome = lambda x: oscillator_end(x[0], x[1], x[2], 2.5)
    x = jnp.array([1.2, 0.4, 5.0])
    expected = jax.jacfwd(lambda x: oscillator_exact(x[0], x[1], x[2], 2.5))(x)
    monkeypatch.setattr(derivative_rule, "FORWARD_LIMIT", 0)
    jax.clear_caches()
    try:
        for derivative in (jax.jacfwd, jax.jacrev, jax.grad):
            np.testing.assert_allclose(derivative(outcome)(x), expected, rtol=1e-7)
        np.testing.assert_allclose(jax.vmap(jax.grad(outcome))(x[None])[0], expected, rtol=1e-7)
        for second in (lambda f: jax.jacfwd(jax.jacfwd(f)), lambda f: jax.jacrev(jax.jacrev(f))):
            with pytest.raises(RuntimeError, match="second derivatives of a motion must be with respect to at most"):
                second(outcome)(x)
    finally:
        monkeypatch.undo()
        jax.clear_caches()


@pytest.mark.slow
def test_gradients_in_many_numbers_are_compiled_once(lowered):
    """Those of the stiffnesses of a hundred springs side by side, called from Python, forward and in reverse."""
    springs = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * jnp.sum(c) * q**2)
    end = lambda c: jl.simulate(springs, 1.0, 0.0, [0.0, 2.0], {"c": c}, rtol=1e-10, atol=1e-12).q[-1]
    forward = lambda c: jax.jvp(end, (c,), (jnp.ones_like(c),))[1]
    c, others = jnp.linspace(0.02, 0.06, 100), jnp.linspace(0.03, 0.04, 100)
    jax.block_until_ready((jax.grad(end)(c), forward(c)))
    lowered.clear()
    gradient, along = jax.grad(end)(others), forward(others)
    assert not lowered
    expected = jax.grad(lambda c: oscillator_exact(1.0, 0.0, c, 2.0))(3.5)
    np.testing.assert_allclose(gradient, np.full(100, expected), rtol=1e-7)
    np.testing.assert_allclose(along, 100 * expected, rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [diffrax.ReversibleHeun(), diffrax.Kvaerno3()], ids=["ReversibleHeun", "Kvaerno3"])
def test_what_a_solver_keeps_from_the_start_is_differentiated(solver):
    """Rates at the start, or none of them."""
    system = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    end = lambda x: jl.simulate(system, x[0], 0.0, [0.0, 2.0], {"c": x[1]}, solver=solver, rtol=1e-6, atol=1e-8).q[-1]
    exact = jax.grad(lambda x: x[0] * jnp.cos(2 * jnp.sqrt(x[1])))(jnp.array([1.0, 4.0]))
    np.testing.assert_allclose(jax.jacfwd(end)(jnp.array([1.0, 4.0])), exact, atol=3e-6)


@pytest.mark.slow
@pytest.mark.parametrize("adjoint, derivative", [(diffrax.RecursiveCheckpointAdjoint(), jax.grad), (diffrax.ForwardMode(), jax.jacfwd)])
def test_an_adjoint_of_diffrax_can_be_asked_for(adjoint, derivative):
    ts, p = jnp.linspace(0, 1, 5), pendulum.params
    end = lambda l, **how: jl.simulate(pendulum.cartesian, {"x": 1.0, "y": 0.0}, {"x": 0.0, "y": 0.0}, ts, {**p, "l": l}, **how).q["x"][-1]
    np.testing.assert_allclose(derivative(lambda l: end(l, adjoint=adjoint))(1.0), jax.grad(end)(1.0), rtol=1e-9)


STEPS_END = {
    "an event": (jl.System(lambda q, qdot: 0.5 * qdot**2 - 2 * q**2, events={"top": jl.Event(lambda qdot: qdot)}), {}),
    "a signal": (jl.System(lambda qdot: 0.5 * qdot**2, force=lambda t, u: u(t)), {"u": jl.Signal(jnp.arange(3.0), jnp.arange(3.0))}),
}


@pytest.mark.parametrize("name", STEPS_END)
@pytest.mark.parametrize(
    "adjoint", [diffrax.DirectAdjoint(), diffrax.RecursiveCheckpointAdjoint(checkpoints=5)], ids=["direct", "checkpoints"]
)
def test_an_adjoint_that_cannot_be_heeded_is_refused(name, adjoint):
    system, params = STEPS_END[name]
    with pytest.raises(
        ValueError, match=r"`adjoint` must be `diffrax.ForwardMode\(\)` or .* where steps end at contacts, events, .* Leave it out"
    ):
        jl.simulate(system, 1.0, 0.0, [0.0, 1.0], params, adjoint=adjoint)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [lambda q: 2.0, lambda q: 2 + jnp.cos(q["x"])], ids=["the same", "by another equation"])
def test_redundant_constraints_have_the_gradients_of_single_ones(factor):
    rod = pendulum.cartesian_rod
    twice = jl.System(pendulum.cartesian_lagrangian, holonomic={"rod": rod, "again": lambda q, l: factor(q) * rod(q, l)})
    ts, p = jnp.linspace(0, 2, 5), pendulum.params

    def end(system, l):
        motion = jl.simulate(system, {"x": 1.0, "y": 0.0}, {"x": 0.0, "y": 0.0}, ts, {**p, "l": l}, rtol=1e-10, atol=1e-12)
        return motion.q["x"][-1]

    np.testing.assert_allclose(end(twice, 1.0), end(pendulum.cartesian, 1.0), rtol=1e-10)
    for derivative in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(derivative(end, 1)(twice, 1.0), derivative(end, 1)(pendulum.cartesian, 1.0), rtol=1e-8)


@pytest.mark.slow
def test_nonholonomic_gradients():
    edge = lambda q, qdot: qdot[0] * jnp.sin(q[2]) - qdot[1] * jnp.cos(q[2])
    system = jl.System(
        lambda q, qdot, m, J, g: 0.5 * m * (qdot[0] ** 2 + qdot[1] ** 2) + 0.5 * J * qdot[2] ** 2 + m * g * q[0], nonholonomic=edge
    )

    def end(x):
        motion = jl.simulate(system, jnp.zeros(3), jnp.array([0, 0, 1.0]) * x[0], jnp.linspace(0, 2, 3), {"m": x[1], "J": 0.2, "g": x[2]})
        return motion.q[-1, :2]

    exact = lambda x: jnp.stack(
        [x[2] / (2 * x[0] ** 2) * jnp.sin(2 * x[0]) ** 2, x[2] / (2 * x[0] ** 2) * (2 * x[0] - jnp.sin(4 * x[0]) / 2)]
    )
    x = jnp.array([1.3, 2.0, 5.0])
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(end)(x), derivative(exact)(x), atol=1e-6)
