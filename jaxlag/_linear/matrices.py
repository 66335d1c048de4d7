"""The matrices of the motion near a state: its equations, differentiated along the tangent space of all constraints."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from .._mechanics.augmented_inertia import augmented, by_weight, unit_lengths
from .._mechanics.constraint_residuals import off_constraints
from .._mechanics.contact import barely_touching, in_current_mode
from .._mechanics.lagrange import applied_force, constraint_rows, inertia
from .._mechanics.massless import first_order, with_masses
from .._model.flat import StatesAt
from .._model.numbers import none_is_nan, where_known
from .._model.state_values import start_values
from .._model.system import System
from .._model.validation import checked
from .._program.jit import compiled
from .._program.size_of_terms import size_of_terms
from .dynamics import Balance, Dynamics, Forces, Whole, dynamics_of
from .inputs import Input
from .newton import least_change
from .tangent_space import Partition

STEADY = 0.375  # exponent of eps (1.3e-6 in double precision): tolerance on the residual of terms that cancel in a steady state


@dataclasses.dataclass(frozen=True)
class Choice:
    """The inputs, the outputs and the independent coordinates."""

    inputs: tuple[Input, ...]  # the user's inputs, then the system's sampled states, if any
    outputs: Callable | None
    partition: Partition
    loops: int  # number of sampled states among the inputs, which the system's own updates move


class ByInputs(NamedTuple):
    """Derivatives of a quantity with respect to x, and to u, u̇ and ü."""

    by_state: Float[Array, "r d"]
    by_inputs: Float[Array, "3 r m"]


class Steadiness(NamedTuple):
    """Residuals of a steady state: q̈, ż and changes of sampled states; and the tolerances on them."""

    left: Float[Array, " y"]
    allowed: Float[Array, " y"]
    determined: Bool[Array, ""]


class Matrices(NamedTuple):
    """Derivatives of ẋ, outputs, multipliers and updates of sampled states with respect to x and u; δ(q, q̇, z) = T x; M."""

    rates: ByInputs
    outputs: ByInputs
    multipliers: ByInputs
    updates: ByInputs
    basis: Float[Array, "y d"]
    mass: Float[Array, "n n"]
    steadiness: Steadiness
    shifted: Bool[Array, ""]  # whether x is not the state itself, but the state less the contributions of u and u̇
    closed: Bool[Array, " c"]  # which contacts are, and are held
    barely: Bool[Array, " c"]  # which touch and are not pressed


@compiled
def constraint_slopes(system, t, q, qdot, params, states):
    """G in units in which each coordinate has inertia of order one, the number of its rows that hold positions (as an array of that
    length), and the deviation of the state from the constraints.

    Rows below G state that velocities of coordinates without inertia depend on the others; rows of G that hold such velocities hold nothing
    else.
    """
    flat, t, q, v = checked(system, t, q, qdot, params, states)
    mode = in_current_mode(flat, t, q, v)
    _, G, _ = constraint_rows(mode, t, q, v)
    G = G * unit_lengths(inertia(mode, t, q, v).as_matrix(), G)[None]
    z, rows, _ = first_order(mode)
    if z.size:
        alone = np.outer(rows, ~np.isin(np.arange(q.size), z))
        G = jnp.concatenate([jnp.where(alone, 0, G), jnp.eye(q.size, dtype=G.dtype)[z]])
    return G, jnp.zeros(flat.holonomic(t, q).size), off_constraints(flat, t, q, v)


@compiled
def matrices(choice: Choice, system: System, t: Any, q: PyTree, qdot: PyTree, params: PyTree, states: PyTree) -> Matrices:
    """The matrices near a state; NaN if an entry of params is NaN."""
    checked(system, t, q, qdot, params, states)
    values = start_values(system, states, t, q, qdot, params)
    at = StatesAt(values, t, ravel_pytree(q)[0], ravel_pytree(qdot)[0])
    dynamics, y = dynamics_of(system, q, params, at, choice.inputs, choice.outputs)
    basis, driven = tangent_basis(dynamics, choice.partition, y)
    forces = dynamics.forces(y, dynamics.still())
    mode = in_current_mode(dynamics.at(y, dynamics.still()), at.t, y.q, y.v)
    z, *_ = first_order(mode)
    if z.size:
        slopes, M, found = _slopes_of_solution(dynamics, y, forces, basis, driven)
    else:
        slopes, M, found = _slopes(dynamics, choice.partition, y, forces, basis, driven)
    n = y.q.size
    velocity = ByInputs(basis[n : 2 * n], jnp.stack([*(of_u[n : 2 * n] for of_u in driven), jnp.zeros_like(driven[0][n : 2 * n])]))
    positions, velocities = (np.array(which, int) for which in choice.partition[:2])
    qddot, multipliers, z, outputs, updates = slopes
    parts = [jax.tree.map(lambda x: x[..., positions, :], velocity), jax.tree.map(lambda x: x[..., velocities, :], qddot), z]
    rates = jax.tree.map(lambda *rows: jnp.concatenate(rows, axis=-2), *parts)
    by_state = jnp.abs(jnp.concatenate([of.by_state for of in (qddot, z, updates)]))
    by_held = jnp.abs(jnp.concatenate([of.by_inputs[0, :, len(choice.inputs) - choice.loops :] for of in (qddot, z, updates)]))
    of_state, of_terms, of_forces = _sizes(dynamics, y, forces.multipliers, M)
    independent = np.array([*positions, *(n + velocities), *range(2 * n, len(of_state))], int)
    size = by_state @ of_state[independent] + of_terms
    of_updates = size[size.size - dynamics.held.size :]  # an update that cancels to zero leaves the rounding of its terms
    size = size + by_held @ jnp.maximum(jnp.abs(dynamics.held), of_updates)[: choice.loops]
    allowed = jnp.finfo(y.q.dtype).eps ** STEADY * size
    left = jnp.concatenate([forces.qddot, found.z, found.updates - dynamics.held])
    steadiness = Steadiness(left, allowed, forces.sound.determined & forces.sound.satisfied)
    outputs, multipliers, updates = (_shifted(rates, of) for of in (outputs, multipliers, updates))
    closed = jnp.zeros(0, bool) if mode.closed is None else mode.closed
    barely = barely_touching(mode, at.t, y.q, y.v, forces.multipliers, of_forces)
    shifted = jnp.any(rates.by_inputs[1:] != 0)
    near = Matrices(_proper(rates), outputs, multipliers, updates, basis, M, steadiness, shifted, closed, barely)
    return where_known(none_is_nan(params) & ~jnp.any(barely), near)


def _slopes(
    dynamics: Dynamics, at: Partition, y: Whole, forces: Forces, basis: Array, driven: tuple[Array, Array]
) -> tuple[list[ByInputs], Array, Balance]:
    """Derivatives of q̈, λ, ż, outputs and updates in the state and the inputs, along the constraints; M; and the balance itself.

    A single derivative of the balance in all directions: with E = M q̈ − f − Gᵀλ and c = G q̈ + γ,  M δq̈ − Gᵀδλ = −δE,  G δq̈ = −δc.
    """
    (n,), d, m, rows = y.q.shape, basis.shape[1], len(dynamics.inputs), forces.multipliers.size
    held = np.array(at.velocity_rows, int)
    redundant = len(held) < rows
    G = _rows(dynamics, y)
    mode = in_current_mode(dynamics.at(y, dynamics.still()), dynamics.t, y.q, y.v)
    units = unit_lengths(inertia(mode, dynamics.t, y.q, y.v).as_matrix(), G)
    inside = least_change(G, forces.multipliers, units) if redundant else jnp.zeros(n, y.q.dtype)

    def along(c):
        x, *u, qddot, multipliers = jnp.split(c, np.cumsum([d, m, m, m, n]))
        step = basis @ x + driven[0] @ u[0] + driven[1] @ u[1]
        moved, motion = Whole(*(a + b for a, b in zip(y, jnp.split(step, (n, 2 * n)), strict=True))), (u[0], u[1], u[2])
        found = dynamics.balance(moved, forces.qddot + qddot, forces.multipliers + multipliers, motion)
        spread = dynamics.rows_along(moved, inside, motion) if redundant else jnp.zeros(rows, y.q.dtype)
        return (found, spread), found

    nothing = jnp.zeros(d + 3 * m + n + rows, y.q.dtype)
    (slope, spread), found = jax.jacfwd(along, has_aux=True)(nothing)
    split = lambda J: (J[:, : d + 3 * m], J[:, d + 3 * m : d + 3 * m + n], J[:, d + 3 * m + n :])
    (E, M, by_force), (c, G, _) = split(slope.imbalance), split(slope.constraint_rate)
    saddle = jnp.block([[M, by_force[:, held]], [G[held], jnp.zeros((len(held), len(held)), M.dtype)]])
    change = -jnp.linalg.solve(saddle, jnp.concatenate([E, c[held]]))
    qddot, multipliers = change[:n], jnp.zeros((rows, d + 3 * m), M.dtype).at[held].set(change[n:])
    if redundant:  # λ of least norm lies in the range of G: add the part that the selected rows lack
        in_range = _onto_range(G, held)
        multipliers = in_range @ multipliers + spread[:, : d + 3 * m] - in_range @ spread[:, : d + 3 * m]

    def followed(J):
        """Derivatives along the state and the inputs, with q̈ and λ following."""
        given, by_qddot, by_multipliers = split(J)
        return given + by_qddot @ qddot + by_multipliers @ multipliers

    of = lambda J: ByInputs(J[:, :d], jnp.moveaxis(J[:, d:].reshape(len(J), 3, m), 1, 0))
    return [of(x) for x in (qddot, multipliers, followed(slope.z), followed(slope.outputs), followed(slope.updates))], M, found


def _onto_range(G: Float[Array, "m n"], held: np.ndarray) -> Float[Array, "m m"]:
    """The projection onto the range of G, from its rows `held`: G = T G_held, in any units of the rows."""
    size = jnp.linalg.norm(G, axis=1, keepdims=True)
    size = jnp.where(size > 0, size, 1)
    unit = G / size
    T = size * (unit @ jnp.linalg.pinv(unit[held])) / size[held].T
    Q, _ = jnp.linalg.qr(T / jnp.linalg.norm(T, axis=0, keepdims=True))
    return Q @ Q.T


def _slopes_of_solution(
    dynamics: Dynamics, y: Whole, forces: Forces, basis: Array, driven: tuple[Array, Array]
) -> tuple[list[ByInputs], Array, Balance]:
    """`_slopes` for coordinates without inertia: differentiates the computation of q̈ and λ."""
    n, d, m = y.q.size, basis.shape[1], len(dynamics.inputs)

    def along(c):
        x, *u = jnp.split(c, np.cumsum([d, m, m]))
        step = basis @ x + driven[0] @ u[0] + driven[1] @ u[1]
        moved, motion = Whole(*(a + b for a, b in zip(y, jnp.split(step, (n, 2 * n)), strict=True))), (u[0], u[1], u[2])
        qddot, multipliers, _ = dynamics.forces(moved, motion)
        return qddot, multipliers, *dynamics.driven(moved, qddot, multipliers, motion)

    slopes = jax.jacfwd(along)(jnp.zeros(d + 3 * m, y.q.dtype))
    of = lambda J: ByInputs(J[:, :d], jnp.moveaxis(J[:, d:].reshape(len(J), 3, m), 1, 0))
    mode = in_current_mode(dynamics.at(y, dynamics.still()), dynamics.t, y.q, y.v)
    M = inertia(mode, dynamics.t, y.q, y.v).as_matrix()
    return [of(J) for J in slopes], M, dynamics.balance(y, forces.qddot, forces.multipliers, dynamics.still())


def tangent_basis(dynamics: Dynamics, at: Partition, y: Whole) -> tuple[Array, tuple[Array, Array]]:
    """T, and the derivatives of the state in u and u̇ if these move constraints: from ∂(g, ψ) = 0 for the dependent entries."""
    (n,), (k,), m = y.q.shape, y.z.shape, len(dynamics.inputs)
    rows_of = lambda given, rows: given[np.array(rows, int)]

    def residuals(c):
        q, v, z, *u = jnp.split(c, np.cumsum([n, n, k, m]))
        g, psi = dynamics.constraints(Whole(q, v, z), (u[0], u[1], jnp.zeros_like(u[0])))
        return jnp.concatenate([rows_of(g, at.position_rows), rows_of(psi, at.velocity_rows)])

    independent = np.array([*at.positions, *(n + i for i in at.velocities), *range(2 * n, 2 * n + k)], int)
    dependent = np.array([*at.dependent_positions, *(n + i for i in at.dependent_velocities)], int)
    known = np.concatenate([independent, 2 * n + k + np.arange(2 * m)])
    T = jnp.zeros((2 * n + k, len(known)), y.q.dtype).at[independent, np.arange(len(independent))].set(1)
    if dependent.size:
        slopes = jax.jacfwd(residuals)(jnp.concatenate([*y, jnp.zeros(2 * m, y.q.dtype)]))
        T = T.at[dependent].set(-jnp.linalg.solve(slopes[:, dependent], slopes[:, known]))
    d = len(independent)
    return T[:, :d], (T[:, d : d + m], T[:, d + m :])


def _rows(dynamics, y):
    """G."""
    mode = in_current_mode(dynamics.at(y, dynamics.still()), dynamics.t, y.q, y.v)
    return constraint_rows(mode, dynamics.t, y.q, y.v)[1]


def _proper(rates: ByInputs) -> ByInputs:
    """The rates in terms of x − B₂ u̇ − (B₁ + A B₂) u, which u alone drives."""
    A, (B, B1, B2) = rates
    return ByInputs(A, jnp.stack([B + A @ (B1 + A @ B2), 0 * B1, 0 * B2]))


def _shifted(rates: ByInputs, of: ByInputs) -> ByInputs:
    """A quantity that depends on x, in terms of the x of `_proper`."""
    A, (_, B1, B2) = rates
    C, (D, D1, D2) = of
    return ByInputs(C, jnp.stack([D + C @ (B1 + A @ B2), D1 + C @ B2, D2]))


def _sizes(dynamics: Dynamics, y: Whole, multipliers: Array, mass: Array) -> tuple[Array, Array, Array]:
    """The size of each entry of the state, with zero entries sized by mass; the size of the terms that cancel in q̈, ż and updates; and that
    of the forces on each coordinate.
    """
    mode, G = in_current_mode(dynamics.at(y, dynamics.still()), dynamics.t, y.q, y.v), _rows(dynamics, y)
    light = first_order(mode).coordinates
    stand_in = with_masses(mode, light) if light.size else None
    mass = mass if stand_in is None else inertia(stand_in, dynamics.t, y.q, y.v).as_matrix()
    units = unit_lengths(mass, G)
    of_lagrangian = lambda q: jax.grad(mode.lagrangian, argnums=1)(dynamics.t, q, y.v)
    applied = applied_force(mode, dynamics.t, y.q, y.v, multipliers)
    forces = jnp.abs(of_lagrangian(y.q)) + size_of_terms(of_lagrangian, y.q) + jnp.abs(applied) + jnp.abs(G.T) @ jnp.abs(multipliers)
    mobility = jnp.abs(jnp.linalg.inv(augmented(mass, G)[0] * jnp.outer(units, units)))
    terms = [units * (mobility @ (units * forces)), jnp.zeros(y.z.size + dynamics.held.size, y.q.dtype)]
    if terms[1].size:
        rates = lambda z: [dynamics.driven(y._replace(z=z), 0 * y.q, multipliers, dynamics.still())[i] for i in (0, 2)]
        terms[1] = size_of_terms(lambda z: jnp.concatenate(rates(z)), y.z)
    sizes = [by_weight(units, jnp.abs(x)) for x in (y.q, y.v)]
    return jnp.concatenate([*sizes, jnp.abs(y.z)]), jnp.concatenate(terms), forces
