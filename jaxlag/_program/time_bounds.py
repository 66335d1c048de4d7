"""What a program makes of the time alone, and bounds of that over whole intervals of time, in which nothing can hide.

Interval arithmetic on a jaxpr.
"""

import functools
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal
from jaxtyping import Array

from .interpreter import is_extended, on_arrays
from .interval_arithmetic import ARITHMETIC, FALLING, LOGICAL, RISING, RULES, Interval, anything, in_integers, without_nan
from .rules import CALLS, body


class OfTime(NamedTuple):
    """How a program f(t, y) depends on t beside y: f(t, y) = rest(φ(t), y)."""

    phi: Callable[..., list[Array]]
    bounds: Callable[..., list[Interval]]  # of φ from one time to another
    rest: Callable[..., Any]
    is_bounded: bool  # whether all that leads to φ is known here


def of_time(function: Callable, t: Array, y: Array) -> OfTime | None:
    """Reads `function(t, y)`, an array; None where t has no part in it."""
    closed = jax.make_jaxpr(function)(t, y)
    steps, constants, (output,) = _flattened(closed)

    def reached(start):
        found = {start}
        for step in steps:
            if found.intersection(step.operands):
                found.update(step.results)
        return found

    by_t, by_y = reached(T), reached(Y)
    early = [step for step in steps if not by_y.intersection(step.results)]
    late = [step for step in steps if by_y.intersection(step.results)]
    used = [output, *(x for step in late for x in step.operands)]
    frontier = list(dict.fromkeys(x for x in used if x in by_t and x not in by_y))
    if not frontier:
        return None

    def phi(t):
        found = _run(early, constants | {T: t})
        return [found[x] for x in frontier]

    def bounds(start, end):
        found = {x: (value, value) for x, value in constants.items()} | {T: (start, end)}
        for step in early:
            found |= dict(zip(step.results, _enclosed(step.equation, [found[x] for x in step.operands]), strict=True))
        return [found[x] for x in frontier]

    def rest(phi, y):
        always = [step for step in early if not by_t.intersection(step.results)]
        return _run([*always, *late], constants | {Y: y} | dict(zip(frontier, phi, strict=True)))[output]

    return OfTime(phi, bounds, rest, all(_is_known(step.equation) for step in early if by_t.intersection(step.results)))


TURNS = 100  # of a loop that is followed; a search in a table takes twenty for a million entries
T, Y = 0, 1  # the numbers of the arguments among all quantities


class _Step(NamedTuple):
    """One equation over quantities by their numbers."""

    equation: Any
    operands: list[int]
    results: list[int]


def _flattened(closed) -> tuple[list[_Step], dict[int, Any], list[int]]:
    """The equations of a program with those of the programs it calls in their places, each once; its constants, and the outputs."""
    numbers, constants = itertools.count(2), {}
    steps: list[_Step] = []
    made: dict[Any, Any] = {}

    def once(key, make):
        try:
            return made[key] if key in made else made.setdefault(key, make())
        except TypeError:  # parameters that cannot be compared
            return make()

    def constant(value):
        small = isinstance(value, np.ndarray) and value.size < 100
        number = once((value.dtype, value.shape, value.tobytes()) if small else id(value), lambda: next(numbers))
        constants[number] = value
        return number

    def step(equation, operands):
        steps.append(_Step(equation, operands, [next(numbers) for _ in equation.outvars]))
        return steps[-1].results

    def read(jaxpr, places):
        place = lambda atom: constant(np.asarray(atom.val, atom.aval.dtype)) if isinstance(atom, Literal) else places[atom]
        for equation in jaxpr.eqns:
            operands = [place(atom) for atom in equation.invars]
            if equation.primitive.name in CALLS:
                inner = body(equation)
                given = (*map(constant, inner.consts), *operands)
                results = read(inner.jaxpr, dict(zip((*inner.jaxpr.constvars, *inner.jaxpr.invars), given, strict=True)))
            else:
                what = (equation.primitive, tuple(equation.params.items()), tuple(operands))
                results = once(what, lambda equation=equation, operands=operands: step(equation, operands))
            places |= dict(zip(equation.outvars, results, strict=True))
        return [place(atom) for atom in jaxpr.outvars]

    jaxpr = closed.jaxpr
    places = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*map(constant, closed.consts), T, Y), strict=True))
    return steps, constants, read(jaxpr, places)


def _run(steps, found):
    for step in steps:
        found |= dict(zip(step.results, on_arrays(step.equation)(*(found[x] for x in step.operands)), strict=True))
    return found


# Intervals.


def _enclosed(equation, operands: list[Interval]) -> list[Interval]:
    """The outputs of one equation over intervals."""
    name, params = equation.primitive.name, equation.params
    if all(low is high for low, high in operands):
        return [(x, x) for x in on_arrays(equation)(*(low for low, _ in operands))]
    if name in PROGRAMS:
        return _through(body(equation), operands)
    if name in LOOPS and params.get("length", 1) <= TURNS:
        return LOOPS[name](params, operands)
    if name in LOOPS or not _is_known(equation):
        return [anything(variable.aval) for variable in equation.outvars]
    kind = equation.outvars[0].aval.dtype
    if name in ARITHMETIC and jnp.issubdtype(kind, jnp.integer):
        rule = functools.partial(RULES[name], params) if name in RULES else lambda *of: [end for (end,) in _at_ends(equation)(*of)]
        found = [in_integers(kind, rule, operands)]
    elif name in RULES:
        found = [RULES[name](params, *operands)]
    else:
        found = list(zip(*_at_ends(equation)(*operands), strict=True))
    return [without_nan(*interval) for interval in found]


def _at_ends(equation) -> Callable[..., list[Any]]:
    """The outputs, at the least and at the greatest, of an operation that rises, or falls, with all its operands."""

    def ends(*operands):
        made = [equation.primitive.bind(*end, **equation.params) for end in zip(*operands, strict=True)]
        made = made if equation.primitive.multiple_results else [[output] for output in made]
        return made[::-1] if equation.primitive.name in FALLING else made

    return ends


def _through(closed, operands):
    """The outputs of a whole program over intervals."""
    jaxpr, exact = closed.jaxpr, lambda x: (x, x)
    found = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*map(exact, closed.consts), *operands), strict=True))
    read = lambda atom: exact(np.asarray(atom.val, atom.aval.dtype)) if isinstance(atom, Literal) else found[atom]
    for equation in jaxpr.eqns:
        found |= dict(zip(equation.outvars, _enclosed(equation, [read(atom) for atom in equation.invars]), strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _looped(params, operands):
    """A loop over as many turns as there are: the same over intervals."""
    closed, split = params["jaxpr"], np.cumsum([params["num_consts"], params["num_carry"]])
    consts, carry, rows = (operands[i:j] for i, j in itertools.pairwise((0, *split, len(operands))))

    def turn(carry, row):
        outputs = _through(closed, [*consts, *carry, *row])
        return outputs[: len(carry)], outputs[len(carry) :]

    last, made = jax.lax.scan(turn, [tuple(map(jnp.asarray, x)) for x in carry], rows, params["length"], params["reverse"])
    return [*last, *made]


def _branched(params, operands):
    """One of several programs."""
    which, *operands = operands
    cases = [_through(branch, operands) for branch in params["branches"]]
    which = tuple(jnp.clip(end, 0, len(cases) - 1) for end in which)
    return [RULES["select_n"](None, which, *column) for column in zip(*cases, strict=True)]


def _is_known(equation) -> bool:
    """Whether bounds of its outputs are any good."""
    name, params = equation.primitive.name, equation.params
    if name in PROGRAMS:
        return all(map(_is_known, body(equation).jaxpr.eqns))
    if name in LOOPS:
        return params.get("length", 1) <= TURNS and all(
            _is_known(step) for inner in params.get("branches", [params.get("jaxpr")]) for step in inner.jaxpr.eqns
        )
    if any(is_extended(x) or jnp.issubdtype(x.aval.dtype, jnp.complexfloating) for x in (*equation.invars, *equation.outvars)):
        return False
    if name in LOGICAL:
        return equation.outvars[0].aval.dtype == bool
    return name in RISING | FALLING | RULES.keys()


PROGRAMS = {*CALLS, "custom_jvp_call", "custom_vjp_call"}
LOOPS = {"scan": _looped, "cond": _branched}
