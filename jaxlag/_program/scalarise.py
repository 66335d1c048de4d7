"""Scalar code: a function of arrays rewritten as operations on JAX scalars.

Values and derivatives are the same. Small systems run several times as fast (tests/benchmarks/bench_entries.py).
"""

import functools
import math
from collections.abc import Callable, Iterable

import jax
import numpy as np
from jax import lax
from jax.extend import core

from .constants import as_function
from .expressions import Algebra, Arrays, TooLong, UnknownPrimitive, filled, is_number, objects
from .interpreter import Interpreter, evaluate, traced, unflattened


class _Jax(Algebra):
    """Scalars are JAX arrays of rank 0. Derivative rules are kept: a function with one stays in one piece, its body as scalar code."""

    def function(self, primitive, params, dtype):
        return ARITHMETIC.get(primitive.name) or functools.partial(primitive.bind, **params)

    def block(self, equation):
        special = {"custom_linear_solve": _linear_solve_as_scalar_code, "custom_jvp_call": _custom_jvp_as_scalar_code}
        return functools.partial(special.get(equation.primitive.name, _whole), equation)


ARITHMETIC = dict(add=lax.add, sub=lax.sub, mul=lax.mul, div=lax.div, neg=lax.neg, sqrt=lax.sqrt, max=lax.max, min=lax.min)
ARITHMETIC |= {"and": lax.bitwise_and, "or": lax.bitwise_or}
JAX_ALGEBRA = _Jax()
FEW = 6  # entries of a result that are put together one by one


def scalarised(function: Callable, *, limit: int = 800, apart: bool = False) -> Callable:
    """`function` of pytrees of arrays as scalar code: the same values and derivatives, to rounding, in less time where it is small.

    What has no scalar form (a decomposition, a loop of unknown length) still works on arrays. A function of more than `limit` scalar
    operations is left as it is, and so is one whose variables are complex or of half precision. The results that an infinity or a NaN
    gives in 0·x, x − x or (1/√x)² are not kept, nor is the sign of a zero, except that of x − y where an angle or a quotient depends on
    it. Results `apart` are put together entry by entry, for programs in which others follow; alone, a batch is one kernel without.
    """
    # 700: a chain of 5 links has 633, and takes half the time of arrays; one of 6 links has 838, and its first derivative would take
    # four times as long to compile, a higher one twice as long (tests/benchmarks/bench_entries.py --limit 100000).
    return jax.jit(functools.wraps(function)(_as_scalar_code(function, limit, apart)))


def _as_scalar_code(function: Callable, limit: int | float = math.inf, apart: bool = False) -> Callable:
    def in_scalars(*arguments):
        closed, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)
        leaves, interpreter = jax.tree.leaves(arguments), Interpreter(JAX_ALGEBRA, limit)
        try:
            inputs, outputs = traced(closed, interpreter)
        except (TooLong, UnknownPrimitive):
            results = core.jaxpr_as_fun(closed)(*leaves)
        else:
            arrays = [*closed.consts, *leaves]
            pairs = [(nodes, array) for nodes, array in zip(inputs, arrays, strict=True) if nodes.dtype == object]
            given = {node: x for nodes, array in pairs for node, x in zip(nodes.flat, _scalars(array).flat, strict=True)}
            array, found = _selected if apart else _array, zip(interpreter.values(outputs, given), closed.jaxpr.outvars, strict=True)
            results = [array(x, atom.aval.dtype) for x, atom in found]
        return jax.tree.unflatten(jax.tree.structure(shapes), results)

    return in_scalars


def _scalars(array) -> np.ndarray:
    """The scalars of a JAX array."""
    shape, size = np.shape(array), math.prod(np.shape(array))
    parts = lax.split(lax.reshape(array, (size,)), (1,) * size) if size > 1 else [array] * size
    return filled(shape, [x if np.shape(x) == () else lax.reshape(x, ()) for x in parts])


def _array(array: np.ndarray, dtype) -> jax.Array:
    """The JAX array of scalars and numbers."""
    if all(map(is_number, array.flat)):
        return jax.numpy.asarray(array.astype(dtype))
    parts = [np.full((1,), x, dtype) if is_number(x) else lax.reshape(x, (1,)) for x in array.flat]
    whole = lax.concatenate(parts, 0) if len(parts) > 1 else array.flat[0]
    return whole if np.shape(whole) == array.shape else lax.reshape(whole, array.shape)


def _selected(array: np.ndarray, dtype) -> jax.Array:
    """The same of few entries without a concatenation: XLA computes what its parts share anew for each of them, and what these share, so
    that a long chain of operations takes twice the time at each of its links.
    """
    if not 1 < array.size <= FEW or all(map(is_number, array.flat)):
        return _array(array, dtype)
    wide = [lax.broadcast_in_dim(np.asarray(x, dtype) if is_number(x) else x, (array.size,), ()) for x in array.flat]
    choose = lambda whole, entry: lax.select_n(np.arange(array.size) == entry[0], whole, entry[1])
    return lax.reshape(functools.reduce(choose, enumerate(wide[1:], 1), wide[0]), array.shape)


def _without_numbers(arrays: Iterable[np.ndarray]) -> tuple[list, Callable[[list], Arrays]]:
    """The scalars of arrays that are not numbers, and a function that puts others in their place."""
    arrays = list(arrays)
    flat, shapes = [x for array in arrays for x in array.flat], [array.shape for array in arrays]
    numbers = {i: x for i, x in enumerate(flat) if is_number(x)}  # only these: tracers would be held for as long as the program is
    places = [i for i in range(len(flat)) if i not in numbers]

    def rebuild(scalars):
        every = numbers | dict(zip(places, scalars, strict=True))
        return unflattened([every[i] for i in range(len(every))], shapes)

    return [flat[i] for i in places], rebuild


def _whole(equation, *arrays):
    given = [_selected(x, atom.aval.dtype) for x, atom in zip(arrays, equation.invars, strict=True)]
    return [_scalars(x) for x in as_function(equation)(*given)]


def _custom_jvp_as_scalar_code(equation, *arrays):
    """The body as scalar code, with its own derivative rule; what is not a real number has no derivative."""
    given, rebuild = _without_numbers(arrays)
    is_real = [jax.numpy.issubdtype(x.dtype, jax.numpy.inexact) for x in given]
    on_scalars = lambda real, others: [x for array in _whole(equation, *rebuild(merged(real, others))) for x in array.flat]

    def merged(real, others):
        parts = {True: iter(real), False: iter(others)}
        return [next(parts[kind]) for kind in is_real]

    @jax.custom_jvp
    def body(real, others):
        results = evaluate(equation.params["call_jaxpr"], JAX_ALGEBRA, *rebuild(merged(real, others)))
        outputs = zip(results, equation.outvars, strict=True)
        found = [jax.numpy.asarray(x, variable.aval.dtype) for array, variable in outputs for x in array.flat]
        return _depending_on([*real, *others], found)

    def rule(primals, tangents):
        (real, others), (change, _) = primals, tangents
        along = lambda real, change, others: jax.jvp(lambda real: on_scalars(real, others), (real,), (change,))
        return _as_scalar_code(along)(real, change, others)

    body.defjvp(rule)
    parts = [[x for x, kind in zip(given, is_real, strict=True) if kind is which] for which in (True, False)]
    return unflattened(body(*parts), [variable.aval.shape for variable in equation.outvars])


def _depending_on(variables, results):
    """`results`, each of them a function of all variables for JAX; the compiler sees that it is not.

    Under `vmap`, JAX wants a function and its derivative rule to depend on the same variables. Of what is simplified the rule may depend
    on more.
    """
    select = lambda value, other: lax.select_n(np.False_, value, lax.convert_element_type(other, value.dtype))
    nothing = functools.reduce(select, variables, jax.numpy.zeros(()))
    return [select(x, nothing) for x in results]


def _linear_solve_as_scalar_code(equation, *arrays):
    """The solution x of A x = b as scalar code within `custom_linear_solve`, whose derivatives of every order solve with A, too."""
    lengths, jaxprs, avals = equation.params["const_lengths"], equation.params["jaxprs"], [v.aval for v in equation.outvars]
    splits = np.cumsum([0, *lengths])
    shapes = [aval.shape for aval in avals]
    as_vector = lambda arrays: _array(np.concatenate([objects(x).reshape(-1) for x in arrays]), avals[0].dtype)

    def function(k):
        """A, its transpose or an inverse as a function of a vector, which comes last: JAX passes the linear map before it."""
        jaxpr, consts = jaxprs[k], arrays[splits[k] : splits[k + 1]]
        split = lambda vector: unflattened(_scalars(vector), shapes)
        return jaxpr and (lambda *arguments: as_vector(evaluate(jaxpr, JAX_ALGEBRA, *consts, *split(arguments[-1]))))

    symmetric = jaxprs.vecmat is jaxprs.matvec
    x = lax.custom_linear_solve(function(0), as_vector(arrays[splits[-1] :]), function(2), function(3), symmetric=symmetric)
    return unflattened(_scalars(x), shapes)
