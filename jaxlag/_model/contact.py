"""Unilateral contact, as the user states it."""

import dataclasses
from collections.abc import Callable
from typing import Any

from .injection import check_function
from .numbers import number


@dataclasses.dataclass(frozen=True)
class NewtonRestitution:
    """Newton's law of restitution: a contact departs e times as fast as it approached."""


@dataclasses.dataclass(frozen=True)
class PoissonRestitution:
    """Poisson's law of restitution: in the expansion, a contact gives back e times its impulse of the compression."""


@dataclasses.dataclass(frozen=True)
class Contact:
    r"""A contact that pushes and never pulls, and the restitution of its impacts.

    $$ g(t, q) \ge 0, \qquad \lambda \ge 0, \qquad g\,\lambda = 0; \qquad
       \dot g^+ + e\,\dot g^- \ge 0, \quad \Lambda \ge 0, \quad (\dot g^+ + e\,\dot g^-)\,\Lambda = 0 \text{ in an impact} $$

    **Arguments:** `gap`: g(t, q), a real number, the distance to the obstacle; negative inside of it; or an array of such gaps, each a
    contact of its own. `restitution`: e from 0 to 1, a number, or a function of `params`, their entries and `speed`, the rate −ġ⁻ of
    approach; of several gaps an array, if it is not the same for all. Values outside this range are clipped to it. `law`:
    `NewtonRestitution()`, the law above, or `PoissonRestitution()`: a compression, which is an impact with e = 0, and then an
    expansion, in which the contact gives back Λ ≥ e Λᶜ. They differ if impacts are coupled by friction or other contacts; in Poisson's law
    a contact that does not approach receives nothing from the restitution of others. Any consistent units.

    Simultaneous impacts, and contacts that are already closed, follow Moreau's law: one complementarity problem for all of them. Pass
    contacts to a system by name: `System(..., unilateral={"table": Contact(gap, restitution=0.8)})`.

    **Raises:** `TypeError` or `ValueError` if `gap` is no function, or `restitution` neither a function nor a number from 0 to 1.

    **Source:** Glocker, Set-Valued Force Laws, chapters 5 and 10; Moreau, in Nonsmooth Mechanics and Applications (1988); Pfeiffer &
    Glocker, Multibody Dynamics with Unilateral Contacts, chapter 8 (Poisson's law).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    ball = jl.System(
        lambda q, qdot, m, g: 0.5 * m * qdot**2 - m * g * q, unilateral={"floor": jl.Contact(lambda q: q, restitution=lambda e: e)}
    )
    motion = jl.simulate(ball, 1.0, 0.0, jnp.linspace(0, 1, 11), {"m": 1.0, "g": 9.81, "e": 0.8})
    motion.contacts["floor"].impacts[-1]  # 1
    motion.contacts["floor"].changed[-1]  # √(2 h/g) = 0.4515
    ```
    """

    gap: Callable
    restitution: Any = 0.0
    law: NewtonRestitution | PoissonRestitution = NewtonRestitution()

    def __post_init__(self):
        if not isinstance(self.law, (NewtonRestitution, PoissonRestitution)):
            raise TypeError(f"`law` must be `NewtonRestitution()` or `PoissonRestitution()`, but is {self.law!r}. Take one of these.")
        check_function(self.gap, "`gap`")
        if callable(self.restitution):
            check_function(self.restitution, "`restitution`")
            return
        given = number(self.restitution, "`restitution`", least=0.0, cure="Take a number from 0 to 1, or a function of params.")
        if given > 1:
            raise ValueError(f"`restitution` must be from 0 to 1, but is {float(given):g}. An impact gives back no more than it takes.")
        object.__setattr__(self, "restitution", float(given))
