"""Whether the start of a motion has to be put on the constraints: seen in its numbers, where Python may look at them."""

from typing import Literal

import jax

from .._mechanics.constraint_residuals import is_on_constraints, off_constraints
from .._model.given import Given
from .._model.signal import is_signal
from .._model.system import System
from .._model.validation import checked
from .._program.jit import compiled, is_called_by_python, is_concrete, values
from .._program.scalarise import scalarised

Search = Literal["all", "derivative", "nothing"]
"""What is left of the search for a start on the constraints: to compile all of it takes as long as the motion, and most need none. Where
the start given is on them already, it is the derivative, how it changes with what they depend on; where nothing is differentiated, nothing.
"""


def search_for(system: System, given: Given, states: dict, ts, is_varied: bool) -> Search:
    """What is left of the search: all of it where the numbers are not known, where contacts have to start outside of obstacles, and beside
    signals, which may bend at the start.

    What tells is a program of its own, compiled in a fifth of the time that this saves.
    """
    if not system.constraints or system.unilateral or (given.others and _has_signals(given)):
        return "all"
    known = values((given, states, ts))
    if known is None or not is_called_by_python((known[0].numbers, *known[0].others)):
        return "all"
    given, states, ts = known
    given = Given.of(given.trees) if given.others else given  # so that a derivative asks the program that its motion has asked
    needs_none, off = _needs_none(system, given, states, ts)
    if not is_concrete(needs_none, off) or not needs_none:  # a constraint may close over what is differentiated, or a batch
        return "all"
    return "derivative" if is_varied else "nothing"


def _has_signals(given: Given) -> bool:
    return any(map(is_signal, jax.tree.leaves(given.trees, is_leaf=is_signal)))


@compiled
def _needs_none(system, given, states, ts):
    q0, qdot0, params = given.trees
    flat, *state = checked(system, ts[0], q0, qdot0, params, states)
    of_state = lambda t, q, v: (is_on_constraints(flat, t, q, v), off_constraints(flat, t, q, v))
    return scalarised(of_state)(*state)
