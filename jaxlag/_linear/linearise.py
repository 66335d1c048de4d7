"""The motion near an equilibrium or a steady motion, as a linear system in independent coordinates."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from .._mechanics.consistent_state import state_in_contact
from .._model.flat import Flat, StatesAt, bind
from .._model.injection import check_function
from .._model.numbers import number, refuse_nan
from .._model.paths import entry_names, is_within, listed
from .._model.state_values import Layout, given_states, of_first_order, sampled, start_values
from .._model.system import System
from .._model.validation import coordinates, parameters, state
from .._motion.trajectory import Trajectory
from .._program.jit import is_concrete, seen
from .bends import refuse_bends
from .dynamics import dynamics_of
from .inputs import Input, find_inputs
from .linear_system import Coordinates, LinearSystem
from .matrices import Choice, Matrices, constraint_slopes, matrices
from .origin import Origin
from .sampled_data import between_updates
from .steadiness import moved_on, refuse_unsteady
from .tangent_space import Partition, partition


def linearise(
    system: System,
    q: Any,
    qdot: PyTree = None,
    params: PyTree = None,
    *,
    inputs: Sequence[str] = (),
    outputs: Callable | None = None,
    t: Any = 0.0,
    states: PyTree = None,
    independent: Any = None,
    frozen: bool = False,
) -> LinearSystem:
    r"""The motion near an equilibrium or a steady motion, with every kind of constraint, in independent coordinates.

    $$ \dot x = A x + B u, \qquad y = C x + D u, \qquad \delta(q, \dot q, z) = T x, \qquad
       \frac{\partial(g, \psi)}{\partial(q, \dot q, z)}\,T = 0, \qquad
       A = \left[\frac{\partial F}{\partial(q, \dot q, z)}\,T\right]_{\text{independent}} $$

    F is the rate (q̇, q̈, ż) and ψ = (dg/dt, a). x holds the deviations of independent coordinates, then of independent velocities, then of
    the first-order states z; in these rows, T is the identity.

    **Arguments:**

    - `q`, `qdot`: the state, at rest if `qdot` is omitted; or, in place of both, the result of `equilibrium` or `steady`, or a
      `Trajectory`, along which all arrays get the samples as first axis. `params`, `t`, `states` as for `acceleration`.
    - `inputs`: names of what u acts on: entries of `params` (numbers, arrays, signals), a coordinate (a force on it), a force (multiplied
      by 1 + u), a holonomic constraint (g = u) or a nonholonomic one (a = u), a sampled state. The velocity and acceleration of an input
      are included wherever they matter: to shake a base, move its position.
    - `outputs`: what is seen, a function like `observe` of an `Experiment`. Default: all coordinates.
    - `independent`: names of coordinates that are to be independent if possible, or a `LinearSystem` whose choice is reused. Required under
      `jit` if there are constraints, because the choice depends on numbers that `jit` hides; `grad` and `vmap` do not. Along a trajectory,
      the choice at the first sample is kept; where those coordinates cease to be independent, T and A grow without bounds.
    - `frozen`: allows a state that is not steady, where eigenvalues say little about stability.

    Dry friction: elements that stick are held, elements that slip keep their sliding force. Contacts: what presses is held, what stands
    open has no part; one that touches and is not pressed is refused, for the motion is another one on either side (NaN under `jit`). With
    `Sampled` states of one period the result is in discrete time, and exact. Any consistent units.

    **Returns:** a `LinearSystem`. Differentiable in `q`, `qdot`, `params`, `states`; a state given as numbers follows its constraints, as
    the position of a pendulum follows the length of its rod.

    **Raises:** `ValueError` if the state accelerates or A changes along the motion, if it is off its constraints, at a singular position,
    if a contact touches without being pressed, or opens or closes along a trajectory, if a function bends or jumps at the state, or if a
    name is unknown.

    **Source:** Wehage & Haug, J. Mechanical Design 104 (1982) 247-255 (independent coordinates); Meijaard, Papadopoulos, Ruina & Schwab,
    Proc. R. Soc. A 463 (2007) 1955-1982 (a rolling bicycle, as a check).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    rod = jl.System(
        lambda q, qdot, m, g: 0.5 * m * qdot @ qdot - m * g * q[1], holonomic={"rod": lambda q, l: q @ q - l**2}
    )
    pendulum = jl.linearise(rod, jnp.array([0.0, -2.0]), params={"m": 3.0, "g": 9.81, "l": 2.0})
    pendulum.modes().angular_frequency  # √(g/l) = 2.215
    ```
    """
    along, found_before = isinstance(q, Trajectory), hasattr(q, "qdot")
    if found_before:  # an equilibrium, an instant, a trajectory
        t, states = getattr(q, "ts" if along else "t", t), q.states if states is None else states
        q, qdot = q.q, q.qdot
    q = coordinates(q, "q")
    q, qdot = state(q, jax.tree.map(jnp.zeros_like, q) if qdot is None else qdot)
    dtype = jax.tree.leaves(q)[0].dtype
    t = jnp.asarray(t, dtype) if along else number(t, "`t`", dtype, cure="Pass one time, or a `Trajectory`.")
    params, states = parameters(params, q), given_states(system, states, q)
    refuse_nan(params)
    if system.constraints and not found_before and not is_concrete((t, q, qdot, params, states)):
        q, qdot = _with_constraints(system, t, q, qdot, params, states)
    first = jax.tree.map(lambda x: x[0], (t, q, qdot, states)) if along else (t, q, qdot, states)
    near = _Near(system, first, params)
    choice = near.choice(inputs, outputs, independent)
    of = lambda t, q, qdot, states: matrices(choice, system, t, q, qdot, params, states)
    found = jax.vmap(of)(t, q, qdot, states) if along else of(t, q, qdot, states)
    if system.unilateral and is_concrete(found):
        _refuse_contacts(near.flat, found)
    if not along:
        refuse_bends(system, near.flat, first, params, of)
    if along and is_concrete(found) and np.any(found.shifted):
        raise ValueError("`inputs` must not move a constraint along a trajectory, where A changes, but do. Move a force instead.")
    if not (along or frozen):
        refuse_unsteady(found, lambda step: of(*moved_on(first, step)), near.names)
    return _linear_system(near, choice, found, q, qdot, None if along else Origin.of(t, q, qdot, params, system))


def _with_constraints(system: System, t: Any, q: PyTree, qdot: PyTree, params: PyTree, states: PyTree) -> tuple[PyTree, PyTree]:
    """The given state, with derivatives that keep it on its constraints."""
    nearest = state_in_contact(system, q, qdot, params, t, states)
    fixed = jax.lax.stop_gradient
    return jax.tree.map(lambda x, nearest: fixed(x) + (nearest - fixed(nearest)), (q, qdot), nearest)


def _refuse_contacts(flat: Flat, found: Matrices) -> None:
    """Raises where a contact touches and is not pressed, or opens or closes along a trajectory."""
    of_each = lambda masks: [name for name, mask in flat.by_contact(jnp.asarray(masks)).items() if np.any(mask)]
    barely, closed = (np.asarray(x).reshape(-1, flat.gap_count) for x in (found.barely, found.closed))
    if names := of_each(np.any(barely, axis=0)):
        raise ValueError(
            f"`q` must be where contacts are pressed or stand open, but {names[0]!r} touches and nothing presses it: the motion is another "
            "one on either side. Move q away from it, or state it as `holonomic`."
        )
    if names := of_each(np.any(closed != closed[:1], axis=0)):
        raise ValueError(
            f"`q` must be a trajectory along which contacts stay open or closed, but {names[0]!r} changes. Take a part of it, as "
            "`motion[:20]`."
        )


class _Near:
    """A state of a system, its names, and the choices near it."""

    def __init__(self, system: System, at: Any, params: PyTree):
        t, q, qdot, states = at
        self.system, self.given = system, (t, q, qdot, params, states)
        self.values = start_values(system, states, t, q, qdot, params)
        self.at = StatesAt(self.values, t, ravel_pytree(q)[0], ravel_pytree(qdot)[0])
        self.flat: Flat = bind(system, q, params, self.at)
        self.entries = entry_names(q, "q")
        self.first_order, self.sampled = ({name: self.values[name] for name in of(system)} for of in (of_first_order, sampled))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coordinates, then of the states."""
        return (*self.entries, *entry_names(self.first_order), *entry_names(self.sampled))

    def choice(self, inputs: Sequence[str], outputs: Callable | None, independent: Any) -> Choice:
        """The inputs, the outputs and the independent coordinates."""
        if outputs is not None:
            check_function(outputs, "`outputs`")
        _, q, _, params, _ = self.given
        found = find_inputs(inputs, params, q, self.flat, self.sampled)
        moved, every = [entry.name for entry in found if entry.kind == "sampled"], entry_names(self.sampled)
        if moved and set(moved) != set(every):
            raise ValueError("`inputs` must name all sampled states or none, but leaves some out, which then had no law. Name them too.")
        loops = () if moved else tuple(Input(name, "sampled", i) for i, name in enumerate(every))
        return Choice((*found, *loops), outputs, self._partition(independent), len(loops))

    def _partition(self, independent: Any) -> Partition:
        if isinstance(independent, LinearSystem):
            return independent.coordinates.partition
        t, q, qdot, params, states = self.given
        G, positions, _ = jax.eval_shape(lambda: constraint_slopes(self.system, t, q, qdot, params, states))
        if not G.shape[0]:
            return partition(np.zeros(G.shape), 0)
        values = seen(self.given)
        if values is None:
            raise ValueError(HIDDEN)
        rows, _, off = jax.tree.map(np.asarray, constraint_slopes(self.system, *values))
        if not off <= np.sqrt(np.finfo(rows.dtype).eps):
            raise ValueError(f"`q` and `qdot` must satisfy the constraints, but are off by {off:.2g} of their size. {CURE}")
        return partition(rows, positions.shape[0], [i for name in listed(independent or ()) for i in self._entries_within(name)])

    def _entries_within(self, name):
        found = [i for i, entry in enumerate(self.entries) if is_within(entry, name)]
        if not found:
            raise ValueError(f"`independent` must name coordinates, but holds {name!r}. The coordinates are {', '.join(self.entries)}.")
        return found


CURE = "Put them there by `consistent_state`, or look for an equilibrium by `equilibrium` or `steady`."
HIDDEN = (
    "`independent` must be a `LinearSystem` under `jit`, which hides the numbers by which independent coordinates are chosen, but is not. "
    "Linearise once outside and pass the result: `independent=lin`."
)


def _linear_system(near: _Near, choice: Choice, found: Matrices, q: PyTree, qdot: PyTree, origin: Origin | None) -> LinearSystem:
    """The matrices as a `LinearSystem` with names; in discrete time if sampled states update themselves."""
    _, like, _, params, _ = near.given
    dynamics, y = dynamics_of(near.system, like, params, near.at, choice.inputs, choice.outputs)
    at = choice.partition
    positions, velocities = ([near.entries[i] for i in which] for which in at[:2])
    shapes = dynamics.output_shapes(y, near.flat.rows)
    multipliers = jax.eval_shape(near.flat.unravel_multipliers, jax.ShapeDtypeStruct((near.flat.rows,), y.q.dtype))
    rows = found.multipliers.by_state[..., : near.flat.rows, :]
    outputs = found.outputs
    system = LinearSystem(
        A=found.rates.by_state,
        B=found.rates.by_inputs[..., 0, :, :],
        C=outputs.by_state,
        D=outputs.by_inputs[..., 0, :, :],
        D_rates=outputs.by_inputs[..., 1:, :, :],
        basis=found.basis,
        constraint_forces=rows,
        mass=found.mass,
        q=q,
        qdot=qdot,
        origin=origin,
        sample_time=None,
        state_names=(*positions, *(f"{name}_dot" for name in velocities), *entry_names(near.first_order)),
        input_names=tuple(entry.name for entry in choice.inputs),
        output_names=entry_names(shapes, "q" if choice.outputs is None else "y"),
        coordinates=Coordinates(at, Layout.of(like), Layout.of(near.first_order), Layout.of(multipliers)),
    )
    if not choice.loops:
        return system
    closed = lambda updates, system: between_updates(near.system, params, near.sampled, updates, system)
    return (closed if origin is not None else jax.vmap(closed))(found.updates, system)
