"""The source of functional mock-up units, and what they cannot hold."""

import ctypes
import re
import subprocess
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag.examples import pendulum, vehicle

# --- what is refused

MASS = lambda qdot: 0.5 * qdot**2
REFUSED = {
    "dry friction": (jl.System(MASS, dissipation={"pad": lambda qdot: 2.0 * jnp.abs(qdot)}), {}, "no dry friction .* 'pad'"),
    "friction as a force": (jl.System(MASS, force=lambda qdot: -jnp.sign(qdot)), {}, "no dry friction"),
    "contacts": (jl.System(MASS, unilateral={"floor": lambda q: q + 1.0}), {}, "no contacts .* 'floor'"),
    "events": (jl.System(MASS, events={"edge": jl.Event(lambda q: q - 1.0)}), {}, "no events .* 'edge'"),
    "no inertia": (jl.System(lambda q: -0.5 * q**2, dissipation=lambda qdot: 0.5 * qdot**2), {}, "acceleration.* of q does not"),
    "an input without a name": (jl.System(MASS), {"inputs": "F"}, "`inputs` must name parameters, but holds 'F'"),
    "an output without a name": (jl.System(MASS), {"outputs": ["z"]}, "`outputs` must name .* but holds 'z'. There are q, der"),
    "an input that moves a constraint": (
        jl.System(MASS, holonomic=lambda q, u: q - u),
        {"params": {"u": 0.0}, "inputs": "u"},
        "`inputs` must not name what a constraint depends on, .* holds 'u'",
    ),
    "friction that depends on a load": (
        jl.System(
            lambda qdot: 0.5 * (qdot["x"] ** 2 + qdot["y"] ** 2),
            holonomic={"floor": lambda q: q["y"]},
            force=lambda multipliers: {"x": -(multipliers["floor"] ** 2), "y": 0.0},
        ),
        {"q0": {"x": 0.0, "y": 0.0}, "qdot0": {"x": 0.0, "y": 0.0}},
        "linear in the multipliers",
    ),
    "one name for two": (
        jl.System(lambda qdot, x: 0.5 * x * qdot["x"] ** 2),
        {"q0": {"x": 0.0}, "qdot0": {"x": 0.0}, "params": {"x": 1.0}},
        "called 'x'",
    ),
    "the wrong file": (jl.System(MASS), {"path": "q.zip"}, "`path` must end in .fmu"),
    "NaN": (jl.System(MASS), {"q0": np.nan}, "`q0` must be finite"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_an_fmu_cannot_hold_is_refused_by_name(tmp_path, what):
    system, given, message = REFUSED[what]
    given = {"path": "q.fmu", "q0": 0.0, "qdot0": 0.0} | given
    with pytest.raises(ValueError, match=message):
        jl.to_fmu(system, tmp_path / given.pop("path"), given.pop("q0"), given.pop("qdot0"), **given)
    assert not list(tmp_path.iterdir())


def test_functions_and_inputs_that_c_lacks_are_refused_by_name(tmp_path):
    signal = jl.Signal([0.0, 1.0], [1.0, 2.0])
    with pytest.raises(ValueError, match="'F' is a `Signal`"):
        jl.to_fmu(jl.System(MASS, force=lambda t, F: F(t)), tmp_path / "q.fmu", 0.0, 0.0, {"F": signal})
    with pytest.raises(NotImplementedError, match="digamma.*test_fmu"):
        jl.to_fmu(jl.System(MASS, force=lambda q: jax.scipy.special.digamma(q)), tmp_path / "q.fmu", 1.0, 0.0)
    on_paper = jl.equations(jl.System(MASS, dissipation=lambda qdot: jnp.abs(qdot)), "x")
    with pytest.raises(ValueError, match="no dry friction"):
        on_paper.to_fmu(tmp_path / "q.fmu", 0.0, 0.0)
    on_paper = jl.equations(pendulum.polar, {"r", "phi"}, {"m", "l", "g"})
    with pytest.raises(ValueError, match="`params` must be structured"):
        on_paper.to_fmu(tmp_path / "q.fmu", *pendulum.polar_state(1.0, 0.0, 1.0), pendulum.params | {"k": 1.0})


def test_without_a_compiler_the_cure_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(FileNotFoundError, match="no 'no-such-compiler'. Install one"):
        jl.to_fmu(jl.System(MASS), tmp_path / "q.fmu", 0.0, 0.0)


# --- the source


def polar(path):
    equations = jl.equations(pendulum.polar, {"r", "phi"}, {"m", "l", "g"})
    return equations.to_fmu(path, *pendulum.polar_state(1.0, 0.5, 1.0), pendulum.params)


def cartesian(path):
    return jl.to_fmu(pendulum.cartesian, path, *pendulum.cartesian_state(1.0, 0.5, 1.0), pendulum.params, name="a rod, 1 m")


def drive(path):
    return jl.to_fmu(vehicle.system, path, vehicle.q0, vehicle.qdot0, vehicle.params, inputs=["M0", "v"], outputs="x")


def test_an_fmu_is_the_same_each_time(tmp_path):
    """Also in a program that runs in single precision."""
    first = drive(tmp_path / "first" / "drive.fmu").read_bytes()
    with jax.enable_x64(False):
        assert drive(tmp_path / "second" / "drive.fmu").read_bytes() == first


@pytest.mark.parametrize("write", [polar, cartesian, drive])
def test_the_source_is_c99_without_a_warning_and_can_be_linked_with_others(tmp_path, write):
    path = write(tmp_path / "unit.fmu")
    with zipfile.ZipFile(path) as archive:
        archive.extractall(tmp_path)
        for header in ("fmi3Functions.h", "fmi3FunctionTypes.h", "fmi3PlatformTypes.h"):
            assert b"2-Clause BSD License" in archive.read(f"sources/{header}")
        model = re.search(r'<CoSimulation modelIdentifier="(\w+)"', archive.read("modelDescription.xml").decode())[1]
    options = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O1", "-c"]
    subprocess.run(["cc", *options, tmp_path / "sources" / "fmu.c", "-o", tmp_path / "fmu.o"], check=True)
    symbols = subprocess.run(["nm", "--defined-only", "-g", tmp_path / "fmu.o"], check=True, capture_output=True, text=True).stdout
    assert {line.split()[-1].split("fmi3")[0] for line in symbols.splitlines()} == {f"{model}_"}
    (binary,) = (tmp_path / "binaries").glob("*/*")
    assert binary.stem == model and ctypes.CDLL(str(binary)).fmi3GetVersion
