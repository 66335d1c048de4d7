"""Old spellings of public names, which keep working for one version."""

import warnings
from typing import Any

from .user_errors import levels_to_the_user


def warn_renamed(old: str, new: str) -> None:
    """Warns, at the user's line, that `old` is now called `new`."""
    warnings.warn(f"`{old}` is now called `{new}`. Write `{new}`.", DeprecationWarning, stacklevel=levels_to_the_user())


def renamed(value: Any, name: str, **old: Any) -> Any:
    """The value of the argument `name`, or what was given under its old name."""
    ((old_name, old_value),) = old.items()
    if old_value is None:
        return value
    warn_renamed(old_name, name)
    return old_value
