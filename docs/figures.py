"""Writes the tables of measured times into the page on performance, from the file that the benchmarks write.

python tests/benchmarks/run.py
python docs/figures.py
"""

import json
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "pages" / "explanation" / "performance.md"
RESULTS = ROOT / "tests" / "benchmarks" / "results.json"
BLOCK = re.compile(r"(<!-- figures: (?P<topic>[^:>]+?)(?:: (?P<task>[^>]+?))? -->\n).*?(<!-- end -->)", re.DOTALL)
UNITS = (("s", 1), ("ms", 1e-3), ("µs", 1e-6), ("ns", 1e-9))


def filled(text: str, results: dict) -> str:
    """The page with each table between its two comments, `<!-- figures: topic: beginning of the tasks -->` and `<!-- end -->`."""
    table = lambda block: _table(results[block["topic"]], block["task"] or "")
    return BLOCK.sub(lambda block: f"{block[1]}\n{table(block)}\n{block[4]}", text)


def _table(tasks: dict, beginning: str) -> str:
    """A table with a row for each candidate and a column for each task with this beginning."""
    columns = {task.removeprefix(f"{beginning}: "): rows for task, rows in tasks.items() if task.startswith(beginning)}
    times = {task: {row["name"]: _duration(row["seconds"]) for row in rows} for task, rows in columns.items()}
    names = dict.fromkeys(name for column in times.values() for name in column)
    rows = [[name, *(column.get(name, "") for column in times.values())] for name in names]
    lines = [["", *times], ["---"] * (len(times) + 1), *(row for row in rows if any(row[1:]))]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _duration(seconds: float | None) -> str:
    """A duration with two digits, in a suitable unit."""
    if seconds is None:
        return ""
    unit, size = next(((unit, size) for unit, size in UNITS if seconds >= size), UNITS[-1])
    value = seconds / size
    return f"{value:.2g} {unit}" if value < 100 else f"{round(value, -1):.0f} {unit}"


if __name__ == "__main__":
    PAGE.write_text(filled(PAGE.read_text(), json.loads(RESULTS.read_text())))
