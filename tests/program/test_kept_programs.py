"""Programs found on disk without being traced: found where all is the same, and only there.

Expected numbers are closed forms: a program that was mistaken for another one would return those of the other.
"""

import collections
import dataclasses
import functools

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend import core
from programs import jaxpr_of, random_program

import jaxlag as jl
from jaxlag._program.description import NotDescribable, Words
from jaxlag._program.user_calls import Call

TS = np.linspace(0.0, 3.0, 31)
FACTOR = 1.0


def without_custom_rules(seed):
    """A random program, if it can be described."""
    with jax.numpy_rank_promotion("allow"):  # as a user's program may do
        run, x, v = random_program(seed)
        closed = jaxpr_of(run, x, v)
    try:
        return closed and (closed, digest(closed))
    except NotDescribable:
        return None


def digest(*values):
    words = Words()
    for value in values:
        words.value(value)
    return words.digest()


def answer(function, *given, **named):
    words = Words()
    words.answer(function, Call.of(list(given), named))
    return words.digest()


@pytest.mark.slow
def test_random_programs_have_words_of_their_own():
    """Two programs have equal words where, and only where, they are printed alike, with the same constants."""
    found = collections.defaultdict(set)
    for seed in [*range(50), *range(10)]:
        if described := without_custom_rules(seed):
            closed, words = described
            found[str(closed), tuple(np.asarray(c).tobytes() for c in closed.consts)].add(words)
    assert len(found) > 15 and all(len(digests) == 1 for digests in found.values())
    assert len(set().union(*found.values())) == len(found)


@pytest.mark.slow
def test_a_change_of_any_part_changes_the_words():
    """One parameter of one equation of a random program: what JAX prints does not show all of them."""
    changed = 0
    for closed, before in filter(None, map(without_custom_rules, range(40))):
        for i, equation in enumerate(closed.jaxpr.eqns):
            for key, value in equation.params.items():
                if not isinstance(value, (bool, int, tuple)) or (isinstance(value, tuple) and not all(type(n) is int for n in value)):
                    continue
                other = (*value, 1) if isinstance(value, tuple) else not value if isinstance(value, bool) else value + 1
                equations = list(closed.jaxpr.eqns)
                equations[i] = equation.replace(params=equation.params | {key: other})
                assert digest(core.ClosedJaxpr(closed.jaxpr.replace(eqns=equations), closed.consts)) != before, (equation.primitive, key)
                changed += 1
    assert changed > 100


UNLIKE = {
    "a number": (lambda q: 2.0 * q, lambda q: 2.0000000000000004 * q),
    "a sign of zero": (lambda q: q + 0.0, lambda q: q + -0.0),
    "what has no derivative": (lambda q: q * q, lambda q: q * jax.lax.stop_gradient(q)),
    "the order": (lambda q: q[0] - q[1], lambda q: q[1] - q[0]),
    "an array in it": (lambda q: q @ np.array([1.0, 2, 3]), lambda q: q @ np.array([1.0, 2, 4])),
    "a loop's length": (lambda q: jax.lax.fori_loop(0, 3, lambda _, q: q * q, q), lambda q: jax.lax.fori_loop(0, 4, lambda _, q: q * q, q)),
    "a number known to Python": (lambda q: 1.0, lambda q: 2.0),
    "a number that only JAX knows": (lambda q: 1.0, lambda q: jnp.asarray(1.0)),
    "names of what is returned": (lambda q: {"x": q}, lambda q: {"y": q}),
    "a case": (lambda q: jax.lax.cond(q[0] > 0, jnp.sin, jnp.cos, q), lambda q: jax.lax.cond(q[0] > 0, jnp.sin, jnp.tan, q)),
}


@pytest.mark.parametrize("unlike", UNLIKE)
def test_functions_are_told_apart_by_what_they_return(unlike):
    one, other = UNLIKE[unlike]
    of = lambda f: answer(f, jnp.zeros(3))
    assert of(one) == of(one) != of(other)


def test_what_has_no_certain_words_is_refused():
    @jax.custom_jvp
    def own(q):
        return q

    own.defjvp(lambda p, t: (p[0], 2 * t[0]))
    calls_python = lambda q: jax.pure_callback(lambda q: q, jax.ShapeDtypeStruct((3,), "float64"), q)
    for function in (own, jax.jit(own), calls_python, lambda q: jax.lax.cond(q[0] > 0, own, lambda q: q, q)):
        with pytest.raises(NotDescribable):
            answer(lambda q, f=function: f(q), jnp.zeros(3))
    for thing in (object(), iter(()), collections.OrderedDict()):
        with pytest.raises(NotDescribable):
            digest(thing)


def oscillator(c=4.0, **slots):
    """q̈ = −c q, from functions made anew."""
    return jl.System(lambda q, qdot, m=1.0: 0.5 * m * qdot**2 - 0.5 * c * FACTOR * q**2, **slots)


def motion(system, params=None, **options):
    return np.asarray(jl.simulate(system, 1.0, 0.0, TS, params, **options).q)


@pytest.mark.slow
def test_a_motion_is_found_where_all_is_the_same_and_only_there(compilation_cache, tmp_path, lowered, monkeypatch):
    jl.keep_compiled(tmp_path)
    cosine = lambda w: np.cos(w * TS)
    np.testing.assert_allclose(motion(oscillator()), cosine(2.0), atol=1e-7)
    assert lowered["jit(_trajectory)"] == 1
    again = jl.simulate(system := oscillator(), 1.0, 0.0, TS)
    np.testing.assert_allclose(again.q, cosine(2.0), atol=1e-7)
    assert lowered["jit(_trajectory)"] == 1 and again.provenance.system is system
    np.testing.assert_allclose(again.energy(), 2.0, rtol=1e-7)
    for name, other, expected in (
        ("closed over", lambda: motion(oscillator(9.0)), cosine(3.0)),
        ("a parameter", lambda: motion(oscillator(), {"m": 4.0}), cosine(1.0)),
        ("a force", lambda: motion(oscillator(force=lambda q: -5.0 * q)), cosine(3.0)),
        ("a solver", lambda: motion(oscillator(), solver=dfx.Tsit5()), cosine(2.0)),
    ):
        before = lowered["jit(_trajectory)"]
        for _ in range(2):
            np.testing.assert_allclose(other(), expected, atol=1e-6, err_msg=name)
        assert lowered["jit(_trajectory)"] == before + 1, name
    monkeypatch.setitem(globals(), "FACTOR", 2.25)
    np.testing.assert_allclose(motion(oscillator()), cosine(3.0), atol=1e-7)
    for file in tmp_path.glob("jaxlag-*"):  # as after a full disk
        file.write_bytes(file.read_bytes()[:-1000])
    np.testing.assert_allclose(motion(oscillator()), cosine(3.0), atol=1e-7)


class Spring(eqx.Module):
    """A system's function with numbers in it."""

    c: float

    def __call__(self, q, qdot):
        return 0.5 * qdot**2 - 0.5 * self.c * q**2


@dataclasses.dataclass(frozen=True)
class Stiff:
    c: float

    def force(self, q):
        return -self.c * q


@pytest.mark.slow
def test_derivatives_and_functions_of_other_kinds(compilation_cache, tmp_path, lowered):
    """d cos(√c t)/dc = −t sin(√c t)/(2√c); functions are callable objects, partial ones and methods."""
    jl.keep_compiled(tmp_path)
    scaled = lambda factor, qdot, b: 0.5 * factor * b * qdot**2
    for c in (4.0, 4.0, 9.0):
        system = jl.System(Spring(1.0), dissipation=functools.partial(scaled, 0.0), force=Stiff(c - 1.0).force)
        np.testing.assert_allclose(motion(system, {"b": 1.0}), np.cos(np.sqrt(c) * TS), atol=1e-7)
    assert lowered["jit(_trajectory)"] == 2
    for _ in range(2):
        system = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
        slope = jax.grad(lambda c: jl.simulate(system, 1.0, 0.0, TS, {"c": c}).q[-1])(4.0)  # noqa: B023
        np.testing.assert_allclose(slope, -3.0 / 4 * np.sin(6.0), rtol=1e-6)
    assert lowered["jit(solved)"] == 1


def test_functions_that_were_called_before_are_not_followed(compilation_cache, tmp_path):
    """What was asked of them is not known, so their programs stay in the process."""
    system = oscillator(2.0)
    jl.energy(system, 1.0, 0.0)
    jl.keep_compiled(tmp_path)
    np.testing.assert_allclose(motion(system), np.cos(np.sqrt(2.0) * TS), atol=1e-7)
    assert not list(tmp_path.glob("jaxlag-*"))


def test_signals_errors_and_closed_over_numbers(compilation_cache, tmp_path, lowered):
    """A signal is asked for the present time by the very number t; a wrong call before, and numbers that are traced, spoil nothing."""
    jl.keep_compiled(tmp_path)
    driven = lambda: jl.System(lambda q, qdot: 0.5 * qdot**2, force=lambda t, u: u(t))
    signal = {"u": jl.Signal(TS, 2 * TS, jl.interpolation.Linear())}
    for _ in range(2):
        np.testing.assert_allclose(motion(driven(), signal), 1 + TS**3 / 3, atol=1e-7)
    assert lowered["jit(_trajectory)"] == 1
    weighted = jl.System(lambda q, qdot: 0.5 * qdot @ qdot - 0.5 * q @ np.diag([1.0, 4.0]) @ q)
    with pytest.raises((TypeError, ValueError)):
        jl.simulate(weighted, np.ones(3), np.zeros(3), TS)
    found = jl.simulate(weighted, np.ones(2), np.zeros(2), TS).q
    np.testing.assert_allclose(found, np.stack([np.cos(TS), np.cos(2 * TS)], 1), atol=1e-7)
    ends = jax.vmap(lambda c: jl.simulate(oscillator(c), 1.0, 0.0, TS).q[-1])(jnp.array([1.0, 4.0]))
    np.testing.assert_allclose(ends, np.cos([3.0, 6.0]), atol=1e-7)


class Halved(dfx.Tsit5):
    """A user's solver: its methods are no part of its name."""


@pytest.mark.slow
def test_what_outlives_its_functions_is_not_found(compilation_cache, tmp_path, lowered, capfd):
    """After `jax.clear_caches()` a global that has changed is seen; so is a bit of a file; a user's solver and progress are left to JAX."""
    jl.keep_compiled(tmp_path)
    scale = [1.0]
    system = jl.System(lambda q, qdot: 0.5 * qdot**2 - 2.0 * scale[0] * q**2)
    np.testing.assert_allclose(motion(system), np.cos(2 * TS), atol=1e-7)
    scale[0] = 2.25
    jax.clear_caches()
    np.testing.assert_allclose(motion(system), np.cos(3 * TS), atol=1e-7)
    files = set(tmp_path.glob("jaxlag-*"))
    for options in ({"solver": Halved()}, {"progress": True}):
        np.testing.assert_allclose(motion(oscillator(), **options), np.cos(2 * TS), atol=1e-6)
    assert set(tmp_path.glob("jaxlag-*")) == files
    np.testing.assert_allclose(motion(oscillator()), np.cos(2 * TS), atol=1e-7)
    for file in tmp_path.glob("jaxlag-*"):
        content = bytearray(file.read_bytes())
        content[len(content) // 2] ^= 1
        file.write_bytes(content)
    before = lowered["jit(_trajectory)"]
    np.testing.assert_allclose(motion(oscillator()), np.cos(2 * TS), atol=1e-7)
    assert lowered["jit(_trajectory)"] == before + 1


@pytest.mark.slow
def test_what_a_function_returned_has_to_be_what_it_returns(compilation_cache, tmp_path):
    """A gradient within a program was traced with the old number, and JAX still has parts of it: that is not handed on."""
    jl.keep_compiled(tmp_path)
    scale = [4.0]
    system = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * scale[0] * q**2)
    end = lambda c: jl.simulate(system, 1.0, 0.0, TS, {"c": c}).q[-1]
    np.testing.assert_allclose(jax.jit(jax.grad(end))(1.0), -3 * np.sin(6.0), rtol=1e-6)
    scale[0] = 9.0
    jax.grad(end)(1.0)
    assert not list(tmp_path.glob("jaxlag-*"))
