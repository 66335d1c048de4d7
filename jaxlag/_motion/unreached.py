"""Samples that a motion does not have are NaN; their derivatives are infinite, or zero where the samples do not matter.

With NaN as derivatives a loss that leaves such samples out would have no gradient: zero times NaN is NaN. With zeros a loss that is NaN
would seem to be stationary. So a change of them is multiplied by the largest number, twice: nothing stays nothing, all else is infinite.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def nan_unless(there: Bool[Array, "..."], x: Float[Array, "..."]) -> Float[Array, "..."]:
    """x where it is there, NaN elsewhere."""
    factor = jnp.where(there, 1, jnp.finfo(x.dtype).max).astype(x.dtype)
    return x * factor * factor + jnp.where(there, 0, jnp.nan).astype(x.dtype)


def with_unreached(change: Any, y: Any, dx: Float[Array, "p ..."]) -> Any:
    """The change of y with dx, infinite where y is NaN and dx is not zero; further axes of dx are the last of y."""
    combined = jnp.tensordot(jnp.cos(jnp.arange(len(dx), dtype=dx.dtype)), dx, 1)  # of these no rational combination is zero

    def of_leaf(change, y):
        factor = jnp.where(jnp.isnan(y), jnp.finfo(y.dtype).max, 0).astype(y.dtype)
        return change + jnp.broadcast_to(combined, y.shape) * factor * factor

    return jax.tree.map(of_leaf, change, y)


def rows_reached(J: Float[Array, "*shape p"], y: Float[Array, "*shape"]) -> Float[Array, "*shape p"]:
    """The Jacobian of y, zero where y is NaN."""
    return jnp.where(jnp.isnan(y)[..., None], 0, J)
