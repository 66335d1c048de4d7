"""Programs cut at their running sums: what lies between the cuts touches few numbers each.

Positions of a chain in joint angles are sums of all links before, x = Σ l sin φ: each velocity depends on half of q̇, and ∂²L/∂q̇² is full.
With the running sums w = (u₁, u₁ + u₂, …) as further unknowns, L(q̇, w) and the summands u(q̇, w) are sparse again. A product with a
triangle of ones is a running sum, too, and so is what a scan adds up; and a number that is repeated along an axis, of itself and zeros.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .constants import as_function, fold_by_jax, has_extended_dtype, is_numeric
from .expressions import TooLong
from .primitives import CALLS, ELEMENTWISE
from .sparse_jacobian import entries
from .sparse_matrix import SparseMatrix, colors
from .sparsity import dependence
from .sums_in_scans import in_running_sums
from .walker import called_program, primitive_names, walk

MIN_LENGTH = 16  # of an axis, from which on a sum along it is cut
MAX_COLORS = 48  # directions of a chain of bodies in space with some sums each; more, and it is not sparse between the cuts


class RunningSum(NamedTuple):
    """Sums along an axis, from its start or from its end."""

    shape: tuple[int, ...]
    axis: int
    reverse: bool

    @property
    def size(self) -> int:
        """How many sums there are."""
        return int(np.prod(self.shape))

    def along(self) -> np.ndarray:
        """For each sum how many come before it."""
        place = np.arange(self.shape[self.axis])[:: -1 if self.reverse else 1]
        return np.broadcast_to(np.expand_dims(place, [d for d in range(len(self.shape)) if d != self.axis]), self.shape).ravel()

    def before(self) -> np.ndarray:
        """For each sum the number of the one before it; −1 where it is the first."""
        number = np.arange(self.size).reshape(self.shape)
        return np.where(self.along() > 0, np.roll(number, -1 if self.reverse else 1, self.axis).ravel(), -1)

    def summed(self, u: Float[Array, "s *k"], transposed: bool = False) -> Float[Array, "s *k"]:  # noqa: F821
        """The sums of the summands u, or the transpose of that."""
        columns = u.reshape(*self.shape, *u.shape[1:])
        return jax.lax.cumsum(columns, self.axis, reverse=self.reverse != transposed).reshape(u.shape)


class Lifted(NamedTuple):
    """∂(∂L/∂z, u)/∂z with z = (x, w): the slopes of L, and below them those of the summands."""

    slopes: SparseMatrix
    sums: tuple[RunningSum, ...]


def lifted(function: Callable, x: Float[Array, " n"]) -> Lifted | None:
    """The second derivatives of a scalar f(x) between the cuts; None where it has no running sums of x, or is not sparse between them, or
    where summands are not affine in x: then f'' has more to it than these.
    """
    closed = jax.make_jaxpr(function)(x)
    at_x, looked = _Cuts(), _Cuts()
    jax.eval_shape(lambda x: looked.run(closed, x), x)
    if not looked.sums:
        return None
    at_x.run(closed, x)
    z = jnp.concatenate([x, *at_x.values])
    ends = np.cumsum([x.size, *(s.size for s in at_x.sums)])[:-1]

    def between(z):
        given, *sums = jnp.split(z, ends)
        cuts = _Cuts(sums)
        total = cuts.run(closed, given)
        return total, jnp.concatenate(cuts.summands)

    def slopes(z):
        return jnp.concatenate(jax.grad(between, has_aux=True)(z))

    def turned(at_and_along):
        """How the summands change, along a direction of which nothing is known: of one of ones some products would be seen to be zero."""
        at, along = jnp.split(at_and_along, 2)
        return jax.jvp(lambda z: between(z)[1], (at,), (along,))[1]

    try:
        turning = dependence(turned, jax.ShapeDtypeStruct((2 * z.size,), z.dtype))[:, : z.size]
        pattern = dependence(slopes, z)
    except TooLong:
        return None
    if turning.nnz or np.diff(pattern.indptr).max() > MAX_COLORS or max(color := colors(pattern)) >= MAX_COLORS:
        return None
    return Lifted(entries(jax.linearize(slopes, z)[1], color, pattern, z), tuple(at_x.sums))


class _Cuts:
    """A walk over a program that notes running sums, or puts others in their place. Values are pairs: an array, and whether it depends
    on x.
    """

    def __init__(self, given: list[Array] | None = None):
        self.given = given
        self.needs_numbers = False
        self.sums: list[RunningSum] = []
        self.values: list[Array] = []
        self.summands: list[Array] = []

    def run(self, closed: Any, x: Array) -> Array:
        """The result."""
        self.dtype = x.dtype  # of what is cut: numbers of another kind stay as they are
        self.needs_numbers = bool({"dot_general", "scan"}.intersection(primitive_names(closed)))
        return self.within(closed, [(x, True)])[0][0]

    def within(self, program: Any, operands: list) -> list:
        """The results of a program, or of one that it calls."""
        return walk(program, operands, self.equation, lambda array: (array, False))

    def equation(self, equation: Any, operands: list) -> list:
        """The rule of running sums; all else is as it was."""
        name, p = equation.primitive.name, equation.params
        arrays, depends = [array for array, _ in operands], any(moves for _, moves in operands)
        is_known = not depends and all(map(is_numeric, arrays)) and not any(map(has_extended_dtype, equation.outvars))
        if self.needs_numbers and is_known:  # something may be multiplied by it, or gather_static
            return [(array, False) for array in fold_by_jax(equation, arrays)]
        same = equation.outvars and equation.outvars[0].aval.dtype == self.dtype
        if name == "dot_general" and same and (product := _as_running_sum(arrays, [moves for _, moves in operands], p)) is not None:
            return [(self.cut(*product), True)]
        if depends and name in CALLS:
            return self.within(called_program(equation), operands)
        if depends and name == "cumsum" and arrays[0].dtype == self.dtype and arrays[0].shape[p["axis"]] >= MIN_LENGTH:
            return [(self.cut(arrays[0], RunningSum(arrays[0].shape, p["axis"], p["reverse"])), True)]
        if depends and name == "scan" and p["length"] >= MIN_LENGTH:
            along = lambda summands, reverse: self.cut(summands, RunningSum(summands.shape, 0, reverse))
            if (found := in_running_sums(equation, arrays, [moves for _, moves in operands], along, self.dtype)) is not None:
                return found
        if depends and name == "broadcast_in_dim":
            array = jnp.expand_dims(arrays[0], [d for d in range(len(p["shape"])) if d not in p["broadcast_dimensions"]])
            return [(self.repeated(array, p["shape"]), True)]
        if depends and name in ELEMENTWISE:
            shape = equation.outvars[0].aval.shape
            whole = lambda array: self.repeated(array if np.ndim(array) else jnp.reshape(array, [1] * len(shape)), shape)
            arrays = [whole(array) if moves and np.shape(array) != shape else array for array, moves in operands]
        return [(array, depends) for array in as_function(equation)(*arrays)]

    def repeated(self, array: Array, shape: tuple[int, ...]) -> Array:
        """Broadcast to a shape; along the axis that grows most by a running sum of the array and zeros."""
        growth = [of if had == 1 else 1 for had, of in zip(array.shape, shape, strict=True)]
        if max(growth, default=1) >= MIN_LENGTH and array.dtype == self.dtype:
            axis = int(np.argmax(growth))
            summands = jnp.concatenate([array, jnp.repeat(jnp.zeros_like(array), shape[axis] - 1, axis)], axis)
            array = self.cut(summands, RunningSum(summands.shape, axis, False))
        return jnp.broadcast_to(array, shape)

    def cut(self, summands: Array, kind: RunningSum) -> Array:
        """The sums of these, or those given."""
        w = kind.summed(summands.ravel()) if self.given is None else self.given[len(self.sums)]
        self.sums.append(kind)
        self.values.append(w)
        self.summands.append(summands.ravel())
        return w.reshape(kind.shape)


def _as_running_sum(arrays: list, depends: list[bool], p: dict) -> tuple[Array, RunningSum] | None:
    """The summands of a product with a triangle of ones along one axis, and their sums; None where it is another product."""
    (contracted, batch), at = p["dimension_numbers"], depends.index(True) if any(depends) else 0
    x, K = arrays[at], arrays[1 - at]
    is_matrix = sum(depends) == 1 and is_numeric(K) and np.ndim(K) == 2 and K.shape[0] == K.shape[1] >= MIN_LENGTH
    if not is_matrix or len(contracted[0]) != 1 or batch[0]:
        return None
    A = np.asarray(K) if contracted[1 - at] == (1,) else np.asarray(K).T
    reverse = not np.array_equal(A, np.tril(np.ones(A.shape)))
    if reverse and not np.array_equal(A, np.triu(np.ones(A.shape))):
        return None
    axis = 0 if at else x.ndim - 1  # where the axis of the matrix stands in the product
    summands = jnp.moveaxis(x, contracted[at][0], axis)
    return summands, RunningSum(summands.shape, axis, reverse)
