"""Progress: a line that is rewritten where somebody watches, and few lines in a log."""

import io
import re
import sys
import threading

import jax
import jax.numpy as jnp
import pytest

import jaxlag as jl
from jaxlag._motion import progress
from jaxlag._motion.progress import COMPILED, STAGES, Bar, Compilation, Steps, compiling


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


@pytest.mark.slow
def test_a_motion_shows_its_bar(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    oscillator = jl.System(lambda q, qdot: 0.5 * qdot**2 - 2.0 * q**2)
    motion = jl.simulate(oscillator, 1.0, 0.0, jnp.linspace(0.0, 10.0, 11), progress=True)
    assert motion.succeeded
    assert sys.stderr.getvalue().split("\r")[-1].startswith("█" * 30 + " 100 %")


def test_a_motion_that_fails_says_how_far_it_came(monkeypatch):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    monkeypatch.setattr(progress, "LONG", 1e9)
    oscillator = jl.System(lambda q, qdot: 0.5 * qdot**2 - 2.0 * q**2)
    motion = jl.simulate(oscillator, 1.0, 0.0, jnp.linspace(0.0, 100.0, 11), progress=True, max_steps=100, throw=False)
    assert not motion.succeeded
    assert re.fullmatch(r"█+░+ +\d+ %   \d+\.\d s\n", sys.stderr.getvalue())


def compile_for(clock, compilation, seconds, stages=STAGES):
    """The events of a compilation that takes some seconds in all, which is looked at five times a second."""
    for stage in stages:
        compilation.begins(stage, 0.0, fun_name="f")
        for _ in range(round(5 * seconds / len(stages))):
            clock[0] += 0.2
            compilation.say_if_long()
        compilation.ends(stage, seconds / len(stages), fun_name="f")


@pytest.mark.fast
def test_a_long_compilation_is_named_until_it_is_over(monkeypatch, clock):
    monkeypatch.setattr(sys, "stderr", Terminal())
    compilation = Compilation("the motion")
    compile_for(clock, compilation, 6.0)
    said = [state.rstrip() for state in sys.stderr.getvalue().split("\r")]
    assert said[1] == "compiling the motion   2 s" and said[-3] == "compiling the motion   6 s" and said[-2:] == ["", ""]
    Bar()(0.5)
    assert sys.stderr.getvalue().split("\r")[-1].startswith("█" * 15 + "░" * 15)


@pytest.mark.fast
def test_a_log_gets_one_line_for_long_compilations(monkeypatch, clock):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    compilation = Compilation("the fit")
    for seconds in (1.0, 9.0, 9.0):
        compile_for(clock, compilation, seconds)
    assert sys.stderr.getvalue() == "compiling the fit ...\n"


@pytest.mark.fast
@pytest.mark.parametrize("stream", [Terminal, io.StringIO])
def test_short_compilations_go_without_saying(monkeypatch, clock, stream):
    monkeypatch.setattr(sys, "stderr", stream())
    compilation = Compilation("the fit")
    for _ in range(10):
        compile_for(clock, compilation, 1.8)
        clock[0] += 5.0  # a step of the fit
        compilation.say_if_long()
    assert not sys.stderr.getvalue()


def test_what_is_traced_and_not_compiled_is_forgotten(monkeypatch, clock):
    monkeypatch.setattr(sys, "stderr", Terminal())
    compilation = Compilation("the fit")
    compile_for(clock, compilation, 1.8, STAGES[:1])
    clock[0] += 60.0  # of a program that was compiled before
    compilation.say_if_long()
    compile_for(clock, compilation, 1.8)
    assert not sys.stderr.getvalue()


def test_a_compilation_within_a_trace_does_not_end_it(monkeypatch, clock):
    monkeypatch.setattr(sys, "stderr", Terminal())
    compilation = Compilation("the motion")
    compilation.begins(STAGES[0], 0.0)
    compile_for(clock, compilation, 3.0)
    compile_for(clock, compilation, 0.2, (COMPILED,))
    assert sys.stderr.getvalue().endswith("compiling the motion   3 s")


@pytest.mark.parametrize("shown", [True, False])
def test_what_jax_compiles_is_shown_where_it_is_asked_for(monkeypatch, shown):
    """The events are those of JAX; the line appears in a thread of its own, which does not outlast the block."""
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setattr(progress, "LONG", 0.0)
    monkeypatch.setattr(progress, "OFTEN", 0.01)
    threads = threading.active_count()

    def long_to_trace(x):
        threading.Event().wait(0.2)
        return x

    with pytest.raises(ZeroDivisionError), compiling("a program", shown):
        jax.jit(long_to_trace)(1.0)
        assert ("compiling a program   0 s" in sys.stderr.getvalue()) == shown
        raise ZeroDivisionError
    said = sys.stderr.getvalue()
    assert threading.active_count() == threads and said.split("\r")[-1] == ""
    jax.jit(lambda x: long_to_trace(x))(1.0)
    assert sys.stderr.getvalue() == said
