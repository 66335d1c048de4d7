"""Progress: a line that is rewritten where somebody watches, and few lines in a log."""

import io
import re
import sys

import jax.numpy as jnp
import pytest

import jaxlag as jl
from jaxlag._motion import progress
from jaxlag._motion.progress import Bar, Steps


class Terminal(io.StringIO):
    def isatty(self):
        return True


class OfANotebook(io.StringIO):
    """Says of itself that it is no terminal, as ipykernel's."""


OfANotebook.__module__ = "ipykernel.iostream"


@pytest.fixture
def clock(monkeypatch):
    """A time that passes when it is told to."""
    now = [0.0]
    monkeypatch.setattr(progress.time, "perf_counter", lambda: now[0])
    return now


def hundred_seconds(clock):
    bar = Bar()
    for i in range(1, 101):
        clock[0] = float(i)
        bar(i / 100)
    bar.end()


@pytest.mark.fast
@pytest.mark.parametrize("stream", [Terminal, OfANotebook])
def test_one_line_is_rewritten_where_somebody_watches(monkeypatch, clock, stream):
    monkeypatch.setattr(sys, "stderr", stream())
    hundred_seconds(clock)
    said = sys.stderr.getvalue()
    assert said.count("\r") == 101 and said.count("\n") == 1 and said.endswith("\n")
    states = said.rstrip("\n").split("\r")
    assert states[25].rstrip() == "█" * 8 + "░" * 22 + "  25 %   75 s more"
    assert states[-1].rstrip() == "█" * 30 + " 100 %   100.0 s"
    assert len(states[-1]) == max(map(len, states))  # so that nothing of a longer one is left


@pytest.mark.fast
def test_a_log_gets_few_lines(monkeypatch, clock):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    hundred_seconds(clock)
    said = sys.stderr.getvalue()
    assert "\r" not in said
    assert re.findall(r"(\d+) %", said) == ["10", "20", "40", "80", "100"]


def test_fast_steps_are_not_all_written(monkeypatch, clock):
    monkeypatch.setattr(sys, "stderr", Terminal())
    steps = Steps(1000)
    for i in range(1, 1001):
        clock[0] = i / 1000
        steps(i, 1 / i)
    steps.end()
    said = sys.stderr.getvalue().split("\r")
    assert len(said) <= 7
    assert said[2].rstrip() == "step 201   cost 0.00497512   at most 1 s more" and said[-1].rstrip() == "step 1000   cost 0.001   1.0 s"


def test_a_motion_shows_its_bar(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    oscillator = jl.System(lambda q, qdot: 0.5 * qdot**2 - 2.0 * q**2)
    motion = jl.simulate(oscillator, 1.0, 0.0, jnp.linspace(0.0, 10.0, 11), progress=True)
    assert motion.succeeded
    assert sys.stderr.getvalue().split("\r")[-1].startswith("█" * 30 + " 100 %")


def test_a_motion_that_fails_says_how_far_it_came(monkeypatch):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    oscillator = jl.System(lambda q, qdot: 0.5 * qdot**2 - 2.0 * q**2)
    motion = jl.simulate(oscillator, 1.0, 0.0, jnp.linspace(0.0, 100.0, 11), progress=True, max_steps=100, throw=False)
    assert not motion.succeeded
    assert re.fullmatch(r"█+░+ +\d+ %   \d+\.\d s\n", sys.stderr.getvalue())
