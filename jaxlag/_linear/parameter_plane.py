"""Steady states, and the motion near them, on a grid of two parameters."""

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from .._model.injection import call
from .._model.numbers import number, numbers, refuse_nan
from .._model.paths import entry_names, leaf_names
from .._model.state_values import given_states, start_values
from .._model.system import System
from .._model.validation import coordinates, parameters, state
from .._program.jit import is_concrete
from .matrices import Choice, Matrices, constraint_slopes, matrices
from .rest import Search, steady_state
from .root_locus import given_state
from .steadiness import a_little, moved_on, why_unsteady
from .tangent_space import partition


class Row(NamedTuple):
    """States at all values of the second parameter, along the first axis; whether they were found, and whether they stay as they are."""

    q: PyTree
    qdot: PyTree
    states: PyTree
    found: Bool[Array | np.ndarray, " b"]
    uniform: Bool[Array | np.ndarray, " b"]


class ParameterPlane:
    """A system over two of its parameters."""

    def __init__(self, system: System, q: Any, qdot: Any, params: PyTree, over: Mapping[str, Any], t: Any, states: PyTree):
        self.is_given = callable(q) or callable(qdot)
        like = coordinates(call(q, "`q`", params, t=0.0) if callable(q) else q, "q")
        self.system, self.q, self.qdot = system, q, qdot
        self.t = number(t, "`t`", jax.tree.leaves(like)[0].dtype, cure="Pass one time.")
        self.params, self.states = parameters(params, like), given_states(system, states, like)
        if not is_concrete(self.params, self.states, self.t, like):
            raise ValueError(
                "`params` must be known numbers, but are traced: a map of stability is not differentiable. "
                "Call `stability_map` from Python, and differentiate `linearise` or a crossing of `root_locus`."
            )
        self.names, self.values, self.indices = _two(over, self.params)
        refuse_nan(self.at(*(x[0] for x in self.values)))

    @property
    def shape(self) -> tuple[int, int]:
        """The number of values of each parameter."""
        return len(self.values[0]), len(self.values[1])

    def at(self, x: Any, y: Any) -> PyTree:
        """`params` with these two values."""
        leaves, structure = jax.tree.flatten(self.params)
        for i, value in zip(self.indices, (x, y), strict=True):
            leaves[i] = jnp.asarray(value, leaves[i].dtype)
        return jax.tree.unflatten(structure, leaves)

    def linearised(self) -> tuple[list[list[np.ndarray]], dict[tuple[int, int], str]]:
        """A at each point, and the reasons for missing points, by (i, j)."""
        rows, As, missing = self._rows(), [], {}
        choice, names = self._choice(rows)
        for i, (x, row) in enumerate(zip(self.values[0], rows, strict=True)):
            near, off = self._near(choice, x, row, np.zeros(self.shape[1]))
            A = np.asarray(near.rates.by_state)
            later, _ = self._near(choice, x, row, np.array([a_little(one) for one in A]))
            for j in range(self.shape[1]):
                soon = functools.partial(lambda later, j, _: _entry(later, j), later, j)
                if reason := self._why_missing(row, j, float(off[j])) or why_unsteady(_entry(near, j), soon, names):
                    missing[i, j] = reason
            As.append(list(A))
        return As, missing

    def _why_missing(self, row: Row, j: int, off: float) -> str:
        if not row.found[j]:
            return f"no {'equilibrium' if self.qdot is None else 'steady motion'} was found from that of a neighbour"
        if not row.uniform[j]:
            return "the motion that was found does not stay as it is"
        if not off <= np.sqrt(np.finfo(np.asarray(off).dtype).eps):
            return f"`q` and `qdot` must satisfy the constraints, but are off by {off:.2g} of their size."
        return ""

    def _rows(self) -> list[Row]:
        """The steady states: given by functions, or found from neighbours."""
        count, first = self.shape[1], self.values[0][0]
        if self.is_given:
            there = np.ones(count, bool)
            of = lambda x, y: (*given_state(self.q, self.qdot, self.t, self.at(x, y)), self.states)
            return [Row(*jax.vmap(of, in_axes=(None, 0))(x, self.values[1]), there, there) for x in self.values[0]]
        q = coordinates(self.q, "q")
        q, qdot = state(q, jax.tree.map(jnp.zeros_like, q) if self.qdot is None else self.qdot)
        values = start_values(self.system, self.states, self.t, q, qdot, self.params)
        running = () if self.qdot is None else tuple(int(i) for i in np.flatnonzero(np.asarray(ravel_pytree(qdot)[0])))
        every = lambda tree, j: jax.tree.map(lambda x: np.broadcast_to(x[j], (count, *x.shape[1:])), tree)
        near = every(jax.tree.map(lambda x: np.asarray(x)[None], (q, qdot, values)), 0)
        columns = []
        for j in range(count):  # the first row, one state after the other, with the program that finds a whole row
            columns.append(self._found(Search(running=running), first, near))
            near = every(columns[-1][:3], j) if columns[-1].found[j] else near
        rows = [jax.tree.map(lambda *leaves: np.stack([leaf[j] for j, leaf in enumerate(leaves)]), *columns)]
        near = _where(rows[0].found, rows[0][:3], near)
        for x in self.values[0][1:]:
            rows.append(self._found(Search(running=running), x, near))
            near = _where(rows[-1].found, rows[-1][:3], near)
        return rows

    def _found(self, search: Search, x: float, near: tuple) -> Row:
        """The steady states of a row, each from its own guess."""

        def one(y, q, qdot, states):
            given = self.system, self.t, q, qdot, self.at(x, y), states
            found = steady_state(search, *given)
            if found.friction:
                held = steady_state(search._replace(held=True), *given)
                found = jax.tree.map(lambda free, held: jnp.where(found.succeeded, free, held), found, held)
            return Row(found.q, found.qdot, found.states, found.succeeded, found.uniform)

        return jax.tree.map(np.asarray, jax.vmap(one)(self.values[1], *near))

    def _choice(self, rows: list[Row]) -> tuple[Choice, tuple[str, ...]]:
        """Independent coordinates, chosen at the first state that was found, and the names of coordinates and states."""
        i, j = next(((i, j) for i, row in enumerate(rows) for j in np.flatnonzero(row.found)), (0, 0))
        q, qdot, states = jax.tree.map(lambda leaf: leaf[j], rows[i][:3])
        params = self.at(self.values[0][i], self.values[1][j])
        G, positions, _ = constraint_slopes(self.system, self.t, q, qdot, params, states)
        values = start_values(self.system, states, self.t, q, qdot, params)
        at = partition(np.nan_to_num(np.asarray(G)), positions.shape[0])
        return Choice((), None, at, 0), (*entry_names(q, "q"), *entry_names(values))

    def _near(self, choice: Choice, x: float, row: Row, steps: np.ndarray) -> tuple[Matrices, Float[Array, " b"]]:
        """The motion near the states of a row, some time `steps` later, and their deviations from the constraints."""

        def one(y, q, qdot, states, step):
            at, params = moved_on((self.t, q, qdot, states), step.astype(self.t.dtype)), self.at(x, y)
            t, q, qdot, states = at
            return matrices(choice, self.system, t, q, qdot, params, states), constraint_slopes(self.system, t, q, qdot, params, states)[2]

        return jax.vmap(one)(self.values[1], *row[:3], steps)


def _entry(tree, j):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[j], tree)


def _where(found, new, old):
    return jax.tree.map(lambda a, b: np.where(found.reshape(-1, *(1,) * (a.ndim - 1)), a, b), new, old)


def _two(over, params):
    """Names and values of two parameters, and their indices in `params`."""
    names, leaves = leaf_names(params, "params"), jax.tree.leaves(params)
    if not isinstance(over, Mapping) or len(over) != 2:
        raise ValueError(f"`over` must be two names with their values, but is {over!r}. Write e.g. `{{'b1': [0, 1], 'b2': [0, 1, 2]}}`.")
    for name in over:
        if name not in names or np.shape(leaves[names.index(name)]):
            raise ValueError(f"`over` must name two numbers of `params`, but holds {name!r}. The entries are {', '.join(names)}.")
    values = [np.asarray(numbers(x, f"`over[{name!r}]`")) for name, x in over.items()]
    for name, x in zip(over, values, strict=True):
        if x.ndim != 1 or len(x) < 2 or not np.all(np.diff(x) > 0):
            raise ValueError(
                f"`over[{name!r}]` must be at least two numbers that increase, but is not. Write e.g. `jnp.linspace(0, 1, 21)`."
            )
    first, second = over
    return (first, second), (values[0], values[1]), (names.index(first), names.index(second))
