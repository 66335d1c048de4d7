"""What the sensors should have seen: predictions, residuals and their Jacobians, of many experiments in one pass."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import PyTree

from .._mechanics.lagrange import constraint_rows, position_residual
from .._mechanics.projection import consistent_state
from .._model.injection import call
from .._model.paths import is_within
from .._model.system import System
from .._model.validation import at_state
from .._motion.results import RESULTS
from .._motion.simulate import simulate
from .._motion.simulate_many import filled_up, of_each
from .._motion.trajectory import Trajectory
from .._program.jit import is_concrete
from .experiment import Experiment, start_entries, with_own
from .parameters import Free


class Stack(eqx.Module):
    """Experiments of one kind, side by side: each array has them as its first axis. Shorter ones are filled up with missing samples.

    `ways`: how the flat start (q0, qdot0) moves with the unknowns of an experiment that are its own; then come unknown parameters.
    """

    ts: Any
    values: PyTree
    sigma: PyTree
    q0: PyTree
    qdot0: PyTree
    params: dict[str, Any]
    ways: Any
    observe: Callable = eqx.field(static=True)
    delay: Any = eqx.field(static=True)
    own: tuple[str, ...] = eqx.field(static=True)  # entries of params that are unknown
    members: tuple[int, ...] = eqx.field(static=True)  # which of the experiments they are
    mesh: Mesh | None = eqx.field(static=True, default=None)  # the devices they are spread over

    @property
    def unknowns(self) -> int:
        """d, the number of unknowns of one experiment's own."""
        return self.ways.shape[-1] + sum(int(np.prod(leaf.shape[1:])) for name in self.own for leaf in jax.tree.leaves(self.params[name]))

    def started(self, z):
        """The start and the experiment's own parameters, of one member without its first axis, at its unknowns z."""
        if self.unknowns == 0:  # what moves with nothing is not to be differentiated
            return self.q0, self.qdot0, self.params
        start, unravel = ravel_pytree((self.q0, self.qdot0))
        k = self.ways.shape[-1]
        q0, qdot0 = unravel(start + self.ways @ z[:k])
        own, unravel_own = ravel_pytree({name: self.params[name] for name in self.own})
        return q0, qdot0, self.params | unravel_own(own + jnp.where(own == 0, 1, jnp.abs(own)) * z[k:])


ALONG = PartitionSpec("experiments")


def stacked(system: System, params: PyTree, experiments: Sequence[Experiment]) -> tuple[Stack, ...]:
    """Experiments of the same kind brought together, and spread over the devices where there are several."""
    kinds: dict[Any, list[int]] = {}
    ways = [_ways(system, params, e) for e in experiments]
    for i, e in enumerate(experiments):
        rest = (e.q0, e.qdot0, e.params, ways[i])
        shapes = [jnp.shape(x)[1:] for x in jax.tree.leaves(e.values)], [jnp.shape(x) for x in jax.tree.leaves(rest)]
        kind = e.observe, e.delay, _own(e), jax.tree.structure((e.values, rest)), str(shapes)
        kinds.setdefault(kind, []).append(i)
    return tuple(_stack([experiments[i] for i in members], [ways[i] for i in members], members) for members in kinds.values())


def _own(e):
    return tuple(name for name in e.unknown if name in e.params)


def _stack(experiments, ways, members):
    longest = max(e.ts.size for e in experiments)
    xnp: Any = np if is_concrete(experiments, ways) else jnp  # NumPy is quicker where it will do

    def fill(x, e, filling=None):
        x = xnp.asarray(x)
        return xnp.concatenate([x, xnp.broadcast_to(x[-1] if filling is None else filling, (longest - e.ts.size, *x.shape[1:]))])

    sigma = lambda e: e.sigma if e.sigma is not None else jax.tree.map(jnp.ones_like, e.values)
    filled = [
        (
            fill(e.ts, e),
            jax.tree.map(lambda v, e=e: fill(v, e, jnp.nan), e.values),
            jax.tree.map(lambda s, e=e: fill(s, e, 1.0), sigma(e)),
            e.q0,
            e.qdot0,
            e.params,
            way,
        )
        for e, way in zip(experiments, ways, strict=True)
    ]
    arrays, others = eqx.partition(filled, lambda x: isinstance(x, (np.ndarray, jax.Array)))
    together = eqx.combine(jax.tree.map(lambda *leaves: jnp.asarray(xnp.stack(leaves)), *arrays), others[0])
    first = experiments[0]
    return _spread(Stack(*together, first.observe, first.delay, _own(first), tuple(members)))


def _spread(stack):
    """Over all devices, filled up with copies of the last experiment to as many as each device can have alike."""
    count, devices = len(stack.members), jax.device_count()
    if min(count, devices) == 1:
        return stack
    stack = dataclasses.replace(stack, mesh=Mesh(np.array(jax.devices()), "experiments"))
    along = NamedSharding(stack.mesh, ALONG)
    return jax.tree.map(lambda x: jax.device_put(filled_up(x, devices), along) if eqx.is_array(x) else x, stack)


def _ways(system, params, e):
    """Directions in which the start of an experiment may move: what is unknown of it, within the constraints."""
    entries = start_entries(e)
    n = len(entries) // 2
    free = [[i for i in part if any(is_within(entries[i], name) for name in e.unknown)] for part in (range(n), range(n, 2 * n))]
    blocks = [np.eye(2 * n)[:, part] for part in free]
    if system.constraints and any(free):
        every = with_own(params, e.params)
        q, qdot = consistent_state(system, e.q0, e.qdot0, every, t=e.ts[0])
        for k, rows in enumerate(at_state(_rows, system, q, qdot, every, e.ts[0])):
            at = np.array(free[k], int) - k * n
            _, s, Vt = np.linalg.svd(np.asarray(rows)[:, at])
            rank = int(np.sum(s > 1e-9 * s[:1]))
            blocks[k] = blocks[k] @ Vt[rank:].T
    return jnp.asarray(np.hstack(blocks), jax.tree.leaves(e.q0)[0].dtype)


def _rows(flat, t, q, v):
    return position_residual(flat, t, q)[1], constraint_rows(flat, t, q, v)[1]


@dataclasses.dataclass(frozen=True)
class Huber:
    r"""A loss that outliers do not rule: quadratic up to `delta` standard deviations, linear beyond.

    $$ \rho(r) = \tfrac12 r^2 \ (|r| \le \delta), \qquad \rho(r) = \delta |r| - \tfrac12 \delta^2 \ (|r| > \delta) $$

    **Source:** Huber, Ann. Math. Statist. 35 (1964) 73-101; δ = 1.345 has 95 % efficiency where the noise is normal.

    ```python
    import jaxlag as jl
    jl.Huber(delta=1.345)
    ```
    """

    delta: float = 1.345

    def root(self, r):
        """√(2ρ) with the sign of r, so that its square is the loss."""
        beyond = jnp.abs(r) > self.delta
        far = jnp.where(beyond, jnp.abs(r), self.delta)
        return jnp.where(beyond, jnp.sign(r) * jnp.sqrt(2 * self.delta * far - self.delta**2), r)

    def influence(self, r):
        """ψ = dρ/dr."""
        return jnp.clip(r, -self.delta, self.delta)

    def slope(self, r):
        """d root / dr."""
        beyond = jnp.abs(r) > self.delta
        return jnp.where(beyond, self.delta / jnp.abs(self.root(jnp.where(beyond, r, self.delta))), 1)


class Model(eqx.Module):
    """How predictions are made; compared by its fields, so that it compiles once."""

    system: System = eqx.field(static=True)
    numerics: tuple[tuple[str, Any], ...] = eqx.field(static=True)
    loss: Huber | None = eqx.field(static=True)

    def predicted(self, params, e: Stack, z) -> tuple[PyTree, Trajectory]:
        """What the sensors of one experiment should see, and the motion itself."""
        q0, qdot0, own = e.started(z)
        params = with_own(params, own)
        ts = e.ts
        if e.delay is not None:
            delay = call(e.delay, "`delay`", params) if callable(e.delay) else e.delay
            late = ts - jnp.asarray(delay, ts.dtype)
            ts = jnp.concatenate([ts[:1], jnp.where(late > ts[0], late, ts[0])])
        motion = simulate(self.system, q0, qdot0, ts, params, **{**dict(self.numerics), "throw": False})

        def seen(t, q, qdot, qddot, multipliers):
            return call(e.observe, "`observe`", params, t=t, q=q, qdot=qdot, qddot=qddot, multipliers=multipliers)

        channels = jax.vmap(seen)(motion.ts, motion.q, motion.qdot, motion.qddot, motion.multipliers)
        return (channels if e.delay is None else jax.tree.map(lambda x: x[1:], channels)), motion


class Member(NamedTuple):
    """One experiment at given unknowns: weighted residuals, first and last state as (q, q̇, q, q̇), channels, the reason it ended."""

    residuals: Any
    ends: Any
    channels: PyTree
    result: RESULTS


def member(model: Model, free: Free, e: Stack, y, z, scale=1.0) -> Member:
    """The residuals of one experiment as a function of the variables y of the free parameters and z of its own unknowns."""
    channels, motion = model.predicted(free.insert(free.theta(y)), e, z)
    _check(e, channels)

    def weighted(p, v, s):
        there = jnp.isfinite(v)
        r = jnp.where(there, (p - jnp.where(there, v, 0)) / s, 0)
        return r if model.loss is None else scale * model.loss.root(r / scale)

    r = ravel_pytree(jax.tree.map(weighted, channels, e.values, e.sigma))[0]
    ends = ravel_pytree([jax.tree.map(lambda x, i=i: x[i], (motion.q, motion.qdot)) for i in (0, -1)])[0]
    return Member(jnp.where(motion.succeeded, r, jnp.inf), ends, channels, motion.result)


def _check(e, channels):
    """Refuses an `observe` that does not see what was measured; shapes only, while it is traced."""
    of = f"`observe` of experiment {e.members[0]}"
    if jax.tree.structure(channels) != jax.tree.structure(e.values):
        raise ValueError(
            f"{of} must return what `values` holds, {jax.tree.structure(e.values)}, but returns {jax.tree.structure(channels)}. "
            "Give both the same names."
        )
    for (path, seen), v in zip(jax.tree_util.tree_flatten_with_path(channels)[0], jax.tree.leaves(e.values), strict=True):
        if seen.shape != v.shape or not jnp.issubdtype(seen.dtype, jnp.floating):
            raise ValueError(
                f"{of} must return real numbers of shape {v.shape[1:]} for `values{jax.tree_util.keystr(path)}`, "
                f"but returns shape {seen.shape[1:]} and dtype {seen.dtype}. Compare what was measured with what is seen."
            )


def members(model: Model, free: Free, stack: Stack, y, z, scale=1.0) -> Member:
    """The members of a stack at y and z (experiments × unknowns)."""
    return side_by_side(lambda e, z, y, free, scale: member(model, free, e, y, z, scale), stack, z, y, free, scale)


def side_by_side(of_one: Callable[..., Any], stack: Stack, z: Any, *common: Any) -> Any:
    """`of_one(e, z, *common)` of each experiment; on several devices each its part of them."""
    arrays, others = eqx.partition(stack, eqx.is_array)
    if len(z) == 1:  # spares a batch of one
        first = lambda tree: jax.tree.map(lambda x: x[0], tree)
        return jax.tree.map(lambda x: x[None], of_one(eqx.combine(first(arrays), others), z[0], *common))
    numbers, rest = eqx.partition(common, eqx.is_array)
    one = lambda given, numbers: of_one(eqx.combine(given[0], others), given[1], *eqx.combine(numbers, rest))
    batch = lambda arrays, z, numbers: of_each(lambda given: one(given, numbers), (arrays, z))
    if stack.mesh is None:
        return batch(arrays, z, numbers)
    batch = jax.shard_map(batch, mesh=stack.mesh, in_specs=(ALONG, ALONG, PartitionSpec()), out_specs=ALONG, check_vma=False)
    return jax.tree.map(lambda x: x[: len(z)], batch(arrays, filled_up(z, stack.mesh.size), numbers))


class Linearised(NamedTuple):
    """Members with the Jacobians of residuals and ends in (y, z), experiments as first axis."""

    residuals: Any
    jacobian: Any
    ends: Any
    ends_jacobian: Any
    channels: PyTree
    result: RESULTS


def linearised(model: Model, free: Free, stack: Stack, y, z, scale=1.0) -> Linearised:
    """The members of a stack at y and z (experiments × unknowns), with their Jacobians, in one pass."""

    def of_one(e, z, y, free, scale):
        def rows(x):
            m = member(model, free, e, x[: y.size], x[y.size :], scale)
            return (m.residuals, m.ends), m

        (J, ends_J), m = jax.jacfwd(rows, has_aux=True)(jnp.concatenate([y, z]))
        whole = jnp.all(jnp.isfinite(m.residuals)) & jnp.all(jnp.isfinite(J))
        r, J = jnp.where(whole, m.residuals, jnp.inf), jnp.where(whole, J, 0)
        return Linearised(r, J, m.ends, ends_J, m.channels, m.result)

    return side_by_side(of_one, stack, z, y, free, scale)
