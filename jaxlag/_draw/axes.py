"""Axes, colours and labels that all pictures share. Matplotlib is imported when the first one is drawn."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from .._model.paths import labels, leaf_names, listed
from .._motion.trajectory import Trajectory

# Okabe & Ito, Color Universal Design (2008), distinguishable with any colour vision. Their yellow is too pale for a thin line.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
GREY = "#777777"
COINCIDENT = 0.01  # of the height of the curves: lines nearer than this over half of their length coincide

Units = Mapping[str, str] | None


def colour(i: int) -> str:
    """Colour number i, in cyclic order."""
    return COLOURS[i % len(COLOURS)]


def channels(tree: PyTree, bare: str) -> dict[str, dict[str, np.ndarray]]:
    """The samples of each entry, by the path of the leaf and then by a label; `bare` names a leaf without a path."""
    found = {}
    for name, leaf in zip(leaf_names(tree, bare), map(np.asarray, jax.tree.leaves(tree)), strict=True):
        found[name] = dict(zip(labels(name, leaf.shape[1:]), leaf.reshape(len(leaf), -1).T, strict=True))
    return found


def one_motion(trajectory: Trajectory) -> Trajectory:
    """The trajectory, if it is not a batch of them."""
    if trajectory.ts.ndim != 1:
        raise ValueError(
            f"`trajectory` must be one motion, but is a batch of shape {trajectory.ts.shape[:-1]}. Take one of them, e.g. `trajectory[0]`."
        )
    return trajectory


def chosen(names: Sequence[str] | None, known: Sequence[str], what: str) -> tuple[str, ...]:
    """The requested names, or all."""
    names = known if names is None else listed(names)
    for name in names:
        if name not in known:
            raise ValueError(f"`names` must name {what}, but holds {name!r}. There are {', '.join(known)}.")
    return tuple(names)


def panels(axes: Any, shape: tuple[int, int], which: str, *, sharex: Any = True, **layout: Any) -> Any:
    """The given axes, or axes of a new figure, as an array of this shape."""
    if axes is None:
        _, axes = pyplot().subplots(*shape, sharex=sharex, squeeze=False, layout="constrained", **layout)
    if np.size(axes) != np.prod(shape):
        raise ValueError(
            f"`axes` must be {np.prod(shape)}, {which}, but {np.size(axes)} were given. "
            f"Make them by `plt.subplots{shape}`, or leave them out."
        )
    return np.reshape(axes, shape)


def canvas(ax: Any, **layout: Any) -> Any:
    """The given axes, or axes of a new figure."""
    return pyplot().subplots(layout="constrained", **layout)[1] if ax is None else ax


def pyplot() -> Any:
    """Matplotlib's `pyplot`, imported when it is needed."""
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise ImportError("`jaxlag.plot` must have matplotlib, but it cannot be imported. Install `jaxlag[plot]`.") from error
    return plt


def curve(ax: Any, x: Any, y: Any, **style: Any) -> None:
    """Draws a line, dashed if it coincides with earlier lines, so that these show through."""
    x, y = np.asarray(x), np.asarray(y)
    before = [np.asarray(line.get_ydata()) for line in ax.lines if np.array_equal(line.get_xdata(), x)]
    height = max((float(np.ptp(z[np.isfinite(z)])) for z in (y, *before) if np.isfinite(z).any()), default=0.0)
    below = sum(np.mean(np.abs(y - z) <= COINCIDENT * height) > 0.5 for z in before)
    ax.plot(x, y, **({"linestyle": (6 * (below - 1), (6, 6 * below))} if below else {}) | style)


def legend_beside(ax: Any) -> None:
    """A legend to the right of the panel, where it covers nothing."""
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="small")


def legend_above(ax: Any, ncols: int = 3) -> None:
    """A legend above the panel, where it covers nothing and takes no width."""
    ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), fontsize="small", ncols=ncols, frameon=False)


def zero_line(ax: Any) -> None:
    """A thin line at zero, behind the curves."""
    ax.axhline(0.0, color=GREY, linewidth=0.8, zorder=0.5)


def units_of(stated: tuple[tuple[str, str], ...], given: Units) -> dict[str, str]:
    """The units that a system states, overridden by the given ones."""
    return dict(stated) | dict(given or {})


def label(name: str, units: Units, of: str | None = None) -> str:
    """A name with its unit, or with the unit of another quantity."""
    unit = (units or {}).get(of or name)
    return f"{name} ({unit})" if unit else name


def over_time(
    trajectory: Trajectory,
    quantities: Mapping[str, dict[str, np.ndarray]],
    names: Sequence[str] | None,
    what: str,
    units: Units,
    axes: Any,
    prefix: str = "",
) -> tuple[Any, dict[str, dict[str, np.ndarray]]]:
    """A panel for each requested quantity, over a common time axis; and these quantities."""
    units = units_of(trajectory.provenance.units, units)
    shown = {name: quantities[name] for name in chosen(names, tuple(quantities), f"{what}s")}
    drawn = panels(axes, (len(shown), 1), f"one for each {what}", figsize=(6.4, 1.0 + 1.7 * len(shown)))[:, 0]
    for ax, (name, entries) in zip(drawn, shown.items(), strict=True):
        for i, (entry, samples) in enumerate(entries.items()):
            curve(ax, trajectory.ts, samples, color=colour(i), label=entry)
        ax.set_ylabel(label(f"{prefix}{name}", units, name))
        if len(entries) > 1:
            legend_beside(ax)
    drawn[-1].set_xlabel(label("t", units))
    return drawn, shown
