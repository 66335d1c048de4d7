"""The remarks on the card of a fit: sentences on what is held at a bound, or not explained by the model."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from .channels import Channel
from .identifiability import MANY
from .parameter_stability import Halves
from .parameters import Free
from .rounding import plus_minus
from .undetermined import joined

NO_ERRORS = "standard errors are not computed for so many parameters"
UNEXPLAINED = 3.0  # residuals this many times the noise are not noise
LARGER, CERTAIN = 1.2, 4.0  # residuals this many times the stated noise, by so many standard deviations, are larger than it
UNRELATED_SIZE = 10.0  # residuals this many times the measurements belong to an unrelated motion
WELL_PREDICTED = 0.99  # R² of a channel from which on the table alone reports correlated residuals,
DRIFT = 1 / 6  # unless they are correlated over this part of the record;
EXACT = 1 - 1e-8  # R² from which on residuals are those of the integration


def on_bounds(free: Free, theta: np.ndarray, gradient: np.ndarray) -> Iterator[str]:
    """Estimates that a bound holds back; `gradient` of the cost."""
    for name, value, downhill, *bounds in zip(free.entries, theta, -gradient, np.asarray(free.lower), np.asarray(free.upper), strict=True):
        for bound, outwards in zip(bounds, (-downhill, downhill), strict=True):
            if value == bound and outwards > 0:
                yield f"{name} is at its bound {bound:g}; the measurements favour values beyond it"


def on_too_short(names: Sequence[str]) -> list[str]:
    """Channels whose sigma cannot be estimated."""
    if not names:
        return []
    have, own = ("has", "a sigma of its own") if len(names) == 1 else ("have", "sigmas of their own")
    shown = joined(names) if len(names) <= MANY else f"{names[0]}, … {names[-1]}"
    return [f"{shown} {have} too few measurements for {own}: each channel is weighted by its spread; give `sigma`"]


def on_no_freedom(measurements: int, unknowns: int) -> list[str]:
    """At least as many unknowns as measurements."""
    if unknowns < measurements:
        return []
    are, some = ("is", "unknown") if unknowns == 1 else ("are", "unknowns")
    of = "measurement" if measurements == 1 else "measurements"
    return [f"there {are} {unknowns} {some} for {measurements} {of}: none is left over that could contradict the model"]


def on_exact(channels: Mapping[str, int]) -> list[str]:
    """Channels without noise, with the number of their measurements."""
    return [
        f"{name} is predicted exactly, and its {count} measurements say nothing of the noise of others" for name, count in channels.items()
    ]


def on_inputs(ended: Mapping[str, tuple[float, float]]) -> list[str]:
    """Inputs with the times of their last sample and of that of the record."""
    return [f"{name} ends at t = {end:g} and keeps its value to the end of the record at {last:g}" for name, (end, last) in ended.items()]


def on_misfit(
    relative_size: float,
    times_noise: float,
    independent: float,
    halves: str,
    channels: Sequence[Channel],
    explained: bool,
    recorded: bool,
) -> Iterator[str]:
    """Measurements that the model does not explain.

    `relative_size`: residuals over measurements; `times_noise`: residuals over the stated sigma, from so many `independent` samples;
    `halves`: what differs between the halves of the records, if anything; `explained`: whether another remark already gives a reason;
    `recorded`: whether there are recordings in time.
    """
    if relative_size > UNRELATED_SIZE:
        yield f"the residuals are {relative_size:.2g} times as large as the measurements: check the units, and start from other parameters"
        return
    halves = "" if explained or all(c.r_squared >= EXACT for c in channels) else halves
    if halves:
        yield f"{halves}: the model misses something, and the errors above do not account for that"
    if times_noise > UNEXPLAINED:
        yield (
            f"the model does not explain the measurements; the residuals are {times_noise:.2g} times the noise: try another start"
            f"{' or `segments=`' if recorded else ''}, or look for what the model lacks; the errors above mean little"
        )
    elif times_noise > LARGER and times_noise**2 - 1 > CERTAIN * np.sqrt(2 / independent):
        yield (
            f"the residuals are {times_noise:.2g} times the noise that `sigma` states: it is larger, or the model misses something; "
            "the errors above take `sigma` as it is"
        )
    elif not (explained or halves):
        yield from _on_correlation([c for c in channels if c.correlation_length and not _well_predicted(c)])


def _well_predicted(channel):
    drifts = channel.correlation_length >= DRIFT * channel.samples and channel.r_squared < EXACT
    return channel.r_squared >= WELL_PREDICTED and not drifts


def _on_correlation(missed):
    if missed:
        names = ", ".join(dict.fromkeys(c.name for c in missed[:MANY])) + (", …" if len(missed) > MANY else "")
        length = max(c.correlation_length for c in missed)
        yield f"the model misses something, or the noise is not white: residuals of {names} are correlated over {length} samples"


def on_halves(names: Sequence[str], found: Halves | None, records: int) -> str:
    """What differs between the halves of the records."""
    if found is None:
        return ""
    of, first, second = "record" if records == 1 else "records", plus_minus(*found.first), plus_minus(*found.second)
    return f"{names[found.parameter]} would be {first} by the first half of the {of}, and {second} by the second"


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
