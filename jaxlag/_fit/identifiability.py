"""Which parameters, and which combinations of them, the measurements determine: the algebra of the Jacobian's null space."""

import fractions
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

MANY = 12  # parameters; among more, no combinations are looked for
ZERO = 1e-9  # singular values below this part of the largest are zero: columns have norm one, and are as exact as the integration
ZERO_ULPS = 300  # or this many units in the last place, in single precision
NEGLIGIBLE = 1e-6  # entries of a null vector, relative to the parameters, that count as zero


class Determined(NamedTuple):
    """What the measurements determine of all unknowns.

    `covariance` over σ², (x, x); `determined`, (x,): whether each unknown is; `null`, (x, k): directions that do not show, as columns.
    """

    covariance: np.ndarray
    determined: np.ndarray
    null: np.ndarray


def determined_by(J: np.ndarray, gaps_J: np.ndarray, hidden: int | None = None) -> Determined:
    """(JᵀJ)⁻¹ among the changes that open no gap, without the directions that do not show; how many these are, unless `hidden` says so."""
    zero = max(ZERO, ZERO_ULPS * float(np.finfo(J.dtype).eps))
    J, gaps_J = J.astype(float), gaps_J.astype(float)
    size = np.linalg.norm(J, axis=0)
    scale = np.where(size > 0, 1 / np.where(size > 0, size, 1), 1)
    basis = np.eye(size.size)
    if len(gaps_J):
        _, s, Vt = np.linalg.svd(gaps_J * scale)
        basis = Vt[int(np.sum(s > zero * s[0])) :].T
    R = np.linalg.qr(np.asarray(J) * scale @ basis, mode="r")  # has the singular values of all the rows
    _, s, Vt = np.linalg.svd(R)
    s = np.concatenate([s, np.zeros(basis.shape[1] - s.size)])
    weak = s <= zero * max(s[0], 1e-300) if hidden is None else np.arange(s.size) >= s.size - hidden
    directions = basis @ Vt.T
    inverse = directions[:, ~weak] / s[~weak] ** 2 @ directions[:, ~weak].T
    null = directions[:, weak]
    return Determined(inverse * np.outer(scale, scale), np.all(np.abs(null) < 1e-4, axis=1), null * scale[:, None])


def correlation_of(covariance: np.ndarray) -> np.ndarray:
    """Correlations; NaN for what is not determined."""
    errors = np.sqrt(np.diag(covariance))
    errors = np.where(np.isfinite(errors) & (errors > 0), errors, np.nan)
    return np.where(np.isfinite(covariance), covariance, np.nan) / np.outer(errors, errors)


class Combinations(NamedTuple):
    """What is determined of some parameters: θ_i Π θ_j^−x, or θ_i − Σ x θ_j; for each the index i, and the pairs (j, x)."""

    products: bool
    common_factor: bool  # whether a common factor is all that is not determined
    terms: tuple[tuple[int, tuple[tuple[int, fractions.Fraction], ...]], ...]


class Undetermined(NamedTuple):
    """Which of the parameters the measurements do not determine, by their indices.

    - `idle`: those that no measurement depends on. `with_start`: those that trade with the unknown starts.
    - `joint`: the others, which can change together along `directions`, (len(joint), k). `combinations`: what of them is determined,
      where it is simple.
    """

    idle: list[int]
    with_start: list[int]
    joint: list[int]
    directions: np.ndarray
    combinations: Combinations | None


def undetermined(theta: np.ndarray, nulls: Sequence[np.ndarray], thetas: Sequence[np.ndarray], idle: Sequence[int] = ()) -> Undetermined:
    """Sorts the changes of θ that do not show.

    `nulls`: at the points `thetas`, those changes, as columns. Where they are the same at two points relative to θ, products of the
    parameters are determined; where they are the same absolutely, sums are. `idle`: parameters that no measurement depends on.

    **Source:** Walter & Pronzato, Identification of Parametric Models (1997), section 2.6 (structural identifiability).
    """
    scale = np.where(theta == 0, 1, np.abs(theta))
    nulls = [_without_idle(null / scale[:, None], idle) * scale[:, None] for null in nulls]
    with_start = [i for i in range(theta.size) if _alone(i, nulls, scale)]
    for null in nulls:
        null[with_start] = 0
    nulls = [null[:, np.linalg.norm(null / scale[:, None], axis=0) > NEGLIGIBLE] for null in nulls]
    joint = [i for i in range(theta.size) if np.max(np.abs(nulls[0][i] / scale[i]), initial=0) > NEGLIGIBLE]
    combinations = _combinations(joint, nulls, thetas) if 0 < len(joint) <= MANY else None
    return Undetermined(list(idle), with_start, joint, nulls[0][joint], combinations)


def _without_idle(null, idle):
    """A basis of the changes among the other parameters."""
    size = np.linalg.norm(null, axis=0)
    null[list(idle)] = 0
    return _column_space(null[:, np.linalg.norm(null, axis=0) > NEGLIGIBLE * size])  # what is left out is rounding


def _alone(i, nulls, scale):
    """Whether a change of parameter i alone does not show."""
    e = np.eye(scale.size)[:, [i]]
    spaces = [null / scale[:, None] for null in nulls]
    return all(space.size and np.linalg.norm(e - space @ (space.T @ e)) < 1e-5 for space in spaces)


def _column_space(A):
    U, s, _ = np.linalg.svd(A, full_matrices=False)
    return U[:, s > 1e-6 * max(s[0], 1e-300)] if s.size else U


def _combinations(joint, nulls, thetas):
    """Products or sums of the joint parameters that are determined; None where there are no simple ones."""
    for products in (True, False):
        units = [theta if products else np.ones_like(theta) for theta in thetas]
        if any(np.any(unit[joint] == 0) for unit in units):
            continue
        spaces = [_column_space((null / unit[:, None])[joint]) for null, unit in zip(nulls, units, strict=True)]
        if spaces[0].shape != spaces[1].shape or np.linalg.norm(spaces[0] - spaces[1] @ (spaces[1].T @ spaces[0])) > 1e-4:
            continue
        simplest = _simplest(spaces[0])
        if simplest is None or len(simplest[0]) == len(joint):
            continue
        pivots, exact = simplest
        factors = {i: tuple((joint[p], x) for p, x in zip(pivots, row, strict=True) if x != 0) for i, row in enumerate(exact)}
        if any(not factors[i] for i in factors if i not in pivots):  # which would be determined alone, but is not everywhere
            continue
        common = products and all(x == 1 for row in exact for x in row)
        return Combinations(products, common, tuple((joint[i], factors[i]) for i in factors if i not in pivots))
    return None


def _simplest(space):
    """Pivots, and each row as small fractions of the pivots' rows; of all choices the one with the smallest numbers."""
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
    return None if best is None else best[1:]
