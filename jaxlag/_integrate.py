"""The motion: diffrax integrates the constrained accelerations, and the samples are put back on the constraints."""

import functools
import warnings
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from ._checks import checked, is_concrete, parameters, sample_times, state
from ._manifold import IMPOSSIBLE, Baumgarte, NoStabilisation, Projection, nearest_state
from ._multipliers import NO_INERTIA, constrained_acceleration
from ._power import energy_turnover, listed_powers
from ._sensitivities import differentiable
from ._system import Flat, System, bind, leaf_names

PROJECTION = "projection"  # how the work that projection does is named


class RESULTS(dfx.RESULTS):  # pyright: ignore
    """Why a motion ended: those of diffrax, and three of mechanics."""

    not_finite = "`q0`, `qdot0`, `ts` and `params` must be finite, but there is a NaN or an infinity among them. Look for missing values."
    no_inertia = NO_INERTIA
    impossible_start = IMPOSSIBLE


class _Stated(eqx.Module):
    """The system and params of a motion; what is no array in params is kept aside, so that batches of motions are arrays alone."""

    numbers: list[Array]
    system: System = eqx.field(static=True)
    rest: tuple = eqx.field(static=True)

    @classmethod
    def of(cls, system: System, params: PyTree) -> "_Stated":
        leaves, structure = jax.tree.flatten(params)
        numbers = [leaf for leaf in leaves if eqx.is_array(leaf)]
        return cls(numbers, system, (structure, tuple(None if eqx.is_array(leaf) else leaf for leaf in leaves)))

    def flat(self, like: PyTree) -> Flat:
        structure, others = self.rest
        numbers = iter(self.numbers)
        leaves = [next(numbers) if other is None else other for other in others]
        return bind(self.system, like, jax.tree.unflatten(structure, leaves))


class Trajectory(eqx.Module):
    """A motion at sample times: each field has the samples as its first axis.

    - `ts`: the times; `q`, `qdot`, `qddot`: structured like q0; `multipliers`: λ by the constraint's name.
    - `result`: `RESULTS.successful`, or the reason of failure; samples that were not reached are NaN.
    - `works`: what `work()` returns, where the motion was computed with `audit=True`.
    - `stats`: `num_steps`, `num_accepted_steps`, `num_rejected_steps`, and `start_moved`, how far the start was projected.
    """

    ts: Float[Array, " T"]
    q: PyTree
    qdot: PyTree
    qddot: PyTree
    multipliers: dict[str, PyTree]
    result: RESULTS
    stats: dict[str, Any]
    works: dict[str, Float[Array, " T"]] | None
    stated: "_Stated"

    @property
    def succeeded(self) -> Any:
        """Whether the motion was computed to its end."""
        return self.result == RESULTS.successful

    def energy(self) -> Float[Array, " T"]:
        """The energy h = q̇ · ∂L/∂q̇ − L at the samples; T + V where L = T − V with T quadratic in q̇."""
        return self._energy_turnover()[0]

    def work(self) -> dict[str, Float[Array, " T"]]:
        """Work since the start of each dissipation term, force and constraint by its name, of explicit time in L (`"time"`), and of the
        projection (`"projection"`). Integrated along with the motion: needs `simulate(..., audit=True)`.
        """
        if self.works is None:
            raise ValueError(
                "the motion must be computed with its works, but was computed without. Ask for them by `simulate(..., audit=True)`."
            )
        return self.works

    def balance(self) -> Float[Array, " T"]:
        """Residual of the energy balance, ΔE − ΣW, as a fraction of the energy turned over: the largest q̇ · ∂L/∂q̇ and all works."""
        energy, turned = self._energy_turnover()
        works = jnp.stack(list(self.work().values()))
        scale = jnp.nanmax(jnp.abs(turned)) + jnp.nansum(jnp.nanmax(jnp.abs(works), axis=1))
        return (energy - energy[0] - jnp.sum(works, axis=0)) / jnp.where(scale > 0, scale, 1)

    def _energy_turnover(self):
        q, v = (jax.vmap(lambda leaf: jax.flatten_util.ravel_pytree(leaf)[0])(tree) for tree in (self.q, self.qdot))
        flat = self.stated.flat(jax.tree.map(lambda leaf: leaf[0], self.q))
        return jax.vmap(functools.partial(energy_turnover, flat))(self.ts, q, v)

    def __repr__(self) -> str:
        if not is_concrete(self):
            return "Trajectory(traced)"
        batch = self.ts.shape[:-1]
        rows = [("coordinates", ", ".join(leaf_names(self.q)))]
        if self.multipliers:
            rows.append(("constraints", ", ".join(self.multipliers)))
        steps, rejected = (np.asarray(self.stats[key]) for key in ("num_steps", "num_rejected_steps"))
        rows.append(("steps", f"{steps.max()}, {rejected.max()} of them rejected" + (" (the most in the batch)" if batch else "")))
        if self.multipliers:
            rows.append(("start moved by", f"{np.max(self.stats['start_moved']):.2g}"))
        if self.works is not None:
            residual = self.balance() if not batch else jax.vmap(lambda motion: motion.balance())(self)
            rows.append(("energy balance", f"off by {np.nanmax(np.abs(residual)):.1e} of the energy turned over"))
        rows.append(("result", "successful" if np.all(self.succeeded) else reason_of(self.result)))
        of = f"{' × '.join(map(str, batch))} motions of " if batch else ""
        head = f"Trajectory: {of}{self.ts.shape[-1]} samples, t = {np.min(self.ts):g} … {np.max(self.ts):g}"
        return "\n".join([head, *(f"  {name:<15}{value}" for name, value in rows)])


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
    - `params`: what the functions of the system name.
    - `solver`: any explicit or diagonally implicit Runge–Kutta solver of diffrax. Default `diffrax.Tsit5()`; stiff systems
      want `diffrax.Kvaerno5()`, high accuracy `diffrax.Dopri8()`.
    - `rtol`, `atol`: tolerances of the step size control. Defaults 1e-8 and 1e-10 in double, 1e-4 and 1e-6 in single precision.
    - `stabilisation`: how the constraints are kept, `Projection()`, `Baumgarte(...)` or `NoStabilisation()`.
    - `max_steps`: steps after which the motion is given up.
    - `adjoint`: a diffrax adjoint, to be used in place of the derivative rule of this package.
    - `audit`: integrates the work of each term along with the motion, for `Trajectory.work()` and the energy balance.
    - `progress`: shows a bar while it runs.
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
    how = _How(solver or dfx.Tsit5(), stabilisation, max_steps, adjoint, progress, audit)
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
    max_steps: int = eqx.field(static=True)
    adjoint: dfx.AbstractAdjoint | None
    progress: bool = eqx.field(static=True)
    audit: bool = eqx.field(static=True)


@eqx.filter_jit
def _simulate(system, how, q0, qdot0, ts, params, tolerances):
    _, t0, q, v = checked(system, ts[0], q0, qdot0, params)
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), q0)
    rates, kept, listed = _equations_of_motion(system, how, like)

    def motion(adjoint, inputs, ts):
        t0, q, v, params, tolerances = inputs
        start = nearest_state(bind(system, like, params), t0, q, v)
        y0 = jnp.concatenate([start.q, start.v, jnp.zeros(len(listed), q.dtype)])
        ys, result, stats = _solve(rates, kept, how, adjoint, t0, y0, ts, params, tolerances, 2 * q.size)
        moved = jnp.max(jnp.abs(y0[: 2 * q.size] - jnp.concatenate([q, v])))
        finite = jnp.all(jnp.array([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves((inputs, ts)) if eqx.is_inexact_array(x)]))
        result = RESULTS.where(start.reached, result, RESULTS.impossible_start)
        result = RESULTS.where(start.determined, result, RESULTS.no_inertia)
        result = RESULTS.where(finite, result, RESULTS.not_finite)
        started = finite & start.reached & start.determined
        return jnp.where(started & jnp.isfinite(ys), ys, jnp.nan), (result, stats | {"start_moved": jax.lax.stop_gradient(moved)})

    if how.adjoint is None:
        drift = lambda inputs, ts, ys: jax.vmap(rates, (0, 0, None))(ts, ys, inputs[3])
        forward, reverse = (functools.partial(motion, adjoint) for adjoint in (dfx.ForwardMode(), dfx.RecursiveCheckpointAdjoint()))
        run = differentiable(forward, reverse, drift)
    else:
        run = functools.partial(motion, how.adjoint)
    ys, (result, stats) = run((t0, q, v, params, tolerances), ts)

    def at_sample(t, y):
        flat, (q, v, _) = bind(system, like, params), _parts(y, q0)
        qddot, multipliers, _ = constrained_acceleration(flat, t, q, v, how.stabilisation.feedback())
        return flat.unravel(q), flat.unravel(v), flat.unravel(qddot), flat.unravel_multipliers(multipliers)

    work = dict(zip(listed, ys[:, 2 * q.size :].T, strict=True)) if how.audit else None
    return Trajectory(ts, *jax.vmap(at_sample)(ts, ys), result, stats, work, _Stated.of(system, params))


def _equations_of_motion(system, how, like):
    """ẏ of y = (q, q̇, work of each term), what is done to y after a step, and the names of the works."""
    project = how.stabilisation.project if system.constraints else None
    listed = (*system.terms, PROJECTION) if how.audit else ()

    @eqx.filter_jit  # so that diffrax's many calls trace it once
    def rates(t, y, params):
        flat, (q, v, _) = bind(system, like, params), _parts(y, like)
        qddot = constrained_acceleration(flat, t, q, v, how.stabilisation.feedback()).x
        return jnp.concatenate([v, qddot, *([listed_powers(flat, t, q, v)] if how.audit else [])])

    @eqx.filter_jit
    def kept(t, y, params):
        flat, (q, v, work) = bind(system, like, params), _parts(y, like)
        on_q, on_v = project(flat, t, q, v)
        if how.audit:
            lift = energy_turnover(flat, t, on_q, on_v)[0] - energy_turnover(flat, t, q, v)[0]
            work = work.at[listed.index(PROJECTION)].add(lift)
        return jnp.concatenate([on_q, on_v, work])

    return rates, kept if project else None, listed


def _parts(y, like):
    n = sum(leaf.size for leaf in jax.tree.leaves(like))
    return y[:n], y[n : 2 * n], y[2 * n :]


def _solve(rates, kept, how, adjoint, t0, y0, ts, params, tolerances, controlled):
    """States at the samples, by diffrax, and the reason it stopped. The error of the first `controlled` entries sets the steps."""
    rtol, atol = tolerances
    smallest = 4 * jnp.finfo(y0.dtype).eps * jnp.maximum(jnp.abs(ts[0]), jnp.abs(ts[-1]))
    solution = dfx.diffeqsolve(
        dfx.ODETerm(rates),
        how.solver if kept is None and not how.audit else _Kept(how.solver, kept, controlled),
        t0,
        ts[-1],
        None,
        y0,
        params,
        saveat=dfx.SaveAt(ts=ts),
        stepsize_controller=dfx.PIDController(rtol, atol, dtmin=smallest, force_dtmin=False),
        adjoint=adjoint,
        max_steps=how.max_steps,
        throw=False,
        progress_meter=dfx.TextProgressMeter() if how.progress else dfx.NoProgressMeter(),
    )
    ys = solution.ys if kept is None else jax.vmap(kept, (0, 0, None))(ts, solution.ys, params)
    stats = {key: solution.stats[key] for key in ("num_steps", "num_accepted_steps", "num_rejected_steps")}
    return ys, RESULTS.promote(solution.result), stats


class _Kept(dfx.AbstractWrappedSolver, dfx.AbstractAdaptiveSolver):
    """Any Runge–Kutta solver, with the end of each step put back on the constraints, and works that do not set the steps."""

    solver: dfx.AbstractRungeKutta
    kept: Callable | None = eqx.field(static=True)
    controlled: int = eqx.field(static=True)

    @property
    def term_structure(self):
        return self.solver.term_structure

    @property
    def interpolation_cls(self):
        return self.solver.interpolation_cls

    @property
    def term_compatible_contr_kwargs(self):
        return self.solver.term_compatible_contr_kwargs

    @property
    def scan_kind(self):
        return self.solver.scan_kind

    @property
    def root_finder(self):
        return self.solver.root_finder

    @property
    def root_find_max_steps(self):
        return self.solver.root_find_max_steps

    def order(self, terms):
        return self.solver.order(terms)

    def error_order(self, terms):
        return self.solver.error_order(terms)

    def init(self, terms, t0, t1, y0, args):
        return self.solver.init(terms, t0, t1, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y1, error, dense, solver_state, result = self.solver.step(terms, t0, t1, y0, args, solver_state, made_jump)
        error = error.at[self.controlled :].set(0)
        if self.kept is not None:
            y1 = self.kept(t1, y1, args)
            # A step that cannot be put back is rejected, and tried again with half the length or less.
            error = jnp.where(jnp.all(jnp.isfinite(y1)), error, jnp.inf)
        return y1, error, dense | {"y1": y1}, solver_state, result

    def func(self, terms, t0, y0, args):
        return self.solver.func(terms, t0, y0, args)


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
    if reason in map(reason_of, (RESULTS.not_finite, RESULTS.no_inertia, RESULTS.impossible_start)):
        raise ValueError(reason)
    reached = np.asarray(jnp.sum(jnp.isfinite(jax.tree.leaves(trajectory.q)[0].reshape(trajectory.ts.size, -1)[:, 0])))
    raise RuntimeError(
        f"the motion must reach t = {trajectory.ts[-1]:g}, but stopped after {reached} of {trajectory.ts.size} samples: {reason} "
        "Allow more `max_steps`, look at what was computed with `throw=False`, or take a solver for stiff systems, "
        "`solver=diffrax.Kvaerno5()`."
    )


def reason_of(result: Any) -> str:
    """What a result says; of a batch, what the first failure says."""
    successful: Any = RESULTS.successful
    failed = np.ravel(result._value)[np.ravel(result != successful)]
    one = eqx.tree_at(lambda r: r._value, successful, jnp.asarray(failed[0])) if failed.size else successful
    return RESULTS[one]  # type: ignore[misc]
