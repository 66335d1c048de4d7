"""Events: located, recorded, differentiated; against closed forms and SciPy's events. At jumps and in great number: `test_event_kinds`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxlag as jl

G = 9.81


def oscillator(q, qdot, c):
    return 0.5 * qdot**2 - 0.5 * c * q**2


TIMES = np.linspace(0, 10, 21)


@pytest.mark.parametrize(
    ("direction", "first"),
    [
        (jl.direction.Falling(), 0),
        pytest.param(jl.direction.Rising(), 1, marks=pytest.mark.slow),
        pytest.param(jl.direction.Either(), None, marks=pytest.mark.slow),
    ],
    ids=["falling", "rising", "either"],
)
def test_turning_points_are_counted(direction, first):
    """q̇ = cos 2t is zero at π/4 + kπ/2, falling and rising in turn."""
    system = jl.System(oscillator, events={"turn": jl.Event(lambda qdot: qdot, direction=direction)})
    motion = jl.simulate(system, 0.0, 1.0, TIMES, {"c": 4.0}, rtol=1e-11, atol=1e-13)
    every = np.pi / 4 + np.pi / 2 * np.arange(6)
    expected = every[first::2] if first is not None else every
    turn = motion.events["turn"]
    np.testing.assert_allclose(turn.ts[: len(expected)], expected, rtol=1e-10)
    assert np.all(np.isnan(turn.ts[len(expected) :])) and turn.ts.shape == (100,)
    np.testing.assert_allclose(turn.q[: len(expected)], np.sin(2 * expected) / 2, atol=1e-10)
    np.testing.assert_array_equal(turn.count, np.searchsorted(expected, TIMES))


turning = jl.System(oscillator, events={"turn": jl.Event(lambda qdot: qdot)})


@pytest.mark.slow
def test_derivatives_of_the_time_of_an_event():
    """t = 5π/4 ω⁻¹ 2: forward, reverse and of second order."""
    third = lambda c: jl.simulate(turning, 0.0, 1.0, jnp.array([0.0, 10.0]), {"c": c}, rtol=1e-11, atol=1e-13).events["turn"].ts[2]
    by_hand = lambda c: 2.5 * jnp.pi / jnp.sqrt(c)
    np.testing.assert_allclose(jax.jacfwd(third)(4.0), jax.grad(by_hand)(4.0), rtol=1e-9)
    np.testing.assert_allclose(jax.grad(third)(4.0), jax.grad(by_hand)(4.0), rtol=1e-9)
    np.testing.assert_allclose(jax.jacfwd(jax.jacfwd(third))(4.0), jax.hessian(by_hand)(4.0), rtol=1e-6)


engaging = jl.System(  # a second spring beyond q = 0.3, which stays engaged; and a clutch that lets go when q comes back
    lambda q, qdot, engaged: 0.5 * qdot**2 - 2.0 * q**2 - 0.5 * engaged * 30.0 * (q - 0.3) ** 2,
    states={"engaged": jl.State(lambda: 0.0)},
    events={
        "in": jl.Event(lambda q: q - 0.3, lambda: {"states": {"engaged": 1.0}}, direction=jl.direction.Rising()),
        "out": jl.Event(lambda q: q - 0.1, lambda: {"states": {"engaged": 0.0}}, direction=jl.direction.Falling()),
        "end": jl.Event(lambda t, T: t - T, stop=True, most=1),
    },
)


@pytest.mark.slow
def test_springs_that_engage_and_the_end():
    """A state that an event changes: against SciPy's events; the energy that it brings along is in the balance."""
    T = 7.3
    motion = jl.simulate(engaging, 0.0, 1.0, TIMES, {"T": T}, works=True, rtol=1e-11, atol=1e-13)
    t, y, c, rows = 0.0, np.array([0.0, 1.0]), 0.0, []
    for _ in range(40):
        level, way = (0.1, -1) if c else (0.3, 1)
        event = lambda t, y, level=level: y[0] - level
        event.terminal, event.direction = True, way
        rates = lambda t, y, c=c: [y[1], -4 * y[0] - c * (y[0] - 0.3)]
        part = solve_ivp(rates, (t, T), y, "DOP853", events=event, rtol=1e-12, atol=1e-13, dense_output=True)
        rows += [part.sol(s) for s in TIMES[len(rows) :] if s <= part.t[-1]]
        t, y = part.t[-1], part.y[:, -1]
        if part.status != 1:
            break
        c = 0.0 if c else 30.0
    there = TIMES <= T
    np.testing.assert_allclose(np.stack([motion.q, motion.qdot], axis=1)[there], rows, atol=1e-8)
    assert motion.succeeded and np.all(np.isnan(motion.q[~there]))
    np.testing.assert_allclose(motion.events["end"].ts, [T], rtol=1e-14)
    np.testing.assert_allclose(motion.events["end"].q[0], y[0], atol=1e-8)
    assert np.nanmax(np.abs(motion.balance())) < 1e-9


@pytest.mark.slow
def test_a_rope_that_breaks():
    """A rod that breaks where its force reaches a limit: then a parabola. Differentiated by the limit."""
    rope = jl.System(
        lambda q, qdot: 0.5 * (qdot @ qdot) - G * q[1],
        holonomic={"rope": lambda q, whole: whole * (q @ q - 1.0)},
        states={"whole": jl.State(lambda: 0.0, start=1.0)},
        events={"breaks": jl.Event(lambda multipliers, F: F + 2 * multipliers["rope"], lambda: {"states": {"whole": 0.0}}, most=1)},
    )

    def end(F):
        ts = jnp.array([0.0, 1.0])
        motion = jl.simulate(rope, jnp.array([1.0, 0.0]), jnp.zeros(2), ts, {"F": F}, rtol=1e-11, atol=1e-13)
        return jnp.concatenate([motion.q[-1], motion.events["breaks"].ts])

    def by_hand(F):  # from the horizontal: the force is 3 g sin a, at the angle a below it
        a = np.arcsin(F / (3 * G))
        swing = solve_ivp(lambda t, y: [y[1], G * np.cos(y[0])], (0, 1), [0.0, 0.0], "DOP853", rtol=1e-12, atol=1e-13, dense_output=True)
        from scipy.optimize import brentq

        t = brentq(lambda t: swing.sol(t)[0] - a, 1e-3, 1.0, xtol=1e-15)
        v, s = swing.sol(t)[1], 1.0 - t
        x = np.array([np.cos(a), -np.sin(a)]) + s * v * np.array([-np.sin(a), -np.cos(a)]) - np.array([0, G * s**2 / 2])
        return np.array([*x, t])

    np.testing.assert_allclose(end(20.0), by_hand(20.0), atol=1e-8)
    np.testing.assert_allclose(jax.jacfwd(end)(20.0), (by_hand(20.001) - by_hand(19.999)) / 0.002, atol=1e-6)


@pytest.mark.slow
def test_given_times():
    """Pushes at three times, and what is true at the start already."""
    pushed = jl.System(
        lambda q, qdot: 0.5 * qdot**2,
        events={
            "push": jl.Event([1.0, 2.5, 3.0], lambda qdot: {"qdot": qdot + 1.0}),
            "above": jl.Event(lambda q: q - 2.0, direction=jl.direction.Rising()),
            "below": jl.Event(lambda q: q - 3.0, direction=jl.direction.Negative()),
        },
    )
    motion = jl.simulate(pushed, 2.5, 0.0, np.linspace(0, 4, 9) + 1e-3 * (np.arange(9) > 0))
    np.testing.assert_allclose(motion.qdot, [0, 0, 1, 1, 1, 2, 3, 3, 3], atol=1e-13)
    np.testing.assert_allclose(motion.q[-1], 2.5 + 3.001 + 1.501 + 1.001, rtol=1e-13)
    np.testing.assert_allclose(motion.events["push"].ts[:4], [1.0, 2.5, 3.0, np.nan], rtol=1e-14)
    assert motion.events["above"].count[-1] == 0
    np.testing.assert_allclose(motion.events["below"].ts[:2], [0.0, np.nan])


@pytest.mark.slow
def test_many_members():
    """Members of a batch have their events at different times."""
    c = np.linspace(1, 9, 17)
    motions = jl.simulate_many(turning, jnp.zeros(17), jnp.ones(17), jnp.array([0.0, 6.0]), {"c": c}, over=("q0", "qdot0", "c"))
    np.testing.assert_allclose(motions.events["turn"].ts[:, 0], np.pi / 2 / np.sqrt(c), rtol=1e-7)


@pytest.mark.slow
def test_clear_errors():
    for make, said in (
        (lambda: jl.Event(lambda q: q, direction="up"), "`direction` must be"),
        (lambda: jl.Event([2.0, 1.0]), "`when` must be increasing"),
        (lambda: jl.Event(lambda q: q, most=0), "`most` must be"),
        (lambda: jl.System(oscillator, events=jl.Event(lambda q: q)), "`events` must be a mapping"),
        (lambda: jl.System(oscillator, events={"a": lambda q: q}), "`events` must be a mapping"),
    ):
        with pytest.raises((TypeError, ValueError), match=said):
            make()
    for then, said in ((lambda: {"speed": 1.0}, "'speed'"), (lambda: {"qdot": jnp.ones(2)}, "must return what has the shape")):
        with pytest.raises(ValueError, match=said):
            jl.simulate(jl.System(oscillator, events={"a": jl.Event(lambda q: q, then)}), 0.0, 1.0, TIMES, {"c": 4.0})
    trapped = jl.System(oscillator, events={"a": jl.Event(lambda q: q - 0.1, lambda qdot: {"q": 0.05}, most=5)})
    motion = jl.simulate(trapped, 0.0, 1.0, TIMES, {"c": 4.0}, throw=False)
    assert motion.result == jl.results.RESULTS.too_many_events
