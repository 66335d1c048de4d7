"""Names of what a pytree holds: its leaves, their numbers, and what lies within a name."""

from collections.abc import Callable, Iterable
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree


def leaf_names(tree: PyTree, bare: str = "q", is_leaf: Callable[[Any], bool] | None = None) -> tuple[str, ...]:
    """The leaves by their paths, e.g. "wheel.phi"; `bare` names a leaf without a path."""
    leaves = jax.tree_util.tree_flatten_with_path(tree, is_leaf)[0]
    paths = [jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in leaves]
    return tuple(path or bare for path in paths)


def entry_names(tree: PyTree, bare: str = "") -> tuple[str, ...]:
    """A name for each number of a pytree of arrays, in flat order: "arm.l", "c[1]"; `bare` names a number without a path."""
    named = zip(leaf_names(tree, bare), jax.tree.leaves(tree), strict=True)
    return tuple(label for name, leaf in named for label in labels(name, np.shape(leaf)))


def labels(name: str, shape: tuple[int, ...]) -> list[str]:
    """A label for each number of an array, e.g. "c[1]"; of a single number, its name."""
    return [f"{name}[{', '.join(map(str, index))}]" for index in np.ndindex(shape)] if shape else [name]


def is_within(entry: str, name: str) -> bool:
    """Whether the entry is the one named, or part of it."""
    return entry == name or entry.startswith((f"{name}.", f"{name}["))


def listed(names: str | Iterable[Any]) -> tuple[Any, ...]:
    """The names in a list; a string is one name."""
    return (names,) if isinstance(names, str) else tuple(names)
