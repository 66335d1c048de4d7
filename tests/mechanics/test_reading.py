"""What is static about a system is read once in its programs, and is the same whatever the numbers: counted, and against closed forms."""

import functools
import gc
import weakref

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

TIMES = np.linspace(0.0, 1.0, 5)
PARAMS = {"m": 2.0, "c": 3.0, "F": 0.3, "b": 0.5, "mu": 0.2, "g": 9.81}
START = {"x": 1.0, "y": 0.0, "z": 0.1}, {"x": 0.0, "y": 0.0, "z": 0.0}


def lagrangian(q, qdot, m, c, g):
    return 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2) - 0.5 * c * (q["x"] - q["z"]) ** 2 - m * g * q["y"]


def with_mass(q, qdot, m, c, g):
    return lagrangian(q, qdot, m, c, g) + 0.5 * m * qdot["z"] ** 2


SYSTEMS = {
    "friction, and a dashpot without mass": {
        "lagrangian": lagrangian,
        "dissipation": lambda qdot, F, b: F * jnp.abs(qdot["x"]) + b * qdot["z"] ** 2,
    },
    "friction of a contact": {
        "lagrangian": with_mass,
        "dissipation": lambda qdot, mu, multipliers: mu * multipliers["floor"] * jnp.abs(qdot["x"]),
        "unilateral": {"floor": lambda q: q["y"]},
    },
}


def counted(function, calls):
    @functools.wraps(function)
    def counting(*given, **named):
        calls.append(1)
        return function(*given, **named)

    return counting


@pytest.mark.parametrize("name", SYSTEMS)
def test_programs_ask_for_the_lagrangian_a_few_times(name):
    calls = []
    system = jl.System(**SYSTEMS[name] | {"lagrangian": counted(SYSTEMS[name]["lagrangian"], calls)})
    jax.eval_shape(lambda params: jl.acceleration(system, *START, params), PARAMS)
    assert 0 < len(calls) <= 10
    calls.clear()
    jax.eval_shape(lambda params: jl.simulate(system, *START, TIMES, params, throw=False).q, PARAMS)
    assert 0 < len(calls) <= 30


def test_what_is_read_with_some_numbers_serves_all():
    """A dashpot in series with a spring, b ż = c (x − z): ż of other b and c, and of b that is a table, from one system."""
    system = jl.System(
        lambda q, qdot, c: 0.5 * qdot["x"] ** 2 - 0.5 * c * (q["x"] - q["z"]) ** 2,
        dissipation=lambda qdot, b: 0.5 * jnp.sum(b * qdot["z"] ** 2),
    )
    q, v = {"x": 1.0, "z": 0.4}, {"x": 0.0, "z": 0.0}
    for b, c in [(0.5, 2.0), (1e-6, 1e6), (np.array([0.1, 0.4]), 2.0), (0.5, 0.0)]:
        power = jl.powers(system, q, v, {"b": b, "c": c})["dissipation"]
        np.testing.assert_allclose(power, -((c * 0.6) ** 2) / np.sum(b), rtol=1e-13)


def test_friction_of_some_numbers_serves_all():
    """A block on a belt, μN|ẋ − w|, of which another system knows the speed: q̈ from slip in either direction, and from rest."""
    unknown = jl.System(lambda qdot, m: 0.5 * m * qdot**2, dissipation=lambda qdot, F, w: F * jnp.abs(qdot - w))
    known = jl.System(lambda qdot, m: 0.5 * m * qdot**2, dissipation=lambda qdot, F: F * jnp.abs(qdot - 1.0))
    for v, w, F in [(2.0, 1.0, 3.0), (0.5, 1.0, 3.0), (1.0, 1.0, 3.0), (2.0, 1.0, 0.0)]:
        right = -F * np.sign(v - w) / 2
        np.testing.assert_allclose(jl.acceleration(unknown, 0.0, v, {"m": 2.0, "F": F, "w": w}).qddot, right, rtol=1e-14)
        np.testing.assert_allclose(jl.acceleration(known, 0.0, v, {"m": 2.0, "F": F}).qddot, right, rtol=1e-14)
    slopes = jax.vmap(jax.grad(lambda F, v: jl.acceleration(unknown, 0.0, v, {"m": 2.0, "F": F, "w": 1.0}).qddot), (None, 0))
    np.testing.assert_allclose(slopes(3.0, jnp.array([2.0, 0.5])), [-0.5, 0.5], rtol=1e-14)


def test_friction_of_one_slip_and_of_two_from_one_system():
    """F Σ|v − w_i|: between two belts at ∓1 nothing pulls, faster than both F pulls twice."""
    system = jl.System(lambda qdot: 0.5 * qdot**2, dissipation=lambda qdot, F, w: F * jnp.sum(jnp.abs(qdot - w)))
    for w, v, right in [(1.0, 0.0, 3.0), (np.array([1.0, -1.0]), 0.0, 0.0), (np.array([1.0, -1.0]), 2.0, -6.0), (1.0, 2.0, -3.0)]:
        np.testing.assert_allclose(jl.acceleration(system, 0.0, v, {"F": 3.0, "w": w}).qddot, right, rtol=1e-14)


def test_a_system_within_a_program_closes_over_what_is_traced():
    def stops_at(F, m):
        system = jl.System(lambda qdot: 0.5 * m * qdot**2, dissipation=lambda qdot: F * jnp.abs(qdot))
        return jl.simulate(system, 0.0, 1.0, jnp.array([0.0, 5.0]), throw=False).q[-1]

    for F, m in [(1.0, 2.0), (4.0, 1.0)]:
        np.testing.assert_allclose(jax.jit(stops_at)(F, m), m / (2 * F), rtol=1e-9)


def test_what_was_read_goes_with_the_system():
    system = jl.System(
        lambda qdot: 0.5 * qdot["x"] ** 2, dissipation=lambda qdot, F: F * jnp.abs(qdot["x"] - qdot["z"]) + 0.5 * qdot["z"] ** 2
    )
    jl.acceleration(system, {"x": 0.0, "z": 0.0}, {"x": 1.0, "z": 0.0}, {"F": 1.0})
    gone = weakref.ref(system)
    del system
    jax.clear_caches()
    gc.collect()
    assert gone() is None


def test_what_functions_close_over_may_change_between_programs():
    """A new program sees it everywhere: friction that was read before, and a coupling of masses that was zero."""
    bound, coupling = [1.0], [0.0]
    system = jl.System(
        lambda qdot: 0.5 * qdot @ qdot + coupling[0] * qdot[0] * qdot[1], dissipation=lambda qdot: bound[0] * jnp.abs(qdot[3])
    )
    state = np.zeros(4), np.array([0.0, 0.0, 0.0, 1.0])
    np.testing.assert_allclose(jl.acceleration(system, *state).qddot, [0, 0, 0, -1], rtol=1e-14)
    bound[0], coupling[0] = 2.0, 0.5
    assert jl.powers(system, *state)["dissipation"] == -2.0
    np.testing.assert_array_equal(jl.mass_matrix(system, *state)[:2, :2], [[1.0, 0.5], [0.5, 1.0]])
