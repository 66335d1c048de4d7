"""Values of the further states: at the start, as vectors, and what their functions return."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from .injection import call
from .numbers import Label, in_dtype, numbers
from .states import Sampled, State
from .system import System


class Layout(NamedTuple):
    """How a vector is made of a pytree: its structure, and shape and dtype of each leaf."""

    structure: Any
    leaves: tuple[tuple[tuple[int, ...], Any], ...]

    @classmethod
    def of(cls, tree: PyTree) -> "Layout":
        """That of a pytree of arrays."""
        leaves, structure = jax.tree.flatten(tree)
        return cls(structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves))

    @property
    def size(self) -> int:
        """The length of the vector."""
        return sum(math.prod(shape) for shape, _ in self.leaves)

    @property
    def shapes(self) -> PyTree:
        """The pytree in shapes alone."""
        return jax.tree.unflatten(self.structure, [jax.ShapeDtypeStruct(*leaf) for leaf in self.leaves])

    def unravelled(self, vector: Float[Array, " n"]) -> PyTree:
        """The pytree of a vector."""
        parts = jnp.split(vector, np.cumsum([math.prod(shape) for shape, _ in self.leaves])[:-1]) if self.leaves else []
        arrays = [part.reshape(shape).astype(dtype) for part, (shape, dtype) in zip(parts, self.leaves, strict=True)]
        return jax.tree.unflatten(self.structure, arrays)


NOTHING = Layout.of({})


def ravelled(tree: PyTree, dtype: Any) -> Float[Array, " n"]:
    """The vector of a pytree, also of one without leaves."""
    return ravel_pytree(tree)[0].astype(dtype)


def of_first_order(system: System) -> dict[str, State]:
    """The states with a rate, by name."""
    return {name: state for name, state in system.states if isinstance(state, State)}


def sampled(system: System) -> dict[str, Sampled]:
    """The states that change only at sample times, by name."""
    return {name: state for name, state in system.states if isinstance(state, Sampled)}


def period(system: System, name: str, params: PyTree) -> Float[Array, ""]:
    """The period of a sampled state."""
    every = sampled(system)[name].every
    label = f"`every` of state {name!r}"
    found = jnp.asarray(call(every, label, params) if callable(every) else every)
    if found.shape != ():
        raise ValueError(f"{label} must be one number, but has shape {found.shape}. Return the period of the updates.")
    return found


def given_states(system: System, given: Any, like: PyTree) -> dict[str, PyTree]:
    """The values of states that a user gives by name, as arrays in the precision of the coordinates."""
    if given is None:
        return {}
    known, dtype = [name for name, _ in system.states], jax.tree.leaves(like)[0].dtype
    if not isinstance(given, Mapping) or not set(given) <= set(known):
        what = sorted(map(str, set(given) - set(known))) if isinstance(given, Mapping) else given
        raise ValueError(f"`states` must give values of states by name, but holds {what}. The system has {', '.join(known) or 'none'}.")
    is_leaf = lambda node: isinstance(node, list)
    leaves, structure = jax.tree.flatten(dict(given), is_leaf=is_leaf)
    arrays = [in_dtype(numbers(leaf, Label("states", given, i, is_leaf)), dtype) for i, leaf in enumerate(leaves)]
    return jax.tree.unflatten(structure, arrays)


def start_values(system: System, given: Mapping[str, PyTree], t: Any, q: PyTree, qdot: PyTree, params: PyTree) -> dict[str, PyTree]:
    """The states at the start: those given, and for others what the system says."""
    dtype = jax.tree.leaves(q)[0].dtype
    found = {}
    for name, state in system.states:
        label = f"`start` of state {name!r}"
        value = call(state.start, label, params, t=t, q=q, qdot=qdot) if callable(state.start) else state.start.value
        own = jax.tree.map(lambda x: jnp.asarray(x, dtype), value)
        found[name] = shaped_like(f"`states[{name!r}]`", own, given[name]) if name in given else own
    return found


def shaped_like(label: str, like: PyTree, given: PyTree) -> PyTree:
    """What a rate, an update or a user gives for a state, which must be shaped like it; lists of numbers stand for vectors."""
    structure: Any = jax.tree.structure(like)
    try:
        parts = structure.flatten_up_to(given)
    except ValueError:
        have = jax.tree.structure(given)
        raise ValueError(f"{label} must be structured like the state, {structure}, but is {have}. Give every part of it.") from None
    leaves = [jnp.stack(part) if isinstance(part, (list, tuple)) else part for part in parts]
    for own, leaf in zip(jax.tree.leaves(like), leaves, strict=True):
        if not hasattr(leaf, "shape") or leaf.shape != own.shape:
            have = leaf.shape if hasattr(leaf, "shape") else type(leaf).__name__
            raise ValueError(f"{label} must have the shape of the state, {own.shape}, but has {have}. Give `start` that shape, too.")
    return jax.tree.unflatten(structure, [jnp.asarray(leaf, own.dtype) for own, leaf in zip(jax.tree.leaves(like), leaves, strict=True)])
