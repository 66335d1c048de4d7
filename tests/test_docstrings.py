"""Every public name is documented: its arguments, results, errors and fields, and an example that runs and gives what it states.

An example states the value of an expression in the comment behind it, `f(x)  # 4.0`. Of the comment's parts between commas, those that
are numbers behind their last `=` or `:` are compared with the numbers of the value, in order:

    # −(g/l) sin φ = −2.35        # [[1, 0], [0, 1]]        # oil: −12, pull: 10

A whole number must agree to 1e-4, any other to its last printed digit; the rest of the comment is prose. Of a string the comment is the
value, and of `print(...)` a part of what is printed.
"""

import ast
import contextlib
import dataclasses
import inspect
import io
import re
import textwrap

import equinox as eqx
import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest

import jaxlag
from jaxlag import direction, dissipation, interpolation, learnt, plot, results, rigid


def _public_names():
    """Functions and classes by the names that a user writes behind `jaxlag.`"""
    homes = {
        "": vars(jaxlag),
        "results.": vars(results),
        "direction.": vars(direction),
        "interpolation.": vars(interpolation),
        "dissipation.": vars(dissipation),
        "learnt.": vars(learnt),
        "plot.": {n: getattr(plot, n) for n in plot.__all__},
        "rigid.": vars(rigid),
        "rigid.inertia.": {n: getattr(rigid.inertia, n) for n in rigid.inertia.__all__},
    }
    for home, names in homes.items():
        for name, thing in names.items():
            ours = getattr(thing, "__module__", "").startswith("jaxlag") and (home != "dissipation." or inspect.isfunction(thing))
            if callable(thing) and ours and not name.startswith("_"):
                yield home + name, thing


def _methods(names):
    """Public methods and properties that the public classes define themselves, by `Class.method`."""
    for name, cls in names.items():
        for key, member in vars(cls).items() if inspect.isclass(cls) else ():
            function = getattr(member, "fget", None) or getattr(member, "method", None) or getattr(member, "__func__", member)
            if not key.startswith("_") and inspect.isfunction(function):
                yield f"{name}.{key}", function


PUBLIC = dict(_public_names())
CALLED_BY_THE_PACKAGE = ("elements", "smoothed", "project", "evaluate")  # methods of objects of choice: friction, signals, projection
METHODS = {name: method for name, method in _methods(PUBLIC) if name.split(".")[-1] not in CALLED_BY_THE_PACKAGE}
FUNCTIONS = {name: thing for name, thing in PUBLIC.items() if inspect.isfunction(thing)}
CLASSES = {name: thing for name, thing in PUBLIC.items() if inspect.isclass(thing) and not issubclass(thing, eqx.Enumeration)}
MADE_BY_HAND = {name: cls for name, cls in CLASSES.items() if "**Arguments" in (cls.__doc__ or "")}  # the others are results
ARRAYS = {"t", "ts", "v", "q", "qdot", "q0", "qdot0"}
WITH_EXAMPLES = [name for name, thing in (PUBLIC | METHODS).items() if "```python" in (inspect.getdoc(thing) or "")]


def _parameters(function):
    return [p for p in inspect.signature(function).parameters.values() if p.name not in ("self", "cls")]


def _doc(name):
    """A docstring, with those that it refers to: "as for `fit`", "as `mass_matrix`"."""
    doc = inspect.getdoc((PUBLIC | METHODS)[name]) or ""
    home = name.rpartition(".")[0]
    others = re.findall(r"\bas (?:for |in )?`(\w+)`", doc)
    found = [inspect.getdoc(PUBLIC.get(f"{home}.{other}" if home in ("learnt", "plot", "rigid") else other)) or "" for other in others]
    return "\n".join([doc, *found])


def _is_named(name, doc):
    """Whether a docstring speaks of a name as of code."""
    return re.search(rf"`[^`]*\b{name}\b[^`]*`", doc) is not None


# --- examples

NUMBER = re.compile(r"[-+]?\d+(?:\.\d*)?(?:e[-+]?\d+)?", re.I)


def stated_numbers(comment):
    """The numbers that a comment states, as they are printed."""
    parts = (re.split("[=:]", part)[-1].strip(" []()") for part in comment.replace("−", "-").split(","))
    return [part for part in parts if NUMBER.fullmatch(part)]


def resolution(printed):
    """How far off a value may be from a number as it is printed."""
    if float(printed) == round(float(printed)):
        return 1e-4 * max(1.0, abs(float(printed)))
    digits, _, exponent = printed.lower().partition("e")
    return 0.5 * 10.0 ** (int(exponent or 0) - len(digits.partition(".")[2])) + 1e-12


def statements(code):
    """Each statement of an example as (tree, the comment behind it)."""
    lines = code.splitlines()
    for node in ast.parse(code).body:
        yield node, lines[node.end_lineno - 1].encode()[node.end_col_offset :].decode().partition("#")[2].strip()


def check_statement(node, comment, names):
    """Runs one statement and compares its value with what the comment behind it states."""
    if not isinstance(node, ast.Expr):
        exec(compile(ast.Module([node], []), "<example>", "exec"), names)
        return
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        value = eval(compile(ast.Expression(node.value), "<example>", "eval"), names)
    if printed.getvalue():
        assert comment in printed.getvalue()
    elif comment and isinstance(value, str):
        assert value == comment
    elif (stated := stated_numbers(comment)) or NUMBER.match(comment):
        found = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(value)])
        assert found.size == len(stated), f"{found} is not {comment}"
        for x, text in zip(found, stated, strict=True):
            np.testing.assert_allclose(x, float(text), rtol=0, atol=resolution(text), err_msg=comment)


SHOWN_ELSEWHERE = {  # by the example of the function that makes it, or draws it: `log_density`, `optimise_motion`, `response_curve`, ...
    *("MultiStart", "plot.optimal_motion", "plot.posterior", "plot.recovery", "plot.response_curve"),
    *("results.Design", "results.Discovery", "results.LogDensity", "results.OptimalMotion", "results.Posterior"),
    *("results.Posterior.bands", "results.Posterior.plot", "results.ResponseCurve.plot"),
}


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SHOWN_ELSEWHERE)) for name in WITH_EXAMPLES])
def test_an_example_runs_and_gives_what_it_states(name, compilation_cache, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # some write files
    for code in re.findall(r"```python\n(.*?)```", inspect.getdoc((PUBLIC | METHODS)[name]), re.S):
        names: dict = {}
        for node, comment in statements(textwrap.dedent(code)):
            check_statement(node, comment, names)
    plt.close("all")


@pytest.mark.parametrize(
    "comment, numbers",
    [
        ("−(g/l) sin φ = −2.35", ["-2.35"]),
        ("[[12, 0], [0, 3e-2]], rows phi and x", ["12", "0", "0", "3e-2"]),
        ("oil: −12, pull: 10", ["-12", "10"]),
        ("0.0, exactly", ["0.0"]),
        ("negative: against the motion", []),
    ],
)
def test_numbers_that_a_comment_states(comment, numbers):
    assert stated_numbers(comment) == numbers


@pytest.mark.parametrize("code", ["1.0 + 1.0  # 2.1", "[1.0, 2.0]  # 1.0", "0.4081  # 0.409", "'y'  # x", "print('a')  # b"])
def test_a_false_statement_is_found(code):
    ((node, comment),) = statements(code)
    with pytest.raises(AssertionError):
        check_statement(node, comment, {})


def test_what_a_user_calls_has_an_example():
    assert {*FUNCTIONS, *MADE_BY_HAND} <= {*WITH_EXAMPLES}


# --- sections: of each the names that lack something


def test_every_public_name_has_a_docstring():
    assert not [name for name in PUBLIC | METHODS if len(inspect.getdoc((PUBLIC | METHODS)[name]) or "") <= (60 if name in PUBLIC else 10)]


@pytest.mark.parametrize("section", ["Arguments", "returns", "raises"])
def test_a_public_function_says_what_goes_in_what_comes_out_and_what_is_refused(section):
    names = [name for name, f in FUNCTIONS.items() if section != "Arguments" or _parameters(f)]
    assert not [name for name in names if not re.search(rf"(?i)\*\*[\w, ]*{section}", _doc(name))]


def test_a_public_function_of_arrays_says_their_shapes():
    names = [name for name, f in FUNCTIONS.items() if ARRAYS & {p.name for p in _parameters(f)}]
    assert not [name for name in names if not re.search(r"shape|scalar|number|structured|like|\([\w, ]+,\)|\(\w, \w+\)", _doc(name))]


def test_a_public_class_says_what_is_refused():
    names = [name for name in MADE_BY_HAND if _parameters(CLASSES[name])]
    assert not [name for name in names if not re.search(r"(?i)\*\*[\w, ]*raises", CLASSES[name].__doc__)]


CALLED = {name: thing for name, thing in (PUBLIC | METHODS).items() if name in FUNCTIONS | MADE_BY_HAND | METHODS}


def test_every_parameter_is_documented():
    of = lambda thing: {p.name for p in _parameters(thing)} - {"system"}  # which is what its annotation says
    assert not [(name, p) for name, thing in CALLED.items() for p in of(thing) if not _is_named(p, _doc(name))]


def test_every_parameter_is_annotated():
    assert not [(name, p.name) for name, thing in CALLED.items() for p in _parameters(thing) if p.annotation is p.empty]


def test_every_public_field_is_documented():
    of = lambda cls: [f.name for f in dataclasses.fields(cls)] if dataclasses.is_dataclass(cls) else getattr(cls, "_fields", ())
    fields = [(cls, field) for cls in CLASSES.values() for field in of(cls) if not field.startswith("_")]
    assert not [(cls.__name__, field) for cls, field in fields if not _is_named(field, inspect.getdoc(cls) or "")]
