"""A jaxpr evaluated entry by entry over any scalar algebra.

A small system spends its time in array plumbing, not in arithmetic. Here a program over arrays becomes one over their entries: moving
data costs nothing, and what is left is folded (`_program.scalar_graph`). Over JAX scalars that is fused scalar code, over symbols it
is a formula.
"""

import functools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend import core

from . import elimination as elimination  # its rules
from .constants import ELEMENTWISE, by_jax, folded, is_extended, is_known
from .constants import on_arrays as on_arrays
from .rules import LONG, RULES, each, primitives, turns
from .scalar_graph import Algebra, Arrays, Entry, Folding, TooLong, UnknownPrimitive, filled, is_number, objects

SIGNED = {"atan2", "bitcast_convert_type"}  # to which the sign of a zero matters: an angle of π or −π


def evaluate(closed: Any, algebra: Algebra, *arguments: Any, limit: int | float = math.inf) -> Arrays:
    """The outputs of a jaxpr as arrays of scalars of the algebra, or of numbers.

    **Arguments:** for each input an array of numbers, or an object array of scalars of the algebra and numbers.

    **Raises:** `UnknownPrimitive`, which names it and its line; `TooLong` where there are more than `limit` entries.
    """
    reader = Reader(algebra, limit)
    reader.keeps_signs = not SIGNED.isdisjoint(primitives(closed))
    inputs: Arrays = []
    values: dict[Entry, Any] = {}
    for argument, variable in zip(arguments, closed.jaxpr.invars, strict=True):
        array, dtype = np.asarray(argument), variable.aval.dtype
        if array.dtype == object:
            entries = [reader.known(np.asarray(x, dtype))[()] if is_number(x) else reader.argument(dtype) for x in array.flat]
            values |= {entry: x for entry, x in zip(entries, array.flat, strict=True) if isinstance(entry, Entry) and not is_number(x)}
            inputs.append(settled(filled(array.shape, entries), dtype))
        else:
            inputs.append(reader.known(array))
    return reader.values(reader.inner(closed, inputs), values)


def opened(closed: Any, reader: "Reader") -> tuple[Arrays, Arrays]:
    """Inputs and outputs of a jaxpr in which all but known numbers is an argument: what it closes over, traced, comes first.

    **Raises:** as `evaluate`, and `TooLong` where it has effects, or arguments that are no numbers.
    """
    jaxpr = closed.jaxpr.replace(constvars=[], invars=[*closed.jaxpr.constvars, *closed.jaxpr.invars])
    if closed.effects or any(map(is_extended, jaxpr.invars)):
        raise TooLong
    reader.keeps_signs = not SIGNED.isdisjoint(primitives(closed))
    given = [*closed.consts, *([None] * len(closed.jaxpr.invars))]
    inputs = [
        np.asarray(x)
        if isinstance(x, (np.ndarray, jax.Array)) and not isinstance(x, jax.core.Tracer)
        else filled(v.aval.shape, [reader.argument(v.aval.dtype) for _ in range(v.aval.size)])
        for x, v in zip(given, jaxpr.invars, strict=True)
    ]
    return inputs, reader.inner(jaxpr, [settled(x, v.aval.dtype) for x, v in zip(inputs, jaxpr.invars, strict=True)])


class Reader(Folding):
    """Reads jaxprs into entries."""

    @np.errstate(all="ignore")  # 1/0 among numbers is JAX's inf, without a word
    def inner(self, jaxpr: Any, inputs: Any) -> Arrays:
        """The outputs of a jaxpr, closed or not, whose constants are numbers."""
        consts = [self.known(np.asarray(const)) for const in getattr(jaxpr, "consts", ())]
        jaxpr = getattr(jaxpr, "jaxpr", jaxpr)
        arrays = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *inputs], strict=True))
        literal = lambda atom: self.known(np.asarray(atom.val, atom.aval.dtype))
        read = lambda atom: literal(atom) if isinstance(atom, core.Literal) else arrays[atom]  # type: ignore[attr-defined]
        for equation in jaxpr.eqns:
            results = self.equation(equation, [read(atom) for atom in equation.invars])
            for variable, array in zip(equation.outvars, results, strict=True):
                arrays[variable] = settled(array, variable.aval.dtype)
        return [read(atom) for atom in jaxpr.outvars]

    def equation(self, equation: Any, operands: Arrays) -> Arrays:
        """The outputs of one equation."""
        primitive = equation.primitive
        results: Any = NotImplemented
        self.where.append(equation.source_info)
        numbers = all(x.dtype != object for x in operands)
        atoms = [*equation.invars, *equation.outvars]
        self.spend(10 + (0 if numbers else sum(atom.aval.size for atom in atoms)))
        if any(map(is_extended, atoms)) or not (numbers or all(map(is_known, atoms))):
            raise UnknownPrimitive(primitive, self.where)
        if numbers and (not all(map(is_known, atoms)) or turns(equation) > LONG):
            results = self.whole(equation, operands)
        elif primitive.name in RULES:
            results = RULES[primitive.name](self, equation, *operands)
        elif primitive.name in ELEMENTWISE:
            results = self.elementwise(primitive, equation.params, equation.outvars[0].aval.dtype, *operands)
        if results is NotImplemented:
            results = self.whole(equation, operands)
        self.where.pop()
        return results if isinstance(results, list) else [results]

    def elementwise(self, primitive: core.Primitive, params: dict, dtype: Any, *arrays: np.ndarray) -> np.ndarray:
        """An operation on each entry, at once where all are numbers."""
        if all(x.dtype != object for x in arrays):
            numbers = np.asarray(folded(primitive, params, dtype, *arrays))
            if np.all(self.algebra.folds(numbers)):
                return numbers
        return each(functools.partial(self.apply, primitive, params, dtype), *arrays)

    def whole(self, equation: Any, operands: Arrays) -> Arrays:
        """The outputs of an equation that is not taken apart."""
        if all(x.dtype != object for x in operands) and not equation.effects:
            return [self.known(x) for x in by_jax(equation, operands)]
        function = self.algebra.block(equation)
        if function is None:
            raise UnknownPrimitive(equation.primitive, self.where)
        return self.block(function, operands, equation.outvars)

    def block(self, function: Callable[..., Arrays], operands: Sequence[np.ndarray], outvars: Any) -> Arrays:
        """The outputs of a function of arrays over the algebra."""
        shapes, avals = [x.shape for x in operands], [variable.aval for variable in outvars]
        on_flat = lambda *flat: [x for array in function(*shaped(flat, shapes)) for x in array.flat]
        block = self.new(None, "block", on_flat, tuple(x for array in operands for x in objects(array).flat))
        dtypes = [aval.dtype for aval in avals for _ in range(aval.size)]
        items = [self.new(dtype, "item", operator.itemgetter(k), (block,)) for k, dtype in enumerate(dtypes)]
        return shaped(items, [aval.shape for aval in avals])


def shaped(flat: Any, shapes: Any) -> Arrays:
    """Scalars in a row as arrays of these shapes."""
    splits = np.cumsum([0, *(math.prod(shape) for shape in shapes)])
    return [filled(shape, flat[i:j]) for shape, i, j in zip(shapes, splits[:-1], splits[1:], strict=True)]


def settled(array: np.ndarray, dtype: Any) -> np.ndarray:
    """As numbers, where all entries are known."""
    return array.astype(dtype) if array.dtype == object and not any(isinstance(x, Entry) for x in array.flat) else array
