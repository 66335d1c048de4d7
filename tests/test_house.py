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
ORDER = [
    "_arithmetic",
    "_folding",
    "_primitives",
    "_elimination",
    "_entries",
    "_scalarised",
    "_kernel",
    "_products",
    "_diagnosis",
    "_arguments",
    "_pickling",
    "_system",
    "_compiled",
    "_numbers",
    "_checks",
    "_signal",
    "_kinematics",
    "_jacobian",
    "_mechanics",
    "_multipliers",
    "_causes",
    "_structure",
    "_polynomials",
    "_moduli",
    "_rewritten",
    "_kinks",
    "_share",
    "_friction",
    "_acceleration",
    "_power",
    "_examine",
    "_manifold",
    "_motion",
    "_results",
    "_promises",
    "_progress",
    "_plain",
    "_interpolation",
    "_stated",
    "_trajectory",
    "_load",
    "_canvas",
    "_plot_motion",
    "_plot_forces",
    "_variations",
    "_sensitivities",
    "_tableaux",
    "_runge_kutta",
    "_intervals",
    "_enclosure",
    "_watch",
    "_steps",
    "_solve",
    "_integrate",
    "_animate",
    "_experiment",
    "_many",
    "_free",
    "_prediction",
    "_problem",
    "_least_squares",
    "_autocorrelation",
    "_quality",
    "_smoothing",
    "_shooting",
    "_fit",
    "_plot_fit",
    "_report",
    "_regress",
    "_identify",
    "_assess",
    "_symbols",
    "_tidy",
    "_linear",
    "_derivation",
    "_statement",
    "_notation",
    "_programs",
    "_equations",
    "plot",
]
BESIDE = ["dissipation", "learnt"]  # need nothing of the package
PUBLIC = [name for name in vars(jaxlag) if not name.startswith("_") and callable(getattr(jaxlag, name))]


PAPER = {"_symbols", "_tidy", "_linear", "_derivation", "_statement", "_notation", "_programs", "_equations"}
HOMES = [
    ("diffrax", {"_results", "_runge_kutta", "_steps", "_solve", "_integrate", "_many"}),
    ("matplotlib", {"_canvas", "_animate"}),
    ("optimistix", {"_least_squares"}),
    ("optax", {"_identify"}),
    ("pandas", {"_plain"}),
    ("polars", {"_plain"}),
    ("scipy", {"_autocorrelation", "_smoothing", "_fit"}),
    ("sympy", PAPER),
]


def _imported(file):
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level == 1:
            yield from ([node.module] if node.module else [alias.name for alias in node.names])


@pytest.mark.parametrize("name", ORDER)
def test_a_file_imports_only_from_files_before_it(name):
    assert set(_imported(PACKAGE / f"{name}.py")) <= set(ORDER[: ORDER.index(name)])


def test_every_file_has_its_place():
    assert {f.stem for f in PACKAGE.glob("*.py")} - {"__init__", "__main__"} == set(ORDER + BESIDE)


@pytest.mark.parametrize("library, home", HOMES)
def test_a_library_has_one_home(library, home):
    users = {f.stem for f in PACKAGE.glob("*.py") if re.search(rf"^\s*(import|from) {library}", f.read_text(), re.M)}
    assert users <= home


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
