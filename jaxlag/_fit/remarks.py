"""The remarks on the card of a fit: sentences on what is not determined, held at a bound, or not explained by the model."""

from collections.abc import Iterator, Sequence

import numpy as np

from .channels import Channel
from .identifiability import MANY, Undetermined
from .parameters import Free

NO_ERRORS = "standard errors are not computed for so many parameters"
UNEXPLAINED = 3.0  # residuals this many times the noise are not noise
UNRELATED_SIZE = 10.0  # residuals this many times the measurements belong to an unrelated motion
WELL_PREDICTED = 0.99  # R² of a channel from which on the table alone reports correlated residuals


def on_undetermined(names: Sequence[str], found: Undetermined) -> list[str]:
    """What the measurements do not determine."""
    remarks = [f"{names[i]} has no influence on these measurements" for i in found.idle]
    remarks += [f"{names[i]} cannot be distinguished from the unknown starts" for i in found.with_start]
    joint = [names[i] for i in found.joint]
    if len(joint) > MANY:
        remarks.append(f"{joint[0]}, … {joint[-1]}, {len(joint)} numbers, are not determined individually")
    elif found.combinations is not None:
        remarks.append(_on_combinations(names, joint, found.combinations))
    elif joint:
        changes = "; ".join(
            ", ".join(f"{name} by {change:+.3g}" for name, change in zip(joint, column, strict=True)) for column in found.directions.T
        )
        remarks.append(f"{_listed(joint)} are not determined individually: they can change together without visible effect ({changes})")
    return remarks


def _on_combinations(names, joint, found):
    of_one = _product if found.products else _sum
    determined = [of_one(names[i], [(names[j], x) for j, x in factors]) for i, factors in found.terms]
    rest = "their common factor is not" if found.common_factor else f"{_listed(joint)} individually are not"
    return f"only {_listed(determined)} {'is' if len(determined) == 1 else 'are'} determined; {rest}"


def _product(name, factors):
    """name · Π p^−x."""
    above, below = [name], []
    for p, x in factors:
        (below if x > 0 else above).append(p if abs(x) == 1 else f"{p}^{abs(x) if abs(x).denominator == 1 else f'({abs(x)})'}")
    under = below[0] if len(below) == 1 else f"({' '.join(below)})"
    return " ".join(above) + (f"/{under}" if below else "")


def _sum(name, terms):
    """name − Σ x p."""
    text = name
    for p, x in terms:
        text += f" {'-' if x > 0 else '+'} {p if abs(x) == 1 else f'{abs(x)} {p}'}"
    return text


def _listed(names):
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def on_bounds(free: Free, theta: np.ndarray, gradient: np.ndarray) -> Iterator[str]:
    """Estimates that a bound holds back; `gradient` of the cost."""
    for name, value, downhill, *bounds in zip(free.entries, theta, -gradient, np.asarray(free.lower), np.asarray(free.upper), strict=True):
        for bound, outwards in zip(bounds, (-downhill, downhill), strict=True):
            if value == bound and outwards > 0:
                yield f"{name} is at its bound {bound:g}; the measurements favour values beyond it"


def on_misfit(relative_size: float, times_noise: float, channels: Sequence[Channel], explained: bool) -> Iterator[str]:
    """Measurements that the model does not explain. `relative_size`: residuals over measurements; `explained`: whether another remark
    already gives a reason for correlated residuals.
    """
    if relative_size > UNRELATED_SIZE:
        yield f"the residuals are {relative_size:.2g} times as large as the measurements: check the units, and start from other parameters"
    elif times_noise > UNEXPLAINED:
        yield (
            f"the model does not explain the measurements; the residuals are {times_noise:.2g} times the noise: try another start or "
            "`segments=`, or look for what the model lacks; the errors above mean little"
        )
    elif not explained:
        missed = [c for c in channels if c.correlated and c.r_squared < WELL_PREDICTED]
        if missed:
            names = ", ".join(dict.fromkeys(c.name for c in missed[:MANY])) + (", …" if len(missed) > MANY else "")
            length = max(c.correlated for c in missed)
            yield f"the model misses something, or the noise is not white: residuals of {names} are correlated over {length} samples"
