"""Experiments as they come from a laboratory: gaps, tables, and data that cannot be right."""

import dataclasses
import datetime
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
import oscillator as osc
import pytest

import jaxlag as jl
from jaxlag._fit.experiment_batch import _tangent_basis

T = np.linspace(0.0, 1.0, 5)
X = np.cos(T)


def experiment(ts=T, values=X, **more):
    return jl.Experiment(ts, values, 1.0, 0.0, **more)


BAD = {
    "times that are not sorted": (lambda: experiment(ts=[0.0, 0.2, 0.1, 0.3, 0.4]), "`ts` must increase, but ts[1] = 0.2 is followed"),
    "one time": (lambda: experiment(ts=[0.0], values=[1.0]), "at least two times"),
    "a channel of another length": (lambda: experiment(values={"x": X[:3]}), "`values['x']` must have one row for each of the 5 times"),
    "a channel without a sample": (lambda: experiment(values={"x": X, "y": X * np.nan}), "every sample of a channel is missing"),
    "an infinite sample": (lambda: experiment(values=np.where(T == 0.5, np.inf, X)), "Mark missing samples by NaN"),
    "complex samples": (lambda: experiment(values=X * 1j), "`values` must be real, but has dtype complex128"),
    "text for samples": (
        lambda: experiment(values=X.astype(str)),
        "`values` must be an array of real numbers, but is a ndarray that is text",
    ),
    "truth values for samples": (lambda: experiment(values=X > 0), "`values` must be real, but has dtype bool"),
    "dates": (
        lambda: experiment(ts=np.arange(5).astype("datetime64[s]")),
        "`ts` must be an array of real numbers, but is a ndarray that is a date",
    ),
    "durations": (lambda: experiment(ts=np.arange(5).astype("timedelta64[s]")), "`ts` must be an array of real numbers"),
    "dates of Python": (lambda: experiment(ts=[datetime.datetime(2024, 1, 1, 0, 0, i) for i in range(5)]), "(times - times[0])"),
    "times as text": (
        lambda: experiment(ts=["0", "1", "2", "3", "4"]),
        "`ts` must be an array of real numbers, but is a list that is text",
    ),
    "an infinite sigma": (lambda: experiment(sigma=np.inf), "`sigma` must be positive and finite"),
    "a sigma that is NaN": (lambda: experiment(sigma=np.nan), "`sigma` must be positive and finite"),
    "a sigma of text": (lambda: experiment(sigma="0.1"), "`sigma` must be an array of real numbers, but is a str"),
    "a sigma of truth": (lambda: experiment(sigma={"x": True}, values={"x": X}, observe=lambda q: {"x": q}), "`sigma['x']` must be real"),
    "a delay that is NaN": (lambda: experiment(delay=np.nan), "`delay` must be finite, but is nan"),
    "an observe that changes": (lambda: experiment(observe=Sensor(2.0)), "`observe` must be a hashable function, but is a Sensor"),
    "one number for a channel": (lambda: experiment(values=3.0), "must be an array of real numbers"),
    "a sigma of zero": (lambda: experiment(sigma=0.0), "`sigma` must be positive"),
    "a negative sigma at one sample": (lambda: experiment(sigma=[1.0, 1.0, -1.0, 1.0, 1.0]), "`sigma` must be positive"),
    "sigma for another channel": (lambda: experiment(values={"x": X}, sigma={"y": 1.0}), "`sigma` must be a number or structured like"),
    "an unknown that is not there": (lambda: experiment(unknown=("q0.y",)), "`unknown` must name q0, qdot0, entries of them"),
    "a parameter that hides the state": (lambda: experiment(params={"q": 1.0}), "must not have an entry named 'q'"),
    "channels that name no coordinate": (lambda: experiment(values={"x": X}), "`observe` must say what the sensors see"),
    "q0 and qdot0 that differ": (lambda: jl.Experiment(T, X, {"x": 1.0}, 0.0), "`qdot0` must be structured like `q0`"),
    "an unknown column": (lambda: jl.Experiment.from_dataframe(Frame(t=T, x=X), 1.0, 0.0, time="s"), "must have a column 's'"),
}


@dataclasses.dataclass
class Sensor:
    gain: float

    def __call__(self, q):
        return self.gain * q


class Frame(dict):
    """What data frames have in common."""

    @property
    def columns(self):
        return list(self)

    def __getitem__(self, name):
        return Column(dict.__getitem__(self, name))


class Column(np.ndarray):
    def __new__(cls, values):
        return np.asarray(values).view(cls)

    def to_numpy(self):
        return np.asarray(self)


@pytest.mark.fast
@pytest.mark.parametrize("case", BAD)
def test_bad_data_are_refused_with_the_cure(case):
    make, said = BAD[case]
    with pytest.raises((ValueError, TypeError)) as error:
        make()
    assert said in str(error.value) and str(error.value).endswith(".")


FREE = ("c", "b")
BAD_FITS = {
    "an unknown name": (lambda: fit(free=("d",)), "`free` must name entries of params, but holds 'd'. There are b, c, m."),
    "a name twice": (lambda: fit(free=("c", "c")), "must name each parameter once"),
    "nothing free": (lambda: fit(free=()), "must name at least one entry"),
    "more unknowns than measurements": (
        lambda: fit(experiments=jl.Experiment([0.0, 1.0], [1.0, np.nan], 1.0, 0.0)),
        "there are 2 unknowns and 1 measurements",
    ),
    "a start outside its bounds": (
        lambda: fit(bounds={"c": (5.0, None)}),
        "must start 'c' within its bounds, but 3 is not inside (5, inf)",
    ),
    "bounds in the wrong order": (lambda: fit(bounds={"c": (5.0, 1.0)}), "`bounds` of 'c' must be in order"),
    "bounds of what is not free": (lambda: fit(bounds={"m": (0, 1)}), "`bounds` must name free parameters, but holds 'm'"),
    "one bound": (lambda: fit(bounds={"c": 5.0}), "`bounds` must give two numbers for 'c'"),
    "a prior without spread": (lambda: fit(priors={"c": (4.0, 0.0)}), "`priors` of 'c' must have a positive standard deviation"),
    "no experiment": (lambda: fit(experiments=[]), "`experiments` must be an `Experiment` or a list of them"),
    "a plan": (lambda: fit(experiments=jl.Experiment(T, None, 1.0, 0.0)), "must have been measured, but number 0 has no values"),
    "params without names": (lambda: fit(params=[1.0]), "`free` must name entries of params, but holds 'c'. There are 0."),
    "params that are a number": (lambda: fit(params=1.0), "`params` must have entries that `free` can name, but is a float"),
    "no params": (lambda: fit(params=None), "`params` must have entries that `free` can name, but is a NoneType"),
    "params of its own over no mapping": (
        lambda: jl.fit(BY_FIELD, experiment(params={"c": 4.0}), Oscillator(3.0, Damper(0.2)), free=("c",)),
        "`params` must be a mapping where an experiment has params of its own that override them, but is a Oscillator",
    ),
    "an integer to be fitted": (lambda: fit(params=osc.START | {"c": np.array(3)}), "must name real numbers, but 'c' holds none"),
    "sensors that see something else": (
        lambda: fit(observe=lambda q: {"y": q}),
        "`observe` of experiment 0 must return what `values` holds",
    ),
    "sensors of another shape": (lambda: fit(observe=lambda q: {"x": q * np.ones(2)}), "must return real numbers of shape ()"),
}


class Damper(eqx.Module):
    b: Any
    kind: str = eqx.field(static=True, default="oil")


class Oscillator(NamedTuple):
    c: Any
    damper: Any


class Machine(eqx.Module):
    c: Any
    damper: Damper


BY_FIELD = jl.System(
    lambda q, qdot, params: 0.5 * qdot**2 - 0.5 * params.c * q**2, dissipation=lambda qdot, params: 0.5 * params.damper.b * qdot**2
)


def fit(experiments=None, params=osc.START, free=FREE, observe=lambda q: {"x": q}, **more):
    if experiments is None:
        experiments = jl.Experiment(T, {"x": X}, 1.0, 0.0, observe=observe)
    return jl.fit(osc.SYSTEM, experiments, params, free=free, **more)


@pytest.mark.parametrize("case", BAD_FITS)
def test_what_cannot_be_fitted_is_refused_with_the_cure(case):
    make, said = BAD_FITS[case]
    with pytest.raises((ValueError, TypeError)) as error:
        make()
    assert said in str(error.value) and str(error.value).endswith(".")


@pytest.mark.fast
def test_a_table_in_a_file(tmp_path):
    file = tmp_path / "drive.csv"
    file.write_text("time [s]; x [m]; note\n0; 1.0; 7\n0.5; ; 7\n1; 0.5; 7\n")
    e = jl.Experiment.from_csv(file, 1.0, 0.0, time="time [s]", columns={"x": "x [m]"}, observe=lambda q: {"x": q})
    np.testing.assert_array_equal(e.ts, [0, 0.5, 1])
    np.testing.assert_array_equal(e.values["x"], [1.0, np.nan, 0.5])
    assert set(e.values) == {"x"}
    file.write_text("t,x\n0,1\n1,one\n")
    with pytest.raises(ValueError, match="line 3, column 'x' must be a number, but is 'one'"):
        jl.Experiment.from_csv(file, 1.0, 0.0, time="t", observe=lambda q: {"x": q})


TABLES = {  # x in mm: 1.25, missing, 0.5 at 0, 0.5 and 1 s
    "commas": ("t,x\n0,1.25\n0.5,\n1,0.5\n", "t", {}),
    "decimal commas": ("t;x\n0;1,25\n0,5;\n1;0,5\n", "t", {}),
    "tabs, and a row of units": ("t\tx\ns\tmm\n0\t1,25\n0,5\t\n1\t5e-1\n", "t", {}),
    "milliseconds of a Unix clock": ("t,x\n1712345678250,1.25\n1712345678750,\n1712345679250,0.5\n", ("t", 1e-3), {"from_zero": True}),
    "ISO dates": ("t,x\n2026-11-28T23:59:59.5,1.25\n2026-11-29T00:00:00,\n2026-11-29T00:00:00.5,0.5\n", "t", {}),
    "dates with the day first": ("t;x\n28.11.2026 23:59:59,5;1,25\n29.11.2026 00:00:00,0;\n29.11.2026 00:00:00,5;0,5\n", "t", {}),
    "another encoding": ("t;x;Länge [µm]\n0;1,25;\n0,5;;\n1;0,5;\n", "t", {"encoding": "latin-1"}),
}


@pytest.mark.fast
@pytest.mark.parametrize("case", TABLES)
def test_tables_of_laboratories(case, tmp_path):
    text, time, how = TABLES[case]
    file = tmp_path / "log.csv"
    file.write_text(text, encoding=how.get("encoding", "utf-8"))
    read = lambda file: jl.Experiment.from_csv(file, {"x": 1.0}, {"x": 0.0}, time=time, columns={"x": ("x", 1e-3)}, **how)
    for e in (read(file), *read([file, str(file)])):
        np.testing.assert_allclose(e.ts, [0, 0.5, 1], rtol=1e-12)
        np.testing.assert_allclose(e.values["x"], [1.25e-3, np.nan, 0.5e-3], rtol=1e-12)


@pytest.mark.fast
def test_tables_that_cannot_be_read_say_where(tmp_path):
    file = tmp_path / "log.csv"
    read = lambda **how: jl.Experiment.from_csv(file, {"x": 1.0}, {"x": 0.0}, **({"time": "t"} | how))
    file.write_text("t;x\n0;1\n\n1;l,5\n")
    with pytest.raises(ValueError, match="line 4, column 'x' must be a number, but is 'l,5'"):
        read()
    with pytest.raises(ValueError, match="a column must be a name, or a name and a factor"):
        read(columns={"x": ("x", "mm")})
    file.write_text("t;x\n0;1,5\n1;2.5\n")
    with pytest.raises(ValueError, match="column 'x' must have one decimal mark, but has points and commas. Say which by `decimal`."):
        read()
    file.write_text("t,x\n03/04/2026 23:59:59,1\n03/05/2026 00:00:01,2\n")  # in March, or from April to May
    with pytest.raises(ValueError, match="line 2, column 't' must be a number, but is '03/04/2026 23:59:59'"):
        read()
    file.write_text("")
    with pytest.raises(ValueError, match="must hold a table, but .* is empty"):
        read()


@pytest.mark.fast
def test_a_data_frame():
    e = jl.Experiment.from_dataframe(Frame(t=T, x=X, y=2 * X), {"x": 1.0, "y": 2.0}, {"x": 0.0, "y": 0.0}, time="t")
    np.testing.assert_allclose(e.values["y"], 2 * X)
    assert e.observe({"x": 3.0, "y": 4.0}) == {"x": 3.0, "y": 4.0}  # the coordinates that the columns are named after


def test_times_are_irregular_and_samples_missing():
    """Without noise the truth comes back whatever is missing."""
    rng = np.random.default_rng(0)
    ts = np.concatenate([[0.0], np.sort(rng.uniform(0, 10, 59))])
    values = osc.with_nan(osc.position(ts), *rng.choice(60, 20, replace=False))
    found = jl.fit(osc.SYSTEM, jl.Experiment(ts, values, 1.0, 0.0), osc.START, free=FREE)
    np.testing.assert_allclose([found.estimates[name] for name in FREE], [4.0, 0.3], rtol=1e-6)
    assert found.measurements == 40


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Oscillator, Machine])
def test_params_that_are_no_mapping_are_named_by_their_fields(kind):
    """From starts far off, with the names `c` and `damper.b`; the same kind comes back, and all that a fit tells of."""
    ts = np.linspace(0, 5, 40)
    record = jl.Experiment(ts, osc.position(ts), 1.0, 0.0)
    start = kind(3.0, Damper(0.1))
    found = jl.fit(BY_FIELD, record, start, free=("c", "damper.b"), bounds={"damper.b": (0, 1)})
    assert isinstance(found.params, kind) and found.params.damper.kind == "oil" and found.names == ("c", "damper.b")
    np.testing.assert_allclose([found.estimates["c"], found.params.damper.b], [4.0, 0.3], rtol=1e-6)
    np.testing.assert_allclose(found.predict(record).values, record.values, atol=1e-6)
    if kind is Machine:
        rough = jl.regress(BY_FIELD, record, kind(np.nan, Damper(np.nan)), free=("c", "damper"))
        np.testing.assert_allclose([rough.params.c, rough.estimates["damper"].b], [4.0, 0.3], rtol=1e-2)


def test_masked_samples_are_missing():
    masked = np.ma.masked_array(X, [0, 0, 1, 0, 0])
    np.testing.assert_array_equal(experiment(values=masked).values, np.where(np.arange(5) == 2, np.nan, X))


@pytest.mark.slow
def test_directions_of_an_unknown_start_in_any_units():
    """On a sphere and in a plane, rows and coordinates of which are in units 18 decades apart: one position and one velocity move."""
    s = np.array([1e9, 1e-9, 1.0])
    rows = {"sphere": lambda q, s: 1e9 * ((q / s) @ (q / s) - 1), "plane": lambda q, s: 1e-9 * (q / s)[2]}
    system = jl.System(lambda q, qdot, s: 0.5 * (qdot / s) @ (qdot / s), holonomic=rows)
    start = dict(q0=s * np.array([0.6, 0.8, 0.0]), qdot0=s * np.array([-0.8, 0.6, 0.0]), unknown=("q0", "qdot0"))
    e = jl.Experiment(np.linspace(0, 1, 5), {"x": np.zeros(5)}, observe=lambda q: {"x": q[0]}, **start)
    basis = _tangent_basis(system, {"s": s}, e) / np.tile(s, 2)[:, None]
    position, velocity = (basis / np.linalg.norm(basis, axis=0)).T
    np.testing.assert_allclose(np.abs(position), [0.8, 0.6, 0, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(np.abs(velocity), [0, 0, 0, 0.8, 0.6, 0], atol=1e-9)


@pytest.mark.fast
def test_a_data_frame_with_dates():
    dates = np.datetime64("2026-11-28T23:59:59.5") + np.array([0, 500, 1000]).astype("timedelta64[ms]")
    e = jl.Experiment.from_dataframe(
        Frame(at=dates, x=np.array([1.0, 2.0, 3.0])), {"x": 1.0}, {"x": 0.0}, time="at", columns={"x": ("x", 1e-3)}
    )
    np.testing.assert_allclose(e.ts, [0, 0.5, 1.0], rtol=1e-12)
    np.testing.assert_allclose(e.values["x"], [1e-3, 2e-3, 3e-3])
