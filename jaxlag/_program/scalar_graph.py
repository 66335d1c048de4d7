"""A graph of scalar operations that folds constants, drops zeros and shares common subexpressions.

0·x and x + 0 make no node, x − y and y − x are one node up to the sign, and an operation on the same operands is the same node.
What the nodes stand for is left to the algebra: JAX scalars, symbols.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from jax import lax
from jax.extend import core

from .constants import folded
from .expressions import Algebra, Arrays, Node, TooLong, UnknownPrimitive, filled, is_number, objects, order
from .primitives import EVEN, ODD

WORK_PER_NODE = 50  # steps for each operation that is allowed; mechanical systems take up to 20


class ScalarGraph:
    """The nodes made so far, each once, after those that it needs; and the arithmetic that makes more of them."""

    def __init__(self, algebra: Algebra, limit: int | float = math.inf):
        self.algebra, self.limit, self.work = algebra, limit, 0
        self.nodes: list[Node] = []
        self.node_of_key: dict[tuple, Node] = {}
        self.keeps_signed_zeros = False  # x − y and −(y − x) differ by it where x = y, and so does what is divided by them
        self.source: list = []  # the lines of the user's code, for messages

    def new(self, *what: Any) -> Node:
        """One more node."""
        if len(self.nodes) >= self.limit:
            raise TooLong
        self.nodes.append(Node(len(self.nodes), *what))
        return self.nodes[-1]

    def count_work(self, operations: int) -> None:
        """Counts what is done: zeros and numbers make no nodes but take time."""
        self.work += operations
        if self.work > WORK_PER_NODE * self.limit:
            raise TooLong

    def argument(self, dtype: Any) -> Node:
        """A node whose value comes from outside."""
        return self.new(dtype, "argument")

    def known(self, array: np.ndarray) -> np.ndarray:
        """Numbers, with those that the algebra does not fold as nodes."""
        if np.all(self.algebra.folds(array)):
            return array
        return filled(array.shape, [x if self.algebra.folds(x) else self.constant(x) for x in objects(array).flat])

    def constant(self, x: np.generic) -> Node:
        """A number as a node."""
        key = ("constant", x.dtype, x.tobytes())
        if key not in self.node_of_key:
            self.node_of_key[key] = self.new(x.dtype, "constant", lambda x: x, (x,))
        return self.node_of_key[key]

    def operation(self, primitive: core.Primitive, params: dict, dtype: Any, *operands: Any) -> Node:
        """The node of one operation, not simplified."""
        key = (primitive.name, dtype, *params.items(), *(x if isinstance(x, Node) else (x.dtype, x.tobytes()) for x in operands))
        if key not in self.node_of_key:
            function = self.algebra.function(primitive, params, dtype)
            if function is None:
                raise UnknownPrimitive(primitive, self.source)
            self.node_of_key[key] = self.new(dtype, primitive.name, function, operands)
        return self.node_of_key[key]

    def apply(self, primitive: core.Primitive, params: dict, dtype: Any, *operands: Any) -> Any:
        """One operation, simplified: a number or a node."""
        if not any(isinstance(x, Node) for x in operands):
            number = folded(primitive, params, dtype, *operands)
            return number if self.algebra.folds(number) else self.operation(primitive, params, dtype, *operands)
        simpler = SIMPLIFICATIONS[primitive.name](self, *operands) if primitive.name in SIMPLIFICATIONS else None
        if simpler is not None:
            return simpler
        if primitive.name in ODD | EVEN and _coefficient(operands[0])[0] < 0:
            mirrored = self.operation(primitive, params, dtype, self.negative(operands[0]))
            return self.negative(mirrored) if primitive.name in ODD else mirrored
        return self.operation(primitive, params, dtype, *operands)

    def values(self, outputs: Arrays, values: dict[Node, Any]) -> Arrays:
        """The outputs over the algebra, given the values of the arguments; what they do not need is not computed."""
        needed = {x for array in outputs if array.dtype == object for x in array.flat if isinstance(x, Node)}
        for node in reversed(self.nodes):
            if node in needed:
                needed.update(x for x in node.operands if isinstance(x, Node))
        value = lambda x: values[x] if isinstance(x, Node) else self.algebra.number(x)
        for node in self.nodes:
            if node in needed and node.function is not None:
                values[node] = node.function(*map(value, node.operands))
        return [filled(x.shape, map(value, x.flat)) if x.dtype == object else x for x in outputs]

    # Arithmetic keeps a coefficient in front of each node, so that signs and factors meet and cancel.

    def scaled(self, number: Any, x: Node | None) -> Any:
        """A number times a node; the number where the node is None."""
        if x is None or number == 1:
            return number if x is None else x
        if number == 0:
            return x.dtype.type(0)
        return (
            self.operation(lax.neg_p, {}, x.dtype, x) if number == -1 else self.operation(lax.mul_p, {}, x.dtype, x.dtype.type(number), x)
        )

    def linear_combination(self, a: Any, u: Any, b: Any, v: Any) -> Any:
        """The sum a u + b v; where u or v is None, the number a or b alone."""
        if v is None:
            a, u, b, v = b, v, a, u
        if u is v:
            return self.scaled(a + b, u)
        if u is None and a == 0 and (b > 0 or not self.keeps_signed_zeros):
            return self.scaled(b, v)
        if u is not None and a < 0 and (b > 0 or not self.keeps_signed_zeros):
            if self.keeps_signed_zeros:
                return self.linear_combination(b, v, a, u)
            return self.negative(self.linear_combination(-a, u, -b, v))
        (c, root), (d, same) = _inverse_root(u), _inverse_root(v)
        if root is not None and root is same:
            a, b = v.dtype.type(a), v.dtype.type(b)
            return self.mul(self.add(self.mul(a, c), self.mul(b, d)), root)
        x, y = self.scaled(a, u), self.scaled(abs(b), v)
        if b > 0:
            return self.operation(lax.add_p, {}, v.dtype, *sorted((x, y), key=order))
        if order(x) > order(y) and not self.keeps_signed_zeros:
            return self.negative(self.operation(lax.sub_p, {}, v.dtype, y, x))
        return self.operation(lax.sub_p, {}, v.dtype, x, y)

    def add(self, x: Any, y: Any) -> Any:
        """The sum x + y."""
        return self.linear_combination(*_coefficient(x), *_coefficient(y))

    def sub(self, x: Any, y: Any) -> Any:
        """The difference x − y."""
        (a, u), (b, v) = _coefficient(x), _coefficient(y)
        return self.linear_combination(a, u, -b, v)

    def negative(self, x: Any) -> Any:
        """The same with the other sign, −x."""
        a, u = _coefficient(x)
        return self.scaled(-a, u)

    def mul(self, x: Any, y: Any) -> Any:
        """The product x y."""
        (a, u), (b, v) = _coefficient(x), _coefficient(y)
        if u is None or v is None:
            number, factor, node, whole = (a, b, v, y) if u is None else (b, a, u, x)
            merges = node is None or number == 0 or abs(factor) == 1 or _is_moderate(number, node.dtype)
            return self.scaled(a * b, node) if merges else self.scaled(number, whole)
        (c, root), (d, same) = _inverse_root(u), _inverse_root(v)
        if root is not None and root is same:  # (c/√s) (d/√s) = c d (1/s): so Cholesky's factors act as L D Lᵀ, without a root
            inverse = self.div(u.dtype.type(1), root.operands[1].operands[0])
            return self.mul(a * b, self.mul(self.mul(c, d), inverse))
        return self.scaled(a * b, self.operation(lax.mul_p, {}, u.dtype, *sorted((u, v), key=order)))

    def div(self, x: Any, y: Any) -> Any:
        """The quotient x / y."""
        (a, u), (b, v) = _coefficient(x), _coefficient(y)
        if u is None and v is None:
            return self.apply(lax.div_p, {}, x.dtype, x, y)
        if v is None and math.frexp(b)[0] in (-0.5, 0.5) and _is_moderate(b, x.dtype):  # by a power of two: exact
            return self.scaled(a / b, u)
        if u is None and a == 0:
            return x
        x, y = x if u is None else self.scaled(abs(a), u), y if v is None else self.scaled(abs(b), v)
        quotient = self.operation(lax.div_p, {}, (u or v).dtype, x, y)
        return self.negative(quotient) if (u is not None and a < 0) != (v is not None and b < 0) else quotient

    def power(self, x: Any, n: int) -> Any:
        """The power xⁿ by repeated squaring."""
        if n < 2:
            return x if n == 1 else x.dtype.type(1) if n == 0 else self.div(x.dtype.type(1), self.power(x, -n))
        half, times = self.power(x, n // 2), functools.partial(self.apply, lax.mul_p, {}, x.dtype)
        return times(times(half, half), x) if n % 2 else times(half, half)


def _coefficient(x) -> tuple[Any, Any]:
    """The moderate coefficient of a node, and the node without it; a number, and None, for a number alone."""
    if not isinstance(x, Node):
        return x, None
    if x.name == "neg":
        return -1, x.operands[0]
    is_multiple = x.name == "mul" and is_number(x.operands[0]) and _is_moderate(x.operands[0], x.dtype)
    return x.operands if is_multiple else (1, x)  # type: ignore[return-value]


def _is_moderate(number: Any, dtype: Any) -> bool:
    """Whether a factor may be taken out of products: one far from 1 may be what keeps its node from overflow or underflow."""
    least, most = MODERATE[dtype]
    return bool(least < abs(number) < most)


MODERATE = {np.dtype(dtype): (float(np.finfo(dtype).tiny) ** (1 / 8), float(np.finfo(dtype).max) ** (1 / 8)) for dtype in ("f4", "f8")}


def _inverse_root(x) -> tuple[Any, Node | None]:
    """c and 1/√s of c/√s; None where there is no root."""
    if isinstance(x, Node) and x.name == "div" and is_number(x.operands[0]) and x.operands[0] == 1 and x.operands[1].name == "sqrt":
        return 1, x
    if isinstance(x, Node) and x.name == "mul":
        for rest, factor in (x.operands, x.operands[::-1]):
            if _inverse_root(factor)[1] is factor:
                return rest, factor
    return x, None


# What is simplified before it becomes a node; None where nothing is.


def _if_real(method: Callable) -> Callable:
    """For floating-point numbers only: the arithmetic of integers wraps around, and is left as written."""
    return lambda graph, *operands: method(graph, *operands) if all(x.dtype.kind == "f" for x in operands) else None


def _select(graph, which, *cases):
    if not isinstance(which, Node):
        return cases[min(max(int(which), 0), len(cases) - 1)]
    one = cases[0]
    return one if all(x is one or (is_number(x) and is_number(one) and x.tobytes() == one.tobytes()) for x in cases) else None


def _pow(graph, x, n):
    if not isinstance(n, Node) and n == 0.5:
        return graph.apply(lax.sqrt_p, {}, x.dtype, x)
    return graph.power(x, int(n)) if not isinstance(n, Node) and abs(n) <= 16 and float(n).is_integer() else None


def _logical(neutral: bool) -> Callable:
    """`and`, of which True is the neutral element, or `or`, of which False is."""

    def simpler(graph, x, y):
        x, y = sorted((x, y), key=order)
        if isinstance(x, np.bool_):
            return y if x == neutral else x
        return x if x is y else None

    return simpler


SIMPLIFICATIONS: dict[str, Callable] = {
    **dict(add=_if_real(ScalarGraph.add), add_any=_if_real(ScalarGraph.add), sub=_if_real(ScalarGraph.sub)),
    **dict(neg=_if_real(ScalarGraph.negative), mul=_if_real(ScalarGraph.mul), div=_if_real(ScalarGraph.div), pow=_pow, select_n=_select),
    "and": _logical(True),
    "or": _logical(False),
}
