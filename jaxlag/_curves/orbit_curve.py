"""A curve of periodic motions as it is followed: with numbers that are known."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._program.jit import is_concrete
from .._program.jit import values as known_values
from .arclength import Corrected, Followed, Point, followed, started
from .critical import FLIP, FOLD, borders_of, critical_matrix
from .measures import Measure
from .orbits import ORDINARY, Family, Numbers, Plane, Telling, Told, corrected, told
from .special_points import NOTHING

TURNS = 8  # of Newton's method, after which a step is shortened
LEAVES = (1e-3, 1e-2, 5e-2)  # steps from a special point onto the branch that crosses there


class Asked(NamedTuple):
    """What is asked of a curve: the parameter, between which values, what is measured from how many samples, and the most points."""

    over: str
    bounds: tuple[float, float]
    measures: tuple[Measure, ...]
    samples: int
    steps: int


class OrbitCurve:
    """Points of a curve, as `arclength` asks for them."""

    def __init__(self, family: Family, asked: Asked, numbers: Numbers):
        self.family, self.asked, self.numbers = family, asked, numbers
        known = known_values(numbers)
        if known is None:
            raise ValueError(
                "`params` must be known to follow a curve, but are hidden by `jit` or one set of many under `vmap`. "
                "Call `response_curve` from Python, for one set after the other."
            )
        self.known, self.usual, self.dtype = known, float(known.usual), known.given.t.dtype
        self.kept: dict[bytes, Told] = {}

    def near(self, z: np.ndarray, tangent: np.ndarray, scale: np.ndarray, turns: int = TURNS) -> Any:
        """What Newton's method finds in a plane through z."""
        plane = self.plane(z, tangent, scale)
        near = corrected(self.family, self.known._replace(usual=jnp.asarray(self.usual, self.dtype)), plane, jnp.asarray(turns))
        return jax.tree.map(np.asarray, near)

    def __call__(self, z: np.ndarray, tangent: np.ndarray, scale: np.ndarray, turns: int = TURNS, counted: bool = True) -> Corrected:
        """The same, with what is counted along the orbit that was found."""
        near, corners, found = self.near(z, tangent, scale, turns), (), True
        if near.found and counted:
            counts = np.array(self.told(near.z, tangent, near.scale).counts, float)
            found = bool(np.all(np.isfinite(counts)))
            corners = tuple(counts.astype(int).tolist()) if found else ()
        if near.found and found:
            self.usual = float(near.time)
        return Corrected(near.z, near.J, bool(near.found) and found, int(near.turns), near.scale, corners)

    def told(self, z: np.ndarray, tangent: np.ndarray, scale: np.ndarray) -> Told:
        """What is told of the orbit at z, of known numbers."""
        if z.tobytes() not in self.kept:
            point = Point(z, np.zeros(0), tangent, scale, ())
            self.kept[z.tobytes()] = self._told(self.known, point, ORDINARY, (NOTHING, NOTHING))
        return self.kept[z.tobytes()]

    def shown(self, point: Point, kind: str = ORDINARY, borders: tuple[np.ndarray, np.ndarray] = (NOTHING, NOTHING)) -> Told:
        """What is told of the orbit at a point, differentiable as one of this kind."""
        if is_concrete(self.numbers):
            return self.told(point.z, point.tangent, point.scale)
        return self._told(self.numbers, point, kind, borders)

    def _told(self, numbers: Numbers, point: Point, kind: str, borders: Any) -> Told:
        telling = Telling(self.asked.measures, self.asked.samples, kind)
        plane = self.plane(point.z, point.tangent, point.scale, borders)
        return told(self.family, telling, numbers._replace(usual=jnp.asarray(self.usual, self.dtype)), plane)

    def plane(self, z: Any, tangent: Any, scale: Any, borders: Any = (NOTHING, NOTHING)) -> Plane:
        """A plane of numbers of the kind that motions are computed in."""
        return jax.tree.map(lambda x: jnp.asarray(x, self.dtype), Plane(z, tangent, scale, borders))

    def through(self, z: np.ndarray) -> tuple[Followed, Followed] | None:
        """The curve through z, backward and forward."""
        k = len(z) - 1
        scale = self.near(z, np.append(np.zeros(k), 1.0), np.append(np.ones(k), 1.0), 0).scale
        starts = [started(self, z, scale, direction) for direction in (-1, 1)]
        back, on = (None if at is None else followed(self, at, self.asked.bounds, self.asked.steps) for at in starts)
        return None if back is None or on is None else (back, on)

    def at_parameter(self, z: np.ndarray) -> Point | None:
        """The point near z at the parameter of z."""
        k = len(z) - 1
        scale = self.near(z, np.append(np.zeros(k), 1.0), np.append(np.ones(k), 1.0), 0).scale
        return started(self, z, scale, 1, pinned=True)

    def across(self, z: np.ndarray, kind: str) -> list[Followed]:
        """The other curve through a special point z, to each side that it leaves it to; of twice the turns, from a flip."""
        k = len(z) - 1
        at = self.near(z, np.append(np.zeros(k), 1.0), np.ones(k + 1), 0)
        J = at.J * at.scale
        if kind == FLIP:
            way = np.append(borders_of(critical_matrix(FOLD, J[:, :-1]))[1], 0.0)
        else:
            way = min(np.linalg.svd(J)[2][-2:], key=lambda free: abs(free[-1]))
        sides = []
        for side in (way, -way)[: 1 if kind == FLIP else 2]:
            for step in LEAVES:
                found = self(z + step * at.scale * side, side, at.scale)
                if found.found:
                    first = Point(found.z, found.J, side, found.scale, found.corners)
                    sides.append(followed(self, first, self.asked.bounds, self.asked.steps))
                    break
        return sides
