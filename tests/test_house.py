"""The order of the files: each imports only from files before it, and is short."""

import ast
import importlib.metadata
import pathlib
import re
import subprocess
import sys

import mutate
import pytest

import jaxlag
from jaxlag._program import primitives

pytestmark = pytest.mark.fast

PACKAGE = pathlib.Path(jaxlag.__file__).parent
WINGS = {  # each imports only from those above it, and each file of a wing only from those before it
    "_program": [
        "primitives",
        "constants",
        "expressions",
        "scalar_graph",
        "walker",
        "size_of_terms",
        "signed_zeros",
        "rules",
        "data_movement",
        "elimination",
        "interpreter",
        "scalarise",
        "conditions",
        "single_kernel",
        "without_libraries",
        "whole_kernel",
        "structured_jacobian",
        "registry",
        "description",
        "static",
        "cache_of_jax",
        "kept_programs",
        "jit",
        "implicit",
        "compilation_cache",
        "sparse_matrix",
        "block_tridiagonal",
        "shifted_factors",
        "sparsity",
        "sparse_jacobian",
        "sums_in_scans",
        "running_sums",
        "chain_ordering",
        "recursive_elimination",
        "sparse_newton",
        "velocity_degrees",
        "polynomials",
        "absolute_values",
        "substitution",
        "interval_arithmetic",
        "time_bounds",
        "time_functions",
        "choices",
        "boundaries",
    ],
    "_model": [
        "user_errors",
        "injection",
        "pickling",
        "paths",
        "numbers",
        "tables",
        "states",
        "contact",
        "event",
        "system",
        "state_values",
        "signal_interpolation",
        "signal",
        "excitation",
        "reading",
        "flat",
        "given",
        "validation",
        "kinematics",
        "recorded",
    ],
    "_mechanics": [
        "structured_inertia",
        "lagrange",
        "sliders",
        "pseudo_inverse",
        "augmented_inertia",
        "sparse_saddle_point",
        "block_saddle_point",
        "saddle_point",
        "constrained_root",
        "convex_dissipation",
        "self_consistent",
        "massless",
        "constrained_acceleration",
        "singular_directions",
        "friction_elements",
        "constrained_slip",
        "load_sharing",
        "slip_direction",
        "stick_slip",
        "frictional_contact",
        "friction_treatment",
        "contact",
        "impact",
        "projection",
        "return_mapping",
        "constraint_residuals",
        "consistent_state",
        "acceleration",
        "power",
        "couplings",
        "surfaces",
        "findings",
        "examine",
    ],
    "_motion": [
        "results",
        "scales",
        "step_size",
        "protocol",
        "unreached",
        "variational",
        "derivative_rule",
        "tableaux",
        "runge_kutta",
        "pulses",
        "step_monitor",
        "path_bounds",
        "split",
        "interval_inputs",
        "state_vector",
        "held_sides",
        "formulation",
        "batch",
        "first_order",
        "evaluated_samples",
        "loads",
        "search_for_start",
        "sample",
        "witnesses",
        "mode_changes",
        "jumps",
        "event_record",
        "events",
        "sparse_implicit",
        "guarantees",
        "wrapped_solver",
        "stick_slip_solver",
        "step_turn",
        "step_machine",
        "contact_phases",
        "event_phases",
        "one_evaluation_solver",
        "progress",
        "export",
        "provenance",
        "moments",
        "interpolation",
        "card",
        "trajectory",
        "load",
        "padding",
        "table",
        "failure",
        "interval_loop",
        "integrated",
        "integrate",
        "solution_map",
        "simulate",
        "members",
        "simulate_many",
        "step_map",
        "stepper",
    ],
    "_linear": [
        "origin",
        "inputs",
        "tangent_space",
        "dynamics",
        "newton",
        "matrices",
        "eigenvalues",
        "not_differentiated",
        "modes",
        "response",
        "linear_system",
        "sampled_data",
        "steadiness",
        "bends",
        "linearise",
        "descent",
        "sparse_root",
        "sparse_descent",
        "rest_on_contacts",
        "rest",
        "sparse_rest",
        "stability",
        "equilibrium",
        "pencil",
        "sparse_modes",
        "lowest_modes",
        "zero_eigenvalues",
        "branches",
        "crossing",
        "root_locus",
        "return_map",
        "periodic",
        "parameter_plane",
        "stability_map",
    ],
    "_curves": [
        "arclength",
        "critical",
        "in_plane",
        "curve",
        "measures",
        "orbits",
        "special_points",
        "orbit_curve",
        "response_curve",
        "rests",
        "equilibrium_curve",
    ],
    "_optimal": [
        "radau",
        "block_system",
        "chain",
        "interior_point",
        "sensitivity",
        "input",
        "boundary",
        "transcription",
        "solution",
        "guess",
        "statement",
        "optimise_motion",
    ],
    "_fit": [
        "experiment",
        "parameters",
        "robust_loss",
        "arrow",
        "experiment_batch",
        "autocorrelation",
        "channels",
        "base_parameters",
        "identifiability",
        "measurement",
        "linear_test",
        "modal_test",
        "response_curve_test",
        "frequency_response_test",
        "residuals",
        "problem",
        "levenberg_marquardt",
        "noise",
        "smoothing_spline",
        "multiple_shooting",
        "profile_likelihood",
        "rounding",
        "fit_card",
        "prediction",
        "result",
        "minimum",
        "uncertainty",
        "parameter_stability",
        "undetermined",
        "remarks",
        "experiment_statistics",
        "linear_test_statistics",
        "statistics",
        "windows",
        "weak_form",
        "weak_regression",
        "regress",
        "information",
        "starts",
        "minimise",
        "fit",
        "validate",
        "best_subset",
        "discover",
        "recover",
        "constrained_minimum",
        "design_criteria",
        "design_plan",
        "design_problem",
        "design_search",
        "design",
        "posterior",
        "log_density",
        "comparison",
    ],
    "_paper": [
        "formulas",
        "to_sympy",
        "sum_of_products",
        "factoring",
        "identities",
        "simplify",
        "linear_solve",
        "derivative",
        "derivation",
        "coordinate_elimination",
        "symbol_tree",
        "contact_laws",
        "symbolic_system",
        "operating_point",
        "linearisation",
        "linearised_check",
        "notation",
        "textbook_printer",
        "unicode_printer",
        "latex_printer",
        "identifiers",
        "codegen",
        "fmu_program",
        "fmu_motion",
        "fmu_description",
        "fmu",
        "fmu_of_equations",
        "result",
        "linearised_result",
        "linearised",
        "equations",
    ],
    "_draw": [
        "axes",
        "motion",
        "forces",
        "linear",
        "animation",
        "moving_picture",
        "mode_on_points",
        "animate",
        "mode_shapes",
        "stability_map",
        "fit",
        "recovery",
        "design",
        "posterior",
        "optimal_motion",
        "response_curve",
        "report",
    ],
}
BESIDE = ["dissipation", "learnt", "rigid"]  # need nothing of the package
ON_TOP = [
    "plot",
    "results",
    "direction",
    "interpolation",
    "stabilisation",
    "surfaces",
    "elements",
    "__init__",
    "__main__",
]  # import from any wing


HOMES = [
    ("diffrax", "_motion"),
    ("matplotlib", "_draw"),
    ("optax", "_fit"),
    ("optimistix", "_fit"),
    ("pandas", "_motion/export"),
    ("polars", "_motion/export"),
    ("scipy", ("_program", "_fit", "_linear", "_curves")),
    ("sympy", "_paper"),
]
LONGEST_FILE = 500
TABLES = {"tableaux"}  # coefficients
LONGEST_BODY = 60
OWN_TABLES = {"structured_jacobian", "sums_in_scans", "whole_kernel", "fmu_program", "unicode_printer"}  # the last of SymPy's names
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


def test_a_file_imports_only_from_files_before_it():
    for i, (wing, name) in enumerate(FILES):
        allowed = FILES[:i] + [("", beside) for beside in BESIDE]
        assert set(_imported(PACKAGE / wing / f"{name}.py")) <= set(allowed), f"{wing}/{name}"


def test_every_file_has_its_place():
    found = {(file.parent.name, file.stem) for file in PACKAGE.glob("_*/*.py") if file.stem != "__init__"}
    assert found == set(FILES)
    assert {file.stem for file in PACKAGE.glob("*.py")} | {"learnt", "rigid"} == set(BESIDE + ON_TOP)


def test_what_stands_beside_the_wings_needs_nothing_of_them():
    assert not list(_imported(PACKAGE / "dissipation.py"))
    for package in ("learnt", "rigid"):
        assert {home for file in (PACKAGE / package).glob("*.py") for home, _ in _imported(file)} == {package}


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


def _collections(file):
    """The sets, tuples and lists of constants in a file, texts of several words, and dictionaries of constants by their keys."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, (ast.Set, ast.Tuple, ast.List)):
            yield node.lineno, [x.value for x in node.elts if isinstance(x, ast.Constant)]
        elif isinstance(node, ast.Dict) and any(isinstance(x, (ast.Constant, ast.Tuple)) for x in node.values):  # not rules
            yield node.lineno, [x.value for x in node.keys if isinstance(x, ast.Constant)]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            words = node.value.split()
            yield node.lineno, words if primitives.KNOWN.issuperset(words) else []


def test_names_of_primitives_stand_in_one_table():
    """In others a pair may be named, as of the two that a rule is for; what stands beside the wings cannot look into it."""
    found = [
        (file.stem, line)
        for file in PACKAGE.glob("_*/*.py")
        if file.stem not in ("primitives", *OWN_TABLES)
        for line, names in _collections(file)
        if len(primitives.KNOWN.intersection(names)) > 2
    ]
    assert not found
    names = [name for row in primitives.TABLE.splitlines() for name in row.split(":")[0].split()]
    assert len(names) == len(set(names)) > 100


def test_import_has_no_side_effects():
    code = "import jax; before = jax.config.values.copy(); import jaxlag; assert jax.config.values == before"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0 and run.stdout == run.stderr == "", run.stderr


def test_the_version_is_that_of_the_metadata_and_the_types_are_shipped():
    assert jaxlag.__version__ == importlib.metadata.version("jaxlag")
    assert (PACKAGE / "py.typed").exists()


def test_mutations_are_of_what_stands_in_the_package():
    found = mutate.mutations()
    assert len({mutation.wrong for mutation in found}) == len(found) >= 60
    for mutation in found:
        assert mutate.mutated(mutation, (mutate.ROOT / mutation.file).read_text())
        assert all((mutate.ROOT / "tests" / path).exists() for path in mutation.first), mutation.wrong


def test_benchmarks_import_what_their_siblings_have():
    folder = pathlib.Path(__file__).parent / "benchmarks"
    trees = {path.stem: ast.parse(path.read_text()) for path in folder.glob("*.py")}
    names = lambda tree: {n.id for n in ast.walk(tree) if isinstance(n, ast.Name)} | {getattr(n, "name", "") for n in tree.body}
    defined = {stem: names(tree) for stem, tree in trees.items()}
    imports = [(stem, n) for stem, tree in trees.items() for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and n.module in trees]
    assert imports
    missing = [f"{stem}: {n.module}.{x.name}" for stem, n in imports for x in n.names if x.name not in defined[n.module]]
    assert not missing, missing
