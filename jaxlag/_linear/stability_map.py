"""Stability, flutter and divergence of a steady state over two parameters."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from .._model.state_values import sampled
from .._model.system import System
from .parameter_plane import ParameterPlane
from .root_locus import eigen_and_rounding
from .zero_eigenvalues import Core


@dataclasses.dataclass(frozen=True, repr=False)
class StabilityMap:
    """Stability `over` two parameters, as NumPy arrays; entry [i, j] belongs to `values[0][i]` and `values[1][j]`.

    - `over`: the names of the two; `values`: their values.
    - `growth`: the largest real part of the eigenvalues, in 1/time, without those that are zero everywhere; exactly 0 where rounding would
      decide its sign, and NaN where there is no steady state.
    - `frequency`: |Im λ| of that eigenvalue, in rad/time; the lowest if there are several.
    - `missing`: by (i, j), why there is no steady state. `units`: those that the system states.

    `kind`: "stable" where nothing grows, "flutter" where an oscillation does, "divergence" where λ is real, "missing" where there is none.
    """

    over: tuple[str, str]
    values: tuple[np.ndarray, np.ndarray]
    growth: np.ndarray
    frequency: np.ndarray
    missing: dict[tuple[int, int], str]
    units: tuple[tuple[str, str], ...] = ()

    @property
    def kind(self) -> np.ndarray:
        """What becomes of a small disturbance, one word for each point."""
        unstable = np.where(self.frequency > 0, "flutter", "divergence")
        return np.where(np.isnan(self.growth), "missing", np.where(self.growth > 0, unstable, "stable"))

    def __repr__(self) -> str:
        axes = [f"{name} = {x[0]:g} … {x[-1]:g}" for name, x in zip(self.over, self.values, strict=True)]
        head = f"StabilityMap over {' and '.join(axes)}, {' × '.join(str(len(x)) for x in self.values)} points"
        rows = [f"  {kind:<12}{np.sum(self.kind == kind)}" for kind in ("stable", "flutter", "divergence") if np.any(self.kind == kind)]
        if self.missing:
            rows.append(f"  {'missing':<12}{len(self.missing)}, at {next(iter(self.missing))}: {next(iter(self.missing.values()))}")
        return "\n".join([head, *rows])


def stability_map(
    system: System,
    q: Any,
    qdot: Any = None,
    params: PyTree = None,
    *,
    over: Mapping[str, Any],
    t: Any = 0.0,
    states: PyTree = None,
) -> StabilityMap:
    r"""Growth of small disturbances of a steady state, on a grid of two parameters: where it is stable, flutters or diverges.

    $$ \max_i\,\mathrm{Re}\,\lambda_i(p_1, p_2), \qquad \det(\lambda - A(p_1, p_2)) = 0 $$

    A stable state of a system without damping has growth 0. Nothing between the points of the grid is seen; `root_locus` locates the values
    at which stability is lost. `plot.stability_map` draws it.

    **Arguments:** `q`, `qdot`: the steady state as functions of `params` and its entries, or a guess, structured as for `simulate`, from
    which it is found at the first of all values and then, point by point, from a neighbour. `over`: two names of numbers in `params`, each
    with its values, increasing, at least two: `{"b1": jnp.linspace(0, 1, 21), "b2": …}`. `t`, `states` as for `acceleration`. Any
    consistent units.

    **Returns:** a `StabilityMap`, not differentiable. Points without a steady state are NaN, and `missing` gives the reason.

    **Raises:** `ValueError` if no point has a steady state, `over` does not name two numbers, the system has sampled states, or `params`
    are traced.

    **Source:** Bolotin, Nonconservative Problems of the Theory of Elastic Stability; Seyranian & Mailybaev, Multiparameter Stability Theory
    with Mechanical Applications, chapter 3 (boundaries of stability).

    ```python
    import jaxlag as jl
    rod = jl.System(  # upright under a weight p, on a spring
        lambda q, qdot, c, p: 0.5 * qdot**2 - 0.5 * (c - p) * q**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2
    )
    params = {"c": 4.0, "p": 0.0, "b": 0.0}
    found = jl.stability_map(rod, lambda: 0.0, params=params, over={"b": [-1.0, 1.0], "p": [0.0, 5.0]})
    found.growth  # [[0.5, 1.618], [-0.5, 0.618]]
    print(found.kind[0, 0], found.kind[1, 0], found.kind[1, 1])  # flutter stable divergence
    ```
    """
    if sampled(system):
        raise ValueError("`system` must have no sampled states, but has. Linearise it at each value: its eigenvalues are those of a step.")
    plane = ParameterPlane(system, q, qdot, params, over, t, states)
    rows, missing = plane.linearised()
    there = [at for at in np.ndindex(plane.shape) if at not in missing]
    if not there:
        raise ValueError(f"`over` must hold values at which there is a steady state, but at the first of all: {missing[0, 0]}. Move them.")
    growth, frequency = np.full((2, *plane.shape), np.nan)
    for at, value in zip(there, _fastest([rows[i][j] for i, j in there], len(missing)), strict=True):
        growth[at], frequency[at] = value.real, abs(value.imag)
    return StabilityMap(plane.names, plane.values, growth, frequency, missing, system.units)


def _fastest(grid: list[np.ndarray], idle: int) -> list[complex]:
    """The fastest-growing eigenvalue of each matrix, without eigenvalues that are zero in all matrices."""
    core = Core.of(grid)
    reduced = np.stack([core.without_zeros(A)[0] for A in grid])
    if not reduced.shape[1]:
        return [0j] * len(grid)
    padded = np.concatenate([reduced, np.repeat(reduced[:1], idle, axis=0)])  # a program for each grid, not for each number of points
    values, _, rounding = map(np.asarray, jax.vmap(eigen_and_rounding)(padded))
    real = np.where(np.abs(values.real) <= rounding, 0, values.real)
    imag = np.where(np.abs(values.imag) <= 10 * rounding, 0, values.imag)
    which = np.argmax(real, axis=1)
    return [complex(real[i, j], imag[i, j]) for i, j in zip(range(len(grid)), which, strict=False)]
