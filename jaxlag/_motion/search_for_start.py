"""Whether the start of a motion has to be put on the constraints: seen in its numbers, where Python may look at them."""

import enum

from .._mechanics.constraint_residuals import is_on_constraints
from .._model.given import Given
from .._model.system import System
from .._model.validation import checked
from .._program.jit import compiled, is_called_by_python, values
from .._program.scalarise import scalarised


class Search(enum.Enum):
    """What is left of the search for a start on the constraints: to compile all of it takes as long as the motion, and most need none."""

    ALL = enum.auto()
    DERIVATIVE = enum.auto()  # the start given is on them: how it changes with what they depend on
    NOTHING = enum.auto()  # and nothing is differentiated


def search_for(system: System, given: Given, states: dict, ts, is_varied: bool) -> Search:
    """What is left of the search: all of it where the numbers are not known, and where contacts have to start outside of obstacles.

    What tells is a program of its own, compiled in a fifth of the time that this saves.
    """
    if not system.constraints or system.unilateral:
        return Search.ALL
    known = values((given, states, ts))
    if known is None or not is_called_by_python((known[0].numbers, *known[0].others)) or not _needs_none(system, *known):
        return Search.ALL
    return Search.DERIVATIVE if is_varied else Search.NOTHING


@compiled
def _needs_none(system, given, states, ts):
    q0, qdot0, params = given.trees
    flat, *state = checked(system, ts[0], q0, qdot0, params, states)
    return scalarised(lambda t, q, v: is_on_constraints(flat, t, q, v))(*state)
