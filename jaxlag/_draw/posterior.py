"""A picture of draws from a posterior."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from .._fit.posterior import Posterior
from .axes import GREY, chosen, colour, panels

MOST_NUMBERS = 8  # in one picture
MOST_POINTS = 2000  # in one panel


def posterior(posterior: Posterior, names: Sequence[str] | None = None, *, axes: Any = None) -> Any:
    r"""Draws of parameters: on the diagonal each of them, with the interval that holds it with a probability of 95 %; below, in pairs.

    $$ \theta^{(r)} \sim p(\theta \mid z) $$

    Each chain has a colour of its own on the diagonal: where they differ, more draws are needed.

    **Arguments:**

    - `posterior`: what `LogDensity.sample` returns.
    - `names`: the n numbers to draw, entries of `posterior.names`, at most 8. Default: all, or the first 8.
    - `axes`: matplotlib axes to draw in, (n, n). Default: a new figure.

    **Returns:** the axes, an array (n, n).

    **Raises:** `ValueError` if `names` are unknown, none or too many, or if `axes` are another number; `ImportError` without matplotlib.

    **Source:** Gelman et al., Bayesian Data Analysis, 3rd ed., section 10.1.

    ```python
    import jax, jax.numpy as jnp
    import jaxlag as jl
    from jaxlag import plot
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    ts = jnp.linspace(0.0, 3.0, 50)
    density = jl.log_density(oscillator, jl.Experiment(ts, jnp.cos(2.0 * ts), 1.0, 0.0, sigma=0.1), {"c": 3.0}, free=("c",))
    plot.posterior(density.sample(jax.random.key(0), 200, chains=2))
    ```
    """
    names = chosen(posterior.names[:MOST_NUMBERS] if names is None else names, posterior.names, "numbers that were drawn")
    n = len(names)
    if not 0 < n <= MOST_NUMBERS:
        raise ValueError(f"`names` must be 1 to {MOST_NUMBERS}, to be readable, but are {n}. Choose among `posterior.names`.")
    shown = panels(axes, (n, n), "n rows of n", sharex="col", figsize=(1.9 * n + 0.8, 1.9 * n + 0.4))
    draws = [np.asarray(posterior.draws[name]) for name in names]
    thin = slice(None, None, -(-draws[0].size // MOST_POINTS))
    for i, name in enumerate(names):
        edges = np.linspace(np.min(draws[i]), np.max(draws[i]), 31)
        for chain, x in enumerate(draws[i]):
            shown[i, i].hist(x, edges, density=True, histtype="step", color=colour(chain))
        for end in posterior.interval(name):
            shown[i, i].axvline(end, color=GREY, linewidth=0.8)
        shown[i, i].set_yticks([])
        shown[i, i].set_title(name, fontsize="small")
        for j in range(n):
            if j < i:
                shown[i, j].plot(draws[j].ravel()[thin], draws[i].ravel()[thin], ".", color=colour(0), markersize=2, alpha=0.3)
            elif j > i:
                shown[i, j].set_axis_off()
            if 0 < j < i:
                shown[i, j].set_yticklabels([])
        if i:
            shown[i, 0].set_ylabel(name)
        shown[-1, i].set_xlabel(name, labelpad=12)
        shown[-1, i].locator_params(axis="x", nbins=3)
        shown[-1, i].tick_params(axis="x", labelrotation=30, labelsize="small")
    return shown
