"""What programs asked the user's functions for while they were traced: a program is known by the answers."""

import weakref
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

MOST_NUMBERS = 64  # of an array whose numbers Python knows, and a function may have looked at
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


class Call(NamedTuple):
    """What a function was called with: the leaves and the structure of ((positional arguments), {arguments by name})."""

    leaves: tuple[Hashable, ...]
    structure: Any

    @classmethod
    def of(cls, positional: list, by_name: dict[str, Any]) -> "Call | None":
        """Of a call with these arguments; None if one of them has no hash."""
        leaves, structure = jax.tree.flatten((tuple(positional), by_name))
        described = tuple(map(_described, leaves))
        return cls(described, structure) if all(isinstance(leaf, Hashable) for leaf in described) else None

    def arguments(self) -> tuple[list[jax.ShapeDtypeStruct], Callable]:
        """The shapes among the leaves, and the arguments as a function of arrays of these shapes."""
        shapes = [leaf for leaf in self.leaves if isinstance(leaf, Shape)]

        def filled(arrays: list) -> tuple[tuple, dict[str, Any]]:
            given = iter(arrays)
            return jax.tree.unflatten(self.structure, [next(given) if isinstance(leaf, Shape) else _value(leaf) for leaf in self.leaves])

        return [jax.ShapeDtypeStruct(x.shape, x.dtype, weak_type=x.weak) for x in shapes], filled


class Ledger:
    """The calls of each function while it is open. They are kept by function and not by program: a part of a program may have been traced
    with an earlier one. A function of which not all calls are known has none here.
    """

    def __init__(self) -> None:
        self.is_open = False
        self._calls: weakref.WeakKeyDictionary[Callable, dict[Call, None] | None] = weakref.WeakKeyDictionary()

    def note(self, function: Callable, positional: list, by_name: dict[str, Any]) -> None:
        """Writes a call down."""
        try:
            calls = self._calls.setdefault(function, {} if self.is_open else None)
        except TypeError:  # to which there are no weak references
            return
        if calls is not None:
            call = Call.of(positional, by_name) if self.is_open else None
            if call is None or len(calls) > MOST_CALLS:
                self._calls[function] = None
            else:
                calls[call] = None

    def of(self, function: Callable) -> tuple[Call, ...]:
        """The calls of a function; none if they are not all known."""
        try:
            return tuple(self._calls.get(function) or ())
        except TypeError:
            return ()


LEDGER = Ledger()


def asked(function: Callable, positional: list, by_name: dict[str, Any]) -> Any:
    """`function(*positional, **by_name)`, written down in the ledger."""
    LEDGER.note(function, positional, by_name)
    return function(*positional, **by_name)


def _described(leaf):
    if isinstance(leaf, (np.ndarray, np.generic)) and leaf.size <= MOST_NUMBERS:
        return Known(leaf.shape, str(leaf.dtype), leaf.tobytes())
    if isinstance(leaf, (np.ndarray, np.generic, jax.Array)):
        return Shape(leaf.shape, str(leaf.dtype), bool(getattr(leaf, "weak_type", False)))
    return leaf


def _value(leaf):
    return np.frombuffer(leaf.numbers, jnp.dtype(leaf.dtype)).reshape(leaf.shape).copy() if isinstance(leaf, Known) else leaf
