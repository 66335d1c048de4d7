"""A picture of a best motion: where it goes, what drives it, and the limits."""

from typing import Any

import numpy as np

from .._optimal.solution import OptimalMotion
from .axes import GREY, colour, label, panels, units_of


def optimal_motion(best: OptimalMotion, *, units: dict[str, str] | None = None, axes: Any = None) -> Any:
    r"""A best motion over time: its coordinates, the inputs that drive it, what `within` limits, and the forces of constraints, one panel
    each.

    $$ q_i(t), \qquad u(t), \qquad \lambda(t), \qquad a \le h(t) \le b $$

    Dotted lines are the bounds; dots below mark the nodes between which inputs are polynomials.

    **Arguments:**

    - `best`: what `optimise_motion` returns.
    - `units`: units by name, and of `"t"`, written on the axes; others are taken from the system.
    - `axes`: matplotlib axes to draw in, one for each panel. Default: a new figure.

    **Returns:** the axes, an array.

    **Raises:** `ValueError` if `axes` are another number; `ImportError` without matplotlib.

    **Source:** Betts, Practical Methods for Optimal Control, 2nd ed., chapter 6 (pictures of this kind).

    ```python
    import jaxlag as jl
    from jaxlag import plot
    block = jl.System(lambda qdot: 0.5 * qdot**2, force=lambda u: u)
    best = jl.optimise_motion(block, (0.0, 0.0), (1.0, 0.0), {}, duration=(0.1, 9.0), control={"u": (-1, 1)}, starts=1)
    axes = plot.optimal_motion(best)
    ```
    """
    units = units_of(best.system.units, units)
    coordinates = best.q if isinstance(best.q, dict) else {"q": best.q}
    shown = {**coordinates, **best.u, **best.limited, **{f"λ {name}": x for name, x in best.multipliers.items()}}
    drawn = panels(axes, (len(shown), 1), "one for each coordinate, input and limit", sharex=True, figsize=(6.4, 0.6 + 1.3 * len(shown)))[
        :, 0
    ]
    ts = np.asarray(best.ts)
    for ax, (name, x) in zip(drawn, shown.items(), strict=True):
        lines = np.asarray(x).reshape(len(ts), -1)
        for i, line in enumerate(lines.T):
            ax.plot(ts, line, color=colour(i), label=f"{name}[{i}]" if lines.shape[1] > 1 else None)
        for bound in np.ravel(np.concatenate([np.ravel(end) for end in best.bounds.get(name, ())])) if name in best.bounds else ():
            if np.isfinite(bound):
                ax.axhline(bound, color=GREY, linewidth=0.8, linestyle=":")
        if lines.shape[1] > 1:
            ax.legend(fontsize="small")
        ax.set_ylabel(label(name, units, name.removeprefix("λ ")))
    nodes, last = np.asarray(best.nodes), drawn[-1]
    last.plot(nodes, 0 * nodes, ".", color=GREY, markersize=2.0, clip_on=False, transform=last.get_xaxis_transform())
    drawn[-1].set_xlabel(label("t", units))
    return drawn
