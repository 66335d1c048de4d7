"""What is static about a call, known by its content: functions that are written again, as in a notebook's cell that is run again, are one.

What they refer to, numbers that they close over, other functions, counts as theirs. Where that changes, programs are traced anew.
"""

import collections
from collections.abc import Callable
from typing import Any

from .description import Words
from .registry import Table

ALIKE = 8  # calls of equal content, the latest of which are known at once


class Static:
    """Leaves that are no arrays, and the structure; equal where their words are, or where there are none where they are themselves."""

    __slots__ = ("__weakref__", "_alike", "_hash", "_key", "has_words", "leaves", "structure", "unchanged")

    def __init__(self, leaves: tuple, structure: Any) -> None:
        self.leaves, self.structure = leaves, structure
        self._key: Any = (leaves, structure)
        self.unchanged: list[Callable[[], bool]] = []  # for each thing that its functions refer to
        self._alike: collections.deque[Static] = collections.deque(maxlen=ALIKE)
        words = Words()
        try:
            self.describe(words)
            self._key, self.unchanged = words.digest(), words.unchanged
        except Exception:  # an object of the user's may do anything when it is looked at
            pass
        self.has_words = isinstance(self._key, str)
        self._hash = hash(self._key)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Static) and self._key == other._key)

    def _is_unchanged(self):
        for is_so in self.unchanged:  # noqa: SIM110 - `all(...)` takes three times as long, and this is asked at each call
            if not is_so():
                return False
        return True

    def was_traced(self) -> None:
        """A function that has changed what it refers to itself meanwhile, as one that counts its calls, is not watched any longer."""
        if not self._is_unchanged():
            self.unchanged = []

    def describe(self, words: Words) -> None:
        """Says what it is."""
        words.value(self.leaves)
        words.structure(self.structure)

    @classmethod
    def of(cls, leaves: tuple, structure: Any) -> "Static":
        """That of this call, or of one before."""
        known = _KNOWN.entries.get((leaves, structure))
        if known is not None and known._is_unchanged():
            return known
        new = _KNOWN[leaves, structure] = cls(leaves, structure)
        first = _FIRST.setdefault(new._key, new)  # that JAX keeps alive, with its program
        if first is not new:
            first._alike.append(new)
        return new


_KNOWN = Table(weak="values")  # of each call
_FIRST = Table(weak="values")  # of each content
