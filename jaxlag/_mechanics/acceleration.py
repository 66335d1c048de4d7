"""At one state: acceleration, multipliers, and constraint forces."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, PyTree

from .._model.flat import Flat, rows_by_name
from .._model.injection import check_function
from .._model.system import System
from .._model.validation import at_state
from .._program.jit import is_concrete
from .._program.scalarise import scalarised
from .constrained_acceleration import constrained_acceleration
from .contact import in_current_mode
from .lagrange import constraint_rows
from .pseudo_inverse import pseudo_inverse
from .saddle_point import CONTRADICTION, Sound
from .singular_directions import Failure, explained


class Acceleration(NamedTuple):
    """`qddot`: q̈, structured like q; `multipliers`: λ by the name of the constraint, structured like what g or a returns."""

    qddot: PyTree
    multipliers: dict[str, PyTree]


def acceleration(system: System, q: PyTree, qdot: PyTree, params: PyTree = None, *, t: Any = 0.0, states: PyTree = None) -> Acceleration:
    r"""Acceleration and multipliers of the constrained motion.

    $$ M\ddot q = f + G^T\lambda, \qquad G\ddot q = -\gamma $$

    λ > 0 pushes along +∇g. With redundant constraints q̈ and Gᵀλ are still unique, and λ is the solution of least norm; M may be singular
    in directions that the constraints hold.

    **Arguments:** the state `q`, `qdot` (one pytree structure, n numbers in all), `params`, the time `t`; `states`: values of the system's
    states by name, by default those at the start. Any consistent units.

    **Returns:** `Acceleration(qddot, multipliers)`: q̈ structured like q; λ by the constraint's name, structured like what g or a returns.

    **Raises:** `ValueError` if an entry of `params` is NaN, if a direction has no inertia and no constraint holds it, if constraints
    contradict each other, or if forces depend on λ such that no λ, or more than one, agrees with them. Under `jit` the result is NaN
    instead.

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
    result, verdict = at_state(_acceleration, system, q, qdot, params, t, states)
    _refuse(verdict, system, q, qdot, params, t, states)
    return result


def _refuse(verdict: Bool[Array, "3"], *given) -> None:
    """Raises where a solve has no unique solution; under `jit` its result is NaN."""
    if not is_concrete(verdict):
        return
    determined, satisfied, agrees = np.asarray(verdict)
    if not determined:
        raise ValueError(explained(Failure.no_inertia, *given))
    if not satisfied:
        raise ValueError(CONTRADICTION)
    if not agrees:
        raise ValueError(explained(Failure.no_multipliers, *given))


def _verdict(flat: Flat, sound: Sound, multipliers) -> Bool[Array, "3"]:
    """Whether there is one solution, the constraints do not contradict each other, and λ agrees with the forces that it brings about."""
    agrees = jnp.all(jnp.isfinite(multipliers)) if flat.needs_multipliers else jnp.array(True)
    return jnp.stack([sound.determined, sound.satisfied, agrees])


def _acceleration(flat, t, q, v):
    mode = in_current_mode(flat, t, q, v)

    def known(t, q, v):
        qddot, multipliers, sound = constrained_acceleration(mode, t, q, v)
        known = _is_sound(sound)
        return jnp.where(known, qddot, jnp.nan), jnp.where(known, multipliers, jnp.nan), sound

    qddot, multipliers, sound = scalarised(known)(t, q, v)
    return Acceleration(flat.unravel(qddot), flat.unravel_multipliers(multipliers)), _verdict(flat, sound, multipliers)


def _is_sound(sound: Sound) -> Bool[Array, ""]:
    return sound.determined & sound.satisfied


def constraint_force(
    system: System, q: PyTree, qdot: PyTree, params: PyTree = None, *, t: Any = 0.0, states: PyTree = None, at: Callable | None = None
) -> dict[str, PyTree]:
    r"""Constraint forces by the constraint's name: generalized, λ ∂g/∂q (or λ ∂a/∂q̇), or as a force on a point.

    $$ Q = \lambda\,\frac{\partial g}{\partial q}, \qquad F \cdot \delta x = Q \cdot \delta q \text{ for the point } x(t, q) $$

    **Arguments:** as `acceleration`; `at`: the position map x(t, q) of a point, which receives the arguments it names.

    **Returns:** Q structured like q; their sum is Gᵀλ. With `at`, F structured like x: the force at that point that does the same virtual
    work, NaN if the constraint also acts at other points. With redundant constraints the sum is unique, and its parts belong to the λ of
    least norm. Any consistent units.

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
    if at is not None:
        check_function(at, "`at`")
    force, verdict = at_state(_ConstraintForce(at), system, q, qdot, params, t, states)
    _refuse(verdict, system, q, qdot, params, t, states)
    return force


@dataclasses.dataclass(frozen=True)
class _ConstraintForce:
    """The forces over flat vectors; compared by the point, so that it is compiled once."""

    at: Callable | None

    def __call__(self, flat: Flat, t, q, v):
        _, multipliers, sound = constrained_acceleration(in_current_mode(flat, t, q, v), t, q, v)
        _, G, _ = constraint_rows(flat, t, q, v)
        forces = {name: multipliers[rows] @ G[rows] for name, rows in rows_by_name(flat).items()}
        shown = flat.unravel if self.at is None else _force_on_point(flat, self.at, t, q)
        found = {name: shown(jnp.where(_is_sound(sound), Q, jnp.nan)) for name, Q in forces.items()}
        return found, _verdict(flat, sound, multipliers)


def _force_on_point(flat, at, t, q):
    """Q ↦ F with JᵀF = Q, J = ∂x/∂q."""
    x, unravel = ravel_pytree(flat.position(at, t, q))
    J = jax.jacobian(lambda q: ravel_pytree(flat.position(at, t, q))[0])(q)

    def force(Q):
        F = pseudo_inverse(J @ J.T) @ (J @ Q)
        does_the_work = jnp.max(jnp.abs(J.T @ F - Q)) <= jnp.finfo(q.dtype).eps ** 0.5 * jnp.max(jnp.abs(Q))
        return unravel(jnp.where(does_the_work, F, jnp.nan))

    return force
