"""How a motion treats dry friction: exactly, or regularised."""

import dataclasses
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._model.flat import Flat, variant
from .._model.numbers import count, number
from .friction_elements import FrictionElements, find_elements


@dataclasses.dataclass(frozen=True)
class StickSlip:
    """Exact Coulomb friction: sticking, stopping, breaking away at the bound. The default.

    Each nonsmooth term μN|s| of D slips with the force −μN sign(s), and sticks, as a constraint s = 0, while the constraint force stays
    within ±μN. The times of the transitions between the two are located to rounding and differentiated.

    Elements that can share a load in more than one way, such as the legs of a table, hold it as long as one distribution is admissible; the
    motion is the same for all of them. The same holds if normal forces and friction support each other, as at the two ends of a ladder,
    where the bounds change with the distribution. One admissible distribution is reported: for slip velocities of several components, and
    if bounds depend on multipliers, the one that leaves the largest part of all bounds; for others the one of least norm, until an element
    reaches its bound. The distribution is not differentiated.

    **Arguments:** `max_transitions`: limit on changes of mode, beyond which the motion is reported as chattering.

    **Raises:** `TypeError` or `ValueError` if `max_transitions` is not a whole number of 0 or more.

    **Source:** Pfeiffer & Glocker, Multibody Dynamics with Unilateral Contacts, chapters 5 and 6; for shares Moreau, Application of
    convex analysis to some problems of dry friction (1979).

    ```python
    import jaxlag as jl
    jl.StickSlip(max_transitions=100)
    ```
    """

    max_transitions: int = 10_000

    def __post_init__(self):
        count(self.max_transitions, "`max_transitions`", least=0, cure="The default is 10_000.")

    def elements(self, flat: Flat) -> FrictionElements | None:
        """What sticks and slips."""
        return find_elements(flat)

    def smoothed(self, flat: Flat, t: Any, q: Float[Array, " n"], v: Float[Array, " n"]) -> Flat:
        """The system itself: without elements that stick there is nothing to smooth."""
        return flat


@dataclasses.dataclass(frozen=True)
class Regularised:
    """Regularised dry friction: |s| becomes √(s² + w²) − w, with the force −F s/√(s² + w²).

    It cannot hold a load: under a force f < F it creeps at the velocity w f/√(F² − f²), that is w/√3 at half the bound. It also makes
    the equations stiff, with a time constant of m w/F.

    **Arguments:** `width`: the velocity w, in the units of s.

    **Raises:** `TypeError` or `ValueError` if `width` is not a positive number.

    **Source:** Armstrong-Hélouvry, Dupont & Canudas de Wit, Automatica 30 (1994) 1083-1138.

    ```python
    import jaxlag as jl
    jl.Regularised(width=1e-4)
    ```
    """

    width: float

    def __post_init__(self):
        width = number(self.width, "`width`", positive=True, cure="Take some thousandths of the velocities that occur.")
        object.__setattr__(self, "width", float(width))

    def elements(self, flat: Flat) -> None:
        """None: nothing sticks."""

    def smoothed(self, flat: Flat, t: Any, q: Float[Array, " n"], v: Float[Array, " n"]) -> Flat:
        """The system with smooth friction."""
        elements = find_elements(flat)
        if elements is None:
            return flat

        def extent(t, q, v):
            return jnp.sqrt(elements.sums(elements.slip(t, q, v) ** 2) + self.width**2) - self.width

        def smooth(D):
            return lambda t, q, v, multipliers: D(t, q, v, multipliers, extent(t, q, v))

        return variant(flat, self.smoothed, dissipations={name: smooth(D) for name, D in elements.potentials.items()})
