"""Factors of a matrix that may be singular: then something is added to its diagonal, and what it solves is refined by what is left."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .conditions import repeated, zeros_like

SHIFT = 0.35  # exponent of eps: what is added then, in units in which the matrix has numbers near one
GROWTH = 0.85  # exponent of 1/eps: what the inverse makes of a number then; that of a straight chain of m links makes m²/8 of it
REFINEMENTS = 12, 400  # times that a solution is put right then, at least and at most: a straight chain of 1000 links takes 40
LIGHT = 0.25  # exponent of eps: a number on the diagonal relative to the largest, below which it sets no scale


def shifted_where_singular(factored: Callable, probed: Callable, shift: Array, is_work: bool = True) -> tuple[Any, Bool[Array, ""]]:
    """Factors without a shift, or with it where the inverse makes too much of a vector at random; and whether that is so. They stand in
    the program once, but where making them `is_work` no more than adding the shift.
    """
    is_singular = lambda factors: ~jnp.all(jnp.abs(probed(factors)) < jnp.finfo(shift.dtype).eps ** -GROWTH)
    if not is_work:
        shifted = is_singular(factored(jnp.zeros_like(shift)))
        return factored(jnp.where(shifted, shift, 0)), shifted

    def attempt(carry):
        _, _, shifted = carry
        factors = factored(jnp.where(shifted, shift, 0))
        again = is_singular(factors) & ~shifted
        return factors, again, again | shifted

    nothing = zeros_like(jax.eval_shape(factored, shift))
    start = nothing, jnp.array(True), jnp.array(False)
    factors, _, shifted = lax.while_loop(lambda carry: carry[1], attempt, start)
    return factors, shifted


def refine(once: Callable, matvec: Callable, b: Array, least: int, shifted: Bool[Array, ""]) -> Array:
    """A⁻¹ b by `once(b)`, which is near it, and by what is left of that: `least` times, and where the factors are `shifted` some times, and
    then as long as the changes shrink and are more than rounding. NaN where they still do after all that.
    """
    (few, most), largest = REFINEMENTS, lambda x: jnp.max(jnp.abs(x), initial=0.0)

    def turn(carry):
        x, change, _, i = carry
        new = once(b - matvec(x))
        return x + new, largest(new), change, i + 1

    def going_on(carry):
        x, change, before, i = carry
        shrinking = (change < before) & (change > 4 * jnp.finfo(b.dtype).eps * largest(x))
        return (i < least) | (shifted & ((i < few) | (shrinking & (i < most))))

    unknown = jnp.asarray(jnp.inf, b.dtype)
    x, change, before, i = repeated(turn, (once(b), unknown, unknown, 0), going_on, shifted | (least > 0))
    to_come = change**2 / jnp.where(before > change, before - change, 1)  # of a geometric series
    is_found = ~shifted | (i < most) | (to_come <= jnp.finfo(b.dtype).eps ** 0.5 * largest(x))
    return jnp.where(is_found, x, jnp.nan)


def inverse_lengths(squares: Float[Array, "*m"], least: int | None = None) -> tuple[Float[Array, "*m"], Bool[Array, "*m"]]:
    """1/√ of the squares of lengths, 0 where they are not above the `least`, and where they are; without one, more than rounding beside
    the largest: a row of nothing but that has no part in a matrix.
    """
    present = squares > ((4 * jnp.finfo(squares.dtype).eps) ** 2 * jnp.max(squares) if least is None else least)
    return jnp.where(present, lax.rsqrt(jnp.where(present, squares, 1)), 0), present


def shifts(D: Float[Array, "*m"], present: Bool[Array, "*m"]) -> Float[Array, "*m"]:
    """What is added to the diagonal of a matrix whose rows are scaled by D: as much for each in the units given, about eps^`SHIFT`."""
    mean = jnp.sum(jnp.where(present, jnp.log(jnp.where(present, D, 1)), 0)) / jnp.maximum(jnp.sum(present), 1)
    return jnp.finfo(D.dtype).eps ** SHIFT * D**2 * jnp.exp(-2 * mean)


def scales(diagonal: Float[Array, " n"]) -> Float[Array, " n"]:
    """The sizes of a diagonal, those that are (next to) nothing relative to the largest raised; ones where all are nothing."""
    size = jnp.abs(diagonal)
    largest = jnp.max(size)
    return jnp.where(largest > 0, jnp.maximum(size, jnp.finfo(size.dtype).eps ** LIGHT * largest), 1)


def signs(shape: tuple[int, ...], dtype: Any) -> Float[Array, "..."]:
    """A vector at random, in no null space but by chance."""
    return jnp.asarray(np.random.default_rng(0).choice([-1.0, 1.0], shape), dtype)
