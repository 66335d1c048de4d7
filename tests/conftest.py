"""Tests run in double precision, without implicit broadcasting of ranks, and with every shape annotation checked."""

import collections
import pathlib
import shutil

import compiling  # isort: skip
import costs
import jax
import pytest
from jax.experimental.compilation_cache import compilation_cache as cache_of_jax
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

ROOT = pathlib.Path(__file__).parents[1]
FILES = [file.relative_to(ROOT).with_suffix("") for file in ROOT.glob("jaxlag/**/*.py") if "from jaxtyping import" in file.read_text()]


def pytest_addoption(parser):
    parser.addoption("--part", metavar="I/N", help="of the tests marked slow only every N-th, from the I-th on")
    parser.addoption("--costs", metavar="FILE", help="appends what each test takes: see tests/costs.py")
    parser.addoption("--recompile", action="store_true", help="empties the folder of compiled programs that is kept between runs")


def pytest_configure(config):
    is_worker = hasattr(config, "workerinput")
    if config.getoption("--recompile") and not is_worker:
        shutil.rmtree(compiling.KEPT_IN, ignore_errors=True)
    if is_worker or not getattr(config.option, "numprocesses", None):  # what starts workers runs no test itself
        # Files without annotations of shapes have nothing to check, and the checks of their calls took a sixth of the time of the tests
        with install_import_hook([".".join(file.parts) for file in FILES], "beartype.beartype"):
            import jaxlag  # noqa: F401


def pytest_ignore_collect(collection_path, config):
    """With `-m fast` files without such tests are not even imported."""
    if config.option.markexpr == "fast" and collection_path.suffix == ".py" and "mark.fast" not in collection_path.read_text():
        return True
    return None


def pytest_collection_modifyitems(config, items):
    """The files beside this one first: they hold the longest tests, for one of which a worker should not be left alone at the end."""
    items.sort(key=lambda item: item.path.parent != ROOT / "tests")
    if config.getoption("--part"):
        first, parts = map(int, config.getoption("--part").split("/"))
        slow = [item for item in items if item.get_closest_marker("slow")]
        left_out = {item for i, item in enumerate(slow) if i % parts != first % parts}
        config.hook.pytest_deselected(items=[item for item in items if item in left_out])
        items[:] = [item for item in items if item not in left_out]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item, nextitem):
    """A line of `--costs` for each test."""
    if not item.config.getoption("--costs"):
        return (yield)
    with costs.measured(item.config.getoption("--costs"), item.nodeid):
        return (yield)


@pytest.fixture(autouse=True, scope="module")
def fresh_caches():
    """Releases what a file has compiled: each program holds memory maps, of which a process may have only some 65 000."""
    yield
    jax.clear_caches()


@pytest.fixture
def monkeypatch(monkeypatch):
    """Where the package is changed, no program serves that was compiled before, nor one afterwards that was compiled with the change."""
    changes = []

    def forgetting(change):
        def changed(*given, **named):
            jax.clear_caches()
            changes.append(change)
            return change(*given, **named)

        return changed

    monkeypatch.setattr, monkeypatch.setitem = forgetting(monkeypatch.setattr), forgetting(monkeypatch.setitem)
    yield monkeypatch
    if changes:
        jax.clear_caches()


@pytest.fixture
def lowered():
    """How often each program is lowered to be compiled, during a test, before which nothing is."""
    jax.clear_caches()
    counts = collections.Counter()

    def listen(event, _, fun_name=None, **__):
        counts.update([fun_name] if event.endswith("jaxpr_to_mlir_module_duration") else [])

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield counts
    jax.monitoring.unregister_event_duration_listener(listen)


@pytest.fixture
def single_precision():
    jax.config.update("jax_enable_x64", False)
    yield
    jax.config.update("jax_enable_x64", True)


@pytest.fixture
def compilation_cache(tmp_path):
    """A folder for `keep_compiled`, unless one is set already; the settings of JAX's cache are afterwards as they were."""
    names = ["jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs", "jax_persistent_cache_min_entry_size_bytes"]
    before = {name: getattr(jax.config, name) for name in names}
    if before["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(tmp_path / "compiled"))
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    cache_of_jax.reset_cache()
    from jaxlag._program.kept_programs import KEPT

    KEPT.keep_in(None)
