"""How far a state is off the constraints."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._model.flat import Flat
from .._program.sparse_jacobian import MANY, jacobian
from .._program.sparse_matrix import row_sums
from .lagrange import rows_of, velocity_residual
from .singular_directions import not_affine_in

ROUNDING = 4  # eps of the largest number of a state


class Residuals(NamedTuple):
    """Those of g and ψ, and the sum of the sizes of what each row multiplies."""

    g: Float[Array, " h"]
    psi: Float[Array, " m"]
    of_positions: Float[Array, " h"]
    of_velocities: Float[Array, " m"]

    @classmethod
    def of(cls, flat: Flat, t, q, v) -> "Residuals":
        """At a state."""
        if q.size >= MANY:
            rows = lambda function, x: row_sums(rows_of(jacobian(function, x)[1]))
            g, psi, G = flat.holonomic(t, q), velocity_residual(flat, t, q, v), rows(lambda q: flat.holonomic(t, q), q)
            return cls(g, psi, G, jnp.concatenate([G, rows(lambda v: flat.nonholonomic(t, q, v), v)]))
        directions, still = jnp.eye(q.size, dtype=q.dtype), jnp.zeros_like(t)
        g, along = jax.linearize(flat.holonomic, t, q)
        a, along_v = jax.linearize(lambda v: flat.nonholonomic(t, q, v), v)
        G = row_sums(jax.vmap(lambda dq: along(still, dq), out_axes=1)(directions))
        A = row_sums(jax.vmap(along_v, out_axes=1)(directions))
        return cls(g, jnp.concatenate([along(jnp.ones_like(t), v), a]), G, jnp.concatenate([G, A]))


def off_constraints(flat: Flat, t, q, v) -> Float[Array, ""]:
    """Largest residual of g and ψ, in the units of its row."""
    found = Residuals.of(flat, t, q, v)
    return jnp.maximum(off(found.g, found.of_positions, q), off(found.psi, found.of_velocities, v))


def is_on_constraints(flat: Flat, t, q, v) -> Bool[Array, ""]:
    """Whether a state is on the constraints but for rounding, as one that was computed is, and no velocity follows from dissipation."""
    if flat.massless:
        return jnp.array(False)
    found, unit = Residuals.of(flat, t, q, v), lambda x: ROUNDING * jnp.finfo(x.dtype).eps * jnp.max(jnp.abs(x))
    within = jnp.all(jnp.abs(found.g) <= found.of_positions * unit(q)) & jnp.all(jnp.abs(found.psi) <= found.of_velocities * unit(v))
    return within & ~jnp.any(not_affine_in(flat, t, q, v))


def off(residual, rows, x):
    """Largest residual, in the units of its row, by the sums of them: rounding makes some eps of it."""
    size = rows * (1 + jnp.max(jnp.abs(x)))
    return jnp.max(jnp.abs(residual) / jnp.where(size > 0, size, 1), initial=0.0)
