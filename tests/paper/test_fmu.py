"""Functional mock-up units against the simulation, by a foreign master (FMPy)."""

import contextlib
import ctypes
import dataclasses
import pathlib
import shutil
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag import dissipation
from jaxlag.examples import bicycle, pendulum, vehicle

fmpy = pytest.importorskip("fmpy")
from fmpy.fmi3 import FMU3Model, FMU3Slave  # noqa: E402
from fmpy.validation import validate_fmu  # noqa: E402


@dataclasses.dataclass(frozen=True)
class Case:
    """A system and its start; `on_paper`: arguments of `equations`, whose FMU it is, or None for that of the system itself."""

    system: jl.System
    start: tuple
    params: Any
    end: float
    on_paper: dict | None = None
    inputs: tuple = ()

    def write(self, path):
        if self.on_paper is None:
            return jl.to_fmu(self.system, path, *self.start, self.params, inputs=self.inputs)
        equations = jl.equations(self.system, self.start[0], self.params, **self.on_paper)
        return equations.to_fmu(path, *self.start, self.params, inputs=self.inputs)

    def simulated(self, ts, **params):
        return jl.simulate(self.system, *self.start, ts, self.params | params, rtol=1e-10)

    def motion(self, ts):
        """Coordinates and velocities by the names of the variables; those of the vehicle's parts follow from three."""
        if self.system is not vehicle.first_kind:
            motion = self.simulated(ts)
            q, qdot = motion.q, motion.qdot
        else:
            motion, dimensions = CASES["vehicle"].simulated(ts), (self.params["r"], self.params["a"])
            q, qdot = jax.jvp(lambda q: vehicle.parts(q, *dimensions), (motion.q,), (motion.qdot,))
        return {name: np.asarray(x) for name, x in q.items()} | {f"der({name})": np.asarray(x) for name, x in qdot.items()}


def tilted_bicycle():
    p = bicycle.params
    q, qdot = bicycle.state(p["v"], p["r_R"], p["r_F"])
    return q, qdot | {"roll": 0.3}


def still(q):
    return jax.tree.map(np.zeros_like, q)


parts = vehicle.parts(vehicle.q0, vehicle.params["r"], vehicle.params["a"])
CASES = {
    "vehicle": Case(vehicle.system, (vehicle.q0, vehicle.qdot0), vehicle.params, 5.0, inputs=("M0",)),
    "simplified vehicle": Case(vehicle.system, (vehicle.q0, vehicle.qdot0), vehicle.params, 5.0, {}, ("M0",)),
    "vehicle on paper": Case(vehicle.first_kind, (parts, still(parts)), vehicle.params, 5.0, {}),
    "parts of a vehicle": Case(vehicle.first_kind, (parts, still(parts)), vehicle.params, 5.0, {"multipliers": True}),
    "rod": Case(pendulum.cartesian, pendulum.cartesian_state(1.0, 0.5, 1.0), pendulum.params, 5.0),
    "rod on paper": Case(pendulum.cartesian, pendulum.cartesian_state(1.0, 0.5, 1.0), pendulum.params, 5.0, {"multipliers": True}),
    "polar rod": Case(pendulum.polar, pendulum.polar_state(1.0, 0.5, 1.0), pendulum.params, 5.0, {}),
    "bicycle": Case(bicycle.system, tilted_bicycle(), bicycle.params, 2.0),
}
NAMES = [pytest.param(name, marks=[pytest.mark.slow] * (name == "bicycle")) for name in CASES]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The FMU of a case, written once, and its folder."""
    folder, done = tmp_path_factory.mktemp("fmu"), {}

    def of(name):
        if name not in done:
            path = CASES[name].write(folder / f"{name}.fmu")
            done[name] = path, pathlib.Path(fmpy.extract(str(path), str(folder / name)))
        return done[name]

    return of


def run(path, kind, end, points=101, **more):
    """The solution that FMPy finds, at equal distances of time."""
    start = more.get("start_time", 0.0)
    return fmpy.simulate_fmu(
        str(path), fmi_type=kind, stop_time=end, output_interval=(end - start) / (points - 1), record_events=False, **more
    )


KINDS = ["CoSimulation", "ModelExchange"]


@pytest.mark.parametrize("name", NAMES)
def test_an_fmu_is_valid(written, name):
    path, folder = written(name)
    assert validate_fmu(str(path)) == []
    assert {file.name for file in (folder / "sources").iterdir()} >= {"buildDescription.xml", "fmu.c", "model.c", "fmi3Functions.h"}
    assert len(list(folder.glob("binaries/*/*"))) == 1


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", NAMES)
def test_a_foreign_master_finds_the_motion(written, name, kind):
    case, (_, folder) = CASES[name], written(name)
    motion = case.motion(np.linspace(0.0, case.end, 101))
    found = run(folder, kind, case.end)
    for variable, want in motion.items():
        np.testing.assert_allclose(found[variable], want, rtol=1e-6, atol=1e-6 * max(1.0, np.abs(want).max()), err_msg=variable)


@pytest.mark.parametrize("name", ["rod", "rod on paper", "polar rod"])
def test_accelerations_and_multipliers_are_outputs(written, name):
    case, (_, folder) = CASES[name], written(name)
    motion = case.simulated(np.linspace(0.0, 5.0, 101))
    found = run(folder, "CoSimulation", 5.0)
    np.testing.assert_allclose(found["lambda.rod"], np.asarray(motion.multipliers["rod"]), rtol=1e-6)
    for variable, want in motion.qddot.items():
        np.testing.assert_allclose(found[f"der({variable},2)"], np.asarray(want), atol=1e-6, err_msg=variable)


@pytest.mark.parametrize("name", ["vehicle", "rod", pytest.param("bicycle", marks=pytest.mark.slow)])
def test_a_master_steps_at_a_millisecond(written, name):
    case = CASES[name]
    ts = np.linspace(0.0, 1.0, 11)
    motion = case.motion(ts)
    with slave(written(name)[1]) as (unit, references):
        start(unit)
        found = [values(unit, references, motion)]
        for k in range(1000):
            unit.doStep(k * 1e-3, 1e-3)
            if k % 100 == 99:
                found.append(values(unit, references, motion))
    for variable, got in zip(motion, np.transpose(found), strict=True):
        np.testing.assert_allclose(got, motion[variable], atol=1e-6, err_msg=variable)


def test_an_input_is_held_during_a_step(written):
    """A wheel moment in steps of a millisecond: the same as a measured input with a zero-order hold."""
    ts = np.arange(1001) * 1e-3
    moment = 300 * np.sin(10 * ts)
    signal = jl.Signal(ts, moment)
    system = jl.System(
        vehicle.lagrangian,
        dissipation={"dampers": vehicle.dampers, "air": vehicle.air},
        force={"drive": lambda t, M0, r: {"x": M0(t) / r}},
    )
    want = jl.simulate(system, vehicle.q0, vehicle.qdot0, ts[::100], vehicle.params | {"M0": signal}, rtol=1e-10).q["x"]
    with slave(written("vehicle")[1]) as (unit, references):
        start(unit)
        found = [0.0]
        for k in range(1000):
            unit.setFloat64([references["M0"]], [moment[k]])
            unit.doStep(ts[k], 1e-3)
            if k % 100 == 99:
                found += unit.getFloat64([references["x"]])
    np.testing.assert_allclose(found, want, atol=1e-8)


@pytest.mark.parametrize("kind", KINDS)
def test_an_input_that_jumps_and_rises(tmp_path, kind):
    """A force 2 from 0.5 to 1, then 1 + 2 s: v = 1 + s + s², with s the time since 1."""
    path = jl.to_fmu(jl.System(lambda qdot: 0.5 * qdot**2, force=lambda F: F), tmp_path / "cart.fmu", 0.0, 0.0, {"F": 0.0}, inputs="F")
    points = [(0.0, 0.0), (0.5, 0.0), (0.5, 2.0), (1.0, 2.0), (1.0, 1.0), (2.0, 3.0)]
    signal = np.array(points, dtype=[("time", float), ("F", float)])
    found = run(path, kind, 2.0, 2001, input=signal)
    s = found["time"][1000:] - 1
    atol = 1e-9 if kind == "CoSimulation" else 1e-3  # FMPy holds inputs between samples, which CVode steps over
    np.testing.assert_allclose(found["der(q)"][1000:], 1 + s + s**2 - 1e-3 * s, atol=atol)
    np.testing.assert_array_equal(found["der(q)"][:500], 0.0)


@pytest.mark.parametrize("kind", KINDS)
def test_parameters_are_settable(written, kind):
    """Also to zero: air that does not resist, and a wind in it."""
    ts, changed = np.linspace(0.0, 2.0, 21), {"k": 0.0, "c": 20000.0, "v": -3.0}
    motion = CASES["vehicle"].simulated(ts, **changed)
    found = run(written("vehicle")[1], kind, 2.0, 21, start_values=changed)
    for variable, want in motion.q.items():
        np.testing.assert_allclose(found[variable], np.asarray(want), atol=1e-6, err_msg=variable)


@pytest.mark.parametrize("kind", KINDS)
def test_a_changed_rod_projects_the_start(written, kind):
    """A rod twice as long: the start moves along it, as that of `simulate` does."""
    ts = np.linspace(0.0, 2.0, 21)
    motion = CASES["rod"].simulated(ts, l=2.0)
    found = run(written("rod")[1], kind, 2.0, 21, start_values={"l": 2.0})
    np.testing.assert_allclose(found["x"][0], 2 * np.sin(1.0), rtol=1e-12)
    for variable, want in motion.q.items():
        np.testing.assert_allclose(found[variable], np.asarray(want), atol=2e-6, err_msg=variable)


@pytest.mark.parametrize("kind", KINDS)
def test_a_start_without_a_state_on_the_constraints_is_refused(written, kind):
    logged = []
    with pytest.raises(Exception, match="failed"):
        run(written("rod")[1], kind, 1.0, start_values={"l": -1.0}, logger=lambda *message: logged.append(message[-1].decode()))
    assert "no state on the constraints was found" in logged[0]


def test_a_state_that_is_not_finite_is_refused_by_name(written):
    logged = []
    with pytest.raises(Exception, match="setFloat64|SetFloat64"), slave(written("vehicle")[1], logged) as (unit, references):
        unit.setFloat64([references["c"]], [np.nan])
    assert "c must be finite" in logged[0]


def test_a_motion_that_ends_in_nan_is_an_error(tmp_path):
    """√x of a mass that is driven below zero."""
    system = jl.System(lambda q, qdot: 0.5 * qdot**2 + 0.0 * q, force=lambda q: -1.0 - jnp.sqrt(q))
    path, logged = jl.to_fmu(system, tmp_path / "root.fmu", 1.0, 0.0), []
    with pytest.raises(Exception, match="oStep"), slave(fmpy.extract(str(path), str(tmp_path / "root")), logged) as (unit, _):
        start(unit)
        unit.doStep(0.0, 10.0)
    assert "not finite" in logged[0] and "fmi3DoStep, t = 1." in logged[0]


# --- derivatives


def equations_by_differences(unit, references, unknowns, known, step):
    """A central difference by a parameter or another known."""
    return differences(unit, references[known], unknowns, unit.getFloat64([references[known]])[0], step)


def differences(unit, at, unknowns, middle, step):
    """A central difference of fourth order of values that the instance gives."""

    def moved(by):
        unit.setFloat64([at], [middle + by])
        return np.array(unit.getFloat64(unknowns))

    found = (8 * (moved(step) - moved(-step)) - (moved(2 * step) - moved(-2 * step))) / (12 * step)
    moved(0.0)
    return found


def test_directional_and_adjoint_derivatives_are_exact(written):
    with slave(written("vehicle")[1]) as (unit, references):
        unit.enterInitializationMode()
        unit.setFloat64([references["der(x)"]], [4.0])
        knowns = ["phi", "y", "der(x)", "der(y)", "c", "r", "M0", "Theta_r", "k"]
        unknowns = [references[f"der({x},2)"] for x in ("phi", "x", "y")]
        J = []
        for known in knowns:
            column = unit.getDirectionalDerivative(unknowns, [references[known]], [1.0])
            scale = 1e-3 * max(1e-2, abs(unit.getFloat64([references[known]])[0]))
            np.testing.assert_allclose(
                column, equations_by_differences(unit, references, unknowns, known, scale), rtol=1e-7, atol=1e-9, err_msg=known
            )
            J.append(column)
        seed = [0.3, -0.7, 1.1]
        adjoint = unit.getAdjointDerivative(unknowns, [references[known] for known in knowns], seed, len(knowns))
        np.testing.assert_allclose(adjoint, np.array(J) @ seed, rtol=1e-12)


@pytest.mark.parametrize("name", ["rod", "rod on paper", "polar rod"])
def test_derivatives_of_solved_equations(written, name):
    """In the midst of a motion, by parameters that may be set there."""
    outputs = ["lambda.rod", *(f"der({x},2)" for x in CASES[name].start[0])]
    with slave(written(name)[1]) as (unit, references):
        start(unit)
        unit.doStep(0.0, 0.3)
        unknowns = [references[x] for x in outputs]
        for known in ("m", "g"):
            exact = unit.getDirectionalDerivative(unknowns, [references[known]], [2.0])
            found = 2 * equations_by_differences(unit, references, unknowns, known, 1e-3)
            np.testing.assert_allclose(exact, found, rtol=1e-8, atol=1e-8, err_msg=known)


@pytest.mark.parametrize("name", ["rod", "parts of a vehicle"])
def test_derivatives_of_a_projected_start(written, name):
    """During initialization the start moves along the constraints, by parameters and by the given state."""
    knowns, outputs = {
        "rod": (("l", "g", "x", "y", "der(x)"), ("x", "y", "der(x)", "der(y)", "lambda.rod", "der(x,2)")),
        "parts of a vehicle": (("a", "r", "phi", "y2", "der(x)", "c"), ("phi", "y", "x2", "der(x2)", "der(phi3)", "der(y,2)")),
    }[name]
    with slave(written(name)[1]) as (unit, references):
        unit.enterInitializationMode()
        unknowns = [references[output] for output in outputs]
        for known in knowns:
            at = references[known]
            exact = unit.getDirectionalDerivative(unknowns, [at], [1.0])
            given = description(written(name)[1])[known]
            found = differences(unit, at, unknowns, float(given.start), 1e-4 * max(1.0, abs(float(given.start))))
            np.testing.assert_allclose(exact, found, rtol=1e-6, atol=1e-6 * np.abs(found).max(), err_msg=known)


def test_derivatives_by_the_state(written):
    """Along the state in model exchange, where the master sets it."""
    _, folder = written("rod")
    with model(folder) as (unit, references):
        start(unit)
        unit.updateDiscreteStates()
        unit.enterContinuousTimeMode()
        x = np.array([0.6, -0.8, 0.4, 0.3])  # x, y and their velocities
        states = [references[name] for name in ("x", "y", "der(x)", "der(y)")]
        rates = [references[name] for name in ("der(x)", "der(y)", "der(x,2)", "der(y,2)")]

        def rate(x):
            x = (ctypes.c_double * 4)(*x)
            unit.setContinuousStates(x, 4)
            found = (ctypes.c_double * 4)()
            unit.getContinuousStateDerivatives(found, 4)
            return np.array(found)

        for i in range(4):
            h = 1e-3 * np.eye(4)[i]
            want = (8 * (rate(x + h) - rate(x - h)) - (rate(x + 2 * h) - rate(x - 2 * h))) / 12e-3
            rate(x)
            found = unit.getDirectionalDerivative(rates, [states[i]], [1.0])
            np.testing.assert_allclose(found, want, rtol=1e-8, atol=1e-8)


# --- the state of an instance


def test_the_state_can_be_stored_and_taken_back(written):
    with slave(written("rod")[1]) as (unit, references):
        start(unit)
        unit.doStep(0.0, 0.5)
        kept = unit.getFMUState()
        stored = unit.serializeFMUState(kept)
        unit.doStep(0.5, 0.5)
        there = unit.getFloat64([references["x"], references["lambda.rod"]])
        unit.setFMUState(kept)
        unit.doStep(0.5, 0.5)
        assert unit.getFloat64([references["x"], references["lambda.rod"]]) == there
        unit.setFMUState(unit.deserializeFMUState(stored))
        unit.doStep(0.5, 0.5)
        assert unit.getFloat64([references["x"], references["lambda.rod"]]) == there
        unit.freeFMUState(kept)


def test_instances_do_not_know_of_each_other_and_are_reset(written):
    with slave(written("rod")[1]) as (one, references), slave(written("rod")[1]) as (other, _):
        start(one)
        other.setFloat64([references["g"]], [0.0])
        start(other)
        one.doStep(0.0, 1.0)
        other.doStep(0.0, 1.0)
        first = one.getFloat64([references["x"]])
        assert first != other.getFloat64([references["x"]])
        other.reset()
        start(other)
        other.doStep(0.0, 1.0)
        assert other.getFloat64([references["x"]]) == first


def test_functions_are_refused_in_the_wrong_mode(written):
    logged = []
    with pytest.raises(Exception, match="oStep"), slave(written("rod")[1], logged) as (unit, _):
        unit.doStep(0.0, 1.0)
    with pytest.raises(Exception, match="etFloat64"), slave(written("rod")[1], logged) as (unit, references):
        start(unit)
        unit.setFloat64([references["x"]], [0.5])
    assert "mode" in logged[0] and "x must not be set after initialization" in logged[1]


# --- other units, other times


def oscillator(q, qdot, m, c):
    return 0.5 * m * qdot**2 - 0.5 * c * (q - 1e-6) ** 2


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("m, c, span", [(1e-9, 1e3, 1e-5), (1e9, 1e-3, 1e7)])
def test_units_do_not_matter(tmp_path, kind, m, c, span):
    """A micrometre at rest, with periods of microseconds and of weeks: x = 10⁻⁶ (1 − cos ω t)."""
    path = jl.to_fmu(jl.System(oscillator), tmp_path / "o.fmu", 0.0, 0.0, {"m": m, "c": c})
    found = run(path, kind, span)
    want = 1e-6 * (1 - np.cos(np.sqrt(c / m) * found["time"]))
    np.testing.assert_allclose(found["q"], want, atol=1e-6 * 1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_late_times(tmp_path, kind):
    """A force 1 + (t − 10⁶) from t = 10⁶ on: x = s²/2 + s³/6."""
    system = jl.System(lambda qdot: 0.5 * qdot**2, force=lambda t: 1.0 + (t - 1e6))
    path = jl.to_fmu(system, tmp_path / "late.fmu", 0.0, 0.0)
    found = run(path, kind, 1e6 + 2.0, 21, start_time=1e6)
    s = found["time"] - 1e6
    np.testing.assert_allclose(found["q"], s**2 / 2 + s**3 / 6, atol=1e-6)


def test_arrays_states_and_names(tmp_path):
    """Structured names; an array of parameters; a state of first order; letters beyond ASCII; a coordinate that stays zero."""
    system = jl.System(
        lambda q, qdot, c: 0.5 * jnp.sum(qdot["arm"]["φ"] ** 2) - 0.5 * jnp.sum(c * q["arm"]["φ"] ** 2),
        force=lambda z, u: {"arm": {"φ": jnp.stack([z, u])}},
        units={"t": "s", "arm.φ": "rad", "servo.k": "1/s"},
        states={"z": jl.State(lambda z, params: -params["servo"]["k"] * z, 0.5)},
    )
    q0 = {"arm": {"φ": jnp.array([0.0, 0.0])}}
    params = {"c": np.array([1.0, 4.0]), "servo": {"k": 2.0}, "u": 0.0}
    path = jl.to_fmu(system, tmp_path / "arm.fmu", q0, still(q0), params, inputs="u", outputs=["arm", "z"])
    assert validate_fmu(str(path)) == []
    of = {variable.name: variable for variable in fmpy.read_model_description(str(path)).modelVariables}
    assert [of[x].unit for x in ("arm.phi[1]", "der(arm.phi[1],2)", "servo.k", "time", "z")] == ["rad", "rad/s^2", "1/s", "s", None]
    kinds = {name: variable.causality for name, variable in of.items()}
    assert [kinds[x] for x in ("arm.phi[0]", "z", "c[1]", "servo.k", "u", "der(arm.phi[0])")] == [
        *("output", "output", "parameter", "parameter", "input", "local")
    ]
    want = jl.simulate(system, q0, still(q0), np.linspace(0, 2, 21), params, rtol=1e-10)
    for kind in KINDS:
        found = run(path, kind, 2.0, 21)
        np.testing.assert_allclose(found["arm.phi[0]"], np.asarray(want.q["arm"]["φ"][:, 0]), atol=1e-7)
        np.testing.assert_allclose(found["z"], 0.5 * np.exp(-2 * found["time"]), atol=1e-7)
        np.testing.assert_array_equal(found["arm.phi[1]"], 0.0)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_a_foreign_tool_builds_the_source(written, tmp_path):
    from fmpy.build import build_platform_binary

    _, folder = written("rod")
    shutil.copytree(folder, tmp_path / "rod", ignore=shutil.ignore_patterns("binaries"))
    build_platform_binary(str(tmp_path / "rod"))
    np.testing.assert_allclose(run(tmp_path / "rod", "CoSimulation", 1.0)["x"], run(folder, "CoSimulation", 1.0)["x"], rtol=1e-12)


def test_dependencies_are_those_of_the_equations(written):
    given = fmpy.read_model_description(str(written("simplified vehicle")[0]))
    of = {unknown.variable.name: {x.name for x in unknown.dependencies} for unknown in given.derivatives}
    assert of["der(phi,2)"] == {"phi", "der(phi)"}
    assert of["der(x,2)"] == {"der(x)", "M0"}
    assert of["der(y)"] == {"der(y)"}
    assert {x.variable.name for x in given.initialUnknowns} == {"der(phi,2)", "der(x,2)", "der(y,2)"}


def test_redundant_constraints_have_multipliers_of_least_norm_and_no_derivatives(tmp_path):
    """A rod that is stated twice carries half of the load each."""
    rods = {"one": pendulum.cartesian_rod, "two": pendulum.cartesian_rod}
    system = jl.System(pendulum.cartesian_lagrangian, holonomic=rods)
    q, qdot = pendulum.cartesian_state(1.0, 0.5, 1.0)
    path, logged = jl.to_fmu(system, tmp_path / "two.fmu", q, qdot, pendulum.params), []
    found = run(path, "CoSimulation", 2.0, 21)
    want = CASES["rod"].simulated(np.linspace(0.0, 2.0, 21))
    np.testing.assert_allclose(found["x"], np.asarray(want.q["x"]), atol=1e-6)
    np.testing.assert_allclose(found["lambda.one"], np.asarray(want.multipliers["rod"]) / 2, rtol=1e-6)
    np.testing.assert_allclose(found["lambda.two"], found["lambda.one"], rtol=1e-12)
    with pytest.raises(Exception, match="erivative"), slave(fmpy.extract(str(path), str(tmp_path / "two")), logged) as (unit, references):
        start(unit)
        unit.getDirectionalDerivative([references["der(x,2)"]], [references["m"]], [1.0])
    assert "do not depend on each other" in logged[0]


def characteristic(q, qdot, fs):
    """A table of forces, a stop at 1, and a drive that is on between −0.5 and 0.2 or where it is slow."""
    drive = jnp.where(((q > -0.5) & (q < 0.2)) | (jnp.abs(qdot) < 0.1), 0.3, 0.0)
    return jnp.interp(q, jnp.array([-1.0, 0.0, 0.5, 2.0]), fs) - 50 * jnp.maximum(q - 1, 0.0) - 0.2 * jax.scipy.special.erf(qdot) + drive


@pytest.mark.parametrize("on_paper", [None, {}])
def test_tables_and_choices(tmp_path, on_paper):
    """Also derivatives by the entries of a table."""
    fs = np.array([2.0, 0.5, 1.0, -1.0])
    case = Case(jl.System(lambda qdot: 0.5 * qdot**2, force=characteristic), (0.3, 0.0), {"fs": fs}, 2.0, on_paper)
    path = case.write(tmp_path / "table.fmu")
    want = case.simulated(np.linspace(0.0, 2.0, 21)).q
    np.testing.assert_allclose(run(path, "CoSimulation", 2.0, 21)["q"], np.asarray(want), atol=1e-6)
    with slave(fmpy.extract(str(path), str(tmp_path / "table"))) as (unit, references):
        unit.enterInitializationMode()
        names = [f"fs[{i}]" for i in range(4)]
        slopes = [unit.getDirectionalDerivative([references["der(q,2)"]], [references[name]], [1.0])[0] for name in names]
    np.testing.assert_allclose(slopes, [0.0, 0.4, 0.6, 0.0], atol=1e-12)


def test_drag_is_no_dry_friction(tmp_path):
    """k |v| v from v₀: v = v₀/(1 + k v₀ t/m)."""
    system = jl.System(lambda qdot: 0.5 * qdot**2, dissipation=lambda qdot: dissipation.drag(qdot[None], 2.0))
    found = run(jl.to_fmu(system, tmp_path / "drag.fmu", 0.0, 3.0), "CoSimulation", 1.0)
    np.testing.assert_allclose(found["der(q)"], 3 / (1 + 6 * found["time"]), rtol=1e-7)


# --- a master


def description(folder):
    """The variables by name."""
    return {variable.name: variable for variable in fmpy.read_model_description(str(folder)).modelVariables}


@contextlib.contextmanager
def instance(kind, folder, logged):
    given = fmpy.read_model_description(str(folder))
    interface = given.coSimulation if kind is FMU3Slave else given.modelExchange
    unit = kind(guid=given.guid, unzipDirectory=str(folder), modelIdentifier=interface.modelIdentifier, instanceName=str(id(object())))
    log = lambda *message: None if logged is None else logged.append(message[-1].decode())
    unit.instantiate(logMessage=log)
    try:
        yield unit, {variable.name: variable.valueReference for variable in given.modelVariables}
    finally:
        unit.freeInstance()


def slave(folder, logged=None):
    """An instance for co-simulation, and the value references of the variables."""
    return instance(FMU3Slave, folder, logged)


def model(folder, logged=None):
    """An instance for model exchange."""
    return instance(FMU3Model, folder, logged)


def start(unit):
    unit.enterInitializationMode()
    unit.exitInitializationMode()


def values(unit, references, names):
    return unit.getFloat64([references[name] for name in names])
