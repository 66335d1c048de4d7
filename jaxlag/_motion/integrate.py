"""The solution of the equations of motion: diffrax takes the steps."""

import functools
import warnings
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from .._mechanics.friction_terms import unread_friction
from .._mechanics.projection import Baumgarte, NoStabilisation, Projection, nearest_state
from .._mechanics.singular_directions import because
from .._mechanics.stick_slip import Regularised, StickSlip
from .._model.numbers import count, number
from .._model.signal import jump_times, moves_smoothly
from .._program.jit import is_concrete
from .._program.single_kernel import in_one_kernel
from .first_order import Equations
from .progress import Bar
from .results import OF_THE_INPUT, OF_THE_STEPS, RESULTS, reason_of
from .runge_kutta import Dop853, is_explicit
from .trajectory import Trajectory
from .variational import Varied, along, beside
from .wrapped_solver import AtSamples, Kept, Resuming, StickSlipSolver, Wary, behind_a_jump


class How(eqx.Module):
    """The choices of numerics, which a compiled program is made for."""

    solver: dfx.AbstractSolver
    stabilisation: Any = eqx.field(static=True)
    friction: Any = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)
    adjoint: dfx.AbstractAdjoint | None = None
    progress: bool = eqx.field(static=True, default=False)
    audit: bool = eqx.field(static=True, default=False)

    @classmethod
    def of(cls, solver, *rest) -> "How":
        how = cls(Dop853() if solver is None else solver, *rest)
        _check_kinds(how)
        return how


def _check_kinds(how: How) -> None:
    for name, kinds, cure in (
        ("solver", (dfx.AbstractSolver,), "`jaxlag.Dop853()` or `diffrax.Kvaerno5()`"),
        ("stabilisation", (Projection, Baumgarte, NoStabilisation), "`Projection()`, `Baumgarte()` or `NoStabilisation()`"),
        ("friction", (StickSlip, Regularised), "`StickSlip()` or `Regularised(width)`"),
        ("adjoint", (dfx.AbstractAdjoint, type(None)), "`diffrax.RecursiveCheckpointAdjoint()`, or leave it out"),
    ):
        if not isinstance(given := getattr(how, name), kinds):
            raise TypeError(f"`{name}` must be an object that makes the choice, but is {given!r}. Take e.g. {cure}.")
    count(how.max_steps, "`max_steps`", cure="The default is 100_000.")


def tolerances_of(rtol, atol, dtype) -> tuple[Array, Array]:
    """Those given, or what the precision allows."""
    single = jnp.finfo(dtype).bits < 64
    if single:
        _warn_of_single_precision()
    defaults = (1e-4, 1e-6) if single else (1e-8, 1e-10)
    rtol = number(defaults[0] if rtol is None else rtol, "`rtol`", dtype, least=0.0, cure=f"The default is {defaults[0]:g}.")
    atol = number(defaults[1] if atol is None else atol, "`atol`", dtype, positive=True, cure=f"The default is {defaults[1]:g}.")
    return rtol, atol


@functools.cache
def _warn_of_single_precision() -> None:
    warnings.warn(
        "jaxlag runs in single precision: tolerances below 1e-5 are out of reach. "
        'For double precision: jax.config.update("jax_enable_x64", True).',
        stacklevel=5,
    )


class Begun(NamedTuple):
    """y at the start, how far the start was off, and what may be wrong with it."""

    y: Array
    moved: Array
    obstacles: tuple[tuple[Bool[Array, ""], Any], ...]


def begun(equations: Equations, t0, q, v, params) -> Begun:
    """The start, put on the constraints."""
    nearest = nearest_state(equations.flat(params), t0, q, v)
    start = equations.start(t0, nearest.q, nearest.v, params)
    moved = jax.lax.stop_gradient(jnp.max(jnp.abs(jnp.concatenate([nearest.q - q, nearest.v - v]))))
    obstacles = (
        (start.has_mode, RESULTS.no_friction),
        (start.has_bounds, RESULTS.negative_bound),
        (nearest.reached, RESULTS.impossible_start),
        (nearest.affine, RESULTS.not_affine),
        (nearest.determined, RESULTS.no_inertia),
        (nearest.defined, RESULTS.undefined),
    )
    return Begun(start.y, moved, obstacles)


def judged(ys, result, obstacles, inputs) -> tuple[Array, RESULTS]:
    """States that were not reached as NaN; and the reason that the motion ended, the start or the input included."""
    finite = jnp.all(jnp.array([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(inputs) if eqx.is_inexact_array(x)]))
    ordered = jnp.all(jnp.diff(inputs[-1]) >= 0)  # the times; traced ones may repeat the first or the last, as filling up does
    obstacles = (*obstacles, (ordered, RESULTS.unordered), (finite, RESULTS.not_finite))
    for passed, reason in obstacles:
        result = RESULTS.where(passed, result, reason)
    started = jnp.all(jnp.stack([passed for passed, _ in obstacles]))
    return jnp.where(started & jnp.isfinite(ys), ys, jnp.nan), result


def states_at(equations: Any, how: How, adjoint: dfx.AbstractAdjoint, t0, y0, ts, args, tolerances) -> tuple[Array, RESULTS, dict]:
    """States at the samples, by diffrax, the reason it stopped, and, among the counts, the `last` time and state that it came to."""
    rtol, atol = tolerances
    rounding = jnp.finfo(y0.dtype).eps * jnp.maximum(jnp.abs(ts[0]), jnp.abs(ts[-1]))
    controller = Wary(rtol, atol, dtmin=4 * rounding, force_dtmin=False, norm=equations.error_norm)
    end, jumps, behind = ts[-1], jump_times(args[0], ts.dtype), None
    if jumps is not None:
        controller = dfx.ClipStepSizeController(Resuming(rtol, atol, smallest=4 * rounding, norm=equations.error_norm), jump_ts=jumps)
        end = end + 256 * rounding  # a jump at the last sample is stepped on too: diffrax rounds what is within 100 ulp of the end
        behind = functools.partial(behind_a_jump, equations)
    alone = in_one_kernel if isinstance(adjoint, dfx.ForwardMode) else lambda function: function
    kept = alone(equations.kept) if equations.projection else None
    solver = how.solver
    if equations.rows:
        solver = StickSlipSolver(how.solver, kept, 2 * equations.size, behind, equations)
    elif kept is not None or behind is not None or how.audit:
        solver = Kept(how.solver, kept, 2 * equations.size, behind)
    solution = dfx.diffeqsolve.__wrapped__(  # all is within a program already, and `equinox.filter_jit` would keep what it is given
        dfx.ODETerm(alone(equations.rates)),
        solver,
        t0,
        end,
        None,
        y0,
        args,
        saveat=dfx.SaveAt(t1=True),
        stepsize_controller=controller,
        adjoint=AtSamples(adjoint, ts),
        max_steps=how.max_steps,
        throw=False,
        progress_meter=Meter() if how.progress else dfx.NoProgressMeter(),
    )
    (_, last_t), (ys, last_y) = solution.ts, solution.ys
    ys = ys if kept is None else jax.vmap(lambda t, y: kept(t, y, args))(ts, ys)
    stats = {key: solution.stats[key] for key in ("num_steps", "num_accepted_steps", "num_rejected_steps")}
    result = RESULTS.promote(solution.result)
    for said, meant in SAID_BY_STEPS:
        result = RESULTS.where(result == said, meant, result)
    return ys, result, stats | {"last": jax.lax.stop_gradient((last_t[0], last_y[0]))}


SAID_BY_STEPS = (  # what of diffrax's reasons stands for one of ours
    (RESULTS.internal_error, RESULTS.no_friction),
    (RESULTS.max_steps_rejected, RESULTS.chattering),
    (RESULTS.stagnation, RESULTS.negative_bound),
    (RESULTS.nonlinear_divergence, RESULTS.undefined),
)


def states_varied(equations: Any, how: How, started, moving, directions, t0, dt0, ts, args, tolerances):
    """The same with derivatives along directions of what moves, by the variational equations; `started(moving) -> (y0, aux)`.

    `args` are (params, δparams), and δt0 is None where it stands still.
    """
    y0, dy0, aux = along(started, moving, directions)
    if dt0 is not None:  # a start that is later lies further back at t0
        dy0 = dy0 - jnp.multiply.outer(equations.rates(t0, y0, (args[0], None)), dt0)
    ys, result, stats = states_at(Varied(equations), how, dfx.ForwardMode(), t0, beside(y0, dy0), ts, args, tolerances)
    last_t, last_y = stats["last"]
    return ys[..., 0], ys[..., 1:], result, stats | {"last": (last_t, last_y[..., 0])}, aux


def can_be_varied(equations: Any, how: How, moving_params, params) -> bool:
    """Whether differentiating the motion comes to the variational equations: no mode, jump or solution of equations within a step."""
    return not equations.rows and is_explicit(how.solver) and moves_smoothly(moving_params, params)


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


def raise_failure(trajectory: Trajectory, start: tuple | None = None) -> None:
    """Raises the reason of a failed motion, outside what is compiled; under `jit` the reason stays in the result.

    Of a `start` (q0, qdot0), it names the coordinates that the reason is about.
    """
    if not is_concrete(trajectory.result) or np.all(trajectory.succeeded):
        return
    reason = reason_of(trajectory.result)
    if reason in map(reason_of, OF_THE_INPUT):
        if start is None:
            raise ValueError(reason)
        q0, qdot0 = start
        raise ValueError(because(reason, trajectory.stated.system, q0, qdot0, trajectory.stated.params, trajectory.ts[0]))
    samples, coordinate = trajectory.ts.shape[-1], np.asarray(jax.tree.leaves(trajectory.q)[0])
    reached = np.isfinite(coordinate.reshape(-1, samples, coordinate.size // trajectory.ts.size)[..., 0]).sum(1).min()
    numerics = (
        "Allow more `max_steps`, look at what was computed with `throw=False`, or take a solver for stiff systems, "
        f"`solver=diffrax.Kvaerno5()`.{_of_friction(trajectory)}"
    )
    raise RuntimeError(
        f"the motion must reach t = {np.ravel(trajectory.ts)[-1]:g}, but stopped at t = {np.min(trajectory.stats['reached']):g} "
        f"after {reached} of {samples} samples: {reason} {numerics if reason in map(reason_of, OF_THE_STEPS) else ''}".rstrip()
    )


def _of_friction(trajectory: Trajectory) -> str:
    """What the system has of dry friction that was not read as such; of a batch, in its first motion."""
    for _ in trajectory.ts.shape[1:]:
        trajectory = jax.tree.map(lambda x: x[0], trajectory)
    flat, (q, v) = trajectory._flat(), trajectory._vectors()
    return "".join(f" And {finding}." for finding in unread_friction(flat, trajectory.ts[0], q[0], v[0], trajectory.friction))
