"""How a long computation gets on: one line on standard error, rewritten in place where somebody watches, and few lines in a log."""

import sys
import time

OFTEN, SELDOM = 0.2, 10.0  # seconds between two writings where one watches; before the first in a log
WIDTH = 30  # of a bar


class Line:
    """A line that is rewritten in place, in a terminal and in a notebook.

    A log gets its last state, and before that one line after ten seconds, after twenty, after forty and so on.
    """

    def __init__(self) -> None:
        self.stream = sys.stderr
        self.watched = self.stream.isatty() or type(self.stream).__module__.startswith("ipykernel")
        self.begun = time.perf_counter()
        self.due = 0.0 if self.watched else SELDOM
        self.state, self.longest = "", 0

    @property
    def elapsed(self) -> float:
        """Seconds since the beginning."""
        return time.perf_counter() - self.begun

    def say(self, state: str, left: float | None, at_most: str = "") -> None:
        """Writes the state and the seconds left, where it is time to."""
        self.state = state
        if self.elapsed >= self.due:
            self._write(state if left is None else f"{state}   {at_most}{left:.0f} s more", "" if self.watched else "\n")
            self.due = self.elapsed + OFTEN if self.watched else 2 * self.elapsed

    def end(self) -> None:
        """Writes the last state, and leaves the line."""
        if self.state:
            self._write(f"{self.state}   {self.elapsed:.1f} s", "\n")

    def _write(self, text, ending):
        self.longest = max(self.longest, len(text))
        print("\r" + text.ljust(self.longest) if self.watched else text, end=ending, file=self.stream, flush=True)


class Steps(Line):
    """Step and cost of an iteration, and how long the rest may take at most."""

    def __init__(self, max_steps: int) -> None:
        super().__init__()
        self.max_steps, self.first = max_steps, 0.0

    def __call__(self, step: int, cost: float) -> None:
        """After a step; the first is not counted, for it may compile."""
        self.first = self.elapsed if step == 1 else self.first
        left = None if step == 1 else (self.elapsed - self.first) / (step - 1) * (self.max_steps - step)
        self.say(f"step {step:3d}   cost {cost:.6g}", left, "at most ")


class Bar(Line):
    """The part of a motion that is computed."""

    def __call__(self, part: float) -> None:
        """At so many parts of one."""
        left = self.elapsed * (1 - part) / part if 0 < part < 1 else None
        self.say(f"{'█' * round(WIDTH * part):░<{WIDTH}} {100 * part:3.0f} %", left)
