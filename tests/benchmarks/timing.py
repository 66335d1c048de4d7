"""Times measured side by side, and tables of them.

Every round runs each candidate in turn, so that noise affects all alike; the time is the median of the rounds. The first call, which
compiles, is reported separately. Ratios are relative to the first row of a table; `results.json` beside this file keeps all tables.
"""

import dataclasses
import json
import math
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax

ROUNDS = 9
RESULTS = Path(__file__).with_name("results.json")


@dataclasses.dataclass
class Row:
    """One candidate at one task; `seconds` is None if it was skipped, and `note` says why."""

    name: str
    first: float | None = None
    seconds: float | None = None
    error: float | None = None
    tolerance: float | None = None
    drift: float | None = None  # the largest |g|, where there are constraints
    note: str = ""
    ratio: float | None = None  # to the first row of its table


def once(run: Callable[[], Any]) -> float:
    """Seconds of one call, until its result is available."""
    begin = time.perf_counter()
    jax.block_until_ready(run())
    return time.perf_counter() - begin


def medians(runs: Mapping[str, Callable[[], Any]], rounds: int = ROUNDS, span: float = 2e-3) -> dict[str, float]:
    """Median seconds per call of each candidate, already compiled; quick ones are called repeatedly until `span` seconds have passed."""
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


class Met(NamedTuple):
    """The loosest tolerance that meets a bound, its error, and the seconds of the very first call."""

    tolerance: float
    error: float
    first: float


def loosest(run: Callable[[float], Any], error: Callable[[Any], float], bound: float, start: float = 1e-5) -> Met:
    """The loosest tolerance, in quarters of a decade, that keeps the error within the bound."""
    tolerance = start
    first = once(lambda: run(start))
    found = error(run(start))
    while not found <= bound and tolerance > 1e-14:
        tolerance *= 10**-0.25
        found = error(run(tolerance))
    return Met(tolerance, float(found), first)


def compared(runs: Mapping[str, Callable[[], Any]], met: Mapping[str, Met] | None = None, rounds: int = ROUNDS) -> list[Row]:
    """First calls, medians, and ratios to the first of the runs."""
    if met is None:
        met = {name: Met(math.nan, math.nan, once(run)) for name, run in runs.items()}
    seconds = medians(runs, rounds)
    base, known = seconds[next(iter(runs))], lambda x: None if math.isnan(x) else x
    return [
        Row(name, met[name].first, seconds[name], known(met[name].error), known(met[name].tolerance), ratio=seconds[name] / base)
        for name in runs
    ]


def skipped(names: Mapping[str, str]) -> list[Row]:
    """Rows of candidates that are missing, with the reason."""
    return [Row(name, note=f"skipped: {reason}") for name, reason in names.items()]


def show(task: str, rows: Iterable[Row]) -> None:
    """Prints the table, as Markdown."""
    number = lambda x, form: "" if x is None else format(x, form)
    print(f"\n**{task}**\n\n| | time | ratio | error | drift | tolerance | first call | |\n|---|---|---|---|---|---|---|---|")
    for row in rows:
        cells = [duration(row.seconds), number(row.ratio, ".3g"), *(number(x, ".1e") for x in (row.error, row.drift, row.tolerance))]
        print("| " + " | ".join([row.name, *cells, duration(row.first), row.note]) + " |", flush=True)


def duration(seconds: float | None) -> str:
    """A duration with three digits, in a suitable unit."""
    if seconds is None:
        return ""
    unit, size = next(((u, s) for u, s in (("s", 1), ("ms", 1e-3), ("µs", 1e-6)) if seconds >= s), ("ns", 1e-9))
    return f"{seconds / size:.3g} {unit}"


def record(topic: str, tables: Iterable[tuple[str, list[Row]]]) -> None:
    """Prints each table as soon as it is complete, and stores it in `results.json`, replacing the previous one."""
    for task, rows in tables:
        show(f"{topic}: {task}", rows)
        kept = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
        kept["machine"] = {"cores": os.cpu_count(), "processor": platform.machine(), "jax": jax.__version__}
        kept.setdefault(topic, {})[task] = [dataclasses.asdict(row) for row in rows]
        RESULTS.write_text(json.dumps(kept, indent=1, ensure_ascii=False, allow_nan=True))
