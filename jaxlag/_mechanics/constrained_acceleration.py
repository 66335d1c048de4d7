"""Acceleration and multipliers of a state: Lagrange's equations of the first kind, solved."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Bool, Float

from .._model.flat import Flat
from .._program.sparse_matrix import dense, with_rows_alone
from .augmented_inertia import augmented
from .lagrange import applied_force, inertia, inertial_force, velocity_residual, velocity_rows
from .massless import inertial_part, with_first_order_rates, without_inertia
from .pseudo_inverse import Constraints
from .saddle_point import SaddlePoint, Sound, reach_of, saddle_point, saddle_point_beside
from .self_consistent import others, self_consistent
from .sliders import are_of_sliders


class Impulse(NamedTuple):
    """An impact:  M (q̇⁺ − q̇) = Gᵀ(Λ + given) + force(Λ),  ψ(q̇⁺) = −returned  of closed contacts, zero of other constraints.

    Its equations are those of motion, with q̇⁺ for q̈ and Λ for λ; it is the motion itself where `happens` is not true.
    """

    returned: Float[Array, " c"]
    given: Float[Array, " c"]
    happens: Any = True

    def instead(self, of_impact: Callable, of_motion: Callable) -> Any:
        """What is of the impact, or, where there is none, of the motion."""
        if self.happens is True:
            return of_impact()
        return jax.tree.map(lambda new, old: jnp.where(self.happens, new, old), of_impact(), of_motion())

    def among_rows(self, flat: Flat) -> Float[Array, " m"]:
        """The impulses given, among those of all rows of constraints."""
        return _at_contacts(flat, self.given, flat.rows)

    def asked(self, flat: Flat, M: lx.AbstractLinearOperator, t, q, v, of_motion: Callable) -> tuple[Array, Array]:
        """The momentum in the place of forces, and what is asked of G q̇⁺ in that of G q̈."""

        def of_impact():
            none = jnp.zeros_like(v)
            c = -velocity_residual(flat, t, q, none)
            if flat.closed is not None:
                c = c - _at_contacts(flat, jnp.where(flat.closed, self.returned, 0), c.size)
            given = jax.vjp(lambda v: jax.jvp(flat.gaps, (t, q), (jnp.zeros_like(t), v))[1], none)[1](self.given)[0]
            return M.mv(v) + given, c

        return self.instead(of_impact, of_motion)


class Correction(NamedTuple):
    """A state that is put back on its constraints, by its positions or by its velocities:  M δ = Gᵀλ,  G δ = −g or −ψ.

    These are equations of motion, with δ for q̈, and no forces; they are the motion itself where neither is asked for. What nonholonomic
    constraints forbid has a weight where positions are put back: they may be all that holds a coordinate without inertia.
    """

    of_positions: Bool[Array, ""]
    of_velocities: Bool[Array, ""]

    @property
    def happens(self) -> Bool[Array, ""]:
        """Whether a state is put back."""
        return self.of_positions | self.of_velocities

    def instead(self, of_positions: Array, of_velocities: Array, otherwise: Array) -> Array:
        """What is of one of these, or otherwise of the motion."""
        return jnp.where(self.of_positions, of_positions, jnp.where(self.of_velocities, of_velocities, otherwise))

    def asked(self, flat: Flat, M, G, t, q, psi, c) -> tuple[lx.AbstractLinearOperator, Any, Float[Array, " m"]]:
        """M, and G δ = c of the rows that count."""
        g = flat.holonomic(t, q)
        if 0 < g.size < c.size:
            if flat.massless or isinstance(M, lx.MatrixLinearOperator):
                beside = jnp.where(self.of_positions, dense(G)[g.size :], 0)
                M = lx.MatrixLinearOperator(augmented(M.as_matrix(), beside)[0])
            G = with_rows_alone(G, ~self.of_positions | (np.arange(c.size) < g.size))
        return M, G, self.instead(-jnp.pad(g, (0, c.size - g.size)), -psi, c)


def _at_contacts(flat: Flat, numbers: Float[Array, " c"], rows: int) -> Float[Array, " m"]:
    """Numbers of contacts among those of so many rows."""
    before = flat.rows_of_bilateral
    return jnp.pad(numbers, (before, rows - before - numbers.size))


def constrained_acceleration(flat: Flat, t, q, v, feedback=None, impulse: Impulse | None = None) -> SaddlePoint:
    """q̈ and λ of  M q̈ = f + Gᵀλ,  G q̈ = −γ − feedback(t, q, v); of coordinates without inertia, the rate of the velocity that D decides.

    Of an `impulse`, q̇⁺ and Λ.
    """
    return constrained_motion(flat, t, q, v, feedback, impulse)[1]


def constrained_motion(
    flat: Flat, t, q, v, feedback=None, impulse: Impulse | None = None, correction: Correction | None = None
) -> tuple[Float[Array, " n"], SaddlePoint]:
    """q̇ with the velocities that D decides, and q̈ and λ; of an impact, q̇⁺ and Λ; of a state that is put back, δ."""
    light = without_inertia(flat)
    if not light.size:
        return v, _by_inertia(flat, t, q, v, feedback, light, impulse, correction)
    (v, multipliers, reaction, sound), along = jax.linearize(lambda t, q, v: with_first_order_rates(flat, t, q, v), t, q, v)
    found = _by_inertia(inertial_part(flat, t, q, v, reaction), t, q, v, feedback, light, correction=correction)
    rate = along(jnp.ones_like(t), v, found.x).v
    if correction is not None:  # these follow from the rest
        rate = jnp.where(correction.happens, 0, rate)
    is_sound = Sound(*(a & b for a, b in zip(sound, found.sound, strict=True)))
    kept = np.flatnonzero(~are_of_sliders(flat, multipliers.size))
    return v, SaddlePoint(found.x.at[light].set(rate[light]), multipliers.at[kept].add(found.multipliers), is_sound)


def _by_inertia(
    flat: Flat, t, q, v, feedback, light: np.ndarray, impulse: Impulse | None = None, correction: Correction | None = None
) -> SaddlePoint:
    """q̈ and λ where everything has inertia, or is held by constraints; those `light` have that of another part."""
    M = inertia(flat, t, q, v)
    psi, G, gamma = velocity_rows(flat, t, q, v)
    f, force = inertial_force(flat, t, q, v), lambda multipliers: applied_force(flat, t, q, v, multipliers)
    c = -gamma if feedback is None else -gamma - feedback(flat, t, q, v)
    if impulse is not None:
        f, c = impulse.asked(flat, M, t, q, v, lambda: (f, c))
    near, reach = _near(flat, t, q, v, c.size, correction), None
    if correction is not None:
        M, G, c = correction.asked(flat, M, G, t, q, psi, c)
        reach = reach_of(jnp.where(correction.of_positions, q, v))._replace(counts=correction.happens)
        f, force = jnp.where(correction.happens, 0, f), _unless(correction.happens, force)
    return _solved(flat, M, G, f, c, force, light, near, reach)


def _unless(happens: Bool[Array, ""], force: Callable) -> Callable:
    return lambda multipliers: jnp.where(happens, 0, force(multipliers))


def _solved(flat: Flat, M, G, f, c, force: Callable, light: np.ndarray = np.zeros(0, int), near=None, reach=None) -> SaddlePoint:
    """x and λ of  M x = f + force(λ) + Gᵀλ,  G x = c,  where λ of what is open is zero."""
    if not flat.needs_multipliers:
        found = saddle_point_beside(light, M, G, f + force(jnp.zeros_like(c)), c, reach, near)
        return found._replace(multipliers=_pushing(flat, found.multipliers))
    columns, reaction, unit = _by_force(flat, M, G, f, c, force, near, reach)
    multipliers = _pushing(flat, self_consistent(reaction, unit))
    return SaddlePoint(_affine(columns.x, force(multipliers)), multipliers, columns.sound)


def _near(flat: Flat, t, q, v, rows: int, correction: Correction | None = None) -> Constraints | None:
    """The constraints about a state within a step, which is off them by its error; one row depends on no other."""
    if not flat.holonomic_names or rows < 2:
        return None

    def off():
        g = jax.lax.stop_gradient(flat.holonomic(t, q))
        g = g if correction is None else jnp.where(correction.happens, 0, g)  # as they are here
        return jnp.pad(g, (0, rows - g.size))

    return Constraints(off, lambda change: jax.lax.stop_gradient(dense(velocity_rows(flat, t, q + change, v)[1])))


def _by_force(flat: Flat, M, G, inertial, c, force: Callable, near=None, reach=None) -> tuple[SaddlePoint, Callable, Float[Array, " m"]]:
    """The solution, which is affine in the applied force: beside that without one, what each force adds; λ ↦ the λ that the forces of λ
    bring about; and a unit of each: as large as the forces of one size, in the metric of M, make it.
    """
    beside = lambda vector, matrix: jnp.concatenate([vector[:, None], matrix], axis=1)
    n, dtype = inertial.size, inertial.dtype
    forces = jnp.eye(n, dtype=dtype)
    if reach is not None:
        forces = jnp.where(reach.counts, 0, forces)
    columns = saddle_point(M, G, beside(inertial, forces), beside(c, jnp.zeros((c.size, n), dtype)), reach, near)
    reaction = lambda multipliers: _affine(columns.multipliers, force(_pushing(flat, multipliers)))
    by_force = columns.multipliers[:, 1:]
    size = jnp.sqrt(jnp.sum(by_force.T * jax.vmap(M.mv, 1, 1)(by_force.T), axis=0))
    return columns, reaction, jnp.where(size > 0, size, 1)


def _affine(columns, force):
    return columns[:, 0] + columns[:, 1:] @ force


def other_multipliers(flat: Flat, t, q, v, multipliers) -> Float[Array, "o m"]:
    """Others than those known with which the forces that depend on λ agree, as far as a search finds some; NaN where it does not."""
    M, inertial = inertia(flat, t, q, v), inertial_force(flat, t, q, v)
    _, G, gamma = velocity_rows(flat, t, q, v)
    _, reaction, unit = _by_force(flat, M, G, inertial, -gamma, lambda multipliers: applied_force(flat, t, q, v, multipliers))
    return others(reaction, multipliers, unit, jax.random.key(0))


def _pushing(flat: Flat, multipliers):
    """λ, that of an open contact zero and no rounding."""
    if flat.closed is None:
        return multipliers
    start, end = flat.rows_of_bilateral, flat.rows_of_bilateral + flat.gap_count
    before, of_contacts, behind = jnp.split(multipliers, [start, end])
    return jnp.concatenate([before, jnp.where(flat.closed, of_contacts, 0), behind])
