"""How far a state is off the constraints."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._model.flat import Flat
from .._program.sparse_jacobian import MANY, jacobian
from .lagrange import rows_of, velocity_residual
from .saddle_point import Rows
from .singular_directions import not_affine_in

ROUNDING = 4  # eps, by which a residual may differ from zero beside the terms of its change


class Residuals(NamedTuple):
    """Those of g and ψ = (dg/dt, a), and the rows ∂g/∂q and ∂a/∂q̇."""

    g: Float[Array, " h"]
    psi: Float[Array, " m"]
    of_positions: Rows
    of_velocities: Rows

    @classmethod
    def of(cls, flat: Flat, t, q, v) -> "Residuals":
        """At a state; where there are few coordinates, all of g is computed once."""
        if q.size >= MANY:
            rows = lambda function, x: rows_of(jacobian(function, x)[1])
            of_g, of_a = rows(lambda q: flat.holonomic(t, q), q), rows(lambda v: flat.nonholonomic(t, q, v), v)
            return cls(flat.holonomic(t, q), velocity_residual(flat, t, q, v), of_g, of_a)
        directions, still = jnp.eye(q.size, dtype=q.dtype), jnp.zeros_like(t)
        g, of_g = jax.linearize(flat.holonomic, t, q)
        a, of_a = jax.linearize(lambda v: flat.nonholonomic(t, q, v), v)
        psi = jnp.concatenate([of_g(jnp.ones_like(t), v), a])
        return cls(g, psi, jax.vmap(lambda dq: of_g(still, dq), out_axes=1)(directions), jax.vmap(of_a, out_axes=1)(directions))

    def of_psi(self, size: Callable) -> Float[Array, " m"]:
        """A size of each row of ψ."""
        return jnp.concatenate([size(self.of_positions), size(self.of_velocities)])


def off_constraints(flat: Flat, t, q, v) -> Float[Array, ""]:
    """Largest residual of g and ψ, in the units of its row."""
    found = Residuals.of(flat, t, q, v)
    return jnp.maximum(off(found.g, terms(found.of_positions, q)), off(found.psi, found.of_psi(lambda rows: terms(rows, v))))


def is_on_constraints(flat: Flat, t, q, v) -> Bool[Array, ""]:
    """Whether a state is on the constraints but for rounding, as one that was computed is: row by row, in its units and those of q and q̇.

    False where velocities follow from dissipation, and where L is not finite.
    """
    if flat.massless:
        return jnp.array(False)
    found, rounding = Residuals.of(flat, t, q, v), ROUNDING * jnp.finfo(q.dtype).eps
    on_positions = jnp.abs(found.g) <= rounding * (abs(found.of_positions) @ jnp.abs(q))
    on_velocities = jnp.abs(found.psi) <= rounding * found.of_psi(lambda rows: abs(rows) @ jnp.abs(v))
    is_affine, is_defined = ~not_affine_in(flat, t, q, v), jnp.isfinite(flat.lagrangian(t, q, v))
    return jnp.all(on_positions) & jnp.all(on_velocities) & jnp.all(is_affine) & is_defined


def terms(rows: Rows, x: Float[Array, " n"]) -> Float[Array, " m"]:
    """The size of the terms of each row, of coordinates of at least one: those that it does not touch have no part in it."""
    return abs(rows) @ (1 + jnp.abs(x))


def off(residual: Float[Array, " m"], size: Float[Array, " m"]) -> Float[Array, ""]:
    """Largest residual, beside the size of the terms of its row: rounding makes some eps of it."""
    each = jnp.abs(residual) / jnp.where(size > 0, size, 1)
    return jnp.where(jnp.any(jnp.isnan(each)), jnp.nan, jnp.max(each, initial=0.0))  # a maximum of thousands leaves NaN out on a CPU
