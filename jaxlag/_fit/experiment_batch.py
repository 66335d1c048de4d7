"""Experiments of one kind as a batch: padded to equal length, and distributed over the devices."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, NamedSharding
from jaxtyping import Array, Float, PyTree

from .._mechanics.augmented_inertia import unit_lengths
from .._mechanics.consistent_state import consistent_state
from .._mechanics.lagrange import constraint_rows, inertia, position_residual
from .._mechanics.singular_directions import tangent_basis
from .._model.paths import is_within
from .._model.system import System
from .._model.validation import at_state
from .._motion.members import MEMBERS, all_devices, check_agreement, of_each, over_devices, padded
from .._program.jit import numpy_for
from .experiment import Experiment, start_entries, with_own


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class ExperimentBatch:
    """Experiments of one kind: each array has them as its first axis. Shorter records are padded with missing samples, and events that
    fewer of were observed with missing ones.

    `tangent_basis`: (experiments, 2n, k), directions in which the flat start (q0, qdot0) moves with the first k of an experiment's own
    unknowns z; the other entries of z are its unknown parameters.
    """

    ts: Any
    values: PyTree
    sigma: PyTree
    q0: PyTree
    qdot0: PyTree
    params: dict[str, Any]
    tangent_basis: Any
    observe: Callable = dataclasses.field(metadata={"static": True})
    delay: Any = dataclasses.field(metadata={"static": True})
    events: tuple[str, ...] = dataclasses.field(metadata={"static": True})  # channels that are times of events, (experiments, K)
    own: tuple[str, ...] = dataclasses.field(metadata={"static": True})  # entries of params that are unknown
    members: tuple[int, ...] = dataclasses.field(metadata={"static": True})  # indices of the experiments
    mesh: Mesh | None = dataclasses.field(default=None, metadata={"static": True})  # the devices they are distributed over

    @property
    def unknowns(self) -> int:
        """The number of unknowns of each experiment."""
        of_params = (int(np.prod(leaf.shape[1:])) for name in self.own for leaf in jax.tree.leaves(self.params[name]))
        return self.tangent_basis.shape[-1] + sum(of_params)

    @property
    def times(self) -> list[Any]:
        """For each leaf of the values when its rows were measured, (experiments, T): those of events are times themselves."""
        leaves = jax.tree.leaves(self.values)
        return [leaf if of_event else self.ts for leaf, of_event in zip(leaves, of_events(self), strict=True)]

    def flat(self, tree: PyTree) -> np.ndarray:
        """What is structured like the values, one channel after the other, (experiments, N); without the copies that may follow."""
        count = len(self.members)
        return np.concatenate([np.reshape(np.asarray(x)[:count], (count, -1)) for x in jax.tree.leaves(tree)], axis=1)

    def start(self, z: Float[Array, " d"]) -> tuple[PyTree, PyTree, dict[str, Any]]:
        """q0, qdot0 and the own parameters of one experiment (a batch without its first axis) at its unknowns z."""
        if self.unknowns == 0:  # what depends on no unknown is not to be differentiated
            return self.q0, self.qdot0, self.params
        start, unravel = ravel_pytree((self.q0, self.qdot0))
        k = self.tangent_basis.shape[-1]
        q0, qdot0 = unravel(start + self.tangent_basis @ z[:k])
        own, unravel_own = ravel_pytree({name: self.params[name] for name in self.own})
        return q0, qdot0, self.params | unravel_own(own + jnp.where(own == 0, 1, jnp.abs(own)) * z[k:])


def batches_of(system: System, params: PyTree, experiments: Sequence[Experiment]) -> tuple[ExperimentBatch, ...]:
    """One batch for each kind of experiment, distributed over the devices where there are several."""
    check_agreement(params=params, experiments=experiments)
    kinds: dict[Any, list[int]] = {}
    bases = [_tangent_basis(system, params, e) for e in experiments]
    for i, e in enumerate(experiments):
        rest = (e.q0, e.qdot0, e.params, bases[i])
        shapes = [np.shape(x)[1:] for x in jax.tree.leaves(e.values)], [np.shape(x) for x in jax.tree.leaves(rest)]
        kind = e.observe, e.delay, e.events, _unknown_params(e), jax.tree.structure((e.values, rest)), str(shapes)
        kinds.setdefault(kind, []).append(i)
    return tuple(_batch([experiments[i] for i in members], [bases[i] for i in members], members) for members in kinds.values())


def _unknown_params(e):
    return tuple(name for name in e.unknown if name in e.params)


def of_events(e: Any) -> list[bool]:
    """For each leaf of the values of an experiment or a batch, whether it holds times of events."""
    paths = jax.tree_util.tree_flatten_with_path(e.values)[0]
    return [bool(e.events) and path[0].key in e.events for path, _ in paths]


def _batch(experiments, bases, members):
    xnp = numpy_for(experiments, bases)

    def padded(leaves, padding=None):
        longest, leaves = max(map(len, leaves)), [xnp.asarray(x) for x in leaves]
        more = lambda x: xnp.broadcast_to(x[-1] if padding is None else padding, (longest - len(x), *x.shape[1:]))
        return xnp.stack([xnp.concatenate([x, more(x)]) for x in leaves])

    together = lambda trees, padding: jax.tree.map(lambda *leaves: padded(leaves, padding), *trees)
    sigmas = [e.sigma if e.sigma is not None else jax.tree.map(xnp.ones_like, e.values) for e in experiments]
    recorded = padded([e.ts for e in experiments]), together([e.values for e in experiments], jnp.nan), together(sigmas, 1.0)
    arrays, others = eqx.partition([(e.q0, e.qdot0, e.params, basis) for e, basis in zip(experiments, bases, strict=True)], eqx.is_array)
    rest = eqx.combine(jax.tree.map(lambda *leaves: xnp.stack(leaves), *arrays), others[0])
    first = experiments[0]
    kind = first.observe, first.delay, first.events, _unknown_params(first)
    return _distributed(ExperimentBatch(*recorded, *rest, *kind, tuple(members)))


def _distributed(batch):
    """Over all devices, padded with copies of the last experiment so that each device has equally many."""
    if min(len(batch.members), jax.device_count()) == 1:
        return batch
    batch = dataclasses.replace(batch, mesh=all_devices())
    return jax.tree.map(lambda x: _placed(padded(x, batch.mesh.size), batch.mesh) if eqx.is_array(x) else x, batch)


def _placed(tree, mesh):
    """On the devices that use it; where there are several processes, the recordings stay with each, which reads them too."""
    return tree if jax.process_count() > 1 else jax.device_put(tree, NamedSharding(mesh, MEMBERS))


def with_sigma(batch: ExperimentBatch, sigma: PyTree) -> ExperimentBatch:
    """The batch with another `sigma`, on the same devices."""
    return dataclasses.replace(batch, sigma=sigma if batch.mesh is None else _placed(sigma, batch.mesh))


def _tangent_basis(system, params, e):
    """Directions in which the start of an experiment may move: its unknown entries, within the constraints."""
    entries = start_entries(e)
    n = len(entries) // 2
    free = [[i for i in part if any(is_within(entries[i], name) for name in e.unknown)] for part in (range(n), range(n, 2 * n))]
    blocks = [np.eye(2 * n)[:, part] for part in free]
    if system.constraints and any(free):
        params = with_own(params, e.params)
        q, qdot = consistent_state(system, e.q0, e.qdot0, params, t=e.ts[0])
        *jacobians, units = map(np.asarray, at_state(_constraint_jacobians, system, q, qdot, params, e.ts[0]))
        for k, jacobian in enumerate(jacobians):
            columns = np.array(free[k], int) - k * n
            allowed = units[columns, None] * tangent_basis(jacobian[:, columns] * units[columns], float(np.finfo(units.dtype).eps))
            blocks[k] = blocks[k] @ (allowed / np.linalg.norm(allowed, axis=0))
    return np.hstack(blocks).astype(jax.tree.leaves(e.q0)[0].dtype)


def _constraint_jacobians(flat, t, q, v):
    """Of the constraints on positions, and of all constraints on velocities; and units of coordinates in which they weigh alike."""
    G = constraint_rows(flat, t, q, v)[1]
    return position_residual(flat, t, q)[1], G, unit_lengths(inertia(flat, t, q, v).as_matrix(), G)


def map_batch(of_one: Callable[..., Any], batch: ExperimentBatch, z: Any, *common: Any) -> Any:
    """`of_one(e, z, *common)` for each experiment of a batch; each device computes its share of them."""
    arrays, others = eqx.partition(batch, eqx.is_array)
    if len(z) == 1:  # avoids a batch of one
        first = lambda tree: jax.tree.map(lambda x: x[0], tree)
        return jax.tree.map(lambda x: x[None], of_one(eqx.combine(first(arrays), others), z[0], *common))
    numbers, rest = eqx.partition(common, eqx.is_array)
    one = lambda given, numbers: of_one(eqx.combine(given[0], others), given[1], *eqx.combine(numbers, rest))
    mapped = lambda members, numbers: of_each(lambda given: one(given, numbers), members)
    if batch.mesh is None:
        return mapped((arrays, z), numbers)
    found = over_devices(mapped, batch.mesh, (arrays, padded(z, batch.mesh.size)), numbers)
    return jax.tree.map(lambda x: x[: len(z)], found)
