"""The state behind a jump of an input or of a sampled state."""

import jax.numpy as jnp

from .._mechanics.power import energy_exchange
from .._mechanics.return_mapping import returned
from .._mechanics.stick_slip import select_mode, slip_of, sticking
from .._model.system import EXPLICIT_TIME
from .._program.jit import jitted
from .first_order import EquationsOfMotion
from .mode_changes import behind_contact, in_other_mode
from .protocol import Arguments


@jitted
def after_jump(equations: EquationsOfMotion, t, y0, y, before: Arguments, args: Arguments):
    """y behind a jump of inputs or sampled states at t, and whether a friction mode is consistent with the forces there.

    `y0` and `before` are y and the arguments before the jump; y differs from y0 in sampled states, or in what an event has changed.

    A velocity constraint that jumps takes q̇ along by an impulse, which is the projection in the metric of M. Friction is bounded and
    has no part in it: where there is slip afterwards, it goes on; where there is none, it sticks or breaks away.
    """
    parts = equations.parts(y)
    flat, elements = equations.contents(t, parts, args)
    if equations.works:
        there = equations.parts(y0)
        earlier = equations.flat(before.params, equations.states_of(t, there))
        lift = energy_exchange(flat, t, parts.q, parts.v)[0] - energy_exchange(earlier, t, there.q, there.v)[0]
        parts = parts._replace(works=parts.works.at[equations.works.index(EXPLICIT_TIME)].add(lift))
    slipping = parts._replace(sigma=parts.sigma if elements is None else jnp.where(elements.massless >= 0, parts.sigma, 1))
    if equations.contacts:
        assert args.scales is not None  # contacts are located
        moved = equations.parts(equations.projected(t, parts.y, args))
        errors = args.scales.of_positions(moved.q), args.scales.of_velocities(moved.v)
        nothing = jnp.zeros(equations.elements, bool), jnp.zeros(equations.contacts, bool)
        change = behind_contact(equations, t, moved, args, *nothing, errors, anew=True)
        return change.y, change.consistent & change.dissipates & change.impulsive
    held = equations.projection is not None and (equations.system.constraints or equations.light)
    moved = equations.parts(equations.projected(t, slipping.y, args)) if held else slipping
    if elements is None:
        return moved.y, jnp.array(True)
    assert args.scales is not None  # friction is located
    moved = moved._replace(q=returned(flat, elements, t, moved.q, moved.v))
    q, v = moved.q, moved.v
    slip = elements.slip(t, q, v)
    size = elements.norms(slip)
    direction = slip / jnp.where(size > 0, size, 1)[elements.element_of_row]
    at_rest = elements.is_quasistatic | (size <= slip_of(elements, t, q, v, args.scales.of_velocities(v)))
    breaking = elements.is_quasistatic & ~sticking(elements, parts.sigma)
    mode, _ = select_mode(flat, elements, t, q, v, direction, at_rest, breaking)
    y = in_other_mode(elements, moved._replace(sigma=parts.sigma), mode).y
    return equations.in_new_mode(t, y, args), mode.consistent
