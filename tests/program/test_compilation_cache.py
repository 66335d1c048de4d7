"""Compiled programs on disk: a second process compiles nothing that the first one did, and the folder stays small."""

import os
import pathlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest

import jaxlag as jl

CODE = """
import collections, sys
import jax, jax.numpy as jnp
import jaxlag as jl

jax.config.update("jax_enable_x64", True)
jl.keep_compiled(sys.argv[1])
counts = collections.Counter()
jax.monitoring.register_event_listener(lambda event, **_: counts.update([event.removeprefix("/jax/compilation_cache/")]))
lowered = set()
jax.monitoring.register_event_duration_secs_listener(
    lambda event, _, fun_name=None, **__: lowered.add(fun_name) if event.endswith("to_mlir_module_duration") else None
)
ts = jnp.linspace(0.0, 3.0, 31)

oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2)
rubbing = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2, dissipation=lambda qdot, F: F * jnp.abs(qdot))
on_a_rod = jl.System(
    lambda q, qdot: 0.5 * (qdot["x"] ** 2 + qdot["y"] ** 2) - 9.81 * q["y"],
    holonomic={"rod": lambda q, l: jnp.hypot(q["x"], q["y"]) - l},
)
end = lambda c: jl.simulate(oscillator, 1.0, 0.0, ts, {"c": c, "b": 0.1}).q[-1]
end_on_a_rod = lambda l: jl.simulate(on_a_rod, {"x": 1.5, "y": 0.0}, {"x": 0.0, "y": 0.0}, ts, {"l": l}).q["x"][-1]
record = jl.Experiment(ts, jnp.cos(2.0 * ts), 1.0, 0.0, observe=lambda q: q)
CASES = {
    "motion": lambda: end(4.0),
    "gradient": lambda: jax.grad(end)(4.0),
    "gradient in a program": lambda: jax.jit(jax.grad(end))(4.0),
    "fit": lambda: jl.fit(oscillator, record, {"c": 3.0, "b": 0.1}, free=("c",)).estimates["c"],
    "friction": lambda: jl.simulate(rubbing, 1.0, 0.0, ts, {"c": 4.0, "F": 0.1}).q[-1],
    "constraint": lambda: end_on_a_rod(1.5),
    "gradient with a constraint": lambda: jax.grad(end_on_a_rod)(1.5),
}
for name, run in CASES.items():
    counts.clear()
    value = run()
    print(name, value, counts["compile_requests_use_cache"], counts["cache_hits"], sep=", ")
print(*sorted(lowered), file=sys.stderr)
"""


def in_a_process(folder, seed):
    """(value, programs asked for, programs read from JAX's cache) by case, and the names of all that were lowered."""
    environment = {name: value for name, value in os.environ.items() if "CACHE" not in name} | {"PYTHONHASHSEED": seed}
    run = subprocess.run([sys.executable, "-c", CODE, str(folder)], capture_output=True, text=True, env=environment)
    assert run.returncode == 0, run.stderr[-2000:]
    rows = [line.split(", ") for line in run.stdout.splitlines()]
    return {name: (value, int(asked), int(read)) for name, value, asked, read in rows}, run.stderr.split()


@pytest.mark.slow
def test_a_second_process_compiles_nothing(tmp_path):
    """Nor does it trace what is large. A program is not kept if it calls Python, and not found if it differs from process to process, as
    by the order of a set.
    """
    (first, lowered_first), (second, lowered) = (in_a_process(tmp_path, seed) for seed in "12")
    assert first.keys() == second.keys() and sum(asked - read for _, asked, read in first.values()) > len(first)
    large = {"jit(_trajectory)", "jit(solved)", "jit(_linearise)"}
    assert large <= {*lowered_first} and not large & {*lowered}
    for name, (value, asked, read) in second.items():
        assert (value, asked) == (first[name][0], read), name


@pytest.mark.fast
@pytest.mark.parametrize(
    "platform, variables, folder",
    [
        ("linux", {"XDG_CACHE_HOME": "/var/caches"}, "/var/caches/jaxlag"),
        ("linux", {"XDG_CACHE_HOME": "caches"}, "/home/ada/.cache/jaxlag"),
        ("linux", {}, "/home/ada/.cache/jaxlag"),
        ("darwin", {"XDG_CACHE_HOME": "/var/caches"}, "/home/ada/Library/Caches/jaxlag"),
        ("win32", {"LOCALAPPDATA": "/home/ada/local"}, "/home/ada/local/jaxlag"),
        ("win32", {}, "/home/ada/AppData/Local/jaxlag"),
    ],
)
def test_the_folder_is_that_of_the_users_caches(compilation_cache, tmp_path, monkeypatch, platform, variables, folder):
    """As the XDG base directory specification, Apple and Microsoft have it."""
    jax.config.update("jax_compilation_cache_dir", None)
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value.replace("/home", f"{tmp_path}/home").replace("/var", f"{tmp_path}/var"))
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr(pathlib.Path, "home", lambda: tmp_path / "home" / "ada")
    found = jl.keep_compiled()
    assert found == tmp_path / folder[1:] and found.is_dir()
    assert jax.config.jax_compilation_cache_dir == str(found)


def test_a_folder_that_is_set_already_stays(compilation_cache, tmp_path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "chosen"))
    assert jl.keep_compiled() == tmp_path / "chosen"
    assert jl.keep_compiled(tmp_path / "another") == tmp_path / "another"  # unless another one is asked for


@pytest.mark.fast
def test_programs_of_any_size_are_kept_even_after_others_were_compiled(compilation_cache, tmp_path, monkeypatch):
    monkeypatch.delenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", raising=False)
    for folder in (tmp_path / "a", tmp_path / "b"):
        jl.keep_compiled(folder)
        jax.jit(lambda x: x + 1)(jnp.zeros(3))
        assert len(list(folder.glob("*-cache"))) >= 1
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    jl.keep_compiled(tmp_path / "c")
    assert jax.config.jax_persistent_cache_min_compile_time_secs == 0.5


@pytest.mark.fast
def test_what_was_used_longest_ago_is_deleted(compilation_cache, tmp_path):
    for i, name in enumerate(["new-cache", "newer-cache", "old-cache", "oldest-cache", "notes.txt"]):
        (tmp_path / name).write_bytes(bytes(100))
        day = [3, 4, 2, 1, 0][i] * 86400
        os.utime(tmp_path / name, (day, day))
    jl.keep_compiled(tmp_path, max_bytes=250)
    assert {file.name for file in tmp_path.iterdir()} == {"new-cache", "newer-cache", "notes.txt"}


def test_a_folder_that_cannot_be_made_is_refused(compilation_cache, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(
        ValueError, match=r"^`folder` must be a folder that can be written to, but .*file cannot: File exists\. Give another"
    ):
        jl.keep_compiled(tmp_path / "file")


def test_a_folder_that_cannot_be_written_to_is_refused(compilation_cache, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(ValueError, match=r"cannot: Permission denied\. Give another one\.$"):
        jl.keep_compiled(tmp_path)


def test_a_new_folder_is_private(compilation_cache, tmp_path):
    assert jl.keep_compiled(tmp_path / "new").stat().st_mode & 0o077 == 0


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has other rights")
@pytest.mark.parametrize("rights, is_set", [(0o777, False), (0o770, False), (0o777, True)])
def test_a_folder_that_others_can_write_to_is_not_used(compilation_cache, tmp_path, rights, is_set):
    """They could put a program of theirs there."""
    folder = tmp_path / "shared"
    folder.mkdir()
    folder.chmod(rights)
    before = jax.config.jax_compilation_cache_dir
    if is_set:
        jax.config.update("jax_compilation_cache_dir", str(folder))
    with pytest.warns(UserWarning, match=r"^`folder` must be a folder that only you can write to, .* `chmod go-w`, or give another folder"):
        assert jl.keep_compiled(None if is_set else folder) == folder
    assert is_set or jax.config.jax_compilation_cache_dir == before
    system = jl.System(lambda q, qdot: 0.5 * qdot**2 - 2.0 * q**2)
    assert jl.acceleration(system, 1.0, 0.0).qddot == -4.0
    assert not list(folder.glob("jaxlag-*"))
    folder.chmod(0o700)
    jl.keep_compiled(folder)
    assert jl.acceleration(jl.System(lambda q, qdot: 0.5 * qdot**2 - 2.0 * q**2), 1.0, 0.0).qddot == -4.0
    assert list(folder.glob("jaxlag-*"))


@pytest.mark.parametrize("wrong", [{"folder": 3}, {"max_bytes": "1 GB"}, {"max_bytes": -1}])
def test_arguments_of_the_wrong_kind(wrong):
    (name,) = wrong
    with pytest.raises(TypeError, match=f"`{name}` must be .*, but is"):
        jl.keep_compiled(**wrong)
