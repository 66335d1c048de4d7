"""Private parts of other packages: each use is listed in CONTRIBUTING.md, and the package that owns it has an upper bound."""

import ast
import importlib
import inspect
import re
import tomllib
from fnmatch import fnmatch
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import jaxlag

pytestmark = pytest.mark.fast

ROOT, PACKAGE = Path(__file__).parents[1], Path(jaxlag.__file__).parent
UNSTABLE = {"internal", "interpreters", "extend", "experimental"}  # modules of JAX and Equinox whose interface may change at any time
DOCUMENTED = {"_replace", "_fields", "_asdict", "_getframe"}  # of named tuples and of sys
DESCRIBED = {"jaxlag", "builtins", "abc", "enum", "typing"}  # where private methods are documented, or ours
OPTION = "xla_"  # how names of XLA's options begin
ALSO_ELSEWHERE = {"parent", "unflatten"}  # names of pathlib and of `jax.tree`, too


def listed():
    """The table in CONTRIBUTING.md, as (package, parts, files)."""
    section = (ROOT / "CONTRIBUTING.md").read_text().split("## Private parts of other packages that we use\n")[1]
    rows = re.findall(r"^\| (\w+) \| (`.*?) \| (`.*?) \| .* \|$", section, re.M)
    return [(owner, re.findall("`(.+?)`", parts), re.findall("`(.+?)`", files)) for owner, parts, files in rows]


def read(trees):
    """Private modules and attributes that the files read, as (file, name)."""
    own, of_objects = {name for tree in trees.values() for name in _members(tree)} | DOCUMENTED, undocumented()
    for file, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and not node.level:
                yield from ((file, name) for a in node.names if _is_unstable(name := f"{node.module}.{a.name}"))
            elif isinstance(node, ast.Import):
                yield from ((file, a.name) for a in node.names if _is_unstable(a.name))
            elif isinstance(node, ast.Attribute):
                if (_is_private(node.attr) and node.attr not in own) or node.attr == "__wrapped__":
                    yield file, node.attr
                elif isinstance(node.value, ast.Attribute) and node.value.attr in UNSTABLE:
                    yield file, f"{node.value.attr}.{node.attr}"
                elif node.attr in of_objects:
                    yield file, node.attr
            elif isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("getattr", "hasattr"):
                yield from ((file, x.value) for x in node.args if isinstance(x, ast.Constant) and x.value in of_objects)
            elif isinstance(node, ast.keyword) and (node.arg or "").startswith(OPTION):
                yield file, node.arg
            elif isinstance(node, ast.Constant) and re.fullmatch(OPTION + r"\w+", str(node.value)):
                yield file, node.value


def undocumented():
    """Attributes of JAX's tracers and tree structures, whose classes its documentation does not describe."""
    kinds = {jax.tree_util.PyTreeDef}
    look = lambda x: kinds.add(type(x)) or 2.0 * x
    for traced in (jax.vmap(look), jax.jit(look), jax.jacfwd(look), lambda x: jax.linearize(look, x)):
        traced(jnp.ones(2))
    names = set(dir(jax.tree_util.PyTreeDef)).union(*(vars(base).get("__slots__", ()) for kind in kinds for base in kind.__mro__))
    return {name for name in names if not name.startswith("_")} - ALSO_ELSEWHERE


def overridden(trees):
    """Private methods of other packages that classes of this one define anew, as (file, name)."""
    for file in trees.keys() - {"__main__.py"}:
        module = importlib.import_module(".".join(["jaxlag", *Path(file).with_suffix("").parts]).removesuffix(".__init__"))
        for cls in vars(module).values():
            if inspect.isclass(cls) and cls.__module__ == module.__name__:
                bases = [base for base in cls.__mro__ if base.__module__.split(".")[0] not in DESCRIBED]
                names = {name for name, value in vars(cls).items() if inspect.isfunction(getattr(value, "__func__", value))}
                yield from ((file, name) for name in names if _is_private(name) and any(name in vars(base) for base in bases))


def _is_private(name):
    return name.startswith("_") and not name.startswith("__")


def _is_unstable(path):
    return any(part in UNSTABLE or _is_private(part) for part in path.split("."))


def _members(tree):
    """What the classes of a file define: methods, fields, and attributes set by assignment or `object.__setattr__`."""
    for cls in (node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)):
        for node in ast.walk(cls):
            if isinstance(node, ast.FunctionDef):
                yield node.name
            elif isinstance(node, (ast.Name, ast.Attribute)) and isinstance(node.ctx, ast.Store):
                yield node.id if isinstance(node, ast.Name) else node.attr
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield node.value


def matches(listing, file, name):
    _, parts, files = listing
    return any(fnmatch(name, part) for part in parts) and any(fnmatch(file, pattern) for pattern in files)


@pytest.fixture(scope="module")
def used():
    trees = {file.relative_to(PACKAGE).as_posix(): ast.parse(file.read_text()) for file in PACKAGE.rglob("*.py")}
    return sorted({*read(trees), *overridden(trees)})


def test_every_private_part_that_is_used_is_listed(used):
    assert not [(file, name) for file, name in used if not any(matches(listing, file, name) for listing in listed())]


def test_every_part_and_file_that_is_listed_is_used(used):
    for owner, parts, files in listed():
        of_row = [pair for pair in used if matches((owner, parts, files), *pair)]
        assert not [part for part in parts if not any(fnmatch(name, part) for _, name in of_row)]
        assert not [pattern for pattern in files if not any(fnmatch(file, pattern) for file, _ in of_row)]


def test_packages_whose_private_parts_are_used_have_an_upper_bound():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    required = [*project["dependencies"], *project["optional-dependencies"]["symbolic"]]
    bounded = {re.match(r"[\w-]+", requirement)[0] for requirement in required if "<" in requirement}
    assert {owner for owner, *_ in listed()} <= bounded
