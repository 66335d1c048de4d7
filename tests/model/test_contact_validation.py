"""What contacts must be, and where they are refused."""

import pickle

import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl


def fall(q, qdot):
    return 0.5 * qdot**2 - 9.81 * q


def floor(q):
    return q


ball = jl.System(fall, unilateral={"floor": floor})


@pytest.mark.parametrize(
    ("make", "error", "said"),
    [
        (lambda: jl.Contact(3.0), TypeError, "`gap` must be a function"),
        (lambda: jl.Contact(floor, restitution=1.5), ValueError, "`restitution` must be from 0 to 1, but is 1.5"),
        (lambda: jl.Contact(floor, restitution=-0.1), ValueError, "`restitution` must"),
        (lambda: jl.System(fall, unilateral={"floor": 0.0}), TypeError, "`unilateral` must hold gaps"),
        (lambda: jl.System(fall, holonomic={"floor": floor}, unilateral={"floor": floor}), ValueError, "'floor'"),
    ],
    ids=["no function", "above one", "below zero", "a number", "twice"],
)
def test_what_is_refused_when_it_is_stated(make, error, said):
    with pytest.raises(error, match=said):
        make()


@pytest.mark.parametrize("gap", [lambda q: q[:0], lambda q: {"left": q[0], "right": q[1]}], ids=["none", "a tree"])
def test_gaps_are_numbers_or_an_array_of_them(gap):
    plane = jl.System(lambda qdot: 0.5 * (qdot @ qdot), unilateral={"walls": gap})
    with pytest.raises(ValueError, match="`unilateral` 'walls' must return"):
        jl.simulate(plane, jnp.ones(2), -jnp.ones(2), jnp.array([0.0, 1.0]))


@pytest.mark.parametrize("gap", [lambda q: 0.3, lambda t: 0.5 - t, lambda w: w], ids=["a number", "of time", "of params"])
def test_a_gap_between_things_that_are_both_fixed(gap):
    fixed = jl.System(fall, unilateral={"floor": floor, "walls": gap})
    with pytest.raises(ValueError, match="`unilateral` 'walls' must depend on q, but does not"):
        jl.simulate(fixed, 1.0, 0.0, jnp.array([0.0, 1.0]), {"w": 0.3})


@pytest.mark.slow
def test_walls_that_close_in():
    """What lies between them can go nowhere, which is the reason, at the time when they touch it on both sides."""
    press = jl.System(fall, unilateral={"below": floor, "above": lambda t, q: 1.5 - 2 * t - q})
    motion = jl.simulate(press, 1.0, 0.0, jnp.linspace(0, 1, 4), throw=False)
    assert motion.result == jl.results.RESULTS.beyond_reach
    np.testing.assert_allclose(motion.stats["reached"], 0.75, atol=1e-6)
    np.testing.assert_array_equal(np.isfinite(motion.q), [True, True, True, False])


@pytest.mark.slow
def test_a_start_inside_an_obstacle_is_put_on_it():
    motion = jl.simulate(ball, -0.25, 0.0, jnp.array([0.0, 1.0]))
    np.testing.assert_allclose(motion.q, 0, atol=1e-15)
    np.testing.assert_allclose(motion.stats["start_moved"], 0.25)
    assert np.all(motion.contacts["floor"].closed)


@pytest.mark.slow
def test_a_start_inside_of_what_has_no_outside():
    cage = jl.System(fall, unilateral={"below": lambda q: -1 - q**2})
    motion = jl.simulate(cage, 0.1, 0.0, jnp.array([0.0, 1.0]), throw=False)
    assert motion.result == jl.results.RESULTS.inside_obstacle and np.all(np.isnan(motion.q))


@pytest.mark.slow
def test_friction_that_is_not_proportional_to_the_force():
    sled = jl.System(
        lambda q, qdot: 0.5 * (qdot @ qdot) - 9.81 * q[1],
        dissipation={"rub": lambda qdot, multipliers: 0.1 * multipliers["floor"] ** 2 * jnp.abs(qdot[0])},
        unilateral={"floor": lambda q: q[1]},
    )
    motion = jl.simulate(sled, jnp.array([0.0, 1.0]), jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0]), throw=False)
    assert motion.result == jl.results.RESULTS.not_impulsive
    with pytest.raises(ValueError, match="`friction` must be `StickSlip"):
        jl.simulate(sled, jnp.array([0.0, 1.0]), jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0]), friction=jl.Regularised(1e-3))


@pytest.mark.parametrize(
    "use",
    [
        lambda: jl.equations(ball, 1.0, linearised_at=0.0),
        lambda: jl.regress(ball, jl.Experiment(jnp.linspace(0, 1, 11), jnp.linspace(0, 1, 11), 1.0, 0.0), {"m": 1.0}, free=("m",)),
    ],
    ids=["equations", "regress"],
)
def test_where_contacts_are_refused(use):
    with pytest.raises(ValueError, match="`system` must have no contacts that open and close"):
        use()


def test_at_one_state():
    """q̈ and λ, and what `examine` says, of a contact that is open and of one that is closed."""
    for q, acceleration, force in ((1.0, -9.81, 0.0), (0.0, 0.0, 9.81)):
        found = jl.acceleration(ball, q, 0.0)
        np.testing.assert_allclose([found.qddot, found.multipliers["floor"]], [acceleration, force], atol=1e-14)
        assert jl.examine(ball, q, 0.0).contacts == {"floor": q == 0}


@pytest.mark.slow
def test_a_system_with_contacts_is_pickled():
    again = pickle.loads(pickle.dumps(ball))
    motion = jl.simulate(again, 1.0, 0.0, jnp.array([0.0, 2.0]))
    assert motion.contacts["floor"].closed[-1] and "floor" in repr(again)


@pytest.mark.slow
def test_a_motion_is_saved_and_sliced(tmp_path):
    motion = jl.simulate(ball, 1.0, 0.0, jnp.linspace(0, 1, 11))
    motion.save(tmp_path / "ball.npz")
    again = jl.load(tmp_path / "ball.npz")
    np.testing.assert_array_equal(again.contacts["floor"].closed, motion.contacts["floor"].closed)
    np.testing.assert_array_equal(motion[5:].contacts["floor"].impacts, motion.contacts["floor"].impacts[5:])
    assert "contacts.floor.closed" in motion.to_dict() and "floor" in repr(motion)


def test_speed_names_one_thing():
    """The speed of approach, where a restitution asks for it; elsewhere an entry of params may be called so."""
    contact = lambda restitution: {"floor": jl.Contact(lambda q: q, restitution=restitution)}
    falling = lambda e: jl.System(lambda q, qdot, speed: 0.5 * qdot**2 - speed * q, unilateral=contact(e))
    assert jl.acceleration(falling(0.5), 1.0, 0.0, {"speed": 9.0}).qddot == -9.0
    with pytest.raises(ValueError, match=r"`params` must not have an entry named 'speed' where `restitution` of 'floor' asks"):
        jl.acceleration(falling(lambda speed: 1 / (1 + speed)), 1.0, 0.0, {"speed": 9.0})
