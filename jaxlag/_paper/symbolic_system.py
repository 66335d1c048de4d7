"""A system as formulas: its functions traced with symbols, and the derived equations checked against the simulation."""

import re
from collections.abc import Collection
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import sympy
from jaxtyping import PyTree
from sympy import Matrix, Symbol

from .._mechanics.contact import in_contact
from .._mechanics.lagrange import applied_force, constraint_rows, inertia, inertial_force
from .._model.flat import Flat, StatesAt, bind, rows_by_name
from .._model.state_values import of_first_order, ravelled, sampled, start_values
from .._model.system import System
from .._model.validation import check, coordinates, parameters
from .._program.expressions import Algebra, filled
from .._program.interpreter import evaluate
from .contact_laws import contact_laws
from .derivation import Steps, SymbolicSystem
from .formulas import formulas
from .symbol_tree import SymbolTree, symbol_tree


def dotted(symbol: Symbol, dot: str) -> Symbol:
    """The symbol of a velocity or an acceleration: xdot_1 for x_1."""
    return Symbol(re.sub(r"^([^\W\d_]*)", rf"\1{dot}", symbol.name), real=True)


class States(NamedTuple):
    """The further states: symbols of first-order states, of their rates, and of sampled states; and all states by name."""

    z: tuple[Symbol, ...]
    zdot: tuple[Symbol, ...]
    u: tuple[Symbol, ...]
    tree: SymbolTree

    @classmethod
    def of(cls, system: System, q: SymbolTree, params: SymbolTree) -> "States":
        """The further states of a system."""
        like = coordinates(q.example, "q")
        t = jnp.zeros((), jax.tree.leaves(like)[0].dtype)
        values = jax.tree.map(np.asarray, start_values(system, {}, t, like, like, parameters(params.example, like)))
        tree = symbol_tree(values, "states")
        z, u = (tuple(_flat([tree.symbols[name] for name in names])) for names in (of_first_order(system), sampled(system)))
        return cls(z, tuple(dotted(symbol, "dot") for symbol in z), u, tree)


def _flat(symbols: PyTree[np.ndarray]) -> list[Symbol]:
    return [symbol for array in jax.tree.leaves(symbols) for symbol in array.flat]


def trace_system(
    system: System, q: SymbolTree, params: SymbolTree, states: States, positive: Collection[str]
) -> tuple[SymbolicSystem, dict[str, PyTree]]:
    """L, D, Q, g, a and the rates and updates of the states of a system as formulas, and the indices of each constraint's multipliers."""
    like = coordinates(q.example, "q")
    values = parameters(params.example, like)
    check(system, jnp.zeros((), jax.tree.leaves(like)[0].dtype), like, like, values, states.tree.numbers)
    zeros = jnp.zeros(sum(leaf.size for leaf in jax.tree.leaves(like)))
    flat = bind(system, like, values, StatesAt(states.tree.numbers, jnp.zeros(()), zeros, zeros))
    multiplier_rows = jax.tree.map(lambda row: np.asarray(row, int), flat.unravel_multipliers(jnp.arange(flat.rows, dtype=float)))
    t = Symbol("t", real=True)
    x = _flat(q.symbols)
    v, a = ([dotted(symbol, dot) for symbol in x] for dot in ("dot", "ddot"))
    multipliers = [Symbol(name, real=True, positive=True if name in positive else None) for name in _multiplier_names(rows_by_name(flat))]
    beside = (*states.z, *states.zdot, *states.u)
    _check_names([t, *x, *v, *a, *multipliers, *(symbol for symbol, _ in params.paths), *beside], positive)

    def functions(t, q, v, multipliers, params_, states):
        flat = bound(system, like, params_, params, StatesAt(states, t, q, v))
        D = sum((D(t, q, v, multipliers) for D in flat.dissipations.values()), start=jnp.zeros(()))
        Q = sum((Q(t, q, v, multipliers) for Q in flat.forces.values()), start=jnp.zeros_like(q))
        rates = flat.state_rates(t, q, v)
        rates = ravelled([rates[name] for name in of_first_order(system)], q.dtype)
        return flat.lagrangian(t, q, v), D, Q, flat.holonomic(t, q), flat.nonholonomic(t, q, v), rates

    def updates(t, q, v, params_, states):
        found = bound(system, like, params_, params, StatesAt(states, t, q, v)).updates(t, q, v)
        return ravelled([found[name] for name in sampled(system)], q.dtype)

    vector = lambda symbols: filled((len(symbols),), symbols)
    state = filled((), [t]), vector(x), vector(v)
    L, D, *columns = formulas(functions, *state, vector(multipliers), params.symbols, states.tree.symbols)
    Q, g, nonholonomic, rates = (Matrix(len(column), 1, list(column)) for column in columns)
    try:
        updated = tuple(formulas(updates, *state, params.symbols, states.tree.symbols))
    except NotImplementedError:  # measured inputs and other programs of controllers, on which the mechanics does not depend
        updated = (None,) * len(states.u)
    holonomic = flat.rows_of_bilateral
    contacts = contact_laws(system, flat.contacts, list(g[holonomic:]), multipliers[holonomic : len(g)], params)
    drawn = dict(contacts=contacts, z=states.z, zdot=states.zdot, rates=tuple(rates), u=states.u, updates=updated)
    symbols = t, tuple(x), tuple(v), tuple(a), tuple(multipliers)
    return SymbolicSystem(*symbols, L[()], D[()], Q, g, nonholonomic, **drawn), multiplier_rows


def bound(system: System, like: PyTree, numbers: PyTree, params: SymbolTree, at: StatesAt) -> Flat:
    """The system over flat vectors, with numbers for the symbols of its parameters, and all contacts closed."""
    flat = bind(system, jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), like), eqx.combine(numbers, params.rest), at)
    return in_contact(flat, jnp.ones(flat.gap_count, bool))


def _multiplier_names(rows: dict[str, np.ndarray]) -> list[str]:
    """Names in the order of the rows: λ if there is only one; otherwise by the constraint's name, and by number if it has several."""
    if sum(map(len, rows.values())) == 1:
        return ["lambda"]
    unnamed = len(rows) == 1 and not set(rows) - {"holonomic", "nonholonomic"}
    name_of = lambda name, i: ("lambda" if unnamed else f"lambda_{name}") + (f"_{i + 1}" if len(rows[name]) > 1 else "")
    names = {row: name_of(name, i) for name in rows for i, row in enumerate(rows[name])}
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


def check_against_simulation(system: System, s: SymbolicSystem, steps: Steps, q: SymbolTree, params: SymbolTree, states: States) -> None:
    """Raises if the equations differ from the simulation at random states: all positive, all negative, and of both signs."""
    like = coordinates(q.example, "q")

    def simulated(t, q_, v, multipliers, params_, states_):
        flat = bound(system, like, params_, params, StatesAt(states_, t, q_, v))
        M, force = inertia(flat, t, q_, v), inertial_force(flat, t, q_, v)
        _, G, gamma = constraint_rows(flat, t, q_, v)
        return M.as_matrix(), force + applied_force(flat, t, q_, v, multipliers), G, gamma

    draw = np.random.default_rng(0)
    # A zero would hide its factors, and dividing by it gives infinity.
    drawn = lambda number: np.where(number == 0, draw.uniform(0.2, 0.8, number.shape), number).astype(float)
    state = [np.ones(shape) for shape in ((), len(s.q), len(s.q), len(s.multipliers))]
    given = jax.tree.map(drawn, params.numbers), states.tree.numbers
    with jax.enable_x64(True):
        program = jax.make_jaxpr(simulated)(*state, *given)
    symbols = [s.t, *s.q, *s.qdot, *s.multipliers, *(symbol for symbol, _ in (*params.paths, *states.tree.paths))]
    numbers = np.concatenate([np.ravel(part) for part in (*state, *jax.tree.leaves(given))])
    is_given = np.isin(np.arange(len(symbols)), len(symbols) - len(states.tree.paths) - 1 - np.arange(len(params.paths)))
    some, others = (draw.choice((1, -1), len(symbols)) for _ in range(2))
    for signs in (1, np.where(is_given, 1, -1), np.where(is_given, 1, some), np.where(is_given, -1, others)):
        values = np.where(is_given, numbers, draw.uniform(0.2, 0.8, len(symbols)))
        values = np.where([bool(symbol.is_positive) for symbol in symbols], np.abs(values), signs * values)
        _check_at(dict(zip(symbols, values, strict=True)), program, s, steps)


def _check_at(values: dict[Symbol, float], program: Any, s: SymbolicSystem, steps: Steps) -> None:
    """Raises if the equations differ from the simulation for these numbers."""
    shapes = [aval.shape for aval in program.in_avals]
    parts = np.split(np.array(list(values.values())), np.cumsum([int(np.prod(shape)) for shape in shapes])[:-1])
    with jax.enable_x64(True):
        simulation = evaluate(program, Algebra(), *(part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)))
    point = {symbol: sympy.Float(value) for symbol, value in values.items()}
    point |= {v: sympy.Float(number(rate.xreplace(point)).real) for v, rate in zip(s.zdot, s.rates, strict=True)}
    derived = {"M": steps.M, "f": steps.f, "G": steps.G, "γ": steps.gamma}
    for (name, matrix), want in zip(derived.items(), map(np.ravel, simulation), strict=True):
        got = np.array([number(entry.xreplace(point)) for entry in matrix])
        error = np.abs(got - want)
        if (error > 1e-9 * (1 + np.max(np.abs(want), initial=0))).any():  # NaN, where a function is undefined, compares as false
            raise ValueError(
                f"the equations must agree with the simulation, but {name} differs: {got.real} on paper, {want} in the simulation. "
                "Write functions with a derivative rule of their own (`custom_jvp`, `stop_gradient`) in elementary operations."
            )


def number(formula: Any) -> complex:
    """The value of a formula without symbols; NaN if it is not finite."""
    return complex(formula) if formula.is_finite else complex("nan")
