"""Surfaces of the position across which forces or constraints jump or bend: where the functions of a system choose by q."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from .._model.flat import Flat, StatesAt, bind
from .._model.paths import leaf_names
from .._model.state_values import start_values
from .._model.system import System, role
from .._program.choices import choices

T, Q, V, LOAD = "t", "q", "q̇", "λ"  # no names of leaves of params


class Surface(NamedTuple):
    """A function of the system, as messages call it; what chooses there by q, in which line, and which leaves of params decide."""

    function: str
    what: str
    line: str
    params: frozenset[str]


def surfaces(system: System, q: PyTree, qdot: PyTree, params: PyTree, t: Any, states: Any) -> list[Surface]:
    """Surfaces of all functions, whose programs are read at this state; `states`: those that are given."""
    values = start_values(system, states, t, q, qdot, params)
    (at, v), t = (ravel_pytree(tree)[0] for tree in (q, qdot)), jnp.asarray(t, jax.tree.leaves(q)[0].dtype)
    numbers, rest = eqx.partition(params, eqx.is_inexact_array_like)
    names = leaf_names(numbers, "params")
    leaves, structure = jax.tree.flatten(numbers)
    multipliers = jnp.zeros(bind(system, q, params, StatesAt(values, t, at, v)).rows, at.dtype)
    found: dict[Surface, None] = {}
    for what, of in _functions(system):

        def function(t, at, v, multipliers, *leaves, of=of):
            flat = bind(system, q, eqx.combine(jax.tree.unflatten(structure, leaves), rest), StatesAt(values, t, at, v))
            return of(flat, t, at, v, multipliers)

        for chooses, line, by in choices(function, (t, T), (at, Q), (v, V), (multipliers, LOAD), *zip(leaves, names, strict=True)):
            if _by_position(by):
                found[Surface(what, chooses, line, by - {T, Q})] = None
    return list(found)


def bends_by_position(system: System, flat: Flat, t, q, v) -> bool:
    """Whether any function chooses by the position."""
    given = (jnp.asarray(t, q.dtype), T), (q, Q), (v, V), (jnp.zeros(flat.rows, q.dtype), LOAD)
    found = (choices(lambda *state, of=of: of(flat, *state), *given) for _, of in _functions(system))
    return any(_by_position(choice.by) for of_one in found for choice in of_one)


def _by_position(by: frozenset[str]) -> bool:
    """What a velocity or a constraint force decides too is dry friction's."""
    return Q in by and not by & {V, LOAD}


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
