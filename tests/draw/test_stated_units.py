"""Units that a system states are written beside what is drawn, fitted and saved."""

import matplotlib
import numpy as np
import pytest

import jaxlag as jl
from jaxlag import plot

matplotlib.use("Agg")
import matplotlib.pyplot as plt

UNITS = {"t": "s", "x": "m", "phi": "rad", "b": "N s/m", "c": "N/m", "energy": "J", "rod": "N"}


def lagrangian(q, qdot, m, c):
    return 0.5 * m * (qdot["x"] ** 2 + qdot["phi"] ** 2) - 0.5 * c * (q["x"] ** 2 + q["phi"] ** 2)


def drag(qdot, b):
    return 0.5 * b * (qdot["x"] ** 2 + qdot["phi"] ** 2)


def rod(q):
    return q["x"] - 0.5 * q["phi"]


SYSTEM = jl.System(lagrangian, dissipation=drag, holonomic={"rod": rod}, units=UNITS)
PARAMS, START = {"m": 1.0, "c": 4.0, "b": 0.3}, ({"x": 0.5, "phi": 1.0}, {"x": 0.0, "phi": 0.0})
TS = np.linspace(0, 4, 41)


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def motion():
    return jl.simulate(SYSTEM, *START, TS, PARAMS, works=True)


@pytest.fixture(scope="module")
def fit(motion):
    noise = 1e-3 * np.random.default_rng(0).normal(size=TS.size)
    record = jl.Experiment(TS, {"x": np.asarray(motion.q["x"]) + noise}, *START, unknown=("q0",))
    return jl.fit(SYSTEM, record, PARAMS | {"b": 0.2}, free=("b", "c"))


def labels(axes):
    return [text for ax in np.ravel(axes) for text in (ax.get_xlabel(), ax.get_ylabel())]


def test_units_of_a_motion_and_of_what_a_file_keeps_of_it(motion, tmp_path):
    motion.save(tmp_path / "motion.npz")
    for of in (motion, motion[3:], jl.load(tmp_path / "motion.npz")):
        assert labels(of.plot(names=("x", "phi"))) == ["", "x (m)", "t (s)", "phi (rad)"]
        assert labels(plot.forces(of)) == ["t (s)", "λ rod (N)"]
        assert labels(plot.energy(of)) == ["t (s)", "energy (J)"] and "energy (J)" in labels(plot.balance(of))[1]
        assert labels(plot.phase(of, ("x",))) == ["x (m)", "dx/dt (m/s)"]


def test_units_that_are_given_stand_in_their_place(motion):
    assert labels(motion.plot(names=("x",), units={"x": "mm"})) == ["t (s)", "x (mm)"]


@pytest.mark.slow
def test_units_of_a_fit(fit):
    assert labels(fit.plot())[:2] == ["", "x (m)"] and "t (s)" in labels(fit.plot())
    rows = {row["name"]: row["unit"] for row in fit.to_dict()["parameters"]}
    assert rows == {"b": "N s/m", "c": "N/m", "experiment 0: q0.x": "m", "experiment 0: q0.phi": "rad"}
    lines = str(fit).splitlines()
    assert "N s/m " in lines[1] and "N/m " in lines[2] and any("q0.phi" in line and " rad " in line for line in lines)


def test_units_change_no_number_and_go_with_the_system(motion):
    plain = jl.System(lagrangian, dissipation=drag, holonomic={"rod": rod})
    np.testing.assert_array_equal(jl.simulate(plain, *START, TS, PARAMS, works=True).q["x"], motion.q["x"])
    assert plain != SYSTEM and plain.units == ()
    assert dict(SYSTEM.with_events({"up": jl.Event(lambda q: q["x"])}).units) == UNITS
    assert dict(jl.substitute(SYSTEM, lambda q: {"x": q, "phi": 2 * q}).units) == UNITS


@pytest.mark.parametrize("units", ["m", {"x": 1.0}, {0: "m"}])
def test_units_are_text_by_name(units):
    with pytest.raises(TypeError, match="`units` must be a mapping from names to units as text"):
        jl.System(lagrangian, units=units)


def test_modes_and_responses_have_the_units_of_the_system():
    """Milliseconds: natural frequencies are in 1/ms, not in Hz."""
    slow = jl.System(
        lambda q, qdot, m, c: 0.5 * m * qdot**2 - 0.5 * c * q**2,
        dissipation=lambda qdot, b: 0.5 * b * qdot**2,
        units={"t": "ms", "b": "g/ms"},
    )
    params = {"m": 1.0, "c": 4.0, "b": 0.1}
    near = jl.linearise(slow, 0.0, params=params, inputs=["q"])
    assert all(text in repr(near.modes()) for text in ("ω₀ (rad/ms)", "f (1/ms)", "1/|Re λ| (ms)"))
    magnitude, phase = plot.bode(near, [1.0, 2.0])
    assert (magnitude.get_ylabel(), phase.get_xlabel()) == ("|G|", "ω (rad/ms)")
    points = {"p": lambda q: (q, 0.0)}
    assert plot.mode_shapes(near.modes(), points, [((0.0, 0.0), "p")])[0].get_title().startswith("f₀ = 0.3183 1/ms")
    locus = jl.root_locus(slow, lambda: 0.0, params=params, over="b", values=[-0.1, 0.1])
    assert "2 rad/ms" in repr(locus)
    growth, frequency = locus.plot()
    assert (growth.get_ylabel(), frequency.get_ylabel(), frequency.get_xlabel()) == ("Re λ (1/ms)", "Im λ (1/ms)", "b (g/ms)")
    growth, _ = locus.plot(units={"eigenvalues": "kHz"})
    assert growth.get_ylabel() == "Re λ (kHz)"
    ax = jl.stability_map(slow, lambda: 0.0, params=params, over={"b": [-1.0, 1.0], "c": [1.0, 2.0]}).plot()
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("b (g/ms)", "c")


def test_without_units_modes_are_in_seconds():
    plain = jl.System(lambda q, qdot: 0.5 * qdot**2 - 2.0 * q**2)
    assert "ω₀ (rad/s)" in repr(jl.linearise(plain, 0.0).modes())
    assert plot.bode(jl.linearise(plain, 0.0, inputs=["q"]), [1.0, 3.0])[1].get_xlabel() == "ω"
