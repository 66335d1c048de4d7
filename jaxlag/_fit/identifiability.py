"""Which parameters, and which combinations of them, the measurements determine: the algebra of the Jacobian's null space."""

import fractions
import itertools
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from .base_parameters import NOISE, ROUNDING, Combination, Places, Point, base_parameters, column_space, parts_of

MANY = 12  # parameters; among more, no combinations are looked for
ZERO = 1e-9  # singular values below this part of the largest are zero: columns have norm one, and are as exact as the integration
ZERO_ULPS = 300  # or this many units in the last place, in single precision
VISIBLE = 1e-6  # of the largest derivative, by which what is predicted depends on what is not determined


class Determined(NamedTuple):
    """What the measurements determine of all unknowns.

    `covariance` over σ², (x, x); `determined`, (x,): whether each unknown is; `null`, (x, k): directions that do not show, as columns;
    `noise`: their error, relative.
    """

    covariance: np.ndarray
    determined: np.ndarray
    null: np.ndarray
    noise: float = 0.0

    def deviations(self, J: np.ndarray, columns: Any = slice(None)) -> np.ndarray:
        """√(J cov Jᵀ) over σ of what depends on the unknowns `columns` by the rows J; infinite where it depends on what does not show."""
        finite = np.all(np.isfinite(J), axis=1)
        J = np.where(finite[:, None], J, 0)
        variance = np.einsum("ij,jk,ik->i", J, self.covariance[columns][:, columns], J)
        loose = np.any(np.abs(J @ self.null[columns]) > VISIBLE * np.max(np.abs(J), initial=1e-300), axis=1)
        return np.where(finite, np.where(loose, np.inf, np.sqrt(np.maximum(variance, 0))), np.nan)


def rounding_of(dtype: Any) -> float:
    """What counts as zero beside one, of derivatives in this precision."""
    return max(ZERO, ZERO_ULPS * float(np.finfo(dtype).eps))


def determined_by(J: np.ndarray, gaps_J: np.ndarray, hidden: int | None = None, precision: Any = None) -> Determined:
    """(JᵀJ)⁻¹ among the changes that open no gap, without the directions that do not show; how many these are, unless `hidden` says so.

    `precision`: the type of numbers that J was computed in, if it is not its own.
    """
    zero = rounding_of(precision or J.dtype)
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
    noise = np.max(s[weak], initial=0) / np.min(s[~weak], initial=np.inf)
    return Determined(inverse * np.outer(scale, scale), np.all(np.abs(null) < 1e-4, axis=1), null * scale[:, None], float(noise))


def correlation_of(covariance: np.ndarray) -> np.ndarray:
    """Correlations; NaN for what is not determined."""
    errors = np.sqrt(np.diag(covariance))
    errors = np.where(np.isfinite(errors) & (errors > 0), errors, np.nan)
    return np.where(np.isfinite(covariance), covariance, np.nan) / np.outer(errors, errors)


class Group(NamedTuple):
    """Parameters, by their indices, that can change together along `directions`, (len(joint), k), but with no others.

    `combinations`: what of them is determined, where it is simple; `common_factor`: whether nothing else than a common factor is not.
    """

    joint: list[int]
    directions: np.ndarray
    combinations: tuple[Combination, ...] = ()
    common_factor: bool = False


class Undetermined(NamedTuple):
    """Which of the parameters the measurements do not determine, by their indices.

    - `idle`: those that no measurement depends on. `with_start`: those that trade with the unknown starts.
    - `groups`: the others.
    """

    idle: list[int]
    with_start: list[int]
    groups: list[Group]

    @property
    def combinations(self) -> list[Combination]:
        """What of the groups is determined."""
        return [combination for group in self.groups for combination in group.combinations]


def undetermined(points: Iterable[Point], determined: Sequence[int] = (), idle: Sequence[int] = (), noise: float = 0.0) -> Undetermined:
    """Sorts the changes of θ that do not show.

    **Arguments:**

    - `points`: θ and those changes, as columns: the estimate first, then points around it, of which no more are asked for than are needed.
      Where the changes are the same at all points relative to θ, products of the parameters are determined; otherwise polynomials are
      looked for.
    - `determined`: parameters that are. `idle`: those that no measurement depends on. `noise`: of the changes.

    **Source:** Walter & Pronzato, Identification of Parametric Models (1997), section 2.6 (structural identifiability).
    """
    points, tolerance = iter(points), max(ROUNDING, NOISE * noise)
    begin, fixed = list(itertools.islice(points, 2)), [*idle, *determined]
    spaces = [space for _, space in Places(begin, fixed, tolerance).first(2)]
    with_start = [i for i in range(len(spaces[0])) if all(_is_alone(i, space) for space in spaces)]
    places = Places(itertools.chain(begin, points), [*fixed, *with_start], tolerance)
    ((_, space),) = places.first(1)
    return Undetermined(list(idle), with_start, [_group(joint, determined, places) for joint in parts_of(space)])


def _is_alone(i, space):
    """Whether a change of parameter i alone does not show."""
    e = np.eye(len(space))[:, i]
    return np.linalg.norm(e - space @ (space.T @ e)) < 1e-5


def _group(joint, determined, places):
    """Products of the joint parameters that are determined, or polynomials; neither where there are no simple ones, or too many."""
    ((_, space),) = places.first(1)
    group = Group(joint, column_space(space[joint]) * places.scale[joint, None])
    if len(joint) > MANY:
        return group
    found = _products(joint, places)
    if found is not None:
        return group._replace(combinations=found[0], common_factor=found[1])
    return group._replace(combinations=base_parameters(joint, determined, places) or ())


def _products(joint, places):
    """θ_i Π θ_j^−x, and whether all are ratios of one θ_j; None where the changes are not the same everywhere."""
    points = places.first(3)
    if len(points) < 2 or any(np.any(theta[joint] == 0) for theta, _ in points):
        return None
    first, *others = [column_space(space[joint] / theta[joint, None]) for theta, space in points]
    if any(first.shape != other.shape or np.linalg.norm(first - other @ (other.T @ first)) > 1e-4 for other in others):
        return None
    simplest = _simplest(first)
    if simplest is None or len(simplest[0]) == len(joint):
        return None
    pivots, exact = simplest
    if any(not any(row) for i, row in enumerate(exact) if i not in pivots):  # which would be determined alone, but is not everywhere
        return None
    exponents = np.zeros((len(joint), places.scale.size), object)
    exponents[range(len(joint)), joint] = 1
    exponents[:, [joint[p] for p in pivots]] -= np.array(exact, object)
    products = tuple(Combination((fractions.Fraction(1),), (tuple(row),)) for i, row in enumerate(exponents) if i not in pivots)
    return products, all(x == 1 for row in exact for x in row)


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
