"""The printed card of a fit: a table of the parameters, remarks, and a table of the channels."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax.flatten_util import ravel_pytree

from .._model.paths import entry_names, is_within
from .autocorrelation import COLOURED
from .channels import Channel
from .noise import sigmas_of
from .rounding import plus_minus, rounded

ROWS = 40  # of a table at most
STRONGEST = 6  # correlations on the card
MANY = 16  # numbers of one name; more are only counted
UNEVEN = 0.1  # of an interval between samples
UNFOLDED = 12  # rows of the experiments' own unknowns; more become one for each entry


def card(fit: Any) -> str:
    """The card of a `Fit`, a line for each element."""
    rows = [
        _heading(fit),
        *([f"  start found by {', then '.join(fit.start_log)}"] if fit.start_log else []),
        *_parameter_rows(fit),
        *_correlation_rows(fit),
        *_inflation_rows(fit),
        *(f"  ! {remark}" for remark in fit.remarks),
        *channel_rows(fit.channels),
        f"  residual sigma  {_sigma(fit)}",
    ]
    return "\n".join(rows)


def estimates_by_name(fit: Any) -> Iterator[tuple[str, list[tuple[str, float, float]]]]:
    """A name, and each of its numbers as (name, value, standard error): of the free parameters, then of each experiment's unknowns.

    Numbers of a start of which only others are unknown are left out, unless constraints move them.
    """
    theta = np.concatenate([np.ravel(x) for x in jax.tree.leaves(list(fit.estimates.values()))])
    triples = list(zip(fit.names, theta, np.sqrt(np.diag(fit.covariance)), strict=True))
    yield from ((name, [triple for triple in triples if is_within(triple[0], name)]) for name in fit.estimates)
    for k, unknowns in enumerate(fit.unknowns):
        for which, tree in unknowns.items():
            label = f"experiment {k}: {which}"
            entries = [f"{label}{'.' if name[:1].isalpha() else ''}{name}" for name in entry_names(tree)]
            values, errors = (np.asarray(ravel_pytree(x)[0]) for x in (tree, fit.unknown_errors[k][which]))
            is_named = lambda entry, unknown=fit.experiments[k].unknown: any(is_within(entry.partition(": ")[2], name) for name in unknown)
            yield label, [each for each in zip(entries, values, errors, strict=True) if each[2] != 0 or is_named(each[0])]


def _heading(fit):
    count = len(fit.names)
    outcome = f"converged after {fit.steps} steps" if fit.converged else f"not converged after {fit.steps} steps: {fit.reason}"
    return f"Fit: {count} parameter{'s' if count != 1 else ''}, {fit.measurements} measurements, {outcome}"


def _parameter_rows(fit):
    """Estimates, errors and intervals; many numbers of one name in one row."""
    groups = list(estimates_by_name(fit))
    own = groups[len(fit.estimates) :]
    folded = own if sum(len(group) for _, group in own) > UNFOLDED and len(fit.unknowns) > 1 else []
    groups = groups[: len(groups) - len(folded)]
    units = dict(fit.units)
    of = lambda name, whose: f" {unit}" if (unit := unit_of(name, whose, units)) else ""
    named = [(name, _estimate(fit, name, v, e, of(name, whose))) for whose, group in groups if len(group) <= MANY for name, v, e in group]
    named += [(name, _counted(group)) for name, group in groups if len(group) > MANY]
    named += list(_folded(folded, of))
    width = max((len(name) for name, _ in named[:ROWS]), default=0)
    wide = max((len(value) for _, (value, interval) in named[:ROWS] if interval), default=0)
    rows = [f"  {name:<{width}}  {value:<{wide if interval else 0}}{interval}" for name, (value, interval) in named[:ROWS]]
    return rows + ([f"  … and {len(named) - ROWS} more"] if len(named) > ROWS else [])


def unit_of(name: str, whose: str, units: Mapping[str, str]) -> str:
    """The unit of one number of a name, or of that name; of a start, that of its coordinate. Empty where it is not stated."""
    entry = name.removeprefix(whose).lstrip(".").partition("[")[0] if whose.endswith(": q0") else ""
    return next((units[key] for key in (name, whose, entry) if key in units), "")


def _folded(groups, of):
    """A row for each entry of the unknowns of many experiments: how far they range, and the median of their errors."""
    entries: dict[str, list[tuple[float, float]]] = {}
    units = {}
    for whose, group in groups:
        for name, value, error in group:
            entry = name.partition(": ")[2]
            entries.setdefault(entry, []).append((value, error))
            units[entry] = of(name, whose)
    for entry, pairs in entries.items():
        values, errors = np.array(pairs).T
        error = float(np.median(errors))
        text = f"{rounded(np.min(values), error)} … {rounded(np.max(values), error)}, ± {error:.2g}{units[entry]}"
        yield f"{len(values)} experiments: {entry}", (text, "")


def _estimate(fit, name, value, error, unit):
    """The estimate with its error, and its interval."""
    if not np.isfinite(error):
        return "not determined by these measurements" if np.isinf(error) else f"{value:.6g}{unit}", ""
    t = fit.quantile(0.95)
    ends = fit.interval(name) if name in fit.names else (value - t * error, value + t * error)
    return f"{plus_minus(value, error) + unit:<24}", f" 95 %: {' … '.join(rounded(end, error) for end in ends)}"


def _counted(group):
    errors = np.array([error for _, _, error in group])
    known = "" if np.all(np.isnan(errors)) else f", {np.count_nonzero(np.isfinite(errors))} of them determined individually"
    return f"{len(group)} numbers{known}", ""


def _correlation_rows(fit):
    pairs = itertools.combinations(range(min(len(fit.names), ROWS)), 2)
    strong = sorted((pair for pair in pairs if abs(fit.correlation[pair]) > 0.5), key=lambda pair: -abs(fit.correlation[pair]))
    shown = [f"{fit.names[i]}, {fit.names[j]}: {fit.correlation[i, j]:+.2f}" for i, j in strong[:STRONGEST]]
    more = [f"{len(strong) - STRONGEST} more above 0.5"] if len(strong) > STRONGEST else []
    return [f"  correlation  {'; '.join([*shown, *more])}"] if strong else []


def _inflation_rows(fit):
    if not fit.correlation_length:
        return []
    known = fit.inflation[np.isfinite(fit.inflation) & np.isfinite(np.diag(fit.covariance))]
    factors = dict.fromkeys(f"{x:.2g}" for x in (np.min(known), np.max(known))) if known.size else ()
    larger = f": {' to '.join(factors)} times those for white residuals" if known.size else ""
    uneven = " that are not evenly spaced in time" if any(map(_is_uneven, fit.experiments)) else ""
    return [f"  standard errors account for residuals correlated over {fit.correlation_length} samples{uneven}{larger}"]


def _is_uneven(e):
    """Whether the intervals between samples differ."""
    intervals = np.diff(np.asarray(getattr(e, "ts", ())))
    intervals = intervals[intervals > 0]
    return intervals.size > 0 and np.ptp(intervals) > UNEVEN * np.median(intervals)


def channel_rows(channels: Sequence[Channel]) -> list[str]:
    """The table of channels."""
    several = len({channel.experiment for channel in channels}) > 1
    label = lambda c: f"{c.experiment}: {c.name}" if several else c.name
    shown = channels[:ROWS]
    width = max((len(label(c)) for c in shown), default=0)
    rows = [f"  {label(c):<{width}}  {_quality(c)}rms {c.rms:.3g}   {_whiteness(c.whiteness)}".rstrip() for c in shown]
    return rows + ([f"  … and {len(channels) - ROWS} more channels"] if len(channels) > ROWS else [])


def _quality(c):
    """How much of the spread of the measurements is predicted; nothing where there is none, as of a single mode."""
    return "" if np.isnan(c.fit_percent) else f"fit {_short(c.fit_percent, '6.2f')} %   R² {_short(c.r_squared, '.5f')}   "


def _sigma(fit):
    """In units of the given sigma, or of each channel by name."""
    if fit.freedom == 0:
        return "not known: no measurement is left over"
    if fit.absolute:
        return f"{fit.sigma:.4g}  (1 where the stated noise level is right)"
    relative = sigmas_of(fit.problem)
    if len(relative) == 1:
        return f"{fit.sigma:.4g}"
    shown = ", ".join(f"{name} {fit.sigma * sigma:.4g}" for name, sigma in list(relative.items())[:MANY])
    return shown + (", …" if len(relative) > MANY else "")


def _whiteness(p):
    if np.isnan(p):
        return ""
    return "white" if p >= COLOURED else f"not white (p = {p:.1g})"


def _short(x, digits):
    return f"{x:{digits}}" if abs(x) < 1e4 else f"{x:.1e}"
