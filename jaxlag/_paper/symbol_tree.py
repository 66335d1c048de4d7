"""Symbols for the numbers in a tree of coordinates or parameters, named after their paths."""

import dataclasses
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree
from sympy import Symbol

from .._model.injection import declared_parameters
from .._model.states import State
from .._model.system import SLOTS, System
from .._model.validation import is_vector
from .._program.expressions import filled


class SymbolTree(NamedTuple):
    """A tree of numbers, their symbols, its other leaves, and the Python path of each symbol."""

    numbers: PyTree
    symbols: PyTree[np.ndarray]
    rest: PyTree
    paths: list[tuple[Symbol, str]]

    @property
    def example(self) -> PyTree:
        """The tree, with an arbitrary number for each name."""
        return eqx.combine(self.numbers, self.rest)


def symbol_tree(tree: PyTree, bare: str, positive: Collection[str] = ()) -> SymbolTree:
    """Symbols for a tree of numbers or of names: a string for a number, a list of strings for a vector, a set for a mapping of numbers."""
    mapping = lambda node: {name: name for name in node} if isinstance(node, (set, frozenset)) else dict(node)
    plain = jax.tree.map(lambda node: mapping(node) if isinstance(node, (set, frozenset, Mapping)) else node, tree)
    is_leaf = lambda node: _is_names(node) or (bare == "q" and is_vector(node))  # in params, a list is a pytree
    leaves, structure = jax.tree_util.tree_flatten_with_path(plain, is_leaf=is_leaf)
    parts = [_symbols_of_leaf(jax.tree_util.keystr(path), _name(path, bare), leaf, bare == "q", positive) for path, leaf in leaves]
    numbers, symbols, rest = (jax.tree.unflatten(structure, [part[i] for part in parts]) for i in range(3))
    return SymbolTree(numbers, symbols, rest, [pair for part in parts for pair in part[3]])


def _symbols_of_leaf(path: str, name: str, leaf: Any, is_coordinate: bool, positive: Collection[str]) -> tuple[Any, Any, Any, list]:
    """Numbers, symbols, the leaf if it is neither, and the paths of the symbols. Arrays of integers in the parameters are neither."""
    array = np.asarray(None if callable(leaf) else leaf)
    is_name = array.dtype.kind == "U"
    if not (is_name or array.dtype.kind == "f" or (array.dtype.kind in "iu" and (is_coordinate or isinstance(leaf, int)))):
        return None, None, leaf, []
    names = map(str, array.flat) if is_name else _numbered(name, array.shape)
    symbols = [Symbol(entry, real=True, positive=True if entry in positive else None) for entry in names]
    paths = [path + (f"[{', '.join(map(str, index))}]" if index else "") for index in np.ndindex(array.shape)]
    numbers = np.random.default_rng([*path.encode()]).uniform(0.5, 1.5, array.shape) if is_name else array.astype(float)
    return numbers, filled(array.shape, symbols), None, list(zip(symbols, paths, strict=True))


def _is_names(node: Any) -> bool:
    return isinstance(node, list) and bool(node) and all(isinstance(name, str) for name in node)


def _name(path: tuple, bare: str) -> str:
    """The name of a leaf, followed by its parents' names: phi_wheel for q["wheel"]["phi"], q_1 for q[0]."""
    keys = [jax.tree_util.keystr((key,), simple=True) for key in path]
    *outer, last = [key for key in keys if not key.isdigit()] or [bare]
    return "_".join([last, *outer, *(str(int(key) + 1) for key in keys if key.isdigit())])


def _numbered(name: str, shape: tuple) -> list[str]:
    """Names of the entries of an array, counted from 1."""
    joint = "" if all(size < 10 for size in shape) else "_"
    return ["_".join(filter(None, [name, joint.join(str(i + 1) for i in at)])) for at in np.ndindex(shape)]


def parameters_in_order(system: System, given: PyTree, params: SymbolTree) -> list[Symbol]:
    """The parameters in the order in which the system's functions name them, then in the order of the given mapping."""
    functions = [function for slot in SLOTS for _, function in getattr(system, slot)]
    functions += [state.rate if isinstance(state, State) else state.update for _, state in system.states]
    names = [name for function in functions for name in _argument_names(function)]
    keys = [f"[{key!r}]" for key in (*names, *(given if isinstance(given, Mapping) else ()))]
    place = lambda path: next((i for i, key in enumerate(keys) if path.startswith(key)), len(keys))
    return [symbol for symbol, path in sorted(params.paths, key=lambda pair: place(pair[1]))]


def _argument_names(function: Callable) -> Iterator[str]:
    """The names of a function's arguments, and of the arguments of functions that it is made from."""
    yield from (parameter.name for parameter in declared_parameters(function))
    for field in dataclasses.fields(function) if dataclasses.is_dataclass(function) else ():
        if callable(part := getattr(function, field.name)):
            yield from _argument_names(part)
