"""Pictures of motions, fits and equations. Matplotlib is imported when the first one is drawn; no function shows or keeps a figure."""

from typing import Any

import numpy as np

from ._draw.axes import COLOURS as COLOURS
from ._draw.axes import pyplot
from ._draw.fit import convergence, fit, parameters
from ._draw.forces import forces, friction
from ._draw.motion import balance, energy, motion, phase
from ._paper.equations import Equations

__all__ = ["balance", "convergence", "energy", "equations", "fit", "forces", "friction", "motion", "parameters", "phase"]


def equations(on_paper: Equations, *, ax: Any = None) -> Any:
    r"""The equations of motion of a system, typeset, to be kept as a picture.

    $$ M\ddot q = f + G^T\lambda $$

    **Arguments:**

    - `on_paper`: what `jaxlag.equations` returned.
    - `ax`: matplotlib axes to write in. Default: a new figure of the right size.

    **Returns:** the axes.

    **Raises:** `ImportError` without matplotlib; `ValueError` where matplotlib cannot typeset an equation, as one with cases.

    **Source:** matplotlib's mathtext, which needs no TeX.

    ```python
    import jaxlag as jl
    from jaxlag import plot
    from jaxlag.examples import pendulum
    plot.equations(jl.equations(pendulum.polar, {"r", "phi"}, {"m", "l", "g"}))
    ```
    """
    _, *rows, _ = on_paper.latex().replace(r"\frac", r"\dfrac").replace(" \\\\\n", "\n").split("\n")
    given = ax is not None
    ax = ax if given else pyplot().figure().add_axes((0.0, 0.0, 1.0, 1.0))
    ax.set_axis_off()
    ax.set_ylim(len(rows), 0)
    written = [
        ax.text(0.0, i + 0.5, f"  ${row.replace(' &= ', ' = ')}$  ", fontsize=16, verticalalignment="center", math_fontfamily="cm")
        for i, row in enumerate(rows)
    ]
    if not given:
        sizes = np.array([text.get_window_extent().size for text in written]) / ax.figure.dpi
        ax.figure.set_size_inches(sizes[:, 0].max(), 1.4 * len(rows) * sizes[:, 1].max())
    return ax
