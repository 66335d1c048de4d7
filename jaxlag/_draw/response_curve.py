"""A picture of a response curve: amplitudes over the parameter, unstable motions dashed, and the special points."""

import itertools
from typing import Any

import numpy as np

from .._curves.response_curve import ResponseCurve
from .axes import GREY, Units, canvas, colour, label, units_of

MARKERS = {"fold": "o", "flip": "s", "torus": "D", "branch point": "^", "grazing": "X", "sticking": "P", "reversal": "."}


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
    ax = canvas(ax)
    units = units_of(curve.system.units, units)
    values, stable = np.asarray(curve.values), np.asarray(curve.is_stable)
    names = (of,) if of else tuple(curve.measured)
    for i, name in enumerate(names):
        amplitude = np.asarray(curve.amplitude[name])
        for first, last in _runs(stable):
            part = slice(max(first - 1, 0) if not stable[first] else first, last + (not stable[first]))
            ax.plot(values[part], amplitude[part], color=colour(i), linestyle="-" if stable[first] else "--")
        if len(names) > 1:
            ax.plot([], [], color=colour(i), label=name)
        for point in curve.special:
            style = dict(marker=MARKERS[point.kind], markerfacecolor="white", markeredgecolor="black", linestyle="", zorder=3)
            ax.plot(float(point.value), float(point.amplitude[name]), **style)
    known = {text.get_text() for text in (ax.get_legend().get_texts() if ax.get_legend() else ())}
    for kind in dict.fromkeys(point.kind for point in curve.special if point.kind not in known):
        ax.plot([], [], marker=MARKERS[kind], markerfacecolor="white", markeredgecolor="black", linestyle="", label=kind)
    if not stable.all() and "unstable" not in known:
        ax.plot([], [], color=GREY, linestyle="--", label="unstable")
    if ax.get_legend_handles_labels()[1]:
        ax.legend(frameon=False, fontsize="small")
    ax.set_xlabel(label(curve.over, units))
    ax.set_ylabel("amplitude" if len(names) > 1 else label(f"amplitude of {names[0]}", units, names[0]))
    return ax


def _runs(stable: np.ndarray) -> list[tuple[int, int]]:
    """First and last number of each run of points that are all stable, or all unstable, with one beyond the last."""
    ends = [0, *(np.flatnonzero(np.diff(stable.astype(int))) + 1), len(stable)]
    return list(itertools.pairwise(ends))
