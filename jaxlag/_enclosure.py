"""What a program makes of the time alone, and bounds of that over whole intervals of time, in which nothing can hide.

Interval arithmetic on a jaxpr. What it cannot bound lies anywhere between −∞ and ∞.
Source: Moore, Kearfott & Cloud, Introduction to Interval Analysis (2009), chapters 2 and 5.
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

from ._entries import is_extended, on_arrays
from ._primitives import CALLS, body

Interval = tuple[Any, Any]  # the least and the largest value, of arrays entry by entry


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
    name = equation.primitive.name
    if all(low is high for low, high in operands):
        return [(x, x) for x in on_arrays(equation)(*(low for low, _ in operands))]
    if name in PROGRAMS:
        return _through(body(equation), operands)
    if not _is_known(equation):
        return [_anything(variable.aval) for variable in equation.outvars]
    if name in RULES:
        found = [RULES[name](equation.params, *operands)]
    else:
        ends = [on_arrays(equation)(*end) for end in zip(*operands, strict=True)]
        found = list(zip(*(reversed(ends) if name in FALLING else ends), strict=True))
    return [_without_nan(*interval) for interval in found]


def _through(closed, operands):
    """The outputs of a whole program over intervals."""
    jaxpr, exact = closed.jaxpr, lambda x: (x, x)
    found = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*map(exact, closed.consts), *operands), strict=True))
    read = lambda atom: exact(np.asarray(atom.val, atom.aval.dtype)) if isinstance(atom, Literal) else found[atom]
    for equation in jaxpr.eqns:
        found |= dict(zip(equation.outvars, _enclosed(equation, [read(atom) for atom in equation.invars]), strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _is_known(equation) -> bool:
    """Whether bounds of its outputs are any good."""
    if equation.primitive.name in PROGRAMS:
        return all(map(_is_known, body(equation).jaxpr.eqns))
    if any(is_extended(x) or jnp.issubdtype(x.aval.dtype, jnp.complexfloating) for x in (*equation.invars, *equation.outvars)):
        return False
    if equation.primitive.name in LOGICAL:
        return equation.outvars[0].aval.dtype == bool
    return equation.primitive.name in RISING | FALLING | RULES.keys()


def _anything(aval) -> Interval:
    if aval.dtype == bool:
        return jnp.zeros(aval.shape, bool), jnp.ones(aval.shape, bool)
    least, most = (-np.inf, np.inf) if jnp.issubdtype(aval.dtype, jnp.inexact) else (jnp.iinfo(aval.dtype).min, jnp.iinfo(aval.dtype).max)
    return jnp.full(aval.shape, least, aval.dtype), jnp.full(aval.shape, most, aval.dtype)


def _without_nan(low, high) -> Interval:
    """Where an operation has no value at an end of the interval, or ∞ − ∞, it may be anything."""
    if not jnp.issubdtype(jnp.result_type(low), jnp.floating):
        return low, high
    fine = ~(jnp.isnan(low) | jnp.isnan(high))
    return jnp.where(fine, low, -jnp.inf), jnp.where(fine, high, jnp.inf)


def _hull(*values) -> Interval:
    return functools.reduce(jnp.minimum, values), functools.reduce(jnp.maximum, values)


def _product(_, x, y):
    if x is y:  # a square, as which a product may be written
        return _even(jnp.square, x)
    return _hull(*(jnp.where((a == 0) | (b == 0), 0, a * b) for a in x for b in y))


def _quotient(_, x, y):
    if not jnp.issubdtype(jnp.result_type(*x), jnp.floating):
        return tuple(jnp.full_like(x[0], end) for end in (jnp.iinfo(x[0].dtype).min, jnp.iinfo(x[0].dtype).max))
    through_zero = (y[0] <= 0) & (y[1] >= 0)
    low, high = _hull(*(a / b for a in x for b in y))
    return jnp.where(through_zero, -jnp.inf, low), jnp.where(through_zero, jnp.inf, high)


def _even(power, x):
    """A power that is least at zero."""
    ends = power(x[0]), power(x[1])
    return jnp.where((x[0] <= 0) & (x[1] >= 0), 0, jnp.minimum(*ends)), jnp.maximum(*ends)


def _integer_power(params, x):
    n = params["y"]
    if n < 0:
        one = jnp.ones_like(x[0])
        return _quotient(None, (one, one), _integer_power({"y": -n}, x))
    power = lambda x: x**n
    return _even(power, x) if n % 2 == 0 else (power(x[0]), power(x[1]))


def _power(_, x, y):
    """xʸ of a base that is nowhere negative; of others anything, for not even its sign is known."""
    low, high = _hull(*(a**b for a in x for b in y))
    return jnp.where(x[0] >= 0, low, jnp.nan), high


def _cosine(x):
    """Between its values at the ends, unless a multiple of π lies between them."""
    crest = jnp.floor(x[1] / (2 * jnp.pi)) >= jnp.ceil(x[0] / (2 * jnp.pi))
    trough = jnp.floor(x[1] / (2 * jnp.pi) - 0.5) >= jnp.ceil(x[0] / (2 * jnp.pi) - 0.5)
    low, high = _hull(jnp.cos(x[0]), jnp.cos(x[1]))
    return jnp.where(trough, -1, low), jnp.where(crest, 1, high)


def _tangent(_, x):
    within = jnp.floor(x[0] / jnp.pi + 0.5) == jnp.floor(x[1] / jnp.pi + 0.5)
    return jnp.where(within, jnp.tan(x[0]), -jnp.inf), jnp.where(within, jnp.tan(x[1]), jnp.inf)


def _remainder(_, x, y):
    size = jnp.maximum(jnp.abs(y[0]), jnp.abs(y[1]))
    turn = lambda a: jnp.trunc(a / y[0])
    within = (y[0] == y[1]) & (turn(x[0]) == turn(x[1])) & (jnp.sign(x[0]) == jnp.sign(x[1]))
    return jnp.where(within, x[0] % y[0], jnp.where(x[0] < 0, -size, 0)), jnp.where(within, x[1] % y[0], jnp.where(x[1] > 0, size, 0))


def _equal(x, y):
    if x is y:
        return _hull(jnp.ones_like(x[0], bool))
    return (x[0] == x[1]) & (y[0] == y[1]) & (x[0] == y[0]), (x[0] <= y[1]) & (y[0] <= x[1])


def _chosen(_, which, *cases):
    low, high = functools.reduce(jnp.minimum, [x for x, _ in cases]), functools.reduce(jnp.maximum, [x for _, x in cases])
    known = which[0] == which[1]
    one = [jax.lax.select_n(jnp.broadcast_to(which[0], jnp.shape(low)), *(x[end] for x in cases)) for end in (0, 1)]
    return jnp.where(known, one[0], low), jnp.where(known, one[1], high)


def _contracted(params, x, y):
    """A product of matrices, by centres and radii."""
    product = functools.partial(
        jax.lax.dot_general, **{key: params[key] for key in ("dimension_numbers", "precision", "preferred_element_type")}
    )
    (cx, rx), (cy, ry) = (((low + high) / 2, (high - low) / 2) for low, high in (x, y))
    centre, radius = product(cx, cy), product(jnp.abs(cx), ry) + product(rx, jnp.abs(cy)) + product(rx, ry)
    return centre - radius, centre + radius


RULES: dict[str, Callable[..., Interval]] = {
    "sub": lambda _, x, y: (x[0] - y[1], x[1] - y[0]) if x is not y else _hull(jnp.zeros_like(x[0])),
    "mul": _product,
    "div": _quotient,
    "abs": lambda _, x: _even(jnp.abs, x),
    "square": lambda _, x: _even(jnp.square, x),
    "integer_pow": _integer_power,
    "pow": _power,
    "cos": lambda _, x: _cosine(x),
    "sin": lambda _, x: _cosine((x[0] - jnp.pi / 2, x[1] - jnp.pi / 2)),
    "cosh": lambda _, x: tuple(1 + end for end in _even(lambda x: jnp.cosh(x) - 1, x)),
    "tan": _tangent,
    "rem": _remainder,
    "select_n": _chosen,
    "dot_general": _contracted,
    "lt": lambda _, x, y: (x[1] < y[0], x[0] < y[1]),
    "le": lambda _, x, y: (x[1] <= y[0], x[0] <= y[1]),
    "gt": lambda _, x, y: (x[0] > y[1], x[1] > y[0]),
    "ge": lambda _, x, y: (x[0] >= y[1], x[1] >= y[0]),
    "eq": lambda _, x, y: _equal(x, y),
    "ne": lambda _, x, y: tuple(~end for end in reversed(_equal(x, y))),
}  # fmt: skip
MOVING = {
    "reshape", "squeeze", "expand_dims", "broadcast_in_dim", "transpose", "rev", "slice", "split", "pad", "concatenate", "stack",
    "unstack", "tile", "copy", "convert_element_type", "stop_gradient", "reduce_sum", "reduce_max", "reduce_min", "reduce_and",
    "reduce_or", "cumsum", "cummax", "cummin", "optimization_barrier",
}  # fmt: skip
RISING = MOVING | {
    "add", "add_any", "max", "min", "clamp", "exp", "exp2", "expm1", "log", "log1p", "sqrt", "cbrt", "sinh", "tanh", "asinh", "acosh",
    "atanh", "asin", "atan", "erf", "logistic", "floor", "ceil", "round", "sign", "and", "or", "is_finite",
}  # fmt: skip
FALLING = {"neg", "rsqrt", "acos", "erfc", "not"}
LOGICAL = {"and", "or", "not", "reduce_and", "reduce_or"}  # of other integers they are neither rising nor falling
PROGRAMS = {*CALLS, "custom_jvp_call", "custom_vjp_call"}
