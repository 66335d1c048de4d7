"""What the loop of `step_machine` carries from turn to turn."""

from typing import Any, NamedTuple

from jaxtyping import Array

from .._mechanics.stick_slip import Friction
from .._mechanics.stick_slip import Search as ModeSearch
from .split import Piece, Split
from .step_monitor import Search

STAGE, LOOK, END, SELECT, BACK, COUNT, ALONE, STRIKE, TURN, DONE = range(10)
BEGIN = -1  # the phase before those of a step, in which the motion has no mode yet


class Point(NamedTuple):
    """What is evaluated at one point."""

    rates: Array
    friction: Friction


class Watch(NamedTuple):
    """The search for an end along a piece: the times of its next look, and the margins there; what was looked at before there was an end
    in it, whose interpolant tells slopes; and how steeply margins follow what follows the time alone.
    """

    search: Search
    ts: Any
    values: Any
    smooth: tuple[Any, Any, Any]  # from one time to another, the values at its nodes
    steepness: Any


class Choice(NamedTuple):
    """The selection of the mode that follows: of what is at rest, and what breaks away, and behind which events; in the mode that is asked
    about, the friction, and slip rates, with each row of σ changed as well.
    """

    search: ModeSearch
    at_rest: Any
    breaking: Any
    passed: Any
    found: Friction
    slip_rates: Any


class Back(NamedTuple):
    """A state that is put back on its constraints at some time: y on its way; what it is of, and what follows: the kind of the next
    points, and the number of the first.
    """

    t: Any
    there: Array
    of: Any
    kind: Any
    first: Any


class Turn(NamedTuple):
    """What the loop carries: the kind of its next points, and the number of the first; the phase of the step; the piece of it that is
    made, from y0 at its start to its end; the step so far.
    """

    kind: Any
    first: Any
    phase: Any
    start: Any
    end: Any
    y0: Any
    stages: Any
    piece: Piece
    split: Split
    watch: Watch
    choice: Choice
    back: Back
    change: Any = None  # of contacts
    begun: Any = None  # where motions begin here


class Begun(NamedTuple):
    """The start of a motion in the mode that holds there, and what loads make of velocities; whether the mode is consistent, no bound is
    negative, and an impact there takes energy and follows from impulses.
    """

    y: Array
    loads: Array
    consistent: Any
    bounded: Any
    dissipates: Any
    impulsive: Any


class Decision(NamedTuple):
    """The turn that follows; and whether y is to be put on the constraints at some time, and given to it."""

    turn: Turn
    projects: Any
    t: Any
    y: Any
