"""A motion or a mode as a moving picture: points and links by position maps, constraint forces as arrows."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._linear.modes import Modes
from .._mechanics.acceleration import constraint_force
from .._model.injection import call
from .._motion.trajectory import Trajectory
from .animation import Animation
from .axes import Units, one_motion, units_of
from .mode_on_points import ModesOnPoints, as_many, draw_at_rest, titles, units_of_modes
from .moving_picture import POINTS_PER_FRAME, MovingPicture

MOST_FRAMES = 2000
PERIOD = 2.0  # seconds for which a mode is shown


def animate(
    trajectory: Trajectory | Modes,
    points: Mapping[str, Callable],
    links: Sequence[Any] = (),
    *,
    forces: Mapping[str, str | Sequence[str]] | None = None,
    amplitude: float | None = None,
    trail: float | int | None = None,
    fps: float | int = 25,
    speed: float | int | None = None,
    units: Units = None,
    ax: Any = None,
) -> Animation:
    r"""A motion as a moving picture in the plane, in real time; or a mode, over one period.

    $$ x_p(t) = x_p(t, q(t)), \qquad F_c \cdot \delta x_p = Q_c \cdot \delta q, \qquad
       x_p(t) = x_p(q_0) + \mathrm{Re}\,\Big(a\,\frac{\partial x_p}{\partial q}\,\hat q\,e^{i\,\mathrm{Im}\,\lambda\,t}\Big) $$

    Between the samples q is interpolated, as by `Trajectory.at`. The whole motion sets the limits of the axes; to show a machine that
    travels far, give points relative to a frame that moves with it. A mode is shown to first order, with its phases but without its decay,
    over a faint picture of the mechanism at rest; a mode that does not oscillate swings to and fro. `plot.mode_shapes` draws several modes
    as still pictures.

    **Arguments:**

    - `trajectory`: one motion, as `simulate` returns it, or one mode, `near.modes()[0]` of what `linearise` returns.
    - `points`: position maps by name; each returns (x, y), two numbers, from any of the arguments `t`, `q`, `qdot`, `params` and its
      entries, which it names.
    - `links`: pairs joined by a line, each end the name of a point or a fixed position, `("bob", (0.0, 0.0))`.
    - `forces`: constraint forces drawn as arrows: maps the name of a constraint to the point it acts on, or to all such points, e.g.
      `{"rod": ("a", "b")}` for a rod between two bodies. The forces are `constraint_force(..., at=points)`. The largest of each is shown
      next to its name; all arrows share one scale. Not available for a mode.
    - `amplitude`: for a mode, the displacement of the point that moves most. Default: 10 % of the size of the mechanism.
    - `trail`: for how long the path of the points remains visible, in units of time; `math.inf` keeps all of it.
    - `fps`: frames per second. `speed`: units of time shown per second, 1 for real time, 0.1 for ten times slower. Default: 1; for a mode,
      one period in two seconds.
    - `units`: units of `"t"`, of `"x"` for both axes, and of forces by the name of the constraint.
    - `ax`: matplotlib axes to draw in. Default: those of a new figure.

    **Returns:** an `Animation`, which a notebook shows with buttons; `.save("motion.gif")`, `.save("motion.mp4")` (needs ffmpeg) and
    `.save("motion.html")` write a file; `.frames` is the number of frames, `.ax` the axes. A notebook stores every frame, about 4 kB each,
    so it shows at most 12.5 per second.

    **Raises:** `ValueError` if `points`, `links` or `forces` do not match each other or the system, if `fps` and `speed` give fewer than 2
    or more than 2000 frames, if fewer than 2 samples were computed, or if it is not one motion or one mode; `ImportError` without
    matplotlib.

    **Source:** Goldstein, Classical Mechanics, 3rd ed., eq. 1.49 (the force on a point) and section 6.3 (modes).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    from jaxlag import plot
    from jaxlag.examples import pendulum
    start = pendulum.cartesian_state(2.0, 0.0, 1.0)
    trajectory = jl.simulate(pendulum.cartesian, *start, jnp.linspace(0.0, 2.0, 101), pendulum.params)
    bob = lambda q: (q["x"], q["y"])
    moving = plot.animate(trajectory, {"bob": bob}, [((0.0, 0.0), "bob")], forces={"rod": "bob"}, units={"x": "m", "rod": "N"})
    moving.frames  # 51
    ```
    """
    links = tuple(links)
    acting = {name: (on,) if isinstance(on, str) else tuple(on) for name, on in (forces or {}).items()}
    if isinstance(trajectory, Modes):
        if acting:
            raise ValueError(f"`forces` must be those of a motion, but {', '.join(acting)} is to be drawn on a mode. Leave it out.")
        check_names((), points, links, {})
        return _mode(trajectory, points, links, amplitude, trail, fps, speed, units, ax)
    if amplitude is not None:
        raise ValueError(f"`amplitude` must be left out for a motion, which has its own, but is {amplitude:g}. Leave it out.")
    motion = _computed_part(one_motion(trajectory))
    check_names(motion.multipliers, points, links, acting)
    at = _frame_times(np.asarray(motion.ts), fps, 1.0 if speed is None else speed)
    tracks = {name: _track(motion, at, name, point) for name, point in points.items()}
    arrows = {name: _forces(motion, at, name, {point: points[point] for point in on}) for name, on in acting.items()}
    picture = MovingPicture.of(at, tracks, links, arrows, trail, units_of(motion.provenance.units, units), ax)
    return Animation(picture.ax, at.size, fps, picture.draw)


def _mode(
    mode: Modes,
    points: Mapping[str, Callable],
    links: tuple,
    amplitude: float | None,
    trail: float | int | None,
    fps: float | int,
    speed: float | int | None,
    units: Units,
    ax: Any,
) -> Animation:
    """A mode over one period, whose last frame leads to its first."""
    if mode.eigenvalues.ndim:
        raise ValueError(f"`trajectory` must be one mode, but is {mode.eigenvalues.shape} of them. Take one, e.g. `near.modes()[0]`.")
    turning = float(mode.eigenvalues.imag)
    if speed is not None and not turning:
        raise ValueError(f"`speed` must be left out for a mode that does not oscillate, but is {speed:g}. Leave it out.")
    period = 2 * np.pi / abs(turning) if turning else PERIOD
    speed = period / PERIOD if speed is None else speed
    count = _checked(round(period * fps / speed), period, speed)
    modes, units = as_many(mode), units_of_modes(mode, units)
    on_points = ModesOnPoints.of(modes, points, links, amplitude)
    phases = np.arange(POINTS_PER_FRAME * (count - 1) + 1) * 2 * np.pi / (POINTS_PER_FRAME * count)
    (track,) = on_points.at(phases[None] * (np.sign(turning) or 1.0))
    (title,) = titles(modes, units)
    at = np.arange(count) * period / count
    picture = MovingPicture.of(at, on_points.by_name(track), links, {}, trail, units, ax, title)
    draw_at_rest(picture.ax, on_points.by_name(on_points.rest), links)
    return Animation(picture.ax, count, fps, picture.draw)


def check_names(constraints: Collection[str], points: Mapping[str, Callable], links: tuple, forces: Mapping[str, tuple[str, ...]]) -> None:
    """Checks that links and forces refer to points, and forces to constraints."""
    if not points:
        raise ValueError(
            "`points` must name at least one point, but is empty. Give position maps, e.g. `{'bob': lambda q: (q['x'], q['y'])}`."
        )
    known_points = ", ".join(points)
    for link in links:
        if isinstance(link, str) or len(link) != 2:
            raise ValueError(f"`links` must be pairs, but hold {link!r}. Give the two ends of each line, `('a', 'b')`.")
        for end in link:
            if end not in points if isinstance(end, str) else np.shape(end) != (2,):
                raise ValueError(f"`links` must join points or positions (x, y), but one ends at {end!r}. The points are {known_points}.")
    for name, on in forces.items():
        if name not in constraints:
            known = ", ".join(constraints) or "none"
            raise ValueError(f"`forces` must be of constraints of the system, but {name!r} is not. There are {known}.")
        for point in on:
            if point not in points:
                raise ValueError(f"`forces` must act on points, but {name!r} is to act on {point!r}. The points are {known_points}.")


def _computed_part(motion: Trajectory) -> Trajectory:
    """The samples that were computed."""
    first = np.asarray(jax.tree.leaves(motion.q)[0]).reshape(motion.ts.size, -1)[:, 0]
    count = int(np.sum(np.isfinite(first)))
    if count < 2:
        raise ValueError(f"`trajectory` must have at least two samples, but only {count} were computed. Look at `trajectory.result`.")
    return motion[:count]


def _frame_times(ts: np.ndarray, fps: float | int, speed: float | int) -> np.ndarray:
    """The equidistant times of the frames."""
    count = int(np.floor((ts[-1] - ts[0]) * fps / speed + 1e-9)) + 1
    return ts[0] + np.arange(_checked(count, ts[-1] - ts[0], speed)) * speed / fps


def _checked(count: int, length: float, speed: float | int) -> int:
    """The number of frames, if it is sensible."""
    if not 2 <= count <= MOST_FRAMES:
        raise ValueError(
            f"`fps` and `speed` must give 2 to {MOST_FRAMES} frames, but this motion of {length:g} gives {count}. "
            f"Change `speed`, now {speed:g}: the time that passes in one second."
        )
    return count


def _track(motion: Trajectory, at: np.ndarray, name: str, point: Callable) -> np.ndarray:
    """The positions of a point in each frame, and at times between frames."""
    fine = np.minimum(np.linspace(at[0], at[-1], POINTS_PER_FRAME * (at.size - 1) + 1), motion.ts[-1])
    state = motion.at(fine)
    position = lambda t, q, qdot: ravel_pytree(call(point, f"`points` {name!r}", motion.provenance.params, t=t, q=q, qdot=qdot))[0]
    x = np.asarray(jax.jit(jax.vmap(position))(state.ts, state.q, state.qdot))
    if x.shape[1] != 2:
        raise ValueError(f"`points` {name!r} must return a position (x, y), but returned {x.shape[1]} numbers. Return two.")
    known = np.all(np.isfinite(x), axis=1)  # unknown between two impacts within one sample interval
    within = lambda column: np.interp(fine, fine[known], column[known], np.nan, np.nan)
    return x if np.all(known) or not np.any(known) else np.stack([within(column) for column in x.T], axis=1)


def _forces(motion: Trajectory, at: np.ndarray, name: str, on: Mapping[str, Callable]) -> dict[str, np.ndarray]:
    """The forces of a constraint on its points in each frame, interpolated between the samples."""
    system, params, ts = motion.provenance.system, motion.provenance.params, np.asarray(motion.ts)
    positions = lambda t, q, params: [ravel_pytree(call(x, f"`points` {point!r}", params, t=t, q=q))[0] for point, x in on.items()]
    force = lambda t, q, qdot, states: jnp.stack(constraint_force(system, q, qdot, params, t=t, states=states, at=positions)[name])
    F = np.asarray(jax.jit(jax.vmap(force))(motion.ts, motion.q, motion.qdot, motion.states))
    known = np.all(np.isfinite(F), axis=(1, 2))
    if 2 * np.sum(known) < ts.size:
        raise ValueError(
            f"`forces` must name all points that a constraint acts through, but {name!r} does not act through {', '.join(on)} alone. "
            "Name the points at both of its ends."
        )
    return {point: np.stack([np.interp(at, ts[known], component) for component in F[known, k].T], axis=1) for k, point in enumerate(on)}
