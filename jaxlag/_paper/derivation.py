"""Lagrange's equations on paper: L, D, Q, g and a as formulas, and what follows from them line by line."""

from typing import NamedTuple

import sympy
from sympy import Eq, Expr, Matrix, Symbol

from .simplify import Tidy


class Statement(NamedTuple):
    """A system as formulas of its symbols."""

    t: Symbol
    q: tuple[Symbol, ...]
    qdot: tuple[Symbol, ...]
    qddot: tuple[Symbol, ...]
    multipliers: tuple[Symbol, ...]  # those of g, then those of a
    L: Expr
    D: Expr
    Q: Matrix
    g: Matrix
    a: Matrix


class Steps(NamedTuple):
    """The terms of Lagrange's equations, one row for each coordinate, and those of the constraints, one for each row of G."""

    momentum: Matrix  # ∂L/∂q̇
    inertia: Matrix  # d/dt ∂L/∂q̇
    slope: Matrix  # ∂L/∂q
    damping: Matrix  # ∂D/∂q̇
    reaction: Matrix  # Gᵀλ
    M: Matrix
    f: Matrix
    G: Matrix
    gamma: Matrix


def derived(s: Statement, tidy: Tidy) -> Steps:
    """M q̈ = f + Gᵀλ and G q̈ = −γ, with the steps that lead there."""
    L, D = tidy(s.L), tidy(s.D)
    n, column = len(s.q), lambda rows: Matrix(len(rows), 1, rows)
    p = [tidy(derivative(L, v)) for v in s.qdot]
    lower = {(i, j): tidy(derivative(p[i], s.qdot[j])) for i in range(n) for j in range(i + 1)}
    M = Matrix(n, n, lambda i, j: lower[max(i, j), min(i, j)])
    drift = [along(s, p_i) for p_i in p]
    slope = [tidy(derivative(L, x)) for x in s.q]
    damping = [tidy(derivative(D, v)) for v in s.qdot]
    psi = [*(along(s, g) for g in s.g), *s.a]
    G = Matrix(len(psi), n, lambda i, j: tidy(derivative(psi[i], s.qdot[j])))
    return Steps(
        momentum=column(p),
        inertia=(M * column(s.qddot) + column(drift)).applyfunc(lambda row: tidy.collected(row, s.qddot)),
        slope=column(slope),
        damping=column(damping),
        reaction=(G.T * column(s.multipliers)).applyfunc(tidy),
        M=M,
        f=column([tidy(slope[i] - drift[i] - damping[i] + s.Q[i]) for i in range(n)]),
        G=G,
        gamma=column([tidy(along(s, row)) for row in psi]),
    )


def motion(s: Statement, steps: Steps, tidy: Tidy) -> tuple[Eq, ...]:
    """The equations of motion, what depends on the motion on the left, applied forces and reactions on the right."""
    left = steps.inertia - steps.slope + steps.damping
    right = s.Q + steps.reaction
    return tuple(Eq(tidy.collected(l, s.qddot), tidy(r), evaluate=False) for l, r in zip(left, right, strict=True))


def residuals(s: Statement, steps: Steps) -> list[Expr]:
    """What q̈ and λ make zero: M q̈ − f − Gᵀλ and G q̈ + γ."""
    qddot = Matrix(len(s.qddot), 1, s.qddot)
    return [*(steps.M * qddot - steps.f - steps.reaction), *(steps.G * qddot + steps.gamma)]


def along(s: Statement, formula: Expr) -> Expr:
    """The total derivative (∂/∂q) q̇ + ∂/∂t of a formula, with q̇ held."""
    return sum((derivative(formula, x) * v for x, v in zip(s.q, s.qdot, strict=True)), start=derivative(formula, s.t))


class _size(sympy.Function):
    def fdiff(self, argindex=1):
        return _turn(self.args[0])


class _level(sympy.Function):
    def fdiff(self, argindex=1):
        return sympy.Integer(0)


_turn, _floor, _ceiling = (type(name, (_level,), {}) for name in ("_turn", "_floor", "_ceiling"))
KINKS = {sympy.Abs: _size, sympy.sign: _turn, sympy.floor: _floor, sympy.ceiling: _ceiling}


def derivative(formula: Expr, symbol: Symbol) -> Expr:
    """The derivative of a real formula, away from its kinks: d|u|/du = sign u, d sign u/du = 0."""
    if symbol not in formula.free_symbols:
        return sympy.Integer(0)
    if not formula.has(*KINKS, sympy.Max, sympy.Min):
        return formula.diff(symbol)
    for kink, smooth in KINKS.items():
        formula = formula.replace(kink, smooth)
    formula = formula.diff(symbol).replace(sympy.Heaviside, lambda u, *_: sympy.Piecewise((1, u > 0), (0, True)))
    for kink, smooth in KINKS.items():
        formula = formula.replace(smooth, kink)
    return formula


# Constraints that are solved for coordinates.


def eliminated(s: Statement, tidy: Tidy) -> dict[Symbol, Expr]:
    """Coordinates expressed by others: by holonomic constraints that are linear in them, with a factor that no coordinate enters.

    First come those that stand in the fewest constraints.
    """
    solved: dict[Symbol, Expr] = {}
    left = [tidy(g) for g in s.g]
    constraints = {x: sum(x in g.free_symbols for g in left) for x in s.q}
    while candidates := [
        (not factor.is_number, constraints[x], -j, i)
        for i, g in enumerate(left)
        for j, x in enumerate(s.q)
        if (factor := tidy(derivative(g, x))) != 0 and factor.free_symbols.isdisjoint((*s.q, s.t))
    ]:
        *_, minus_j, i = min(candidates)
        x, g = s.q[-minus_j], left.pop(i)
        formula = {x: tidy(x - g / derivative(g, x))}
        solved = {y: tidy(h.xreplace(formula)) for y, h in solved.items()} | formula
        left = [tidy(h.xreplace(formula)) for h in left]
    return solved


def reduced(s: Statement, steps: Steps, solved: dict[Symbol, Expr], tidy: Tidy) -> tuple[Statement, Steps, tuple[Expr, ...], list[Expr]]:
    """The system in the coordinates that are left, all accelerations in those that are left, and what determines the other multipliers."""
    if not solved:
        return s, steps, s.qddot, []
    kept = [i for i, x in enumerate(s.q) if x not in solved]
    new = s._replace(**{name: tuple(getattr(s, name)[i] for i in kept) for name in ("q", "qdot", "qddot")})
    position = [solved.get(x, x) for x in s.q]
    velocity = [tidy(along(new, x)) for x in position]
    J = Matrix(len(s.q), len(kept), lambda i, j: derivative(velocity[i], new.qdot[j]))
    acceleration = J * Matrix(len(kept), 1, new.qddot) + Matrix([along(new, v) for v in velocity])
    rules = dict(zip((*s.q, *s.qdot, *s.qddot), map(tidy, (*position, *velocity, *acceleration)), strict=True))
    insert = lambda formula: formula.xreplace(rules)
    held = [(tidy(insert(g)), multiplier) for g, multiplier in zip(s.g, s.multipliers, strict=False)]
    left = [(g, multiplier) for g, multiplier in held if g != 0]
    new = new._replace(
        multipliers=(*(multiplier for _, multiplier in left), *s.multipliers[len(s.g) :]),
        L=insert(s.L),
        D=insert(s.D),
        Q=(J.T * s.Q.applyfunc(insert)).applyfunc(tidy),
        g=Matrix(len(left), 1, [g for g, _ in left]),
        a=s.a.applyfunc(insert),
    )
    full = residuals(s, steps)
    return new, derived(new, tidy), tuple(rules[a] for a in s.qddot), [insert(full[i]) for i, x in enumerate(s.q) if x in solved]
