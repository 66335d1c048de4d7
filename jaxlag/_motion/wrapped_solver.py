"""A solver of diffrax, wrapped: the end of each step is put back on the constraints, and no pulse passes within one."""

from collections.abc import Callable

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .protocol import FirstOrderSystem
from .pulses import hides_pulse, nodes_of


class SamplingAdjoint(dfx.AbstractAdjoint):
    """Another adjoint, with samples at `ts` before what `SaveAt` asks for.

    `SaveAt(ts=ts)` has diffrax check `ts` while it runs, and a program with such a check is never taken from JAX's persistent cache.
    """

    adjoint: dfx.AbstractAdjoint
    ts: Float[Array, " k"]

    def loop(self, *, saveat, init_state, **options):
        times, states = jnp.full(self.ts.shape, jnp.inf), jnp.full((self.ts.size, *init_state.y.shape), jnp.inf, init_state.y.dtype)
        last = init_state.save_state
        samples = eqx.tree_at(lambda saved: (saved.ts, saved.ys), last, (times.astype(self.ts.dtype), states))
        state = eqx.tree_at(lambda state: state.save_state, init_state, [samples, last])
        return self.adjoint.loop(saveat=dfx.SaveAt(subs=[dfx.SubSaveAt(ts=self.ts), saveat.subs]), init_state=state, **options)


class ProjectedSolver(dfx.AbstractWrappedSolver, dfx.AbstractAdaptiveSolver):
    """Any solver that estimates its error, with the end of each step put back on the constraints.

    `projected(t, y, args)` does that; the error of those of the first entries of y that are `controlled` alone sets the steps. A step in
    which a pulse passes unseen is refused.
    """

    solver: dfx.AbstractAdaptiveSolver
    projected: Callable | None = eqx.field(static=True)
    equations: FirstOrderSystem = eqx.field(static=True)

    @property
    def controlled(self):
        return self.equations.controlled

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
        y1, error, *rest = self.projected_step(terms, t0, t1, y0, args, solver_state, made_jump)
        return y1, self.refused(error, t0, t1, y0, args), *rest

    def refused(self, error, t0, t1, y0, args):
        """The error of a step, infinite where a pulse hides in it: it is tried again, shorter."""
        return jnp.where(hides_pulse(self.equations, nodes_of(self.solver), t0, t1, y0, args), jnp.inf, error)

    def projected_step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """One step of the solver, its end put back on the constraints."""
        y1, error, dense, solver_state, result = self.solver.step(terms, t0, t1, y0, args, solver_state, made_jump)
        counts = np.zeros(len(error), bool)
        counts[: len(self.controlled)] = self.controlled
        error = jnp.where(counts.reshape(-1, *[1] * (error.ndim - 1)), error, 0)
        if self.projected is not None:
            y1 = self.projected(t1, y1, args)
            # A step that cannot be put back is rejected, and tried again with half the length or less.
            error = jnp.where(jnp.all(jnp.isfinite(y1)), error, jnp.inf)
        return y1, error, dense | {"y1": y1}, solver_state, result
