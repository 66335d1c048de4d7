"""Steps of the integration: put back on the constraints, cut where friction changes its mode, and begun anew where an input jumps."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from equinox.internal import prevbefore
from jaxtyping import Array, Float

from .._mechanics.power import energy_turnover
from .._mechanics.stick_slip import settle, slip_of
from .._model.signal import delayed
from .._model.system import EXPLICIT_TIME
from .._program.jit import jitted
from .first_order import Equations, in_other_mode
from .step_monitor import Seen, first_end, is_hidden
from .tableaux import Tableau

NEWTON_STEPS = 3  # the first makes the time right and its derivative, the others its higher derivatives
LAST = NEWTON_STEPS + 1  # pieces: the whole step, those up to the end of a mode, the rest
TOGETHER = 1e3  # modes that end within so many roundings of time end together
BARELY = 1e-6  # of the motion, the step that ends where a bound turns negative
NEGATIVE = dfx.RESULTS.stagnation  # how a step says so


class AtSamples(dfx.AbstractAdjoint):
    """Another adjoint, with samples at `ts` before what `SaveAt` asks for.

    `SaveAt(ts=ts)` has diffrax check `ts` while it runs, and a program with such a check is never taken from JAX's persistent cache.
    """

    adjoint: dfx.AbstractAdjoint
    ts: Float[Array, " k"]

    def loop(self, *, saveat, init_state, **how):
        times, states = jnp.full(self.ts.shape, jnp.inf), jnp.full((self.ts.size, *init_state.y.shape), jnp.inf, init_state.y.dtype)
        last = init_state.save_state
        samples = eqx.tree_at(lambda saved: (saved.ts, saved.ys), last, (times.astype(self.ts.dtype), states))
        state = eqx.tree_at(lambda state: state.save_state, init_state, [samples, last])
        return self.adjoint.loop(saveat=dfx.SaveAt(subs=[dfx.SubSaveAt(ts=self.ts), saveat.subs]), init_state=state, **how)


class Kept(dfx.AbstractWrappedSolver, dfx.AbstractAdaptiveSolver):
    """Any solver that estimates its error, with the end of each step put back on the constraints.

    `kept(t, y, args)` does that; the error of the first `controlled` entries of y alone sets the steps. Where an input has jumped, a
    step starts from `behind(t, y, args)`.
    """

    solver: dfx.AbstractAdaptiveSolver
    kept: Callable | None = eqx.field(static=True)
    controlled: int = eqx.field(static=True)
    behind: Callable | None = eqx.field(static=True)

    @property
    def term_structure(self):
        return self.solver.term_structure

    @property
    def interpolation_cls(self):
        return self.solver.interpolation_cls

    @property
    def term_compatible_contr_kwargs(self):
        return self.solver.term_compatible_contr_kwargs

    @property
    def scan_kind(self):
        return self.solver.scan_kind

    @property
    def root_finder(self):
        return self.solver.root_finder

    @property
    def root_find_max_steps(self):
        return self.solver.root_find_max_steps

    def order(self, terms):
        return self.solver.order(terms)

    def error_order(self, terms):
        return self.solver.error_order(terms)

    def init(self, terms, t0, t1, y0, args):
        return self.solver.init(terms, t0, t1, y0, args)

    def func(self, terms, t0, y0, args):
        return self.solver.func(terms, t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y0, _ = self._begun(t0, y0, args, made_jump)
        return self._stepped(terms, t0, t1, y0, args, solver_state, made_jump)

    def _begun(self, t0, y0, args, made_jump):
        """Where a step starts, and whether a mode of friction agrees with the forces there."""
        if self.behind is None:
            return y0, jnp.array(True)
        return jax.lax.cond(made_jump, lambda y: self.behind(t0, y, args), lambda y: (y, jnp.array(True)), y0)

    def _stepped(self, terms, t0, t1, y0, args, solver_state, made_jump):
        terms, given = self._within(terms, t1, args)
        y1, error, dense, solver_state, result = self.solver.step(terms, t0, t1, y0, given, solver_state, made_jump)
        error = jnp.where((np.arange(len(error)) < self.controlled).reshape(-1, *[1] * (error.ndim - 1)), error, 0)
        if self.kept is not None:
            y1 = self.kept(t1, y1, args)
            # A step that cannot be put back is rejected, and tried again with half the length or less.
            error = jnp.where(jnp.all(jnp.isfinite(y1)), error, jnp.inf)
        return y1, error, dense | {"y1": y1}, solver_state, result

    def _within(self, terms, t1, args):
        """Terms and args with which a stage beyond t1 sees held inputs as they are at t1, in front of the jump there."""
        if self.behind is None or not _looks_ahead(self.solver):
            return terms, args

        def rates(t, y, given):
            (params, scales), end = given
            return terms.vf(t, y, (delayed(params, jnp.maximum(t - end, 0)), scales))

        return dfx.ODETerm(rates), (args, t1)


def _looks_ahead(solver) -> bool:
    """Whether a stage lies beyond the end of the step, as of Kvaerno4 and Kvaerno5, which would feel its way to each jump."""
    tableau = getattr(solver, "tableau", None)
    return tableau is not None and any(c > 1 for c in tableau.c)


def _nodes(solver) -> np.ndarray:
    """The times, from 0 to 1, of the stages of a step that its error is estimated from."""
    tableau = getattr(solver, "tableau", None)
    if tableau is None:
        return np.linspace(0, 1, 5)
    estimates = tableau.errors if isinstance(tableau, Tableau) else [tableau.b_error]
    times = tableau.c if isinstance(tableau, Tableau) else [0.0, *tableau.c]
    return np.unique(np.clip([c for weights in estimates for c, weight in zip(times, weights, strict=False) if weight], 0, 1))


class TwoPieces(dfx.AbstractLocalInterpolation):
    """Dense output of a step with a change of mode in it, at `cut`."""

    t0: Any
    t1: Any
    cut: Any
    first: Any
    second: Any

    def evaluate(self, t0, t1=None, left=True):
        if t1 is not None:
            return self.evaluate(t1) - self.evaluate(t0)
        before = (t0 < self.cut) | ((t0 == self.cut) & left)
        return jnp.where(before, self.first.evaluate(t0), self.second.evaluate(t0))


class Piece(NamedTuple):
    """A step or a part of one: its end, error, dense output, the state of the solver, and whether it succeeded."""

    y: Any
    error: Any
    dense: Any
    state: Any
    result: dfx.RESULTS


class Turn(NamedTuple):
    """What is known of a step that may have the end of a mode in it: the pieces before and after it; where the first of them ends, and
    would better have ended; what was seen along the step; y in the next mode; whether that agrees with its forces, and whether the
    pieces can be used.
    """

    first: Piece
    second: Piece
    cut: Any
    next_cut: Any
    seen: Seen
    y_new: Any
    possible: Any
    usable: Any


class StickSlipSolver(Kept):
    """A `Kept` solver that ends a mode of friction where it ends, inside the step.

    The end of the mode is bracketed on the dense output, narrowed down there, and made exact by Newton's steps on the step itself, so
    that it is differentiated; their slope is not, for it decides how fast they converge and not to what. From there the step goes on
    in the new mode. A step with a second end is rejected. All pieces are turns of one loop, so that the equations are compiled once.
    """

    equations: Equations = eqx.field(static=True)

    @property
    def interpolation_cls(self):
        def pieces(*, t0, t1, cut, first, second):
            make = self.solver.interpolation_cls
            return TwoPieces(t0, t1, cut, make(t0=t0, t1=cut, **first), make(t0=jnp.where(cut < t1, cut, t0), t1=t1, **second))

        return pieces

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y0, begins = self._begun(t0, y0, args, made_jump)
        piece = lambda *given: Piece(*self._stepped(terms, *given[:3], args, *given[3:]))
        given = t0, t1, y0, solver_state, jnp.asarray(made_jump)
        nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(piece, *given))
        no, zeros = jnp.array(False), jnp.zeros(self.equations.elements, y0.dtype)
        start = Turn(nothing, nothing, t1, t1, Seen(no, no, no, jnp.asarray(t1, y0.dtype), zeros), y0, no, no)

        turn = functools.partial(self._turn, piece, given, args)
        needed = lambda before, count: jax.lax.cond((count == 0) | before.seen.ended, turn, lambda before, _: before, before, count)
        made, _ = jax.lax.scan(lambda *turn: (needed(*turn), None), start, np.arange(LAST + 1))
        first, second, ended = made.first, made.second, made.seen.ended
        cut = jnp.where(ended, made.cut, t1)
        error = jnp.where(ended, jnp.maximum(jnp.abs(first.error), jnp.abs(second.error)), first.error)
        # Where a bound has turned negative, steps shrink until the motion has come as far as it goes.
        shrinking = made.seen.negative & (t1 - t0 > BARELY * args[1].duration)
        error = jnp.where((ended & ~made.usable) | made.seen.unsure | shrinking, jnp.inf, error)
        error = jnp.where(
            is_hidden(lambda t, y: self.equations.rates(t, y, args), _nodes(self.solver), t0, t1, y0, args[1]), jnp.inf, error
        )
        possible = ~ended | made.possible | ~made.usable
        refused = dfx.RESULTS.where(possible & begins, dfx.RESULTS.successful, dfx.RESULTS.internal_error)
        refused = dfx.RESULTS.where(made.seen.negative & ~shrinking, NEGATIVE, refused)
        refused = dfx.RESULTS.where(self.equations.exhausted(second.y), dfx.RESULTS.max_steps_rejected, refused)
        result = dfx.RESULTS.where(first.result == dfx.RESULTS.successful, refused, first.result)
        return second.y, error, {"cut": cut, "first": first.dense, "second": second.dense}, second.state, result

    def _turn(self, piece, given, args, before, count):
        """One piece of the step: the whole at first; if a mode ends in it, what comes before that; and what comes after."""
        t0, t1, y0, state, made_jump = given
        looks, after = (count == 0) | (count == LAST), count == LAST
        begin, end = jnp.where(after, before.cut, t0), jnp.where(looks, t1, before.next_cut)
        state = jax.tree.map(lambda new, old: jnp.where(after, new, old), before.first.state, state)
        done = piece(begin, end, jnp.where(after, before.y_new, y0), state, after | made_jump)

        def look():
            seen = self._looked(begin, end, done.dense, args, ~after)
            fine = ~(seen.ended | seen.unsure | seen.negative)
            return jax.lax.cond(
                after,
                lambda: before._replace(second=done, usable=before.usable & fine),
                lambda: before._replace(first=done, second=done, seen=seen, next_cut=seen.time),
            )

        def locate():
            value, slope = self.equations.margins(end, done.y, args)[: self.equations.elements], before.seen.slope
            falling = slope < 0
            until = jnp.where(falling, jnp.abs(value) / jnp.where(falling, -slope, 1), jnp.inf)
            nearest = jax.lax.stop_gradient(jnp.argmin(until))
            better = end - value[nearest] / jnp.where(falling[nearest], slope[nearest], -jnp.inf)
            usable = jnp.any(falling) & (end >= t0) & (end < t1)
            located = before._replace(first=done, cut=end, next_cut=better, usable=usable)
            together = falling & (value <= -slope * TOGETHER * args[1].rounding)
            which = (jnp.arange(value.size) == nearest) | together
            return jax.lax.cond(count == LAST - 1, lambda: self._changed(located, which, args), lambda: located)

        return jax.lax.cond(looks, look, locate)

    def _changed(self, turn, which, args):
        """With the state in the mode that follows the end of those `which`."""
        y, possible, ready = self.equations.changed(turn.cut, turn.first.y, args, which)
        return turn._replace(y_new=y, possible=possible, usable=turn.usable & ready)

    @jitted
    def _looked(self, t0, t1, dense, args, exactly):
        """What is seen of the margins along a step, on its dense output."""
        t0, t1, dense, args = jax.lax.stop_gradient((t0, t1, dense, args))
        path = self.solver.interpolation_cls(t0=t0, t1=t1, **dense)
        margins = lambda t, y: self.equations.margins(t, y, args)
        return first_end(margins, path.evaluate, t0, t1, self.equations.elements, args[1], exactly)


@jitted
def behind_a_jump(equations: Equations, t, y, args):
    """y behind a jump of an input at t, and whether a mode of friction agrees with its forces.

    A velocity constraint that jumps takes q̇ along by an impulse, which is the projection in the metric of M. Friction is bounded and
    has no part in it: where there is slip then, it goes on as it is; where there is none, it sticks or breaks away.
    """
    params, scales = args
    q, v, works, sigma, *counts = equations.parts(y)
    flat, _, kinks = equations.mode(t, q, v, sigma, args)
    if equations.audit:
        lift = energy_turnover(flat, t, q, v)[0] - energy_turnover(flat, prevbefore(prevbefore(t)), q, v)[0]
        works = works.at[equations.works.index(EXPLICIT_TIME)].add(lift)
    slipping = jnp.concatenate([q, v, works, jnp.ones_like(sigma), *counts])
    y = slipping if equations.projection is None else equations.kept(t, slipping, args)
    if kinks is None:
        return y, jnp.array(True)
    q, v, works, *_ = equations.parts(y)
    slip = kinks.slip(t, q, v)
    size = kinks.norms(slip)
    along = slip / jnp.where(size > 0, size, 1)[kinks.element_of_row]
    at_rest = size <= slip_of(kinks, t, q, v, scales.error(v))
    mode = settle(flat, kinks, t, q, v, along, at_rest, jnp.zeros_like(at_rest))
    y = in_other_mode(equations, kinks, jnp.concatenate([q, v, works, sigma, *counts]), mode)
    return equations.kept(t, y, args), mode.consistent


class Wary(dfx.PIDController):
    """Steps that shrink where they come to numbers that are not finite, and end there by `nonlinear_divergence`."""

    def init(self, terms, t0, t1, *rest):
        tnext, state = super().init(terms, t0, t1, *rest)
        return jnp.where(jnp.isfinite(tnext), tnext, t1), state

    def adapt_step_size(self, t0, t1, y0, y1, args, error, *rest):
        finite = jnp.all(jnp.isfinite(y1)) & ~jnp.any(jnp.isnan(error))  # an infinite error is a step that was refused
        *step, result = super().adapt_step_size(t0, t1, y0, jnp.where(finite, y1, y0), args, jnp.where(finite, error, jnp.inf), *rest)
        lost = (result == dfx.RESULTS.dt_min_reached) & ~finite
        return *step, dfx.RESULTS.where(lost, dfx.RESULTS.nonlinear_divergence, result)


class Resuming(Wary):
    """Steps that resume their length after one that was cut short at a jump of an input, however short that was.

    A step that is kept makes the next one no shorter than was planned, and one that is rejected must stay above `smallest`. (Without
    this, two jumps a few units in the last place apart end the motion as singular.)
    """

    smallest: Any = 0.0

    def init(self, terms, t0, *rest):
        t1, state = super().init(terms, t0, *rest)
        return t1, (t1 - t0, state)

    def adapt_step_size(self, *given):
        *step, (planned, state) = given
        keep, t0, t1, made_jump, state, result = super().adapt_step_size(*step, state)
        planned = jnp.where(keep, jnp.maximum(t1 - t0, planned), t1 - t0)
        result = dfx.RESULTS.where(keep | (planned >= self.smallest), result, dfx.RESULTS.dt_min_reached)
        return keep, t0, t0 + planned, made_jump, (planned, state), result
