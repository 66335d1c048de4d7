"""The one rule for functions: a function receives exactly the arguments it names."""

import difflib
import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any

STATE_NAMES = ("t", "q", "qdot", "qddot", "multipliers", "params")


@functools.lru_cache(maxsize=4096)
def parameters(function: Callable) -> tuple[inspect.Parameter, ...]:
    """The parameters a user's function declares; variadic ones are refused, for they name nothing."""
    try:
        declared = tuple(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):
        raise TypeError(
            f"a function must show the names of its arguments, but {function!r} has no readable signature. "
            "Wrap it, e.g. `lambda q, qdot: ...`."
        ) from None
    for p in declared:
        if p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD):
            raise TypeError(
                f"a function must name each of its arguments, but {function!r} takes `{p}`. "
                "Name them, or keep the signature of a wrapped function by `functools.wraps`."
            )
    return declared


def names(function: Callable, name: str) -> bool:
    """Whether a user's function asks for the argument `name`."""
    return any(p.name == name for p in parameters(function))


def call(function: Callable, role: str, params: Any, /, **state: Any) -> Any:
    """Calls `function` with exactly the arguments it names, out of the state, `params` and the entries of `params`.

    `role` is how messages speak of the function, e.g. "`dissipation` 'dampers'".
    """
    entries = params if isinstance(params, Mapping) else {}
    available = {**entries, **state, "params": params}
    positional, keywords = [], {}
    for p in parameters(function):
        if p.name in available:
            value = available[p.name]
        elif p.default is not p.empty:
            continue
        else:
            raise TypeError(_unknown(role, p.name, state, params))
        if p.kind is p.POSITIONAL_ONLY:
            positional.append(value)
        else:
            keywords[p.name] = value
    return function(*positional, **keywords)


def check_entries(params: Any) -> None:
    """Refuses entries of `params` that a name of the state would hide."""
    if isinstance(params, Mapping):
        for hidden in set(params) & set(STATE_NAMES):
            raise ValueError(
                f"`params` must not have an entry named {hidden!r}, but it has; that name stands for the state. Rename the entry."
            )


def missing(role: str, key: Any, q: Any, params: Any) -> str:
    """What to say where a function asks for an entry of q or params that is not there."""
    entries = {"q": q, "params": params}
    there = {name: sorted(map(str, tree)) for name, tree in entries.items() if isinstance(tree, Mapping)}
    close = difflib.get_close_matches(str(key), [entry for keys in there.values() for entry in keys], n=1)
    cure = f"Did you mean {close[0]!r}?" if close else f"Add {key!r} where it belongs."
    have = "; ".join(f"{name} has {', '.join(keys) or 'none'}" for name, keys in there.items())
    return f"{role} must ask for entries that exist, but asks for {key!r}. {have}. {cure}"


def _unknown(role: str, name: str, state: Mapping[str, Any], params: Any) -> str:
    own = [known for known in STATE_NAMES if known in (*state, "params")]
    if isinstance(params, Mapping):
        entries = sorted(map(str, params))
        where = f"the entries of params: {', '.join(entries)}" if entries else "params has no entries"
    elif params is None:
        entries, where = [], "params was not given"
    else:
        entries, where = [], "params is not a mapping, so its parts have no names"
    close = difflib.get_close_matches(name, own + entries, n=1)
    cure = f"Did you mean {close[0]!r}?" if close else f"Add {name!r} to params, or give it a default value."
    return f"{role} must name arguments that exist, but it names {name!r}. There are {', '.join(own)}; {where}. {cure}"
