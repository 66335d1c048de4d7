"""Pictures: the right lines with the right labels, on the axes that were given."""

import dataclasses
import functools
import inspect
import re
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from scipy import stats

import jaxlag as jl
from jaxlag import plot
from jaxlag._motion.trajectory import Provenance

matplotlib.use("Agg")
import matplotlib.pyplot as plt

TIMES = np.linspace(0.0, 1.0, 11)


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


def motion(q):
    """A trajectory that was not simulated, so that the tests know every number of it."""
    samples = jax.tree.map(lambda start: jnp.stack([jnp.asarray(start + t) for t in TIMES]), q)
    provenance = Provenance.of(jl.System(lambda qdot: qdot), {})
    return jl.results.Trajectory(jnp.asarray(TIMES), samples, samples, samples, {}, jl.results.RESULTS.successful, {}, None, {}, provenance)


def fitted(*residuals, of, sigma=0.5):
    """A fit of an experiment of which only what is drawn is filled in; its predictions have the standard error 0.1."""
    fit = object.__new__(jl.results.Fit)
    predictions = [jax.tree.map(lambda z, r: np.asarray(z) - r, of.values, r) for r in residuals]
    errors = [jax.tree.map(lambda z: np.full(z.shape, 0.1), tree) for tree in predictions]
    filled = {"experiments": (of,) * len(residuals), "residuals": list(residuals), "sigma": sigma, "absolute": True}
    filled["problem"] = SimpleNamespace(model=SimpleNamespace(system=jl.System(lambda qdot: qdot)))
    filled["sigmas"] = [jax.tree.map(lambda r: np.full(np.shape(r)[1:], sigma), one) for one in residuals]
    for name, value in (filled | {"predictions": predictions, "prediction_errors": errors}).items():
        object.__setattr__(fit, name, value)
    return fit


def experiment(values, **options):
    return jl.Experiment(TIMES, values, 0.0, 0.0, observe=lambda q: q, **options)


@pytest.mark.fast
def test_motion_has_a_panel_for_each_coordinate():
    axes = plot.motion(motion({"x": 1.0, "phi": 2.0}), units={"t": "s", "phi": "rad"})
    assert [ax.get_ylabel() for ax in axes] == ["phi (rad)", "x"]
    assert [ax.get_xlabel() for ax in axes] == ["", "t (s)"]
    for ax, start in zip(axes, (2.0, 1.0), strict=True):
        (line,) = ax.lines
        np.testing.assert_allclose(line.get_xdata(), TIMES, rtol=1e-6)
        np.testing.assert_allclose(line.get_ydata(), start + TIMES, rtol=1e-6)
        assert ax.get_legend() is None


def test_motion_of_one_number_has_one_panel():
    (ax,) = plot.motion(motion(1.0))
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("t", "q")


@pytest.mark.fast
def test_motion_draws_the_entries_of_an_array_in_one_panel():
    axes = plot.motion(motion({"body": {"R": np.arange(4.0).reshape(2, 2)}, "z": 0.0}))
    assert [ax.get_ylabel() for ax in axes] == ["body.R", "z"]
    lines = axes[0].lines
    assert [line.get_label() for line in lines] == [f"body.R[{i}, {j}]" for i in (0, 1) for j in (0, 1)]
    for start, line in enumerate(lines):
        np.testing.assert_allclose(line.get_ydata(), start + TIMES, rtol=1e-6)
    assert len({line.get_color() for line in lines}) == 4
    assert len(axes[0].get_legend().get_texts()) == 4


@pytest.mark.fast
def test_motion_draws_the_names_in_their_order():
    axes = plot.motion(motion({"x": 1.0, "y": 2.0, "phi": 3.0}), ("y", "phi"))
    assert [ax.get_ylabel() for ax in axes] == ["y", "phi"]


def test_axes_that_are_given_are_drawn_in():
    _, given = plt.subplots(2)
    axes = plot.motion(motion({"x": 1.0, "y": 2.0}), axes=given)
    assert list(axes) == list(given) and len(plt.get_fignums()) == 1
    _, given = plt.subplots(2)
    axes = plot.fit(fitted({"x": np.zeros(11)}, of=experiment({"x": TIMES})), axes=given)
    assert list(axes[:, 0]) == list(given) and len(plt.get_fignums()) == 2


def test_motion_leaves_samples_out_that_were_not_reached():
    trajectory = jax.tree.map(lambda x: x.at[5:].set(jnp.nan) if x.shape == (11,) else x, motion(1.0))
    (ax,) = plot.motion(trajectory)
    assert np.isnan(ax.lines[0].get_ydata()[5:]).all()
    assert ax.get_ylim()[1] < 1.5


@pytest.mark.parametrize(("sigma", "band"), [(None, 1.0), (0.1, 0.2)], ids=["estimated", "given"])
def test_fit_has_measured_and_fitted_above_and_residuals_below(sigma, band):
    values = {"x": TIMES**2, "v": 2 * TIMES}
    residuals = {"x": 0.1 * np.cos(9 * TIMES), "v": 0.1 * np.sin(9 * TIMES)}
    axes = plot.fit(fitted(residuals, sigma=0.5, of=experiment(values, sigma=sigma)), units={"t": "s", "x": "m", "v": "m/s"})
    assert axes.shape == (2, 2)
    assert [ax.get_ylabel() for ax in axes.flat] == ["v (m/s)", "x (m)", "residual, ±2σ (m/s)", "residual, ±2σ (m)"]
    assert [ax.get_xlabel() for ax in axes[1]] == ["t (s)", "t (s)"]
    for (upper, lower), name in zip(axes.T, ("v", "x"), strict=True):
        measured, line = upper.lines
        assert (measured.get_label(), line.get_label()) == ("measured", "fitted")
        assert (measured.get_marker(), measured.get_linestyle(), line.get_linestyle()) == (".", "None", "-")
        np.testing.assert_allclose(measured.get_ydata(), values[name], atol=1e-6)
        np.testing.assert_allclose(line.get_ydata(), values[name] - residuals[name], atol=1e-6)
        np.testing.assert_allclose(lower.lines[0].get_ydata(), residuals[name], atol=1e-6)
        (confidence,) = upper.collections
        for t, end in ((TIMES[3], -1), (TIMES[3], 1)):
            inside = confidence.get_paths()[0].contains_points(
                [(t, (values[name] - residuals[name])[3] + end * f * 0.196) for f in (0.99, 1.01)]
            )
            assert inside.tolist() == [True, False]
        heights = lower.collections[0].get_paths()[0].vertices[:, 1]
        np.testing.assert_allclose((heights.min(), heights.max()), (-band, band), rtol=1e-6)


def test_fit_draws_the_entries_of_an_array_in_one_column():
    values = np.stack([TIMES, TIMES**2], axis=1)
    axes = plot.fit(fitted(np.zeros((11, 2)), of=experiment(values)))
    assert axes.shape == (2, 1)
    assert [text.get_text() for text in axes[0, 0].get_legend().get_texts()] == [
        "measured",
        "z[0] fitted",
        "95 % confidence",
        "z[1] fitted",
    ]
    assert len(axes[1, 0].lines) == 2


def test_fit_of_several_experiments_is_drawn_by_number():
    fit = fitted({"x": np.zeros(11)}, {"x": np.ones(11)}, of=experiment({"x": TIMES}))
    axes = plot.fit(fit, number=1)
    np.testing.assert_allclose(axes[0, 0].lines[1].get_ydata(), TIMES - 1, atol=1e-6)


@pytest.fixture(scope="module")
def fall():
    """A thrown stone, whose heights are linear in g and its unknown start, two samples missing; and z = A θ in closed form."""
    ts = np.linspace(0.0, 2.0, 21)
    rng = np.random.default_rng(3)
    heights = 1.0 + 8.0 * ts - 0.5 * 9.81 * ts**2 + 0.05 * rng.standard_normal(ts.size)
    heights[[4, 5]] = np.nan
    stone = jl.System(lambda q, qdot, g: 0.5 * qdot**2 - g * q)
    record = jl.Experiment(ts, {"height": heights}, 0.9, 7.0, observe=lambda q: {"height": q}, unknown=("q0", "qdot0"))
    return jl.fit(stone, record, {"g": 8.0}, free=("g",)), np.stack([np.ones_like(ts), ts, -0.5 * ts**2], axis=1), heights


@pytest.mark.slow
def test_the_confidence_band_is_that_of_linear_regression(fall):
    fit, A, z = fall
    there = np.isfinite(z)
    theta, squares, *_ = np.linalg.lstsq(A[there], z[there])
    covariance = squares[0] / (there.sum() - 3) * np.linalg.inv(A[there].T @ A[there])
    half = stats.t.ppf(0.95, there.sum() - 3) * np.sqrt(np.diag(A @ covariance @ A.T))
    lower, upper = fit.band(level=0.9)
    np.testing.assert_allclose(lower["height"], A @ theta - half, rtol=1e-5)  # where samples are missing as well
    np.testing.assert_allclose(upper["height"], A @ theta + half, rtol=1e-5)

    axes = plot.fit(fit, level=0.9, units={"t": "s", "height": "m"})
    line, (band,) = axes[0, 0].lines[1], axes[0, 0].collections
    np.testing.assert_allclose(line.get_ydata(), A @ theta, rtol=1e-5)  # where samples are missing as well
    assert band.get_label() == "90 % confidence" and np.isfinite(band.get_paths()[0].vertices).all()


@pytest.mark.slow
def test_times_of_events_share_the_axis_of_time():
    """An oscillator late on the clock is heard at (k + ½) π/2, and seen in between."""
    heard = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2, events={"click": jl.Event(lambda q: q)})
    ts, clicks = 1e6 + np.linspace(0.0, 6.0, 40), 1e6 + (np.arange(4) + 0.5) * np.pi / 2
    record = jl.Experiment(
        ts, {"x": np.cos(2 * (ts - 1e6))}, 1.0, 0.0, observe=lambda q: {"x": q}, events={"click": clicks}, sigma={"x": 0.1, "click": 1e-3}
    )
    axes = plot.fit(jl.fit(heard, record, {"c": 3.9}, free="c"))
    for column, times in zip(axes.T, (clicks, ts), strict=True):
        for line in (*column[0].lines, *column[1].lines):
            np.testing.assert_allclose(line.get_xdata(), times, atol=1e-5)
        assert column[0].get_xlim()[0] > 1e6 - 1


@pytest.mark.slow
def test_parameters_have_bars_in_percent_and_correlations(fall):
    fit = example("parameters")["fit"]
    bars, matrix = plot.parameters(fit, ("k", "b"))
    assert [text.get_text().split("\n")[0] for text in bars.get_yticklabels()] == ["k", "b"]
    assert bars.get_yticklabels()[1].get_text() == f"b\n{fit.estimates['b']:.1f} ± {fit.standard_errors['b']:.1f}"
    thin, thick = (np.array([segment[:, 0] for segment in lines.get_segments()]) for lines in bars.collections)
    percent = np.array([100 * fit.standard_errors[name] / fit.estimates[name] for name in ("k", "b")])
    np.testing.assert_allclose(thick, np.stack([-percent, percent], axis=1), rtol=1e-6)
    np.testing.assert_allclose(thin, 1.96 * np.stack([-percent, percent], axis=1), rtol=1e-3)
    drawn = matrix.images[0].get_array()
    np.testing.assert_allclose(drawn, fit.correlation[np.ix_([2, 0], [2, 0])], rtol=1e-6)
    assert {text.get_text() for text in matrix.texts} == {"+1.00", f"{fit.correlation[0, 2]:+.2f}"}
    with pytest.raises(ValueError, match=r"`names` must name fitted parameters, but holds 'M'\. There are b, c, k\."):
        plot.parameters(fit, ("M",))
    with pytest.raises(ValueError, match=r"`names` must be 1 to 40, to be readable, but are 0\. Choose"):
        plot.parameters(fit, ())


def test_a_parameter_that_is_not_determined_has_no_bar(fall):
    fit = dataclasses.replace(fall[0], covariance=np.array([[np.inf]]), correlation=np.array([[np.nan]]))
    bars, matrix = plot.parameters(fit)
    assert bars.get_yticklabels()[0].get_text() == "g\nnot determined"
    assert not any(len(lines.get_segments()) for lines in bars.collections)
    assert matrix.texts[0].get_text() == "–"


def test_convergence_is_the_cost_of_each_step(fall):
    ax = plot.convergence(fall[0])
    np.testing.assert_array_equal(ax.lines[0].get_ydata(), fall[0].costs)
    assert ax.get_yscale() == "log" and ax.get_title() == f"converged after {fall[0].steps} steps"
    np.testing.assert_allclose(fall[0].costs[-1], fall[0].cost, rtol=1e-9)


def test_a_phase_portrait_is_velocity_over_position():
    trajectory = example("phase")["trajectory"]
    ax = plot.phase(trajectory, ("x",), units={"t": "s", "x": "m"})
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x (m)", "dx/dt (m/s)")
    np.testing.assert_array_equal(ax.lines[0].get_xydata(), np.stack([trajectory.q["x"], trajectory.qdot["x"]], axis=1))
    assert plot.phase(trajectory, ("y",), ax=ax) is ax
    assert ax.lines[0].get_color() != ax.lines[1].get_color()
    both = plot.phase(trajectory, units={"x": "m", "y": "m"}, ax=plt.figure().subplots())
    assert (both.get_xlabel(), both.get_ylabel()) == ("q (m)", "dq/dt")
    assert [text.get_text() for text in both.get_legend().get_texts()] == ["x", "y"]


def test_a_phase_portrait_has_a_panel_for_each_number():
    axes = plot.phase(motion({"r": np.array([1.0, 5.0]), "z": 9.0}), units={"t": "s", "r": "m"})
    assert [ax.get_xlabel() for ax in axes] == ["r[0] (m)", "r[1] (m)", "z"]
    assert [ax.get_ylabel() for ax in axes] == ["dr[0]/dt (m/s)", "dr[1]/dt (m/s)", "dz/dt"]
    for ax, start in zip(axes, (1.0, 5.0, 9.0), strict=True):
        np.testing.assert_allclose(ax.lines[0].get_xdata(), start + TIMES, rtol=1e-6)
        assert len(ax.lines) == 1 and ax.get_legend() is None
    again = plot.phase(motion({"r": np.array([1.0, 5.0]), "z": 9.0}), ax=axes)
    assert list(again) == list(axes) and [len(ax.lines) for ax in axes] == [2, 2, 2]
    with pytest.raises(ValueError, match="`axes` must be 3, one for each number, or one for all, but 2 were given."):
        plot.phase(motion({"r": np.array([1.0, 5.0]), "z": 9.0}), ax=axes[:2])


def test_forces_have_a_ring_where_the_rod_begins_to_push():
    """λ = −m l φ̇² − m g cos φ, and with φ̇² = 2 (g/l) (cos φ − cos φ₀) it is zero where cos φ = ⅔ cos φ₀."""
    trajectory = example("forces")["trajectory"]
    (ax,) = plot.forces(trajectory, units={"t": "s", "rod": "N"})
    line, zero, rings = ax.lines
    assert (ax.get_ylabel(), ax.get_xlabel()) == ("λ rod (N)", "t (s)")
    np.testing.assert_array_equal(line.get_ydata(), trajectory.multipliers["rod"])
    cosine = np.interp(rings.get_xdata(), trajectory.ts, -trajectory.q["y"])
    assert cosine.size >= 2
    np.testing.assert_allclose(cosine, 2 / 3 * np.cos(2.0), atol=2e-3)


def test_energy_stands_beside_the_works():
    trajectory = example("energy")["trajectory"]
    ax = plot.energy(trajectory, units={"energy": "J"})
    lines = {line.get_label(): line.get_ydata() for line in ax.lines}
    np.testing.assert_array_equal(lines["energy"], trajectory.energy())
    for name in ("dampers", "air", "drive"):
        np.testing.assert_array_equal(lines[f"work of {name}"], trajectory.work()[name])
    assert "work of time" not in lines and ax.get_ylabel() == "energy (J)"
    np.testing.assert_allclose(lines["initial energy + work"], lines["energy"], rtol=1e-6)
    plain = example("motion")["trajectory"]
    assert [line.get_label() for line in plot.energy(plain).lines] == ["energy"]


def test_curves_that_lie_on_each_other_are_both_seen():
    """The second of two equal ones covers half of the first; the third leaves gaps that show both."""
    (ax,) = plot.motion(motion({"r": np.array([1.0, 1.0, 2.0, 1.0005, 2.0])}))
    width = lambda line: line.get_linewidth()
    assert [line._unscaled_dash_pattern[1] for line in ax.lines] == [None, (6, 6), None, (6, 12), (6, 6)]
    assert [line._unscaled_dash_pattern[0] for line in ax.lines] == [0, 0, 0, 6, 0] and width(ax.lines[0]) == width(ax.lines[1])
    half = np.where(TIMES < 0.45, 1.0, 2.0)
    crossing = dataclasses.replace(motion({"r": np.zeros(2)}), q={"r": jnp.stack([jnp.ones(11), jnp.asarray(half)], axis=1)})
    assert [line.get_linestyle() for line in plot.motion(crossing)[0].lines] == ["-", "-"]


@pytest.mark.parametrize("size", [2, 10])
def test_correlations_of_either_sign_look_different(size):
    """In colour by far, and where there is no place for numbers, by their signs."""
    rho = np.tile([[1.0, -1.0], [-1.0, 1.0]], (size // 2, size // 2))
    fit, free = object.__new__(jl.results.Fit), SimpleNamespace(theta=lambda y: y)
    filled = {"names": tuple(f"p{i}" for i in range(size)), "x": np.ones(size), "covariance": np.eye(size), "correlation": rho}
    for name, value in (filled | {"absolute": True, "problem": SimpleNamespace(free=free)}).items():
        object.__setattr__(fit, name, value)
    matrix = plot.parameters(fit)[1]
    plus, minus = matrix.images[0].cmap([1.0, 0.0])
    assert plus[2] - plus[0] > 0.4 and minus[0] - minus[2] > 0.4  # blue, red
    signs = [text.get_text() for text in matrix.texts]
    assert signs == (["+1.00", "-1.00", "-1.00", "+1.00"] if size == 2 else ["+" if r > 0 else "−" for r in rho.flat])


def test_forces_are_shaded_where_a_constraint_would_have_to_pull():
    lagrangian = lambda q, qdot: 0.5 * qdot @ qdot - q[1]
    system = jl.System(lagrangian, holonomic={"table": lambda q: q[1], "wall": lambda q: q[0]}, one_sided="table")
    wave = jnp.cos(2 * jnp.pi * jnp.asarray(TIMES))  # negative at 0.3 … 0.7
    trajectory = dataclasses.replace(motion(np.zeros(2)), multipliers={"table": wave, "wall": wave}, provenance=Provenance.of(system, None))
    table, wall = plot.forces(trajectory)
    (shade,) = table.patches
    box = shade.get_extents().transformed(table.transData.inverted())
    np.testing.assert_allclose((box.x0, box.x1), (0.25, 0.75))
    assert [text.get_text() for text in table.get_legend().get_texts()] == ["would have to pull", "λ changes sign"]
    assert not wall.patches


def heights(area, ts):
    """The thickness of an area at the times, by the vertices of its outline."""
    corners = area.get_paths()[0].vertices
    return np.array([np.ptp(corners[np.isclose(corners[:, 0], t), 1]) for t in ts])


def test_the_areas_of_the_balance_add_up_to_nothing():
    trajectory = example("balance")["trajectory"]
    ax = plot.balance(trajectory, units={"t": "s", "energy": "J"})
    ts, areas = np.asarray(trajectory.ts), ax.collections
    above, below = ([heights(area, ts) for area in areas[k::2]] for k in (0, 1))
    exchanged = np.max(np.sum(above, axis=0))
    np.testing.assert_allclose(np.sum(above, axis=0), np.sum(below, axis=0), atol=1e-6 * exchanged)
    assert [area.get_label() for area in areas[::2]] == ["change of energy", "air", "dampers", "drive"]
    np.testing.assert_allclose(below[3], trajectory.work()["drive"], atol=1e-9 * exchanged)
    np.testing.assert_allclose(above[2], -trajectory.work()["dampers"], atol=1e-9 * exchanged)
    with pytest.raises(ValueError, match=re.escape("Ask for them with `simulate(..., works=True)`.")):
        plot.balance(example("motion")["trajectory"])


def test_friction_is_shaded_where_it_sticks():
    """Half-swings of π/2 s, each of which loses 2F/c = 0.15: the seventh ends at 0.05 ≤ F/c, where it sticks."""
    trajectory = example("friction")["trajectory"]
    upper, lower = plot.friction(trajectory, units={"slip": "m/s", "dry": "N"})[:, 0]
    assert (upper.get_ylabel(), lower.get_ylabel()) == ("slip dry (m/s)", "force dry (N)")
    np.testing.assert_allclose(upper.lines[1].get_ydata(), trajectory.qdot, atol=1e-12)
    np.testing.assert_array_equal(lower.lines[1].get_ydata(), trajectory.friction["dry"].force)
    for ax in (upper, lower):
        (shade,) = ax.patches
        box = shade.get_extents().transformed(ax.transData.inverted())
        np.testing.assert_allclose((box.x0, box.x1), (7 * np.pi / 2, 14.0), atol=0.07)  # a sample
    assert plot.friction(trajectory, ("dry",)).shape == (2, 1)


@pytest.mark.fast
@pytest.mark.parametrize(
    ("function", "sentence"),
    [
        (plot.forces, "`trajectory` must be of a system with constraints, but it has none. State them with"),
        (plot.friction, "`trajectory` must have dry friction that sticks and slips, but has none. Write it as a nonsmooth term"),
    ],
)
def test_what_is_not_there_cannot_be_drawn(function, sentence):
    with pytest.raises(ValueError, match=re.escape(sentence)):
        function(motion(1.0))


@functools.cache
def example(name):
    """The names that the example in a docstring has made."""
    (code,) = re.findall(r"```python\n(.*?)```", inspect.getdoc(getattr(plot, name)), re.S)
    names: dict = {}
    exec(code, names)
    return names


def test_a_batch_is_refused():
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), motion(1.0))
    with pytest.raises(ValueError, match=re.escape("`trajectory` must be one motion, but is a batch of shape (2,). Take one")):
        plot.motion(batch)


@pytest.mark.fast
def test_an_unknown_name_is_refused():
    with pytest.raises(ValueError, match=r"`names` must name coordinates, but holds 'z'\. There are x, y\."):
        plot.motion(motion({"x": 1.0, "y": 2.0}), ("z",))


def test_too_few_axes_are_refused():
    with pytest.raises(ValueError, match=r"`axes` must be 2, one for each coordinate, but 1 were given\."):
        plot.motion(motion({"x": 1.0, "y": 2.0}), axes=plt.gca())


def test_missing_matplotlib_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(ImportError, match=re.escape("Install `jaxlag[plot]`.")):
        plot.motion(motion(1.0))
