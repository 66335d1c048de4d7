"""Pictures: the right lines with the right labels, on the axes that were given."""

import inspect
import re
import sys

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest

import jaxlag as jl
from jaxlag import plot
from jaxlag._trajectory import Stated

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
    stated = Stated.of(jl.System(lambda qdot: qdot), {})
    return jl.Trajectory(jnp.asarray(TIMES), samples, samples, samples, {}, jl.RESULTS.successful, {}, None, {}, stated)


def fitted(*residuals, of, sigma=0.5):
    """A fit of an experiment of which only what is drawn is filled in."""
    fit = object.__new__(jl.Fit)
    for name, value in {"experiments": (of,) * len(residuals), "residuals": list(residuals), "sigma": sigma}.items():
        object.__setattr__(fit, name, value)
    return fit


def experiment(values, **options):
    return jl.Experiment(TIMES, values, 0.0, 0.0, observe=lambda q: q, **options)


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


def test_motion_draws_the_entries_of_an_array_in_one_panel():
    axes = plot.motion(motion({"body": {"R": np.arange(4.0).reshape(2, 2)}, "z": 0.0}))
    assert [ax.get_ylabel() for ax in axes] == ["body.R", "z"]
    lines = axes[0].lines
    assert [line.get_label() for line in lines] == [f"body.R[{i}, {j}]" for i in (0, 1) for j in (0, 1)]
    for start, line in enumerate(lines):
        np.testing.assert_allclose(line.get_ydata(), start + TIMES, rtol=1e-6)
    assert len({line.get_color() for line in lines}) == 4
    assert len(axes[0].get_legend().get_texts()) == 4


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
        heights = lower.collections[0].get_paths()[0].vertices[:, 1]
        np.testing.assert_allclose((heights.min(), heights.max()), (-band, band), rtol=1e-6)


def test_fit_draws_the_entries_of_an_array_in_one_column():
    values = np.stack([TIMES, TIMES**2], axis=1)
    axes = plot.fit(fitted(np.zeros((11, 2)), of=experiment(values)))
    assert axes.shape == (2, 1)
    assert [text.get_text() for text in axes[0, 0].get_legend().get_texts()] == ["measured", "z[0] fitted", "z[1] fitted"]
    assert len(axes[1, 0].lines) == 2


def test_fit_of_several_experiments_is_drawn_by_number():
    fit = fitted({"x": np.zeros(11)}, {"x": np.ones(11)}, of=experiment({"x": TIMES}))
    axes = plot.fit(fit, number=1)
    np.testing.assert_allclose(axes[0, 0].lines[1].get_ydata(), TIMES - 1, atol=1e-6)


def test_a_real_fit_is_drawn():
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    record = jl.Experiment(TIMES, np.cos(2 * TIMES), 1.0, 0.0, observe=lambda q: q)
    fit = jl.fit(oscillator, record, {"c": 3.0}, free=("c",), rtol=1e-5, atol=1e-6)
    axes = plot.fit(fit)
    np.testing.assert_allclose(axes[0, 0].lines[1].get_ydata(), np.cos(2 * TIMES), atol=1e-4)


@pytest.mark.parametrize("function", [plot.motion, plot.fit])
def test_the_example_in_the_docstring_runs(function):
    (example,) = re.findall(r"```python\n(.*?)```", inspect.getdoc(function), re.S)
    exec(example, {})
    assert len(plt.get_fignums()) == 1


def test_a_batch_is_refused():
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), motion(1.0))
    with pytest.raises(ValueError, match=re.escape("`trajectory` must be one motion, but is a batch of shape (2,). Take one")):
        plot.motion(batch)


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
