"""Scalars of any algebra, with numbers folded, zeros dropped and nothing made twice.

An entry is a scalar that is not a number: 0·x and x + 0 are none, x − y and y − x are one up to the sign, and an operation on
the same entries is the same entry. What the entries stand for is left to the algebra: JAX scalars, symbols.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from jax import lax
from jax.extend import core, source_info_util

from .constants import folded

Arrays = list[np.ndarray]  # each of numbers or, where at least one entry is not known, of objects: NumPy scalars and `Entry`s

EFFORT = 50  # steps for each operation that is allowed; mechanical systems take up to 20


class UnknownPrimitive(NotImplementedError):
    """A primitive that cannot be taken apart, and that the algebra does not know as a whole."""

    def __init__(self, primitive: core.Primitive, where: list):
        line = next(filter(None, map(source_info_util.summarize, where)), "an unknown line")
        super().__init__(
            f"a function that is written out must use known operations only, but uses `{primitive}` at {line}. "
            "Write it in elementary operations."
        )


class TooLong(Exception):
    """More scalar operations than allowed."""


class Algebra:
    """How scalars are combined."""

    def number(self, x: np.generic) -> Any:
        """A number among the operands."""
        return x

    def folds(self, x: Any) -> Any:
        """For each number whether its arithmetic is exact enough to be done at once; what is not stays an entry."""
        return True

    def function(self, primitive: core.Primitive, params: dict, dtype: Any) -> Callable | None:
        """The scalar function that an element-wise primitive stands for; None where there is none."""
        raise NotImplementedError

    def shortcut(self, equation: core.JaxprEqn) -> Callable[..., Arrays] | None:
        """A function of object arrays for a call that has a simpler form than its body; None where it has none."""
        return None

    def block(self, equation: core.JaxprEqn) -> Callable[..., Arrays] | None:
        """A function of object arrays for an equation that is not to be taken apart; None where there is none."""
        return None


@dataclasses.dataclass(eq=False, slots=True)
class Entry:
    """A scalar that is not a number: a function of earlier entries and of numbers or, without a function, an argument."""

    place: int
    dtype: Any
    name: str
    function: Callable | None = None
    operands: tuple = ()


class Folding:
    """The entries made so far, each once, after those that it needs; and the arithmetic that makes more of them."""

    def __init__(self, algebra: Algebra, limit: int | float = math.inf):
        self.algebra, self.limit, self.spent = algebra, limit, 0
        self.entries: list[Entry] = []
        self.made: dict[tuple, Entry] = {}
        self.keeps_signs = False  # of zeros: x − y and −(y − x) differ by it where x = y, and so does the angle that atan2 gives
        self.where: list = []  # where in the user's code, for messages

    def new(self, *what: Any) -> Entry:
        """One more entry."""
        if len(self.entries) >= self.limit:
            raise TooLong
        self.entries.append(Entry(len(self.entries), *what))
        return self.entries[-1]

    def spend(self, operations: int) -> None:
        """Counts what is done, for zeros and numbers make no entries but take time."""
        self.spent += operations
        if self.spent > EFFORT * self.limit:
            raise TooLong

    def argument(self, dtype: Any) -> Entry:
        """An entry whose value comes from outside."""
        return self.new(dtype, "argument")

    def known(self, array: np.ndarray) -> np.ndarray:
        """Numbers, with those that the algebra does not fold as entries."""
        if np.all(self.algebra.folds(array)):
            return array
        return filled(array.shape, [x if self.algebra.folds(x) else self.constant(x) for x in objects(array).flat])

    def constant(self, x: np.generic) -> Entry:
        """A number as an entry."""
        key = ("constant", x.dtype, x.tobytes())
        if key not in self.made:
            self.made[key] = self.new(x.dtype, "constant", lambda x: x, (x,))
        return self.made[key]

    def entry(self, primitive: core.Primitive, params: dict, dtype: Any, *operands: Any) -> Entry:
        """The entry of one operation, not simplified."""
        key = (primitive.name, dtype, *params.items(), *(x if isinstance(x, Entry) else (x.dtype, x.tobytes()) for x in operands))
        if key not in self.made:
            function = self.algebra.function(primitive, params, dtype)
            if function is None:
                raise UnknownPrimitive(primitive, self.where)
            self.made[key] = self.new(dtype, primitive.name, function, operands)
        return self.made[key]

    def apply(self, primitive: core.Primitive, params: dict, dtype: Any, *operands: Any) -> Any:
        """One operation, a number or an entry."""
        if not any(isinstance(x, Entry) for x in operands):
            number = folded(primitive, params, dtype, *operands)
            return number if self.algebra.folds(number) else self.entry(primitive, params, dtype, *operands)
        simpler = SIMPLER[primitive.name](self, *operands) if primitive.name in SIMPLER else None
        if simpler is not None:
            return simpler
        if primitive.name in ODD | EVEN and _factored(operands[0])[0] < 0:
            mirrored = self.entry(primitive, params, dtype, self.negative(operands[0]))
            return self.negative(mirrored) if primitive.name in ODD else mirrored
        return self.entry(primitive, params, dtype, *operands)

    def values(self, outputs: Arrays, values: dict[Entry, Any]) -> Arrays:
        """The outputs over the algebra, given the values of the arguments; what they do not need is not computed."""
        needed = {x for array in outputs if array.dtype == object for x in array.flat if isinstance(x, Entry)}
        for entry in reversed(self.entries):
            if entry in needed:
                needed.update(x for x in entry.operands if isinstance(x, Entry))
        value = lambda x: values[x] if isinstance(x, Entry) else self.algebra.number(x)
        for entry in self.entries:
            if entry in needed and entry.function is not None:
                values[entry] = entry.function(*map(value, entry.operands))
        return [filled(x.shape, map(value, x.flat)) if x.dtype == object else x for x in outputs]

    # Arithmetic keeps a number in front of what it multiplies, so that signs and factors meet and cancel.

    def scaled(self, number: Any, x: Entry | None) -> Any:
        """A number times an entry; the number where the entry is None."""
        if x is None or number == 1:
            return number if x is None else x
        if number == 0:
            return x.dtype.type(0)
        return self.entry(lax.neg_p, {}, x.dtype, x) if number == -1 else self.entry(lax.mul_p, {}, x.dtype, x.dtype.type(number), x)

    def total(self, a: Any, u: Any, b: Any, v: Any) -> Any:
        """The sum a u + b v; where u or v is None, the number a or b alone."""
        if v is None:
            a, u, b, v = b, v, a, u
        if u is v:
            return self.scaled(a + b, u)
        if u is None and a == 0 and (b > 0 or not self.keeps_signs):
            return self.scaled(b, v)
        if u is not None and a < 0 and (b > 0 or not self.keeps_signs):
            return self.total(b, v, a, u) if self.keeps_signs else self.negative(self.total(-a, u, -b, v))
        (c, root), (d, same) = _rooted(u), _rooted(v)
        if root is not None and root is same:
            return self.mul(self.add(self.mul(a, c), self.mul(b, d)), root)
        x, y = self.scaled(a, u), self.scaled(abs(b), v)
        if b > 0:
            return self.entry(lax.add_p, {}, v.dtype, *sorted((x, y), key=place))
        if place(x) > place(y) and not self.keeps_signs:
            return self.negative(self.entry(lax.sub_p, {}, v.dtype, y, x))
        return self.entry(lax.sub_p, {}, v.dtype, x, y)

    def add(self, x: Any, y: Any) -> Any:
        """The sum x + y."""
        return self.total(*_factored(x), *_factored(y))

    def sub(self, x: Any, y: Any) -> Any:
        """The difference x − y."""
        (a, u), (b, v) = _factored(x), _factored(y)
        return self.total(a, u, -b, v)

    def negative(self, x: Any) -> Any:
        """The same with the other sign, −x."""
        a, u = _factored(x)
        return self.scaled(-a, u)

    def mul(self, x: Any, y: Any) -> Any:
        """The product x y."""
        (a, u), (b, v) = _factored(x), _factored(y)
        if u is None or v is None:
            number, factor, entry, whole = (a, b, v, y) if u is None else (b, a, u, x)
            merges = entry is None or number == 0 or abs(factor) == 1 or _is_moderate(number, entry.dtype)
            return self.scaled(a * b, entry) if merges else self.scaled(number, whole)
        (c, root), (d, same) = _rooted(u), _rooted(v)
        if root is not None and root is same:  # (c/√s) (d/√s) = c d (1/s): so Cholesky's factors act as L D Lᵀ, without a root
            inverse = self.div(u.dtype.type(1), root.operands[1].operands[0])
            return self.mul(a * b, self.mul(self.mul(c, d), inverse))
        return self.scaled(a * b, self.entry(lax.mul_p, {}, u.dtype, *sorted((u, v), key=place)))

    def div(self, x: Any, y: Any) -> Any:
        """The quotient x / y."""
        (a, u), (b, v) = _factored(x), _factored(y)
        if u is None and v is None:
            return self.apply(lax.div_p, {}, x.dtype, x, y)
        if v is None and math.frexp(b)[0] in (-0.5, 0.5) and _is_moderate(b, x.dtype):  # by a power of two: exact
            return self.scaled(a / b, u)
        if u is None and a == 0:
            return x
        x, y = x if u is None else self.scaled(abs(a), u), y if v is None else self.scaled(abs(b), v)
        quotient = self.entry(lax.div_p, {}, (u or v).dtype, x, y)
        return self.negative(quotient) if (u is not None and a < 0) != (v is not None and b < 0) else quotient

    def power(self, x: Any, n: int) -> Any:
        """The power xⁿ by repeated squaring."""
        if n < 2:
            return x if n == 1 else x.dtype.type(1) if n == 0 else self.div(x.dtype.type(1), self.power(x, -n))
        half, times = self.power(x, n // 2), functools.partial(self.apply, lax.mul_p, {}, x.dtype)
        return times(times(half, half), x) if n % 2 else times(half, half)


def is_number(x: Any) -> bool:
    """Whether it is a number, not an entry or a scalar of an algebra."""
    return isinstance(x, (np.generic, int, float))


def place(x: Any) -> int:
    """Where an entry stands among the others; numbers before all."""
    return x.place if isinstance(x, Entry) else -1


def _factored(x) -> tuple[Any, Any]:
    """A number and the entry it multiplies; None for a number alone."""
    if not isinstance(x, Entry):
        return x, None
    if x.name == "neg":
        return -1, x.operands[0]
    is_multiple = x.name == "mul" and is_number(x.operands[0]) and _is_moderate(x.operands[0], x.dtype)
    return x.operands if is_multiple else (1, x)  # type: ignore[return-value]


def _is_moderate(number: Any, dtype: Any) -> bool:
    """Whether a factor may be taken out of products: one far from 1 may be what keeps its entry from overflow or underflow."""
    least, most = MODERATE[dtype]
    return bool(least < abs(number) < most)


MODERATE = {np.dtype(dtype): (float(np.finfo(dtype).tiny) ** (1 / 8), float(np.finfo(dtype).max) ** (1 / 8)) for dtype in ("f4", "f8")}


def _rooted(x) -> tuple[Any, Entry | None]:
    """c and 1/√s of c/√s; None where there is no root."""
    if isinstance(x, Entry) and x.name == "div" and is_number(x.operands[0]) and x.operands[0] == 1 and x.operands[1].name == "sqrt":
        return 1, x
    if isinstance(x, Entry) and x.name == "mul":
        for rest, factor in (x.operands, x.operands[::-1]):
            if _rooted(factor)[1] is factor:
                return rest, factor
    return x, None


def filled(shape: tuple, entries: Iterable) -> np.ndarray:
    """An array of objects."""
    entries = list(entries)
    array = np.empty(len(entries), object)
    for i, x in enumerate(entries):
        array[i] = x
    return array.reshape(shape)


def objects(array: np.ndarray) -> np.ndarray:
    """With NumPy scalars, which know their dtype, in place of numbers."""
    return array if array.dtype == object else filled(array.shape, array.flat)


ODD = frozenset(("sin", "tan", "asin", "atan", "sinh", "tanh", "asinh", "atanh", "cbrt", "erf"))
EVEN = frozenset(("cos", "cosh"))  # not abs: there the derivative at 0 would change its sign


# What is simplified before it becomes an entry; None where nothing is.


def _if_real(method: Callable) -> Callable:
    """Of floating-point numbers: the arithmetic of integers wraps around, and stays as it is."""
    return lambda folding, *operands: method(folding, *operands) if all(x.dtype.kind == "f" for x in operands) else None


def _selected(folding, which, *cases):
    if not isinstance(which, Entry):
        return cases[min(max(int(which), 0), len(cases) - 1)]
    one = cases[0]
    return one if all(x is one or (is_number(x) and is_number(one) and x.tobytes() == one.tobytes()) for x in cases) else None


def _raised(folding, x, n):
    if not isinstance(n, Entry) and n == 0.5:
        return folding.apply(lax.sqrt_p, {}, x.dtype, x)
    return folding.power(x, int(n)) if not isinstance(n, Entry) and abs(n) <= 16 and float(n).is_integer() else None


def _junction(neutral: bool) -> Callable:
    def simpler(folding, x, y):
        x, y = sorted((x, y), key=place)
        if isinstance(x, np.bool_):
            return y if x == neutral else x
        return x if x is y else None

    return simpler


SIMPLER: dict[str, Callable] = {
    **dict(add=_if_real(Folding.add), add_any=_if_real(Folding.add), sub=_if_real(Folding.sub), neg=_if_real(Folding.negative)),
    **dict(mul=_if_real(Folding.mul), div=_if_real(Folding.div), pow=_raised, select_n=_selected),
    "and": _junction(True),
    "or": _junction(False),
}
