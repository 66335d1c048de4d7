"""What a process remembers: it is little, it is forgotten at once, and results do not depend on it."""

import ast
import gc
import weakref
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._model import given, user_errors
from jaxlag._motion import padding
from jaxlag._program.registry import Table, forget, remembered

pytestmark = pytest.mark.fast

PACKAGE = Path(jl.__file__).parent
TABLES = {"WeakKeyDictionary", "WeakValueDictionary", "WeakSet", "lru_cache", "OrderedDict"}
WITH_TABLES = {"registry.py", "formulas.py"}  # of SymPy's expressions, by themselves


def test_the_latest_entries_stay():
    table = Table(most=2)
    for key in "abac":
        table[key] = key.upper()
    assert dict(table) == {"b": "B", "c": "C"}


def test_an_entry_goes_with_the_object_that_it_is_about():
    table, held = Table(weak=True), lambda: None
    table[held] = 1
    assert table[held] == 1 and len(table) == 1
    del held
    gc.collect()
    assert not table


def test_a_value_is_computed_once_until_it_is_forgotten():
    asked = []
    double = remembered(lambda x: asked.append(x) or 2 * x)
    assert [double(2), double(2), double(3)] == [4, 4, 6] and asked == [2, 3]
    forget()
    assert double(2) == 4 and asked == [2, 3, 2]


def test_motions_are_the_same_after_all_is_forgotten():
    system, ts = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2), jnp.linspace(0, 2, 41)
    before = jl.simulate(system, 1.0, 0.0, ts, {"c": 4.0}).q
    assert given._CHECKED and padding._KEPT and user_errors._seen
    forget()
    assert not given._CHECKED and not padding._KEPT and not user_errors._seen
    np.testing.assert_array_equal(jl.simulate(system, 1.0, 0.0, ts, {"c": 4.0}).q, before)
    alive = weakref.ref(system.lagrangian[0][1])
    del system
    forget()
    gc.collect()
    assert alive() is None


def test_there_are_no_other_tables():
    """But those of what is computed once, `functools.cache` of a function without arguments."""
    found = {
        file.name
        for file in PACKAGE.rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text()))
        if (isinstance(node, ast.Attribute) and node.attr in TABLES) or _is_cached(node)
    }
    assert found <= WITH_TABLES


def _is_cached(node):
    return isinstance(node, ast.FunctionDef) and node.args.args and "functools.cache" in map(ast.unparse, node.decorator_list)
