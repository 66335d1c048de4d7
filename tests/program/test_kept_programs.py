"""Programs found on disk without being traced: found where all is the same, and only there (`test_static.py`: what is the same).

Expected numbers are closed forms: a program that was mistaken for another one would return those of the other.
"""

import functools

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from callables import Spring, Stiff

import jaxlag as jl

TS = np.linspace(0.0, 3.0, 31)
FACTOR = 1.0


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
    jax.clear_caches()
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
            jax.clear_caches()
            np.testing.assert_allclose(other(), expected, atol=1e-6, err_msg=name)
        assert lowered["jit(_trajectory)"] == before + 1, name
    monkeypatch.setitem(globals(), "FACTOR", 2.25)
    np.testing.assert_allclose(motion(oscillator()), cosine(3.0), atol=1e-7)
    for file in tmp_path.glob("jaxlag-*"):  # as after a full disk
        file.write_bytes(file.read_bytes()[:-1000])
    np.testing.assert_allclose(motion(oscillator()), cosine(3.0), atol=1e-7)


@pytest.mark.slow
def test_derivatives_and_functions_of_other_kinds(compilation_cache, tmp_path, lowered):
    """d cos(√c t)/dc = −t sin(√c t)/(2√c); functions are callable objects, partial ones and methods."""
    jl.keep_compiled(tmp_path)
    scaled = lambda factor, qdot, b: 0.5 * factor * b * qdot**2
    for c in (4.0, 4.0, 9.0):
        jax.clear_caches()
        system = jl.System(Spring(1.0), dissipation=functools.partial(scaled, 0.0), force=Stiff(c - 1.0).force)
        np.testing.assert_allclose(motion(system, {"b": 1.0}), np.cos(np.sqrt(c) * TS), atol=1e-7)
    assert lowered["jit(_trajectory)"] == 2
    for _ in range(2):
        jax.clear_caches()
        system = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
        slope = jax.grad(lambda c: jl.simulate(system, 1.0, 0.0, TS, {"c": c}).q[-1])(4.0)  # noqa: B023
        np.testing.assert_allclose(slope, -3.0 / 4 * np.sin(6.0), rtol=1e-6)
    assert lowered["jit(solved)"] == 1


def test_signals_errors_and_closed_over_numbers(compilation_cache, tmp_path, lowered):
    """A signal is asked for the present time by the very number t; a wrong call before, and numbers that are traced, spoil nothing."""
    jl.keep_compiled(tmp_path)
    driven = lambda: jl.System(lambda q, qdot: 0.5 * qdot**2, force=lambda t, u: u(t))
    signal = {"u": jl.Signal(TS, 2 * TS, jl.interpolation.Linear())}
    for _ in range(2):
        jax.clear_caches()
        np.testing.assert_allclose(motion(driven(), signal), 1 + TS**3 / 3, atol=1e-7)
    assert lowered["jit(_trajectory)"] == 1
    weighted = jl.System(lambda q, qdot: 0.5 * qdot @ qdot - 0.5 * q @ np.diag([1.0, 4.0]) @ q)
    with pytest.raises((TypeError, ValueError)):
        jl.simulate(weighted, np.ones(3), np.zeros(3), TS)
    found = jl.simulate(weighted, np.ones(2), np.zeros(2), TS).q
    np.testing.assert_allclose(found, np.stack([np.cos(TS), np.cos(2 * TS)], 1), atol=1e-7)
    ends = jax.vmap(lambda c: jl.simulate(oscillator(c), 1.0, 0.0, TS).q[-1])(jnp.array([1.0, 4.0]))
    np.testing.assert_allclose(ends, np.cos([3.0, 6.0]), atol=1e-7)


@pytest.mark.slow
def test_what_has_changed_is_not_found(compilation_cache, tmp_path, lowered, capfd):
    """After `jax.clear_caches()` a number that has changed is seen; so is a bit of a file; a progress bar is left to JAX."""
    jl.keep_compiled(tmp_path)
    scale = [1.0]
    system = jl.System(lambda q, qdot: 0.5 * qdot**2 - 2.0 * scale[0] * q**2)
    np.testing.assert_allclose(motion(system), np.cos(2 * TS), atol=1e-7)
    scale[0] = 2.25
    jax.clear_caches()
    np.testing.assert_allclose(motion(system), np.cos(3 * TS), atol=1e-7)
    files = set(tmp_path.glob("jaxlag-*"))
    np.testing.assert_allclose(motion(oscillator(), progress=True), np.cos(2 * TS), atol=1e-6)
    assert set(tmp_path.glob("jaxlag-*")) == files
    np.testing.assert_allclose(motion(oscillator()), np.cos(2 * TS), atol=1e-7)
    for file in tmp_path.glob("jaxlag-*"):
        content = bytearray(file.read_bytes())
        content[len(content) // 2] ^= 1
        file.write_bytes(content)
    before = lowered["jit(_trajectory)"]
    jax.clear_caches()
    np.testing.assert_allclose(motion(oscillator()), np.cos(2 * TS), atol=1e-7)
    assert lowered["jit(_trajectory)"] == before + 1


@pytest.mark.slow
def test_what_has_changed_is_not_handed_on(compilation_cache, tmp_path):
    """A gradient within a program was traced with the old number, and JAX still has parts of it."""
    jl.keep_compiled(tmp_path)
    scale = [4.0]
    system = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * scale[0] * q**2)
    end = lambda c: jl.simulate(system, 1.0, 0.0, TS, {"c": c}).q[-1]
    np.testing.assert_allclose(jax.jit(jax.grad(end))(1.0), -3 * np.sin(6.0), rtol=1e-6)
    scale[0] = 9.0
    jax.grad(end)(1.0)
    assert not list(tmp_path.glob("jaxlag-*"))
