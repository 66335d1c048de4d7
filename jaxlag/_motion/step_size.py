"""Step size control that ends by a reason where numbers are not finite, and resumes behind jumps of an input."""

import dataclasses
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp

from .results import RESULTS, under_diffrax


class GuardedController(dfx.PIDController):
    """Steps that shrink where they meet numbers that are not finite, and end there as `undefined`."""

    def init(self, terms, t0, t1, *rest):
        tnext, state = super().init(terms, t0, t1, *rest)
        return jnp.where(jnp.isfinite(tnext), tnext, t1), state

    def adapt_step_size(self, t0, t1, y0, y1, args, error, *rest):
        finite = jnp.all(jnp.isfinite(y1)) & ~jnp.any(jnp.isnan(error))  # an infinite error is a step that was refused
        *step, result = super().adapt_step_size(t0, t1, y0, jnp.where(finite, y1, y0), args, jnp.where(finite, error, jnp.inf), *rest)
        lost = (result == dfx.RESULTS.dt_min_reached) & ~finite
        return *step, dfx.RESULTS.where(lost, under_diffrax(RESULTS.undefined), result)


class ResumingController(GuardedController):
    """Steps that resume their length after one that was cut short at a jump of an input, however short that was.

    A step that is kept makes the next one no shorter than was planned, and one that is rejected must stay above `smallest`. (Without
    this, two jumps a few units in the last place apart end the motion as singular.)
    """

    smallest: Any = 0.0

    def init(self, terms, t0, *rest):
        t1, state = super().init(terms, t0, *rest)
        return t1, (t1 - t0, state)

    def adapt_step_size(self, *given):
        *step, (planned, state) = given
        keep, t0, t1, made_jump, state, result = super().adapt_step_size(*step, state)
        planned = jnp.where(keep, jnp.maximum(t1 - t0, planned), t1 - t0)
        result = dfx.RESULTS.where(keep | (planned >= self.smallest), result, dfx.RESULTS.dt_min_reached)
        return keep, t0, t0 + planned, made_jump, (planned, state), result


def with_tolerances(solver: Any, controller: Any) -> Any:
    """An implicit solver, with the tolerances of the steps for its equations, as diffrax has it."""
    inner = getattr(solver, "solver", solver)
    if not isinstance(inner, dfx.AbstractImplicitSolver):
        return solver
    names = [name for name in ("rtol", "atol", "norm") if not _is_given(getattr(inner.root_finder, name))]
    root_finder = dataclasses.replace(inner.root_finder, **{name: getattr(controller, name) for name in names})
    inner = dataclasses.replace(inner, root_finder=root_finder)
    return dataclasses.replace(solver, solver=inner) if hasattr(solver, "solver") else inner


def _is_given(tolerance):
    return callable(tolerance) or eqx.is_inexact_array_like(tolerance)
