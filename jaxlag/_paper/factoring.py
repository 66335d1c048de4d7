"""Sums of products as formulas, with common factors in front of brackets."""

import itertools
from collections.abc import Iterable
from typing import Any

import sympy
from sympy import Add, Expr, Mul, Symbol, cos, sin

from .sum_of_products import ONE, Atoms, Product, Sum, common_factor, divided, divides

QUOTIENTS = {sympy.tan: (sin, cos), sympy.tanh: (sympy.sinh, sympy.cosh)}
MANY_TERMS = 30  # number of terms above which only single symbols are tried as common factors

Term = tuple[dict[int, Any], Expr]  # powers and their coefficient


class Factoring:
    """Writes sums as formulas; terms with different powers of the `separate` symbols, e.g. velocities, do not share a bracket."""

    def __init__(self, atoms: Atoms, separate: Iterable[Symbol], parameters: Iterable[Symbol]):
        self.atoms, self.separate, self.parameters = atoms, frozenset(separate), frozenset(parameters)

    def of_sum(self, terms: Sum) -> Expr:
        """The formula of a sum of products, with common factors in front of brackets."""
        groups: dict[Product, list[Term]] = {}
        for product, c in terms.items():
            outside = tuple((a, e) for a, e in product if not self.separate.isdisjoint(self.atoms[a].free_symbols))
            groups.setdefault(outside, []).append(({a: e for a, e in product if (a, e) not in outside}, c))
        return Add(*(Mul(self._factored(group), self.of_product(dict(outside))) for outside, group in groups.items()))

    def of_product(self, powers: dict[int, Any], c: Expr = ONE) -> Expr:
        """The formula of a product, with tan in place of sin/cos."""
        for quotient, (above, below) in QUOTIENTS.items():
            for atom in [atom for atom in powers if self.atoms[atom].func is above]:
                (angle,) = self.atoms[atom].args
                other = self.atoms.index(below(angle))
                if powers.get(other) == -powers[atom]:
                    c, powers = c * quotient(angle) ** powers[atom], {a: e for a, e in powers.items() if a not in (atom, other)}
        return Mul(c, *(self.atoms[atom] ** exponent for atom, exponent in powers.items()))

    def _factored(self, group: list[Term]) -> Expr:
        """A sum of terms with the factor that saves most in front of a bracket, repeated inside and outside the bracket."""
        if len(group) == 1:
            return self.of_product(*group[0])
        common = common_factor(*(powers for powers, _ in group))
        if common:
            coefficients = [c for _, c in group]
            content = sympy.gcd_list(coefficients) if all(c.is_Rational for c in coefficients) else ONE
            content = -content if self._leading_coefficient(group).could_extract_minus_sign() else content
            return Mul(content, self.of_product(common), self._factored([(divided(powers, common), c / content) for powers, c in group]))
        best = max(self._candidates(group), key=lambda factor: self._saving(group, factor), default=None)
        if best is None:
            return Add(*(self.of_product(*term) for term in group))
        inside = [term for term in group if divides(best, term[0])]
        return Add(self._factored(inside), self._factored([term for term in group if term not in inside]))

    def _candidates(self, group: list[Term]) -> list[dict[int, Any]]:
        """The common factors of each pair of terms, or single symbols in a long sum, to keep the time from growing with the third power."""
        if len(group) > MANY_TERMS:
            return [
                {atom: 1}
                for atom in dict.fromkeys(atom for powers, _ in group for atom in powers)
                if sum(divides({atom: 1}, p) for p, _ in group) > 1
            ]
        return [factor for (left, _), (right, _) in itertools.combinations(group, 2) if (factor := common_factor(left, right))]

    def _saving(self, group: list[Term], factor: dict[int, Any]) -> tuple[Any, bool]:
        terms = sum(divides(factor, powers) for powers, _ in group)
        size = sum(abs(e) if isinstance(e, int) or e.is_Rational else 1 for e in factor.values())  # e of exp(e) may be a formula
        return (terms - 1) * size, all(self.atoms[a] in self.parameters for a in factor)

    def _leading_coefficient(self, group: list[Term]) -> Expr:
        """The coefficient of the first term that is not made of parameters alone."""
        is_moving = lambda powers: any(self.atoms[atom] not in self.parameters for atom in powers)
        return next((c for powers, c in group if is_moving(powers)), group[0][1])
