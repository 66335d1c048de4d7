"""Equations of motion on paper as what becomes an FMU."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jax.scipy.special as special
import numpy as np
import sympy
from jaxtyping import Array, PyTree
from sympy.printing.numpy import JaxPrinter

from .._model.paths import entry_names
from .fmu_motion import ExportedMotion, Start, constraint_values

FUNCTIONS: dict[str, Any] = dict(
    erf=special.erf, erfc=special.erfc, erfinv=special.erfinv, digamma=special.digamma, loggamma=special.gammaln
)
FUNCTIONS |= dict(
    where=jnp.where, nan=jnp.nan, And=jnp.logical_and, Or=jnp.logical_or, Xor=jnp.logical_xor, Max=jnp.maximum, Min=jnp.minimum
)


class _Printer(JaxPrinter):
    """Choices and their conditions as scalar operations; functions that JAX has elsewhere by their name."""

    def _print_Piecewise(self, formula):
        text = "nan"
        for value, condition in reversed(formula.args):
            text = f"where({self._print(condition)}, {self._print(value)}, {text})"
        return text

    def _by_name(self, formula):
        return f"{formula.func.__name__}({', '.join(map(self._print, formula.args))})"

    def _joined(self, formula):
        return functools.reduce(lambda x, y: f"{formula.func.__name__}({x}, {y})", map(self._print, formula.args))

    _print_erf = _print_erfc = _print_erfinv = _print_digamma = _print_loggamma = _by_name
    _print_And = _print_Or = _print_Xor = _print_Max = _print_Min = _joined


def exported_equations(equations: Any, q0: PyTree, qdot0: PyTree, params: PyTree) -> ExportedMotion:
    """The remaining coordinates with the constraints that remain; the eliminated ones follow from these."""
    program = equations._program()
    details = equations._details
    start = Start.of(details.system, q0, qdot0, params, None)
    _check_structure("q0", start.q, details.structure)
    _check_structure("params", start.params, equations.params)
    q, v, p, s = start.numbers
    place = {symbol: i for i, symbol in enumerate(_flat(details.structure))}
    here, away = ([place[x] for x in symbols] for symbols in (equations.q, equations.eliminated))
    names = entry_names(start.q, "q")
    constants, n = _flat(equations.params), len(equations.q)
    at = ([equations.t], equations.q, equations.qdot, (), constants)
    function = functools.partial(_function, at)
    residuals = function(program.residuals, program.unknowns)
    g, a, positions = function(list(equations.g)), function(list(equations.a)), function(list(equations.eliminated.values()))

    def solved(parts, multipliers):
        residual = lambda z: residuals(*parts, z)
        z = jnp.concatenate([jnp.zeros(n), multipliers])
        return jax.jacfwd(residual)(z), -residual(jnp.zeros_like(z)), jnp.zeros(0)

    return ExportedMotion(
        q=[names[i] for i in here],
        states=[],
        params=list(entry_names(start.params, "params")),
        multipliers=start.multipliers,
        dependent=[names[i] for i in away],
        units=dict(details.system.units),
        start=np.concatenate([np.zeros(1), q[here], v[here], s, p]),
        equations=solved,
        constraints=lambda parts: constraint_values(
            lambda t, q: g(t, q, *parts[2:], jnp.zeros(0)), lambda t, q, v: a(t, q, v, *parts[3:], jnp.zeros(0)), *parts[:3]
        ),
        positions=lambda parts: positions(*parts, jnp.zeros(0)),
    )


def _flat(symbols: PyTree) -> list[Any]:
    return [symbol for leaf in jax.tree.leaves(symbols) for symbol in np.ravel(np.asarray(leaf, object))]


def _check_structure(name: str, given: PyTree, symbols: PyTree) -> None:
    shapes = lambda tree: jax.tree.map(np.shape, tree)
    if shapes(given) != shapes(symbols):
        raise ValueError(
            f"`{name}` must be structured as for `equations`, {shapes(symbols)}, but is {shapes(given)}. Give all its numbers."
        )


def _function(
    at: Sequence[Sequence[sympy.Symbol]], formulas: Sequence[sympy.Expr], unknowns: Sequence[sympy.Symbol] = ()
) -> Callable[..., Array]:
    """Formulas as a function of t, q, q̇, states, parameters and the unknowns, which gives a vector."""
    symbols = [*(symbol for part in at for symbol in part), *unknowns]
    plain = {symbol: sympy.Symbol(f"x{i}", real=True) for i, symbol in enumerate(symbols)}
    inserted = [formula.xreplace(plain) for formula in formulas]
    evaluate = sympy.lambdify(list(plain.values()), inserted, modules=[FUNCTIONS, "jax"], printer=_Printer, cse=True)

    def function(t, *parts):
        found = evaluate(t, *(x for part in parts for x in part))
        return jnp.stack([jnp.asarray(x, float) for x in found]) if found else jnp.zeros(0)

    return function
