"""Pictures of the forces during one motion: constraint forces and dry friction."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from .._motion.trajectory import Trajectory
from .axes import (
    COLOURS,
    GREY,
    Units,
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


def forces(trajectory: Trajectory, names: Sequence[str] | None = None, *, units: Units = None, axes: Any = None) -> Any:
    r"""The multipliers λ over time, one panel for each constraint, with a ring wherever one changes sign.

    For a constraint that is `one_sided` in `System`, the times at which it would have to pull are shaded; for a contact, the times at which
    it is closed, and the impulses of its impacts are stems on a second axis, on the right.

    $$ M\ddot q = f + G^T\lambda $$

    λ > 0 pushes along +∇g: the tension of a rod or a string with g = r − l is −λ, so it goes slack where λ becomes positive. A multiplier
    is a force if g is a length, and a torque if g is an angle.

    **Arguments:**

    - `trajectory`: one motion, as `simulate` returns it.
    - `names`: the constraints to draw, in this order. Default: all.
    - `units`: units by name of constraint, and of `"t"`, written on the axes, e.g. `{"t": "s", "rod": "N"}`; those of impulses follow.
    - `axes`: matplotlib axes to draw in, as many as there are constraints. Default: a new figure with a common time axis.

    **Returns:** the axes, an array of shape (constraints,).

    **Raises:** `ValueError` if there are no constraints, if `names` or `axes` do not match them, or for a batch of motions; `ImportError`
    without matplotlib.

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
            "`trajectory` must be of a system with constraints, but it has none. State them with `System(..., holonomic=...)`, "
            "or draw its coordinates with `plot.motion`."
        )
    units = units_of(trajectory.provenance.units, units)
    drawn, shown = over_time(trajectory, multipliers, names, "constraint", units, axes, prefix="λ ")
    pulling = channels(trajectory.pulling(), "λ")
    for ax, (name, entries) in zip(drawn, shown.items(), strict=True):
        zero_line(ax)
        pulled = [x for row in pulling.get(name, {}).values() for x in _intervals(np.asarray(trajectory.ts), row)]
        for i, interval in enumerate(pulled):
            ax.axvspan(*interval, color=COLOURS[1], alpha=0.25, linewidth=0, label=None if i else "would have to pull")
        crossings = np.concatenate([_sign_changes(np.asarray(trajectory.ts), samples) for samples in entries.values()])
        if crossings.size:
            ax.plot(crossings, 0 * crossings, "o", markerfacecolor="white", markeredgecolor="black", label="λ changes sign")
        touches = name in trajectory.contacts and _contact(ax, trajectory, name, units)
        if crossings.size or pulled or touches:
            if len(entries) == 1:
                ax.lines[0].set_label(None)
            if len(entries) == 1 or touches:  # on the right there are the impulses
                legend_above(ax)
            else:
                legend_beside(ax)
    return drawn


def friction(trajectory: Trajectory, names: Sequence[str] | None = None, *, units: Units = None, axes: Any = None) -> Any:
    r"""Dry friction over time: the slip velocity, and the force below it, one column for each term; times of sticking are shaded.

    $$ F = -\mu N\,\frac{s}{|s|} \ (s \neq 0), \qquad |F| \le \mu N \ (s = 0) $$

    **Arguments:**

    - `trajectory`: one motion with dry friction, as `simulate` returns it.
    - `names`: the dissipation terms to draw. Default: all with dry friction.
    - `units`: units of `"t"`, of `"slip"`, and of the force by the name of the term, e.g. `{"t": "s", "slip": "m/s", "brake": "N"}`.
    - `axes`: matplotlib axes to draw in, 2 × number of terms. Default: a new figure with a common time axis.

    **Returns:** the axes, an array of shape (2, terms).

    **Raises:** `ValueError` if there is no dry friction, if `names` or `axes` do not match it, or for a batch of motions; `ImportError`
    without matplotlib.

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
            "`trajectory` must have dry friction that sticks and slips, but has none. Write it as a nonsmooth term, e.g. "
            "`F * jnp.abs(qdot)`, and simulate with `friction=StickSlip()`, which is the default."
        )
    units = units_of(trajectory.provenance.units, units)
    names = chosen(names, tuple(trajectory.friction), "dissipation terms with dry friction")
    slip = channels(trajectory.slip(), "")
    force = channels({name: rubbing.force for name, rubbing in trajectory.friction.items()}, "")
    drawn = panels(axes, (2, len(names)), "two for each term", figsize=(max(6.4, 4.2 * len(names)), 4.6))
    for (upper, lower), name in zip(drawn.T, names, strict=True):
        for ax, entries in ((upper, slip[name]), (lower, force[name])):
            zero_line(ax)
            for i, (entry, samples) in enumerate(entries.items()):
                curve(ax, trajectory.ts, samples, color=colour(i), label=entry)
            stuck = np.reshape(trajectory.friction[name].sticking, (trajectory.ts.size, -1)).T
            intervals = [interval for row in stuck for interval in _intervals(np.asarray(trajectory.ts), row)]
            for i, (start, end) in enumerate(intervals):
                ax.axvspan(start, end, color=GREY, alpha=0.35 / len(stuck), linewidth=0, label=None if i else "sticks")
        upper.set_ylabel(label(f"slip {name}", units, "slip"))
        lower.set_ylabel(label(f"force {name}", units, name))
        lower.set_xlabel(label("t", units))
        has_several = len(slip[name]) > 1
        if not has_several:
            upper.lines[-1].set_label(None)
        if has_several or intervals:
            legend_above(upper)
    return drawn


def _contact(ax, trajectory, name, units):
    """Shades the times at which a contact is closed and draws the impulses of its impacts; returns whether there are any."""
    ts = np.asarray(trajectory.ts)
    contact = jax.tree.map(lambda x: np.reshape(x, (ts.size, -1)).T, trajectory.contacts[name])  # gap by gap
    closed = [interval for of_gap in contact.closed for interval in _intervals(ts, of_gap)]
    for i, interval in enumerate(closed):
        ax.axvspan(*interval, color=GREY, alpha=0.35 / len(contact.closed), linewidth=0, label=None if i else "closed")
    impulses, changed = np.diff(contact.impulse), contact.changed[:, 1:]
    struck, (before, behind) = impulses > 0, (np.broadcast_to(of, changed.shape) for of in (ts[:-1], ts[1:]))
    times = np.where((changed > before) & (changed <= behind), changed, behind)[struck]
    if times.size:
        (low, high), top, right = ax.get_ylim(), 1.1 * np.max(impulses[struck]), ax.twinx()
        right.vlines(times, 0, impulses[struck], color=COLOURS[1])
        right.plot(times, impulses[struck], "o", markersize=4, color=COLOURS[1])
        ax.plot([], [], "-o", markersize=4, color=COLOURS[1], label="impulse")
        right.set_ylim(top * min(low / high, 0) if high > 0 else 0, top)
        unit, time = units.get(name), units.get("t")
        right.set_ylabel(label(f"Λ {name}", {f"Λ {name}": f"{unit} {time}"} if unit and time else None))
    return bool(closed) or bool(times.size)


def _sign_changes(ts, samples):
    """The times at which the linear interpolation crosses zero."""
    before, after = samples[:-1], samples[1:]
    at = np.flatnonzero(before * after < 0)
    return ts[at] + (ts[at + 1] - ts[at]) * before[at] / (before[at] - after[at])


def _intervals(ts, is_true):
    """Start and end of each run of true samples, half a sample wider on either side."""
    edges = np.concatenate([ts[:1], (ts[1:] + ts[:-1]) / 2, ts[-1:]])
    steps = np.diff(np.concatenate([[0], np.asarray(is_true, int), [0]]))
    return list(zip(edges[np.flatnonzero(steps == 1)], edges[np.flatnonzero(steps == -1)], strict=True))
