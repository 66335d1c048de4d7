"""A whole loop in one kernel: a CPU runs it like compiled C, instead of calling some hundred kernels a turn.

XLA compiles a loop into one kernel by itself if a turn reads and writes less than 1 kB. Larger ones it compiles likewise where the call
of a program says so. That is asked for where the program is of a kind that such a kernel may hold: nothing in it calls a library. Two
more conditions are met by a choice that the compiler cannot foresee: it uses every argument, and what depends on it is not spread over
threads.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from jaxtyping import Array, Float

from .conditions import one_by_one
from .walker import called_program, count_equations
from .without_libraries import is_scattered, without_libraries, without_scatters

try:
    from jax.experimental.xla_metadata import set_xla_metadata
except ImportError:  # a version of JAX without it runs the loop kernel by kernel
    set_xla_metadata = None  # type: ignore[assignment]

ELEMENTWISE = (
    "abs acos acosh add add_any and asin asinh atan atan2 atanh bitcast_convert_type cbrt ceil clamp convert_element_type copy cos cosh "
    "div eq erf erf_inv exp exp2 expm1 floor ge gt integer_pow is_finite le log log1p logistic lt lt_to max min mul ne neg nextafter not "
    "or pow reduce_precision rem round rsqrt select_n shift_left shift_right_arithmetic shift_right_logical sign sin sinh sqrt square "
    "stop_gradient sub tan tanh xor"
)
STRUCTURE = (
    "argmax argmin broadcast_in_dim concatenate dot_general dynamic_slice dynamic_update_slice gather iota nonbatchable "
    "optimization_barrier pad platform_index reduce_and reduce_max reduce_min reduce_or reduce_prod reduce_sum reshape rev slice split "
    "squeeze stack transpose scatter scatter-add"
)
CALLS = "closed_call cond core_call custom_jvp_call custom_linear_solve custom_vmap_call jit pjit scan while"
SUMS = frozenset(("dot_general", "reduce_and", "reduce_max", "reduce_min", "reduce_or", "reduce_prod", "reduce_sum"))
MOST_TERMS = 4095  # of a sum: more of them XLA leaves to a library; products of matrices far later
MOST_EQUATIONS = 12000  # one kernel of 6,000 takes 3 s to compile, one of 60,000 a minute, where many take 14 s
ALLOWED = frozenset(f"{ELEMENTWISE} {STRUCTURE} {CALLS}".split())


def in_whole_kernel(function: Callable) -> Callable:
    """`function(given, result) -> result` of vectors of any length, compiled into one kernel where a CPU can; otherwise as it is.

    It writes into `result` in place. Where the first number given is NaN, so are the results. Members of a batch run one after the other.
    Where it is differentiated, the program within is.
    """

    def wrapped(given: Float[Array, " n"], result: Float[Array, " m"]) -> Float[Array, " m"]:
        program = jax.make_jaxpr(function)(given, result)
        written_out = _without_libraries(program)
        run = lambda given, result: core.jaxpr_as_fun(program)(given, result)[0]
        if set_xla_metadata is None or jax.default_backend() != "cpu" or not _is_allowed(written_out):
            return run(given, result)

        def chosen(given, result):
            is_number = given[0] == given[0]  # unless it is NaN
            inside = lambda given, result: core.jaxpr_as_fun(written_out)(given, result)[0]
            return jax.lax.cond(is_number, inside, lambda given, result: jnp.full_like(result, jnp.nan), given, result)

        @jax.custom_jvp
        @one_by_one
        def call(given, result):
            unknown = jax.lax.optimization_barrier((given, result))  # a constant would be moved into the program, its argument be unused
            return set_xla_metadata(jax.jit(chosen)(*unknown), inlineable="false", xla_cpu_small_call="true")

        call.defjvp(lambda primals, tangents: jax.jvp(run, primals, tangents))
        return call(given, result)

    return wrapped


def _without_libraries(program):
    """The program, with its small matrices written out where it is not so long that one kernel of it takes longer to compile than all."""
    return (without_libraries if count_equations(program) <= MOST_EQUATIONS else without_scatters)(program)


def _is_allowed(program) -> bool:
    """Whether such a kernel can hold it; closed-over arrays would be further arguments."""
    closed_over = any(isinstance(x, jax.core.Tracer) for x in program.consts)
    fits = lambda e: e.primitive.name in ALLOWED and _terms(e) <= MOST_TERMS and not (_is_product_of_matrices(e) or is_scattered(e))
    return not closed_over and all(map(fits, _lowered(program)))


def _is_product_of_matrices(equation) -> bool:
    """Whether XLA may leave it to a library, however small it is; not a product with a vector."""
    if equation.primitive.name != "dot_general":
        return False
    of_both = zip(*equation.params["dimension_numbers"], strict=True)  # contracted and batch dimensions of each
    free = [np.delete(x.aval.shape, [*contracted, *batch]) for x, (contracted, batch) in zip(equation.invars, of_both, strict=True)]
    return all(np.prod(sizes) > 1 for sizes in free)


def _terms(equation) -> int:
    """How many numbers a sum or a product of matrices adds up."""
    if equation.primitive.name not in SUMS:
        return 0
    size = equation.invars[0].aval.size
    if equation.primitive.name != "dot_general":
        return size
    (contracted, _), (batch, _) = equation.params["dimension_numbers"]
    left = math.prod(equation.invars[0].aval.shape[i] for i in (*contracted, *batch))
    return size * equation.invars[1].aval.size // max(left, 1)


def _lowered(program: Any) -> Iterator[Any]:
    """All equations that are lowered; of a solve, and of a function with a derivative rule, these are its own alone."""
    for equation in getattr(program, "jaxpr", program).eqns:
        yield equation
        if equation.primitive.name in ("custom_linear_solve", "custom_jvp_call"):
            yield from _lowered(called_program(equation))
            continue
        for value in equation.params.values():
            for part in value if isinstance(value, (tuple, list)) else [value]:
                if hasattr(part, "eqns") or hasattr(part, "jaxpr"):
                    yield from _lowered(part)
