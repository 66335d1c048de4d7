"""Derivatives that are not traced through a computation: none, or those of a root by the implicit function theorem."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend import core
from jaxtyping import Array, Float

from .conditions import one_by_one
from .walker import used_constants


def undifferentiated(function: Callable, in_turn: bool = False) -> Callable:
    """`function` of arrays, which is not differentiated, nor by what it closes over: its derivative is not even traced.

    `in_turn`: a CPU computes the members of a batch one after the other. Functions of LAPACK share theirs among the threads that run them,
    and where as many do that at once as there are threads, each waits for the others for ever (jaxlib 0.10).
    """

    @functools.wraps(function)
    def call(*given):
        if in_turn and jax.default_backend() == "cpu":
            program, closed_over = open_function(function, *given)
            program = one_by_one(program)
        else:
            program, closed_over = jax.closure_convert(function, *given)
        return program(*jax.lax.stop_gradient((*given, *closed_over)))

    return call


def open_function(function: Callable, *given: Any) -> tuple[Callable, list[Array]]:
    """A function of `given` and of all arrays that it closes over, and these arrays, as floats.

    `jax.closure_convert` leaves truth values and integers closed over, and a rule of derivatives must hold none that is traced.
    """
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*given)
    program, used = used_constants(closed)
    run = core.jaxpr_as_fun(core.ClosedJaxpr(program, ()))
    numbers = [jnp.asarray(x) for x in used]
    counts = [jnp.issubdtype(x.dtype, jnp.integer) or jnp.issubdtype(x.dtype, jnp.bool_) for x in numbers]

    def opened(*given_and_more):
        values, more = given_and_more[: len(given)], given_and_more[len(given) :]
        more = [x.astype(like.dtype) if count else x for x, like, count in zip(more, numbers, counts, strict=True)]
        return jax.tree.unflatten(jax.tree.structure(shape), run(*more, *jax.tree.leaves(values)))

    return opened, [x.astype(float) if count else x for x, count in zip(numbers, counts, strict=True)]


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def implicit_root(residual: Callable, change: Callable, args: Any, w: Float[Array, " u"]) -> Float[Array, " u"]:
    """w, which depends on args as residual(args, w) = 0 says: differentiable to any order.

    `change(args, w, R)` is −(∂residual/∂w)⁻¹ R.
    """
    return w


@implicit_root.defjvp
def _implicit_rule(residual, change, primals, tangents):
    (args, found), (d_args, _) = primals, tangents
    w = implicit_root(residual, change, args, found)
    return w, change(args, w, jax.jvp(lambda args: residual(args, w), (args,), (d_args,))[1])
