"""The map of one step of a `Stepper`: from the state at its beginning and params to the state at its end; and what differentiates it."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree

from .._model.flat import StatesAt
from .._model.signal import SinceOrigin, with_second_derivatives
from .first_order import EquationsOfMotion
from .integrate import SolverOptions, Variations, begins_in_steps, in_one_loop, initialised, with_status
from .interval_loop import Resumed
from .jumps import after_jump
from .loads import told_of_loads
from .protocol import Arguments
from .results import RESULTS
from .scales import Scales, shares_of
from .step_size import StepControl
from .variational import split_varying, varied_along

HORIZON = 1000  # steps: what counts as small is judged as in a motion of as many, or, in a longer one, as long as it has been


class Going(NamedTuple):
    """What a motion goes on with, not differentiated: its steps, and what forces at the start make of each velocity."""

    steps: Resumed
    loads: dict[str, Any]


class Inputs(NamedTuple):
    """What a step depends on besides its times, counted from the start: y there, params, and where these may jump, whether they do; the
    time of the start.
    """

    y: Any
    params: PyTree
    jumps: Bool[Array, ""] | None
    t0: Any
    tolerances: tuple[Array, Array | None]
    going: Going


class Unchanging(NamedTuple):
    """What is not differentiated: the reason that the step ended, and what the next goes on with."""

    result: Any
    going: Going


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class StepMap:
    """One step of a motion, as a function of `Inputs` and the times of its ends: a `DifferentiableMap`."""

    equations: EquationsOfMotion = dataclasses.field(metadata={"static": True})
    options: SolverOptions

    def solve(self, inputs: Inputs, ts: Array) -> tuple[Array, Unchanging]:
        """y at the end; with forward-mode derivatives."""
        return self.push(inputs, (), ts)

    def pull_back(self, inputs: Inputs, ts: Array) -> tuple[Array, Unchanging]:
        """The same with reverse-mode derivatives."""
        return self._ended(inputs, inputs.y, ts, (), reverse=True)

    def push(self, inputs: Inputs, directions: tuple[Inputs, ...], ts: Array) -> tuple[Any, Unchanging]:
        """The same and its derivatives along directions, for each order."""
        variations = Variations(self.equations, lambda inputs: (self._moved_on_constraints(inputs, ts), None))
        for of_order in directions:
            variations = variations.along(of_order, None, None, lambda _: None)
        y0 = variations.initial(inputs)[0] if directions else inputs.y
        ys, aux = self._ended(inputs, y0, ts, directions, reverse=False)
        return _taken_apart(ys, len(directions)), aux

    def drift(self, inputs: Inputs, ts: Array, y: Array) -> Array:
        """The times of a stepper are its own, and not differentiated."""
        return jnp.zeros_like(y)

    def _ended(self, inputs: Inputs, y0: Array, ts: Array, directions: tuple, reverse: bool) -> tuple[Array, Unchanging]:
        equations, params = self.equations, SinceOrigin.of(inputs.params, inputs.t0)
        args = self.arguments(inputs.params, inputs.t0, ts, inputs.tolerances, *self._moving(inputs.y), inputs.going.loads)
        may_jump, fine = inputs.jumps is not None, jnp.array(True)
        begins = may_jump and begins_in_steps(equations, self.options, params, reverse)
        if may_jump and not begins and equations.projection is not None:
            y0, fine = self._behind_jump(inputs, y0, ts, args, directions)
        along, steps = tuple((SinceOrigin(of_order.params, None), None) for of_order in directions), inputs.going.steps
        shares = tuple(shares_of(split_varying(inputs, of_order)[0], of_order) for of_order in directions)
        args = args._replace(scales=args.scales._replace(shares=shares))
        given = equations, self.options, ts[0], y0, ts, args, inputs.tolerances
        resumed = steps._replace(known=jnp.array(True) if inputs.jumps is None else ~inputs.jumps)
        ys, result, stats = in_one_loop(*given, directions=along, reverse=reverse, begins=begins, resumed=resumed)
        y, result = with_status(ys[1], result, ((fine, RESULTS.no_friction),), (inputs.params, ts))
        return y, Unchanging(result, inputs.going._replace(steps=stats["resumed"]))

    def _moved_on_constraints(self, inputs: Inputs, ts: Array) -> Array:
        """y, which is on the constraints of its mode, with changes that are so, too: others say nothing of its next step."""
        if self.equations.projection is None:
            return inputs.y
        args = self.arguments(inputs.params, inputs.t0, ts, inputs.tolerances, *self._moving(inputs.y), inputs.going.loads)
        there = self.equations.projected(ts[0], inputs.y, args)
        return jax.lax.stop_gradient(inputs.y) + (there - jax.lax.stop_gradient(there))

    def _behind_jump(self, inputs: Inputs, y0, ts, args: Arguments, directions):
        """y behind a jump of inputs at the beginning, where the steps do not find that themselves."""

        def behind(y, params):
            given = args._replace(params=with_second_derivatives(SinceOrigin.of(params, inputs.t0)))
            y, consistent = after_jump(self.equations, ts[0], y, y, given, given)
            return y, consistent

        along = [of_order.params for of_order in directions]
        return jax.lax.cond(inputs.jumps, lambda: varied_along(behind, along)(y0, inputs.params), lambda: (y0, jnp.array(True)))

    def _moving(self, y: Array) -> tuple[Array, Array]:
        """q and q̇."""
        return self.equations.parts(y)[:2]

    def arguments(self, params: PyTree, t0: Array, ts: Array, tolerances, q: Array, v: Array, loads: dict[str, Any]) -> Arguments:
        """Those of a step, or of the start, where nothing is known of loads."""
        params = with_second_derivatives(SinceOrigin.of(params, t0))
        duration = jnp.stack([0 * ts[0], jnp.maximum(HORIZON * (ts[1] - ts[0]), ts[1])])
        scales = Scales.of(tolerances, duration, params, q, v, self.equations.sees_time)
        return Arguments(params, scales._replace(**loads))

    def start(self, at: StatesAt, params: PyTree, t0: Array, ts: Array, tolerances) -> tuple[Array, Unchanging]:
        """y at the start, put on the constraints and in its mode; `at` is on the clock of the motion."""
        equations, args = self.equations, self.arguments(params, t0, ts, tolerances, at.q, at.v, {})
        found = initialised(equations, at, args.params, args.scales)
        y, result = with_status(found.y, RESULTS.successful, found.conditions, (at, params, ts))
        scales = told_of_loads(equations, at.t, found.y, args).scales
        loads = {name: getattr(scales, name) for name in ("driven", "held", "given", "units")}
        control = StepControl.of(tolerances, (ts[0], ts[1]), equations, resumes=True)
        control = dataclasses.replace(control, duration=args.scales.duration)
        end, state = jax.tree.map(jnp.asarray, control.init(None, ts[0], ts[1], found.y, None, None, None, None))
        return y, Unchanging(result, jax.lax.stop_gradient(Going(Resumed(end - ts[0], state, jnp.array(True)), loads)))


def _taken_apart(ys: Array, orders: int) -> Any:
    """y, or y and its variations, for each order."""
    if not orders:
        return ys
    alone, varied = (jnp.take(ys, 0, axis=orders), jax.lax.slice_in_dim(ys, 1, None, axis=orders))
    return _taken_apart(alone, orders - 1), _taken_apart(varied, orders - 1)
