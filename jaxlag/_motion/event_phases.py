"""Events in the loop of `step_machine` without friction and contact: behind one the step goes on in the only mode there is."""

import dataclasses

import jax.numpy as jnp

from .._mechanics.friction_elements import FrictionElements
from .._mechanics.stick_slip import Friction
from .state_vector import Parts
from .step_machine import Step
from .step_turn import Decision, Turn
from .witnesses import beyond


@dataclasses.dataclass(frozen=True)
class EventStep(Step):
    """A step of a smooth motion with events."""

    def new_search(self, y, t) -> None:
        """None."""

    def asked(self, turn: Turn):
        """y at the end of a piece."""
        return lambda k: turn.piece.y

    def ended(self, turn: Turn, last, parts: Parts, elements: FrictionElements, found: Friction, ended, moved) -> Decision:
        """After the last of Newton's steps, the events that have happened; the rest of the step follows."""
        begins, keeps, cut = self.at_start(turn), self.equations.projection is not None, turn.split.cut
        turn = turn._replace(choice=turn.choice._replace(passed=jnp.where(begins, False, ended)))
        y = parts._replace(sign=beyond(parts.sign, turn.choice.passed)).y
        yes = jnp.array(True)
        turn = self.onto_rest(turn._replace(split=turn.split._replace(cut=cut._replace(consistent=yes))), last)
        return Decision(turn if keeps else self.with_cut(turn, last, y), last & keeps, turn.end, y)

    def put(self, turn: Turn, there, y) -> Turn:
        """With what follows from there, where the constraints hold."""
        return self.with_cut(turn, there, y)

    def _selected(self, turn: Turn, point) -> Decision:
        """Never asked for."""
        return Decision(turn, jnp.array(False), turn.end, turn.piece.y)
