"""The state about which equations are linearised: the user's input as formulas of symbols."""

import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import sympy
from jaxtyping import PyTree
from sympy import Expr, Symbol

from .coordinate_elimination import eliminate_coordinates
from .derivation import SymbolicSystem, total_derivative
from .formulas import exact
from .simplify import Simplifier
from .symbol_tree import SymbolTree

FUNCTIONS: dict[str, Any] = dict(sqrt=sympy.sqrt, exp=sympy.exp, log=sympy.log, abs=sympy.Abs, sign=sympy.sign, pi=sympy.pi)
FUNCTIONS |= dict(sin=sympy.sin, cos=sympy.cos, tan=sympy.tan, asin=sympy.asin, acos=sympy.acos, atan=sympy.atan, atan2=sympy.atan2)
FUNCTIONS |= dict(sinh=sympy.sinh, cosh=sympy.cosh, tanh=sympy.tanh, arcsin=sympy.asin, arccos=sympy.acos, arctan=sympy.atan)


class OperatingPoint(NamedTuple):
    """Formulas of the coordinates, of their rates, and of the parameters that are given with them."""

    position: dict[Symbol, Expr]
    velocity: dict[Symbol, Expr]
    parameters: dict[Symbol, Expr]
    running: frozenset[Symbol]  # coordinates whose rates are not zero, and time
    given: dict[Symbol, Expr]  # what the user said

    def __call__(self, formula: Expr) -> Expr:
        """A formula at this point."""
        return formula.xreplace(self.position | self.velocity | self.parameters)


def operating_point(given: Any, s: SymbolicSystem, q: SymbolTree, params: SymbolTree, simplify: Simplifier) -> OperatingPoint:
    """The point from `linearised_at`: coordinates, or a pair of these and their rates; coordinates left out keep their symbols.

    Coordinates that constraints express in terms of others follow from these.
    """
    is_pair = type(given) is tuple and len(given) == 2 and (not isinstance(q.symbols, tuple) or isinstance(given[0], (tuple, Mapping)))
    given_q, given_qdot = given if is_pair else (given, {})
    constants = tuple(symbol for symbol, _ in params.paths)
    read = _Reader({symbol.name: symbol for symbol in (*s.q, *constants)}, {x.name for x in (s.t, *s.qdot, *s.qddot, *s.multipliers)})
    values = read.tree(given_q, q.symbols, (*s.q, *constants))
    rates = {s.qdot[s.q.index(x)]: rate for x, rate in read.tree(given_qdot, q.symbols, s.q).items()}
    runs = {x: rates.get(v, sympy.Integer(0)) != 0 for x, v in zip(s.q, s.qdot, strict=True)}
    own = {x: formula for x, formula in values.items() if formula != x and not runs.get(x, False)}
    followed = _followed(s, own, [x for x in s.q if x not in own and not runs[x]], simplify)
    every = _resolved(own | followed, simplify)
    at_rest = dict.fromkeys(s.qdot, sympy.Integer(0)) | rates
    carried = {v: total_derivative(s, every[x]).xreplace(at_rest) for x, v in zip(s.q, s.qdot, strict=True) if x in followed}
    velocity = {v: simplify(formula.xreplace(every)) for v, formula in (at_rest | carried | rates).items()}
    return OperatingPoint(
        position={x: every.get(x, x) for x in s.q},
        velocity=velocity,
        parameters={p: every[p] for p in constants if p in every},
        running=frozenset([s.t, *(x for x, v in zip(s.q, s.qdot, strict=True) if velocity[v] != 0)]),
        given={x: every[x] for x in own} | {v: velocity[v] for v in rates if velocity[v] != 0},
    )


def _followed(s: SymbolicSystem, own: dict[Symbol, Expr], still: list[Symbol], simplify: Simplifier) -> dict[Symbol, Expr]:
    """Coordinates in terms of others, as constraints demand: first coordinates that are neither given nor run, then running ones."""
    first = eliminate_coordinates(s._replace(q=tuple(still), g=s.g.xreplace(own)), simplify)
    left = tuple(x for x in s.q if x not in own and x not in first)
    return first | eliminate_coordinates(s._replace(q=left, g=s.g.xreplace(own).xreplace(first)), simplify)


def _resolved(values: dict[Symbol, Expr], simplify: Simplifier) -> dict[Symbol, Expr]:
    """The formulas, with each inserted into the others."""
    for _ in values:
        values = {x: formula.xreplace(values) for x, formula in values.items()}
    for x, formula in values.items():
        if not formula.free_symbols.isdisjoint(values):
            raise ValueError(f"`linearised_at` must not express {x.name!r} by itself, but does. Write it by other symbols.")
    return {x: simplify(formula) for x, formula in values.items()}


class _Reader:
    """Reads numbers, text and expressions as formulas of the known symbols; other names become new real symbols."""

    def __init__(self, names: dict[str, Symbol], reserved: set[str]):
        self.names, self.reserved = names, reserved

    def tree(self, given: Any, symbols: PyTree[np.ndarray], known: tuple[Symbol, ...]) -> dict[Symbol, Expr]:
        """Formulas by symbol, from a tree like `symbols`; a mapping may leave out entries and name any of the known symbols."""
        if isinstance(given, Mapping):
            parts = [self._entry(name, value, symbols, known) for name, value in given.items()]
        elif isinstance(symbols, np.ndarray):
            array = np.asarray(given.tolist() if hasattr(given, "tolist") else given, object)
            if array.shape not in ((), symbols.shape):
                raise ValueError(
                    f"`linearised_at` must be structured like `q`, but an entry of shape {symbols.shape} is {given!r}. "
                    "Name the coordinates in a mapping."
                )
            parts = [{x: self(value)} for x, value in zip(symbols.flat, np.broadcast_to(array, symbols.shape).flat, strict=True)]
        elif isinstance(given, (list, tuple)) and isinstance(symbols, (list, tuple)) and len(given) == len(symbols):
            parts = [self.tree(value, part, known) for value, part in zip(given, symbols, strict=True)]
        else:
            raise TypeError(f"`linearised_at` must be structured like `q`, but holds {given!r}. Name the coordinates in a mapping.")
        return {x: formula for part in parts for x, formula in part.items()}

    def _entry(self, name: Any, value: Any, symbols: PyTree[np.ndarray], known: tuple[Symbol, ...]) -> dict[Symbol, Expr]:
        if isinstance(symbols, Mapping) and name in symbols:
            return self.tree(value, symbols[name], known)
        for symbol in known:
            if getattr(name, "name", name) == symbol.name:
                return {symbol: self(value)}
        there = ", ".join(symbol.name for symbol in known)
        raise ValueError(f"`linearised_at` must name coordinates or parameters, but names {name!r}. There are {there}.")

    def __call__(self, value: Any) -> Expr:
        """One formula."""
        try:
            formula = self._text(value) if isinstance(value, str) else self._expression(value)
        except (sympy.SympifyError, SyntaxError, TypeError, AttributeError) as error:
            raise ValueError(
                f"`linearised_at` must hold numbers, formulas as text or SymPy expressions, but holds {value!r}. "
                "Write products with `*` and powers with `**`."
            ) from error
        for symbol in formula.free_symbols:
            if symbol.name in self.reserved:
                raise ValueError(
                    f"`linearised_at` must be formulas of coordinates and parameters, but {value!r} holds {symbol.name!r}, "
                    "which changes with time. Give rates as the second of a pair `(q, qdot)`."
                )
        return formula

    def _text(self, text: str) -> Expr:
        words = re.findall(r"[^\W\d]\w*", text)
        meaning: dict[str, Callable | Expr] = {word: self._symbol(Symbol(word, real=True)) for word in words if word not in FUNCTIONS}
        return self._expression(sympy.sympify(text, locals=FUNCTIONS | meaning | self.names, rational=True))

    def _expression(self, value: Any) -> Expr:
        number: Any = np.asarray(value)[()]
        formula = value if isinstance(value, sympy.Basic) else exact(number)
        if not isinstance(formula, Expr):
            raise TypeError
        return formula.xreplace({symbol: self._symbol(symbol) for symbol in formula.free_symbols})

    def _symbol(self, symbol: Symbol) -> Symbol:
        return self.names.setdefault(symbol.name, Symbol(symbol.name, real=True, positive=symbol.is_positive))
