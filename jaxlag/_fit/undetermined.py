"""Remarks on parameters that are not determined, with the combinations that are, as formulas."""

import fractions
import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from .._model.paths import is_within
from .identifiability import MANY, Undetermined
from .rounding import plus_minus


def on_undetermined(
    names: Sequence[str], found: Undetermined, estimates: Sequence[tuple[float, float]], deciding: Mapping[str, str]
) -> list[str]:
    """What the measurements do not determine. `estimates`: of the combinations that they do, with standard errors; `deciding`: what decides
    where a function jumps or bends, and in which line.
    """
    remarks = [_on_idle(names[i], next((line for name, line in deciding.items() if is_within(names[i], name)), "")) for i in found.idle]
    remarks += [f"{names[i]} cannot be distinguished from the unknown starts" for i in found.with_start]
    values = iter(estimates)
    return remarks + [_on_group(names, group, list(itertools.islice(values, len(group.combinations)))) for group in found.groups]


def _on_idle(name, line):
    if not line:
        return f"{name} has no influence on these measurements"
    return (
        f"{name} decides where a function of the system jumps or bends ({line}), and its influence is not seen there: give the system an "
        "event that is zero where it does"
    )


def _on_group(names, group, estimates):
    joint = [names[i] for i in group.joint]
    if len(joint) > MANY:
        return f"{joint[0]}, … {joint[-1]}, {len(joint)} numbers, are not determined individually"
    if not group.combinations:
        changes = "; ".join(
            ", ".join(f"{name} by {change:+.3g}" for name, change in zip(joint, column, strict=True)) for column in group.directions.T
        )
        if len(joint) == 1:
            return f"{joint[0]} is not determined"
        return f"{joined(joint)} are not determined individually: they can change together without visible effect ({changes})"
    determined = [f"{_written(names, c)}{_estimated(*estimate)}" for c, estimate in zip(group.combinations, estimates, strict=True)]
    rest = "their common factor is not" if group.common_factor else f"{joined(joint)} individually are not"
    return f"only {joined(determined)} {'is' if len(determined) == 1 else 'are'} determined; {rest}"


def _estimated(value, error):
    if not np.isfinite(value):
        return ""
    return f" = {plus_minus(value, error)}" if np.isfinite(error) else f" = {value:.6g}"


def _written(names, combination):
    """Σ c Π θ^x."""
    text = ""
    for c, exponents in zip(*combination, strict=True):
        size = "" if abs(c) == 1 else f"{abs(c)} " if isinstance(c, fractions.Fraction) else f"{abs(c):.4g} "
        text += f"{' - ' if c < 0 else ' + '}{size}{_product(names, exponents)}"
    return text.removeprefix(" + ")


def _product(names, exponents):
    above, below = ([_power(n, s * x) for n, x in zip(names, exponents, strict=True) if s * x > 0] for s in (1, -1))
    under = below[0] if len(below) == 1 else f"({' '.join(below)})"
    return " ".join(above) + (f"/{under}" if below else "")


def _power(name, x):
    return name + {1: "", 2: "²", 3: "³"}.get(x, f"^{x}" if x == int(x) else f"^({x})")


def joined(names: Sequence[str]) -> str:
    """The names as an enumeration in a sentence."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
