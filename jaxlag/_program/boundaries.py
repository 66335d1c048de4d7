"""Where what a program computes jumps or bends, as functions that pass through zero there: x − y of x > y, or of maximum(x, y)."""

from collections.abc import Callable, Hashable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.extend import source_info_util
from jaxtyping import Array, Float

from .choices import SMOOTH, is_own
from .primitives import ANY_CALL, BENDS, CALLS, CHOOSING, EDGES, JUMPS, MOVEMENTS, ORDER, STEPS
from .walker import called_program, name_in_jax, primitive_names, walk, without_unused

Marks = frozenset[str]
PERIODIC = frozenset(["remainder", "fmod", "floor_divide"])  # of NumPy: they jump at multiples of their second operand
SEARCH = "searchsorted"  # of NumPy, by which a table is looked up
WITH_BODIES = frozenset(["scan", "cond"])


class Boundaries(NamedTuple):
    """The values of what passes through zero; the level of each: one of level 0 is continuous, another jumps where those of lower levels
    pass through zero; and the lines in which the program chooses otherwise, where nothing is known to do so.
    """

    values: Float[Array, " s"]
    levels: tuple[int, ...]
    unknown: tuple[str, ...]


class Value(NamedTuple):
    """A number; the marks of the inputs that it follows between jumps; a key, by which values are computed alike; and its level."""

    number: Any
    marks: Marks
    key: int
    level: int = 0

    def higher(self) -> "Value":
        """As the result of what jumps."""
        return self._replace(level=self.level + 1)


def boundaries(function: Callable, counts: Callable[[Marks, bool], bool], *marked: tuple[Any, str]) -> Boundaries:
    """Those of `function(*arguments)`, each argument with its mark, that depend on inputs whose marks are such that `counts(marks, bends)`,
    where the second says that the function just bends there: each of them once, without those of jaxlag's own code.
    """
    program = without_unused(jax.make_jaxpr(function)(*(argument for argument, _ in marked)))
    reader = _Reader(counts)
    leaves = [(leaf, frozenset((mark,))) for argument, mark in marked for leaf in jax.tree.leaves(argument)]
    inputs = [Value(leaf, marks, reader.key("input", k)) for k, (leaf, marks) in enumerate(leaves)]
    reader.read(program, inputs, None, False)
    values = [jnp.zeros(0, leaves[0][0].dtype), *(jnp.ravel(value) for value, _ in reader.found.values())]
    levels = [level for value, level in reader.found.values() for _ in range(value.size)]
    return Boundaries(jnp.concatenate(values), tuple(levels), tuple(reader.unknown))


class _Reader:
    """Walks through a program with its numbers, and finds what passes through zero."""

    def __init__(self, counts: Callable[[Marks, bool], bool]):
        self.counts = counts
        self.found: dict[Hashable, tuple[Any, int]] = {}
        self.unknown: dict[str, None] = {}
        self._keys: dict[Hashable, int] = {}
        self._differences: dict[int, tuple[int, int]] = {}  # by the key of x − y, those of x and y
        self._zeros: set[int] = set()  # keys of the number 0

    def key(self, *of: Hashable) -> int:
        """The number of what is made of these."""
        return self._keys.setdefault(of, len(self._keys))

    def read(self, program: Any, inputs: Iterable[Value], within: str | None, quiet: bool) -> list[Value]:
        """The outputs; nothing is looked for in a call that is `quiet`."""
        evaluate = lambda equation, operands: self._evaluated(equation, operands, within, quiet)
        return walk(program, inputs, evaluate, self._constant, self._literal)

    def _constant(self, value: Any) -> Value:
        return Value(value, frozenset(), self.key("constant", id(value)))

    def _literal(self, atom: Any) -> Value:
        key = self.key("literal", str(atom.aval), repr(atom.val))
        if atom.val == 0:
            self._zeros.add(key)
        return Value(jnp.asarray(atom.val, atom.aval.dtype), frozenset(), key)

    def _evaluated(self, equation: Any, operands: list[Value], within: str | None, quiet: bool) -> list[Value]:
        line = within or source_info_util.summarize(equation.source_info)
        if equation.primitive.name in ANY_CALL:
            return self._called(equation, operands, line, quiet)
        values = self._bound(equation, operands)
        if self.counts(_all(operands), equation.primitive.name in BENDS):
            if not (quiet or is_own(line)):
                self._look(equation, operands, line)
            if equation.primitive.name in JUMPS or not _is_real(values[0].number):
                values = [value.higher() for value in values]
        return values

    def _called(self, equation, operands, line, quiet):
        """What a call returns, with the derivative rule that it may have."""
        program, called = called_program(equation), name_in_jax(equation)
        given = operands[len(operands) - len(program.jaxpr.invars) :]
        is_periodic = called in PERIODIC and len(given) == 2 and "rem" in primitive_names(program)  # no linear part of it
        jumps = (is_periodic or called == SEARCH) and self.counts(_all(given), False)
        if jumps and not (quiet or is_own(line)):
            if called == SEARCH:
                self._look_in_table(*given, self._bound(equation, operands)[0])
            else:
                self._add("multiples", lambda x, y: jnp.sin(jnp.pi * x / y), *given)
        outputs = self.read(program, given, line, quiet or jumps or called in SMOOTH)
        if jumps:
            outputs = [output._replace(level=1 + max(operand.level for operand in given)) for output in outputs]
        if equation.primitive.name not in CALLS:
            levels = [output.level for output in outputs]
            outputs = [value._replace(level=level) for value, level in zip(self._bound(equation, operands), levels, strict=True)]
        return outputs

    def _bound(self, equation, operands):
        """What an equation computes."""
        primitive, params, keys = equation.primitive, equation.params, [operand.key for operand in operands]
        found = primitive.bind(*(operand.number for operand in operands), **primitive.get_bind_params(params))
        numbers = found if primitive.multiple_results else [found]
        try:
            alike = self.key(primitive.name, tuple(sorted(params.items(), key=lambda item: item[0])), *keys)
        except TypeError:  # of parameters that cannot be compared
            alike = self.key("equation", id(equation), len(self._keys))
        marks = frozenset() if primitive.name in STEPS or not all(map(_is_real, numbers)) else _all(operands)
        level = max((operand.level for operand in operands), default=0)
        values = [Value(number, marks, self.key(alike, k), level) for k, number in enumerate(numbers)]
        if primitive.name == "sub":
            self._differences[values[0].key] = keys[0], keys[1]
        if primitive.name in MOVEMENTS | {"convert_element_type"} and keys[0] in self._zeros:
            self._zeros.add(values[0].key)
        return values

    def _look(self, equation, operands, line):
        """What passes through zero where this equation chooses."""
        name, numbers = equation.primitive.name, [operand.number for operand in operands]
        kind = EDGES.get(name)
        if name == "convert_element_type" and not _is_real(equation.outvars[0].aval):
            kind = "at_integers"
        if not all(map(_is_real, numbers)):
            kind = None
        if kind == "at_zero":
            self._add_difference(operands[0], None)
        elif kind == "at_equality":
            self._add_difference(*operands)
        elif kind == "at_bounds":
            least, x, most = operands
            self._add_difference(x, least)
            self._add_difference(x, most)
        elif kind == "at_integers":
            self._add(kind, lambda x: jnp.sin(jnp.pi * x), *operands)
        elif kind == "at_halves":
            self._add(kind, lambda x: jnp.cos(jnp.pi * x), *operands)
        elif kind == "at_multiples":
            self._add("multiples", lambda x, y: jnp.sin(jnp.pi * x / y), *operands)
        elif name in CHOOSING or (name in WITH_BODIES and not (CHOOSING | ORDER.keys()).isdisjoint(primitive_names([equation]))):
            self.unknown[line] = None

    def _add(self, kind, function, *operands):
        key = kind, *(operand.key for operand in operands)
        if key not in self.found:
            number = function(*(operand.number for operand in operands))
            self.found[key] = number, max(operand.level for operand in operands)

    def _add_difference(self, x, y):
        """x − y, or x where y is none or zero: also that of a difference that is compared with zero."""
        if y is not None and x.key in self._zeros:
            x, y = y, None
        is_zero = y is None or y.key in self._zeros
        of = self._differences.get(x.key, (x.key,)) if is_zero else (x.key, y.key)
        key = "difference", frozenset(of)
        if key not in self.found:
            self.found[key] = (x.number, x.level) if is_zero else (x.number - y.number, max(x.level, y.level))

    def _look_in_table(self, places, x, index):
        """A function that changes its sign at each place of a table: between two of them, a parabola."""

        def alternating(places, x, index):
            places = jnp.asarray(places)
            before, behind = places[jnp.maximum(index - 1, 0)], places[jnp.minimum(index, places.size - 1)]
            inside, width = (index > 0) & (index < places.size), jnp.where(behind > before, behind - before, 1)
            size = jnp.where(inside, (x - before) * (behind - x) / width, jnp.where(index > 0, x - before, behind - x))
            return jnp.where(index % 2 == 1, -size, size)

        self._add("table", alternating, places, x, index)


def _is_real(x: Any) -> bool:
    return jnp.issubdtype(x.dtype, jnp.inexact)


def _all(values: Iterable[Value]) -> Marks:
    return frozenset().union(*(value.marks for value in values))
