"""Steps of the integration: put back on the constraints, and cut where friction changes its mode."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._motion import Equations

LOOKS = 4  # how often a step looks for an end of the mode, at its end the last time
BISECTIONS = 40
NEWTON_STEPS = 3  # the first makes the time right, the second its derivative, the third its second derivative


class Kept(dfx.AbstractWrappedSolver, dfx.AbstractAdaptiveSolver):
    """Any Runge–Kutta solver, with the end of each step put back on the constraints.

    `kept(t, y, args)` does that; the error of the first `controlled` entries of y alone sets the steps.
    """

    solver: dfx.AbstractRungeKutta
    kept: Callable | None = eqx.field(static=True)
    controlled: int = eqx.field(static=True)

    @property
    def term_structure(self):
        return self.solver.term_structure

    @property
    def interpolation_cls(self):
        return self.solver.interpolation_cls

    @property
    def term_compatible_contr_kwargs(self):
        return self.solver.term_compatible_contr_kwargs

    @property
    def scan_kind(self):
        return self.solver.scan_kind

    @property
    def root_finder(self):
        return self.solver.root_finder

    @property
    def root_find_max_steps(self):
        return self.solver.root_find_max_steps

    def order(self, terms):
        return self.solver.order(terms)

    def error_order(self, terms):
        return self.solver.error_order(terms)

    def init(self, terms, t0, t1, y0, args):
        return self.solver.init(terms, t0, t1, y0, args)

    def func(self, terms, t0, y0, args):
        return self.solver.func(terms, t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y1, error, dense, solver_state, result = self.solver.step(terms, t0, t1, y0, args, solver_state, made_jump)
        error = error.at[self.controlled :].set(0)
        if self.kept is not None:
            y1 = self.kept(t1, y1, args)
            # A step that cannot be put back is rejected, and tried again with half the length or less.
            error = jnp.where(jnp.all(jnp.isfinite(y1)), error, jnp.inf)
        return y1, error, dense | {"y1": y1}, solver_state, result


class TwoPieces(dfx.AbstractLocalInterpolation):
    """Dense output of a step with a change of mode in it, at `cut`."""

    t0: Any
    t1: Any
    cut: Any
    first: Any
    second: Any

    def evaluate(self, t0, t1=None, left=True):
        if t1 is not None:
            return self.evaluate(t1) - self.evaluate(t0)
        before = (t0 < self.cut) | ((t0 == self.cut) & left)
        return jnp.where(before, self.first.evaluate(t0), self.second.evaluate(t0))


class StickSlipSolver(Kept):
    """A `Kept` solver that ends a mode of friction where it ends, inside the step.

    The end of the mode is bracketed on the dense output, located by bisection, and made exact by Newton's step on the step itself,
    so that it is differentiated. From there the step goes on in the new mode. A step with a second end is rejected.
    """

    equations: Equations = eqx.field(static=True)

    @property
    def interpolation_cls(self):
        def pieces(*, t0, t1, cut, first, second):
            make = self.solver.interpolation_cls
            return TwoPieces(t0, t1, cut, make(t0=t0, t1=cut, **first), make(t0=jnp.where(cut < t1, cut, t0), t1=t1, **second))

        return pieces

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        piece = lambda *given: Kept.step(self, terms, *given[:3], args, *given[3:])
        looked = lambda a, b, dense: self._looks(a, b, dense, args)
        y1, error, dense, state, result = piece(t0, t1, y0, solver_state, made_jump)
        ended = jnp.any(looked(t0, t1, dense) < 0, axis=1)
        plain = y1, error, {"cut": t1, "first": dense, "second": dense}, state

        def newton(carry, _):
            cut, _ = carry
            done = piece(t0, cut, y0, solver_state, made_jump)
            value, slope = jax.jvp(
                lambda t, y: self.equations.margins(t, y, args),
                (cut, done[0]),
                (jnp.ones_like(cut), self.equations.rates(cut, done[0], args)),
            )
            falling = slope < 0
            until = jnp.where(falling, jnp.abs(value) / jnp.where(falling, -slope, 1), jnp.inf)
            nearest = jax.lax.stop_gradient(jnp.argmin(until))
            better = cut - value[nearest] / jnp.where(falling[nearest], slope[nearest], -jnp.inf)
            return (better, cut), (done, jnp.arange(value.size) == nearest, jnp.any(falling))

        def cut_in_two(_):
            rough = self._bisected(t0, t1, dense, ended, args)
            (_, cut), done = jax.lax.scan(newton, (rough, rough), length=NEWTON_STEPS)
            (y_cut, error_1, first, state_1, _), which, falling = jax.tree.map(lambda leaf: leaf[-1], done)
            y_new, possible, ready = self.equations.changed(cut, y_cut, args, which)
            y_end, error_2, second, state_2, _ = piece(cut, t1, y_new, state_1, True)
            again = jnp.any(looked(cut, t1, second) < 0)
            usable = ready & ~again & (cut >= t0) & (cut < t1) & falling
            error = jnp.where(usable, jnp.maximum(jnp.abs(error_1), jnp.abs(error_2)), jnp.inf)
            return (y_end, error, {"cut": cut, "first": first, "second": second}, state_2), possible | ~usable

        (y1, error, dense, state), possible = jax.lax.cond(jnp.any(ended), cut_in_two, lambda _: (plain, jnp.array(True)), None)
        refused = dfx.RESULTS.where(possible, dfx.RESULTS.successful, dfx.RESULTS.internal_error)
        refused = dfx.RESULTS.where(self.equations.exhausted(y1), dfx.RESULTS.max_steps_rejected, refused)
        return y1, error, dense, state, dfx.RESULTS.where(result == dfx.RESULTS.successful, refused, result)

    def _looks(self, t0, t1, dense, args) -> Float[Array, "looks e"]:
        """Margins at a few times within a step."""
        path = self.solver.interpolation_cls(t0=t0, t1=t1, **dense)
        times = t0 + (t1 - t0) * jnp.arange(1, LOOKS + 1) / LOOKS
        return jax.lax.stop_gradient(jax.vmap(lambda t: self.equations.margins(t, path.evaluate(t), args))(times))

    def _bisected(self, t0, t1, dense, ended, args):
        """The time at which the first margin crosses zero on the dense output."""
        path = self.solver.interpolation_cls(t0=t0, t1=t1, **dense)
        first = jnp.argmax(ended)

        def halve(_, bracket):
            low, high = bracket
            middle = 0.5 * (low + high)
            over = jnp.any(self.equations.margins(middle, path.evaluate(middle), args) < 0)
            return jnp.where(over, low, middle), jnp.where(over, middle, high)

        width = (t1 - t0) / LOOKS
        bracket = jax.lax.stop_gradient((t0 + first * width, t0 + (first + 1) * width))
        return jax.lax.stop_gradient(jax.lax.fori_loop(0, BISECTIONS, halve, bracket)[1])
