"""Structured Jacobians of array programs: sums of products of diagonal matrices and matrices of numbers.

Beside element-wise arithmetic, a Lagrangian in arrays contains linear operations that are known: sums, slices, cumulative sums, products
with a given matrix. So the Jacobian of the momenta with respect to the velocities is a sum of diag(a) K diag(b) with K a matrix of
numbers. It costs a product for each element, however many operations K stands for: for a chain of n links n² in place of n³.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .constants import as_function, has_extended_dtype, is_foldable, is_numeric
from .expressions import Algebra, UnknownPrimitive
from .interpreter import Interpreter, numeric_if_known
from .walker import CALLS, called_program, count_equations, walk

MAX_EQUATIONS = 200  # a longer program is scalar code, whose elements cost less one by one
MAX_SUMMANDS = 4  # of a value; more are one dense matrix
LINEAR = {
    "reshape", "squeeze", "broadcast_in_dim", "transpose", "slice", "split", "pad", "concatenate", "gather", "rev", "copy", "neg",
    "convert_element_type", "cumsum", "reduce_sum", "select_n", "add", "add_any", "sub",
}  # fmt: skip


class Summand(NamedTuple):
    """diag(a) K diag(b) over the elements of a value; None is a diagonal of ones."""

    a: Any
    K: Any
    b: Any

    def dense(self):
        """The product."""
        K = self.K if self.a is None else self.a[:, None] * self.K
        return K if self.b is None else K * self.b[None, :]


def structured_jacobian(function: Callable, x: Float[Array, " n"]) -> Float[Array, "m n"] | None:
    """∂f/∂x; None where the program is long, or has an operation that is not covered here."""
    closed = jax.make_jaxpr(lambda x, dx: jax.jvp(function, (x,), (dx,))[1])(x, x)
    if count_equations(closed.jaxpr) > MAX_EQUATIONS:
        return None
    try:
        (summands,) = _run(closed, [x, [Summand(None, np.eye(x.size, dtype=x.dtype), None)]])
    except UnknownPrimitive:
        return None
    if not isinstance(summands, list):
        return jnp.zeros((np.size(summands), x.size), x.dtype)
    return jnp.asarray(sum(summand.dense() for summand in summands))


def _run(program, inputs):
    """The outputs of a program whose values are arrays or, where they depend on x, lists of summands."""
    return walk(program, inputs, _evaluate, literal=lambda atom: np.asarray(atom.val, atom.aval.dtype))


def _evaluate(equation, operands):
    """The outputs of one equation."""
    name, varies = equation.primitive.name, [isinstance(x, list) for x in operands]
    shapes = [atom.aval.shape for atom in equation.invars]
    atoms = [*equation.invars, *equation.outvars]
    if any(map(has_extended_dtype, atoms)) or (any(varies) and not all(map(is_foldable, atoms))):
        raise UnknownPrimitive(equation.primitive, [equation.source_info])
    if name in CALLS or (name == "custom_jvp_call" and any(varies)):
        return _run(called_program(equation), operands)
    if not any(varies):
        return _independent(equation, operands)
    if name in ("add", "add_any", "sub") and all(varies) and shapes[0] == shapes[1]:
        second = [summand._replace(K=-summand.K) for summand in operands[1]] if name == "sub" else operands[1]
        return [_merged([*operands[0], *second])]
    at = varies.index(True)
    if name in ("mul", "div") and sum(varies) == 1 and shapes[at] == equation.outvars[0].aval.shape and (name, at) != ("div", 1):
        factor = operands[1 - at] if name == "mul" else 1 / operands[1]
        return [[_scaled(summand, factor) for summand in operands[at]]]
    if name == "dot_general" and sum(varies) == 1:
        return [_merged([_times_array(equation, operands[1 - at], at, summand) for summand in operands[at]])]
    if name in LINEAR and all(depends or is_numeric(x) for x, depends in zip(operands, varies, strict=True)):
        every = [_mapped(equation, operands, at, summand) for at in np.flatnonzero(varies) for summand in operands[at]]
        return [_merged(list(summands)) for summands in zip(*every, strict=True)]
    raise UnknownPrimitive(equation.primitive, [equation.source_info])


def _independent(equation, operands):
    """The outputs of an equation that does not depend on x; of numbers as numbers."""
    if all(map(is_numeric, operands)):
        return _by_numpy(equation, [np.asarray(x) for x in operands])
    return as_function(equation)(*operands)


def _by_numpy(equation, operands):
    """The outputs of an equation of numbers, by NumPy."""
    outs = Interpreter(Algebra()).equation(equation, operands)
    return [numeric_if_known(out, variable.aval.dtype) for out, variable in zip(outs, equation.outvars, strict=True)]


def _scaled(summand, factor):
    """A summand whose rows are multiplied by factors."""
    rows = (np if is_numeric(factor) else jnp).broadcast_to(factor.reshape(-1), len(summand.K))
    if is_numeric(factor):
        return summand._replace(K=rows[:, None] * summand.K)
    if summand.a is None and _is_selection(summand.K):  # each row belongs to one column
        of_column = np.argmax(summand.K != 0, axis=0)
        columns = rows if np.array_equal(of_column, np.arange(len(rows))) else rows[of_column]
        return summand._replace(b=columns if summand.b is None else summand.b * columns)
    return summand._replace(a=rows if summand.a is None else summand.a * rows)


def _is_selection(K) -> bool:
    """Whether no row and no column has more than one element."""
    return isinstance(K, np.ndarray) and bool(np.all((K != 0).sum(0) <= 1) and np.all((K != 0).sum(1) <= 1))


def _without_left_diagonal(summand):
    """A summand with nothing to the left of a matrix of numbers or, multiplied out, of a dense one."""
    return summand if summand.a is None and isinstance(summand.K, np.ndarray) else Summand(None, summand.dense(), None)


def _times_array(equation, A, at, summand):
    """A summand multiplied by an array from either side."""
    (contracted, (batch, _)), aval = equation.params["dimension_numbers"], equation.invars[at].aval
    if batch or summand.a is not None or any(atom.aval.dtype != aval.dtype for atom in equation.invars):
        raise UnknownPrimitive(equation.primitive, [equation.source_info])  # a product of two dense matrices would cost no less
    xnp: Any = np if is_numeric(A) and isinstance(summand.K, np.ndarray) else jnp
    if isinstance(summand.K, np.ndarray) and aval.ndim == len(contracted[at]) == 1 and np.array_equal(summand.K, np.eye(len(summand.K))):
        product = xnp.moveaxis(A, contracted[1 - at][0], -1)
    else:
        K, free = summand.K.reshape(*aval.shape, -1), aval.ndim - len(contracted[at])
        product = xnp.tensordot(A, K, contracted) if at else xnp.moveaxis(xnp.tensordot(K, A, contracted), free, -1)
    return summand._replace(K=product.reshape(-1, summand.K.shape[1]))


def _mapped(equation, operands, at, summand):
    """A summand after an operation that is linear in everything that depends on x, for each output."""
    summand, zeros = _without_left_diagonal(summand), [np.zeros(atom.aval.shape, atom.aval.dtype) for atom in equation.invars]
    others = [zero if isinstance(x, list) else np.asarray(x) for x, zero in zip(operands, zeros, strict=True)]
    apply = _by_numpy if isinstance(summand.K, np.ndarray) else lambda equation, operands: as_function(equation)(*operands)

    def column(k):
        given = [*others[:at], k.reshape(zeros[at].shape), *others[at + 1 :]]
        return [out.reshape(-1) for out in apply(equation, given)]

    if isinstance(summand.K, np.ndarray):
        outs = [np.stack(of_out, axis=1) for of_out in zip(*map(column, summand.K.T), strict=True)]
    else:
        outs = jax.vmap(column, in_axes=1, out_axes=1)(summand.K)
    return [summand._replace(K=K) for K in outs]


def _merged(summands):
    """Summands with the same diagonals added up; too many become one dense matrix."""
    found: dict[Any, Summand] = {}
    for summand in summands:
        key = id(summand.a), id(summand.b), isinstance(summand.K, np.ndarray)
        found[key] = summand._replace(K=found[key].K + summand.K) if key in found else summand
    return list(found.values()) if len(found) <= MAX_SUMMANDS else [Summand(None, sum(summand.dense() for summand in found.values()), None)]
