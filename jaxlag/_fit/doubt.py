"""Minima that are hardly fits: plateaus of the cost, where a model explains nothing, and parameters that have become one and the same."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .channels import Channel
from .rounding import plus_minus

NOTHING = 0.1  # R² of every channel, below which a model explains nothing of them
WORSE = -0.2  # R² of a single one, below which it is worse than none; that of noise alone is near 0
THOUSANDS = 1e3  # times the value of a parameter, from which an error is no error bar,
TOGETHER = 0.9999  # where it correlates like this with another one
ELSEWHERE = "start elsewhere (`start=jl.Regress()`, `start=jl.MultiStart()`), or look for what the model lacks"
PARTNERS = (
    "measured modes change their partners here, so that no step lowers the cost; see whether `shapes` has one row for each mode, "
    "or start nearer"
)


def doubt_of(parameters: Mapping[str, Any], theta: Any, start: Any, channels: Sequence[Channel], is_noise: bool) -> str:
    """Why a minimum is hardly a fit; empty where nothing speaks against it.

    `parameters`: names, covariance and correlation as in a `Fit`; `theta`, `start`: their numbers, found and given; `is_noise`: whether
    residuals are as small as the stated noise.
    """
    missed = [] if is_noise else unexplained(channels)
    if missed:
        worst = min(missed, key=lambda c: c.r_squared)
        return f"the model explains nothing of {worst.name} here (R² {worst.r_squared:.3g}): {ELSEWHERE}"
    sizes = np.maximum(np.abs(theta), np.abs(np.asarray(start)))
    errors, others = np.sqrt(np.diag(parameters["covariance"])), np.abs(parameters["correlation"] - np.eye(len(sizes)))
    for i, name in enumerate(parameters["names"]):
        if np.isfinite(errors[i]) and errors[i] > THOUSANDS * sizes[i] and np.max(others[i]) > TOGETHER:
            other = parameters["names"][int(np.argmax(others[i]))]
            return f"{name} and {other} cannot be told apart here ({name} {plus_minus(theta[i], errors[i])}): {ELSEWHERE}"
    return ""


def unexplained(channels: Sequence[Channel]) -> list[Channel]:
    """Those of which a model explains nothing."""
    in_time = [c for c in channels if np.isfinite(c.r_squared)]
    return [c for c in in_time if c.r_squared < WORSE] or (in_time if all(c.r_squared < NOTHING for c in in_time) else [])
