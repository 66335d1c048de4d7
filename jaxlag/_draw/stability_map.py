"""Pictures of the stability of a steady state over two parameters."""

from typing import Any

import numpy as np

from .._linear.stability_map import StabilityMap
from .axes import GREY, Units, label, pyplot, units_of

KINDS = {"stable": "#DCEBDD", "flutter": "#F2CDB0", "divergence": "#E3A6A1", "missing": "white"}


def stability_map(found: StabilityMap, *, units: Units = None, ax: Any = None) -> Any:
    r"""Regions of two parameters in which a steady state is stable, flutters or diverges, with lines of equal growth where it grows.

    $$ \max_i\,\mathrm{Re}\,\lambda_i(p_1, p_2) $$

    Each point of the grid has its own cell. The thick line marks zero growth, interpolated linearly between points; without damping, when
    all stable states have zero growth, it follows the last stable points.

    **Arguments:**

    - `found`: the result of `jaxlag.stability_map`; the first of its parameters runs to the right.
    - `units`: of the two parameters, by their names. Default: those that the system states.
    - `ax`: matplotlib axes. Default: a new figure.

    **Returns:** the axes. **Raises:** `ImportError` without matplotlib.

    **Source:** Seyranian & Mailybaev, Multiparameter Stability Theory with Mechanical Applications, chapter 3.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    from jaxlag import plot
    rod = jl.System(
        lambda q, qdot, c, p: 0.5 * qdot**2 - 0.5 * (c - p) * q**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2
    )
    over = {"b": jnp.linspace(-1, 1, 9), "p": jnp.linspace(0, 8, 9)}
    plot.stability_map(jl.stability_map(rod, lambda: 0.0, params={"c": 4.0, "p": 0.0, "b": 0.0}, over=over))
    ```
    """
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    ax = pyplot().subplots(layout="constrained")[1] if ax is None else ax
    x, y = found.values
    names, kinds = list(KINDS), found.kind.T
    number = np.argmax(kinds[..., None] == np.array(names), axis=-1)
    ax.pcolormesh(x, y, number, cmap=ListedColormap(list(KINDS.values())), vmin=-0.5, vmax=len(names) - 0.5, shading="nearest")
    most = np.nanmax(found.growth, initial=0)
    if most > 0:
        ax.contour(x, y, found.growth.T, levels=np.linspace(0, most, 7)[1:-1], colors=GREY, linewidths=0.5)
        border = np.where(found.growth > 0, found.growth, np.minimum(found.growth, -1e-9 * most)).T  # where it is 0, it is still stable
        if np.nanmin(border) < 0:
            ax.contour(x, y, border, levels=[0.0], colors="black", linewidths=1.5)
    ax.set_xlim(x[0], x[-1])
    ax.set_ylim(y[0], y[-1])
    units = units_of(found.units, units)
    ax.set_xlabel(label(found.over[0], units))
    ax.set_ylabel(label(found.over[1], units))
    there = [name for name in names if np.any(kinds == name)]
    handles = [Patch(facecolor=KINDS[name], edgecolor=GREY, label=name) for name in there]
    ax.legend(handles=handles, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(handles), frameon=False)
    return ax
