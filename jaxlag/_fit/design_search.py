"""The search for the best design: begun on the limits, in boxes where it goes astray, and checked between the times of the limits."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from .constrained_minimum import ASTRAY, KEPT, Minimum, constrained_minimum, nearest_to_limits
from .design_criteria import is_sharp
from .design_problem import SHARP, SHARPNESS, DesignProblem

REACH, SMALLEST, BOXES = 1 / 64, 1e-4, 30  # of a search that begins where one went astray, in units of what is chosen; how many follow
FINER = 8  # times more than those at which limits are kept in the search, at which that is checked
ROUNDS = 5  # of searches with limits moved by what was found between those times


def searched(problem: DesignProblem, y: np.ndarray, steps: int, tolerance: float) -> Minimum:
    """The minimum near a start; where limits are exceeded between the times at which they are kept, they are moved inwards."""
    moved, levels = problem, list(SHARPNESS) if is_sharp(problem.criterion) else [SHARP]
    for _ in range(ROUNDS):
        while True:
            found = _step_by_step(moved, levels[0], y, steps, tolerance)
            y, exact = found.y, problem.cost(found.y)[0]
            if len(levels) == 1 or abs(found.cost - exact) <= tolerance:  # no edge is near
                break
            levels = levels[1:]
        fine = np.array([min(np.min(margins), 0.0) for margins, *_ in problem.of_limits(y, FINER)])
        excess = -min(np.min(fine, initial=0.0), np.min(problem.margins(y)[0], initial=0.0))
        found = dataclasses.replace(found, cost=exact, excess=float(excess))
        if found.excess <= KEPT or not problem.limits or not np.isfinite(found.cost):
            break
        moved = dataclasses.replace(moved, moved=moved.moved - fine)
    return found


def _step_by_step(problem: DesignProblem, sharpness: float, y: np.ndarray, steps: int, tolerance: float) -> Minimum:
    """The minimum, begun on the constraints; where a search goes astray, from box to box about what was found last."""
    (lower, upper), reach, last = problem.bounds, np.inf, np.inf
    cost = lambda y: problem.cost(y, sharpness)
    for _ in range(BOXES):
        found = constrained_minimum(
            cost, problem.margins, (np.maximum(lower, y - reach), np.minimum(upper, y + reach)), y, steps, tolerance
        )
        is_at_edge = np.any((np.abs(found.y - y) > reach * (1 - KEPT)) & (found.y > lower) & (found.y < upper))
        y = np.concatenate([part.settled(own) for part, own in zip(problem.parts, problem.split(found.y), strict=True)])
        if found.reason == ASTRAY:
            if reach < SMALLEST or (reach < REACH and last - found.cost < tolerance):
                return found
            reach = min(reach / 4, REACH)
        elif not is_at_edge or found.reason or not np.isfinite(found.cost):
            return found
        else:
            reach *= 2
        last = min(last, found.cost)
    return dataclasses.replace(found, reason="there is no end to what is better. Give `bounds`, or limits by `within`.")


def best(problem: DesignProblem, found: Sequence[Minimum]) -> Minimum:
    """Of those that keep the limits the one with the smallest cost; refuses limits that cannot be kept."""
    kept = [one for one in found if np.isfinite(one.cost) and one.excess <= KEPT]
    if kept:
        return min(kept, key=lambda one: one.cost)
    least = min(found, key=lambda one: one.excess)
    nearest = nearest_to_limits(problem.margins, problem.bounds, least.y)
    values = [np.min(margins) for margins, *_ in problem.of_limits(nearest)]
    excess = -np.min(values, initial=0.0)
    if excess <= KEPT:
        reason = f"limits are exceeded by {100 * least.excess:.2g} % of their size. Allow more `steps`."
        return dataclasses.replace(least, reason=reason)
    names = [repr(str(limit)) for limit, value in zip(problem.limits, values, strict=True) if value < -0.5 * excess]
    which = " and ".join(names) + (" contradict each other" if len(names) > 1 else " cannot be kept")
    raise ValueError(
        f"`within` must leave room for an experiment, but {which}: exceeded by {100 * excess:.2g} % of its size at best. Widen it."
    )
