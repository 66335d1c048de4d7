"""Linear equations between formulas, solved by elimination if the solution is short enough to read."""

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import sympy
from sympy import QQ, Expr, Symbol, cos, sin
from sympy.polys.fields import field
from sympy.polys.orderings import lex

from .simplify import Simplifier
from .sum_of_products import Sum

MOST_TERMS = 100  # of a minor: 31 for a chain of three pendulums, 855 for one of four, whose solution nobody wants to see


def solve_linear(equations: Iterable[Expr], unknowns: Iterable[Symbol], simplify: Simplifier) -> dict[Symbol, Expr]:
    """The unknowns that formulas, set to zero, determine linearly: first unknowns alone in a formula, then unknowns of coupled formulas."""
    left = [simplify(equation) for equation in equations]
    unknowns = list(unknowns)
    solution: dict[Symbol, Expr] = {}
    while True:
        groups = (_solve_group(left, rows, unknowns, simplify) for rows in _coupled(left, unknowns))
        rows, found = next((group for group in groups if group[1]), ([], {}))
        if not found:
            return solution
        solution |= found
        unknowns = [x for x in unknowns if x not in found]
        left = [simplify(equation.xreplace(found)) for i, equation in enumerate(left) if i not in rows]


def _coupled(equations: Sequence[Expr], unknowns: Sequence[Symbol]) -> Iterator[list[int]]:
    """Rows with one unknown, then groups of rows that share unknowns."""
    inside = [equation.free_symbols & set(unknowns) for equation in equations]
    yield from ([i] for i, symbols in enumerate(inside) if len(symbols) == 1)
    waiting = {i for i, symbols in enumerate(inside) if symbols}
    while waiting:
        rows, neighbours = set[int](), {min(waiting)}
        while neighbours - rows:
            rows |= neighbours
            symbols = set().union(*(inside[i] for i in rows))
            neighbours = {i for i in waiting if inside[i] & symbols}
        waiting -= rows
        yield sorted(rows)


def _solve_group(
    equations: Sequence[Expr], rows: list[int], unknowns: Sequence[Symbol], simplify: Simplifier
) -> tuple[list[int], dict[Symbol, Expr]]:
    """The rows, and the unknowns that they determine."""
    mine = [x for x in unknowns if any(x in equations[i].free_symbols for i in rows)]
    if len(mine) != len(rows):
        return rows, {}
    zero = dict.fromkeys(mine, sympy.Integer(0))
    A = [[simplify(equations[i].diff(x)) for x in mine] for i in rows]
    b = [-simplify(equations[i].xreplace(zero)) for i in rows]
    is_linear = all(entry.free_symbols.isdisjoint(mine) for row in A for entry in row)
    x = _eliminate(A, b, simplify) if is_linear else None
    return rows, {} if x is None else dict(zip(mine, x, strict=True))


def _eliminate(A: list[list[Expr]], b: list[Expr], simplify: Simplifier) -> list[Expr] | None:
    """The solution of A x = b in the field of fractions of all atoms; None if A is singular or the solution is too long."""
    if _longest_minor([[len(simplify.terms(entry)) for entry in row] for row in A]) > MOST_TERMS:
        return None
    fractions = _Fractions(simplify, [*itertools.chain(*A), *b])
    rows = [[fractions.of(simplify.terms(entry)) for entry in (*row, right)] for row, right in zip(A, b, strict=True)]
    row_of: dict[int, int] = {}  # for each unknown
    while len(row_of) < len(rows):
        pivot = _pivot({i: row[:-1] for i, row in enumerate(rows) if i not in row_of.values()}, lambda x: len(x.numer) + len(x.denom))
        if pivot is None:
            return None
        i, j = pivot
        row_of[j] = i
        rows[i] = [entry / rows[i][j] for entry in rows[i]]
        for k, row in enumerate(rows):
            if k != i and row[j]:
                rows[k] = [fractions.reduced(x - row[j] * y) if y else x for x, y in zip(row, rows[i], strict=True)]
    return [fractions.formula(rows[row_of[j]][-1]) for j in range(len(b))]


def _pivot(rows: dict[int, list[Any]], length: Callable[[Any], int]) -> tuple[int, int] | None:
    """The entry with the least fill-in (Markowitz), and among these the shortest; None if all entries are zero."""
    in_row = {i: sum(map(bool, row)) for i, row in rows.items()}
    in_column = [sum(map(bool, column)) for column in zip(*rows.values(), strict=True)]
    places = [(i, j) for i, row in rows.items() for j, entry in enumerate(row) if entry]
    fill_in = lambda place: ((in_row[place[0]] - 1) * (in_column[place[1]] - 1), length(rows[place[0]][place[1]]), place)
    return min(places, key=fill_in, default=None)


def _longest_minor(lengths: list[list[int]]) -> int:
    """An estimate of the number of terms in the longest minor of an elimination, from the number of terms in each entry."""
    rows, last_pivot, longest = dict(enumerate(lengths)), 1, 0
    while (pivot := _pivot(rows, lambda terms: terms)) is not None:
        i, j = pivot
        row = rows.pop(i)
        for k, other in rows.items():  # without fractions (Bareiss): x p − a y, over the last pivot
            a, p = other[j], row[j]
            grown = [-(-(x * p + a * y) // last_pivot) if a and y else x for x, y in zip(other, row, strict=True)]
            rows[k] = [0 if column == j else terms for column, terms in enumerate(grown)]
        last_pivot, longest = row[j], max([longest, *itertools.chain(*rows.values())])
    return longest


class _Fractions:
    """Quotients of polynomials in the atoms of formulas, and the relations between atoms: sin² + cos² = 1, R² = a + b for √(a + b)."""

    def __init__(self, simplify: Simplifier, formulas: Iterable[Expr]):
        self.simplify = simplify
        self.roots: dict[Any, Any] = {}  # for each atom, the part of an exponent that its generator stands for
        for formula in formulas:
            self._register(simplify.terms(formula))
        atoms = sorted(self.roots, key=lambda atom: (self.roots[atom] == 1, not isinstance(atom, sin)))
        self.field, *generators = field([sympy.Dummy() for _ in atoms] or [sympy.Dummy()], QQ, lex)
        self.generators = dict(zip(atoms, generators, strict=False))
        self.relations = [relation.numer for relation in self._relations() if relation.denom == 1]

    def _register(self, terms: Sum) -> None:
        for product, number in terms.items():
            if not number.is_Rational:
                self.roots[number] = sympy.Integer(1)
            for atom, exponent in ((self.simplify.atoms[i], exponent) for i, exponent in product):
                if self._is_sum(atom):
                    self._register(self.simplify.terms(atom))
                if not sympy.sympify(exponent).is_Rational:
                    self.roots[atom**exponent] = sympy.Integer(1)
                elif not (self._is_sum(atom) and isinstance(exponent, int)):
                    root = sympy.Rational(1, sympy.denom(exponent))
                    self.roots[atom] = sympy.Rational(1, math.lcm(root.q, self.roots.get(atom, root).q))

    def _is_sum(self, atom: Expr) -> bool:
        return atom.is_Add and atom not in self.simplify.unexpanded

    def _relations(self) -> Iterable[Any]:
        for atom, root in self.roots.items():
            if root != 1 and self._is_sum(atom):
                yield self.generators[atom] ** root.q - self.of(self.simplify.terms(atom))
            if isinstance(atom, sin) and (other := cos(atom.args[0])) in self.roots:
                yield self.generators[atom] ** 2 + self.generators[other] ** 2 - 1

    def of(self, terms: Sum) -> Any:
        """A sum of products as a fraction."""
        out = self.field(0)
        for product, number in terms.items():
            term = self.field(QQ(number.p, number.q)) if number.is_Rational else self.generators[number]
            for i, exponent in product:
                term *= self._power(self.simplify.atoms[i], exponent)
            out += term
        return out

    def _power(self, atom: Expr, exponent: Any) -> Any:
        if atom**exponent in self.roots and not sympy.sympify(exponent).is_Rational:
            return self.generators[atom**exponent]
        if self._is_sum(atom) and isinstance(exponent, int):
            return self.of(self.simplify.terms(atom)) ** exponent
        return self.generators[atom] ** int(exponent / self.roots[atom])

    def reduced(self, fraction: Any) -> Any:
        """The fraction, reduced by the relations."""
        if not self.relations:
            return fraction
        return self.field(fraction.numer.rem(self.relations)) / self.field(fraction.denom.rem(self.relations))

    def formula(self, fraction: Any) -> Expr:
        """The fraction as a simplified formula: a sum if the denominator is a product, otherwise one quotient."""
        fraction = self.reduced(fraction)
        meaning = [atom ** self.roots[atom] for atom in self.generators] or [sympy.Integer(1)]
        number, factors = fraction.denom.factor_list()
        above, below = fraction.numer.as_expr(*meaning) / sympy.Rational(number.numerator, number.denominator), sympy.Integer(1)
        for base, power in self._joined([(self.simplify(polynomial.as_expr(*meaning)), power) for polynomial, power in factors]):
            sign = -1 if base.is_Add and base.could_extract_minus_sign() else 1
            above, below = above * sign**power, below * (sign * base) ** power
        if any(factor.as_base_exp()[0].is_Add for factor in sympy.Mul.make_args(below)):
            return self.simplify.factored(above) / below
        return self.simplify(above / below)

    def _joined(self, factors: list[tuple[Expr, int]]) -> list[tuple[Expr, int]]:
        """The factors with −sin² in place of (cos − 1) (cos + 1)."""
        for (left, power), (right, other) in itertools.combinations(factors, 2):
            product = self.simplify(left * right)
            if left.is_Add and right.is_Add and power == other and not product.is_Add:
                return self._joined([(product, power), *(factor for factor in factors if factor[0] not in (left, right))])
        return factors
