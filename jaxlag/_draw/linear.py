"""Pictures of linear systems: frequency responses, and eigenvalues over a parameter."""

from typing import Any

import numpy as np

from .._linear.linear_system import LinearSystem
from .._linear.root_locus import RootLocus
from .axes import COLOURS, GREY, Units, colour, label, panels, pyplot, units_of


def bode(system: LinearSystem, omega: Any, *, units: Units = None, axes: Any = None) -> Any:
    r"""Magnitude and phase of the frequency response, one line for each pair of output and input.

    $$ |G(i\omega)|, \qquad \arg G(i\omega) $$

    **Arguments:**

    - `system`: a `LinearSystem`. `omega`: angular frequencies, increasing and positive.
    - `units`: of `"omega"` and `"magnitude"`, written on the axes, e.g. `{"omega": "rad/s"}`. Default: that of ω follows from
      the unit of `"t"` that the system states.
    - `axes`: two matplotlib axes to draw in. Default: a new figure with a common, logarithmic frequency axis.

    **Returns:** the axes, an array of shape (2,).

    **Raises:** `ValueError` as `LinearSystem.frequency_response`, or if `omega` or `axes` do not fit; `ImportError` without matplotlib.

    **Source:** Åström & Murray, Feedback Systems, 2nd ed., section 9.6.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    from jaxlag import plot
    oscillator = jl.System(lambda q, qdot: 0.5 * qdot**2 - 2.0 * q**2, dissipation=lambda qdot: 0.1 * qdot**2)
    magnitude, phase = plot.bode(jl.linearise(oscillator, 0.0, inputs=["q"]), jnp.geomspace(0.1, 10, 200), units={"omega": "rad/s"})
    ```
    """
    omega = np.asarray(omega)
    found = system.bode(omega)
    if not np.all(omega > 0):
        raise ValueError("`omega` must be positive for a logarithmic axis, but holds a zero. Begin with a small frequency.")
    upper, lower = drawn = panels(axes, (2, 1), "magnitude and phase").ravel()
    for i, (output, source) in enumerate(np.ndindex(found.magnitude.shape[1:])):
        of = f"{system.output_names[output]} / {system.input_names[source]}"
        upper.loglog(omega, found.magnitude[:, output, source], color=colour(i), label=of)
        lower.semilogx(omega, found.phase[:, output, source], color=colour(i))
    stated = {} if system.origin is None else dict(system.origin.units)
    units = ({"omega": f"rad/{stated['t']}"} if "t" in stated else {}) | dict(units or {})
    upper.set_ylabel(label("|G|", units, "magnitude"))
    lower.set_ylabel("phase (°)")
    lower.set_xlabel(label("ω", units, "omega"))
    lower.yaxis.set_major_locator(_locator(45))
    upper.legend(frameon=False)
    return drawn


def nyquist(system: LinearSystem, omega: Any, *, ax: Any = None) -> Any:
    r"""The frequency response in the complex plane, with its mirror image of negative frequencies dashed and the point −1 marked.

    $$ G(i\omega), \qquad -\infty < \omega < \infty $$

    **Arguments, raises:** as `bode`; `ax`: matplotlib axes. **Returns:** the axes.

    **Source:** Åström & Murray, Feedback Systems, 2nd ed., section 10.2.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    from jaxlag import plot
    oscillator = jl.System(lambda q, qdot: 0.5 * qdot**2 - 2.0 * q**2, dissipation=lambda qdot: 0.1 * qdot**2)
    plot.nyquist(jl.linearise(oscillator, 0.0, inputs=["q"]), jnp.geomspace(0.1, 10, 200))
    ```
    """
    response = np.asarray(system.frequency_response(omega))
    ax = pyplot().subplots(layout="constrained")[1] if ax is None else ax
    for i, (output, source) in enumerate(np.ndindex(response.shape[1:])):
        G = response[:, output, source]
        ax.plot(G.real, G.imag, color=colour(i), label=f"{system.output_names[output]} / {system.input_names[source]}")
        ax.plot(G.real, -G.imag, "--", color=colour(i), linewidth=0.8)
    ax.plot(-1, 0, "+", color="black")
    ax.axhline(0, color=GREY, linewidth=0.5)
    ax.axvline(0, color=GREY, linewidth=0.5)
    ax.set_xlabel("Re G")
    ax.set_ylabel("Im G")
    ax.set_aspect("equal", adjustable="datalim")
    ax.legend(frameon=False)
    return ax


def root_locus(locus: RootLocus, *, units: Units = None, axes: Any = None) -> Any:
    r"""Real and imaginary parts of the eigenvalues over the parameter; a ring marks each change of stability.

    $$ \lambda(p), \qquad \mathrm{Re}\,\lambda(p^*) = 0 $$

    **Arguments:**

    - `locus`: the result of `jaxlag.root_locus`.
    - `units`: of the parameter, by its name, and of `"eigenvalues"`, e.g. `{"v": "m/s", "eigenvalues": "1/s"}`. Default: those that the
      system states.
    - `axes`: two matplotlib axes. Default: a new figure.

    **Returns:** the axes, an array of shape (2,). **Raises:** `ImportError` without matplotlib.

    **Source:** Meijaard, Papadopoulos, Ruina & Schwab, Proc. R. Soc. A 463 (2007) 1955-1982, figure 3.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    from jaxlag import plot
    bead = jl.System(lambda q, qdot, w: 0.5 * (qdot**2 + (jnp.sin(q) * w) ** 2) + 9.81 * jnp.cos(q))
    locus = jl.root_locus(bead, 0.0, params={"w": 0.0}, over="w", values=jnp.linspace(0.0, 5.0, 21))
    growth, frequency = plot.root_locus(locus, units={"w": "rad/s"})
    ```
    """
    growth, frequency = drawn = panels(axes, (2, 1), "real and imaginary parts").ravel()
    values, eigenvalues = np.asarray(locus.values), np.asarray(locus.eigenvalues)
    for i, branch in enumerate(branch for branch in eigenvalues.T if np.any(branch)):
        growth.plot(values, branch.real, color=colour(i))
        frequency.plot(values, np.where(branch.imag > 0, branch.imag, np.nan), color=colour(i))  # the upper one of a pair
    growth.axhline(0, color=GREY, linewidth=0.5)
    for crossing in locus.crossings:
        at = float(crossing.value)
        style = dict(marker="o", markerfacecolor="white", markeredgecolor="black", linestyle="")
        growth.plot(at, 0, label=f"{crossing.kind} {crossing.direction} at {at:.4g}", **style)
        frequency.plot(at, crossing.frequency, **style)
        for ax in drawn:
            ax.axvline(at, color=COLOURS[1], linewidth=0.5)
    stated = dict(locus.units)
    units = units_of(locus.units, ({"eigenvalues": f"1/{stated['t']}"} if "t" in stated else {}) | dict(units or {}))
    growth.set_ylabel(label("Re λ", units, "eigenvalues"))
    frequency.set_ylabel(label("Im λ", units, "eigenvalues"))
    frequency.set_xlabel(label(locus.over, units))
    if locus.crossings:
        growth.legend(frameon=False)
    return drawn


def _locator(step):
    from matplotlib.ticker import MultipleLocator

    return MultipleLocator(step)
