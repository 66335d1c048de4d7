"""Numbers given by the user: text, dates and truth values are refused, and masked values count as missing.

What JAX holds stays with JAX, all else becomes an array of NumPy, which compiled programs take as well: `jnp.asarray(1.0)` takes as
long as the acceleration of a vehicle, 300 times as long as `np.asarray(1.0)`.
"""

import datetime
import math
from collections.abc import Callable, Mapping
from numbers import Integral
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from .._program.jit import compiled, is_concrete, values

TIMES = (datetime.date, datetime.timedelta)  # in arrays of objects
DATES = "Count the time from a start, e.g. `(times - times[0]) / np.timedelta64(1, 's')`."


class Label(NamedTuple):
    """The name of a leaf in messages, put together only where there is one to write."""

    name: str
    tree: Any
    leaf: int
    is_leaf: Callable | None = None

    def __str__(self) -> str:
        path, _ = jax.tree_util.tree_flatten_with_path(self.tree, is_leaf=self.is_leaf)[0][self.leaf]
        return f"`{self.name}{jax.tree_util.keystr(path)}`"


def numbers(given: Any, label: Any, dtype: Any = None) -> Float[Array | np.ndarray, "..."]:
    """`given` as a floating array of `dtype`; without one, of its own dtype where JAX knows that."""
    if type(given) in (float, int, np.float64):  # the usual case first
        return np.asarray(given, _double() if dtype is None else dtype)
    array = _array(given, label)
    if array.dtype.kind in "bc":
        raise TypeError(f"{label} must be real, but has dtype {array.dtype}. Pass floating-point numbers.")
    if dtype is None:
        known = jnp.issubdtype(array.dtype, jnp.floating) and array.dtype.itemsize <= 8  # NumPy's long double is not
        dtype = jax.dtypes.canonicalize_dtype(array.dtype) if known else _double()
    return in_dtype(array, dtype)


def in_dtype(array: Any, dtype: Any) -> Array | np.ndarray:
    """An array of JAX in this dtype, not weakly typed, or a copy of one of NumPy, which its owner may change later."""
    if not isinstance(array, jax.Array):
        return np.array(array, dtype)
    return array if array.dtype == dtype and not jax.typeof(array).weak_type else array.astype(dtype)


def library(*arrays: Any) -> Any:
    """What computes with them: NumPy, which takes microseconds, where all are its own, or `jax.numpy`."""
    return np if all(isinstance(array, (np.ndarray, np.generic, float, int)) for array in arrays) else jnp


def _double():
    """What JAX makes of double precision: single, unless it was allowed."""
    return jax.dtypes.canonicalize_dtype(float)


def number(
    given: Any, label: Any, dtype: Any = None, *, positive: bool = False, least: float = -math.inf, cure: str
) -> Float[Array | np.ndarray, ""]:
    """One number; where it is concrete, it must be finite and within its limits."""
    x = numbers(given, label, dtype)
    if x.shape != ():
        raise ValueError(f"{label} must be one number, but has shape {x.shape}. {cure}")
    if is_concrete(x):
        value = float(x)
        if not (math.isfinite(value) and value >= least and (value > 0 or not positive)):
            wanted = "finite" if not math.isfinite(value) else "positive" if positive else f"at least {least:g}"
            raise ValueError(f"{label} must be {wanted}, but is {value:g}. {cure}")
    return x


@compiled
def none_is_nan(params: PyTree) -> Bool[Array | np.ndarray, ""]:
    """Whether no entry of params is NaN. What a program makes of one may hide it: 0·x is 0, whatever x."""
    leaves = [leaf for leaf in jax.tree.leaves(params) if _may_be_nan(leaf)]
    return ~jnp.any(jnp.stack([jnp.any(jnp.isnan(leaf)) for leaf in leaves])) if leaves else np.array(True)


def where_known(sound: Bool[Array | np.ndarray, ""], tree: PyTree) -> PyTree:
    """The numbers of a tree, where they are sound."""
    return jax.tree.map(lambda x: jnp.where(sound, x, jnp.nan) if _may_be_nan(x) else x, tree)


def _may_be_nan(x: Any) -> bool:
    return jnp.issubdtype(getattr(x, "dtype", int), jnp.inexact)


def refuse_nan(params: PyTree, sound: Bool[Array | np.ndarray, ""] | None = None) -> None:
    """Raises where an entry of params is NaN, unless `jit` or `vmap` hides it; `sound`: `none_is_nan` of params, where it is known."""
    sound = values(none_is_nan(params) if sound is None else sound)
    if sound is None or sound:
        return
    paths, _ = jax.tree_util.tree_flatten_with_path(params)
    names = [jax.tree_util.keystr(path) for path, leaf in paths if not values(none_is_nan(leaf))]
    raise ValueError(f"`params{names[0]}` must be known, but is NaN. Give it a value.")


def count(given: Any, label: str, *, least: int = 1, cure: str) -> int:
    """An integer, at least `least`."""
    if not isinstance(given, Integral) or isinstance(given, bool):
        raise TypeError(f"{label} must be an integer, but is {given!r}. {cure}")
    if given < least:
        raise ValueError(f"{label} must be at least {least}, but is {given}. {cure}")
    return int(given)


def _array(given: Any, label: Any) -> np.ndarray | Array:
    if (isinstance(given, jax.Array) or type(given) is np.ndarray) and given.dtype.kind == "f":
        return given
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
