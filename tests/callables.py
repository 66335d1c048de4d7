"""Functions of systems that are objects: one that is called, and one with a method."""

import dataclasses

import equinox as eqx


class Spring(eqx.Module):
    """A system's function with numbers in it."""

    c: float

    def __call__(self, q, qdot):
        return 0.5 * qdot**2 - 0.5 * self.c * q**2


@dataclasses.dataclass(frozen=True)
class Stiff:
    """An object with a method that is a force."""

    c: float

    def force(self, q):
        return -self.c * q
