"""Numbers as a user hands them over: text, dates and truth values are none, and what is masked is missing."""

import datetime
from collections.abc import Mapping
from numbers import Integral
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._program.jit import is_concrete

TIMES = (datetime.date, datetime.timedelta)  # as they stand in arrays of objects
DATES = "Count the time from a start, e.g. `(times - times[0]) / np.timedelta64(1, 's')`."


def numbers(given: Any, spoken: str, dtype: Any = None) -> Float[Array, "..."]:
    """`given` as a floating array: of `dtype`, or of its own, where it has one that JAX knows."""
    array = _array(given, spoken)
    if array.dtype == bool or jnp.issubdtype(array.dtype, jnp.complexfloating):
        raise TypeError(f"{spoken} must be real, but has dtype {array.dtype}. Hand over floating-point numbers.")
    known = jnp.issubdtype(array.dtype, jnp.floating) and array.dtype.itemsize <= 8  # NumPy's long double is not
    own = jax.dtypes.canonicalize_dtype(array.dtype) if known else float
    return jnp.asarray(array if known else array.astype(float), own if dtype is None else dtype)


def number(given: Any, spoken: str, dtype: Any = None, *, positive: bool = False, least: float = -np.inf, cure: str) -> Float[Array, ""]:
    """One such number, which is finite and not beyond its limits, as far as it is known."""
    x = numbers(given, spoken, dtype)
    if x.shape != ():
        raise ValueError(f"{spoken} must be one number, but has shape {x.shape}. {cure}")
    if is_concrete(x) and not (np.isfinite(x) and x >= least and (x > 0 or not positive)):
        wanted = "finite" if not np.isfinite(x) else "positive" if positive else f"at least {least:g}"
        raise ValueError(f"{spoken} must be {wanted}, but is {x:g}. {cure}")
    return x


def count(given: Any, spoken: str, *, least: int = 1, cure: str) -> int:
    """A whole number from `least` on."""
    if not isinstance(given, Integral) or isinstance(given, bool):
        raise TypeError(f"{spoken} must be a whole number, but is {given!r}. {cure}")
    if given < least:
        raise ValueError(f"{spoken} must be at least {least}, but is {given}. {cure}")
    return int(given)


def _array(given: Any, spoken: str) -> np.ndarray | Array:
    array = None
    try:
        if isinstance(given, np.ma.MaskedArray):
            given = np.ma.filled(given.astype(float), np.nan)
        if not isinstance(given, Mapping):
            array = jnp.asarray(given) if any(isinstance(x, jax.Array) for x in jax.tree.leaves(given)) else np.asarray(given)
    except (TypeError, ValueError):
        pass
    kind = "O" if array is None else array.dtype.kind
    is_number = (
        array is not None and (jnp.issubdtype(array.dtype, jnp.number) or kind == "b") and kind != "m"
    )  # NumPy's durations are integers
    if array is None or not is_number:
        what, cure = "none", "Hand over rows of equal length."
        if kind in "SU":
            what, cure = "text", "Read the numbers out of it first, by `float`."
        if kind in "mM" or (array is not None and isinstance(next(iter(np.ravel(array)), None), TIMES)):
            what, cure = "a date", DATES
        raise TypeError(f"{spoken} must be an array of real numbers, but is a {type(given).__name__} that is {what}. {cure}")
    return array
