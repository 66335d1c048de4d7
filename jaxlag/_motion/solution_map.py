"""The solution map of a motion: from its inputs (start, params, tolerances) and sample times to its samples; and what differentiates it."""

import dataclasses
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from .._model.flat import StatesAt
from .._model.signal import SinceOrigin, is_signal, origin_of, with_second_derivatives
from .._model.state_values import start_values
from .._model.system import System
from .._model.validation import check
from .._program.conditions import computed_first
from .evaluated_samples import taken_apart
from .event_record import records
from .first_order import EquationsOfMotion
from .guarantees import verified
from .integrate import (
    SolverOptions,
    Variations,
    begins_in_steps,
    in_one_loop,
    in_rows,
    initialised,
    is_variational,
    states_at,
    with_status,
)
from .moments import ContactState, EventState, FrictionState
from .protocol import Arguments
from .provenance import Provenance
from .sample import Sample, sample_at
from .scales import Scales, shares_of
from .search_for_start import Search
from .trajectory import Trajectory
from .variational import AccompaniedEquations, derived, pushforward, split_varying, with_variations


class Inputs(NamedTuple):
    """What a motion depends on besides its sample times; without `t0` it starts at the first of them."""

    t0: Array | None
    q0: PyTree
    qdot0: PyTree
    params: PyTree
    tolerances: tuple[Array, Array | None]
    states: dict[str, PyTree]  # values at the start that differ from those of the system


class Samples(NamedTuple):
    """The states y at the sample times, and what a `Trajectory` shows of them, what is not a real number is None here; and by name the
    times of events and the states there.
    """

    ys: Array
    shown: Sample
    events: dict[str, tuple]


class Unchanging(NamedTuple):
    """What is not differentiated: the reason that the motion ended, counts, and what is not a real number in its samples."""

    result: Any
    stats: dict[str, Array]
    shown: Sample


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class SolutionMap:
    """The samples of one motion as a function of `Inputs` and sample times: a `DifferentiableMap`."""

    system: System = dataclasses.field(metadata={"static": True})
    options: SolverOptions
    search: Search = dataclasses.field(default="all", metadata={"static": True})  # for a start on the constraints

    def solve(self, inputs: Inputs, ts: Array) -> tuple[Samples, Unchanging]:
        """The samples; unless the user has chosen an adjoint, with forward-mode derivatives."""
        return self._solve(inputs, ts, self.options.adjoint or dfx.ForwardMode())

    def pull_back(self, inputs: Inputs, ts: Array) -> tuple[Samples, Unchanging]:
        """The samples, with reverse-mode derivatives."""
        return self._solve(inputs, ts, dfx.RecursiveCheckpointAdjoint())

    def _solve(self, inputs: Inputs, ts: Array, adjoint: dfx.AbstractAdjoint) -> tuple[Samples, Unchanging]:
        equations, at = self.equations(inputs, ts)
        params, times, tolerances = _counted(inputs, ts), ts - ts[0], inputs.tolerances
        args, reverse = self._arguments(equations, at, inputs, ts), not isinstance(adjoint, dfx.ForwardMode)
        begins, rows = (asks(equations, self.options, params, reverse) for asks in (begins_in_steps, in_rows))
        start = initialised(equations, at, args.params, args.scales, self.search, begins)
        if isinstance(adjoint, dfx.ForwardMode) or self.options.adjoint or not is_variational(equations, self.options, None, params):
            ys, result, stats = states_at(equations, self.options, adjoint, at.t, start.y, times, args, tolerances, begins, rows)
        else:
            ys, result, stats = self._accompanied(equations, adjoint, start.y, inputs, ts, args)
        ys, result = with_status(ys, result, start.conditions, (inputs, ts))
        return samples_at(equations, times, ys, params, result, stats | {"start_moved": start.moved}, tolerances, rows)

    def _accompanied(self, equations, adjoint, y0, inputs: Inputs, ts: Array, args: Arguments):
        """The states of a motion in steps that fit a variation along a direction at random as well: reverse mode asks for all."""
        direction = _at_random(inputs)
        variations = self._variations(equations, inputs, (direction,), ts)
        of_start = jax.lax.stop_gradient(variations.initial(jax.lax.stop_gradient(inputs))[0][..., 1:])
        args = args._replace(directions=variations.directions)
        y0, accompanied = with_variations(y0, of_start), AccompaniedEquations(equations)
        t0, times = _first_time(inputs, ts), ts - ts[0]
        ys, result, stats = states_at(accompanied, self.options, adjoint, t0, y0, times, args, inputs.tolerances)
        last_t, last_y = stats["last"]
        return ys[..., 0], result, stats | {"last": (last_t, last_y[..., 0])}

    def _arguments(self, equations, at: StatesAt, inputs: Inputs, ts: Array) -> Arguments:
        params = with_second_derivatives(_counted(inputs, ts))
        scales = Scales.of(inputs.tolerances, ts - ts[0], params, at.q, at.v, equations.sees_time)
        return Arguments(params, scales)

    def _variations(self, equations, inputs: Inputs, directions: tuple[Inputs, ...], ts: Array) -> Variations:
        """The equations of the motion with its variations along directions, for each order."""

        def initial(inputs):
            at = self._at(inputs, ts)
            args = self._arguments(equations, at, inputs, ts)
            start = initialised(equations, at, args.params, args.scales, self.search, self._begins(equations, inputs, directions, ts))
            return start.y, start

        arguments = lambda inputs: (_first_time(inputs, ts), Arguments(with_second_derivatives(_counted(inputs, ts)), None))
        variations = Variations(equations, initial)
        for of_order in directions:
            variations = variations.along(of_order, (SinceOrigin(of_order.params, None), None), of_order.t0, arguments)
        return variations

    def _begins(self, equations, inputs: Inputs, directions: tuple[Inputs, ...], ts: Array) -> bool:
        """Whether the first step finds the mode at the start; not where its time moves, along which y0 is taken in that mode."""
        stays = all(of_order.t0 is None for of_order in directions)
        return stays and begins_in_steps(equations, self.options, _counted(inputs, ts), False)

    def push(self, inputs: Inputs, directions: tuple[Inputs, ...], ts: Array) -> tuple[Any, Unchanging]:
        """The samples and their derivatives along directions, for each order; by the variational equations where they hold."""
        if self.options.adjoint is not None:
            return pushforward(self.solve)(inputs, directions, ts)
        equations, at = self.equations(inputs, ts)
        varying = [split_varying(inputs, of_order)[0].params for of_order in directions]
        variations, times = self._variations(equations, inputs, directions, ts), ts - ts[0]
        y0, start = variations.initial(inputs)
        args, tolerances = self._arguments(equations, at, inputs, ts), inputs.tolerances
        shares = tuple(_shares(inputs, of_order, args.scales.duration) for of_order in directions)
        args = args._replace(scales=args.scales._replace(shares=shares))
        rows = in_rows(equations, self.options, args.params, False)
        if is_variational(equations, self.options, varying, inputs.params):
            args = args._replace(directions=variations.directions)
            ys, result, stats = in_one_loop(variations.equations, self.options, at.t, y0, times, args, tolerances)
            last_t, last_y = stats["last"]
            stats = stats | {"last": (last_t, last_y[(..., *[0] * len(directions))])}
        else:
            along = tuple((SinceOrigin(of_order.params, None), of_order.t0) for of_order in directions)
            given, begins = (equations, self.options, at.t, y0, times, args, tolerances), self._begins(equations, inputs, directions, ts)
            ys, result, stats = in_one_loop(*given, directions=along, begins=begins, rows=rows)
        return self._samples_and_variations(equations, inputs, directions, ts, ys, result, stats, start, rows)

    def _samples_and_variations(self, equations, inputs, directions, ts, ys, result, stats, start, rows):
        motion = lambda ys: ys[(..., *[0] * len(directions))]  # without variations
        stats = stats | {"start_moved": start.moved}
        states, result = with_status(motion(ys), result, start.conditions, (inputs, ts))
        known = jnp.isfinite(states).reshape(*states.shape, *[1] * len(directions))

        def samples(ys_and_params):
            ys, params = ys_and_params
            of_these = _counted(inputs._replace(params=params), ts)
            return samples_at(equations, ts - ts[0], ys, of_these, result, stats, inputs.tolerances, rows)

        def with_more(function, directions):
            """Of states with the variations of one order more."""

            def of_variations(ys_and_params):
                ys, params = ys_and_params
                return derived(function, (ys[..., 1:], directions))((ys[..., 0], params))

            return of_variations

        function = samples
        for of_order in directions:
            function = with_more(function, of_order.params)
        is_motion = np.zeros(ys.shape[states.ndim :], bool)
        is_motion[(0,) * len(directions)] = True
        return function((jnp.where(is_motion, states.reshape(known.shape), jnp.where(known, ys, jnp.nan)), inputs.params))

    def drift(self, inputs: Inputs, ts: Array, samples: Samples) -> Samples:
        """The change of each sample with its own time."""
        equations, _ = self.equations(inputs, ts)
        params, times = _counted(inputs, ts), ts - ts[0]
        scales = scales_of(equations, inputs.tolerances, times, params, samples.ys)

        def at(t, y):
            shown, _ = sample_at(equations, t, y, params, scales)
            return y, eqx.filter(shown, eqx.is_inexact_array)

        def of_one(t, y):
            rate = equations.rates(t, y, Arguments(params))
            found, change = jax.jvp(at, (t, y), (jnp.ones_like(t), rate))
            return jax.tree.map(lambda x, dx: jnp.where(jnp.isfinite(x), dx, 0), found, change)

        ys, shown = jax.vmap(of_one)(ts - ts[0], samples.ys)
        return Samples(ys, shown, jax.tree.map(jnp.zeros_like, samples.events))

    def equations(self, inputs: Inputs, ts: Array) -> tuple[EquationsOfMotion, StatesAt]:
        """The equations of motion, found and checked in shapes alone, and the start as it is given."""
        at = self._at(inputs, ts)
        check(self.system, at.t, inputs.q0, inputs.qdot0, inputs.params, at.values)
        return EquationsOfMotion.of(self.system, inputs.q0, self.options.formulation, _counted(inputs, ts), at), at

    def _at(self, inputs: Inputs, ts: Array) -> StatesAt:
        """The start as it is given, on the clock of the motion."""
        q, v = (ravel_pytree(tree)[0] for tree in (inputs.q0, inputs.qdot0))
        t0, given = ts[0] if inputs.t0 is None else inputs.t0, (inputs.q0, inputs.qdot0, inputs.params)
        return StatesAt(start_values(self.system, inputs.states, t0, *given), _first_time(inputs, ts), q, v)


def _counted(inputs: Inputs, ts: Array) -> SinceOrigin:
    """The params on the clock of the motion, τ = t − ts[0]: in t itself a late motion would have no digits left for its steps."""
    return SinceOrigin.of(inputs.params, ts[0])


def _at_random(inputs: Inputs) -> Inputs:
    """A direction of the start and of params, each number changed by its own size, or by one where it is zero."""
    signs = np.random.default_rng(0)

    def one(leaf):
        if is_signal(leaf) or not eqx.is_inexact_array(leaf):
            return jax.tree.map(lambda _: None, leaf)
        size = jnp.where(leaf == 0, 1, jnp.abs(leaf)) * signs.normal(size=np.shape(leaf))
        return jax.lax.stop_gradient(size.astype(jnp.asarray(leaf).dtype))[..., None]

    parts = inputs.q0, inputs.qdot0, inputs.params, inputs.states
    q0, qdot0, params, states = (jax.tree.map(one, part, is_leaf=is_signal) for part in parts)
    return Inputs(None, q0, qdot0, params, jax.tree.map(lambda _: None, inputs.tolerances), states)


def _shares(inputs: Inputs, directions: Inputs, duration) -> Array:
    """Of the motion, 1; of each direction, the share of itself by which a number that is not zero changes at most, a time that of the
    duration.
    """
    varying, _ = split_varying(inputs, directions)
    if varying.t0 is not None:
        varying = varying._replace(t0=duration * jnp.ones_like(varying.t0))
    return shares_of(varying, directions)


def _first_time(inputs: Inputs, ts: Array) -> Array:
    """That of the start on the clock of the motion: zero, but it moves with t0."""
    return ts[0] - ts[0] if inputs.t0 is None else inputs.t0 - ts[0]


def samples_at(equations: EquationsOfMotion, ts, ys, params, result, stats, tolerances, rows: bool = False) -> tuple[Samples, Unchanging]:
    """The samples of a motion with these states, as far as they keep what a successful motion guarantees; behind them are its events.

    `rows`: whether they come with the friction there.
    """
    ys, events = ys[: ts.size], records(equations, ys[ts.size :], origin_of(params))
    last_t, last_y = stats["last"]
    times, states = jnp.concatenate([ts, last_t[None]]), jnp.concatenate([ys, last_y[None]])
    scales = scales_of(equations, tolerances, ts, params, states)

    def at(t, y):
        y, found = taken_apart(equations, t, y, Arguments(params)) if rows else (y, None)
        return y, sample_at(equations, t, y, params, scales, found)

    states, samples = computed_first(jax.vmap(at)(times, states), last_t)
    ys = states[:-1]
    if equations.events:  # behind the end of a motion there is none
        states = jnp.where(states[:, -1:] > 0, jnp.nan, states)
    shown, result, reached = verified(equations, times, states, samples, result, tolerances[0])
    counts = {name: count for name, count in stats.items() if name != "last"} | {
        "reached": jax.lax.stop_gradient(origin_of(params) + reached)
    }
    changing, rest = eqx.partition(shown, eqx.is_inexact_array)
    return Samples(ys, changing, events), Unchanging(result, counts, rest)


def scales_of(equations: EquationsOfMotion, tolerances, ts, params, ys) -> Scales:
    """The scales of a motion by its samples, as far as it went."""
    largest = jnp.max(jnp.where(jnp.isfinite(ys), jnp.abs(ys), 0), axis=0)
    q, v = jnp.split(largest[: 2 * equations.size], 2)
    return Scales.of(tolerances, ts, params, q, v, equations.sees_time)


def trajectory_of(system: System, options: SolverOptions, params: PyTree, ts, samples: Samples, unchanging: Unchanging) -> Trajectory:
    """The trajectory of these samples."""
    shown: Sample = eqx.combine(samples.shown, unchanging.shown)
    friction = {name: FrictionState(*of_term) for name, of_term in shown.friction.items()}
    provenance = Provenance.of(system, params, options.formulation.friction)
    state, counts = (shown.q, shown.qdot, shown.qddot, shown.multipliers), unchanging.stats | shown.counts
    contacts = {name: ContactState(*of_one) for name, of_one in shown.contacts.items()}
    events = {name: EventState(*of_one, shown.events[name]) for name, of_one in samples.events.items()}
    stops = [events[name].ts for name, event in system.events if event.stop]
    if stops:
        counts["reached"] = jax.lax.stop_gradient(jnp.nanmin(jnp.stack([counts["reached"], *map(jnp.nanmin, stops)])))
    return Trajectory(ts, *state, unchanging.result, counts, shown.works, friction, provenance, shown.states, contacts, events)
