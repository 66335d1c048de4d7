"""Interval arithmetic: bounds on the results of JAX's operations, whose operands lie anywhere between two values.

Where no good bounds are known, they are −∞ and ∞.
Source: Moore, Kearfott & Cloud, Introduction to Interval Analysis (2009), chapters 2 and 5.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Interval = tuple[Any, Any]  # the least and the greatest value, of arrays element by element
WINDOW = 8  # elements of a table that are looked up at once


def _extremes(dtype) -> tuple[Any, Any]:
    if jnp.issubdtype(dtype, bool):
        return False, True
    return (-np.inf, np.inf) if jnp.issubdtype(dtype, jnp.inexact) else (jnp.iinfo(dtype).min, jnp.iinfo(dtype).max)


def anything(aval) -> Interval:
    """The interval of an array of which nothing is known."""
    least, most = _extremes(aval.dtype)
    return jnp.full(aval.shape, least, aval.dtype), jnp.full(aval.shape, most, aval.dtype)


def _where_known(where, low, high) -> Interval:
    least, most = _extremes(low.dtype)
    return jnp.where(where, low, jnp.asarray(least, low.dtype)), jnp.where(where, high, jnp.asarray(most, low.dtype))


def without_nan(low, high) -> Interval:
    """Where an operation is undefined at an end of the interval, or is ∞ − ∞, its result may be anything."""
    if not jnp.issubdtype(jnp.result_type(low), jnp.floating):
        return low, high
    return _where_known(~(jnp.isnan(low) | jnp.isnan(high)), low, high)


def hull(*values) -> Interval:
    """The least and the greatest of some arrays."""
    return functools.reduce(jnp.minimum, values), functools.reduce(jnp.maximum, values)


def _product(_, x, y):
    if x is y:  # a square
        return _even(jnp.square, x)
    return hull(*(jnp.where((a == 0) | (b == 0), 0, a * b) for a in x for b in y))


def _quotient(_, x, y):
    through_zero = (y[0] <= 0) & (y[1] >= 0)
    low, high = hull(*(a / b for a in x for b in y))
    return jnp.where(through_zero, -jnp.inf, low), jnp.where(through_zero, jnp.inf, high)


def _even(power, x):
    """An even power, which is least at zero."""
    ends = power(x[0]), power(x[1])
    return jnp.where((x[0] <= 0) & (x[1] >= 0), 0, jnp.minimum(*ends)), jnp.maximum(*ends)


def _integer_power(params, x):
    n = params["y"]
    if n < 0:
        one = jnp.ones_like(x[0])
        return _quotient(None, (one, one), _integer_power({"y": -n}, x))
    power = lambda x: x**n
    return _even(power, x) if n % 2 == 0 else (power(x[0]), power(x[1]))


def _power(_, x, y):
    """xʸ of a base that is nowhere negative; of others anything, for not even the sign is known."""
    low, high = hull(*(a**b for a in x for b in y))
    return jnp.where(x[0] >= 0, low, jnp.nan), high


def _cosine(x):
    """Between its values at the ends, unless a multiple of π lies between them."""
    has_maximum = jnp.floor(x[1] / (2 * jnp.pi)) >= jnp.ceil(x[0] / (2 * jnp.pi))
    has_minimum = jnp.floor(x[1] / (2 * jnp.pi) - 0.5) >= jnp.ceil(x[0] / (2 * jnp.pi) - 0.5)
    low, high = hull(jnp.cos(x[0]), jnp.cos(x[1]))
    return jnp.where(has_minimum, -1, low), jnp.where(has_maximum, 1, high)


def _tangent(_, x):
    within = jnp.floor(x[0] / jnp.pi + 0.5) == jnp.floor(x[1] / jnp.pi + 0.5)
    return jnp.where(within, jnp.tan(x[0]), -jnp.inf), jnp.where(within, jnp.tan(x[1]), jnp.inf)


def _remainder(_, x, y):
    size = jnp.maximum(jnp.abs(y[0]), jnp.abs(y[1]))
    period = lambda a: jnp.trunc(a / y[0])
    within = (y[0] == y[1]) & (period(x[0]) == period(x[1])) & (jnp.sign(x[0]) == jnp.sign(x[1]))
    low, high = (jax.lax.rem(end, y[0]) for end in x)
    return jnp.where(within, low, jnp.where(x[0] < 0, -size, 0)), jnp.where(within, high, jnp.where(x[1] > 0, size, 0))


def _convert(params, x):
    """To another dtype: to truth values, which say whether a number is not zero, or to integers, whose range may be too small."""
    kind = params["new_dtype"]
    if jnp.issubdtype(kind, bool):
        return (x[0] > 0) | (x[1] < 0), (x[0] != 0) | (x[1] != 0)
    return _rounded_to_integers(kind, *x) if jnp.issubdtype(kind, jnp.integer) else tuple(jnp.asarray(end, kind) for end in x)


def _rounded_to_integers(kind, low, high) -> Interval:
    """Integers that were computed as real numbers; anything where they are too large to be exact, or for their dtype."""
    limit = 1 / float(jnp.finfo(float).eps)
    fits = (low >= max(-limit, float(jnp.iinfo(kind).min))) & (high <= min(limit, float(jnp.iinfo(kind).max)))
    return _where_known(fits, *(jnp.where(fits, jnp.trunc(end), 0).astype(kind) for end in (low, high)))


def in_integers(kind, rule: Callable, operands) -> Interval:
    """A rule of arithmetic on integers, which wrap around beyond the greatest one."""
    return _rounded_to_integers(kind, *rule(*(tuple(end.astype(float) for end in x) for x in operands)))


def _finite(x):
    fine = jnp.isfinite(x[0]) & jnp.isfinite(x[1])
    return fine, jnp.ones_like(fine)


def _equal(x, y):
    if x is y:
        return hull(jnp.ones_like(x[0], bool))
    return (x[0] == x[1]) & (y[0] == y[1]) & (x[0] == y[0]), (x[0] <= y[1]) & (y[0] <= x[1])


def _select(_, which, *cases):
    low, high = functools.reduce(jnp.minimum, [x for x, _ in cases]), functools.reduce(jnp.maximum, [x for _, x in cases])
    known = which[0] == which[1]
    one = [jax.lax.select_n(jnp.broadcast_to(which[0], jnp.shape(low)), *(x[end] for x in cases)) for end in (0, 1)]
    return jnp.where(known, one[0], low), jnp.where(known, one[1], high)


def _reduce_prod(params, x):
    """A product of elements, one after the other."""
    axes = params["axes"]
    ends = [jnp.moveaxis(end, axes, range(len(axes))).reshape(-1, *np.delete(end.shape, axes)) for end in x]
    return functools.reduce(lambda x, y: _product({}, x, y), zip(*ends, strict=True))


def _dot_general(params, x, y):
    """A product of matrices, by midpoints and radii."""
    product = functools.partial(jax.lax.dot_general, **{key: params[key] for key in ("dimension_numbers", "precision")})
    (cx, rx), (cy, ry) = (((low + high) / 2, (high - low) / 2) for low, high in (x, y))
    centre, radius = product(cx, cy), product(jnp.abs(cx), ry) + product(rx, jnp.abs(cy)) + product(rx, ry)
    return centre - radius, centre + radius


def _table_lookup(take, table, *indices):
    """Elements of a table at indices that are not quite known: the extremes of the candidates, where these are few."""
    widths = [high - low for low, high in indices if low is not high]
    windows = [[low + jnp.minimum(k, high - low).astype(low.dtype) for low, high in indices] for k in range(WINDOW)]
    tables = table[:1] if table[0] is table[1] else table
    found = hull(*(take(x, *window) for window in windows for x in tables))
    is_narrow = jnp.all(jnp.stack([jnp.all(width < WINDOW) for width in widths])) if widths else True
    return _where_known(is_narrow if len(widths) <= 1 else False, *found)


def _gather(params, table, index):
    take = functools.partial(jax.lax.gather_p.bind, **params)
    is_single = index[0].shape[-1] == 1 or index[0] is index[1]
    return _table_lookup(take, table, index) if is_single else _where_known(False, *[take(table[0], index[0])] * 2)


def _scatter_add(params, x, index, updates):
    """Updates added to elements at known indices."""
    ends = [jax.lax.scatter_add_p.bind(*end, **params) for end in zip(x, index, updates, strict=True)]
    return _where_known(index[0] is index[1] and jnp.issubdtype(x[0].dtype, jnp.floating), *ends)  # integers may wrap around


def _dynamic_slice(params, table, *starts):
    return _table_lookup(lambda x, *at: jax.lax.dynamic_slice(x, at, params["slice_sizes"]), table, *starts)


INTERVAL_RULES: dict[str, Callable[..., Interval]] = {
    "sub": lambda _, x, y: (x[0] - y[1], x[1] - y[0]) if x is not y else hull(jnp.zeros_like(x[0])),
    "mul": _product,
    "div": _quotient,
    "reduce_prod": _reduce_prod,
    "abs": lambda _, x: _even(jnp.abs, x),
    "square": lambda _, x: _even(jnp.square, x),
    "integer_pow": _integer_power,
    "pow": _power,
    "cos": lambda _, x: _cosine(x),
    "sin": lambda _, x: _cosine((x[0] - jnp.pi / 2, x[1] - jnp.pi / 2)),
    "cosh": lambda _, x: tuple(1 + end for end in _even(lambda x: jnp.cosh(x) - 1, x)),
    "tan": _tangent,
    "rem": _remainder,
    "select_n": _select,
    "dot_general": _dot_general,
    "convert_element_type": _convert,
    "is_finite": lambda _, x: _finite(x),
    "scatter-add": _scatter_add,
    "gather": _gather,
    "dynamic_slice": _dynamic_slice,
    "lt": lambda _, x, y: (x[1] < y[0], x[0] < y[1]),
    "le": lambda _, x, y: (x[1] <= y[0], x[0] <= y[1]),
    "gt": lambda _, x, y: (x[0] > y[1], x[1] > y[0]),
    "ge": lambda _, x, y: (x[0] >= y[1], x[1] >= y[0]),
    "lt_to": lambda _, x, y: (x[1] < y[0], x[0] < y[1]),
    "le_to": lambda _, x, y: (x[1] <= y[0], x[0] <= y[1]),
    "eq": lambda _, x, y: _equal(x, y),
    "ne": lambda _, x, y: tuple(~end for end in reversed(_equal(x, y))),
}  # fmt: skip
