"""Programs written out: a function of arrays as scalar code, over JAX scalars.

The same values and the same derivatives. Small systems run several times as fast so (tests/benchmarks/bench_entries.py).
"""

import functools
import math
from collections.abc import Callable, Iterable

import jax
import numpy as np
from jax import lax
from jax.extend import core

from .constants import on_arrays
from .interpreter import Reader, evaluate, opened, shaped
from .scalar_graph import Algebra, Arrays, TooLong, UnknownPrimitive, filled, is_number, objects


class _Jax(Algebra):
    """Scalars are JAX arrays of rank 0. Derivative rules are kept, so what has one stays in one piece, its body written out."""

    names = ("add", "sub", "mul", "div", "neg", "sqrt", "max", "min")
    arithmetic = {name: getattr(lax, name) for name in names} | {"and": lax.bitwise_and, "or": lax.bitwise_or}

    def function(self, primitive, params, dtype):
        return self.arithmetic.get(primitive.name) or functools.partial(primitive.bind, **params)

    def block(self, equation):
        within = {"custom_linear_solve": _linear_solve_in_scalars, "custom_jvp_call": _custom_jvp_in_scalars}
        return functools.partial(within.get(equation.primitive.name, _whole), equation)


JAX_ALGEBRA = _Jax()


def scalarised(function: Callable, *, limit: int = 700) -> Callable:
    """`function` of pytrees of arrays as scalar code: the same values and derivatives, to rounding, in less time where it is small.

    What is not taken apart (a decomposition, a loop of unknown length) works on arrays as before, and a function of more than
    `limit` scalar operations does so altogether, and so does one with complex numbers or half precision among what varies. What an
    infinity or a NaN would have made of 0·x, x − x or (1/√x)² is not kept, nor the sign of a zero but where an angle asks for it.
    """
    # 700: a chain of 5 links has 633, and takes half the time of arrays; one of 6 links has 838, and its first derivative would take
    # four times as long to compile, a further one twice as long (tests/benchmarks/bench_entries.py --limit 100000).
    return jax.jit(functools.wraps(function)(_written_out(function, limit)))


def _written_out(function: Callable, limit: int | float = math.inf) -> Callable:
    def in_scalars(*arguments):
        closed, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)
        leaves, reader = jax.tree.leaves(arguments), Reader(JAX_ALGEBRA, limit)
        try:
            inputs, outputs = opened(closed, reader)
        except (TooLong, UnknownPrimitive):
            results = core.jaxpr_as_fun(closed)(*leaves)
        else:
            arrays = [*closed.consts, *leaves]
            pairs = [(entries, array) for entries, array in zip(inputs, arrays, strict=True) if entries.dtype == object]
            given = {entry: x for entries, array in pairs for entry, x in zip(entries.flat, _apart(array).flat, strict=True)}
            results = [_together(x, atom.aval.dtype) for x, atom in zip(reader.values(outputs, given), closed.jaxpr.outvars, strict=True)]
        return jax.tree.unflatten(jax.tree.structure(shapes), results)

    return in_scalars


def _apart(array) -> np.ndarray:
    """The scalars of a JAX array."""
    shape, size = np.shape(array), math.prod(np.shape(array))
    parts = lax.split(lax.reshape(array, (size,)), (1,) * size) if size > 1 else [array] * size
    return filled(shape, [x if np.shape(x) == () else lax.reshape(x, ()) for x in parts])


def _together(array: np.ndarray, dtype) -> jax.Array:
    """The JAX array of scalars and numbers."""
    if all(map(is_number, array.flat)):
        return jax.numpy.asarray(array.astype(dtype))
    parts = [np.full((1,), x, dtype) if is_number(x) else lax.reshape(x, (1,)) for x in array.flat]
    whole = lax.concatenate(parts, 0) if len(parts) > 1 else array.flat[0]
    return whole if np.shape(whole) == array.shape else lax.reshape(whole, array.shape)


def _free(arrays: Iterable[np.ndarray]) -> tuple[list, Callable[[list], Arrays]]:
    """The scalars of arrays that are no numbers, and the arrays with others in their place."""
    arrays = list(arrays)
    flat, shapes = [x for array in arrays for x in array.flat], [array.shape for array in arrays]
    numbers = {i: x for i, x in enumerate(flat) if is_number(x)}  # no others: what is traced would be held for as long as the program is
    places = [i for i in range(len(flat)) if i not in numbers]

    def filled(scalars):
        every = numbers | dict(zip(places, scalars, strict=True))
        return shaped([every[i] for i in range(len(every))], shapes)

    return [flat[i] for i in places], filled


def _whole(equation, *arrays):
    given = [_together(x, atom.aval.dtype) for x, atom in zip(arrays, equation.invars, strict=True)]
    return [_apart(x) for x in on_arrays(equation)(*given)]


def _custom_jvp_in_scalars(equation, *arrays):
    """The body written out, and its own rule for the derivative."""
    given, filled = _free(arrays)
    if not all(jax.numpy.issubdtype(x.dtype, jax.numpy.inexact) for x in given):
        return _whole(equation, *arrays)
    on_arrays = lambda given: [x for array in _whole(equation, *filled(given)) for x in array.flat]

    @jax.custom_jvp
    def body(given):
        outputs = zip(evaluate(equation.params["call_jaxpr"], JAX_ALGEBRA, *filled(given)), equation.outvars, strict=True)
        return [jax.numpy.asarray(x, variable.aval.dtype) for array, variable in outputs for x in array.flat]

    body.defjvp(lambda primals, tangents: _written_out(lambda *pair: jax.jvp(on_arrays, *pair))(primals, tangents))
    return shaped(body(given), [variable.aval.shape for variable in equation.outvars])


def _linear_solve_in_scalars(equation, *arrays):
    """The solution x of A x = b as it was written out; its derivative solves A dx = db − dA x, as `custom_linear_solve` has it."""
    lengths, jaxprs, avals = equation.params["const_lengths"], equation.params["jaxprs"], [v.aval for v in equation.outvars]
    (x, with_x), (given, with_given) = _free(arrays[: len(avals)]), _free(arrays[len(avals) :])
    is_free = [not is_number(entry) for array in arrays[: len(avals)] for entry in array.flat]
    splits = np.cumsum([0, *lengths])
    joined = lambda arrays: _together(np.concatenate([objects(x).reshape(-1) for x in arrays]), avals[0].dtype)

    def function(k, given):
        """A, its transpose or an inverse as a function of a vector, which comes last: JAX hands over the map before it."""
        jaxpr, consts = jaxprs[k], with_given(given)[splits[k] : splits[k + 1]]
        parted = lambda vector: shaped(_apart(vector), [aval.shape for aval in avals])
        return jaxpr and (lambda *arguments: joined(evaluate(jaxpr, JAX_ALGEBRA, *consts, *parted(arguments[-1]))))

    @jax.custom_jvp
    def solution(x, given):
        return x

    @solution.defjvp
    def differential(primals, tangents):
        x, given = solution(*primals), primals[1]
        vector = joined(with_x(x))
        defect = lambda given: joined(with_given(given)[splits[-1] :]) - function(0, given)(vector)
        _, right = jax.jvp(defect, (given,), (tangents[1],))
        symmetric = jaxprs.vecmat is jaxprs.matvec
        dx = lax.custom_linear_solve(function(0, given), right, function(2, given), function(3, given), symmetric=symmetric)
        return x, [entry for entry, free in zip(_apart(dx).flat, is_free, strict=True) if free]

    return with_x(solution(x, given))
