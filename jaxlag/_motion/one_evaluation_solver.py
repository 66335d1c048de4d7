"""The solver whose steps evaluate the equations in one place: those of `step_machine`, with the phases of `contact_phases`."""

from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp

from .contact_phases import ContactStep
from .event_phases import EventStep
from .first_order import EquationsOfMotion
from .results import RESULTS, under_diffrax
from .runge_kutta import ExplicitRungeKutta
from .step_machine import Step
from .stick_slip_solver import StickSlipSolver
from .witnesses import asks_for_forces, changes_states

AT_START = RESULTS.no_friction, RESULTS.negative_bound, RESULTS.energy_gained, RESULTS.not_impulsive  # what `Begun` says in this order


def has_one_evaluation(equations: EquationsOfMotion, solver: Any, reverse: bool) -> bool:
    """Whether one evaluation serves all: of an explicit scheme, where events change no state and ask for no constraint forces, and neither
    shares of friction nor slips that constraints turn or drive are to be found beside.
    """
    other = asks_for_forces(equations) or changes_states(equations) or (equations.light and (equations.contacts or equations.sided))
    plain = equations.formulation.stabilisation.feedback() is None and (equations.contacts or not equations.entangled)
    return bool(isinstance(solver, ExplicitRungeKutta) and equations.modes and plain and not other and not reverse)


class Found(NamedTuple):
    """What the first step finds of the start: y in the mode there, and what loads make of velocities; whether it has been found, and is as
    it must be.
    """

    y: Any
    loads: Any
    known: Any
    fine: Any


class OneEvaluationSolver(StickSlipSolver):
    """A `StickSlipSolver` of an explicit scheme, all of whose evaluations are those of one loop."""

    begins: bool = eqx.field(static=True, default=False)  # whether the first step finds the mode of the start

    def init(self, terms, t0, t1, y0, args):
        """The state of the scheme, which the first step makes, and what there is to be found of the start."""
        rate, is_new = super().init(terms, t0, t1, y0, args)
        no = jnp.array(False)
        found = Found(y0, jnp.zeros(self.equations.size, y0.dtype), no, no) if self.begins else None
        return rate, is_new, found, jnp.asarray(t1, y0.dtype)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        rate, is_new, start, _ = solver_state
        kind = ContactStep if self.equations.contacts else Step if self.equations.elements else EventStep
        done = kind.of(self, t0, t1, y0, args, ~start.known if self.begins else None).run(rate, made_jump | is_new)
        ended = done.split.seen.ended
        first = jax.tree.map(lambda cut, whole: jnp.where(ended, cut, whole), done.split.first, done.piece)
        split, t1 = done.split._replace(first=first, second=done.piece), done.end
        y1, error, dense, rate, result = self._joined(split, t0, t1, y0, args)
        if self.begins:
            begins, fine, begun = ~start.known, jnp.array(True), done.begun
            for passed, reason in zip(begun[2:], AT_START, strict=True):
                result = dfx.RESULTS.where(~begins | passed, result, under_diffrax(reason))
                fine &= passed
            fails = begins & ~fine  # the step is kept as it is, so that it says why
            y1, error = jnp.where(fails, y0, y1), jnp.where(fails, 0, error)
            found = Found(begun.y, begun.loads, jnp.array(True), fine)
            start = jax.tree.map(lambda new, old: jnp.where(begins, new, old), found, start)
        return y1, error, dense, (rate, jnp.array(False), start, t1), result

    def end_of(self, solver_state: Any, t1: Any) -> Any:
        """Where a step has ended that was to go to t1: before a second mode ends in it."""
        return solver_state[3]

    def start_of(self, solver_state: Any, y0: Any) -> tuple[Any, Any]:
        """y at the start of the motion, as far as that was found, and whether it is as it must be."""
        start = solver_state[2]
        return jnp.where(start.known, start.y, y0), start.fine | ~start.known

    def loads_of(self, solver_state: Any) -> Any:
        """What loads at the start make of velocities, as soon as that is known."""
        return solver_state[2].loads

    @staticmethod
    def knowing(solver_state: Any, known: Any) -> Any:
        """The state of the solver where the mode at the start may be known."""
        rate, is_new, start, end = solver_state
        return rate, is_new, start._replace(known=known), end
