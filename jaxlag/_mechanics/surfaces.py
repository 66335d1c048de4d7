"""Surfaces of the position across which forces or constraints jump or bend: where the functions of a system choose by q."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from .._model.flat import Flat, StatesAt, bind
from .._model.paths import leaf_names
from .._model.system import System, role
from .._program.choices import choices

T, Q, V, LOAD = "t", "q", "q̇", "λ"  # no names of leaves of params


class Surface(NamedTuple):
    """A function of the system, as messages call it; what chooses there by q, in which line, and which leaves of params decide."""

    function: str
    what: str
    line: str
    params: frozenset[str]


def surfaces(system: System, like: PyTree, params: PyTree, at: StatesAt) -> list[Surface]:
    """Those of all functions; what chooses by a velocity or a constraint force too is dry friction's."""
    numbers, rest = eqx.partition(params, eqx.is_inexact_array_like)
    names = leaf_names(numbers, "params")
    numbers, structure = jax.tree.flatten(numbers)
    multipliers = jnp.zeros(bind(system, like, params, at).rows, at.q.dtype)
    found: dict[Surface, None] = {}
    for what, of in _functions(system):

        def function(t, q, v, multipliers, *numbers, of=of):
            flat = bind(system, like, eqx.combine(jax.tree.unflatten(structure, numbers), rest), at._replace(t=t, q=q, v=v))
            return of(flat, t, q, v, multipliers)

        marked = (jnp.asarray(at.t, at.q.dtype), T), (at.q, Q), (at.v, V), (multipliers, LOAD), *zip(numbers, names, strict=True)
        for chooses, line, by in choices(function, *marked):
            if Q in by and not by & {V, LOAD}:
                found[Surface(what, chooses, line, by - {T, Q})] = None
    return list(found)


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


def bends_by_position(flat: Flat, t, q, v) -> bool:
    """Whether any function chooses by q alone."""
    multipliers = jnp.zeros(flat.rows, q.dtype)
    everything = lambda t, q, v, multipliers: (
        *(L(t, q, v) for L in flat.lagrangians.values()),
        *(of(t, q, v, multipliers) for of in (*flat.dissipations.values(), *flat.forces.values())),
        flat.holonomic(t, q),
        flat.nonholonomic(t, q, v),
        flat.state_rates(t, q, v),
    )
    by = [choice.by for choice in choices(everything, (jnp.asarray(t, q.dtype), T), (q, Q), (v, V), (multipliers, LOAD))]
    return any(Q in marks and not marks & {V, LOAD} for marks in by)
