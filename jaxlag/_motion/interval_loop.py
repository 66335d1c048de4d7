"""Integration from node to node: a node is a sample of the motion, or a time at which an input jumps or bends or a state is updated.

A step ends at each node, so that between two of them an input is a constant or a line, which need not be looked up. Where there is
nothing but samples, steps go on over these, and their dense output says what is there. The steps, their control and their stages are
diffrax's and the solver's; the loop around them, short as it is, runs in one kernel on a CPU. Variations are the derivative of each step
and not of the loop, which stays the same.

Source: Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, section I.14: this gives what the variational equations would.
"""

import dataclasses
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
from .._program.conditions import zeros_like
from .._program.single_kernel import in_one_kernel
from .event_record import has_stopped, with_events
from .events import behind_jump
from .interval_inputs import Inputs, Rows
from .protocol import Arguments
from .results import RESULTS, under_diffrax
from .runge_kutta import ExplicitRungeKutta
from .sparse_implicit import SparseImplicit
from .step_size import StepControl, with_tolerances
from .variational import varied_along, with_variations


class Moving(NamedTuple):
    """What a step moves and is differentiated; leaves have their variations as last axes, one for each order."""

    t: Float[Array, ""]
    y: Array
    solver_state: PyTree


class Steps(NamedTuple):
    """What controls the steps and counts them, not differentiated."""

    length: Float[Array, ""]  # planned, of the next step
    solver_state: PyTree
    control: PyTree
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


class Tried(NamedTuple):
    """A step that was tried: its end, the node that follows, y and its error, the state of the solver, its dense output where that is of
    use.
    """

    t1: Float[Array, ""]
    node: Float[Array, ""]
    y: Array
    error: Array
    solver_state: PyTree
    dense: PyTree


class Numbers(NamedTuple):
    """The numbers that the loop reads at each turn."""

    varied: tuple[PyTree, Array]  # params, and the time at which the motion begins
    args: Arguments  # without params
    tolerances: tuple[Array, Array | None]
    directions: tuple  # of what is varied, for each order


class Resumed(NamedTuple):
    """Where a motion goes on that was left: the planned length of its next step, what controls the steps, and whether inputs, which are
    others since, leave it in its mode.
    """

    length: Float[Array, ""]
    control: PyTree
    known: Bool[Array, ""]


class IntervalLoop(NamedTuple):
    """The loop, apart from its numbers."""

    equations: Any
    solver: Any
    max_steps: int
    meter: dfx.AbstractProgressMeter
    ts: Rows
    inputs: Callable[[PyTree], Inputs]
    moving: tuple[bool, ...]  # which jumps move with what is varied
    variations: int  # how many last axes of the y of the equations hold variations
    dense: bool  # whether there is nothing but samples, which the dense output of the steps then shows

    @property
    def begins(self) -> bool:
        """Whether the first step finds the mode at the start."""
        return getattr(self.solver, "begins", False)

    def sample_time(self, sample: Int[Array, ""]) -> Float[Array, ""]:
        """Of a sample of the motion, or of the last."""
        return self.ts.at(jnp.minimum(sample, self.ts.shape[0] - 1))[0]

    def run(
        self, y0, following, sample, numbers: Numbers, resumed: Resumed | None, saved: Any, write: Callable, loop: Callable
    ) -> tuple[Moving, Steps, Any]:
        """From the first sample to the last, or as far as it goes; with what was saved at the samples. `sample` is the first one later."""
        first, last = (self.ts.at(i)[0] for i in (0, self.ts.shape[0] - 1))
        rounding = jnp.finfo(y0.dtype).eps * jnp.maximum(jnp.abs(first), jnp.abs(last))
        same = rounding + jnp.finfo(y0.dtype).eps * jnp.abs(origin_of(numbers.varied[0]))  # times as given, which round with the user's
        variations = self.variations + len(numbers.directions)
        control = StepControl.of(numbers.tolerances, (first, last), self.equations, variations, resumes=not self.dense)
        if resumed is not None:
            control = dataclasses.replace(control, duration=numbers.args.scales.duration)
        now = lambda x: _alone(x, numbers)

        def turn(carry):
            moving, steps, saved, meter = carry
            sample, before = steps.sample, jax.tree.map(now, moving)
            size = steps.control[0].size
            stepping = self._replace(solver=with_tolerances(self.solver, control, now(size)))
            scales = _at_scale(numbers.args.scales, size)
            if self.begins:
                scales = scales._replace(held=scales.held + jax.lax.stop_gradient(now(self.solver.loads_of(moving.solver_state))))
            scaled = numbers._replace(args=numbers.args._replace(scales=scales))
            (moving, reached), (steps, is_sample) = stepping._varied(control, same, steps, scaled)(moving)
            meter = self.meter.step(meter, (now(moving.t) - first) / (last - first))
            if self.dense:
                steps, saved = self._sampled(steps, (before.t, now(moving.t)), reached.dense, numbers, saved, write)
                return moving, steps, saved, meter
            for earlier, later in ((before.y, reached.there), (now(reached.there), moving.y)):
                saved = with_events(self.equations, write, saved, self.ts.shape[0], earlier, later, now)
            return moving, steps, write(saved, sample, reached.shown, is_sample), meter

        def going_on(carry):
            moving, steps, *_ = carry
            within = (steps.sample < self.ts.shape[0]) & (self.sample_time(steps.sample) > now(moving.t))  # the last may be repeated
            if self.begins:
                within |= ~steps.solver_state[2].known  # where all times are the same, there is the start alone
            going = (steps.result == dfx.RESULTS.successful) & (steps.accepted + steps.rejected < self.max_steps)
            return within & going & ~has_stopped(self.equations, now(moving.y))

        moving, steps = self._start(control, first, last, y0, following, sample, numbers)
        steps = steps if resumed is None else self._resumed(steps, resumed, numbers)
        saved = with_events(self.equations, write, saved, self.ts.shape[0], None, y0, now)
        moving, steps, saved, meter = loop(going_on, turn, (moving, steps, saved, self.meter.init()))
        self.meter.close(meter)
        if self.begins:
            saved = self._with_start(moving, steps, y0, sample, saved, write)
        return moving, steps, saved

    def _resumed(self, steps: Steps, resumed: Resumed, numbers: Numbers) -> Steps:
        """With the steps as they were planned; variations, whose scales are those of this part alone, are planned for anew."""
        of_motion = lambda new, old: jnp.asarray(new).at[(..., *[0] * (jnp.ndim(new) - old.ndim))].set(old)
        control = jax.tree.map(of_motion, steps.control, resumed.control)
        state = self.solver.knowing(steps.solver_state, resumed.known) if self.begins else steps.solver_state
        return steps._replace(length=resumed.length, control=control, solver_state=state)

    def _with_start(self, moving: Moving, steps: Steps, y0, sample, saved: Any, write: Callable) -> Any:
        """With the state at the start as the first step has found it, at the samples that are there."""
        y, fine = self.solver.start_of(eqx.combine(moving.solver_state, steps.solver_state), y0)
        y = jnp.where(fine, y, jnp.nan)
        at_start = lambda carry: carry[0] < sample
        return jax.lax.while_loop(at_start, lambda carry: (carry[0] + 1, write(carry[1], carry[0], y, jnp.array(True))), (0, saved))[1]

    def _start(self, control: StepControl, first, last, y0, following, sample, numbers: Numbers) -> tuple[Moving, Steps]:
        """What is there before the first step."""
        term, y = self._term(), _alone(y0, numbers)
        args_of = lambda params: numbers.args._replace(params=self.inputs(params).pieces(following))
        params, origin = numbers.varied
        t1, state = control.init(term, first, last, y0, None, None, None, None)

        def make(y, given):
            return eqx.partition(self.solver.init(term, first, t1, y, args_of(given[0])), eqx.is_inexact_array)

        is_new = isinstance(getattr(self.solver, "solver", self.solver), (ExplicitRungeKutta, SparseImplicit))
        if is_new:  # the first step makes the state of the solver, as it does behind a jump
            changing, rest = zeros_like(jax.eval_shape(lambda: make(y, numbers.varied)))
            changing = jax.tree.map(lambda x: functools.reduce(_with_zeros, y0.shape[y.ndim :], x), changing)
        else:
            changing, rest = varied_along(make, numbers.directions)(y0, numbers.varied)
        origin = functools.reduce(_with_zeros, y0.shape[y.ndim :], origin)
        moving = Moving(origin, y0, changing)  # y0 is that at a fixed time, where there are directions
        zero = jnp.array(0)
        return moving, Steps(t1 - first, rest, state, jnp.array(is_new), following, sample, dfx.RESULTS.successful, zero, zero)

    def _varied(self, control: StepControl, same, steps: Steps, numbers: Numbers) -> Callable:
        """A step of what moves and its value at a sample, with their variations along the directions of what is varied, for each order.

        It is tried first, then it is decided whether its errors are small enough, those of the variations among them.
        """
        args = numbers.args
        tried = varied_along(lambda moving, given: self._tried(same, moving, given, steps, args), numbers.directions)

        def step(moving):
            found, (solved, rest) = tried(moving, numbers.varied)
            now = jax.lax.stop_gradient((moving.t, found.t1, moving.y, found.y, found.error))
            t0, t1 = (_alone(t, numbers) for t in now[:2])
            decided = control.adapt_step_size(t0, t1, *now[2:4], args, now[4], self.solver.error_order(self._term()), steps.control)
            decided = jax.lax.stop_gradient((decided, solved, rest))
            done = lambda both, given: self._done(same, *both, given, steps, args, decided)
            return varied_along(done, numbers.directions)((moving, found), numbers.varied)

        return step

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

    def _coming(self, given, t, steps: Steps):
        """The times that come next: of each signal, and of each sampled state."""
        params, origin = given
        inputs, periods = self.inputs(params), self.equations.periods(params)
        signals = len(inputs.records)
        ticks = [(origin + i * period).astype(t.dtype) for i, period in zip(steps.following[signals:], periods, strict=True)]
        times = [time.astype(t.dtype) for time in inputs.times(steps.following, origin, periods)]
        return [jnp.where(time > t, time, jnp.inf) for time in (*times, *ticks)]  # a period that is not positive has no next tick

    def _tried(self, same, moving: Moving, given, steps: Steps, args) -> tuple[Tried, Any]:
        """A step of the solver up to the next node at most; and, not differentiated, its result and the rest of the solver's state.

        Nodes are at one time where they are no further apart than the `same` time may be by rounding.
        """
        t, coming = moving.t, self._coming(given, moving.t, steps)
        sample = self.ts.at(self.ts.shape[0] - 1)[0] if self.dense else self.sample_time(steps.sample)
        node, end = functools.reduce(lambda first, time: jnp.where(time + same < first, time, first), coming, sample), t + steps.length
        t1 = jnp.where(end + jnp.minimum(same, steps.length / 2) >= node, node, end)  # a step that was refused becomes shorter at any time
        args = args._replace(params=self.inputs(given[0]).pieces(steps.following))
        state = eqx.combine(moving.solver_state, steps.solver_state)
        y, error, dense, new, result = self.solver.step(self._term(), t, t1, moving.y, args, state, steps.has_jumped)
        t1 = self.solver.end_of(new, t1) if hasattr(self.solver, "end_of") else t1
        changing, rest = eqx.partition(new, eqx.is_inexact_array)
        result = None if result is dfx.RESULTS.successful else result  # always, as of an explicit scheme: to compare them would be compiled
        return Tried(t1, node, y, error, changing, dense if self.dense else None), jax.lax.stop_gradient((result, rest))

    def _done(self, same, moving: Moving, tried: Tried, given, steps: Steps, args, decided) -> tuple[tuple[Moving, Reached], Any]:
        """What follows a step, tried and `decided` on: where it is kept, behind the jumps at its end."""
        (keep, begin, end, _, control, result), solved, rest = decided
        old = moving.y, moving.solver_state, steps.solver_state
        y, changing, rest = jax.tree.map(lambda new, old: jnp.where(keep, new, old), (tried.y, tried.solver_state, rest), old)
        result, t1, node = self._result(keep, solved, result), tried.t1, tried.node
        coming = self._coming(given, moving.t, steps)
        inputs, periods = self.inputs(given[0]), steps.following[len(self.inputs(given[0]).records) :]
        signals = len(inputs.records)
        sample = self.ts.at(self.ts.shape[0] - 1)[0] if self.dense else self.sample_time(steps.sample)
        args, after = args._replace(params=inputs.pieces(steps.following)), args

        t = jnp.where(keep, t1, moving.t)
        passed = [keep & (t1 == node) & (time <= node + same) for time in coming]
        following = tuple(i + by for i, by in zip(steps.following, passed, strict=True))
        is_sample = keep & (t1 == node) & (sample <= node + same)
        for time, by, moves in zip(coming, passed, self.moving, strict=True):
            if moves:  # two nodes at one time are so for these numbers alone
                y = jnp.where(by, self._moved(time, t, y, args), y)
                t = jnp.where(by, time, t)
        follows_slopes = bool(self.equations.modes and self.equations.light)  # what slips without inertia
        bends = [follows_slopes or k in self.equations.driving for k in range(signals)]
        jump = [*map(max, inputs.jump, bends), *[True] * len(periods)]
        jumps = functools.reduce(jnp.logical_or, (by for by, jumps in zip(passed, jump, strict=True) if jumps), jnp.array(False))
        after = after._replace(params=inputs.pieces(following))

        def behind(y):
            updated = self.equations.updated(t, y, after, passed[signals:]) if periods else y
            return behind_jump(self.equations, t, y, updated, args, after)

        there = y
        if any(jump):
            y, consistent = jax.lax.cond(jumps, behind, lambda y: (y, jnp.array(True)), y)
            result = dfx.RESULTS.where(consistent, result, under_diffrax(RESULTS.no_friction))
        reached = Reached(self._moved(sample, t, y, after) if any(self.moving) else y, there, tried.dense)
        counts = steps.sample + (is_sample & (not self.dense)), result, steps.accepted + keep, steps.rejected + ~keep
        steps = Steps(end - begin, rest, control, jumps | (steps.has_jumped & ~keep), following, *counts)
        return (Moving(t, y, changing), reached), jax.lax.stop_gradient((steps, is_sample))

    def _result(self, keep, solved, controlled):
        """The result of a step: that of its control, or what the solver reported of one that is kept."""
        if solved is None:
            return controlled
        ended = solved != dfx.RESULTS.successful
        if not (self.equations.contacts or self.equations.events):
            ended &= keep  # what was refused is tried again
        return dfx.RESULTS.where(ended, solved, controlled)

    def _term(self) -> dfx.ODETerm:
        return dfx.ODETerm(in_one_kernel(self.equations.rates) if self.dense else self.equations.rates)

    def _moved(self, time, t, y, args):
        """y at a time that equals t, but moves otherwise with what is varied."""
        return flow(time, t, (y, self.equations.rates(t, y, args)))


def _at_scale(scales, size: Array):
    """The scales of a motion whose entries have been as large as this so far."""
    return None if scales is None else scales.at(size[(..., *[0] * (size.ndim - 1))])


def _alone(x: Array, numbers: Numbers) -> Array:
    """Without its variations."""
    return x[(..., *[0] * len(numbers.directions))]


def _with_zeros(x: Array, size: int) -> Array:
    """With variations of zero as a last axis of this size."""
    return with_variations(x, jnp.zeros((*x.shape, size - 1), x.dtype))
