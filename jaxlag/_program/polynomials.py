"""Polynomials in expression nodes, in moduli u = ‖s‖ and in signs σ of a node s: σ s = u, σ u = s, σ² = 1."""

from collections import Counter
from typing import NamedTuple

from .expressions import Node

Monomial = frozenset  # of pairs of a factor (a node, a modulus, a sign) and its exponent
Polynomial = dict[Monomial, float]  # the coefficient of each monomial
MAX_TERMS = 32  # a longer polynomial is given up


class Modulus(NamedTuple):
    """u = ‖s‖ of the nodes s, up to a factor: of one node, its absolute value."""

    of: tuple[Node, ...]


class Sign(NamedTuple):
    """σ, the sign of a node."""

    of: Node


def moduli_in(p: Polynomial) -> set[Modulus]:
    """The moduli of a polynomial."""
    return {factor for monomial in p for factor, _ in monomial if isinstance(factor, Modulus)}


def combined_powers(*powers: dict) -> dict:
    """The exponents of the product of some monomials."""
    whole: Counter = Counter()
    for given in powers:
        for x, n in given.items():
            whole[x] += n
    return {x: n for x, n in whole.items() if n}


def added(*polynomials: Polynomial | None) -> Polynomial | None:
    """The sum; None where a summand is None, or where it is too long."""
    if any(p is None for p in polynomials):
        return None
    total: Polynomial = {}
    for p in polynomials:
        for monomial, number in (p or {}).items():
            total[monomial] = total.get(monomial, 0.0) + number
    return {monomial: number for monomial, number in total.items() if number} if len(total) <= MAX_TERMS else None


def scaled(p: Polynomial | None, number: float) -> Polynomial | None:
    """The polynomial times a number."""
    return p and {monomial: number * coefficient for monomial, coefficient in p.items()}


def multiplied(p: Polynomial | None, q: Polynomial | None) -> Polynomial | None:
    """The product, with signs absorbed in the moduli."""
    if p is None or q is None or len(p) * len(q) > MAX_TERMS**2:
        return None
    return added(*({_monomial_product(x, y): a * b} for x, a in p.items() for y, b in q.items()))


def _monomial_product(x: Monomial, y: Monomial) -> Monomial:
    powers = combined_powers(dict(x), dict(y))
    for sign in [factor for factor in powers if isinstance(factor, Sign)]:
        modulus = Modulus((sign.of,))
        if powers.pop(sign) % 2:
            absorbed, result = next(((a, b) for a, b in ((sign.of, modulus), (modulus, sign.of)) if powers.get(a, 0) >= 1), (None, sign))
            powers = combined_powers(powers, {result: 1}, {absorbed: -1} if absorbed is not None else {})
    return Monomial(powers.items())
