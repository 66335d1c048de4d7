"""The smallest cost within limits: sequential quadratic programming, as SciPy does it."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

KEPT = 1e-6  # limits are, of their size
SUCCESS, STALLED, STEPS_USED_UP = 0, 8, 9  # exit modes of SLSQP
ASTRAY = "the optimiser found no way along the limits. Start elsewhere."
LEAST_STEPS = 50  # of the search for a point within the limits


@dataclasses.dataclass(frozen=True)
class Minimum:
    """Where the cost is smallest, the cost, by how much a limit is exceeded there, and why the search ended, if not at a minimum."""

    y: np.ndarray
    cost: float
    excess: float
    reason: str | None


def constrained_minimum(
    cost: Callable[[np.ndarray], tuple[float, np.ndarray]],
    margins: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    bounds: tuple[np.ndarray, np.ndarray],
    start: np.ndarray,
    steps: int,
    tolerance: float,
) -> Minimum:
    """Of a cost and margins ≥ 0, each with its derivatives. Where there is no motion both are NaN: no step goes there.

    **Source:** Kraft, A software package for sequential quadratic programming, DFVLR-FB 88-28 (1988); SciPy's `minimize(method="SLSQP")`.
    """
    cost, margins = _remembered(cost), _remembered(margins)
    worst, best = 0.0, (np.inf, start)

    def of_cost(y):
        nonlocal worst, best
        value, slope = cost(y)
        if not np.isfinite(value):
            return worst + 10.0, np.zeros(y.size)
        if value < best[0] and np.min(margins(y)[0], initial=0.0) >= -KEPT:
            best = value, y.copy()
        worst = max(worst, value)
        return value, slope

    there = margins(start)[0].size > 0
    limits = [{"type": "ineq", "fun": lambda y: _known(margins(y)[0]), "jac": lambda y: _known(margins(y)[1])}] if there else []
    found = _slsqp(of_cost, start, bounds, limits, steps, tolerance)
    y = np.clip(found.x, *bounds)
    reason = None if found.status in (SUCCESS, STALLED) else f"the optimiser stopped after {found.nit} steps: {found.message}."
    if np.min(margins(y)[0], initial=0.0) < -KEPT and np.isfinite(best[0]):
        y, reason = best[1], ASTRAY
    return Minimum(y, float(cost(y)[0]), -float(min(np.min(margins(y)[0], initial=0.0), 0.0)), reason)


def nearest_to_limits(margins: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], bounds: Any, start: np.ndarray) -> np.ndarray:
    """Where the largest excess over the limits is smallest."""
    margins = _remembered(margins)
    most = float(np.max(-_known(margins(start)[0])))

    def left(y):
        return np.append(_known(margins(y[:-1])[0]) + y[-1], y[-1])

    def jacobian(y):
        J = _known(margins(y[:-1])[1])
        return np.column_stack([np.vstack([J, np.zeros(J.shape[1])]), np.ones(len(J) + 1)])

    wider = [np.append(bounds[0], 0.0), np.append(bounds[1], np.inf)]
    excess = lambda y: (y[-1], np.append(np.zeros(y.size - 1), 1.0))
    return _slsqp(
        excess, np.append(start, max(most, 0.0)), wider, [{"type": "ineq", "fun": left, "jac": jacobian}], LEAST_STEPS, KEPT / 10
    ).x[:-1]


def _slsqp(cost, start, bounds, constraints, steps, tolerance):
    from scipy import optimize  # SciPy is a dependency of JAX; imported here because that takes a while

    ends = optimize.Bounds(*(np.asarray(bound, float) for bound in bounds))
    options = {"maxiter": steps, "ftol": tolerance}
    return optimize.minimize(cost, start, jac=True, method="SLSQP", bounds=ends, constraints=constraints, options=options)


def _known(x: np.ndarray) -> np.ndarray:
    """Without NaN."""
    return np.where(np.isfinite(x), x, 0.0)


def _remembered(of: Callable[[np.ndarray], Any]) -> Callable[[np.ndarray], Any]:
    """The same, computed once where it is asked for twice in turn."""
    last: dict[bytes, Any] = {}

    def call(y):
        key = np.asarray(y, float).tobytes()
        if key not in last:
            last.clear()
            last[key] = of(np.array(y, float))
        return last[key]

    return call
