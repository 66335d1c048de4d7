"""Conditions that stay conditions in a batch, and what they keep apart."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


@jax.custom_batching.custom_vmap
def everywhere(condition: Bool[Array, ""]) -> Bool[Array, ""]:
    """A condition; in a batch, whether it holds for all members, so that a `cond` on it stays one and not the work of both branches."""
    return condition


@everywhere.def_vmap
def _for_all_members(axis_size, in_batched, conditions):
    return everywhere(jnp.all(conditions)), False


@jax.custom_jvp
def computed_first(tree: Any, number: Float[Array, ""]) -> Any:
    """`tree`, which is computed before anything that uses it; `number` is any that the compiler does not know.

    On a CPU, XLA joins what computes numbers and what uses them in one kernel. Where two parts of such a kernel see the numbers in other
    places, as slices of them do, each computes anew what both share, and what they share does likewise: a long chain of operations takes
    twice the time at each of its links. A branch ends a kernel; a barrier alone is gone before kernels are made.
    """
    if jax.default_backend() != "cpu":
        return tree
    return jax.lax.cond(everywhere(number == number), lambda tree: tree, jax.lax.optimization_barrier, tree)


@computed_first.defjvp
def _unchanged(primals, tangents):
    """Changes go past the branch, in which those that nothing asks for would be zeros, and NaN beside a state that was not reached."""
    return computed_first(*primals), tangents[0]
