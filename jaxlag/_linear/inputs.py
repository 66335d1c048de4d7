"""Inputs of a linearised system: entries of `params`, forces and residuals of constraints, moved away from their values."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._mechanics.contact import contact_rows
from .._model.flat import Flat, rows_by_name
from .._model.paths import entry_names, is_within, labels, leaf_names, listed
from .._model.signal import is_signal
from .._model.states import Flowing

Motion = tuple[Float[Array, " m"], Float[Array, " m"], Float[Array, " m"]]  # w, ẇ, ẅ: inputs and their rates, which constraints feel


class Input(NamedTuple):
    """One number that is moved: entry `number` of the object at `where`."""

    name: str
    kind: str  # "parameter", "signal", "force on a coordinate", "force", "holonomic", "nonholonomic" or "sampled"
    where: Any
    number: int = 0


def find_inputs(names: Sequence[str], params: PyTree, q: PyTree, flat: Flat, sampled: PyTree) -> tuple[Input, ...]:
    """The inputs that the names stand for, one for each number."""
    names, known = listed(names), list(_candidates(params, q, flat, sampled))
    found: list[Input] = []
    for name in names:
        meant = [entry for entry in known if is_within(entry.name, name)]
        kinds = dict.fromkeys((entry.kind, entry.where) if entry.kind in ("parameter", "signal") else entry.kind for entry in meant)
        if not meant:
            there = ", ".join(dict.fromkeys(entry.name for entry in known))
            raise ValueError(f"`inputs` must name what can be moved, but {name!r} names nothing. There are {there}.")
        if len({kind if isinstance(kind, str) else "parameter" for kind in kinds}) > 1:
            several = " and a ".join(dict.fromkeys(entry.kind for entry in meant))
            raise ValueError(f"`inputs` must name one thing each, but {name!r} names a {several}. Rename one of them.")
        found += meant
    if len({entry.name for entry in found}) < len(found):
        raise ValueError(f"`inputs` must name each input once, but names one twice: {', '.join(names)}. Remove one of the names.")
    return tuple(found)


def _candidates(params: PyTree, q: PyTree, flat: Flat, sampled: PyTree) -> Iterator[Input]:
    leaves = jax.tree.leaves(params, is_leaf=is_signal)
    for i, (name, leaf) in enumerate(zip(leaf_names(params, "params", is_signal), leaves, strict=True)):
        if is_signal(leaf):
            yield from (Input(label, "signal", i, k) for k, label in enumerate(labels(name, leaf.values.shape[1:])))
        elif jnp.issubdtype(getattr(leaf, "dtype", int), jnp.floating):
            yield from (Input(label, "parameter", i, k) for k, label in enumerate(labels(name, np.shape(leaf))))
    yield from (Input(name, "force on a coordinate", i) for i, name in enumerate(entry_names(q, "q")))
    yield from (Input(name, "force", name) for name in flat.forces)
    for name, rows in rows_by_name(flat).items():
        kind = "holonomic" if name in flat.holonomic_names else "nonholonomic"
        entries = [name] if len(rows) == 1 else [f"{name}[{k}]" for k in range(len(rows))]
        yield from (Input(entry, kind, int(row)) for entry, row in zip(entries, rows, strict=True))
    yield from (Input(name, "sampled", i) for i, name in enumerate(entry_names(sampled)))


def moved_params(inputs: tuple[Input, ...], params: PyTree, t: Any, motion: Motion) -> PyTree:
    """`params` with its inputs moved, each as a flow from t on."""
    leaves, structure = jax.tree.flatten(params, is_leaf=is_signal)
    for i in {entry.where for entry in inputs if entry.kind in ("parameter", "signal")}:
        own = [(number, entry) for number, entry in enumerate(inputs) if entry.where == i and entry.kind in ("parameter", "signal")]
        value = leaves[i].values if is_signal(leaves[i]) else jnp.asarray(leaves[i])
        shape = value.shape[1:] if is_signal(leaves[i]) else value.shape
        indices, numbers = [entry.number for _, entry in own], np.array([number for number, _ in own])
        by = [jnp.zeros(int(np.prod(shape)), value.dtype).at[np.array(indices)].set(w[numbers]).reshape(shape) for w in motion]
        flowing = Flowing(jnp.asarray(t), (value + by[0], *(jnp.broadcast_to(w, value.shape) for w in by[1:])))
        leaves[i] = eqx.tree_at(lambda signal: signal.values, leaves[i], flowing) if is_signal(leaves[i]) else flowing
    return jax.tree.unflatten(structure, leaves)


def moved_forces(inputs: tuple[Input, ...], flat: Flat, t: Any, motion: Motion) -> Flat:
    """The system with its forces and constraints moved: Q + u, (1 + u) Q, g = u, a = u."""
    w = Flowing(jnp.asarray(t), motion)
    place = lambda kind: [(i, entry.where) for i, entry in enumerate(inputs) if entry.kind == kind]

    def spread(kind, size):
        at = place(kind)
        numbers, rows = np.array([i for i, _ in at], int), np.array([row for _, row in at], int)
        return lambda t: jnp.zeros(size, motion[0].dtype).at[rows].add(w(t)[numbers])

    forces = dict(flat.forces)
    for i, name in place("force"):
        forces[name] = lambda t, q, v, multipliers, i=i, Q=flat.forces[name]: (1 + w(t)[i]) * Q(t, q, v, multipliers)
    if place("force on a coordinate"):
        forces["inputs"] = lambda t, q, v, multipliers: spread("force on a coordinate", q.size)(t)
    holonomic, bilateral, gaps, nonholonomic = flat.holonomic, flat.bilateral, flat.gaps, flat.nonholonomic
    if place("holonomic"):
        of_rows = spread("holonomic", flat.rows)
        holonomic = lambda t, q: (g := flat.holonomic(t, q)) - of_rows(t)[: g.size]
        bilateral = lambda t, q: flat.bilateral(t, q) - of_rows(t)[: flat.rows_of_bilateral]
        gaps = lambda t, q: flat.gaps(t, q) - contact_rows(flat, of_rows(t))
    if place("nonholonomic"):
        nonholonomic = lambda t, q, v: (a := flat.nonholonomic(t, q, v)) - spread("nonholonomic", flat.rows)(t)[flat.rows - a.size :]
    return flat._replace(forces=forces, holonomic=holonomic, bilateral=bilateral, gaps=gaps, nonholonomic=nonholonomic)


def moved_states(inputs: tuple[Input, ...], sampled: Float[Array, " s"], motion: Motion) -> Float[Array, " s"]:
    """The sampled states with their inputs moved, as if given from outside."""
    for i, entry in enumerate(inputs):
        sampled = sampled.at[entry.where].add(motion[0][i]) if entry.kind == "sampled" else sampled
    return sampled
