"""Events that happen: what is recorded of them, and the state behind."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from .._mechanics.contact import roundings
from .._mechanics.projection import nearest_state
from .._model.event import Negative
from .._model.state_values import of_first_order, ravelled, sampled
from .._model.system import System
from .._program.jit import jitted
from .first_order import EquationsOfMotion
from .jumps import after_jump
from .mode_changes import Change, changed
from .protocol import Arguments
from .state_vector import Parts, Sample
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
    the other side, each of them once; and whether a mode of friction and contact is consistent there. Recorded is the state that was
    `seen`, before a jump.
    """

    def turn(carry):
        seen, y, consistent, passed, done = carry
        done = done | passed
        after, fine = _happened(equations, t, seen, y, args, passed, done)
        return after, after, consistent & fine, _taken_across(equations, t, after, args) & ~done, done

    def maybe(_, carry):
        return jax.lax.cond(jnp.any(carry[3]), turn, lambda carry: carry, carry)

    none = jnp.zeros_like(passed)
    passed = passed | jax.lax.cond(jumped, lambda: _taken_across(equations, t, y, args), lambda: none)
    _, y, consistent, *_ = jax.lax.fori_loop(0, equations.events, maybe, (seen, y, jnp.array(True), passed, none))
    return y, consistent


def _taken_across(equations, t, y, args):
    """Which witnesses are beyond zero, but for rounding, without having passed through it."""
    parts = equations.parts(y)
    side, is_far = sides(equations, t, parts, args, roundings(parts.q), roundings(parts.v))
    return is_far & (side != parts.sign)


def _happened(equations: EquationsOfMotion, t, seen, y, args: Arguments, passed: Bool[Array, " w"], done: Bool[Array, " w"]):
    """y behind events whose witnesses `passed` through zero, and whether a mode of friction and contact is consistent there; those that
    are `done` at this time do not happen again, on whichever side of zero their witnesses are now.
    """
    before = equations.parts(y)
    happens = passed & matching(equations, before.sign)
    record = _recorded(equations, t, equations.parts(seen), happens)
    parts = before._replace(record=record, happened=before.happened + happens)
    unmoved = lambda: (parts.y, jnp.array(True))
    changes = jnp.any(happens & np.array([event.then is not None for _, event in equations.system.events]))
    moved, consistent = jax.lax.cond(changes, lambda: _moved(equations, t, parts, args, happens), unmoved)
    after = equations.parts(moved)
    stops = jnp.any(happens & np.array([event.stop for _, event in equations.system.events]))
    assert args.scales is not None  # events are located
    side, _ = sides(equations, t, after, args, args.scales.error(after.q), args.scales.error(after.v))
    return after._replace(sign=jnp.where(done, side, after.sign), stopped=jnp.maximum(after.stopped, stops)).y, consistent


def _recorded(equations: EquationsOfMotion, t, parts: Parts, happens):
    """The record, with this time and state in the next row of each event that happens."""
    row = jnp.concatenate([t[None], parts.q, parts.v, parts.z, parts.u])
    rows, start = parts.record.reshape(-1, equations.recorded), 0
    for i, most in enumerate(equations.most):
        here = happens[i] & (np.arange(len(rows)) == start + parts.happened[i].astype(int)) & (parts.happened[i] < most)
        rows = jnp.where(here[:, None], row[None], rows)
        start += most
    return rows.ravel()


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
    there, _, _ = equations.mode(t, new, args)
    nearest = nearest_state(there._replace(holonomic=there.bilateral), t, new.q, new.v)
    return after_jump(equations, t, parts.y, new._replace(q=nearest.q, v=nearest.v).y, args, args)


def recorded(system: System, shown: Sample, ys: Float[Array, "T y"]) -> dict[str, tuple[Array, PyTree, PyTree, dict[str, PyTree]]]:
    """By name, the times of events and the states there, from the last state that was reached; NaN beyond the last event."""
    if not system.events:
        return {}
    last = jnp.maximum(jnp.sum(jnp.isfinite(ys[:, 0])) - 1, 0)
    y, most = ys[last], [event.most for _, event in system.events]
    of = lambda tree: jax.tree.map(lambda x: x[0], tree)
    parts = of(shown.q), of(shown.qdot), *({name: of(shown.states[name]) for name in kind(system)} for kind in (of_first_order, sampled))
    sizes = [1, *(sum(x.size for x in jax.tree.leaves(part)) for part in parts)]
    rows = y[-1 - sum(most) * sum(sizes) : -1].reshape(sum(most), sum(sizes))
    number = y[-1 - rows.size - len(most) : -1 - rows.size]
    found = {}
    for i, name in enumerate(dict(system.events)):
        mine = rows[sum(most[:i]) : sum(most[: i + 1])]
        mine = jnp.where((np.arange(most[i]) < number[i])[:, None], mine, jnp.nan)
        t, *columns = jnp.split(mine, np.cumsum(sizes)[:-1], axis=1)
        q, v, z, u = (_unravelled(part, column) for part, column in zip(parts, columns, strict=True))
        found[name] = t[:, 0], q, v, z | u
    return found


def _unravelled(like: PyTree, rows: Float[Array, "k n"]) -> Any:
    """Pytrees of vectors, one for each row."""
    leaves, structure = jax.tree.flatten(like)
    parts = jnp.split(rows, np.cumsum([x.size for x in leaves])[:-1], axis=1) if leaves else []
    return jax.tree.unflatten(structure, [part.reshape(-1, *x.shape) for part, x in zip(parts, leaves, strict=True)])
