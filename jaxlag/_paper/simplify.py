"""Formulas simplified as by a person: like terms combined by well-known identities, common factors in front of brackets."""

from collections.abc import Iterable
from typing import Any

from sympy import Abs, Add, Expr, Mul, Symbol, sign

from .factoring import QUOTIENTS, Factoring
from .identities import combine
from .sum_of_products import ONE, Atoms, Product, Sum, added, common_factor, divided

MOST_PRODUCTS = 2000  # of a sum that is still expanded; nobody reads more


class Simplifier:
    """Simplifies formulas; terms with different powers of the `separate` symbols, e.g. velocities, do not share a bracket."""

    def __init__(self, separate: Iterable[Symbol] = (), parameters: Iterable[Symbol] = ()):
        self.atoms = Atoms()
        self.unexpanded: set[Expr] = set()  # sums inside | | and sign, which are not expanded next to these
        self._factoring = Factoring(self.atoms, separate, parameters)
        self._normal_forms: dict[Expr, Expr] = {}  # of such sums, by their original form
        self._expanded: dict[Expr, Sum] = {}

    def __call__(self, formula: Expr) -> Expr:
        """The formula, simplified."""
        return self._factoring.of_sum(self.terms(formula))

    def collected(self, formula: Expr, leading: Iterable[Symbol]) -> Expr:
        """The formula, simplified, with one coefficient for each of the leading symbols, in which it is linear."""
        terms, parts = self.terms(formula), []
        for symbol in leading:
            atom = (self.atoms.index(symbol), 1)
            mine = {product: terms.pop(product) for product in [*terms] if atom in product}
            coefficient = {tuple(a for a in product if a != atom): c for product, c in mine.items()}
            parts.append(Mul(self._factoring.of_sum(coefficient), symbol))
        return Add(*parts, self._factoring.of_sum(terms))

    def factored(self, formula: Expr) -> Expr:
        """The formula, simplified, with the factors that all its terms share in front."""
        terms = self.terms(formula)
        common = common_factor(*map(dict, terms)) if terms else {}
        sign_ = -ONE if all(c.could_extract_minus_sign() for c in terms.values()) else ONE
        rest = self._factoring.of_sum({tuple(divided(dict(product), common).items()): sign_ * c for product, c in terms.items()})
        sums = set.intersection(*(set(Mul.make_args(part)) for part in Add.make_args(rest))) if rest.is_Add else set()
        bracket = Mul(*(factor for factor in sums if factor.is_Add))
        return Mul(sign_, self._factoring.of_product(common), bracket, Add(*(part / bracket for part in Add.make_args(rest))))

    def terms(self, formula: Expr) -> Sum:
        """The formula as a sum of products, none of which cancel or combine."""
        if formula.has(Abs, sign):
            formula = formula.replace(lambda e: isinstance(e, (Abs, sign)), self._normalised)
        return combine(self, self._expanded_where_alone(self.expanded(formula)))

    # Expansion.

    def expanded(self, formula: Expr) -> Sum:
        """The formula as a sum of products."""
        if formula not in self._expanded:
            self._expanded[formula] = self._expand(self._normal_forms.get(formula, formula))
        return self._expanded[formula]

    def _expand(self, formula: Expr) -> Sum:
        if formula.is_number:
            return {(): formula} if formula != 0 else {}
        if formula.is_Add:
            content, primitive = formula.primitive() if self.unexpanded else (ONE, formula)
            for number, u in ((content, primitive), (-content, -primitive)):
                if u in self.unexpanded:
                    return {((self.atoms.index(u), 1),): number}
            return added(map(self.expanded, formula.args))
        if formula.is_Mul:
            return self.product(map(self.expanded, formula.args))
        base, exponent = formula.as_base_exp()
        if exponent.is_Integer and exponent > 1:
            return self.product([self.expanded(base)] * int(exponent))
        if formula.func in QUOTIENTS:
            above, below = QUOTIENTS[formula.func]
            return self.expanded(above(*formula.args) / below(*formula.args))
        simplified = formula.func(*map(self._argument, formula.args)) if formula.args else formula
        if simplified.func is not formula.func:  # SymPy has simplified it further, e.g. √(l²) = |l|
            return self.expanded(self._normalised(simplified))
        base, exponent = simplified.as_base_exp()
        return {((self.atoms.index(base), int(exponent) if exponent.is_Integer else exponent),): ONE}

    def _argument(self, argument: Any) -> Any:
        """An argument of a function, simplified: a formula, or a condition or a pair that holds formulas."""
        if isinstance(argument, Expr):
            return self(argument)
        return argument.func(*map(self._argument, argument.args)) if argument.args else argument

    def product(self, sums: Iterable[Sum]) -> Sum:
        """The product of sums; a sum that would make it too long enters as an atom."""
        out: Sum = {(): ONE}
        for terms in sums:
            if len(out) * len(terms) > MOST_PRODUCTS:
                terms = {((self.atoms.index(self._factoring.of_sum(terms)), 1),): ONE}
            out = added({self.atoms.times(p, r): c * d} for p, c in out.items() for r, d in terms.items())
        return out

    # Sums inside | | and sign.

    def _normalised(self, term: Expr) -> Expr:
        """|u| or sign u with u simplified; a sum u is recorded, so that it is not expanded next to |u|."""
        if not isinstance(term, (Abs, sign)):
            return term
        (u,) = term.args
        if u.is_Mul:
            return Mul(*(self._normalised(term.func(factor)) for factor in u.args))
        if u in self.unexpanded or not u.is_Add:
            return term if u in self.unexpanded else term.func(self(u))
        number, simplified = self(u).primitive()  # positive
        if not simplified.is_Add:
            return self._normalised(term.func(number * simplified))
        size = Abs(simplified)
        sign_ = 1 if not isinstance(size, Abs) or size.args[0] == simplified else -1  # always the same one of u and −u
        self.unexpanded |= {size.args[0]} if isinstance(size, Abs) else set()
        self._normal_forms |= {u: number * simplified, -u: -number * simplified}
        self._expanded.clear()
        return number * size if isinstance(term, Abs) else sign_ * sign(sign_ * simplified)

    def _expanded_where_alone(self, terms: Sum) -> Sum:
        """The terms with each sum expanded that is not next to its own | | or sign."""
        if not self.unexpanded:
            return terms
        partners = {self.atoms.index(u): {self.atoms.index(Abs(u)), self.atoms.index(sign(u))} for u in self.unexpanded}
        return added(self._expanded_alone(product, c, partners) for product, c in terms.items())

    def _expanded_alone(self, product: Product, c: Expr, partners: dict[int, set[int]]) -> Sum:
        atoms = {atom for atom, _ in product}
        alone = [(a, e) for a, e in product if a in partners and not partners[a] & atoms and isinstance(e, int) and e > 0]
        if not alone:
            return {product: c}
        sums = [added(map(self.expanded, self.atoms[a].args)) for a, e in alone for _ in range(e)]
        return self.product([{tuple(power for power in product if power not in alone): c}, *sums])
