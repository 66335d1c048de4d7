"""Conditions that stay conditions in a batch, loops whose condition is one there, and what conditions keep apart."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.custom_batching
import jax.numpy as jnp
from jax.extend import core
from jaxtyping import Array, Bool, Float


def zeros_like(shapes: Any) -> Any:
    """Zeros in the shapes of a pytree, as `jax.eval_shape` gives them."""
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)


@jax.custom_batching.custom_vmap
def everywhere(condition: Bool[Array, ""]) -> Bool[Array, ""]:
    """A condition; in a batch, whether it holds for all members, so that a `cond` on it stays one and not the work of both branches."""
    return condition


@everywhere.def_vmap
def _for_all_members(axis_size, in_batched, conditions):
    return everywhere(jnp.all(conditions)), False


def one_by_one(function: Callable) -> Callable:
    """`function`, which a batch computes for one member after the other.

    JAX's own finds nothing to go through where derivatives have members and what they are taken of has none.
    """
    call = jax.custom_batching.sequential_vmap(function)
    through_members = call.vmap_rule

    @call.def_vmap
    def _once_or_through_members(axis_size, in_batched, *given):
        if any(jax.tree.leaves(in_batched)):
            return through_members(axis_size, in_batched, *given)
        found = function(*given)
        return found, jax.tree.map(lambda _: False, found)

    return call


def one_of(index: Any, branches: Sequence[Callable], state: Any) -> Any:
    """`branches[index](state)`, the state again, in which each branch changes something.

    `jax.lax.switch` does the same, but each of its branches copies all that it returns, also what it leaves as it was. Here each branch is
    a condition of its own, for what it changes alone: of a bouncing ball's program a quarter of the copies is left.
    """
    leaves, structure = jax.tree.flatten(state)
    for i, branch in enumerate(branches):
        program = jax.make_jaxpr(lambda *leaves, branch=branch: jax.tree.leaves(branch(jax.tree.unflatten(structure, leaves))))(*leaves)
        given, found = program.jaxpr.invars, program.jaxpr.outvars
        changed = [k for k, (old, new) in enumerate(zip(given, found, strict=True)) if old is not new]

        def after(leaves, program=program, changed=changed):
            found = core.jaxpr_as_fun(program)(*leaves)
            return [jnp.asarray(found[k], leaves[k].dtype) for k in changed]

        before = lambda leaves, changed=changed: [leaves[k] for k in changed]
        for k, new in zip(changed, jax.lax.cond(index == i, after, before, leaves), strict=True):
            leaves[k] = new
    return jax.tree.unflatten(structure, leaves)


def repeated(turn: Callable, start: Any, going_on: Callable, begins: Bool[Array, ""] | bool = True) -> Any:
    """`start` after one turn, if it `begins` at all, and after as many more as it is `going_on`, which is decided within the turn.

    In a batch `while_loop` computes its condition in two places: whether any member goes on, and which. Where it is more than a comparison
    of what is carried, rounding may differ between the two, and a loop in which one says yes and the other no runs for ever.
    """

    def turned(carry):
        after = turn(carry[1])
        return going_on(after), after

    return jax.lax.while_loop(lambda carry: carry[0], turned, (jnp.asarray(begins), start))[1]


def halved(is_good: Callable, least: float, dtype: Any) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """The largest of 1, ½, ¼, … that is good, and whether there is one: the last that is tried is not above the `least`."""
    turn = lambda carry: (carry[0] / 2, is_good(carry[0] / 2))
    return repeated(turn, (jnp.full((), 2, dtype), jnp.array(False)), lambda carry: ~carry[1] & (carry[0] > least))


@jax.custom_jvp
def computed_first(tree: Any, number: Float[Array, ""]) -> Any:
    """`tree`, which is computed before anything that uses it; `number` is any that the compiler does not know.

    On a CPU, XLA joins what computes numbers and what uses them in one kernel. Where two parts of such a kernel see the numbers in other
    places, as slices of them do, each computes anew what both share, and what they share does likewise: a long chain of operations takes
    twice the time at each of its links. A branch ends a kernel; a barrier alone is gone before kernels are made.
    """
    return computed_first_with_changes(tree, number)


def computed_first_with_changes(tree: Any, number: Float[Array, ""]) -> Any:
    """The same, with the derivatives of `tree`, which are computed before anything that uses them, too."""
    if jax.default_backend() != "cpu":
        return tree
    return jax.lax.cond(everywhere(number == number), lambda tree: tree, jax.lax.optimization_barrier, tree)


@computed_first.defjvp
def _unchanged(primals, tangents):
    """Changes go past the branch, in which those that nothing asks for would be zeros, and NaN beside a state that was not reached."""
    return computed_first(*primals), tangents[0]
