"""Lagrange's equations on paper: from L, D, Q, g and a as formulas to the equations of motion, term by term."""

from typing import NamedTuple

from sympy import Eq, Expr, Matrix, Symbol

from .derivative import derivative
from .simplify import Simplifier


class ContactLaw(NamedTuple):
    """A contact as formulas: its name, the symbols of its gap and gap rate, the gap, the symbol of its force, and its impact law."""

    name: str
    gap: Symbol
    rate: Symbol
    formula: Expr
    multiplier: Symbol
    restitution: Expr
    by_impulse: bool  # Poisson's law, not Newton's


class SymbolicSystem(NamedTuple):
    """A system as formulas of its symbols."""

    t: Symbol
    q: tuple[Symbol, ...]
    qdot: tuple[Symbol, ...]
    qddot: tuple[Symbol, ...]
    multipliers: tuple[Symbol, ...]  # for g, then for a
    L: Expr
    D: Expr
    Q: Matrix
    g: Matrix  # and the gaps of contacts, as if all were closed
    a: Matrix
    z: tuple[Symbol, ...] = ()  # first-order states
    zdot: tuple[Symbol, ...] = ()
    rates: tuple[Expr, ...] = ()  # of these
    u: tuple[Symbol, ...] = ()  # sampled states
    updates: tuple[Expr | None, ...] = ()  # of these; None if they have no formula
    contacts: tuple[ContactLaw, ...] = ()


class Steps(NamedTuple):
    """The terms of Lagrange's equations, one row for each coordinate, and of the constraints, one for each row of G."""

    momentum: Matrix  # ∂L/∂q̇
    momentum_rate: Matrix  # d/dt ∂L/∂q̇
    gradient: Matrix  # ∂L/∂q
    damping: Matrix  # ∂D/∂q̇
    reaction: Matrix  # Gᵀλ
    M: Matrix
    f: Matrix
    G: Matrix
    gamma: Matrix


def derive(s: SymbolicSystem, simplify: Simplifier) -> Steps:
    """M q̈ = f + Gᵀλ and G q̈ = −γ, with the steps that lead there."""
    L, D = simplify(s.L), simplify(s.D)
    n, column = len(s.q), lambda rows: Matrix(len(rows), 1, rows)
    p = [simplify(derivative(L, v)) for v in s.qdot]
    lower = {(i, j): simplify(derivative(p[i], s.qdot[j])) for i in range(n) for j in range(i + 1)}
    M = Matrix(n, n, lambda i, j: lower[max(i, j), min(i, j)])
    drift = [total_derivative(s, p_i) for p_i in p]
    gradient = [simplify(derivative(L, x)) for x in s.q]
    damping = [simplify(derivative(D, v)) for v in s.qdot]
    psi = [*(total_derivative(s, g) for g in s.g), *s.a]
    G = Matrix(len(psi), n, lambda i, j: simplify(derivative(psi[i], s.qdot[j])))
    return Steps(
        momentum=column(p),
        momentum_rate=(M * column(s.qddot) + column(drift)).applyfunc(lambda row: simplify.collected(row, s.qddot)),
        gradient=column(gradient),
        damping=column(damping),
        reaction=(G.T * column(s.multipliers)).applyfunc(simplify),
        M=M,
        f=column([simplify(gradient[i] - drift[i] - damping[i] + s.Q[i]) for i in range(n)]),
        G=G,
        gamma=column([simplify(total_derivative(s, row)) for row in psi]),
    )


def equations_of_motion(s: SymbolicSystem, steps: Steps, simplify: Simplifier) -> tuple[Eq, ...]:
    """Inertia, potential and dissipation on the left, applied forces and reactions on the right."""
    left = steps.momentum_rate - steps.gradient + steps.damping
    right = s.Q + steps.reaction
    return tuple(Eq(simplify.collected(l, s.qddot), simplify(r), evaluate=False) for l, r in zip(left, right, strict=True))


def residuals(s: SymbolicSystem, steps: Steps) -> list[Expr]:
    """Expressions that are zero for the right q̈ and λ: M q̈ − f − Gᵀλ and G q̈ + γ, except for contacts, which may be open."""
    qddot, holonomic = Matrix(len(s.qddot), 1, s.qddot), len(s.g) - len(s.contacts)
    rows = list(steps.G * qddot + steps.gamma)
    return [*(steps.M * qddot - steps.f - steps.reaction), *rows[:holonomic], *rows[len(s.g) :]]


def total_derivative(s: SymbolicSystem, formula: Expr) -> Expr:
    """The total derivative (∂/∂q) q̇ + (∂/∂z) ż + (∂/∂ż) z̈ + ∂/∂t of a formula, with q̇ constant."""
    flow = [(x, v) for x, v in zip((*s.q, *s.z), (*s.qdot, *s.zdot), strict=True)]
    flow += [(v, total_derivative(s, rate)) for v, rate in zip(s.zdot, s.rates, strict=True) if formula.has(v)]
    return sum((derivative(formula, x) * v for x, v in flow), start=derivative(formula, s.t))
