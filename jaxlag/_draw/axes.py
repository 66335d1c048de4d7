"""What all pictures have in common: axes, colours, labels. Matplotlib is imported when the first one is drawn."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from .._model.paths import labels, leaf_names
from .._motion.trajectory import Trajectory

# Okabe & Ito, Color Universal Design (2008): told apart with every kind of colour vision. Their yellow is too pale for a thin line.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
GREY = "#777777"

Units = Mapping[str, str] | None


def colour(i: int) -> str:
    """The colours in turn."""
    return COLOURS[i % len(COLOURS)]


def channels(tree: PyTree, bare: str) -> dict[str, dict[str, np.ndarray]]:
    """The samples of each entry, by the path of the leaf and then by a label; `bare` names a leaf without a path."""
    found = {}
    for name, leaf in zip(leaf_names(tree, bare), map(np.asarray, jax.tree.leaves(tree)), strict=True):
        found[name] = dict(zip(labels(name, leaf.shape[1:]), leaf.reshape(len(leaf), -1).T, strict=True))
    return found


def one_motion(trajectory: Trajectory) -> Trajectory:
    """The trajectory, which a batch is refused as."""
    if trajectory.ts.ndim != 1:
        raise ValueError(
            f"`trajectory` must be one motion, but is a batch of shape {trajectory.ts.shape[:-1]}. Take one of it, e.g. `trajectory[0]`."
        )
    return trajectory


def chosen(names: Sequence[str] | None, known: Sequence[str], what: str) -> tuple[str, ...]:
    """The names that were asked for, or all."""
    for name in names or ():
        if name not in known:
            raise ValueError(f"`names` must name {what}, but holds {name!r}. There are {', '.join(known)}.")
    return tuple(known if names is None else names)


def panels(axes: Any, shape: tuple[int, int], which: str, *, sharex: Any = True, **layout: Any) -> Any:
    """The axes that were handed over, or those of a new figure, as an array of that shape."""
    if axes is None:
        _, axes = pyplot().subplots(*shape, sharex=sharex, squeeze=False, layout="constrained", **layout)
    if np.size(axes) != np.prod(shape):
        raise ValueError(
            f"`axes` must be {np.prod(shape)}, {which}, but {np.size(axes)} were given. "
            f"Make them by `plt.subplots{shape}`, or leave them out."
        )
    return np.reshape(axes, shape)


def canvas(ax: Any, **layout: Any) -> Any:
    """The axes that were handed over, or those of a new figure."""
    return pyplot().subplots(layout="constrained", **layout)[1] if ax is None else ax


def pyplot() -> Any:
    """Matplotlib's, without which there are no pictures."""
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise ImportError("`jaxlag.plot` must have matplotlib, but it cannot be imported. Install `jaxlag[plot]`.") from error
    return plt


def curve(ax: Any, x: Any, y: Any, **style: Any) -> None:
    """A line; where it lies on lines drawn before it is dashed, so that these are seen between the dashes."""
    x, y = np.asarray(x), np.asarray(y)
    before = [np.asarray(line.get_ydata()) for line in ax.lines if np.array_equal(line.get_xdata(), x)]
    height = max((float(np.ptp(z[np.isfinite(z)])) for z in (y, *before) if np.isfinite(z).any()), default=0.0)
    below = sum(np.mean(np.abs(y - z) <= SEEN * height) > 0.5 for z in before)
    ax.plot(x, y, **({"linestyle": (6 * (below - 1), (6, 6 * below))} if below else {}) | style)


SEEN = 0.01  # of the height of what is drawn: lines that are nearer to each other over half of their length lie on each other


def legend_beside(ax: Any) -> None:
    """A legend to the right of the panel, where it hides nothing."""
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="small")


def legend_above(ax: Any, ncols: int = 3) -> None:
    """A legend above the panel, where it hides nothing and takes no width."""
    ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), fontsize="small", ncols=ncols, frameon=False)


def zero_line(ax: Any) -> None:
    """A thin line at zero, behind what is drawn."""
    ax.axhline(0.0, color=GREY, linewidth=0.8, zorder=0.5)


def label(name: str, units: Units, of: str | None = None) -> str:
    """A name with the unit of it, or of another quantity."""
    unit = (units or {}).get(of or name)
    return f"{name} ({unit})" if unit else name


def over_time(ts: Any, quantities: Mapping[str, dict], titles: Sequence[str], which: str, units: Units, axes: Any) -> Any:
    """A panel for each quantity, over a common time axis."""
    drawn = panels(axes, (len(quantities), 1), which, figsize=(6.4, 1.0 + 1.7 * len(quantities)))[:, 0]
    for ax, (name, entries), title in zip(drawn, quantities.items(), titles, strict=True):
        for i, (entry, samples) in enumerate(entries.items()):
            curve(ax, ts, samples, color=colour(i), label=entry)
        ax.set_ylabel(label(title, units, name))
        if len(entries) > 1:
            legend_beside(ax)
    drawn[-1].set_xlabel(label("t", units))
    return drawn
