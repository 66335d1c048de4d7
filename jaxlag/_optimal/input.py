"""The input that was found: polynomials between the nodes."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .radau import interpolation, points


def is_called(error: TypeError) -> bool:
    """Whether a function failed because it calls an input, `u(t)`, that was given as a number."""
    return "not callable" in str(error)


class Held(eqx.Module):
    """An input at one instant, as a signal."""

    value: Float[Array | np.ndarray, "..."]

    def __call__(self, t: ArrayLike) -> Float[Array, "..."]:
        """The value, at any time."""
        return jnp.asarray(self.value)


class Piecewise(eqx.Module):
    """An input as a signal `u(t)`: between two nodes the polynomial through its values at Radau's points; beyond the ends as there.

    **Fields:** `start`, `duration`; `values`: (intervals, points of an interval, ...).
    """

    start: Float[Array | np.ndarray, ""]
    duration: Float[Array | np.ndarray, ""]
    values: Float[Array | np.ndarray, "N s ..."]

    def __call__(self, t: ArrayLike) -> Float[Array, "..."]:
        """u(t)."""
        N, s = self.values.shape[:2]
        at = jnp.clip((jnp.asarray(t) - self.start) / self.duration, 0, 1) * N
        k = jnp.clip(jnp.floor(at).astype(int), 0, N - 1)
        return jnp.tensordot(jnp.stack(interpolation(points(s), at - k)), jnp.asarray(self.values)[k], axes=1)
