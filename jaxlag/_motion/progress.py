"""Progress of a long computation: one line on standard error, rewritten in place where somebody watches, and few lines in a log."""

import sys
import time

OFTEN, SELDOM = 0.2, 10.0  # seconds between two updates where somebody watches; before the first in a log
WIDTH = 30  # of a bar


class Line:
    """A line that is rewritten in place, in a terminal and in a notebook.

    A log gets the last state, and before that a line after ten seconds, twenty, forty and so on.
    """

    def __init__(self) -> None:
        self.stream = sys.stderr
        self.watched = self.stream.isatty() or type(self.stream).__module__.startswith("ipykernel")
        self.started = time.perf_counter()
        self.due = 0.0 if self.watched else SELDOM
        self.state, self.longest = "", 0

    @property
    def elapsed(self) -> float:
        """Seconds since the start."""
        return time.perf_counter() - self.started

    def say(self, state: str, left: float | None, at_most: str = "") -> None:
        """Writes the state and the seconds left when an update is due."""
        self.state = state
        if self.elapsed >= self.due:
            self._write(state if left is None else f"{state}   {at_most}{left:.0f} s more", "" if self.watched else "\n")
            self.due = self.elapsed + OFTEN if self.watched else 2 * self.elapsed

    def end(self) -> None:
        """Writes the last state and ends the line."""
        if self.state:
            self._write(f"{self.state}   {self.elapsed:.1f} s", "\n")

    def _write(self, text, ending):
        self.longest = max(self.longest, len(text))
        print("\r" + text.ljust(self.longest) if self.watched else text, end=ending, file=self.stream, flush=True)


class Steps(Line):
    """Step and cost of an iteration, and an upper bound of the time left."""

    def __init__(self, max_steps: int) -> None:
        super().__init__()
        self.max_steps, self.first = max_steps, 0.0

    def __call__(self, step: int, cost: float) -> None:
        """After a step; the first does not count, as it may include compilation."""
        self.first = self.elapsed if step == 1 else self.first
        left = None if step == 1 else (self.elapsed - self.first) / (step - 1) * (self.max_steps - step)
        self.say(f"step {step:3d}   cost {cost:.6g}", left, "at most ")


class Bar(Line):
    """The fraction of a motion that has been computed."""

    def __call__(self, part: float) -> None:
        """At a fraction from 0 to 1."""
        left = self.elapsed * (1 - part) / part if 0 < part < 1 else None
        self.say(f"{'█' * round(WIDTH * part):░<{WIDTH}} {100 * part:3.0f} %", left)
