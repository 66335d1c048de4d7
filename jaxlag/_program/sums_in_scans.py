"""Scans whose carries are running sums, as of a chain that is written link by link.

A carry with c' = c + u is the running sum of its summands u, where these do not depend on c itself. With all such sums given, the turns no
longer depend on one another, and stand side by side.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from jaxtyping import Array

from .constants import has_extended_dtype, is_numeric
from .walker import CALLS, called_program, parts_of_scan, walk


class Term(NamedTuple):
    """A value within a turn: the inputs of the turn that it depends on; and, for each of these that it is the sum of, unscaled, and
    something else, what that depends on.
    """

    of: frozenset[int]
    beside: dict[int, frozenset[int]]


class Turn(NamedTuple):
    """The body of a scan: its inputs are constants, carries and the rows of arrays, its outputs the carries and further rows."""

    body: Any
    constants: int
    carries: int
    length: int
    reverse: bool
    terms: list[Term]  # of its outputs

    @classmethod
    def of(cls, equation: Any) -> "Turn":
        """That of an equation."""
        p = equation.params
        inputs = [Term(frozenset([k]), {k: frozenset()}) for k in range(len(equation.invars))]
        terms = walk(p["jaxpr"], inputs, _term, _constant, _constant)
        i, j = parts_of_scan(p)
        return cls(p["jaxpr"], i, j - i, p["length"], p["reverse"], terms)

    def reached_from(self, depends: list[bool]) -> list[bool]:
        """Which inputs depend on those that do, the carries by way of other turns."""
        depends = list(depends)
        for _ in range(self.carries):
            for k in range(self.carries):
                depends[self.constants + k] |= any(depends[i] for i in self.terms[k].of)
        return depends

    def shifted(self, first: Any, after: Array) -> tuple[Array, Array]:
        """The values before each turn, from that before the first and those after each; and that after the last."""
        if self.reverse:
            return jnp.concatenate([after[1:], first[None]]), after[0]
        return jnp.concatenate([first[None], after[:-1]]), after[-1]

    def side_by_side(self, operands: list, before: dict[int, Array]) -> list[Array]:
        """The outputs of all turns, from carries before each of them; those that are not given are zero."""
        i, j = self.constants, self.constants + self.carries
        stacked = lambda x: jnp.zeros((self.length, *jnp.shape(x)), jnp.result_type(x))
        carries = [before[k] if k in before else stacked(operands[k]) for k in range(i, j)]
        axes = [None] * i + [0] * (len(operands) - i)
        return jax.vmap(core.jaxpr_as_fun(self.body), axes, axis_size=self.length)(*operands[:i], *carries, *operands[j:])

    def in_turn(self, operands: list, given: list[bool], known: dict[int, Array]) -> dict[int, Array]:
        """Beside those that are `known`, the carries before each turn that follow from the operands `given`, one turn after the other."""
        i, j = self.constants, self.constants + self.carries
        reached = self.reached_from([not of for of in given])
        which = [k for k in range(i, j) if not reached[k] and k not in known]
        operands = [x if of else np.zeros(np.shape(x), jnp.result_type(x)) for x, of in zip(operands, given, strict=True)]

        def turn(carry, rows):
            given, known = rows
            there = dict(enumerate(operands)) | known | dict(zip(which, carry, strict=True))
            outputs = core.jaxpr_as_fun(self.body)(*(there[k] for k in range(j)), *given)
            return [outputs[k - i] for k in which], carry

        if not which:
            return known
        start, rows = [jnp.asarray(operands[k]) for k in which], (operands[j:], known)
        return known | dict(zip(which, jax.lax.scan(turn, start, rows, self.length, self.reverse)[1], strict=True))


def _constant(_: Any) -> Term:
    """What depends on no input."""
    return Term(frozenset(), {})


def _term(equation: Any, operands: list[Term]) -> list[Term]:
    """What an equation makes of its operands."""
    name, shape = equation.primitive.name, equation.outvars[0].aval.shape if equation.outvars else ()
    if name in CALLS:
        return walk(called_program(equation), operands, _term, _constant, _constant)
    if name == "convert_element_type" and equation.invars[0].aval.dtype == equation.outvars[0].aval.dtype:
        return operands
    found = Term(frozenset().union(*(x.of for x in operands)), {})
    for at in {"add": (0, 1), "add_any": (0, 1), "sub": (0,)}.get(name, ()):
        if equation.invars[at].aval.shape == shape:
            more = operands[1 - at].of
            found = found._replace(beside=found.beside | {k: of | more for k, of in operands[at].beside.items() if k not in more})
    return [found] * len(equation.outvars)


def in_running_sums(equation: Any, operands: list, depends: list[bool], summed: Callable, dtype: Any) -> list[tuple[Array, bool]] | None:
    """The results of a scan, and whether they depend on what those of its operands do that `depends` says, with carries by
    `summed(summands, reverse)`; None where no carry depends on it, or one that is no running sum, or of another kind of numbers.
    """
    turn = Turn.of(equation)
    i, terms, moves = turn.constants, turn.terms, turn.reached_from(depends)
    waiting = [k for k in range(i, i + turn.carries) if moves[k]]
    if not waiting or not all(k in terms[k - i].beside for k in waiting) or any(map(has_extended_dtype, equation.invars)):
        return None
    if any(equation.invars[k].aval.dtype != dtype for k in waiting):
        return None
    with jax.ensure_compile_time_eval():
        operands = [jnp.asarray(x, atom.aval.dtype) if is_numeric(x) else x for x, atom in zip(operands, equation.invars, strict=True)]
        known = turn.in_turn(operands, [is_numeric(x) and not of for x, of in zip(operands, depends, strict=True)], {})
    before, finals = turn.in_turn(operands, [not of for of in depends], known), {}
    while waiting:
        k = next((k for k in waiting if not terms[k - i].beside[k].intersection(waiting)), None)
        if k is None:
            return None  # they need one another
        waiting.remove(k)
        summands, first = turn.side_by_side(operands, before)[k - i], operands[k]
        if any(k in term.of for at, term in enumerate(terms) if at != k - i):
            at_first = np.eye(1, turn.length, turn.length - 1 if turn.reverse else 0).reshape(-1, *[1] * (summands.ndim - 1))
            after = summed(summands + at_first.astype(summands.dtype) * first[None], turn.reverse)
            before[k], finals[k] = turn.shifted(first, after)
        else:  # it matters as a whole
            finals[k] = first + jnp.sum(summands, axis=0)
    outputs, last = turn.side_by_side(operands, before), 0 if turn.reverse else -1
    carries = [finals[k] if k in finals else outputs[k - i][last] for k in range(i, i + turn.carries)]
    return [(x, any(moves[k] for k in term.of)) for x, term in zip([*carries, *outputs[turn.carries :]], terms, strict=True)]
