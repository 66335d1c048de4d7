"""Jacobians of programs in arrays, read as products of diagonal matrices and matrices of numbers.

What a Lagrangian in arrays does beside arithmetic on each entry is linear and known: sums, slices, cumulative sums, products with a
matrix that is given. So the program that leads from velocities to momenta is a sum of diag(a) K diag(b) with K a matrix of numbers,
which costs a product for each entry, however many operations K came about by: for a chain of n links n² in place of n³.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal
from jaxtyping import Array, Float

from .constants import is_extended, is_known, on_arrays
from .interpreter import Reader, settled
from .rules import CALLS, body
from .scalar_graph import Algebra, UnknownPrimitive
from .single_kernel import length

SHORT = 200  # equations; what is longer is scalar code, whose entries cost less one by one
FEW = 4  # terms of a value; more are one dense matrix
LINEAR = {
    "reshape", "squeeze", "broadcast_in_dim", "transpose", "slice", "split", "pad", "concatenate", "gather", "rev", "copy", "neg",
    "convert_element_type", "cumsum", "reduce_sum", "select_n", "add", "add_any", "sub",
}  # fmt: skip


class Term(NamedTuple):
    """diag(a) K diag(b) over the entries of a value; None is a diagonal of ones."""

    a: Any
    K: Any
    b: Any

    def dense(self):
        """The product."""
        K = self.K if self.a is None else self.a[:, None] * self.K
        return K if self.b is None else K * self.b[None, :]


def matrix(function: Callable, x: Float[Array, " n"]) -> Float[Array, "m n"] | None:
    """∂f/∂x; None where the program is long, or does what is not read here."""
    closed = jax.make_jaxpr(lambda x, dx: jax.jvp(function, (x,), (dx,))[1])(x, x)
    if length(closed.jaxpr) > SHORT:
        return None
    try:
        (terms,) = _run(closed.jaxpr, closed.consts, [x, [Term(None, np.eye(x.size, dtype=x.dtype), None)]])
    except UnknownPrimitive:
        return None
    if not isinstance(terms, list):
        return jnp.zeros((np.size(terms), x.size), x.dtype)
    return jnp.asarray(sum(term.dense() for term in terms))


def _run(jaxpr, consts, inputs):
    """The outputs of a program whose values are arrays or, where they depend on x, lists of terms."""
    env = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *inputs], strict=True))
    read = lambda atom: np.asarray(atom.val, atom.aval.dtype) if isinstance(atom, Literal) else env[atom]
    for equation in jaxpr.eqns:
        env |= dict(zip(equation.outvars, _step(equation, [read(atom) for atom in equation.invars]), strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _step(equation, operands):
    """The outputs of one equation."""
    name, moving = equation.primitive.name, [isinstance(x, list) for x in operands]
    shapes = [atom.aval.shape for atom in equation.invars]
    atoms = [*equation.invars, *equation.outvars]
    if any(map(is_extended, atoms)) or (any(moving) and not all(map(is_known, atoms))):
        raise UnknownPrimitive(equation.primitive, [equation.source_info])
    if name in CALLS or (name == "custom_jvp_call" and any(moving)):
        return _run(body(equation).jaxpr, body(equation).consts, operands)
    if not any(moving):
        return _known(equation, operands)
    if name in ("add", "add_any", "sub") and all(moving) and shapes[0] == shapes[1]:
        second = [term._replace(K=-term.K) for term in operands[1]] if name == "sub" else operands[1]
        return [_merged([*operands[0], *second])]
    at = moving.index(True)
    if name in ("mul", "div") and sum(moving) == 1 and shapes[at] == equation.outvars[0].aval.shape and (name, at) != ("div", 1):
        factor = operands[1 - at] if name == "mul" else 1 / operands[1]
        return [[_scaled(term, factor) for term in operands[at]]]
    if name == "dot_general" and sum(moving) == 1:
        return [_merged([_multiplied(equation, operands[1 - at], at, term) for term in operands[at]])]
    if name in LINEAR and all(moves or _is_number(x) for x, moves in zip(operands, moving, strict=True)):
        every = [_moved(equation, operands, at, term) for at in np.flatnonzero(moving) for term in operands[at]]
        return [_merged(list(terms)) for terms in zip(*every, strict=True)]
    raise UnknownPrimitive(equation.primitive, [equation.source_info])


def _is_number(x) -> bool:
    return isinstance(x, (np.ndarray, np.generic, jax.Array)) and not isinstance(x, jax.core.Tracer)


def _known(equation, operands):
    """The outputs of an equation that x has no part in; of numbers as numbers."""
    if all(map(_is_number, operands)):
        return _in_numbers(equation, [np.asarray(x) for x in operands])
    return on_arrays(equation)(*operands)


def _in_numbers(equation, operands):
    """The outputs of an equation of numbers, by NumPy."""
    outs = Reader(Algebra()).equation(equation, operands)
    return [settled(out, variable.aval.dtype) for out, variable in zip(outs, equation.outvars, strict=True)]


def _scaled(term, factor):
    """A term whose rows are multiplied."""
    rows = (np if _is_number(factor) else jnp).broadcast_to(factor.reshape(-1), len(term.K))
    if _is_number(factor):
        return term._replace(K=rows[:, None] * term.K)
    if term.a is None and _is_selection(term.K):  # its rows are columns
        of_column = np.argmax(term.K != 0, axis=0)
        columns = rows if np.array_equal(of_column, np.arange(len(rows))) else rows[of_column]
        return term._replace(b=columns if term.b is None else term.b * columns)
    return term._replace(a=rows if term.a is None else term.a * rows)


def _is_selection(K) -> bool:
    """Whether no row and no column has more than one entry."""
    return isinstance(K, np.ndarray) and bool(np.all((K != 0).sum(0) <= 1) and np.all((K != 0).sum(1) <= 1))


def _of_rows(term):
    """A term with nothing on its left but the matrix."""
    return term if term.a is None and isinstance(term.K, np.ndarray) else Term(None, term.dense(), None)


def _multiplied(equation, A, at, term):
    """A term multiplied by an array, from either side."""
    (contracted, (batch, _)), moving = equation.params["dimension_numbers"], equation.invars[at].aval
    if batch or term.a is not None or any(atom.aval.dtype != moving.dtype for atom in equation.invars):
        raise UnknownPrimitive(equation.primitive, [equation.source_info])  # a product of two dense matrices costs no less so
    xnp: Any = np if _is_number(A) and isinstance(term.K, np.ndarray) else jnp
    if isinstance(term.K, np.ndarray) and moving.ndim == len(contracted[at]) == 1 and np.array_equal(term.K, np.eye(len(term.K))):
        product = xnp.moveaxis(A, contracted[1 - at][0], -1)
    else:
        K, free = term.K.reshape(*moving.shape, -1), moving.ndim - len(contracted[at])
        product = xnp.tensordot(A, K, contracted) if at else xnp.moveaxis(xnp.tensordot(K, A, contracted), free, -1)
    return term._replace(K=product.reshape(-1, term.K.shape[1]))


def _moved(equation, operands, at, term):
    """A term after an operation that is linear in all that depends on x, for each output."""
    term, zeros = _of_rows(term), [np.zeros(atom.aval.shape, atom.aval.dtype) for atom in equation.invars]
    others = [zero if isinstance(x, list) else np.asarray(x) for x, zero in zip(operands, zeros, strict=True)]
    apply = _in_numbers if isinstance(term.K, np.ndarray) else lambda equation, operands: on_arrays(equation)(*operands)

    def column(k):
        given = [*others[:at], k.reshape(zeros[at].shape), *others[at + 1 :]]
        return [out.reshape(-1) for out in apply(equation, given)]

    if isinstance(term.K, np.ndarray):
        outs = [np.stack(of_out, axis=1) for of_out in zip(*map(column, term.K.T), strict=True)]
    else:
        outs = jax.vmap(column, in_axes=1, out_axes=1)(term.K)
    return [term._replace(K=K) for K in outs]


def _merged(terms):
    """Terms with the same diagonals as one, and many as a dense one."""
    found: dict[Any, Term] = {}
    for term in terms:
        key = id(term.a), id(term.b), isinstance(term.K, np.ndarray)
        found[key] = term._replace(K=found[key].K + term.K) if key in found else term
    return list(found.values()) if len(found) <= FEW else [Term(None, sum(term.dense() for term in found.values()), None)]
