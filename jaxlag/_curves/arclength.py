"""A curve R(x, p) = 0 of k equations in k unknowns and a parameter, followed by its arc length.

Source: Keller, Numerical solution of bifurcation and nonlinear eigenvalue problems (1977); Allgower & Georg, Introduction to Numerical
Continuation Methods, chapters 6 and 10.
"""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

STEP, LONGEST, SHORTEST = 0.02, 0.04, 1e-5  # of a step: the first, bounds; in these units the values asked for are 1 wide
FEW, MANY = 3, 5  # turns of Newton's method after which the next step is longer or shorter
STRAIGHT = np.cos(np.radians(20))  # between the tangents at the ends of a step
ASIDE = 0.3  # of a step, by which its end may lie beside the tangent
ACROSS = 1e-6  # of its length: what is left of a vector across all tangents
LAST = 40  # points, on whose way a curve must not come back
UNIQUE = 1e-8  # of the largest singular value of a Jacobian, below which another is zero
BEYOND = tuple(SHORTEST * 4.0**i for i in range(7))  # steps that are tried across a corner
AHEAD = (1e-5, 1e-3)  # where the tangent behind a corner is looked for
HALVINGS = 26  # of a step, until a corner in it is located


class Corrected(NamedTuple):
    """What Newton's method finds near z = (x, p): the Jacobian (k, k + 1) there, whether it is a solution, how many turns it took, the
    scales of all entries, and the corners that the solution has passed: whatever is counted along it.
    """

    z: np.ndarray
    J: np.ndarray
    found: bool
    turns: int
    scale: np.ndarray
    corners: tuple


class Point(NamedTuple):
    """A point of a curve, its Jacobian, the unit tangent and the scales in whose units it is one, and its corners."""

    z: np.ndarray
    J: np.ndarray
    direction: np.ndarray
    scale: np.ndarray
    corners: tuple

    def ahead(self, step: float) -> np.ndarray:
        """The point a step along the tangent."""
        return self.z + step * self.scale * self.direction


Correct = Callable[..., Corrected]  # of z, the tangent and the scales of a plane through z; `turns=0` evaluates there
Followed = tuple[list[Point], str]


def started(correct: Correct, z: np.ndarray, scale: np.ndarray, direction: int, pinned: bool = False) -> Point | None:
    """The point at the parameter of z, from which the curve is followed to greater or lesser values; None if none is there. One that is
    `pinned` has its tangent along the parameter.
    """
    along = np.zeros_like(z)
    along[-1] = direction
    found = correct(z, along, scale)
    if not found.found:
        return None
    return Point(found.z, found.J, along, found.scale, found.corners) if pinned else _point(found, along)


def followed(correct: Correct, start: Point, bounds: tuple[float, float], steps: int) -> Followed:
    """Points of the curve from `start` until the parameter leaves its bounds, the curve closes, or there is none beyond; and which."""
    points, step = [start], STEP
    while len(points) <= steps:
        here = points[-1]
        found = correct(here.ahead(step), here.direction, here.scale)
        after = _point(found, here.direction * here.scale) if found.found else None
        if after is None or _turned(here, after) < STRAIGHT or _beside(here, after, step) > ASIDE * step:
            if step > SHORTEST:
                step /= 2
                continue
            after = _behind_corner(correct, points)
            if after is None:
                return points, "lost"
            step = STEP
        elif found.turns <= FEW:
            step = min(1.5 * step, LONGEST)
        elif found.turns >= MANY:
            step = max(step / 1.5, SHORTEST)
        low, high = bounds
        if not low <= after.z[-1] <= high:
            last = _at(correct, here, after, low if after.z[-1] < low else high)
            return [*points, *([last] if last is not None else [])], "bounds"
        if len(points) > 2 and _passes(here, after, start):
            return [*points, start], "closed"
        points.append(after)
    return points, "steps"


def tangent_of(J: np.ndarray, scale: np.ndarray, along: np.ndarray) -> np.ndarray:
    """The unit vector t of J t = 0, in units of `scale`, that goes the way of `along`: of several the nearest to it."""
    J = J * scale
    rows = np.abs(J).max(axis=1, keepdims=True, initial=0.0)
    _, sizes, v = np.linalg.svd(J / np.where(rows > 0, rows, 1))
    free = v[np.concatenate([sizes, np.zeros(len(v) - len(sizes))]) <= UNIQUE * max(sizes[0], 1e-300)] if sizes.size else v
    t = free.T @ (free @ along)
    if np.linalg.norm(t) <= ACROSS * np.linalg.norm(along):  # the curve begins where it turns: either way is one
        t = free[-1] * (np.sign(along[-1]) or 1.0)
    return t / np.linalg.norm(t)


def corner(correct: Correct, here: Point, after: Point) -> Point:
    """The last point of the curve before its corners change, between two points of it; from the side where less happens: the curve is
    smoother there.
    """
    near, way = (here, 1) if sum(here.corners) <= sum(after.corners) else (after._replace(direction=-after.direction), -1)
    low, high, last = 0.0, 2 * float(np.linalg.norm((after.z - here.z) / near.scale)), None
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        found = correct(near.ahead(middle), near.direction, near.scale)
        if found.found and found.corners == near.corners:
            low, last = middle, found
        else:
            high = middle
    at = near if last is None else _point(last, near.direction * near.scale)
    return at._replace(direction=way * at.direction)


def _point(found: Corrected, along: np.ndarray) -> Point:
    """A point with its tangent; `along` has no units."""
    return Point(found.z, found.J, tangent_of(found.J, found.scale, along / found.scale), found.scale, found.corners)


def _turned(here: Point, after: Point) -> float:
    """The cosine of the angle between two tangents."""
    before = here.direction * here.scale / after.scale
    return float(before @ after.direction / np.linalg.norm(before))


def _beside(here: Point, after: Point, step: float) -> float:
    """How far a point lies beside the tangent."""
    return float(np.linalg.norm((after.z - here.ahead(step)) / here.scale))


def _behind_corner(correct: Correct, points: list[Point]) -> Point | None:
    """The next point where the curve has a corner, along the tangent or along that which lies behind the corner, which may turn back."""
    here, ways = points[-1], [points[-1].direction]
    for little in AHEAD:
        beyond = correct(here.ahead(little), here.direction, here.scale, turns=0)
        if np.all(np.isfinite(beyond.J)):
            ways.append(tangent_of(beyond.J, here.scale, here.direction))
    for step in BEYOND:
        for way in (sign * way for way in ways for sign in (1, -1)):
            found = correct(here.z + step * here.scale * way, way, here.scale)
            if not found.found:
                continue
            gone = (found.z - here.z) / here.scale
            if 0 < np.linalg.norm(gone) <= 3 * step and not _is_known(points, found.z):
                return _point(found, way * here.scale)
    return None


def _is_known(points: list[Point], z: np.ndarray) -> bool:
    """Whether a point lies on the way that the curve has come."""
    scale = points[-1].scale
    back = np.array([(point.z - points[-1].z) / scale for point in points[-LAST:]])
    at = (z - points[-1].z) / scale
    length = np.linalg.norm(at)
    for a, b in itertools.pairwise(back):
        along = (b - a) / max(float((b - a) @ (b - a)), 1e-300)
        nearest = a + np.clip((at - a) @ along, 0, 1) * (b - a)
        if np.linalg.norm(at - nearest) < ASIDE * length:
            return True
    return False


def _at(correct: Correct, here: Point, after: Point, bound: float) -> Point | None:
    """The point between two others at this parameter."""
    part = (bound - here.z[-1]) / (after.z[-1] - here.z[-1])
    z = here.z + part * (after.z - here.z)
    z[-1] = bound
    along = np.zeros_like(z)
    along[-1] = np.sign(after.z[-1] - here.z[-1])
    found = correct(z, along, here.scale)
    return _point(found, here.direction * here.scale) if found.found else None


def _passes(here: Point, after: Point, start: Point) -> bool:
    """Whether the start lies between two points, and the curve goes the same way there."""
    off, length = (start.z - here.z) / here.scale, np.linalg.norm((after.z - here.z) / here.scale)
    along = off @ here.direction
    beside = np.linalg.norm(off - along * here.direction)
    return bool(0 < along <= length and beside < 0.2 * length and here.direction @ (start.direction * start.scale / here.scale) > 0)


def bounded(values: Any, label: str = "`values`") -> tuple[float, float]:
    """The two values between which a curve is followed."""
    ends = np.asarray(values, float)
    if ends.shape != (2,) or not np.all(np.isfinite(ends)) or not ends[0] < ends[1]:
        raise ValueError(f"{label} must be two numbers, the lower and the upper end, but is {values!r}. Write e.g. `(0.5, 2.0)`.")
    return float(ends[0]), float(ends[1])
