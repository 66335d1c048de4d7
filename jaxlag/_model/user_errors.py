"""Errors in a user's functions, reported at the user's line: operations that JAX cannot trace, and functions recreated in a loop."""

import contextlib
import dataclasses
import functools
import inspect
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator
from types import CodeType, TracebackType
from typing import Any

import equinox as eqx
import jax
import jaxlib
import numpy as np

from .._program.kept_programs import CompiledAgain
from .._program.registry import Table

LIBRARIES = tuple(os.path.dirname(os.path.abspath(str(module.__file__))) + os.sep for module in (jax, jaxlib, eqx, np, contextlib))
HERE = os.path.dirname(os.path.dirname(os.path.abspath(__file__))) + os.sep  # the package

CHOICE = "Write `jnp.where(condition, a, b)` for `if`, `and` and masks, `jnp.maximum(a, b)` for `max`."
NUMPY = "Write `jnp.sin` for `np.sin`, and so on, after `import jax.numpy as jnp`."
PLAIN = "Write `jnp.sin` for `math.sin`, and so on, and omit `float(...)` and `.item()`."
COUNT = (
    "Entries of params and q are differentiated, so they cannot count or index. Keep an integer out of params: pass it as a default value, "
    "`def f(q, n=3)`, with `functools.partial(f, n=3)`, or as the length of an array."
)
INTEGER_WANTED = (  # what JAX says where it needs an integer but got a tracer, in errors without a class of their own
    "Only integer scalar arrays can be converted",
    "Shapes must be 1D sequences of concrete values",
    "Indexer must have integer",
    "Slice entries must be static integers",
    "expected a sequence of integers or a single integer",
)


@contextlib.contextmanager
def explain_tracing_errors(role: str) -> Iterator[None]:
    """Turns JAX's tracing errors into a sentence with the user's line and the cure."""
    try:
        yield
    except (TypeError, IndexError) as error:
        cure = _cure(error)
        if cure is None:
            raise
        where = _line_of(error.__traceback__)
        raise TypeError(
            f"{role} must be written in operations that JAX can trace, since it is differentiated and compiled, but {where} is not. {cure}"
        ) from error


def _cure(error: Exception) -> str | None:
    if isinstance(error, (jax.errors.TracerBoolConversionError, jax.errors.NonConcreteBooleanIndexError)):
        return CHOICE
    if isinstance(error, jax.errors.TracerArrayConversionError):
        return NUMPY
    message = str(error)
    if isinstance(error, jax.errors.ConcretizationTypeError):
        return PLAIN if "`float` function" in message or "item()" in message else COUNT
    if isinstance(error, jax.errors.TracerIntegerConversionError) or any(text in message for text in INTEGER_WANTED):
        return COUNT
    return None


def _line_of(trace: TracebackType | None) -> str:
    """The innermost line of code that belongs neither to this package nor to JAX."""
    frames = traceback.extract_tb(trace)
    users = [frame for frame in frames if not frame.filename.startswith((*LIBRARIES, HERE))]
    frame = (users or frames)[-1]
    return f"line {frame.lineno} of {frame.filename}" + (f", `{frame.line}`," if frame.line else "")


RECREATIONS = 3  # of one function body in systems of one kind, from which on it counts as recreated in a loop

_seen = Table(weak=True)  # functions
_creations = Table(weak=True)  # of each function body, by the kind of its system


def warn_of_recreated_functions(functions: list[tuple[str, Callable]], shapes: Any) -> None:
    """Warns once where functions that differ only in what they close over are compiled again and again; keeps none of them alive.

    `functions` are those of one system, each with its name in messages; `shapes` are those they are compiled for: other shapes have to be
    compiled anyway.
    """
    by_code: dict[CodeType, list[tuple[str, Any]]] = {}
    for role, function in functions:
        for part in _parts(function):
            by_code.setdefault(part.__code__, []).append((role, part))
    kind = str(([role for role, _ in functions], shapes))
    for code, made in by_code.items():
        is_new = not any(function in _seen for _, function in made)
        for _, function in made:
            _seen[function] = True
        counts = _creations.setdefault(code, {})
        counts[kind] = counts.get(kind, 0) + is_new
        if is_new and counts[kind] == RECREATIONS:
            warnings.warn(
                f"{made[0][0]} must be made once to be compiled once, but `{code.co_name}`, line {code.co_firstlineno} of "
                f"{code.co_filename}, was created {RECREATIONS} times, and each time everything is compiled again. "
                "Define it and the system once, outside the loop, and make what changes an entry of params.",
                CompiledAgain,
                stacklevel=levels_to_the_user(),
            )


def _parts(function: Any) -> Iterator[Any]:
    """The plain functions that a function is composed of."""
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


def levels_to_the_user() -> int:
    """How many frames above the caller the first line lies that belongs to no library."""
    frame, level = sys._getframe(1), 1
    while frame.f_back is not None and frame.f_code.co_filename.startswith((*LIBRARIES, HERE)):
        frame, level = frame.f_back, level + 1
    return level
