"""Vectors and matrices in space, converted and checked."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def check_rotation(R: Any, name: str) -> Float[Array, "3 3"]:
    """A rotation matrix, checked for right-handed orthogonal unit vectors as columns, as far as its numbers are known."""
    seen, R = known(R), floating(R)
    if R.shape != (3, 3):
        raise ValueError(
            f"{name} must be a rotation matrix of shape (3, 3), but has shape {R.shape}. Make it by `rigid.euler` or the like."
        )
    if seen is not None:
        off = np.max(np.abs(seen.T @ seen - np.eye(3)))
        if not off < 1e2 * float(jnp.finfo(R.dtype).eps) ** 0.5:
            raise ValueError(f"{name} must be a rotation, but its columns are off orthogonal unit vectors by {off:.2g}. Divide by lengths.")
        if np.linalg.det(seen) < 0:
            raise ValueError(f"{name} must be a rotation, but is a reflection: its determinant is −1. Turn one of its axes round.")
    return R


def skew(a: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """[a]×, the matrix of the cross product a × …"""
    x, y, z = a
    zero = jnp.zeros_like(x)
    return jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])


def one(like: Array) -> Float[Array, "3 3"]:
    """The unit matrix, in the precision of another array."""
    return jnp.eye(3, dtype=like.dtype)


def known(x: Any) -> np.ndarray | None:
    """Numbers as a concrete array; None if they are traced."""
    return None if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(x)) else np.asarray(x, float)


def floating(x: Any) -> Array:
    """Numbers as an array of floating-point numbers, in the precision they have."""
    x = jnp.asarray(x)
    return x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(float)


def moving(function: Callable, q: Any, qdot: Any) -> tuple[Any, Any]:
    """A function of q and its rate."""
    given = [jax.tree.map(floating, tree) for tree in (q, qdot)]
    return jax.jvp(function, given[:1], given[1:])


def vector(x: Any, name: str, size: int = 3) -> Array:
    """A vector of `size` numbers, checked."""
    x = floating(x)
    if x.shape != (size,):
        raise ValueError(f"`{name}` must be {size} numbers, but has shape {x.shape}. Write them as an array of shape ({size},).")
    return x
