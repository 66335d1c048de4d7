"""Expression nodes: scalars that are not numbers, and the algebra that says what they stand for."""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from jax.extend import core, source_info_util

Arrays = list[np.ndarray]  # each of numbers or, where at least one element is not known, of objects: NumPy scalars and `Node`s


class UnknownPrimitive(NotImplementedError):
    """A primitive that has no rule, and that the algebra does not know as a whole."""

    def __init__(self, primitive: core.Primitive, source: list):
        line = next(filter(None, map(source_info_util.summarize, source)), "an unknown line")
        super().__init__(
            f"a function that is written out must use known operations only, but uses `{primitive}` at {line}. "
            "Write it in elementary operations."
        )


class TooLong(Exception):
    """More scalar operations than allowed."""


class Algebra:
    """How scalars are combined: the meaning of expression nodes."""

    def number(self, x: np.generic) -> Any:
        """The scalar for a number among the operands."""
        return x

    def folds(self, x: Any) -> Any:
        """For each number, whether its arithmetic is exact enough to be done while tracing; other numbers become nodes."""
        return True

    def function(self, primitive: core.Primitive, params: dict, dtype: Any) -> Callable | None:
        """The scalar function that an element-wise primitive stands for; None where there is none."""
        raise NotImplementedError

    def shortcut(self, equation: core.JaxprEqn) -> Callable[..., Arrays] | None:
        """A function of object arrays for a call that has a simpler form than its body; None where it has none."""
        return None

    def block(self, equation: core.JaxprEqn) -> Callable[..., Arrays] | None:
        """A function of object arrays for an equation that is kept whole; None where there is none."""
        return None


@dataclasses.dataclass(eq=False, slots=True)
class Node:
    """An expression node: a function of earlier nodes and of numbers or, without a function, an argument."""

    index: int
    dtype: Any
    name: str
    function: Callable | None = None
    operands: tuple = ()

    def __hash__(self) -> int:
        """So that sets of nodes have one order, and a system one program, in every process."""
        return self.index


def is_number(x: Any) -> bool:
    """Whether it is a number, not a node or a scalar of an algebra."""
    return isinstance(x, (np.generic, int, float))


def order(x: Any) -> int:
    """Where a node stands among the others; numbers come before all."""
    return x.index if isinstance(x, Node) else -1


def filled(shape: tuple, elements: Iterable) -> np.ndarray:
    """An array of objects."""
    elements = list(elements)
    array = np.empty(len(elements), object)
    for i, x in enumerate(elements):
        array[i] = x
    return array.reshape(shape)


def objects(array: np.ndarray) -> np.ndarray:
    """The array with NumPy scalars, which know their dtype, in place of numbers."""
    return array if array.dtype == object else filled(array.shape, array.flat)
