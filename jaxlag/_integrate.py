"""The motion: diffrax integrates the equations of motion."""

import functools
import warnings
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from ._checks import checked, is_concrete, parameters, sample_times, state
from ._friction import Regularised, StickSlip
from ._manifold import Baumgarte, NoStabilisation, Projection, nearest_state
from ._motion import Equations, slack_of
from ._progress import Bar
from ._results import OF_THE_INPUT, RESULTS, reason_of
from ._sensitivities import differentiable
from ._signal import jump_times, solved
from ._steps import Kept, Resuming, StickSlipSolver, behind_a_jump
from ._system import System
from ._trajectory import Rubbing, Stated, Trajectory


def simulate(
    system: System,
    q0: PyTree,
    qdot0: PyTree,
    ts: Any,
    params: PyTree = None,
    *,
    solver: dfx.AbstractSolver | None = None,
    rtol: float | None = None,
    atol: float | None = None,
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
    - `solver`: any explicit or diagonally implicit Runge–Kutta solver of diffrax. Default `diffrax.Tsit5()`; stiff systems
      want `diffrax.Kvaerno5()`, high accuracy `diffrax.Dopri8()`.
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
    ts = sample_times(ts, dtype)
    how = _How(solver or dfx.Tsit5(), stabilisation, friction, max_steps, adjoint, progress, audit)
    single = jnp.finfo(dtype).bits < 64
    if single:
        _warn_of_single_precision()
    defaults = (1e-4, 1e-6) if single else (1e-8, 1e-10)
    tolerances = tuple(jnp.asarray(given or default, dtype) for given, default in zip((rtol, atol), defaults, strict=True))
    trajectory = _simulate(system, how, q0, qdot0, ts, parameters(params, q0), tolerances)
    if throw:
        _raise_failure(trajectory)
    return trajectory


class _How(eqx.Module):
    """The choices of numerics, which a compiled program is made for."""

    solver: dfx.AbstractSolver
    stabilisation: Any = eqx.field(static=True)
    friction: Any = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)
    adjoint: dfx.AbstractAdjoint | None
    progress: bool = eqx.field(static=True)
    audit: bool = eqx.field(static=True)


@eqx.filter_jit
def _simulate(system, how, q0, qdot0, ts, params, tolerances):
    _, t0, q, v = checked(system, ts[0], q0, qdot0, params)
    equations = Equations.of(system, q0, how.stabilisation, how.friction, how.audit, t0, q, v, params)
    solve = functools.partial(_motion, equations, how)
    if how.adjoint is None:
        drift = lambda inputs, ts, ys: jax.vmap(lambda t, y: equations.rates(t, y, inputs[3:]))(ts, ys)
        forward, reverse = (functools.partial(solve, adjoint) for adjoint in (dfx.ForwardMode(), dfx.RecursiveCheckpointAdjoint()))
        run = differentiable(forward, reverse, drift)
    else:
        run = functools.partial(solve, how.adjoint)
    ys, (result, stats) = run((t0, q, v, params, tolerances), ts)
    q, qdot, qddot, multipliers, works, rubbing, counts = jax.vmap(lambda t, y: equations.sample(t, y, params))(ts, ys)
    rubbing = {name: Rubbing(*of_term) for name, of_term in rubbing.items()}
    return Trajectory(ts, q, qdot, qddot, multipliers, result, stats | counts, works, rubbing, Stated.of(system, params, how.friction))


def _motion(equations, how, adjoint, inputs, ts):
    """y at the samples; and, not differentiated, the reason it ended and the counts."""
    t0, q, v, params, tolerances = inputs
    params = solved(params)
    nearest = nearest_state(equations.flat(params), t0, q, v)
    start = equations.start(t0, nearest.q, nearest.v, params)
    ys, result, stats = _solve(equations, how, adjoint, t0, start.y, ts, (params, slack_of(tolerances, nearest.v)), tolerances)
    finite = jnp.all(jnp.array([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves((inputs, ts)) if eqx.is_inexact_array(x)]))
    obstacles = (
        (start.has_mode, RESULTS.no_friction),
        (start.has_bounds, RESULTS.negative_bound),
        (nearest.reached, RESULTS.impossible_start),
        (nearest.determined, RESULTS.no_inertia),
        (finite, RESULTS.not_finite),
    )
    for passed, reason in obstacles:
        result = RESULTS.where(passed, result, reason)
    started = jnp.all(jnp.stack([passed for passed, _ in obstacles]))
    moved = jax.lax.stop_gradient(jnp.max(jnp.abs(jnp.concatenate([nearest.q - q, nearest.v - v]))))
    return jnp.where(started & jnp.isfinite(ys), ys, jnp.nan), (result, stats | {"start_moved": moved})


def _solve(equations, how, adjoint, t0, y0, ts, args, tolerances):
    """States at the samples, by diffrax, and the reason it stopped."""
    rtol, atol = tolerances
    rounding = jnp.finfo(y0.dtype).eps * jnp.maximum(jnp.abs(ts[0]), jnp.abs(ts[-1]))
    controller = dfx.PIDController(rtol, atol, dtmin=4 * rounding, force_dtmin=False)
    end, jumps, behind = ts[-1], jump_times(args[0], ts.dtype), None
    if jumps is not None:
        controller = dfx.ClipStepSizeController(Resuming(rtol, atol, smallest=4 * rounding), jump_ts=jumps)
        end = end + 256 * rounding  # a jump at the last sample is stepped on too: diffrax rounds what is within 100 ulp of the end
        behind = functools.partial(behind_a_jump, equations)
    kept = equations.kept if equations.projection else None
    solver = how.solver
    if equations.rows:
        solver = StickSlipSolver(how.solver, kept, 2 * equations.size, behind, equations)
    elif kept is not None or behind is not None or how.audit:
        solver = Kept(how.solver, kept, 2 * equations.size, behind)
    solution = dfx.diffeqsolve(
        dfx.ODETerm(equations.rates),
        solver,
        t0,
        end,
        None,
        y0,
        args,
        saveat=dfx.SaveAt(ts=ts),
        stepsize_controller=controller,
        adjoint=adjoint,
        max_steps=how.max_steps,
        throw=False,
        progress_meter=Meter() if how.progress else dfx.NoProgressMeter(),
    )
    ys = solution.ys if kept is None else jax.vmap(lambda t, y: kept(t, y, args))(ts, solution.ys)
    stats = {key: solution.stats[key] for key in ("num_steps", "num_accepted_steps", "num_rejected_steps")}
    result = RESULTS.promote(solution.result)
    result = RESULTS.where(result == RESULTS.internal_error, RESULTS.no_friction, result)  # as StickSlipSolver says it
    return ys, RESULTS.where(result == RESULTS.max_steps_rejected, RESULTS.chattering, result), stats


class Meter(dfx.TextProgressMeter):
    """diffrax's meter, which keeps count inside the compiled loop, with a bar in place of its printing."""

    @staticmethod
    def _init_bar():
        return Bar()

    @staticmethod
    def _step_bar(bar, progress):
        bar(float(progress))

    @staticmethod
    def _close_bar(bar):
        bar.end()


@functools.cache
def _warn_of_single_precision() -> None:
    warnings.warn(
        "jaxlag runs in single precision: tolerances below 1e-5 are out of reach. "
        'For double precision: jax.config.update("jax_enable_x64", True).',
        stacklevel=4,
    )


def _raise_failure(trajectory: Trajectory) -> None:
    """Raises the reason of a failed motion, outside what is compiled; under `jit` the reason stays in the result."""
    if not is_concrete(trajectory.result) or np.all(trajectory.succeeded):
        return
    reason = reason_of(trajectory.result)
    if reason in map(reason_of, OF_THE_INPUT):
        raise ValueError(reason)
    reached = np.asarray(jnp.sum(jnp.isfinite(jax.tree.leaves(trajectory.q)[0].reshape(trajectory.ts.size, -1)[:, 0])))
    raise RuntimeError(
        f"the motion must reach t = {trajectory.ts[-1]:g}, but stopped after {reached} of {trajectory.ts.size} samples: {reason} "
        "Allow more `max_steps`, look at what was computed with `throw=False`, or take a solver for stiff systems, "
        "`solver=diffrax.Kvaerno5()`."
    )
