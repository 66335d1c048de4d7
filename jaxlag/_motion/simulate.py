"""The motion of one system."""

from collections.abc import Mapping
from typing import Any

import diffrax as dfx
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from .._mechanics.friction_treatment import Regularised, StickSlip
from .._mechanics.projection import Baumgarte, NoStabilisation, Projection
from .._mechanics.surfaces import Located, NotLocated
from .._model.event import Event
from .._model.state_values import given_states
from .._model.system import System
from .._model.validation import state_and_params
from .._program.jit import compiled, is_concrete
from .derivative_rule import differentiable
from .failure import raise_failure
from .formulation import Formulation
from .integrate import SolverOptions
from .padding import padded_signals, padded_times, without_padding
from .progress import compiling
from .scales import tolerances_of
from .search_for_start import search_for
from .solution_map import Inputs, SolutionMap, trajectory_of
from .table import Table
from .trajectory import Trajectory


def simulate(
    system: System,
    q0: PyTree,
    qdot0: PyTree,
    ts: Any,
    params: PyTree = None,
    *,
    states: PyTree = None,
    events: Mapping[str, Event] | None = None,
    solver: dfx.AbstractSolver | None = None,
    rtol: float | Array | None = None,
    atol: PyTree = None,
    stabilisation: Projection | Baumgarte | NoStabilisation = Projection(),
    friction: StickSlip | Regularised = StickSlip(),
    surfaces: Located | NotLocated = Located(),
    max_steps: int = 100_000,
    adjoint: dfx.AbstractAdjoint | None = None,
    works: bool = False,
    progress: bool = False,
    throw: bool = True,
) -> Trajectory:
    r"""The motion of a system from an initial state, at the times `ts`.

    $$ M\ddot q = f + G^T\lambda, \qquad g(t, q) = 0, \qquad a(t, q, \dot q) = 0 $$

    Differentiable in q0, qdot0, ts and params, forward and reverse, to any order, under `jit` and `vmap`, without any setting. The initial
    state is first projected onto the constraints (`stats["start_moved"]` says how far it was off); derivatives include this.

    **Arguments:**

    - `system`: the `System`, n coordinates in all.
    - `q0`, `qdot0`: the state at ts[0]; pytrees of one structure, of numbers or arrays of any shape. Any consistent units. To continue from
      `last = motion[-1]`: `last.q, last.qdot`, with `states=last.states`.
    - `ts`: sample times, shape (T,), increasing, at least two.
    - `params`: what the functions of the system name, any pytree; measured inputs among them are `Signal`s.
    - `states`: initial values of states of the system, by name, in place of the `start` of `State` and `Sampled`.
    - `events`: by name, `Event(when, then, stop)`, in place of those of the system. Reuse these objects: new ones are compiled again.
    - `solver`: any explicit or diagonally implicit Runge–Kutta solver of diffrax. Default `jaxlag.Dop853()`; for forces
      that are not smooth `jaxlag.Dopri5()`, for stiff systems `diffrax.Kvaerno5()`.
    - `rtol`, `atol`: tolerances of the step size control. `rtol` is 1e-8 in double and 1e-4 in single precision. Without `atol`, each
      coordinate, velocity and state is compared with its own scale, a hundredth of its largest value so far, in any unit; otherwise `atol`
      is a number, or a pytree like `q0` with one for each coordinate and its velocity. Derivatives are as accurate as the motion: their
      errors, compared with their own scales, shorten the steps of a motion that is differentiated.
    - `stabilisation`: how the constraints are maintained, one of `jl.stabilisation`: `Projection()`, `Baumgarte(...)` or
      `NoStabilisation()`.
    - `friction`: treatment of dry friction: `StickSlip()` (exact Coulomb friction) or `Regularised(width)`.
    - `surfaces`: whether steps end where functions jump or bend by the position, the time or a state, as of `where`, `maximum`, `interp`:
      one of `jl.surfaces`, `Located()` or `NotLocated()`.
    - `max_steps`: step limit.
    - `adjoint`: a diffrax adjoint, used in place of the derivative rule of this package; with contacts, events, sampled states, and signals
      that jump or bend, either `diffrax.ForwardMode()` or `diffrax.RecursiveCheckpointAdjoint()`, for forward or reverse mode.
    - `works`: integrates the work of each term along with the motion, for `Trajectory.work()` and the energy balance.
    - `progress`: shows a progress bar on standard error; in a log, a line now and then. It also reports compilation that takes long.
    - `throw`: whether a failure raises. If not, or under `jit`, `Trajectory.result` holds the reason, and samples not reached are NaN.

    **Returns:** a `Trajectory`; each of its fields has the samples, T, as its first axis.

    **Raises:** `ValueError` or `TypeError` for unusable arguments; `RuntimeError` if the integration fails.

    **Source:** Hairer, Lubich & Wanner, Geometric Numerical Integration, section IV.4 (projection).

    ```python
    import jax, jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    motion = jl.simulate(oscillator, 1.0, 0.0, jnp.linspace(0, 10, 11), {"c": 4.0})
    motion.q[-1]  # cos(2 · 10) = 0.408
    jax.grad(lambda c: jl.simulate(oscillator, 1.0, 0.0, jnp.linspace(0, 10, 11), {"c": c}).q[-1])(4.0)  # −(10/4) sin 20 = −2.28
    ```
    """
    system = system if events is None else system.with_events(events)
    given = state_and_params(q0, qdot0, params, ("q0", "qdot0"))
    options = SolverOptions.of(solver, Formulation(stabilisation, friction, surfaces, works), max_steps, adjoint, progress)
    (ts, length), tolerances = padded_times(ts, given.dtype), tolerances_of(rtol, atol, given.trees[0])
    states = {} if states is None else given_states(system, states, given.trees[0])
    padded = padded_signals(given)
    with compiling("the motion", progress):
        if adjoint is not None or is_concrete(given.others, tolerances, states, ts):
            search = search_for(system, padded, states, ts, is_varied=adjoint is not None)
            table = _trajectory(system, options, padded, tolerances, states, ts, search)
            q0, qdot0, params = given.trees
            trajectory = table.trajectory(length, params)
        else:
            q0, qdot0, params = given.trees
            inputs = Inputs(ts[0], q0, qdot0, padded.trees[2], tolerances, states)
            search = search_for(system, padded, states, ts, is_varied=True)
            solution = differentiable(SolutionMap(system, options, search))(inputs, ts)
            trajectory = trajectory_of(system, options, params, jnp.asarray(ts), *solution)
            trajectory = without_padding(trajectory, length) if ts.size > length else trajectory
    if throw:
        raise_failure(trajectory, (q0, qdot0, states))
    return trajectory


@compiled
def _trajectory(system, options, given, tolerances, states, ts, search):
    """The motion and its `Trajectory` in one program: to build that in Python takes as long as some ten steps of a vehicle."""
    q0, qdot0, params = given.trees
    solution = SolutionMap(system, options, search).solve(Inputs(None, q0, qdot0, params, tolerances, states), ts)
    return Table.of(trajectory_of(system, options, params, ts, *solution))
