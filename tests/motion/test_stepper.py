"""A motion one step at a time: the motions of `simulate`, and of closed forms, in loops of `lax.scan`, with derivatives; in small units."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

LENGTH, TIME = 1e-6, 1e-3

oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
block = jl.System(
    lambda qdot, m: 0.5 * m * qdot**2,
    dissipation=lambda qdot, F: F * jnp.abs(qdot),
    force=lambda u: u,
)
ball = jl.System(lambda q, qdot, g: 0.5 * qdot**2 - g * q, unilateral={"floor": jl.Contact(lambda q: q, 0.8)})


def rolled(stepper, state, inputs=None, length=None):
    """The last state, and q of all."""

    def step(state, u):
        state = stepper(state, None if u is None else {"u": u})
        return state, state.q

    return jax.lax.scan(step, state, inputs, length=length)


def pushed(q, v, m, F, dt, u):
    """A block under a constant force for a time: where it comes to rest, it stays or is pushed the other way."""
    way = np.sign(v) if v else np.sign(u) * (abs(u) > F)
    a = (u - way * F) / m if way else 0.0
    stops = -v / a if v * a < 0 else np.inf
    if stops < dt:
        return pushed(q + v * stops / 2, 0.0, m, F, dt - stops, u)
    return q + v * dt + a * dt**2 / 2, v + a * dt


@pytest.mark.parametrize("late", [0.0, 1.7e9])
def test_a_block_under_forces_that_jump(late):
    """It sticks, breaks away, stops within steps and turns, as forces have it that are constant in each."""
    m, F, dt = 2e-3, 3e-3 * LENGTH / TIME**2, 0.7 * TIME
    forces = F * np.random.default_rng(1).normal(scale=2, size=40)
    stepper = jl.stepper(block, dt, {"m": m, "F": F}, inputs={"u": 0.0})
    state, q = rolled(stepper, stepper.start(0.0, 0.0, late), jnp.asarray(forces))
    expected, there, resting = [], (0.0, 0.0), 0
    for u in forces:
        there = pushed(*there, m, F, dt, u)
        resting += there[1] == 0
        expected.append(there[0])
    assert 3 < resting < 37
    np.testing.assert_allclose(q, expected, rtol=1e-9, atol=1e-9 * LENGTH)
    np.testing.assert_allclose(state.qdot, there[1], atol=1e-9 * LENGTH / TIME)
    assert state.t == late + 40 * dt and state.result == jl.results.RESULTS.successful


@pytest.mark.slow
def test_a_ball_that_bounces():
    """At times beside its impacts, by closed form."""
    g, dt = 9.81 * LENGTH / TIME**2, 0.01 * TIME
    height = 1.0 * LENGTH
    stepper = jl.stepper(ball, dt, {"g": g})
    _, q = rolled(stepper, stepper.start(height, 0.0), length=200)
    ts, hit, v, expected = dt * np.arange(1, 201), np.sqrt(2 * height / g), 0.8 * np.sqrt(2 * g * height), None
    expected = np.where(ts < hit, height - g * ts**2 / 2, 0)
    while hit < ts[-1]:
        next_hit = hit + 2 * v / g
        expected = np.where((ts >= hit) & (ts < next_hit), v * (ts - hit) - g * (ts - hit) ** 2 / 2, expected)
        hit, v = next_hit, 0.8 * v
    np.testing.assert_allclose(q, expected, atol=1e-9 * LENGTH)


@pytest.mark.slow
def test_a_ball_at_rest_is_lifted():
    """A force that jumps leaves it on the floor while it is less than the weight, and then none of its derivatives moves it."""
    pushed_ball = jl.System(ball.lagrangian[0][1], force=lambda u: u, unilateral=dict(ball.unilateral))
    g, dt = 9.81 * LENGTH / TIME**2, 0.3 * TIME

    def end(forces, g):
        stepper = jl.stepper(pushed_ball, dt, {"g": g}, inputs={"u": 0.0})
        return rolled(stepper, stepper.start(0.0, 0.0), forces)[0].q / LENGTH

    below, above = g * jnp.array([0.5, 0.9, -3.0, 0.2]), g * jnp.array([0.5, 0.9, -3.0, 1.5, 1.2])
    assert end(below, g) == 0
    for derivative in (jax.grad, jax.jacfwd):
        np.testing.assert_array_equal(jnp.append(*derivative(end, argnums=(0, 1))(below, g)), 0)
    lifted = lambda forces, g: (forces[3] - g) * dt**2 * 1.5 / LENGTH + (forces[4] - g) * dt**2 / 2 / LENGTH
    np.testing.assert_allclose(end(above, g), lifted(above, g), rtol=1e-9)
    for found, expected in zip(*(jax.grad(f, argnums=(0, 1))(above, g) for f in (end, lifted)), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-9 * dt**2 / LENGTH)


@pytest.mark.slow
def test_derivatives_of_all_orders():
    """Of cos(√c t) by c, forward, reverse and twice; and by each of the forces on the way, beside differences."""
    n, dt = 7, 0.3 * TIME
    t, c = n * dt, 4.0 / TIME**2

    def end(c):
        stepper = jl.stepper(oscillator, dt, {"c": c})
        return rolled(stepper, stepper.start(LENGTH, 0.0), length=n)[0].q / LENGTH

    exact = lambda c: jnp.cos(jnp.sqrt(c) * t)
    for derivative in (jax.grad, jax.jacfwd, lambda f: jax.jacfwd(jax.grad(f))):
        np.testing.assert_allclose(derivative(end)(c), derivative(exact)(c), rtol=1e-6)


@pytest.mark.slow
def test_derivatives_by_forces_that_jump():
    """By each of the forces, and by a bound; none while a block rests under less than that, be it zero or not."""
    dt, F = 0.7 * TIME, 3e-3 * LENGTH / TIME**2
    forces = jnp.asarray(F * np.array([2.0, 1.5, -3.0, 0.5, 0.0, -2.0]))

    def end(forces, F):
        stepper = jl.stepper(block, dt, {"m": 2e-3, "F": F}, inputs={"u": 0.0})
        return rolled(stepper, stepper.start(0.0, 0.0), forces)[0].q / LENGTH

    def by_hand(forces, F):
        q, v = 0.0, 0.0
        for u in forces:
            q, v = pushed(q, v, 2e-3, F, dt, u)
        return q / LENGTH

    h = 1e-5 * F
    differences = [(by_hand(np.asarray(forces) + h * e, F) - by_hand(np.asarray(forces) - h * e, F)) / (2 * h) for e in np.eye(6)]
    found = jax.grad(end, argnums=(0, 1))(forces, F)
    np.testing.assert_allclose(found[0] * F, np.array(differences) * F, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(found[1] * F, (by_hand(forces, F + h) - by_hand(forces, F - h)) / (2 * h) * F, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(jax.jacfwd(end)(forces, F), found[0], rtol=1e-9, atol=1e-9 * np.max(np.abs(found[0])))
    np.testing.assert_array_equal(jax.grad(end, argnums=(0, 1))(0.5 * forces / 3, F)[0], 0)


def test_a_batch_of_starts():
    """Under `vmap`, the states of each."""
    stepper = jl.stepper(ball, 0.05, {"g": 9.81})
    heights = jnp.array([0.3, 1.0, 2.0])
    states, _ = jax.vmap(lambda q: rolled(stepper, stepper.start(q, 0.0), length=20))(heights)
    each = [rolled(stepper, stepper.start(q, 0.0), length=20)[0] for q in heights]
    np.testing.assert_allclose(states.q, [state.q for state in each], rtol=1e-12)
    np.testing.assert_allclose(states.t, 1.0)


@pytest.mark.slow
def test_constraints_states_and_events_are_those_of_simulate():
    """A rod with friction in its joint, a filter of its height, and a kick each time that it passes the lowest point."""
    system = jl.System(
        lambda q, qdot, g: 0.5 * (qdot["x"] ** 2 + qdot["y"] ** 2) - g * q["y"],
        dissipation=lambda q, qdot, F: F * jnp.abs(q["x"] * qdot["y"] - q["y"] * qdot["x"]),
        holonomic={"rod": lambda q, l: q["x"] ** 2 + q["y"] ** 2 - l**2},
        states={"low": jl.State(lambda q, low, l: q["y"] / l - low, 0.0)},
        events={"kick": jl.Event(lambda q: q["x"], lambda qdot: {"qdot": jax.tree.map(lambda v: 1.1 * v, qdot)})},
    )
    params = {"g": 9.81, "F": 0.05, "l": 2.0}
    start = {"x": 1.2, "y": -1.6}, {"x": 0.0, "y": 0.0}
    stepper = jl.stepper(system, 0.1, params)
    state, q = rolled(stepper, stepper.start(*start, 5.0), length=30)
    motion = jl.simulate(system, *start, 5 + 0.1 * np.arange(31), params)
    np.testing.assert_allclose(q["x"], motion.q["x"][1:], atol=1e-7)
    np.testing.assert_allclose(state.states["low"], motion.states["low"][-1], atol=1e-7)


def test_what_fails_says_so():
    """At the start and within a step; what follows is NaN, for the same reason."""
    stepper = jl.stepper(jl.System(lambda qdot: 0.5 * qdot**2, force=lambda t: jnp.sqrt(2.5 - t)), 1.0)
    state, q = rolled(stepper, stepper.start(0.0, 0.0), length=4)
    assert state.result == jl.results.RESULTS.undefined
    np.testing.assert_array_equal(np.isnan(q), [False, False, True, True])
    state = jl.stepper(jl.System(lambda q, qdot: 0.5 * qdot[0] ** 2), 1.0).start(jnp.zeros(2), jnp.zeros(2))
    assert state.result == jl.results.RESULTS.no_inertia


def test_what_cannot_be_is_refused():
    """With what to do instead."""
    sampled = jl.System(lambda qdot: 0.5 * qdot**2, force=lambda u: u, states={"u": jl.Sampled(lambda u: u, 0.1)})
    with pytest.raises(ValueError, match="`system` must have no sampled states, but has u"):
        jl.stepper(sampled, 0.1)
    stepper = jl.stepper(block, 0.1, {"m": 1.0, "F": 1.0}, inputs={"u": 0.0})
    state = stepper.start(0.0, 0.0)
    with pytest.raises(ValueError, match="`inputs` must be among those that the stepper has, u, but hold w"):
        stepper(state, {"w": 1.0})
    with pytest.raises(ValueError, match=r"`inputs\['u'\]` must be shaped as"):
        stepper(state, {"u": jnp.ones(2)})
    with pytest.raises(TypeError, match="`inputs` must be a mapping"):
        stepper(state, 1.0)
    with pytest.raises(ValueError, match="`dt` must be positive"):
        jl.stepper(block, 0.0)
    with pytest.raises(TypeError, match="`params` must be a mapping"):
        jl.stepper(block, 0.1, 1.0)


@pytest.mark.slow
def test_derivatives_by_many_numbers():
    """Of a chain of 60 masses, whose state has 120 numbers: each step pulls back, and all together what one motion does."""
    chain = jl.System(lambda q, qdot, c: 0.5 * qdot @ qdot - 0.5 * c * (q[0] ** 2 + jnp.sum(jnp.diff(q) ** 2)))
    start, still, c = jnp.linspace(0, 1, 60) ** 2, jnp.zeros(60), 3.0

    def by_steps(start, c):
        stepper = jl.stepper(chain, 0.2, {"c": c})
        return jnp.sum(rolled(stepper, stepper.start(start, still), length=5)[0].q ** 2)

    at_once = lambda start, c: jnp.sum(jl.simulate(chain, start, still, jnp.array([0.0, 1.0]), {"c": c}).q[-1] ** 2)
    for found, expected in zip(*(jax.grad(f, argnums=(0, 1))(start, c) for f in (by_steps, at_once)), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_single_precision():
    """Steps and their states keep the precision that they are given."""
    stepper = jl.stepper(ball, 0.05, {"g": 9.81})
    state = stepper.start(np.float32(1.0), np.float32(0.0))
    state, q = rolled(stepper, state, length=20)
    assert q.dtype == np.float32
    motion = jl.simulate(ball, 1.0, 0.0, np.linspace(0, 1, 21), {"g": 9.81})
    np.testing.assert_allclose(q, motion.q[1:], atol=1e-3)
