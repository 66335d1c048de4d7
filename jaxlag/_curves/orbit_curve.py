"""A curve of periodic motions as it is followed: with numbers that are known."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._model.event import Every
from .._program.jit import is_concrete
from .arclength import Corrected, Followed, Point, started
from .critical import FLIP, FOLD, borders_of, critical_matrix, crossing
from .curve import NOTHING, Curve, along_parameter, known_of
from .measures import Measure
from .orbits import ORDINARY, Family, Numbers, Telling, Told, corrected, told

BEYOND = 1e-3  # a step beyond the end of a curve


class Asked(NamedTuple):
    """What is asked of a curve: the parameter, between which values, what is measured from how many samples, and the most points."""

    over: str
    bounds: tuple[float, float]
    measures: tuple[Measure, ...]
    samples: int
    steps: int


class OrbitCurve(Curve):
    """Points of a curve of orbits."""

    def __init__(self, family: Family, asked: Asked, numbers: Numbers):
        known = known_of(numbers, "response_curve")
        super().__init__(asked.bounds, asked.steps, known.given.t.dtype)
        self.family, self.asked, self.numbers, self.known = family, asked, numbers, known
        self.times: list[tuple[np.ndarray, float]] = []  # points that were found, and the times of their orbits
        self.kept: dict[bytes, Told] = {}

    def near(self, z: np.ndarray, tangent: np.ndarray, scale: np.ndarray, turns: int, counted: bool) -> Corrected:
        """What Newton's method finds in a plane through z, with what is counted along the orbit."""
        numbers, plane = self.timed(self.known, z, scale), self.plane(z, tangent, scale)
        near = jax.tree.map(np.asarray, corrected(self.family, numbers, plane, jnp.asarray(turns)))
        found, corners = bool(near.found), ()
        if found and counted:
            told = self.told(near.z, tangent, near.scale)
            counts = np.array(told.counts, float)
            found = bool(np.all(np.isfinite(counts)) and np.isfinite(told.period))
            corners = tuple(counts.astype(int).tolist()) if found else ()
        if found:
            self.times.append((near.z, float(near.time)))
        return Corrected(near.z, near.J, found, int(near.turns), near.scale, corners)

    def why(self, point: Point, way: int) -> str:
        """Why nothing is found beyond a point, along its direction or against it."""
        if not isinstance(self.family.map.section, Every):
            return "no periodic motion that passes through the section is near the last one"
        ahead = self.near(point.ahead(way * BEYOND), point.direction, point.scale, 0, False)
        return "no periodic motion is near the last one" if np.all(np.isfinite(ahead.J)) else "motions fail there"

    def told(self, z: np.ndarray, tangent: np.ndarray, scale: np.ndarray) -> Told:
        """What is told of the orbit at z, of known numbers."""
        if z.tobytes() not in self.kept:
            point = Point(z, np.zeros(0), tangent, scale, ())
            self.kept[z.tobytes()] = self._told(self.known, point, ORDINARY, (NOTHING, NOTHING))
        return self.kept[z.tobytes()]

    def shown(self, point: Point, kind: str = ORDINARY, borders: tuple[np.ndarray, np.ndarray] = (NOTHING, NOTHING)) -> Told:
        """What is told of the orbit at a point, differentiable as one of this kind."""
        if is_concrete(self.numbers):
            return self.told(point.z, point.direction, point.scale)
        return self._told(self.numbers, point, kind, borders)

    def _told(self, numbers: Numbers, point: Point, kind: str, borders: Any) -> Told:
        telling = Telling(self.asked.measures, self.asked.samples, kind)
        plane = self.plane(point.z, point.direction, point.scale, borders)
        return told(self.family, telling, self.timed(numbers, point.z, point.scale), plane)

    def timed(self, numbers: Numbers, z: np.ndarray, scale: np.ndarray) -> Numbers:
        """The numbers of a curve, with the time of the orbit that is nearest to z of those found."""
        if not self.times:
            return numbers
        _, time = min(self.times, key=lambda known: float(np.max(np.abs(known[0] - z) / scale)))
        return numbers._replace(usual=jnp.asarray(time, self.dtype))

    def at_parameter(self, z: np.ndarray) -> Point | None:
        """The point near z at the parameter of z."""
        return started(self, z, self.scale_at(z), 1, pinned=True)

    def beside(self, z: np.ndarray, kind: str) -> list[Followed]:
        """The other curve through a special point z, to each side that it leaves it to; of twice the turns, from a flip."""
        scale = self.scale_at(z)
        J = self(z, along_parameter(z), scale, 0).J * scale
        if kind == FLIP:
            return self.across(z, np.append(borders_of(critical_matrix(FOLD, J[:, :-1]))[1], 0.0), sides=1)
        return self.across(z, crossing(J), sides=2)
