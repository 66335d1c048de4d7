"""Events that happen: what is recorded of them, and the state behind."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from .._mechanics.contact import roundings
from .._mechanics.projection import nearest_state
from .._model.event import Negative
from .._model.flat import Flat
from .._model.state_values import of_first_order, ravelled, sampled
from .._model.system import System
from .._program.jit import jitted
from .first_order import EquationsOfMotion
from .jumps import after_jump
from .mode_changes import Change, changed
from .protocol import Arguments
from .state_vector import Parts, Sample
from .witnesses import matching, signs


def behind(equations: EquationsOfMotion, t, y, args: Arguments, ended: Bool[Array, " m"]) -> Change:
    """y behind the end of modes of friction and contact, and behind the events, that `ended` marks."""
    if not equations.events:
        return changed(equations, t, y, args, ended)
    modes, events = jnp.split(ended, [equations.elements + equations.contacts])
    yes = jnp.array(True)
    same = lambda: Change(y, yes, yes, yes, yes)
    change = jax.lax.cond(jnp.any(modes), lambda: changed(equations, t, y, args, modes), same) if modes.size else same()
    after, consistent = jax.lax.cond(
        jnp.any(events), lambda: happened(equations, t, change.y, args, events), lambda: (change.y, jnp.array(True))
    )
    return change._replace(y=after, consistent=change.consistent & consistent)


@jitted
def happened(equations: EquationsOfMotion, t, y, args: Arguments, passed: Bool[Array, " w"]):
    """y behind events whose witnesses `passed` through zero, and whether a mode of friction and contact is consistent there."""
    before = equations.parts(y)
    flat, _, _ = equations.mode(t, before, args)
    happens = passed & matching(equations, before.sign)
    parts = before._replace(record=_recorded(equations, t, before, happens), happened=before.happened + happens)
    moved, consistent = jax.lax.cond(
        jnp.any(happens), lambda: _moved(equations, flat, t, parts, args, happens), lambda: (parts.y, jnp.array(True))
    )
    after = equations.parts(moved)
    stops = jnp.any(happens & np.array([event.stop for _, event in equations.system.events]))
    behind_all, mode, _ = equations.mode(t, after, args)
    qddot = equations.acceleration(mode, t, after.q, after.v).x
    assert args.scales is not None  # events are located
    sign = signs(behind_all, t, after, qddot, args.scales.error(after.q), args.scales.error(after.v))
    sign = jnp.where(passed, sign, after.sign)
    return after._replace(sign=sign, stopped=jnp.maximum(after.stopped, stops)).y, consistent


def _recorded(equations: EquationsOfMotion, t, parts: Parts, happens):
    """The record, with this time and state in the next row of each event that happens."""
    row = jnp.concatenate([t[None], parts.q, parts.v, parts.z, parts.u])
    rows, start = parts.record.reshape(-1, equations.recorded), 0
    for i, (_, event) in enumerate(equations.system.events):
        here = happens[i] & (jnp.arange(len(rows)) == start + parts.happened[i].astype(int)) & (parts.happened[i] < event.most)
        rows = jnp.where(here[:, None], row[None], rows)
        start += event.most
    return rows.ravel()


def _moved(equations: EquationsOfMotion, flat: Flat, t, parts: Parts, args: Arguments, happens):
    """y with what all of `then` return, one after the other, on the constraints."""
    if all(event.then is None for _, event in equations.system.events):
        return parts.y, jnp.array(True)
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


def begun(equations: EquationsOfMotion, t, y, args: Arguments) -> tuple[Float[Array, " y"], Bool[Array, ""]]:
    """y at the start, with the sides of zero on which the witnesses are, and behind the events of those that are `Negative` already; and
    whether a mode of friction and contact is consistent there.
    """
    parts = equations.parts(y)
    flat, mode, _ = equations.mode(t, parts, args)
    errors = (roundings(1 + jnp.abs(jax.lax.stop_gradient(x))) for x in (parts.q, parts.v))
    sign = signs(flat, t, parts, equations.acceleration(mode, t, parts.q, parts.v).x, *errors)
    due = np.array([isinstance(event.direction, Negative) for _, event in equations.system.events]) & (sign < 0)
    begun = parts._replace(sign=jnp.where(due, 1, sign)).y
    return jax.lax.cond(jnp.any(due), lambda: happened(equations, t, begun, args, due), lambda: (begun, jnp.array(True)))


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
