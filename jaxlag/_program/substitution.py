"""Evaluation of a program on arrays, with some of its nodes replaced by polynomials in others and in moduli.

Calls, loops and branches are inlined only where something within them is replaced or recorded: the others stay single equations.
"""

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import Jaxpr

from .constants import as_function
from .expressions import Node
from .polynomials import Modulus, Polynomial
from .velocity_degrees import Path, Place
from .walker import called_program, unrolled_scan, walk

INPUTS: Path = (-1,)
Recorded = dict[Path, Sequence[Any]]  # the outputs of the equations that are recorded
Places = Mapping[Node, Place]


def source_equations(polynomials: Iterable[Polynomial], places: Places) -> set[Path]:
    """The equations whose results are factors of some polynomials."""
    return {places[factor][0] for p in polynomials for monomial in p for factor, _ in monomial if isinstance(factor, Node)}


def polynomial_values(
    polynomials: Sequence[Polynomial], places: Places, recorded: Recorded, moduli: Sequence[Modulus] = (), u: Any = ()
) -> jax.Array:
    """The values of polynomials whose moduli have the values u."""
    where: dict[Any, int] = {modulus: i for i, modulus in enumerate(moduli)}
    parts, offsets, size = [jnp.asarray(u)] if moduli else [], {}, len(moduli)
    nodes = [f for p in polynomials for monomial in p for f, _ in monomial if isinstance(f, Node)]
    for path, i in dict.fromkeys(places[node][:2] for node in nodes):
        parts.append(jnp.ravel(recorded[path][i]))
        offsets[path, i] = size
        size += np.size(recorded[path][i])

    def position(factor):
        if not isinstance(factor, Node):
            return where[factor], 1.0
        path, i, k, number = places[factor]
        return offsets[path, i] + k, number

    dtype = jnp.result_type(*(part.dtype for part in parts if jnp.issubdtype(part.dtype, jnp.inexact)))
    pool = jnp.concatenate([part.astype(dtype) for part in parts])
    monomials = [[(number, _factors(monomial)) for monomial, number in p.items()] for p in polynomials]
    most_terms = max(map(len, monomials))
    width = max(len(factors) for row in monomials for _, factors in row)
    numbers = np.zeros((len(monomials), most_terms), dtype)
    shape = (*numbers.shape, width)
    index, scales, exponents = np.full(shape, -1), np.ones(shape, dtype), np.ones(shape)
    for at, row in enumerate(monomials):
        for m, (number, factors) in enumerate(row):
            numbers[at, m] = number
            for k, (factor, exponent) in enumerate(factors):
                (index[at, m, k], scales[at, m, k]), exponents[at, m, k] = position(factor), exponent
    products = jnp.asarray(numbers) if np.any(numbers != 1) else 1
    for k in range(width):
        taken = _take(pool, index[..., k])
        taken = taken if np.all(scales[..., k] == 1) else taken * scales[..., k]
        products = products * _power(taken, exponents[..., k])
    return jnp.sum(jnp.broadcast_to(products, numbers.shape), axis=1) if most_terms > 1 else jnp.broadcast_to(products, numbers.shape)[:, 0]


def _factors(monomial) -> list[tuple[Any, float]]:
    """Factors and exponents, with positive integer powers as repeated factors."""
    return [pair for factor, n in monomial for pair in ([(factor, 1.0)] * int(n) if n > 0 and n % 1 == 0 else [(factor, n)])]


def _take(pool, index):
    """Elements of the pool, 1 where the index is −1."""
    first = int(index.flat[0])
    if first >= 0 and np.array_equal(index.ravel(), first + np.arange(index.size)):
        return pool[first : first + index.size].reshape(index.shape)
    return jnp.where(index < 0, 1, pool[np.maximum(index, 0)]) if np.any(index < 0) else pool[index]


def _power(x, exponents):
    """Powers; the root of 0 is given the derivative 0."""
    if np.all(exponents == 1):
        return x
    vanishes = (exponents > 0) & (exponents != 1) & (x == 0)
    return jnp.where(exponents == 1, x, jnp.where(vanishes, 0, jnp.where(vanishes | (exponents == 1), 1, x) ** exponents))


def evaluate_with_replacements(
    jaxpr: Jaxpr, inputs: Sequence[Any], wanted: set[Path], branches: Mapping[Path, int], replace: Callable, stop: int | None = None
):
    """The outputs of a program, and what the `wanted` equations gave: `replace(path, outputs, recorded)` in place of their outputs.

    With `stop`, the equations from that number on are left out, and there are no outputs.
    """
    inlined = {path[:k] for path in wanted for k in range(1, len(path), 2)}
    recorded: Recorded = {INPUTS: inputs}

    def run(program, inputs, path, stop=None):
        numbers = itertools.count()

        def evaluate(equation, operands):
            here = (*path, next(numbers))
            outputs = within(equation, operands, here) if here in inlined else as_function(equation)(*operands)
            if here in wanted:
                outputs = recorded[here] = replace(here, outputs, recorded)
            return outputs

        return walk(program, inputs, evaluate, stop=stop)

    def within(equation, operands, here):
        p = equation.params
        if equation.primitive.name == "cond":
            index, *operands = operands
            if here in branches:
                return run(p["branches"][branches[here]], operands, (*here, 0))
            cases = [run(branch, operands, (*here, k)) for k, branch in enumerate(p["branches"])]
            which = lax.clamp(np.int32(0), jnp.asarray(index, np.int32), np.int32(len(cases) - 1))
            return [lax.select_n(which, *column) for column in zip(*cases, strict=True)]
        if equation.primitive.name == "scan":
            turns = itertools.count()
            carry, columns = unrolled_scan(p, operands, lambda inputs: run(p["jaxpr"], inputs, (*here, next(turns))))
            return [*carry, *map(jnp.stack, columns)]
        return run(called_program(equation), operands, (*here, 0))

    return run(jaxpr, inputs, (), stop), recorded
