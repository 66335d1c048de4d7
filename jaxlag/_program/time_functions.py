"""The functions of time in a program in which a pulse may hide, told from those that go on as they are wherever one looks."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .interval_arithmetic import Interval
from .primitives import ANY_CALL, LINEAR, LINEAR_ALGEBRA, LOOKUPS
from .time_bounds import Step, T, Y, ancestors, bounds_of_steps, dependents, has_bounds, inlined_steps, run_steps

MAX_DEGREE = 4  # of a polynomial that hides nothing: a step is looked at in more places
UNKNOWN, NO_FORM = -1, (None, 0)


class TimeFunctions(NamedTuple):
    """The functions of time alone in a program in which a pulse may hide.

    Of those that have bounds the `values`, one after the other, and the `bounds` from one time to another; and what is `read` of tables,
    which have no bounds of use where a knot is within, with the places there, from one of which to the next is a knot.
    """

    values: Callable[..., Array]
    bounds: Callable[..., Interval]
    read: Callable[..., tuple[Array, Array]]
    are_bounded: bool  # whether there are some with bounds,
    are_read: bool  # and some that are read
    are_known: bool  # whether these are read at such places


def time_functions(function: Callable, t: Array, y: Array) -> TimeFunctions | None:
    """The functions of time in `function(t, y)`, an array; None where there are none in which a pulse may hide.

    None hides in t itself, nor in what comes of it by sine, cosine and polynomials of low degree: these go on as they are everywhere.
    Of what comes by such polynomials of one other function, that one is among these, so that A f(t) is looked at for A = 0, too, where a
    derivative by A needs it. A sum of two is one more. Of what is made of tables, weights and neighbours, only what comes of it in the end.
    """
    steps, constants, (output,) = inlined_steps(jax.make_jaxpr(function)(t, y), ANY_CALL)
    of_t, of_y, needed = dependents(steps, T), dependents(steps, Y), ancestors(steps, [output])
    forms, of_table, are_known = {T: (T, 1)}, set[int](), True
    bounded, lookups, used = list[int](), list[tuple[set[int], list[int]]](), [output]
    for step in (step for step in steps if needed.intersection(step.results)):
        if of_y.intersection(step.results) or not of_t.intersection(step.results):
            used += step.operands
            continue
        form = _polynomial(step, [forms.get(x, NO_FORM) for x in step.operands])
        forms |= {x: form or (x, 1) for x in step.results}
        at = [x for x in step.operands[1:] if x in of_t] if step.equation.primitive.name in LOOKUPS else []
        is_ruled, lookups = has_bounds(step.equation), [*lookups, (set(step.results), at)]
        if form and form[0] == UNKNOWN:
            used += step.operands
        elif at or not is_ruled or of_table.intersection(step.operands):
            of_table.update(step.results)
            are_known &= is_ruled
        elif form is None:
            bounded += [x for x, of in zip(step.results, step.equation.outvars, strict=True) if of.aval.dtype == bool or _is_real(of)]
    read = [x for x in dict.fromkeys(forms[x][0] for x in used if x in of_table) if x in of_table]
    if not bounded + read:
        return None
    entries = _made_of(steps, read)
    places = [x for results, at in lookups if entries.intersection(results) for x in at]
    joined = lambda every, which: jnp.concatenate([jnp.zeros(0, y.dtype), *(jnp.ravel(every[x]).astype(y.dtype) for x in which)])
    to_bounded, to_read = _leading_to(steps, bounded), _leading_to(steps, [*read, *places])

    def bounds(start, end):
        every = bounds_of_steps(to_bounded, constants, [(start, end)])
        low, high = ({x: every[x][k] for x in bounded} for k in (0, 1))
        return joined(low, bounded), joined(high, bounded)

    def read_at(t):
        every = run_steps(to_read, constants | {T: t})
        return joined(every, read), joined(every, places)

    values = lambda t: joined(run_steps(to_bounded, constants | {T: t}), bounded)
    return TimeFunctions(values, bounds, read_at, bool(bounded), bool(read), are_known)


def _leading_to(steps: list[Step], ends: list[int]) -> list[Step]:
    """The steps that these quantities depend on."""
    needed = ancestors(steps, ends)
    return [step for step in steps if needed.intersection(step.results)]


def _made_of(steps: list[Step], ends: list[int]) -> set[int]:
    """The numbers that these are computed from: not where they are looked up, nor what is only compared, as in a search of the place."""
    found = set(ends)
    for step in reversed(steps):
        if found.intersection(step.results):
            given = step.operands[:1] if step.equation.primitive.name in LOOKUPS else step.operands
            found.update(x for x, of in zip(given, step.equation.invars, strict=False) if of.aval.dtype != bool)
    return found


def _polynomial(step: Step, forms: list[tuple[Any, int]]) -> tuple[Any, int] | None:
    """In which quantity the results are a polynomial of low degree, and of which; None where they are not.

    That is unknown where they come of functions without bounds, such as a linear solve, of others, in which any pulse is seen already.
    """
    name, params, degrees = step.equation.primitive.name, step.equation.params, [degree for _, degree in forms]
    bases = {base for base, degree in forms if degree}
    if UNKNOWN in bases or (not has_bounds(step.equation) and (name in LINEAR_ALGEBRA or (T not in bases and _is_of_reals(step)))):
        return UNKNOWN, 1
    own = bases - {T}
    if ((name in LINEAR or name == "convert_element_type") and _is_of_reals(step)) or (name in ("sin", "cos") and not own):
        degree = max(degrees)
    elif name in ("mul", "dot_general") or (name == "div" and not degrees[1]):
        degree = sum(degrees)
    elif name == "square" or (name == "integer_pow" and params["y"] > 0):
        degree = params.get("y", 2) * degrees[0]
    else:
        return None
    return (own.pop() if own else T, degree) if len(own) < 2 and degree <= MAX_DEGREE else None


def _is_of_reals(step):
    return all(map(_is_real, (*step.equation.invars, *step.equation.outvars)))


def _is_real(variable):
    return jnp.issubdtype(variable.aval.dtype, jnp.floating)
