"""Pictures of an identification: the fit and the measurements, the parameters, and the convergence."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._fit.experiment import Experiment
from .._fit.response_curve_test import ResponseCurveTest
from .._fit.result import Fit
from .._fit.rounding import plus_minus
from .axes import GREY, Units, canvas, channels, chosen, colour, label, legend_above, legend_beside, panels, units_of

MOST_PARAMETERS = 40  # in one picture
MOST_WITH_NUMBERS = 8  # most parameters for which correlations are written as numbers


def fit(fit: Fit, *, number: int = 0, level: float = 0.95, units: Units = None, axes: Any = None) -> Any:
    r"""Measurements with the fitted motion and its confidence band, and the residuals below: one column for each channel.

    $$ \hat z_i = h(t_i, q(t_i; \hat\theta), \dot q(t_i; \hat\theta)) \pm t\,\mathrm{se}(\hat z_i), \qquad r_i = z_i - \hat z_i,
       \qquad |r_i| < 2\sigma $$

    The band of the fit shows the uncertainty of the motion that follows from its parameters and initial states; it is often thinner than
    the line. Times of events are drawn over those that are fitted, a `ResponseCurveTest` over its parameter. The band of the residuals is
    ±2σ, with the sigma of the experiment if one was given, otherwise the estimated one. If the residuals are noise, 95 % of them lie in it,
    without any pattern; a pattern points to something that the model lacks.

    **Arguments:**

    - `fit`: the result of `jaxlag.fit`.
    - `number`: the index of the experiment to draw.
    - `level`: the level of the confidence band.
    - `units`: units by name of channel, and of `"t"`, written on the axes in place of those of the system. A recording that is one array
      is named `"z"`.
    - `axes`: matplotlib axes to draw in, 2 × number of channels. Default: a new figure.

    **Returns:** the axes, an array of shape (2, channels).

    **Raises:** `ValueError` if `axes` do not match the channels or the experiment is no recording and no sweep, `IndexError` if there is
    no such experiment; `ImportError` without matplotlib.

    **Source:** Ljung, System Identification, 2nd ed., section 16.6 (residual analysis); Seber & Wild, Nonlinear Regression (1989),
    section 5.1 (the band).

    ```python
    import jaxlag as jl
    from jaxlag import plot
    from jaxlag.examples import vehicle
    record = jl.Experiment.from_csv(vehicle.recording, vehicle.q0, vehicle.qdot0, time="t", observe=vehicle.observe)
    fit = jl.fit(vehicle.system, record, vehicle.params | {"b": 4000.0, "c": 30000.0}, free=("b", "c", "k"))
    axes = plot.fit(fit, units={"t": "s", "y": "m", "phi": "rad", "xdot": "m/s"})
    axes.shape  # (2, 3)
    ```
    """
    experiment, units = fit.experiments[number], units_of(fit.units, units)
    if not isinstance(experiment, (Experiment, ResponseCurveTest)):
        what = type(experiment).__name__
        raise ValueError(
            f"`number` must be that of a recording or of a sweep, but number {number} is a {what}. Draw its `fit.residuals[{number}]`."
        )
    is_sweep = isinstance(experiment, ResponseCurveTest)
    along, events = ("t", experiment.events) if not is_sweep else (experiment.over, ())
    sigma = experiment.sigma
    if sigma is None:
        sigma = jax.tree.map(lambda own, value: np.broadcast_to(own, value.shape), fit.sigmas[number], experiment.values)
    trees = (experiment.values, fit.predictions[number], fit.band(number, level)[1], fit.residuals[number], sigma)
    measured, fitted, upmost, residuals, sigma = (channels(tree, "z") for tree in trees)

    size = (max(5.0, 3.6 * len(measured)), 4.8)
    drawn = panels(axes, (2, len(measured)), "two for each channel", figsize=size, height_ratios=(3, 2))
    for (upper, lower), (name, entries) in zip(drawn.T, measured.items(), strict=True):
        several = len(entries) > 1
        for i, (entry, z) in enumerate(entries.items()):
            model, noise = fitted[name][entry], 2 * sigma[name][entry]
            ts = model if name in events else np.asarray(experiment.at if is_sweep else experiment.ts)
            upper.plot(ts, z, ".", color=GREY, markersize=3, label=None if i else "measured")
            upper.plot(ts, model, color=colour(i), label=f"{entry} fitted" if several else "fitted")
            reach = upmost[name][entry] - model
            if np.isfinite(reach).any():
                text = None if i else f"{100 * level:g} % confidence"
                upper.fill_between(ts, model - reach, model + reach, color=colour(i), alpha=0.3, linewidth=0, label=text)
            lower.fill_between(ts, -noise, noise, color=GREY, alpha=0.3 / len(entries), linewidth=0)
            lower.plot(ts, residuals[name][entry], ".", color=colour(i), markersize=3)
        upper.set_ylabel(label(name, units))
        if several:
            legend_beside(upper)
        elif upper is drawn[0, 0]:
            legend_above(upper)
        lower.set_ylabel("residual, ±2σ" + label(name, units).removeprefix(name))
        lower.set_xlabel(label(along, units))
    return drawn


def parameters(fit: Fit, names: Sequence[str] | None = None, *, axes: Any = None) -> Any:
    r"""Estimates with their errors in percent, so that all units fit in one picture, and the matrix of correlations.

    $$ \frac{\mathrm{se}(\hat\theta_i)}{|\hat\theta_i|}, \qquad
       \rho_{ij} = \frac{\mathrm{cov}_{ij}}{\sqrt{\mathrm{cov}_{ii}\,\mathrm{cov}_{jj}}} $$

    The thick bar is one standard error to either side, the thin one the 95 % interval. These measurements can hardly distinguish two
    parameters whose correlation is near ±1. Blue is +1, red is −1; with many parameters, correlations above ½ are marked by their sign.

    **Arguments:**

    - `fit`: the result of `jaxlag.fit`.
    - `names`: the parameters to draw, entries of `fit.names`, at most 40. Default: all.
    - `axes`: two matplotlib axes to draw in. Default: a new figure.

    **Returns:** the axes, an array of shape (2,).

    **Raises:** `ValueError` if `names` are unknown, none or too many, or if `axes` are not two; `ImportError` without matplotlib.

    **Source:** Seber & Wild, Nonlinear Regression (1989), section 5.1.

    ```python
    import jaxlag as jl
    from jaxlag import plot
    from jaxlag.examples import vehicle
    record = jl.Experiment.from_csv(vehicle.recording, vehicle.q0, vehicle.qdot0, time="t", observe=vehicle.observe)
    fit = jl.fit(vehicle.system, record, vehicle.params | {"b": 4000.0, "c": 30000.0}, free=("b", "c", "k"))
    plot.parameters(fit)
    ```
    """
    names = chosen(names, fit.names, "fitted parameters")
    if not 0 < len(names) <= MOST_PARAMETERS:
        raise ValueError(f"`names` must be 1 to {MOST_PARAMETERS}, to be readable, but are {len(names)}. Choose among `fit.names`.")
    at = [fit.names.index(name) for name in names]
    values = np.asarray(fit.problem.free.theta(jnp.asarray(fit.x[: len(fit.names)])))[at]
    errors, correlation = np.sqrt(np.diag(fit.covariance))[at], fit.correlation[np.ix_(at, at)]
    height = 1.6 + 0.45 * len(names)
    size = (4.8 + height, height)
    bars, matrix = panels(axes, (1, 2), "for errors and correlations", sharex=False, figsize=size, width_ratios=(4.8, height))[0]

    rows = np.arange(len(names))
    percent = np.where(np.isfinite(errors) & (values != 0), 100 * errors / np.abs(np.where(values == 0, 1, values)), np.nan)
    known = np.isfinite(percent)
    for width, reach in ((1.5, fit.quantile(0.95)), (6.0, 1.0)):
        bars.hlines(rows[known], -reach * percent[known], reach * percent[known], color=colour(0), linewidth=width)
    bars.plot(0 * rows[known], rows[known], "o", color="white", markeredgecolor=colour(0), markersize=5)
    bars.set_yticks(rows, [f"{name}\n{_in_words(*pair)}" for name, *pair in zip(names, values, errors, strict=True)])
    bars.set_ylim(len(names) - 0.5, -0.5)
    bars.set_xlabel("standard error and 95 % interval (% of the value)")
    bars.grid(axis="x", alpha=0.4)

    image = matrix.imshow(np.where(np.isfinite(correlation), correlation, 0), cmap="coolwarm_r", vmin=-1, vmax=1)
    matrix.set_xticks(rows, names, rotation=90 if max(map(len, names)) > 4 else 0)
    matrix.set_yticks(rows, names)
    matrix.set_title("correlation", fontsize="medium")
    for (i, j), rho in np.ndenumerate(correlation):
        sign = "+−"[int(rho < 0)] if abs(rho) > 0.5 else ""
        text = sign if len(names) > MOST_WITH_NUMBERS else f"{rho:+.2f}" if np.isfinite(rho) else "–"
        matrix.text(j, i, text, ha="center", va="center", fontsize="small", color="white" if abs(rho) > 0.7 else "black")
    if len(names) > MOST_WITH_NUMBERS:
        matrix.figure.colorbar(image, ax=matrix)
    return np.array([bars, matrix])


def convergence(fit: Fit, *, ax: Any = None) -> Any:
    r"""The cost of a fit after each step.

    $$ \tfrac12\sum_i \left(\frac{r_i}{\sigma_i}\right)^2 $$

    The first value belongs to the initial guess. The cost can rise when the problem itself changes: when the weight of the gaps between
    segments (`segments=`) is raised, and when the sigmas of the channels are estimated again.

    **Arguments:**

    - `fit`: the result of `jaxlag.fit`.
    - `ax`: matplotlib axes to draw in. Default: a new figure.

    **Returns:** the axes.

    **Raises:** `ImportError` without matplotlib.

    **Source:** Nocedal & Wright, Numerical Optimization, section 10.3.

    ```python
    import jaxlag as jl
    from jaxlag import plot
    from jaxlag.examples import vehicle
    record = jl.Experiment.from_csv(vehicle.recording, vehicle.q0, vehicle.qdot0, time="t", observe=vehicle.observe)
    fit = jl.fit(vehicle.system, record, vehicle.params | {"b": 4000.0, "c": 30000.0}, free=("b", "c", "k"))
    plot.convergence(fit)
    ```
    """
    costs = np.asarray(fit.costs)
    ax = canvas(ax, figsize=(5.4, 3.4))
    ax.plot(costs, color=colour(0), marker="o" if costs.size < 60 else None, markersize=4)
    if np.all(costs > 0):
        ax.set_yscale("log")
    ax.xaxis.get_major_locator().set_params(integer=True)
    ax.set_xlabel("step")
    ax.set_ylabel("cost ½ Σ (r/σ)²")
    ax.set_title(f"converged after {fit.steps} steps" if fit.converged else fit.reason, fontsize="medium")
    return ax


def _in_words(value, error):
    """The estimate with its error, or words if it has none."""
    if np.isfinite(error):
        return plus_minus(value, error)
    return "not determined" if np.isinf(error) else f"{value:.4g}"
