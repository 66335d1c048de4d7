"""A motion as a moving picture: points and links by position maps, in a notebook or a file."""

import base64
import dataclasses
import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._mechanics.acceleration import constraint_force
from .._model.injection import call
from .._motion.trajectory import Trajectory
from .axes import GREY, Units, canvas, colour, label, one_motion, pyplot

MOST_FRAMES = 2000
BETWEEN = 4  # points of a trail from frame to frame
LONGEST_ARROW = 0.25  # of the diagonal of all points
MARGIN = 0.06
SMALL, FEW = 72, 12.5  # dots per inch and frames per second in a notebook, which stores every frame


def animate(
    trajectory: Trajectory,
    points: Mapping[str, Callable],
    links: Sequence[Any] = (),
    *,
    forces: Mapping[str, str | Sequence[str]] | None = None,
    trail: float | int | None = None,
    fps: float | int = 25,
    speed: float | int = 1.0,
    units: Units = None,
    ax: Any = None,
) -> "Animation":
    r"""A motion as a moving picture in the plane, in real time.

    $$ x_p(t) = x_p(t, q(t)), \qquad F_c \cdot \delta x_p = Q_c \cdot \delta q $$

    Between the samples q is interpolated, as by `Trajectory.at`. The limits are fixed, from the whole motion; a machine that
    travels far is looked at in a frame of its own, by points that leave its travel out.

    **Arguments:**

    - `trajectory`: one motion, as `simulate` returns it.
    - `points`: position maps (x, y) by name, functions of the arguments they name, of `t`, `q`, `qdot`, `params` and its entries.
    - `links`: pairs to be joined by a line, of names of points or of places that stay, `("bob", (0.0, 0.0))`.
    - `forces`: constraint forces to be drawn as arrows: by the name of the constraint the name of the point it acts on, or of all such
      points, `{"rod": ("a", "b")}` for one that pulls two bodies together; the forces are `constraint_force(..., at=points)`. The
      largest of each is written beside its name; all arrows have one scale.
    - `trail`: for how long the path of the points stays in sight, in units of time; `math.inf` keeps all of it.
    - `fps`: frames per second. `speed`: units of time shown per second, 1 for real time, 0.1 for ten times slower.
    - `units`: units of `"t"`, of `"x"` for both axes, and of forces by the name of the constraint.
    - `ax`: matplotlib axes to draw in. Default: those of a new figure.

    **Returns:** an object that a notebook shows, with buttons; `.save("motion.gif")`, `.save("motion.mp4")` (needs ffmpeg) and
    `.save("motion.html")` write a file; `.frames` is their number, `.ax` the axes. A notebook stores each frame it shows, of some 4 kB,
    and so gets no more than 12.5 of them per second.

    **Raises:** `ValueError` where `points`, `links` or `forces` do not fit together, or `fps` and `speed` make fewer than 2 or more than
    2000 frames; `ImportError` without matplotlib.

    **Source:** Goldstein, Classical Mechanics, 3rd ed., eq. 1.49 (the force on a point).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    from jaxlag.examples import pendulum
    start = pendulum.cartesian_state(2.0, 0.0, 1.0)
    trajectory = jl.simulate(pendulum.cartesian, *start, jnp.linspace(0.0, 2.0, 101), pendulum.params)
    bob = lambda q: (q["x"], q["y"])
    moving = jl.animate(trajectory, {"bob": bob}, [((0.0, 0.0), "bob")], forces={"rod": "bob"}, units={"x": "m", "rod": "N"})
    moving.frames  # 51
    ```
    """
    motion, links = _reached(one_motion(trajectory)), tuple(links)
    acting = {name: (on,) if isinstance(on, str) else tuple(on) for name, on in (forces or {}).items()}
    _check_names(motion, points, links, acting)
    at = _frame_times(np.asarray(motion.ts), fps, speed)
    tracks = {name: _track(motion, at, name, point) for name, point in points.items()}
    arrows = {name: _forces(motion, at, name, {point: points[point] for point in on}) for name, on in acting.items()}
    picture = _Picture.of(at, tracks, links, arrows, trail, units, ax)
    return Animation(picture.ax, at.size, fps, picture.draw)


@dataclasses.dataclass(frozen=True, repr=False)
class Animation:
    """A moving picture, drawn when it is shown or saved."""

    ax: Any
    frames: int
    fps: float | int
    draw: Callable[[int], Any]

    def save(self, file: str | Path, *, dpi: float | int = 100) -> None:
        """Writes a GIF, an MP4 (which needs ffmpeg) or an HTML file with buttons, by the ending of its name."""
        from matplotlib import animation

        ending = Path(file).suffix.lower()
        if ending == ".html":
            Path(file).write_text(self._html(dpi), encoding="utf-8")
            return
        if ending not in (".gif", ".mp4"):
            raise ValueError(f"`file` must end with .gif, .mp4 or .html, but is {str(file)!r}. Rename it.")
        if ending == ".mp4" and not animation.FFMpegWriter.isAvailable():
            raise RuntimeError("an .mp4 must be written by ffmpeg, but it is not installed. Install it, or save a .gif.")
        writer = animation.PillowWriter if ending == ".gif" else animation.FFMpegWriter
        self._animated(animation).save(file, writer=writer(fps=self.fps), dpi=dpi)  # type: ignore[arg-type]

    def _repr_html_(self) -> str:
        return self._html(SMALL, stride=math.ceil(self.fps / FEW))

    def _html(self, dpi, stride=1):
        from matplotlib import animation

        with pyplot().rc_context({"savefig.dpi": dpi, "animation.embed_limit": 1000}):
            page = self._animated(animation, stride).to_jshtml(fps=self.fps / stride, default_mode="loop")
        return re.sub(r'(?<=data:image/png;base64,)[^"]+', _fewer_colours, page)

    def _animated(self, animation, stride=1):
        frames = range(0, self.frames, stride)
        return animation.FuncAnimation(
            self.ax.figure, self.draw, frames, init_func=lambda: None, interval=1000 * stride / self.fps, cache_frame_data=False
        )

    def __repr__(self) -> str:
        return f"Animation({self.frames} frames, {self.frames / self.fps:.3g} s)"


@dataclasses.dataclass(frozen=True)
class _Picture:
    """The axes with what moves in them, and where it is in each frame."""

    ax: Any
    at: np.ndarray
    tracks: dict[str, np.ndarray]  # (BETWEEN · frames, 2)
    links: tuple
    arrows: dict[str, dict[str, np.ndarray]]  # by constraint and point, (frames, 2)
    trail: float | int | None
    unit: str
    paths: list
    lines: list
    dots: list
    quivers: dict[tuple[str, str], Any]

    @classmethod
    def of(cls, at, tracks, links, arrows, trail, units, ax) -> "_Picture":
        """Everything laid out once; the frames move it alone."""
        fixed = [np.asarray(end, float) for link in links for end in link if not isinstance(end, str)]
        arrows, largest, lower, upper = _scaled(tracks, fixed, arrows)
        mine, size = ax is None, upper - lower
        ax = _alone(size[1] / size[0]) if mine else ax
        ax.set(
            aspect="equal", xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), xlabel=label("x", units), ylabel=label("y", units, "x")
        )
        paths = [ax.plot([], [], color=colour(i), alpha=0.5, linewidth=1.2)[0] for i in range(len(tracks))]
        lines = [ax.plot([], [], color=GREY, linewidth=2.5, solid_capstyle="round")[0] for _ in links]
        for x, y in fixed:
            ax.plot(x, y, "s", color="black", markersize=6)
        dots = [ax.plot([], [], "o", color=colour(i), markersize=9)[0] for i in range(len(tracks))]
        quivers = {}
        for i, (name, on) in enumerate(arrows.items()):
            of_all = f"{name}, up to {largest[name]:.3g} {(units or {}).get(name, '')}".rstrip()
            for said, point in zip((of_all, *(None,) * len(on)), on, strict=False):
                shaft = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "width": 0.008, "zorder": 3}
                quivers[name, point] = ax.quiver([0.0], [0.0], [0.0], [0.0], color=colour(len(tracks) + i), label=said, **shaft)
        if quivers:
            ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), fontsize="small", frameon=False, borderpad=0)
        picture = cls(ax, at, tracks, links, arrows, trail, (units or {}).get("t", ""), paths, lines, dots, quivers)
        picture.draw(0)
        if mine:  # laid out once, so that nothing trembles
            ax.figure.draw_without_rendering()
            ax.figure.set_layout_engine("none")
        return picture

    def draw(self, i: int) -> list:
        """Moves all to frame i."""
        now = BETWEEN * i
        place = lambda end: self.tracks[end][now] if isinstance(end, str) else end
        for line, link in zip(self.lines, self.links, strict=True):
            line.set_data(*zip(*map(place, link), strict=True))
        step = self.at[1] - self.at[0]
        since = max(0, now - int(min(BETWEEN * (self.trail or 0) / step, now)))
        for dot, path, track in zip(self.dots, self.paths, self.tracks.values(), strict=True):
            dot.set_data(*track[now][:, None])
            path.set_data(*track[since : now + 1].T)
        for (name, point), quiver in self.quivers.items():
            quiver.set_offsets(place(point))
            quiver.set_UVC(*self.arrows[name][point][i])
        digits = max(0, int(np.ceil(-np.log10(step))))
        self.ax.set_title(f"t = {self.at[i]:.{digits}f} {self.unit}".rstrip(), loc="left", fontsize="medium")
        return [*self.paths, *self.lines, *self.dots, *self.quivers.values()]


def _scaled(tracks, fixed, arrows):
    """The forces in lengths of the picture; the largest of each; and the corners of what is to be seen."""
    seen = np.concatenate([*tracks.values(), *(end[None] for end in fixed)])
    length = np.linalg.norm(np.ptp(seen, axis=0)) or 1.0
    largest = {name: max(np.max(np.linalg.norm(F, axis=1)) for F in on.values()) for name, on in arrows.items()}
    scale = LONGEST_ARROW * length / (max(largest.values(), default=1.0) or 1.0)
    arrows = {name: {point: scale * F for point, F in on.items()} for name, on in arrows.items()}
    tips = [tracks[point][::BETWEEN] + F for on in arrows.values() for point, F in on.items()]
    seen = np.concatenate([seen, *tips])
    return arrows, largest, seen.min(axis=0) - MARGIN * length, seen.max(axis=0) + MARGIN * length


def _fewer_colours(match):
    """A picture in base64 that takes a third of the room, for want of shades."""
    from PIL import Image  # which matplotlib needs as well

    small = io.BytesIO()
    picture = Image.open(io.BytesIO(base64.b64decode(match[0].replace("\\\n", "")))).convert("RGB")
    picture.quantize(64, Image.Quantize.FASTOCTREE).save(small, "PNG", optimize=True)
    return base64.b64encode(small.getvalue()).decode()


def _alone(ratio):
    """The axes of a figure that no notebook shows by itself as well."""
    ax = canvas(None, figsize=(4.8, 1.0 + 4.2 * float(np.clip(ratio, 0.25, 1.3))))
    pyplot().close(ax.figure)
    return ax


def _check_names(motion, points, links, forces):
    if not points:
        raise ValueError(
            "`points` must name at least one point, but is empty. Give position maps, e.g. `{'bob': lambda q: (q['x'], q['y'])}`."
        )
    there = ", ".join(points)
    for link in links:
        if isinstance(link, str) or len(link) != 2:
            raise ValueError(f"`links` must be pairs, but hold {link!r}. Give the two ends of each line, `('a', 'b')`.")
        for end in link:
            if end not in points if isinstance(end, str) else np.shape(end) != (2,):
                raise ValueError(f"`links` must join points or places (x, y), but one ends at {end!r}. The points are {there}.")
    for name, on in forces.items():
        if name not in motion.multipliers:
            known = ", ".join(motion.multipliers) or "none"
            raise ValueError(f"`forces` must be of constraints of the system, but {name!r} is not. There are {known}.")
        for point in on:
            if point not in points:
                raise ValueError(f"`forces` must act on points, but {name!r} is to act on {point!r}. The points are {there}.")


def _reached(motion):
    """The part of a motion that was computed."""
    first = np.asarray(jax.tree.leaves(motion.q)[0]).reshape(motion.ts.size, -1)[:, 0]
    count = int(np.sum(np.isfinite(first)))
    if count < 2:
        raise ValueError(f"`trajectory` must have at least two samples, but only {count} were computed. Look at `trajectory.result`.")
    return motion[:count]


def _frame_times(ts, fps, speed):
    """Even times, one for each frame."""
    count = int(np.floor((ts[-1] - ts[0]) * fps / speed + 1e-9)) + 1
    if not 2 <= count <= MOST_FRAMES:
        raise ValueError(
            f"`fps` and `speed` must give 2 to {MOST_FRAMES} frames, but this motion of {ts[-1] - ts[0]:g} gives {count}. "
            f"Choose `speed`, now {speed:g}: what passes in a second."
        )
    return ts[0] + np.arange(count) * speed / fps


def _track(motion, at, name, point):
    """Where a point is in each frame, and at times between two of them."""
    fine = np.minimum(np.linspace(at[0], at[-1], BETWEEN * (at.size - 1) + 1), motion.ts[-1])
    state = motion.at(fine)
    place = lambda t, q, qdot: ravel_pytree(call(point, f"`points` {name!r}", motion.stated.params, t=t, q=q, qdot=qdot))[0]
    x = np.asarray(jax.jit(jax.vmap(place))(state.ts, state.q, state.qdot))
    if x.shape[1] != 2:
        raise ValueError(f"`points` {name!r} must return a position (x, y), but returned {x.shape[1]} numbers. Return the two to be seen.")
    return x


def _forces(motion, at, name, on):
    """The forces of a constraint on its points in each frame, from those at the samples."""
    system, params, ts = motion.stated.system, motion.stated.params, np.asarray(motion.ts)
    together = lambda t, q, params: [ravel_pytree(call(x, f"`points` {point!r}", params, t=t, q=q))[0] for point, x in on.items()]
    force = lambda t, q, qdot: jnp.stack(constraint_force(system, q, qdot, params, t=t, at=together)[name])
    F = np.asarray(jax.jit(jax.vmap(force))(motion.ts, motion.q, motion.qdot))
    known = np.all(np.isfinite(F), axis=(1, 2))
    if 2 * np.sum(known) < ts.size:
        raise ValueError(
            f"`forces` must name all points that a constraint acts through, but {name!r} acts not through {', '.join(on)} alone. "
            "Name the points at both of its ends."
        )
    return {point: np.stack([np.interp(at, ts[known], component) for component in F[known, k].T], axis=1) for k, point in enumerate(on)}
