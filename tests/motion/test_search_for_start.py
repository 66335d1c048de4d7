"""Starts that lie on the constraints are not searched for: what comes out is the same to rounding, and others are put there as ever.

Within `jax.jit` the numbers of a start are not known, and all of the search is in the program: it serves as the reference.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._motion import search_for_start

TS = np.linspace(0.3, 1.3, 6)
ROUNDING = 1e-13


@pytest.fixture
def searched(monkeypatch):
    """What was left of each search."""
    found, original = [], search_for_start.search_for

    def noted(*given, **named):
        found.append(original(*given, **named))
        return found[-1]

    monkeypatch.setattr("jaxlag._motion.simulate.search_for", noted)
    return found


def curve(t, q, p):
    """Two rows on five coordinates, curved and driven."""
    return jnp.stack([p["a"] @ q + 0.2 * jnp.sin(q[0] * q[1]) - p["s"] * t, (q**2).sum() - 2.5 + 0.1 * t * q[2]])


def rolling(q, qdot, p):
    return p["e"] @ qdot - q[3] * qdot[4]


def lagrangian(q, qdot, p):
    return 0.5 * (1 + q[1] ** 2) * (qdot @ qdot) + 0.25 * (p["a"] @ qdot) ** 2 - 9.81 * p["e"] @ q


system = jl.System(
    lambda q, qdot, p: lagrangian(q, qdot, p), holonomic=lambda t, q, p: curve(t, q, p), nonholonomic=lambda q, qdot, p: rolling(q, qdot, p)
)


def cases(count):
    random = np.random.default_rng(7)
    for _ in range(count):
        p = {"a": random.normal(size=5), "e": random.normal(size=5), "s": 0.1 * random.normal()}
        start = random.normal(size=5), random.normal(size=5)
        q, qdot = jl.consistent_state(system, *start, {"p": p}, t=TS[0])
        yield np.asarray(q), np.asarray(qdot), {"p": p}


@jax.jit
def within_jit(q, qdot, params):
    return jl.simulate(system, q, qdot, TS, params, throw=False)


@pytest.mark.slow
def test_random_starts_on_the_constraints_and_beside_them(searched):
    """The nearest state is as near as ten roundings."""
    random, nothing = np.random.default_rng(8), 0
    for q, qdot, params in cases(20):
        motion, search = jl.simulate(system, q, qdot, TS, params), searched[-1]
        reference = within_jit(q, qdot, params)
        np.testing.assert_allclose(motion.q, reference.q, atol=1e-9)  # 1/10 of a step's tolerance: steps follow the last bits of the start
        np.testing.assert_allclose(motion.q[0], reference.q[0], atol=ROUNDING)
        np.testing.assert_allclose(motion.qdot[0], reference.qdot[0], atol=10 * ROUNDING)
        nothing += search == "nothing"
        assert search == "all" or motion.stats["start_moved"] == 0
        for off in (10.0 ** random.uniform(-12, -1), 1e-12):
            aside = jl.simulate(system, q + off * random.normal(size=5), qdot, TS, params)
            assert searched[-1] == "all"
            assert aside.stats["start_moved"] > 0
    assert nothing > 10  # of twenty that Newton's method has found: the others are off by more than some roundings


@pytest.mark.slow
def test_derivatives_of_a_start_that_is_not_searched_for(searched):
    """The start moves along with the length of the rod and the speed of its end: forward, reverse and twice, as within `jit`."""
    rod = jl.System(lambda q, qdot: 0.5 * (qdot @ qdot) - 9.81 * q[1], holonomic=lambda t, q, l, s: jnp.hypot(q[0], q[1]) - l - s * t)

    def end(x):
        return jl.simulate(rod, jnp.stack([0.6, 0.8 + x[2]]), np.zeros(2), TS - TS[0], {"l": 1 + x[0], "s": x[1]}).q[-1, 0]

    zero = jnp.zeros(3)
    for derivative in (jax.grad, jax.jacfwd, jax.hessian):
        found = derivative(end)(zero)
        assert searched[-1] == "derivative"
        np.testing.assert_allclose(found, jax.jit(derivative(end))(zero), rtol=1e-6)
        assert searched[-1] == "all"


@pytest.mark.slow
def test_a_batch_is_put_on_the_constraints_member_by_member(searched):
    """The first of an eager batch lies on the circle, the second beside it."""
    pendulum = jl.System(lambda qdot: 0.5 * qdot @ qdot, holonomic=lambda q: q @ q - 1)
    moved = jax.vmap(lambda q: jl.simulate(pendulum, q, np.zeros(2), [0.0, 1.0]).stats["start_moved"])(jnp.array([[1.0, 0.0], [2.0, 0.0]]))
    assert searched == ["all"]
    np.testing.assert_allclose(moved, [0, 1], atol=ROUNDING)


@pytest.mark.slow
def test_a_constraint_that_closes_over_what_is_differentiated_or_a_batch(searched):
    """What is differentiated would not be seen among the arguments: it is refused. Of a batch each member has its own length."""

    def closed_over(l):
        rod = jl.System(lambda q, qdot: 0.5 * (qdot @ qdot) - 9.81 * q[1], holonomic=lambda q: jnp.hypot(q[0], q[1]) - l)
        return jl.simulate(rod, np.array([0.6, 0.8]), np.zeros(2), TS).q[-1, 0]

    rod = jl.System(lambda q, qdot: 0.5 * (qdot @ qdot) - 9.81 * q[1], holonomic=lambda q, l: jnp.hypot(q[0], q[1]) - l)
    stated = lambda l: jl.simulate(rod, np.array([0.6, 0.8]), np.zeros(2), TS, {"l": l}).q[-1, 0]
    with pytest.raises(ValueError, match="must take what is differentiated from params, but closes over 'l'"):
        jax.jvp(closed_over, (1.0,), (1.0,))
    np.testing.assert_allclose(jax.vmap(closed_over)(jnp.array([1.0, 1.2])), [stated(1.0), stated(1.2)], rtol=1e-8)
    assert searched == ["all"]


@pytest.mark.slow
@pytest.mark.parametrize("rate, search", [(0.7, "nothing"), (0.0, "all")])
def test_a_support_that_moves_takes_a_start_at_rest_along(rate, search, searched):
    lift = jl.System(lambda qdot: 0.5 * qdot @ qdot, holonomic=lambda t, q: q[1] - 0.7 * t)
    motion = jl.simulate(lift, np.zeros(2), np.array([0.2, rate]), [0.0, 1.0])
    assert searched == [search]
    np.testing.assert_allclose([motion.q[-1], motion.qdot[0]], [[0.2, 0.7]] * 2, rtol=1e-12)


@pytest.mark.slow
def test_a_support_that_begins_to_move_at_the_start(searched):
    """Recorded from before: what rests has to move along with what follows."""
    lift = jl.System(lambda qdot: 0.5 * qdot @ qdot, holonomic=lambda t, q, way: q[1] - way(t))
    way = jl.Signal(np.array([-1.0, 0.0, 2.0]), np.array([0.0, 0.0, 1.4]), jl.interpolation.Linear())
    motion = jl.simulate(lift, np.zeros(2), np.array([0.2, 0.0]), [0.0, 1.0], {"way": way})
    assert searched == ["all"]
    np.testing.assert_allclose([motion.q[-1], motion.qdot[0]], [[0.2, 0.7]] * 2, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_units_do_not_matter(scale, searched):
    """A start that is a millionth off its length is put right, however long the length is."""
    rod = jl.System(lambda qdot: 0.5 * qdot @ qdot, holonomic=lambda q, l: q @ q / l - l)
    for off, search in ((0.0, "nothing"), (1e-6, "all")):
        motion = jl.simulate(rod, scale * np.array([0.6, 0.8 + off]), np.zeros(2), [0.0, 1.0], {"l": scale})
        assert searched.pop() == search
        np.testing.assert_allclose(np.hypot(*motion.q[0]), scale, rtol=1e-12)


half_massless = jl.System(lambda qdot, m: 0.5 * qdot[0] ** 2 + 0.5 * m * qdot[1] ** 2, holonomic=lambda q: q[0] - 1)
undefined = jl.System(lambda q, qdot: 0.5 * jnp.sqrt(q[1]) * (qdot @ qdot), holonomic=lambda q: q[0] - 1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "system, q0, params, reason",
    [
        (half_massless, np.array([1.0, 0.0]), {"m": 0.0}, "`lagrangian` must give every direction inertia"),
        (undefined, np.array([1.0, -1.0]), None, "must return finite numbers"),
    ],
)
def test_what_is_wrong_with_a_start_on_the_constraints_is_said_as_within_jit(system, q0, params, reason):
    start = q0, 0 * q0, TS, params
    with pytest.raises((ValueError, RuntimeError), match=reason):
        jl.simulate(system, *start)
    reasons = [
        run().result
        for run in (lambda: jl.simulate(system, *start, throw=False), jax.jit(lambda: jl.simulate(system, *start, throw=False)))
    ]
    assert bool(reasons[0] == reasons[1])


@pytest.mark.slow
def test_with_friction_in_the_joint(searched):
    """Coulomb's torque F l on a rod at rest, in two ways to know the start."""
    lagrangian = lambda q, qdot, g: 0.5 * (qdot @ qdot) - g * q[1]
    joint = lambda q, qdot, F: F * jnp.abs(q[0] * qdot[1] - q[1] * qdot[0])
    pendulum = jl.System(lagrangian, dissipation={"joint": joint}, holonomic=lambda q: jnp.hypot(q[0], q[1]) - 1)
    end = lambda F: jl.simulate(pendulum, np.array([1.0, 0.0]), np.zeros(2), TS, {"g": 9.81, "F": F})
    motion, reference = end(2.0), jax.jit(end)(2.0)
    assert searched == ["nothing", "all"]
    np.testing.assert_allclose(motion.q, reference.q, atol=1e-9)
