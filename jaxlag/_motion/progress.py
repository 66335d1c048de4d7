"""Progress of a long computation: one line on standard error, rewritten in place where somebody watches, and few lines in a log."""

import contextlib
import sys
import threading
import time
from collections.abc import Iterator

import jax

OFTEN, SELDOM = 0.2, 10.0  # seconds between two updates where somebody watches; before the first in a log
LONG = 2.0  # seconds, after which a compilation is worth a word
COMPILED = "/jax/core/compile/backend_compile_duration"  # the last stage of three, as `jax.monitoring` names them
STAGES = ("/jax/core/compile/jaxpr_trace_duration", "/jax/core/compile/jaxpr_to_mlir_module_duration", COMPILED)
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


@contextlib.contextmanager
def compiling(what: str, shown: bool = True) -> Iterator[None]:
    """Says that `what` is being compiled wherever JAX, while the block runs, takes more than two seconds over a program."""
    if not shown:
        yield
        return
    compilation, over = Compilation(what), threading.Event()

    def watch():
        while not over.wait(OFTEN):
            compilation.say_if_long()

    watching = threading.Thread(target=watch, daemon=True)
    jax.monitoring.register_scalar_listener(compilation.begins)
    jax.monitoring.register_event_duration_secs_listener(compilation.ends)
    watching.start()
    try:
        yield
    finally:
        over.set()
        watching.join()
        jax.monitoring.unregister_scalar_listener(compilation.begins)
        jax.monitoring.unregister_event_duration_listener(compilation.ends)
        compilation.vanish()


class Compilation(Line):
    """The seconds that a compilation has taken, gone when it is over; in a log, a line when one first takes long.

    A program is traced, lowered and compiled, one after the other, and each of these stages may hold others.
    """

    def __init__(self, what: str) -> None:
        super().__init__()
        self.state = f"compiling {what}"
        self.lock = threading.RLock()  # of the thread that compiles and the one that watches
        self.depth, self.rested = 0, 0.0
        self.began: float | None = None

    def begins(self, event: str, value: float, **about: str | int) -> None:
        """When JAX begins a stage."""
        with self.lock:
            if event in STAGES:
                self.began = self.elapsed if self.began is None else self.began
                self.depth += 1

    def ends(self, event: str, duration_secs: float, **about: str | int) -> None:
        """When a stage is over."""
        with self.lock:
            if event in STAGES:
                self.depth, self.rested = self.depth - 1, self.elapsed
            if event == COMPILED and self.depth == 0:
                self.vanish()

    def say_if_long(self) -> None:
        """The line, if a program has been in compilation for long; what is traced and then not compiled is forgotten."""
        with self.lock:
            if self.depth == 0 and self.elapsed > self.rested + LONG:
                self.vanish()
            elif self.began is not None and self.elapsed > self.began + LONG:
                if self.watched:
                    self._write(f"{self.state}   {self.elapsed - self.began:.0f} s", "")
                elif not self.longest:
                    self._write(f"{self.state} ...", "\n")

    def vanish(self) -> None:
        """Leaves an empty line to whatever comes next, such as the progress bar."""
        with self.lock:
            self.began = None
            if self.watched and self.longest:
                print("\r" + " " * self.longest, end="\r", file=self.stream, flush=True)
                self.longest = 0
