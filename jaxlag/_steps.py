"""Steps of the integration: put back on the constraints, cut where friction changes its mode, and begun anew where an input jumps."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from equinox.internal import prevbefore
from jaxtyping import Array, Float

from ._friction import norms, settle
from ._motion import Equations
from ._power import energy_turnover
from ._signal import delayed
from ._system import EXPLICIT_TIME

LOOKS = 4  # how often a step looks for an end of the mode, at its end the last time
BISECTIONS = 40
NEWTON_STEPS = 3  # the first makes the time right, the second its derivative, the third its second derivative


class AtSamples(dfx.AbstractAdjoint):
    """Another adjoint, with samples at `ts` in place of what `SaveAt` asks for.

    `SaveAt(ts=ts)` has diffrax check `ts` while it runs, and a program with such a check is never taken from JAX's persistent cache.
    """

    adjoint: dfx.AbstractAdjoint
    ts: Float[Array, " k"]

    def loop(self, *, saveat, init_state, **how):
        times, states = jnp.full(self.ts.shape, jnp.inf), jnp.full((self.ts.size, *init_state.y.shape), jnp.inf, init_state.y.dtype)
        saved = lambda state: (state.save_state.ts, state.save_state.ys)
        state = eqx.tree_at(saved, init_state, (times.astype(self.ts.dtype), states))
        return self.adjoint.loop(saveat=dfx.SaveAt(ts=self.ts), init_state=state, **how)


class Kept(dfx.AbstractWrappedSolver, dfx.AbstractAdaptiveSolver):
    """Any solver that estimates its error, with the end of each step put back on the constraints.

    `kept(t, y, args)` does that; the error of the first `controlled` entries of y alone sets the steps. Where an input has jumped, a
    step starts from `behind(t, y, args)`.
    """

    solver: dfx.AbstractAdaptiveSolver
    kept: Callable | None = eqx.field(static=True)
    controlled: int = eqx.field(static=True)
    behind: Callable | None = eqx.field(static=True)

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
        y0, _ = self._begun(t0, y0, args, made_jump)
        return self._stepped(terms, t0, t1, y0, args, solver_state, made_jump)

    def _begun(self, t0, y0, args, made_jump):
        """Where a step starts, and whether a mode of friction agrees with the forces there."""
        if self.behind is None:
            return y0, jnp.array(True)
        return jax.lax.cond(made_jump, lambda y: self.behind(t0, y, args), lambda y: (y, jnp.array(True)), y0)

    def _stepped(self, terms, t0, t1, y0, args, solver_state, made_jump):
        terms, given = self._within(terms, t1, args)
        y1, error, dense, solver_state, result = self.solver.step(terms, t0, t1, y0, given, solver_state, made_jump)
        error = jnp.where((np.arange(len(error)) < self.controlled).reshape(-1, *[1] * (error.ndim - 1)), error, 0)
        if self.kept is not None:
            y1 = self.kept(t1, y1, args)
            # A step that cannot be put back is rejected, and tried again with half the length or less.
            error = jnp.where(jnp.all(jnp.isfinite(y1)), error, jnp.inf)
        return y1, error, dense | {"y1": y1}, solver_state, result

    def _within(self, terms, t1, args):
        """Terms and args with which a stage beyond t1 sees held inputs as they are at t1, in front of the jump there."""
        if self.behind is None or not _looks_ahead(self.solver):
            return terms, args

        def rates(t, y, given):
            (params, slack), end = given
            return terms.vf(t, y, (delayed(params, jnp.maximum(t - end, 0)), slack))

        return dfx.ODETerm(rates), (args, t1)


def _looks_ahead(solver) -> bool:
    """Whether a stage lies beyond the end of the step, as of Kvaerno4 and Kvaerno5, which would feel its way to each jump."""
    tableau = getattr(solver, "tableau", None)
    return tableau is not None and any(c > 1 for c in tableau.c)


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
        y0, begins = self._begun(t0, y0, args, made_jump)
        piece = lambda *given: self._stepped(terms, *given[:3], args, *given[3:])
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
        refused = dfx.RESULTS.where(possible & begins, dfx.RESULTS.successful, dfx.RESULTS.internal_error)
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


@eqx.filter_jit
def behind_a_jump(equations: Equations, t, y, args):
    """y behind a jump of an input at t, and whether a mode of friction agrees with its forces.

    A velocity constraint that jumps takes q̇ along by an impulse, which is the projection in the metric of M. Friction is bounded and
    has no part in it: where there is slip then, it goes on as it is; where there is none, it sticks or breaks away.
    """
    params, slack = args
    q, v, works, sigma, transitions, time_stuck = equations.parts(y)
    flat, _, kinks = equations.mode(t, q, v, sigma, params)
    if equations.audit:
        lift = energy_turnover(flat, t, q, v)[0] - energy_turnover(flat, prevbefore(prevbefore(t)), q, v)[0]
        works = works.at[equations.works.index(EXPLICIT_TIME)].add(lift)
    slipping = jnp.concatenate([q, v, works, jnp.ones_like(sigma), transitions, time_stuck])
    y = slipping if equations.projection is None else equations.kept(t, slipping, args)
    if kinks is None:
        return y, jnp.array(True)
    q, v, works, *_ = equations.parts(y)
    slip = kinks.slip(t, q, v)
    size = norms(kinks, slip)
    along = slip / jnp.where(size > 0, size, 1)[kinks.element_of_row]
    mode = settle(flat, kinks, t, q, v, along, size <= slack, jnp.zeros_like(size, bool))
    changes = jnp.sum(norms(kinks, mode.sigma - sigma) > 0.5)
    y = jnp.concatenate([q, v, works, mode.sigma, transitions + changes, time_stuck])
    return equations.kept(t, y, args), mode.consistent


class Resuming(dfx.PIDController):
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
