"""What goes wrong in a user's function, said of its own line: operations that JAX cannot trace, and functions made anew again and again."""

import contextlib
import dataclasses
import functools
import inspect
import os
import sys
import traceback
import warnings
import weakref
from collections.abc import Callable, Iterator
from types import CodeType, TracebackType
from typing import Any

import equinox as eqx
import jax
import jaxlib
import numpy as np

LIBRARIES = tuple(os.path.dirname(os.path.abspath(str(module.__file__))) + os.sep for module in (jax, jaxlib, eqx, np, contextlib))
HERE = os.path.dirname(os.path.dirname(os.path.abspath(__file__))) + os.sep  # the package

CHOICE = "Write `jnp.where(condition, a, b)` for `if`, `and` and masks, `jnp.maximum(a, b)` for `max`."
NUMPY = "Write `jnp.sin` for `np.sin`, and so on, after `import jax.numpy as jnp`."
PLAIN = "Write `jnp.sin` for `math.sin`, and so on, and leave out `float(...)` and `.item()`."
COUNT = (
    "What is in params or q is differentiated, so it cannot count or index. Keep a whole number apart from params: as a default value, "
    "`def f(q, n=3)`, by `functools.partial(f, n=3)`, or as the length of an array."
)
INTEGER_WANTED = (  # what JAX says where a number that it traces was to be an integer, in errors of no kind of their own
    "Only integer scalar arrays can be converted",
    "Shapes must be 1D sequences of concrete values",
    "Indexer must have integer",
    "Slice entries must be static integers",
    "expected a sequence of integers or a single integer",
)


@contextlib.contextmanager
def told_by_line(role: str) -> Iterator[None]:
    """Turns JAX's errors about what it traces into a sentence with the user's line and the cure."""
    try:
        yield
    except (TypeError, IndexError) as error:
        cure = _cure(error)
        if cure is None:
            raise
        where = _line_of(error.__traceback__)
        raise TypeError(
            f"{role} must be written in operations that JAX can trace, for it is differentiated and compiled, but {where} is not. {cure}"
        ) from error


def _cure(error: Exception) -> str | None:
    if isinstance(error, (jax.errors.TracerBoolConversionError, jax.errors.NonConcreteBooleanIndexError)):
        return CHOICE
    if isinstance(error, jax.errors.TracerArrayConversionError):
        return NUMPY
    said = str(error)
    if isinstance(error, jax.errors.ConcretizationTypeError):
        return PLAIN if "`float` function" in said or "item()" in said else COUNT
    if isinstance(error, jax.errors.TracerIntegerConversionError) or any(text in said for text in INTEGER_WANTED):
        return COUNT
    return None


def _line_of(trace: TracebackType | None) -> str:
    """The innermost line that is neither of this package nor of JAX."""
    frames = traceback.extract_tb(trace)
    users = [frame for frame in frames if not frame.filename.startswith((*LIBRARIES, HERE))]
    frame = (users or frames)[-1]
    return f"line {frame.lineno} of {frame.filename}" + (f", `{frame.line}`," if frame.line else "")


REPEATS = 3  # of a function with one body in systems of one kind: then it is made anew in a loop

_met: weakref.WeakSet = weakref.WeakSet()
_times_made: weakref.WeakKeyDictionary[CodeType, dict[str, int]] = weakref.WeakKeyDictionary()


def warn_of_functions_made_anew(functions: list[tuple[str, Callable]], shapes: Any) -> None:
    """Warns once where functions that differ in nothing but what they hold are compiled again and again; holds none of them.

    `functions` are those of one system with how messages speak of them; `shapes` of what they are compiled for, for other shapes have to
    be compiled anyway.
    """
    by_code: dict[CodeType, list[tuple[str, Any]]] = {}
    for role, function in functions:
        for part in _parts(function):
            by_code.setdefault(part.__code__, []).append((role, part))
    kind = str(([role for role, _ in functions], shapes))
    for code, made in by_code.items():
        anew = not any(function in _met for _, function in made)
        for _, function in made:
            _met.add(function)
        counts = _times_made.setdefault(code, {})
        counts[kind] = counts.get(kind, 0) + anew
        if anew and counts[kind] == REPEATS:
            warnings.warn(
                f"{made[0][0]} must be made once to be compiled once, but `{code.co_name}`, line {code.co_firstlineno} of "
                f"{code.co_filename}, was made anew {REPEATS} times, and each time all is compiled again. Define it and the system "
                "once, outside of the loop, and let what changes be an entry of params.",
                stacklevel=_levels_to_the_user(),
            )


def _parts(function: Any) -> Iterator[Any]:
    """The plain functions that a function is made from."""
    function = inspect.unwrap(function)
    if isinstance(function, functools.partial):
        yield from _parts(function.func)
    elif hasattr(function, "__func__"):
        yield from _parts(function.__func__)
    elif hasattr(function, "__code__"):
        yield function
    elif dataclasses.is_dataclass(function):
        for field in dataclasses.fields(function):
            if callable(part := getattr(function, field.name, None)):
                yield from _parts(part)


def _levels_to_the_user() -> int:
    """How far up from the caller the first line is that is of no library."""
    frame, level = sys._getframe(1), 1
    while frame.f_back is not None and frame.f_code.co_filename.startswith((*LIBRARIES, HERE)):
        frame, level = frame.f_back, level + 1
    return level
