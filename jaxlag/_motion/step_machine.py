"""Steps with dry friction in one loop, which holds the equations once: an evaluation serves as a stage of the scheme, as a look at the
margins of a mode, as the end of a mode, and in the selection of the next one.

    STAGE   the rates at the stages of a piece of the step    then its end, put back on the constraints
    LOOK    the margins at some times along a piece           then the next times, or where the mode ends, if it does
    END     the margins where it ends                         then Newton's next piece up to there, or what is at rest there
    SELECT  the friction in a mode that may follow            then another one, or y in that mode, put on its constraints
    TURN    slip rates with each row of σ changed             then the same

A turn of the loop evaluates points of one kind, and decides what is next. What is decided is cheap; the projection, which is not, stands
behind all decisions once.
"""

import dataclasses
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._mechanics.friction_elements import FrictionElements
from .._mechanics.slip_direction import asks_for_rates, changed_row, turned_by_rates, without_force
from .._mechanics.stick_slip import DONE as SELECTED
from .._mechanics.stick_slip import Friction, ModeSelection
from .._mechanics.stick_slip import Search as ModeSearch
from .._model.flat import Flat
from .._program.conditions import computed_first_with_changes
from .._program.time_bounds import TimeDependence, time_dependence
from .first_order import EquationsOfMotion
from .mode_changes import at_rest_within, in_other_mode, margins
from .protocol import Arguments, undifferentiated
from .runge_kutta import ExplicitRungeKutta, weighted, with_row
from .split import CHANGE, PHASES, REST, WHOLE, Cut, Piece, Split, next_estimate
from .state_vector import Parts
from .step_monitor import CHEBYSHEV, LOOKS, Looks, Monitor, Search, Seen, changes_by_time, reach_of_time, slopes_of_interpolant
from .stick_slip_solver import StickSlipSolver

STAGE, LOOK, END, SELECT, TURN, DONE = range(6)


def has_one_evaluation(equations: EquationsOfMotion, solver: Any, reverse: bool, varied: bool) -> bool:
    """Whether one evaluation serves all: of an explicit scheme, where nothing but friction changes modes, and neither shares of it nor
    slips that constraints turn or drive are to be found beside.

    Where variations go along, it pays beside constraints and for elements of several rows alone: what is less takes longer to compile.
    """
    if varied and not equations.system.constraints and equations.rows == equations.elements:
        return False
    other = equations.contacts or equations.events or equations.sided
    plain = equations.formulation.stabilisation.feedback() is None and not equations.entangled
    return bool(isinstance(solver, ExplicitRungeKutta) and equations.elements and plain and not other and not reverse)


class Point(NamedTuple):
    """What is evaluated at one point."""

    rates: Array
    friction: Friction


class Watch(NamedTuple):
    """The search for an end along a piece: the times of its next look, and the margins there; what was looked at before there was an end
    in it, whose interpolant tells slopes; and how steeply margins follow what follows the time alone.
    """

    search: Search
    ts: Any
    values: Any
    smooth: tuple[Any, Any, Any]  # from one time to another, the values at its nodes
    steepness: Any


class Choice(NamedTuple):
    """The selection of the mode that follows: of what is at rest, and what breaks away; in the mode that is asked about, the friction, and
    slip rates, with each row of σ changed as well.
    """

    search: ModeSearch
    at_rest: Any
    breaking: Any
    found: Friction
    slip_rates: Any


class Turn(NamedTuple):
    """What the loop carries: the kind of its next points, and the number of the first; the phase of the step; the piece of it that is
    made, from y0 at its start to its end; the step so far.
    """

    kind: Any
    first: Any
    phase: Any
    start: Any
    end: Any
    y0: Any
    stages: Any
    piece: Piece
    split: Split
    watch: Watch
    choice: Choice


class Decision(NamedTuple):
    """The turn that follows; and whether y is to be put on the constraints at some time, and given to it."""

    turn: Turn
    projects: Any
    t: Any
    y: Any


class OneEvaluationSolver(StickSlipSolver):
    """A `StickSlipSolver` of an explicit scheme, all of whose evaluations are those of one loop."""

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        rate, is_new = solver_state
        done = _Step.of(self, t0, t1, y0, args).run(rate, made_jump | is_new)
        ended, ok = done.split.seen.ended, dfx.RESULTS.successful
        first = jax.tree.map(lambda cut, whole: jnp.where(ended, cut, whole), done.split.first, done.piece)
        split = done.split._replace(first=first._replace(result=ok), second=done.piece._replace(result=ok))
        y1, error, dense, rate, result = self._joined(split, t0, t1, y0, args)
        return y1, error, dense, (rate, jnp.array(False)), result


@dataclasses.dataclass(frozen=True)
class _Step:
    """One step from t0 to t1."""

    solver: OneEvaluationSolver
    t0: Any
    t1: Any
    y0: Any
    args: Arguments
    of_time_alone: TimeDependence | None

    @classmethod
    def of(cls, solver: OneEvaluationSolver, t0, t1, y0, args: Arguments) -> "_Step":
        t, y, still = undifferentiated((t0, y0, args))
        return cls(solver, t0, t1, y0, args, time_dependence(lambda t, y: margins(solver.equations, t, y, still, y), t, y))

    @property
    def equations(self) -> EquationsOfMotion:
        """Those of the motion."""
        return self.solver.equations

    @property
    def scheme(self) -> ExplicitRungeKutta:
        """The explicit scheme."""
        assert isinstance(self.solver.solver, ExplicitRungeKutta)  # as `has_one_evaluation` has it
        return self.solver.solver

    @property
    def may_turn(self) -> bool:
        """Whether there are elements of several rows."""
        return self.equations.rows != self.equations.elements

    def run(self, rate, made_jump) -> Turn:
        """The step, from the rate at its start, which has yet to be made behind a jump."""
        return jax.lax.while_loop(lambda turn: turn.kind != DONE, self._turned, self._start(rate, made_jump))

    def _start(self, rate, made_jump) -> Turn:
        y0, no, none = self.y0, jnp.array(False), jnp.zeros(self.equations.elements, bool)
        t0, t1 = (jnp.asarray(t, y0.dtype) for t in (self.t0, self.t1))
        size, rows, margins = len(self.scheme.tableau.c), self.equations.rows, jnp.zeros(none.size, y0.dtype)
        stages = jnp.concatenate([rate[None], jnp.zeros((size - 1, *rate.shape), rate.dtype)])
        piece = _zeros(jax.eval_shape(self._finished, y0, stages, t1 - t0))
        start, end, stages, piece = _moving((t0, t1, stages, piece), y0)
        split = Split(piece, piece, Cut(end, end, y0, no, no, no, no), Seen(no, no, no, t1, margins))
        looks, steepness = jnp.zeros((LOOKS + 1, 2 * none.size), y0.dtype), jax.eval_shape(self._steepness, piece, t0, t1)
        watch = Watch(self._monitor(t0, t1).start(y0.dtype), jnp.zeros(LOOKS + 1, y0.dtype), looks, (t0, t1, looks), _zeros(steepness))
        search = _zeros(jax.eval_shape(lambda: self._selection(y0, t0, none, none)[0].start()))
        slip_rates = jnp.zeros((rows + 1 if self.may_turn else 0, rows), y0.dtype)
        choice = Choice(search, none, none, _zeros(self._like().friction), slip_rates)
        first = jnp.where(made_jump, 0, 1)
        return Turn(jnp.array(STAGE), first, jnp.array(0), start, end, y0, stages, piece, split, watch, choice)

    def _like(self) -> Point:
        """What an evaluation gives, in shapes."""
        return jax.eval_shape(lambda: Point(*self.equations.rates_and_friction(self.t0, self.equations.parts(self.y0), self.args)))

    def _turned(self, turn: Turn) -> Turn:
        """The points up to the next decision, the decision, and what it puts back on the constraints."""
        turn, point = self._evaluated(turn)
        kind = jnp.minimum(turn.kind, SELECT)
        turn, projects, t, y = jax.lax.switch(kind, [self._stages_done, self._looked, self._at_end, self._selected], turn, point)
        projected = self.solver.projected
        assert projected is not None  # there is friction
        y = jax.lax.cond(projects, lambda: projected(t, y, self.args), lambda: y)
        of_piece, of_cut = projects & (kind == STAGE), projects & (kind == SELECT)
        piece, cut = turn.piece, turn.split.cut
        piece = piece._replace(
            y=jnp.where(of_piece, y, piece.y),
            error=jnp.where(of_piece & ~jnp.all(jnp.isfinite(y)), jnp.inf, piece.error),  # it is rejected, and tried again shorter
            dense=piece.dense | {"y1": jnp.where(of_piece, y, piece.dense["y1"])},
        )
        split = turn.split._replace(cut=cut._replace(y=jnp.where(of_cut, y, cut.y)))
        return turn._replace(piece=piece, split=split, y0=jnp.where(of_cut, y, turn.y0))

    def _evaluated(self, turn: Turn) -> tuple[Turn, Point]:
        """The rates at stages, margins along a piece, or the friction at its end in a mode that is asked about; and the last point."""
        _, c, weights = map(jnp.asarray, self.scheme.stages(turn.y0.dtype))
        count = jnp.array([len(c), LOOKS + 1, 1, 1, self.equations.rows + 1])[turn.kind]
        h, path, ts, asks = turn.end - turn.start, self._path(turn.piece, turn.start, turn.end), turn.watch.ts, turn.kind >= SELECT
        asked = self._asked(turn)

        def evaluated(carry):
            k, stages, values, slip_rates, _ = carry
            i, j = jnp.minimum(k, len(c) - 1), jnp.minimum(k, LOOKS)
            at_stage = jnp.where(c[i] == 1, turn.end, turn.start + c[i] * h), turn.y0 + h * weighted(weights[i], stages)
            of_three = zip(at_stage, (ts[j], path(ts[j])), (turn.end, jnp.where(asks, asked(k), turn.piece.y)), strict=True)
            t, y = (jnp.where(turn.kind == STAGE, a, jnp.where(turn.kind == LOOK, b, c)) for a, b, c in of_three)
            t, y = computed_first_with_changes((t, y), turn.end)
            parts = self.equations.parts(y)
            point = computed_first_with_changes(Point(*self.equations.rates_and_friction(t, parts, self.args)), t)
            seen, slip_rate = jax.lax.stop_gradient((self._margins(parts, point.friction), point.friction.slip_rate))
            stages = jnp.where(turn.kind == STAGE, with_row(stages, point.rates, k), stages)
            values = jnp.where(turn.kind == LOOK, with_row(values, seen, k), values)
            if self.may_turn:
                slip_rates = jnp.where(asks, with_row(slip_rates, slip_rate, k), slip_rates)
            return k + 1, stages, values, slip_rates, point

        start = turn.first, turn.stages, turn.watch.values, turn.choice.slip_rates, _moving(_zeros(self._like()), turn.y0)
        _, stages, values, slip_rates, point = jax.lax.while_loop(lambda carry: carry[0] < count, evaluated, start)
        watch, choice = turn.watch._replace(values=values), turn.choice._replace(slip_rates=slip_rates)
        return turn._replace(stages=stages, watch=watch, choice=choice), point

    def _asked(self, turn: Turn):
        """y at the end of a piece in the mode that is asked about, with row k − 1 of σ changed."""
        selection, there = self._selection(turn.piece.y, turn.end, turn.choice.at_rest, turn.choice.breaking)
        freed, *_ = selection.kinds(turn.choice.search)
        sigma = without_force(selection.elements, turn.choice.search.mode.sigma, freed)
        changed = lambda k: sigma + changed_row(k - 1, sigma.size, sigma.dtype) if self.may_turn else sigma
        return lambda k: there._replace(sigma=changed(k)).y

    def _margins(self, parts: Parts, found: Friction):
        """Of the elements, and their bounds."""
        return jnp.concatenate([jnp.where(parts.held > 0, 1, found.margin), found.bound])

    def _path(self, piece: Piece, start, end):
        dense, start, end = jax.lax.stop_gradient((piece.dense, start, end))
        return self.scheme.interpolation_cls(t0=start, t1=end, **dense).evaluate

    def _monitor(self, start, end) -> Monitor:
        bounded = self.of_time_alone is None or self.of_time_alone.is_bounded
        return Monitor(self.equations.elements, self.args.scales, *jax.lax.stop_gradient((start, end)), bounded, nodes=CHEBYSHEV)

    def _steepness(self, piece: Piece, start, end):
        """How steeply margins follow what follows the time alone, along a piece."""
        return jnp.zeros(()) if self.of_time_alone is None else reach_of_time(self.of_time_alone, self._path(piece, start, end), start, end)

    def _finished(self, y0, stages, h) -> Piece:
        """A piece of its stages."""
        y1, error, dense, rate = self.scheme.finished(y0, stages, lambda change: h * change)
        counts = np.zeros(len(error), bool)
        counts[: len(self.solver.controlled)] = self.solver.controlled
        return Piece(y1, jnp.where(counts, error, 0), dense, rate, None)

    def _contents(self, t, parts: Parts) -> tuple[Flat, FrictionElements]:
        flat, elements = self.equations.contents(t, parts, self.args)
        assert elements is not None  # as `has_one_evaluation` has it
        return flat, elements

    def _selection(self, y, t, at_rest, breaking) -> tuple[ModeSelection, Parts]:
        """The selection of a mode at the end of a piece; and the state there without what is but an error."""
        parts = self.equations.parts(jax.lax.stop_gradient(y))
        t, there = jax.lax.stop_gradient(t), parts.without(self.args.scales.of_velocities(parts.v))
        return ModeSelection(*self._contents(t, parts), t, parts.q, there.v, parts.sigma, at_rest, breaking), there

    def _stages_done(self, turn: Turn, point: Point) -> Decision:
        """Stages have become a piece: it is looked along, or the mode may end at its end."""
        piece = self._finished(turn.y0, turn.stages, turn.end - turn.start)
        phase, monitor = jnp.asarray(PHASES)[turn.phase], self._monitor(turn.start, turn.end)
        search, looks_along = monitor.start(piece.y.dtype), jnp.where(turn.start < turn.end, LOOK, DONE)
        kind = jnp.where((phase == WHOLE) | (phase == REST), looks_along, END)
        watch = turn.watch._replace(search=search, ts=monitor.times(search))
        return Decision(turn._replace(kind=kind, first=jnp.array(0), piece=piece, watch=watch), jnp.array(True), turn.end, piece.y)

    def _looked(self, turn: Turn, point: Point) -> Decision:
        """It was looked along a piece: at other times next, or what was seen is known."""
        (search, ts, values, smooth, steepness), cut = turn.watch, turn.split.cut
        start, end = jax.lax.stop_gradient((turn.start, turn.end))
        monitor, rest = self._monitor(start, end), jnp.asarray(PHASES)[turn.phase] == REST
        here = search.low, search.high, values
        smooth = low, high, nodes = jax.tree.map(lambda new, old: jnp.where(search.found, old, new), here, smooth)
        if self.of_time_alone is not None:
            anew = lambda: self._steepness(jax.lax.stop_gradient(turn.piece), start, end)
            steepness = jax.lax.cond(search.rounds == 0, anew, lambda: steepness)
        looks = Looks(values, slopes_of_interpolant(low, high, nodes, ts), changes_by_time(self.of_time_alone, steepness, ts))
        search = monitor.closer(search, ts, looks)
        more, seen = monitor.going_on(search, ~rest), monitor.seen(search)
        fine = more | ~rest | ~(seen.ended | seen.unsure | seen.negative)
        cuts = ~more & ~rest & seen.ended
        cut = cut._replace(usable=cut.usable & fine, estimate=jnp.where(rest, cut.estimate, seen.time))
        kept = jax.tree.map(lambda new, old: jnp.where(rest, old, new), seen, turn.split.seen)
        turn = turn._replace(
            kind=jnp.where(more, LOOK, jnp.where(cuts, STAGE, DONE)),
            first=jnp.where(cuts, 1, 0),
            phase=turn.phase + cuts,
            end=jnp.where(cuts, seen.time, turn.end),
            split=turn.split._replace(seen=kept, cut=cut),
            watch=Watch(search, monitor.times(search), values, smooth, steepness),
        )
        return Decision(turn, jnp.array(False), turn.end, turn.piece.y)

    def _at_end(self, turn: Turn, point: Point) -> Decision:
        """Newton's next step for the time at which the mode ends; after the last, which elements are at rest and which break away."""
        parts, found = self.equations.parts(turn.piece.y), point.friction
        value, last = self._margins(parts, found)[: self.equations.elements], jnp.asarray(PHASES)[turn.phase] == CHANGE
        (_, elements), seen = self._contents(turn.end, parts), turn.split.seen.slope
        slides = (elements.norms(parts.sigma) > 0) & (parts.held == 0) & jnp.isfinite(seen) & ~elements.is_quasistatic
        slope = jnp.where(slides, jax.lax.stop_gradient(elements.sums(parts.sigma * found.slip_rate)), seen)  # of a slip, its rate
        given = turn.end, value, slope, jnp.zeros_like(value)
        cut, ended, moved = next_estimate(turn.split.cut, *given, (self.t0, self.t1), self.args)
        at_rest, breaking, stopped = at_rest_within(elements, turn.end, parts, self.args, ended, moved, found.driven)
        selection, _ = self._selection(turn.piece.y, turn.end, at_rest, breaking)
        turn = turn._replace(
            kind=jnp.where(last, SELECT, STAGE),
            first=jnp.where(last, 0, 1),
            phase=turn.phase + ~last,
            end=jnp.where(last, turn.end, cut.estimate),
            split=turn.split._replace(cut=cut._replace(usable=cut.usable & (stopped | ~last))),
            choice=turn.choice._replace(search=selection.start(), at_rest=at_rest, breaking=breaking),
        )
        return Decision(turn, jnp.array(False), turn.end, turn.piece.y)

    def _selected(self, turn: Turn, point: Point) -> Decision:
        """One more turn of the selection; in the mode that is found the step goes on, to be put on its constraints first."""
        search, at_rest, breaking, kept, slip_rates = turn.choice
        selection, _ = self._selection(turn.piece.y, turn.end, at_rest, breaking)
        *kinds, breaks = selection.kinds(search)
        found = jax.tree.map(lambda old, new: jnp.where(turn.kind == TURN, old, new), kept, jax.lax.stop_gradient(point.friction))
        given = selection.elements, found, search.mode.sigma
        more = (turn.kind == SELECT) & asks_for_rates(*given, tuple(kinds), search.free_rate)
        onward = selection.next(search, found, *turned_by_rates(*given, slip_rates, tuple(kinds), breaks, search.free_rate))
        search = jax.lax.stop_gradient(jax.tree.map(lambda new, old: jnp.where(more, old, new), onward, search))
        done = ~more & ((search.stage == SELECTED) | (search.turns >= selection.most))
        y = in_other_mode(selection.elements, self.equations.parts(turn.piece.y), search.mode).y
        yes, cut = jnp.array(True), turn.split.cut
        cut = cut._replace(consistent=jnp.where(done, search.mode.consistent, cut.consistent), dissipates=yes, impulsive=yes)
        turn = turn._replace(
            kind=jnp.where(done, STAGE, jnp.where(more, TURN, SELECT)),
            first=jnp.where(more, 1, 0),
            phase=turn.phase + done,
            start=jnp.where(done, turn.end, turn.start),
            end=jnp.where(done, self.t1, turn.end),
            split=turn.split._replace(cut=cut, first=turn.piece),
            choice=turn.choice._replace(search=search, found=found),
        )
        return Decision(turn, done, turn.start, y)


def _zeros(like):
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)


def _moving(tree, y):
    """The same numbers, as ones that move with y: where a loop is differentiated, what it carries is found to move in one pass."""
    moved = lambda x: jnp.where(np.False_, y[0].astype(x.dtype), x) if jnp.issubdtype(x.dtype, jnp.inexact) else x
    return jax.tree.map(moved, tree)
