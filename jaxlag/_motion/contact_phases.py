"""Contacts in the loop of `step_machine`: what happens where one closes or opens.

END      a contact is struck: q is put on it
ALONE    what counts as rounding of impulses                 then which contacts and what friction take part: SELECT
STRIKE   the velocities behind it, by Poisson's law twice
ALONE    what counts as rounding of forces                   then which contacts stay closed, and what sticks: SELECT
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._mechanics.constrained_acceleration import Impulse
from .._mechanics.contact import Alone, Contacts, begins_with_choice, from_choice, gap_rates, roundings_beside, scales_of, turned_with
from .._mechanics.friction_elements import FrictionElements
from .._mechanics.impact import Phase, Rubbing, of_compression, of_expansion, of_impulses, phase_behind, together
from .._mechanics.slip_direction import without_force
from .._mechanics.stick_slip import Friction, ModeSelection
from .._mechanics.stick_slip import Search as ModeSearch
from .._model.flat import rows_by_name
from .._program.conditions import zeros_like
from .._program.implicit import undifferentiated
from .mode_changes import Touch, behind_impact, friction_at, resting_at, touching_at, with_closed
from .state_vector import Parts
from .step_machine import Step
from .step_turn import ALONE, BACK, SELECT, STAGE, STRIKE, Decision, Point, Turn
from .witnesses import beyond

MOTION, COMPRESSION, EXPANSION = range(3)


class Change(NamedTuple):
    """Where modes end: the phase, of an impact or of none; y on its way to the next mode; which modes have ended, and what slip is rounding
    of the time; what touches; the impact that is asked about, how much of it is rounding, and what it has done so far; where friction has
    directions, the motion without contacts and friction, and σ behind the impact, both as they move.
    """

    phase: Any
    y: Array
    ended: Bool[Array, " m"]
    moved: Float[Array, " m"]
    touch: Touch
    impulse: Impulse
    loose: Float[Array, "2 c"]
    total: Phase
    alone: Alone | None
    sigma: Float[Array, " r"]

    @property
    def is_impact(self) -> Bool[Array, ""]:
        """Whether velocities are to jump."""
        return self.phase != MOTION


@dataclasses.dataclass(frozen=True)
class ContactStep(Step):
    """A step of a motion with contacts, with friction or without."""

    @property
    def decisions(self) -> list:
        """Those of a step, and those of contacts."""
        return [*super().decisions, self._alone, self._struck]

    @property
    def no_impulse(self) -> Impulse:
        """Of no contact."""
        number = jnp.zeros(self.equations.contacts, self.y0.dtype)
        return Impulse(number, number, jnp.array(False))

    def _unchanged(self) -> Change:
        y, elements, modes = self.y0, self.equations.elements, self.equations.modes
        number, none = jnp.zeros(self.equations.contacts, y.dtype), jnp.zeros(self.equations.contacts, bool)
        touch = Touch(none, none, none, none, number, number, number, number)
        flat, friction = self.contents(self.t0, self.equations.parts(y))
        terms = (*rows_by_name(flat), *(friction.rows_of_term if elements else ()))
        zero, yes = jnp.zeros((), y.dtype), jnp.array(True)
        total = Phase(y[: self.equations.size], number, dict.fromkeys(terms, zero), yes, yes, zero, zero)
        loose, alone, sigma = jnp.stack([number, number]), None, jnp.zeros(self.equations.rows, y.dtype)
        if self.begins_with_choice:
            alone = Alone(y[: self.equations.size], jnp.zeros(flat.rows, y.dtype), sigma)
        no = jnp.zeros(modes, bool), jnp.zeros(modes, y.dtype)
        return Change(jnp.array(MOTION), y, *no, touch, self.no_impulse, loose, total, alone, sigma)

    @property
    def begins_with_choice(self) -> bool:
        """Whether a mode is looked for from a `choice`."""
        flat, elements = self.contents(self.t0, self.equations.parts(self.y0))
        return begins_with_choice(flat, elements if self.equations.elements else None)

    def new_search(self, y, t) -> ModeSearch:
        none = jnp.zeros(self.equations.elements, bool)
        selection, _ = self.selection(y, t, none, none)
        number = jnp.zeros(self.equations.contacts, y.dtype)
        return selection.start(Contacts(number > 0, number > 0, jnp.array(0), number, number))

    def impulse(self, turn: Turn) -> Impulse:
        """The impact that is asked about."""
        return turn.change.impulse._replace(happens=turn.change.is_impact & (turn.kind >= SELECT) & (turn.kind != BACK))

    def corrections(self, turn: Turn):
        """None where nothing is held."""
        holds = self.equations.system.constraints or self.equations.elements
        closed = self.equations.parts(jnp.where(turn.kind == STAGE, turn.y0, turn.back.there)).closed
        return self.equations.corrections[1] if holds else jnp.where(jnp.any(closed > 0.5), self.equations.corrections[1], 0)

    def asked(self, turn: Turn):
        """y on its way, in the mode and with the contacts that are asked about; alone, without friction and contacts."""
        search, kind = turn.choice.search, turn.kind
        selection, there = self._selection_in(turn)
        moving = self.equations.parts(turn.change.y)
        moves = (kind == STRIKE) | (kind == ALONE) & self.begins_with_choice
        q, v = (
            jnp.where(moves, _with_motion_of(all, of_search), of_search) for all, of_search in ((moving.q, there.q), (moving.v, there.v))
        )
        freed, *_ = selection.kinds(search)
        alone, none = (kind == ALONE) & jnp.ones_like(freed), jnp.zeros_like(there.closed)
        sigma = jnp.where(kind == STRIKE, turn.change.sigma, search.mode.sigma) if self.begins_with_choice else search.mode.sigma
        sigma = without_force(selection.elements, sigma, jnp.where(kind == STRIKE, False, freed | alone))
        closed, sign = jnp.where(kind == ALONE, none, search.contacts.closed), beyond(there.sign, turn.choice.passed)
        there = moving._replace(q=q, v=v, closed=closed, sign=sign)
        return lambda k: there._replace(sigma=self.changed(sigma, k)).y

    def _selection_in(self, turn: Turn) -> tuple[ModeSelection, Parts]:
        """The selection of a mode on the way to the next: of an impact, which begins from rest, or of the motion."""
        change, impulse = turn.change, self.impulse(turn)
        parts = jax.lax.stop_gradient(self.equations.parts(change.y))
        selection, there = self.selection(change.y, turn.end, turn.choice.at_rest, turn.choice.breaking)
        v, sigma = (jnp.where(change.is_impact, a, b) for a, b in ((parts.v, there.v), (jnp.zeros_like(parts.sigma), parts.sigma)))
        impulse = jax.lax.stop_gradient(impulse._replace(happens=change.is_impact))
        return dataclasses.replace(selection, v=v, sigma=sigma, impulse=impulse), there._replace(v=v)

    def _moving(self, selection: ModeSelection, turn: Turn) -> ModeSelection:
        """The same of the phase that is asked about, as it moves with all that it depends on."""
        change, parts = turn.change, self.equations.parts(turn.change.y)
        v, impulse = _with_motion_of(parts.v, selection.v), change.impulse._replace(happens=change.is_impact)
        flat, elements = of_impulses(*self.contents(turn.end, parts), turn.end, parts.q, v, impulse)
        assert elements is not None  # as many as there are
        return dataclasses.replace(selection, flat=flat, elements=elements, t=turn.end, q=parts.q, v=v, impulse=impulse)

    def ended(self, turn: Turn, last, parts: Parts, elements: FrictionElements, found: Friction, ended, moved) -> Decision:
        """After the last of Newton's steps: what is struck, and is put there."""
        flat, _ = self.contents(turn.end, parts)
        of_positions, at_start = self.args.scales.of_positions(parts.q), self.at_start(turn)
        if self.begins is not None:
            closing = (flat.gaps(turn.end, parts.q) <= 0) & (parts.closed < 0.5)
            others = (jnp.zeros(size, bool) for size in (self.equations.elements, self.equations.events))
            touching = jnp.concatenate([next(others), closing, next(others)])
            ended, moved = jnp.where(at_start, touching, ended), jnp.where(at_start, 0, moved)
            of_positions = jnp.where(at_start, roundings_beside(flat, turn.end, parts.q, parts.v)[0], of_positions)
        _, of_contact, passed = jnp.split(ended, np.cumsum([self.equations.elements, self.equations.contacts]))
        parts = self._beyond(turn.end, parts, passed)
        touch = touching_at(self.equations, flat, turn.end, parts, self.args, of_contact, of_positions)
        is_impact = jnp.any(touch.hits)
        impulse = of_compression(flat, turn.end, parts.q, parts.v, touch.e)._replace(happens=is_impact)
        nothing = zeros_like(turn.change.total)._replace(v=parts.v, consistent=jnp.array(True), impulsive=jnp.array(True))
        loose = jnp.zeros_like(turn.change.loose)
        phase = jnp.where(is_impact, COMPRESSION, MOTION)
        change = Change(phase, parts.y, ended, moved, touch, impulse, loose, nothing, turn.change.alone, turn.change.sigma)
        change = jax.tree.map(lambda new, old: jnp.where(last, new, old), change, turn.change)
        search = jax.tree.map(lambda new, old: jnp.where(last, new, old), self.new_search(parts.y, turn.end), turn.choice.search)
        turn = turn._replace(kind=jnp.where(last, ALONE, turn.kind), first=jnp.where(last, 0, turn.first), change=change)
        passed = jnp.where(last, passed, turn.choice.passed)
        turn = turn._replace(choice=turn.choice._replace(search=search, passed=passed))
        on_contacts = parts._replace(closed=jnp.maximum(parts.closed, touch.hits.astype(parts.closed.dtype)))
        return Decision(turn, last & is_impact, turn.end, on_contacts.y)

    def _beyond(self, t, parts: Parts, passed) -> Parts:
        """The state by a few roundings beyond the surfaces that were passed: there gaps and their rates are seen, which may bend."""
        _, there = self.equations.on_held_sides(t, parts._replace(sign=beyond(parts.sign, passed)), self.args)
        return there._replace(sign=parts.sign)

    def put(self, turn: Turn, there, y) -> Turn:
        """With q on what is struck."""
        parts = self.equations.parts(turn.change.y)
        q = jnp.where(there, self.equations.parts(y).q, parts.q)
        return turn._replace(change=turn.change._replace(y=parts._replace(q=q).y))

    def _alone(self, turn: Turn, point: Point) -> Decision:
        """What the motion is without contact says what is rounding of forces; with that a selection begins."""
        change, t, equations = turn.change, turn.end, self.equations
        parts, before = jax.lax.stop_gradient((equations.parts(change.y), equations.parts(turn.piece.y)))
        flat, elements = self.contents(t, parts)
        of_friction, of_contact, _ = jnp.split(change.ended, np.cumsum([equations.elements, equations.contacts]))
        anew = jnp.any(change.touch.hits) | jnp.any(of_contact & (before.closed < 0.5))
        behind = before._replace(q=parts.q, v=parts.v)
        errors, moved = self.args.scales.of_velocities(parts.v), change.moved[: equations.elements]
        if self.begins is not None:
            at_start = self.at_start(turn)
            anew |= at_start
            errors = jnp.where(at_start, roundings_beside(flat, t, before.q, before.v)[1], errors)
        at_rest, breaking, along, fine = friction_at(elements, t, behind, of_friction, errors, moved, anew)
        resting, loose = resting_at(equations, flat, t, parts, change.touch)
        everywhere = jnp.ones_like(at_rest)
        of_impact = change.touch.near & ~change.touch.opening, change.loose, everywhere, ~everywhere
        of_motion = resting, jnp.stack([loose, jnp.zeros_like(loose)]), at_rest, breaking
        either = jax.tree.map(lambda new, old: jnp.where(change.is_impact, new, old), of_impact, of_motion)
        candidates, (loose, least), at_rest, breaking = jax.lax.stop_gradient(either)
        change = change._replace(y=equations.parts(change.y)._replace(sigma=along).y)
        turn = turn._replace(change=change, choice=turn.choice._replace(at_rest=at_rest, breaking=breaking))
        selection, _ = self._selection_in(turn)
        given = flat, t, parts.q, selection.v, jax.lax.stop_gradient(point.friction.qddot), selection.impulse
        force, acceleration = jax.lax.stop_gradient(scales_of(*given))
        force, acceleration = jnp.where(loose > 0, -force - loose, force), jnp.maximum(acceleration, least)
        search = selection.start(Contacts(candidates, candidates, jnp.array(0), force, acceleration))
        if self.begins_with_choice:
            turn = turn._replace(change=change._replace(alone=Alone.of(flat, point.friction)))
            search = undifferentiated(lambda: from_choice(self._moving(selection, turn), search, turn.change.alone))()
        cut = turn.split.cut
        cut = cut._replace(usable=cut.usable & (change.is_impact | fine))
        turn = turn._replace(choice=turn.choice._replace(search=search), split=turn.split._replace(cut=cut))
        return Decision(turn._replace(kind=jnp.array(SELECT), first=jnp.array(0)), jnp.array(False), t, change.y)

    def _selected(self, turn: Turn, point: Point) -> Decision:
        """One more turn of the selection; behind one of an impact this strikes, behind that of a motion the step goes on."""
        change, equations = turn.change, self.equations
        selection, _ = self._selection_in(turn)
        search = turn.choice.search
        search = search._replace(contacts=search.contacts._replace(impulse=selection.impulse))
        turn = turn._replace(choice=turn.choice._replace(search=search))
        search, found, more, done = self.onward(selection, turn, point)
        contacts = search.contacts._replace(impulse=None)
        turn = turn._replace(choice=turn.choice._replace(search=search._replace(contacts=contacts), found=found))
        parts = self.in_mode(turn, selection.elements, search)
        if self.begins_with_choice:
            sigma = turned_with(self._moving(selection, turn), search.mode, search.contacts, change.alone)
            change = change._replace(sigma=sigma)
            turn, parts = turn._replace(change=change), parts._replace(sigma=jnp.where(change.is_impact, parts.sigma, sigma))
        modes = {"sigma": parts.sigma, "held": parts.held, "transitions": parts.transitions, "sign": parts.sign}
        parts = with_closed(turn.end, equations.parts(change.y)._replace(**modes), change.touch, contacts.closed)
        goes_on, strikes, cut = done & ~change.is_impact, done & change.is_impact, turn.split.cut
        struck = change.total.found
        flags = {"dissipates": struck.dissipates, "impulsive": struck.impulsive, "consistent": search.mode.consistent & struck.consistent}
        cut = cut._replace(**{name: jnp.where(goes_on, value, getattr(cut, name)) for name, value in flags.items()})
        turn = self.with_rest(turn._replace(split=turn.split._replace(cut=cut)), more, goes_on)
        turn = turn._replace(kind=jnp.where(strikes, STRIKE, turn.kind))
        return Decision(turn, goes_on, jnp.where(goes_on, turn.start, turn.end), parts.y)

    def _struck(self, turn: Turn, point: Point) -> Decision:
        """Velocities behind an impact; by Poisson's law expansion follows compression."""
        change, search, equations = turn.change, turn.choice.search, self.equations
        parts, t = equations.parts(change.y), turn.end
        flat, elements = self.contents(t, parts)
        impulse = change.impulse._replace(happens=True)
        _, of_impact = of_impulses(flat, elements, t, parts.q, parts.v, impulse)
        assert of_impact is not None  # as many as there are elements
        rubbing = Rubbing(elements, of_impact, search.mode.sigma, search.mode.held, point.friction) if equations.elements else None
        solution = point.friction.qddot, point.friction.multipliers
        struck = phase_behind(flat, rubbing, t, parts.q, parts.v, impulse, solution, search.mode.consistent)
        total = together(change.total, struck)
        expands = jnp.array(any(flat.poisson)) & (change.phase == COMPRESSION)
        behind = parts._replace(v=total.v)
        expansion, loose = change.impulse, change.loose
        if any(flat.poisson):
            before = gap_rates(flat, t, parts.q, parts.v)
            expansion, loose = of_expansion(flat, change.impulse, change.touch.e, total.impulses, before)
        final = behind_impact(equations, t, behind, change.touch, total.found)
        y = jnp.where(expands, behind.y, final.y)
        phase = jnp.where(expands, EXPANSION, MOTION)
        change = change._replace(phase=phase, y=y, impulse=expansion, loose=loose, total=total)
        turn = turn._replace(kind=jnp.array(ALONE), first=jnp.array(0), change=change)
        return Decision(turn, jnp.array(False), t, y)


def _with_motion_of(moving: Array, values: Array) -> Array:
    """The same values, which move as others do."""
    return values + moving - jax.lax.stop_gradient(moving)
