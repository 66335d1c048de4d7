"""Long programs of few numbers as one kernel each.

On a CPU, XLA runs what it has fused as kernels that are called one by one, at some 0.15 µs each, but compiles a loop whole if one turn
of it reads and writes less than 1 kB. So a long program with few numbers in and out is put into a loop of its own, which turns once.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

# Operations. Two links with one variation have 334, and take a seventh of the time; the vehicle has 206, and would take over twice as long.
LONG = 320
SMALL = 1024  # bytes, in and out


def in_one_kernel(function: Callable) -> Callable:
    """`function` with its program in a loop that turns once, where that pays. It is not for reverse mode."""

    def turned(*given):
        value = eqx.filter_eval_shape(function, *given)
        if _bytes((given, value)) > SMALL or not _is_long(function, *given):
            return function(*given)
        return _once(lambda: function(*given), value, given)

    return turned


def _once(run: Callable, like: Any, given: Any) -> Any:
    """run() in a loop that turns once, which the compiler cannot know: a number is equal to itself unless it is NaN."""
    number = next(jnp.ravel(x)[0] for x in jax.tree.leaves(given) if eqx.is_inexact_array(x) and x.size)
    start = jax.tree.map(lambda s: jnp.full(s.shape, jnp.nan, s.dtype), like)
    return jax.lax.while_loop(lambda state: state[0], lambda _: (jnp.array(False), run()), (number == number, start))[1]


def _bytes(tree: Any) -> int:
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(tree) if eqx.is_array(x) or isinstance(x, jax.ShapeDtypeStruct))


def _is_long(function: Callable, *given: Any) -> bool:
    """Whether it is worth a loop: never on a GPU, which would ask its host at each turn whether there is another."""
    if jax.default_backend() != "cpu":
        return False
    arrays, static = eqx.partition(given, eqx.is_array)
    return _length(jax.make_jaxpr(lambda arrays: function(*eqx.combine(arrays, static)))(arrays).jaxpr) >= LONG


def _length(jaxpr: Any) -> int:
    """Its operations, those of programs within it included."""
    is_program = lambda x: hasattr(x, "eqns") or hasattr(x, "jaxpr")
    parts = lambda equation: filter(is_program, jax.tree.leaves(list(equation.params.values()), is_leaf=is_program))
    return sum(1 + sum(_length(getattr(part, "jaxpr", part)) for part in parts(equation)) for equation in jaxpr.eqns)
