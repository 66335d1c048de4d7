"""The constrained solve: x and λ of  M x = f + Gᵀλ,  G x = c."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from ._checks import at_state, is_concrete
from ._mechanics import applied_force, constraint_rows, inertia
from ._system import Flat, System


class Acceleration(NamedTuple):
    """q̈, structured like q, and the multipliers λ by the constraint's name."""

    qddot: PyTree
    multipliers: dict[str, PyTree]


class SaddlePoint(NamedTuple):
    """Solution of the constrained solve; `determined` is false where M leaves a direction free that no constraint holds."""

    x: Float[Array, " n"]
    multipliers: Float[Array, " m"]
    determined: Bool[Array, ""]


def saddle_point(M: Float[Array, "n n"], G: Float[Array, "m n"], f, c) -> SaddlePoint:
    """The unique x and the λ of least norm with M x = f + Gᵀλ and G x = c.

    M need be positive definite on the null space of G only, and rows of G may depend on each other: on the
    constraint M + GᵀWG says the same as M, with GᵀWc added to f, and is positive definite, so one Cholesky
    factorisation and the pseudo-inverse of the small matrix S = G (M + GᵀWG)⁻¹ Gᵀ serve every case.
    Source: Benzi, Golub & Liesen, Numerical solution of saddle point problems, Acta Numerica 2005, sections 5 and 6.
    """
    augmented, W = _augmented(M, G)
    factor = jnp.linalg.cholesky(jax.lax.stop_gradient(augmented))
    X = _solve(augmented, factor, jnp.column_stack([f + G.T @ (W * c), G.T]))
    free, mobility = X[:, 0], X[:, 1:]
    multipliers = pseudo_inverse(G @ mobility) @ (c - G @ free)
    return SaddlePoint(free + mobility @ multipliers, multipliers, _is_positive(factor, augmented))


def is_determined(M: Float[Array, "n n"], G: Float[Array, "m n"]) -> Bool[Array, ""]:
    """Whether M is positive definite on the null space of G."""
    augmented = jax.lax.stop_gradient(_augmented(M, G)[0])
    return _is_positive(jnp.linalg.cholesky(augmented), augmented)


def _augmented(M, G):
    """M + GᵀWG, with W such that a row of it is as heavy as M is on average; the solution does not depend on W."""
    size, mean = jnp.sum(G**2, axis=1), jnp.mean(jnp.diagonal(M))
    W = jax.lax.stop_gradient(jnp.where(mean > 0, mean, 1.0) / jnp.where(size > 0, size, jnp.inf))
    return M + G.T @ (W[:, None] * G), W


def _is_positive(factor, A):
    """Whether no pivot of the Cholesky factor of A is mere rounding, some n eps of its diagonal entry."""
    threshold = 10 * A.shape[0] * jnp.finfo(A.dtype).eps
    return jnp.all(jnp.diagonal(factor) ** 2 > threshold * jnp.diagonal(A))


def _solve(A, factor, B):
    """A⁻¹B by the Cholesky factor at hand; its derivative is one more such solve, never that of the factorisation."""
    by_factor = lambda _, B: jax.scipy.linalg.cho_solve((factor, True), B)
    return jax.lax.custom_linear_solve(lambda X: A @ X, B, by_factor, symmetric=True)


@jax.custom_jvp
def pseudo_inverse(S: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """Moore–Penrose inverse of a symmetric positive semidefinite S.

    The rank is judged on S scaled to a unit diagonal, so that it does not depend on the units of the constraints:
    eigenvalues below eps^(5/8) (1.6e-10 in double precision) of the largest count as zero.
    """
    m = S.shape[0]
    if m == 0:
        return S
    if m == 1:
        return jnp.where(S > 0, 1 / jnp.where(S > 0, S, 1), 0)
    size = jnp.diagonal(S)
    D = jnp.where(size > 0, jax.lax.rsqrt(jnp.where(size > 0, size, 1)), 1)
    values, U = jnp.linalg.eigh(S * jnp.outer(D, D))
    kept = values > jnp.finfo(S.dtype).eps ** 0.625 * values[-1]
    inverse = U @ (jnp.where(kept, 1 / jnp.where(kept, values, 1), 0)[:, None] * U.T) * jnp.outer(D, D)
    # Least norm in the units given: take out of range and domain what lies in the null space of S, spanned by V.
    V = D[:, None] * U * ~kept[None, :]
    out = jnp.eye(m, dtype=S.dtype) - V @ jnp.linalg.solve(V.T @ V + jnp.diag(kept.astype(S.dtype)), V.T)
    return out @ inverse @ out


@pseudo_inverse.defjvp
def _pseudo_inverse_jvp(primals, tangents):
    # Golub & Pereyra 1973, eq. 4.12, for constant rank.
    (S,), (dS,) = primals, tangents
    P = pseudo_inverse(S)
    null = jnp.eye(S.shape[0], dtype=S.dtype) - P @ S
    across = null @ dS @ P @ P
    return P, across + across.T - P @ dS @ P


def constrained_acceleration(flat: Flat, t, q, v, feedback=None) -> SaddlePoint:
    """q̈ and λ of  M q̈ = f + Gᵀλ,  G q̈ = −γ − feedback(t, q, v)."""
    M, inertial = inertia(flat, t, q, v)
    _, G, gamma = constraint_rows(flat, t, q, v)
    c = -gamma if feedback is None else -gamma - feedback(flat, t, q, v)
    solved = lambda multipliers: saddle_point(M, G, inertial + applied_force(flat, t, q, v, multipliers), c)
    free = solved(jnp.zeros(G.shape[0], v.dtype))
    if not flat.needs_multipliers:
        return free
    return solved(_self_consistent(lambda multipliers: solved(multipliers).multipliers, free.multipliers))


def _self_consistent(reaction, start):
    """λ = reaction(λ), where applied forces depend on the constraint forces they bring about."""
    tolerance = jnp.finfo(start.dtype).eps ** 0.75
    root = optx.root_find(
        lambda multipliers, _: reaction(multipliers) - multipliers, optx.Newton(tolerance, tolerance), start, max_steps=50, throw=False
    )
    return root.value


def acceleration(system: System, q: PyTree, qdot: PyTree, params: PyTree = None, *, t: Any = 0.0) -> Acceleration:
    r"""Acceleration and multipliers of the constrained motion.

    $$ M\ddot q = f + G^T\lambda, \qquad G\ddot q = -\gamma $$

    λ > 0 pushes along +∇g. With redundant constraints q̈ and Gᵀλ are still unique, and λ is the one of least norm;
    M may be singular where the constraints hold what it leaves free.

    **Arguments:** the state `q`, `qdot` (one pytree structure), `params`, the time `t`. Any consistent units.

    **Returns:** `Acceleration(qddot, multipliers)`: q̈ structured like q; λ by the constraint's name, structured like what g or a returns.

    **Raises:** `ValueError` where a direction has no inertia and no constraint holds it. Under `jit` the result is NaN there.

    **Source:** Hairer & Wanner, Solving Ordinary Differential Equations II, eqs. VII.1.46.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    pendulum = jl.System(
        lambda q, qdot, m, g: 0.5 * m * (qdot["r"] ** 2 + q["r"] ** 2 * qdot["phi"] ** 2) + m * g * q["r"] * jnp.cos(q["phi"]),
        holonomic={"rod": lambda q, l: q["r"] - l},
    )
    state = {"r": 2.0, "phi": 0.0}, {"r": 0.0, "phi": 1.0}
    jl.acceleration(pendulum, *state, {"m": 3.0, "g": 9.81, "l": 2.0}).multipliers["rod"]  # −m l φ̇² − m g cos φ = −35.43
    ```
    """
    result, determined = at_state(_acceleration, system, q, qdot, params, t)
    if is_concrete(determined) and not determined:
        raise ValueError(NO_INERTIA)
    return result


NO_INERTIA = (
    "`lagrangian` must give every direction inertia that no constraint holds, but the mass matrix is singular "
    "(or not positive) on the null space of the constraints. Add the missing mass, or a constraint."
)


def _acceleration(flat, t, q, v):
    qddot, multipliers, determined = constrained_acceleration(flat, t, q, v)
    multipliers = jnp.where(determined, multipliers, jnp.nan)
    qddot = jnp.where(determined, qddot, jnp.nan)
    return Acceleration(flat.unravel(qddot), flat.unravel_multipliers(multipliers)), determined


def constraint_force(
    system: System, q: PyTree, qdot: PyTree, params: PyTree = None, *, t: Any = 0.0, at: Callable | None = None
) -> dict[str, PyTree]:
    r"""Constraint forces by the constraint's name: generalized, λ ∂g/∂q (or λ ∂a/∂q̇), or as a force on a point.

    $$ Q = \lambda\,\frac{\partial g}{\partial q}, \qquad F \cdot \delta x = Q \cdot \delta q \text{ for the point } x(t, q) $$

    **Arguments:** as `acceleration`; `at`: the position map x(t, q) of a point, which receives the arguments it names.

    **Returns:** Q structured like q; their sum is Gᵀλ. With `at`, F structured like x: the force at that point that does the same
    virtual work, NaN where the constraint does not act through that point alone. With redundant constraints the sum is unique, its parts
    are those of the λ of least norm. Any consistent units.

    **Raises:** as `acceleration`.

    **Source:** Goldstein, Classical Mechanics, 3rd ed., eqs. 2.24 and 1.49.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    block = jl.System(
        lambda q, qdot, m, g: 0.5 * m * qdot @ qdot - m * g * q[1], holonomic={"floor": lambda q: 2 * q[1]}
    )
    jl.constraint_force(block, jnp.zeros(2), jnp.zeros(2), {"m": 2.0, "g": 9.81})["floor"]  # [0, 19.62]
    ```
    """
    force, determined = at_state(_ConstraintForce(at), system, q, qdot, params, t)
    if is_concrete(determined) and not determined:
        raise ValueError(NO_INERTIA)
    return force


@dataclasses.dataclass(frozen=True)
class _ConstraintForce:
    """The forces over flat vectors; compared by the point, so that it compiles once."""

    at: Callable | None

    def __call__(self, flat: Flat, t, q, v):
        _, multipliers, determined = constrained_acceleration(flat, t, q, v)
        _, G, _ = constraint_rows(flat, t, q, v)
        forces = {name: multipliers[rows] @ G[rows] for name, rows in rows_by_name(flat, G.shape[0]).items()}
        shown = flat.unravel if self.at is None else _force_on_point(flat, self.at, t, q)
        return {name: shown(jnp.where(determined, Q, jnp.nan)) for name, Q in forces.items()}, determined


def _force_on_point(flat, at, t, q):
    """Q ↦ F with JᵀF = Q, J = ∂x/∂q."""
    x, unravel = ravel_pytree(flat.position(at, t, q))
    J = jax.jacobian(lambda q: ravel_pytree(flat.position(at, t, q))[0])(q)

    def force(Q):
        F = pseudo_inverse(J @ J.T) @ (J @ Q)
        does_the_work = jnp.max(jnp.abs(J.T @ F - Q)) <= jnp.finfo(q.dtype).eps ** 0.5 * jnp.max(jnp.abs(Q))
        return unravel(jnp.where(does_the_work, F, jnp.nan))

    return force


def rows_by_name(flat: Flat, m: int) -> dict[str, np.ndarray]:
    """Which rows of G, and entries of λ, belong to which constraint."""
    with jax.ensure_compile_time_eval():
        rows = jax.tree.map(np.asarray, flat.unravel_multipliers(jnp.arange(m, dtype=float)))
    return {name: np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(rows[name])]).astype(int) for name in rows}
