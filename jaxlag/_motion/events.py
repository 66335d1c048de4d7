"""Events that happen: what is recorded of them, and the state behind."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._mechanics.consistent_state import nearest_state
from .._mechanics.contact import gap_rates, gap_scales, outside
from .._model.flat import Flat
from .._model.state_values import ravelled
from .._program.jit import jitted
from .first_order import EquationsOfMotion
from .jumps import after_jump
from .mode_changes import Change, changed
from .protocol import Arguments
from .scales import Scales
from .state_vector import Parts
from .witnesses import brought_to_zero, changes_states, passing, signs_behind_step, struck, with_seen


def behind_end(equations: EquationsOfMotion, t, y, args: Arguments, ended: Bool[Array, " m"], moved: Float[Array, " m"]) -> Change:
    """y behind the end of modes of friction and contact, and behind the events, that `ended` marks; see `changed`."""
    if not equations.events:
        return changed(equations, t, y, args, ended, moved)
    count, yes = equations.elements + equations.contacts, jnp.array(True)
    modes, passed = jnp.split(ended, [count])
    same = lambda: Change(y, yes, yes, yes, yes)
    change = jax.lax.cond(jnp.any(modes), lambda: changed(equations, t, y, args, modes, moved[:count]), same) if count else same()
    after, consistent = _settled(equations, t, y, change.y, args, passed | struck(equations, y, change.y))
    return change._replace(y=after, consistent=change.consistent & consistent)


def behind_jump(equations: EquationsOfMotion, t, y0, y, before: Arguments, args: Arguments) -> tuple[Float[Array, " y"], Bool[Array, ""]]:
    """y behind a jump of inputs or sampled states, as `after_jump`, and behind the events that come of it."""
    after, consistent = after_jump(equations, t, y0, y, before, args)
    if not equations.events:
        return after, consistent
    after, also = _settled(equations, t, y, after, args, struck(equations, y, after))
    return after, consistent & also


def behind_step(equations: EquationsOfMotion, t, y, args: Arguments) -> Float[Array, " y"]:
    """y at the end of a step, where witnesses that stayed at zero may have left it."""
    if not equations.events:
        return y
    parts = equations.parts(y)
    return parts._replace(sign=signs_behind_step(equations, t, parts, args)).y


def begun(equations: EquationsOfMotion, t, y, args: Arguments) -> tuple[Float[Array, " y"], Bool[Array, ""]]:
    """y at the start, behind the events of witnesses that are `Negative` already and of impacts there; and whether a mode of friction and
    contact is consistent there.
    """
    return _settled(equations, t, y, y, args, struck(equations, None, y), at_start=True)


@jitted
def _settled(equations: EquationsOfMotion, t, seen, y, args: Arguments, passed: Bool[Array, " w"], at_start: bool = False):
    """y behind the events whose witnesses `passed` through zero, and behind those whose witnesses these, or a jump before, have taken to
    the other side, each of them once; and whether a mode of friction and contact is consistent there. What is recorded is the state that
    was `seen` before all this.
    """

    def turn(carry):
        y, consistent, passed, done, _ = carry
        parts = before = equations.parts(y)
        brought = brought_to_zero(equations, t, seen, parts, args)
        parts, happens, done = passing(equations, t, parts, args, passed, brought, done, at_start)
        changing = np.array([event.then is not None for event in equations.watched])
        unmoved = lambda: (parts.y, jnp.array(True))
        move = (lambda: _moved(equations, t, parts, args, happens)) if changing.any() else unmoved
        moves = jnp.any(happens & changing)
        y, fine = jax.lax.cond(moves, move, unmoved)
        consistent &= fine
        if equations.sided and (equations.elements or equations.contacts):  # where forces jump, what sticks may break away, or gaps bend
            selected = lambda: _on_new_sides(equations, t, y, args)
            y, fine = jax.lax.cond(jnp.any(parts.sign != before.sign), selected, lambda: (y, jnp.array(True)))
            consistent &= fine
        return y, consistent, struck(equations, parts.y, y), done, moves

    yes, none = jnp.array(True), jnp.zeros_like(passed)
    carry = with_seen(equations, t, seen, equations.parts(y)).y, yes, passed, none, yes
    most = equations.events if changes_states(equations) else 0
    maybe = lambda _, carry: jax.lax.cond(carry[-1], turn, lambda carry: carry, carry)
    y, consistent, *_ = jax.lax.fori_loop(0, most + 1, maybe, carry)
    return y, consistent


def _on_new_sides(equations: EquationsOfMotion, t, y, args: Arguments):
    """y in the mode of friction and contact that holds on the sides where witnesses are now; gaps that bend there open, or strike."""
    parts = equations.parts(y)
    flat, _ = equations.contents(t, parts, args)
    time, held = equations.on_held_sides(t, parts, args)
    held = held._replace(closed=_still_closed(flat, time, held.q, held.v, held.closed, args.scales))
    after, consistent = after_jump(equations, time, held.y, held.y, args, args)
    after = equations.parts(after)
    return after._replace(q=parts.q, v=after.v if equations.contacts else parts.v).y, consistent


def _moved(equations: EquationsOfMotion, t, parts: Parts, args: Arguments, happens):
    """y with what all of `then` return, one after the other, on the constraints."""
    new = parts
    for i, (name, event) in enumerate(equations.system.events):
        if event.then is None:
            continue
        now, _ = equations.contents(t, new, args)
        q, v, states = now.happened(name, t, new.q, new.v)
        z, u = (ravelled({name: states[name] for name in layout.shapes}, q.dtype) for layout in (equations.states, equations.sampled))
        changed = new._replace(q=q, v=v, z=z, u=u)
        new = jax.tree.map(lambda x, old, i=i: jnp.where(happens[i], x, old), changed, new)
    if equations.system.constraints:
        there, _ = equations.contents(t, new, args)
        q = outside(there, t, new.q, new.v)
        nearest = nearest_state(there._replace(holonomic=there.bilateral), t, q, new.v)
        new = new._replace(q=nearest.q, v=nearest.v, closed=_still_closed(there, t, nearest.q, nearest.v, new.closed, args.scales))
    return after_jump(equations, t, parts.y, new.y, args, args)


def _still_closed(flat: Flat, t, q, v, closed, scales: Scales | None):
    """Which contacts are still closed where q̇ has changed: not those that it opens, or that it makes strike."""
    if not flat.contacts:
        return closed
    assert scales is not None  # contacts are located
    resting = jnp.abs(gap_rates(flat, t, q, v)) <= gap_scales(flat, t, q, v, scales.of_positions(q), scales.of_velocities(v)).rate
    return jnp.where(resting, closed, 0)
