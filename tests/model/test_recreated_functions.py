"""Recreated functions: compiled anew each time, of which one warning tells; and freed together with what they close over."""

import gc
import json
import subprocess
import sys
import warnings
import weakref

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._model import user_errors


def spring(stiffness):
    return lambda q: 0.5 * stiffness * q**2


def warnings_of(action, times):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for i in range(times):
            action(i)
    return [str(warning.message) for warning in caught if "must be made once" in str(warning.message)]


def test_a_lambda_recreated_in_a_loop_is_warned_of_once():
    found = warnings_of(lambda i: jl.mass_matrix(jl.System(lambda qdot: 0.5 * (1 + i) * qdot**2), 0.0, 0.0), 5)
    assert len(found) == 1
    assert found[0].startswith("`lagrangian` must be made once to be compiled once, but `<lambda>`, line ")
    assert "test_recreated_functions.py, was created 3 times" in found[0] and found[0].endswith("make what changes an entry of params.")


def test_what_a_function_is_composed_of_counts_too():
    point = lambda i: jl.virtual_work(lambda q: (1 + i) * q, 1.0)
    system = lambda i: jl.System({"T": kinetic}, force={"wind": point(i)})
    assert warnings_of(lambda i: jl.powers(system(i), 0.0, 0.0), 3)[0].startswith("`force` 'wind' must be made once to be compiled once")


def kinetic(qdot):
    return 0.5 * jnp.sum(qdot**2)


def test_systems_that_differ_are_not_warned_of():
    one = jl.System({f"V{i}": spring(i) for i in range(5)} | {"T": kinetic})  # several from one factory, in one system
    assert not warnings_of(lambda i: jl.mass_matrix(one, 0.0, 0.0), 5)
    assert not warnings_of(lambda i: jl.mass_matrix(jl.System(kinetic), *np.zeros((2, 1 + i))), 4)  # one function, of other shapes
    chains = lambda i: jl.System(lambda qdot: 0.5 * (1 + i) * qdot @ qdot)
    assert not warnings_of(lambda i: jl.mass_matrix(chains(i), *np.zeros((2, 1 + i))), 4)  # each compiled anew for its shapes anyway
    terms = [jl.System({"T": kinetic, name: spring(1.0)}) for name in ("a", "b")]
    assert not warnings_of(lambda i: jl.mass_matrix(terms[i], 0.0, 0.0), 2)


SCRIPT = """
import json, warnings
import jaxlag as jl
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    for i in range(3):
        system = jl.System(lambda qdot, i=i: 0.5 * (1 + i) * qdot**2)
        jl.mass_matrix(system, 0.0, 0.0)
print(json.dumps([(w.filename, w.lineno) for w in caught if "must be made once" in str(w.message)]))
"""


def test_the_warning_names_the_line_of_the_user():
    """Seen from a script, since here the checks of annotations stand in between."""
    run = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True)
    assert json.loads(run.stdout) == [["<string>", 8]]


class Held:
    """Stands for what a function closes over: a table, a recording."""

    stiffness = 4.0


CALLS = {
    "acceleration": lambda system: jl.acceleration(system, 1.0, 0.0),
    "gradient": lambda system: jax.grad(lambda q: jl.energy(system, q, 0.0))(1.0),
    "motion": lambda system: jl.simulate(system, 1.0, 0.0, [0.0, 0.1]),
    "motions": lambda system: jl.simulate_many(system, jnp.ones(2), jnp.zeros(2), [0.0, 0.1], over=("q0", "qdot0")),
}


@pytest.mark.parametrize("call", CALLS)
def test_what_a_function_closes_over_is_freed(call):
    held = Held()
    alive = weakref.ref(held)
    system = jl.System({"T": kinetic, "V": lambda q: -0.5 * held.stiffness * q**2})  # noqa: F821
    CALLS[call](system)
    del held, system
    jax.clear_caches()
    gc.collect()
    assert alive() is None


def test_counting_keeps_no_function_alive():
    before = len(user_errors._seen)
    warnings_of(lambda i: jl.mass_matrix(jl.System(lambda qdot: 0.5 * (3 + i) * qdot**2), 0.0, 0.0), 3)
    jax.clear_caches()
    gc.collect()
    assert len(user_errors._seen) <= before
