"""Programs whose small factorisations, solves and products of matrices are written out, so that they call no library, and whose entries
are put in place one after the other, for which the kernels of XLA have no code.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

LARGEST = 8  # rows of a matrix: ten in a loop run in 42 ms for 113, but take five seconds longer to compile
UNROLLED = 3  # rows up to which they are eliminated one after the other, and not in a loop, whose program is shorter
LONG, LONGEST = 2048, 32768  # numbers that are added in a loop: sums of 4096 are left to a library
SWEEPS = 30  # of rotations: some six do


def without_libraries(program: Any) -> Any:
    """A closed program that computes the same without a library where its matrices are small. It has no derivative and no batch."""
    return _Rewriting(RULES | SCATTERS).closed(program)


def without_scatters(program: Any) -> Any:
    """The same program, with but its entries put in place one after the other."""
    return _Rewriting(SCATTERS).closed(program)


class _Rewriting:
    """Each program that is called is rewritten once."""

    def __init__(self, rules):
        self.done, self.rules = {}, rules

    def closed(self, program):
        jaxpr = self.jaxpr(program.jaxpr)
        return program if jaxpr is program.jaxpr else program.replace(jaxpr=jaxpr)

    def jaxpr(self, jaxpr):
        if id(jaxpr) not in self.done:
            equations = [self.equation(e) for e in jaxpr.eqns]
            same = all(new is old for new, old in zip(equations, jaxpr.eqns, strict=True))
            self.done[id(jaxpr)] = jaxpr, jaxpr if same else jaxpr.replace(eqns=equations)
        return self.done[id(jaxpr)][1]

    def equation(self, e):
        name = e.primitive.name
        rule = self.rules[name](e) if name in self.rules else None
        if rule is not None:
            return _called(rule, e)
        params = {key: self.part(value) for key, value in e.params.items()}
        return e if all(params[key] is e.params[key] for key in params) else e.replace(params=params)

    def part(self, value):
        if isinstance(value, (tuple, list)):
            parts = [self.part(x) for x in value]
            same = all(new is old for new, old in zip(parts, value, strict=True))
            return value if same else type(value)(*parts) if hasattr(value, "_fields") else type(value)(parts)
        if hasattr(value, "consts"):
            return self.closed(value)
        return self.jaxpr(value) if hasattr(value, "eqns") else value


def _called(function, e):
    """An equation as a call of a function of its operands."""
    like = (jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in e.invars)
    with jax.numpy_rank_promotion("allow"):
        (call,) = jax.make_jaxpr(jax.jit(function))(*like).jaxpr.eqns
    return e.replace(primitive=call.primitive, params=call.params, effects=call.effects)


def _is_small(e) -> bool:
    a = e.invars[0].aval
    return a.shape[-2] <= LARGEST and jnp.issubdtype(a.dtype, jnp.floating)


def _repeated(n: int, turn: Callable, start: Any) -> Any:
    """`start` after turns 0 to n − 1."""
    if n > UNROLLED:
        return jax.lax.fori_loop(0, n, turn, start)
    return functools.reduce(lambda carry, k: turn(k, carry), range(n), start)


def _row(A, k):
    return A[..., k, :] if isinstance(k, int) else jax.lax.dynamic_index_in_dim(A, k, A.ndim - 2, keepdims=False)


def _column(A, k):
    return A[..., k] if isinstance(k, int) else jax.lax.dynamic_index_in_dim(A, k, A.ndim - 1, keepdims=False)


def cholesky(A: Float[Array, "*b n n"]) -> Float[Array, "*b n n"]:
    """L of A = L Lᵀ, by columns; NaN throughout where A is not positive definite, as libraries have it.

    **Source:** Golub & Van Loan, Matrix Computations, 4th ed., algorithm 4.2.2 (outer product form).
    """
    i = np.arange(A.shape[-1])

    def turn(k, carry):
        A, L = carry
        column = _column(A, k)
        column = jnp.where(i >= k, column / jnp.sqrt(_column(column[..., None, :], k)), 0)
        return A - column[..., None] * column[..., None, :], jnp.where(i == k, column[..., None], L)

    _, L = _repeated(len(i), turn, (A, jnp.zeros_like(A)))
    positive = jnp.all(jnp.diagonal(L, axis1=-2, axis2=-1) > 0, axis=-1)
    return jnp.where(positive[..., None, None], L, jnp.nan)


def triangular_solve(A: Float[Array, "*b n n"], B: Array, *, left: bool, lower: bool, transposed: bool, unit: bool) -> Array:
    """X of A X = B, or X A = B, with one triangle of A, or of Aᵀ, row by row."""
    if not left:
        return triangular_solve(A, B.mT, left=True, lower=lower, transposed=not transposed, unit=unit).mT
    if transposed:
        return triangular_solve(A.mT, B, left=True, lower=not lower, transposed=False, unit=unit)
    n, i = A.shape[-1], np.arange(A.shape[-1])

    def turn(k, X):
        k = k if lower else n - 1 - k
        column, row = _column(A, k), _row(X, k)
        row = row if unit else row / _column(column[..., None, :], k)
        rest = i > k if lower else i < k
        X = jnp.where((i == k)[:, None], row[..., None, :], X)
        return X - jnp.where(rest, column, 0)[..., None] * row[..., None, :]

    return _repeated(n, turn, B)


def lu(A: Float[Array, "*b n n"]) -> tuple[Float[Array, "*b n n"], Int[Array, "*b n"], Int[Array, "*b n"]]:
    """L and U of P A = L U in one matrix, the pivots, and the permutation, with the largest of each column as its pivot.

    **Source:** Golub & Van Loan, Matrix Computations, 4th ed., algorithm 3.4.1.
    """
    i = np.arange(A.shape[-1], dtype=np.int32)
    rows = jnp.broadcast_to(i, A.shape[:-1])

    def turn(k, carry):
        A, pivots, order = carry
        of_column = jnp.where(i >= k, jnp.abs(_column(A, k)), -1)
        p = jnp.argmax(of_column, axis=-1).astype(np.int32)[..., None]
        is_k, is_p = jnp.broadcast_to(i == k, p.shape[:-1] + i.shape), i == p
        A, order = _exchanged(A, is_k[..., None], is_p[..., None], -2), _exchanged(order, is_k, is_p, -1)
        row, column = _row(A, k), _column(A, k)
        below = jnp.where(i > k, column / _column(row[..., None, :], k), 0)
        A = A - below[..., None] * jnp.where(i > k, row, 0)[..., None, :]
        A = jnp.where((i > k)[:, None] & (i == k), below[..., None], A)
        return A, jnp.where(i == k, p, pivots), order

    return _repeated(len(i), turn, (A, jnp.zeros_like(rows), rows))


def _exchanged(x, here, there, axis):
    """x with what stands here and there along an axis exchanged."""
    at = lambda place: jnp.sum(jnp.where(place, x, 0), axis, keepdims=True, dtype=x.dtype)
    return jnp.where(here, at(there), jnp.where(there, at(here), x))


def svd(A: Float[Array, "*b m n"]) -> tuple[Float[Array, "*b m"], Float[Array, "*b m m"], Float[Array, "*b m n"]]:
    """Singular values, U and Vᵀ of no more rows than columns: of small values those rows of Vᵀ are zero that are nothing but rounding.

    By rotations of two rows at a time, which make all orthogonal. **Source:** Golub & Van Loan, section 8.6.3 (one-sided Jacobi).
    """
    if A.ndim > 2:
        return jax.lax.map(svd, A)
    m, eps = len(A), jnp.finfo(A.dtype).eps
    i, pairs = np.arange(m), np.array(np.triu_indices(m, 1))
    least = eps * jnp.sqrt(jnp.max(jnp.sum(A**2, axis=1)))

    def rotated(k, carry):
        U, R, _ = carry
        first, second = (i[:, None] == jnp.asarray(of)[k] for of in pairs)
        of_both = lambda X: [jnp.sum(jnp.where(at, X, 0), axis=0) for at in (first, second)]
        a, b = of_both(R)
        squares, product = (jnp.sum(a**2), jnp.sum(b**2)), jnp.sum(a * b)
        lengths = tuple(map(jnp.sqrt, squares))
        is_due = (jnp.abs(product) > eps * lengths[0] * lengths[1]) & (jnp.minimum(*lengths) > least)
        zeta = (squares[1] - squares[0]) / jnp.where(is_due, 2 * product, 1)
        tangent = jnp.where(is_due, jnp.where(zeta < 0, -1, 1) / (jnp.abs(zeta) + jnp.sqrt(1 + zeta**2)), 0)
        c = jax.lax.rsqrt(1 + tangent**2)
        s = c * tangent
        turned = lambda X, a, b: jnp.where(first, c * a - s * b, jnp.where(second, s * a + c * b, X))
        return turned(U, *of_both(U)), turned(R, a, b), carry[2] | is_due

    def sweep(carry):
        n, U, R, _ = carry
        return n + 1, *jax.lax.fori_loop(0, pairs.shape[1], rotated, (U, R, jnp.array(False)))

    start = jnp.array(0), jnp.eye(m, dtype=A.dtype), A, jnp.array(m > 1)
    _, U, R, _ = jax.lax.while_loop(lambda carry: carry[3] & (carry[0] < SWEEPS), sweep, start)
    values = jnp.sqrt(jnp.sum(R**2, axis=1))
    rank = jnp.sum((values[None] > values[:, None]) | ((values[None] == values[:, None]) & (i < i[:, None])), axis=1)
    sorted_by = lambda X: jnp.sum(jnp.where((rank == i[:, None])[:, :, None], X[None], 0), axis=1)
    values, U, R = sorted_by(values[:, None])[:, 0], sorted_by(U), sorted_by(R)
    return values, U.T, R / jnp.where(values > least, values, jnp.inf)[:, None]


def _product(e) -> Callable | None:
    """A product of matrices as sums: XLA may leave it to a library, however small it is; not a product with a vector."""
    (contracted, batched), operands = e.params["dimension_numbers"], e.invars
    sides = zip(operands, contracted, batched, strict=True)
    free = [[i for i in range(x.aval.ndim) if i not in (*c, *b)] for x, c, b in sides]
    if any(np.prod([x.aval.shape[i] for i in of]) <= 1 for x, of in zip(operands, free, strict=True)):
        return None

    def product(*operands):
        first, second = (jnp.transpose(x, (*b, *f, *c)) for x, b, f, c in zip(operands, batched, free, contracted, strict=True))
        before, end = len(batched[0]), len(batched[0]) + len(free[0])
        first, second = (x.reshape(*x.shape[: x.ndim - len(contracted[0])], -1) for x in (first, second))
        first = jnp.expand_dims(first, range(end, end + len(free[1])))
        second = jnp.expand_dims(second, range(before, end))
        out, count = e.outvars[0].aval, first.shape[-1]
        if math.prod(out.shape) * count < LONG:
            return jnp.sum(first * second, axis=-1, dtype=out.dtype)
        term = lambda k: (_column(first, k) * _column(second, k)).astype(out.dtype)
        return jax.lax.fori_loop(0, count, lambda k, sum_: sum_ + term(k), jnp.zeros(out.shape, out.dtype))

    return product


def _sum(e) -> Callable | None:
    """A long sum along its first axis in a loop."""
    axes, like = e.params["axes"], e.invars[0].aval
    if not LONG <= like.size <= LONGEST or not axes:
        return None

    def sum_(x):
        x = jnp.moveaxis(x, axes[0], 0)
        term = lambda k: jax.lax.dynamic_index_in_dim(x, k, 0, keepdims=False)
        whole = jax.lax.fori_loop(0, len(x), lambda k, sum_: sum_ + term(k), jnp.zeros(x.shape[1:], x.dtype))
        return jnp.sum(whole, axis=[i - (i > axes[0]) for i in axes[1:]])

    return sum_


def is_scattered(e) -> bool:
    """Whether an equation puts several parts in their places; of a single one XLA makes an update of a slice."""
    return e.primitive.name in SCATTERS and math.prod(e.invars[1].aval.shape[:-1]) > 1


def _scatter(combine: Callable) -> Callable:
    """Of an equation, its parts put in place one after the other; those that lie outside are left out, or moved inside, as it has them."""

    def rule(e):
        if not is_scattered(e):
            return None
        of, clips = e.params["dimension_numbers"], e.params["mode"] == jax.lax.GatherScatterMode.CLIP

        def scattered(x, places, parts):
            batch = [i for i in range(parts.ndim) if i not in of.update_window_dims]
            within = [i for i in range(x.ndim) if i not in (*of.inserted_window_dims, *of.operand_batching_dims)]
            window = np.ones(x.ndim, int)
            window[within] = [parts.shape[i] for i in of.update_window_dims]
            shape, room = places.shape[:-1], np.array(x.shape) - window
            parts = jnp.transpose(parts, (*batch, *of.update_window_dims)).reshape(-1, *window)
            places = places.reshape(-1, places.shape[-1]).astype(np.int32)
            of_batch = np.indices(shape, np.int32).reshape(len(shape), -1)

            def turn(k, x):
                start = [jnp.zeros((), np.int32)] * x.ndim
                for column, axis in enumerate(of.scatter_dims_to_operand_dims):
                    start[axis] = jnp.asarray(places)[k, column]
                for axis, along in zip(of.operand_batching_dims, of.scatter_indices_batching_dims, strict=True):
                    start[axis] = jnp.asarray(of_batch)[along, k]
                is_inside = functools.reduce(jnp.logical_and, [(i >= 0) & (i <= most) for i, most in zip(start, room, strict=True)])
                old = jax.lax.dynamic_slice(x, start, tuple(window))  # moved inside
                new = combine(old, jnp.asarray(parts)[k])
                return jax.lax.dynamic_update_slice(x, new if clips else jnp.where(is_inside, new, old), start)

            return _repeated(len(parts), turn, x)

        return scattered

    return rule


def _is_wide(e) -> bool:
    m, n = e.invars[0].aval.shape[-2:]
    return m == n or (m < n and not e.params["full_matrices"])


def _solve_rule(e):
    p = e.params
    given = {"left": p["left_side"], "lower": p["lower"], "transposed": p["transpose_a"], "unit": p["unit_diagonal"]}
    return functools.partial(triangular_solve, **given) if _is_small(e) and not p["conjugate_a"] else None


RULES: dict[str, Callable[[Any], Callable | None]] = {
    "cholesky": lambda e: cholesky if _is_small(e) else None,
    "triangular_solve": _solve_rule,
    "lu": lambda e: lu if _is_small(e) and e.invars[0].aval.shape[-1] == e.invars[0].aval.shape[-2] else None,
    "svd": lambda e: svd if _is_small(e) and _is_wide(e) and e.params["compute_uv"] else None,
    "dot_general": _product,
    "reduce_sum": _sum,
}
SCATTERS = {"scatter": _scatter(lambda old, new: new), "scatter-add": _scatter(lambda old, new: old + new)}
