"""Equations of motion linearised about an equilibrium or a steady motion, in independent coordinates."""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
import sympy
from sympy import Expr, Matrix, Symbol
from sympy.core.relational import Relational

from .coordinate_elimination import eliminate_coordinates
from .derivation import Steps, SymbolicSystem, total_derivative
from .derivative import Side, derivative, one_sided
from .linear_solve import solve_linear
from .operating_point import OperatingPoint
from .simplify import Simplifier

NOT_FINITE = sympy.nan, sympy.zoo, sympy.oo, -sympy.oo
NUMBERS = "`linearise` does it with numbers"


class Linearisation(NamedTuple):
    """M δq̈ + P δq̇ + R δq = B δu in independent coordinates, and the reduction to these from all coordinates."""

    independent: tuple[int, ...]
    eliminated: dict[Symbol, Expr]  # deviations of the other coordinates
    basis: Matrix  # J: all deviations are J times the independent ones
    multipliers: dict[Symbol, Expr]  # λ at the point, of constraints that are curved there
    M: Matrix
    P: Matrix
    R: Matrix
    B: Matrix


class Lineariser:
    """Linearises a system at a point; `show` writes formulas in messages."""

    def __init__(self, s: SymbolicSystem, steps: Steps, at: OperatingPoint, simplify: Simplifier, show: Callable[[Expr], str]):
        self.s, self.steps, self.at, self.simplify, self.show = s, steps, at, simplify, show

    def __call__(self, inputs: Sequence[Symbol]) -> Linearisation:
        """The linear equations, after checks that they exist."""
        s, steps = self.s, self.steps
        self._check_kind(inputs)
        self._check_constraints()
        deviations = tuple(Symbol(f"δ{x.name}", real=True) for x in s.q)
        eliminated, J = self._tangent(deviations)
        independent = tuple(i for i, x in enumerate(deviations) if x not in eliminated)
        force = steps.f.applyfunc(lambda f: one_sided(f, self._is_zero))
        at_rest, by_q, by_qdot = (self._at(part) for part in (force, _jacobian(force, s.q), _jacobian(force, s.qdot)))
        self._check_smooth(force, at_rest.row_join(by_q).row_join(by_qdot))
        self._check_balance(J, at_rest, independent)
        curvature = self._at(_jacobian(steps.reaction, s.q))
        multipliers = self._multipliers(at_rest, [i for i in range(len(s.q)) if i not in independent], curvature)
        in_tangent = lambda matrix: (J.T * matrix * J).applyfunc(self.simplify)
        found = Linearisation(
            independent=independent,
            eliminated=eliminated,
            basis=J,
            multipliers=multipliers,
            M=in_tangent(self._at(steps.M)),
            P=in_tangent(-by_qdot),
            R=in_tangent(-by_q - curvature.xreplace(multipliers)),
            B=(J.T * self._at(_jacobian(force, inputs))).applyfunc(self.simplify),
        )
        self._check_constant(found)
        return found

    def _at_point(self, formula: Expr) -> Expr:
        """A formula at the point."""
        value, beside = self.at(formula), lambda formula: formula.xreplace(dict.fromkeys(formula.atoms(Side), sympy.Integer(1)))
        if value.has(*NOT_FINITE):
            value = self._as_rates_vanish(formula)
        if value.has(*NOT_FINITE):
            raise ValueError(
                f"`linearised_at` must be a state where all formulas are finite, but {self.show(beside(formula))} is not. "
                "Choose another one, or other coordinates."
            )
        return self.simplify(value)

    def _as_rates_vanish(self, formula: Expr) -> Expr:
        """The limit at rest, if it is the same from all directions, as for the slope of |v| v, which is 0/0 as it stands."""
        if any(self.at(rate) != 0 for rate in self.s.qdot):
            return sympy.nan
        small, directions = sympy.Dummy("ε", positive=True), [sympy.Dummy(rate.name, real=True) for rate in self.s.qdot]
        near = self.at(formula.xreplace({rate: small * way for rate, way in zip(self.s.qdot, directions, strict=True)}))
        near = near.replace(lambda part: part.is_Pow and not part.exp.is_integer, lambda part: sympy.factor(part.base) ** part.exp)
        limit = sympy.cancel(sympy.together(near)).xreplace({small: sympy.Integer(0)})
        return sympy.nan if limit.free_symbols & {small, *directions} else limit

    def _at(self, matrix: Matrix) -> Matrix:
        return matrix.applyfunc(self._at_point)

    def _is_zero(self, formula: Expr) -> bool:
        value = self._at_point(formula)
        return value == 0 or is_identity(value)

    def _list(self, pairs: Iterable[tuple[Expr, Expr]]) -> str:
        return ", ".join(f"{self.show(left)} = {self.show(right)}" for left, right in pairs)

    def _tangent(self, deviations: tuple[Symbol, ...]) -> tuple[dict[Symbol, Expr], Matrix]:
        """Deviations that the constraints express in terms of the others, and the basis J of all deviations."""
        column = Matrix(len(deviations), 1, deviations)
        G = self._at(self.steps.G)
        eliminated = eliminate_coordinates(self.s._replace(q=deviations, g=G * column), self.simplify)
        if len(eliminated) < G.rows:
            raise ValueError(
                f"the constraints must be independent at `linearised_at`, but only {len(eliminated)} of {G.rows} rows are. "
                f"Drop those that repeat others, or choose another state; {NUMBERS}."
            )
        return eliminated, _jacobian(column.xreplace(eliminated), [x for x in deviations if x not in eliminated])

    def _multipliers(self, force: Matrix, dependent: Sequence[int], curvature: Matrix) -> dict[Symbol, Expr]:
        """λ from f + Gᵀλ = 0, if constraints are curved."""
        if curvature.free_symbols.isdisjoint(self.s.multipliers):
            return {}
        balance = force + self._at(self.steps.reaction)
        multipliers = solve_linear([balance[i] for i in dependent], self.s.multipliers, self.simplify)
        if len(multipliers) < len(self.s.multipliers):
            raise ValueError(f"the reactions at `linearised_at` must have formulas short enough to be read, but have none; {NUMBERS}.")
        return multipliers

    # Systems and points that cannot be linearised.

    def _check_kind(self, inputs: Sequence[Symbol]) -> None:
        s, steps = self.s, self.steps
        used = steps.M.free_symbols | steps.f.free_symbols | steps.G.free_symbols
        momenta = self._at(steps.momentum).free_symbols
        moving = [x.name for x in inputs if x in steps.G.free_symbols | s.g.free_symbols | momenta]
        reasons = {
            "has nonholonomic constraints. Write those that can be integrated as `holonomic`": bool(s.a),
            "has further states that act on it. Write them as parameters": not used.isdisjoint((*s.z, *s.zdot, *s.u)),
            "has forces that depend on multipliers. Write them by coordinates": not steps.f.free_symbols.isdisjoint(s.multipliers),
            f"of `inputs` {', '.join(moving)} moves a constraint or a mass. Name those of forces and potentials": bool(moving),
        }
        for reason, holds in reasons.items():
            if holds:
                raise ValueError(f"`system` must be linear of second order for `linearised_at`, but {reason}; {NUMBERS}.")

    def _check_constraints(self) -> None:
        for g in self.s.g:
            for residual, what in ((g, "g"), (total_derivative(self.s, g), "dg/dt")):
                if not self._is_zero(residual):
                    value = self.show(self._at_point(residual))
                    raise ValueError(
                        f"`linearised_at` must satisfy the constraints, but with g = {self.show(g)}, {what} is {value} there. "
                        "Give all coordinates that it holds, and name in `positive` what is positive."
                    )

    def _check_smooth(self, force: Matrix, derivatives: Matrix) -> None:
        for i, formula in enumerate(force):
            borders = [border.lhs - border.rhs for border in formula.atoms(Relational)]
            whole = [self.at(step.args[0]).is_integer for step in formula.atoms(sympy.floor, sympy.ceiling)]
            if any(map(self._is_zero, borders)) or any(whole) or derivatives[i, :].has(Side):
                raise ValueError(
                    f"the forces must be smooth at `linearised_at`, but {self.show(self.steps.f[i])} has a jump or a kink there, as dry "
                    "friction at rest has. Choose a state beside it, or a smooth law."
                )

    def _check_balance(self, J: Matrix, force: Matrix, independent: Sequence[int]) -> None:
        """Checks that the point stays as it is: constant rates, and forces balanced along all deviations."""
        changing = [(x, formula) for x, formula in self.at.given.items() if not formula.free_symbols.isdisjoint(self.at.running)]
        if changing:
            raise ValueError(
                f"`linearised_at` must be constant, but {self._list(changing)} changes along the motion. Give it by parameters."
            )
        turning = [residual for residual in self._at(self.steps.gamma) if residual != 0 and not self._is_zero(residual)]
        if turning:
            raise ValueError(
                f"`linearised_at` must be a steady motion, but the constraints turn it: G q̈ = {self.show(-turning[0])}. "
                "Choose coordinates whose rates are constant, such as angles."
            )
        balance = (J.T * force).applyfunc(self.simplify)
        if not all(map(self._is_zero, balance)):
            rows = [-row if row.could_extract_minus_sign() else row for row in balance if row != 0]
            if not self.s.g and not any(row.is_Add for row in map(self.simplify, rows)):  # as m g = 0, which no coordinate can satisfy
                still = dict.fromkeys(self.s.qdot, sympy.Integer(0))
                rows = [row for row in self.steps.f.xreplace(still) if not self._is_zero(row)]
            condition = self._list((self.simplify(row), sympy.Integer(0)) for row in rows)
            accelerations = self._accelerations(J, balance, independent)
            raise ValueError(
                f"`linearised_at` must be an equilibrium or a steady motion, but {accelerations} there. It is one where {condition}. "
                "Give coordinates, rates, or parameters in the same mapping, for which this holds, and name in `positive` what is positive."
            )

    def _accelerations(self, J: Matrix, balance: Matrix, independent: Sequence[int]) -> str:
        unknowns = [self.s.qddot[i] for i in independent]
        rows = J.T * self._at(self.steps.M) * J * Matrix(len(unknowns), 1, unknowns) - balance
        solution = solve_linear(rows, unknowns, self.simplify)
        return self._list((a, solution[a]) for a in unknowns if solution.get(a, 0) != 0) or "forces do not balance"

    def _check_constant(self, found: Linearisation) -> None:
        for matrix in (found.M, found.P, found.R, found.basis):
            changing = [entry for entry in matrix if not entry.free_symbols.isdisjoint(self.at.running)]
            if changing:
                raise ValueError(
                    f"the linear equations must have constant coefficients, but one is {self.show(changing[0])}, which changes along the "
                    f"motion. Choose coordinates that turn with it; {NUMBERS}."
                )


def is_identity(formula: Expr) -> bool:
    """Whether a formula is zero at random numbers, positive and negative, to 25 of 40 digits, even if no simplification shows it."""
    draw = np.random.default_rng(0)
    for _ in range(10):
        signs = {x: 1 if x.is_positive else draw.choice((-1, 1)) for x in sorted(formula.free_symbols, key=lambda x: x.name)}
        value = formula.xreplace({x: sympy.Float(sign * draw.uniform(0.2, 2.0), 40) for x, sign in signs.items()})
        if not (value.is_number and abs(value.evalf(40)) < 1e-25):
            return False
    return True


def _jacobian(column: Matrix, symbols: Sequence[Symbol]) -> Matrix:
    """The Jacobian; next to kinks, with the powers of their sides separated: the derivative of |v|^(3/2) at v = 0 is zero."""
    entry = lambda formula: sympy.expand_power_base(formula, force=True) if formula.has(Side) else formula
    return Matrix(len(column), len(symbols), lambda i, j: entry(derivative(column[i], symbols[j])))
