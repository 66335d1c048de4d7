"""Pictures of curves over a parameter: amplitudes of periodic motions, coordinates at rest; what is unstable dashed; special points."""

import itertools
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from .._curves.equilibrium_curve import EquilibriumCurve
from .._curves.response_curve import ResponseCurve
from .axes import GREY, Units, canvas, channels, colour, label, units_of

MARKERS = {
    "fold": "o",
    "flip": "s",
    "torus": "D",
    "branch point": "^",
    "grazing": "X",
    "sticking": "P",
    "reversal": ".",
    "event": "*",
    "flutter": "D",
}


def response_curve(curve: ResponseCurve, *, of: str | None = None, units: Units = None, ax: Any = None) -> Any:
    r"""The amplitude of each measure over the parameter; unstable motions are dashed, special points are marked.

    $$ A(p) = \tfrac12\left(\max_t f - \min_t f\right) $$

    **Arguments:**

    - `curve`: what `response_curve` returns; several are drawn into the same axes, one after the other.
    - `of`: the name of one measure. Default: all.
    - `units`: units by name, written on the axes; others are taken from the system.
    - `ax`: matplotlib axes to draw in. Default: those of a new figure.

    **Returns:** the axes.

    **Raises:** `ValueError` if `of` names no measure; `ImportError` without matplotlib.

    **Source:** Nayfeh & Balachandran, Applied Nonlinear Dynamics, chapter 6 (pictures of this kind).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    from jaxlag import plot
    duffing = jl.System(
        lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2 - 0.25 * q**4,
        dissipation=lambda qdot: 0.05 * qdot**2,
        force=lambda t, w: 0.3 * jnp.cos(w * t),
    )
    orbit = jl.periodic(duffing, 0.4, 0.0, {"w": 0.5}, section=jl.Every(lambda w: 2 * jnp.pi / w))
    ax = plot.response_curve(jl.response_curve(orbit, over="w", values=(0.3, 2.5)))
    ```
    """
    if of is not None and of not in curve.measured:
        raise ValueError(f"`of` must name what was measured, but is {of!r}. There are {', '.join(curve.measured)}.")
    names = (of,) if of else tuple(curve.measured)
    lines = {name: np.asarray(curve.amplitude[name]) for name in names}
    special = [(point.kind, float(point.value), {name: float(point.amplitude[name]) for name in names}) for point in curve.special]
    ax = _drawn(curve, lines, special, units, canvas(ax))
    ax.set_ylabel("amplitude" if len(names) > 1 else label(f"amplitude of {names[0]}", units_of(curve.system.units, units), names[0]))
    return ax


def equilibrium_curve(curve: EquilibriumCurve, *, of: str | None = None, units: Units = None, ax: Any = None) -> Any:
    r"""The coordinates of equilibria over the parameter; unstable ones are dashed, special points are marked.

    $$ q(p), \qquad f(q, 0; p) + G^T\lambda = 0 $$

    **Arguments:**

    - `curve`: what `equilibrium_curve` returns; several are drawn into the same axes, one after the other.
    - `of`: the name of one coordinate. Default: all.
    - `units`: units by name, written on the axes; others are taken from the system.
    - `ax`: matplotlib axes to draw in. Default: those of a new figure.

    **Returns:** the axes.

    **Raises:** `ValueError` if `of` names no coordinate; `ImportError` without matplotlib.

    **Source:** Thompson & Hunt, A General Theory of Elastic Stability, chapter 3 (pictures of this kind).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    from jaxlag import plot
    bead = jl.System(lambda q, qdot, w: 0.5 * (qdot**2 + (jnp.sin(q) * w) ** 2) + 9.81 * jnp.cos(q))
    bottom = jl.equilibrium_curve(bead, 0.0, {"w": 1.0}, over="w", values=(0.5, 6.0))
    ax = plot.equilibrium_curve(bottom)
    plot.equilibrium_curve(bottom.branch(0), ax=ax)
    ```
    """
    known = {name: line for entries in channels(curve.q, "q").values() for name, line in entries.items()}
    if of is not None and of not in known:
        raise ValueError(f"`of` must name a coordinate, but is {of!r}. There are {', '.join(known)}.")
    lines = {of: known[of]} if of else known
    at = lambda q: {name: float(x[0]) for part in channels(_first(q), "q").values() for name, x in part.items()}
    ax = _drawn(curve, lines, [(point.kind, float(point.value), at(point.q)) for point in curve.special], units, canvas(ax))
    if len(lines) == 1:
        ax.set_ylabel(label(next(iter(lines)), units_of(curve.system.units, units)))
    return ax


def _first(tree: PyTree) -> PyTree:
    """One point, as a curve of one."""
    return jax.tree.map(lambda x: np.asarray(x)[None], tree)


def _drawn(curve: Any, lines: dict[str, np.ndarray], special: list[tuple[str, float, dict[str, float]]], units: Units, ax: Any) -> Any:
    """Lines over the parameter, solid where they are stable, with the special points on each."""
    values, stable = np.asarray(curve.values), np.asarray(curve.is_stable)
    marked = dict(markerfacecolor="white", markeredgecolor="black", linestyle="", zorder=3)
    for i, (name, line) in enumerate(lines.items()):
        for first, last in _runs(stable):
            part = slice(max(first - 1, 0) if not stable[first] else first, last + (not stable[first]))
            ax.plot(values[part], line[part], color=colour(i), linestyle="-" if stable[first] else "--")
        if len(lines) > 1:
            ax.plot([], [], color=colour(i), label=name)
        for kind, value, heights in special:
            ax.plot(value, heights[name], marker=MARKERS[kind], **marked)
    known = {text.get_text() for text in (ax.get_legend().get_texts() if ax.get_legend() else ())}
    for kind in dict.fromkeys(kind for kind, *_ in special if kind not in known):
        ax.plot([], [], marker=MARKERS[kind], label=kind, **marked)
    if not stable.all() and "unstable" not in known:
        ax.plot([], [], color=GREY, linestyle="--", label="unstable")
    if ax.get_legend_handles_labels()[1]:
        ax.legend(frameon=False, fontsize="small")
    ax.set_xlabel(label(curve.over, units_of(curve.system.units, units)))
    return ax


def _runs(stable: np.ndarray) -> list[tuple[int, int]]:
    """First and last number of each run of points that are all stable, or all unstable, with one beyond the last."""
    ends = [0, *(int(i) + 1 for i in np.flatnonzero(np.diff(stable.astype(int)))), len(stable)]
    return list(itertools.pairwise(ends))
