"""Events of all kinds: several in one step, at jumps, by times, at impacts, that end a motion; in batches, files, with friction."""

import copy
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

G = 9.81


def free(q, qdot):
    return 0.5 * qdot**2


def polynomial(q, roots):
    return jnp.prod(q - roots)


crossing = jl.System(free, events={"zero": jl.Event(polynomial), "up": jl.Event(polynomial, direction=jl.direction.Rising())})


@pytest.mark.slow
def test_many_random_zeros_within_single_steps():
    """A free particle, which takes as long steps as it may: 400 polynomials with five zeros, some of them hardly apart."""
    rng = np.random.default_rng(3)
    roots = rng.uniform(0.05, 9.95, (400, 5))
    close = rng.integers(0, 5, 400), rng.integers(0, 5, 400)
    apart = 10.0 ** rng.uniform(-5, 0, 400)
    roots[np.arange(400), close[0]] = np.clip(roots[np.arange(400), close[1]] + apart, 0.01, 9.99)
    expected = np.sort(roots)
    distinct = np.min(np.diff(expected), axis=1) > 1e-6
    motions = jl.simulate_many(crossing, 0.0, 1.0, jnp.array([0.0, 10.0]), {"roots": jnp.asarray(roots)}, over=("roots",))
    zero, up = (np.asarray(motions.events[name].ts) for name in ("zero", "up"))
    condition = np.max(np.abs(expected), axis=1) * 2e-12 / np.min(np.diff(expected), axis=1)
    assert np.all(np.abs(zero[distinct, :5] - expected[distinct]) <= 1e-11 + condition[distinct, None])
    assert np.all(np.isnan(zero[distinct, 5:])) and distinct.sum() > 350
    np.testing.assert_allclose(up[distinct, :3], zero[distinct, 0:5:2], rtol=1e-13)  # the first goes up: five factors are negative


kinds = jl.System(
    free,
    states={"z": jl.State(lambda: 0.0)},
    events={
        "chained": jl.Event(lambda z: z - 0.5, lambda qdot: {"qdot": 2 * qdot}),
        "kick": jl.Event(lambda q: q - 4.2, lambda: {"states": {"z": 1.0}}),
        "both": jl.Event(lambda q: (q - 1.0) * (q - 1.0001)),
        "rough": jl.Event(lambda q: jnp.abs(q - 3.0) - 1e-5),
        "every": jl.Event(jl.Every(lambda T: T)),
        "times": jl.Event([0.0, 0.5, 4.0]),
    },
)


@pytest.mark.slow
def test_kinds():
    """In one motion: pairs in one step, periods, times (not that of the start), and one that another takes across zero."""
    motion = jl.simulate(kinds, 0.0, 1.0, jnp.array([0.0, 5.0]), {"T": 0.7})
    expected = {
        "both": [1.0, 1.0001],
        "chained": [4.2],
        "every": 0.7 * np.arange(1, 8),
        "kick": [4.2],
        "rough": [3 - 1e-5, 3 + 1e-5],
        "times": [0.5, 4.0],
    }
    for name, ts in expected.items():
        np.testing.assert_allclose(motion.events[name].ts[: len(ts) + 1], [*ts, np.nan], rtol=1e-12)
    np.testing.assert_allclose([motion.q[-1], motion.qdot[-1]], [4.2 + 2 * 0.8, 2.0], rtol=1e-13)
    np.testing.assert_allclose(motion.events["chained"].qdot[0], 1.0)  # the state before all that happens there
    last = jax.jacfwd(lambda T: jl.simulate(kinds, 0.0, 1.0, jnp.array([0.0, 5.0]), {"T": T}).events["every"].ts[6])
    np.testing.assert_allclose(last(0.7), 7.0, rtol=1e-12)


@pytest.mark.slow
def test_events_of_one_motion():
    """`simulate(..., events=...)`: in place of those of the system; the end of it is the event's, and a success."""
    end = {"end": jl.Event(lambda q, L: q - L, stop=True)}

    def run(L):
        motion = jl.simulate(crossing, 0.0, 1.0, jnp.linspace(0.0, 5.0, 6), {"L": L}, events=end)
        return motion.events["end"].ts[0], motion

    (t, motion), slope = run(2.5), jax.grad(lambda L: run(L)[0])(2.5)
    assert motion.succeeded and list(motion.events) == ["end"]
    np.testing.assert_allclose([t, slope, motion.stats["reached"]], [2.5, 1.0, 2.5], rtol=1e-13)
    np.testing.assert_allclose(motion.q, [0, 1, 2, np.nan, np.nan, np.nan], atol=1e-14)
    assert crossing.with_events(end) == crossing.with_events(dict(end)) != crossing


def rising(qdot):
    return qdot


def height(q):
    return q


def weight(q, qdot):
    return 0.5 * qdot**2 - G * q


ball = jl.System(
    weight,
    unilateral={"floor": jl.Contact(height, 0.8)},
    events={
        "click": jl.Event("floor"),
        "turn": jl.Event(rising, direction=jl.direction.Rising()),
        "apex": jl.Event(rising, direction=jl.direction.Falling()),
        "end": jl.Event("floor", most=64),
    },
)


@pytest.mark.slow
def test_impacts():
    """Impacts are events, and take witnesses of the velocity across zero; derivatives of their times in the height."""
    ts = jnp.linspace(0, 2.0, 21)
    first = lambda h: np.sqrt(2 * h / G)
    expected = lambda h: first(h) * np.array([1, 1 + 2 * 0.8, 1 + 2 * 0.8 + 2 * 0.64])
    motion = jl.simulate(ball, 1.0, 0.0, ts)
    for name in ("click", "turn"):
        np.testing.assert_allclose(motion.events[name].ts[:3], expected(1.0), rtol=1e-13)
    np.testing.assert_allclose(motion.events["apex"].ts[:2], first(1.0) * np.array([1.8, 1.8 + 0.8 + 0.64]), rtol=1e-12)
    np.testing.assert_allclose(motion.events["click"].qdot[:2], -np.sqrt(2 * G) * np.array([1, 0.8]), rtol=1e-12)
    third = lambda h: jl.simulate(ball, h, 0.0, ts).events["click"].ts[2]
    slope = (expected(1.0) / 2)[2]
    np.testing.assert_allclose([jax.grad(third)(1.0), jax.jacfwd(third)(1.0)], slope, rtol=1e-10)


@pytest.mark.slow
def test_files_and_copies(tmp_path):
    """What happened is in files, tables and slices; events are pickled with their system."""
    motion = jl.simulate(ball, 1.0, 0.0, jnp.linspace(0, 2.0, 21))
    motion.save(tmp_path / "motion.npz")
    loaded = jl.load(tmp_path / "motion.npz")
    for name, event in motion.events.items():
        for field in ("ts", "q", "qdot", "count"):
            np.testing.assert_array_equal(getattr(loaded.events[name], field), getattr(event, field))
    np.testing.assert_array_equal(motion.to_dict()["events.click.count"], motion.events["click"].count)
    assert motion[5:].events["click"].count.shape == (16,) and "'click': 3 times, first at t = 0.451524" in repr(motion)
    assert pickle.loads(pickle.dumps(ball)) == ball == copy.deepcopy(ball)


moving = jl.System(
    weight,
    dissipation=lambda qdot: 0.05 * qdot**2,
    unilateral={"table": jl.Contact(lambda t, q, A: q - A * jnp.sin(9 * t), 0.6)},
    events={"end": jl.Event(lambda t, T: t - T, stop=True)},
)


@pytest.mark.slow
@pytest.mark.parametrize("T", [0.9, 2.0])
def test_what_moves_on_behind_the_end(T):
    """A motion that has ended is not hit by a table that has not."""
    motion = jl.simulate(moving, 0.5, 0.0, jnp.linspace(0, 4, 41), {"A": 0.05, "T": T})
    assert motion.succeeded
    np.testing.assert_allclose([motion.events["end"].ts[0], motion.stats["reached"]], T, rtol=1e-13)
    assert np.isfinite(motion.q).sum() == int(10 * T) + 1


belt = jl.System(  # under a block, which it reverses while it slides
    lambda q, qdot: 0.5 * qdot**2,
    dissipation=lambda qdot, v, mu: mu * G * jnp.abs(qdot - v),
    states={"v": jl.State(lambda: 0.0, start=2.0)},
    events={"reverses": jl.Event([0.25], lambda v: {"states": {"v": -v}}), "halts": jl.Event(lambda qdot: qdot)},
)


@pytest.mark.slow
@pytest.mark.parametrize("mu", [0.4, 1.6])
def test_friction_and_events(mu):
    """A block on a belt, from rest: with little friction it slides when the belt reverses, with more it has been caught before."""
    motion = jl.simulate(belt, 0.0, 0.0, jnp.linspace(0, 2, 21), {"mu": mu}, works=True)
    a = mu * G
    top, way = min(a * 0.25, 2.0), a * 0.25**2 / 2 if a * 0.25 < 2 else 2.0**2 / (2 * a) + 2.0 * (0.25 - 2.0 / a)
    np.testing.assert_allclose(motion.events["halts"].ts[:2], [0.25 + top / a, np.nan], rtol=1e-9)
    np.testing.assert_allclose(motion.events["halts"].q[0], way + top**2 / (2 * a), rtol=1e-9)
    caught = 0.25 + (top + 2.0) / a
    np.testing.assert_allclose(motion.q[-1], way + (top**2 - 4.0) / (2 * a) - 2.0 * (2.0 - caught), rtol=1e-9)
    assert np.max(np.abs(motion.balance())) < 1e-9


pushed = jl.System(
    weight,
    unilateral={"floor": jl.Contact(height, 0.5)},
    events={"push": jl.Event([0.5], lambda: {"qdot": -1.0}), "click": jl.Event("floor")},
)


@pytest.mark.slow
def test_an_event_that_makes_an_impact():
    """What lies on the floor is pushed into it: it leaves with half the speed, and the impact is an event, too."""
    motion = jl.simulate(pushed, 0.0, 0.0, jnp.array([0.0, 0.45, 0.55]))
    for name in ("push", "click"):
        np.testing.assert_allclose(motion.events[name].ts[:2], [0.5, np.nan], rtol=1e-14)
    np.testing.assert_allclose(motion.qdot[1:], [0.0, 0.5 - 0.05 * G], atol=1e-12)
    np.testing.assert_allclose(motion.events["click"].qdot[0], 0.0, atol=1e-12)  # before all that happens there


@pytest.mark.parametrize("then", [None, pytest.param(lambda q: {"q": q}, marks=pytest.mark.slow)], ids=["plain", "then"])
def test_an_impact_that_ends_a_slip(then):
    """Friction of the impact takes the whole slip, and a force the body back from there: its velocity passes through zero by the impact,
    and once. Before, steps came to nothing there. Beside it, in other units and from another start of time.
    """
    disc = jl.System(
        lambda q, qdot, g: 0.5 * (qdot["x"] ** 2 + qdot["y"] ** 2) - g * q["y"],
        dissipation=lambda qdot, multipliers: multipliers["floor"] * jnp.abs(qdot["x"]),
        force=lambda f: {"x": -f},
        unilateral={"floor": jl.Contact(lambda q: q["y"], 0.5)},
        events={"turn": jl.Event(lambda qdot: qdot["x"], then)},
    )

    @jax.jit
    def found(h, length, time, t0):
        g, f = 10.0 * length / time**2, 0.1 * length / time**2
        start = {"x": 0 * length, "y": h * length}, {"x": length / time, "y": 0 * length}
        motion = jl.simulate(disc, *start, t0 + jnp.array([0.0, 0.5, 0.7]) * time, {"g": g, "f": f})
        turn = motion.events["turn"]
        return (turn.ts[0] - t0) / time, (turn.count[-1], motion.qdot["x"][1:] * time / length, jnp.isfinite(turn.ts[1]))

    first = np.sqrt(2 * 0.8 / 10)  # 0.4
    for length, time, t0 in ((1.0, 1.0, 0.0), (1e-6, 1e-3, 0.0), (1e3, 1.0, 1e6)):
        (t, (count, v, again)), slope = jax.value_and_grad(found, has_aux=True)(0.8, length, time, t0)
        np.testing.assert_allclose(t, first, rtol=1e-7)
        np.testing.assert_allclose(slope, first / (2 * 0.8), rtol=1e-7)
        np.testing.assert_allclose(v, [-0.1 * (0.5 - first), -0.1 * (0.7 - first)], rtol=1e-5)
        assert count == 1 and not again


@pytest.mark.slow
@pytest.mark.usefixtures("single_precision")
@pytest.mark.filterwarnings("ignore:jaxlag runs in single precision")
def test_single_precision_under_vmap():
    """The second turning point of an oscillator, 3π/(2ω) after it has passed through zero, and its derivative."""
    swing = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2, events={"turn": jl.Event(rising)})
    second = lambda c: jl.simulate(swing, 0.0, 1.0, jnp.linspace(0, 10, 11), {"c": c}).events["turn"].ts[1]
    c = jnp.array([1.0, 4.0, 9.0])
    found, slope = jax.jit(jax.vmap(jax.value_and_grad(second)))(c)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, 1.5 * np.pi / np.sqrt(c), rtol=1e-4)
    np.testing.assert_allclose(slope, -0.75 * np.pi / np.asarray(c) ** 1.5, rtol=1e-3)


def test_clear_errors():
    for make, said in (
        (lambda: jl.Every(0.0), "`period` must be positive"),
        (lambda: jl.Event("floor", direction=jl.direction.Rising()), "`direction` must be left out"),
        (lambda: jl.System(free, events={"a": jl.Event("floor")}), "must name a contact"),
        (lambda: jl.Event(lambda q: q, stop="yes"), "`stop` must be"),
        (lambda: jl.simulate(jl.System(free), 0.0, 1.0, [0.0, 1.0], events={"a": jl.Event(lambda q: jnp.ones(2))}), "one real number"),
        (lambda: jl.simulate(jl.System(free), 0.0, 1.0, [0.0, 1.0], events={"a": jl.Event(lambda q: q > 0)}), "must return real numbers"),
        (lambda: jl.simulate(jl.System(free), 0.0, 1.0, [0.0, 1.0], events={"a": jl.Event(lambda k: k)}), "names 'k'"),
    ):
        with pytest.raises((TypeError, ValueError), match=said):
            make()
