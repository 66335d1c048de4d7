"""Steps that end a mode of dry friction where it ends."""

import functools

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp

from .._program.conditions import zeros_like
from .._program.jit import jitted
from .event_record import overflows
from .events import behind_end, behind_step
from .first_order import EquationsOfMotion
from .mode_changes import approach, at_end, margins
from .results import RESULTS, under_diffrax
from .runge_kutta import ExplicitRungeKutta
from .split import CHANGE, PHASES, REST, SEEN_LATE, WHOLE, Cut, Piece, Split, SplitInterpolation, next_estimate
from .step_monitor import Seen, first_end
from .wrapped_solver import ProjectedSolver

BARELY = 1e-6  # of the motion, the step that ends where a bound turns negative


class StickSlipSolver(ProjectedSolver):
    """A `ProjectedSolver` that ends a mode of friction where it ends, inside the step.

    The end of the mode is bracketed on the dense output, narrowed down there, and made exact by Newton's steps on the step itself, so
    that it is differentiated; their slope is not, for it decides how fast they converge and not to what. From there the step goes on
    in the new mode. A step with a second end is rejected. All phases are turns of one loop, so that the equations are compiled once.
    """

    equations: EquationsOfMotion
    reverse: bool = eqx.field(static=True)  # whether reverse mode may go through the loop over the phases

    @property
    def interpolation_cls(self):
        def pieces(*, t0, t1, cut, first, second):
            make = self.solver.interpolation_cls
            return SplitInterpolation(t0, t1, cut, make(t0=t0, t1=cut, **first), make(t0=jnp.where(cut < t1, cut, t0), t1=t1, **second))

        return pieces

    def init(self, terms, t0, t1, y0, args):
        """The state of the solver, and whether it has yet to be made: the loop over the first step's stages does, which is there anyway."""
        if not isinstance(self.solver, ExplicitRungeKutta):
            return self.solver.init(terms, t0, t1, y0, args), jnp.array(False)
        return jax.tree.map(jnp.zeros_like, y0), jnp.array(True)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        solver_state, is_new = solver_state
        made_jump = made_jump | is_new
        piece = lambda *given: Piece(*self.projected_step(terms, *given[:3], args, *given[3:])[:4])  # what failed has an infinite error
        given = t0, t1, y0, solver_state, jnp.asarray(made_jump)
        nothing = zeros_like(jax.eval_shape(piece, *given))
        no, zeros = jnp.array(False), jnp.zeros(self.equations.modes, y0.dtype)
        uncut = Split(nothing, nothing, Cut(t1, t1, y0, no, no, no, no), Seen(no, no, no, jnp.asarray(t1, y0.dtype), zeros))

        run = functools.partial(self._run, piece, given, args)
        _, split = self._phases(run, (jnp.array(0), uncut))
        y1, error, dense, solver_state, result = self._joined(split, t0, t1, y0, args)
        return y1, error, dense, (solver_state, jnp.array(False)), result

    def _phases(self, run, carry):
        """The step after its phases, from the number of the first: there is but one, unless a mode ends."""
        phases = SEEN_LATE if self.equations.contacts or self.equations.events else PHASES
        going_on = lambda carry: (carry[0] == 0) | (carry[1].seen.ended & (carry[0] < phases.size))
        turn = lambda carry: (carry[0] + 1, run(carry[1], jnp.asarray(phases)[carry[0]]))
        if not self.reverse:  # a sixth faster: a turn that does nothing copies all that the loop carries
            return jax.lax.while_loop(going_on, turn, carry)
        return jax.lax.fori_loop(0, phases.size, lambda _, carry: jax.lax.cond(going_on(carry), turn, lambda carry: carry, carry), carry)

    def _run(self, piece, given, args, split: Split, phase) -> Split:
        """One phase of the step."""
        t0, t1, y0, state, made_jump = given
        watched, rest = (phase == WHOLE) | (phase == REST), phase == REST
        start, end = jnp.where(rest, split.cut.time, t0), jnp.where(watched, t1, split.cut.estimate)
        state = jax.tree.map(lambda new, old: jnp.where(rest, new, old), split.first.state, state)
        done = piece(start, end, jnp.where(rest, split.cut.y, y0), state, rest | made_jump)
        watch = lambda: self._watch(split, done, start, end, args, rest)
        locate = lambda: self._locate(split, done, end, t0, t1, args, phase == CHANGE)
        return jax.lax.cond(watched, watch, locate)

    def _watch(self, split: Split, done: Piece, start, end, args, rest) -> Split:
        """What is seen along a piece: of the whole step when its mode ends, of the rest whether all is fine."""
        seen = self._seen(*jax.lax.stop_gradient((start, end, done.dense, args, ~rest)))
        fine = ~(seen.ended | seen.unsure | seen.negative)
        if not self.equations.elements:
            fine |= ~split.cut.consistent  # nothing can follow
        return jax.lax.cond(
            rest,
            lambda: split._replace(second=done, cut=split.cut._replace(usable=split.cut.usable & fine)),
            lambda: split._replace(first=done, second=done, seen=seen, cut=split.cut._replace(estimate=seen.time)),
        )

    def _locate(self, split: Split, done: Piece, end, t0, t1, args, last) -> Split:
        """A Newton step for the time at which the mode ends, from the margins at the end of the piece; after the last, the next mode."""
        found = at_end(self.equations, end, done.y, args, split.seen.slope)
        cut, ended, moved = next_estimate(split.cut, end, *found, (t0, t1), args)
        located = split._replace(first=done, cut=cut)
        return jax.lax.cond(last, lambda: self._change(located, ended, moved, args), lambda: located)

    def _change(self, split: Split, ended, moved, args) -> Split:
        """With the state in the mode that follows when those of the elements `ended` end; margins may be off by `moved`."""
        found = behind_end(self.equations, split.cut.time, split.first.y, args, ended, moved)
        fine = {"consistent": found.consistent, "dissipates": found.dissipates, "impulsive": found.impulsive}
        cut = split.cut._replace(y=found.y, **fine, usable=split.cut.usable & found.at_rest)
        return split._replace(cut=cut)

    def _joined(self, split: Split, t0, t1, y0, args):
        """What diffrax asks of a step, from its pieces."""
        (first, second, cut, seen), ended = split, split.seen.ended
        error = jnp.where(ended, first.error + second.error, first.error)  # a sum, which has a derivative at zero
        jammed = ended & cut.usable & ~cut.consistent & (self.equations.elements == 0)  # as between walls that close in
        # There, and where a bound has turned negative, steps shrink until the motion has come as far as it goes.
        shrinking = (seen.negative | jammed) & (t1 - t0 > BARELY * args.scales.duration)
        refused = (ended & ~cut.usable) | seen.unsure | shrinking | jammed
        error = jnp.where(refused, jnp.inf, error)
        error = self.refused(error, t0, t1, y0, args)
        consistent = ~ended | cut.consistent | ~cut.usable | shrinking
        none = RESULTS.no_friction if self.equations.elements else RESULTS.beyond_reach
        result = dfx.RESULTS.where(consistent, dfx.RESULTS.successful, under_diffrax(none))
        for passed, reason in ((cut.dissipates, RESULTS.energy_gained), (cut.impulsive, RESULTS.not_impulsive)):
            result = dfx.RESULTS.where(~ended | passed | ~cut.usable | jammed, result, under_diffrax(reason))
        result = dfx.RESULTS.where(seen.negative & ~shrinking, under_diffrax(RESULTS.negative_bound), result)
        result = dfx.RESULTS.where(self.equations.exhausted(second.y), under_diffrax(RESULTS.chattering), result)
        result = dfx.RESULTS.where(overflows(self.equations, second.y), under_diffrax(RESULTS.too_many_events), result)
        dense = {"cut": jnp.where(ended, cut.time, t1), "first": first.dense, "second": second.dense}
        return behind_step(self.equations, t1, second.y, args), error, dense, second.state, result

    @jitted
    def _seen(self, t0, t1, dense, args, exactly):
        """What is seen of the margins along a piece, on its dense output; not differentiated."""
        make, zero = self.solver.interpolation_cls, jnp.zeros_like(t0)
        path = make(t0=t0, t1=t1, **dense)
        of, as_written = (lambda t, y, start, e=e: margins(e, t, y, args, start) for e in (self.equations, self.equations.as_written))
        modes, along = self.equations.modes, (path.evaluate, t0, t1)
        if not (self.equations.contacts or self.equations.events):
            return first_end(of, *along, modes, args.scales, exactly)
        between = approach(self.equations, make(t0=zero, t1=zero + 1, **dense).evaluate, t0, t1, args)
        watched = lambda: first_end(of, *along, modes, args.scales, exactly, between.may_arrive, as_written)
        if between.stays_away is None:
            return watched()
        no = jnp.array(False)
        return jax.lax.cond(between.stays_away(t0, t1), lambda: Seen(no, no, no, t1, jnp.zeros(modes, t1.dtype)), watched)
