"""Formulas as a person writes them: like terms together by the identities that everyone knows, common factors out.

A formula is held as a sum of products, each with its number; a product is made of powers of atoms, and an atom is a symbol, or a
function of tidy formulas.
"""

import itertools
from collections.abc import Iterable, Iterator
from typing import Any

import sympy
from sympy import Abs, Add, Expr, Mul, cos, sign, sin

Product = tuple[tuple[int, Any], ...]  # the numbers of atoms, increasing, and their exponents
Sum = dict[Product, Expr]
ONE = sympy.Integer(1)
QUOTIENTS = {sympy.tan: (sin, cos), sympy.tanh: (sympy.sinh, sympy.cosh)}
LONGEST = 2000  # products that a sum is still multiplied out to; nobody reads more


class Tidy:
    """Tidies formulas; terms with different powers of what is `apart`, velocities say, do not share a bracket."""

    def __init__(self, apart: Iterable[sympy.Symbol] = (), parameters: Iterable[sympy.Symbol] = ()):
        self.apart, self.parameters = frozenset(apart), frozenset(parameters)
        self.atoms: list[Expr] = []
        self.numbers: dict[Expr, int] = {}
        self.kept: set[Expr] = set()  # sums inside | | and sign: beside these they stay sums
        self.same: dict[Expr, Expr] = {}  # what such sums came as
        self.known: dict[Expr, Sum] = {}

    def __call__(self, formula: Expr) -> Expr:
        """The formula, tidied."""
        return self.written(self.terms(formula))

    def collected(self, formula: Expr, leading: Iterable[sympy.Symbol]) -> Expr:
        """The formula, tidied, with one coefficient for each of the leading symbols, in which it is linear."""
        terms, parts = self.terms(formula), []
        for symbol in leading:
            atom = (self.number(symbol), 1)
            mine = {product: terms.pop(product) for product in [*terms] if atom in product}
            parts.append(Mul(self.written({tuple(a for a in product if a != atom): c for product, c in mine.items()}), symbol))
        return Add(*parts, self.written(terms))

    def factored(self, formula: Expr) -> Expr:
        """The formula, tidied, with the factors in front that all its terms share."""
        terms = self.terms(formula)
        common = _common(*map(dict, terms)) if terms else {}
        sign_ = -ONE if all(c.could_extract_minus_sign() for c in terms.values()) else ONE
        rest = self.written({tuple(_divided(dict(product), common).items()): sign_ * c for product, c in terms.items()})
        sums = set.intersection(*(set(Mul.make_args(part)) for part in Add.make_args(rest))) if rest.is_Add else set()
        bracket = Mul(*(factor for factor in sums if factor.is_Add))
        return Mul(sign_, self._formula(common), bracket, Add(*(part / bracket for part in Add.make_args(rest))))

    # A formula as a sum of products.

    def terms(self, formula: Expr) -> Sum:
        """The formula as a sum of products, of which none cancel or combine."""
        if formula.has(Abs, sign):
            formula = formula.replace(lambda e: isinstance(e, (Abs, sign)), self._keep)
        return self._combined(self._loosened(self._multiplied(formula)))

    def number(self, atom: Expr) -> int:
        """The number of an atom."""
        if atom not in self.numbers:
            self.numbers[atom] = len(self.atoms)
            self.atoms.append(atom)
        return self.numbers[atom]

    def _keep(self, kink: Expr) -> Expr:
        """|u| or sign u with u tidied, and a sum u noted, so that it is not multiplied out beside |u|."""
        if not isinstance(kink, (Abs, sign)):
            return kink
        (u,) = kink.args
        if u.is_Mul:
            return Mul(*(self._keep(kink.func(factor)) for factor in u.args))
        if u in self.kept or not u.is_Add:
            return kink if u in self.kept else kink.func(self(u))
        number, tidied = self(u).primitive()  # positive
        if not tidied.is_Add:
            return self._keep(kink.func(number * tidied))
        size = Abs(tidied)
        turn = 1 if not isinstance(size, Abs) or size.args[0] == tidied else -1  # of u and −u it takes always the same
        self.kept |= {size.args[0]} if isinstance(size, Abs) else set()
        self.same |= {u: number * tidied, -u: -number * tidied}
        self.known.clear()
        return number * size if isinstance(kink, Abs) else turn * sign(turn * tidied)

    def _multiplied(self, formula: Expr) -> Sum:
        if formula not in self.known:
            self.known[formula] = self._multiply(self.same.get(formula, formula))
        return self.known[formula]

    def _multiply(self, formula: Expr) -> Sum:
        if formula.is_number:
            return {(): formula} if formula != 0 else {}
        if formula.is_Add:
            content, primitive = formula.primitive() if self.kept else (ONE, formula)
            for number, u in ((content, primitive), (-content, -primitive)):
                if u in self.kept:
                    return {((self.number(u), 1),): number}
            return _added(map(self._multiplied, formula.args))
        if formula.is_Mul:
            return self._product(map(self._multiplied, formula.args))
        base, exponent = formula.as_base_exp()
        if exponent.is_Integer and exponent > 1:
            return self._product([self._multiplied(base)] * int(exponent))
        if formula.func in QUOTIENTS:
            above, below = QUOTIENTS[formula.func]
            return self._multiplied(above(*formula.args) / below(*formula.args))
        tidied = formula.func(*map(self._argument, formula.args)) if formula.args else formula
        if tidied.func is not formula.func:  # SymPy has seen more, e.g. √(l²) = |l|
            return self._multiplied(self._keep(tidied))
        base, exponent = tidied.as_base_exp()
        return {((self.number(base), int(exponent) if exponent.is_Integer else exponent),): ONE}

    def _argument(self, argument: Any) -> Any:
        """An argument of a function, tidied: a formula, or a condition or a pair that holds formulas."""
        if isinstance(argument, Expr):
            return self(argument)
        return argument.func(*map(self._argument, argument.args)) if argument.args else argument

    def _product(self, sums: Iterable[Sum]) -> Sum:
        out: Sum = {(): ONE}
        for terms in sums:
            if len(out) * len(terms) > LONGEST:
                terms = {((self.number(self.written(terms)), 1),): ONE}
            out = _added({self._times(p, r): c * d} for p, c in out.items() for r, d in terms.items())
        return out

    def _times(self, left: Product, right: Product) -> Product:
        powers = dict(left)
        for atom, exponent in right:
            powers[atom] = powers.get(atom, 0) + exponent
        for atom in [*powers]:
            if isinstance(self.atoms[atom], (Abs, sign)):
                self._straighten(powers, self.atoms[atom].args[0])
        return tuple(sorted((atom, exponent) for atom, exponent in powers.items() if exponent != 0))

    def _straighten(self, powers: dict[int, Any], u: Expr) -> None:
        """|u|² = u², (sign u)² = 1, |u| sign u = u, u sign u = |u|, |u|/u = sign u: what is left is |u| or sign u, once."""
        atoms = [self.number(x) for x in (Abs(u), sign(u), u)]
        size, turn, plain = (powers.get(atom, 0) for atom in atoms)
        if all(isinstance(exponent, int) for exponent in (size, turn, plain)):
            size, turn, plain = size % 2, turn % 2, plain + size - size % 2
            if size and turn:
                size, turn, plain = 0, 0, plain + 1
            elif turn and plain > 0:
                size, turn, plain = 1, 0, plain - 1
            elif size and plain < 0:
                size, turn, plain = 0, 1, plain + 1
        elif isinstance(turn, int) and isinstance(plain, int):  # |u|ⁿ takes up what it can
            size, turn, plain = size + plain - plain % 2, turn % 2, plain % 2
            if turn and plain:
                size, turn, plain = size + 1, 0, 0
        powers.update(zip(atoms, (size, turn, plain), strict=True))

    def _loosened(self, terms: Sum) -> Sum:
        """Sums that were kept for the sake of | | and sign, multiplied out where none of these stands beside them."""
        if not self.kept:
            return terms
        kept = {self.number(u): {self.number(Abs(u)), self.number(sign(u))} for u in self.kept}
        return _added(self._let_go(product, c, kept) for product, c in terms.items())

    def _let_go(self, product: Product, c: Expr, kept: dict[int, set[int]]) -> Sum:
        atoms = {atom for atom, _ in product}
        loose = [(a, e) for a, e in product if a in kept and not kept[a] & atoms and isinstance(e, int) and e > 0]
        if not loose:
            return {product: c}
        sums = [_added(map(self._multiplied, self.atoms[a].args)) for a, e in loose for _ in range(e)]
        return self._product([{tuple(power for power in product if power not in loose): c}, *sums])

    # Identities: each finds partners of a product, with which it makes one.

    def _combined(self, terms: Sum) -> Sum:
        terms = dict(terms)
        terms = self._in_one_function(terms)
        for identity in (self._pythagoras, self._whole_sum, self._addition_theorem, self._pythagoras):
            waiting = [*terms]
            while waiting:
                product = waiting.pop()
                for partners, result in identity(product) if product in terms else ():
                    c = terms[product]
                    if all(terms.get(partner) == ratio * c for partner, ratio in partners.items()):
                        for partner in (product, *partners):
                            del terms[partner]
                        terms = _added([terms, {p: c * d for p, d in result.items()}])
                        waiting += [p for p in result if p in terms]
                        break
        return terms

    def _in_one_function(self, terms: Sum) -> Sum:
        """Even powers of sin by those of cos, or of cos by those of sin, for each angle, where that leaves fewer terms."""
        squares = lambda product, atom: max(e // 2, 0) if isinstance(e := dict(product).get(atom, 0), int) else 0
        angles = dict.fromkeys(
            self.atoms[a].args[0] for p in terms for a, _ in p if isinstance(self.atoms[a], (sin, cos)) and squares(p, a)
        )
        for angle, (gone, left) in itertools.product(angles, ((sin, cos), (cos, sin))):
            atom, square = self.number(gone(angle)), self._multiplied(1 - left(angle) ** 2)
            replaced = [(self._times(p, ((atom, -2 * n),)), c, n) for p, c in terms.items() for n in [squares(p, atom)]]
            terms = min(terms, _added(self._product([{p: c}, *[square] * n]) if n else {p: c} for p, c, n in replaced), key=len)
        return terms

    def _pythagoras(self, product: Product) -> Iterator[tuple[Sum, Sum]]:
        """The identity sin² + cos² = 1, read in every direction."""
        for atom, exponent in product:
            function = self.atoms[atom]
            if isinstance(function, (sin, cos)) and isinstance(exponent, int) and exponent > 1:
                other = (cos if function.func is sin else sin)(function.args[0])
                rest = self._times(product, ((atom, -2),))
                mirrored = self._times(rest, ((self.number(other), 2),))
                yield {mirrored: ONE}, {rest: ONE}
                yield {rest: -ONE}, {mirrored: -ONE}

    def _addition_theorem(self, product: Product) -> Iterator[tuple[Sum, Sum]]:
        """The identities cos a cos b ± sin a sin b = cos(a ∓ b) and sin a cos b ± cos a sin b = sin(a ± b)."""
        waves = [self.atoms[atom] for atom, exponent in product if isinstance(self.atoms[atom], (sin, cos)) and isinstance(exponent, int)]
        for left, right in itertools.permutations(waves, 2):
            (a,), (b,) = left.args, right.args
            if left.func is cos and a != b:
                other = cos if right.func is sin else sin
                rest = self._times(product, ((self.number(left), -1), (self.number(right), -1)))
                partner = self._times(rest, self._powers(sin(a), other(b)))
                for number in (ONE, -ONE):
                    angle = a - number * b if right.func is cos else b + number * a
                    yield {partner: number}, self._product([{rest: ONE}, self._multiplied(right.func(self(angle)))])

    def _whole_sum(self, product: Product) -> Iterator[tuple[Sum, Sum]]:
        """The sum (a + b)ⁿ a + (a + b)ⁿ b = (a + b)ⁿ⁺¹, where n is not a positive whole number."""
        for atom, exponent in product:
            if self.atoms[atom].is_Add and not (isinstance(exponent, int) and exponent > 0):
                (first, number), *others = _added(map(self._multiplied, self.atoms[atom].args)).items()
                rest = self._times(product, tuple((a, -e) for a, e in first))
                yield {self._times(rest, p): c / number for p, c in others}, {self._times(rest, ((atom, 1),)): 1 / number}

    def _powers(self, *factors: Expr) -> Product:
        return tuple((self.number(factor), 1) for factor in factors)

    # A sum of products as a formula.

    def written(self, terms: Sum) -> Expr:
        """The formula of a sum of products, with common factors out."""
        groups: dict[Product, list[tuple[dict[int, Any], Expr]]] = {}
        for product, c in terms.items():
            velocity = tuple((a, e) for a, e in product if not self.apart.isdisjoint(self.atoms[a].free_symbols))
            groups.setdefault(velocity, []).append(({a: e for a, e in product if (a, e) not in velocity}, c))
        return Add(*(Mul(self._bracketed(group), self._formula(dict(velocity))) for velocity, group in groups.items()))

    def _formula(self, powers: dict[int, Any], c: Expr = ONE) -> Expr:
        for quotient, (above, below) in QUOTIENTS.items():
            for atom in [atom for atom in powers if self.atoms[atom].func is above]:
                (angle,) = self.atoms[atom].args
                other = self.number(below(angle))
                if powers.get(other) == -powers[atom]:
                    c, powers = c * quotient(angle) ** powers[atom], {a: e for a, e in powers.items() if a not in (atom, other)}
        return Mul(c, *(self.atoms[atom] ** exponent for atom, exponent in powers.items()))

    def _bracketed(self, group: list[tuple[dict[int, Any], Expr]]) -> Expr:
        """A sum of powers with their numbers, the factor that saves most in front of a bracket, and so on."""
        if len(group) == 1:
            return self._formula(*group[0])
        common = _common(*(powers for powers, _ in group))
        if common:
            numbers = [c for _, c in group]
            content = sympy.gcd_list(numbers) if all(c.is_Rational for c in numbers) else ONE
            content = -content if self._leading(group).could_extract_minus_sign() else content
            return Mul(content, self._formula(common), self._bracketed([(_divided(powers, common), c / content) for powers, c in group]))
        best = max(self._factors(group), key=lambda factor: self._saving(group, factor), default=None)
        if best is None:
            return Add(*(self._formula(*term) for term in group))
        inside = [term for term in group if _divides(best, term[0])]
        return Add(self._bracketed(inside), self._bracketed([term for term in group if term not in inside]))

    def _factors(self, group: list) -> list[dict[int, Any]]:
        """What two terms share, or in a long sum single symbols, so that the time does not grow with the third power."""
        if len(group) > 30:
            return [
                {atom: 1}
                for atom in dict.fromkeys(atom for powers, _ in group for atom in powers)
                if sum(_divides({atom: 1}, p) for p, _ in group) > 1
            ]
        return [factor for (left, _), (right, _) in itertools.combinations(group, 2) if (factor := _common(left, right))]

    def _saving(self, group: list, factor: dict[int, Any]) -> tuple[Any, bool]:
        terms = sum(_divides(factor, powers) for powers, _ in group)
        size = sum(abs(e) if isinstance(e, int) or e.is_Rational else 1 for e in factor.values())  # e of exp(e) may be a formula
        return (terms - 1) * size, all(self.atoms[a] in self.parameters for a in factor)

    def _leading(self, group: list) -> Expr:
        """The number of the first term that is not made of parameters alone."""
        is_moving = lambda powers: any(self.atoms[atom] not in self.parameters for atom in powers)
        return next((c for powers, c in group if is_moving(powers)), group[0][1])


def _added(sums: Iterable[Sum]) -> Sum:
    out: Sum = {}
    for terms in sums:
        for product, c in terms.items():
            out[product] = out[product] + c if product in out else c
    return {product: c for product, c in out.items() if c != 0}


def _common(*products: dict[int, Any]) -> dict[int, Any]:
    """The powers that all have: the smallest where they are positive, the largest where they are negative."""
    first, *others = products
    out = {}
    for atom, exponent in first.items():
        exponents = [exponent, *(powers.get(atom, 0) for powers in others)]
        if all(isinstance(e, int) or e.is_Rational for e in exponents):
            out[atom] = max(min(exponents), 0) + min(max(exponents), 0)
        elif all(e == exponent for e in exponents):
            out[atom] = exponent
    return {atom: exponent for atom, exponent in out.items() if exponent != 0}


def _divides(factor: dict[int, Any], powers: dict[int, Any]) -> bool:
    return _common(factor, powers) == factor


def _divided(powers: dict[int, Any], factor: dict[int, Any]) -> dict[int, Any]:
    return {atom: e for atom, exponent in powers.items() if (e := exponent - factor.get(atom, 0)) != 0}
