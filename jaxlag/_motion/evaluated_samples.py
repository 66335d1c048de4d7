"""Samples between steps, by the evaluation that steps have: rows of y, put back on its constraints, and the friction there."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._mechanics.stick_slip import Friction
from .._program.conditions import zeros_like
from .._program.whole_kernel import in_whole_kernel
from .first_order import EquationsOfMotion
from .interval_inputs import packed
from .protocol import Arguments
from .variational import varied_along, with_variations


def evaluated(equations: EquationsOfMotion, t, y: Float[Array, " y"], args: Arguments) -> Float[Array, " r"]:
    """The row of a sample of a motion without contacts."""
    _, count = equations.corrections

    def turn(carry):
        k, y, _ = carry
        parts, correction = equations.parts(y), equations.correction(jnp.where(k < count, k, -1))
        _, found = equations.rates_and_friction(t, parts, args, None, correction, k == count)
        y = equations.where_corrected(t, parts, args, found, jnp.where(k < count, k, -1), y)
        return equations.next_correction(parts, found, k), y, found

    nothing = zeros_like(_like(equations, t, y, args))
    _, y, found = jax.lax.while_loop(lambda carry: carry[0] <= count, turn, (jnp.array(0), y, nothing))
    return jnp.concatenate([y, *(jnp.ravel(x).astype(y.dtype) for x in found)])


def rows_of(
    equations: EquationsOfMotion, ts, ys: Array, last: tuple[Array, Array], args: Arguments, directions: tuple
) -> tuple[Array, Array]:
    """The rows of states at samples, and of the last one, with variations along directions of params, for each order, as last axes.

    In a kernel of its own beside that of the steps: together they take longer to compile.
    """
    last_t, last_y = last
    for size in ys.shape[2:]:
        last_y = with_variations(last_y, jnp.zeros((*last_y.shape, size - 1), ys.dtype))
    times, states = jnp.concatenate([ts, last_t[None]]), jnp.concatenate([ys, last_y[None]])
    size = jax.eval_shape(lambda: evaluated(equations, last_t, last[1], args)).size
    count, shape, wide = len(states), states.shape[1:], (size, *states.shape[2:])
    given, unpack, rows = packed((jax.lax.stop_gradient(ts[0]), args, directions), [times, states.reshape(count, -1)])

    def run(given, found):
        (_, args, directions), (times, states) = unpack(given), rows(given)
        of = lambda y, given: (evaluated(equations, given[1], y, args._replace(params=given[0])), None)
        at = varied_along(of, [(of_params, None) for of_params in directions])

        def turn(carry):
            i, found = carry
            row, _ = at(states.at(i).reshape(shape), (args.params, times.at(i)[0]))
            return i + 1, jax.lax.dynamic_update_slice_in_dim(found, row.ravel(), i * row.size, 0)

        return jax.lax.while_loop(lambda carry: carry[0] < count, turn, (jnp.array(0), found))[1]

    found = in_whole_kernel(run)(given, jnp.zeros(count * math.prod(wide), ys.dtype)).reshape(count, *wide)
    return found[:-1], found[(-1, ..., *[0] * len(directions))]


def taken_apart(equations: EquationsOfMotion, t, row: Float[Array, " r"], args: Arguments) -> tuple[Float[Array, " y"], Friction]:
    """y and the friction there, of a row."""
    y, rest = jnp.split(row, [equations.width])
    like = _like(equations, t, y, args)
    parts = jnp.split(rest, np.cumsum([x.size for x in like])[:-1])
    return y, Friction(*(part.astype(x.dtype).reshape(x.shape) for part, x in zip(parts, like, strict=True)))


def _like(equations, t, y, args) -> Friction:
    """Friction in shapes."""
    return jax.eval_shape(lambda: equations.rates_and_friction(t, equations.parts(y), args, None, equations.correction(-1))[1])
