"""Tables as laboratories write them: text with any separator, decimal commas, a row of units, dates; and data frames."""

import csv
import datetime
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

SEPARATORS = "\t;,"  # in this order, the first that the line of names holds
PLAIN_DATE = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4})[ T]+(.*)")  # day before month; with slashes, some write the month first

Column = Callable[[str], np.ndarray]


def of_text(file: str | Path, time: str, delimiter: str | None, decimal: str | None, encoding: str) -> tuple[list[str], Column]:
    """The names of the columns of a text file, and each column as numbers."""
    with open(file, newline="", encoding=encoding) as lines:
        numbered = [(number, line) for number, line in enumerate(lines, 1) if line.strip()]
    if not numbered:
        raise ValueError(f"`file` must hold a table, but {str(file)!r} is empty. Export it again, with the names of the columns first.")
    numbers_of_lines, rows = zip(*numbered, strict=True)
    delimiter = delimiter or next((mark for mark in SEPARATORS if mark in rows[0]), ",")
    names, *cells = ([cell.strip() for cell in row] for row in csv.reader(rows, delimiter=delimiter, skipinitialspace=True))
    if decimal not in (None, ".", ","):
        raise ValueError(f"`decimal` must be '.' or ',', but is {decimal!r}. Leave it out, and both are read, unless cells end at commas.")
    is_said, decimal = decimal is not None, decimal or ("," if delimiter != "," else ".")
    as_number = (lambda text: text.replace(",", ".")) if decimal == "," else (lambda text: text)
    has_units = bool(cells) and all(_number(as_number(cell)) is None and _date(cell) is None for cell in cells[0])
    table = list(zip(numbers_of_lines[1:], cells, strict=True))[has_units:]

    def column(name):
        i = names.index(name)
        texts = [(line, row[i] if i < len(row) else "") for line, row in table]
        marks = [{*text} & {".", ","} for _, text in texts]
        if not is_said and decimal == "," and {"."} in marks and {","} in marks and name != time:
            raise ValueError(f"column {name!r} must have one decimal mark, but has points and commas. Say which by `decimal`.")
        numbers = [np.nan if text == "" else _number(as_number(text)) for _, text in texts]
        if None not in numbers:
            return np.array(numbers, float)
        wrong = numbers.index(None)
        if name == time and (dates := [_date(text) for _, text in texts]) and None not in dates:
            return np.array([(date - dates[0]).total_seconds() for date in dates])
        line, text = texts[wrong]
        raise ValueError(
            f"line {line}, column {name!r} must be a number, but is {text!r}. Leave the cell empty where it is missing; "
            "decimal commas need another `delimiter` than a comma."
        )

    return [name for name in names if name], column


def of_frame(frame: Any) -> tuple[list[str], Column]:
    """The same of a data frame; a column of dates in seconds from its first one."""

    def column(name):
        found = np.asarray(frame[name].to_numpy())
        return (found - found[0]) / np.timedelta64(1, "s") if found.dtype.kind == "M" else found

    return list(frame.columns), column


def scaled(names: Sequence[str], column: Column, time: Any, columns: Any, from_zero: bool) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Times and values by channel; each column is a name, or (name, factor)."""
    of_time = _with_factor(time)
    if columns is None:
        columns = [name for name in names if name != of_time[0]]
    columns = [columns] if isinstance(columns, str) else columns
    chosen = {channel: _with_factor(of) for channel, of in _pairs(columns)}
    for name, _ in (of_time, *chosen.values()):
        if name not in names:
            raise ValueError(f"the table must have a column {name!r}, but has {', '.join(map(repr, names))}. Name it in the first line.")
    ts = column(of_time[0])
    ts = ts - ts[0] if from_zero else ts  # before they are scaled: so late times keep their digits
    times = lambda values, factor: values if factor == 1 else values * factor
    return times(ts, of_time[1]), {channel: times(column(name), factor) for channel, (name, factor) in chosen.items()}


def _pairs(columns: Any) -> Iterable[tuple[str, Any]]:
    return columns.items() if isinstance(columns, Mapping) else [(_with_factor(of)[0], of) for of in columns]


def _with_factor(column: Any) -> tuple[str, float]:
    if isinstance(column, str):
        return column, 1.0
    if isinstance(column, tuple) and len(column) == 2 and isinstance(column[0], str) and isinstance(column[1], (int, float)):
        return column
    raise ValueError(f"a column must be a name, or a name and a factor, but is {column!r}. Write e.g. `('laser_mm', 1e-3)`.")


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _date(text: str) -> datetime.datetime | None:
    """A date and time by ISO 8601, or with the day first."""
    plain = PLAIN_DATE.fullmatch(text)
    iso = "{2}-{1:0>2}-{0:0>2} {3}".format(*plain.groups()) if plain else text
    try:
        return datetime.datetime.fromisoformat(iso.replace(",", "."))
    except ValueError:
        return None


def write_text(file: str | Path, columns: Mapping[str, Any]) -> None:
    """Columns by name, of one length, with all their digits; what is missing is an empty cell."""
    with open(file, "w", newline="", encoding="utf-8") as stream:
        rows = csv.writer(stream)
        rows.writerow(columns)
        cells = [[repr(float(x)) if np.isfinite(x) else "" for x in column] for column in columns.values()]
        rows.writerows(zip(*cells, strict=True))
