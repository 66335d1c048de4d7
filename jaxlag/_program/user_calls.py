"""What programs asked the user's functions for while they were traced, and what these answered: a program is known by the answers."""

from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .registry import Table

MOST_NUMBERS = 64  # of an array whose numbers Python knows: a function may have looked at them
MOST_CALLS = 64  # of different kinds, of one function; one that was called in more ways is not followed any longer


class Shape(NamedTuple):
    """An array of which only this is known."""

    shape: tuple[int, ...]
    dtype: str
    weak: bool


class Known(NamedTuple):
    """An array of known numbers."""

    shape: tuple[int, ...]
    dtype: str
    numbers: bytes


class Same(NamedTuple):
    """The very array that an earlier leaf is."""

    leaf: int


class Call(NamedTuple):
    """What a function was called with: the leaves and the structure of ((positional arguments), {arguments by name})."""

    leaves: tuple[Hashable, ...]
    structure: Any

    @classmethod
    def of(cls, positional: list, by_name: dict[str, Any]) -> "Call | None":
        """Of a call with these arguments; None if one of them cannot be described."""
        leaves, structure = jax.tree.flatten((tuple(positional), by_name))
        first: dict[int, int] = {}
        described = [_described(leaf) if first.setdefault(id(leaf), i) == i else Same(first[id(leaf)]) for i, leaf in enumerate(leaves)]
        return cls(tuple(described), structure) if all(isinstance(leaf, Hashable) for leaf in described) else None

    def arguments(self) -> tuple[list[jax.ShapeDtypeStruct], Callable]:
        """The shapes among the leaves, and the arguments as a function of arrays of these shapes."""
        shapes = [leaf for leaf in self.leaves if isinstance(leaf, Shape)]

        def filled(arrays: list) -> tuple[tuple, dict[str, Any]]:
            given = iter(arrays)
            leaves: list[Any] = []
            for leaf in self.leaves:
                leaves.append(leaves[leaf.leaf] if isinstance(leaf, Same) else next(given) if isinstance(leaf, Shape) else _value(leaf))
            return jax.tree.unflatten(self.structure, leaves)

        return [jax.ShapeDtypeStruct(x.shape, x.dtype, weak_type=x.weak) for x in shapes], filled


class Ledger:
    """The calls of each function while it is open, each with the digest of its answer then: a part of a program may have been traced with
    an earlier one, and what a function closes over may have changed since. A function of which not all is known has none here.
    """

    def __init__(self) -> None:
        self.digest: Callable[[Callable, Call], str | None] | None = None  # of an answer, while it is open; None where there is none
        self._answers = Table(weak=True)  # of each function, by call

    def note(self, function: Callable, positional: list, by_name: dict[str, Any]) -> None:
        """Writes a call down that has succeeded."""
        try:
            answers = self._answers.setdefault(function, None if self.digest is None else {})
        except TypeError:  # to which there are no weak references
            return
        if answers is None:
            return
        call = None if self.digest is None or len(answers) >= MOST_CALLS else Call.of(positional, by_name)
        if call is not None and call in answers:
            return
        answer = None if call is None or self.digest is None else self.digest(function, call)
        if call is None or answer is None:
            self._answers[function] = None
        else:
            answers[call] = answer

    def of(self, function: Callable) -> dict[Call, str]:
        """The calls of a function and its answers; none if they are not all known."""
        try:
            return self._answers.get(function) or {}
        except TypeError:
            return {}


LEDGER = Ledger()


def asked(function: Callable, positional: list, by_name: dict[str, Any]) -> Any:
    """`function(*positional, **by_name)`, written down in the ledger."""
    returned = function(*positional, **by_name)
    LEDGER.note(function, positional, by_name)
    return returned


def _described(leaf):
    if isinstance(leaf, (np.ndarray, np.generic)):
        return Known(leaf.shape, str(leaf.dtype), leaf.tobytes()) if leaf.size <= MOST_NUMBERS else leaf
    if isinstance(leaf, jax.Array):
        return Shape(leaf.shape, str(leaf.dtype), bool(getattr(leaf, "weak_type", False)))
    return leaf


def _value(leaf):
    return np.frombuffer(leaf.numbers, jnp.dtype(leaf.dtype)).reshape(leaf.shape).copy() if isinstance(leaf, Known) else leaf
