"""The motion of one system."""

import functools
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from .._mechanics.projection import Baumgarte, NoStabilisation, Projection
from .._mechanics.stick_slip import Regularised, StickSlip
from .._model.deprecation import renamed
from .._model.signal import with_second_derivatives
from .._model.system import System
from .._model.validation import checked, parameters, sample_times, state
from .._program.jit import compiled
from .derivative_rule import differentiable
from .failure import raise_failure
from .first_order import EquationsOfMotion, Formulation
from .guarantees import verified
from .integrate import SolverOptions, initialised, is_variational, states_and_variations, states_at, tolerances_of, with_status
from .protocol import Arguments, Scales
from .provenance import Provenance
from .trajectory import FrictionState, Trajectory
from .variational import pushforward


def simulate(
    system: System,
    q0: PyTree,
    qdot0: PyTree,
    ts: Any,
    params: PyTree = None,
    *,
    solver: dfx.AbstractSolver | None = None,
    rtol: float | Array | None = None,
    atol: float | Array | None = None,
    stabilisation: Projection | Baumgarte | NoStabilisation = Projection(),
    friction: StickSlip | Regularised = StickSlip(),
    max_steps: int = 100_000,
    adjoint: dfx.AbstractAdjoint | None = None,
    works: bool = False,
    progress: bool = False,
    throw: bool = True,
    audit: bool | None = None,
) -> Trajectory:
    r"""The motion of a system from an initial state, at the times `ts`.

    $$ M\ddot q = f + G^T\lambda, \qquad g(t, q) = 0, \qquad a(t, q, \dot q) = 0 $$

    Differentiable in q0, qdot0, ts and params, forward and reverse, to any order, under `jit` and `vmap`, without any setting.
    The initial state is put on the constraints first (`stats["start_moved"]` says how far it was off), inside what is differentiated.

    **Arguments:**

    - `system`: the `System`, n coordinates in all.
    - `q0`, `qdot0`: the state at ts[0]; pytrees of one structure, of numbers or arrays of any shape. Any consistent units.
    - `ts`: sample times, shape (T,), increasing, at least two.
    - `params`: what the functions of the system name, any pytree; measured inputs among them are `Signal`s.
    - `solver`: any explicit or diagonally implicit Runge–Kutta solver of diffrax. Default `jaxlag.Dop853()`; for forces
      that are not smooth `jaxlag.Dopri5()`, for stiff systems `diffrax.Kvaerno5()`.
    - `rtol`, `atol`: tolerances of the step size control. Defaults 1e-8 and 1e-10 in double, 1e-4 and 1e-6 in single precision.
    - `stabilisation`: how the constraints are maintained: `Projection()`, `Baumgarte(...)` or `NoStabilisation()`.
    - `friction`: treatment of dry friction: `StickSlip()` (exact Coulomb friction) or `Regularised(width)`.
    - `max_steps`: step limit.
    - `adjoint`: a diffrax adjoint, used in place of the derivative rule of this package.
    - `works`: integrates the work of each term along with the motion, for `Trajectory.work()` and the energy balance.
    - `progress`: shows a progress bar on standard error; in a log, a line now and then.
    - `throw`: whether a failure raises. If not, or under `jit`, `Trajectory.result` holds the reason, and samples not reached are NaN.
    - `audit`: deprecated name of `works`.

    **Returns:** a `Trajectory`; each of its fields has the samples, T, as its first axis.

    **Raises:** `ValueError` or `TypeError` for unusable arguments; `RuntimeError` where the integration fails.

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
    works = renamed(works, "works", audit=audit)
    q0, qdot0 = state(q0, qdot0, ("q0", "qdot0"))
    dtype = jax.tree.leaves(q0)[0].dtype
    options = SolverOptions.of(solver, Formulation(stabilisation, friction, works), max_steps, adjoint, progress)
    ts, tolerances = sample_times(ts, dtype), tolerances_of(rtol, atol, dtype)
    trajectory = _simulate(system, options, q0, qdot0, ts, parameters(params, q0), tolerances)
    if throw:
        raise_failure(trajectory, (q0, qdot0))
    return trajectory


@compiled
def _simulate(system, options, q0, qdot0, ts, params, tolerances):
    flat, t0, q, v = checked(system, ts[0], q0, qdot0, params)
    equations = EquationsOfMotion.of(system, q0, options.formulation, flat, t0, q, v)
    solve = functools.partial(_motion, equations, options)
    if options.adjoint is None:
        drift = lambda inputs, ts, ys: jax.vmap(lambda t, y: equations.rates(t, y, Arguments(inputs[3])))(ts, ys)
        forward, reverse = (functools.partial(solve, adjoint) for adjoint in (dfx.ForwardMode(), dfx.RecursiveCheckpointAdjoint()))
        run = differentiable(forward, reverse, drift, functools.partial(_motion_and_variations, equations, options))
    else:
        run = functools.partial(solve, options.adjoint)
    ys, (result, stats) = run((t0, q, v, params, tolerances), ts)
    return trajectory_of(system, equations, ts, ys, params, result, stats, tolerances)


def trajectory_of(system: System, equations: EquationsOfMotion, ts, ys, params, result, stats, tolerances) -> Trajectory:
    """The trajectory with these states, and whether it keeps what a successful motion guarantees."""
    last_t, last_y = stats.pop("last")
    times, states = jnp.concatenate([ts, last_t[None]]), jnp.concatenate([ys, last_y[None]])
    samples = jax.vmap(lambda t, y: equations.sample(t, y, params, tolerances))(times, states)
    samples, result, reached = verified(equations, times, states, samples, params, result, tolerances)
    q, qdot, qddot, multipliers, works, friction_states, counts, *_ = samples
    friction_states = {name: FrictionState(*of_term) for name, of_term in friction_states.items()}
    provenance = Provenance.of(system, params, equations.formulation.friction)
    stats = stats | counts | {"reached": reached}
    return Trajectory(ts, q, qdot, qddot, multipliers, result, stats, works, friction_states, provenance)


def _motion(equations, options, adjoint, inputs, ts):
    """y at the samples; and, not differentiated, the reason it ended and the counts."""
    t0, q, v, params, tolerances = inputs
    params = with_second_derivatives(params)
    start, args = initialised(equations, t0, q, v, params), Arguments(params, Scales.of(tolerances, ts, params))
    ys, result, stats = states_at(equations, options, adjoint, t0, start.y, ts, args, tolerances)
    ys, result = with_status(ys, result, start.conditions, (inputs, ts))
    return ys, (result, stats | {"start_moved": start.moved})


def _motion_and_variations(equations, options, varying, constant, directions, ts):
    """The same with derivatives along directions of what varies, by the variational equations where they hold."""
    inputs = t0, *_, params, tolerances = eqx.combine(varying, constant)
    if not is_variational(equations, options, varying[3], params):
        return pushforward(functools.partial(_motion, equations, options, dfx.ForwardMode()))(varying, constant, directions, ts)

    def initial(varying):
        t0, q, v, params, _ = eqx.combine(varying, constant)
        start = initialised(equations, t0, q, v, with_second_derivatives(params))
        return start.y, start

    args = Arguments(with_second_derivatives(params), directions=(directions[3], None))
    along_all = varying, directions, t0, directions[0], ts, args
    ys, change, result, stats, start = states_and_variations(equations, options, initial, *along_all, tolerances)
    ys, result = with_status(ys, result, start.conditions, (inputs, ts))
    return ys, jnp.where(jnp.isfinite(ys)[..., None], change, 0), (result, stats | {"start_moved": start.moved})
