"""Polynomials in entries of a program, in moduli u = ‖s‖ and in signs σ of an entry s: σ s = u, σ u = s, σ² = 1."""

from collections import Counter
from typing import NamedTuple

from .scalar_graph import Entry

Product = frozenset  # of pairs of a factor (an entry, a modulus, a sign) and its exponent
Polynomial = dict[Product, float]  # the number before each product
TERMS = 32  # a longer polynomial is not looked at


class Modulus(NamedTuple):
    """u = ‖s‖ of the entries s, each but for a factor: of one entry the absolute value."""

    of: tuple[Entry, ...]


class Sign(NamedTuple):
    """σ, the sign of an entry."""

    of: Entry


def moduli_in(p: Polynomial) -> set[Modulus]:
    """Those of a polynomial."""
    return {factor for product in p for factor, _ in product if isinstance(factor, Modulus)}


def joined(*powers: dict) -> dict:
    """The powers of a product of products."""
    whole: Counter = Counter()
    for given in powers:
        for x, n in given.items():
            whole[x] += n
    return {x: n for x, n in whole.items() if n}


def added(*polynomials: Polynomial | None) -> Polynomial | None:
    """The sum; None where one is none, or it is long."""
    if any(p is None for p in polynomials):
        return None
    total: Polynomial = {}
    for p in polynomials:
        for product, number in (p or {}).items():
            total[product] = total.get(product, 0.0) + number
    return {product: number for product, number in total.items() if number} if len(total) <= TERMS else None


def scaled(p: Polynomial | None, number: float) -> Polynomial | None:
    """The polynomial times a number."""
    return p and {product: number * before for product, before in p.items()}


def multiplied(p: Polynomial | None, q: Polynomial | None) -> Polynomial | None:
    """The product, with signs taken into the moduli."""
    if p is None or q is None or len(p) * len(q) > TERMS**2:
        return None
    return added(*({_together(x, y): a * b} for x, a in p.items() for y, b in q.items()))


def _together(x: Product, y: Product) -> Product:
    powers = joined(dict(x), dict(y))
    for sign in [factor for factor in powers if isinstance(factor, Sign)]:
        modulus = Modulus((sign.of,))
        if powers.pop(sign) % 2:
            here, there = next(((a, b) for a, b in ((sign.of, modulus), (modulus, sign.of)) if powers.get(a, 0) >= 1), (None, sign))
            powers = joined(powers, {there: 1}, {here: -1} if here is not None else {})
    return Product(powers.items())
