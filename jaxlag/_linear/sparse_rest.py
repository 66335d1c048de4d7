"""Rest of many coordinates, each coupled to a few, without dense matrices.

F(q, λ) = (f + Gᵀλ, g) = 0,    ∂F/∂(q, λ) = [−K Gᵀ; G 0]
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PyTree

from .._mechanics.augmented_inertia import units_alike
from .._mechanics.friction_elements import find_elements
from .._mechanics.lagrange import imbalance, inertia, position_rows
from .._mechanics.saddle_point import saddle_point
from .._model.flat import Flat
from .._model.state_values import start_values
from .._model.system import System
from .._model.validation import checked
from .._program.jit import compiled
from .._program.sparse_jacobian import MANY
from .._program.sparse_matrix import SparseMatrix, row_sums
from .._program.sparse_newton import newton_factors, refined
from .newton import Root
from .rest import Curvature, Equations, Given, Rest, Search
from .sparse_descent import eigenvalues_below, sparse_minimum_near
from .sparse_root import SparseEquations, sparse_root_near, sparse_units_beside

MOST_DENSE = 400  # most unknowns of a dense search if the sparse one finds nothing: it takes less than a minute


class EquationsOfRest(Equations):
    """f + Gᵀλ = 0 and g = 0, from derivatives of L and g alone."""

    def __call__(self, given: Given, w: Float[Array, " u"]) -> Float[Array, " u"]:
        flat, q, v, of = self.taken_apart(given, w)
        lacking, _ = imbalance(flat, given.t, q, v, jnp.zeros_like(q), of.multipliers)
        return jnp.concatenate([-lacking, flat.holonomic(given.t, q)]).astype(w.dtype)


@compiled
def many_at_rest(search: Search, system: System, t: Any, q: PyTree, qdot: PyTree, params: PyTree, states: PyTree) -> Rest | None:
    """As `steady_state`; None if there are few coordinates, no structure, or more than forces and positions in the equations."""
    flat, t, q0, v0 = checked(system, t, q, qdot, params, states)
    beside = search.fixed or search.running or search.held or system.states or system.nonholonomic
    if q0.size < MANY or beside or system.unilateral or (search.stable and flat.rows) or find_elements(flat) is not None:
        return None
    values = start_values(system, states, t, q, qdot, params)
    given = Given(eqx.filter(params, eqx.is_array), t, q0, v0, *[jnp.zeros(0, bool)] * 2)
    start = lax.stop_gradient(jnp.concatenate([q0, jnp.zeros(flat.rows, q0.dtype)]))
    of_rest = EquationsOfRest(search, system, q, params, values, given, flat)
    equations = SparseEquations.of(of_rest, given, start, q0.size)
    if equations is None:
        return None
    root = _searched(equations, lax.stop_gradient(given), flat, start, search.stable, can_descend=not (flat.rows or system.force))
    return _described(of_rest, equations, given, equations.differentiable_root(given, root.w), root)


def _searched(equations: SparseEquations, given: Given, flat: Flat, start: Array, stable: bool, can_descend: bool) -> Root:
    """The root from Newton's method, started at the guess. If it finds nothing or a minimum is asked for, it starts at a minimum near the
    guess, if the potential can be followed: unstretched springs have no lateral stiffness.
    """
    V = lambda q: -flat.lagrangian(given.t, q, given.v)
    of_V = lambda q: (equations.residual(given, q), equations.jacobian(given, q))
    masses = units_alike(inertia(flat, given.t, given.q, given.v), [])
    units = jnp.zeros_like(start).at[: masses.size].set(masses)
    if not can_descend:
        return sparse_root_near(equations, given, _with_multipliers(equations, given, start), units)
    within = sparse_units_beside(equations.jacobian(given, start), units)

    def turn(carry):
        _, attempts = carry
        guess = lax.cond(attempts == 0, lambda: start, lambda: sparse_minimum_near(V, of_V, start, jnp.where(within > 0, within, 1)))
        return sparse_root_near(equations, given, guess, units), attempts + 1

    nothing = Root(start, jnp.array(False), jnp.zeros_like(start)), jnp.array(1 if stable else 0)
    return lax.while_loop(lambda carry: ~carry[0].found & (carry[1] < 2), turn, nothing)[0]


def _with_multipliers(equations: SparseEquations, given: Given, w: Array) -> Array:
    """w with the multipliers that best balance the forces."""
    J, n = equations.jacobian(given, w), given.q.size
    of_q = np.arange(w.size) < n
    within = of_q[J.pattern.rows] & of_q[J.pattern.columns]
    A = equations.matrix(SparseMatrix(jnp.where(within, 0, J.values), J.pattern)).plus_diagonal(jnp.asarray(of_q, w.dtype))
    balance = refined(A.__matmul__, A.pattern, newton_factors(A), jnp.where(of_q, equations.residual(given, w), 0))
    return w + jnp.where(of_q | ~jnp.all(jnp.isfinite(balance)), 0, balance)


def _described(of_rest: EquationsOfRest, equations: SparseEquations, given: Given, w: Array, root: Root) -> Rest:
    """A state of rest with everything that is reported about it."""
    flat, q, v, of = of_rest.taken_apart(given, w)
    known, at_rest = lax.stop_gradient((given, w))
    J, R = equations.jacobian(known, at_rest), equations.residual(known, at_rest)
    shown, multipliers = lambda x: jnp.where(root.found, x, jnp.nan), of.multipliers
    if flat.rows:  # multipliers of least norm, if rows are dependent
        _, G = position_rows(flat, given.t, q)
        unit = lx.DiagonalLinearOperator(jnp.ones_like(q))
        multipliers = saddle_point(unit, G, -(G.T @ multipliers), jnp.zeros_like(multipliers)).multipliers
    alone = jnp.asarray(equations.alone[: q.size] > 0)
    M = lax.stop_gradient(inertia(flat, given.t, q, v))
    return Rest(
        flat.unravel(shown(q)),
        flat.unravel(v),
        {},
        flat.unravel_multipliers(shown(multipliers)),
        {},
        jnp.array(False),
        given.t,
        root.found,
        jnp.array(True),
        R / jnp.where(root.size > 0, root.size, 1),
        R[: q.size],
        _curvature(J, M, alone),
    )


def _curvature(J: SparseMatrix, M: lx.AbstractLinearOperator, alone: Array) -> Curvature:
    """The number of squared natural frequencies below zero, and within rounding of zero, from the inertia of J relative to M."""
    n, eps, pattern = alone.size, jnp.finfo(J.values.dtype).eps, J.pattern
    masses = jnp.append(units_alike(M, []), jnp.zeros(J.shape[0] - n, J.values.dtype))
    units = sparse_units_beside(J, masses)[:n]
    units = jnp.where(units > 0, units, 1)
    mass = units**-2
    within = (pattern.rows < n) & (pattern.columns < n)
    unit = jnp.append(units, jnp.zeros(J.shape[0] - n, J.values.dtype))
    K = SparseMatrix(jnp.where(within, J.values * unit[pattern.rows] * unit[pattern.columns], 0), pattern)
    difference = jnp.max(jnp.abs(K.T.values - K.values)) if K.T.pattern == pattern else jnp.inf
    largest = jnp.max(row_sums(K))
    J = J.plus_diagonal(jnp.concatenate([jnp.where(alone, -largest * mass, 0), jnp.zeros(J.shape[0] - n)]).astype(mass.dtype))
    dust = eps**0.625 * largest
    within = jnp.maximum(dust, jnp.nan_to_num(eigenvalues_below(J, mass, dust)[1], nan=jnp.inf))
    (falling, error), (not_rising, error_too) = (eigenvalues_below(J, mass, bound) for bound in (-within, within))
    seen = (within == dust) | (falling > 0) | (not_rising == 0)
    symmetric = difference <= eps**0.5 * largest
    return Curvature(falling, not_rising + jnp.sum(alone), seen & (jnp.maximum(error, error_too) <= within), symmetric, alone)
