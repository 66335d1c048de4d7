"""Pictures of one motion: coordinates, phase portrait, constraint forces, energy, friction."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ._canvas import GREY, Units, canvas, channels, chosen, colour, label, legend_above, legend_beside, one_motion, panels, zero_line
from ._trajectory import Trajectory, energies

THIN = 1e-3  # of the largest area, below which none can be seen


def motion(trajectory: Trajectory, names: Sequence[str] | None = None, *, units: Units = None, axes: Any = None) -> Any:
    r"""The coordinates of a motion over time, one panel each.

    $$ q_i(t), \qquad i = 1 \dots n $$

    A coordinate that is an array has one line for each entry, `r[0]`, `r[1]`, …. Samples that were not reached are left out.

    **Arguments:**

    - `trajectory`: one motion, as `simulate` returns it.
    - `names`: the coordinates to be drawn, in this order, by their path in q (`"phi"`, `"body.x"`, `"q"` where q is one array).
      Default: all.
    - `units`: units by name of coordinate, and of `"t"`, to be written on the axes, e.g. `{"t": "s", "phi": "rad"}`.
    - `axes`: matplotlib axes to draw in, as many as there are coordinates. Default: a new figure with a common time axis.

    **Returns:** the axes, an array of shape (n,).

    **Raises:** `ValueError` where `names` or `axes` do not fit the motion, `ImportError` without matplotlib.

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
    coordinates = channels(one_motion(trajectory).q, "q")
    names = chosen(names, tuple(coordinates), "coordinates")
    return _over_time(trajectory.ts, {name: coordinates[name] for name in names}, names, "one for each coordinate", units, axes)


def phase(trajectory: Trajectory, names: Sequence[str] | None = None, *, units: Units = None, ax: Any = None) -> Any:
    r"""The phase portrait of a motion: velocity over position, with a dot at the start.

    $$ (q_i(t), \dot q_i(t)) $$

    Drawn again on the same axes, another motion has the next colour: so a phase portrait is made of many.

    **Arguments:**

    - `trajectory`: one motion, as `simulate` returns it.
    - `names`: the coordinates to be drawn, by their path in q. Default: all; they share the axes, so choose those of one unit.
    - `units`: units by name of coordinate, and of `"t"`; the velocity has the one divided by the other.
    - `ax`: matplotlib axes to draw in. Default: a new figure.

    **Returns:** the axes.

    **Raises:** `ValueError` where `names` do not fit the motion, `ImportError` without matplotlib.

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
    positions, velocities = (channels(tree, "q") for tree in (one_motion(trajectory).q, trajectory.qdot))
    names = chosen(names, tuple(positions), "coordinates")
    ax = canvas(ax, figsize=(5.4, 4.2))
    entries = [(entry, x, velocities[name][entry]) for name in names for entry, x in positions[name].items()]
    for entry, x, v in entries:
        ax.plot(x, v, color=colour(len(ax.lines)), marker="o", markevery=[0], label=entry)
    whose = names[0] if len(names) == 1 else "q"
    alike = {(units or {}).get(name) for name in names}
    unit, time = alike.pop() if len(alike) == 1 else None, (units or {}).get("t")
    ax.set_xlabel(label(whose, {whose: unit} if unit else None))
    ax.set_ylabel(label(f"d{whose}/dt", {f"d{whose}/dt": f"{unit}/{time}"} if unit and time else None))
    if len(entries) > 1:
        legend_beside(ax)
    return ax


def forces(trajectory: Trajectory, names: Sequence[str] | None = None, *, units: Units = None, axes: Any = None) -> Any:
    r"""The multipliers λ over time, one panel for each constraint, with a ring wherever one changes its sign.

    $$ M\ddot q = f + G^T\lambda $$

    λ > 0 pushes along +∇g: the tension of a rod or a string with g = r − l is −λ, so it goes slack where λ becomes positive. A multiplier
    is a force where g is a length, and a moment where g is an angle.

    **Arguments:**

    - `trajectory`: one motion, as `simulate` returns it.
    - `names`: the constraints to be drawn, in this order. Default: all.
    - `units`: units by name of constraint, and of `"t"`, to be written on the axes, e.g. `{"t": "s", "rod": "N"}`.
    - `axes`: matplotlib axes to draw in, as many as there are constraints. Default: a new figure with a common time axis.

    **Returns:** the axes, an array, one for each constraint.

    **Raises:** `ValueError` where there are no constraints, or `names` or `axes` do not fit them; `ImportError` without matplotlib.

    **Source:** Goldstein, Classical Mechanics, 3rd ed., section 2.4.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    from jaxlag import plot
    from jaxlag.examples import pendulum
    start = pendulum.cartesian_state(2.0, 0.0, 1.0)
    trajectory = jl.simulate(pendulum.cartesian, *start, jnp.linspace(0.0, 2.0, 101), pendulum.params)
    (ax,) = plot.forces(trajectory, units={"t": "s", "rod": "N"})
    ax.get_ylabel()  # λ rod (N)
    ```
    """
    multipliers = channels(one_motion(trajectory).multipliers, "λ")
    if not multipliers:
        raise ValueError(
            "`trajectory` must be of a system with constraints, but it has none. State them by `System(..., holonomic=...)`, "
            "or draw its coordinates by `plot.motion`."
        )
    names = chosen(names, tuple(multipliers), "constraints")
    shown = {name: multipliers[name] for name in names}
    drawn = _over_time(trajectory.ts, shown, [f"λ {name}" for name in names], "one for each constraint", units, axes)
    for ax, entries in zip(drawn, shown.values(), strict=True):
        zero_line(ax)
        crossings = np.concatenate([_sign_changes(np.asarray(trajectory.ts), samples) for samples in entries.values()])
        if crossings.size:
            ax.plot(crossings, 0 * crossings, "o", markerfacecolor="white", markeredgecolor="black", label="λ changes its sign")
            if len(entries) == 1:
                ax.lines[0].set_label(None)
                legend_above(ax)
            else:
                legend_beside(ax)
    return drawn


def energy(trajectory: Trajectory, *, units: Units = None, ax: Any = None) -> Any:
    r"""The energy over time, and beside it the work of each term since the start.

    $$ h(t) = \dot q\cdot\frac{\partial L}{\partial\dot q} - L, \qquad h(t) = h(0) + \sum_i W_i(t) $$

    The dashed line is the right side of that balance: it lies on the energy where the integration is good. Works need
    `simulate(..., audit=True)`; without, the energy is drawn alone. Terms that do no work to be seen, as constraints at rest, are left out.

    **Arguments:**

    - `trajectory`: one motion, as `simulate` returns it.
    - `units`: units of `"t"` and `"energy"`, to be written on the axes.
    - `ax`: matplotlib axes to draw in. Default: a new figure.

    **Returns:** the axes.

    **Raises:** `ValueError` for a batch of motions, `ImportError` without matplotlib.

    **Source:** Goldstein, Classical Mechanics, 3rd ed., eqs. 2.53 and 2.63.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    from jaxlag import plot
    from jaxlag.examples import vehicle
    trajectory = jl.simulate(vehicle.system, vehicle.q0, vehicle.qdot0, jnp.linspace(0.0, 5.0, 101), vehicle.params, audit=True)
    ax = plot.energy(trajectory, units={"t": "s", "energy": "J"})
    [line.get_label() for line in ax.lines]  # energy, work of air, work of dampers, work of drive, energy at the start + works
    ```
    """
    h, ts = np.asarray(one_motion(trajectory).energy()), trajectory.ts
    ax = canvas(ax, figsize=(6.4, 3.6))
    ax.plot(ts, h, color=colour(0), linewidth=2.5, label="energy")
    if trajectory.works is not None:
        for name, work in _shown_works(trajectory).items():
            ax.plot(ts, work, color=colour(len(ax.lines)), label=f"work of {name}")
        ax.plot(ts, h[0] + sum(np.asarray(work) for work in trajectory.works.values()), "k--", label="energy at the start + works")
        zero_line(ax)
    ax.set_xlabel(label("t", units))
    ax.set_ylabel(label("energy", units))
    legend_above(ax)
    return ax


def balance(trajectory: Trajectory, *, units: Units = None, ax: Any = None) -> Any:
    r"""The energy balance as stacked areas that add up to nothing: above the line where energy went to, below it where it came from.

    $$ \Delta h(t) - \sum_i W_i(t) = 0 $$

    The change of energy and the work of each term with its sign turned are stacked, the positive ones upwards and the negative ones
    downwards: at each time both stacks are equally high. What brakes lies above and what drives below; energy that is stored lies
    above, and energy that the motion has given away since the start below. Terms thinner than 1/1000 of the largest are left out.

    **Arguments:**

    - `trajectory`: one motion, computed by `simulate(..., audit=True)`.
    - `units`: units of `"t"` and `"energy"`, to be written on the axes.
    - `ax`: matplotlib axes to draw in. Default: a new figure.

    **Returns:** the axes.

    **Raises:** `ValueError` where the motion was computed without its works, `ImportError` without matplotlib.

    **Source:** Goldstein, Classical Mechanics, 3rd ed., eqs. 2.52 to 2.58.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    from jaxlag import plot
    from jaxlag.examples import vehicle
    trajectory = jl.simulate(vehicle.system, vehicle.q0, vehicle.qdot0, jnp.linspace(0.0, 5.0, 101), vehicle.params, audit=True)
    plot.balance(trajectory, units={"t": "s", "energy": "J"})
    ```
    """
    one_motion(trajectory).work()  # which says what to do where there are none
    h, turned = map(np.asarray, energies(trajectory))
    parts = {"change of energy": h - h[0]} | {name: -work for name, work in _shown_works(trajectory).items()}
    ax = canvas(ax, figsize=(6.4, 3.6))
    above = below = np.zeros_like(h)
    for i, (name, part) in enumerate(parts.items()):
        style = {"color": colour(i - 1) if i else GREY, "edgecolor": "white", "linewidth": 0.5}
        up, down = above + np.maximum(part, 0), below + np.minimum(part, 0)
        ax.fill_between(trajectory.ts, above, up, label=name, **style)
        ax.fill_between(trajectory.ts, below, down, **style)
        above, below = up, down
    height = 1.05 * max(np.nanmax(above), -np.nanmin(below), THIN * np.nanmax(np.abs(turned)), np.finfo(h.dtype).tiny)
    ax.set_ylim(-height, height)
    ax.set_xlim(float(trajectory.ts[0]), float(trajectory.ts[-1]))
    ax.axhline(0.0, color="black", linewidth=0.8)
    ax.set_xlabel(label("t", units))
    ax.set_ylabel(f"← from    {label('energy', units)}    to →")
    legend_above(ax, 4)
    return ax


def friction(trajectory: Trajectory, names: Sequence[str] | None = None, *, units: Units = None, axes: Any = None) -> Any:
    r"""Dry friction over time: the slip velocity and below it the force, one column for each term; where it sticks is shaded.

    $$ F = -\mu N\,\frac{s}{|s|} \ (s \neq 0), \qquad |F| \le \mu N \ (s = 0) $$

    **Arguments:**

    - `trajectory`: one motion with dry friction, as `simulate` returns it.
    - `names`: the dissipation terms to be drawn. Default: all that have a kink.
    - `units`: units of `"t"`, of `"slip"`, and of the force by the name of the term, e.g. `{"t": "s", "slip": "m/s", "brake": "N"}`.
    - `axes`: matplotlib axes to draw in, 2 × number of terms. Default: a new figure with a common time axis.

    **Returns:** the axes, an array of shape (2, terms).

    **Raises:** `ValueError` where there is no dry friction, or `names` or `axes` do not fit it; `ImportError` without matplotlib.

    **Source:** Pfeiffer & Glocker, Multibody Dynamics with Unilateral Contacts, chapter 5.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    from jaxlag import plot
    block = jl.System(lambda q, qdot: 0.5 * qdot**2 - 2.0 * q**2, dissipation={"dry": lambda qdot: 0.3 * jnp.abs(qdot)})
    trajectory = jl.simulate(block, 1.0, 0.0, jnp.linspace(0.0, 14.0, 201))
    plot.friction(trajectory, units={"t": "s", "slip": "m/s", "dry": "N"})
    ```
    """
    if not one_motion(trajectory).friction:
        raise ValueError(
            "`trajectory` must have dry friction that sticks and slips, but has none. Write it with a kink, e.g. `F * jnp.abs(qdot)`, "
            "and simulate with `friction=StickSlip()`, which is the default."
        )
    names = chosen(names, tuple(trajectory.friction), "dissipation terms with dry friction")
    slip = channels(trajectory.slip(), "")
    force = channels({name: rubbing.force for name, rubbing in trajectory.friction.items()}, "")
    drawn = panels(axes, (2, len(names)), "two for each term", figsize=(max(6.4, 4.2 * len(names)), 4.6))
    for (upper, lower), name in zip(drawn.T, names, strict=True):
        for ax, entries in ((upper, slip[name]), (lower, force[name])):
            zero_line(ax)
            for i, (entry, samples) in enumerate(entries.items()):
                ax.plot(trajectory.ts, samples, color=colour(i), label=entry)
            stuck = np.reshape(trajectory.friction[name].sticking, (trajectory.ts.size, -1)).T
            intervals = [interval for row in stuck for interval in _intervals(np.asarray(trajectory.ts), row)]
            for i, (start, end) in enumerate(intervals):
                ax.axvspan(start, end, color=GREY, alpha=0.35 / len(stuck), linewidth=0, label=None if i else "sticks")
        upper.set_ylabel(label(f"slip {name}", units, "slip"))
        lower.set_ylabel(label(f"force {name}", units, name))
        lower.set_xlabel(label("t", units))
        several = len(slip[name]) > 1
        if not several:
            upper.lines[-1].set_label(None)
        if several or intervals:
            legend_above(upper)
    return drawn


def _over_time(ts, quantities, titles, which, units, axes):
    """A panel for each quantity, over a common time axis."""
    drawn = panels(axes, (len(quantities), 1), which, figsize=(6.4, 1.0 + 1.7 * len(quantities)))[:, 0]
    for ax, (name, entries), title in zip(drawn, quantities.items(), titles, strict=True):
        for i, (entry, samples) in enumerate(entries.items()):
            ax.plot(ts, samples, color=colour(i), label=entry)
        ax.set_ylabel(label(title, units, name))
        if len(entries) > 1:
            legend_beside(ax)
    drawn[-1].set_xlabel(label("t", units))
    return drawn


def _sign_changes(ts, samples):
    """The times at which the straight lines between samples cross zero."""
    before, after = samples[:-1], samples[1:]
    at = np.flatnonzero(before * after < 0)
    return ts[at] + (ts[at + 1] - ts[at]) * before[at] / (before[at] - after[at])


def _shown_works(trajectory):
    """The works that can be seen beside the largest change of energy."""
    works = {name: np.asarray(work) for name, work in trajectory.work().items()}
    h, turned = map(np.asarray, energies(trajectory))
    sizes = {name: np.nanmax(np.abs(work)) for name, work in works.items()}
    least = THIN * max(*sizes.values(), np.nanmax(np.abs(h - h[0])), THIN * np.nanmax(np.abs(turned)))
    return {name: works[name] for name, size in sizes.items() if size > least}


def _intervals(ts, sticking):
    """Begin and end of each run of samples that stick, half a sample wider on either side."""
    edges = np.concatenate([ts[:1], (ts[1:] + ts[:-1]) / 2, ts[-1:]])
    steps = np.diff(np.concatenate([[0], np.asarray(sticking, int), [0]]))
    return list(zip(edges[np.flatnonzero(steps == 1)], edges[np.flatnonzero(steps == -1)], strict=True))
