"""Motion, constraints and outputs of a system as vector functions of its whole state and inputs."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from .._mechanics.constrained_acceleration import constrained_acceleration
from .._mechanics.contact import in_current_mode
from .._mechanics.lagrange import imbalance, velocity_residual
from .._mechanics.massless import first_order, with_first_order_rates
from .._mechanics.saddle_point import Sound
from .._model.flat import Flat, StatesAt, bind
from .._model.injection import call
from .._model.signal import at_time
from .._model.state_values import Layout, of_first_order, ravelled, sampled
from .._model.system import System
from .._program.scalarise import scalarised
from .inputs import Input, Motion, moved_forces, moved_params, moved_states


class Whole(NamedTuple):
    """The whole state: q, q̇ and the first-order states z."""

    q: Float[Array, " n"]
    v: Float[Array, " n"]
    z: Float[Array, " k"]


class Forces(NamedTuple):
    """q̈ and λ, and whether they are determined."""

    qddot: Float[Array, " n"]
    multipliers: Float[Array, " l"]
    sound: Sound


class Balance(NamedTuple):
    """The quantities that follow from a state, q̈ and λ: M q̈ − f − Gᵀλ, G q̈ + γ, ż, the outputs, and the updates of sampled states."""

    imbalance: Float[Array, " n"]
    constraint_rate: Float[Array, " l"]
    z: Float[Array, " k"]
    outputs: Float[Array, " p"]
    updates: Float[Array, " s"]


@dataclasses.dataclass(frozen=True)
class Dynamics:
    """A system with its parameters at one time, whose state and inputs are moved."""

    system: System
    like: Layout  # of q
    states: Layout  # of first order, by name
    sampled: Layout  # states that change at sample times, by name
    params: PyTree
    t: Float[Array | np.ndarray, ""]
    held: Float[Array, " s"]  # values of the sampled states
    inputs: tuple[Input, ...] = ()
    outputs: Callable | None = None

    def at(self, y: Whole, motion: Motion) -> Flat:
        """The system over flat vectors at this state, with its inputs moved."""
        values = self.states.unravelled(y.z) | self.sampled.unravelled(moved_states(self.inputs, self.held, motion))
        flat = bind(self.system, self.like.shapes, self._params(motion), StatesAt(values, self.t, y.q, y.v))
        return moved_forces(self.inputs, flat, self.t, motion)

    def _params(self, motion):
        return moved_params(self.inputs, self.params, self.t, motion)

    def constraints(self, y: Whole, motion: Motion) -> tuple[Float[Array, " h"], Float[Array, " l"]]:
        """g and ψ, including the slip of dry friction that sticks, followed by the velocity errors of coordinates without inertia."""
        flat = self.at(y, motion)
        mode = in_current_mode(flat, self.t, y.q, y.v)
        z, *_ = first_order(mode)
        off = (y.v - with_first_order_rates(mode, self.t, y.q, y.v).v)[z]
        return mode.holonomic(self.t, y.q), jnp.concatenate([velocity_residual(mode, self.t, y.q, y.v), off])

    def forces(self, y: Whole, motion: Motion) -> Forces:
        """q̈ and λ of the state, with its inputs moved."""
        mode = in_current_mode(self.at(y, motion), self.t, y.q, y.v)
        return Forces(*scalarised(lambda t, q, v: constrained_acceleration(mode, t, q, v))(self.t, y.q, y.v))

    def balance(self, y: Whole, qddot: Array, multipliers: Array, motion: Motion) -> Balance:
        """The equations of motion and the quantities that go with them."""
        flat = self.at(y, motion)
        mode = in_current_mode(flat, self.t, y.q, y.v)
        off, constraint_rate = imbalance(mode, self.t, y.q, y.v, qddot, multipliers)
        return Balance(off, constraint_rate, *self.driven(y, qddot, multipliers, motion))

    def driven(self, y: Whole, qddot: Array, multipliers: Array, motion: Motion) -> tuple[Array, Array, Array]:
        """ż, the outputs, and the updates of sampled states."""
        flat = self.at(y, motion)
        z, updates = (ravelled(of(self.t, y.q, y.v), y.q.dtype) for of in (flat.state_rates, flat.updates))
        return z, self._outputs(flat, y, qddot, multipliers, motion), updates

    def rows_along(self, y: Whole, direction: Float[Array, " n"], motion: Motion) -> Float[Array, " l"]:
        """G times a direction."""
        mode = in_current_mode(self.at(y, motion), self.t, y.q, y.v)
        return jax.jvp(lambda v: velocity_residual(mode, self.t, y.q, v), (y.v,), (direction,))[1]

    def still(self) -> Motion:
        """Inputs that are not moved."""
        return (jnp.zeros(len(self.inputs), self.held.dtype),) * 3

    def _outputs(self, flat, y, qddot, multipliers, motion):
        return ravel_pytree(self._seen(flat, y, qddot, multipliers, motion))[0].astype(y.q.dtype)

    def _seen(self, flat, y, qddot, multipliers, motion):
        if self.outputs is None:
            return flat.unravel(y.q)
        states = self.states.unravelled(y.z) | self.sampled.unravelled(moved_states(self.inputs, self.held, motion))
        state = dict(t=self.t, q=flat.unravel(y.q), qdot=flat.unravel(y.v), qddot=flat.unravel(qddot))
        forces = flat.unravel_multipliers(multipliers)
        return call(
            self.outputs, "`outputs`", at_time(self._params(motion), self.t)[0], **state, multipliers=forces, **states, states=states
        )

    def output_shapes(self, y: Whole, rows: int) -> PyTree:
        """The shapes that the outputs return."""
        nothing = jnp.zeros(rows, y.q.dtype)
        return jax.eval_shape(lambda y: self._seen(self.at(y, self.still()), y, y.v, nothing, self.still()), y)


def dynamics_of(
    system: System, q: PyTree, params: PyTree, at: StatesAt, inputs: tuple[Input, ...] = (), outputs: Callable | None = None
) -> tuple[Dynamics, Whole]:
    """The system around a state, and the state."""
    z, u = ({name: at.values[name] for name in of(system)} for of in (of_first_order, sampled))
    dtype = at.q.dtype
    dynamics = Dynamics(system, Layout.of(q), Layout.of(z), Layout.of(u), params, at.t, ravelled(u, dtype), inputs, outputs)
    return dynamics, Whole(at.q, at.v, ravelled(z, dtype))
