"""What Python does in a call whose program is compiled already: counted in a fresh process, since a time would depend on the machine."""

import json
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

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


@pytest.mark.parametrize("call, most", [("simulate", 1000), ("acceleration", 450), ("fit", 6000), ("iteration", 350)])
def test_python_does_little(counts, call, most):
    """One conversion by JAX is some 90 calls of functions: were each number converted by itself, `simulate` would make 4000."""
    assert 0 < counts[call] <= most


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
