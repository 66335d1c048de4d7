"""Functional mock-up units (FMI 3.0): the motion of a system as C source, a binary and a description, in one file."""

import hashlib
import os
import pathlib
import platform
import re
import shlex
import shutil
import subprocess
import tempfile
import zipfile
from collections.abc import Collection
from importlib.metadata import version

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .._model.paths import listed
from .._model.system import System
from .._program.sparse_jacobian import underdetermined
from .fmu_description import Structure, Variable, build_description, model_description, variables
from .fmu_motion import ExportedMotion, exported_system
from .fmu_program import Program, literal, read, written
from .identifiers import identifier, in_ascii

SOURCES = pathlib.Path(__file__).parent / "c"
LONGEST_PROGRAM_OPTIMISED = 20_000  # operations: from there on, optimising takes a compiler longer than it saves
EPOCH = (1980, 1, 1, 0, 0, 0)  # of files in the archive, so that the same system gives the same file


def to_fmu(
    system: System,
    path: str | os.PathLike[str],
    q0: PyTree,
    qdot0: PyTree,
    params: PyTree = None,
    *,
    states: PyTree = None,
    inputs: str | Collection[str] = (),
    outputs: str | Collection[str] | None = None,
    name: str | None = None,
) -> pathlib.Path:
    r"""Writes a functional mock-up unit (FMI 3.0) of a system: C source, compiled for this machine, for other simulators; no Python inside.

    $$ A \begin{pmatrix} \ddot q \\ \lambda \end{pmatrix} = b, \qquad g(t, q) = 0, \quad \dot g = 0, \quad a(t, q, \dot q) = 0 $$

    **Variables:** coordinates q under their names, such as `arm.phi` or `x[0]`, velocities `der(phi)`, accelerations `der(phi,2)`,
    multipliers `lambda.rod`, further states and their rates, and the numbers of `params`, which may be set before the motion, at events
    and between steps. Letters beyond ASCII are spelt out: `phi` for φ.

    **Model exchange:** the state is q, q̇ and further states. Where a step drifts off the constraints, an event takes it back.

    **Co-simulation:** Dormand and Prince's pair with steps by the relative tolerance of the experiment (1e-9 without one), each followed by
    a projection onto the constraints; inputs are held during a step.

    Both give exact derivatives, directional and adjoint, and states that can be stored. The start is projected like that of `simulate`; it
    has derivatives if it was on the constraints. Of constraints that depend on each other, multipliers are those of least norm, and there
    are no derivatives. What fails returns an error and logs a sentence: a start near which no state is on the constraints, numbers that are
    not finite, steps that become too short.

    **Arguments:**

    - `system`, `q0`, `qdot0`, `params`, `states`: a system and its start, as for `simulate`; these are the values that the FMU starts with.
    - `path`: the file to write, whose name ends in .fmu.
    - `inputs`: names of parameters that become inputs: of a number, or of all numbers within, such as `"c"` for `c[0]` and `c[1]`. Their
      rates count as zero: constraints must not depend on them.
    - `outputs`: names of variables that become outputs; others that are no parameters are local. All of them without it.
    - `name`: of the model; that of the file without it.

    Any consistent set of units; those that the system states are those of the variables. The compiler is `cc`, or that of the environment
    variable CC.

    **Returns:** the path.

    **Raises:** `ValueError` or `TypeError` if an argument or a function of the system is of the wrong kind, if `inputs` or `outputs` name
    nothing, if two variables have one name, and if the system has what the FMU cannot hold: contacts, events, dry friction, sampled states,
    measured inputs (`Signal`), coordinates without inertia, forces that depend on multipliers nonlinearly; `NotImplementedError`, which
    names the line, if a function is not made of scalar operations that C has; `FileNotFoundError` without a C compiler, `RuntimeError` if
    it fails.

    **Source:** Modelica Association, Functional Mock-up Interface Specification 3.0 (2022); Hairer, Nørsett & Wanner, Solving Ordinary
    Differential Equations I, section II.5; Hairer, Lubich & Wanner, Geometric Numerical Integration, section IV.4 (projection).

    ```python
    import tempfile
    import jaxlag as jl
    from jaxlag.examples import vehicle
    with tempfile.TemporaryDirectory() as folder:
        path = jl.to_fmu(vehicle.system, f"{folder}/vehicle.fmu", vehicle.q0, vehicle.qdot0, vehicle.params, inputs="M0")
        path.name  # vehicle.fmu
    ```
    """
    with jax.enable_x64(True):
        return export(exported_system(system, q0, qdot0, params, states), path, inputs, outputs, name)


def export(
    motion: ExportedMotion,
    path: str | os.PathLike[str],
    inputs: str | Collection[str],
    outputs: str | Collection[str] | None,
    name: str | None,
) -> pathlib.Path:
    """Writes the FMU of a motion."""
    path = pathlib.Path(path)
    if path.suffix != ".fmu":
        raise ValueError(f"`path` must end in .fmu, but is {str(path)!r}. Simulators know an FMU by it.")
    name = path.stem if name is None else name
    model = re.sub(r"[^A-Za-z0-9_]", "_", in_ascii(identifier(name)))
    given = variables(motion, listed(inputs), None if outputs is None else listed(outputs))
    programs = _programs(motion)
    _refuse_inputs_of_constraints(given, programs, len(motion.dependent))
    sources = _sources(motion, given, programs, model)
    structure = _structure(motion, programs)
    draft = model_description(name, model, "", _tool(), given, structure)
    token = hashlib.sha256(b"".join([draft, *(text.encode() for text in sources.values())])).hexdigest()
    sources["model.c"] = f'static const char *const TOKEN = "{token}";\n' + sources["model.c"]
    optimise = max(len(program.lines) for program in programs.values()) < LONGEST_PROGRAM_OPTIMISED
    files = {
        "modelDescription.xml": model_description(name, model, token, _tool(), given, structure),
        "sources/buildDescription.xml": build_description(model),
        **{f"sources/{file}": text.encode() for file, text in sources.items()},
        **_binary(sources, model, optimise),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file, content in files.items():
            archive.writestr(zipfile.ZipInfo(file, EPOCH), content, zipfile.ZIP_DEFLATED)
    return path


def _tool() -> str:
    return f"jaxlag {version('jaxlag')}"


def _programs(motion: ExportedMotion) -> dict[str, Program]:
    """The functions of a model, by their name in C."""
    n, m = len(motion.q), len(motion.multipliers)
    size = motion.start.size
    of_equations = lambda x: jnp.concatenate([jnp.ravel(part) for part in motion.equations(motion.parts(x), jnp.zeros(m))])
    tangent = lambda function: lambda x, dx: jax.jvp(function, (x,), (dx,))[1]

    def outputs(x):
        t, q, v, _, _ = motion.parts(x[:size])
        a = x[size : size + n]
        moved = lambda by: x[:size].at[0].set(t + by).at[1 : n + 1].set(q + by * v + by**2 / 2 * a)
        positions = lambda by: motion.positions(motion.parts(moved(by)))
        velocities = lambda by: jax.jvp(positions, (by,), (jnp.ones(()),))[1]
        now = jnp.zeros(())
        return jnp.concatenate([positions(now), velocities(now), jax.jvp(velocities, (now,), (jnp.ones(()),))[1]])

    with_multipliers = read(
        lambda x, multipliers: jnp.ravel(motion.equations(motion.parts(x), multipliers)[0]), {"x": size, "multipliers": m}
    )
    if any(i >= size for entry in with_multipliers.outputs for i in entry.behind):
        raise ValueError(
            "`force` and `dissipation` must be linear in the multipliers for an FMU to solve for them, but they are not. "
            "Leave out what depends on constraint forces in another way, such as dry friction."
        )
    behind = size + n + m
    programs = {
        "equations": read(of_equations, {"x": size}),
        "equations_tangent": read(tangent(of_equations), {"x": size, "dx": size}),
        "constraints": read(lambda x: jnp.concatenate(motion.constraints(motion.parts(x))), {"x": size}),
        "constraints_tangent": read(tangent(lambda x: jnp.concatenate(motion.constraints(motion.parts(x))[:2])), {"x": size, "dx": size}),
        "outputs": read(outputs, {"x": behind}),
        "outputs_tangent": read(tangent(outputs), {"x": behind, "dx": behind}),
    }
    _refuse_missing_inertia(motion, programs["equations"])
    return programs


def _refuse_missing_inertia(motion: ExportedMotion, program: Program) -> None:
    n, size = len(motion.q), len(motion.q) + len(motion.multipliers)
    undecided = np.flatnonzero(underdetermined(_pattern(program, size))[:n])
    if undecided.size:
        raise ValueError(
            "`system` must have accelerations that follow from its equations in an FMU, but that of "
            f"{', '.join(motion.q[i] for i in undecided)} does not: it has no inertia. Give it a mass, or hold it by a constraint."
        )


def _refuse_inputs_of_constraints(given: list[Variable], programs: dict[str, Program], dependent: int) -> None:
    found = [*programs["constraints"].outputs, *programs["outputs"].outputs[:dependent]]
    for i in sorted(frozenset().union(*(x.behind for x in found))):
        if given[i].causality == "input":
            raise ValueError(
                f"`inputs` must not name what a constraint depends on, whose rate an FMU is not given, but holds {given[i].name!r}. "
                "Leave it a parameter, or let a force that it enters hold the coordinate."
            )


def _pattern(program: Program, size: int) -> np.ndarray:
    """Which entries of A may differ from zero."""
    return np.array([not x.is_zero for x in program.outputs[: size * size]], bool).reshape(size, size)


def _structure(motion: ExportedMotion, programs: dict[str, Program]) -> Structure:
    """Which values depend on which."""
    n, k = len(motion.q), len(motion.states)
    size, at_z = n + len(motion.multipliers), motion.start.size
    of = [x.behind for x in programs["equations"].outputs]
    pattern = _pattern(programs["equations"], size)
    of_row = [frozenset().union(*of[i * size : (i + 1) * size], of[size * size + i]) for i in range(size)]
    coupled = pattern.T @ pattern  # which of q̈ and λ share an equation, then which are solved for together
    for _ in range(size.bit_length()):
        coupled = coupled @ coupled
    of_z = [frozenset().union(*(of_row[i] for i in np.flatnonzero(np.any(pattern[:, coupled[j]], axis=1)))) for j in range(size)]
    found = {at_z + i: known for i, known in enumerate([*of_z, *of[size * size + size :]])}
    through = lambda known: frozenset().union(*(found.get(i, frozenset((i,))) for i in known))
    found |= {at_z + size + k + i: through(known) for i, known in enumerate(x.behind for x in programs["outputs"].outputs)}
    derivatives = (*range(1 + n, 1 + 2 * n), *range(at_z, at_z + n), *range(at_z + size, at_z + size + k))
    return Structure(found, derivatives, range(1, 1 + 2 * n + k), motion.rows[1] > 0)


def _sources(motion: ExportedMotion, given: list[Variable], programs: dict[str, Program], model: str) -> dict[str, str]:
    """The source files by their name."""
    sizes = dict(Q=len(motion.q), S=len(motion.states), P=len(motion.params), Z=len(motion.q) + len(motion.multipliers))
    sizes |= dict(G=motion.rows[0], PSI=motion.rows[1], D=3 * len(motion.dependent))
    texts = {file.name: file.read_text() for file in sorted(SOURCES.iterdir()) if file.suffix in (".c", ".h")}
    texts["sizes.h"] = "\n".join([*(f"#define {name}_SIZE {size}" for name, size in sizes.items()), f"#define PREFIX {model}_", ""])
    names = ", ".join('"' + variable.name.replace("\\", "\\\\").replace('"', '\\"') + '"' for variable in given)
    is_input = ", ".join(str(int(variable.causality == "input")) for variable in given if variable.causality in ("input", "parameter"))
    start = ", ".join(literal(x) for x in motion.start)
    tables = [
        f"static const char *const NAMES[] = {{{names}}};",
        f"static const double START[] = {{{start}}};",
        f"static const char IS_INPUT[] = {{{is_input or 0}}};",
    ]
    functions = [written(name, program, ("x", "dx") if name.endswith("tangent") else ("x",)) for name, program in programs.items()]
    texts["model.c"] = "\n".join(["#include <math.h>", "", *tables, "", *functions])
    return texts


def _binary(sources: dict[str, str], model: str, optimise: bool) -> dict[str, bytes]:
    """The compiled binary by its path in the FMU."""
    compiler = shlex.split(os.environ.get("CC", "cc"))
    if not compiler or shutil.which(compiler[0]) is None:
        raise FileNotFoundError(
            f"`to_fmu` must find a C compiler to make the binary of an FMU, but there is no {compiler[0] if compiler else 'cc'!r}. "
            "Install one, e.g. gcc, or name one in the environment variable CC."
        )
    system, suffix = {"Windows": ("windows", "dll"), "Darwin": ("darwin", "dylib")}.get(platform.system(), ("linux", "so"))
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(platform.machine().lower(), platform.machine().lower())
    with tempfile.TemporaryDirectory() as folder:
        for file, text in sources.items():
            pathlib.Path(folder, file).write_text(text)
        options = ["-std=c99", "-O2" if optimise else "-O1", "-fPIC", "-shared", "-fvisibility=hidden", "-DFMI3_OVERRIDE_FUNCTION_PREFIX"]
        command = [*compiler, *options, "fmu.c", "-o", f"{model}.{suffix}", "-lm"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"`to_fmu` must compile the FMU, but {shlex.join(command)} fails: {done.stderr[:2000]}")
        return {f"binaries/{machine}-{system}/{model}.{suffix}": pathlib.Path(folder, f"{model}.{suffix}").read_bytes()}
