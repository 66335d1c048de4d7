"""Numbers without a derivative, which is NaN and not silently zero."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Num, PyTree


def without_derivative(x: Num[Array, "..."], of: PyTree) -> Num[Array, "..."]:
    """x, which depends on `of` in a way that is not differentiated: its derivative is NaN."""
    return _without_derivative(x, [leaf for leaf in jax.tree.leaves(of) if jnp.issubdtype(getattr(leaf, "dtype", int), jnp.inexact)])


@jax.custom_jvp
def _without_derivative(x: Num[Array, "..."], of: Sequence[Any]) -> Num[Array, "..."]:
    return x


@_without_derivative.defjvp
def _rule(primals: Any, tangents: Any) -> Any:
    return primals[0], jnp.full_like(primals[0], jnp.nan) * sum(jnp.sum(jnp.real(d)) for d in tangents[1])
