"""What Python does in a call whose program is compiled already: counted in a fresh process, since a time would depend on the machine."""

import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._model import given
from jaxlag._motion import padding

TS = np.linspace(0, 1, 11)
COUNTED = """
import json, sys
import jax, jax.numpy as jnp
jax.config.update("jax_enable_x64", True)
import jaxlag as jl
from jaxlag.examples import vehicle

ts = jnp.linspace(0, 2, 101)
state, params = (vehicle.q0, vehicle.qdot0), vehicle.params
measured = {"y": jl.simulate(vehicle.system, *state, ts, params).q["y"]}

def fit(steps):
    start = params | {"b": 4000.0, "c": 30000.0}
    return jl.fit(vehicle.system, jl.Experiment(ts, measured, *state), start, free=("b", "c"), max_steps=steps)

def calls(function):
    function(), function()
    count = 0
    def counted(frame, event, argument):
        nonlocal count
        count += event in ("call", "c_call")
    sys.setprofile(counted)
    function()
    sys.setprofile(None)
    return count

print(json.dumps({
    "simulate": calls(lambda: jl.simulate(vehicle.system, *state, ts, params)),
    "acceleration": calls(lambda: jl.acceleration(vehicle.system, *state, params)),
    "fit": calls(lambda: fit(1)),
    "iteration": (calls(lambda: fit(4)) - calls(lambda: fit(1))) / 3,
}))
"""


@pytest.fixture(scope="module")
def counts():
    return json.loads(subprocess.run([sys.executable, "-c", COUNTED], capture_output=True, text=True, check=True).stdout)


@pytest.mark.slow
@pytest.mark.parametrize("call, most", [("simulate", 300), ("acceleration", 150), ("fit", 5700), ("iteration", 300)])
def test_python_does_little(counts, call, most):
    """One conversion by JAX is some 90 calls of functions: were each number converted by itself, `simulate` would make 4000; were each
    checked by itself at every call, 970.
    """
    assert 0 < counts[call] <= most


OSCILLATOR = jl.System(lambda q, qdot, c: 0.5 * qdot["x"] ** 2 - 0.5 * c * q["x"] ** 2)


def accelerated(x=1.0, v=0.0, c=4.0):
    return jl.acceleration(OSCILLATOR, {"x": x}, {"x": v}, {"c": c}).qddot["x"]


@pytest.mark.parametrize("bad", [None, 1j, "1.0", np.ones(2), {"y": 1.0}, {1.0}])
@pytest.mark.parametrize("place", ["x", "v", "c"])
def test_a_structure_that_passed_its_checks_lets_nothing_else_pass(bad, place):
    """The kinds of its numbers are part of it: what is refused at first is refused later, in the same words."""

    def told():
        with pytest.raises((TypeError, ValueError)) as refused:
            accelerated(**{place: bad})
        return str(refused.value)

    given._CHECKED.clear()
    at_first = told()
    assert accelerated() == accelerated(c=4) == -4.0 and given._CHECKED
    assert told() == at_first


def test_a_structure_is_checked_anew_in_another_precision():
    assert accelerated(0.1, c=0.1).dtype == np.float64
    with jax.enable_x64(False):
        found = accelerated(0.1, c=0.1)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, -0.01, rtol=1e-6)
    np.testing.assert_allclose(accelerated(0.1, c=0.1), -0.01, rtol=1e-14)


def test_few_structures_are_remembered(monkeypatch):
    monkeypatch.setattr(given._CHECKED, "most", 2)
    for extra in ("a", "b", "c"):
        jl.energy(OSCILLATOR, {"x": 1.0}, {"x": 0.0}, {"c": 4.0, extra: 1.0})
    assert len(given._CHECKED) <= 2


def test_a_list_of_numbers_is_a_vector_however_often_it_is_given():
    system = jl.System(lambda q, qdot, c: 0.5 * qdot @ qdot - 0.5 * c * q @ q)
    for c in (4.0, 5.0):
        np.testing.assert_allclose(jl.acceleration(system, [1.0, 2.0], [0.0, 0.0], {"c": c}).qddot, [-c, -2 * c], rtol=1e-15)


def test_sample_times_of_jax_are_kept_while_they_live():
    """Those of NumPy may be filled anew, so they are looked at each time."""
    run = lambda ts: jl.simulate(OSCILLATOR, {"x": 1.0}, {"x": 0.0}, ts, {"c": 4.0})
    ts, buffer, before = jnp.linspace(0, 1, 21), np.linspace(0, 1, 21), len(padding._KEPT)
    for _ in range(2):
        np.testing.assert_array_equal(run(ts).ts, buffer)
    assert len(padding._KEPT) == before + 1
    del ts
    assert len(padding._KEPT) == before
    np.testing.assert_array_equal(run(buffer).ts, np.linspace(0, 1, 21))
    buffer *= 2
    motion = run(buffer)
    np.testing.assert_array_equal(motion.ts, np.linspace(0, 2, 21))
    np.testing.assert_allclose(motion.q["x"], np.cos(2 * buffer), atol=1e-7)
    buffer[3] = 0.0
    with pytest.raises(ValueError, match="`ts` must increase, but ts\\[2\\]"):
        run(buffer)


def test_a_number_of_any_kind_is_compiled_for_once():
    traced = []

    def lagrangian(q, qdot, c):
        traced.append(c)
        return 0.5 * qdot**2 - 0.5 * c * q**2

    system = jl.System(lagrangian)
    expected = jl.simulate(system, 1.0, 0.0, TS, {"c": 4.0}).q
    once = len(traced)
    for number in (np.float64, np.array, jnp.asarray, jnp.float64, lambda c: np.asarray(c)[()], int):
        found = jl.simulate(system, number(1.0), number(0.0), list(TS), {"c": number(4.0)}, rtol=number(1) * 1e-8)
        np.testing.assert_array_equal(found.q, expected)
    assert len(traced) == once


def test_what_is_given_may_be_changed_afterwards():
    """Arrays of NumPy are copied: a buffer may be filled anew for the next recording."""
    buffer, record = TS.copy(), np.cos(2 * TS)
    experiment = jl.Experiment(buffer, record, 1.0, 0.0)
    params = {"c": np.array(4.0)}
    motion = jl.simulate(jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2), 1.0, 0.0, buffer, params)
    buffer[:], record[:], params["c"][...] = 0.0, 0.0, 0.0
    np.testing.assert_array_equal(experiment.ts, TS)
    np.testing.assert_array_equal(experiment.values, np.cos(2 * TS))
    np.testing.assert_array_equal(motion.ts, TS)
    assert motion.provenance.params["c"] == 4.0
