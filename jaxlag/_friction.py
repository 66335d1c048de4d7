"""Dry friction: the modes of sliding and sticking, and how long each lasts.

    slipping  σ = ±1 (or the direction of slip):  D(u) with u = ‖s‖, smooth;  force −F s/‖s‖, F = ∂D/∂u
    sticking  σ = 0:                              s = 0, a nonholonomic constraint;  force μ, its multiplier, ‖μ‖ ≤ F

In each mode the system is an ordinary one, so the rest of the package need not know of friction.
Source: Pfeiffer & Glocker, Multibody Dynamics with Unilateral Contacts, chapters 5 and 6.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._kinks import Kinks, kinks_of
from ._multipliers import constrained_acceleration
from ._numbers import count, number
from ._system import Flat


def in_mode(flat: Flat, kinks: Kinks, sigma: Float[Array, " r"]) -> Flat:
    """The system in one mode: D with ‖s‖ = σ·s where it slips, and s = 0 among the constraints where it sticks."""
    stuck = sticking(kinks, sigma)
    extent = lambda t, q, v: _extent(kinks, sigma, kinks.slip(t, q, v))

    def slipping(D):
        return lambda t, q, v, multipliers: D(t, q, v, multipliers, extent(t, q, v))

    def nonholonomic(t, q, v):
        held = jnp.where(stuck[kinks.element_of_row], kinks.slip(t, q, v), 0)
        return jnp.concatenate([flat.nonholonomic(t, q, v), held])

    held = {name: flat.rows + rows for name, rows in kinks.own_rows.items()}
    return flat._replace(dissipations={name: slipping(D) for name, D in kinks.lifted.items()}, nonholonomic=nonholonomic, held=held)


def sticking(kinks: Kinks, sigma: Float[Array, " r"]) -> Bool[Array, " e"]:
    """Which elements stick."""
    return norms(kinks, sigma) == 0


def norms(kinks: Kinks, rows: Float[Array, " r"]) -> Float[Array, " e"]:
    """Norm of each element's rows, with a zero derivative at zero."""
    squared = _per_element(kinks, rows**2)
    return jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1)), 0)


def _per_element(kinks, rows):
    return jnp.zeros(kinks.elements, rows.dtype).at[kinks.element_of_row].add(rows)


def _extent(kinks, sigma, slip):
    """u = ‖s‖ of each element: σ s for a single row, which goes on smoothly through s = 0; of several rows σ·s near rest alone."""
    along, norm = _per_element(kinks, sigma * slip), norms(kinks, slip)
    several = np.bincount(kinks.element_of_row) > 1
    near_rest = norm <= jnp.finfo(slip.dtype).tiny ** 0.25
    return jnp.where(sticking(kinks, sigma), 0, jnp.where(several & ~near_rest, norm, along))


class Friction(NamedTuple):
    """At one state in one mode: acceleration and multipliers; force and rate of the slip over the rows; bound, and how far from its end
    the mode is, per element.
    """

    qddot: Float[Array, " n"]
    multipliers: Float[Array, " m"]
    force: Float[Array, " r"]
    slip_rate: Float[Array, " r"]
    bound: Float[Array, " e"]
    margin: Float[Array, " e"]


def friction(flat: Flat, kinks: Kinks, sigma, t, q, v, feedback=None) -> Friction:
    """Friction forces on the slip velocities; `margin` < 0 where the mode has ended: the slip reversed, or the bound exceeded."""
    stuck, of = sticking(kinks, sigma), kinks.element_of_row
    qddot, multipliers, _ = constrained_acceleration(in_mode(flat, kinks, sigma), t, q, v, feedback)
    slip, slip_rate = jax.jvp(kinks.slip, (t, q, v), (jnp.ones_like(t), v, qddot))
    total = lambda u: sum(D(t, q, v, multipliers, u) for D in kinks.lifted.values())
    extent, pull = jax.vjp(lambda slip: _extent(kinks, sigma, slip), slip)
    bound = jax.grad(total)(extent)
    held = multipliers[flat.rows :]
    force = jnp.where(stuck[of], held, -pull(bound)[0])
    slack = 1e2 * jnp.finfo(v.dtype).eps * jnp.abs(bound)
    margin = jnp.where(stuck, bound + slack - norms(kinks, held), _per_element(kinks, sigma * slip))
    return Friction(qddot, multipliers, force, slip_rate, bound, margin)


class Settled(NamedTuple):
    """A mode σ, whether the forces it brings about agree with it, and the bounds."""

    sigma: Float[Array, " r"]
    consistent: Bool[Array, ""]
    bound: Float[Array, " e"]


def settle(flat: Flat, kinks: Kinks, t, q, v, sigma, at_rest: Bool[Array, " e"], breaking: Bool[Array, " e"]) -> Settled:
    """The mode that follows where the elements `at_rest` have no slip: all of them stick, but those `breaking` away at their bound;
    and the one farthest beyond its bound breaks away against its force, one after the other, until none is beyond.
    The others slip on along σ.
    """
    of = kinks.element_of_row
    t, q, v = jax.lax.stop_gradient((t, q, v))

    def release(turn, carry):
        sigma, clearly, *_ = carry
        found = jax.lax.stop_gradient(friction(flat, kinks, sigma, t, q, v))
        over = jnp.where(sticking(kinks, sigma), -found.margin, -jnp.inf)
        worst = jnp.arange(over.size) == jnp.argmax(over)
        beyond = jnp.where(turn == 0, breaking, worst & (over > 0)) & (turn <= kinks.elements)
        clear = clearly | (beyond & (over > 1e-6 * jnp.abs(found.bound)))
        size = norms(kinks, found.force)[of]
        released = jnp.where(beyond[of], -found.force / jnp.where(size > 0, size, 1), sigma)
        # What has clearly broken away has to set off the way it was let go: if not, no mode agrees with its forces (Painlevé).
        backwards = clearly & (_per_element(kinks, found.slip_rate * sigma) < 0)
        agrees = jnp.all(over <= 0) & ~jnp.any(backwards) & jnp.all(jnp.isfinite(found.force))
        return released, clear, agrees, found.bound

    resting = jax.lax.stop_gradient(jnp.where(at_rest[of], 0, sigma))
    nothing = jnp.zeros(kinks.elements, v.dtype)
    start = (resting, nothing > 0, jnp.array(False), nothing)
    sigma, _, consistent, bound = jax.lax.fori_loop(0, kinks.elements + 2, release, start)
    return Settled(sigma, consistent, bound)


def first_mode(flat: Flat, kinks: Kinks, t, q, v) -> Settled:
    """The mode at a start: what moves slips along its motion; what rests sticks, or breaks away."""
    slip = jax.lax.stop_gradient(kinks.slip(t, q, v))
    size = norms(kinks, slip)
    at_rest = size <= 1e2 * jnp.finfo(v.dtype).eps * jnp.max(jnp.abs(v))
    sigma = slip / jnp.where(at_rest, 1, size)[kinks.element_of_row]
    return settle(flat, kinks, t, q, v, sigma, at_rest, jnp.zeros_like(at_rest))


def redirected(kinks: Kinks, sigma, slip):
    """σ of the slipping elements of several rows, turned along with their motion."""
    of = kinks.element_of_row
    several, size = (np.bincount(of) > 1)[of], norms(kinks, slip)[of]
    turns = several & (size > jnp.finfo(slip.dtype).tiny ** 0.25) & ~sticking(kinks, sigma)[of]
    return jnp.where(turns, slip / jnp.where(turns, size, 1), sigma)


def friction_by_term(kinks: Kinks, sigma, t, q, v, found: Friction) -> dict[str, tuple[Array, Array]]:
    """Force on each slip velocity and whether it sticks, by dissipation term. Where several terms rub on one slip velocity, each has
    its share of the force by its bound.
    """
    of, stuck = kinks.element_of_row, sticking(kinks, sigma)
    extent, forces = _extent(kinks, sigma, kinks.slip(t, q, v)), {}
    for name, rows in kinks.rows_of_term.items():
        bound = jax.grad(lambda u, D=kinks.lifted[name]: D(t, q, v, found.multipliers, u))(extent)
        share = bound / jnp.where(found.bound != 0, found.bound, 1)
        shape = () if rows.size == 1 else (rows.size,)
        forces[name] = (share[of[rows]] * found.force[rows]).reshape(shape), stuck[of[rows]].reshape(shape)
    return forces


@dataclasses.dataclass(frozen=True)
class StickSlip:
    """Dry friction as it is: exact sticking, exact stopping, breaking away at the bound. The default.

    Each kink μN|s| of D slips with the force −μN sign(s), sticks as a constraint s = 0 with a multiplier of its own while that is
    within ±μN, and the times at which it changes from one to the other are located to rounding and differentiated.

    **Arguments:** `max_transitions`: changes of mode after which the motion is given up as chattering.

    **Source:** Pfeiffer & Glocker, Multibody Dynamics with Unilateral Contacts, chapters 5 and 6.

    ```python
    import jaxlag as jl
    jl.StickSlip(max_transitions=100)
    ```
    """

    max_transitions: int = 10_000

    def __post_init__(self):
        count(self.max_transitions, "`max_transitions`", least=0, cure="The default is 10_000.")


@dataclasses.dataclass(frozen=True)
class Regularised:
    """Dry friction made smooth: |s| becomes √(s² + w²) − w, of force −F s/√(s² + w²).

    It cannot hold a load: under a force f < F it creeps with the velocity w f/√(F² − f²), that is w/√3 at half the bound. And it makes the
    equations stiff, with a time constant of m w/F.

    **Arguments:** `width`: the velocity w, in the units of s.

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

    def smooth(self, flat: Flat, kinks: Kinks) -> Flat:
        """The system with smooth friction."""

        def extent(t, q, v):
            return jnp.sqrt(_per_element(kinks, kinks.slip(t, q, v) ** 2) + self.width**2) - self.width

        def smoothed(D):
            return lambda t, q, v, multipliers: D(t, q, v, multipliers, extent(t, q, v))

        return flat._replace(dissipations={name: smoothed(D) for name, D in kinks.lifted.items()})


def settled(flat: Flat, t, q, v) -> Flat:
    """The system in the mode that holds at this state; without dry friction the system as it is."""
    kinks = kinks_of(flat, t, q, v)
    return flat if kinks is None else in_mode(flat, kinks, first_mode(flat, kinks, t, q, v).sigma)
