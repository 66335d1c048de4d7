"""A system as formulas: its entries named, its functions traced, and what is derived from them held against the simulation."""

import dataclasses
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import sympy
from jaxtyping import PyTree
from sympy import Matrix, Symbol

from .._mechanics.lagrange import applied_force, constraint_rows, inertia
from .._model.injection import parameters as declared
from .._model.system import SLOTS, Flat, System, bind, rows_by_name
from .._model.validation import check, coordinates, is_vector, parameters
from .._program.interpreter import evaluate
from .._program.scalar_graph import Algebra, filled
from .derivation import Statement, Steps
from .to_sympy import formulas


class Named(NamedTuple):
    """A tree of numbers, the symbols that stand for them, what else it holds, and how each symbol is reached in Python."""

    numbers: PyTree
    symbols: PyTree[np.ndarray]
    rest: PyTree
    paths: list[tuple[Symbol, str]]

    @property
    def example(self) -> PyTree:
        """The tree, with some number for each name."""
        return eqx.combine(self.numbers, self.rest)


def named(tree: PyTree, bare: str, positive: Collection[str] = ()) -> Named:
    """Symbols for a tree of numbers or of names: a string for a number, a list of strings for a vector, a set for a mapping of numbers."""
    mapping = lambda node: {name: name for name in node} if isinstance(node, (set, frozenset)) else dict(node)
    opened = jax.tree.map(lambda node: mapping(node) if isinstance(node, (set, frozenset, Mapping)) else node, tree)
    is_leaf = lambda node: _is_names(node) or (bare == "q" and is_vector(node))  # in params, a list is a pytree
    leaves, structure = jax.tree_util.tree_flatten_with_path(opened, is_leaf=is_leaf)
    parts = [_named_leaf(jax.tree_util.keystr(path), _name(path, bare), leaf, bare == "q", positive) for path, leaf in leaves]
    numbers, symbols, rest = (jax.tree.unflatten(structure, [part[i] for part in parts]) for i in range(3))
    return Named(numbers, symbols, rest, [pair for part in parts for pair in part[3]])


def _named_leaf(path: str, name: str, leaf: Any, is_coordinate: bool, positive: Collection[str]) -> tuple[Any, Any, Any, list]:
    """Numbers, symbols, what is neither, and where the symbols are: of parameters, whole numbers in arrays are neither."""
    array = np.asarray(None if callable(leaf) else leaf)
    is_name = array.dtype.kind == "U"
    if not (is_name or array.dtype.kind == "f" or (array.dtype.kind in "iu" and (is_coordinate or isinstance(leaf, int)))):
        return None, None, leaf, []
    spoken = map(str, array.flat) if is_name else _numbered(name, array.shape)
    symbols = [Symbol(one, real=True, positive=True if one in positive else None) for one in spoken]
    at = [path + (f"[{', '.join(map(str, index))}]" if index else "") for index in np.ndindex(array.shape)]
    numbers = np.random.default_rng([*path.encode()]).uniform(0.5, 1.5, array.shape) if is_name else array.astype(float)
    return numbers, filled(array.shape, symbols), None, list(zip(symbols, at, strict=True))


def _is_names(node: Any) -> bool:
    return isinstance(node, list) and bool(node) and all(isinstance(name, str) for name in node)


def _name(path: tuple, bare: str) -> str:
    """The name of a leaf, what it is part of behind it: phi_wheel of q["wheel"]["phi"], q_1 of q[0]."""
    keys = [jax.tree_util.keystr((key,), simple=True) for key in path]
    *outer, last = [key for key in keys if not key.isdigit()] or [bare]
    return "_".join([last, *outer, *(str(int(key) + 1) for key in keys if key.isdigit())])


def _numbered(name: str, shape: tuple) -> list[str]:
    """Names of the entries of an array, counted from 1 as on paper."""
    joint = "" if all(size < 10 for size in shape) else "_"
    return ["_".join(filter(None, [name, joint.join(str(i + 1) for i in at)])) for at in np.ndindex(shape)]


def in_order(system: System, given: PyTree, params: Named) -> list[Symbol]:
    """The parameters in the order in which the system's functions mention them, then in that of the mapping that was given."""
    mentioned = [name for slot in SLOTS for _, function in getattr(system, slot) for name in _mentioned(function)]
    keys = [f"[{key!r}]" for key in (*mentioned, *(given if isinstance(given, Mapping) else ()))]
    place = lambda path: next((i for i, key in enumerate(keys) if path.startswith(key)), len(keys))
    return [symbol for symbol, path in sorted(params.paths, key=lambda pair: place(pair[1]))]


def _mentioned(function: Callable) -> Iterator[str]:
    """The arguments that a function names, and those of the functions that it is made from."""
    yield from (parameter.name for parameter in declared(function))
    for field in dataclasses.fields(function) if dataclasses.is_dataclass(function) else ():
        if callable(part := getattr(function, field.name)):
            yield from _mentioned(part)


def dotted(symbol: Symbol, dot: str) -> Symbol:
    """The symbol of a velocity or an acceleration: xdot_1 of x_1."""
    return Symbol(re.sub(r"^([^\W\d_]*)", rf"\1{dot}", symbol.name), real=True)


def stated(system: System, q: Named, params: Named, positive: Collection[str]) -> tuple[Statement, dict[str, PyTree]]:
    """L, D, Q, g and a of a system as formulas, and which multipliers belong to which constraint."""
    like = coordinates(q.example, "q")
    values = parameters(params.example, like)
    check(system, jnp.zeros((), jax.tree.leaves(like)[0].dtype), like, like, values)
    flat = bind(system, like, values)
    rows = jax.tree.map(lambda row: np.asarray(row, int), flat.unravel_multipliers(jnp.arange(flat.rows, dtype=float)))
    t = Symbol("t", real=True)
    x = [symbol for array in jax.tree.leaves(q.symbols) for symbol in array.flat]
    v, a = ([dotted(symbol, dot) for symbol in x] for dot in ("dot", "ddot"))
    multipliers = [Symbol(name, real=True, positive=True if name in positive else None) for name in _multiplier_names(rows_by_name(flat))]
    _check_names([t, *x, *v, *a, *multipliers, *(symbol for symbol, _ in params.paths)], positive)

    def pieces(t, q, v, multipliers, params_):
        flat = _bound(system, like, params_, params)
        D = sum((D(t, q, v, multipliers) for D in flat.dissipations.values()), start=jnp.zeros(()))
        Q = sum((Q(t, q, v, multipliers) for Q in flat.forces.values()), start=jnp.zeros_like(q))
        return flat.lagrangian(t, q, v), D, Q, flat.holonomic(t, q), flat.nonholonomic(t, q, v)

    row = lambda symbols: filled((len(symbols),), symbols)
    L, D, *columns = formulas(pieces, filled((), [t]), row(x), row(v), row(multipliers), params.symbols)
    Q, g, rolling = (Matrix(len(column), 1, list(column)) for column in columns)
    return Statement(t, tuple(x), tuple(v), tuple(a), tuple(multipliers), L[()], D[()], Q, g, rolling), rows


def _bound(system: System, like: PyTree, numbers: PyTree, params: Named) -> Flat:
    return bind(system, jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), like), eqx.combine(numbers, params.rest))


def _multiplier_names(rows: dict[str, np.ndarray]) -> list[str]:
    """In the order of the rows: λ where there is one; by the constraint's name elsewhere, and by number where it has several."""
    if sum(map(len, rows.values())) == 1:
        return ["lambda"]
    unnamed = len(rows) == 1 and not set(rows) - {"holonomic", "nonholonomic"}
    spoken = lambda name, i: ("lambda" if unnamed else f"lambda_{name}") + (f"_{i + 1}" if len(rows[name]) > 1 else "")
    names = {row: spoken(name, i) for name in rows for i, row in enumerate(rows[name])}
    return [names[row] for row in sorted(names)]


def _check_names(symbols: list[Symbol], positive: Collection[str]) -> None:
    names = [symbol.name for symbol in symbols]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"names must differ on paper, but two entries are called {name!r}. Hand over names for `q` or `params`.")
    for name in positive:
        if name not in names:
            there = ", ".join(names)
            raise ValueError(f"`positive` must name entries of q or params, or multipliers, but holds {name!r}. There are {there}.")


def check_against_simulation(system: System, s: Statement, steps: Steps, q: Named, params: Named) -> None:
    """Refuses equations that differ from what is simulated, at one state with random coordinates."""
    like = coordinates(q.example, "q")

    def simulated(t, q_, v, multipliers, params_):
        flat = _bound(system, like, params_, params)
        M, force = inertia(flat, t, q_, v)
        _, G, gamma = constraint_rows(flat, t, q_, v)
        return M.as_matrix(), force + applied_force(flat, t, q_, v, multipliers), G, gamma

    draw = np.random.default_rng(0).uniform
    state = [draw(0.2, 0.8, shape) for shape in ((), len(s.q), len(s.q), len(s.multipliers))]
    # A zero would hide what it multiplies, and make infinite what it divides.
    numbers = jax.tree.map(lambda number: np.where(number == 0, draw(0.2, 0.8, number.shape), number), params.numbers)
    with jax.enable_x64(True):
        need = evaluate(jax.make_jaxpr(simulated)(*state, numbers), Algebra(), *state, *jax.tree.leaves(numbers))
    symbols = [s.t, *s.q, *s.qdot, *s.multipliers, *(symbol for symbol, _ in params.paths)]
    values = np.concatenate([np.ravel(part) for part in (*state, *jax.tree.leaves(numbers))])
    point = dict(zip(symbols, map(sympy.Float, values), strict=True))
    for name, have, want in zip(("M", "f", "G", "γ"), (steps.M, steps.f, steps.G, steps.gamma), map(np.ravel, need), strict=True):
        got = np.array([_value(entry.xreplace(point)) for entry in have])
        off = np.abs(got - want)
        if (off > 1e-9 * (1 + np.max(np.abs(want), initial=0))).any():  # where a function is not defined, NaN is never above
            raise ValueError(
                f"the equations must agree with the simulation, but {name} differs: {got.real} on paper, {want} in the simulation. "
                "Write functions with a derivative rule of their own (`custom_jvp`, `stop_gradient`) in elementary operations."
            )


def _value(number: Any) -> complex:
    return complex(number) if number.is_finite else complex("nan")
