"""Steps with dry friction and contact in one loop, which holds the equations once: an evaluation serves as a stage of the scheme, as a look
at the margins of a mode, as the end of a mode, and in the selection of the next one.

    STAGE   the rates at the stages of a piece of the step    then its end, put back on the constraints
    LOOK    the margins at some times along a piece           then the next times, or where the mode ends, if it does
    END     the margins where it ends                         then Newton's next piece up to there, or what is at rest there
    SELECT  the friction in a mode that may follow            then another one, or y in that mode, put on its constraints
    TURN    slip rates with each row of σ changed             then the same
    BACK    what takes a state back to its constraints        then what follows with that state there
    COUNT   the accelerations behind an event                 then the rest of the step, with what has happened

and, where there are contacts (`contact_phases`), before each selection

    ALONE   the accelerations without contact                 then the selection, with what counts as rounding of forces
    STRIKE  the velocities behind an impact                   then its expansion, or the selection of what follows

A turn of the loop evaluates points of one kind, and decides what is next, which is cheap.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._mechanics.constrained_acceleration import Impulse
from .._mechanics.friction_elements import FrictionElements
from .._mechanics.slip_direction import asks_for_rates, changed_row, turned_by_rates, without_force
from .._mechanics.stick_slip import DONE as SELECTED
from .._mechanics.stick_slip import Friction, ModeSelection, sticking
from .._mechanics.stick_slip import Search as ModeSearch
from .._model.flat import Flat
from .._program.conditions import computed_first_with_changes, one_of, zeros_like
from .._program.time_bounds import TimeDependence, time_dependence
from .first_order import EquationsOfMotion
from .loads import loads_within
from .mode_changes import Approach, AtEnd, approach, at_rest_within, exactly, in_other_mode, margins, margins_of
from .protocol import Arguments, undifferentiated
from .runge_kutta import ExplicitRungeKutta, weighted, with_row
from .split import CHANGE, PHASES, REST, SEEN_LATE, SHORT, WHOLE, Cut, Piece, Split, next_estimate
from .state_vector import Parts
from .step_monitor import CHEBYSHEV, LOOKS, Looks, Monitor, Seen, changes_by_time, reach_of_time, slopes_of_interpolant
from .step_turn import BACK, BEGIN, COUNT, DONE, END, LOOK, SELECT, STAGE, TURN, Back, Begun, Choice, Decision, Point, Turn, Watch
from .witnesses import behind_mode, beyond, margins_at
from .wrapped_solver import ProjectedSolver


@dataclasses.dataclass(frozen=True)
class Step:
    """One step from t0 to t1."""

    solver: ProjectedSolver
    t0: Any
    t1: Any
    y0: Any
    args: Arguments
    of_time_alone: TimeDependence | None
    begins: Any = None  # whether the motion does, in a mode that has yet to be found

    @classmethod
    def of(cls, solver: ProjectedSolver, t0, t1, y0, args: Arguments, begins: Any = None) -> "Step":
        t, y, still = undifferentiated((t0, y0, args))
        equations = solver.equations
        assert isinstance(equations, EquationsOfMotion)  # as `has_one_evaluation` has it
        of_time = time_dependence(lambda t, y: margins(equations.as_written, t, y, still, y), t, y) if equations.follows_time else None
        return cls(solver, t0, t1, y0, args, of_time, begins)

    @property
    def equations(self) -> EquationsOfMotion:
        """Those of the motion."""
        assert isinstance(self.solver.equations, EquationsOfMotion)  # as `has_one_evaluation` has it
        return self.solver.equations

    @property
    def scheme(self) -> ExplicitRungeKutta:
        """The explicit scheme."""
        assert isinstance(self.solver.solver, ExplicitRungeKutta)  # as `has_one_evaluation` has it
        return self.solver.solver

    @property
    def phases(self) -> Array:
        """Those of a step, the last for one that ends before a second end of a mode."""
        phases = SEEN_LATE if self.equations.contacts or self.equations.events else PHASES
        return jnp.asarray([*phases, SHORT])

    @property
    def may_turn(self) -> bool:
        """Whether there are elements of several rows."""
        return self.equations.rows != self.equations.elements

    def run(self, rate, made_jump) -> Turn:
        """The step, from the rate at its start, which has yet to be made behind a jump."""
        return jax.lax.while_loop(lambda turn: turn.kind != DONE, self._turned, self._start(rate, made_jump))

    def _start(self, rate, made_jump) -> Turn:
        y0, no, none, modes = self.y0, jnp.array(False), jnp.zeros(self.equations.elements, bool), self.equations.modes
        t0, t1 = (jnp.asarray(t, y0.dtype) for t in (self.t0, self.t1))
        size, rows, margins = len(self.scheme.tableau.c), self.equations.rows, jnp.zeros(modes, y0.dtype)
        stages = jnp.concatenate([rate[None], jnp.zeros((size - 1, *rate.shape), rate.dtype)])
        piece = zeros_like(jax.eval_shape(self._finished, y0, stages, t1 - t0))
        start, end, stages, piece = _moving((t0, t1, stages, piece), y0)
        yes = jnp.array(True)
        split = Split(piece, piece, Cut(end, end, y0, no, yes, yes, no), Seen(no, no, no, t1, margins))
        looks, steepness = jnp.zeros((LOOKS + 1, 2 * modes), y0.dtype), jax.eval_shape(self._steepness, piece, t0, t1)
        watch = Watch(self._monitor(t0, t1).start(y0.dtype), jnp.zeros(LOOKS + 1, y0.dtype), looks, (t0, t1, looks), zeros_like(steepness))
        search = zeros_like(jax.eval_shape(lambda: self.new_search(y0, t0)))
        slip_rates = jnp.zeros((rows + 1 if self.may_turn else 0, rows), y0.dtype)
        choice = Choice(search, none, none, jnp.zeros(self.equations.events, bool), zeros_like(self._like().friction), slip_rates)
        first, stage = jnp.where(made_jump, 0, 1), jnp.array(STAGE)
        back = Back(start, y0, stage, stage, jnp.array(0))
        turn = Turn(stage, first, jnp.array(0), start, end, y0, stages, piece, split, watch, choice, back, self._unchanged())
        if self.begins is None:
            return turn
        kind, phase, first = (jnp.where(self.begins, a, b) for a, b in ((END, STAGE), (BEGIN, 0), (0, first)))
        piece = piece._replace(y=jnp.where(self.begins, y0, piece.y))
        end, begun = jnp.where(self.begins, start, end), Begun(y0, jnp.zeros(self.equations.size, y0.dtype), yes, yes, yes, yes)
        return turn._replace(kind=kind, phase=phase, first=first, end=end, piece=piece, begun=begun)

    def new_search(self, y, t) -> ModeSearch | None:
        """A search for the mode at a state, in shapes."""
        none = jnp.zeros(self.equations.elements, bool)
        return self.selection(y, t, none, none)[0].start()

    @property
    def no_impulse(self) -> Impulse | None:
        """An impact that does not happen, if there are contacts."""

    def _unchanged(self) -> Any:
        """What is known of contacts before any changes: there are none."""

    def _like(self) -> Point:
        """What an evaluation gives, in shapes."""
        given = self.equations.parts(self.y0), self.args, self.no_impulse, self.equations.correction(-1)
        return jax.eval_shape(lambda: Point(*self.equations.rates_and_friction(self.t0, *given)))

    def _turned(self, turn: Turn) -> Turn:
        """The points up to the next decision, and the decision; what is to be put back on the constraints, comes first."""
        turn, point = self._evaluated(turn)
        kind = jnp.where(turn.kind == TURN, SELECT, turn.kind)
        nothing = Decision(turn, jnp.array(False), turn.end, turn.y0)
        decided = [lambda before, decide=decide: decide(before.turn, point) for decide in self.decisions]
        turn, projects, t, y = one_of(kind, decided, nothing)
        back = Back(t, y, kind, turn.kind, turn.first)
        back = jax.tree.map(lambda new, old: jnp.where(projects, new, old), back, turn.back)
        kind, first = jnp.where(projects, BACK, turn.kind), jnp.where(projects, 0, turn.first)
        return turn._replace(kind=kind, first=first, back=back)

    def _put_back(self, turn: Turn, point: Point) -> Decision:
        """A state is back on its constraints, and what was decided before follows."""
        t, y, kind, *onward = turn.back
        turn = self.with_cut(turn._replace(kind=onward[0], first=onward[1]), kind == SELECT, y)
        return Decision(self.put(turn, kind == END, y), jnp.array(False), t, y)

    def with_cut(self, turn: Turn, here, y) -> Turn:
        """With the rest of the step from this y on, where it is `here` that a mode has ended."""
        if turn.begun is not None:  # works are counted from here on
            begins = here & (turn.phase == BEGIN + 1)
            without = self.equations.parts(y)._replace(works=jnp.zeros(len(self.equations.works), y.dtype)).y
            y = jnp.where(begins, without, y)
        return self._from_here(turn, here, y)

    def _from_here(self, turn: Turn, here, y) -> Turn:
        """With this y, where it is `here`."""
        if turn.begun is not None:
            begins = here & (turn.phase == BEGIN + 1)
            turn = turn._replace(begun=turn.begun._replace(y=jnp.where(begins, y, turn.begun.y)))
        split = turn.split._replace(cut=turn.split.cut._replace(y=jnp.where(here, y, turn.split.cut.y)))
        return turn._replace(split=split, y0=jnp.where(here, y, turn.y0))

    @property
    def decisions(self) -> list[Callable]:
        """What is decided where points have been evaluated, in the order of their kinds."""
        return [self._stages_done, self._looked, self._at_end, self._selected, self._put_back, self._counted]

    def put(self, turn: Turn, there, y) -> Turn:
        """With y, if it was put on the constraints where a mode ends."""
        return turn

    def unless_far(self, turn: Turn, looks) -> Turn:
        """Done, where bounds say, without looking along a piece, that no gap closes and nothing passes through zero on it."""
        if not self.is_rough:
            return turn
        start, end = jax.lax.stop_gradient((turn.start, turn.end))
        stays_away = self._approach(turn.piece, start, end).stays_away
        if stays_away is None:
            return turn
        is_far = jax.lax.cond(looks, lambda: stays_away(start, end), lambda: jnp.array(False))
        return turn._replace(kind=jnp.where(is_far, DONE, turn.kind))

    def _evaluated(self, turn: Turn) -> tuple[Turn, Point]:
        """The rates at stages and what takes the end of their piece back to its constraints, margins along a piece, or the friction at its
        end in a mode that is asked about; and the last point.
        """
        _, c, weights = map(jnp.asarray, self.scheme.stages(turn.y0.dtype))
        of_stages, last, corrections = len(c), self.scheme.tableau.stages - 1, self.corrections(turn)
        count = jnp.array([of_stages, LOOKS + 1, 1, 1, 0, 1, 1, 1, self.equations.rows + 1])[turn.kind]
        h, path, ts, asks = turn.end - turn.start, self.path(turn.piece, turn.start, turn.end), turn.watch.ts, turn.kind >= SELECT
        asked, impulse, is_stage, is_back = self.asked(turn), self.impulse(turn), turn.kind == STAGE, turn.kind == BACK
        count += jnp.where(is_stage | is_back, corrections, 0)

        def evaluated(carry):
            k, stages, values, slip_rates, back, _ = carry
            number = jnp.where(is_stage, k - of_stages, jnp.where(is_back, k, -1))  # of a correction
            i, j = jnp.where(number >= 0, last, jnp.minimum(k, of_stages - 1)), jnp.minimum(k, LOOKS)
            at_stage = jnp.where(c[i] == 1, turn.end, turn.start + c[i] * h), turn.y0 + h * weighted(weights[i], stages)
            asked_for = jnp.where(is_back, turn.back.t, turn.end), jnp.where(is_back, back, jnp.where(asks, asked(k), turn.piece.y))
            if self.equations.events:
                asked_for = tuple(jnp.where(turn.kind == COUNT, a, b) for a, b in zip((turn.start, turn.y0), asked_for, strict=True))
            of_three = zip((at_stage[0], jnp.where(number > 0, back, at_stage[1])), (ts[j], path(ts[j])), asked_for, strict=True)
            t, y = (jnp.where(is_stage, a, jnp.where(turn.kind == LOOK, b, c)) for a, b, c in of_three)
            t, y = computed_first_with_changes((t, y), turn.end)
            parts, correction, shares = self.equations.parts(y), self.equations.correction(number), ~is_stage & ~is_back
            found = self.equations.rates_and_friction(t, parts, self.args, impulse, correction, shares)
            point = computed_first_with_changes(Point(*found), t)
            after = 1
            if correction is not None:
                back = self.equations.where_corrected(t, parts, self.args, point.friction, number, back)
                after = self.equations.next_correction(parts, point.friction, number) - number
            seen, slip_rate = jax.lax.stop_gradient((self._margins(t, parts, point.friction), point.friction.slip_rate))
            stages = jnp.where(is_stage & (number < 0), with_row(stages, point.rates, k), stages)
            values = jnp.where(turn.kind == LOOK, with_row(values, seen, k), values)
            if self.may_turn:
                slip_rates = jnp.where(asks, with_row(slip_rates, slip_rate, k), slip_rates)
            return k + after, stages, values, slip_rates, back, point

        start = (
            turn.first,
            turn.stages,
            turn.watch.values,
            turn.choice.slip_rates,
            turn.back.there,
            _moving(zeros_like(self._like()), turn.y0),
        )
        _, stages, values, slip_rates, back, point = jax.lax.while_loop(lambda carry: carry[0] < count, evaluated, start)
        watch, choice = turn.watch._replace(values=values), turn.choice._replace(slip_rates=slip_rates)
        return turn._replace(stages=stages, watch=watch, choice=choice, back=turn.back._replace(there=back)), point

    def corrections(self, turn: Turn) -> Any:
        """How many points put a state back."""
        return self.equations.corrections[1]

    def impulse(self, turn: Turn) -> Impulse | None:
        """The impact that is asked about, if there are contacts."""

    def asked(self, turn: Turn) -> Callable:
        """y at the end of a piece in the mode that is asked about, with row k − 1 of σ changed."""
        selection, there = self.selection(turn.piece.y, turn.end, turn.choice.at_rest, turn.choice.breaking)
        freed, *_ = selection.kinds(turn.choice.search)
        sigma = without_force(selection.elements, turn.choice.search.mode.sigma, freed)
        there = there._replace(sign=beyond(there.sign, turn.choice.passed))
        return lambda k: there._replace(sigma=self.changed(sigma, k)).y

    def changed(self, sigma, k) -> Array:
        """σ with row k − 1 changed, where there are elements of several rows."""
        return sigma + changed_row(k - 1, sigma.size, sigma.dtype) if self.may_turn else sigma

    def _margins(self, t, parts: Parts, found: Friction):
        """Of elements, contacts and events, and bounds."""
        of_events = sum(margins_at(self.equations, t, parts._replace(v=found.qdot), self.args)) if self.equations.events else None
        return margins_of(self.equations, t, parts, self.args, found, of_events)

    def path(self, piece: Piece, start, end) -> Callable:
        """The dense output of a piece."""
        dense, start, end = jax.lax.stop_gradient((piece.dense, start, end))
        return self.scheme.interpolation_cls(t0=start, t1=end, **dense).evaluate

    def _monitor(self, start, end) -> Monitor:
        bounded = self.of_time_alone is None or self.of_time_alone.is_bounded
        return Monitor(self.equations.modes, self.args.scales, *jax.lax.stop_gradient((start, end)), bounded, nodes=CHEBYSHEV)

    @property
    def is_rough(self) -> bool:
        """Whether there are functions of the user's among the margins: gaps and witnesses."""
        return bool(self.equations.contacts or self.equations.events)

    def arriving(self, piece: Piece, start, end) -> Callable | None:
        """Which modes may end between two times along a path, for all that is known of what may be rough."""
        return self._approach(piece, start, end).may_arrive if self.is_rough else None

    def _approach(self, piece: Piece, start, end) -> Approach:
        """What is known of gaps and witnesses along a piece."""
        by_share = self.path(piece, jnp.zeros_like(start), jnp.ones_like(start))
        return approach(self.equations, by_share, start, end, self.args)

    def _steepness(self, piece: Piece, start, end):
        """How steeply margins follow what follows the time alone, along a piece."""
        return jnp.zeros(()) if self.of_time_alone is None else reach_of_time(self.of_time_alone, self.path(piece, start, end), start, end)

    def _finished(self, y0, stages, h) -> Piece:
        """A piece of its stages."""
        y1, error, dense, rate = self.scheme.finished(y0, stages, lambda change: h * change)
        counts = np.zeros(len(error), bool)
        counts[: len(self.solver.controlled)] = self.solver.controlled
        return Piece(y1, jnp.where(counts, error, 0), dense, rate)

    def contents(self, t, parts: Parts) -> tuple[Flat, FrictionElements]:
        """The system and its elements of dry friction."""
        return self.equations.rubbing(t, parts, self.args)

    def selection(self, y, t, at_rest, breaking) -> tuple[ModeSelection, Parts]:
        """The selection of a mode at the end of a piece; and the state there without what is but an error."""
        parts = self.equations.parts(jax.lax.stop_gradient(y))
        t, there = jax.lax.stop_gradient(t), parts.without(self.args.scales.of_velocities(parts.v))
        return ModeSelection(*self.contents(t, parts), t, parts.q, there.v, parts.sigma, at_rest, breaking), there

    def _stages_done(self, turn: Turn, point: Point) -> Decision:
        """Stages have become a piece: it is looked along, or the mode may end at its end."""
        piece = self._finished(turn.y0, turn.stages, turn.end - turn.start)
        y = piece.y
        if self.equations.projection:
            y = jnp.where(self.corrections(turn) > 0, turn.back.there, y)
        error = jnp.where(jnp.all(jnp.isfinite(y)), piece.error, jnp.inf)  # it is rejected, and tried again shorter
        piece = piece._replace(y=y, error=error, dense=piece.dense | {"y1": y})
        phase, monitor = self.phases[turn.phase], self._monitor(turn.start, turn.end)
        search, looks_along = monitor.start(piece.y.dtype), jnp.where(turn.start < turn.end, LOOK, DONE)
        kind = jnp.where((phase == WHOLE) | (phase == REST), looks_along, jnp.where(phase == SHORT, DONE, END))
        watch = turn.watch._replace(search=search, ts=monitor.times(search))
        turn = turn._replace(kind=kind, first=jnp.array(0), piece=piece, watch=watch)
        return Decision(self.unless_far(turn, turn.kind == LOOK), jnp.array(False), turn.end, y)

    def _looked(self, turn: Turn, point: Point) -> Decision:
        """It was looked along a piece: at other times next, or what was seen is known."""
        (search, ts, values, smooth, steepness), cut = turn.watch, turn.split.cut
        start, end = jax.lax.stop_gradient((turn.start, turn.end))
        monitor, rest = self._monitor(start, end), self.phases[turn.phase] == REST
        here = search.low, search.high, values
        smooth = low, high, nodes = jax.tree.map(lambda new, old: jnp.where(search.found, old, new), here, smooth)
        if self.of_time_alone is not None:
            anew = lambda: self._steepness(jax.lax.stop_gradient(turn.piece), start, end)
            steepness = jax.lax.cond(search.rounds == 0, anew, lambda: steepness)
        looks = Looks(values, slopes_of_interpolant(low, high, nodes, ts), changes_by_time(self.of_time_alone, steepness, ts))
        hides = self.arriving(turn.piece, start, end)
        search = dataclasses.replace(monitor, hides=hides).closer(search, ts, looks)
        before = search.low > start  # up to there no mode ends
        more, seen = monitor.going_on(search, ~(rest & before)), monitor.seen(search)
        shorter = rest & ~more & seen.ended & ~seen.unsure & before
        fine = more | ~rest | shorter | ~(seen.ended | seen.unsure | seen.negative)
        if not self.equations.elements:
            fine |= ~cut.consistent  # nothing can follow
        cuts = ~more & ~rest & seen.ended
        halfway = (start + search.low) / 2
        shorter &= cut.usable & fine & (halfway > jax.lax.stop_gradient(self.t0))
        onward, later = cuts | shorter, jnp.where(rest, halfway, seen.time)
        cut = cut._replace(usable=cut.usable & fine, estimate=jnp.where(rest, cut.estimate, seen.time))
        kept = jax.tree.map(lambda new, old: jnp.where(rest, old, new), seen, turn.split.seen)
        turn = turn._replace(
            kind=jnp.where(more, LOOK, jnp.where(onward, STAGE, DONE)),
            first=jnp.where(onward, 1, 0),
            phase=turn.phase + onward,
            end=jnp.where(onward, later, turn.end),
            split=turn.split._replace(seen=kept, cut=cut),
            watch=Watch(search, monitor.times(search), values, smooth, steepness),
        )
        return Decision(turn, jnp.array(False), turn.end, turn.piece.y)

    def _at_end(self, turn: Turn, point: Point) -> Decision:
        """Newton's next step for the time at which the mode ends; after the last, which elements are at rest and which break away."""
        parts, found, end = self.equations.parts(turn.piece.y), point.friction, turn.end
        value, last = self._margins(end, parts, found)[: self.equations.modes], (self.phases[turn.phase] == CHANGE) | self.at_start(turn)
        (_, elements), seen = self.contents(end, parts), turn.split.seen.slope
        seen, of_others = jnp.split(seen, [elements.size])
        slides = (elements.norms(parts.sigma) > 0) & (parts.held == 0) & jnp.isfinite(seen) & ~elements.is_quasistatic
        slope = jnp.where(slides, jax.lax.stop_gradient(elements.sums(parts.sigma * found.slip_rate)), seen)  # of a slip, its rate
        given = AtEnd(value, slope, jnp.zeros_like(value))
        if self.is_rough:
            witnessed = parts._replace(v=found.qdot)
            given = exactly(self.equations, end, witnessed, self.args, value, jnp.concatenate([slope, of_others]), found.qddot)
        cut, ended, moved = next_estimate(turn.split.cut, end, *given, (self.t0, self.t1), self.args)
        onward = turn._replace(
            kind=jnp.array(STAGE),
            first=jnp.array(1),
            phase=turn.phase + ~last,
            end=jnp.where(last, end, cut.estimate),
            split=turn.split._replace(cut=cut),
        )
        return self.ended(onward, last, parts, elements, found, ended, moved)

    def at_start(self, turn: Turn) -> Any:
        """Whether the motion has yet to begin."""
        return False if self.begins is None else turn.phase == BEGIN

    def ended(self, turn: Turn, last, parts: Parts, elements: FrictionElements, found: Friction, ended, moved) -> Decision:
        """After the last of Newton's steps, what follows a mode that has ended."""
        of_friction, passed = jnp.split(ended, [self.equations.elements])
        at_rest, breaking, stopped = at_rest_within(elements, turn.end, parts, self.args, of_friction, moved, found.driven)
        if self.begins is not None:
            begins = self.at_start(turn)
            resting = sticking(elements, parts.sigma)
            at_rest, breaking, passed = (jnp.where(begins, a, b) for a, b in ((resting, at_rest), (False, breaking), (False, passed)))
        selection, _ = self.selection(turn.piece.y, turn.end, at_rest, breaking)
        cut, choice = turn.split.cut, turn.choice._replace(search=selection.start(), at_rest=at_rest, breaking=breaking, passed=passed)
        turn = turn._replace(
            kind=jnp.where(last, SELECT, turn.kind),
            first=jnp.where(last, 0, turn.first),
            split=turn.split._replace(cut=cut._replace(usable=cut.usable & (stopped | ~last))),
            choice=choice,
        )
        return Decision(turn, jnp.array(False), turn.end, turn.piece.y)

    def _selected(self, turn: Turn, point: Point) -> Decision:
        """One more turn of the selection; in the mode that is found the step goes on, to be put on its constraints first."""
        selection, _ = self.selection(turn.piece.y, turn.end, turn.choice.at_rest, turn.choice.breaking)
        search, found, more, done = self.onward(selection, turn, point)
        y = self.in_mode(turn, selection.elements, search).y
        cut = turn.split.cut
        cut = cut._replace(consistent=jnp.where(done, search.mode.consistent, cut.consistent))
        turn = turn._replace(choice=turn.choice._replace(search=search, found=found), split=turn.split._replace(cut=cut))
        return Decision(self.with_rest(turn, more, done), done, turn.end, y)

    def in_mode(self, turn: Turn, elements: FrictionElements, search: ModeSearch) -> Parts:
        """The state at the end of a piece in the mode that was found; what holds at the start was not changed to."""
        before = self.equations.parts(turn.piece.y)
        after = in_other_mode(elements, before, search.mode)
        transitions = jnp.where(self.at_start(turn), before.transitions, after.transitions)
        return after._replace(transitions=transitions, sign=beyond(before.sign, turn.choice.passed))

    def _counted(self, turn: Turn, point: Point) -> Decision:
        """A state behind events, with those that have happened."""
        if not self.equations.events:
            return Decision(turn, jnp.array(False), turn.start, turn.y0)  # never asked for
        begins, passed = turn.phase == BEGIN + 1, turn.choice.passed
        parts = self.equations.parts(turn.y0)
        parts = parts._replace(sign=beyond(parts.sign, passed))  # as it was before
        y = behind_mode(self.equations, turn.start, turn.piece.y, parts, self.args, passed, point.friction, begins).y
        turn = self._from_here(turn._replace(kind=jnp.array(STAGE), first=jnp.array(0)), jnp.array(True), y)
        return Decision(turn, jnp.array(False), turn.start, y)

    def onward(self, selection: ModeSelection, turn: Turn, point: Point) -> tuple[ModeSearch, Friction, Any, Any]:
        """The search one turn on, and the friction that was found; whether it asks for slip rates first, and whether it has ended."""
        search, *_, kept, slip_rates = turn.choice
        *kinds, breaks = selection.kinds(search)
        found = jax.tree.map(lambda old, new: jnp.where(turn.kind == TURN, old, new), kept, jax.lax.stop_gradient(point.friction))
        given = selection.elements, found, search.mode.sigma
        more = (turn.kind == SELECT) & asks_for_rates(*given, tuple(kinds), search.free_rate)
        onward = selection.next(search, found, *turned_by_rates(*given, slip_rates, tuple(kinds), breaks, search.free_rate))
        search = jax.lax.stop_gradient(jax.tree.map(lambda new, old: jnp.where(more, old, new), onward, search))
        return search, found, more, ~more & (search.stage == SELECTED)

    def with_rest(self, turn: Turn, more, done) -> Turn:
        """With the rest of the step next, where the selection is done; what was before is its first piece."""
        if turn.begun is not None:
            cut, mode = turn.split.cut, turn.choice.search.mode
            parts = jax.lax.stop_gradient(self.equations.parts(turn.piece.y))
            loads = loads_within(*self.contents(turn.end, parts), turn.end, parts, turn.choice.found)
            found = Begun(turn.begun.y, loads, cut.consistent, ~jnp.any(mode.bound < 0), cut.dissipates, cut.impulsive)
            begins = done & self.at_start(turn)
            turn = turn._replace(begun=jax.tree.map(lambda new, old: jnp.where(begins, new, old), found, turn.begun))
        turn = turn._replace(kind=jnp.where(more, TURN, SELECT), first=jnp.where(more, 1, 0))
        return self.onto_rest(turn, done)

    def onto_rest(self, turn: Turn, done) -> Turn:
        """The rest of the step next, if what is before is done."""
        return turn._replace(
            kind=jnp.where(done, COUNT if self.equations.events else STAGE, turn.kind),
            first=jnp.where(done, 0, turn.first),
            phase=turn.phase + done,
            start=jnp.where(done, turn.end, turn.start),
            end=jnp.where(done, self.t1, turn.end),
            split=turn.split._replace(first=turn.piece),
        )


def _moving(tree, y):
    """The same numbers, as ones that move with y: where a loop is differentiated, what it carries is found to move in one pass."""
    moved = lambda x: jnp.where(np.False_, y[0].astype(x.dtype), x) if jnp.issubdtype(x.dtype, jnp.inexact) else x
    return jax.tree.map(moved, tree)
