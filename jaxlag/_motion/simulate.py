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
from .._model.signal import solved
from .._model.system import System
from .._model.validation import checked, parameters, sample_times, state
from .._program.jit import compiled
from .derivative_rule import differentiable, pushed
from .first_order import Equations, Scales
from .guarantees import upheld
from .integrate import How, begun, can_be_varied, judged, raise_failure, states_at, states_varied, tolerances_of
from .trajectory import Rubbing, Stated, Trajectory


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
    audit: bool = False,
    progress: bool = False,
    throw: bool = True,
) -> Trajectory:
    r"""The motion of a system from a start, at the times `ts`.

    $$ M\ddot q = f + G^T\lambda, \qquad g(t, q) = 0, \qquad a(t, q, \dot q) = 0 $$

    Differentiable in q0, qdot0, ts and params, forward and reverse, to any order, under `jit` and `vmap`, with no setting.
    The start is put on the constraints first (and `stats["start_moved"]` says how far it was off), inside what is differentiated.

    **Arguments:**

    - `q0`, `qdot0`: the state at ts[0]; pytrees of one structure. Any consistent units.
    - `ts`: sample times, increasing, at least two.
    - `params`: what the functions of the system name; measured inputs among them are `Signal`s.
    - `solver`: any explicit or diagonally implicit Runge–Kutta solver of diffrax. Default `jaxlag.Dop853()`; forces
      that are not smooth want `jaxlag.Dopri5()`, stiff systems `diffrax.Kvaerno5()`.
    - `rtol`, `atol`: tolerances of the step size control. Defaults 1e-8 and 1e-10 in double, 1e-4 and 1e-6 in single precision.
    - `stabilisation`: how the constraints are kept, `Projection()`, `Baumgarte(...)` or `NoStabilisation()`.
    - `friction`: how kinks of D are taken, `StickSlip()` (exactly) or `Regularised(width)`.
    - `max_steps`: steps after which the motion is given up.
    - `adjoint`: a diffrax adjoint, to be used in place of the derivative rule of this package.
    - `audit`: integrates the work of each term along with the motion, for `Trajectory.work()` and the energy balance.
    - `progress`: shows a bar while it runs, on standard error; in a log a line now and then.
    - `throw`: whether a failure raises. If not, or under `jit`, `Trajectory.result` holds the reason, and samples not reached are NaN.

    **Returns:** a `Trajectory`.

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
    q0, qdot0 = state(q0, qdot0, ("q0", "qdot0"))
    dtype = jax.tree.leaves(q0)[0].dtype
    how = How.of(solver, stabilisation, friction, max_steps, adjoint, progress, audit)
    ts, tolerances = sample_times(ts, dtype), tolerances_of(rtol, atol, dtype)
    trajectory = _simulate(system, how, q0, qdot0, ts, parameters(params, q0), tolerances)
    if throw:
        raise_failure(trajectory, (q0, qdot0))
    return trajectory


@compiled
def _simulate(system, how, q0, qdot0, ts, params, tolerances):
    _, t0, q, v = checked(system, ts[0], q0, qdot0, params)
    equations = Equations.of(system, q0, how.stabilisation, how.friction, how.audit, t0, q, v, params)
    solve = functools.partial(_motion, equations, how)
    if how.adjoint is None:
        drift = lambda inputs, ts, ys: jax.vmap(lambda t, y: equations.rates(t, y, (inputs[3], None)))(ts, ys)
        forward, reverse = (functools.partial(solve, adjoint) for adjoint in (dfx.ForwardMode(), dfx.RecursiveCheckpointAdjoint()))
        run = differentiable(forward, reverse, drift, functools.partial(_varied_motion, equations, how))
    else:
        run = functools.partial(solve, how.adjoint)
    ys, (result, stats) = run((t0, q, v, params, tolerances), ts)
    return trajectory_of(system, equations, ts, ys, params, result, stats, tolerances)


def trajectory_of(system: System, equations: Equations, ts, ys, params, result, stats, tolerances) -> Trajectory:
    """What there is to say of a motion, from its states, and whether that is what it promises."""
    last_t, last_y = stats.pop("last")
    times, states = jnp.concatenate([ts, last_t[None]]), jnp.concatenate([ys, last_y[None]])
    samples = jax.vmap(lambda t, y: equations.sample(t, y, params, tolerances))(times, states)
    samples, result, reached = upheld(equations, times, states, samples, params, result, tolerances)
    q, qdot, qddot, multipliers, works, rubbing, counts, *_ = samples
    rubbing = {name: Rubbing(*of_term) for name, of_term in rubbing.items()}
    stated = Stated.of(system, params, equations.friction)
    return Trajectory(ts, q, qdot, qddot, multipliers, result, stats | counts | {"reached": reached}, works, rubbing, stated)


def _motion(equations, how, adjoint, inputs, ts):
    """y at the samples; and, not differentiated, the reason it ended and the counts."""
    t0, q, v, params, tolerances = inputs
    params = solved(params)
    start, scales = begun(equations, t0, q, v, params), Scales.of(tolerances, ts, params)
    ys, result, stats = states_at(equations, how, adjoint, t0, start.y, ts, (params, scales), tolerances)
    ys, result = judged(ys, result, start.obstacles, (inputs, ts))
    return ys, (result, stats | {"start_moved": start.moved})


def _varied_motion(equations, how, moving, still, directions, ts):
    """The same with derivatives along directions of what moves, by the variational equations where they hold."""
    inputs = t0, *_, params, tolerances = eqx.combine(moving, still)
    if not can_be_varied(equations, how, moving[3], params):
        return pushed(functools.partial(_motion, equations, how, dfx.ForwardMode()))(moving, still, directions, ts)

    def started(moving):
        t0, q, v, params, _ = eqx.combine(moving, still)
        start = begun(equations, t0, q, v, solved(params))
        return start.y, start

    along_all = moving, directions, t0, directions[0], ts, (solved(params), directions[3])
    ys, change, result, stats, start = states_varied(equations, how, started, *along_all, tolerances)
    ys, result = judged(ys, result, start.obstacles, (inputs, ts))
    return ys, jnp.where(jnp.isfinite(ys)[..., None], change, 0), (result, stats | {"start_moved": start.moved})
