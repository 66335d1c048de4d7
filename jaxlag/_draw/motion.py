"""Pictures of one motion: coordinates, phase portrait, energy and where it goes."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from .._motion.trajectory import Trajectory, energies
from .axes import (
    GREY,
    Units,
    canvas,
    channels,
    chosen,
    colour,
    curve,
    label,
    legend_above,
    legend_beside,
    one_motion,
    over_time,
    panels,
    units_of,
    zero_line,
)

THIN = 1e-3  # of the largest area: a smaller one is invisible


def motion(trajectory: Trajectory, names: Sequence[str] | None = None, *, units: Units = None, axes: Any = None) -> Any:
    r"""The coordinates and states of a motion over time, one panel each.

    $$ q_i(t), \qquad i = 1 \dots n $$

    A coordinate that is an array has one line for each entry, `r[0]`, `r[1]`, …. Samples that were not reached are omitted. Dotted lines
    mark events.

    **Arguments:**

    - `trajectory`: one motion, as `simulate` returns it.
    - `names`: the coordinates to draw, in this order, by their path in q (`"phi"`, `"body.x"`, `"q"` where q is one array), and states
      by their path in `trajectory.states`. Default: all.
    - `units`: units by name of coordinate, and of `"t"`, written on the axes, e.g. `{"t": "s", "phi": "rad"}`; others are taken from the
      system, as in all pictures of motions and fits.
    - `axes`: matplotlib axes to draw in, as many as there are coordinates. Default: a new figure with a common time axis.

    **Returns:** the axes, an array of shape (n,).

    **Raises:** `ValueError` if `names` or `axes` do not match the motion, or for a batch of motions; `ImportError` without matplotlib.

    **Source:** the colours are those of Okabe & Ito, Color Universal Design (2008).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    from jaxlag import plot
    from jaxlag.examples import pendulum
    start = pendulum.cartesian_state(2.0, 0.0, 1.0)
    trajectory = jl.simulate(pendulum.cartesian, *start, jnp.linspace(0.0, 2.0, 101), pendulum.params)
    axes = plot.motion(trajectory, units={"t": "s", "x": "m", "y": "m"})
    axes[0].get_ylabel()  # x (m)
    ```
    """
    shown = channels(one_motion(trajectory).q, "q") | channels(trajectory.states, "states")
    drawn, _ = over_time(trajectory, shown, names, "coordinate", units, axes)
    for ax in drawn:
        for i, (name, event) in enumerate(trajectory.events.items()):
            for j, time in enumerate(np.asarray(event.ts)[np.isfinite(event.ts)]):
                ax.axvline(time, color=colour(i + 1), linewidth=0.8, linestyle=":", label=None if j or ax is not drawn[0] else name)
    if np.size(drawn) and any(np.isfinite(event.ts).any() for event in trajectory.events.values()):
        legend_above(drawn[0])
    return drawn


def phase(trajectory: Trajectory, names: Sequence[str] | None = None, *, units: Units = None, ax: Any = None) -> Any:
    r"""The phase portrait of a motion: velocity over position, with a dot at the start, one panel for each number.

    $$ (q_i(t), \dot q_i(t)) $$

    Drawn on the same axes, another motion gets the next colour, so that a phase portrait can show many. A coordinate that is an array
    has one panel for each entry.

    **Arguments:**

    - `trajectory`: one motion, as `simulate` returns it.
    - `names`: the coordinates to draw, by their path in q. Default: all.
    - `units`: units by name of coordinate, and of `"t"`; those of the velocity follow.
    - `ax`: matplotlib axes to draw in: one for each panel, or one that all share. Default: a new figure.

    **Returns:** the axes; an array of them, of shape (panels,), if there are several.

    **Raises:** `ValueError` if `names` or `ax` do not match the motion, or for a batch of motions; `ImportError` without matplotlib.

    **Source:** Arnold, Mathematical Methods of Classical Mechanics, 2nd ed., section 4.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    from jaxlag import plot
    from jaxlag.examples import pendulum
    start = pendulum.cartesian_state(2.0, 0.0, 1.0)
    trajectory = jl.simulate(pendulum.cartesian, *start, jnp.linspace(0.0, 2.0, 101), pendulum.params)
    ax = plot.phase(trajectory, ("x",), units={"t": "s", "x": "m"})
    ax.get_ylabel()  # dx/dt (m/s)
    ```
    """
    units = units_of(trajectory.provenance.units, units)
    positions, velocities = (channels(tree, "q") for tree in (one_motion(trajectory).q, trajectory.qdot))
    names = chosen(names, tuple(positions), "coordinates")
    entries = [(name, entry, x, velocities[name][entry]) for name in names for entry, x in positions[name].items()]
    if np.size(ax) == 1 and ax is not None:
        ax, own = np.ravel(ax)[0], False
    elif len(entries) == 1:
        ax, own = canvas(None, figsize=(5.4, 4.2)), True
    else:
        shape = 1, len(entries)
        ax, own = panels(ax, shape, "one for each number, or one for all", sharex=False, figsize=(1.0 + 3.4 * len(entries), 3.6))[0], True
    for one, (_, entry, x, v) in zip(np.broadcast_to(ax, len(entries)), entries, strict=True):
        one.plot(x, v, color=colour(len(one.lines)), marker="o", markevery=[0], label=entry)
    alike = {units.get(name) for name in names}
    named = [(name, entry) for name, entry, *_ in entries] if own else [(names[0], names[0] if len(names) == 1 else "q")]
    for one, (name, whose) in zip(np.ravel(ax), named, strict=True):
        unit, time = units.get(name) if own or len(alike) == 1 else None, units.get("t")
        one.set_xlabel(label(whose, {whose: unit} if unit else None))
        one.set_ylabel(label(f"d{whose}/dt", {f"d{whose}/dt": f"{unit}/{time}"} if unit and time else None))
    if len(entries) > 1 and not own:
        legend_beside(ax)
    return ax


def energy(trajectory: Trajectory, *, units: Units = None, ax: Any = None) -> Any:
    r"""The energy over time, with the work of each term since the start.

    $$ h(t) = \dot q\cdot\frac{\partial L}{\partial\dot q} - L, \qquad h(t) = h(0) + \sum_i W_i(t) $$

    The dashed line is the right side of that balance; it coincides with the energy if the integration is accurate. The work needs
    `simulate(..., works=True)`; without it, the energy is drawn alone. Terms with no visible work, such as fixed constraints, are omitted;
    a curve that coincides with another is dashed, so that both are visible.

    **Arguments:**

    - `trajectory`: one motion, as `simulate` returns it.
    - `units`: units of `"t"` and `"energy"`, written on the axes.
    - `ax`: matplotlib axes to draw in. Default: a new figure.

    **Returns:** the axes.

    **Raises:** `ValueError` for a batch of motions, `ImportError` without matplotlib.

    **Source:** Goldstein, Classical Mechanics, 3rd ed., eqs. 2.53 and 2.63.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    from jaxlag import plot
    from jaxlag.examples import vehicle
    trajectory = jl.simulate(vehicle.system, vehicle.q0, vehicle.qdot0, jnp.linspace(0.0, 5.0, 101), vehicle.params, works=True)
    ax = plot.energy(trajectory, units={"t": "s", "energy": "J"})
    [line.get_label() for line in ax.lines]  # energy, work of air, work of dampers, work of drive, initial energy + work
    ```
    """
    h, ts = np.asarray(one_motion(trajectory).energy()), trajectory.ts
    ax = canvas(ax, figsize=(6.4, 3.6))
    ax.plot(ts, h, color=colour(0), linewidth=2.5, label="energy")
    if trajectory.works is not None:
        for name, work in _shown_works(trajectory).items():
            curve(ax, ts, work, color=colour(len(ax.lines)), label=f"work of {name}")
        ax.plot(ts, h[0] + sum(np.asarray(work) for work in trajectory.works.values()), "k--", label="initial energy + work")
        zero_line(ax)
    units = units_of(trajectory.provenance.units, units)
    ax.set_xlabel(label("t", units))
    ax.set_ylabel(label("energy", units))
    legend_above(ax)
    return ax


def balance(trajectory: Trajectory, *, units: Units = None, ax: Any = None) -> Any:
    r"""The energy balance as stacked areas that sum to zero: above the line where energy went, below it where it came from.

    $$ \Delta h(t) - \sum_i W_i(t) = 0 $$

    The change of energy and the negative work of each term are stacked, positive values upwards and negative ones downwards; at each time
    both stacks have the same height. Terms that brake lie above, terms that drive below; stored energy lies above, energy released since
    the start below. Terms thinner than 1/1000 of the largest are omitted.

    **Arguments:**

    - `trajectory`: one motion, computed by `simulate(..., works=True)`.
    - `units`: units of `"t"` and `"energy"`, written on the axes.
    - `ax`: matplotlib axes to draw in. Default: a new figure.

    **Returns:** the axes.

    **Raises:** `ValueError` if the motion was computed without its work, or for a batch of motions; `ImportError` without matplotlib.

    **Source:** Goldstein, Classical Mechanics, 3rd ed., eqs. 2.52 to 2.58.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    from jaxlag import plot
    from jaxlag.examples import vehicle
    trajectory = jl.simulate(vehicle.system, vehicle.q0, vehicle.qdot0, jnp.linspace(0.0, 5.0, 101), vehicle.params, works=True)
    plot.balance(trajectory, units={"t": "s", "energy": "J"})
    ```
    """
    one_motion(trajectory).work()  # raises if there is none
    h, exchanged = map(np.asarray, energies(trajectory))
    parts = {"change of energy": h - h[0]} | {name: -work for name, work in _shown_works(trajectory).items()}
    ax = canvas(ax, figsize=(6.4, 3.6))
    above = below = np.zeros_like(h)
    for i, (name, part) in enumerate(parts.items()):
        style = {"color": colour(i - 1) if i else GREY, "edgecolor": "white", "linewidth": 0.5}
        up, down = above + np.maximum(part, 0), below + np.minimum(part, 0)
        ax.fill_between(trajectory.ts, above, up, label=name, **style)
        ax.fill_between(trajectory.ts, below, down, **style)
        above, below = up, down
    height = 1.05 * max(np.nanmax(above), -np.nanmin(below), THIN * np.nanmax(np.abs(exchanged)), np.finfo(h.dtype).tiny)
    ax.set_ylim(-height, height)
    ax.set_xlim(float(trajectory.ts[0]), float(trajectory.ts[-1]))
    ax.axhline(0.0, color="black", linewidth=0.8)
    units = units_of(trajectory.provenance.units, units)
    ax.set_xlabel(label("t", units))
    ax.set_ylabel(f"← from    {label('energy', units)}    to →")
    legend_above(ax, 4)
    return ax


def _shown_works(trajectory):
    """The work of each term that is visible relative to the largest change of energy."""
    works = {name: np.asarray(work) for name, work in trajectory.work().items()}
    h, exchanged = map(np.asarray, energies(trajectory))
    sizes = {name: np.nanmax(np.abs(work)) for name, work in works.items()}
    least = THIN * max(*sizes.values(), np.nanmax(np.abs(h - h[0])), THIN * np.nanmax(np.abs(exchanged)))
    return {name: works[name] for name, size in sizes.items() if size > least}
