"""Holonomic constraints solved for coordinates, and the system in the coordinates that remain."""

from sympy import Expr, Matrix, Symbol

from .derivation import Steps, SymbolicSystem, derive, residuals, total_derivative
from .derivative import derivative
from .simplify import Simplifier


def eliminate_coordinates(s: SymbolicSystem, simplify: Simplifier) -> dict[Symbol, Expr]:
    """Coordinates in terms of others, from holonomic constraints that are linear in them, with a factor free of coordinates.

    Coordinates that appear in the fewest constraints come first.
    """
    eliminated: dict[Symbol, Expr] = {}
    left = [simplify(g) for g in s.g]
    constraints = {x: sum(x in g.free_symbols for g in left) for x in s.q}
    while candidates := [
        (not factor.is_number, constraints[x], -j, i)
        for i, g in enumerate(left)
        for j, x in enumerate(s.q)
        if (factor := simplify(derivative(g, x))) != 0 and factor.free_symbols.isdisjoint((*s.q, s.t))
    ]:
        *_, minus_j, i = min(candidates)
        x, g = s.q[-minus_j], left.pop(i)
        formula = {x: simplify(x - g / derivative(g, x))}
        eliminated = {y: simplify(h.xreplace(formula)) for y, h in eliminated.items()} | formula
        left = [simplify(h.xreplace(formula)) for h in left]
    return eliminated


def reduce_system(
    s: SymbolicSystem, steps: Steps, eliminated: dict[Symbol, Expr], simplify: Simplifier
) -> tuple[SymbolicSystem, Steps, tuple[Expr, ...], list[Expr]]:
    """The system in the remaining coordinates, all accelerations in terms of these, and residuals that determine the other λ."""
    if not eliminated:
        return s, steps, s.qddot, []
    remaining = [i for i, x in enumerate(s.q) if x not in eliminated]
    new = s._replace(**{name: tuple(getattr(s, name)[i] for i in remaining) for name in ("q", "qdot", "qddot")})
    position = [eliminated.get(x, x) for x in s.q]
    velocity = [simplify(total_derivative(new, x)) for x in position]
    J = Matrix(len(s.q), len(remaining), lambda i, j: derivative(velocity[i], new.qdot[j]))
    acceleration = J * Matrix(len(remaining), 1, new.qddot) + Matrix([total_derivative(new, v) for v in velocity])
    rules = dict(zip((*s.q, *s.qdot, *s.qddot), map(simplify, (*position, *velocity, *acceleration)), strict=True))
    insert = lambda formula: formula.xreplace(rules)
    constraints = [(simplify(insert(g)), multiplier) for g, multiplier in zip(s.g, s.multipliers, strict=False)]
    left = [(g, multiplier) for g, multiplier in constraints if g != 0]
    new = new._replace(
        multipliers=(*(multiplier for _, multiplier in left), *s.multipliers[len(s.g) :]),
        L=insert(s.L),
        D=insert(s.D),
        Q=(J.T * s.Q.applyfunc(insert)).applyfunc(simplify),
        g=Matrix(len(left), 1, [g for g, _ in left]),
        a=s.a.applyfunc(insert),
        rates=tuple(map(insert, s.rates)),
        updates=tuple(formula and insert(formula) for formula in s.updates),
    )
    full = residuals(s, steps)
    return new, derive(new, simplify), tuple(rules[a] for a in s.qddot), [insert(full[i]) for i, x in enumerate(s.q) if x in eliminated]
