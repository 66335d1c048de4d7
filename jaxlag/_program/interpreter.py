"""An interpreter of jaxprs over scalars of any algebra.

A small system spends its time in array overhead, not in arithmetic. Here a program over arrays becomes one over their elements: moving
data costs nothing, and what is left is simplified (`_program.scalar_graph`). Over JAX scalars the result is fused scalar code, over
symbols it is a formula.
"""

import functools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax.extend import core

from . import data_movement as data_movement  # its rules
from . import elimination as elimination
from .constants import fold_by_jax, folded, has_extended_dtype, is_foldable, is_numeric
from .expressions import Algebra, Arrays, Node, TooLong, UnknownPrimitive, filled, is_number, objects
from .primitives import ANY_CALL, ELEMENTWISE, LINEAR_ALGEBRA
from .rules import RULES, map_elements
from .scalar_graph import ScalarGraph
from .signed_zeros import equations_with_signed_zeros
from .walker import called_program, constants_as_inputs, walk

MAX_FOLDED_OPERATIONS = 1000  # on numbers: some 20 ms in Python, less than a program takes to compile


def evaluate(closed: Any, algebra: Algebra, *arguments: Any, limit: int | float = math.inf) -> Arrays:
    """The outputs of a jaxpr as arrays of scalars of the algebra, or of numbers.

    **Arguments:** for each input an array of numbers, or an object array of scalars of the algebra and numbers.

    **Raises:** `UnknownPrimitive`, which names the primitive and its line; `TooLong` if there are more than `limit` nodes.
    """
    interpreter = Interpreter(algebra, limit)
    interpreter.with_signed_zeros = equations_with_signed_zeros(closed)
    inputs: Arrays = []
    values: dict[Node, Any] = {}
    for argument, variable in zip(arguments, closed.jaxpr.invars, strict=True):
        array, dtype = np.asarray(argument), variable.aval.dtype
        if array.dtype == object:
            nodes = [interpreter.known(np.asarray(x, dtype))[()] if is_number(x) else interpreter.argument(dtype) for x in array.flat]
            values |= {node: x for node, x in zip(nodes, array.flat, strict=True) if isinstance(node, Node) and not is_number(x)}
            inputs.append(numeric_if_known(filled(array.shape, nodes), dtype))
        else:
            inputs.append(interpreter.known(array))
    return interpreter.values(interpreter.run(closed, inputs), values)


def traced(closed: Any, interpreter: "Interpreter") -> tuple[Arrays, Arrays]:
    """Inputs and outputs of a jaxpr in which everything but known numbers is an argument: its constants come first.

    **Raises:** as `evaluate`, and `TooLong` if it has effects, or arguments that are not numbers.
    """
    jaxpr = constants_as_inputs(closed)
    if closed.effects or any(map(has_extended_dtype, jaxpr.invars)):
        raise TooLong
    interpreter.with_signed_zeros = equations_with_signed_zeros(closed)
    given = [*closed.consts, *([None] * len(closed.jaxpr.invars))]
    inputs = [
        np.asarray(x) if is_numeric(x) else filled(v.aval.shape, [interpreter.argument(v.aval.dtype) for _ in range(v.aval.size)])
        for x, v in zip(given, jaxpr.invars, strict=True)
    ]
    return inputs, interpreter.run(jaxpr, [numeric_if_known(x, v.aval.dtype) for x, v in zip(inputs, jaxpr.invars, strict=True)])


class Interpreter(ScalarGraph):
    """Evaluates jaxprs over arrays of numbers and expression nodes."""

    with_signed_zeros: frozenset[int] = frozenset()  # equations, by their `id`

    def run(self, program: Any, inputs: Any) -> Arrays:
        """The outputs of a jaxpr, closed or not, whose constants are numbers."""
        return walk(program, inputs, self.evaluated, lambda value: self.known(np.asarray(value)))

    @np.errstate(all="ignore")  # 1/0 among numbers is JAX's inf, without a warning
    def evaluated(self, equation: Any, operands: Arrays) -> Arrays:
        """The outputs of one equation, as arrays of numbers where all elements are known."""
        results = self.equation(equation, operands)
        return [numeric_if_known(array, variable.aval.dtype) for array, variable in zip(results, equation.outvars, strict=True)]

    def equation(self, equation: Any, operands: Arrays) -> Arrays:
        """The outputs of one equation."""
        primitive = equation.primitive
        results: Any = NotImplemented
        self.source.append(equation.source_info)
        outside, self.keeps_signed_zeros = self.keeps_signed_zeros, id(equation) in self.with_signed_zeros
        numbers = all(x.dtype != object for x in operands)
        atoms = [*equation.invars, *equation.outvars]
        self.count_work(10 + (0 if numbers else sum(atom.aval.size for atom in atoms)))
        if any(map(has_extended_dtype, atoms)) or not (numbers or all(map(is_foldable, atoms))):
            results = self.foreign(equation, operands)
        elif numbers and (not all(map(is_foldable, atoms)) or _operations(equation) > MAX_FOLDED_OPERATIONS):
            results = self.whole(equation, operands)
        elif primitive.name in RULES:
            results = RULES[primitive.name](self, equation, *operands)
        elif primitive.name in ELEMENTWISE:
            results = self.elementwise(primitive, equation.params, equation.outvars[0].aval.dtype, *operands)
        if results is NotImplemented:
            results = self.whole(equation, operands)
        self.source.pop()
        self.keeps_signed_zeros = outside
        return results if isinstance(results, list) else [results]

    def foreign(self, equation: Any, operands: Arrays) -> Arrays:
        """The outputs of an equation with variables whose arithmetic is left to JAX: complex, of half precision, keys of random numbers."""
        raise UnknownPrimitive(equation.primitive, self.source)

    def elementwise(self, primitive: core.Primitive, params: dict, dtype: Any, *arrays: np.ndarray) -> np.ndarray:
        """An element-wise operation, in one call of NumPy where all elements are numbers."""
        if all(x.dtype != object for x in arrays):
            numbers = np.asarray(folded(primitive, params, dtype, *arrays))
            if np.all(self.algebra.folds(numbers)):
                return numbers
        return map_elements(functools.partial(self.apply, primitive, params, dtype), *arrays)

    def whole(self, equation: Any, operands: Arrays) -> Arrays:
        """The outputs of an equation that is not taken apart."""
        if all(x.dtype != object for x in operands) and not equation.effects:
            return [self.known(x) for x in fold_by_jax(equation, operands)]
        function = self.algebra.block(equation)
        if function is None:
            raise UnknownPrimitive(equation.primitive, self.source)
        return self.block(function, operands, equation.outvars)

    def block(self, function: Callable[..., Arrays], operands: Sequence[np.ndarray], outvars: Any) -> Arrays:
        """The outputs of a function of arrays over the algebra: one node for all, and one for each element of the outputs."""
        shapes, avals = [x.shape for x in operands], [variable.aval for variable in outvars]
        on_flat = lambda *flat: [x for array in function(*unflattened(flat, shapes)) for x in array.flat]
        block = self.new(None, "block", on_flat, tuple(x for array in operands for x in objects(array).flat))
        dtypes = [aval.dtype for aval in avals for _ in range(aval.size)]
        items = [self.new(dtype, "item", operator.itemgetter(k), (block,)) for k, dtype in enumerate(dtypes)]
        return unflattened(items, [aval.shape for aval in avals])


def unflattened(flat: Any, shapes: Any) -> Arrays:
    """A flat sequence of scalars as arrays of these shapes."""
    splits = np.cumsum([0, *(math.prod(shape) for shape in shapes)])
    return [filled(shape, flat[i:j]) for shape, i, j in zip(shapes, splits[:-1], splits[1:], strict=True)]


def numeric_if_known(array: np.ndarray, dtype: Any) -> np.ndarray:
    """An array of numbers, where all elements are known."""
    return array.astype(dtype) if array.dtype == object and not any(isinstance(x, Node) for x in array.flat) else array


def _operations(equation: Any) -> int | float:
    """How many operations on numbers, one by one, the rule of an equation would do."""
    name, p = equation.primitive.name, equation.params
    if name == "while":
        return math.inf  # as long as it takes
    if name == "cond":
        return max(sum(map(_operations, branch.jaxpr.eqns)) for branch in p["branches"])
    if name in ANY_CALL or name in ("scan", "custom_linear_solve"):
        return p.get("length", 1) * sum(map(_operations, called_program(equation).jaxpr.eqns))
    if name in LINEAR_ALGEBRA:
        return equation.invars[0].aval.size * equation.invars[0].aval.shape[-1]
    windows = math.prod(equation.invars[1].aval.shape[:-1]) if name.startswith(("gather", "scatter")) else 1
    return windows + equation.invars[0].aval.size if name.startswith("scatter") else windows
