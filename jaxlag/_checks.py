"""The border: what a user hands over becomes arrays once, and is checked once, free of run time."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ._arguments import call, check_entries, missing
from ._compiled import compiled, is_concrete
from ._system import Flat, System, bind, role


def is_vector(node: Any) -> bool:
    """Whether `node` is a list of plain numbers, which is taken as a vector."""
    return isinstance(node, list) and all(isinstance(entry, (float, int)) for entry in node)


def coordinates(q: Any, name: str) -> PyTree[Array]:
    """`q` as a pytree of floating arrays; integers are taken as floats, and a list of numbers as a vector."""

    def floating(path, leaf):
        where = f"`{name}{jax.tree_util.keystr(path)}`"
        leaf = np.asarray(leaf) if is_vector(leaf) else leaf
        if not isinstance(leaf, (float, int, complex, np.generic, np.ndarray, jax.Array)):
            raise TypeError(f"{where} must be a real number or array, but is a {type(leaf).__name__}. Hand over numbers only.")
        dtype = np.asarray(leaf).dtype if not isinstance(leaf, jax.Array) else leaf.dtype
        if jnp.issubdtype(dtype, jnp.bool_) or not jnp.issubdtype(dtype, jnp.number) or jnp.issubdtype(dtype, jnp.complexfloating):
            raise TypeError(f"{where} must be real, but has dtype {dtype}. Hand over floating-point numbers.")
        return jnp.asarray(leaf, None if jnp.issubdtype(dtype, jnp.floating) and not isinstance(leaf, float) else float)

    q = jax.tree_util.tree_map_with_path(floating, q, is_leaf=lambda node: node is None or is_vector(node))
    if not jax.tree.leaves(q):
        raise TypeError(f"`{name}` must hold at least one coordinate, but it is empty. Hand over a number, an array or a dict of them.")
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


def parameters(params: PyTree, like: PyTree[Array]) -> PyTree:
    """`params` with Python numbers and NumPy arrays as JAX arrays, in the precision of the coordinates; the rest as it is."""
    check_entries(params)
    dtype = jax.tree.leaves(like)[0].dtype

    def array(leaf):
        if isinstance(leaf, (int, float)) and not isinstance(leaf, bool):
            return jnp.asarray(leaf, dtype)
        return jnp.asarray(leaf) if isinstance(leaf, (np.ndarray, np.generic)) else leaf

    return jax.tree.map(array, params)


def sample_times(ts: Any, dtype: Any) -> Array:
    """The sample times as a vector, at least two and increasing."""
    ts = jnp.asarray(ts, dtype)
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
    """Refuses functions that return the wrong kind of thing. Shapes only: runs while a program is traced, never with it."""
    for slot in ("lagrangian", "dissipation"):
        for name, function in getattr(system, slot):
            more = {} if slot == "lagrangian" else {"multipliers": _multipliers(system, t, q, qdot, params)}
            out = _shape_of(function, role(slot, name), params, t=t, q=q, qdot=qdot, **more)
            if not (_is_real(out) and out.shape == ()):
                raise ValueError(
                    f"{role(slot, name)} must return a real scalar, but returned {_spoken(out)}. Did you forget to sum, e.g. `qdot @ qdot`?"
                )
    for slot in ("holonomic", "nonholonomic"):
        for name, function in getattr(system, slot):
            velocity = {} if slot == "holonomic" else {"qdot": qdot}
            out = _shape_of(function, role(slot, name), params, t=t, q=q, **velocity)
            if not (jax.tree.leaves(out) and all(map(_is_real, jax.tree.leaves(out)))):
                raise ValueError(
                    f"{role(slot, name)} must return real floating-point residuals, but returned {_spoken(out)}. "
                    "Return what has to be zero, e.g. `q @ q - l**2`."
                )
    for name, function in system.force:
        multipliers = _multipliers(system, t, q, qdot, params)
        out = _shape_of(function, role("force", name), params, t=t, q=q, qdot=qdot, multipliers=multipliers)
        _check_force(role("force", name), out, q)


def at_state(core: Callable[..., Any], system: System, q: Any, qdot: Any, params: Any, t: Any) -> Any:
    """`core(flat, t, q, v)` of the checked system at one state given by a user; compiled once for each `core` and `system`."""
    q, qdot = state(q, qdot)
    dtype = jax.tree.leaves(q)[0].dtype
    return _at_state(core, system, jnp.asarray(t, dtype), q, qdot, parameters(params, q))


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
        (role(s, n), f, {} if s == "holonomic" else {"qdot": qdot}) for s in ("holonomic", "nonholonomic") for n, f in getattr(system, s)
    ]
    shapes = [_shape_of(f, spoken, params, t=t, q=q, **velocity) for spoken, f, velocity in slots]
    return dict(zip(system.constraints, jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes), strict=True))


def _shape_of(function, spoken, params, **state):
    try:
        return eqx.filter_eval_shape(lambda params, state: call(function, spoken, params, **state), params, state)
    except KeyError as error:
        if not (isinstance(state["q"], Mapping) or isinstance(params, Mapping)):
            raise
        raise ValueError(missing(spoken, error.args[0] if error.args else "", state["q"], params)) from error


def _is_real(leaf: Any) -> bool:
    return hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jnp.floating)


def _spoken(out: Any) -> str:
    if hasattr(out, "shape"):
        return f"an array of shape {out.shape} and dtype {out.dtype}"
    return "nothing" if out is None else f"a {type(out).__name__}: {out}"


def _check_force(spoken: str, out: Any, q: PyTree) -> None:
    cure = "Return one entry for each coordinate; where q is a mapping, coordinates without a force may be left out."
    if not jax.tree.leaves(out) and out != {}:
        raise ValueError(f"{spoken} must be shaped like q, but returned nothing. {cure}")
    shapes = dict(jax.tree_util.tree_flatten_with_path(q)[0])
    for path, leaf in jax.tree_util.tree_flatten_with_path(out)[0]:
        at = jax.tree_util.keystr(path)
        if path not in shapes:
            raise ValueError(f"{spoken} must be shaped like q, but returned an entry {at or 'without a name'} that q has not. {cure}")
        if not _is_real(leaf) or leaf.shape != shapes[path].shape:
            raise ValueError(f"{spoken}{at} must be real and of shape {shapes[path].shape}, but is {_spoken(leaf)}. {cure}")
    if not isinstance(q, dict) and len(jax.tree.leaves(out)) != len(shapes):
        raise ValueError(f"{spoken} must be shaped like q, but returned {len(jax.tree.leaves(out))} of {len(shapes)} entries. {cure}")
