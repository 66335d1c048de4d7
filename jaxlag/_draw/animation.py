"""A moving picture in a notebook or a file."""

import base64
import dataclasses
import io
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .axes import pyplot

NOTEBOOK_DPI, NOTEBOOK_FPS = 72, 12.5  # dots per inch and frames per second in a notebook, which stores every frame


@dataclasses.dataclass(frozen=True, repr=False)
class Animation:
    """A moving picture, drawn when it is shown or saved; a notebook shows it with buttons.

    - `ax`: its matplotlib axes.
    - `frames`: the number of frames; `fps`: frames per second.
    - `draw`: `draw(i)` draws frame `i` on the axes.
    """

    ax: Any
    frames: int
    fps: float | int
    draw: Callable[[int], Any]

    def save(self, file: str | Path, *, dpi: float | int = 100) -> None:
        """Writes a GIF, an MP4 (which needs ffmpeg) or an HTML file with buttons, by the suffix of its name.

        **Arguments:** `file`: its path; `dpi`: dots per inch.

        **Raises:** `ValueError` for another suffix, `RuntimeError` without ffmpeg.
        """
        from matplotlib import animation

        ending = Path(file).suffix.lower()
        if ending == ".html":
            Path(file).write_text(self._html(dpi), encoding="utf-8")
            return
        if ending not in (".gif", ".mp4"):
            raise ValueError(f"`file` must end with .gif, .mp4 or .html, but is {str(file)!r}. Rename it.")
        if ending == ".mp4" and not animation.FFMpegWriter.isAvailable():
            raise RuntimeError(f"`file` must not end with .mp4 without ffmpeg, but is {str(file)!r}. Install ffmpeg, or save a .gif.")
        writer = animation.PillowWriter if ending == ".gif" else animation.FFMpegWriter
        self._animated(animation).save(file, writer=writer(fps=self.fps), dpi=dpi)  # type: ignore[arg-type]

    def _repr_html_(self) -> str:
        return self._html(NOTEBOOK_DPI, stride=math.ceil(self.fps / NOTEBOOK_FPS))

    def _html(self, dpi: float | int, stride: int = 1) -> str:
        from matplotlib import animation

        with pyplot().rc_context({"savefig.dpi": dpi, "animation.embed_limit": 1000}):
            page = self._animated(animation, stride).to_jshtml(fps=self.fps / stride, default_mode="loop")
        return re.sub(r'(?<=data:image/png;base64,)[^"]+', _fewer_colours, page)

    def _animated(self, animation: Any, stride: int = 1) -> Any:
        frames = range(0, self.frames, stride)
        return animation.FuncAnimation(
            self.ax.figure, self.draw, frames, init_func=lambda: None, interval=1000 * stride / self.fps, cache_frame_data=False
        )

    def __repr__(self) -> str:
        return f"Animation({self.frames} frames, {self.frames / self.fps:.3g} s)"


def _fewer_colours(match: re.Match) -> str:
    """A picture in base64 with 64 colours, a third of the size."""
    from PIL import Image  # matplotlib depends on it

    smaller = io.BytesIO()
    picture = Image.open(io.BytesIO(base64.b64decode(match[0].replace("\\\n", "")))).convert("RGB")
    picture.quantize(64, Image.Quantize.FASTOCTREE).save(smaller, "PNG", optimize=True)
    return base64.b64encode(smaller.getvalue()).decode()
