"""Plates on legs that hold a load together: how they share it, when they break away, and how they move then. Against SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import null_space
from scipy.optimize import minimize

import jaxlag as jl
from jaxlag._mechanics.friction_elements import FrictionElements
from jaxlag._mechanics.load_sharing import best_share

LEGS = {
    2: np.array([[1.0, 0.0], [-1.0, 0.0]]),
    3: np.array([[1.0, 0.0], [-0.5, 0.8], [-0.5, -0.8]]),
    4: np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]]),
}
BOUND = 0.5


def slips(q, qdot, legs, xp=jnp):
    c, s = xp.cos(q[2]), xp.sin(q[2])
    rx, ry = c * legs[:, 0] - s * legs[:, 1], s * legs[:, 0] + c * legs[:, 1]
    return xp.stack([qdot[0] - qdot[2] * ry, qdot[1] + qdot[2] * rx], axis=1)


plate = jl.System(
    lambda qdot: 0.5 * qdot @ qdot,
    dissipation={"legs": lambda q, qdot, legs: BOUND * jnp.sum(jnp.linalg.norm(slips(q, qdot, legs), axis=1))},
    force=lambda t, load: load * t,
)


def jacobians(legs):
    return np.stack([np.asarray(slips(np.zeros(3), e, legs, np)) for e in np.eye(3)], axis=-1)


def limit(legs, load):
    """The time t at which load · t breaks the plate away: the least power of friction for a power of the load of 1."""
    J = jacobians(legs)
    power = lambda d: BOUND * np.sum(np.sqrt(np.sum((J @ d) ** 2, axis=1)))
    starts = [load, load + 0.1, load - [0.0, 0.1, -0.1]]
    given = dict(constraints={"type": "eq", "fun": lambda d: load @ d - 1}, options={"ftol": 1e-15, "maxiter": 1000})
    return min(minimize(power, start / (load @ start), **given).fun for start in starts)


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3, 4))])
def test_the_most_loaded_element_is_used_as_little_as_can_be(seed):
    rng = np.random.default_rng(seed)
    count = rng.integers(3, 6)
    of = np.repeat(np.arange(count), rng.integers(1, 3, count))
    J, given, bound = rng.normal(size=(of.size, 3)), rng.normal(size=of.size), rng.uniform(0.5, 2, count)
    elements = FrictionElements(lambda t, q, v: J @ v, {}, of, {"all": np.arange(of.size)})
    left = jax.jit(lambda given: best_share(elements, jnp.asarray(J), given, lambda x: jnp.asarray(bound), jnp.ones(count, bool), 1))
    share = left(given)
    np.testing.assert_allclose(J.T @ share.multipliers, J.T @ given, atol=1e-13)
    N = null_space(J.T)
    room = lambda x: x[-1] ** 2 - np.bincount(of, (given + N @ x[:-1]) ** 2) / bound**2
    best = minimize(lambda x: x[-1], np.r_[0 * N[0], 9.0], constraints={"type": "ineq", "fun": room}, options={"ftol": 1e-15})
    np.testing.assert_allclose(np.max(1 - share.margin / bound), best.fun, atol=1e-8)
    least = lambda given: jnp.min(left(given).margin / bound)
    along, h = rng.normal(size=of.size), 1e-6
    slope = (least(given + h * along) - least(given - h * along)) / (2 * h)
    np.testing.assert_allclose(jax.grad(least)(given) @ along, slope, atol=1e-6)
    np.testing.assert_allclose(jax.jvp(least, (given,), (along,))[1], slope, atol=1e-6)


def regularised(legs, load, ts, state, width):
    def rates(t, y):
        u = slips(y[:3], y[3:], legs, np)
        pull = BOUND * u / np.sqrt(np.sum(u**2, axis=1, keepdims=True) + width**2)
        r = slips(y[:3], np.array([0.0, 0.0, 1.0]), legs, np)
        return np.r_[y[3:], load * t - [*pull.sum(0), np.sum(pull * r)]]

    with np.errstate(over="ignore"):  # of steps that are rejected
        return solve_ivp(rates, (ts[0], ts[-1]), state, "Radau", ts, rtol=1e-8, atol=1e-11).y.T


def off_regularised(motion, legs, load, ts, v0):
    """How far positions are from those with smooth friction of the widths 1e-4 and 1e-5, which creeps and breaks away gently."""
    others = (regularised(legs, load, ts, np.r_[np.zeros(3), v0], width) for width in (1e-4, 1e-5))
    return [np.max(np.abs(motion.q - other[:, :3])) for other in others]


@pytest.mark.slow
@pytest.mark.parametrize("legs", LEGS)
def test_a_plate_breaks_away(legs):
    """It holds as long as some share of the load does. Pulled at its centre, F legs in all, it goes x = (t − t₁)³/6; turned, t₁ = Σ F r.

    Pulled and turned, it goes along as with smooth friction, the closer the smaller its width. All was "minimum step size".
    """
    still = np.zeros(3)
    for load in np.array([[0.6, 0.8, 0.0], [0.0, 0.0, 1.0], [0.9, 0.0, 0.2]]):
        start = limit(LEGS[legs], load)
        ts = start + np.array([-0.01, -1e-6, 0.1, 0.5, 1.0])
        motion = jl.simulate(plate, still, still, ts, {"legs": LEGS[legs], "load": load})
        np.testing.assert_allclose(motion.qdot[1], 0, atol=1e-30)
        assert np.all(motion.stats["time_stuck"][-1] < 0.01 + 1e-5)
        assert np.all(np.linalg.norm(motion.friction["legs"].force.reshape(5, -1, 2), axis=-1) <= BOUND * (1 + 1e-6))
        if load[2] == 1 and legs != 3:  # three of them not at one distance turn about another point
            np.testing.assert_allclose(start, BOUND * np.sum(np.linalg.norm(LEGS[legs], axis=1)), rtol=1e-7)
        if load[2] == 0:
            np.testing.assert_allclose(start, BOUND * legs, rtol=1e-7)
            np.testing.assert_allclose(motion.q[-1], load / 6, atol=1e-7)
        if load[0] == 0.9:
            wide, narrow = off_regularised(motion, LEGS[legs], load, ts, still)
            assert narrow < min(4e-4, 0.3 * wide)


@pytest.mark.slow
def test_a_plate_slides_to_rest_on_four_legs():
    """All legs stop at the same time. The gradient against differences."""
    load, v0, ts = np.array([0.9, 0.0, 0.2]), np.array([0.3, -0.2, 0.4]), np.linspace(0, 1, 5)
    params = {"legs": LEGS[4], "load": load}
    motion = jl.simulate(plate, np.zeros(3), v0, ts, params)
    wide, narrow = off_regularised(motion, LEGS[4], load, ts, v0)
    assert narrow < min(5e-5, 0.3 * wide)
    np.testing.assert_allclose(motion.qdot[-1], 0, atol=1e-30)
    end = lambda load: jl.simulate(plate, np.zeros(3), v0, ts, params | {"load": load}).q[-1, 0]
    h = np.array([1e-5, 0.0, 0.0])
    slope = (end(load + h) - end(load - h)) / 2e-5
    np.testing.assert_allclose(jax.grad(end)(load)[0], slope, rtol=1e-5)


begun = jl.System(
    lambda qdot, J: 0.5 * (qdot[0] ** 2 + qdot[1] ** 2) + 0.5 * J * qdot[2] ** 2,
    dissipation=lambda q, qdot, legs, x: jnp.sum(x[3:] * jnp.linalg.norm(slips(q, qdot, legs), axis=1)),
    force=lambda x: x[:3],
)


@pytest.mark.slow
def test_plates_begin_to_move_where_all_their_legs_let_them():
    """From rest, under loads below and beyond what friction holds: q̈ minimises ½ (q̈ − f)ᵀM(q̈ − f) + Σ F ‖J q̈‖, which is convex, so that
    no direction leads down from it. The direction of slip was that of the force which would have held: up to 30 % off. In all units.
    """
    legs_of = 4
    start = jl.System(
        lambda qdot, m, J: 0.5 * m * (qdot[0] ** 2 + qdot[1] ** 2) + 0.5 * J * qdot[2] ** 2,
        dissipation=lambda q, qdot, legs, F: jnp.sum(F * jnp.linalg.norm(slips(q, qdot, legs), axis=1)),
        force=lambda load: load,
    )
    begins = jax.jit(lambda params: jl.acceleration(start, jnp.zeros(3), jnp.zeros(3), params).qddot)
    rng, slipped = np.random.default_rng(5), []
    for _ in range(300):
        length, mass, time = 10.0 ** rng.uniform(-6, 6, 3)
        legs, F = rng.normal(size=(legs_of, 2)), rng.uniform(0.2, 2, legs_of) * (rng.random(legs_of) < 0.8)
        legs[1] = (legs[0], -legs[0], legs[1])[rng.integers(3)]
        m, J = 10.0 ** rng.uniform(-1, 1, 2)
        load, unit, force = rng.normal(size=3) * 10.0 ** rng.uniform(-1, 1), np.array([1, 1, length]), mass * length / time**2
        given = {"m": m * mass, "J": J * mass * length**2, "legs": legs * length, "F": F * force, "load": load * unit * force}
        a = np.asarray(begins(given)) * unit * time**2 / length
        M, jacobian = np.array([m, m, J]), jacobians(legs)
        slip = jacobian @ a
        size = np.linalg.norm(slip, axis=1)
        moves = size > 1e-8 * np.max(np.abs(load / M))
        descent = M * a - load + np.einsum("e,erk,er->k", F * moves / np.where(moves, size, 1), jacobian, slip)
        ways = rng.normal(size=(4000, 3))
        ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        held = np.einsum("e,ew->w", np.where(moves, 0, F), np.linalg.norm(np.einsum("erk,wk->erw", jacobian, ways), axis=1))
        assert np.min(ways @ descent + held) > -1e-7 * np.max(np.abs(load))
        slipped.append(np.sum(moves & (F > 0)))
    assert min(slipped.count(k) for k in range(5)) > 3  # legs that slip while others stay


def pulled(load, mu, length):
    """A block of 2 kg on a table z = 0 under a load beyond what friction holds: m r̈ = F − μ (m g − F_z) F/‖F‖ along the table."""
    along = jnp.array([1.0, 1.0, 0.0]) * load
    return along / 2 - mu * (9.81 * length - load[2] / 2) * along / jnp.linalg.norm(along)


BLOCK = jl.System(
    lambda q, qdot, length: qdot @ qdot - 2 * 9.81 * length * q[2],
    dissipation=lambda qdot, mu, multipliers: mu * jnp.abs(multipliers["table"]) * jl.dissipation.speed(qdot),
    holonomic={"table": lambda q: q[2]},
    force=lambda load: load,
)


@pytest.mark.slow
@pytest.mark.parametrize("length", [1.0, 1e-4])
def test_the_direction_of_slip_turns_with_a_load_that_switches_on(length):
    """The first and second derivatives of q̈ at rest left this out: off by any factor, without a word."""
    load, mu = np.array([3.0, 4.0, -2.0]) * 9.81 * length, 0.3
    begins = lambda load, mu: jl.acceleration(BLOCK, jnp.zeros(3), jnp.zeros(3), {"length": length, "mu": mu, "load": load}).qddot
    exact = lambda load, mu: pulled(load, mu, length)
    np.testing.assert_allclose(begins(load, mu), exact(load, mu), rtol=1e-12, atol=1e-15 * length)
    of_both = lambda f: jax.jacrev(f, (0, 1))(load, mu)
    for found, right, unit in zip(of_both(begins), of_both(exact), (1, length), strict=True):
        np.testing.assert_allclose(found, right, atol=1e-12 * unit)
    twice = lambda f: jax.jacfwd(jax.jacrev(f))(load, mu)
    np.testing.assert_allclose(twice(begins) * length, twice(exact) * length, atol=1e-10)


@pytest.mark.slow
def test_derivatives_at_the_bound_and_of_nothing():
    """At the very bound friction has the direction of the load, not of rounding; without load and friction all is finite."""
    block = jl.System(lambda qdot: qdot @ qdot, dissipation=lambda qdot, F: F * jl.dissipation.speed(qdot), force=lambda load: load)
    begins = lambda load, F: jl.acceleration(block, jnp.zeros(2), jnp.zeros(2), {"F": F, "load": load}).qddot
    both = jax.jit(jax.jacrev(begins, (0, 1)))
    np.testing.assert_allclose(both(jnp.array([3.0, 4.0]), 5.0)[1], [-0.3, -0.4], atol=1e-12)
    np.testing.assert_allclose(both(jnp.array([3e-9, 4e-9]), 0.0)[0], np.eye(2) / 2, atol=1e-12)
    assert all(np.all(np.isfinite(x)) for x in both(jnp.zeros(2), 0.0))


@pytest.mark.slow
def test_plates_begin_to_move_with_derivatives():
    """Of random plates on four legs, each of which turns with all others, against differences; a leg that stays has no part in them."""
    rng, ends, step = np.random.default_rng(3), [], 1e-4
    begins = jax.jit(lambda x, J, legs: jl.acceleration(begun, jnp.zeros(3), jnp.zeros(3), {"J": J, "legs": legs, "x": x}).qddot)
    forward, reverse = (jax.jit(derivative(begins)) for derivative in (jax.jacfwd, jax.jacrev))
    for _ in range(60):
        given = 10.0 ** rng.uniform(-1, 1), rng.normal(size=(4, 2))
        x = np.concatenate([rng.normal(size=3) * 10 ** rng.uniform(0, 1), rng.uniform(0.2, 2, 4)])
        of = lambda h, x=x, given=given: np.stack(
            [(begins(x + e, *given) - begins(x - e, *given)) / (2 * h) for e in h * np.eye(7)], axis=1
        )
        wide, narrow = of(2 * step), of(step)
        size = max(np.max(np.abs(narrow)), 1e-6)
        if np.max(np.abs(wide - narrow)) > 1e-3 * size:  # across the border between two kinds of slip
            continue
        for derivative in (forward, reverse):
            np.testing.assert_allclose(derivative(x, *given) / size, narrow / size, atol=3e-4)
        ends.append(size > 1e-6)
    assert len(ends) > 50 and 20 < sum(ends) < len(ends)
