"""Results as plain data that other programs read: named arrays, tables, JSON."""

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from .._model.paths import leaf_names

FORMAT = 1  # of the files


def arrays_of(**trees: PyTree) -> dict[str, np.ndarray]:
    """The leaves of trees by flat names: "q.x", "qdot.wheel.phi", "q" where it is one array."""
    named = [
        (f"{prefix}.{name}" if name else prefix, leaf)
        for prefix, tree in trees.items()
        for name, leaf in zip(leaf_names(tree, ""), jax.tree.leaves(tree), strict=True)
    ]
    names = [name for name, _ in named]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"names must differ in a table, but two entries are called {name!r}. Avoid dots in names.")
    return {name: np.asarray(leaf) for name, leaf in named}


def frame_of(columns: Mapping[str, Any], frame: Callable | None) -> Any:
    """A data frame: of the given class, or of pandas or polars, whichever is installed."""
    return (_installed() if frame is None else frame)(dict(columns))


def _installed() -> Callable:
    try:
        from pandas import DataFrame
    except ImportError:
        try:
            from polars import DataFrame
        except ImportError:
            raise ImportError(
                "`to_dataframe` must have pandas or polars, but neither can be imported. Install one of them, or use `to_dict()`."
            ) from None
    return DataFrame


def nested(tree: PyTree, leaf: Callable[[Any], Any]) -> Any:
    """A pytree as dicts and lists of `leaf(x)`; an object such as a NamedTuple becomes the dict of its fields."""
    parts = jax.tree_util.tree_flatten_with_path(tree, is_leaf=lambda node: node is not tree)[0]
    if [path for path, _ in parts] == [()]:
        return leaf(tree)
    if isinstance(tree, dict):
        return {str(name): nested(part, leaf) for name, part in tree.items()}  # in their own order
    if isinstance(tree, (list, tuple)) and not hasattr(tree, "_fields"):
        return [nested(part, leaf) for _, part in parts]
    return {jax.tree_util.keystr(path, simple=True): nested(part, leaf) for path, part in parts} if tree is not None else None


def jsonable(tree: PyTree) -> Any:
    """What `json.dumps` accepts: NaN and infinities as None; what is not data by the name of its type."""

    def plain(x):
        if x is None or isinstance(x, (str, bool)):
            return x
        if callable(x) or not (np.isscalar(x) or hasattr(x, "dtype")):
            return f"<{type(x).__name__}>"
        flat = [n if np.isfinite(n) else None for n in np.ravel(x).tolist()]
        return np.reshape(np.array(flat, object), np.shape(x)).tolist()

    return nested(tree, plain)


def write_arrays(file: str | Path, kind: str, arrays: Mapping[str, np.ndarray], **about: Any) -> None:
    """Arrays by name, in the format of NumPy (.npz), with a description of them."""
    text = json.dumps({"jaxlag": kind, "format": FORMAT} | about)
    with open(file, "wb") as stream:  # `savez` would add to a name
        np.savez(stream, allow_pickle=False, about=np.array(text), **arrays)


def write_json(file: str | Path, kind: str, content: Mapping[str, Any]) -> None:
    """A text file that every language can read."""
    text = json.dumps({"jaxlag": kind, "format": FORMAT} | dict(content), indent=1, allow_nan=False, ensure_ascii=False)
    Path(file).write_text(text, encoding="utf-8")


def outline(tree: PyTree, names: Iterable[str]) -> Any:
    """The structure of a tree, with a name in place of each leaf."""
    return nested(jax.tree.unflatten(jax.tree.structure(tree), names), lambda name: name)


def filled_outline(drawn: Any, arrays: Mapping[str, Any]) -> Any:
    """The tree of an outline, with an array for each name."""
    return jax.tree.map(lambda name: arrays[name], drawn)
