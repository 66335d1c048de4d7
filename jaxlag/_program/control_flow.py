"""Rules of calls, functions with derivative rules of their own, branches and loops."""

import jax
import numpy as np

from .rules import promoted, rule
from .walker import CALLS, CALLS_WITH_DERIVATIVE_RULE, branch_index, called_program, unrolled_scan


@rule(*CALLS)
def _call(interpreter, equation, *operands):
    shortcut = interpreter.algebra.shortcut(equation)
    if shortcut is not None and any(x.dtype == object for x in operands):
        return interpreter.block(shortcut, operands, equation.outvars)
    return interpreter.run(called_program(equation), operands)


@rule(*CALLS_WITH_DERIVATIVE_RULE)
def _call_with_derivative_rule(interpreter, equation, *operands):
    """Taken apart, unless the algebra differentiates nodes: then it stays in one piece, with its rule."""
    results, known = _call(interpreter, equation, *operands), all(x.dtype != object for x in operands)
    return results if known or interpreter.algebra.block(equation) is None else NotImplemented


@rule("platform_index")
def _platform_index(interpreter, equation):
    fits = [names is None or jax.default_backend() in names for names in equation.params["platforms"]]
    return np.asarray(fits.index(True), np.int32)


@rule("cond")
def _cond(interpreter, equation, index, *operands):
    if index.dtype == object:
        return NotImplemented
    return interpreter.run(equation.params["branches"][branch_index(index, equation.params)], operands)


@rule("while")
def _while(interpreter, equation, *operands):
    p = equation.params
    i, j = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]
    condition, consts, state = operands[:i], operands[i:j], list(operands[j:])
    while (goes_on := interpreter.run(p["cond_jaxpr"], [*condition, *state])[0]).dtype != object and goes_on.ndim == 0:
        if not goes_on:
            return state
        state = interpreter.run(p["body_jaxpr"], [*consts, *state])
    return NotImplemented


@rule("scan")
def _scan(interpreter, equation, *operands):
    p = equation.params
    if not p["length"]:
        return NotImplemented
    row = lambda x, k: np.asarray(x[k], x.dtype)
    carry, columns = unrolled_scan(p, operands, lambda inputs: interpreter.run(p["jaxpr"], inputs), row)
    return [*carry, *(np.stack(promoted(*column)) for column in columns)]
