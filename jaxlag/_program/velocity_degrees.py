"""The structure of a program with unknown arguments: its expression nodes, their degree in the velocities, and the equations that they
come from.
"""

import math
from collections.abc import Iterable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax

from .expressions import Algebra, Arrays, Node, filled, is_number, objects
from .interpreter import Interpreter
from .primitives import ANY_CALL, LINEAR, ORDER
from .rules import map_elements
from .walker import branch_index, columns_of_branches, is_call_of, primitive_names

Path = tuple[int, ...]  # to an equation: its number in the program, that of the call within it, that of the equation in there, ...
Place = tuple[Path, int, int, float]  # the equation, its output, the element of it, and the number to multiply it by
INLINED = ANY_CALL | {"scan", "cond"}
NONLINEAR = 9
MAX_MULTIPLICATIONS = 2_000  # a product of arrays with more of them is not taken apart


class _Symbolic(Algebra):
    """Of a node only its operands are known: enough to ask what it becomes where others vanish."""

    interpreter: "VelocityDegrees"

    def function(self, primitive, params, dtype):
        return lambda *operands: self.interpreter.apply(primitive, params, dtype, *operands)


class VelocityDegrees(Interpreter):
    """Interprets programs for their structure: of each node its degree in the velocities, and its place in the program.

    It walks as every `Interpreter` does, and notes the path to each equation: `run` and `equation` wrap those of the interpreter.
    """

    def __init__(self, limit: int | float = math.inf):
        super().__init__(_Symbolic(), limit)
        self.algebra.interpreter = self  # type: ignore[attr-defined]
        self.degrees: dict[Node, int] = {}
        self.given: dict[int, tuple[Any, np.ndarray]] = {}
        self.blocks: dict[tuple, Arrays] = {}
        self.primitives: dict[Node, frozenset[str]] = {}  # of a result of a block, those within it
        self.reset()

    def reset(self) -> None:
        """Forgets the places of nodes: another program follows."""
        self.path: list[int] = []
        self.opaque_depth = 0
        self.places: dict[Node, Place] = {}
        self.new_nodes: dict[Path, list[list[tuple[int, Node]]]] = {}
        self.branches: dict[Path, int] = {}

    def unknown(self, array: Any, argument: int = -1, degree: int = 0) -> np.ndarray:
        """Nodes for an array from outside; the same for the same array, or for the same argument of a function."""
        key = id(array) if argument < 0 else argument  # q and q̇ may be the same array
        if key not in self.given:
            nodes = filled(array.shape, [self.argument(array.dtype) for _ in range(array.size)])
            self.given[key] = array, nodes
            self.degrees |= dict.fromkeys(nodes.flat, degree)
        return self.given[key][1]

    def new(self, *what: Any) -> Node:
        node = super().new(*what)
        self.degrees[node] = self._degree(node)
        return node

    def degree(self, x: Any) -> int:
        """The degree in the velocities: 0 does not depend on them, 1 is affine."""
        return self.degrees[x] if isinstance(x, Node) else 0

    def _degree(self, node) -> int:
        of = [self.degree(x) for x in node.operands]
        if not any(of):
            return 0
        if node.name in LINEAR or (node.name == "convert_element_type" and jnp.issubdtype(node.dtype, jnp.inexact)):
            return max(of)
        if node.name == "mul":
            return min(sum(of), NONLINEAR)
        if node.name in ("div", "select_n", "item"):
            special = {"div": 1, "select_n": 0, "item": None}[node.name]  # the operand in which it is not linear
            return max(of) if special is None or of[special] == 0 else NONLINEAR
        return NONLINEAR

    def run(self, program: Any, inputs: Any) -> Arrays:
        if self.path:
            self.path[-1] += 1
        for i, array in enumerate(inputs):
            if not self.path and array.dtype == object:
                self._record_place((-1,), i, array)
        self.path.append(-1)
        outputs = super().run(program, inputs)
        self.path.pop()
        return outputs

    def equation(self, equation: Any, operands: Arrays) -> Arrays:
        name = equation.primitive.name
        self.path[-1] += 1
        here = tuple(self.path)
        self.path.append(-1)
        special = {"cond": self._cond, "dot_general": self._dot_general}.get(name)
        results = special(equation, operands, here) if special else None
        if results is None and equation.params.get("name") == "hypot" and len(operands) == 2 and is_call_of(equation, jnp.hypot):
            root = lambda x, y: self.apply(lax.sqrt_p, {}, x.dtype, self.add(self.mul(x, x), self.mul(y, y)))
            results, name = [map_elements(root, *operands)], "sqrt"
        if results is None:
            self.opaque_depth += name not in INLINED
            results = super().equation(equation, operands)
            self.opaque_depth -= name not in INLINED
        self.path.pop()
        if not self.opaque_depth and name not in INLINED:
            before = {x for array in operands if array.dtype == object for x in array.flat}
            new_nodes = [[(k, x) for k, x in enumerate(a.flat) if isinstance(x, Node) and x not in before] for a in map(objects, results)]
            if any(new_nodes):
                self.new_nodes[here] = new_nodes
            for i, array in enumerate(results):
                self._record_place(here, i, array)
        return results

    def _record_place(self, path, i, array):
        if array.dtype == object:
            for k, x in enumerate(array.flat):
                if isinstance(x, Node):
                    self.places.setdefault(x, (path, i, k, 1.0))
                    number, node = split_coefficient(x)
                    if node is not x and number != 0:
                        self.places.setdefault(node, (path, i, k, 1 / float(number)))

    def whole(self, equation: Any, operands: Arrays) -> Arrays:
        if all(x.dtype != object for x in operands):
            return super().whole(equation, operands)
        return self._block(equation, operands)

    def foreign(self, equation: Any, operands: Arrays) -> Arrays:
        return self._block(equation, operands)

    def _block(self, equation, operands, degree=None) -> Arrays:
        """Outputs of which only the operands are known; the same for the same operands."""
        flat = [x for array in operands for x in objects(array).flat]
        key = (equation.primitive.name, str(equation.params), *(x if isinstance(x, Node) else (x.dtype, str(x)) for x in flat))
        if key not in self.blocks:
            self.blocks[key] = self.block(lambda *_: [], operands, equation.outvars)
            names = frozenset(primitive_names([equation]))
            self.primitives |= {x: names for array in self.blocks[key] for x in array.flat}
            if degree is not None:
                self.degrees |= {x: degree for array in self.blocks[key] for x in array.flat}
        return self.blocks[key]

    def _dot_general(self, equation, operands, here):
        (x_sum, _), _ = equation.params["dimension_numbers"]
        x, _ = operands
        size = equation.outvars[0].aval.size * math.prod(x.shape[d] for d in x_sum)
        if size <= MAX_MULTIPLICATIONS or all(operand.dtype != object for operand in operands):
            return None
        degree = sum(max(map(self.degree, operand.flat), default=0) for operand in operands)
        return self._block(equation, operands, min(degree, NONLINEAR))

    def _cond(self, equation, operands, here):
        """All branches where the index is not known: one of them is selected, as under `vmap`."""
        index, *operands = operands
        if index.dtype != object:
            self.branches[here] = branch_index(index, equation.params)
            return self.run(equation.params["branches"][self.branches[here]], operands)
        select = lambda *of: self.apply(lax.select_n_p, {}, of[0].dtype, index.item(), *of)
        return [map_elements(select, *column) for column in columns_of_branches(equation.params, operands, self.run)]

    def with_zeros(self, x: Any, zeros: Iterable[Node], positive: frozenset[Node]) -> Any:
        """What a node becomes where others are zero. In a power 0^p with unknown p, p > 0 is assumed; a node among `positive` that is
        compared with zero is taken to be positive.
        """
        values: dict[Any, Any] = {node: node.dtype.type(0) for node in zeros}
        for node in self.dependencies([x]):
            if node not in values:
                operands = tuple(values.get(y, y) for y in node.operands)
                changed = any(a is not b for a, b in zip(operands, node.operands, strict=True))
                make = self.new if node.name in ("block", "item") else None
                if changed and node.name == "pow" and is_number(operands[0]) and operands[0] == 0:
                    values[node] = node.dtype.type(0)
                elif changed and node.name in ORDER and any(is_number(y) and y == 0 for y in operands):
                    sizes = [y.dtype.type(np.sign(split_coefficient(y)[0])) if split_coefficient(y)[1] in positive else y for y in operands]
                    values[node] = node.function(*sizes)  # type: ignore[misc]
                elif changed:
                    rebuilt = make(node.dtype, node.name, node.function, operands) if make else node.function(*operands)  # type: ignore[misc]
                    values[node] = rebuilt
        return values.get(x, x)

    def dependencies(self, outputs: Iterable[Any]) -> list[Node]:
        """All nodes that some depend on, these included, each after its operands."""
        found, waiting = set(), [x for x in outputs if isinstance(x, Node)]
        while waiting:
            node = waiting.pop()
            if node not in found:
                found.add(node)
                waiting += [x for x in node.operands if isinstance(x, Node)]
        return sorted(found, key=lambda node: node.index)


def split_coefficient(x: Any) -> tuple[Any, Any]:
    """The coefficient of a node and the node without it; a number, and None, for a number alone."""
    if is_number(x):
        return x, None
    if x.name == "neg":
        number, node = split_coefficient(x.operands[0])
        return -number, node
    return x.operands if x.name == "mul" and is_number(x.operands[0]) else (1.0, x)
