"""Pictures of motions, fits and equations. Matplotlib is imported when the first one is drawn; no function shows or stores a figure.

`motion.plot()` is short for `plot.motion(motion)`, `motion.animate(points)` for `plot.animate(motion, points)`; fits, modes, root loci,
stability maps and equations have their `plot()`, too.
"""

from typing import Any

import numpy as np

from ._curves.equilibrium_curve import EquilibriumCurve
from ._curves.response_curve import ResponseCurve
from ._draw.animate import animate
from ._draw.axes import COLOURS as COLOURS
from ._draw.axes import pyplot
from ._draw.design import design
from ._draw.fit import convergence, fit, parameters
from ._draw.forces import forces, friction
from ._draw.linear import bode, nyquist, root_locus
from ._draw.mode_shapes import mode_shapes
from ._draw.motion import balance, energy, motion, phase
from ._draw.optimal_motion import optimal_motion
from ._draw.posterior import posterior
from ._draw.recovery import recovery
from ._draw.report import report
from ._draw.response_curve import equilibrium_curve, response_curve
from ._draw.stability_map import stability_map
from ._fit.design import Design
from ._fit.posterior import Posterior
from ._fit.recover import Recovery
from ._fit.result import Fit
from ._linear.modes import Modes
from ._linear.root_locus import RootLocus
from ._linear.stability_map import StabilityMap
from ._motion.trajectory import Trajectory
from ._optimal.solution import OptimalMotion
from ._paper.linearised_result import LinearisedEquations
from ._paper.result import Equations

__all__ = [
    "animate",
    "balance",
    "bode",
    "convergence",
    "design",
    "energy",
    "equations",
    "equilibrium_curve",
    "fit",
    "forces",
    "friction",
    "mode_shapes",
    "motion",
    "nyquist",
    "optimal_motion",
    "parameters",
    "phase",
    "posterior",
    "recovery",
    "response_curve",
    "root_locus",
    "stability_map",
]


def equations(on_paper: Equations | LinearisedEquations, *, ax: Any = None) -> Any:
    r"""The equations of motion of a system, typeset as a picture.

    $$ M\ddot q = f + G^T\lambda $$

    **Arguments:**

    - `on_paper`: the result of `jaxlag.equations`.
    - `ax`: matplotlib axes to write in. Default: those of a new figure of the right size.

    **Returns:** the axes.

    **Raises:** `ValueError` if matplotlib cannot typeset an equation, such as one with cases; `ImportError` without matplotlib.

    **Source:** matplotlib's mathtext, which needs no TeX.

    ```python
    import jaxlag as jl
    from jaxlag import plot
    from jaxlag.examples import pendulum
    plot.equations(jl.equations(pendulum.polar, {"r", "phi"}, {"m", "l", "g"}))
    ```
    """
    _, *rows, _ = on_paper.latex().replace(r"\frac", r"\dfrac").replace(" \\\\\n", "\n").split("\n")
    is_own = ax is None
    ax = pyplot().figure().add_axes((0.0, 0.0, 1.0, 1.0)) if is_own else ax
    ax.set_axis_off()
    ax.set_ylim(len(rows), 0)
    texts = [
        ax.text(0.0, i + 0.5, f"  ${row.replace(' &= ', ' = ')}$  ", fontsize=16, verticalalignment="center", math_fontfamily="cm")
        for i, row in enumerate(rows)
    ]
    if is_own:
        sizes = np.array([text.get_window_extent().size for text in texts]) / ax.figure.dpi
        ax.figure.set_size_inches(sizes[:, 0].max(), 1.4 * len(rows) * sizes[:, 1].max())
    return ax


SHORT_WAYS: tuple[tuple[type, str, Any], ...] = (  # what is computed knows nothing of pictures; the usual one of each is a method of it
    (Trajectory, "plot", motion),
    (Trajectory, "animate", animate),
    (Fit, "plot", fit),
    (Fit, "report", report),
    (Recovery, "plot", recovery),
    (Design, "plot", design),
    (Posterior, "plot", posterior),
    (OptimalMotion, "plot", optimal_motion),
    (Modes, "plot", mode_shapes),
    (Modes, "animate", animate),
    (EquilibriumCurve, "plot", equilibrium_curve),
    (ResponseCurve, "plot", response_curve),
    (RootLocus, "plot", root_locus),
    (StabilityMap, "plot", stability_map),
    (Equations, "plot", equations),
    (LinearisedEquations, "plot", equations),
)
for _of, _name, _draw in SHORT_WAYS:
    setattr(_of, _name, _draw)
