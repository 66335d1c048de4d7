"""Witnesses of events: functions of the state that pass through zero where something happens; and what is then known of the event."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._mechanics.contact import roundings
from .._mechanics.stick_slip import Friction
from .._model.event import Either, Negative, Rising
from .._model.flat import Flat
from .._model.injection import asks_for
from .._model.signal import origin_of
from .first_order import EquationsOfMotion
from .held_sides import on_held_sides
from .protocol import Arguments
from .state_vector import Parts


def witness_margins(equations: EquationsOfMotion, t, parts: Parts, args: Arguments) -> tuple[Float[Array, " w"], Float[Array, " w"]]:
    """Of each witness, its value with the sign that it has until it passes through zero, and what of it counts as rounding."""
    return margins_at(equations, t, equations.decided(t, parts, args), args) if equations.events else (parts.sign, parts.sign)


def margins_at(equations: EquationsOfMotion, t, parts: Parts, args: Arguments) -> tuple[Float[Array, " w"], Float[Array, " w"]]:
    """The same where velocities that follow from the rest do."""
    if not equations.events:
        return parts.sign, parts.sign
    value, _, scale_of = _value_and_scale(equations, t, parts, args)
    assert args.scales is not None  # events are located
    return parts.sign * value, scale_of(*args.scales.roundings(parts.q, parts.v))


def _value_and_scale(equations, t, parts, args):
    """The value of each witness, the sizes of its slopes over t, q, q̇ and multipliers, and its error as a function of those of q and q̇."""
    flat, _ = equations.contents(t, parts, args)
    multipliers = _multipliers(equations, t, parts, args)(t, parts.q, parts.v)
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(multipliers), initial=0.0)) * jnp.ones_like(multipliers)
    of_loads, of_time = roundings(largest, largest), roundings(t[None], args.scales.duration)
    late = 4 * jnp.finfo(t.dtype).eps * jnp.abs(origin_of(args.params))  # the rounding of the user's time, which functions see
    of_times = late * np.array([callable(event.when) for event in equations.watched])

    def witnessed(t, q, v):
        slopes = jax.jacfwd(flat.witnesses, argnums=(0, 1, 2, 3))(t, q, v, multipliers)
        return flat.witnesses(t, q, v, multipliers), [jnp.abs(by).reshape(equations.events, -1) for by in slopes]

    value, slopes = witnessed(t, parts.q, parts.v)
    for level in range(1, max(equations.levels) + 1):  # one that jumps where others pass through zero is seen where these have their signs
        (time, there), follows = on_held_sides(flat, t, parts, args, equations.levels, level), np.array(equations.levels) == level
        of_level = lambda new, old, follows=follows: jnp.where(follows.reshape(-1, *[1] * (old.ndim - 1)), new, old)
        value, slopes = jax.tree.map(of_level, witnessed(time, there.q, there.v), (value, slopes))

    def scale(of_q, of_v):
        errors = (of_time + of_times)[:, None], of_q[None], of_v[None], of_loads[None]
        return jax.lax.stop_gradient(sum(jnp.sum(by * of, axis=1) for by, of in zip(slopes, errors, strict=True)))

    return value, slopes, scale


def _multipliers(equations, t, parts, args):
    """Those of the mode as a function of (t, q, v), where a witness asks for them."""
    flat, _ = equations.contents(t, parts, args)
    if not flat.events_need_multipliers:
        return lambda t, q, v: jnp.zeros(flat.rows, v.dtype)
    _, mode, elements = equations.mode(t, parts, args)
    if elements is None:
        return lambda t, q, v: equations.acceleration(mode, t, q, v).multipliers
    return lambda t, q, v: equations.friction(t, parts._replace(q=q, v=v), args).multipliers


def sides(equations: EquationsOfMotion, t, parts: Parts, args: Arguments, qddot=None) -> tuple[Float[Array, " w"], Bool[Array, " w"]]:
    """The side of zero of each witness, 1 or −1: the one to which it goes if it is zero up to the errors of the integration, and 0 if it
    stays there, as a velocity does that friction holds. And whether it is away from zero by more than rounding. Where q̈ is given,
    velocities that follow from the rest do.
    """
    assert args.scales is not None  # events are located
    if qddot is None:
        parts = equations.decided(t, parts, args)
        _, mode, _ = equations.mode(t, parts, args)
        qddot = equations.acceleration(mode, t, parts.q, parts.v).x
    found = _sides(equations, t, parts, args, qddot)
    for level in range(1, max(equations.levels) + 1):
        lower, (side, _) = np.array(equations.levels) < level, found
        there = parts._replace(sign=jnp.where(lower, side, parts.sign))
        found = jax.tree.map(lambda old, new, lower=lower: jnp.where(lower, old, new), found, _sides(equations, t, there, args, qddot))
    return jax.lax.stop_gradient(found)


def _sides(equations, t, parts, args, qddot):
    value, slopes, scale_of = _value_and_scale(equations, t, parts, args)
    flat, _ = equations.contents(t, parts, args)
    multipliers = _multipliers(equations, t, parts, args)
    along = lambda t, q, v: flat.witnesses(t, q, v, multipliers(t, q, v))
    way = lambda v: (jnp.ones_like(t), v, qddot)
    rate, turn = jax.jvp(lambda *state: jax.jvp(along, state, way(state[-1]))[1], (t, parts.q, parts.v), way(parts.v))
    is_far = jnp.abs(value) > scale_of(args.scales.of_positions(parts.q), args.scales.of_velocities(parts.v))
    of_q, of_v = args.scales.roundings(parts.q, parts.v)
    of_rates = args.scales.roundings_of_rates(qddot)
    is_slow = jnp.abs(rate) <= slopes[1] @ of_v + slopes[2] @ of_rates
    turns = (
        jnp.all(slopes[2] == 0, axis=1) & _is_surface(equations) & (jnp.abs(turn) > slopes[1] @ of_rates)
    )  # as its acceleration is known
    stays = ~is_far & is_slow & ~turns & _may_stay(equations)
    going = jnp.where(is_far, value, jnp.where(is_slow & turns, turn, rate))
    side = jnp.where(stays, 0.0, jnp.where(going < 0, -1.0, 1.0)).astype(value.dtype)
    return side, jnp.abs(value) > scale_of(of_q, of_v)


def sides_at_start(equations: EquationsOfMotion, t, parts: Parts, args: Arguments) -> Float[Array, " w"]:
    """The signs of the surfaces on which a motion begins and which velocities tell it leaves, and to which side: the mode is that there."""
    t, q, v = jax.lax.stop_gradient((t, parts.q, parts.v))
    flat = equations.contents(t, parts, args)[0]
    of_state = lambda t, q: plain_witnesses(flat, t, q, v)
    value, rate = jax.jvp(of_state, (t, q), (jnp.ones_like(t), v))
    leaves = (value == 0) & (parts.sign == 0) & _is_surface(equations)
    return jnp.where(leaves, jnp.sign(rate), parts.sign)


def signs_behind_step(equations: EquationsOfMotion, t, parts: Parts, args: Arguments) -> Float[Array, " w"]:
    """The signs of the witnesses behind a step. One that stayed at zero and has left it takes its present sign, without an event."""
    assert args.scales is not None  # events are located

    def found():
        there = equations.decided(t, parts, args)
        value, _, scale_of = _value_and_scale(equations, t, there, args)
        scales = args.scales.with_held_forces
        has_left = (parts.sign == 0) & (jnp.abs(value) > scale_of(scales.of_positions(there.q), scales.of_velocities(there.v)))
        return jnp.where(has_left, jnp.sign(value), parts.sign)

    return jax.lax.stop_gradient(jax.lax.cond(jnp.any(parts.sign == 0), found, lambda: parts.sign))


def _may_stay(equations) -> Bool[np.ndarray, " w"]:
    """Which witnesses may leave zero without an event: not those that happen wherever they are negative."""
    return np.array([not isinstance(event.direction, Negative) for event in equations.watched])


def _is_surface(equations) -> Bool[np.ndarray, " w"]:
    """Which of them are surfaces."""
    return np.arange(equations.events) >= len(equations.system.events)


def beyond(sign: Float[Array, " w"], passed: Bool[Array, " w"]) -> Float[Array, " w"]:
    """The signs where some witnesses have passed through zero."""
    return jnp.where(passed, -sign, sign)


def matching(equations: EquationsOfMotion, sign: Float[Array, " w"]) -> Bool[Array, " w"]:
    """Which events happen where their witness had this sign and loses it."""
    of = [event.direction for event in equations.watched]
    falls = np.array([not isinstance(direction, Rising) for direction in of])
    rises = np.array([isinstance(direction, (Rising, Either)) for direction in of])
    return jnp.where(sign > 0, falls, rises)


def plain_witnesses(flat: Flat, t, q, v) -> Float[Array, " w"]:
    """Those that follow the state alone; of the others, which follow constraint forces, nothing is known."""
    return flat.witnesses(t, q, v, jnp.zeros(flat.rows, v.dtype))


def behind_mode(equations: EquationsOfMotion, t, seen, parts: Parts, args: Arguments, passed, found: Friction, at_start) -> Parts:
    """The state behind the end of a mode, in the next one, where friction is as it was `found`, and no event changes the state: with the
    events whose witnesses have passed through zero, or were taken to the other side by an impact.
    """
    passed = passed | struck(equations, seen, parts.y)
    brought = brought_to_zero(equations, t, seen, parts, args) if equations.contacts else jnp.zeros_like(passed)
    there, none = with_seen(equations, t, seen, parts), jnp.zeros_like(passed)
    decided = there._replace(v=jnp.where(np.isin(np.arange(equations.size), equations.light), found.qdot, there.v))
    counted, _, _ = passing(equations, t, decided, args, passed, brought, none, at_start, found.qddot)
    return counted._replace(v=there.v)


def brought_to_zero(equations: EquationsOfMotion, t, seen, parts: Parts, args: Arguments) -> Bool[Array, " w"]:
    """Which witnesses are at zero, up to the errors of the integration, and were not before a jump: as of a slip that an impact ends."""
    assert args.scales is not None  # events are located

    def at_zero(parts):
        value, _, scale_of = _value_and_scale(equations, t, parts, args)
        return jnp.abs(value) <= scale_of(args.scales.of_positions(parts.q), args.scales.of_velocities(parts.v))

    return at_zero(parts) & ~at_zero(equations.parts(seen))


def struck(equations: EquationsOfMotion, before, y) -> Bool[Array, " w"]:
    """Which events are those of contacts that had an impact between two states."""
    impacts = equations.parts(y).impacts - (0 if before is None else equations.parts(before).impacts)
    names = np.repeat([name for name, _ in equations.gaps], [math.prod(shape) for _, shape in equations.gaps])
    of = [event.when for event in equations.watched]
    return jnp.stack([jnp.any(impacts[names == when] > 0) if isinstance(when, str) else jnp.array(False) for when in of])


def with_seen(equations: EquationsOfMotion, t, seen, parts: Parts) -> Parts:
    """With what is recorded of an event: the time, and the state that was `seen` before."""
    before = equations.parts(seen)
    return parts._replace(seen=jnp.concatenate([t[None], before.q, before.v, before.z, before.u])) if equations.seen else parts


def passing(equations: EquationsOfMotion, t, parts: Parts, args: Arguments, passed, brought, done, at_start, qddot=None):
    """The state with each event counted whose witness `passed` through zero, or is on the other side than it was, or goes there from zero,
    to which it was `brought`, and was not `done`; which of them happen in this direction, and all that are done. Where q̈ is given,
    velocities that follow from the rest do.
    """
    side, is_far = sides(equations, t, parts, args, qddot)
    is_new = parts.sign == 0
    before = jnp.where(is_new, 1, parts.sign)
    crosses = (is_far & (side != parts.sign)) | (brought & (side == -parts.sign))
    passed = (passed | (is_new & _due(equations) & (side < 0)) | (~is_new & crosses)) & ~done
    done = done | passed
    happens = passed & matching(equations, before)
    stops = jnp.any(happens & np.array([event.stop for event in equations.watched]))
    sign, stopped = jnp.where(done | (is_new & at_start), side, parts.sign), jnp.maximum(parts.stopped, stops)
    return parts._replace(sign=sign, happened=parts.happened + happens, stopped=stopped), happens, done


def _due(equations):
    """Which events happen where their witness is negative at the start."""
    return np.array([isinstance(event.direction, Negative) for event in equations.watched])


def changes_states(equations: EquationsOfMotion) -> bool:
    """Whether any event changes the state."""
    return any(event.then is not None for event in equations.watched)


def asks_for_forces(equations: EquationsOfMotion) -> bool:
    """Whether any witness depends on constraint forces."""
    return any(callable(event.when) and asks_for(event.when, "multipliers") for event in equations.watched)


def may_be_due(equations: EquationsOfMotion) -> bool:
    """Whether events may happen at the start."""
    return bool(np.any(_due(equations))) or any(isinstance(event.when, str) for event in equations.watched)
