"""Bounds of a polynomial path and of its rates from one time to another: by its coefficients of Bernstein's polynomials there.

Source: Farouki, Computer Aided Geometric Design 29 (2012) 379, sections 3 and 4.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

DEGREE = 8  # of a path at most; its values at as many Chebyshev nodes and one more tell it
NODES = (1 - np.cos(np.pi * np.arange(DEGREE + 1) / DEGREE)) / 2
EVERY = np.arange(DEGREE + 1)
BASIS = np.array([[math.comb(DEGREE, k) * s**k * (1 - s) ** (DEGREE - k) for k in EVERY] for s in NODES])
TO_COEFFICIENTS = np.linalg.inv(BASIS)
ROUNDING = 100  # of the coefficients, of which the conversion makes up to 20 of the values

Interval = tuple[Array, Array]


class PathBounds(NamedTuple):
    """y at the start, and the coefficients of its change."""

    start: Any
    end: Any
    y: Float[Array, " y"]
    coefficients: Float[Array, "k y"]

    @classmethod
    def of(cls, path: Callable, start, end) -> "PathBounds":
        """Those of a path from one time to another, as a function of the share of the time between them: from 0 to 1, however late."""
        y = path(jnp.zeros((), jnp.result_type(start)))
        changes = jax.vmap(lambda share: path(share) - y)(NODES.astype(y.dtype))
        return cls(start, end, y, jnp.sum(TO_COEFFICIENTS.astype(y.dtype)[:, :, None] * changes[None], axis=1))

    def between(self, low, high) -> tuple[Interval, Interval, Interval]:
        """Bounds of y, of its rates and of theirs from one time to another within."""
        length = jnp.where(self.end == self.start, 1, self.end - self.start)
        a, b = ((t - self.start) / length for t in (low, high))
        part = _until((b - a) / jnp.where(a == 1, 1, 1 - a), _from(a, self.coefficients))
        duration = jnp.where(high == low, 1, high - low)
        slope = DEGREE * jnp.diff(part, axis=0) / duration
        curvature = (DEGREE - 1) * jnp.diff(slope, axis=0) / duration
        rounding = ROUNDING * jnp.finfo(part.dtype).eps * jnp.max(jnp.abs(self.coefficients), axis=0)
        of_y, of_rates, of_curvature = ((jnp.min(x, axis=0), jnp.max(x, axis=0)) for x in (part, slope, curvature))
        return (self.y + of_y[0] - rounding, self.y + of_y[1] + rounding), of_rates, of_curvature


def _from(s, coefficients):
    """Those from s to 1 (de Casteljau)."""

    def turn(r, b):
        return jnp.where((DEGREE - r >= EVERY.astype(r.dtype))[:, None], (1 - s) * b + s * jnp.roll(b, -1, axis=0), b)

    return jax.lax.fori_loop(1, DEGREE + 1, turn, coefficients)


def _until(s, coefficients):
    """Those from 0 to s."""

    def turn(r, b):
        return jnp.where((r <= EVERY.astype(r.dtype))[:, None], (1 - s) * jnp.roll(b, 1, axis=0) + s * b, b)

    return jax.lax.fori_loop(1, DEGREE + 1, turn, coefficients)
