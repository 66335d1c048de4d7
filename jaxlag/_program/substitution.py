"""A program evaluated on arrays, with polynomials of its entries and of moduli in place of some of them.

Calls, loops and branches are opened only where there is something to replace, or to take, within them: all else stays as it was compiled.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import Jaxpr, Literal

from .dependence import Path, Place
from .interpreter import on_arrays
from .polynomials import Modulus, Polynomial
from .rules import body
from .scalar_graph import Entry

INPUTS: Path = (-1,)
Seen = dict[Path, Sequence[Any]]  # what equations that are looked for gave
Places = Mapping[Entry, Place]


def sources(polynomials: Iterable[Polynomial], places: Places) -> set[Path]:
    """The equations whose results stand in some polynomials."""
    return {places[factor][0] for p in polynomials for product in p for factor, _ in product if isinstance(factor, Entry)}


def values(polynomials: Sequence[Polynomial], places: Places, seen: Seen, moduli: Sequence[Modulus] = (), u: Any = ()) -> jax.Array:
    """The values of polynomials, of which the moduli have the values u."""
    where: dict[Any, int] = {modulus: i for i, modulus in enumerate(moduli)}
    parts, offsets, size = [jnp.asarray(u)] if moduli else [], {}, len(moduli)
    entries = [f for p in polynomials for product in p for f, _ in product if isinstance(f, Entry)]
    for path, i in dict.fromkeys(places[entry][:2] for entry in entries):
        parts.append(jnp.ravel(seen[path][i]))
        offsets[path, i] = size
        size += np.size(seen[path][i])

    def position(factor):
        if not isinstance(factor, Entry):
            return where[factor], 1.0
        path, i, k, number = places[factor]
        return offsets[path, i] + k, number

    dtype = jnp.result_type(*(part.dtype for part in parts if jnp.issubdtype(part.dtype, jnp.inexact)))
    pool = jnp.concatenate([part.astype(dtype) for part in parts])
    rows = [[(number, _factors(product)) for product, number in p.items()] for p in polynomials]
    longest = max(map(len, rows))
    width = max(len(factors) for row in rows for _, factors in row)
    numbers = np.zeros((len(rows), longest), dtype)
    shape = (*numbers.shape, width)
    index, scales, exponents = np.full(shape, -1), np.ones(shape, dtype), np.ones(shape)
    for at, row in enumerate(rows):
        for m, (number, factors) in enumerate(row):
            numbers[at, m] = number
            for k, (factor, exponent) in enumerate(factors):
                (index[at, m, k], scales[at, m, k]), exponents[at, m, k] = position(factor), exponent
    products = jnp.asarray(numbers) if np.any(numbers != 1) else 1
    for k in range(width):
        taken = _taken(pool, index[..., k])
        taken = taken if np.all(scales[..., k] == 1) else taken * scales[..., k]
        products = products * _power(taken, exponents[..., k])
    return jnp.sum(jnp.broadcast_to(products, numbers.shape), axis=1) if longest > 1 else jnp.broadcast_to(products, numbers.shape)[:, 0]


def _factors(product) -> list[tuple[Any, float]]:
    """Whole powers as so many factors."""
    return [pair for factor, n in product for pair in ([(factor, 1.0)] * int(n) if n > 0 and n % 1 == 0 else [(factor, n)])]


def _taken(pool, index):
    """Entries of the pool, 1 where the index is −1."""
    first = int(index.flat[0])
    if first >= 0 and np.array_equal(index.ravel(), first + np.arange(index.size)):
        return pool[first : first + index.size].reshape(index.shape)
    return jnp.where(index < 0, 1, pool[np.maximum(index, 0)]) if np.any(index < 0) else pool[index]


def _power(x, exponents):
    """Powers, of which the root of 0 has no derivative."""
    if np.all(exponents == 1):
        return x
    vanishes = (exponents > 0) & (exponents != 1) & (x == 0)
    return jnp.where(exponents == 1, x, jnp.where(vanishes, 0, jnp.where(vanishes | (exponents == 1), 1, x) ** exponents))


def evaluated(
    jaxpr: Jaxpr, inputs: Sequence[Any], wanted: set[Path], branches: Mapping[Path, int], replaced: Callable, until: int | None = None
):
    """The outputs of a program, and what the `wanted` equations gave: `replaced(path, outputs, seen)` in place of their outputs."""
    opened = {path[:k] for path in wanted for k in range(1, len(path), 2)}
    seen: Seen = {INPUTS: inputs}

    def run(jaxpr, consts, inputs, path, equations=None):
        env = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *inputs], strict=True))
        read = lambda x: x.val if isinstance(x, Literal) else env[x]
        for i, equation in enumerate(jaxpr.eqns[:equations]):
            here = (*path, i)
            operands = [read(x) for x in equation.invars]
            outputs = within(equation, operands, here) if here in opened else on_arrays(equation)(*operands)
            if here in wanted:
                outputs = seen[here] = replaced(here, outputs, seen)
            env |= dict(zip(equation.outvars, outputs, strict=True))
        return [] if equations is not None else [read(x) for x in jaxpr.outvars]

    def call(program, inputs, path):
        return run(program.jaxpr, program.consts, inputs, path)

    def within(equation, operands, here):
        p = equation.params
        if equation.primitive.name == "cond":
            index, *operands = operands
            if here in branches:
                return call(p["branches"][branches[here]], operands, (*here, 0))
            cases = [call(branch, operands, (*here, k)) for k, branch in enumerate(p["branches"])]
            which = lax.clamp(np.int32(0), jnp.asarray(index, np.int32), np.int32(len(cases) - 1))
            return [lax.select_n(which, *column) for column in zip(*cases, strict=True)]
        if equation.primitive.name == "scan":
            i, j = p["num_consts"], p["num_consts"] + p["num_carry"]
            carry, rows = operands[i:j], {}
            for turn, k in enumerate(reversed(range(p["length"])) if p["reverse"] else range(p["length"])):
                results = call(p["jaxpr"], [*operands[:i], *carry, *(x[k] for x in operands[j:])], (*here, turn))
                carry, rows[k] = results[: j - i], results[j - i :]
            return [*carry, *(jnp.stack(column) for column in zip(*(rows[k] for k in sorted(rows)), strict=True))]
        return call(body(equation), operands, (*here, 0))

    return run(jaxpr, (), inputs, (), until), seen
