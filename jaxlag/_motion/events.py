"""Events that happen: what is recorded of them, and the state behind."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._mechanics.consistent_state import nearest_state
from .._mechanics.contact import gap_rates, gap_scales, outside
from .._model.event import Negative
from .._model.flat import Flat
from .._model.state_values import ravelled
from .._program.jit import jitted
from .first_order import EquationsOfMotion
from .jumps import after_jump
from .mode_changes import Change, changed
from .protocol import Arguments
from .scales import Scales
from .state_vector import Parts
from .witnesses import matching, sides, signs_behind_step


def behind_end(equations: EquationsOfMotion, t, y, args: Arguments, ended: Bool[Array, " m"], moved: Float[Array, " m"]) -> Change:
    """y behind the end of modes of friction and contact, and behind the events, that `ended` marks; see `changed`."""
    if not equations.events:
        return changed(equations, t, y, args, ended, moved)
    count, yes = equations.elements + equations.contacts, jnp.array(True)
    modes, passed = jnp.split(ended, [count])
    same = lambda: Change(y, yes, yes, yes, yes)
    change = jax.lax.cond(jnp.any(modes), lambda: changed(equations, t, y, args, modes, moved[:count]), same) if count else same()
    after, consistent = _settled(equations, t, y, change.y, args, passed | _struck(equations, y, change.y))
    return change._replace(y=after, consistent=change.consistent & consistent)


def behind_jump(equations: EquationsOfMotion, t, y0, y, before: Arguments, args: Arguments) -> tuple[Float[Array, " y"], Bool[Array, ""]]:
    """y behind a jump of inputs or sampled states, as `after_jump`, and behind the events that come of it."""
    after, consistent = after_jump(equations, t, y0, y, before, args)
    if not equations.events:
        return after, consistent
    after, also = _settled(equations, t, y, after, args, _struck(equations, y, after))
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
    return _settled(equations, t, y, y, args, _struck(equations, None, y), at_start=True)


def _struck(equations: EquationsOfMotion, before, y) -> Bool[Array, " w"]:
    """Which events are those of contacts that had an impact between two states."""
    impacts = equations.parts(y).impacts - (0 if before is None else equations.parts(before).impacts)
    names = [name for name, _ in equations.system.unilateral]
    of = [event.when for _, event in equations.system.events]
    return jnp.stack([impacts[names.index(when)] > 0 if isinstance(when, str) else jnp.array(False) for when in of])


@jitted
def _settled(equations: EquationsOfMotion, t, seen, y, args: Arguments, passed: Bool[Array, " w"], at_start: bool = False):
    """y behind the events whose witnesses `passed` through zero, and behind those whose witnesses these, or a jump before, have taken to
    the other side, each of them once; and whether a mode of friction and contact is consistent there. What is recorded is the state that
    was `seen` before all this.
    """

    def turn(carry):
        y, consistent, passed, done, _ = carry
        parts = equations.parts(y)
        side, is_far = sides(equations, t, parts, args)
        is_new = parts.sign == 0
        before = jnp.where(is_new, 1, parts.sign)
        passed = (passed | (is_new & _due(equations) & (side < 0)) | (~is_new & is_far & (side != parts.sign))) & ~done
        done = done | passed
        happens = passed & matching(equations, before)
        stops = jnp.any(happens & np.array([event.stop for _, event in equations.system.events]))
        sign, stopped = jnp.where(done | (is_new & at_start), side, parts.sign), jnp.maximum(parts.stopped, stops)
        parts = parts._replace(sign=sign, happened=parts.happened + happens, stopped=stopped)
        changing = np.array([event.then is not None for _, event in equations.system.events])
        unmoved = lambda: (parts.y, jnp.array(True))
        move = (lambda: _moved(equations, t, parts, args, happens)) if changing.any() else unmoved
        moves = jnp.any(happens & changing)
        y, fine = jax.lax.cond(moves, move, unmoved)
        return y, consistent & fine, _struck(equations, parts.y, y), done, moves

    before = equations.parts(seen)
    there = jnp.concatenate([t[None], before.q, before.v, before.z, before.u])
    yes, none = jnp.array(True), jnp.zeros_like(passed)
    carry = equations.parts(y)._replace(seen=there).y, yes, passed, none, yes
    most = equations.events if any(event.then for _, event in equations.system.events) else 0
    maybe = lambda _, carry: jax.lax.cond(carry[-1], turn, lambda carry: carry, carry)
    y, consistent, *_ = jax.lax.fori_loop(0, most + 1, maybe, carry)
    return y, consistent


def _due(equations):
    """Which events happen where their witness is negative at the start."""
    return np.array([isinstance(event.direction, Negative) for _, event in equations.system.events])


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
