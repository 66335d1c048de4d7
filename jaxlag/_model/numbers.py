"""Numbers given by the user: text, dates and truth values are refused, and masked values count as missing."""

import datetime
from collections.abc import Mapping
from numbers import Integral
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._program.jit import is_concrete

TIMES = (datetime.date, datetime.timedelta)  # in arrays of objects
DATES = "Count the time from a start, e.g. `(times - times[0]) / np.timedelta64(1, 's')`."


def numbers(given: Any, label: str, dtype: Any = None) -> Float[Array, "..."]:
    """`given` as a floating array of `dtype`; without one, of its own dtype where JAX knows that."""
    array = _array(given, label)
    if array.dtype == bool or jnp.issubdtype(array.dtype, jnp.complexfloating):
        raise TypeError(f"{label} must be real, but has dtype {array.dtype}. Pass floating-point numbers.")
    known = jnp.issubdtype(array.dtype, jnp.floating) and array.dtype.itemsize <= 8  # NumPy's long double is not
    own = jax.dtypes.canonicalize_dtype(array.dtype) if known else float
    return jnp.asarray(array if known else array.astype(float), own if dtype is None else dtype)


def number(given: Any, label: str, dtype: Any = None, *, positive: bool = False, least: float = -np.inf, cure: str) -> Float[Array, ""]:
    """One number; where it is concrete, it must be finite and within its limits."""
    x = numbers(given, label, dtype)
    if x.shape != ():
        raise ValueError(f"{label} must be one number, but has shape {x.shape}. {cure}")
    if is_concrete(x) and not (np.isfinite(x) and x >= least and (x > 0 or not positive)):
        wanted = "finite" if not np.isfinite(x) else "positive" if positive else f"at least {least:g}"
        raise ValueError(f"{label} must be {wanted}, but is {x:g}. {cure}")
    return x


def count(given: Any, label: str, *, least: int = 1, cure: str) -> int:
    """An integer, at least `least`."""
    if not isinstance(given, Integral) or isinstance(given, bool):
        raise TypeError(f"{label} must be an integer, but is {given!r}. {cure}")
    if given < least:
        raise ValueError(f"{label} must be at least {least}, but is {given}. {cure}")
    return int(given)


def _array(given: Any, label: str) -> np.ndarray | Array:
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
        what, cure = "none", "Pass rows of equal length."
        if kind in "SU":
            what, cure = "text", "Convert it to numbers first, with `float`."
        if kind in "mM" or (array is not None and isinstance(next(iter(np.ravel(array)), None), TIMES)):
            what, cure = "a date", DATES
        raise TypeError(f"{label} must be an array of real numbers, but is a {type(given).__name__} that is {what}. {cure}")
    return array
