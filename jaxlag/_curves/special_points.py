"""The special points of a curve: found between two of its points, and located."""

import itertools
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np

from .arclength import Correct, Corrected, Point, corner
from .critical import FLIP, FOLD, TORUS, borders_of, critical_matrix
from .curve import NOTHING

BRANCH, CORNER = "branch point", "corner"
SURE = 1e-6  # by which a multiplier must be off its critical value at both ends
SHARP = 1e-13  # of the way between two points, to which a special point is located


class Special(NamedTuple):
    """A special point: its kind, where it is, the vectors that border its critical matrix there, and the corners before and behind it."""

    kind: str
    at: Point
    borders: tuple[np.ndarray, np.ndarray]
    corners: tuple[tuple, tuple]


Changes = Callable[[Correct, Point, Point], Iterable[Special]]


def with_special_points(correct: Correct, runs: list[list[Point]], changes: Changes) -> tuple[list[Point], dict[int, Special]]:
    """The points of a curve with the special ones among them, and these by their number; `changes` finds those between two of a run."""
    points, special = [], {}
    for run in runs:
        points.append(run[0])
        for here, after in itertools.pairwise(run):
            chord = (after.z - here.z) / here.scale
            for at in sorted(changes(correct, here, after), key=lambda at: (at.at.z - here.z) / here.scale @ chord):
                special[len(points)] = at
                points.append(at.at)
            points.append(after)
    return points, special


def changes_of_orbits(correct: Correct, here: Point, after: Point) -> Iterator[Special]:
    """The special points between two orbits. Where corners change, nothing else is sought."""
    if here.corners != after.corners:
        yield Special(CORNER, corner(correct, here, after), (NOTHING, NOTHING), (here.corners, after.corners))
        return
    yield from folds_and_branches(correct, here, after)
    multipliers = [np.linalg.eigvals(point.J[:, :-1] + np.eye(len(point.J))) for point in (here, after)]
    i, j = np.triu_indices(len(here.J), 1)
    for kind, off in ((FLIP, lambda m: m + 1), (TORUS, lambda m: m[i] * m[j] - 1)):
        if min(np.min(np.abs(off(m)), initial=np.inf) for m in multipliers) > SURE:
            found = _singular(correct, here, after, kind)
            if found is not None and (kind == FLIP or _is_pair(found.J[:, :-1])):
                yield Special(kind, found, borders_of(critical_matrix(kind, found.J[:, :-1])), (here.corners, after.corners))


def folds_and_branches(correct: Correct, here: Point, after: Point) -> Iterator[Special]:
    """Where the curve turns back between two points, and where another one crosses it."""
    tangents = here.direction[-1], after.direction[-1]
    turns = tangents[0] * tangents[1] < 0 and min(map(abs, tangents)) > SURE
    for kind in (*([FOLD] if turns else []), BRANCH):
        found = _singular(correct, here, after, kind)
        if found is not None:
            yield Special(kind, found, borders_of(found.J[:, :-1]), (here.corners, after.corners))


def located(correct: Correct, here: Point, after: Point, test: Callable[[Corrected | Point], float]) -> Point | None:
    """The point between two others where a function of it changes its sign; None if it does not, or a point in between is not found."""
    from scipy.optimize import brentq  # imported here because that takes a while

    chord = (after.z - here.z) / here.scale
    chord = chord / np.linalg.norm(chord)

    def at(part):
        found = correct(here.z + part * (after.z - here.z), chord, here.scale, counted=False)
        if not found.found:
            raise _NotFound
        return found

    if not test(here) * test(after) < 0:
        return None
    try:
        found = at(float(brentq(lambda part: test(at(part)), 0.0, 1.0, xtol=SHARP)))
    except (_NotFound, ValueError):
        return None
    along = here.direction * here.scale / found.scale
    return Point(found.z, found.J, along / np.linalg.norm(along), found.scale, here.corners)


def _singular(correct: Correct, here: Point, after: Point, kind: str) -> Point | None:
    """The point where the determinant of the critical matrix changes its sign; of a branch point, of the Jacobian with the tangent."""
    tangents = (here.direction[None], after.direction[None])

    def matrix(J, tangent):
        return np.concatenate([J * here.scale, tangent]) if kind == BRANCH else critical_matrix(kind, J[:, :-1])

    if here.J.shape[0] + 1 != here.J.shape[1]:
        return None  # constraints that depend on each other
    signs = [np.linalg.slogdet(matrix(point.J, tangent))[0] for point, tangent in zip((here, after), tangents, strict=True)]
    if not signs[0] * signs[1] < 0:
        return None
    size = np.linalg.slogdet(matrix(here.J, tangents[0]))[1]

    def test(found):
        sign, log = np.linalg.slogdet(matrix(found.J, tangents[0] + tangents[1]))
        return float(sign * np.exp(log - size))

    return located(correct, here, after, test)


def _is_pair(change: np.ndarray) -> bool:
    """Whether the multipliers nearest to the unit circle are complex."""
    multipliers = np.linalg.eigvals(change + np.eye(len(change)))
    i, j = np.triu_indices(len(change), 1)
    nearest = i[np.argmin(np.abs(multipliers[i] * multipliers[j] - 1))]
    return bool(abs(multipliers[nearest].imag) > SURE)


class _NotFound(Exception):
    """Newton's method finds no point between two."""
