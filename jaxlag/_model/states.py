"""Further states: those of first order, and those that change only at sample times."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._program.jit import is_concrete
from .injection import STATE_NAMES, check_function
from .numbers import Label, number, numbers
from .pickling import picklable, unpickled


@dataclasses.dataclass(frozen=True)
class Constant:
    """Numbers that are hashed and compared by their values."""

    structure: Any
    leaves: tuple[tuple[tuple[int, ...], tuple[float, ...]], ...]  # shape and numbers of each

    @classmethod
    def of(cls, given: Any, label: str) -> "Constant":
        """Of a number, an array or a pytree of them."""
        if not is_concrete(given):
            raise TypeError(f"{label} must be known when the system is created, but is traced. Give a function: `lambda z0: z0`.")
        is_leaf = lambda node: node is None or isinstance(node, list)
        leaves, structure = jax.tree.flatten(given, is_leaf=is_leaf)
        if not leaves:
            raise TypeError(f"{label} must hold at least one number, but is empty. Give a number, an array or a dict of them.")
        arrays = [np.asarray(numbers(leaf, Label(label.strip("`"), given, i, is_leaf))) for i, leaf in enumerate(leaves)]
        if not all(np.all(np.isfinite(x)) for x in arrays):
            raise ValueError(f"{label} must be finite, but has a NaN or an infinity. Give the value at the start.")
        return cls(structure, tuple((x.shape, tuple(x.ravel().tolist())) for x in arrays))

    @property
    def value(self) -> PyTree:
        """The numbers."""
        return jax.tree.unflatten(self.structure, [np.array(x).reshape(shape) for shape, x in self.leaves])


def _start(given: Any, label: str) -> Any:
    if callable(given):
        check_function(given, label)
        return given
    return given if isinstance(given, Constant) else Constant.of(given, label)


@dataclasses.dataclass(frozen=True)
class State:
    r"""A first-order state z in addition to q, for `System(states={"z": State(...)})`.

    $$ \dot z = r(t, q, \dot q, z, \dots) $$

    A low-pass actuator, the bristles of a friction model, an integrator of a controller, a temperature. All functions of the system may
    name `z`, including the rates of other states; if L or a constraint depends on z, its rate is part of d/dt. A state is driven and does
    not react on the mechanism: no force on q follows from ż. If it must react, as a gear does, state a velocity constraint between q̇ and a
    coordinate without mass.

    **Arguments:**

    - `rate`: ż, structured and shaped like z; it receives the arguments it names, out of `t`, `q`, `qdot`, `params`, the entries of
      `params` and the states.
    - `start`: z at the start: a number, an array or a pytree of them, or a function that receives what it names, out of `t`, `q`, `qdot`,
      `params` and the entries of `params`.

    Any consistent set of units. A position constraint g may depend on a state whose rate does not depend on q̇.

    **Raises:** `TypeError` if `rate` is no function or `start` holds no numbers.

    **Source:** Åström & Canudas de Wit, Revisiting the LuGre friction model, IEEE Control Systems Magazine 28 (2008) 101-114, as example.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    motor = jl.State(lambda z, command, tau: (command - z) / tau)  # a force that follows its command with a lag
    cart = jl.System(lambda qdot, m: 0.5 * m * qdot**2, force=lambda z: z, states={"z": motor})
    motion = jl.simulate(cart, 0.0, 0.0, jnp.linspace(0, 1, 11), {"m": 2.0, "command": 3.0, "tau": 0.5})
    motion.states["z"][-1]  # 3 (1 − e⁻²) = 2.594
    ```
    """

    rate: Callable
    start: Any = 0.0

    def __post_init__(self):
        check_function(self.rate, "`rate`")
        object.__setattr__(self, "start", _start(self.start, "`start`"))

    def __reduce__(self) -> Any:
        return _unpickled, (State, [_reference(x, label) for x, label in ((self.rate, "`rate`"), (self.start, "`start`"))])


@dataclasses.dataclass(frozen=True)
class Sampled:
    r"""A state u that changes only at sample times and is held in between, for `System(states={"u": Sampled(...)})`.

    $$ u_k = f(t_k, q, \dot q, u_{k-1}, \dots), \qquad t_k = t_0 + k T, \qquad u(t) = u_k \text{ for } t_k \le t < t_{k+1} $$

    A digital controller, a counter, a filter in discrete time; its memory is part of u. The first update is at the start of the motion, t₀
    = ts[0]. States of one system may have different periods; updates due at the same time all see the previous values. A sample of the
    motion at t_k shows u_k.

    **Arguments:**

    - `update`: u_k, structured and shaped like u; it receives the arguments it names, as the rate of a `State`.
    - `every`: the period T > 0: a number, or a function of `params` and its entries, which may be free in a fit.
    - `start`: u before the first update, as that of a `State`.

    Any consistent set of units. Derivatives with respect to T assume that no sample and no other update moves past an update.

    **Raises:** `TypeError` or `ValueError` if `update` is no function, `every` is missing or not positive, or `start` holds no numbers.

    **Source:** Åström & Wittenmark, Computer-Controlled Systems, 3rd ed., section 2.3.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    controller = jl.Sampled(lambda q, qdot, goal: 9.0 * (goal - q) - 3.0 * qdot, every=0.01)
    cart = jl.System(lambda qdot: 0.5 * qdot**2, force=lambda u: u, states={"u": controller})
    motion = jl.simulate(cart, 0.0, 0.0, jnp.linspace(0, 4, 41), {"goal": 2.0})
    motion.q[-1]  # 2.005
    motion.states["u"][0]  # 18.0
    ```
    """

    update: Callable
    every: Any
    start: Any = 0.0

    def __post_init__(self):
        check_function(self.update, "`update`")
        if callable(self.every):
            check_function(self.every, "`every`")
        else:
            if not is_concrete(self.every):
                raise TypeError("`every` must be known when the system is created, but is traced. Give a function: `lambda T: T`.")
            object.__setattr__(self, "every", float(number(self.every, "`every`", positive=True, cure="Give the period of the updates.")))
        object.__setattr__(self, "start", _start(self.start, "`start`"))

    def __reduce__(self) -> Any:
        parts = ((self.update, "`update`"), (self.every, "`every`"), (self.start, "`start`"))
        return _unpickled, (Sampled, [_reference(x, label) for x, label in parts])


def _reference(x: Any, label: str) -> Any:
    return picklable(x, label) if callable(x) else x


def _unpickled(kind: type, parts: list) -> Any:
    return kind(*map(unpickled, parts))


Named = tuple[tuple[str, State | Sampled], ...]


def states_of(given: Any) -> Named:
    """The states of a system by name, checked."""
    if given is None:
        return ()
    if not isinstance(given, Mapping):
        raise TypeError(f"`states` must be a mapping from names to `State` or `Sampled`, but is {given!r}. Name each state.")
    for name, state in given.items():
        if not isinstance(name, str) or not name.isidentifier() or not isinstance(state, (State, Sampled)):
            raise TypeError(
                f"`states` must map names to `State` or `Sampled`, but holds {state!r} under {name!r}. "
                "Write e.g. `states={'z': jaxlag.State(rate)}`."
            )
        if name in STATE_NAMES:
            raise ValueError(f"`states` must not have a state named {name!r}, but has one; that name is taken. Rename the state.")
    return tuple(given.items())


class Flowing(eqx.Module):
    """One leaf of a state around the time `at`: its value and its derivatives by time."""

    at: Float[Array, ""]
    derivatives: tuple[Array, ...]

    def __call__(self, t: Any) -> Array:
        """The state at t, which is `at`, but may be differentiated."""
        return flow(t, self.at, self.derivatives)


@jax.custom_jvp
def flow(t: Any, at: Any, derivatives: tuple[Array, ...]) -> Array:
    """x at t = `at`, of which are known x, ẋ, …: differentiated, it moves on with ẋ. By itself it does no arithmetic."""
    return derivatives[0]


@flow.defjvp
def _flow_rule(primals: Any, tangents: Any) -> Any:
    return flow(*primals), jax.jvp(_taylor, primals, tangents)[1]


def _taylor(t, at, derivatives):
    factorials = np.cumprod([1, *range(1, len(derivatives))])
    return sum(x * (t - at) ** k / factorials[k] if k else x for k, x in enumerate(derivatives))


def values_at(states: Mapping[str, PyTree], t: Any) -> dict[str, PyTree]:
    """States as they flow, at the time t."""
    is_flowing = lambda node: isinstance(node, Flowing)
    of_leaf = lambda node: node(t) if is_flowing(node) else node
    return {name: jax.tree.map(of_leaf, tree, is_leaf=is_flowing) for name, tree in states.items()}


def flowing(t: Any, *derivatives: PyTree) -> PyTree:
    """A state with its derivatives by time, as it flows."""
    return jax.tree.map(lambda *leaves: Flowing(jnp.asarray(t), tuple(map(jnp.asarray, leaves))), *derivatives)
