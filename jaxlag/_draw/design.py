"""A picture of what a chosen experiment is worth."""

from typing import Any

import jax
import numpy as np

from .._fit.design import Design
from .axes import GREY, canvas, colour

NOT_DETERMINED = 1e2  # relative error at which what is not determined is drawn


def design(design: Design, *, ax: Any = None) -> Any:
    r"""Standard errors to expect, relative to the values, of each parameter: before the design and after it.

    $$ \frac{\mathrm{se}(\theta_j)}{|\theta_j|} $$

    A parameter that the plan did not determine stands at the right end, as an open circle; of one that is zero the error itself is drawn.

    **Arguments:** `design`: the result of `jaxlag.design`; `ax`: matplotlib axes to draw in. Default: those of a new figure.

    **Returns:** the axes. **Raises:** `ImportError` without matplotlib.

    **Source:** Cleveland, The Elements of Graphing Data (1994), section 3.3 (dot plots).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    from jaxlag import plot
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    plan = jl.Experiment(jnp.linspace(0.0, 3.0, 50), None, q0=1.0, qdot0=0.0, sigma=1e-3)
    plot.design(jl.design(oscillator, plan, {"c": 4.0}, free="c", over="q0", bounds={"q0": (-2.0, 2.0)}, starts=1))
    ```
    """
    names = design.after.names
    ax = canvas(ax, figsize=(5.5, 0.8 + 0.45 * len(names)))
    values = np.concatenate([np.ravel(np.asarray(x, float)) for part in design.after.estimates.values() for x in jax.tree.leaves(part)])
    size = np.where(values == 0, 1, np.abs(values))
    before, after = (np.sqrt(np.diag(of.covariance)) / size for of in (design.before, design.after))
    known = np.concatenate([before[np.isfinite(before)], after[np.isfinite(after)]])
    end = NOT_DETERMINED * np.max(known, initial=1.0)
    rows = np.arange(len(names))
    for x, label, which in ((before, "before", GREY), (after, "after", colour(0))):
        there = np.isfinite(x)
        ax.plot(x[there], rows[there], "o", color=which, label=label)
        ax.plot(np.full(np.sum(~there), end), rows[~there], "o", color=which, markerfacecolor="none")
    ax.hlines(
        rows, np.where(np.isfinite(after), after, end), np.where(np.isfinite(before), before, end), color=GREY, linewidth=0.8, zorder=0
    )
    ax.set(xscale="log", yticks=rows, yticklabels=names, xlabel="standard error / value", ylim=(len(names) - 0.5, -0.5))
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=9))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{100 * x:.2g} %"))
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.grid(axis="x", alpha=0.3)
    ax.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5))
    return ax
