"""Surfaces across which functions of a system jump or bend: where they choose by the position, the time or a state."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from .._model.event import Event
from .._model.flat import Flat, StatesAt, bind, read_once
from .._model.numbers import count
from .._model.paths import leaf_names
from .._model.state_values import start_values
from .._model.system import System, role
from .._program.boundaries import Boundaries, boundaries
from .._program.choices import choices

T, Q, V, LOAD = "t", "q", "q̇", "λ"  # no names of leaves of params
CROSSING = Event(lambda: 0.0)  # what happens at each surface that is located: nothing but that the step ends


@dataclasses.dataclass(frozen=True)
class Located:
    r"""Steps end where a function of the system jumps or bends by the position, the time or a state. The default.

    $$ s(t^*, q, z) = 0: \qquad \ddot q(t^* - 0) \ne \ddot q(t^* + 0) $$

    The surfaces s are found in the programs of all functions of the system: x − y of a comparison x > y, as of `where` and `cond`, and of
    `maximum`, `minimum`, `clip`, `abs` and `sign`; places of `floor`, `round` and `mod`; each knot of a table that is looked up by
    `interp` or `searchsorted`. Each is located to rounding; up to there, forces are those of the side that the motion comes from, and the
    derivative of the motion has the jump that the surface brings (saltation). An end stop, play in a gear, a preload or a broken table
    need no `Event`.

    So are bends by a velocity in forces and rates of states, as where a controller saturates. Not located, but named by `examine`: jumps of
    forces by a velocity, as of friction that is written there; the largest of several numbers (`max` over an axis, `argmax`, `sort`);
    choices within the branches of `cond` and within `scan`. Where the motion comes to rest on a jump that pushes it back on either side, it
    rattles, and ends with a reason that says so. At a start on a surface the acceleration decides to which side the motion goes.

    **Arguments:** `most`: the number of surfaces from which on none is located, because each is looked at in each step. A table counts
    once, an array of n numbers n times.

    **Raises:** `TypeError` or `ValueError` if `most` is not a whole number of 0 or more.

    **Source:** Filippov, Differential Equations with Discontinuous Righthand Sides; Hiskens & Pai, IEEE Trans. Circuits Syst. I 47 (2000)
    204-220 (derivatives through surfaces).

    ```python
    import jax, jax.numpy as jnp
    import jaxlag as jl
    spring = lambda q, qdot, a, c: 0.5 * qdot**2 - 0.5 * c * jnp.maximum(q - a, 0.0) ** 2  # that one runs into at q = a
    last = lambda a: jl.simulate(jl.System(spring), 0.0, 1.0, jnp.array([0.0, 10.0]), {"a": a, "c": 4.0}).q[-1]
    jax.value_and_grad(last)(0.5)  # 0.5 − (9.5 − π/2) = −7.43, and 2
    ```
    """

    most: int = 32

    def __post_init__(self):
        count(self.most, "`most`", least=0, cure="The default is 32.")

    def levels(self, flat: Flat) -> tuple[int, ...]:
        """Of each surface, by how many others its function may jump."""
        found, _ = _known(flat)
        return found if len(found) <= self.most else ()


@dataclasses.dataclass(frozen=True)
class NotLocated:
    """Steps pass over surfaces across which functions of the system jump or bend: the error control makes them short there, and derivatives
    by what decides where a force jumps are wrong. Compiles in a third of the time.

    ```python
    import jaxlag as jl
    jl.surfaces.NotLocated()
    ```
    """

    def levels(self, flat: Flat) -> tuple[int, ...]:
        """None."""
        return ()


class Surface(NamedTuple):
    """A place at which a function of the system jumps or bends.

    - `function`: its name, as messages have it. `what`: what chooses there, e.g. "where". `line`: that of the user's code.
    - `params`: the names of those leaves of params that decide.
    - `located`: whether `Located()` finds it, so that steps end there.
    """

    function: str
    what: str
    line: str
    params: frozenset[str]
    located: bool


def surfaces(system: System, q: PyTree, qdot: PyTree, params: PyTree, t: Any, states: Any) -> list[Surface]:
    """Surfaces of all functions, whose programs are read at this state; `states`: those that are given."""
    values = start_values(system, states, t, q, qdot, params)
    (at, v), t = (ravel_pytree(tree)[0] for tree in (q, qdot)), jnp.asarray(t, jax.tree.leaves(q)[0].dtype)
    numbers, rest = eqx.partition(params, eqx.is_inexact_array_like)
    names = leaf_names(numbers, "params")
    leaves, structure = jax.tree.flatten(numbers)
    flat, found = bind(system, q, params, StatesAt(values, t, at, v)), dict[Surface, None]()
    few, (_, unknown) = bool(Located().levels(flat)), _known(flat)
    multipliers = jnp.zeros(flat.rows, at.dtype)
    for what, of in _functions(system):

        def function(t, at, v, multipliers, *leaves, of=of):
            flat = bind(system, q, eqx.combine(jax.tree.unflatten(structure, leaves), rest), StatesAt(values, t, at, v))
            return of(flat, t, at, v, multipliers)

        for chooses, line, by in choices(function, (t, T), (at, Q), (v, V), (multipliers, LOAD), *zip(leaves, names, strict=True)):
            if _decide(by):
                found[Surface(what, chooses, line, by - {T, Q}, few and line not in unknown)] = None
    return list(found)


def bends(flat: Flat) -> bool:
    """Whether there is any."""
    return read_once(flat, _chooses, stated=True)


def _chooses(flat, t, q, v):
    given = (t, T), (q, Q), (v, V), (jnp.zeros(flat.rows, q.dtype), LOAD)
    found = (choices(lambda *state, of=of: of(flat, *state), *given) for _, of in _functions(flat.source.system))
    return any(_decide(choice.by) for of_one in found for choice in of_one)


def with_surfaces(flat: Flat) -> Flat:
    """With the functions that pass through zero at surfaces among the witnesses of events, behind these."""

    def witnesses(t, q, v, multipliers):
        return jnp.concatenate([flat.witnesses(t, q, v, multipliers), surface_values(flat, t, q, v)])

    return flat._replace(witnesses=witnesses)


def surface_values(flat: Flat, t: Any, q: Any, v: Any) -> Array:
    """The functions that pass through zero at surfaces."""
    return _boundaries(flat, t, q, v).values


def _known(flat: Flat) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """The levels of all surfaces that are known as functions, and the lines in which there are others."""
    return read_once(flat, _levels_and_unknown, stated=True)


def _levels_and_unknown(flat, *state):
    _, levels, unknown = _boundaries(flat, *state)
    return levels, unknown


def _boundaries(flat: Flat, t: Any, q: Any, v: Any) -> Boundaries:
    given = (t, T), (q, Q), (v, V), (jnp.zeros(flat.rows, q.dtype), LOAD)
    of_all = lambda functions: lambda *state: [of(flat, *state) for of in functions]
    system = flat.source.system
    rates = {role("force", name) for name, _ in system.force} | {"`states`"}  # neither potentials nor constraints
    of_rates, others = ([of for name, of in _functions(system) if (name in rates) == is_rate] for is_rate in (True, False))
    found = boundaries(of_all(of_rates), _decide_rates, *given), boundaries(of_all(others), _decide, *given)
    return Boundaries(
        jnp.concatenate([of.values for of in found]), *(sum(both, ()) for both in zip(*(of[1:] for of in found), strict=True))
    )


def _decide_rates(by: frozenset[str], bends: bool) -> bool:
    """A force or a rate that bends by a velocity, as where a controller saturates, is no friction."""
    return _decide(by) or (bends and V in by and LOAD not in by)


def _decide(by: frozenset[str], bends: bool = False) -> bool:
    """Whether those with these marks decide: states flow with the time. What velocities or constraint forces decide is dry friction's."""
    return bool(by & {T, Q}) and not by & {V, LOAD}


def _functions(system: System) -> list[tuple[str, Any]]:
    """Each function by its name in messages, as one of (flat, t, q, v, λ)."""
    of_terms = [
        *((role("lagrangian", name), lambda flat, t, q, v, _, name=name: flat.lagrangians[name](t, q, v)) for name, _ in system.lagrangian),
        *((role("dissipation", name), lambda flat, *state, name=name: flat.dissipations[name](*state)) for name, _ in system.dissipation),
        *((role("force", name), lambda flat, *state, name=name: flat.forces[name](*state)) for name, _ in system.force),
    ]
    of_all = {
        "holonomic": lambda flat, t, q, v, _: flat.bilateral(t, q),
        "unilateral": lambda flat, t, q, v, _: flat.gaps(t, q),
        "nonholonomic": lambda flat, t, q, v, _: flat.nonholonomic(t, q, v),
        "states": lambda flat, t, q, v, _: flat.state_rates(t, q, v),
    }
    return of_terms + [(f"`{slot}`", of) for slot, of in of_all.items() if getattr(system, slot)]
