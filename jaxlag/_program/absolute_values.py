"""Absolute values and norms among the entries of a program, however they are written.

An entry is a polynomial in entries before it, in moduli u = ‖s‖ and in signs σ of some s, with σ s = u, σ u = s, σ² = 1:

    |s| = u,  √Σ sᵢ² = u,  max(x, y) = (x + y + u)/2 with s = x − y,  (s > 0 ? a : b) = (a + b)/2 + σ (a − b)/2

Where no sign is left over, the entry is made of moduli: v sign(v), relu(v) + relu(−v), where(v > 0, 3, 1.5) |v|.
"""

from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np
from jax import lax

from .dependence import ORDER, Structure, factored
from .polynomials import Modulus, Polynomial, Product, Sign, added, joined, moduli_in, multiplied, scaled
from .scalar_graph import Entry, is_number

Powers = dict[Any, Any]  # exponents of entries


class Moduli:
    """Which entries of one program are made of moduli, and of which."""

    def __init__(self, structure: Structure, results: Iterable[Any]):
        self.structure, self.places, self.results = structure, structure.places, list(results)
        self.rows: dict[Modulus, list[Polynomial]] = {}
        self.hard: set[Modulus] = set()  # those that are an absolute value or a norm, not a maximum or a selection alone
        self.found: dict[Entry, Polynomial] = {}
        self.unresolved: set[Entry] = set()  # entries that jump or bend with a velocity in another way
        self.forms: dict[Entry, Polynomial | None] = {}  # of entries with signs within them
        self.cone = cone = structure.below(self.results)
        self.slips = {x for entry in cone for x in self._slip(entry)}
        for entry in cone:
            self._look(entry)

    def used(self) -> set[Modulus]:
        """Those that stand in what was found."""
        return set().union(*map(moduli_in, self.found.values()))

    def left_over(self) -> set[Entry]:
        """Those whose sign the results depend on in another way, too."""
        lost = [y for x in self.cone if x in self.unresolved for y in x.operands]
        forms = [self.forms[x] or {} for x in (*self.results, *lost) if x in self.forms]
        return {factor.of for form in forms for product in form for factor, _ in product if isinstance(factor, Sign)}

    def jumps(self) -> bool:
        """Whether a result jumps where a velocity changes its sign, or does all but that."""
        jumps = any(self._jumps(x) for x in self.results if x in self.forms)
        hidden = any(x in self.unresolved for x in self.results) and any(x.name == "sign" and self._depends(x) for x in self.cone)
        directions = [x for x in self.cone if x.name == "div" and x.operands[1] in self.found and self._depends(x.operands[0])]
        steep = [factored(x.operands[0])[0] for x in self.cone if x.name in STEPS and self._depends(x)]
        return bool(jumps or hidden or directions or any(abs(number) >= STEEP for number in steep))

    def _jumps(self, x) -> bool:
        """Whether what stands beside a sign is anything but zero where the sign changes."""
        form = self.forms[x] or {}
        for sign in {factor for product in form for factor, _ in product if isinstance(factor, Sign)}:
            beside: Any = 0.0
            for product, number in form.items():
                others = [(self._where_zero(f, sign.of), n) for f, n in product if f is not sign and f != sign]
                if len(others) == len(product):
                    continue
                if not all(is_number(value) for value, _ in others):
                    return True
                beside += number * np.prod([float(value) ** n for value, n in others])
            if abs(beside) > 1e-12:
                return True
        return False

    def _where_zero(self, factor, slip):
        return self.structure.where_zero(factor, [slip], frozenset()) if isinstance(factor, Entry) else factor

    def _depends(self, x) -> bool:
        return self.structure.degree(x) > 0

    def _slip(self, entry):
        """The entry whose sign decides on this one."""
        if entry.name in ("abs", "sign") and self._depends(entry):
            yield factored(entry.operands[0])[1]
        if entry.name in (*ORDER, "max", "min") and self._depends(entry):
            yield factored(self.structure.sub(*entry.operands))[1]

    def _look(self, entry) -> None:
        """Whether it is made of moduli, or has signs within."""
        if not self._depends(entry):
            return
        switched = any(x in self.forms or x in self.unresolved for x in entry.operands)
        form = self._form(entry) if switched or entry.name in SWITCHES else None
        if form is not None and not any(isinstance(factor, Sign) for product in form for factor, _ in product):
            known = all(u in self.rows or self._absolute(u.of[0], 1.0) for u in moduli_in(form))
            if known and entry in self.places and all(map(self._located, form)):
                self.found[entry] = form
                return
        if form is not None:
            self.forms[entry] = form
        elif switched or entry.name in JUMPS or (entry.name == "sqrt" and self._squares(entry.operands[0]) is None):
            self.unresolved.add(entry)

    def _located(self, product) -> bool:
        return all(not isinstance(factor, Entry) or factor in self.places for factor, _ in product)

    def _form(self, entry) -> Polynomial | None:
        """The entry as a polynomial; None where it is none."""
        name, of = entry.name, entry.operands
        if name == "sqrt":
            return self._root(of[0])
        if name in ("abs", "sign"):
            number, slip = factored(of[0])
            if name == "sign":
                return {Product([(Sign(slip), 1)]): np.sign(number)}
            inner = self._modulus_of(slip)
            if inner is not None:
                return {Product([(Modulus((inner,)), 1)]): abs(number)}
            self.hard.add(Modulus((slip,)))
            return self._absolute(of[0], abs(number))
        if name in ("max", "min"):
            x, y = of
            number, slip = factored(self.structure.sub(x, y))
            u = self._absolute(self.structure.sub(x, y), abs(number)) if self._is_affine(slip) else None
            return added(self._parts(x, 0.5), self._parts(y, 0.5), scaled(u, 0.5 if name == "max" else -0.5))
        if name in ORDER:
            number, slip = factored(self.structure.sub(*of))
            return {Product(): 0.5, Product([(Sign(slip), 1)]): 0.5 * ORDER[name] * np.sign(number)} if self._is_affine(slip) else None
        if name == "select_n" and len(of) == 3 and self._depends(of[0]):
            return self._selected(*of)
        if name == "mul":
            return multiplied(self._parts(of[0]), self._parts(of[1]))
        if name in ("add", "sub", "add_any"):
            return added(self._parts(of[0]), self._parts(of[1], -1.0 if name == "sub" else 1.0))
        if name in ("neg", "convert_element_type", "copy", "stop_gradient"):
            return self._parts(of[0], -1.0 if name == "neg" else 1.0)
        if name == "div" and not self._depends(of[1]):
            return multiplied(self._parts(of[0]), {Product([(of[1], -1)]): 1.0} if isinstance(of[1], Entry) else {Product(): 1 / of[1]})
        return None

    def _parts(self, x, number: float = 1.0) -> Polynomial | None:
        """What an operand adds, times a number."""
        if is_number(x):
            return {Product(): number * float(x)}
        if x in self.found:
            return scaled(self.found[x], number)
        if x in self.slips:
            return {Product([(x, 1)]): number}
        if x in self.unresolved:
            return None
        if x in self.forms:
            return scaled(self.forms[x], number)
        factor, entry = factored(x)
        if entry is not x:
            return self._parts(entry, number * factor)
        if x.name == "mul":
            return scaled(multiplied(self._parts(x.operands[0]), self._parts(x.operands[1])), number)
        return {Product([(x, 1)]): number}

    def _absolute(self, x, number) -> Polynomial | None:
        """The modulus of one entry, which need not stand in the program itself if what it is made of does."""
        _, slip = factored(x)
        if slip is None or not self._depends(slip):
            return None
        row: Polynomial | None = {Product([(slip, 1)]): 1.0}
        if slip not in self.places:
            of = slip.operands if slip.name in ("add", "sub") else ()
            row = added(*(self._parts(y, -1.0 if k and slip.name == "sub" else 1.0) for k, y in enumerate(of)))
        if not row or not all(map(self._located, row)):
            return None
        modulus = Modulus((slip,))
        self.rows.setdefault(modulus, [row])
        return {Product([(modulus, 1)]): float(number)}

    def _root(self, x) -> Polynomial | None:
        """The root of a sum of squares: a norm, or the modulus of one entry."""
        squares = self._squares(x)
        if not squares:
            return None
        rows = sorted(((self._key(halves), number**0.5, halves) for number, halves in squares), key=lambda row: row[0].place)
        unit, modulus = rows[0][1], Modulus(tuple(key for key, _, _ in rows))
        if len(rows) > 1:  # moduli of the same entries with other weights are others
            weighted = tuple(self.structure.scaled(key.dtype.type(number / unit), key) for key, number, _ in rows)
            modulus = Modulus(weighted)
        polynomials: list[Polynomial] = [{Product(halves.items()): number / unit} for _, number, halves in rows]
        if not all(self._located(product) for row in polynomials for product in row):
            return None
        self.rows.setdefault(modulus, polynomials)
        self.hard.add(modulus)
        return {Product([(modulus, 1)]): unit}

    def _squares(self, x) -> list[tuple[float, Powers]] | None:
        """The roots of squares that add up to an entry, each a number and powers; none where one of them does not move."""
        found, still = [], False
        waiting: list[tuple[float, Powers, Any]] = [(1.0, {}, x)]
        while waiting:
            number, powers, x = waiting.pop()
            factor, entry = factored(x)
            number *= float(factor)
            if entry is not None and entry.name in ("add", "sub", "add_any"):
                x, y = entry.operands
                waiting += [(-number if entry.name == "sub" else number, powers, y), (number, powers, x)]
                continue
            numbers, factors = self._factors(entry)
            number, powers = number * numbers, joined(powers, factors)
            moving = [f for f in powers if self._depends(f)]
            sums = [f for f in moving if f.name in ("add", "sub", "add_any") and powers[f] == 1]
            if len(moving) == 1 and sums:  # a weight before the sum
                waiting.append((number, {f: n for f, n in powers.items() if f is not sums[0]}, sums[0]))
                continue
            still |= not moving
            if not moving:
                continue
            if number <= 0 or any(powers[f] % 2 for f in moving):
                return None
            halves: Powers = {}
            for f, n in powers.items():
                slip = self._modulus_of(f)  # |s|² = s²
                halves = joined(halves, {f if slip is None else slip: n / 2})
            found.append((number, halves))
        return [] if still else found

    def _modulus_of(self, x) -> Entry | None:
        """s of an entry that is |s|."""
        moduli = [u for u in moduli_in(self.found.get(x, {})) if len(u.of) == 1]
        return next((u.of[0] for u in moduli if self.found[x] == {Product([(u, 1)]): 1.0}), None)

    def _factors(self, x) -> tuple[float, Powers]:
        """An entry as a number and powers of entries."""
        number, waiting = 1.0, [] if x is None else [(x, 1)]
        powers: Counter = Counter()
        while waiting:
            x, n = waiting.pop()
            factor, x = factored(x)
            number *= float(factor) ** n
            if x is None:
                continue
            if x.name == "mul":
                waiting += [(y, n) for y in x.operands]
            elif x.name == "div" and not self._depends(x.operands[1]):
                waiting += [(x.operands[0], n), (x.operands[1], -n)]
            else:
                powers[x] += n
        return number, dict(powers)

    def _key(self, powers) -> Entry:
        """The entry that such a product is."""
        whole: Any = None
        for x, n in powers.items():
            base = x if n % 1 == 0 else self.structure.apply(lax.sqrt_p, {}, x.dtype, x)
            power = self.structure.power(base, int(n if n % 1 == 0 else 2 * n))
            whole = power if whole is None else self.structure.mul(whole, power)
        return whole

    def _is_affine(self, x) -> bool:
        return isinstance(x, Entry) and self.structure.degree(x) == 1

    def _selected(self, which, no, yes) -> Polynomial | None:
        """One of two entries, by a comparison; a norm that is 0 at rest by a selection of its own."""
        for zero, root in ((no, yes), (yes, no)):
            if is_number(zero) and zero == 0 and isinstance(root, Entry) and root.name == "sqrt":
                inside = root.operands[0]
                if isinstance(inside, Entry) and inside.name == "select_n" and inside.operands[0] is which:
                    inside = inside.operands[1 if zero is yes else 2]
                    if self._at_rest(which, inside):
                        return self._root(inside)
        sign = self._parts(which)
        if sign is None:
            return None
        yes, no = self._parts(yes), self._parts(no)
        return added(multiplied(sign, yes), no, scaled(multiplied(sign, no), -1.0))

    def _at_rest(self, which, square) -> bool:
        """Whether a comparison says that a sum of squares, or its root, is zero or next to it."""
        numbers, entries = [x for x in which.operands if is_number(x)], [x for x in which.operands if not is_number(x)]
        if which.name not in (*ORDER, "eq", "ne") or len(numbers) != 1 or not abs(numbers[0]) <= 1e-10:
            return False
        one = entries[0].operands[0] if entries[0].name == "sqrt" else entries[0]
        return factored(one)[1] is factored(square)[1]


STEPS = frozenset(("tanh", "atan", "erf", "logistic"))
STEEP = 100  # per unit of velocity
SWITCHES = frozenset(("abs", "sign", "max", "min", "sqrt", "select_n", *ORDER))
JUMPS = SWITCHES - {"sqrt"} | {"floor", "ceil", "round", "rem", "clamp", "eq", "ne"}
