"""Derivatives that are not traced through a computation: none, or those of a root by the implicit function theorem."""

import functools
from collections.abc import Callable
from typing import Any

import jax
from jaxtyping import Array, Float


def undifferentiated(function: Callable) -> Callable:
    """`function` of arrays, which is not differentiated, nor by what it closes over: its derivative is not even traced."""

    @functools.wraps(function)
    def call(*given):
        converted, closed_over = jax.closure_convert(function, *given)
        return converted(*jax.lax.stop_gradient((*given, *closed_over)))

    return call


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
