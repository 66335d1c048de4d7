"""What ends a mode of friction and contact, and what follows it: the impact, the contacts that stay closed, what slides and what sticks."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._mechanics.contact import (
    ROUNDING,
    Contacts,
    contact_rows,
    gap_rates,
    gap_scales,
    idle,
    on_contact,
    roundings,
    roundings_beside,
    select_closed,
)
from .._mechanics.friction_elements import FrictionElements
from .._mechanics.impact import Impact, impact, no_impact
from .._mechanics.return_mapping import returned
from .._mechanics.stick_slip import Friction, Mode, first_mode, select_mode, slip_of, slipping, sticking
from .._model.flat import Flat, StatesAt
from .._program.jit import jitted
from .._program.time_bounds import bounds_over_boxes
from .first_order import EquationsOfMotion
from .path_bounds import PathBounds
from .protocol import Arguments
from .state_vector import Parts, Start
from .witnesses import margins_at, plain_witnesses, sides_at_start, witness_margins

CONVERGED = 1e-9  # of the motion, the time that infinitely many impacts may yet take when they are summed up,
OFTEN = 64  # parts of a step, in each of which what has no bounds is looked at
LOW = 10  # or, in roundings of the gap, the height of the last flight


class Change(NamedTuple):
    """y behind the end of a mode; whether it is consistent there, an impact took energy and followed from impulses, slip was at rest."""

    y: Float[Array, " y"]
    consistent: Bool[Array, ""]
    dissipates: Bool[Array, ""]
    impulsive: Bool[Array, ""]
    at_rest: Bool[Array, ""]


def margins(equations: EquationsOfMotion, t, y, args: Arguments, start) -> Float[Array, " k"]:
    """Per element of dry friction and per contact, the margin of its mode, negative beyond its end; and then the bounds of friction.

    The mode and the sampled states are those of `start`, y at the start of the step: what these alone determine is computed once.
    """
    here, there = equations.parts(y), equations.parts(start)
    still = {"u": there.u, "held": there.held, "closed": there.closed, "sign": there.sign}
    if equations.rows == equations.elements:  # others may turn
        still["sigma"] = there.sigma
    return _margins(equations, t, here._replace(**still), args)


@jitted
def _margins(equations: EquationsOfMotion, t, parts: Parts, args):
    q, v = parts.q, parts.v
    flat, mode, elements = equations.mode(t, parts, args)
    of_events = sum(witness_margins(equations, t, parts, args))
    unbounded = jnp.ones_like(parts.closed), jnp.ones_like(parts.sign)
    if elements is None:
        closed, none = parts.closed > 0.5, lambda: jnp.zeros_like(parts.closed)
        pressing = lambda: contact_rows(flat, equations.acceleration(mode, t, q, v).multipliers)
        forces = jax.lax.cond(jnp.any(closed), pressing, none) if equations.contacts else none()
        return jnp.concatenate([_contact_margins(flat, t, q, closed, forces, args), of_events, *unbounded])
    time, there = equations.on_held_sides(t, parts, args)
    return margins_of(equations, t, parts, args, equations.friction(time, there, args), of_events)


def margins_of(equations: EquationsOfMotion, t, parts: Parts, args: Arguments, found: Friction, of_events: Array | None = None) -> Array:
    """Margins and bounds, from the friction that was found in the mode."""
    flat, elements = equations.rubbing(t, parts, args)
    of_contacts = _contact_margins(flat, t, parts.q, parts.closed > 0.5, contact_rows(flat, found.multipliers), args)
    of_elements = jnp.where((parts.held > 0) | idle(flat, elements, parts.sigma, found.bound), 1, found.margin)
    of_events = jnp.zeros_like(parts.sign) if of_events is None else of_events
    unbounded = jnp.ones_like(parts.closed), jnp.ones_like(parts.sign)
    return jnp.concatenate([of_elements, of_contacts, of_events, found.bound, *unbounded])


def _contact_margins(flat: Flat, t, q, closed, forces, args: Arguments):
    """The force of a closed contact, the gap of an open one: with some of their rounding, since both begin at zero."""
    own = q if args.scales is None else args.scales.of_q
    rounding = gap_scales(flat, t, q, q, roundings(q, jnp.abs(own)), q).gap
    little = jnp.finfo(q.dtype).eps ** ROUNDING * jnp.max(jnp.abs(jax.lax.stop_gradient(forces)), initial=0.0)
    return jnp.where(closed, forces + little, flat.gaps(t, q) + rounding)


class Approach(NamedTuple):
    """What is known of gaps and witnesses along the path of a step: whether none is zero from one time to another, if that can be known at
    all, and of the margins of all modes, whether they may be negative between two times at which they are known.
    """

    stays_away: Callable | None
    may_arrive: Callable


def approach(equations: EquationsOfMotion, path: Callable, t0, t1, args: Arguments) -> Approach:
    """Bounds of gaps and witnesses, of their rates and of theirs, where there are any, along the path over shares of a step. What rises or
    falls all the time is seen at the ends, and so is what is bent too little to pass zero between them; what has no bounds is looked at
    more often.
    """
    t, bounds = t0, PathBounds.of(path, t0, t1)
    y, parts = bounds.y, equations.parts(bounds.y)
    closed, sign = parts.closed > 0.5, parts.sign
    flat, _ = equations.contents(t, parts, args)
    often = lambda start, end: end - start > (t1 - t0) / OFTEN

    def along(function):
        def at(t, y):
            parts = equations.decided(t, equations.parts(y), args)
            return function(equations.flat_at(args.params, equations.states_of(t, parts)), t, parts)

        rate = lambda t, y, ydot: jax.jvp(at, (t, y), (jnp.ones_like(t), ydot))[1]
        curvature = lambda t, y, ydot, yddot: jax.jvp(rate, (t, y, ydot), (jnp.ones_like(t), ydot, yddot))[1]
        found = [bounds_over_boxes(of, t, *[y] * count) for count, of in enumerate((at, rate, curvature), 1)]
        if any(of is None for of in found):
            return found[0] and (lambda start, end: found[0]((start, end), bounds.between(start, end)[0])), None
        within = lambda start, end: bounds.between(start, end)
        all_of = lambda start, end: [of((start, end), *within(start, end)[:count]) for count, of in enumerate(found, 1)]
        return (lambda start, end: all_of(start, end)[0]), all_of

    of_gaps = along(lambda flat, t, parts: flat.gaps(t, parts.q))
    of_events = along(lambda flat, t, parts: sign * plain_witnesses(flat, t, parts.q, parts.v))
    known = [(of, watched) for of, watched in ((of_gaps, ~closed), (of_events, jnp.ones(equations.events, bool))) if watched.size]
    is_known = not flat.events_need_multipliers and all(bound is not None for of, _ in known for bound in of)

    def may_arrive(start, end, before, behind):
        found, first = [jnp.zeros(equations.elements, bool)], equations.elements
        for (_, all_of), watched in known:
            if all_of is None:
                found.append(watched & often(start, end))
            else:
                (low, _), (falls, rises), (_, curvature) = all_of(start, end)
                ends = jnp.minimum(before, behind)[first : first + watched.size]
                dips = ends < jnp.maximum(curvature, 0) * (end - start) ** 2 / 8  # below the chord by no more
                found.append(watched & (low < 0) & (falls < 0) & (rises > 0) & dips)
            first += watched.size
        if flat.events_need_multipliers:
            found[-1] = found[-1] | often(start, end)
        return jnp.concatenate(found)

    def stays_away(start, end):
        return jnp.all(jnp.concatenate([watched & (value(start, end)[0] > 0) for (value, _), watched in known]))

    can_tell = is_known and known and not equations.elements
    return Approach(stays_away if can_tell else None, may_arrive)


class AtEnd(NamedTuple):
    """Margins and slopes at the end of a mode, for Newton's method; and by how much rounding may have hidden the end from a step before."""

    value: Float[Array, " m"]
    slope: Float[Array, " m"]
    late: Float[Array, " m"]


def at_end(equations: EquationsOfMotion, t, y, args: Arguments, slopes: Float[Array, " m"]) -> AtEnd:
    """Margins at the end of a mode, where they have such `slopes`."""
    found = margins(equations, t, y, args, y)[: equations.modes]
    if not (equations.contacts or equations.events):
        return AtEnd(found, slopes, jnp.zeros_like(slopes))
    return exactly(equations, t, equations.parts(y), args, found, slopes)


def exactly(
    equations: EquationsOfMotion,
    t,
    parts: Parts,
    args: Arguments,
    found: Float[Array, " m"],
    slopes: Float[Array, " m"],
    qddot: Float[Array, " n"] | None = None,
) -> AtEnd:
    """With the margins `found` and their `slopes`, those of open contacts apart, which are g and ġ as they are: among many impacts a gap is
    hardly more than its rounding, and its rate is no difference of gaps. Where q̈ is given, the slopes of witnesses are those there, and
    velocities that follow from the rest do.
    """
    flat, _ = equations.contents(t, parts, args)
    first = [equations.elements, equations.elements + equations.contacts]
    (of_elements, of_contacts, _), (falls, rises, passes) = (jnp.split(x, first) for x in (found, slopes))
    is_closed = parts.closed > 0.5
    gaps = jnp.where(is_closed, of_contacts, flat.gaps(t, parts.q))
    rates = jnp.where(is_closed, rises, gap_rates(flat, t, parts.q, parts.v))
    witnesses, rounding = (witness_margins if qddot is None else margins_at)(equations, t, parts, args)
    if qddot is not None:
        along = jnp.ones_like(t), parts.v, qddot
        passes = parts.sign * jax.jvp(lambda *state: plain_witnesses(flat, *state), (t, parts.q, parts.v), along)[1]
    passes = jnp.where(parts.sign == 0, 0, passes)  # what stays at zero does not pass through it
    value, slope = jnp.concatenate([of_elements, gaps, witnesses]), jnp.concatenate([falls, rates, passes])
    is_exact = jnp.concatenate([jnp.zeros_like(falls, bool), ~is_closed, jnp.ones_like(passes, bool)])
    beside = jnp.concatenate([jnp.zeros_like(falls), of_contacts - gaps, rounding])
    late = jnp.where(is_exact & (slope < 0), 2 * beside / jnp.where(slope < 0, -slope, 1), 0)
    return AtEnd(value, *jax.lax.stop_gradient((slope, late)))


@jitted
def changed(equations: EquationsOfMotion, t, y, args: Arguments, ended: Bool[Array, " m"], moved: Float[Array, " m"]) -> Change:
    """y in the mode that follows when those of the elements and contacts `ended` end. Slip may be off by `moved`, by the rounding of t."""
    assert args.scales is not None  # ends are located
    parts = equations.parts(y)
    flat, _, elements = equations.mode(t, parts, args)
    of_friction, of_contact = jnp.split(ended[: equations.elements + equations.contacts], [equations.elements])
    if not equations.contacts:
        assert elements is not None
        at_rest, breaking, at_its_end = at_rest_within(elements, t, parts, args, of_friction, moved, elements.driven)
        there = parts.without(args.scales.of_velocities(parts.v))
        given = parts.q, there.v, parts.sigma, at_rest, breaking
        mode, _ = select_mode(flat, elements, t, *given, friction_in=in_other(equations, t, there, args))
        after = equations.in_new_mode(t, in_other_mode(elements, parts, mode).y, args)
        return Change(after, mode.consistent, jnp.array(True), jnp.array(True), at_its_end)
    errors = args.scales.of_positions(parts.q), args.scales.of_velocities(parts.v)
    return behind_contact(equations, t, parts, args, of_friction, of_contact, errors, moved=moved)


def at_rest_within(elements: FrictionElements, t, parts: Parts, args: Arguments, ended, moved, driven):
    """Where the modes of friction of those `ended` end: which elements are at rest, which of them break away, and whether all that slide
    have come to rest, within the errors of the motion and by how much slip has `moved` within the rounding of the time.
    """
    stuck = sticking(elements, parts.sigma) | (parts.held > 0)
    slow = _slow(elements, t, parts, args.scales.of_velocities(parts.v), moved)
    return stuck | ended | (slow & ~driven), ended & stuck, jnp.all(~ended | stuck | slow)


def _slow(elements: FrictionElements, t, parts: Parts, errors, moved):
    """Which elements slip by no more than errors of the velocities and of the time amount to."""
    slack = 0 if moved is None else jnp.where(jnp.isfinite(moved), moved, 0)[: elements.size]
    return elements.norms(elements.slip(t, parts.q, parts.v)) <= slip_of(elements, t, parts.q, parts.v, errors) + slack


class Touch(NamedTuple):
    """Of each contact, where modes end: whether it touches, opens, and is struck; its restitution, by which impacts that are still to come
    are summed up where they converge, in the time that remains for them; the rate of its gap within which it rests.
    """

    near: Bool[Array, " c"]
    opening: Bool[Array, " c"]
    hits: Bool[Array, " c"]
    converged: Bool[Array, " c"]
    e: Float[Array, " c"]
    ratio: Float[Array, " c"]
    remaining: Float[Array, " c"]
    rest: Float[Array, " c"]


def touching_at(equations: EquationsOfMotion, flat: Flat, t, parts: Parts, args: Arguments, of_contact, of_positions) -> Touch:
    """What touches at this state, where the modes of contacts end that `of_contact` marks."""
    closed, q, v = parts.closed > 0.5, parts.q, parts.v
    scales = gap_scales(flat, t, q, v, of_positions, roundings_beside(flat, t, q, v)[1])
    near = closed | of_contact | (jax.lax.stop_gradient(flat.gaps(t, q)) <= scales.gap)
    opening, rates = of_contact & closed, gap_rates(flat, t, q, v)
    hits = near & ~opening & (rates < -scales.rate)
    duration, own = (jnp.inf, jnp.abs(q)) if args.scales is None else (args.scales.duration, args.scales.of_q)
    speed = jnp.maximum(-rates, 0)
    is_low = speed * (t - parts.changed) / 4 <= LOW * gap_scales(flat, t, q, v, roundings(q, own), v).gap
    ratio, remaining, converged = _last_impacts(t, parts, hits & of_contact, is_low, duration)
    e = jnp.where(converged, 0, flat.restitution(t, speed))
    return Touch(near, opening, hits, converged, e, ratio, remaining, scales.rate)


def behind_impact(equations: EquationsOfMotion, t, parts: Parts, touch: Touch, found: Impact) -> Parts:
    """The state with what an impact makes of it, or with q̇ as it was."""
    if equations.works:
        does = jnp.stack([jnp.asarray(found.works.get(name, 0.0), found.v.dtype) for name in equations.works])
        parts = parts._replace(works=parts.works + does)
    _, opening, hits, converged, _, ratio, remaining, _ = touch
    impulses = found.impulses * jnp.where(converged, (1 + ratio) / jnp.where(converged, 1 - ratio, 1), 1)
    return parts._replace(v=found.v, **_counted(t, parts, hits, opening, impulses, jnp.where(converged, remaining, 0)))


def resting_at(equations: EquationsOfMotion, flat: Flat, t, parts: Parts, touch: Touch) -> tuple[Bool[Array, " c"], Array]:
    """Which contacts may stay closed at a state behind the impact, if there was one; and which of them are loose."""
    rests = jnp.abs(gap_rates(flat, t, parts.q, parts.v)) <= touch.rest
    varies = np.array([callable(e) for _, e in equations.system.restitution], bool)
    loose = jnp.where(touch.hits & varies, jnp.finfo(parts.q.dtype).tiny, 0)  # they depart as e grows
    return touch.near & ~touch.opening & rests, loose


class Resting(NamedTuple):
    """Friction where its modes end: which elements are at rest, which of these break away, and σ of those that slip; whether all whose
    modes have ended are at rest.
    """

    at_rest: Bool[Array, " e"]
    breaking: Bool[Array, " e"]
    sigma: Float[Array, " r"]
    fine: Bool[Array, ""]


def friction_at(elements: FrictionElements, t, parts: Parts, of_friction, of_velocities, moved, anew) -> Resting:
    """Of the modes `of_friction` that end; `anew`: whether what slides and sticks follows from the motion alone, as behind an impact."""
    stuck, slow = sticking(elements, parts.sigma) | (parts.held > 0), _slow(elements, t, parts, of_velocities, moved)
    slip = elements.slip(t, parts.q, parts.v)
    size = elements.norms(slip)[elements.element_of_row]
    at_rest = jnp.where(anew, slow | elements.is_quasistatic, stuck | of_friction | (slow & ~elements.driven))
    breaking = jnp.where(anew, elements.is_quasistatic & ~stuck, of_friction & stuck)  # at its bound: the forces tell where it goes on
    along = jnp.where(anew, slip / jnp.where(size > 0, size, 1), parts.sigma)
    return Resting(at_rest, breaking, along, jnp.all(~of_friction | stuck | slow) | anew)


def with_closed(t, parts: Parts, touch: Touch, closed: Bool[Array, " c"]) -> Parts:
    """The state with these contacts closed, each of which changed now, if not by an impact."""
    changes = ((parts.closed > 0.5) != closed) & ~touch.hits
    return parts._replace(closed=closed.astype(parts.q.dtype), changed=jnp.where(changes, t, parts.changed))


def behind_contact(equations: EquationsOfMotion, t, parts: Parts, args: Arguments, of_friction, of_contact, errors, anew=False, moved=None):
    """y behind the end of modes of friction and contact; `errors` of positions and velocities, within which contacts touch and slip rests;
    `moved`: slip that is rounding of the time as well, where that is known.

    `anew`: whether what slides and what sticks follows from the motion alone, as it does behind an impact.
    """
    flat, _, elements = equations.mode(t, parts, args)
    closed, before = parts.closed > 0.5, parts.v
    touch = touching_at(equations, flat, t, parts, args, of_contact, errors[0])
    is_impact = jnp.any(touch.hits)

    def struck():
        there = on_contact(flat, t, parts.q, before, closed | touch.hits)
        return there, impact(flat, elements, t, there, before, touch.near & ~touch.opening, touch.e)

    q, found = jax.lax.cond(is_impact, struck, lambda: (parts.q, no_impact(flat, elements, before)))
    parts = behind_impact(equations, t, parts._replace(q=q), touch, found)
    resting, loose = resting_at(equations, flat, t, parts, touch)
    fine, consistent = jnp.array(True), found.consistent
    if elements is None:
        chosen = select_closed(flat, t, q, parts.v, resting, loose)
        chosen_closed, consistent = chosen.closed, consistent & chosen.consistent
    else:
        anew = is_impact | anew | jnp.any(of_contact & ~closed)
        at_rest, breaking, along, fine = friction_at(elements, t, parts, of_friction, errors[1], moved, anew)
        among, there = Contacts.of(flat, t, q, parts.v, resting, loose), parts.without(errors[1])
        given = q, there.v, along, at_rest, breaking, among
        mode, contacts = select_mode(flat, elements, t, *given, friction_in=in_other(equations, t, there, args))
        chosen_closed, consistent = contacts.closed, consistent & mode.consistent
        parts = in_other_mode(elements, parts, mode)
    parts = with_closed(t, parts, touch, chosen_closed)
    return Change(equations.projected(t, parts.y, args), consistent, found.dissipates, found.impulsive, fine)


def _last_impacts(t, parts: Parts, hits, is_low, duration):
    """Of each contact, the ratio by which flights shrink, the time that the impacts that are still to come will take; and whether that is
    next to nothing, so that this impact may stand for them all, its impulse with theirs.
    """
    flight, before = t - parts.changed, parts.flight
    ratio = flight / jnp.where(before > 0, before, 1)
    shrinks = (before > 0) & (ratio < 1) & (parts.impacts >= 2)
    remaining = flight * ratio / jnp.where(shrinks, 1 - ratio, 1)
    return ratio, remaining, hits & shrinks & ((remaining < CONVERGED * duration) | is_low)


def _counted(t, parts: Parts, hits, opening, impulses, remaining):
    """What is kept of each contact, behind an impact or an opening."""
    return {
        "impacts": parts.impacts + hits,
        "changed": jnp.where(hits, t + remaining, parts.changed),
        "flight": jnp.where(hits, t - parts.changed, jnp.where(opening, 0, parts.flight)),
        "impulse": parts.impulse + impulses,
    }


def in_other(equations: EquationsOfMotion, t, parts: Parts, args: Arguments) -> Callable:
    """Friction of this state as a function of σ and, where there are any, the contacts that are closed."""

    def friction_in(sigma, contacts):
        closed = contacts.closed.astype(parts.closed.dtype) if equations.contacts else parts.closed
        return equations.friction(t, parts._replace(sigma=sigma, closed=closed), args)

    return friction_in


def in_other_mode(elements: FrictionElements, parts: Parts, mode: Mode) -> Parts:
    """y in another mode, and its transitions counted: what begins or ceases to slip, or slips another way, where there is friction."""
    of, sigma, held = elements.element_of_row, parts.sigma, parts.held
    before, after = jnp.where((held > 0)[of], 0, sigma), jnp.where(mode.held[of], 0, mode.sigma)
    changes = jnp.sum((elements.norms(after - before) > 0.5) & (mode.bound != 0))
    return parts._replace(sigma=mode.sigma, held=mode.held.astype(held.dtype), transitions=parts.transitions + changes)


def started(equations: EquationsOfMotion, at: StatesAt, params) -> Start:
    """y at the start, in the mode that holds there: what touches and approaches has an impact."""
    parts, args, t = equations.at_start(at, params), Arguments(params), at.t
    flat, elements = equations.contents(t, parts, args)
    yes = jnp.array(True)
    if equations.contacts:
        errors = roundings_beside(flat, t, parts.q, parts.v)
        of_contact = flat.gaps(t, parts.q) <= 0
        change = behind_contact(equations, t, parts, args, jnp.zeros(equations.elements, bool), of_contact, errors, anew=True)
        return Start(change.y, change.consistent, yes, _is_outside(flat, t, parts), change.dissipates, change.impulsive)
    if elements is None:
        return Start(parts.y, yes, yes, yes, yes, yes)
    parts = parts._replace(q=returned(flat, elements, t, parts.q, parts.v))
    mode, _ = first_mode(flat, elements, t, parts.q, parts.v, friction_in=in_other(equations, t, parts, args))
    parts = parts._replace(sigma=mode.sigma, held=mode.held.astype(parts.q.dtype))
    return Start(equations.in_new_mode(t, parts.y, args), mode.consistent, ~jnp.any(mode.bound < 0), yes, yes, yes)


def unstarted(equations: EquationsOfMotion, at: StatesAt, params) -> Start:
    """y at the start, whose mode the first step finds: what has no slip is at rest, and contacts are open."""
    parts, args, t, yes = equations.at_start(at, params), Arguments(params), at.t, jnp.array(True)
    flat, elements = equations.rubbing(t, parts, args)
    if equations.elements:
        _, sigma = slipping(elements, t, parts.q, parts.v)
        parts = parts._replace(q=returned(flat, elements, t, parts.q, parts.v), sigma=sigma)
    if equations.sided:
        parts = parts._replace(sign=sides_at_start(equations, t, parts, args))
    is_outside = _is_outside(flat, t, parts) if equations.contacts else yes
    return Start(parts.y, yes, yes, is_outside, yes, yes)


def _is_outside(flat: Flat, t, parts: Parts) -> Bool[Array, ""]:
    """Whether a start lies in no obstacle, but for the rounding of what put it there."""
    of_positions, _ = roundings_beside(flat, t, parts.q, parts.v)
    inside = gap_scales(flat, t, parts.q, parts.v, jnp.finfo(parts.q.dtype).eps ** (0.5 - ROUNDING) * of_positions, parts.v).gap
    return jnp.all(flat.gaps(t, parts.q) >= -inside)
