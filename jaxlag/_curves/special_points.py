"""The special points of a curve: found between two of its points, and located."""

import itertools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from .arclength import Correct, Point, corner
from .critical import FLIP, FOLD, TORUS, borders_of, critical_matrix

BRANCH, CORNER = "branch point", "corner"
SURE = 1e-6  # by which a multiplier must be off its critical value at both ends
SHARP = 1e-13  # of the way between two points, to which a special point is located
NOTHING = np.zeros(0)


class Special(NamedTuple):
    """A special point: its kind, where it is, the vectors that border its critical matrix there, and the corners before and behind it."""

    kind: str
    at: Point
    borders: tuple[np.ndarray, np.ndarray]
    corners: tuple[tuple, tuple]


def with_special_points(correct: Correct, points: list[Point]) -> tuple[list[Point], dict[int, Special]]:
    """The points of a curve with the special ones among them, and these by their number. Where corners change, nothing else is sought."""
    all_of_them, special = points[:1], {}
    for here, after in itertools.pairwise(points):
        found = list(_between(correct, here, after))
        chord = (after.z - here.z) / here.scale
        for at in sorted(found, key=lambda at: (at.at.z - here.z) / here.scale @ chord):
            special[len(all_of_them)] = at
            all_of_them.append(at.at)
        all_of_them.append(after)
    return all_of_them, special


def _between(correct: Correct, here: Point, after: Point) -> Iterator[Special]:
    """The special points between two points of a curve."""
    corners = here.corners, after.corners
    if here.corners != after.corners:
        yield Special(CORNER, corner(correct, here, after), (NOTHING, NOTHING), corners)
        return
    for kind in _kinds(here, after):
        found = _located(correct, here, after, kind)
        if found is not None:
            A = critical_matrix(FOLD if kind == BRANCH else kind, found.J[:, :-1])
            yield Special(kind, found, borders_of(A), corners)


def _kinds(here: Point, after: Point) -> Iterator[str]:
    """What changes its sign from one point to the next, beyond rounding."""
    changes = [point.J[:, :-1] for point in (here, after)]
    multipliers = [np.linalg.eigvals(change + np.eye(len(change))) for change in changes]
    sign = lambda of: np.sign(of[0]) * np.sign(of[1]) < 0
    tangents = here.tangent[-1], after.tangent[-1]
    if sign(tangents) and min(map(abs, tangents)) > SURE:
        yield FOLD
    if sign([_orientation(point) for point in (here, after)]):
        yield BRANCH
    sure = lambda off: min(np.min(np.abs(off(m)), initial=np.inf) for m in multipliers) > SURE
    if sure(lambda m: m + 1) and sign([np.linalg.slogdet(critical_matrix(FLIP, change))[0] for change in changes]):
        yield FLIP
    i, j = np.triu_indices(len(changes[0]), 1)
    if sure(lambda m: m[i] * m[j] - 1) and sign([np.linalg.slogdet(critical_matrix(TORUS, change))[0] for change in changes]):
        yield TORUS


def _orientation(point: Point) -> float:
    """The sign of the determinant of the Jacobian and the tangent, which changes where branches cross."""
    return float(np.linalg.slogdet(np.concatenate([point.J * point.scale, point.tangent[None]]))[0])


def _located(correct: Correct, here: Point, after: Point, kind: str) -> Point | None:
    """The point where it happens; None if it does not: a pair of real multipliers whose product passes 1 is no torus."""
    from scipy.optimize import brentq  # imported here because that takes a while

    chord = (after.z - here.z) / here.scale
    chord = chord / np.linalg.norm(chord)

    def at(part):
        found = correct(here.z + part * (after.z - here.z), chord, here.scale, counted=False)
        if not found.found:
            raise _NotFound
        return found

    test = _tested(kind, here, after)
    try:
        part = float(brentq(lambda part: test(at(part).J), 0.0, 1.0, xtol=SHARP))
        found = at(part)
    except (_NotFound, ValueError):
        return None
    if kind == TORUS and not _is_pair(found.J[:, :-1]):
        return None
    along = here.tangent * here.scale
    return Point(found.z, found.J, along / found.scale / np.linalg.norm(along / found.scale), found.scale, here.corners)


def _tested(kind: str, here: Point, after: Point) -> Callable[[np.ndarray], float]:
    """The determinant that changes its sign between two points, as a function of the Jacobian; 1 or −1 here."""
    tangent = (here.tangent + after.tangent)[None]

    def matrix(J):
        if kind == BRANCH:
            return np.concatenate([J * here.scale, tangent])
        return critical_matrix(kind, J[:, :-1])

    size = np.linalg.slogdet(matrix(here.J))[1]

    def test(J):
        sign, log = np.linalg.slogdet(matrix(J))
        return float(sign * np.exp(log - size))

    return test


def _is_pair(change: np.ndarray) -> bool:
    """Whether the multipliers nearest to the unit circle are complex."""
    multipliers = np.linalg.eigvals(change + np.eye(len(change)))
    i, j = np.triu_indices(len(change), 1)
    nearest = i[np.argmin(np.abs(multipliers[i] * multipliers[j] - 1))]
    return bool(abs(multipliers[nearest].imag) > SURE)


class _NotFound(Exception):
    """Newton's method finds no point between two."""
