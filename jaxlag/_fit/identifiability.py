"""How good a fit is: of each channel, and which parameters the measurements determine at all, in words."""

import fractions
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from .._model.paths import entry_names
from .autocorrelation import autoregression, reach, whiteness

MANY = 12  # parameters that are looked at for what they determine together
NOTHING = 1e-9  # singular values below this part of the largest are zero: columns have norm one, and are as exact as the integration
ROUNDINGS = 300  # or so many units in the last place, in single precision


class Channel(NamedTuple):
    """How well one channel is predicted.

    - `fit_percent`: 100 (1 − |z − ẑ| / |z − z̄|); `r_squared`: 1 − |z − ẑ|² / |z − z̄|²; `rms` of the residuals.
    - `whiteness`: the p-value of Ljung & Box's test that residuals are independent; small where the model misses something.
    - `correlated`: over how many samples the residuals are; 0 where they are white.

    **Source:** Ljung, System Identification, 2nd ed., sections 16.4 and 16.6; Ljung & Box, Biometrika 65 (1978) 297.
    """

    experiment: int
    name: str
    samples: int
    fit_percent: float
    r_squared: float
    rms: float
    whiteness: float
    correlated: int


def channels_of(number: int, values: PyTree, residuals: PyTree) -> list[Channel]:
    """Each scalar channel of an experiment, in flat order."""
    flat = lambda tree: np.concatenate([np.reshape(leaf, (len(leaf), -1)) for leaf in jax.tree.leaves(tree)], axis=1).T
    names = entry_names(jax.tree.map(lambda leaf: np.zeros(np.shape(leaf)[1:]), values))
    return [_channel(number, name or "z", z, r) for name, z, r in zip(names, flat(values), flat(residuals), strict=True)]


def _channel(number, name, z, r):
    there = np.isfinite(z) & np.isfinite(r)
    z, r = z[there], r[there]
    around, off = np.linalg.norm(z - np.mean(z)) if z.size else np.nan, np.linalg.norm(r)
    part = off / around if around > 0 else np.nan
    rms, correlated = off / np.sqrt(max(z.size, 1)), reach(autoregression(r), z.size)
    return Channel(number, name, z.size, 100 * (1 - part), 1 - part**2, rms, whiteness(r), correlated)


class Determined(NamedTuple):
    """Covariance over σ², of what is determined; which unknowns are; directions that are not, as columns."""

    covariance: np.ndarray
    determined: np.ndarray
    null: np.ndarray


def determined_by(J: np.ndarray, gaps_J: np.ndarray) -> Determined:
    """(JᵀJ)⁻¹ on the changes that open no gap, where these are determined."""
    nothing = max(NOTHING, ROUNDINGS * float(np.finfo(J.dtype).eps))
    J, gaps_J = J.astype(float), gaps_J.astype(float)
    size = np.linalg.norm(J, axis=0)
    scale = np.where(size > 0, 1 / np.where(size > 0, size, 1), 1)
    basis = np.eye(size.size)
    if len(gaps_J):
        _, s, Vt = np.linalg.svd(gaps_J * scale)
        basis = Vt[int(np.sum(s > nothing * s[0])) :].T
    R = np.linalg.qr(np.asarray(J) * scale @ basis, mode="r")  # has the singular values of all the rows
    _, s, Vt = np.linalg.svd(R)
    s = np.concatenate([s, np.zeros(basis.shape[1] - s.size)])
    weak = s <= nothing * max(s[0], 1e-300)
    ways = basis @ Vt.T
    inverse = ways[:, ~weak] / s[~weak] ** 2 @ ways[:, ~weak].T
    null = ways[:, weak]
    return Determined(inverse * np.outer(scale, scale), np.all(np.abs(null) < 1e-4, axis=1), null * scale[:, None])


def correlation_of(covariance: np.ndarray) -> np.ndarray:
    """Correlations; NaN for what is not determined."""
    errors = np.sqrt(np.diag(covariance))
    errors = np.where(np.isfinite(errors) & (errors > 0), errors, np.nan)
    return np.where(np.isfinite(covariance), covariance, np.nan) / np.outer(errors, errors)


def in_words(
    names: Sequence[str], theta: np.ndarray, nulls: Sequence[np.ndarray], thetas: Sequence[np.ndarray], idle: Sequence[int] = ()
) -> list[str]:
    """What the measurements do not determine.

    `nulls`: at two places `thetas`, changes of θ that do not show, as columns. They are of one factor, or of one sum, where these
    changes are the same at both places relative to θ, or as they are. `idle`: parameters of which no measurement depends.

    **Source:** Walter & Pronzato, Identification of Parametric Models (1997), section 2.6 (structural identifiability).
    """
    scale = np.where(theta == 0, 1, np.abs(theta))
    said = [f"{names[i]} has no influence on these measurements" for i in idle]
    rest = []
    for n in nulls:
        left = n / scale[:, None]
        size = np.linalg.norm(left, axis=0)
        left[list(idle)] = 0
        left = left[:, np.linalg.norm(left, axis=0) > 1e-6 * size]  # the others are rounding
        rest.append(_column_space(left) * scale[:, None])
    for i in [i for i in range(len(names)) if _alone(i, rest, scale)]:
        said.append(f"{names[i]} cannot be told from the unknown starts")
        for n in rest:
            n[i] = 0
    rest = [n[:, np.linalg.norm(n / scale[:, None], axis=0) > 1e-6] for n in rest]
    involved = [i for i in range(len(names)) if np.max(np.abs(rest[0][i] / scale[i]), initial=0) > 1e-6]
    if not involved:
        return said
    shown = [names[i] for i in involved]
    if len(shown) > MANY:
        return [*said, f"{shown[0]}, … {shown[-1]}, {len(shown)} numbers, are not determined one by one"]
    for relative in (True, False):
        per = [t if relative else np.ones_like(t) for t in thetas]
        if any(np.any(t[involved] == 0) for t in per):
            continue
        spaces = [_column_space((n / t[:, None])[involved]) for n, t in zip(rest, per, strict=True)]
        if spaces[0].shape != spaces[1].shape or np.linalg.norm(spaces[0] - spaces[1] @ (spaces[1].T @ spaces[0])) > 1e-4:
            continue
        combinations = _combinations(spaces[0], shown, relative)
        if combinations is not None:
            return [*said, combinations]
    parts = "; ".join(", ".join(f"{name} by {d:+.3g}" for name, d in zip(shown, column, strict=True)) for column in rest[0][involved].T)
    return [*said, f"{_listed(shown)} are not determined one by one: they can change together without showing ({parts})"]


def _alone(i, nulls, scale):
    """Whether a change of parameter i alone does not show."""
    e = np.eye(scale.size)[:, [i]]
    spaces = [n / scale[:, None] for n in nulls]
    return all(space.size and np.linalg.norm(e - space @ (space.T @ e)) < 1e-5 for space in spaces)


def _column_space(A):
    U, s, _ = np.linalg.svd(A, full_matrices=False)
    return U[:, s > 1e-6 * max(s[0], 1e-300)] if s.size else U


def _combinations(space, names, relative):
    """Products of powers, or sums, of the parameters that are determined, from the changes that do not show; None without simple ones."""
    q, k = space.shape
    best: tuple | None = None
    for pivots in itertools.islice(itertools.combinations(reversed(range(q)), k), 200):
        square = space[list(pivots)]
        if np.linalg.cond(square) > 1e6:
            continue
        R = space @ np.linalg.inv(square)  # unit changes of the pivots
        exact = [[fractions.Fraction(float(x)).limit_denominator(4) for x in row] for row in R]
        off = np.max(np.abs(R - np.array(exact, float)))
        size = sum(abs(x.numerator) + x.denominator for row in exact for x in row)
        if off < 1e-3 and (best is None or size < best[0]):
            best = size, pivots, exact
    if best is None:
        return None
    _, pivots, exact = best
    others = [i for i in range(q) if i not in pivots]
    if not others:
        return None
    word = _power if relative else _sum
    determined = [word(names[i], [(names[p], x) for p, x in zip(pivots, exact[i], strict=True) if x != 0]) for i in others]
    one = len(determined) == 1
    common = relative and all(x == 1 for row in exact for x in row)
    last = "their common factor is not" if common else f"{_listed(names)} one by one are not"
    return f"only {_listed(determined)} {'is' if one else 'are'} determined; {last}"


def _power(name, factors):
    """name · Π p^−x."""
    above, below = [name], []
    for p, x in factors:
        (below if x > 0 else above).append(p if abs(x) == 1 else f"{p}^{abs(x) if abs(x).denominator == 1 else f'({abs(x)})'}")
    under = below[0] if len(below) == 1 else f"({' '.join(below)})"
    return " ".join(above) + (f"/{under}" if below else "")


def _sum(name, terms):
    """name − Σ x p."""
    said = name
    for p, x in terms:
        said += f" {'-' if x > 0 else '+'} {p if abs(x) == 1 else f'{abs(x)} {p}'}"
    return said


def _listed(names: Sequence[Any]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
