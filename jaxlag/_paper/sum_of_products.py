"""Sums of products of powers of atoms: the form of a formula while it is simplified.

An atom is a symbol, or a function of simplified formulas; it is identified by an index. A product is made of powers of atoms, and a sum
holds the coefficient of each of its products.
"""

from collections.abc import Iterable
from typing import Any

import sympy
from sympy import Abs, Expr, sign

Product = tuple[tuple[int, Any], ...]  # indices of atoms, increasing, and their exponents
Sum = dict[Product, Expr]
ONE = sympy.Integer(1)


class Atoms:
    """The atoms of formulas, indexed in the order in which they appear, and the products of their powers."""

    def __init__(self) -> None:
        self._atoms: list[Expr] = []
        self._indices: dict[Expr, int] = {}

    def __getitem__(self, index: int) -> Expr:
        return self._atoms[index]

    def index(self, atom: Expr) -> int:
        """The index of an atom."""
        if atom not in self._indices:
            self._indices[atom] = len(self._atoms)
            self._atoms.append(atom)
        return self._indices[atom]

    def powers(self, *factors: Expr) -> Product:
        """The product of some atoms."""
        return tuple((self.index(factor), 1) for factor in factors)

    def times(self, left: Product, right: Product) -> Product:
        """The product of two products."""
        powers = dict(left)
        for atom, exponent in right:
            powers[atom] = powers.get(atom, 0) + exponent
        for atom in [*powers]:
            if isinstance(self._atoms[atom], (Abs, sign)):
                self._combine_abs_and_sign(powers, self._atoms[atom].args[0])
        return tuple(sorted((atom, exponent) for atom, exponent in powers.items() if exponent != 0))

    def _combine_abs_and_sign(self, powers: dict[int, Any], u: Expr) -> None:
        """|u|² = u², (sign u)² = 1, |u| sign u = u, u sign u = |u|, |u|/u = sign u: at most one |u| or one sign u remains."""
        atoms = [self.index(x) for x in (Abs(u), sign(u), u)]
        abs_, sign_, plain = (powers.get(atom, 0) for atom in atoms)
        if all(isinstance(exponent, int) for exponent in (abs_, sign_, plain)):
            abs_, sign_, plain = abs_ % 2, sign_ % 2, plain + abs_ - abs_ % 2
            if abs_ and sign_:
                abs_, sign_, plain = 0, 0, plain + 1
            elif sign_ and plain > 0:
                abs_, sign_, plain = 1, 0, plain - 1
            elif abs_ and plain < 0:
                abs_, sign_, plain = 0, 1, plain + 1
        elif isinstance(sign_, int) and isinstance(plain, int):  # |u|ⁿ absorbs what it can
            abs_, sign_, plain = abs_ + plain - plain % 2, sign_ % 2, plain % 2
            if sign_ and plain:
                abs_, sign_, plain = abs_ + 1, 0, 0
        powers.update(zip(atoms, (abs_, sign_, plain), strict=True))


def added(sums: Iterable[Sum]) -> Sum:
    """The sum of sums, without the products that cancel."""
    out: Sum = {}
    for terms in sums:
        for product, c in terms.items():
            out[product] = out[product] + c if product in out else c
    return {product: c for product, c in out.items() if c != 0}


def common_factor(*products: dict[int, Any]) -> dict[int, Any]:
    """The powers that all products share: the smallest if they are positive, the largest if they are negative."""
    first, *others = products
    out = {}
    for atom, exponent in first.items():
        exponents = [exponent, *(powers.get(atom, 0) for powers in others)]
        if all(isinstance(e, int) or e.is_Rational for e in exponents):
            out[atom] = max(min(exponents), 0) + min(max(exponents), 0)
        elif all(e == exponent for e in exponents):
            out[atom] = exponent
    return {atom: exponent for atom, exponent in out.items() if exponent != 0}


def divides(factor: dict[int, Any], powers: dict[int, Any]) -> bool:
    """Whether a factor is contained in a product."""
    return common_factor(factor, powers) == factor


def divided(powers: dict[int, Any], factor: dict[int, Any]) -> dict[int, Any]:
    """A product over a factor."""
    return {atom: e for atom, exponent in powers.items() if (e := exponent - factor.get(atom, 0)) != 0}
