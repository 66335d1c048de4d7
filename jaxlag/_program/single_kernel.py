"""Long programs with few inputs and outputs, each compiled into one kernel.

On a CPU, XLA calls fused kernels one by one, at some 0.15 µs each, but compiles a loop into one kernel if an iteration reads and writes
less than 1 kB. So a long program with few inputs and outputs is put into a loop of its own with a single iteration; and so is a short
one among the stages of a step that together have too many numbers for such a loop.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .walker import count_equations

# Operations. Two links with one variation have 311, and take a seventh of the time; the vehicle has 206, and would take over twice as long.
MIN_OPERATIONS = 300
# The leading size of the result. From here on the stages of a step are too large for one kernel: 8 coordinates take 42 µs a step
# against 4.5.
MIN_ROWS = 16
MAX_BYTES = 1024  # bytes, in and out


def in_one_kernel(function: Callable) -> Callable:
    """`function` with its program in a loop of one iteration, where that pays. Reverse mode is not supported."""

    def wrapped(*given):
        value = eqx.filter_eval_shape(function, *given)
        pays = _bytes((given, value)) <= MAX_BYTES and (_leading_size(value) >= MIN_ROWS or _is_long(function, *given))
        if jax.default_backend() != "cpu" or not pays:  # a GPU would ask its host after each iteration whether there is another
            return function(*given)
        return _single_iteration_loop(lambda: function(*given), value, given)

    return wrapped


def _single_iteration_loop(run: Callable, like: Any, given: Any) -> Any:
    """run() in a loop of one iteration, which the compiler cannot know: a number is equal to itself unless it is NaN."""
    number = next(jnp.ravel(x)[0] for x in jax.tree.leaves(given) if eqx.is_inexact_array(x) and x.size)
    start = jax.tree.map(lambda s: jnp.full(s.shape, jnp.nan, s.dtype), like)
    return jax.lax.while_loop(lambda state: state[0], lambda _: (jnp.array(False), run()), (number == number, start))[1]


def _bytes(tree: Any) -> int:
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(tree) if eqx.is_array(x) or isinstance(x, jax.ShapeDtypeStruct))


def _leading_size(tree: Any) -> int:
    return max(x.shape[0] if x.ndim else 1 for x in jax.tree.leaves(tree))


def _is_long(function: Callable, *given: Any) -> bool:
    arrays, static = eqx.partition(given, eqx.is_array)
    return count_equations(jax.make_jaxpr(lambda arrays: function(*eqx.combine(arrays, static)))(arrays).jaxpr) >= MIN_OPERATIONS
