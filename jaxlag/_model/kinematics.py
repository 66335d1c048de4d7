"""Kinematics: velocities and generalized forces of points and angles, from their position maps alone; changes of coordinates."""

import dataclasses
import inspect
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._program.jit import is_concrete
from .contact import Contact
from .flat import flat_like
from .injection import asks_for, call, check_function, needs
from .numbers import numbers
from .states import Sampled, State, values_at
from .system import System, Terms, role


def rate(coordinate: Callable) -> Callable:
    r"""Velocity of a point or rate of an angle, as a function of the state, from its position map.

    $$ \dot x = \frac{\partial x}{\partial q}\,\dot q + \frac{\partial x}{\partial t} $$

    **Arguments:** `coordinate`: the position x(t, q), a number, a vector or any pytree; it receives the arguments it names, out of
    `t`, `q`, `params` and the entries of `params`.

    **Returns:** a function of `(t, q, qdot, params)`, whose value has the structure and shapes of x. Entries of params may be given by
    name, and t omitted if x does not name it: `rate(x)(q=..., qdot=..., l=1.0)`. If x depends on states of the system, the function that
    calls the rate names `states` and passes it on as a fifth argument. Any consistent units.

    **Raises:** `TypeError` if `coordinate` is no hashable function; when the rate is called, `TypeError` if t, q or qdot is missing.

    **Source:** Goldstein, Classical Mechanics, 3rd ed., eq. 1.46.

    ```python
    import jaxlag as jl
    front = lambda q, a: q["y"] + a * q["phi"]
    state = {"y": 0.5, "phi": 0.1}, {"y": 2.0, "phi": -1.0}
    jl.rate(front)(0.0, *state, {"a": 1.5})  # ẏ + a φ̇ = 0.5
    ```
    """
    check_function(coordinate, "`coordinate`")
    return _Rate(coordinate)


def virtual_work(coordinate: Callable, effort: Any) -> Callable:
    r"""Generalized force of a force on a point, or of a moment on an angle, for `System(force=...)`.

    $$ \delta W = F \cdot \delta x, \qquad Q_j = F \cdot \frac{\partial x}{\partial q_j} $$

    **Arguments:**

    - `coordinate`: the position x(t, q) of the point, or the angle; a number, a vector or any pytree.
    - `effort`: the force or moment that does work on x, with the structure and shapes of x: a number, a sequence of numbers, or a
      function, which receives the arguments it names, out of `t`, `q`, `qdot`, `multipliers`, `params` and the entries of `params`.

    **Returns:** a function for `System(force=...)`; its value is structured like q. Any consistent units.

    **Raises:** `TypeError` if `coordinate` or `effort` is of a wrong kind; when the force is first computed, `ValueError` if the
    effort is not structured like the coordinate.

    **Source:** Goldstein, Classical Mechanics, 3rd ed., eq. 1.49.

    ```python
    import jaxlag as jl
    # a wheel of radius r that rolls without slip turns by φ = −x/r; a moment −M0 on φ pushes the car with M0/r
    drive = jl.virtual_work(lambda q, r: -q["x"] / r, lambda M0: -M0)
    car = jl.System(lambda qdot, m: 0.5 * m * qdot["x"] ** 2, force={"drive": drive})
    jl.acceleration(car, {"x": 0.0}, {"x": 0.0}, {"m": 10.0, "r": 0.5, "M0": 20.0}).qddot["x"]  # 4.0
    ```
    """
    check_function(coordinate, "`coordinate`")
    if not callable(effort):
        return _VirtualWork(coordinate, _Constant.of(effort))
    check_function(effort, "`effort`")
    return _VirtualWork(coordinate, effort)


def substitute(system: System, coordinates: Callable) -> System:
    r"""The same system in new generalized coordinates: L, D, Q, g and a are pulled back along x = x(t, q).

    $$ L'(t, q, \dot q) = L(t, x, \dot x), \qquad Q' = \left(\frac{\partial x}{\partial q}\right)^T Q, \qquad
       \dot x = \frac{\partial x}{\partial q}\,\dot q + \frac{\partial x}{\partial t} $$

    With fewer new coordinates than old ones this eliminates constraints: x(t, q) is the solution of the constraint equations
    (Bindungsgleichungen), and their forces do no work.

    **Arguments:**

    - `system`: the `System` in the old coordinates x.
    - `coordinates`: x(t, q), with the structure and shapes of the old coordinates; it receives the arguments it names, out of `t`, `q`,
      `params` and the entries of `params`. Time may appear.

    **Returns:** a `System` in the new coordinates q, whose terms keep their names. Any consistent units.

    **Raises:** `TypeError` if `coordinates` is no hashable function.

    **Source:** Goldstein, Classical Mechanics, 3rd ed., section 1.4; Lurie, Analytical Mechanics, section 1.4.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    mass = jl.System(lambda q, qdot, m, g: 0.5 * m * qdot @ qdot - m * g * q[1])  # in x and y
    pendulum = jl.substitute(mass, lambda q, l: l * jnp.stack([jnp.sin(q), -jnp.cos(q)]))  # in the angle
    jl.acceleration(pendulum, 0.5, 0.0, {"m": 1.0, "g": 9.81, "l": 2.0}).qddot  # −(g/l) sin φ = −2.35
    ```
    """

    check_function(coordinates, "`coordinates`")
    for name, _ in system.events:
        raise ValueError(f"`system` must have no events in `substitute`, but has {name!r}. Write them in the new coordinates.")

    def pulled(slot: str, kind: type) -> dict[str, Callable]:
        terms: Terms = getattr(system, slot)
        return {name: kind(function, coordinates, role(slot, name)) for name, function in terms}

    return System(
        pulled("lagrangian", _PulledBack),
        dissipation=pulled("dissipation", _PulledBack),
        force=pulled("force", _PulledForce),
        holonomic=pulled("holonomic", _PulledPosition),
        unilateral={
            name: Contact(gap, dict(system.restitution)[name], dict(system.laws)[name])
            for name, gap in pulled("unilateral", _PulledPosition).items()
        },
        nonholonomic=pulled("nonholonomic", _PulledBack),
        one_sided=system.one_sided,
        states={name: _pulled_state(state, coordinates) for name, state in system.states},
        units=dict(system.units),
    )


def _pulled_state(state: State | Sampled, coordinates: Callable) -> State | Sampled:
    """A state that is driven by the old coordinates."""
    pulled = lambda given, what: _PulledBack(given, coordinates, f"`{what}`") if callable(given) else given
    driven = callable(state.start) and (needs(state.start, "q") or needs(state.start, "qdot"))
    start = pulled(state.start, "start") if driven else state.start
    if isinstance(state, State):
        return State(pulled(state.rate, "rate"), start)
    return Sampled(pulled(state.update, "update"), state.every, start)


class _Composed:
    """A function of the state composed of a user's functions: its signature names what they need, so it too is called by names."""

    @property
    def __signature__(self) -> inspect.Signature:
        kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
        states = inspect.Parameter("states", kind, default=None)
        return inspect.Signature([*(inspect.Parameter(name, kind) for name in self._names()), states])

    def _names(self) -> tuple[str, ...]:
        raise NotImplementedError

    @property
    def composed_of(self) -> tuple[Callable, ...]:
        """The user's functions."""
        parts = (getattr(self, field.name) for field in dataclasses.fields(self))  # type: ignore[arg-type]
        return tuple(part for part in parts if callable(part))


def _multipliers_of(function: Callable) -> tuple[str, ...]:
    return ("multipliers",) if asks_for(function, "multipliers") else ()


def _at(t: Any, states: dict[str, Any] | None) -> dict[str, Any]:
    """The states at the time t, by name, and as they flow for functions that are composed in their turn."""
    return values_at(states or {}, t) | {"states": states}


def _with_velocity(coordinate: Callable, label: str, t: Any, q: Any, qdot: Any, params: Any, states: Any) -> tuple[Any, Any]:
    """A position and its velocity, by one `jvp`."""
    t = jnp.asarray(t, jnp.result_type(*jax.tree.leaves(q), 1.0))
    q, qdot = (jax.tree.map(lambda leaf: jnp.asarray(leaf, t.dtype), tree) for tree in (q, qdot))
    return jax.jvp(lambda t, q: call(coordinate, label, params, t=t, q=q, **_at(t, states)), (t, q), (jnp.ones_like(t), qdot))


@dataclasses.dataclass(frozen=True)
class _Rate(_Composed):
    coordinate: Callable

    def _names(self):
        return ("t", "q", "qdot", "params")

    def __call__(self, t=None, q=None, qdot=None, params=None, states=None, **entries):
        if entries and not (params is None or isinstance(params, Mapping)):
            raise TypeError(f"`params` must be a mapping where its entries are named, but is a {type(params).__name__}. Pass it alone.")
        params = {**(params or {}), **entries} if entries else params
        if t is None and not asks_for(self.coordinate, "t"):
            t = 0.0
        for name, value in (("t", t), ("q", q), ("qdot", qdot)):
            if value is None:
                raise TypeError(f"a rate must be given t, q and qdot, but `{name}` is missing. Call it `rate(x)(t, q, qdot, params)`.")
        return _with_velocity(self.coordinate, "`coordinate`", t, q, qdot, params, states)[1]


@dataclasses.dataclass(frozen=True)
class _Constant:
    value: Any  # a number, or tuples of them

    @classmethod
    def of(cls, effort: Any) -> "_Constant":
        if not is_concrete(effort):
            raise TypeError("`effort` must be known when it is given, but is traced. Make it an entry of params: `lambda F: F`.")
        return cls(_tuples(np.asarray(numbers(effort, "`effort`")).tolist()))

    def __call__(self):
        return np.asarray(self.value)


@dataclasses.dataclass(frozen=True)
class _VirtualWork(_Composed):
    coordinate: Callable
    effort: Callable

    def _names(self):
        return ("t", "q", "qdot", "params", *_multipliers_of(self.effort))

    def __call__(self, t, q, qdot, params, states=None, **multipliers):
        x, pull = jax.vjp(lambda q: _vectors(call(self.coordinate, "`coordinate`", params, t=t, q=q, **_at(t, states))), q)
        effort = _vectors(call(self.effort, "`effort`", params, t=t, q=q, qdot=qdot, **_at(t, states), **multipliers))
        need, have = (jax.tree.map(jnp.shape, tree) for tree in (x, effort))
        if need != have:
            raise ValueError(
                f"`effort` must be structured like its `coordinate`, {need}, but is {have}. Give a force the components of its point."
            )
        return pull(jax.tree.map(lambda force, position: jnp.asarray(force, position.dtype), effort, x))[0]


@dataclasses.dataclass(frozen=True)
class _PulledBack(_Composed):
    """L, D or a of the old coordinates."""

    function: Callable
    coordinates: Callable
    label: str

    def _names(self):
        return ("t", "q", "qdot", "params", *_multipliers_of(self.function))

    def __call__(self, t, q, qdot, params, states=None, **multipliers):
        x, xdot = map(_vectors, _with_velocity(self.coordinates, "`coordinates`", t, q, qdot, params, states))
        return call(self.function, self.label, params, t=t, q=x, qdot=xdot, **_at(t, states), **multipliers)


class _PulledPosition(_PulledBack):
    """g of the old coordinates."""

    def _names(self):
        return ("t", "q", "params")

    def __call__(self, t, q, params, states=None):
        x = _vectors(call(self.coordinates, "`coordinates`", params, t=t, q=q, **_at(t, states)))
        return call(self.function, self.label, params, t=t, q=x, **_at(t, states))


class _PulledForce(_PulledBack):
    """Q of the old coordinates, mapped to the new ones by equal virtual work."""

    def __call__(self, t, q, qdot, params, states=None, **multipliers):
        force = super().__call__(t, q, qdot, params, states, **multipliers)
        x, pull = jax.vjp(lambda q: _vectors(call(self.coordinates, "`coordinates`", params, t=t, q=q, **_at(t, states))), q)
        return pull(ravel_pytree(x)[1](flat_like(x, self.label, force)))[0]


def _vectors(tree: Any) -> Any:
    """A pytree with its lists and plain tuples of numbers as vectors: a point (x, 0.0) is one."""
    is_number = lambda x: isinstance(x, (jax.Array, np.ndarray)) and x.shape == ()
    is_vector = lambda node: type(node) in (list, tuple) and len(node) > 0 and all(map(is_number, node))
    return jax.tree.map(lambda node: jnp.stack(node) if is_vector(node) else node, tree, is_leaf=is_vector)


def _tuples(lists: Any) -> Any:
    return tuple(map(_tuples, lists)) if isinstance(lists, list) else lists
