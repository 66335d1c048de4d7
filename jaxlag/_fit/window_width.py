"""The width of the windows, chosen by the data."""

from collections.abc import Sequence

import numpy as np

from .weak_form import Record
from .weak_regression import Estimate, Problem

GROWTH = 1.4  # from one width to the next that is tried
WIDEST = 0.25  # half a window, as a part of the longest record
NARROWEST = 2.0  # intervals between samples in half a window
SPARE = 3  # windows that do not overlap, beyond those needed, from which on standard errors can be trusted
ROUNDING = 1e-13  # of a parameter
HOPELESS = 4.0  # a fall of what is explained, to noise seven times as large, from which on narrower windows are not tried
SLIDING, REVERSING = 0.0, 0.4  # the largest part of a window near rest: where friction slides, and where it may reverse
STICKS = 2.0  # a growth of the intervals by windows in which friction may reverse, which means that it sticks there


def best_estimate(problem: Problem, halves: np.ndarray) -> Estimate | None:
    """The best estimate from windows of these half widths, the widest first: of those in which friction may reverse, unless it sticks
    there. None where windows are too few.

    Where friction sticks its force is unknown, so that windows scatter: those in which it only slides are then used alone.
    """
    y = np.zeros(problem.free.size)
    sliding = _best_width(problem, halves, SLIDING, y)
    if all(np.all(record.moves) for record in problem.records):
        return sliding
    reversing = _best_width(problem, halves, REVERSING, y if sliding is None else sliding.y)
    if reversing is None or sliding is None or sliding.spare < SPARE:
        return reversing or sliding
    undetermined, size = np.subtract(_uncertainty(reversing), _uncertainty(sliding))
    sticks = undetermined > 0 or (undetermined == 0 and size > y.size * np.log(STICKS))
    return sliding if sticks or not _agree(sliding, reversing) else reversing


def _best_width(problem, halves, near_rest, y):
    """The estimate with the smallest 95 % intervals among those that agree with all that explain more.

    In narrow windows the noise is large, in windows of many oscillations the terms average to nothing; in both cases noise in the motion
    draws estimates towards zero, with standard errors that know nothing of it. In between they do not depend on the width. The more of
    the known terms is explained, the smaller the noise in the equations is, and so the bias: in this order the intervals are compared, as
    those of wider and wider windows are by Goldenshluger and Nemirovski.

    **Source:** Goldenshluger & Nemirovski, Math. Methods Stat. 6 (1997) 135 (the intersection of confidence intervals); Fuller,
    Measurement Error Models (1987), section 1.1 (attenuation).
    """
    sure, unsure = [], None
    for half in halves:
        found = problem.estimate(half, near_rest, y)
        if found is None:
            continue
        if found.spare < SPARE:
            unsure = found
            continue
        y = found.y
        sure.append(found)
        if found.explained < max(map(_explained, sure)) - HOPELESS:
            break
    agreeing: list[Estimate] = []
    for found in sorted(sure, key=_explained, reverse=True):
        if all(_agree(found, other) for other in agreeing):
            agreeing.append(found)
    return min(agreeing, key=_uncertainty) if agreeing else unsure


def half_widths(records: Sequence[Record]) -> np.ndarray:
    """Half widths that are tried, the widest first."""
    longest = max(record.span[1] - record.span[0] for record in records)
    shortest = NARROWEST * min(record.interval for record in records)
    count = max(int(np.log(WIDEST * longest / shortest) / np.log(GROWTH)) + 1, 1)
    return WIDEST * longest / GROWTH ** np.arange(count)


def _explained(found):
    return found.explained


def _agree(one, other):
    """Whether their 95 % intervals touch."""
    return bool(np.all(np.abs(one.y - other.y) <= one.intervals + other.intervals))


def _uncertainty(found):
    """How many parameters are not determined, then the product of the intervals of the others, as a logarithm."""
    known = found.intervals[np.isfinite(found.errors)]
    return found.y.size - known.size, float(np.sum(np.log(np.maximum(known, ROUNDING))))
