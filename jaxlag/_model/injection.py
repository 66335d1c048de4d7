"""Arguments by name: a user's function receives exactly the arguments it names, and what it returns becomes floating arrays."""

import difflib
import inspect
from collections.abc import Callable, Collection, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .user_errors import explain_tracing_errors

STATE_NAMES = ("t", "q", "qdot", "qddot", "multipliers", "params", "states")  # "states": as they flow, for composed functions


def declared_parameters(function: Callable) -> tuple[inspect.Parameter, ...]:
    """The parameters that a user's function declares; variadic ones are refused, because they name nothing."""
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
                "Name them, or keep the signature of a wrapped function with `functools.wraps`."
            )
    return declared


def check_function(function: Any, label: str) -> None:
    """Refuses what cannot be called or hashed: compiled programs are found again by the hash of their functions."""
    if not callable(function):
        raise TypeError(f"{label} must be a function, but is {function!r}. Pass the function itself, not its value.")
    try:
        hash(function)
    except TypeError:
        kind = type(function).__name__
        cure = "Put its arrays into params and let the function name them as arguments."
        if type(function).__hash__ is None:
            cure = "Make it immutable, `@dataclass(frozen=True)`, or a plain function, and put what changes into params."
        raise TypeError(f"{label} must be a hashable function, but is a {kind} that cannot be hashed. {cure}") from None
    for name in _differentiated(function):
        raise ValueError(
            f"{label} must take what is differentiated from params, but closes over {name!r}, which is being differentiated. "
            f"Make {name!r} an entry of params, and let the function name it."
        )


def _differentiated(function: Any) -> list[str]:
    """Variables that a function closes over and `jax.grad` or `jax.jvp` is differentiating: no program would see their derivatives."""
    cells = zip(getattr(getattr(function, "__code__", None), "co_freevars", ()), getattr(function, "__closure__", None) or (), strict=False)
    traced = lambda x: isinstance(x, jax.core.Tracer) and hasattr(x, "tangent")  # an attribute of JAX's: without it nothing is refused
    return [name for name, cell in cells if _is_filled(cell) and any(map(traced, jax.tree.leaves(cell.cell_contents)))]


def _is_filled(cell: Any) -> bool:
    try:
        cell.cell_contents  # noqa: B018
    except ValueError:  # of a variable that is defined later
        return False
    return True


def asks_for(function: Callable, name: str) -> bool:
    """Whether a user's function asks for the argument `name`."""
    return any(p.name == name for p in declared_parameters(function))


def needs(function: Callable, name: str) -> bool:
    """Whether a user's function, or one of those that it is composed of, asks for the argument `name`."""
    return asks_for(function, name) or any(needs(part, name) for part in getattr(function, "composed_of", ()))


def call(function: Callable, role: str, params: Any, /, **state: Any) -> Any:
    """Calls `function` with exactly the arguments it names, taken from the state, `params` and the entries of `params`.

    `role` names the function in messages, e.g. "`dissipation` 'dampers'". What it returns becomes floating arrays.
    """
    entries = params if isinstance(params, Mapping) else {}
    available = {**entries, **state, "params": params}
    positional, keywords = [], {}
    for p in declared_parameters(function):
        if p.name not in available and p.default is p.empty:
            raise TypeError(_unknown(role, p.name, state, params))
        if p.kind is p.POSITIONAL_ONLY:  # one left out would shift the next into its place
            positional.append(available.get(p.name, p.default))
        elif p.name in available:
            keywords[p.name] = available[p.name]
    with explain_tracing_errors(role):
        returned = function(*positional, **keywords)
    return floating(returned, role, jnp.result_type(float, *filter(_is_floating, jax.tree.leaves(state))))


def floating(returned: Any, role: str, dtype: Any) -> Any:
    """What a function returned, as floating arrays: plain numbers as NumPy arrays, whose values Python can still read."""

    def leaf(path, x):
        if isinstance(x, (int, float, np.generic, np.ndarray)) and np.asarray(x).dtype.kind in "iuf" and not isinstance(x, bool):
            return np.asarray(x, dtype)
        if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jnp.integer):
            return x.astype(dtype)
        if not _is_floating(x):
            at = f" at {jax.tree_util.keystr(path)}" if path else ""
            raise TypeError(f"{role} must return real numbers, but returned {described(x)}{at}. Return numbers or arrays of them.")
        return x

    return jax.tree_util.tree_map_with_path(leaf, returned, is_leaf=lambda node: node is None)


def described(x: Any) -> str:
    """What a function returned, in words for messages."""
    if isinstance(x, np.ndarray) and x.shape == ():
        return f"the number {x:g}"
    if isinstance(x, (jax.Array, np.ndarray, jax.ShapeDtypeStruct)):
        return f"an array of shape {x.shape} and dtype {x.dtype}"
    return "nothing" if x is None else f"a {type(x).__name__}: {x!r}"


def _is_floating(x: Any) -> bool:
    return isinstance(x, (jax.Array, np.ndarray, np.generic)) and jnp.issubdtype(x.dtype, jnp.floating)


def check_entries(params: Any, names: Collection[str] = STATE_NAMES) -> None:
    """Refuses entries of `params` that the name of a state variable would hide."""
    if isinstance(params, Mapping):
        for hidden in set(params) & set(names):
            raise ValueError(
                f"`params` must not have an entry named {hidden!r}, but has one; that name stands for the state. Rename the entry."
            )


def missing(role: str, key: Any, q: Any, params: Any) -> str:
    """The message for a function that asks for an entry missing from q and params."""
    entries = {"q": q, "params": params}
    there = {name: sorted(map(str, tree)) for name, tree in entries.items() if isinstance(tree, Mapping)}
    close = difflib.get_close_matches(str(key), [entry for keys in there.values() for entry in keys], n=1)
    cure = f"Did you mean {close[0]!r}?" if close else f"Add {key!r} to q or params."
    have = "; ".join(f"{name} has {', '.join(keys) or 'none'}" for name, keys in there.items())
    return f"{role} must ask for entries that exist, but asks for {key!r}. {have}. {cure}"


def _unknown(role: str, name: str, state: Mapping[str, Any], params: Any) -> str:
    own = [known for known in STATE_NAMES if known in (*state, "params") and known != "states"]
    own += [known for known in state if known not in STATE_NAMES]
    if isinstance(params, Mapping):
        entries = sorted(map(str, params))
        where = f"the entries of params: {', '.join(entries)}" if entries else "params has no entries"
    elif params is None:
        entries, where = [], "params was not given"
    else:
        entries, where = [], "params is not a mapping, so its parts have no names"
    close = difflib.get_close_matches(name, own + entries, n=1)
    cure = f"Did you mean {close[0]!r}?" if close else f"Add {name!r} to params, or give it a default value."
    if name in STATE_NAMES:
        cure = "Leave it out: it is not known there."
    if not isinstance(params, Mapping) and hasattr(params, name):
        cure = f"Write `params.{name}`."
    return f"{role} must name arguments that exist, but it names {name!r}. There are {', '.join(own)}; {where}. {cure}"
