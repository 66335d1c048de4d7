"""Linear equations of motion on paper, from a system's equations and the point about which they are linear."""

from collections.abc import Collection, Sequence
from typing import Any

import jax
from sympy import Eq, Matrix, Symbol

from .._model.system import System
from .derivation import Steps, SymbolicSystem
from .linearisation import Linearisation, Lineariser
from .linearised_check import check_against_derivatives
from .linearised_result import LinearDetails, LinearisedEquations
from .notation import Notation
from .operating_point import OperatingPoint, operating_point
from .result import arranged
from .simplify import Simplifier
from .symbol_tree import SymbolTree
from .symbolic_system import States
from .unicode_printer import Unicode

FREE_NAMES = ("omega_0", "omega_n", "omega_00"), ("zeta", "zeta_0", "zeta_00")


def linearised(
    system: System,
    s: SymbolicSystem,
    steps: Steps,
    given: Any,
    inputs: str | Collection[str],
    parameters: Sequence[Symbol],
    q: SymbolTree,
    params: SymbolTree,
    states: States,
) -> LinearisedEquations:
    """The equations linearised at a given point."""
    simplify = Simplifier(s.qdot, parameters)
    u = _inputs(inputs, parameters)
    at = operating_point(given, s, q, params, simplify)
    found = Lineariser(s, steps, at, simplify, Unicode(Notation(s, parameters)).doprint)(u)
    check_against_derivatives(system, s, found, at, u, q, params, states)
    small = lambda symbols: tuple(Symbol(f"δ{symbol.name}", real=True) for symbol in symbols)
    x, v, a = (small(symbols[i] for i in found.independent) for symbols in (s.q, s.qdot, s.qddot))
    linear = s._replace(q=x, qdot=v, qddot=a, multipliers=(), z=(), zdot=(), u=small(u))
    omega, zeta, notation = _notation(linear, found, s, at, parameters)
    simplify = Simplifier((*a, *v, *x), [symbol for symbol, kind in notation.kind.items() if kind == 0])
    half = lambda matrix, sign: ((matrix + sign * matrix.T) / 2).applyfunc(simplify)
    return LinearisedEquations(
        **dict(q=x, qdot=v, qddot=a, inputs=linear.u, input_matrix=found.B, mass=found.M, eliminated=found.eliminated),
        **dict(damping=half(found.P, 1), gyroscopic=half(found.P, -1), stiffness=half(found.R, 1), circulatory=half(found.R, -1)),
        params=jax.tree.map(lambda symbols: arranged(symbols.shape, iter(symbols.flat)), params.symbols),
        at=at.position | at.velocity | at.parameters,
        motion=_motion(linear, found, simplify),
        _details=LinearDetails(at.given, omega, zeta, simplify, notation),
    )


def _inputs(names: str | Collection[str], parameters: Sequence[Symbol]) -> list[Symbol]:
    """The named parameters."""
    by_name = {symbol.name: symbol for symbol in parameters}
    names = (names,) if isinstance(names, str) else tuple(names)
    for name in names:
        if name not in by_name:
            raise ValueError(f"`inputs` must name parameters, but names {name!r}. There are {', '.join(by_name) or 'none'}.")
    return [by_name[name] for name in names]


def _notation(
    linear: SymbolicSystem, found: Linearisation, s: SymbolicSystem, at: OperatingPoint, parameters: Sequence[Symbol]
) -> tuple[Symbol, Symbol, Notation]:
    """Symbols for ω₀ and ζ that differ from all others when printed, and the notation of deviations; all else is constant."""
    formulas = (*found.M, *found.P, *found.R, *found.B, *found.basis, *at.given.values())
    new = set().union(*(formula.free_symbols for formula in formulas)) - {*parameters, *s.q, s.t}
    constants = (*parameters, *s.q, *s.qdot, *sorted(new, key=lambda symbol: symbol.name))
    text = Unicode(Notation(s, parameters)).doprint
    printed = {text(symbol) for symbol in constants}
    omega, zeta = (next(x for x in map(Symbol, names) if text(x) not in printed) for names in FREE_NAMES)
    notation = Notation(linear, (*constants, omega))
    notation.dotted |= Notation(s, parameters).dotted
    notation.deviations = frozenset((*linear.q, *linear.qdot, *linear.qddot, *linear.u, *found.eliminated))
    return omega, zeta, notation


def _motion(linear: SymbolicSystem, found: Linearisation, simplify: Simplifier) -> tuple[Eq, ...]:
    column = lambda symbols: Matrix(len(symbols), 1, symbols)
    left = found.M * column(linear.qddot) + found.P * column(linear.qdot) + found.R * column(linear.q)
    right = found.B * column(linear.u)
    leading = (*linear.qddot, *linear.qdot, *linear.q)
    rows = zip(left, right, strict=True)
    return tuple(Eq(simplify.collected(l, leading), simplify.collected(r, linear.u), evaluate=False) for l, r in rows)
