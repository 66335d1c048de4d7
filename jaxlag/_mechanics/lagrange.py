"""Lagrange's equations: mass matrix, forces and constraint rows by automatic differentiation.

M q̈ = f + Gᵀ λ,    M = ∂²L/∂q̇²,    f = ∂L/∂q − (∂²L/∂q̇∂q) q̇ − ∂²L/∂q̇∂t − ∂D/∂q̇ + Q
G q̈ = −γ,          G = ∂ψ/∂q̇,      γ = ∂ψ/∂t + (∂ψ/∂q) q̇,    ψ = (dg/dt, a)
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from .._model.flat import Flat, read_once
from .._model.system import System
from .._model.validation import at_state
from .._program.sparse_jacobian import MAX_DENSE_COLUMNS, jacobian
from .._program.sparse_matrix import SparseMatrix, dense
from .._program.sparsity import MANY, sparsity_pattern
from .structured_inertia import MOST_FULL, structured_inertia


def inertia(flat: Flat, t, q, v) -> lx.AbstractLinearOperator:
    """M."""
    M = _inertia(flat, lambda v: flat.lagrangian(t, q, v), v)
    return _with_stand_ins(flat, M, t, q, v) if flat.stand_ins else M


def _inertia(flat, kinetic, v):
    if v.size < MANY:
        return jacobian(jax.grad(kinetic), v, lambda: read_once(flat, _pattern_of_inertia, stated=True))[1]
    M = structured_inertia(kinetic, v)
    if flat.massless and v.size <= MOST_FULL:  # it is not positive itself, but where constraints hold what has no mass
        M = lx.MatrixLinearOperator(M.as_matrix())
    return M


def _pattern_of_inertia(flat: Flat, t, q, v) -> Bool[np.ndarray, "n n"]:
    return sparsity_pattern(jax.grad(lambda v: flat.lagrangian(t, q, v)), v)


def _with_stand_ins(flat, M, t, q, v):
    """M with the mean of its other masses on the coordinates of `flat.stand_ins`."""
    here = np.isin(np.arange(v.size), flat.stand_ins)
    diagonal = M.diagonal if isinstance(M, lx.DiagonalLinearOperator) else jnp.diagonal(M.as_matrix())
    mean = jax.lax.stop_gradient(jnp.sum(diagonal[~here]) / max(np.sum(~here), 1))
    masses = jnp.where(here, jnp.where(mean > 0, mean, 1), 0)
    if v.size >= MANY and not isinstance(M, lx.DiagonalLinearOperator):
        return _inertia(flat, lambda v: flat.lagrangian(t, q, v) + jnp.sum(masses / 2 * v**2), v)
    if isinstance(M, lx.DiagonalLinearOperator) or (v.size > MAX_DENSE_COLUMNS and _is_diagonal(flat)):
        return lx.DiagonalLinearOperator(diagonal + masses)
    return lx.MatrixLinearOperator(M.as_matrix() + jnp.diag(masses))


def _is_diagonal(flat):
    """Whether M has no other numbers, some of which may be zero."""
    pattern = read_once(flat, _pattern_of_inertia, stated=True)
    return not np.any(pattern & ~np.eye(len(pattern), dtype=bool))


def inertial_force(flat: Flat, t, q, v) -> Float[Array, " n"]:
    """The force of the Lagrangian alone, ∂L/∂q − (∂²L/∂q̇∂q) q̇ − ∂²L/∂q̇∂t."""
    slopes = lambda t, q: jax.grad(flat.lagrangian, argnums=(1, 2))(t, q, v)
    (force, _), (_, carried) = jax.jvp(slopes, (t, q), (jnp.ones_like(t), v))
    return force - carried


def applied_force(flat: Flat, t, q, v, multipliers) -> Float[Array, " n"]:
    """−∂D/∂q̇ + Q."""
    D = lambda v: sum((D(t, q, v, multipliers) for D in flat.dissipations.values()), start=jnp.zeros((), v.dtype))
    Q = sum((Q(t, q, v, multipliers) for Q in flat.forces.values()), start=jnp.zeros_like(v))
    return Q - jax.grad(D)(v)


def smooth_force(flat: Flat, t, q, v) -> Float[Array, " n"]:
    """f, of all but constraints and the forces that depend on their multipliers."""
    return inertial_force(flat, t, q, v) + applied_force(flat, t, q, v, jnp.zeros(flat.rows, v.dtype))


def rows_of(G: lx.AbstractLinearOperator | SparseMatrix) -> Float[Array, "m n"] | SparseMatrix:
    """A Jacobian as an array, but where it is sparse."""
    return G if isinstance(G, SparseMatrix) else G.as_matrix()


def position_rows(flat: Flat, t, q) -> tuple[Float[Array, " h"], Float[Array, "h n"] | SparseMatrix]:
    """g and its Jacobian ∂g/∂q, sparse where it is large."""
    g, G = jacobian(lambda q: flat.holonomic(t, q), q)
    return g, rows_of(G)


def position_residual(flat: Flat, t, q) -> tuple[Float[Array, " h"], Float[Array, "h n"]]:
    """g and its Jacobian ∂g/∂q with all its zeros."""
    g, G = position_rows(flat, t, q)
    return g, dense(G)


def velocity_residual(flat: Flat, t, q, v) -> Float[Array, " m"]:
    """ψ: dg/dt of the holonomic constraints, and a of the nonholonomic ones."""
    dg_dt = jax.jvp(flat.holonomic, (t, q), (jnp.ones_like(t), v))[1]
    return jnp.concatenate([dg_dt, flat.nonholonomic(t, q, v)])


def velocity_rows(flat: Flat, t, q, v) -> tuple[Float[Array, " m"], Float[Array, "m n"] | SparseMatrix, Float[Array, " m"]]:
    """ψ, G and γ, such that dψ/dt = G q̈ + γ; G sparse where it is large."""
    psi, G = jacobian(lambda v: velocity_residual(flat, t, q, v), v, lambda: read_once(flat, pattern_of_rows))
    _, gamma = jax.jvp(lambda t, q: velocity_residual(flat, t, q, v), (t, q), (jnp.ones_like(t), v))
    return psi, rows_of(G), gamma


def pattern_of_rows(flat: Flat, t, q, v) -> Bool[np.ndarray, "m n"]:
    """Which numbers of G may differ from zero."""
    return sparsity_pattern(lambda v: velocity_residual(flat, t, q, v), v)


def constraint_rows(flat: Flat, t, q, v) -> tuple[Float[Array, " m"], Float[Array, "m n"], Float[Array, " m"]]:
    """ψ, G and γ, such that dψ/dt = G q̈ + γ, with all zeros of G."""
    psi, G, gamma = velocity_rows(flat, t, q, v)
    return psi, dense(G), gamma


def imbalance(flat: Flat, t, q, v, qddot, multipliers) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
    """M q̈ − f − Gᵀλ and G q̈ + γ, which are zero in motion: derivatives along the motion, without a matrix."""

    def parts(t, q, v):
        """∂L/∂q, ∂L/∂q̇, ψ and Gᵀλ, each computed once."""
        psi, pulled = jax.vjp(lambda v: velocity_residual(flat, t, q, v), v)
        return *jax.grad(flat.lagrangian, argnums=(1, 2))(t, q, v), psi, pulled(multipliers)[0]

    now, rates = jax.jvp(parts, (t, q, v), (jnp.ones_like(t), v, qddot))
    (force, _, _, reaction), (_, momentum_rate, psi_rate, _) = now, rates
    return momentum_rate - force - applied_force(flat, t, q, v, multipliers) - reaction, psi_rate


def mass_matrix(
    system: System, q: PyTree, qdot: PyTree, params: PyTree = None, *, t: Any = 0.0, states: PyTree = None
) -> Float[Array, "n n"]:
    """Mass matrix M = ∂²L/∂q̇², in the flat order of `jax.flatten_util.ravel_pytree(q)`.

    **Arguments:** the state `q`, `qdot` (one pytree structure, n numbers in all), `params`, the time `t`; `states`: values by name of the
    further states, where they are not those at the start. Any consistent units.

    **Returns:** an (n, n) array, symmetric.

    **Raises:** `TypeError` or `ValueError` if an argument or a function of the system is of the wrong kind.

    **Source:** Goldstein, Classical Mechanics, 3rd ed., eq. 1.71.

    ```python
    import jaxlag as jl
    system = jl.System(lambda q, qdot, m: 0.5 * m * (qdot["x"] ** 2 + q["x"] ** 2 * qdot["phi"] ** 2))
    jl.mass_matrix(system, {"x": 2.0, "phi": 0.0}, {"x": 0.0, "phi": 0.0}, {"m": 3.0})  # rows phi, x: [[12, 0], [0, 3]]
    ```
    """
    return at_state(_mass_matrix, system, q, qdot, params, t, states)


def _mass_matrix(flat, t, q, v):
    return inertia(flat, t, q, v).as_matrix()


def momentum(system: System, q: PyTree, qdot: PyTree, params: PyTree = None, *, t: Any = 0.0, states: PyTree = None) -> PyTree:
    """Generalized momentum p = ∂L/∂q̇, structured like q.

    **Arguments, raises:** as `mass_matrix`. **Source:** Goldstein, 3rd ed., eq. 2.44.

    ```python
    import jaxlag as jl
    jl.momentum(jl.System(lambda qdot, m: 0.5 * m * qdot**2), 0.0, 2.0, {"m": 3.0})  # 6.0
    ```
    """
    return at_state(_momentum, system, q, qdot, params, t, states)


def _momentum(flat, t, q, v):
    return flat.unravel(jax.grad(flat.lagrangian, argnums=2)(t, q, v))


def energy(system: System, q: PyTree, qdot: PyTree, params: PyTree = None, *, t: Any = 0.0, states: PyTree = None) -> Float[Array, ""]:
    """Energy h = q̇ · ∂L/∂q̇ − L, which is T + V where L = T − V with T quadratic in q̇.

    **Arguments, raises:** as `mass_matrix`. **Source:** Goldstein, 3rd ed., eq. 2.53 (energy function).

    ```python
    import jaxlag as jl
    jl.energy(jl.System(lambda q, qdot, m, c: 0.5 * m * qdot**2 - 0.5 * c * q**2), 1.0, 2.0, {"m": 3.0, "c": 4.0})  # 8.0
    ```
    """
    return at_state(_energy, system, q, qdot, params, t, states)


def _energy(flat, t, q, v):
    L, p = jax.value_and_grad(flat.lagrangian, argnums=2)(t, q, v)
    return v @ p - L


def constraint_jacobian(
    system: System, q: PyTree, qdot: PyTree, params: PyTree = None, *, t: Any = 0.0, states: PyTree = None
) -> Float[Array, "m n"]:
    """Constraint Jacobian G: rows ∂g/∂q of the holonomic, then ∂a/∂q̇ of the nonholonomic constraints.

    **Arguments, raises:** as `mass_matrix`. **Returns:** an (m, n) array; rows in the order of `system.constraints`.

    **Source:** Hairer & Wanner, Solving Ordinary Differential Equations II, section VII.1.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    rod = jl.System(lambda qdot: 0.5 * qdot @ qdot, holonomic=lambda q, l: q @ q - l**2)
    jl.constraint_jacobian(rod, jnp.array([3.0, 4.0]), jnp.zeros(2), {"l": 5.0})  # [[6, 8]]
    ```
    """
    return at_state(_constraint_jacobian, system, q, qdot, params, t, states)


def _constraint_jacobian(flat, t, q, v):
    return constraint_rows(flat, t, q, v)[1]


class Residual(NamedTuple):
    """How far a state is from its constraints: `position` holds g, `velocity` holds dg/dt and a, each by the constraint's name."""

    position: dict[str, PyTree]
    velocity: dict[str, PyTree]


def constraint_residual(system: System, q: PyTree, qdot: PyTree, params: PyTree = None, *, t: Any = 0.0, states: PyTree = None) -> Residual:
    """Constraint residuals: `position` holds g, `velocity` holds dg/dt and a, each by the constraint's name.

    **Arguments, raises:** as `mass_matrix`. **Returns:** `Residual(position, velocity)`; values structured like what g and a return.

    **Source:** Hairer & Wanner, Solving Ordinary Differential Equations II, section VII.1.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    rod = jl.System(lambda qdot: 0.5 * qdot @ qdot, holonomic={"rod": lambda q, l: q @ q - l**2})
    jl.constraint_residual(rod, jnp.array([3.0, 4.0]), jnp.array([1.0, 0.0]), {"l": 5.0})  # rod: g = 0, dg/dt = 6
    ```
    """
    return at_state(_constraint_residual, system, q, qdot, params, t, states)


def _constraint_residual(flat, t, q, v):
    g, psi = flat.holonomic(t, q), velocity_residual(flat, t, q, v)
    position = flat.unravel_multipliers(jnp.concatenate([g, jnp.zeros(psi.size - g.size, g.dtype)]))
    return Residual({name: position[name] for name in flat.holonomic_names}, flat.unravel_multipliers(psi))
