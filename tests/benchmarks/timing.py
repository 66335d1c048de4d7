"""Times measured side by side, and the tables made of them.

Every round runs each candidate in turn, so that noise hits all alike; the time is the median of the rounds. The first call, which
compiles, is kept apart. A table compares with its first row; `results.json` beside this file keeps them all.
"""

import dataclasses
import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import jax

ROUNDS = 9
RESULTS = Path(__file__).with_name("results.json")


@dataclasses.dataclass
class Row:
    """One candidate at one task; `seconds` is None where it was skipped, and `note` says why."""

    name: str
    first: float | None = None
    seconds: float | None = None
    error: float | None = None
    tolerance: float | None = None
    note: str = ""
    ratio: float | None = None  # to the first row of its table


def once(run: Callable[[], Any]) -> float:
    """Seconds of one call, until its result is there."""
    begin = time.perf_counter()
    jax.block_until_ready(run())
    return time.perf_counter() - begin


def medians(runs: Mapping[str, Callable[[], Any]], rounds: int = ROUNDS, span: float = 2e-3) -> dict[str, float]:
    """Median seconds of a call of each, compiled already; quick ones are called repeatedly until `span` seconds have passed."""
    repeats = {name: max(1, int(span / max(min(once(run), once(run)), 1e-7))) for name, run in runs.items()}
    taken: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(rounds):
        for name, run in runs.items():
            begin = time.perf_counter()
            for _ in range(repeats[name]):
                out = run()
            jax.block_until_ready(out)
            taken[name].append((time.perf_counter() - begin) / repeats[name])
    return {name: statistics.median(times) for name, times in taken.items()}


def loosest(run: Callable[[float], Any], error: Callable[[Any], float], bound: float, start: float = 1e-5) -> tuple[float, float]:
    """The loosest tolerance, in quarters of a decade, with which the error is within the bound; and that error."""
    tolerance, found = start, error(run(start))
    while not found <= bound:
        tolerance *= 10**-0.25
        if tolerance < 1e-14:
            return float("nan"), found
        found = error(run(tolerance))
    return tolerance, found


def compared(runs: Mapping[str, Callable[[], Any]], rounds: int = ROUNDS, **facts: Mapping[str, Any]) -> list[Row]:
    """First calls, medians and ratios to the first of the runs; `facts` are more entries of the rows, by name."""
    first = {name: once(run) for name, run in runs.items()}
    seconds = medians(runs, rounds)
    base = seconds[next(iter(runs))]
    more = lambda name: {fact: by_name[name] for fact, by_name in facts.items() if name in by_name}
    return [Row(name, first[name], seconds[name], ratio=seconds[name] / base, **more(name)) for name in runs]


def skipped(names: Mapping[str, str]) -> list[Row]:
    """Rows of candidates that are not there, with the reason."""
    return [Row(name, note=f"skipped: {reason}") for name, reason in names.items()]


def show(task: str, rows: Iterable[Row]) -> None:
    """Prints the table, as Markdown."""
    number = lambda x, form: "" if x is None else format(x, form)
    print(f"\n**{task}**\n\n| | time | ratio | error | tolerance | first call | |\n|---|---|---|---|---|---|---|")
    for row in rows:
        cells = [duration(row.seconds), number(row.ratio, ".3g"), number(row.error, ".1e"), number(row.tolerance, ".1e")]
        print("| " + " | ".join([row.name, *cells, duration(row.first), row.note]) + " |", flush=True)


def duration(seconds: float | None) -> str:
    """Seconds with three digits, in a fitting unit."""
    if seconds is None:
        return ""
    unit, size = next(((u, s) for u, s in (("s", 1), ("ms", 1e-3), ("µs", 1e-6)) if seconds >= s), ("ns", 1e-9))
    return f"{seconds / size:.3g} {unit}"


def record(topic: str, tables: Mapping[str, Iterable[Row]]) -> None:
    """Shows the tables and keeps them in `results.json`, in place of the topic's older ones."""
    for task, rows in tables.items():
        show(f"{topic}: {task}", rows)
    kept = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    kept["machine"] = {"cores": os.cpu_count(), "processor": platform.machine(), "jax": jax.__version__}
    kept[topic] = {task: [dataclasses.asdict(row) for row in rows] for task, rows in tables.items()}
    RESULTS.write_text(json.dumps(kept, indent=1, ensure_ascii=False, allow_nan=True))
