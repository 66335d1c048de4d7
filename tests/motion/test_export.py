"""What comes out of a motion and of a fit: samples, times between them, dicts, tables, files; and where a one-sided constraint pulls."""

import copy
import dataclasses
import functools
import json
import pickle
import re
import subprocess
import sys
from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oscillator import START, SYSTEM, TRUE, record
from scipy.interpolate import BPoly, CubicHermiteSpline

import jaxlag as jl
from jaxlag._motion.moments import ContactState
from jaxlag._motion.provenance import Provenance

TS = np.array([0.0, 0.1, 0.25, 0.3, 0.55, 0.7])
STILL = Provenance.of(jl.System(lambda qdot: qdot), {})


def given(ts, q, qdot, qddot):
    """A motion that was not simulated, so that the tests know every number of it."""
    states = jax.tree.map(jnp.asarray, (ts, q, qdot, qddot))
    return jl.results.Trajectory(*states, {}, jl.results.RESULTS.successful, {}, None, {}, STILL)


def waves(ts, omega=3.0):
    """Entries sin(kωt), k = 1, 2."""
    k = omega * np.array([1.0, 2.0])
    s, c = np.sin(np.outer(ts, k)), np.cos(np.outer(ts, k))
    return given(ts, {"x": s}, {"x": k * c}, {"x": -(k**2) * s})


# Between the samples.


@pytest.mark.fast
def test_between_samples_it_is_hermites():
    motion, at = waves(TS), np.linspace(0.0, 0.7, 41)
    q, v, a = (np.asarray(tree["x"]) for tree in (motion.q, motion.qdot, motion.qddot))
    found, cubic = motion.at(at), CubicHermiteSpline(TS, v, a)
    np.testing.assert_allclose(found.q["x"], BPoly.from_derivatives(TS, np.stack([q, v, a], axis=1))(at), atol=1e-14)
    np.testing.assert_allclose(found.qdot["x"], cubic(at), atol=1e-13)
    np.testing.assert_allclose(found.qddot["x"], cubic(at, 1), atol=1e-11)
    np.testing.assert_allclose(motion.at(TS).q["x"], q, atol=1e-15)


@pytest.mark.parametrize("h", [0.1, 0.05, 0.02])
def test_the_error_is_what_is_said(h):
    """Sixth and fifth derivatives of sin ωt are at most ω⁶ and ω⁵; the estimates are the true errors over two intervals."""
    ts, omega = np.arange(0.0, 2.0, h), 3.0
    at = np.linspace(0.0, ts[-1], 1000)
    found = waves(ts, omega).at(at)
    off_q, off_v, off_a = (
        np.max(np.abs(tree["x"][:, 0] - true), axis=0)
        for tree, true in (
            (found.q, np.sin(omega * at)),
            (found.qdot, omega * np.cos(omega * at)),
            (found.qddot, -(omega**2) * np.sin(omega * at)),
        )
    )
    rounding = 1e-14
    assert 0.9 * h**6 / 46080 * omega**6 < off_q + rounding and off_q < 1.001 * h**6 / 46080 * omega**6 + rounding
    assert 0.9 * h**4 / 384 * omega**5 < off_v < 1.001 * h**4 / 384 * omega**5 + rounding
    assert 0.9 * np.sqrt(3) * h**3 / 216 * omega**5 < off_a < 1.001 * np.sqrt(3) * h**3 / 216 * omega**5
    assert off_q < np.max(found.q_error["x"][:, 0]) + rounding and np.max(found.q_error["x"][:, 0]) < 65 * off_q + 10 * rounding
    assert off_v < np.max(found.qdot_error["x"][:, 0]) < 20 * off_v


@pytest.mark.parametrize("jump", np.linspace(0.31, 0.69, 8))
def test_the_error_is_told_where_the_acceleration_jumps(jump):
    motion = lambda t: (0.5 * np.maximum(t - jump, 0) ** 2, np.maximum(t - jump, 0), 1.0 * (t > jump))
    ts, at = np.linspace(0.0, 1.0, 11), np.linspace(0.0, 1.0, 500)
    found = given(ts, *motion(ts)).at(at)
    for value, true, said in zip((found.q, found.qdot), motion(at), (found.q_error, found.qdot_error), strict=False):
        assert np.max(np.abs(value - true)) < np.max(said) < 0.6 * 0.1 ** (2 if said is found.q_error else 1)


def test_of_two_samples_no_error_is_known():
    found = given(TS[:2], TS[:2], np.ones(2), np.zeros(2)).at(0.05)
    assert np.isnan(found.q_error) and np.isnan(found.qdot_error) and float(found.q) == pytest.approx(0.05)


def test_gradients_through_interpolation():
    """x(t) = cos(√c t), of samples that depend on c: by hand, and by differences."""
    ts, t, c = jnp.linspace(0.0, 2.0, 41), 1.234, 4.0

    def x(t, c):
        w = jnp.sqrt(c)
        return given(ts, jnp.cos(w * ts), -w * jnp.sin(w * ts), -c * jnp.cos(w * ts)).at(t).q

    w = np.sqrt(c)
    by_hand = -w * np.sin(w * t), -t / (2 * w) * np.sin(w * t)
    np.testing.assert_allclose(x(t, c), np.cos(w * t), atol=1e-10)
    for derivative in (jax.grad, jax.jacfwd):
        found = jax.jit(derivative(x, argnums=(0, 1)))(t, c)
        np.testing.assert_allclose(found, by_hand, atol=1e-7)
    step = 1e-4
    differences = (x(t + step, c) - x(t - step, c)) / (2 * step), (x(t, c + step) - x(t, c - step)) / (2 * step)
    np.testing.assert_allclose(found, differences, atol=1e-7)
    many = jax.vmap(lambda c: x(jnp.array([0.3, t]), c))(jnp.array([1.0, c]))
    np.testing.assert_allclose(many, np.cos(np.outer(np.sqrt([1.0, c]), [0.3, t])), atol=1e-9)


def test_one_time_has_no_axis_and_many_keep_theirs():
    motion = waves(TS)
    assert motion.at(0.2).q["x"].shape == (2,) and motion.at(np.full((3, 4), 0.2)).qddot["x"].shape == (3, 4, 2)
    assert motion.at([]).q["x"].shape == (0, 2)


def test_outside_there_is_nothing():
    motion = waves(TS)
    with pytest.raises(ValueError, match=re.escape("`ts` must lie within the motion, from 0 to 0.7, but holds 0.8. Simulate further.")):
        motion.at([0.1, 0.8])
    traced = jax.jit(lambda t: motion.at(t).q["x"])
    assert np.all(np.isnan(traced(0.8))) and np.all(np.isfinite(traced(0.7)))
    assert np.all(np.isfinite(motion.at(0.7 * (1 + 1e-16)).q["x"]))


BALL = jl.System(lambda q, qdot, g: 0.5 * qdot**2 - g * q, unilateral={"floor": jl.Contact(lambda q: q, restitution=lambda e: e)})


def bounce(at, h, g, e):
    """Position and velocity of a ball that falls from h, in closed form."""
    start, v = np.sqrt(2 * h / g), np.sqrt(2 * g * h)
    if at < start:
        return h - g * at**2 / 2, -g * at
    while at >= start + 2 * e * v / g:
        v, start = e * v, start + 2 * e * v / g
    return e * v * (at - start) - g * (at - start) ** 2 / 2, e * v - g * (at - start)


@pytest.mark.slow
@pytest.mark.parametrize("length, time", [(1.0, 1.0), (1e-9, 1e6)], ids=["SI", "small and slow"])
def test_a_bouncing_ball_between_samples_is_exact(length, time):
    """Also at the impacts, of which the first is a sample of its own; between two of them in one interval nothing is known."""
    unit, p = np.array([length, length / time]), {"g": 9.81 * length / time**2, "e": 0.8}
    first = np.sqrt(2 / 9.81)
    ts = np.sort([*np.linspace(0, 0.9, 10), first, 1.1, 1.9, 2.0])
    motion = jl.simulate(BALL, length, 0.0, ts * time, p)
    assert list(motion.contacts["floor"].impacts[-4:]) == [1, 1, 3, 3]
    at = np.linspace(0, 1.1, 221)
    expected = np.array([bounce(t, 1.0, 9.81, 0.8) for t in at])
    found = motion.at(at * time)
    np.testing.assert_allclose(found.q / unit[0], expected[:, 0], atol=1e-11)
    np.testing.assert_allclose(found.qdot / unit[1], expected[:, 1], atol=1e-11)
    np.testing.assert_allclose(found.qddot, -p["g"], rtol=1e-9)
    assert np.all(found.q_error[at < 0.9] < 1e-9 * length)
    before, unknown, behind = (motion.at(t * time).q for t in (1.15, 1.5, 1.85))
    np.testing.assert_allclose([before / length, behind / length], [np.nan, bounce(1.85, 1.0, 9.81, 0.8)[0]], rtol=1e-9)
    assert np.isnan(unknown)


@pytest.mark.parametrize("length, time", [(1.0, 1.0), (1e-9, 1e6)], ids=["SI", "small and slow"])
def test_samples_on_both_sides_of_impacts_are_not_joined(length, time):
    """Known exactly, of a ball that leaves with its speed; the third interval has two impacts."""
    g, v = 2 * length / time**2, 2 * length / time  # up and down in 2, from 1 at the start
    fall = lambda t: np.stack([v * (t % 2) * time - g * ((t % 2) * time) ** 2 / 2, v - g * (t % 2) * time, np.full_like(t, -g)])
    ts = np.array([0.2, 0.9, 1.6, 2.6, 3.0, 7.2, 7.8])
    contact = [jnp.asarray(x) for x in (np.full(7, False), ts // 2, ts // 2 * 2 * time, np.zeros(7))]
    motion = dataclasses.replace(given(ts * time, *fall(ts)), contacts={"floor": ContactState(*contact)})
    at = np.array([0.2, 0.5, 1.7, 1.99, 2.01, 2.3, 2.9, 3.0, 6.1, 7.2, 7.5])
    found = motion.at(at * time)
    np.testing.assert_allclose([found.q, found.qdot, found.qddot], fall(at), rtol=1e-9, atol=1e-12 * v * time)
    assert np.all(found.q_error[:6] < 1e-9 * length) and np.all(np.isnan(motion.at(np.array([3.1, 5.0, 5.99]) * time).q))


@pytest.mark.slow
def test_interpolation_at_impacts_is_differentiated_and_compiled():
    ts, first = np.linspace(0, 0.6, 7), np.sqrt(2 / 9.81)
    at = lambda e: jl.simulate(BALL, 1.0, 0.0, ts, {"g": 9.81, "e": e}).at(0.47)
    np.testing.assert_allclose(jax.grad(lambda e: at(e).q)(0.8), np.sqrt(2 * 9.81) * (0.47 - first), rtol=1e-8)
    np.testing.assert_allclose(jax.jit(lambda e: at(e).qdot)(0.8), bounce(0.47, 1.0, 9.81, 0.8)[1], rtol=1e-8)


@pytest.mark.slow
def test_nothing_is_interpolated_across_an_event_that_changes_the_state():
    """A free mass is at 0.55, where it is put back to 0.2 and runs twice as fast; another event looks on."""
    gate = jl.Event(lambda q: q - 0.55, lambda qdot: {"q": 0.2, "qdot": 2 * qdot}, most=1)
    free = jl.System(lambda qdot: 0.5 * qdot**2, events={"gate": gate, "seen": jl.Event(lambda q: q - 0.32, most=3)})
    found = jl.simulate(free, 0.0, 1.0, np.linspace(0, 0.7, 8)).at([0.31, 0.51, 0.549, 0.551, 0.58])
    np.testing.assert_allclose(found.q, [0.31, 0.51, 0.549, 0.202, 0.26], rtol=1e-8)
    np.testing.assert_allclose(found.qdot, [1, 1, 1, 2, 2], rtol=1e-8)


@pytest.mark.parametrize(
    "motion, has", [(jax.tree.map(lambda x: jnp.stack([x, x]), waves(TS)), "2 motions"), (waves(TS)[:1], "one sample")], ids=["many", "one"]
)
def test_what_cannot_be_interpolated(motion, has):
    with pytest.raises(ValueError, match=f"`at` must interpolate between the samples of one motion, but has {has}. Take one"):
        motion.at(0.1)


# Samples.


@pytest.fixture(scope="module")
def rubbed():
    """A block on a spring with dry friction, in closed form: half-swings of π/2 s, each of which loses 2F/c = 0.15, until the seventh
    ends at 0.05 ≤ F/c, where it sticks; and on a table a body that is pushed along it.
    """
    ts, F, c = np.linspace(0.0, 14.0, 141), 0.3, 4.0
    k = np.minimum(np.floor(ts / (np.pi / 2)), 6)
    side, size, phase = (-1.0) ** k, 0.925 - 0.15 * k, 2 * np.minimum(ts - k * np.pi / 2, np.pi / 2)
    stuck = ts > 3.5 * np.pi
    v = np.where(stuck, 0, -2 * side * size * np.sin(phase))
    path = np.concatenate([[0], np.cumsum(2 * (0.925 - 0.15 * np.arange(7)))])[k.astype(int)] + size * (1 - np.cos(phase))
    x, x_end = side * (0.075 + size * np.cos(phase)), side[-1] * (0.075 - size[-1])
    rubbing = jl.results.FrictionState(jnp.asarray(np.where(stuck, c * x_end, -F * np.sign(v))), jnp.asarray(stuck))
    flat = lambda y: np.stack([y, 0 * y], axis=1)
    system = jl.System(
        lambda q, qdot, c: 0.5 * qdot["x"] ** 2 + 0.5 * qdot["r"] @ qdot["r"] - 0.5 * c * q["x"] ** 2,
        dissipation={"dry": lambda qdot, F: F * jnp.abs(qdot["x"])},
        force={"push": lambda t: {"r": jnp.stack([jnp.cos(t), -1.0 + 0 * t])}},
        holonomic={"table": lambda q: q["r"][1]},
        one_sided="table",
    )
    states = (
        {"x": np.where(stuck, x_end, x), "r": flat(1 - np.cos(ts))},
        {"x": v, "r": flat(np.sin(ts))},
        {"x": np.where(stuck, 0, -4 * side * size * np.cos(phase)), "r": flat(np.cos(ts))},
        {"table": np.ones(141)},
    )
    steps = {name: np.int64(n) for name, n in (("num_steps", 70), ("num_accepted_steps", 60), ("num_rejected_steps", 10))}
    counts = {"transitions": k + stuck, "time_stuck": np.maximum(ts - 3.5 * np.pi, 0)[:, None], "start_moved": np.float64(0)}
    works = {"dry": -F * path, "push": 0.5 * np.sin(ts) ** 2, "table": 0 * ts, "time": 0 * ts, "projection": 0 * ts}
    ts, states, stats, works = jax.tree.map(jnp.asarray, (ts, states, steps | counts, works))
    stated = Provenance.of(system, jax.tree.map(jnp.asarray, {"c": c, "F": F, "label": {"spring": [1.0, 2.0]}}) | {"net": jnp.sin})
    return jl.results.Trajectory(ts, *states, jl.results.RESULTS.successful, stats, works, {"dry": rubbing}, stated)


def test_a_slice_is_a_motion_that_starts_later(rubbed):
    late = rubbed[100:]
    assert len(rubbed) == 141 and len(late) == 41 and late.ts[0] == rubbed.ts[100]
    np.testing.assert_array_equal(late.q["r"], rubbed.q["r"][100:])
    np.testing.assert_array_equal(late.friction["dry"].sticking, rubbed.friction["dry"].sticking[100:])
    np.testing.assert_allclose(late.work()["dry"], rubbed.work()["dry"][100:] - rubbed.work()["dry"][100], atol=1e-15)
    assert np.max(np.abs(rubbed.balance())) < 1e-14 > np.max(np.abs(late.balance())) and late.stats["transitions"][0] == 0
    np.testing.assert_allclose(late.stats["time_stuck"][-1, 0], 14.0 - 3.5 * np.pi)
    np.testing.assert_allclose(rubbed[120:].stats["time_stuck"][-1, 0], 2.0)
    assert "41 samples, t = 10 … 14" in str(late) and "'table' never pulls" in str(late)


@pytest.mark.parametrize("start, said", [(1.7e9, "t = 1700000000 … 1700000014"), (1e5, "t = 100000 … 100014"), (0.0, "t = 0 … 14")])
def test_the_card_of_a_late_motion_tells_its_times_apart(rubbed, start, said):
    assert said in str(dataclasses.replace(rubbed, ts=start + rubbed.ts))


def test_the_card_of_a_motion_that_failed_counts_what_was_reached(rubbed):
    unreached = lambda x: x.at[100:].set(jnp.nan) if x.shape[:1] == (141,) and x.dtype == float else x
    failed = dataclasses.replace(jax.tree.map(unreached, rubbed), ts=rubbed.ts, result=jl.results.RESULTS.max_steps_reached)
    assert "6 transitions, stuck for 0" in str(failed) and "maximum number of solver steps" in str(failed)


def test_a_mask_and_every_second_sample(rubbed):
    np.testing.assert_array_equal(rubbed[rubbed.ts > 3].ts, rubbed.ts[31:])
    np.testing.assert_array_equal(rubbed[np.asarray(rubbed.ts) > 3].q["x"], rubbed.q["x"][31:])
    np.testing.assert_array_equal(rubbed[::2].qddot["x"], rubbed.qddot["x"][::2])


def test_one_sample_is_an_instant_from_which_the_motion_goes_on(rubbed):
    last = rubbed[-1]
    assert last.t == 14.0 and last.q["r"].shape == (2,) and last.multipliers["table"] == rubbed.multipliers["table"][-1]
    assert [float(instant.t) for instant in rubbed[:3]] == pytest.approx([0.0, 0.1, 0.2])
    np.testing.assert_array_equal(jax.jit(lambda motion, i: motion[i].q["x"])(rubbed, 5), rubbed.q["x"][5])
    np.testing.assert_array_equal(rubbed[np.int64(5)].q["x"], rubbed.q["x"][5])


@pytest.mark.parametrize(
    "which, error, sentence",
    [
        (141, IndexError, "`motion[141]` must be there, but there are 141 samples."),
        (-142, IndexError, "`motion[-142]` must be there, but there are 141 samples."),
        (
            slice(None, None, -1),
            TypeError,
            "must be asked for a sample, a slice forward in time or a mask of the samples, but is for slice",
        ),
        ([True], TypeError, "a mask of the samples, but is for [True]. Write e.g. `motion[-1]`"),
        ("x", TypeError, "a mask of the samples, but is for 'x'."),
        (1.5, TypeError, "a mask of the samples, but is for 1.5."),
        (slice(3, 3), ValueError, "`motion[...]` must keep at least one sample, but keeps none of the 141."),
    ],
)
def test_what_is_no_sample(rubbed, which, error, sentence):
    with pytest.raises(error, match=re.escape(sentence)):
        rubbed[which]


@pytest.fixture(scope="module")
def many():
    """Three oscillators, as `simulate_many` returns them."""
    free, ts = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2), jnp.linspace(0, 1, 5)

    def one(c):
        w = jnp.sqrt(c)
        states = jnp.cos(w * ts), -w * jnp.sin(w * ts), -c * jnp.cos(w * ts)
        stats = {"num_steps": 3, "num_rejected_steps": 0}
        return jl.results.Trajectory(ts, *states, {}, jl.results.RESULTS.successful, stats, None, {}, Provenance.of(free, {"c": c}))

    return jax.vmap(one)(jnp.array([1.0, 4.0, 9.0]))


@pytest.mark.fast
def test_of_many_motions_one_is_taken_by_its_number(many):
    assert len(many) == 3 and many[1:].q.shape == (2, 5)
    one = many[1]
    np.testing.assert_allclose(one.q, np.cos(2 * np.linspace(0, 1, 5)), atol=1e-15)
    np.testing.assert_allclose(one.energy(), 2.0, rtol=1e-6)
    assert len(one) == 5 and str(one).startswith("Trajectory: 5 samples")
    np.testing.assert_array_equal(jax.vmap(lambda motion: motion[2:])(many).q, many.q[:, 2:])
    with pytest.raises(IndexError, match=re.escape("`motion[3]` must be there, but there are 3 members.")):
        many[3]
    with pytest.raises(ValueError, match="`to_dataframe` must be of one motion, but there are 3. Take one of them, e.g. `motions"):
        many.to_dataframe()


# Dicts and tables.


class Plane(NamedTuple):
    x: float
    y: float


@pytest.mark.fast
@pytest.mark.parametrize(
    "q, names",
    [
        (1.0, ["q"]),
        (Plane(1.0, 2.0), ["q.x", "q.y"]),
        ({"arm": {"phi": 1.0}, "r": np.ones(2)}, ["q.arm.phi", "q.r"]),
        ((1.0, 2.0), ["q.0", "q.1"]),
    ],
    ids=["number", "NamedTuple", "nested", "tuple"],
)
def test_names_are_paths(q, names):
    samples = jax.tree.map(lambda x: np.multiply.outer(TS, x), q)
    arrays = given(TS, samples, samples, samples).to_dict()
    assert list(arrays) == ["t", *names, *(name.replace("q", of, 1) for of in ("qdot", "qddot") for name in names)]
    assert all(type(x) is np.ndarray for x in arrays.values())
    np.testing.assert_array_equal(arrays[names[-1]], jax.tree.leaves(samples)[-1])


def test_names_that_become_one_are_refused():
    q = {"a.b": TS, "a": {"b": TS}}
    with pytest.raises(ValueError, match="names must differ in a table, but two entries are called 'q.a.b'. Avoid dots in names."):
        given(TS, q, q, q).to_dict()


COLUMNS = ["t", *(f"{of}.{name}" for of in ("q", "qdot", "qddot") for name in ("r[0]", "r[1]", "x")), "multipliers.table"]


def test_a_table_has_a_row_for_each_sample(rubbed):
    table = rubbed.to_dataframe(dict)
    assert list(table) == [
        *COLUMNS,
        *("friction.dry.force", "friction.dry.sticking"),
        *(f"works.{name}" for name in ("dry", "projection", "push", "table", "time")),
    ]
    np.testing.assert_array_equal(table["q.r[0]"], rubbed.q["r"][:, 0])
    assert table["friction.dry.sticking"].dtype == bool and {x.shape for x in table.values()} == {(141,)}


@pytest.mark.parametrize("there", ["pandas", "polars"])
def test_the_table_is_that_of_what_is_installed(there, rubbed, monkeypatch):
    for name in ("pandas", "polars"):
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(DataFrame=lambda columns, n=name: (n, columns)) if name == there else None)
    library, columns = rubbed.to_dataframe()
    assert library == there and list(columns)[:11] == COLUMNS
    monkeypatch.setitem(sys.modules, there, None)
    with pytest.raises(ImportError, match="`to_dataframe` must have pandas or polars, but neither can be imported. Install one of them"):
        rubbed.to_dataframe()


@pytest.mark.parametrize("library", ["pandas", "polars"])
def test_an_experiment_reads_the_table(library, rubbed):
    frame = pytest.importorskip(library).DataFrame
    table = rubbed.to_dataframe(frame)
    start = rubbed[0]
    experiment = jl.Experiment.from_dataframe(table, start.q, start.qdot, time="t", columns={"x": "q.x"}, observe=lambda q: q)
    np.testing.assert_array_equal(experiment.values["x"], rubbed.q["x"])


# Files.


def same(one, other):
    for name in ("ts", "q", "qdot", "qddot", "multipliers", "works", "friction", "stats", "result"):
        a, b = getattr(one, name), getattr(other, name)
        assert jax.tree.structure(a) == jax.tree.structure(b)
        jax.tree.map(np.testing.assert_array_equal, a, b)
    assert str(one) == str(other)


def test_a_motion_comes_back_from_its_file(rubbed, tmp_path):
    rubbed.save(tmp_path / "motion")
    loaded = jl.load(tmp_path / "motion")
    same(rubbed, loaded)
    np.testing.assert_array_equal(loaded.energy(), rubbed.energy())
    np.testing.assert_array_equal(loaded.balance(), rubbed.balance())
    np.testing.assert_array_equal(loaded.slip()["dry"], rubbed.slip()["dry"])
    np.testing.assert_array_equal(loaded.pulling()["table"], rubbed.pulling()["table"])
    np.testing.assert_array_equal(loaded.at(1.05).q["x"], rubbed.at(1.05).q["x"])
    assert loaded.provenance.params == {"c": 4.0, "F": 0.3, "label": {"spring": [1.0, 2.0]}, "net": None}
    late = loaded[100:]
    np.testing.assert_array_equal(late.energy(), rubbed.energy()[100:])
    np.testing.assert_array_equal(late.slip()["dry"], rubbed.slip()["dry"][100:])
    same(late, rubbed[100:])
    with np.load(tmp_path / "motion") as arrays:
        np.testing.assert_array_equal(arrays["q.r"], rubbed.q["r"])
    again = tmp_path / "again.npz"
    loaded.save(again)
    same(rubbed, jl.load(again))
    with pytest.raises(ValueError, match="a motion that was loaded from a file must do without its system, whose functions are not in the"):
        jl.plot.animate(loaded, {"r": lambda q: q["r"]}, forces={"table": "r"})


def test_another_process_needs_none_of_the_functions(rubbed, tmp_path):
    rubbed.save(tmp_path / "motion.npz")
    code = f"import jaxlag as jl; motion = jl.load({str(tmp_path / 'motion.npz')!r}); print(motion); print(motion.energy()[-1])"
    run = subprocess.run([sys.executable, "-c", f"import jax; jax.config.update('jax_enable_x64', True); {code}"], capture_output=True)
    assert run.stdout.decode().splitlines() == [*str(rubbed).splitlines(), str(rubbed.energy()[-1])], run.stderr.decode()


def test_what_many_motions_and_failed_ones_come_back_as(many, tmp_path):
    many.save(tmp_path / "many.npz")
    loaded = jl.load(tmp_path / "many.npz")
    same(many, loaded)
    np.testing.assert_allclose(loaded[2].energy(), 4.5, rtol=1e-6)
    failed = dataclasses.replace(many[0], result=jl.results.RESULTS.no_friction)
    failed.save(tmp_path / "failed.npz")
    assert jl.load(tmp_path / "failed.npz").result == jl.results.RESULTS.no_friction


def test_a_named_tuple_comes_back_as_the_dict_of_its_fields(tmp_path):
    free = jl.System(lambda qdot: 0.5 * (qdot.x**2 + qdot.y**2), dissipation={"oil": lambda qdot: qdot.x**2})
    motion = jl.simulate(free, Plane(0.0, 1.0), Plane(1.0, 0.0), jnp.linspace(0.0, 1.0, 3))
    motion.save(tmp_path / "motion.npz")
    loaded = jl.load(tmp_path / "motion.npz")
    np.testing.assert_array_equal(loaded.qdot["x"], motion.qdot.x)
    assert loaded.works is None and loaded.friction == {} and loaded.provenance.params is None


@pytest.mark.fast
@pytest.mark.parametrize("content", [b"", b"PK no archive", b"{}", b"[1]", b"\xff\xfe", b'{"jaxlag": "Trajectory", "format": 1}'])
def test_other_files_are_refused(content, tmp_path):
    file = tmp_path / "file"
    file.write_bytes(content)
    with pytest.raises(ValueError, match="`file` must be written by `save` of a motion or a fit, but .*file' is not. Look at its name."):
        jl.load(file)


def test_files_of_a_newer_format_are_refused(tmp_path):
    (tmp_path / "fit.json").write_text('{"jaxlag": "Fit", "format": 2}')
    with pytest.raises(ValueError, match="`file` must be of format 1 or before, but is of format 2. Load it with a newer jaxlag."):
        jl.load(tmp_path / "fit.json")


# Pickles.


def free(q, qdot):
    return 0.5 * qdot**2


class Spring:
    def __init__(self, c):
        self.c = c

    def __call__(self, q, qdot):
        return -0.5 * self.c * q**2

    def __eq__(self, other):
        return self.c == other.c

    def __hash__(self):
        return hash(self.c)


def test_a_system_of_named_functions_is_pickled():
    system = jl.System({"T": free, "V": Spring(4.0)}, holonomic={"table": jnp.sin}, one_sided="table")
    assert pickle.loads(pickle.dumps(system)) == system
    motion = given(TS, TS, TS, TS)
    motion = dataclasses.replace(motion, provenance=Provenance.of(system, {"c": jnp.ones(())}))
    back = pickle.loads(pickle.dumps(motion))
    jax.tree.map(np.testing.assert_array_equal, motion, back)
    assert back.provenance.system == system and jax.tree.structure(back) == jax.tree.structure(motion)


@pytest.mark.parametrize("function, called", [(lambda q, qdot: qdot**2, "<lambda>"), (functools.partial(lambda a, q: q, 1), "partial")])
def test_a_pickle_without_a_name_says_how_results_are_saved(function, called):
    system = jl.System({"T": free, "V": function})
    motion = dataclasses.replace(waves(TS), provenance=Provenance.of(system, None))
    sentence = (
        f"`lagrangian` 'V' must be a function of a module to be pickled, but '.*{called}' cannot be found by its name. Define .*jl.load"
    )
    for what in (system, motion):
        with pytest.raises(pickle.PicklingError, match=sentence):
            pickle.dumps(what)
    assert copy.deepcopy(system) is system and copy.copy(system) is system and copy.deepcopy(motion).provenance.system is system


def test_a_pickler_that_takes_functions_along_is_let(monkeypatch):
    function = lambda q, qdot: qdot**2
    monkeypatch.setitem(sys.modules, "somebody.cloudpickle", SimpleNamespace())
    assert jl.System(function).__reduce__()[1][0]["lagrangian"]["lagrangian"] is function


def test_a_pickle_whose_functions_are_gone_says_so(monkeypatch):
    dumped = pickle.dumps(jl.System(free))
    monkeypatch.delattr(sys.modules[__name__], "free")
    with pytest.raises(pickle.UnpicklingError, match="must be importable as when it was pickled, but there is no 'free' in module"):
        pickle.loads(dumped)


# Fits.


@pytest.fixture(scope="module")
def fit():
    return jl.fit(SYSTEM, record(1, unknown=("q0",)), START | {"b": TRUE["b"]}, free=("c",))


@pytest.mark.slow
def test_a_fit_is_ready_for_json(fit):
    said = json.loads(json.dumps(fit.to_dict(level=0.9), allow_nan=False))
    first, start = said["parameters"]
    assert first["name"] == "c" and start["name"] == "experiment 0: q0" and said["level"] == 0.9
    assert first["value"] == fit.estimates["c"] and first["standard_error"] == pytest.approx(float(fit.standard_errors["c"]))
    assert (first["lower"], first["upper"]) == pytest.approx(fit.interval("c", 0.9))
    half = fit.interval("c", 0.9).upper - first["value"]
    assert start["upper"] - start["value"] == pytest.approx(half / first["standard_error"] * start["standard_error"])
    assert said["params"] == {"m": 1.0, "c": first["value"], "b": 0.3} and said["channels"][0]["name"] == "z"
    assert said["converged"] is True and said["measurements"] == 60 and said["costs"] == fit.costs.tolist()


def test_the_table_of_a_fit(fit):
    table = fit.to_dataframe(dict)
    assert list(table) == ["name", "value", "standard_error", "lower", "upper"] and table["name"] == ["c", "experiment 0: q0"]
    assert (table["lower"][0], table["upper"][0]) == fit.interval("c")


def test_a_fit_comes_back_from_its_file(fit, tmp_path):
    fit.save(tmp_path / "fit.json", level=0.9)
    assert jl.load(tmp_path / "fit.json") == fit.to_dict(level=0.9) | {"card": str(fit)}


def test_what_is_not_determined_is_none(fit):
    loose = dataclasses.replace(fit, covariance=np.array([[np.inf]]), correlation=np.array([[np.nan]]), remarks=["c is not determined"])
    said = loose.to_dict()
    row = said["parameters"][0]
    assert row == {"name": "c", "value": fit.estimates["c"], "standard_error": None, "lower": None, "upper": None}
    assert said["correlation"] == [[None]] and said["remarks"] == ["c is not determined"]
    json.dumps(said, allow_nan=False)


# Constraints that cannot pull.


def dome(one_sided=("dome",)):
    """A stone that slides down from the top of a dome of radius 1; it would leave it where cos φ = 2/3."""
    return jl.System(
        lambda q, qdot: 0.5 * (qdot["r"] ** 2 + (q["r"] * qdot["phi"]) ** 2) - 9.81 * q["r"] * jnp.cos(q["phi"]),
        holonomic={"dome": lambda q: q["r"] - 1.0},
        one_sided=one_sided,
    )


@pytest.fixture(scope="module")
def slid():
    return jl.simulate(dome(), {"r": 1.0, "phi": 0.01}, {"r": 0.0, "phi": 0.0}, jnp.linspace(0.0, 2.1, 211))


@pytest.mark.slow
def test_where_a_stone_would_leave_the_dome(slid):
    """λ = m g (3 cos φ − 2 cos φ₀)."""
    pulls = slid.pulling()["dome"]
    np.testing.assert_array_equal(pulls, 3 * np.cos(slid.q["phi"]) < 2 * np.cos(0.01))
    assert 0 < pulls.sum() < 211
    first = slid.ts[np.argmax(pulls)]
    least = 9.81 * (3 * np.cos(slid.q["phi"]).min() - 2 * np.cos(0.01))
    assert f"'dome' would have to pull at {pulls.sum()} of 211 samples (first at t = {first:g}, λ down to {least:.3g})" in str(slid)
    assert "its contact would have opened" in str(slid) and "never pulls" in str(slid[:50])
    both = jax.tree.map(lambda x: jnp.stack([x, x]), slid)
    assert f"at {2 * pulls.sum()} of 422 samples of 2 motions (first" in str(both)


def test_two_sided_constraints_say_nothing(slid):
    plain = dataclasses.replace(slid, provenance=Provenance.of(dome(()), None))
    assert plain.pulling() == {} and "pull" not in str(plain)


@pytest.mark.parametrize("phi, pulls", [(0.5, False), (1.0, True)])
def test_examine_says_that_a_contact_would_open(phi, pulls):
    found = jl.examine(dome(), {"r": 1.0, "phi": phi}, {"r": 0.0, "phi": np.sqrt(2 * 9.81 * (1 - np.cos(phi)))}).findings
    said = f"the one-sided constraint 'dome' would have to pull here (λ = {9.81 * (3 * np.cos(phi) - 2):.3g}), so its contact would open"
    assert [finding.startswith(said) for finding in found if "one-sided" in finding] == [True] * pulls


def test_one_sided_constraints_belong_to_the_system():
    system = dome("dome")
    assert system.one_sided == ("dome",) and "one-sided: dome" in repr(system)
    moved = jl.substitute(system, lambda q: {"r": q["r"] + 1.0, "phi": q["phi"]})
    assert moved.one_sided == ("dome",)
    twice = jl.System(lambda qdot: qdot**2, holonomic={"a": lambda q: q, "b": lambda q: q}, one_sided=["b", "a"])
    assert twice.one_sided == ("a", "b") and hash(twice)


@pytest.mark.parametrize("one_sided, holds, there", [("x", "'x'", "dome"), (("dome", 3), "3", "dome"), (True, "True", "dome")])
def test_one_sided_must_name_constraints(one_sided, holds, there):
    with pytest.raises(ValueError, match=f"`one_sided` must name holonomic constraints, but holds {holds}. There are {there}."):
        dome(one_sided)
    with pytest.raises(ValueError, match="but holds 'a'. There are none."):
        jl.System(lambda qdot: qdot**2, nonholonomic={"a": lambda qdot: qdot}, one_sided="a")
