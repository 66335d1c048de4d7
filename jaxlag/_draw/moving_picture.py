"""Points, links and arrows on fixed axes, moved from frame to frame."""

import dataclasses
from typing import Any

import numpy as np

from .axes import GREY, Units, canvas, colour, label, pyplot

POINTS_PER_FRAME = 4  # of a trail
LONGEST_ARROW = 0.25  # of the diagonal of all points
MARGIN = 0.06


@dataclasses.dataclass(frozen=True)
class MovingPicture:
    """The axes, the lines and arrows on them, and their positions in each frame."""

    ax: Any
    at: np.ndarray
    tracks: dict[str, np.ndarray]  # (POINTS_PER_FRAME · frames, 2)
    links: tuple
    arrows: dict[str, dict[str, np.ndarray]]  # by constraint and point, (frames, 2)
    trail: float | int | None
    unit: str
    title: str | None  # in place of the time
    paths: list
    lines: list
    dots: list
    quivers: dict[tuple[str, str], Any]

    @classmethod
    def of(
        cls,
        at: np.ndarray,
        tracks: dict[str, np.ndarray],
        links: tuple,
        forces: dict[str, dict[str, np.ndarray]],
        trail: float | int | None,
        units: Units,
        ax: Any,
        title: str | None = None,
    ) -> "MovingPicture":
        """Lays out the picture once, so that frames only move its contents."""
        fixed = [np.asarray(end, float) for link in links for end in link if not isinstance(end, str)]
        arrows, largest, lower, upper = _scaled(tracks, fixed, forces)
        is_own, size = ax is None, upper - lower
        ax = _detached_axes(size[1] / size[0]) if is_own else ax
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
            text = f"{name}, up to {largest[name]:.3g} {(units or {}).get(name, '')}".rstrip()
            for entry, point in zip((text, *(None,) * len(on)), on, strict=False):
                style = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "width": 0.008, "zorder": 3}
                quivers[name, point] = ax.quiver([0.0], [0.0], [0.0], [0.0], color=colour(len(tracks) + i), label=entry, **style)
        if quivers:
            ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), fontsize="small", frameon=False, borderpad=0)
        picture = cls(ax, at, tracks, links, arrows, trail, (units or {}).get("t", ""), title, paths, lines, dots, quivers)
        picture.draw(0)
        if is_own:  # laid out once, so that the axes do not jitter
            ax.figure.draw_without_rendering()
            ax.figure.set_layout_engine("none")
        return picture

    def draw(self, i: int) -> list:
        """Moves everything to frame i."""
        now = POINTS_PER_FRAME * i
        position = lambda end: self.tracks[end][now] if isinstance(end, str) else end
        for line, link in zip(self.lines, self.links, strict=True):
            line.set_data(*zip(*map(position, link), strict=True))
        step = self.at[1] - self.at[0]
        since = max(0, now - int(min(POINTS_PER_FRAME * (self.trail or 0) / step, now)))
        for dot, path, track in zip(self.dots, self.paths, self.tracks.values(), strict=True):
            dot.set_data(*track[now][:, None])
            path.set_data(*track[since : now + 1].T)
        for (name, point), quiver in self.quivers.items():
            quiver.set_offsets(position(point))
            quiver.set_UVC(*self.arrows[name][point][i])
        digits = max(0, int(np.ceil(-np.log10(step))))
        time = f"t = {self.at[i]:.{digits}f} {self.unit}".rstrip()
        self.ax.set_title(time if self.title is None else self.title, loc="left", fontsize="medium")
        return [*self.paths, *self.lines, *self.dots, *self.quivers.values()]


def _scaled(tracks, fixed, forces):
    """The forces as arrows in the picture's units of length, the largest force of each constraint, and the corners of the picture."""
    visible = np.concatenate([*tracks.values(), *(end[None] for end in fixed)])
    length = np.linalg.norm(np.ptp(visible, axis=0)) or 1.0
    largest = {name: max(np.max(np.linalg.norm(F, axis=1)) for F in on.values()) for name, on in forces.items()}
    scale = LONGEST_ARROW * length / (max(largest.values(), default=1.0) or 1.0)
    arrows = {name: {point: scale * F for point, F in on.items()} for name, on in forces.items()}
    tips = [tracks[point][::POINTS_PER_FRAME] + F for on in arrows.values() for point, F in on.items()]
    visible = np.concatenate([visible, *tips])
    return arrows, largest, visible.min(axis=0) - MARGIN * length, visible.max(axis=0) + MARGIN * length


def _detached_axes(ratio):
    """The axes of a new figure that a notebook does not show on its own."""
    ax = canvas(None, figsize=(4.8, 1.0 + 4.2 * float(np.clip(ratio, 0.25, 1.3))))
    pyplot().close(ax.figure)
    return ax
