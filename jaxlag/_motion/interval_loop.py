"""Integration from node to node: a node is a sample of the motion, or a time at which an input jumps or bends or a state is updated.

A step ends at each node, so that between two of them an input is a constant or a line, which need not be looked up. Where there is
nothing but samples, steps go on over these, and their dense output says what is there. The steps, their control and their stages are
diffrax's and the solver's; the loop around them, short as it is, runs in one kernel on a CPU. Variations are the derivative of each step
and not of the loop, which stays the same.

Source: Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, section I.14: this gives what the variational equations would.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._model.signal import origin_of
from .._model.states import flow
from .._program.single_kernel import in_one_kernel
from .event_record import has_stopped, with_events
from .events import behind_jump
from .interval_inputs import Inputs, Rows
from .protocol import Arguments
from .results import RESULTS, under_diffrax
from .runge_kutta import ExplicitRungeKutta
from .sparse_implicit import SparseImplicit
from .step_size import GuardedController, ResumingController, with_tolerances
from .variational import varied_along, with_variations

FIRST_STEP = 0.01  # what diffrax takes in a loop of its own; each step that is refused may be a fifth as long, each that is kept ten times


class Moving(NamedTuple):
    """What a step moves and is differentiated; leaves have their variations as last axes, one for each order."""

    t: Float[Array, ""]
    y: Array
    solver_state: PyTree


class Steps(NamedTuple):
    """What controls the steps and counts them, not differentiated."""

    length: Float[Array, ""]  # planned, of the next step
    solver_state: PyTree
    controller_state: PyTree
    has_jumped: Bool[Array, ""]
    following: tuple[Int[Array, ""], ...]  # of each signal its first sample after t, of each sampled state its next update
    sample: Int[Array, ""]  # the next one
    result: dfx.RESULTS
    accepted: Int[Array, ""]
    rejected: Int[Array, ""]


class Reached(NamedTuple):
    """Where a step has come: y at a sample it may end at, and before the jumps there; and its dense output, where that is of use."""

    shown: Array
    there: Array
    dense: PyTree


class Numbers(NamedTuple):
    """The numbers that the loop reads at each turn."""

    varied: tuple[PyTree, Array]  # params, and the time at which the motion begins
    args: Arguments  # without params
    tolerances: tuple[Array, Array]
    directions: tuple  # of what is varied, for each order


class IntervalLoop(NamedTuple):
    """The loop, apart from its numbers."""

    equations: Any
    solver: Any
    max_steps: int
    meter: dfx.AbstractProgressMeter
    ts: Rows
    inputs: Callable[[PyTree], Inputs]
    moving: tuple[bool, ...]  # which jumps move with what is varied
    dense: bool  # whether there is nothing but samples, which the dense output of the steps then shows

    def sample_time(self, sample: Int[Array, ""]) -> Float[Array, ""]:
        """Of a sample of the motion, or of the last."""
        return self.ts.at(jnp.minimum(sample, self.ts.shape[0] - 1))[0]

    def run(self, y0, following, sample, numbers: Numbers, saved: Any, write: Callable, loop: Callable) -> tuple[Moving, Steps, Any]:
        """From the first sample to the last, or as far as it goes; with what was saved at the samples. `sample` is the first one later."""
        first, last = (self.ts.at(i)[0] for i in (0, self.ts.shape[0] - 1))
        rtol, atol = numbers.tolerances
        rounding = jnp.finfo(y0.dtype).eps * jnp.maximum(jnp.abs(first), jnp.abs(last))
        norm = self.equations.error_norm
        controller = ResumingController(rtol, atol, smallest=4 * rounding, norm=norm)
        if self.dense:  # no node cuts a step short
            controller = GuardedController(rtol, atol, dtmin=4 * rounding, force_dtmin=False, norm=norm)
        same = rounding + jnp.finfo(y0.dtype).eps * jnp.abs(origin_of(numbers.varied[0]))  # times as given, which round with the user's
        stepping = self._replace(solver=with_tolerances(self.solver, controller))
        now = lambda x: _alone(x, numbers)

        def turn(carry):
            moving, steps, saved, meter = carry
            sample, before = steps.sample, jax.tree.map(now, moving)
            (moving, reached), (steps, is_sample) = stepping._varied(controller, same, steps, numbers)(moving)
            meter = self.meter.step(meter, (now(moving.t) - first) / (last - first))
            if self.dense:
                steps, saved = stepping._sampled(steps, (before.t, now(moving.t)), reached.dense, numbers, saved, write)
                return moving, steps, saved, meter
            for earlier, later in ((before.y, reached.there), (now(reached.there), moving.y)):
                saved = with_events(self.equations, write, saved, self.ts.shape[0], earlier, later, now)
            return moving, steps, write(saved, sample, reached.shown, is_sample), meter

        def going_on(carry):
            moving, steps, *_ = carry
            within = (steps.sample < self.ts.shape[0]) & (self.sample_time(steps.sample) > now(moving.t))  # the last may be repeated
            going = (steps.result == dfx.RESULTS.successful) & (steps.accepted + steps.rejected < self.max_steps)
            return within & going & ~has_stopped(self.equations, now(moving.y))

        moving, steps = stepping._start(controller, first, last, y0, following, sample, numbers)
        saved = with_events(self.equations, write, saved, self.ts.shape[0], None, y0, now)
        moving, steps, saved, meter = loop(going_on, turn, (moving, steps, saved, self.meter.init()))
        self.meter.close(meter)
        return moving, steps, saved

    def _start(self, controller, first, last, y0, following, sample, numbers: Numbers) -> tuple[Moving, Steps]:
        """What is there before the first step."""
        term, y = self._term(), _alone(y0, numbers)
        args_of = lambda params: numbers.args._replace(params=self.inputs(params).pieces(following))
        params, origin = numbers.varied
        planned = FIRST_STEP if self.dense else None  # and otherwise as the rates and their change suggest
        more = y, planned, args_of(params), self.solver.func, self.solver.error_order(term)
        t1, controller_state = controller.init(term, first, last, *more)

        def make(y, given):
            return eqx.partition(self.solver.init(term, first, t1, y, args_of(given[0])), eqx.is_inexact_array)

        is_new = isinstance(getattr(self.solver, "solver", self.solver), (ExplicitRungeKutta, SparseImplicit))
        if is_new:  # the first step makes the state of the solver, as it does behind a jump
            zeros = lambda like: jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), like)
            changing, rest = zeros(jax.eval_shape(lambda: make(y, numbers.varied)))
            changing = jax.tree.map(lambda x: functools.reduce(_with_zeros, y0.shape[y.ndim :], x), changing)
        else:
            changing, rest = varied_along(make, numbers.directions)(y0, numbers.varied)
        origin = functools.reduce(_with_zeros, y0.shape[y.ndim :], origin)
        moving = Moving(origin, y0, changing)  # y0 is that at a fixed time, where there are directions
        zero = jnp.array(0)
        return moving, Steps(t1 - first, rest, controller_state, jnp.array(is_new), following, sample, dfx.RESULTS.successful, zero, zero)

    def _varied(self, controller, same, steps: Steps, numbers: Numbers) -> Callable:
        """A step of what moves and its value at a sample, with their variations along the directions of what is varied, for each order."""

        function = lambda moving, given: self._step(controller, same, moving, given, steps, numbers.args)
        function = varied_along(function, numbers.directions)
        return lambda moving: function(moving, numbers.varied)

    def _sampled(self, steps: Steps, between, dense, numbers: Numbers, saved, write: Callable) -> tuple[Steps, Any]:
        """With the samples of the last step, if it was kept, from its dense output."""
        start, end = between
        path = lambda dense, t: (self.solver.interpolation_cls(t0=start, t1=end, **dense).evaluate(t), None)
        at = varied_along(path, [None] * len(numbers.directions))

        def sampled(carry):
            i, saved = carry
            return i + 1, write(saved, i, at(dense, self.sample_time(i))[0], jnp.array(True))

        is_within = lambda carry: (carry[0] < self.ts.shape[0]) & (self.sample_time(carry[0]) <= end) & (start < end)
        i, saved = jax.lax.while_loop(is_within, sampled, (steps.sample, saved))
        return steps._replace(sample=i), saved

    def _step(self, controller, same, moving: Moving, given, steps: Steps, args) -> tuple[tuple[Moving, Reached], tuple[Steps, Any]]:
        """One step, tried, up to the next node at most and behind the jumps there; nodes are at one time where they are no further apart
        than the `same` time may be by rounding.
        """
        (params, origin), t = given, moving.t
        sample = self.ts.at(self.ts.shape[0] - 1)[0] if self.dense else self.sample_time(steps.sample)
        inputs, periods = self.inputs(params), self.equations.periods(params)
        signals = len(inputs.records)
        ticks = [(origin + i * period).astype(t.dtype) for i, period in zip(steps.following[signals:], periods, strict=True)]
        ticks = [jnp.where(tick > t, tick, jnp.inf) for tick in ticks]  # a period that is not positive has none
        coming = [*inputs.times(steps.following, t), *ticks]
        node, end = functools.reduce(lambda first, time: jnp.where(time + same < first, time, first), coming, sample), t + steps.length
        t1 = jnp.where(end + same >= node, node, end)
        args, after = args._replace(params=inputs.pieces(steps.following)), args
        state = eqx.combine(moving.solver_state, steps.solver_state)
        keep, y, state, dense, planned, control, result = self._tried(controller, t, t1, moving.y, args, state, steps)

        t = jnp.where(keep, t1, t)
        passed = [keep & (t1 == node) & (time <= node + same) for time in coming]
        following = tuple(i + by for i, by in zip(steps.following, passed, strict=True))
        is_sample = keep & (t1 == node) & (sample <= node + same)
        for time, by, moves in zip(coming, passed, self.moving, strict=True):
            if moves:  # two nodes at one time are so for these numbers alone
                y = jnp.where(by, self._moved(time, t, y, args), y)
                t = jnp.where(by, time, t)
        follows_slopes = bool(self.equations.modes and self.equations.light)  # what slips without inertia
        bends = [follows_slopes or k in self.equations.driving for k in range(signals)]
        jump = [*map(max, inputs.jump, bends), *[True] * len(ticks)]
        jumps = functools.reduce(jnp.logical_or, (by for by, jumps in zip(passed, jump, strict=True) if jumps), jnp.array(False))
        after = after._replace(params=inputs.pieces(following))

        def behind(y):
            updated = self.equations.updated(t, y, after, passed[signals:]) if ticks else y
            return behind_jump(self.equations, t, y, updated, args, after)

        there = y
        if any(jump):
            y, consistent = jax.lax.cond(jumps, behind, lambda y: (y, jnp.array(True)), y)
            result = dfx.RESULTS.where(consistent, result, under_diffrax(RESULTS.no_friction))
        reached = Reached(self._moved(sample, t, y, after) if any(self.moving) else y, there, dense if self.dense else None)
        changing, rest = eqx.partition(state, eqx.is_inexact_array)
        counts = steps.sample + (is_sample & (not self.dense)), result, steps.accepted + keep, steps.rejected + ~keep
        steps = Steps(planned, rest, control, jumps | (steps.has_jumped & ~keep), following, *counts)
        return (Moving(t, y, changing), reached), jax.lax.stop_gradient((steps, is_sample))

    def _term(self) -> dfx.ODETerm:
        return dfx.ODETerm(in_one_kernel(self.equations.rates) if self.dense else self.equations.rates)

    def _moved(self, time, t, y, args):
        """y at a time that equals t, but moves otherwise with what is varied."""
        return flow(time, t, (y, self.equations.rates(t, y, args)))

    def _tried(self, controller, t0, t1, y0, args, state, steps: Steps):
        """A step of the solver and its dense output, and whether it is kept."""
        term = self._term()
        y1, error, dense, new, result = self.solver.step(term, t0, t1, y0, args, state, steps.has_jumped)
        *states, error = jax.lax.stop_gradient((t0, t1, y0, y1, error))
        more = error, self.solver.error_order(term), steps.controller_state
        keep, t, end, _, control, controlled = controller.adapt_step_size(*states, args, *more)
        y, state = jax.tree.map(lambda new, old: jnp.where(keep, new, old), (y1, new), (y0, state))
        if result is dfx.RESULTS.successful:  # always, as of an explicit scheme: to compare them would be compiled
            return keep, y, state, dense, end - t, control, controlled
        ended = result != dfx.RESULTS.successful
        if not (self.equations.contacts or self.equations.events):
            ended &= keep  # what was refused is tried again
        return keep, y, state, dense, end - t, control, dfx.RESULTS.where(ended, result, controlled)


def _alone(x: Array, numbers: Numbers) -> Array:
    """Without its variations."""
    return x[(..., *[0] * len(numbers.directions))]


def _with_zeros(x: Array, size: int) -> Array:
    """With variations of zero as a last axis of this size."""
    return with_variations(x, jnp.zeros((*x.shape, size - 1), x.dtype))
