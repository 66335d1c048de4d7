"""A curve over a parameter as it is followed: what curves of orbits and of equilibria share."""

import abc
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .._model.paths import leaf_names
from .._program.jit import values as known_values
from .arclength import Corrected, Followed, Point, followed, started
from .in_plane import UNKNOWN, Plane

NOTHING = np.zeros(0)
TURNS = 8  # of Newton's method, after which a step is shortened
LEAVES = (1e-3, 1e-2, 5e-2)  # steps from a special point onto the curve that crosses there
LEAST = 0.1  # of the largest scale of an entry along a curve: its least
ENDS = {
    "bounds": "an end of `values` is reached",
    "closed": "the curve closes",
    "steps": "`steps` were not enough",
    "lost": "nothing was found beyond",
    "start": "it branches off there",
}
Runs = tuple[list[list[Point]], tuple[str, str]]  # points, one after the other in each run, and why the first and the last end


class Curve(abc.ABC):
    """A curve that `arclength` can follow."""

    def __init__(self, bounds: tuple[float, float], steps: int, dtype: Any):
        self.bounds, self.steps, self.dtype = bounds, steps, dtype
        self.largest: Any = 0.0

    @abc.abstractmethod
    def near(self, z: np.ndarray, tangent: np.ndarray, scale: np.ndarray, turns: int, counted: bool) -> Corrected:
        """What Newton's method finds in a plane through z; `counted`: with what is counted along it."""

    def __call__(self, z: np.ndarray, tangent: np.ndarray, scale: np.ndarray, turns: int = TURNS, counted: bool = True) -> Corrected:
        """The same, in scales that an entry which passes zero keeps."""
        near = self.near(z, tangent, scale, turns, counted)
        if not near.found:
            return near
        self.largest = np.maximum(self.largest, near.scale)
        return near._replace(scale=np.maximum(near.scale, LEAST * self.largest))

    def plane(self, z: Any, direction: Any, scale: Any, borders: Any = (NOTHING, NOTHING)) -> Plane:
        """A plane of numbers of the kind that is computed with."""
        return jax.tree.map(lambda x: jnp.asarray(x, self.dtype), Plane(z, direction, scale, borders))

    def scale_at(self, z: np.ndarray) -> np.ndarray:
        """The scales at z; of an entry that is zero there, by what the parameter does to it over all values asked for, or else 1."""
        at = self(z, along_parameter(z), np.append(np.full(len(z) - 1, UNKNOWN), 1.0), 0)
        try:
            moved = np.abs(np.linalg.solve(at.J[:, :-1], at.J[:, -1] * at.scale[-1]))
        except np.linalg.LinAlgError:  # what friction holds, rests anywhere
            moved = np.zeros(len(z) - 1)
        unit = np.append(np.where((moved > 0) & np.isfinite(moved), moved, 1.0), 1.0)
        return np.maximum(np.where(at.scale > UNKNOWN, at.scale, unit), LEAST * self.largest)

    def through(self, z: np.ndarray) -> tuple[Followed, Followed] | None:
        """The curve through z, backward and forward; None if z is not near it."""
        scale = self.scale_at(z)
        starts = [started(self, z, scale, direction) for direction in (-1, 1)]
        back, on = (None if at is None else followed(self, at, self.bounds, self.steps) for at in starts)
        return None if back is None or on is None else (back, on)

    def across(self, z: np.ndarray, way: np.ndarray, sides: int) -> list[Followed]:
        """The curve through a special point z that leaves it along `way`, in units of scale, and to the other side."""
        scale, found = self.scale_at(z), []
        for side in (way, -way)[:sides]:
            for step in LEAVES:
                near = self(z + step * scale * side, side, scale)
                if near.found:
                    first = Point(near.z, near.J, side, near.scale, near.corners)
                    found.append(followed(self, first, self.bounds, self.steps))
                    break
        return found


def along_parameter(z: np.ndarray) -> np.ndarray:
    """The unit vector of the parameter."""
    return np.append(np.zeros(len(z) - 1), 1.0)


def joined(back: Followed, on: Followed) -> Runs:
    """The points of both sides from one start in one order, and why they end."""
    (before, first), (after, last) = back, on
    if "closed" in (first, last):
        return [after if last == "closed" else before], ("closed", "closed")
    return [[*backward(before)[:-1], *after]], (first, last)


def beside(sides: list[Followed]) -> Runs:
    """The points of the sides to which a curve leaves a special point, in one order, and why they end."""
    if len(sides) == 1:
        return [sides[0][0]], ("start", sides[0][1])
    (after, last), (before, first) = sides
    return [backward(before), after], (first, last)


def backward(points: list[Point]) -> list[Point]:
    """The same points in the other order."""
    return [point._replace(direction=-point.direction) for point in points[::-1]]


def known_of(numbers: Any, function: str) -> Any:
    """The numbers as Python may look at them, of what is differentiated the values."""
    known = known_values(numbers)
    if known is None:
        raise ValueError(
            "`params` must be known to follow a curve, but are hidden by `jit` or one set of many under `vmap`. "
            f"Call `{function}` from Python, for one set after the other."
        )
    return known


def place_of(params: PyTree, over: str) -> int:
    """The place of a parameter among the leaves of params."""
    names = leaf_names(params, "params")
    if over not in names or np.shape(jax.tree.leaves(params)[names.index(over)]):
        raise ValueError(f"`over` must name one number of `params`, but is {over!r}. The entries are {', '.join(names)}.")
    return names.index(over)


def refuse_outside(start: Any, bounds: tuple[float, float], over: str) -> None:
    """Raises if a curve would not begin between its bounds."""
    if start is not None and not bounds[0] <= start <= bounds[1]:
        raise ValueError(f"`values` must lie around that of the start, but are {bounds}, and {over} = {start:g} there. Widen them.")
