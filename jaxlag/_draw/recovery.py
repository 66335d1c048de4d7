"""A picture of how known parameters are recovered."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from .._fit.recover import Recovery
from .axes import GREY, chosen, colour, panels

MOST_PARAMETERS = 12  # in one picture
REACH = 4.5  # predicted standard errors to either side


def recovery(recovery: Recovery, names: Sequence[str] | None = None, *, axes: Any = None) -> Any:
    r"""Errors of the estimates of repeated fits, in units of the standard errors that were predicted: one panel for each parameter.

    $$ \frac{\hat\theta^{(r)} - \theta}{\mathrm{se}(\hat\theta)} \sim N(0, 1) \quad \text{if the fits are as good as predicted} $$

    The line is the normal distribution. Estimates beyond the ends are counted in the last bars.

    **Arguments:**

    - `recovery`: the result of `jaxlag.recover`.
    - `names`: the parameters to draw, entries of `recovery.names`, at most 12. Default: all.
    - `axes`: matplotlib axes to draw in, one for each. Default: a new figure.

    **Returns:** the axes, an array.

    **Raises:** `ValueError` if `names` are unknown, none or too many, or if `axes` are another number; `ImportError` without matplotlib.

    **Source:** Bates & Watts, Nonlinear Regression Analysis and Its Applications (1988), section 6.1.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    from jaxlag import plot
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    plan = jl.Experiment(jnp.linspace(0.0, 3.0, 50), None, q0=1.0, qdot0=0.0, sigma=1e-2)
    plot.recovery(jl.recover(oscillator, plan, {"c": 4.0}, free=("c",), repeats=50))
    ```
    """
    names = chosen(names, recovery.names, "recovered parameters")
    if not 0 < len(names) <= MOST_PARAMETERS:
        raise ValueError(f"`names` must be 1 to {MOST_PARAMETERS}, to be readable, but are {len(names)}. Choose among `recovery.names`.")
    shown = panels(axes, (1, len(names)), "one for each parameter", sharey=True, figsize=(2.6 * len(names) + 0.8, 2.8))[0]
    x, edges = np.linspace(-REACH, REACH, 200), np.linspace(-REACH, REACH, 19)
    for ax, name in zip(shown, names, strict=True):
        i = recovery.names.index(name)
        errors = recovery.estimates[:, i] - recovery.truth[i]
        errors = errors[np.isfinite(errors)] / recovery.predicted[i]
        ax.hist(np.clip(errors, -REACH, REACH), edges, density=True, color=colour(0), alpha=0.35)
        ax.plot(x, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), color=GREY, linewidth=1.0)
        ax.axvline(np.mean(errors), color=colour(0), linewidth=1.5)
        ax.set_title(f"{name}: {100 * recovery.coverage[i]:.0f} % of intervals of {100 * recovery.level:g} % hold it", fontsize="small")
        ax.set_xlabel("error / predicted standard error")
    shown[0].set_ylabel("share of fits")
    return shown
