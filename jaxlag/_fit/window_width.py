"""The width of the windows, chosen by how well an estimate predicts windows of all widths."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from .weak_form import Record
from .weak_regression import Estimate, WeakFormProblem

GROWTH = 1.4  # from one width to the next that is tried
WIDEST = 0.25  # half a window, as a part of the longest record
NARROWEST = 2.0  # intervals between samples in half a window
SPARE = 3  # windows that do not overlap, beyond those needed, from which on standard errors can be trusted
SLIDING, REVERSING = 0.0, 0.4  # the largest part of a window near rest: where friction slides, and where it may reverse
NEGLIGIBLE = 0.003  # of the size of an equation's terms: residuals below it count as that
ALIKE = 0.8  # of the signal-to-noise ratio of the best: estimates that predict as well, whose scatter is part of its error


def best_estimate(problem: WeakFormProblem, halves: np.ndarray) -> Estimate | None:
    """The best estimate from windows of these half widths, the widest first; None where windows are too few.

    In narrow windows the noise is large, in windows of many oscillations the terms average to nothing; in both cases noise in the motion
    draws estimates towards zero. In windows of steady motion some terms do not vary. In those where friction sticks its force is
    unknown. Standard errors of one width know nothing of all that, but windows of other widths contradict it. So the best estimate is
    the one with the largest ratio of signal to noise on average over all widths: of the terms of the equations to what is left of them,
    to which the error of the prediction is added. Where estimates that are as good scatter by more than their standard errors allow, as
    they do where the model misses something, the error grows by that scatter.

    **Source:** Stone, J. R. Stat. Soc. B 36 (1974) 111 (choice by prediction); Hausman, Econometrica 46 (1978) 1251 (the variance of the
    difference of two estimates).
    """
    slides = all(np.all(record.moves) for record in problem.records)
    tried: list[Estimate] = []
    for near_rest in (SLIDING,) if slides else (SLIDING, REVERSING):
        y = tried[-1].y if tried else np.zeros(problem.free.size)
        for half in halves:
            found = problem.estimate(half, near_rest, y)
            if found is not None:
                y = found.y
                tried.append(found)
    sure = [found for found in tried if found.spare >= SPARE]
    if not sure:
        return tried[-1] if tried else None
    fewest = min(_undetermined(found) for found in sure)
    sure = [found for found in sure if _undetermined(found) == fewest]
    windows = [(found.half, found.near_rest) for found in sure]
    ratios = np.array([_signal_to_noise(problem, found, windows) for found in sure])
    best = sure[int(np.argmax(ratios))]
    as_good = [found for found, ratio in zip(sure, ratios, strict=True) if ratio >= ALIKE * np.max(ratios)]
    return best._replace(errors=with_scatter(best.y, best.errors, [(one.y, one.errors) for one in as_good]), as_good=tuple(as_good))


def half_widths(records: Sequence[Record]) -> np.ndarray:
    """Half widths that are tried, the widest first."""
    longest = max(record.span[1] - record.span[0] for record in records)
    shortest = NARROWEST * min(record.interval for record in records)
    count = max(int(np.log(WIDEST * longest / shortest) / np.log(GROWTH)) + 1, 1)
    return WIDEST * longest / GROWTH ** np.arange(count)


def _undetermined(found):
    return int(np.sum(np.isinf(found.errors)))


def _signal_to_noise(problem, found, windows):
    """On average over all windows and the equations; of those in which nothing is explained it is one."""
    left = np.array([problem.unexplained(*which, found) for which in windows])
    return float(np.mean(1 / np.sqrt(np.minimum(left, 1) + NEGLIGIBLE**2)))


def with_scatter(value: Any, error: Any, others: Sequence[tuple[Any, Any]]) -> Any:
    """The standard error, with the median square by which others, (value, error), differ beyond the difference of their variances."""
    known = np.isfinite(error)
    square = lambda error: np.where(known, error, 0) ** 2
    excess = [np.maximum((other - value) ** 2 - np.abs(square(its_error) - square(error)), 0) for other, its_error in others]
    return np.sqrt(error**2 + np.where(known, np.median(excess, axis=0), 0)) if others else error
