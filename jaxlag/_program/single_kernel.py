"""Long programs of few numbers as one kernel each.

On a CPU, XLA runs what it has fused as kernels that are called one by one, at some 0.15 µs each, but compiles a loop whole if one turn
of it reads and writes less than 1 kB. So a long program with few numbers in and out is put into a loop of its own, which turns once;
and so is a short one among the stages of a step that are together too many numbers for a small loop.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .rules import primitives

# Operations. Two links with one variation have 334, and take a seventh of the time; the vehicle has 206, and would take over twice as long.
LONG = 320
WIDE = 16  # rows of the result. From here on the stages of a step are no small loop: 8 coordinates take 42 µs a step against 4.5
SMALL = 1024  # bytes, in and out


def in_one_kernel(function: Callable) -> Callable:
    """`function` with its program in a loop that turns once, where that pays. It is not for reverse mode."""

    def turned(*given):
        value = eqx.filter_eval_shape(function, *given)
        pays = _bytes((given, value)) <= SMALL and (_rows(value) >= WIDE or _is_long(function, *given))
        if jax.default_backend() != "cpu" or not pays:  # a GPU would ask its host at each turn whether there is another
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


def _rows(tree: Any) -> int:
    return max(x.shape[0] if x.ndim else 1 for x in jax.tree.leaves(tree))


def _is_long(function: Callable, *given: Any) -> bool:
    arrays, static = eqx.partition(given, eqx.is_array)
    return length(jax.make_jaxpr(lambda arrays: function(*eqx.combine(arrays, static)))(arrays).jaxpr) >= LONG


def length(jaxpr: Any) -> int:
    """Its operations, those of programs within it included."""
    return sum(1 for _ in primitives(jaxpr))
