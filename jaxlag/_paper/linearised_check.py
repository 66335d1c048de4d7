"""Linear equations on paper, checked against automatic differentiation of the functions that are simulated."""

from collections.abc import Sequence

import jax
import numpy as np
import sympy
from jax.flatten_util import ravel_pytree
from sympy import Expr, Symbol

from .._mechanics.lagrange import applied_force, constraint_rows, inertia, inertial_force
from .._model.flat import StatesAt
from .._model.system import System
from .._model.validation import coordinates
from .._program.expressions import Algebra
from .._program.interpreter import evaluate
from .derivation import SymbolicSystem
from .linearisation import Linearisation
from .operating_point import OperatingPoint
from .symbol_tree import SymbolTree
from .symbolic_system import States, bound, number

Numbers = dict[Symbol, Expr]
DRAWS = 100  # of parameters, ever further from the given ones, until the point is real: acos(g/(l Ω²)) is not for slow rotation


def check_against_derivatives(
    system: System,
    s: SymbolicSystem,
    found: Linearisation,
    at: OperatingPoint,
    inputs: Sequence[Symbol],
    q: SymbolTree,
    params: SymbolTree,
    states: States,
) -> None:
    """Raises if M, P, R or B differ from the matrices of the simulation, at random parameters."""
    like = coordinates(q.example, "q")
    point = _random_point(found, at, params)
    valued = lambda formulas: np.array([number(formula.xreplace(point)).real for formula in formulas])
    symbols = [symbol for symbol, _ in params.paths]
    multipliers = valued(found.multipliers.get(x, sympy.Integer(0)) for x in s.multipliers)
    rates = [at.velocity[v] for v in s.qdot]
    state = [*map(valued, ([at.position[x] for x in s.q], rates, [at.parameters.get(x, x) for x in symbols]))]

    def balance(q_, v, p):
        flat = bound(system, like, unravel(p), params, StatesAt(states.tree.numbers, t, q_, v))
        M, force = inertia(flat, t, q_, v), inertial_force(flat, t, q_, v)
        force = force + applied_force(flat, t, q_, v, multipliers)
        return force + constraint_rows(flat, t, q_, v)[1].T @ multipliers, M.as_matrix()

    with jax.enable_x64(True):
        _, unravel = ravel_pytree(params.numbers)
        t = jax.numpy.asarray(float(point[s.t]))
        derivatives = lambda *state: jax.jacfwd(balance, argnums=(0, 1, 2), has_aux=True)(*state)
        (by_q, by_qdot, by_p), M = _evaluated(derivatives, state)
    J = valued(found.basis).reshape(found.basis.shape)
    want = {"M": J.T @ M @ J, "C": -J.T @ by_qdot @ J, "K": -J.T @ by_q @ J, "B": J.T @ by_p[:, [symbols.index(x) for x in inputs]]}
    for (name, wanted), matrix in zip(want.items(), (found.M, found.P, found.R, found.B), strict=True):
        got = valued(matrix).reshape(matrix.shape)
        if not np.all(np.isfinite(wanted)):
            raise ValueError(
                f"the forces must have a derivative at `linearised_at` in the simulation, too, but {name} is {wanted} there, as "
                "a power of a speed makes it at rest. Write drag by `jaxlag.dissipation.drag` or `power_law`."
            )
        if not np.allclose(got, wanted, rtol=0, atol=1e-9 * (1 + np.max(np.abs(wanted), initial=0))):
            raise ValueError(
                f"the linear equations must agree with the simulation, but {name} differs: {got} on paper, {wanted} in the simulation. "
                "Write functions with a derivative rule of their own (`custom_jvp`, `stop_gradient`) in elementary operations."
            )


def _evaluated(function, arguments):
    out = jax.eval_shape(function, *arguments)
    return jax.tree.unflatten(jax.tree.structure(out), evaluate(jax.make_jaxpr(function)(*arguments), Algebra(), *arguments))


def _random_point(found: Linearisation, at: OperatingPoint, params: SymbolTree) -> Numbers:
    """Numbers for all symbols, near the given parameters, for which the point is real."""
    draw = np.random.default_rng(0).uniform
    numbers = [float(entry) for array in jax.tree.leaves(params.numbers) for entry in np.ravel(array)]
    given = dict(zip([symbol for symbol, _ in params.paths], numbers, strict=True))
    state = [*at.position.values(), *at.velocity.values(), *at.parameters.values(), *found.multipliers.values()]
    everything = set(given).union(at.running, *(formula.free_symbols for formula in (*state, *found.M, *found.P, *found.R, *found.B)))
    symbols = sorted(everything, key=lambda symbol: symbol.name)
    for decades in np.linspace(0, 3, DRAWS):
        near = 10 ** draw(-decades, decades, len(symbols))
        point = {x: sympy.Float((given.get(x) or draw(0.2, 0.8)) * factor) for x, factor in zip(symbols, near, strict=True)}
        values = [number(formula.xreplace(point)) for formula in state]
        if all(np.isfinite(value) and value.imag == 0 for value in values):
            return point
    raise ValueError("`linearised_at` must be real for some parameters, but no such were found. Look at its roots and inverse functions.")
