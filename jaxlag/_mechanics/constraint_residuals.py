"""How far a state is off the constraints."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._model.flat import Flat
from .._program.size_of_terms import size_of_terms
from .._program.sparse_jacobian import MANY, jacobian
from .augmented_inertia import alike
from .lagrange import inertia, rows_of, velocity_residual
from .saddle_point import Rows
from .singular_directions import not_affine_in

ROUNDING = 4  # eps, by which a residual may differ from zero relative to the terms of its change


class Residuals(NamedTuple):
    """Residuals g and ψ = (dg/dt, a), and the rows ∂g/∂q and ∂a/∂q̇."""

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

    def of_psi(self, x: Callable) -> Float[Array, " m"]:
        """Something of the rows of ψ."""
        return jnp.concatenate([x(self.of_positions), x(self.of_velocities)])


def off_constraints(flat: Flat, t, q, v, reach: tuple[Array, Array] | None = None) -> Float[Array, ""]:
    """Largest residual of g and ψ relative to the terms of its row, for coordinates and velocities as large as they are, or
    in a motion as they `reach`.
    """
    found, M = Residuals.of(flat, t, q, v), inertia(flat, t, q, v)
    G = [rows for rows in (found.of_positions, found.of_velocities) if rows.shape[0]]
    of_q, of_v = (alike(M, G, size) for size in ((jnp.abs(q), jnp.abs(v)) if reach is None else reach))
    of_g = abs(found.of_positions) @ of_q + terms(flat, t, q)
    of_psi = found.of_psi(lambda rows: abs(rows) @ of_v) + jnp.abs(found.psi - found.of_psi(lambda rows: rows @ v))
    return jnp.maximum(off(found.g, of_g), off(found.psi, of_psi))


def terms(flat: Flat, t, q) -> Float[Array, " h"]:
    """The size of the terms that cancel in g, where q itself may be zero: of y − l (1 − cos φ) some l."""
    return size_of_terms(lambda q: flat.holonomic(t, q), q)


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


def off(residual: Float[Array, " m"], size: Float[Array, " m"]) -> Float[Array, ""]:
    """Largest residual, relative to the size of the terms of its row: rounding makes some eps of it."""
    each = jnp.where(residual == 0, 0, jnp.abs(residual) / size)
    return jnp.where(jnp.any(jnp.isnan(each)), jnp.nan, jnp.max(each, initial=0.0))  # a maximum of thousands leaves NaN out on a CPU
