"""Where a program chooses by the value of an input, so that what it computes jumps or bends: where, max, |x|, floor, a table."""

import pathlib
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.extend import source_info_util

from .primitives import ANY_CALL, CALLS, CHOOSING, EQUALITIES, LOOKUPS, NAMES_IN_NUMPY
from .walker import called_name, called_program, columns_of_branches, name_in_jax, parts_of_scan, walk

PACKAGE = pathlib.Path(__file__).parents[1]
OWN, LENT = str(PACKAGE), (str(PACKAGE / "elements.py"), str(PACKAGE / "examples"))  # and what stands for code of the user's
SMOOTH = frozenset(["hypot", "logaddexp", "logaddexp2", "sinc", "softplus"])  # though they choose inside
Marks = frozenset[str]


class Choice(NamedTuple):
    """What chooses, the line of the user's code, and the marks of the inputs that decide."""

    what: str
    line: str
    by: Marks


class Value(NamedTuple):
    """The marks of the inputs that a value depends on, and the choices behind it."""

    marks: Marks = frozenset()
    choices: frozenset[Choice] = frozenset()

    @classmethod
    def of(cls, values: Iterable["Value"]) -> "Value":
        """One that depends on all of these."""
        values = list(values)
        return cls(frozenset().union(*(value.marks for value in values)), frozenset().union(*(value.choices for value in values)))


class _Call(NamedTuple):
    """What the user calls, and in which line."""

    what: str | None
    line: str


def choices(function: Callable, *marked: tuple[Any, str]) -> list[Choice]:
    """The choices of `function(*arguments)`, each argument with its mark; those of jaxlag's own code are left out."""
    program = jax.make_jaxpr(function)(*(argument for argument, _ in marked))
    inputs = [Value(frozenset((mark,))) for argument, mark in marked for _ in jax.tree.leaves(argument)]
    found: dict[tuple[str, str], Marks] = {}
    for what, line, by in Value.of(_walked(program, inputs, None)).choices:
        if not is_own(line):
            found[what, line] = found.get((what, line), frozenset()) | by
    return sorted(Choice(*of, by) for of, by in found.items())


def is_own(line: str) -> bool:
    """Whether a line is of jaxlag's own code, which chooses, but neither jumps nor bends."""
    return OWN in line and not any(file in line for file in LENT)


def _walked(program: Any, inputs: Iterable[Value], within: _Call | None) -> list[Value]:
    """The outputs; what chooses within a program that is called is the call."""
    return walk(program, inputs, lambda equation, operands: _evaluated(equation, operands, within), lambda _: Value())


def _evaluated(equation: Any, operands: list[Value], within: _Call | None) -> Sequence[Value]:
    name, params, found = equation.primitive.name, equation.params, Value.of(operands)
    here = within or _Call(None, source_info_util.summarize(equation.source_info))

    def chosen(what: str, by: Marks) -> Value:
        return found._replace(choices=found.choices | {Choice(here.what or what, here.line, by)}) if by else found

    if name in ANY_CALL:
        program = called_program(equation)
        called = called_name(equation).strip("_<>")
        inner = _Call(here.what or (called if called != "lambda" else None), here.line)
        given = operands[len(operands) - len(program.jaxpr.invars) :]
        if name_in_jax(equation) in SMOOTH:
            return [found] * len(equation.outvars)
        outputs = _walked(program, given, inner)
        return outputs if name in CALLS else [value._replace(marks=value.marks | found.marks) for value in outputs]  # a rule may see more
    if name == "cond":
        columns = columns_of_branches(params, operands[1:], lambda branch, given: _walked(branch, given, here))
        return [Value.of((chosen("cond", operands[0].marks), *of)) for of in columns]
    if name == "scan":
        return _scanned(params, operands, here)
    if name in EQUALITIES:  # what is smooth is guarded by them
        found = Value()
    elif name == "stop_gradient":
        found = found._replace(choices=frozenset())
    elif name == "select_n":
        found = chosen("where", operands[0].marks)
    elif name in LOOKUPS:
        found = chosen("a table", Value.of(operands[1:]).marks)
    elif name == "convert_element_type" and _counts(equation.outvars[0]) and not _counts(equation.invars[0]):
        found = chosen("a conversion to integers", found.marks)
    elif name in CHOOSING:
        found = chosen(NAMES_IN_NUMPY.get(name, name), found.marks)
    return [found] * len(equation.outvars)


def _scanned(params: dict, operands: list[Value], within: _Call) -> list[Value]:
    """Turns until no carry depends on more."""
    i, j = parts_of_scan(params)
    carry = list(operands[i:j])
    while True:
        outputs = _walked(params["jaxpr"], [*operands[:i], *carry, *operands[j:]], within)
        more = [Value.of(pair) for pair in zip(carry, outputs, strict=False)]
        if more == carry:
            return [*carry, *outputs[j - i :]]
        carry = more


def _counts(atom: Any) -> bool:
    return jnp.issubdtype(atom.aval.dtype, jnp.integer) or atom.aval.dtype == bool
