"""Dissipation potentials: forces, derivatives at rest, Euler's identity, passivity, and motions against closed forms."""

import functools
import inspect
from collections.abc import Callable
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

import jaxlag as jl
from jaxlag import dissipation
from jaxlag.dissipation import drag, power_law, sliding, speed, stribeck, viscous

SHARP = {"solver": diffrax.Dopri8(), "rtol": 1e-11, "atol": 1e-12}
FUNCTIONS = (speed, sliding, viscous, drag, power_law, stribeck)
STRIBECK = (2.0, 3.0, 0.4)  # F_c, F_s, v_s


class Case(NamedTuple):
    D: Callable  # D(v, *parameters)
    parameters: tuple
    F: Callable  # size of the force at the speed s, by hand
    slope: Callable  # dF/ds by hand
    degree: float | None  # of homogeneity
    stiffness: float = 0.0  # the Hessian at rest is this times the identity; of a vector at a kink it is 0


def power_case(n, **more):
    return Case(power_law, (1.3, float(n)), lambda s: 1.3 * s**n, lambda s: 1.3 * n * s ** (n - 1), n + 1, **more)


def stribeck_case(delta):
    F_c, F_s, v_s = STRIBECK
    fall = lambda s: (F_s - F_c) * np.exp(-((s / v_s) ** delta))
    slope = lambda s: -delta * s ** (delta - 1) / v_s**delta * fall(s)
    return Case(lambda v, *p: stribeck(v, *p, delta), STRIBECK, lambda s: F_c + fall(s), slope, None, stiffness=slope(0.0))


CASES = {
    "sliding": Case(sliding, (0.3, 10.0), lambda s: 3.0, lambda s: 0.0, 1),
    "viscous": Case(viscous, (2.5,), lambda s: 2.5 * s, lambda s: 2.5, 2, stiffness=2.5),
    "drag": Case(drag, (0.7,), lambda s: 0.7 * s**2, lambda s: 1.4 * s, 3),
    "power 0": power_case(0),
    "power 0.4": power_case(0.4),
    "power 1": power_case(1, stiffness=1.3),
    "power 1.7": power_case(1.7),
    "power 2": power_case(2),
    "power 3": power_case(3),
    "stribeck": stribeck_case(2),
    "stribeck, exponential": stribeck_case(1),
}
SCALARS = jnp.array([0.35, -1.2, 2.0, -0.01, 0.6, -0.2])
VECTORS = jnp.array([[0.2, -0.3, 0.1], [1.1, 0.0, -2.0], [0.0, 0.5, 0.0], [-0.01, 0.02, 0.03], [0.3, 0.3, 0.4], [-1.0, -0.1, 0.2]])

every_case = pytest.mark.parametrize("case", CASES.values(), ids=CASES)
scalars_and_vectors = pytest.mark.parametrize("v", [SCALARS, VECTORS], ids=["scalars", "vectors"])


class Derivatives(NamedTuple):
    value: jax.Array
    first: list  # forward and reverse, each by v and by every parameter
    hessians: list  # by v, in the four mixes of the modes
    mixed: tuple  # by all arguments, a matrix of blocks


def derivatives(case, v):
    """All of them, of a batch of velocities."""
    return _derivatives(case.D, len(case.parameters))(v, *case.parameters)


@functools.cache
def _derivatives(D, count):
    every, modes = tuple(range(1 + count)), (jax.jacfwd, jax.jacrev)

    def at(*arguments):
        first = [mode(D, every)(*arguments) for mode in modes]
        hessians = [outer(inner(D))(*arguments) for outer in modes for inner in modes]
        return Derivatives(D(*arguments), first, hessians, jax.jacfwd(jax.jacrev(D, every), every)(*arguments))

    return jax.jit(jax.vmap(at, in_axes=(0,) + count * (None,)))


def unit_and_speed(v):
    """Directions and speeds of a batch."""
    s = np.abs(v) if v.ndim == 1 else np.linalg.norm(v, axis=1)
    return np.asarray(v) / s.reshape(-1, *(1,) * (v.ndim - 1)), s


def along(hessian, dv):
    return hessian * dv if dv.ndim == 1 else np.einsum("bij,bj->bi", hessian, dv)


# Away from rest


@every_case
@scalars_and_vectors
def test_potential_is_the_integral_of_the_force(case, v):
    for D, s in zip(derivatives(case, v).value, unit_and_speed(v)[1], strict=True):
        work, error = quad(case.F, 0, s, epsabs=1e-13, epsrel=1e-13)
        np.testing.assert_allclose(D, work, rtol=0, atol=1e-12 + error)


@every_case
@scalars_and_vectors
def test_force_and_its_slope_are_those_of_the_closed_form(case, v):
    """∂D/∂v = F e and ∂²D/∂v² = F' e eᵀ + (F/s)(1 − e eᵀ) with e = v/s, in both modes and their four mixes."""
    found = derivatives(case, v)
    for i, (e, s) in enumerate(zip(*unit_and_speed(v), strict=True)):
        for by_v, *_ in found.first:
            np.testing.assert_allclose(by_v[i], case.F(s) * e, rtol=1e-13, atol=1e-16)
        along = np.multiply.outer(e, e)
        across = (np.eye(e.size) - along) / s if e.ndim else 0.0
        for hessian in found.hessians:
            np.testing.assert_allclose(hessian[i], case.slope(s) * along + case.F(s) * across, rtol=1e-12, atol=1e-12)


@every_case
@scalars_and_vectors
def test_slope_of_the_force_against_finite_differences(case, v):
    h = 1e-6  # times the speed; error of the differences: h² of the third derivative, 1e-16/h of rounding
    e, s = unit_and_speed(v)
    dv = jnp.asarray(s * np.cos(1 + np.arange(v.size).reshape(v.shape[::-1]))).T
    force = lambda v: derivatives(case, v).first[1][0]
    differences = (force(v + h * dv) - force(v - h * dv)) / (2 * h)
    slope = along(derivatives(case, v).hessians[1], dv)
    np.testing.assert_allclose(slope, differences, rtol=1e-7, atol=1e-8)


@every_case
@scalars_and_vectors
def test_derivatives_with_respect_to_the_parameters(case, v):
    h, found = 1e-5, derivatives(case, v)
    for i, p in enumerate(case.parameters):
        D, force = ([getattr(derivatives(case._replace(parameters=(*case.parameters[:i], x, *case.parameters[i + 1 :])), v), what)
                     for x in (p + h, p - h)] for what in ("value", "first"))  # fmt: skip
        for first in found.first:
            np.testing.assert_allclose(first[1 + i], (D[0] - D[1]) / (2 * h), rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(found.mixed[0][1 + i], (force[0][1][0] - force[1][1][0]) / (2 * h), rtol=1e-7, atol=1e-8)
        np.testing.assert_allclose(found.mixed[1 + i][0], found.mixed[0][1 + i], rtol=1e-12, atol=1e-12)


@pytest.mark.fast
def test_power_law_takes_its_exponent_from_the_parameters():
    """∂D/∂n = c s^{n+1} (ln s − 1/(n+1)) / (n+1), also at n = 1, where the Hessian at rest is set apart."""
    s, c = 0.6, 1.3
    slope = jax.jit(jax.grad(power_law, argnums=2))
    for n in (0.0, 0.4, 1.0, 2.0):
        np.testing.assert_allclose(slope(-s, c, n), c * s ** (n + 1) * (np.log(s) - 1 / (n + 1)) / (n + 1), rtol=1e-13)
    np.testing.assert_allclose(power_law(-s, c, 2), drag(-s, c), rtol=1e-14)
    np.testing.assert_allclose(power_law(-s, c, 1), viscous(-s, c), rtol=1e-14)
    np.testing.assert_allclose(power_law(-s, c, 0), sliding(-s, c, 1.0), rtol=1e-14)


# At rest


@every_case
@scalars_and_vectors
def test_derivatives_at_rest_are_finite_and_right(case, v):
    """In both modes and their four mixes. At a kink the slope is that of `speed`: 0 of a vector, JAX's 1 of the `abs` of a scalar."""
    found = derivatives(case, 0 * v)
    kink, stiffness = (0.0, 0.0) if case.F(0.0) and v.ndim == 2 else (case.F(0.0), case.stiffness)
    assert (found.value == 0).all()
    for by_v, *by_parameters in found.first:
        np.testing.assert_array_equal(by_v, np.full(v.shape, kink))
        assert all((leaf == 0).all() for leaf in by_parameters)
    expected = np.broadcast_to(stiffness * np.eye(v[0].size).reshape(v[0].shape * 2), found.hessians[0].shape)
    for hessian in found.hessians:
        np.testing.assert_allclose(hessian, expected, rtol=1e-15)
    np.testing.assert_allclose(found.mixed[0][0], expected, rtol=1e-15)
    for leaf in (*found.mixed[0][1:], *jax.tree.leaves(found.mixed[1:])):
        assert np.isfinite(leaf).all() if kink else (leaf == 0).all()


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.degree and case.degree >= 2])
@scalars_and_vectors
def test_slope_of_a_smooth_force_at_rest_against_finite_differences(name, v):
    case, h = CASES[name], 1e-6
    force = lambda v: derivatives(case, v).first[1][0]
    dv = jnp.asarray(unit_and_speed(v)[0])
    slope = along(derivatives(case, 0 * v).hessians[1], dv)
    secant_off_tangent = case.F(h) / h - case.stiffness
    np.testing.assert_allclose(slope, (force(h * dv) - force(-h * dv)) / (2 * h), rtol=0, atol=1.01 * secant_off_tangent + 1e-9)


@every_case
@pytest.mark.parametrize(
    "dtype, smallest", [(jnp.float64, [-322, -309, -300, -160, -154, -110]), (jnp.float32, [-45, -39, -30, -22, -19, -15])]
)
def test_derivatives_just_off_rest_are_finite(case, dtype, smallest):
    """Down to where squares of the speed underflow, and below."""
    s = jnp.asarray([10.0**e for e in smallest], dtype)
    for v in (s, jnp.stack([s, -2 * s, 0 * s], axis=1)):
        found = derivatives(case, v)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((found.value, found.first)))
        if case.degree and case.degree >= 2:  # a kink, or an exponent below 1, has unbounded second derivatives of its own
            assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((found.hessians, found.mixed)))


def test_a_velocity_that_is_no_number_is_not_rest():
    assert np.isnan(jax.grad(sliding)(jnp.array([np.nan, 1.0]), 0.3, 10.0)).any()


# Kinks


@every_case
def test_bound_of_the_kink_is_the_force_just_off_rest(case):
    for v in (1e-12 * SCALARS, 1e-12 * VECTORS):
        e, s = unit_and_speed(v)
        force = derivatives(case, v).first[1][0]
        np.testing.assert_allclose(force, [case.F(s) * e for e, s in zip(e, s, strict=True)], rtol=1e-11)


@pytest.mark.parametrize("name", ["sliding", "stribeck", "stribeck, exponential", "power 0", "drag"])
def test_the_speed_stands_once_in_the_program(name):
    """`abs` of a scalar; of a vector one call of the norm with a rule of its own. Both at the outermost level."""
    case = CASES[name]
    for v, primitive in ((0.5, "abs"), (jnp.ones(2), "custom_jvp_call")):
        program = jax.make_jaxpr(case.D)(v, *case.parameters).jaxpr
        found = [eqn for eqn in program.eqns if eqn.primitive.name == primitive and eqn.invars[0] is program.invars[0]]
        assert len(found) == 1
        assert found[0].outvars[0].aval.shape == ()


# Laws


@every_case
@scalars_and_vectors
def test_eulers_identity(case, v):
    """v · ∂D/∂v = n D; where the force falls it is less than D, the area under the curve."""
    found = derivatives(case, v)
    euler = np.sum((v * found.first[1][0]).reshape(len(v), -1), axis=1)
    if case.degree:
        np.testing.assert_allclose(euler, case.degree * found.value, rtol=1e-13)
    else:
        assert (euler < found.value).all()


MATRIX = jnp.array([[2.0, 0.7, -0.4], [0.1, 1.5, 0.3], [0.2, -0.5, 0.9]])


def test_eulers_identity_of_a_damping_matrix():
    for v in VECTORS:
        np.testing.assert_allclose(v @ jax.grad(viscous)(v, MATRIX), 2 * viscous(v, MATRIX), rtol=1e-13)


def random_velocities(seed, count, *shape):
    """Of all sizes from 1e-12 to 1e4, a hundred of them at rest."""
    rng = np.random.default_rng(seed)
    v = rng.normal(size=(count, *shape)) * 10 ** rng.uniform(-12, 4, (count, *(1 for _ in shape)))
    v[:100] = 0
    return jnp.asarray(v)


PASSIVE = {
    "sliding": (sliding, 2),
    "viscous": (viscous, 1),
    "drag": (drag, 1),
    "power law": (power_law, 2),
    "stribeck": (stribeck, 3),
    "stribeck, exponential": (lambda v, F_c, F_s, v_s: stribeck(v, F_c, F_s, v_s, 1), 3),
    "speed": (speed, 0),
}


@pytest.mark.parametrize("shape", [(), (3,)], ids=["scalar", "vector"])
@pytest.mark.parametrize("name", PASSIVE)
def test_passivity(name, shape):
    """The power −v · ∂D/∂v is never positive, whatever the velocity and the (positive) parameters."""
    D, count = PASSIVE[name]
    v = random_velocities(3, 100_000, *shape)
    parameters = np.random.default_rng(4).uniform(0.01, 3, (count, 100_000))
    power = jax.jit(jax.vmap(lambda v, *p: -jnp.sum(v * jax.grad(D)(v, *p))))(v, *parameters)
    assert np.max(power) <= 0
    assert (power[:100] == 0).all() and (power[100:] < 0).all()


def test_passivity_of_a_damping_matrix():
    """Any matrix whose symmetric part is positive definite."""
    v = random_velocities(5, 100_000, 3)
    A, S = np.random.default_rng(6).normal(size=(2, 100_000, 3, 3))
    B = A @ A.transpose(0, 2, 1) + 0.01 * np.eye(3) + S - S.transpose(0, 2, 1)
    power = jax.vmap(lambda v, B: -v @ jax.grad(viscous)(v, B))(v, B)
    assert np.max(power) <= 0 and (power[100:] < 0).all()


# Each potential


def test_only_the_symmetric_part_of_a_damping_matrix_counts():
    v = jnp.array([0.3, -1.0, 2.0])
    symmetric = 0.5 * (MATRIX + MATRIX.T)
    np.testing.assert_allclose(viscous(v, MATRIX), viscous(v, symmetric), rtol=1e-14)
    for rest_or_not in (v, jnp.zeros(3)):
        np.testing.assert_allclose(jax.grad(viscous)(rest_or_not, MATRIX), symmetric @ rest_or_not, rtol=1e-14, atol=1e-15)
        np.testing.assert_allclose(jax.hessian(viscous)(rest_or_not, MATRIX), symmetric, rtol=1e-15)
    np.testing.assert_allclose(viscous(v, 1.7 * jnp.eye(3)), viscous(v, 1.7), rtol=1e-14)


@pytest.mark.parametrize("delta", [1, 2])
def test_stribeck_force_is_the_curve(delta):
    F_c, F_s, v_s = STRIBECK
    v = jnp.linspace(-5, 5, 400)  # no sample at zero
    force = jax.jit(jax.vmap(jax.grad(lambda v: stribeck(v, F_c, F_s, v_s, delta))))(v)
    curve = F_c + (F_s - F_c) * np.exp(-((np.abs(v) / v_s) ** delta))
    np.testing.assert_allclose(force, np.sign(v) * curve, rtol=1e-14)
    np.testing.assert_allclose(force[:: len(v) - 1], [-F_c, F_c], rtol=1e-5)
    assert (np.diff(force[v > 0]) < 1e-14).all()  # D is not convex
    np.testing.assert_allclose(stribeck(v[0], F_c, F_c, v_s, delta), sliding(v[0], 1.0, F_c), rtol=1e-15)


@every_case
@scalars_and_vectors
def test_single_precision_stays_single(case, v):
    single, double = derivatives(case, v.astype(jnp.float32)), derivatives(case, v)
    assert {leaf.dtype for leaf in (single.value, single.first[1][0], *single.hessians)} == {jnp.dtype("float32")}
    for found, expected in zip(jax.tree.leaves(single), jax.tree.leaves(double), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * (1 + np.max(np.abs(expected))))


def test_integers_and_lists_of_numbers_are_velocities(single_precision):
    assert float(viscous(2, 3)) == 6.0
    assert float(speed([3, -4])) == 5.0
    x, y = jnp.float32(3.0), jnp.float32(4.0)
    assert float(drag([x, y], 3)) == 125.0
    assert power_law(2, 1, 1).dtype == jnp.float32


@pytest.mark.fast
@pytest.mark.parametrize(
    "wrong, sentence",
    [
        (lambda: speed(jnp.ones((2, 2))), r"`v` must be a scalar or a vector, but has shape \(2, 2\). Pass one relative velocity"),
        (lambda: drag({"x": 1.0}, 1.0), r"`v` must be a scalar or a vector, but is a dict. Pass one relative velocity, e.g. .*'x'"),
        (
            lambda: viscous(jnp.ones(3), jnp.ones(3)),
            r"`b` must be a scalar or, .*, but has shape \(3,\) where `v` has \(3,\). .* `jnp.diag",
        ),
        (lambda: viscous(1.0, jnp.ones((1, 1))), r"`b` must be a scalar or, .*, but has shape \(1, 1\) where `v` has \(\)"),
        (lambda: stribeck(1.0, *STRIBECK, 1.5), "`delta` must be 1 or 2, but is 1.5. Write the number into the call"),
        (lambda: jax.grad(stribeck, argnums=4)(1.0, *STRIBECK, 2.0), "`delta` must be 1 or 2, but is .*, not into params"),
    ],
)
def test_wrong_shapes_get_a_sentence_with_the_cure(wrong, sentence):
    with pytest.raises((ValueError, TypeError), match=sentence):
        wrong()


def test_every_public_function_is_tested_here():
    public = {n for n, f in vars(dissipation).items() if inspect.isfunction(f) and f.__module__ == dissipation.__name__ and n[0] != "_"}
    assert public == {f.__name__ for f in FUNCTIONS}


# Motions. The numbers are those of the reference collection's cf_fall_quadratic_drag and cf_linear_damped: closed forms, checked apart.

falling = jl.System(lambda q, qdot, m, g: 0.5 * m * qdot**2 + m * g * q, dissipation={"air": lambda qdot, c: drag(qdot, c)})  # q downward
V_T, G = 20.0, 9.81  # m/s, m/s²
FALL = {"m": 1.7, "g": G, "c": 1.7 * G / V_T**2}


def test_fall_with_quadratic_drag():
    """v = v_t tanh(g t/v_t), y = (v_t²/g) ln cosh(g t/v_t), from rest; and its terminal velocity v_t = √(m g/c)."""
    motion = jl.simulate(falling, 0.0, 0.0, [0.0, 1.0, 2.0, 5.0, 60.0], FALL, **SHARP)
    np.testing.assert_allclose(motion.qdot[1:4], [9.092263725186795, 15.069969414353892, 19.705802119136784], rtol=1e-10)
    np.testing.assert_allclose(motion.q[1:4], [4.720080982239957, 17.100390684347605, 72.03812221989564], rtol=1e-10)
    np.testing.assert_allclose(motion.qdot[4], V_T, rtol=1e-10)


def test_throw_with_quadratic_drag():
    """Thrown up at 30 m/s: up (v_t/g) atan(v₀/v_t), high (v_t²/2g) ln(1 + v₀²/v_t²), back at v₀ v_t/√(v₀² + v_t²)."""
    height, up_time, return_speed = 24.029663533978514, 2.0036569281291112, 16.641005886756872
    down_time = V_T / G * np.arccosh(np.exp(G * height / V_T**2))
    motion = jl.simulate(falling, 0.0, -30.0, [0.0, 1.0, 2.0, up_time, up_time + down_time], FALL, **SHARP)
    np.testing.assert_allclose(motion.q[3:], [-height, 0], rtol=0, atol=1e-8)
    np.testing.assert_allclose(motion.qdot[3:], [0, return_speed], rtol=0, atol=1e-8)


def test_gradient_of_a_fall_from_rest():
    """dv/dc of v = v_t tanh(g t/v_t), though the motion starts on the edge of |v|."""
    t, c = 2.0, FALL["c"]

    def end(c):
        return jl.simulate(falling, 0.0, 0.0, [0.0, t], FALL | {"c": c}, **SHARP).qdot[-1]

    x = G * t / V_T
    by_hand = -V_T / (2 * c) * (np.tanh(x) - x / np.cosh(x) ** 2)  # dv_t/dc = −v_t/2c
    np.testing.assert_allclose(jax.grad(end)(c), by_hand, rtol=1e-8)


def test_terminal_velocity_in_wind():
    """A body let go at rest in a wind w ends at w + (0, −v_t): ‖v‖ of a vector, started at rest relative to still air."""
    flight = jl.System(
        lambda q, qdot, m, g: 0.5 * m * qdot @ qdot - m * g * q[1], dissipation=lambda qdot, c, w: drag(qdot - w * jnp.array([1.0, 0.0]), c)
    )
    still = jl.simulate(flight, jnp.zeros(2), jnp.zeros(2), [0.0, 5.0], FALL | {"w": 0.0}, **SHARP)
    np.testing.assert_allclose(still.qdot[-1], [0, -19.705802119136784], rtol=1e-10)
    windy = jl.simulate(flight, jnp.zeros(2), jnp.zeros(2), [0.0, 60.0], FALL | {"w": 7.0}, **SHARP)
    np.testing.assert_allclose(windy.qdot[-1], [7, -V_T], rtol=1e-10)


def oscillator_lagrangian(q, qdot, m, k):
    return 0.5 * m * qdot**2 - 0.5 * k * q**2


damped = jl.System(oscillator_lagrangian, dissipation=lambda qdot, b: viscous(qdot, b))


@pytest.mark.parametrize(
    "b, x, v",
    [
        (0.7, -0.021434173631646306, -1.1613827854583334),
        (6.841052550594828, 0.002870860480638291, -0.006721164443063346),
        (9.0, 0.03109086554733972, -0.03769074993871671),
    ],
    ids=["under", "critical", "over"],
)
def test_damped_oscillator(b, x, v):
    motion = jl.simulate(damped, 1.0, -0.4, [0.0, 1.0, 3.0], {"m": 1.3, "k": 9.0, "b": b}, **SHARP)
    np.testing.assert_allclose([motion.q[-1], motion.qdot[-1]], [x, v], rtol=0, atol=1e-10)


def test_logarithmic_decrement():
    m, k, b = 1.3, 9.0, 0.7
    period = 2 * np.pi / np.sqrt(k / m - (b / (2 * m)) ** 2)
    motion = jl.simulate(damped, 1.0, -0.4, [0.0, 0.3 * period, 1.3 * period], {"m": m, "k": k, "b": b}, **SHARP)
    np.testing.assert_allclose(np.log(motion.q[1] / motion.q[2]), 0.646309467677697, rtol=1e-8)  # samples lie between the steps


@pytest.mark.slow
def test_coasting_to_just_before_the_stop():
    """m v̇ = −a − k v²: v = √(a/k) tan(atan(v₀ √(k/a)) − t √(a k)/m), and x = (m/2k) ln((a + k v₀²)/(a + k v²))."""
    m, mu, N, k, v0 = 900.0, 0.015, 9000.0, 0.5, 25.0  # kg, 1, N, kg/m, m/s: a car out of gear
    a = mu * N
    car = jl.System(lambda qdot, m: 0.5 * m * qdot**2, dissipation={"tyres": lambda qdot, mu, N: sliding(qdot, mu, N), "air": drag_of_car})
    angle = np.arctan(v0 * np.sqrt(k / a))
    stop = m / np.sqrt(a * k) * angle
    ts = np.linspace(0, 0.999 * stop, 20)
    motion = jl.simulate(car, 0.0, v0, ts, {"m": m, "mu": mu, "N": N, "k": k}, **SHARP)
    v = np.sqrt(a / k) * np.tan(angle - ts * np.sqrt(a * k) / m)
    np.testing.assert_allclose(motion.qdot, v, rtol=0, atol=1e-9 * v0)
    np.testing.assert_allclose(motion.q, m / (2 * k) * np.log((a + k * v0**2) / (a + k * v**2)), rtol=1e-9, atol=1e-9)


def drag_of_car(qdot, k):
    return drag(qdot, k)
