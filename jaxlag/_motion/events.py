"""Events that happen: what is recorded of them, and the state behind."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._mechanics.contact import roundings
from .._mechanics.projection import nearest_state
from .._model.event import Negative
from .._model.state_values import ravelled
from .._program.jit import jitted
from .first_order import EquationsOfMotion
from .jumps import after_jump
from .mode_changes import Change, changed
from .protocol import Arguments
from .state_vector import Parts
from .witnesses import matching, sides


def behind_end(equations: EquationsOfMotion, t, y, args: Arguments, ended: Bool[Array, " m"]) -> Change:
    """y behind the end of modes of friction and contact, and behind the events, that `ended` marks."""
    if not equations.events:
        return changed(equations, t, y, args, ended)
    modes, passed = jnp.split(ended, [equations.elements + equations.contacts])
    yes = jnp.array(True)
    same = lambda: Change(y, yes, yes, yes, yes)
    change = jax.lax.cond(jnp.any(modes), lambda: changed(equations, t, y, args, modes), same) if modes.size else same()
    passed = passed | _struck(equations, y, change.y)
    after, consistent = _settled(equations, t, y, change.y, args, passed, jnp.any(modes))
    return change._replace(y=after, consistent=change.consistent & consistent)


def behind_jump(equations: EquationsOfMotion, t, y0, y, before: Arguments, args: Arguments) -> tuple[Float[Array, " y"], Bool[Array, ""]]:
    """y behind a jump of inputs or sampled states, as `after_jump`, and behind the events that come of it."""
    after, consistent = after_jump(equations, t, y0, y, before, args)
    if not equations.events:
        return after, consistent
    after, also = _settled(equations, t, y, after, args, _struck(equations, y, after), jnp.array(True))
    return after, consistent & also


def begun(equations: EquationsOfMotion, t, y, args: Arguments) -> tuple[Float[Array, " y"], Bool[Array, ""]]:
    """y at the start, with the sides of zero on which the witnesses are, and behind the events of those that are `Negative` already; and
    whether a mode of friction and contact is consistent there.
    """
    parts = equations.parts(y)
    errors = (roundings(1 + jnp.abs(jax.lax.stop_gradient(x))) for x in (parts.q, parts.v))
    side, _ = sides(equations, t, parts, args, *errors)
    due = np.array([isinstance(event.direction, Negative) for _, event in equations.system.events]) & (side < 0)
    y = parts._replace(sign=jnp.where(due, 1, side)).y
    return _settled(equations, t, y, y, args, due | _struck(equations, None, y), jnp.array(False))


def _struck(equations: EquationsOfMotion, before, y) -> Bool[Array, " w"]:
    """Which events are those of contacts that had an impact between two states."""
    impacts = equations.parts(y).impacts - (0 if before is None else equations.parts(before).impacts)
    names = [name for name, _ in equations.system.unilateral]
    of = [event.when for _, event in equations.system.events]
    return jnp.stack([impacts[names.index(when)] > 0 if isinstance(when, str) else jnp.array(False) for when in of])


@jitted
def _settled(equations: EquationsOfMotion, t, seen, y, args: Arguments, passed: Bool[Array, " w"], jumped: Bool[Array, ""]):
    """y behind the events whose witnesses `passed` through zero, and behind those whose witnesses these, or a jump before, have taken to
    the other side, each of them once; and whether a mode of friction and contact is consistent there. What is recorded is the state that
    was `seen` before all this.
    """

    def turn(carry):
        y, consistent, passed, done = carry
        done = done | passed
        after, fine = _happened(equations, t, y, args, passed, done)
        return after, consistent & fine, _taken_across(equations, t, after, args) & ~done, done

    def maybe(_, carry):
        return jax.lax.cond(jnp.any(carry[2]), turn, lambda carry: carry, carry)

    none = jnp.zeros_like(passed)
    passed = passed | jax.lax.cond(jumped, lambda: _taken_across(equations, t, y, args), lambda: none)
    before = equations.parts(seen)
    there = jnp.concatenate([t[None], before.q, before.v, before.z, before.u])
    y = equations.parts(y)._replace(seen=there).y
    y, consistent, *_ = jax.lax.fori_loop(0, equations.events, maybe, (y, jnp.array(True), passed, none))
    return y, consistent


def _taken_across(equations, t, y, args):
    """Which witnesses are beyond zero, but for rounding, without having passed through it."""
    parts = equations.parts(y)
    side, is_far = sides(equations, t, parts, args, roundings(parts.q), roundings(parts.v))
    return is_far & (side != parts.sign)


def _happened(equations: EquationsOfMotion, t, y, args: Arguments, passed: Bool[Array, " w"], done: Bool[Array, " w"]):
    """y behind events whose witnesses `passed` through zero, and whether a mode of friction and contact is consistent there; those that
    are `done` at this time do not happen again, on whichever side of zero their witnesses are now.
    """
    before = equations.parts(y)
    happens = passed & matching(equations, before.sign)
    parts = before._replace(happened=before.happened + happens)
    unmoved = lambda: (parts.y, jnp.array(True))
    changing = np.array([event.then is not None for _, event in equations.system.events])
    move = (lambda: _moved(equations, t, parts, args, happens)) if changing.any() else unmoved
    moved, consistent = jax.lax.cond(jnp.any(happens & changing), move, unmoved)
    after = equations.parts(moved)
    stops = jnp.any(happens & np.array([event.stop for _, event in equations.system.events]))
    assert args.scales is not None  # events are located
    side, _ = sides(equations, t, after, args, args.scales.error(after.q), args.scales.error(after.v))
    return after._replace(sign=jnp.where(done, side, after.sign), stopped=jnp.maximum(after.stopped, stops)).y, consistent


def _moved(equations: EquationsOfMotion, t, parts: Parts, args: Arguments, happens):
    """y with what all of `then` return, one after the other, on the constraints."""
    new = parts
    for i, (name, event) in enumerate(equations.system.events):
        if event.then is None:
            continue
        now, _, _ = equations.mode(t, new, args)
        q, v, states = now.happened(name, t, new.q, new.v)
        z, u = (ravelled({name: states[name] for name in layout.shapes}, q.dtype) for layout in (equations.states, equations.sampled))
        changed = new._replace(q=q, v=v, z=z, u=u)
        new = jax.tree.map(lambda x, old, i=i: jnp.where(happens[i], x, old), changed, new)
    if equations.system.constraints:
        there, _, _ = equations.mode(t, new, args)
        nearest = nearest_state(there._replace(holonomic=there.bilateral), t, new.q, new.v)
        new = new._replace(q=nearest.q, v=nearest.v)
    return after_jump(equations, t, parts.y, new.y, args, args)
