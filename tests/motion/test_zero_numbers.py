"""Derivatives by numbers that are zero, along a motion that rests, where all that changes is held by constraints and friction.

Such a derivative has no size of its own and neither has its number: what its rounding may be follows from the forces that it changes.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

REST = {"x": 0.0, "y": 0.0}
G = 9810.0  # mm/s²


def kinetic(q, qdot, m):
    return 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2)


def hanging(q, qdot, m):
    return kinetic(q, qdot, m) - m * G * q["y"]


def along(x, y):
    """A force of zero along (x, y)."""
    return lambda t, a: {"x": x * a * jnp.sin(9 * t), "y": y * a * jnp.sin(9 * t)}


rod = {"rod": lambda q: jnp.hypot(q["x"], q["y"]) - 300.0}
rough = lambda qdot, multipliers: 0.3 * multipliers["floor"] * jnp.abs(qdot["x"])
floor = {"floor": lambda q: q["y"]}
in_plane = {"dry": lambda qdot, F: F * jnp.hypot(qdot["x"], qdot["y"])}
HELD = {
    "rod": (jl.System(hanging, holonomic=rod, force=along(0.0, 1.0)), {"x": 0.0, "y": -300.0}),
    "guide": (jl.System(kinetic, holonomic={"guide": lambda q: q["y"] - 0.3 * q["x"]}, force=along(-0.3, 1.0)), REST),
    "no velocity": (jl.System(kinetic, nonholonomic={"blade": lambda qdot: qdot["y"]}, force=along(0.0, 1.0)), REST),
    "floor": (jl.System(hanging, unilateral=floor, force=along(0.0, 1.0)), REST),
    "rough floor": (jl.System(hanging, dissipation=rough, unilateral=floor, force=along(1.0, 1.0)), REST),
    "friction": (jl.System(kinetic, dissipation={"dry": lambda qdot, F: F * jnp.abs(qdot["x"])}, force=along(1.0, 0.0)), REST),
    "friction in a plane": (jl.System(kinetic, dissipation=in_plane, force=along(1.0, 0.5)), REST),
}


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("name", HELD)
def test_what_is_held_does_not_change(name, mode):
    """Beside 1/m, what a force of one would do to a free body."""
    system, q0 = HELD[name]
    ts = jnp.linspace(0.0, 1.0, 5)
    m = 2e-4  # t
    of = lambda a: jl.simulate(system, q0, REST, ts, {"m": m, "F": 3.0, "a": a}).q
    for change in jax.tree.leaves(mode(of)(jnp.zeros(()))):
        np.testing.assert_allclose(m * change, 0.0, atol=1e-12)


block = jl.System(
    lambda q, qdot, m, k: 0.5 * m * qdot**2 - 0.5 * k * q**2,
    dissipation={"dry": lambda qdot, F: F * jnp.abs(qdot)},
    force=lambda t, a: 5 * jnp.sin(9 * t) + jnp.sum(a * jnp.sin(5 * t * jnp.arange(1, a.size + 1))),
)
PARAMS = {"m": 0.2, "k": 10.0, "F": 3.0}


def end_of(a):
    return jl.simulate(block, 0.0, 0.0, jnp.linspace(0.0, 1.0, 5), PARAMS | {"a": a}, rtol=1e-10, atol=1e-12).q


def test_what_slips_later():
    """Stuck at first, against differences."""
    h = 1e-4
    expected = np.stack([(end_of(e) - end_of(-e)) / (2 * h) for e in h * np.eye(3)], axis=-1)
    np.testing.assert_allclose(jax.jacfwd(end_of)(jnp.zeros(3)), expected, atol=1e-6 * np.max(np.abs(expected)))


@pytest.mark.slow
def test_more_numbers_than_are_differentiated_in_one_pass():
    few, many = (jax.grad(lambda a: end_of(a)[-1])(jnp.zeros(count)) for count in (3, 100))
    np.testing.assert_allclose(many[:3], few, atol=1e-6 * np.max(np.abs(few)))


@pytest.mark.parametrize("tiny", [1e-300, 1e-14, 1e-9])
def test_a_number_near_zero_is_no_other(tiny):
    of = lambda a: jl.simulate(block, 0.0, 0.0, jnp.linspace(0.0, 1.0, 5), PARAMS | {"a": a}).q
    zero = jax.jacfwd(of)(jnp.zeros(2))
    np.testing.assert_allclose(jax.jacfwd(of)(jnp.array([tiny, 0.0])), zero, atol=1e-7 * np.max(np.abs(zero)))


@pytest.mark.slow
@pytest.mark.parametrize("a", [0.0, 1e-3])
def test_a_stepper_and_a_batch_at_rest(a):
    free = jl.System(
        lambda qdot, m: 0.5 * m * qdot**2, dissipation={"dry": lambda qdot, F: F * jnp.abs(qdot)}, force=lambda t, a: a * jnp.sin(9 * t)
    )
    params = {"m": 2e-4, "F": 3.0}

    def stepped(a):
        stepper = jl.stepper(free, 0.1, params | {"a": a})
        state = stepper.start(0.0, 0.0)
        for _ in range(3):
            state = stepper(state)
        return state.q

    many = lambda a: (
        jl.simulate_many(free, 0.0, 0.0, jnp.linspace(0.0, 1.0, 5), params | {"F": jnp.array([1.0, 2.0]), "a": a}, over=("F",)).q
    )
    for of in (stepped, many):
        for mode in (jax.jacfwd, jax.jacrev):
            np.testing.assert_allclose(2e-4 * mode(of)(jnp.asarray(a)), 0.0, atol=1e-12)


@pytest.mark.slow
def test_second_derivatives_at_rest():
    of = lambda a: end_of(a)[-1]
    quiet = jl.System(
        lambda qdot, m: 0.5 * m * qdot**2,
        dissipation={"dry": lambda qdot, F: F * jnp.abs(qdot)},
        force=lambda t, a: jnp.sum(a * jnp.sin(9 * t * jnp.arange(1, 3))),
    )
    at_rest = jax.hessian(lambda a: jl.simulate(quiet, 0.0, 0.0, jnp.linspace(0.0, 1.0, 5), {"m": 0.2, "F": 3.0, "a": a}).q[-1])
    np.testing.assert_allclose(at_rest(jnp.zeros(2)), 0.0, atol=1e-12)
    h = 1e-4
    slopes = lambda a: np.asarray(jax.grad(of)(a))
    expected = np.stack([(slopes(e) - slopes(-e)) / (2 * h) for e in h * np.eye(2)])
    np.testing.assert_allclose(jax.hessian(of)(jnp.zeros(2)), expected, atol=1e-4 * np.max(np.abs(expected)))


def test_friction_of_zero_holds_what_rests_without_a_load():
    """A known gap: with F = 0 and no load the body could slip, but it counts as stuck, and so do its derivatives."""
    free = jl.System(
        lambda qdot, m: 0.5 * m * qdot**2, dissipation={"dry": lambda qdot, F: F * jnp.abs(qdot)}, force=lambda t, a: a * jnp.sin(9 * t)
    )
    of = lambda a: jl.simulate(free, 0.0, 0.0, jnp.linspace(0.0, 1.0, 5), {"m": 0.2, "F": 0.0, "a": a}).q
    ts = np.linspace(0.0, 1.0, 5)
    np.testing.assert_allclose(jax.jacfwd(of)(1.0), (ts / 9 - np.sin(9 * ts) / 81) / 0.2, atol=1e-7)
    np.testing.assert_allclose(jax.jacfwd(of)(0.0), 0.0, atol=1e-12)
