"""Members of a batch, spread over the devices of one computer or of several.

Several processes (`jax.distributed.initialize`) run one program: each makes the same calls with the same arguments, computes the members
of its own devices, and gets the whole result.
"""

import functools
import zlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, PyTree

from .._program.jit import is_concrete

MEMBERS = PartitionSpec("members")
SHARED = PartitionSpec()


def all_devices() -> Mesh:
    """The devices of all processes, along one axis."""
    return Mesh(np.array(jax.devices()), "members")


def padded(leaf: Array, size: int) -> Array:
    """With copies of the last member, to a multiple of a size."""
    return jnp.concatenate([leaf, jnp.repeat(leaf[-1:], -len(leaf) % size, axis=0)])


def of_each(function: Callable, members: PyTree) -> PyTree:
    """`function` of each member, each with steps of its own.

    In turn on a CPU, where in a batch all would go on until the slowest has ended, and pay for both branches of every choice.
    """
    return jax.lax.map(function, members) if jax.default_backend() == "cpu" else jax.vmap(function)(members)


def over_devices(function: Callable, mesh: Mesh, members: PyTree, *shared: PyTree) -> PyTree:
    """`function(members, *shared)`, each device with its part of the members, a multiple of the number of devices."""
    specs = (MEMBERS, *(SHARED for _ in shared))
    of_devices = jax.shard_map(function, mesh=mesh, in_specs=specs, out_specs=MEMBERS, check_vma=False)
    if jax.process_count() == 1:
        return of_devices(members, *shared)
    whole = functools.partial(jax.lax.with_sharding_constraint, shardings=NamedSharding(mesh, SHARED))  # what each process can read
    return whole(of_devices(whole(members), *shared))  # the derivatives by members, too


def check_agreement(**arguments: Any) -> None:
    """Raises where processes were given different numbers, of which each would compute its part, and none would see it.

    Arguments without numbers (under a transformation), and arrays that all processes hold together, are one by construction.
    """
    if jax.process_count() == 1 or not is_concrete(arguments):
        return
    sums = np.array([_checksum(argument) for argument in arguments.values()], np.uint32)
    differs = np.ptp(multihost_utils.process_allgather(sums).astype(np.int64), axis=0) != 0
    if np.any(differs):
        name = list(arguments)[int(np.argmax(differs))]
        raise ValueError(
            f"`{name}` must be the same in every process, but differs. Give all of them to each; each computes the part of its devices."
        )


def _checksum(argument):
    whole = [leaf for leaf in jax.tree.leaves(argument) if not isinstance(leaf, jax.Array) or leaf.is_fully_addressable]
    numbers = [np.asarray(leaf) for leaf in whole if isinstance(leaf, (jax.Array, np.ndarray, np.generic, int, float))]
    return zlib.crc32(b"".join(str((x.shape, x.dtype)).encode() + x.tobytes() for x in numbers))
