"""The order of the files: each imports only from files before it; and every public name is documented with an example that runs."""

import ast
import inspect
import pathlib
import re
import subprocess
import sys

import pytest

import jaxlag

PACKAGE = pathlib.Path(jaxlag.__file__).parent
WINGS = {  # each imports only from those above it, and each file of a wing only from those before it
    "_program": [
        "constants",
        "scalar_graph",
        "rules",
        "elimination",
        "interpreter",
        "scalarise",
        "single_kernel",
        "structured_jacobian",
        "jit",
        "sparse_jacobian",
        "dependence",
        "polynomials",
        "absolute_values",
        "substitution",
        "interval_arithmetic",
        "time_bounds",
    ],
    "_model": [
        "user_errors",
        "injection",
        "pickling",
        "paths",
        "system",
        "numbers",
        "validation",
        "signal",
        "kinematics",
    ],
    "_mechanics": [
        "lagrange",
        "saddle_point",
        "singular_directions",
        "friction_terms",
        "load_sharing",
        "stick_slip",
        "acceleration",
        "power",
        "examine",
        "projection",
    ],
    "_motion": [
        "first_order",
        "results",
        "guarantees",
        "progress",
        "export",
        "interpolation",
        "provenance",
        "trajectory",
        "load",
        "variational",
        "derivative_rule",
        "tableaux",
        "runge_kutta",
        "step_monitor",
        "wrapped_solver",
        "integrate",
        "simulate",
        "simulate_many",
    ],
    "_fit": [
        "experiment",
        "parameters",
        "residuals",
        "problem",
        "levenberg_marquardt",
        "autocorrelation",
        "identifiability",
        "smoothing_spline",
        "multiple_shooting",
        "result",
        "statistics",
        "regress",
        "fit",
        "assess",
    ],
    "_paper": [
        "to_sympy",
        "simplify",
        "linear_solve",
        "derivation",
        "symbolic_system",
        "printers",
        "codegen",
        "equations",
    ],
    "_draw": [
        "axes",
        "motion",
        "forces",
        "animate",
        "fit",
    ],
}
BESIDE = ["dissipation", "learnt"]  # need nothing of the package
ON_TOP = ["plot", "__init__", "__main__"]  # import from any wing
PUBLIC = [name for name in vars(jaxlag) if not name.startswith("_") and callable(getattr(jaxlag, name))]


HOMES = [
    ("diffrax", "_motion"),
    ("matplotlib", "_draw"),
    ("optax", "_fit"),
    ("optimistix", "_fit"),
    ("pandas", "_motion/export"),
    ("polars", "_motion/export"),
    ("scipy", "_fit"),
    ("sympy", "_paper"),
]
LONGEST_FILE = 300
TABLES = {"tableaux"}  # coefficients
LONGEST_BODY = 60
FILES = [(wing, name) for wing, names in WINGS.items() for name in names]


def _imported(file):
    """The files of the package that `file` imports, as (wing, name)."""
    inside = file.parent != PACKAGE
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            *wing, name = [*([file.parent.name] if inside and node.level == 1 else []), *(node.module or "").split(".")]
            if name:
                yield (wing[0] if wing else "", name)
            else:
                yield from ((file.parent.name if inside else "", alias.name) for alias in node.names)


@pytest.mark.parametrize("wing, name", FILES)
def test_a_file_imports_only_from_files_before_it(wing, name):
    allowed = FILES[: FILES.index((wing, name))] + [("", beside) for beside in BESIDE]
    assert set(_imported(PACKAGE / wing / f"{name}.py")) <= set(allowed)


def test_every_file_has_its_place():
    found = {(file.parent.name, file.stem) for file in PACKAGE.glob("_*/*.py") if file.stem != "__init__"}
    assert found == set(FILES)
    assert {file.stem for file in PACKAGE.glob("*.py")} == set(BESIDE + ON_TOP)


def test_what_stands_beside_the_wings_needs_nothing_of_them():
    assert not [imported for name in BESIDE for imported in _imported(PACKAGE / f"{name}.py")]


@pytest.mark.parametrize("wing, names", WINGS.items())
def test_a_wing_has_few_floors(wing, names):
    floor = {}
    for name in names:
        floor[name] = 1 + max((floor[below] for home, below in _imported(PACKAGE / wing / f"{name}.py") if home == wing), default=0)
    assert max(floor.values()) <= 12


def test_a_file_is_short_enough_to_be_read():
    lengths = {file.stem: len(file.read_text().splitlines()) for file in PACKAGE.rglob("*.py")}
    assert not {name: length for name, length in lengths.items() if length > LONGEST_FILE and name not in TABLES}


def _length(function):
    """Lines of a function's body: without its signature and its docstring."""
    first = function.body[1] if ast.get_docstring(function) and len(function.body) > 1 else function.body[0]
    return function.end_lineno - first.lineno + 1


def test_a_body_is_short_enough_to_be_seen_at_once():
    functions = [
        (file.stem, node.name, _length(node))
        for file in PACKAGE.rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.FunctionDef)
    ]
    assert not [found for found in functions if found[2] > LONGEST_BODY]


@pytest.mark.parametrize("library, home", HOMES)
def test_a_library_has_one_home(library, home):
    users = [f for f in PACKAGE.glob("_*/*.py") if re.search(rf"^\s*(import|from) {library}\b", f.read_text(), re.M)]
    assert users and all(f.relative_to(PACKAGE).as_posix().startswith(home) for f in users)


@pytest.mark.parametrize("name", PUBLIC)
def test_every_public_name_has_a_docstring(name):
    assert len(inspect.getdoc(getattr(jaxlag, name)) or "") > 60


@pytest.mark.parametrize("name", [name for name in PUBLIC if "```python" in (inspect.getdoc(getattr(jaxlag, name)) or "")])
def test_docstring_examples_run_and_give_what_they_say(name):
    doc = inspect.getdoc(getattr(jaxlag, name))
    for block in re.findall(r"```python\n(.*?)```", doc, re.S):
        exec(block, {})


def test_import_has_no_side_effects():
    code = "import jax; before = jax.config.values.copy(); import jaxlag; assert jax.config.values == before"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0 and run.stdout == run.stderr == "", run.stderr
