"""What of a system becomes an FMU: its equations as functions of vectors, and the names of their numbers."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from .._mechanics.friction_elements import find_elements, unread_friction
from .._mechanics.lagrange import applied_force, constraint_rows, inertia, smooth_force
from .._model.flat import Flat, StatesAt, bind
from .._model.paths import entry_names
from .._model.signal import is_signal
from .._model.state_values import given_states, of_first_order, ravelled, sampled, start_values
from .._model.system import System
from .._model.validation import check, parameters, state, without_contacts, without_events
from .._program.size_of_terms import size_of_terms

Parts = tuple[Array, ...]  # t, q, q̇, further states, parameters


class ExportedMotion(NamedTuple):
    """The motion of a system as functions of t, q, q̇, further states and parameters:

    A (q̈, λ) = b,  g = 0,  ψ = 0, where the first columns of A are M and, below it, G of ψ.
    """

    q: list[str]  # names
    states: list[str]
    params: list[str]
    multipliers: list[str]  # of their constraints
    dependent: list[str]  # coordinates that follow from q
    units: dict[str, str]  # as the system states them
    start: np.ndarray  # of t, q, q̇, states, parameters
    equations: Callable[[Parts, Array], tuple[Array, Array, Array]]  # A, b and the rates of the states, by the multipliers in A and b
    constraints: Callable[[Parts], tuple[Array, Array, Array]]  # g, ψ, and the size of the terms of g
    positions: Callable[[Parts], Array]  # of the dependent coordinates, by t, q and parameters

    def parts(self, x: Float[Array, " k"]) -> Parts:
        """The parts of a vector of all."""
        n, k = len(self.q), len(self.states)
        return x[0], x[1 : n + 1], x[n + 1 : 2 * n + 1], x[2 * n + 1 : 2 * n + k + 1], x[2 * n + k + 1 :]

    @property
    def rows(self) -> tuple[int, int]:
        """How many rows g and ψ have."""
        g, psi, _ = jax.eval_shape(lambda x: self.constraints(self.parts(x)), jnp.asarray(self.start))
        return g.size, psi.size


class Start(NamedTuple):
    """A system that an FMU can hold, and its start in double precision."""

    q: PyTree
    qdot: PyTree
    params: PyTree  # the numbers alone
    rest: PyTree  # of the parameters
    states: dict[str, PyTree]
    flat: Flat

    @classmethod
    def of(cls, system: System, q0: PyTree, qdot0: PyTree, params: PyTree, states: Any) -> "Start":
        """The start, after the checks."""
        without_contacts(system, "an FMU")
        without_events(system, "an FMU")
        for name in sampled(system):
            raise ValueError(f"`system` must have no sampled states in an FMU, but has {name!r}. Leave the controller to the master.")
        q0, qdot0 = state(double_precision(q0), double_precision(qdot0), ("q0", "qdot0"))
        params = parameters(double_precision(params), q0)
        numbers, rest = separated(params)
        t, given = jnp.zeros(()), given_states(system, double_precision(states), q0)
        values = start_values(system, given, t, q0, qdot0, params)
        check(system, t, q0, qdot0, params, values)
        (q, _), (v, _) = map(ravel_pytree, (q0, qdot0))
        flat = bind(system, q0, params, StatesAt(values, t, q, v))
        _refuse_friction(flat, t, q, v)
        found = cls(q0, qdot0, numbers, rest, {name: values[name] for name in of_first_order(system)}, flat)
        for name, x in zip(("q0", "qdot0", "params", "states"), found.numbers, strict=True):
            if not np.all(np.isfinite(x)):
                raise ValueError(f"`{name}` must be finite in an FMU, but is not. Its numbers are the values at the start.")
        return found

    @property
    def numbers(self) -> list[np.ndarray]:
        """q, q̇, parameters and states as vectors."""
        return [np.asarray(ravel_pytree(part)[0], float) for part in self[:3]] + [np.asarray(ravel_pytree(self.states)[0], float)]

    @property
    def multipliers(self) -> list[str]:
        """Their names, in the order of the rows."""
        rows = self.flat.unravel_multipliers(jnp.arange(self.flat.rows, dtype=float))
        names = dict(zip(np.asarray(ravel_pytree(rows)[0]).astype(int), entry_names(rows), strict=True))
        return [names[row] for row in sorted(names)]


def exported_system(system: System, q0: PyTree, qdot0: PyTree, params: PyTree, states: Any) -> ExportedMotion:
    """All coordinates of a system, with all its constraints."""
    start = Start.of(system, q0, qdot0, params, states)
    q, v, p, s = start.numbers
    unravel, unravel_states = (ravel_pytree(part)[1] for part in (start.params, start.states))
    states_at = lambda t, q, v, s: StatesAt(unravel_states(s), t, q, v)
    bound = lambda t, q, v, s, p: bind(system, start.q, eqx.combine(unravel(p), start.rest), states_at(t, q, v, s))
    return ExportedMotion(
        q=list(entry_names(start.q, "q")),
        states=list(entry_names(start.states)),
        params=list(entry_names(start.params, "params")),
        multipliers=start.multipliers,
        dependent=[],
        units=dict(system.units),
        start=np.concatenate([np.zeros(1), q, v, s, p]),
        equations=lambda parts, multipliers: _equations(system, bound(*parts), multipliers, *parts[:3]),
        constraints=lambda parts: constraint_values(bound(*parts).holonomic, bound(*parts).nonholonomic, *parts[:3]),
        positions=lambda parts: jnp.zeros(0),
    )


def double_precision(tree: PyTree) -> PyTree:
    """The numbers in double precision; lists of numbers stay what they are."""
    is_plain = lambda x: isinstance(x, (float, int)) and not isinstance(x, bool)
    wide = lambda x: np.float64(x) if is_plain(x) else np.asarray(x, np.float64) if eqx.is_inexact_array_like(x) else x
    plain = lambda node: dict(node) if isinstance(node, Mapping) else node
    return jax.tree.map(lambda node: wide(plain(node)), tree)


def separated(params: PyTree) -> tuple[PyTree, PyTree]:
    """The numbers, which become variables of the FMU, and the rest.

    **Raises:** `ValueError` if there are measured inputs.
    """
    for path, node in jax.tree_util.tree_flatten_with_path(params, is_leaf=is_signal)[0]:
        if is_signal(node):
            raise ValueError(
                f"`params` must hold numbers in an FMU, but {jax.tree_util.keystr(path, simple=True, separator='.')!r} is a `Signal`. "
                "Let the functions read a number in its place, and name it in `inputs`: the master then gives its values."
            )
    return eqx.partition(params, eqx.is_inexact_array_like)


def _refuse_friction(flat: Flat, t: Any, q: Any, v: Any) -> None:
    elements = find_elements(flat)
    if elements is not None:
        raise ValueError(
            f"`system` must have no dry friction in an FMU, but `dissipation` has it in {', '.join(map(repr, elements.rows_of_term))}. "
            "Leave it out, or write a smooth function, such as F √(v² + w²) with a small velocity w."
        )
    for finding in unread_friction(flat, t, q, v):
        raise ValueError(f"`system` must have no dry friction in an FMU, but {finding}. Leave it out, or write a smooth function.")


def _equations(system: System, flat: Flat, multipliers: Any, t: Any, q: Any, v: Any) -> tuple[Array, Array, Array]:
    M, (_, G, gamma) = inertia(flat, t, q, v).as_matrix(), constraint_rows(flat, t, q, v)
    f, right = smooth_force(flat, t, q, v), -G.T
    if flat.needs_multipliers and flat.rows:
        right = right - jax.jacfwd(lambda multipliers: applied_force(flat, t, q, v, multipliers))(multipliers)
    A = jnp.block([[M, right], [G, jnp.zeros((flat.rows, flat.rows))]])
    rates = flat.state_rates(t, q, v)
    return A, jnp.concatenate([f, -gamma]), ravelled([rates[name] for name in of_first_order(system)], q.dtype)


def constraint_values(holonomic: Callable, nonholonomic: Callable, t: Any, q: Any, v: Any) -> tuple[Array, Array, Array]:
    """g, ψ, and the size of the terms of g."""
    g, rate = jax.jvp(holonomic, (t, q), (jnp.ones_like(t), v))
    sizes = size_of_terms(lambda q: holonomic(t, q), q) if g.size else g
    return g, jnp.concatenate([rate, nonholonomic(t, q, v)]), sizes
