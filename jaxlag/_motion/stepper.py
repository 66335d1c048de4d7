"""A motion one step at a time, for loops that are not of this package: a learnt policy, a filter, an environment."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from .._mechanics.friction_treatment import Regularised, StickSlip
from .._mechanics.projection import Baumgarte, NoStabilisation, Projection
from .._mechanics.surfaces import Located, NotLocated
from .._model.event import Event
from .._model.numbers import number
from .._model.state_values import given_states, sampled
from .._model.system import System
from .._model.validation import parameters, state_and_params
from .._program.jit import compiled
from .derivative_rule import differentiable
from .first_order import EquationsOfMotion
from .formulation import Formulation
from .integrate import SolverOptions
from .results import RESULTS
from .scales import tolerances_of
from .solution_map import Inputs as Start
from .solution_map import SolutionMap
from .step_map import Going, Inputs, StepMap


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class StepState:
    """Where a `Stepper` has come: `t`, `q`, `qdot`, `states` by name, `inputs` of the last step, and the `result`, why the motion ended, if
    it did: all is NaN from there on. A pytree of arrays, for `lax.scan` and `vmap`.
    """

    _y: Float[Array, "*batch y"]
    _t0: Float[Array, "*batch"]
    _time: Float[Array, "*batch"]
    _steps: Any  # how many
    inputs: PyTree
    _going: Going
    result: Any
    _tolerances: Any
    _equations: EquationsOfMotion = dataclasses.field(metadata={"static": True})

    @property
    def t(self) -> Array:
        """The time of this state."""
        return self._t0 + self._time

    @property
    def q(self) -> PyTree:
        """Coordinates, structured like those at the start."""
        return self._of(lambda parts: self._equations.like.unravelled(parts.q))

    @property
    def qdot(self) -> PyTree:
        """Velocities, structured like q."""
        return self._of(lambda parts: self._equations.like.unravelled(parts.v))

    @property
    def states(self) -> dict[str, PyTree]:
        """States of the system beside q and q̇, by name."""
        return self._of(lambda parts: self._equations.states.unravelled(parts.z))

    def _of(self, of_parts) -> Any:
        """Of each member of a batch, too."""
        function = lambda y: of_parts(self._equations.parts(y))
        for _ in self._y.shape[1:]:
            function = jax.vmap(function)
        return function(self._y)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Stepper:
    """What `stepper` returns, and of its arguments `system`, `dt`, `params`, `inputs`: `start(q0, qdot0)` is a state, and the stepper of a
    state the next. A pytree.
    """

    system: System = dataclasses.field(metadata={"static": True})
    _options: SolverOptions
    dt: Any
    params: PyTree
    inputs: dict[str, PyTree]
    _tolerances: tuple  # rtol and atol as given

    def start(self, q0: PyTree, qdot0: PyTree, t0: Any = 0.0, *, states: PyTree = None) -> StepState:
        """The state `q0`, `qdot0` at the time `t0`, with values of `states` by name, put on the constraints and in its mode of friction and
        contact; differentiable in all but `t0`. All are as in `simulate`.

        **Returns:** a `StepState`. **Raises:** `ValueError` or `TypeError` for unusable arguments.
        """
        given = state_and_params(q0, qdot0, self.params | self.inputs, ("q0", "qdot0"))
        q0, qdot0, params = given.trees
        t0 = jax.lax.stop_gradient(jnp.asarray(number(t0, "`t0`", given.dtype, cure="It is the time of q0."), given.dtype))
        states = {} if states is None else given_states(self.system, states, q0)
        rtol, atol = self._tolerances
        tolerances, inputs = tolerances_of(rtol, atol, q0), {name: params[name] for name in self.inputs}
        start = Start(None, q0, qdot0, params, tolerances, states)
        equations = _equations(SolutionMap(self.system, self._options), start, t0)
        y, (result, going) = _started(StepMap(equations, self._options), start, t0, self.dt)
        return StepState(y, t0, jnp.zeros_like(t0), jnp.array(0), inputs, going, result, tolerances, equations)

    def __call__(self, state: StepState, inputs: PyTree = None) -> StepState:
        """The state that is a step of dt later than `state`, with these `inputs` all the while, or those of the last step. Differentiable
        in all of it, forward and reverse, to any order.
        """
        new = state.inputs | self._checked({} if inputs is None else inputs, state)
        params = parameters(self.params | new, state.q)
        steps = state._steps + 1
        times = jax.lax.stop_gradient(jnp.stack([state._time, steps * self.dt]).astype(state._y.dtype))
        jumps = _differ(new, state.inputs) if inputs else None
        of = Inputs(state._y, params, jumps, state._t0, state._tolerances, state._going)
        y, (result, going) = differentiable(StepMap(state._equations, self._options))(of, times)
        result = RESULTS.where(state.result == RESULTS.successful, result, state.result)
        return dataclasses.replace(state, _y=y, _time=times[1], _steps=steps, inputs=new, _going=going, result=result)

    def _checked(self, inputs: Any, state: StepState) -> dict[str, PyTree]:
        """Inputs as arrays, each like that at the start."""
        _check_mapping(inputs, "inputs")
        if unknown := sorted(set(inputs) - set(self.inputs)):
            raise ValueError(
                f"`inputs` must be among those that the stepper has, {', '.join(self.inputs) or 'none'}, but hold {', '.join(unknown)}. "
                "Name them in `stepper(..., inputs=)`."
            )
        given = parameters(dict(inputs), state.q, "inputs")
        shapes = lambda tree: jax.tree.map(np.shape, tree)
        for name, value in given.items():
            if shapes(value) != shapes(state.inputs[name]):
                raise ValueError(
                    f"`inputs[{name!r}]` must be shaped as in `stepper(..., inputs=)`, {shapes(state.inputs[name])}, but is "
                    f"{shapes(value)}. Give both the same shape."
                )
        return given


def _check_mapping(given: Any, name: str) -> None:
    if not isinstance(given, Mapping):
        raise TypeError(f"`{name}` must be a mapping from names to values, but is {given!r}. Name them.")


def _differ(inputs: PyTree, before: PyTree) -> Bool[Array, ""]:
    """Whether some number is another than before."""
    differ = [jnp.any(new != old) for new, old in zip(*map(jax.tree.leaves, (inputs, before)), strict=True)]
    return jax.lax.stop_gradient(jnp.any(jnp.stack(differ)))


def _equations(of: SolutionMap, start: Start, t0: Array) -> EquationsOfMotion:
    """The equations of motion, which are found while shapes are traced."""
    found = []
    jax.eval_shape(lambda start, t0: found.append(of.equations(start, t0[None])[0]), start, t0)
    return found[-1]


@compiled
def _started(of: StepMap, start: Start, t0: Array, dt: Any) -> tuple[Array, Any]:
    """y at the start, and what is not differentiated."""
    _, at = SolutionMap(of.equations.system, of.options).equations(start, t0[None])
    return of.start(at, start.params, t0, jnp.stack([jnp.zeros_like(t0), jnp.asarray(dt, t0.dtype)]), start.tolerances)


def stepper(
    system: System,
    dt: Any,
    params: PyTree = None,
    *,
    inputs: PyTree = None,
    events: Mapping[str, Event] | None = None,
    solver: dfx.AbstractSolver | None = None,
    rtol: float | Array | None = None,
    atol: float | None = None,
    stabilisation: Projection | Baumgarte | NoStabilisation = Projection(),
    friction: StickSlip | Regularised = StickSlip(),
    surfaces: Located | NotLocated = Located(),
    max_steps: int = 1000,
) -> Stepper:
    r"""Steps of `dt` of a motion, one at a time, for a loop of your own: pure, for `lax.scan`, `vmap` and `grad`.

    $$ y(t + \Delta t) = \Phi_{\Delta t}(y(t), u), \qquad u \text{ constant in the step} $$

    Within each step the motion is that of `simulate`: with error control, and with dry friction, contacts, impacts and events located.
    Where inputs jump from one step to the next, what sticks and what is closed is found anew.

    **Arguments:**

    - `system`: the `System`; it may have no sampled states: what they are updated by is your loop.
    - `dt`: the length of a step, in any consistent unit.
    - `params`: what the functions of the system name, by name.
    - `inputs`: by name, params that may be others in each step, with their values at the start.
    - `events`, `solver`, `rtol`, `atol`, `stabilisation`, `friction`, `surfaces`: as of `simulate`.
    - `max_steps`: step limit of the solver within each step of `dt`.

    **Returns:** a `Stepper`: `stepper.start(q0, qdot0, t0)` is a state, `stepper(state, inputs)` the next, with `t`, `q`, `qdot`, `states`
    and `result`. Differentiable in q0, qdot0, states, params and inputs, forward and reverse; not in times.

    **Raises:** `ValueError` or `TypeError` for unusable arguments. A step that fails raises nothing: it says why in `result`.

    **Source:** Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, section II.4.

    ```python
    import jax, jax.numpy as jnp
    import jaxlag as jl
    block = jl.System(lambda qdot, m: 0.5 * m * qdot**2, dissipation=lambda qdot, F: F * jnp.abs(qdot), force=lambda u: u)
    stepper = jl.stepper(block, 0.1, {"m": 2.0, "F": 3.0}, inputs={"u": 0.0})
    policy = lambda state, _: ((state := stepper(state, {"u": 8.0 * (1 - state.q)})), state.q)
    state, q = jax.lax.scan(policy, stepper.start(0.0, 0.0), length=10)
    ```
    """
    system = system if events is None else system.with_events(events)
    if sampled(system):
        raise ValueError(
            f"`system` must have no sampled states, but has {', '.join(sampled(system))}. Update them in your own loop, and pass what they "
            "do as `inputs`."
        )
    params, inputs = ({} if given is None else given for given in (params, inputs))
    _check_mapping(params, "params")
    _check_mapping(inputs, "inputs")
    options = SolverOptions.of(solver, Formulation(stabilisation, friction, surfaces), max_steps)
    dt = number(dt, "`dt`", positive=True, cure="It is the length of a step.")
    return Stepper(system, options, dt, dict(params), dict(inputs), (rtol, atol))
