"""Everything that a process remembers between calls: tables of limited size, forgotten together.

An entry about an object of the user's goes with that object. Of all other entries, the latest stay.
"""

import functools
import weakref
from collections.abc import Callable, Iterator, MutableMapping
from typing import Any

import jax

MOST = 128  # entries of a table: a compiled program has some megabytes

_CLEAR: list[Callable[[], None]] = []  # one for each table


class Table(MutableMapping):
    """Values by key; with `weak` for as long as the key lives, or with `weak="values"` the value."""

    def __init__(self, *, weak: bool | str = False, most: int = MOST) -> None:
        of_values: MutableMapping[Any, Any] = weakref.WeakValueDictionary()
        self.entries = of_values if weak == "values" else weakref.WeakKeyDictionary() if weak else {}
        self.most = None if weak else most
        _CLEAR.append(self.entries.clear)

    def __getitem__(self, key: Any) -> Any:
        return self.entries[key]

    def __setitem__(self, key: Any, value: Any) -> None:
        while self.most is not None and key not in self.entries and len(self.entries) >= self.most:
            del self.entries[next(iter(self.entries))]
        self.entries[key] = value

    def __delitem__(self, key: Any) -> None:
        del self.entries[key]

    def __iter__(self) -> Iterator[Any]:
        return iter(self.entries)

    def __len__(self) -> int:
        return len(self.entries)


def remembered(function: Callable) -> Any:
    """`function` with the values that it returned last, by its arguments, which are kept alive."""
    cached = functools.lru_cache(MOST)(function)
    _CLEAR.append(cached.cache_clear)
    return cached


def forget() -> None:
    """Clears all tables, and the caches of JAX, which hold what the tables know about."""
    jax.clear_caches()
    for clear in _CLEAR:
        clear()
