"""Trigonometric identities, and the identity of a sum and its parts: each finds terms that it combines into one."""

import itertools
from collections.abc import Iterable, Iterator
from typing import Protocol

from sympy import Expr, cos, sin

from .sum_of_products import ONE, Atoms, Product, Sum, added


class Expander(Protocol):
    """The interface that the identities need: atoms, and formulas as sums of their products."""

    atoms: Atoms

    def __call__(self, formula: Expr) -> Expr:
        """The formula, simplified."""
        ...

    def expanded(self, formula: Expr) -> Sum:
        """The formula as a sum of products."""
        ...

    def product(self, sums: Iterable[Sum]) -> Sum:
        """The product of sums."""
        ...


Replacement = tuple[Sum, Sum]  # the other terms that an identity needs, relative to the first, and their common result


def combine(s: Expander, terms: Sum) -> Sum:
    """The sum, with terms joined by the identities."""
    terms = _in_one_function(s, dict(terms))
    for identity in (_pythagoras, _sum_and_its_parts, _addition_theorem, _pythagoras):
        waiting = [*terms]
        while waiting:
            product = waiting.pop()
            for partners, result in identity(s, product) if product in terms else ():
                c = terms[product]
                if all(terms.get(partner) == ratio * c for partner, ratio in partners.items()):
                    for partner in (product, *partners):
                        del terms[partner]
                    terms = added([terms, {p: c * d for p, d in result.items()}])
                    waiting += [p for p in result if p in terms]
                    break
    return terms


def _in_one_function(s: Expander, terms: Sum) -> Sum:
    """The sum with even powers of sin as powers of cos, or of cos as powers of sin, for each angle, if that leaves fewer terms."""
    squares = lambda product, atom: max(e // 2, 0) if isinstance(e := dict(product).get(atom, 0), int) else 0
    angles = dict.fromkeys(s.atoms[a].args[0] for p in terms for a, _ in p if isinstance(s.atoms[a], (sin, cos)) and squares(p, a))
    for angle, (replaced, by) in itertools.product(angles, ((sin, cos), (cos, sin))):
        atom, square = s.atoms.index(replaced(angle)), s.expanded(1 - by(angle) ** 2)
        parts = [(s.atoms.times(p, ((atom, -2 * n),)), c, n) for p, c in terms.items() for n in [squares(p, atom)]]
        terms = min(terms, added(s.product([{p: c}, *[square] * n]) if n else {p: c} for p, c, n in parts), key=len)
    return terms


def _pythagoras(s: Expander, product: Product) -> Iterator[Replacement]:
    """The identity sin² + cos² = 1, read in every direction."""
    for atom, exponent in product:
        function = s.atoms[atom]
        if isinstance(function, (sin, cos)) and isinstance(exponent, int) and exponent > 1:
            other = (cos if function.func is sin else sin)(function.args[0])
            rest = s.atoms.times(product, ((atom, -2),))
            mirrored = s.atoms.times(rest, ((s.atoms.index(other), 2),))
            yield {mirrored: ONE}, {rest: ONE}
            yield {rest: -ONE}, {mirrored: -ONE}


def _addition_theorem(s: Expander, product: Product) -> Iterator[Replacement]:
    """The identities cos a cos b ± sin a sin b = cos(a ∓ b) and sin a cos b ± cos a sin b = sin(a ± b)."""
    waves = [s.atoms[atom] for atom, exponent in product if isinstance(s.atoms[atom], (sin, cos)) and isinstance(exponent, int)]
    for left, right in itertools.permutations(waves, 2):
        (a,), (b,) = left.args, right.args
        if left.func is cos and a != b:
            other = cos if right.func is sin else sin
            rest = s.atoms.times(product, ((s.atoms.index(left), -1), (s.atoms.index(right), -1)))
            partner = s.atoms.times(rest, s.atoms.powers(sin(a), other(b)))
            for number in (ONE, -ONE):
                angle = a - number * b if right.func is cos else b + number * a
                yield {partner: number}, s.product([{rest: ONE}, s.expanded(right.func(s(angle)))])


def _sum_and_its_parts(s: Expander, product: Product) -> Iterator[Replacement]:
    """The sum (a + b)ⁿ a + (a + b)ⁿ b = (a + b)ⁿ⁺¹, if n is not a positive integer."""
    for atom, exponent in product:
        if s.atoms[atom].is_Add and not (isinstance(exponent, int) and exponent > 0):
            (first, number), *others = added(map(s.expanded, s.atoms[atom].args)).items()
            rest = s.atoms.times(product, tuple((a, -e) for a, e in first))
            yield {s.atoms.times(rest, p): c / number for p, c in others}, {s.atoms.times(rest, ((atom, 1),)): 1 / number}
