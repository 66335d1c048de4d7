"""User input: converted to arrays once and checked once, while a program is traced, at no cost at run time."""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from .._program.jit import compiled, is_concrete
from .flat import Flat, bind, flat_like
from .injection import call, check_entries, described, missing
from .numbers import number, numbers
from .system import CONSTRAINT_SLOTS, SLOTS, System, role
from .user_errors import warn_of_recreated_functions


def is_vector(node: Any) -> bool:
    """Whether `node` is a list of plain numbers, which counts as a vector."""
    return isinstance(node, list) and all(isinstance(entry, (float, int)) for entry in node)


def coordinates(q: Any, name: str) -> PyTree[Array]:
    """`q` as a pytree of floating arrays; integers and half precision become Python floats, and a list of numbers becomes a vector."""

    def floating(path, leaf):
        where = f"`{name}{jax.tree_util.keystr(path)}`"
        if not isinstance(leaf, (float, int, complex, np.generic, np.ndarray, jax.Array, list)):
            raise TypeError(f"{where} must be a real number or array, but is a {type(leaf).__name__}. Pass numbers only.")
        array = numbers(leaf, where)
        return array if array.dtype.itemsize >= 4 else array.astype(float)

    q = jax.tree_util.tree_map_with_path(floating, q, is_leaf=lambda node: node is None or is_vector(node))
    if not jax.tree.leaves(q):
        raise TypeError(f"`{name}` must hold at least one coordinate, but it is empty. Pass a number, an array or a dict of them.")
    return q


def state(q: Any, qdot: Any, names: tuple[str, str] = ("q", "qdot")) -> tuple[PyTree[Array], PyTree[Array]]:
    """Position and velocity as arrays of one structure, of equal shapes and one dtype."""
    q, qdot = coordinates(q, names[0]), coordinates(qdot, names[1])
    have, need = jax.tree.structure(qdot), jax.tree.structure(q)
    if have != need:  # type: ignore[operator]
        raise TypeError(f"`{names[1]}` must be structured like `{names[0]}`, {need}, but is {have}. Give each coordinate its velocity.")
    dtype = jnp.result_type(*jax.tree.leaves((q, qdot)))
    for (path, x), v in zip(jax.tree_util.tree_flatten_with_path(q)[0], jax.tree.leaves(qdot), strict=True):
        if x.shape != v.shape:
            at = jax.tree_util.keystr(path)
            raise ValueError(
                f"`{names[1]}{at}` must have the shape of `{names[0]}{at}`, {x.shape}, but has {v.shape}. "
                "Give each coordinate its velocity."
            )
    return jax.tree.map(lambda x: x.astype(dtype), (q, qdot))


def parameters(params: PyTree, like: PyTree[Array], name: str = "params") -> PyTree:
    """`params` with numbers and arrays as JAX arrays, Python numbers in the precision of the coordinates, and mappings as dicts."""
    check_entries(params)
    dtype = jax.tree.leaves(like)[0].dtype

    def array(path, leaf):
        label = f"`{name}{jax.tree_util.keystr(path)}`"
        if isinstance(leaf, Mapping):  # one that JAX takes for a leaf
            return jax.tree_util.tree_map_with_path(lambda rest, leaf: array((*path, *rest), leaf), dict(leaf))
        if isinstance(leaf, (int, float)) and not isinstance(leaf, bool):
            return jnp.asarray(leaf, dtype)
        if isinstance(leaf, np.ma.MaskedArray) or (isinstance(leaf, (np.ndarray, np.generic)) and leaf.dtype.kind not in "biucfV"):
            return str(leaf) if isinstance(leaf, np.str_) else numbers(leaf, label)
        if isinstance(leaf, (np.ndarray, np.generic)):
            return jnp.asarray(leaf if leaf.dtype.itemsize <= 8 or leaf.dtype.kind == "c" else leaf.astype(float))
        _check_visible(leaf, label)
        return leaf

    return jax.tree_util.tree_map_with_path(array, params)


def _check_visible(leaf: Any, label: str) -> None:
    """Refuses objects whose numbers JAX cannot see: a compiled program would keep the ones it was first given."""
    kind = type(leaf).__name__
    if isinstance(leaf, (set, frozenset)):
        raise TypeError(f"{label} must be numbers in some order, but is a {kind}, which has none. Write a list or a tuple.")
    by_identity = type(leaf).__hash__ is object.__hash__ and not callable(leaf) and not isinstance(leaf, jax.Array)  # type: ignore[comparison-overlap]
    try:
        hash(None if isinstance(leaf, jax.Array) else leaf)
    except TypeError:
        by_identity = True
    if by_identity:
        raise TypeError(
            f"{label} must be numbers, arrays, or a pytree of them, but is a {kind}, whose numbers JAX cannot see. "
            f"Register its class, `jax.tree_util.register_dataclass({kind})`, make it an `equinox.Module`, or write a dict."
        )


def sample_times(ts: Any, dtype: Any) -> Array:
    """The sample times as a vector, at least two and increasing."""
    if isinstance(ts, Mapping):
        raise TypeError(f"`ts` must be a list of times, but is a {type(ts).__name__}. Pass `ts` before `params`.")
    ts = numbers(ts, "`ts`", dtype)
    if ts.ndim != 1 or ts.size < 2:
        raise ValueError(f"`ts` must be a list of at least two times, but has shape {ts.shape}. Start it with the time of q0.")
    if is_concrete(ts):
        if not np.all(np.isfinite(ts)):
            raise ValueError("`ts` must be finite, but has a NaN or an infinity. Drop the rows without a time.")
        steps = np.diff(np.asarray(ts))
        if (steps <= 0).any():
            i = int(np.argmax(steps <= 0))
            raise ValueError(
                f"`ts` must increase, but ts[{i}] = {ts[i]:g} is followed by ts[{i + 1}] = {ts[i + 1]:g}. "
                "Sort the times and drop repeated ones."
            )
    return ts


def check(system: System, t: Array, q: PyTree[Array], qdot: PyTree[Array], params: PyTree) -> None:
    """Refuses functions that return the wrong kind of thing. Evaluates shapes only: it runs while a program is traced, never with it."""
    for slot in ("lagrangian", "dissipation"):
        for name, function in getattr(system, slot):
            more = {} if slot == "lagrangian" else {"multipliers": _multipliers(system, t, q, qdot, params)}
            out = _shape_of(function, role(slot, name), params, t=t, q=q, qdot=qdot, **more)
            if not (isinstance(out, jax.ShapeDtypeStruct) and out.shape == ()):
                raise ValueError(
                    f"{role(slot, name)} must return a real scalar, but returned {described(out)}. "
                    "Did you forget to sum, e.g. `qdot @ qdot`?"
                )
    for slot, has_velocity in CONSTRAINT_SLOTS.items():
        for name, function in getattr(system, slot):
            velocity = {"qdot": qdot} if has_velocity else {}
            out = _shape_of(function, role(slot, name), params, t=t, q=q, **velocity)
            if not jax.tree.leaves(out):
                raise ValueError(
                    f"{role(slot, name)} must return residuals, but returned {described(out)}. "
                    "Return what has to be zero, e.g. `q @ q - l**2`."
                )
    for name, function in system.force:
        label, state = role("force", name), {"t": t, "q": q, "qdot": qdot, "multipliers": _multipliers(system, t, q, qdot, params)}
        _shape_of(function, label, params, functools.partial(flat_like, q, label), **state)
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), (q, eqx.filter(params, eqx.is_array)))
    warn_of_recreated_functions([(role(s, n), f) for s in SLOTS for n, f in getattr(system, s)], shapes)


def at_state(core: Callable[..., Any], system: System, q: Any, qdot: Any, params: Any, t: Any) -> Any:
    """`core(flat, t, q, v)` of the checked system at a state given by the user; compiled once for each `core` and `system`."""
    q, qdot = state(q, qdot)
    t = number(t, "`t`", jax.tree.leaves(q)[0].dtype, cure="Pass one time, and use `jax.vmap` for several.")
    return _at_state(core, system, t, q, qdot, parameters(params, q))


@compiled
def _at_state(core, system, t, q, qdot, params):
    return core(*checked(system, t, q, qdot, params))


def checked(system: System, t: Array, q: PyTree, qdot: PyTree, params: PyTree) -> tuple[Flat, Array, Array, Array]:
    """The system over flat vectors and the state in them, after the check."""
    check(system, t, q, qdot, params)
    ravelled, _ = jax.flatten_util.ravel_pytree(q)
    return bind(system, q, params), t, ravelled, jax.flatten_util.ravel_pytree(qdot)[0]


def _multipliers(system, t, q, qdot, params):
    slots = [
        (role(s, n), f, {"qdot": qdot} if has_velocity else {})
        for s, has_velocity in CONSTRAINT_SLOTS.items()
        for n, f in getattr(system, s)
    ]
    shapes = [_shape_of(f, label, params, t=t, q=q, **velocity) for label, f, velocity in slots]
    return dict(zip(system.constraints, jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes), strict=True))


def _shape_of(function, label, params, then=lambda out: out, /, **state):
    numbers, rest = eqx.partition(params, eqx.is_array)
    try:
        return jax.eval_shape(lambda numbers, state: then(call(function, label, eqx.combine(numbers, rest), **state)), numbers, state)
    except KeyError as error:
        if not (isinstance(state["q"], Mapping) or isinstance(params, Mapping)):
            raise
        raise ValueError(missing(label, error.args[0] if error.args else "", state["q"], params)) from error
