"""The state behind a jump of an input."""

import jax.numpy as jnp

from .._mechanics.power import energy_exchange
from .._mechanics.stick_slip import select_mode, slip_of
from .._model.system import EXPLICIT_TIME
from .._program.jit import jitted
from .first_order import EquationsOfMotion, in_other_mode
from .protocol import Arguments


@jitted
def after_jump(equations: EquationsOfMotion, t, y, before: Arguments, args: Arguments):
    """y behind a jump of an input at t, from the arguments `before` it, and whether a friction mode is consistent with the forces there.

    A velocity constraint that jumps takes q̇ along by an impulse, which is the projection in the metric of M. Friction is bounded and
    has no part in it: where there is slip afterwards, it goes on; where there is none, it sticks or breaks away.
    """
    q, v, works, sigma, *counts = equations.parts(y)
    flat, _, elements = equations.mode(t, q, v, sigma, args)
    if equations.works:
        lift = energy_exchange(flat, t, q, v)[0] - energy_exchange(equations.flat(before.params), t, q, v)[0]
        works = works.at[equations.works.index(EXPLICIT_TIME)].add(lift)
    slipping = jnp.concatenate([q, v, works, jnp.ones_like(sigma), *counts])
    y = slipping if equations.projection is None else equations.projected(t, slipping, args)
    if elements is None:
        return y, jnp.array(True)
    assert args.scales is not None  # friction is located
    q, v, works, *_ = equations.parts(y)
    slip = elements.slip(t, q, v)
    size = elements.norms(slip)
    direction = slip / jnp.where(size > 0, size, 1)[elements.element_of_row]
    at_rest = size <= slip_of(elements, t, q, v, args.scales.error(v))
    mode = select_mode(flat, elements, t, q, v, direction, at_rest, jnp.zeros_like(at_rest))
    y = in_other_mode(equations, elements, jnp.concatenate([q, v, works, sigma, *counts]), mode)
    return equations.projected(t, y, args), mode.consistent
