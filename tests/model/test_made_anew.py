"""Functions made anew: compiled anew each time, which is said once; and let go of with what they hold."""

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


def said(action, times):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for i in range(times):
            action(i)
    return [str(warning.message) for warning in caught if "must be made once" in str(warning.message)]


def test_a_lambda_made_anew_in_a_loop_is_said_once():
    found = said(lambda i: jl.mass_matrix(jl.System(lambda qdot: 0.5 * (1 + i) * qdot**2), 0.0, 0.0), 5)
    assert len(found) == 1
    assert found[0].startswith("`lagrangian` must be made once to be compiled once, but `<lambda>`, line ")
    assert "test_made_anew.py, was made anew 3 times" in found[0] and found[0].endswith("let what changes be an entry of params.")


def test_what_a_function_is_made_from_counts_too():
    point = lambda i: jl.virtual_work(lambda q: (1 + i) * q, 1.0)
    system = lambda i: jl.System({"T": kinetic}, force={"wind": point(i)})
    assert said(lambda i: jl.powers(system(i), 0.0, 0.0), 3)[0].startswith("`force` 'wind' must be made once to be compiled once")


def kinetic(qdot):
    return 0.5 * jnp.sum(qdot**2)


def test_what_is_no_loop_is_not_warned_of():
    one = jl.System({f"V{i}": spring(i) for i in range(5)} | {"T": kinetic})  # several from one factory, in one system
    assert not said(lambda i: jl.mass_matrix(one, 0.0, 0.0), 5)
    assert not said(lambda i: jl.mass_matrix(jl.System(kinetic), *np.zeros((2, 1 + i))), 4)  # one function, of other shapes
    chains = lambda i: jl.System(lambda qdot: 0.5 * (1 + i) * qdot @ qdot)
    assert not said(lambda i: jl.mass_matrix(chains(i), *np.zeros((2, 1 + i))), 4)  # each compiled anew for its shapes anyway
    terms = [jl.System({"T": kinetic, name: spring(1.0)}) for name in ("a", "b")]
    assert not said(lambda i: jl.mass_matrix(terms[i], 0.0, 0.0), 2)


SCRIPT = """
import json, warnings
import jaxlag as jl
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    for i in range(3):
        system = jl.System(lambda qdot: 0.5 * qdot**2)
        jl.mass_matrix(system, 0.0, 0.0)
print(json.dumps([(w.filename, w.lineno) for w in caught if "must be made once" in str(w.message)]))
"""


def test_the_warning_is_of_the_line_of_the_user():
    """Seen from a script, for here the annotations are checked in between."""
    run = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True)
    assert json.loads(run.stdout) == [["<string>", 8]]


class Held:
    """Stands for what a function holds: a table, a recording."""

    stiffness = 4.0


CALLS = {
    "acceleration": lambda system: jl.acceleration(system, 1.0, 0.0),
    "gradient": lambda system: jax.grad(lambda q: jl.energy(system, q, 0.0))(1.0),
    "motion": lambda system: jl.simulate(system, 1.0, 0.0, [0.0, 0.1]),
    "motions": lambda system: jl.simulate_many(system, jnp.ones(2), jnp.zeros(2), [0.0, 0.1], over=("q0", "qdot0")),
}


@pytest.mark.parametrize("call", CALLS)
def test_what_a_function_holds_is_let_go_of(call):
    held = Held()
    alive = weakref.ref(held)
    system = jl.System({"T": kinetic, "V": lambda q: -0.5 * held.stiffness * q**2})  # noqa: F821
    CALLS[call](system)
    del held, system
    jax.clear_caches()
    gc.collect()
    assert alive() is None


def test_what_is_counted_holds_no_function():
    before = len(user_errors._met)
    said(lambda i: jl.mass_matrix(jl.System(lambda qdot: 0.5 * (3 + i) * qdot**2), 0.0, 0.0), 3)
    jax.clear_caches()
    gc.collect()
    assert len(user_errors._met) <= before
