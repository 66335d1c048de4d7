"""Where the sign of a zero matters: what is divided by it is infinite with that sign, and an angle π or −π."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.extend import core

from .primitives import ANY_CALL, SIGN_OF_ZERO, STRICT, ZERO_UNSIGNED
from .walker import called_program, name_in_jax, programs_within


def equations_with_signed_zeros(program: Any) -> frozenset[int]:
    """The equations of a program, by their `id`, of whose results the sign of a zero may matter within the program."""
    found: set[int] = set()
    _operands_of_program(program, [], found)
    return frozenset(found)


def _operands_of_program(program: Any, results: Sequence[bool], found: set[int]) -> list[bool]:
    """For each argument whether the sign of a zero matters, given the results of which it does; the equations are added to `found`."""
    jaxpr = getattr(program, "jaxpr", program)
    signed = {x for x, matters in zip(jaxpr.outvars, results, strict=False) if matters and not isinstance(x, core.Literal)}
    compared = {e.outvars[0]: e.invars for e in jaxpr.eqns if e.primitive.name in STRICT}
    for equation in reversed(jaxpr.eqns):
        matters = [x in signed for x in equation.outvars]
        if any(matters):
            found.add(id(equation))
        of, guarded = zip(equation.invars, _operands(equation, matters, found), strict=True), _chosen_where_not_zero(equation, compared)
        signed |= {x for x, sign in of if sign and _has_zeros(x) and x is not guarded}
    return [x in signed for x in jaxpr.invars]


def _has_zeros(x: Any) -> bool:
    """Whether it is a variable of real or complex numbers."""
    return not isinstance(x, core.Literal) and getattr(x.aval, "size", 0) > 0 and jnp.issubdtype(x.aval.dtype, jnp.inexact)


def _chosen_where_not_zero(equation: Any, compared: dict) -> Any:
    """x of a choice like `where(x > 0, x, 1)`; None of other equations."""
    if equation.primitive.name == "select_n":
        which, *_, x = equation.invars
    elif equation.primitive.name in ANY_CALL and name_in_jax(equation) == "where" and len(equation.invars) == 3:  # NumPy's
        which, x, _ = equation.invars
    else:
        return None
    operands = () if isinstance(which, core.Literal) else compared.get(which, ())
    is_zero = [isinstance(y, core.Literal) and np.all(y.val == 0) for y in operands]
    return x if any(is_zero) and any(y is x for y in operands) else None


def _operands(equation: Any, matters: list[bool], found: set[int]) -> list[bool]:
    """The same for one equation."""
    name, count = equation.primitive.name, len(equation.invars)
    if name in ANY_CALL:
        return _operands_of_program(called_program(equation), matters, found)
    within = programs_within(equation)
    if within:  # of loops and choices the results are arguments again
        if any(matters) or any(any(_operands_of_program(program, [], found)) for program in within):
            for program in within:
                _operands_of_program(program, [True] * len(getattr(program, "jaxpr", program).outvars), found)
            return [True] * count
        return [False] * count
    power = equation.params.get("y", 1) if name == "integer_pow" else 1
    if name in ZERO_UNSIGNED or power % 2 == 0 or (name == "mul" and equation.invars[0] is equation.invars[1]):
        return [False] * count
    return [any(matters) or k in SIGN_OF_ZERO.get(name, ()) or power < 0 for k in range(count)]
