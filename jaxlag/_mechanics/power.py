"""Energy and power: what each force, dissipation term and moving constraint does to the energy."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._model.flat import Flat, rows_by_name
from .._model.system import EXPLICIT_TIME, System
from .._model.validation import at_state
from .constrained_acceleration import constrained_acceleration
from .contact import in_current_mode
from .lagrange import velocity_rows
from .massless import with_first_order_rates


def powers(
    system: System, q: PyTree, qdot: PyTree, params: PyTree = None, *, t: Any = 0.0, states: PyTree = None
) -> dict[str, Float[Array, ""]]:
    r"""Power of each term by its name; their sum is the rate of the energy.

    $$ \frac{dh}{dt} = -\sum_D \dot q\cdot\frac{\partial D}{\partial\dot q} + \sum_Q Q\cdot\dot q
       + \sum_\lambda \dot q\cdot G^T\lambda - \frac{\partial L}{\partial t}, \qquad h = \dot q\cdot\frac{\partial L}{\partial\dot q} - L $$

    A constraint at rest does no work; a moving one does −λ ∂g/∂t (it pushes along +∇g where λ > 0). The last term, energy supplied by
    explicit time in L, has the name `"time"`.

    **Arguments, raises:** as `acceleration`. Any consistent units.

    **Returns:** a dict of scalars: dissipation terms, forces, constraints, `"time"`.

    **Source:** Goldstein, Classical Mechanics, 3rd ed., eqs. 2.52 to 2.58; Lurie, Analytical Mechanics, section 7.6.

    ```python
    import jaxlag as jl
    car = jl.System(lambda qdot, m: 0.5 * m * qdot**2, dissipation={"oil": lambda qdot, b: 0.5 * b * qdot**2}, force={"pull": lambda F: F})
    jl.powers(car, 0.0, 2.0, {"m": 1.0, "b": 3.0, "F": 5.0})  # oil: −12, pull: 10, time: 0
    ```
    """
    return at_state(_powers, system, q, qdot, params, t, states)


def _powers(flat, t, q, v):
    return powers_of(in_current_mode(flat, t, q, v), t, q, v)


def powers_of(flat: Flat, t, q, v) -> dict[str, Float[Array, ""]]:
    """The powers over flat vectors."""
    v = with_first_order_rates(flat, t, q, v).v
    _, multipliers, _ = constrained_acceleration(flat, t, q, v)
    _, G, _ = velocity_rows(flat, t, q, v)
    rates = G @ v
    does = lambda rows: multipliers[rows] @ rates[rows]
    stuck = {name: does(rows) for name, rows in flat.held.items()}  # friction that sticks to something that moves
    damped = {name: stuck.get(name, 0) - v @ jax.grad(D, argnums=2)(t, q, v, multipliers) for name, D in flat.dissipations.items()}
    forced = {name: v @ Q(t, q, v, multipliers) for name, Q in flat.forces.items()}
    held = {name: does(rows) for name, rows in rows_by_name(flat).items()}
    return damped | forced | held | {EXPLICIT_TIME: -jax.grad(flat.lagrangian, argnums=0)(t, q, v)}


def energy_exchange(flat: Flat, t, q, v) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The energy h = q̇·p − L, and q̇·p, twice the kinetic energy where T is quadratic: a scale for the energy exchanged."""
    L, p = jax.value_and_grad(flat.lagrangian, argnums=2)(t, q, v)
    return v @ p - L, v @ p


def listed_powers(flat: Flat, t, q, v) -> Float[Array, " w"]:
    """The powers as a vector, in the order of `system.terms`, and a zero for the work of projection, which has no rate."""
    named = powers_of(flat, t, q, v)
    return jnp.stack([*(named[name] for name in flat.terms), jnp.zeros((), v.dtype)])
