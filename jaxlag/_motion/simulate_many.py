"""Many motions of one system at once."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from .._mechanics.friction_treatment import Regularised, StickSlip
from .._mechanics.projection import Baumgarte, NoStabilisation, Projection
from .._mechanics.surfaces import Located, NotLocated
from .._model.event import Event
from .._model.flat import StatesAt
from .._model.paths import is_within, leaf_names, listed
from .._model.signal import SinceOrigin, is_signal, jump_times, with_second_derivatives
from .._model.state_values import start_values
from .._model.system import System
from .._model.validation import check, coordinates, parameters, sample_times, state
from .._program.jit import jitted
from .batch import BatchedEquations
from .derivative_rule import differentiable_batch
from .failure import raise_failure
from .first_order import EquationsOfMotion
from .formulation import Formulation
from .integrate import SolverOptions, Variations, by_diffrax, initialised, is_variational, with_status
from .members import all_devices, check_agreement, of_each, over_devices, padded
from .protocol import Arguments
from .results import RESULTS
from .scales import Scales, tolerances_of
from .simulate import simulate
from .solution_map import samples_at, trajectory_of
from .trajectory import Trajectory
from .variational import pushforward, split_varying

BATCH_SIZE = 64  # members that share their steps: as many as the cache holds the stages of


def simulate_many(
    system: System,
    q0: PyTree,
    qdot0: PyTree,
    ts: Any,
    params: PyTree = None,
    *,
    over: Sequence[str],
    events: Mapping[str, Event] | None = None,
    common_steps: bool | None = None,
    solver: dfx.AbstractSolver | None = None,
    rtol: float | Array | None = None,
    atol: PyTree = None,
    stabilisation: Projection | Baumgarte | NoStabilisation = Projection(),
    friction: StickSlip | Regularised = StickSlip(),
    surfaces: Located | NotLocated = Located(),
    max_steps: int = 100_000,
    throw: bool = True,
) -> Trajectory:
    r"""The motions of many machines that differ in their parameters or in their starts.

    $$ M(q_i; p_i)\,\ddot q_i = f(q_i, \dot q_i; p_i) + G^T\lambda_i, \qquad i = 1 \dots B $$

    Everything that `over` names has the members as its first axis. The result is that of `simulate` for each member, within the tolerances,
    with the members as first axis of every field; derivatives are those of `simulate`, with up to 96 numbers of a member differentiated in
    one pass. The members are divided among all devices, and among several processes (`jax.distributed.initialize`) that make this call with
    the same arguments; each process gets the whole result.

    **Arguments:**

    - `system`, `q0`, `qdot0`, `ts`, `params`, `events`, `solver` to `throw`: as `simulate`; `ts` is the same for all.
    - `over`: what differs: "q0", "qdot0", entries of them ("q0.phi") or of `params` ("b", "wheel.c").
    - `common_steps`: True makes 64 members at a time take the same steps, short enough for each of them, with the members as the last axis
      of all arithmetic: many times faster than one by one. False lets each member take its own steps. Default: True, but False with dry
      friction, a contact, an event, a force that jumps or bends, or a measured input that jumps, or bends and drives a constraint: these
      end steps at different times.
      If one of 64 cannot go on, all stop; `common_steps=False` then shows which.

    **Returns:** a `Trajectory`; each of its fields has the B members as its first axis, the samples as its second.

    **Raises:** as `simulate`; `ValueError` if `over` names none of these, if sizes differ, or if common steps are impossible.

    **Source:** Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, section II.4: a step fits a vector of equations
    when it fits the worst of them.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    stiffness = jnp.linspace(1.0, 4.0, 1000)
    motions = jl.simulate_many(oscillator, 1.0, 0.0, jnp.linspace(0, 10, 11), {"c": stiffness}, over=("c",))
    motions.q[-1, -1]  # cos(2 · 10) = 0.408
    ```
    """
    system = system if events is None else system.with_events(events)
    everything = {"q0": coordinates(q0, "q0"), "qdot0": coordinates(qdot0, "qdot0")}
    everything["params"] = parameters(params, everything["q0"])
    own, shared = eqx.partition(everything, _differing(everything, listed(over)))
    dtype = jnp.result_type(*jax.tree.leaves((everything["q0"], everything["qdot0"])))
    options = SolverOptions.of(solver, Formulation(stabilisation, friction, surfaces), max_steps)
    if common_steps not in (None, True, False):
        raise ValueError(f"`common_steps` must be True or False, but is {common_steps!r}. Leave it out to have it chosen.")
    like = eqx.combine(jax.tree.map(lambda leaf: np.zeros(leaf.shape[1:], leaf.dtype), own["q0"]), shared["q0"])
    check_agreement(**everything, ts=ts)
    tolerances = tolerances_of(rtol, atol, like)
    trajectory = _simulate_many(system, options, common_steps, own, shared, sample_times(ts, dtype), tolerances)
    if throw:
        raise_failure(trajectory)
    return trajectory


def _differing(everything, over):
    """Which leaves have the members as their first axis."""
    params, starts = everything["params"], {name: everything[name] for name in ("q0", "qdot0")}
    names = [*leaf_names(params, ""), *leaf_names(starts)]
    leaves, sizes = [*jax.tree.leaves(params), *jax.tree.leaves(starts)], {}
    for name in over:
        within = [leaf for entry, leaf in zip(names, leaves, strict=True) if is_within(entry, name)]
        if not within:
            raise ValueError(f"`over` must name q0, qdot0 or entries of params, but holds {name!r}. There are {', '.join(names)}.")
        sizes[name] = {np.shape(leaf)[:1] for leaf in within}
    if not sizes:
        raise ValueError("`over` must name what differs between members, but is empty. Call `simulate` for one motion.")
    every = set().union(*sizes.values())
    if len(every) != 1 or () in every:
        shown = ", ".join(f"{name}: {sorted(of_name)}" for name, of_name in sizes.items())
        raise ValueError(f"`over` must name what has all members as its first axis, but first axes are {shown}. Stack them alike.")
    differs = [any(is_within(entry, name) for name in over) for entry in names]
    of_params = jax.tree.unflatten(jax.tree.structure(params), differs[: len(jax.tree.leaves(params))])
    of_starts = jax.tree.unflatten(jax.tree.structure(starts), differs[len(jax.tree.leaves(params)) :])
    return {"params": of_params, **of_starts}


@jitted
def _simulate_many(system, options, common_steps, own, shared, ts, tolerances):
    first = eqx.combine(jax.tree.map(lambda leaf: leaf[0], own), shared)
    q0, qdot0 = state(first["q0"], first["qdot0"], ("q0", "qdot0"))
    at = _at(system, ts[0], q0, qdot0, first["params"])
    check(system, ts[0], q0, qdot0, first["params"], at.values)
    equations = EquationsOfMotion.of(system, q0, options.formulation, first["params"], at)
    members, (numbers, rest) = jax.tree.leaves(own)[0].shape[0], eqx.partition(shared, eqx.is_array)
    if _share_steps(common_steps, equations, first["params"], own):
        batch = lambda own, *given: _in_batches(system, equations, options, own, eqx.combine(given[0], rest), *given[1:])
    else:
        one = lambda own, *given: _one(system, options, eqx.combine(own, given[0], rest), *given[1:])
        batch = lambda own, *given: of_each(lambda own: one(own, *given), own)
    if min(members, jax.device_count()) > 1:
        devices = all_devices()
        own = jax.tree.map(lambda leaf: padded(leaf, devices.size), own)
        batch = functools.partial(over_devices, batch, devices)
    return jax.tree.map(lambda leaf: leaf[:members], batch(own, numbers, ts, tolerances))


def _at(system, t, q0, qdot0, params):
    """The start of one member."""
    q, v = (ravel_pytree(tree)[0] for tree in (q0, qdot0))
    return StatesAt(start_values(system, {}, t, q0, qdot0, params), t, q, v)


def _share_steps(common_steps, equations, params, own):
    signals = [leaf for leaf in jax.tree.leaves(own, is_leaf=is_signal) if is_signal(leaf) and jax.tree.leaves(leaf)]
    obstacle = equations.modes or equations.sampled.size or signals or equations.driving or jump_times(params, float) is not None
    if common_steps and obstacle:
        raise ValueError(
            "`common_steps` must be False where dry friction, a contact, an event, a force or an input that jumps or bends, or an update "
            "ends steps at its own time, or signals differ, but is True. Leave it out."
        )
    return common_steps is not False and not obstacle


def _one(system, options, everything, ts, tolerances):
    """One member, with steps of its own."""
    formulation = options.formulation
    choices = {name: getattr(formulation, name) for name in ("stabilisation", "friction", "surfaces")} | {"max_steps": options.max_steps}
    start = everything["q0"], everything["qdot0"], ts, everything["params"]
    return simulate(system, *start, solver=options.solver, rtol=tolerances[0], atol=tolerances[1], **choices, throw=False)


def _in_batches(system, equations, options, own, shared, ts, tolerances):
    """Members in batches that share their steps."""
    members = jax.tree.leaves(own)[0].shape[0]
    size = min(members, BATCH_SIZE)
    batches = jax.tree.map(lambda leaf: (x := padded(leaf, size)).reshape(-1, size, *x.shape[1:]), own)
    found = jax.lax.map(lambda own: _batch(system, equations, options, own, shared, ts, tolerances), batches)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:members], found)


def _batch(system, equations, options, own, shared, ts, tolerances):
    """Members that share their steps."""
    solve = functools.partial(_motions, equations, options)
    push = functools.partial(_motions_and_variations, equations, options)
    run = differentiable_batch(solve, functools.partial(_drift, equations), push)
    last = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), own)
    ys, (result, stats, moved) = run(((ts[0], tolerances, shared), last), ts)

    last_t, last_ys = stats.pop("last")

    def one(ys, last_y, result, moved, own):
        params = eqx.combine(own, shared)["params"]
        of_member = stats | {"start_moved": moved, "last": (last_t, last_y)}
        samples = samples_at(equations, ts - ts[0], ys, SinceOrigin.of(params, ts[0]), result, of_member, tolerances)
        return trajectory_of(system, options, params, ts, *samples)

    return jax.vmap(one, in_axes=(-1, -1, 0, 0, 0))(ys, last_ys, result, moved, own)


def _motions(equations, options, inputs, ts):
    """States at the samples, (T, size, members); and, not differentiated, why each motion ended, the counts, how far starts were off."""
    (t0, tolerances, _), _ = inputs
    y0, start = _initialised(equations, inputs, ts)
    given = t0 - ts[0], y0, ts - ts[0], _arguments(inputs, ts), tolerances
    ys, result, stats = by_diffrax(BatchedEquations(equations), options, dfx.ForwardMode(), *given)
    return _with_status(ys, result, stats, start)


def _arguments(inputs, ts):
    """Params on the clock of the motions, as of a `SolutionMap`, with second derivatives of signals."""
    (_, tolerances, shared), own = inputs
    params, none = SinceOrigin.of(with_second_derivatives(shared["params"]), ts[0]), jnp.zeros(0, ts.dtype)
    return Arguments(params, Scales.of(tolerances, ts - ts[0], params, none, none, sees_time=False), SinceOrigin(own["params"], None))


def _motions_and_variations(equations, options, inputs, directions, ts):
    """The same with derivatives along directions of what varies, by the variational equations where they hold."""
    (t0, tolerances, shared), own = inputs
    (dt0, _, d_shared), d_own = directions
    varying = split_varying(inputs, directions)[0][0][2]["params"]
    if not is_variational(equations, options, varying, shared["params"]):
        return pushforward(functools.partial(_motions, equations, options))(inputs, (directions,), ts)
    args, along = _arguments(inputs, ts), (SinceOrigin(d_shared["params"], None), SinceOrigin(d_own["params"], None))
    variations = Variations(BatchedEquations(equations), lambda inputs: _initialised(equations, inputs, ts))
    variations = variations.along(directions, along, dt0, lambda _: (t0 - ts[0], args))
    y0, start = variations.initial(inputs)
    args = args._replace(directions=variations.directions)
    ys, result, stats = by_diffrax(variations.equations, options, dfx.ForwardMode(), t0 - ts[0], y0, ts - ts[0], args, tolerances)
    last_t, last_y = stats["last"]
    ys, change = ys[..., 0], ys[..., 1:]
    ys, aux = _with_status(ys, result, stats | {"last": (last_t, last_y[..., 0])}, start)
    return (ys, change), aux


def _initialised(equations, inputs, ts):
    """y0; and, not differentiated, how far starts were off and what is wrong with them."""
    (t0, _, shared), own = inputs
    shared = shared | {"params": with_second_derivatives(shared["params"])}

    def start(own):
        member = eqx.combine(own, shared)
        at = _at(equations.system, t0, *(member[name] for name in ("q0", "qdot0", "params")))
        found = initialised(equations, at._replace(t=t0 - ts[0]), SinceOrigin.of(member["params"], ts[0]))
        return found.y, (found.moved, with_status(found.y, RESULTS.successful, found.conditions, (member, ts))[1])

    y0, start = jax.vmap(start, in_axes=-1, out_axes=(-1, 0))(own)
    return y0, start


def _with_status(ys, result, stats, start):
    moved, started = start
    result = jax.vmap(lambda started: RESULTS.where(started == RESULTS.successful, result, started))(started)
    return jnp.where((started == RESULTS.successful)[None, None] & jnp.isfinite(ys), ys, jnp.nan), (result, stats, moved)


def _drift(equations, inputs, ts, ys):
    args = _arguments(inputs, ts)
    return jax.vmap(lambda t, y: BatchedEquations(equations).rates(t, y, args))(ts - ts[0], ys)
