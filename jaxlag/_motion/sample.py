"""Samples of a motion: what a `Trajectory` holds of y, and what tells whether it keeps the guarantees of a motion."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._mechanics.constraint_residuals import off_constraints
from .._mechanics.contact import contact_rows, gap_scales, idle
from .._mechanics.saddle_point import Sound
from .._mechanics.stick_slip import Friction, friction_by_term, slip_of, sticking
from .._model.signal import origin_of
from .._program.implicit import undifferentiated
from .._program.scalarise import scalarised
from .first_order import EquationsOfMotion
from .protocol import Arguments
from .scales import Scales

NEGLIGIBLE = 1e7  # times the tolerance, compared with which a slip of a thousand tolerances is negligible


class Violation(NamedTuple):
    """How far a sample lies beyond the end of its mode, and the scale on which that is small; two per element, one per contact."""

    excess: Float[Array, " m"]
    scale: Float[Array, " m"]

    def beside(self, excess: Float[Array, " c"], scale: Float[Array, " c"]) -> "Violation":
        """With some more."""
        return Violation(jnp.concatenate([self.excess, excess]), jnp.concatenate([self.scale, scale]))


class Sample(NamedTuple):
    """One sample of a motion: what a `Trajectory` holds of it."""

    q: PyTree
    qdot: PyTree
    qddot: PyTree
    multipliers: dict[str, PyTree]
    states: dict[str, PyTree]
    works: dict[str, Array] | None
    friction: dict[str, tuple[Array, Array]]
    contacts: dict[str, tuple[Array, Array, Array, Array]]
    events: dict[str, Array]  # how often they happened
    counts: dict[str, Array]


class Evidence(NamedTuple):
    """What tells whether a sample keeps the guarantees of a motion."""

    sound: Sound
    off: Float[Array, ""]  # the constraints, in the units of their rows
    violation: Violation


def sample_at(equations: EquationsOfMotion, t, y, params, scales: Scales, found: Friction | None = None) -> tuple[Sample, Evidence]:
    """One sample, from y on the constraints, and the friction there, if that is `found` already."""
    parts = equations.parts(y)
    q, v, works, sigma, held = parts.q, parts.v, parts.works, parts.sigma, parts.held
    flat, mode, elements = equations.mode(t, parts, Arguments(params))
    states = equations.states_of(t, parts).values
    friction_states, counts, violation = {}, {}, Violation(jnp.zeros(0), jnp.zeros(0))
    if elements is None:
        qddot, multipliers, sound = equations.accelerated(t, parts, Arguments(params))
    else:
        found = found or equations.friction(t, parts, Arguments(params), stabilised=True)
        qddot, multipliers, sound = found.qddot, found.multipliers, Sound(jnp.array(True), jnp.array(True))
        friction_states = friction_by_term(elements, sigma, held > 0, t, q, v, found)
        stuck, load = sticking(elements, sigma), elements.norms(found.force)
        scale = jnp.where(stuck, jnp.abs(found.bound) + load, slip_of(elements, t, q, v, scales.of_velocities(v, NEGLIGIBLE)))
        excess = jnp.where((held > 0) | idle(flat, elements, sigma, found.bound), 0, -found.margin)
        violation = Violation(jnp.concatenate([excess, -found.bound]), jnp.concatenate([scale, jnp.abs(found.bound)]))
        counts = {"transitions": parts.transitions[0], "time_stuck": parts.time_stuck}
    of_mode = undifferentiated(scalarised(lambda t, q, v, *reach: off_constraints(mode, t, q, v, reach)))
    off = of_mode(t, q, v, scales.of_q, scales.of_v) if equations.projection else jnp.zeros_like(t)
    named = dict(zip(equations.works, works, strict=True)) if equations.works else None
    if equations.contacts:
        violation = violation.beside(*_contact_violation(flat, t, parts, multipliers, scales))
    of_contact = parts.closed > 0.5, parts.impacts, origin_of(params) + parts.changed, parts.impulse
    by_contact = [flat.by_contact(of_gaps) for of_gaps in of_contact]
    contacts = {name: tuple(of_one[name] for of_one in by_contact) for name in flat.contacts}
    events = dict(zip(dict(equations.system.events), parts.happened, strict=False))
    unraveled = flat.unravel(q), flat.unravel(v), flat.unravel(qddot), flat.unravel_multipliers(multipliers)
    sample = Sample(*unraveled, dict(states), named, friction_states, contacts, events, counts)
    return sample, Evidence(sound, off, jax.lax.stop_gradient(violation))


def _contact_violation(flat, t, parts, multipliers, scales):
    """Of each contact, how far it is inside of its obstacle or pulls."""
    closed, forces = parts.closed > 0.5, contact_rows(flat, multipliers)
    allowed = gap_scales(flat, t, parts.q, parts.v, scales.of_positions(parts.q, NEGLIGIBLE), parts.v).gap
    scale = jnp.where(closed, jnp.max(jnp.abs(multipliers), initial=0.0), allowed)
    return jnp.where(closed, -forces, -flat.gaps(t, parts.q)), scale
