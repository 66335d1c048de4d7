"""Absolute values and norms in a program, however they are written.

A node is a polynomial in earlier nodes, in moduli u = ‖s‖ and in signs σ of some s, with σ s = u, σ u = s, σ² = 1:

    |s| = u,  √Σ sᵢ² = u,  max(x, y) = (x + y + u)/2 with s = x − y,  (s > 0 ? a : b) = (a + b)/2 + σ (a − b)/2

Where no sign remains, the node is a polynomial in moduli: v sign(v), relu(v) + relu(−v), where(v > 0, 3, 1.5) |v|.
"""

from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np
from jax import lax

from .expressions import Node, is_number
from .polynomials import Modulus, Monomial, Polynomial, Sign, added, combined_powers, moduli_in, multiplied, scaled
from .primitives import EQUALITIES, MODULI, NONSMOOTH, ORDER, SIGMOIDS, SUMS, UNCHANGED
from .velocity_degrees import VelocityDegrees, split_coefficient

Powers = dict[Any, Any]  # nodes and their exponents


class Moduli:
    """The nodes of one program that are polynomials in moduli."""

    def __init__(self, structure: VelocityDegrees, results: Iterable[Any]):
        self.structure, self.places, self.results = structure, structure.places, list(results)
        self.components: dict[Modulus, list[Polynomial]] = {}
        self.genuine: set[Modulus] = set()  # an absolute value or a norm, not only a maximum or a selection
        self.resolved: dict[Node, Polynomial] = {}
        self.unresolved: set[Node] = set()  # nodes that are nonsmooth in a velocity in another way
        self.forms: dict[Node, Polynomial | None] = {}  # of nodes that contain signs
        self.nodes = nodes = structure.dependencies(self.results)
        self.slips = {x for node in nodes for x in self._slip(node)}
        for node in nodes:
            self._classify(node)

    def used(self) -> set[Modulus]:
        """The moduli in resolved nodes."""
        return set().union(*map(moduli_in, self.resolved.values()))

    def unpaired_signs(self) -> set[Node]:
        """The slip velocities on whose sign the results also depend in another way."""
        lost = [y for x in self.nodes if x in self.unresolved for y in x.operands]
        forms = [self.forms[x] or {} for x in (*self.results, *lost) if x in self.forms]
        return {factor.of for form in forms for monomial in form for factor, _ in monomial if isinstance(factor, Sign)}

    def is_unread(self) -> bool:
        """Whether the results may be nonsmooth in a velocity in another way, also within what is not taken apart."""
        hidden = [self.structure.primitives[x] for x in self.nodes if x in self.structure.primitives and self._depends(x)]
        return bool(self.unresolved) or not NONSMOOTH.isdisjoint(set().union(*hidden))

    def jumps(self) -> bool:
        """Whether a result jumps where a velocity changes its sign, or changes almost as steeply."""
        jumps = any(self._jumps(x) for x in self.results if x in self.forms)
        hidden = any(x in self.unresolved for x in self.results) and any(x.name == "sign" and self._depends(x) for x in self.nodes)
        directions = [x for x in self.nodes if x.name == "div" and x.operands[1] in self.resolved and self._depends(x.operands[0])]
        steep = [split_coefficient(x.operands[0])[0] for x in self.nodes if x.name in SIGMOIDS and self._depends(x)]
        return bool(jumps or hidden or directions or any(abs(number) >= STEEP for number in steep))

    def _jumps(self, x) -> bool:
        """Whether the factor of a sign is nonzero where the sign changes."""
        form = self.forms[x] or {}
        for sign in {factor for monomial in form for factor, _ in monomial if isinstance(factor, Sign)}:
            factor_at_zero: Any = 0.0
            for monomial, number in form.items():
                others = [(self._where_zero(f, sign.of), n) for f, n in monomial if f is not sign and f != sign]
                if len(others) == len(monomial):
                    continue
                if not all(is_number(value) for value, _ in others):
                    return True
                factor_at_zero += number * np.prod([float(value) ** n for value, n in others])
            if abs(factor_at_zero) > 1e-12:
                return True
        return False

    def _where_zero(self, factor, slip):
        return self.structure.with_zeros(factor, [slip], frozenset()) if isinstance(factor, Node) else factor

    def _depends(self, x) -> bool:
        return self.structure.degree(x) > 0

    def _slip(self, node):
        """The node whose sign this one depends on."""
        if node.name in ("abs", "sign") and self._depends(node):
            yield split_coefficient(node.operands[0])[1]
        if node.name in (*ORDER, "max", "min") and self._depends(node):
            yield split_coefficient(self.structure.sub(*node.operands))[1]

    def _classify(self, node) -> None:
        """Records whether it is a polynomial in moduli, or contains signs."""
        if not self._depends(node):
            return
        is_nonsmooth = any(x in self.forms or x in self.unresolved for x in node.operands)
        form = self._form(node) if is_nonsmooth or node.name in MODULI else None
        if form is not None and not any(isinstance(factor, Sign) for monomial in form for factor, _ in monomial):
            known = all(u in self.components or self._absolute(u.of[0], 1.0) for u in moduli_in(form))
            if known and node in self.places and all(map(self._has_places, form)):
                self.resolved[node] = form
                return
        if form is not None:
            self.forms[node] = form
        elif is_nonsmooth or node.name in NONSMOOTH or (node.name == "sqrt" and self._squares(node.operands[0]) is None):
            self.unresolved.add(node)

    def _has_places(self, monomial) -> bool:
        return all(not isinstance(factor, Node) or factor in self.places for factor, _ in monomial)

    def _form(self, node) -> Polynomial | None:
        """The node as a polynomial; None where it is not one."""
        name, of = node.name, node.operands
        if name == "sqrt":
            return self._root(of[0])
        if name in ("abs", "sign"):
            number, slip = split_coefficient(of[0])
            if name == "sign":
                return {Monomial([(Sign(slip), 1)]): np.sign(number)}
            inner = self._modulus_of(slip)
            if inner is not None:
                return {Monomial([(Modulus((inner,)), 1)]): abs(number)}
            self.genuine.add(Modulus((slip,)))
            return self._absolute(of[0], abs(number))
        if name in ("max", "min"):
            x, y = of
            number, slip = split_coefficient(self.structure.sub(x, y))
            u = self._absolute(self.structure.sub(x, y), abs(number)) if self._is_affine(slip) else None
            return added(self._polynomial(x, 0.5), self._polynomial(y, 0.5), scaled(u, 0.5 if name == "max" else -0.5))
        if name in ORDER:
            number, slip = split_coefficient(self.structure.sub(*of))
            return {Monomial(): 0.5, Monomial([(Sign(slip), 1)]): 0.5 * ORDER[name] * np.sign(number)} if self._is_affine(slip) else None
        if name == "select_n" and len(of) == 3 and self._depends(of[0]):
            return self._selected(*of)
        if name == "mul":
            return multiplied(self._polynomial(of[0]), self._polynomial(of[1]))
        if name in SUMS:
            return added(self._polynomial(of[0]), self._polynomial(of[1], -1.0 if name == "sub" else 1.0))
        if name == "neg" or name in UNCHANGED:
            return self._polynomial(of[0], -1.0 if name == "neg" else 1.0)
        if name == "div" and not self._depends(of[1]):
            return multiplied(
                self._polynomial(of[0]), {Monomial([(of[1], -1)]): 1.0} if isinstance(of[1], Node) else {Monomial(): 1 / of[1]}
            )
        return None

    def _polynomial(self, x, number: float = 1.0) -> Polynomial | None:
        """An operand as a polynomial, times a number."""
        if is_number(x):
            return {Monomial(): number * float(x)}
        if x in self.resolved:
            return scaled(self.resolved[x], number)
        if x in self.slips:
            return {Monomial([(x, 1)]): number}
        if x in self.unresolved:
            return None
        if x in self.forms:
            return scaled(self.forms[x], number)
        factor, node = split_coefficient(x)
        if node is not x:
            return self._polynomial(node, number * factor)
        if x.name == "mul":
            return scaled(multiplied(self._polynomial(x.operands[0]), self._polynomial(x.operands[1])), number)
        return {Monomial([(x, 1)]): number}

    def _absolute(self, x, number) -> Polynomial | None:
        """The modulus of one node, which need not be in the program itself if its operands are."""
        _, slip = split_coefficient(x)
        if slip is None or not self._depends(slip):
            return None
        component: Polynomial | None = {Monomial([(slip, 1)]): 1.0}
        if slip not in self.places:
            of = slip.operands if slip.name in ("add", "sub") else ()
            component = added(*(self._polynomial(y, -1.0 if k and slip.name == "sub" else 1.0) for k, y in enumerate(of)))
        if not component or not all(map(self._has_places, component)):
            return None
        modulus = Modulus((slip,))
        self.components.setdefault(modulus, [component])
        return {Monomial([(modulus, 1)]): float(number)}

    def _root(self, x) -> Polynomial | None:
        """The root of a sum of squares: a norm, or the modulus of one node."""
        squares = self._squares(x)
        if not squares:
            return None
        squared = sorted(((self._key(halves), number**0.5, halves) for number, halves in squares), key=lambda square: square[0].index)
        unit, modulus = squared[0][1], Modulus(tuple(key for key, _, _ in squared))
        if len(squared) > 1:  # moduli of the same nodes with other weights differ
            weighted = tuple(self.structure.scaled(key.dtype.type(number / unit), key) for key, number, _ in squared)
            modulus = Modulus(weighted)
        polynomials: list[Polynomial] = [{Monomial(halves.items()): number / unit} for _, number, halves in squared]
        if not all(self._has_places(monomial) for polynomial in polynomials for monomial in polynomial):
            return None
        self.components.setdefault(modulus, polynomials)
        self.genuine.add(modulus)
        return {Monomial([(modulus, 1)]): unit}

    def _squares(self, x) -> list[tuple[float, Powers]] | None:
        """The roots of squares that add up to a node, each a number and powers; none where one of them does not depend on velocities."""
        found, is_offset = [], False
        pending: list[tuple[float, Powers, Any]] = [(1.0, {}, x)]
        while pending:
            number, powers, x = pending.pop()
            factor, node = split_coefficient(x)
            number *= float(factor)
            if node is not None and node.name in SUMS:
                x, y = node.operands
                pending += [(-number if node.name == "sub" else number, powers, y), (number, powers, x)]
                continue
            numbers, factors = self._factors(node)
            number, powers = number * numbers, combined_powers(powers, factors)
            varying = [f for f in powers if self._depends(f)]
            sums = [f for f in varying if f.name in SUMS and powers[f] == 1]
            if len(varying) == 1 and sums:  # a weight in front of the sum
                pending.append((number, {f: n for f, n in powers.items() if f is not sums[0]}, sums[0]))
                continue
            is_offset |= not varying
            if not varying:
                continue
            if number <= 0 or any(powers[f] % 2 for f in varying):
                return None
            halves: Powers = {}
            for f, n in powers.items():
                slip = self._modulus_of(f)  # |s|² = s²
                halves = combined_powers(halves, {f if slip is None else slip: n / 2})
            found.append((number, halves))
        return [] if is_offset else found

    def _modulus_of(self, x) -> Node | None:
        """s of a node that is |s|."""
        moduli = [u for u in moduli_in(self.resolved.get(x, {})) if len(u.of) == 1]
        return next((u.of[0] for u in moduli if self.resolved[x] == {Monomial([(u, 1)]): 1.0}), None)

    def _factors(self, x) -> tuple[float, Powers]:
        """A node as a number and powers of nodes."""
        number, pending = 1.0, [] if x is None else [(x, 1)]
        powers: Counter = Counter()
        while pending:
            x, n = pending.pop()
            factor, x = split_coefficient(x)
            number *= float(factor) ** n
            if x is None:
                continue
            if x.name == "mul":
                pending += [(y, n) for y in x.operands]
            elif x.name == "div" and not self._depends(x.operands[1]):
                pending += [(x.operands[0], n), (x.operands[1], -n)]
            else:
                powers[x] += n
        return number, dict(powers)

    def _key(self, powers) -> Node:
        """The node of such a product."""
        whole: Any = None
        for x, n in powers.items():
            base = x if n % 1 == 0 else self.structure.apply(lax.sqrt_p, {}, x.dtype, x)
            power = self.structure.power(base, int(n if n % 1 == 0 else 2 * n))
            whole = power if whole is None else self.structure.mul(whole, power)
        return whole

    def _is_affine(self, x) -> bool:
        return isinstance(x, Node) and self.structure.degree(x) == 1

    def _selected(self, which, no, yes) -> Polynomial | None:
        """One of two nodes, by a comparison; a norm may be 0 at rest by a selection of its own."""
        for zero, root in ((no, yes), (yes, no)):
            if is_number(zero) and zero == 0 and isinstance(root, Node) and root.name == "sqrt":
                inside = root.operands[0]
                if isinstance(inside, Node) and inside.name == "select_n" and inside.operands[0] is which:
                    inside = inside.operands[1 if zero is yes else 2]
                    if self._at_rest(which, inside):
                        return self._root(inside)
        sign = self._polynomial(which)
        if sign is None:
            return None
        yes, no = self._polynomial(yes), self._polynomial(no)
        return added(multiplied(sign, yes), no, scaled(multiplied(sign, no), -1.0))

    def _at_rest(self, which, square) -> bool:
        """Whether a comparison asks whether a sum of squares, or its root, is zero or next to it."""
        numbers, nodes = [x for x in which.operands if is_number(x)], [x for x in which.operands if not is_number(x)]
        if (which.name not in ORDER and which.name not in EQUALITIES) or len(numbers) != 1 or not abs(numbers[0]) <= 1e-10:
            return False
        one = nodes[0].operands[0] if nodes[0].name == "sqrt" else nodes[0]
        return split_coefficient(one)[1] is split_coefficient(square)[1]


STEEP = 100  # per unit of velocity
