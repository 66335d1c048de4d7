"""Still pictures of mode shapes on the mechanism."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from .._linear.modes import Modes
from .animate import check_names
from .axes import COLOURS, Units, label, panels
from .mode_on_points import ModesOnPoints, as_many, draw_at_rest, titles, units_of_modes
from .moving_picture import MARGIN

CYCLE = 72  # phases of a path; the other extreme is half a cycle later
MOST_COLUMNS = 4


def mode_shapes(
    modes: Modes,
    points: Mapping[str, Callable],
    links: Sequence[Any] = (),
    *,
    amplitude: float | None = None,
    units: Units = None,
    axes: Any = None,
) -> Any:
    r"""Mode shapes drawn on the mechanism, one panel each: at rest (faint), at both extremes (one dashed), and the paths of the points.

    $$ x_p(q_0) + \mathrm{Re}\,\Big(a\,\frac{\partial x_p}{\partial q}\,\hat q\,e^{i\varphi}\Big), \qquad 0 \le \varphi < 2\pi $$

    Displacements are of first order, and so the same in all coordinates; a rod that turns therefore appears to stretch.

    The title gives the natural frequency |λ|/2π and the damping ratio, or λ if the mode does not oscillate. In a complex shape the points
    do not reach their extremes at the same time: they are drawn at the phase at which all together are farthest from rest. `animate` shows
    one mode in motion.

    **Arguments:**

    - `modes`: the result of `linearise(...).modes()` or `lowest_modes`, some of them, e.g. `modes[:3]`, or one.
    - `points`, `links`: as for `animate`: position maps by name, and pairs joined by a line.
    - `amplitude`: in each mode, the displacement of the point that moves most. Default: 10 % of the size of the mechanism.
    - `units`: units of `"x"`, for both axes, and of `"t"`, for the title: with `"s"`, frequencies are in Hz.
    - `axes`: matplotlib axes, one for each mode. Default: those of a new figure.

    **Returns:** the axes, an array of shape (modes,).

    **Raises:** `ValueError` if `points` and `links` do not match each other, if `modes` belong to a trajectory, or if the number of `axes`
    differs; `ImportError` without matplotlib.

    **Source:** Ewins, Modal Testing, 2nd ed., section 2.4 (real and complex modes).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    from jaxlag import plot
    ends = lambda q, l: jnp.cumsum(l * jnp.stack([jnp.sin(q), -jnp.cos(q)], axis=1), axis=0)
    def lagrangian(t, q, qdot, params, m, g):
        return 0.5 * m * jnp.sum(jl.rate(ends)(t, q, qdot, params) ** 2) - m * g * jnp.sum(ends(q, params["l"])[:, 1])
    near = jl.linearise(jl.System(lagrangian), jnp.zeros(2), params={"m": 1.0, "g": 9.81, "l": 0.5})
    points = {"upper": lambda q, l: ends(q, l)[0], "lower": lambda q, l: ends(q, l)[1]}
    links = [((0.0, 0.0), "upper"), ("upper", "lower")]
    slow, fast = plot.mode_shapes(near.modes(), points, links, units={"x": "m", "t": "s"})
    slow.get_title()  # f₀ = 0.5396 Hz, ζ = 0
    ```
    """
    links = tuple(links)
    check_names((), points, links, {})
    modes = modes if modes.eigenvalues.ndim else as_many(modes)
    if modes.eigenvalues.ndim > 1:
        raise ValueError(f"`modes` must be those of one system, but have the shape {modes.eigenvalues.shape}. Take those of one of them.")
    on_points, units = ModesOnPoints.of(modes, points, links, amplitude), units_of_modes(modes, units)
    phases = on_points.extreme_phases()[:, None] + np.linspace(0.0, 2 * np.pi, CYCLE + 1)
    moves = np.any(on_points.displacements, axis=(1, 2))
    cycles, rest = on_points.at(phases), on_points.by_name(on_points.rest)
    fixed = [end for link in links for end in link if not isinstance(end, str)]
    lower, upper = _corners(np.concatenate([cycles.reshape(-1, 2), on_points.rest, np.reshape(fixed, (-1, 2))]))
    drawn, columns = _panels(axes, len(modes), upper - lower)
    for i, (ax, cycle, title) in enumerate(zip(drawn, cycles, titles(modes, units), strict=True)):
        draw_at_rest(ax, rest, links)
        if moves[i]:
            _draw(ax, on_points.by_name(cycle), links)
        for x, y in fixed:
            ax.plot(x, y, "s", color="black", markersize=6)
        ax.set(aspect="equal", xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]))
        ax.set_title(title if moves[i] else f"{title}\nno point moves", fontsize="medium")
        is_left, is_lowest = columns is None or i % columns == 0, columns is None or i + columns >= len(modes)
        ax.tick_params(labelleft=is_left, labelbottom=is_lowest)
        ax.set(xlabel=label("x", units) if is_lowest else "", ylabel=label("y", units, "x") if is_left else "")
    return drawn


def _draw(ax: Any, cycle: Mapping[str, np.ndarray], links: tuple) -> None:
    """The paths of the points, and both extremes."""
    for path in cycle.values():
        ax.plot(*path.T, color=COLOURS[1], linewidth=1.0, zorder=2)
    for at, style, marker in ((CYCLE // 2, (0, (4, 2)), "white"), (0, "-", COLOURS[0])):
        position = lambda end, at=at: cycle[end][at] if isinstance(end, str) else end
        for link in links:
            ax.plot(*zip(*map(position, link), strict=True), color=COLOURS[0], linestyle=style, linewidth=1.8, zorder=3)
        for path in cycle.values():
            ax.plot(*path[at], "o", markerfacecolor=marker, markeredgecolor=COLOURS[0], markersize=6, zorder=4)


def _corners(visible: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    margin = MARGIN * (np.linalg.norm(np.ptp(visible, axis=0)) or 1.0)
    return visible.min(axis=0) - margin, visible.max(axis=0) + margin


def _panels(axes: Any, count: int, size: np.ndarray) -> tuple[Any, int | None]:
    """A panel for each mode, and the number of columns, so that long mechanisms are stacked and tall ones stand side by side; None if
    panels were given.
    """
    if axes is not None:
        return panels(axes, (count, 1), "one for each mode")[:, 0], None
    ratio = float(np.clip(size[1] / size[0], 0.1, 2.0))
    columns = min(count, 1 if ratio < 0.15 else 2 if ratio < 0.7 else MOST_COLUMNS)
    width = 6.4 if columns == 1 and ratio < 0.7 else min(9.0 / columns, 4.2)
    rows = -(-count // columns)
    grid = panels(None, (rows, columns), "", sharex=False, figsize=(0.6 + width * columns, 0.5 + rows * (width * ratio + 0.5))).ravel()
    for ax in grid[count:]:
        ax.remove()
    return grid[:count], columns
