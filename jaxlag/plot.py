"""Pictures of motions, fits and equations. Matplotlib is imported when the first one is drawn; no function shows or keeps a figure."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from ._equations import Equations
from ._fit import Fit
from ._integrate import Trajectory

# Okabe & Ito, Color Universal Design (2008): told apart with every kind of colour vision. Their yellow is too pale for a thin line.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
GREY = "#777777"


def motion(trajectory: Trajectory, names: Sequence[str] | None = None, *, units: Mapping[str, str] | None = None, axes: Any = None) -> Any:
    r"""The coordinates of a motion over time, one panel each.

    $$ q_i(t), \qquad i = 1 \dots n $$

    A coordinate that is an array has one line for each entry, `r[0]`, `r[1]`, …. Samples that were not reached are left out.

    **Arguments:**

    - `trajectory`: one motion, as `simulate` returns it.
    - `names`: the coordinates to be drawn, in this order, by their path in q (`"phi"`, `"body.x"`, `"q"` where q is one array).
      Default: all.
    - `units`: units by name of coordinate, and of `"t"`, to be written on the axes, e.g. `{"t": "s", "phi": "rad"}`.
    - `axes`: matplotlib axes to draw in, as many as there are coordinates. Default: a new figure with a common time axis.

    **Returns:** the axes, an array of shape (n,).

    **Raises:** `ValueError` where `names` or `axes` do not fit the motion, `ImportError` without matplotlib.

    **Source:** the colours are those of Okabe & Ito, Color Universal Design (2008).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    from jaxlag import plot
    oscillator = jl.System(lambda q, qdot: 0.5 * qdot["x"] ** 2 - 2.0 * q["x"] ** 2)
    trajectory = jl.simulate(oscillator, {"x": 1.0}, {"x": 0.0}, jnp.linspace(0.0, 5.0, 101))
    (ax,) = plot.motion(trajectory, units={"t": "s", "x": "m"})
    ax.get_ylabel()  # x (m)
    ```
    """
    if trajectory.ts.ndim != 1:
        raise ValueError(
            f"`trajectory` must be one motion, but is a batch of shape {trajectory.ts.shape[:-1]}. "
            "Take one of it, e.g. `jax.tree.map(lambda x: x[0], trajectory)`."
        )
    coordinates = _channels(trajectory.q, "q")
    names = tuple(coordinates if names is None else names)
    for name in names:
        if name not in coordinates:
            raise ValueError(f"`names` must name coordinates, but holds {name!r}. There are {', '.join(coordinates)}.")
    panels = _panels(axes, (len(names), 1), "one for each coordinate", figsize=(6.4, 1.0 + 1.7 * len(names)))[:, 0]
    for ax, name in zip(panels, names, strict=True):
        for (label, samples), colour in zip(coordinates[name].items(), itertools.cycle(COLOURS)):
            ax.plot(trajectory.ts, samples, color=colour, label=label)
        ax.set_ylabel(_label(name, units))
        if len(coordinates[name]) > 1:
            _legend_beside(ax)
    panels[-1].set_xlabel(_label("t", units))
    return panels


def fit(fit: Fit, *, number: int = 0, units: Mapping[str, str] | None = None, axes: Any = None) -> Any:
    r"""What was measured with the fitted motion, and below it what is left: one column for each channel.

    $$ \hat z_i = h(t_i, q(t_i; \hat\theta), \dot q(t_i; \hat\theta)), \qquad r_i = z_i - \hat z_i, \qquad |r_i| < 2\sigma $$

    The band is ±2σ, with the sigma of the experiment where one was given and the estimated one where not. Of residuals that are
    noise, 95 % lie in it, without any pattern; a pattern is motion that the model has not.

    **Arguments:**

    - `fit`: what `jaxlag.fit` returned.
    - `number`: which of the experiments of the fit to draw.
    - `units`: units by name of channel, and of `"t"`, to be written on the axes. A recording that is one array is named `"z"`.
    - `axes`: matplotlib axes to draw in, 2 × number of channels. Default: a new figure.

    **Returns:** the axes, an array of shape (2, channels).

    **Raises:** `ValueError` where `axes` do not fit the channels, `ImportError` without matplotlib.

    **Source:** Ljung, System Identification, 2nd ed., section 16.6 (residual analysis).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    from jaxlag import plot
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    ts = jnp.linspace(0.0, 3.0, 50)
    measured = {"x": jnp.cos(2.0 * ts) + 1e-3 * jnp.sin(1e3 * ts)}
    record = jl.Experiment(ts, measured, q0=1.0, qdot0=0.0, observe=lambda q: {"x": q})
    axes = plot.fit(jl.fit(oscillator, record, {"c": 3.0}, free=("c",)), units={"t": "s", "x": "m"})
    axes.shape  # (2, 1)
    ```
    """
    residuals = _channels(fit.residuals[number], "z")
    experiment = fit.experiments[number]
    measured, ts = _channels(experiment.values, "z"), np.asarray(experiment.ts)
    sigma = experiment.sigma
    if sigma is None:
        sigma = jax.tree.map(lambda value: np.full(value.shape, fit.sigma), experiment.values)
    sigma = _channels(sigma, "z")

    size = (max(5.0, 3.6 * len(measured)), 4.8)
    panels = _panels(axes, (2, len(measured)), "two for each channel", figsize=size, height_ratios=(3, 2))
    for (upper, lower), (name, entries) in zip(panels.T, measured.items(), strict=True):
        several = len(entries) > 1
        for (label, z), colour in zip(entries.items(), itertools.cycle(COLOURS)):
            r, band = residuals[name][label], 2 * sigma[name][label]
            upper.plot(ts, z, ".", color=GREY, markersize=3, label=None if upper.lines else "measured")
            upper.plot(ts, z - r, color=colour, label=f"{label} fitted" if several else "fitted")
            lower.fill_between(ts, -band, band, color=GREY, alpha=0.3 / len(entries), linewidth=0)
            lower.plot(ts, r, ".", color=colour, markersize=3)
        upper.set_ylabel(_label(name, units))
        if several:
            _legend_beside(upper)
        else:
            upper.legend(loc="best")
        lower.set_ylabel("residual, ±2σ" + _label(name, units).removeprefix(name))
        lower.set_xlabel(_label("t", units))
    return panels


def equations(on_paper: Equations, *, ax: Any = None) -> Any:
    r"""The equations of motion of a system, typeset, to be kept as a picture.

    $$ M\ddot q = f + G^T\lambda $$

    **Arguments:**

    - `on_paper`: what `jaxlag.equations` returned.
    - `ax`: matplotlib axes to write in. Default: a new figure of the right size.

    **Returns:** the axes.

    **Raises:** `ImportError` without matplotlib; `ValueError` where matplotlib cannot typeset an equation, as one with cases.

    **Source:** matplotlib's mathtext, which needs no TeX.

    ```python
    import jaxlag as jl
    from jaxlag import plot
    from jaxlag.examples import pendulum
    plot.equations(jl.equations(pendulum.polar, {"r", "phi"}, {"m", "l", "g"}))
    ```
    """
    _, *rows, _ = on_paper.latex().replace(r"\frac", r"\dfrac").replace(" \\\\\n", "\n").split("\n")
    given = ax is not None
    ax = ax if given else _pyplot().figure().add_axes((0.0, 0.0, 1.0, 1.0))
    ax.set_axis_off()
    ax.set_ylim(len(rows), 0)
    written = [
        ax.text(0.0, i + 0.5, f"  ${row.replace(' &= ', ' = ')}$  ", fontsize=16, verticalalignment="center", math_fontfamily="cm")
        for i, row in enumerate(rows)
    ]
    if not given:
        sizes = np.array([text.get_window_extent().size for text in written]) / ax.figure.dpi
        ax.figure.set_size_inches(sizes[:, 0].max(), 1.4 * len(rows) * sizes[:, 1].max())
    return ax


def _channels(tree: PyTree, bare: str) -> dict[str, dict[str, np.ndarray]]:
    """The samples of each entry, by the path of the leaf and then by a label; `bare` names a leaf without a path."""
    channels = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        name = jax.tree_util.keystr(path, simple=True, separator=".") or bare
        leaf = np.asarray(leaf)
        labels = [f"{name}[{', '.join(map(str, index))}]" if index else name for index in np.ndindex(leaf.shape[1:])]
        channels[name] = dict(zip(labels, leaf.reshape(len(leaf), -1).T, strict=True))
    return channels


def _panels(axes: Any, shape: tuple[int, int], which: str, **layout: Any) -> Any:
    """The axes that were handed over, or those of a new figure, as an array of that shape."""
    if axes is None:
        _, axes = _pyplot().subplots(*shape, sharex=True, squeeze=False, layout="constrained", **layout)
    if np.size(axes) != np.prod(shape):
        raise ValueError(
            f"`axes` must be {np.prod(shape)}, {which}, but {np.size(axes)} were given. "
            f"Make them by `plt.subplots{shape}`, or leave them out."
        )
    return np.reshape(axes, shape)


def _pyplot() -> Any:
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise ImportError("`jaxlag.plot` must have matplotlib, but it cannot be imported. Install `jaxlag[plot]`.") from error
    return plt


def _legend_beside(ax: Any) -> None:
    """A legend to the right of the panel, where it hides nothing."""
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="small")


def _label(name: str, units: Mapping[str, str] | None) -> str:
    unit = (units or {}).get(name)
    return f"{name} ({unit})" if unit else name
