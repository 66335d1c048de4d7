"""The part of a program that depends on time alone, and bounds on it over whole intervals of time, between which no pulse can hide."""

import functools
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .constants import as_function, bound, has_extended_dtype
from .interval_arithmetic import INTERVAL_RULES, Interval, anything, in_integers, without_nan
from .primitives import ANY_CALL, CALLS, DECREASING, INCREASING, LOGICAL, OVERFLOWS
from .walker import called_program, columns_of_branches, parts_of_scan, walk, without_unused


class TimeDependence(NamedTuple):
    """How a program f(t, y) depends on t beside y: f(t, y) = rest(φ(t), y)."""

    phi: Callable[..., list[Array]]
    bounds: Callable[..., list[Interval]]  # of φ from one time to another
    rest: Callable[..., Any]
    is_bounded: bool  # whether there are interval rules for all that leads to φ


def time_dependence(function: Callable, t: Array, y: Array) -> TimeDependence | None:
    """How `function(t, y)`, an array, depends on t; None where it does not."""
    steps, constants, (output,) = inlined_steps(without_unused(jax.make_jaxpr(function)(t, y)))
    of_t, of_y = dependents(steps, T), dependents(steps, Y)
    before_y = [step for step in steps if not of_y.intersection(step.results)]
    with_y = [step for step in steps if of_y.intersection(step.results)]
    used = [output, *(x for step in with_y for x in step.operands)]
    frontier = list(dict.fromkeys(x for x in used if x in of_t and x not in of_y))
    if not frontier:
        return None

    def phi(t):
        found = run_steps(before_y, constants | {T: t})
        return [found[x] for x in frontier]

    def bounds(start, end):
        found = bounds_of_steps(before_y, constants, [(start, end)])
        return [found[x] for x in frontier]

    def rest(phi, y):
        always = [step for step in before_y if not of_t.intersection(step.results)]
        return run_steps([*always, *with_y], constants | {Y: y} | dict(zip(frontier, phi, strict=True)))[output]

    return TimeDependence(phi, bounds, rest, all(has_bounds(step.equation) for step in before_y if of_t.intersection(step.results)))


def bounds_over_boxes(function: Callable, *arguments: Array) -> Callable[..., Interval] | None:
    """Bounds of an array `function(*arguments)` from an interval for each argument; None where part of it has none."""
    steps, constants, (output,) = inlined_steps(without_unused(jax.make_jaxpr(function)(*arguments)))
    depending = set().union(*(dependents(steps, x) for x in range(len(arguments))))
    if not all(has_bounds(step.equation) for step in steps if depending.intersection(step.results)):
        return None
    return lambda *intervals: bounds_of_steps(steps, constants, intervals)[output]


MAX_ITERATIONS = 100  # of a loop that is bounded; a search in a table takes twenty for a million elements
T, Y = 0, 1  # the numbers of the arguments among all quantities


class Step(NamedTuple):
    """One equation over quantities by their numbers."""

    equation: Any
    operands: list[int]
    results: list[int]


def inlined_steps(closed, calls=CALLS) -> tuple[list[Step], dict[int, Any], list[int]]:
    """The equations of a program with calls inlined, equal ones once; its constants, and the numbers of its outputs."""
    arguments = len(closed.jaxpr.invars)
    numbers, constants = itertools.count(arguments), {}
    steps: list[Step] = []
    cache: dict[Any, Any] = {}

    def cached(key, make):
        try:
            return cache[key] if key in cache else cache.setdefault(key, make())
        except TypeError:  # parameters that cannot be compared
            return make()

    def constant(value):
        small = isinstance(value, np.ndarray) and value.size < 100
        number = cached((value.dtype, value.shape, value.tobytes()) if small else id(value), lambda: next(numbers))
        constants[number] = value
        return number

    def step(equation, operands):
        steps.append(Step(equation, operands, [next(numbers) for _ in equation.outvars]))
        return steps[-1].results

    def evaluate(equation, operands):
        return cached((equation.primitive, tuple(equation.params.items()), tuple(operands)), lambda: step(equation, operands))

    return steps, constants, walk(closed, tuple(range(arguments)), evaluate, constant, opened=calls)


def dependents(steps: list[Step], start: int) -> set[int]:
    """A quantity and all that depend on it."""
    found = {start}
    for step in steps:
        if found.intersection(step.operands):
            found.update(step.results)
    return found


def ancestors(steps: list[Step], ends: list[int]) -> set[int]:
    """Some quantities and all that they depend on."""
    found = set(ends)
    for step in reversed(steps):
        if found.intersection(step.results):
            found.update(step.operands)
    return found


def bounds_of_steps(steps, constants, intervals):
    """The intervals of all quantities, from those of the first arguments."""
    found = {x: (value, value) for x, value in constants.items()} | dict(enumerate(intervals))
    for step in steps:
        found |= dict(zip(step.results, _evaluate_intervals(step.equation, [found[x] for x in step.operands]), strict=True))
    return found


def run_steps(steps, found):
    for step in steps:
        found |= dict(zip(step.results, as_function(step.equation)(*(found[x] for x in step.operands)), strict=True))
    return found


# Intervals.


def _evaluate_intervals(equation, operands: list[Interval]) -> list[Interval]:
    """The outputs of one equation over intervals."""
    name, params = equation.primitive.name, equation.params
    if all(low is high for low, high in operands):
        return [(x, x) for x in as_function(equation)(*(low for low, _ in operands))]
    if name in ANY_CALL:
        return _run_intervals(called_program(equation), operands)
    if name in LOOPS_AND_BRANCHES and params.get("length", 1) <= MAX_ITERATIONS:
        return LOOPS_AND_BRANCHES[name](params, operands)
    if name in LOOPS_AND_BRANCHES or not has_bounds(equation):
        return [anything(variable.aval) for variable in equation.outvars]
    kind = equation.outvars[0].aval.dtype
    if name in OVERFLOWS and jnp.issubdtype(kind, jnp.integer):
        rule = (
            functools.partial(INTERVAL_RULES[name], params)
            if name in INTERVAL_RULES
            else lambda *of: [end for (end,) in _at_ends(equation)(*of)]
        )
        found = [in_integers(kind, rule, operands)]
    elif name in INTERVAL_RULES:
        found = [INTERVAL_RULES[name](params, *operands)]
    else:
        found = list(zip(*_at_ends(equation)(*operands), strict=True))
    return [without_nan(*interval) for interval in found]


def _at_ends(equation) -> Callable[..., list[Any]]:
    """The outputs at both ends of an operation that increases, or decreases, with all its operands."""

    def ends(*operands):
        made = [bound(equation, *end) for end in zip(*operands, strict=True)]
        return made[::-1] if equation.primitive.name in DECREASING else made

    return ends


def _run_intervals(closed, operands):
    """The outputs of a whole program over intervals."""
    return walk(closed, operands, _evaluate_intervals, lambda x: (x, x))


def _scan(params, operands):
    """A `scan` over intervals is a `scan` as well, of as many iterations."""
    closed, (i, j) = params["jaxpr"], parts_of_scan(params)
    consts, carry, rows = operands[:i], operands[i:j], operands[j:]

    def iteration(carry, row):
        outputs = _run_intervals(closed, [*consts, *carry, *row])
        return outputs[: len(carry)], outputs[len(carry) :]

    last, stacked = jax.lax.scan(iteration, [tuple(map(jnp.asarray, x)) for x in carry], rows, params["length"], params["reverse"])
    return [*last, *stacked]


def _cond(params, operands):
    """One of several branches."""
    which, *operands = operands
    which = tuple(jnp.clip(end, 0, len(params["branches"]) - 1) for end in which)
    return [INTERVAL_RULES["select_n"](None, which, *column) for column in columns_of_branches(params, operands, _run_intervals)]


def has_bounds(equation) -> bool:
    """Whether there are useful bounds on its outputs."""
    name, params = equation.primitive.name, equation.params
    if name in ANY_CALL:
        return all(map(has_bounds, called_program(equation).jaxpr.eqns))
    if name in LOOPS_AND_BRANCHES:
        return params.get("length", 1) <= MAX_ITERATIONS and all(
            has_bounds(step) for inner in params.get("branches", [params.get("jaxpr")]) for step in inner.jaxpr.eqns
        )
    if any(has_extended_dtype(x) or jnp.issubdtype(x.aval.dtype, jnp.complexfloating) for x in (*equation.invars, *equation.outvars)):
        return False
    if name in LOGICAL:
        return equation.outvars[0].aval.dtype == bool
    return name in INCREASING | DECREASING | INTERVAL_RULES.keys()


LOOPS_AND_BRANCHES = {"scan": _scan, "cond": _cond}
