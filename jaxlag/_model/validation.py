"""User input: its numbers are converted at each call, on the host; its functions are checked once, while a program is traced."""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._program.jit import compiled, is_concrete
from .._program.walker import used_arguments
from .event import merged
from .flat import Flat, StatesAt, bind, flat_like
from .given import Given, known, remember
from .injection import asks_for, call, check_entries, described, missing
from .numbers import Label, in_dtype, none_is_nan, number, numbers, refuse_nan, where_known
from .state_values import given_states, of_first_order, sampled, shaped_like, start_values
from .system import CONSTRAINT_SLOTS, SLOTS, System, role
from .user_errors import warn_of_recreated_functions

Arrays = PyTree[Array | np.ndarray]


def is_vector(node: Any) -> bool:
    """Whether `node` is a list of plain numbers, which counts as a vector."""
    return isinstance(node, list) and all(isinstance(entry, (float, int)) for entry in node)


def coordinates(q: Any, name: str) -> Arrays:
    """`q` as a pytree of floating arrays; integers and half precision become Python floats, and a list of numbers becomes a vector."""
    leaves, structure = _coordinates(q, name)
    return jax.tree.unflatten(structure, leaves)


def _coordinates(q, name):
    """The same as leaves and structure."""
    if hasattr(q, "q") and hasattr(q, "qdot"):  # a sample of a motion, an equilibrium, a motion
        raise TypeError(
            f"`{name}` must be coordinates, but is of class {type(q).__name__}, which holds them. Pass its parts, e.g. after "
            "`last = motion[-1]`: `simulate(system, last.q, last.qdot, ts, params, states=last.states)`."
        )
    is_leaf = lambda node: node is None or is_vector(node)
    given, structure = jax.tree.flatten(q, is_leaf=is_leaf)
    if not given:
        raise TypeError(f"`{name}` must hold at least one coordinate, but it is empty. Pass a number, an array or a dict of them.")
    return [_coordinate(leaf, Label(name, q, i, is_leaf)) for i, leaf in enumerate(given)], structure


def _coordinate(leaf, where):
    if not isinstance(leaf, (float, int, complex, np.generic, np.ndarray, jax.Array, list)):
        raise TypeError(f"{where} must be a real number or array, but is a {type(leaf).__name__}. Pass numbers only.")
    array = numbers(leaf, where)
    return array if array.dtype.itemsize >= 4 else array.astype(float)


def state(q: Any, qdot: Any, names: tuple[str, str] = ("q", "qdot")) -> tuple[Arrays, Arrays]:
    """Position and velocity as arrays of one structure, of equal shapes and one dtype."""
    (xs, need), (vs, have) = _coordinates(q, names[0]), _coordinates(qdot, names[1])
    if have != need:
        raise TypeError(f"`{names[1]}` must be structured like `{names[0]}`, {need}, but is {have}. Give each coordinate its velocity.")
    for i, (x, v) in enumerate(zip(xs, vs, strict=True)):
        if x.shape != v.shape:
            labels = (Label(name, jax.tree.unflatten(need, xs), i) for name in names)
            raise ValueError(
                "{1} must have the shape of {0}, {2}, but has {3}. Give each coordinate its velocity.".format(*labels, x.shape, v.shape)
            )
    dtypes = {x.dtype for x in (*xs, *vs)}
    dtype = dtypes.pop() if len(dtypes) == 1 else jnp.result_type(*dtypes)
    q, qdot = (jax.tree.unflatten(need, [in_dtype(x, dtype) for x in part]) for part in (xs, vs))
    return q, qdot


def parameters(params: PyTree, like: Arrays, name: str = "params") -> PyTree:
    """`params` with numbers as arrays, Python's in the precision of the coordinates, and mappings as dicts."""
    check_entries(params)
    return _parameters(params, jax.tree.leaves(like)[0].dtype, name)


def _parameters(params, dtype, name):
    leaves, structure = jax.tree.flatten(params)
    return jax.tree.unflatten(structure, [_parameter(leaf, dtype, Label(name, params, i)) for i, leaf in enumerate(leaves)])


def _parameter(leaf, dtype, label):
    if isinstance(leaf, (int, float)) and type(leaf) is not bool:
        return np.asarray(leaf, dtype)
    if type(leaf) is np.ndarray and leaf.dtype == dtype:  # the common one
        return np.array(leaf)
    if isinstance(leaf, jax.Array):  # a weakly typed one, such as `jnp.asarray(1.0)`, counts as a number: nothing is compiled again for it
        return leaf.astype(dtype) if jax.typeof(leaf).weak_type and leaf.dtype.kind == "f" else leaf
    if isinstance(leaf, Mapping):  # one that JAX takes for a leaf
        return _parameters(dict(leaf), dtype, str(label).strip("`"))
    if isinstance(leaf, np.ma.MaskedArray) or (isinstance(leaf, (np.ndarray, np.generic)) and leaf.dtype.kind not in "biucfV"):
        return str(leaf) if isinstance(leaf, np.str_) else numbers(leaf, label)
    if isinstance(leaf, (np.ndarray, np.generic)):
        known = leaf.dtype.itemsize <= 8 or leaf.dtype.kind == "c"
        return in_dtype(leaf, jax.dtypes.canonicalize_dtype(leaf.dtype if known else float))
    _check_visible(leaf, label)
    return leaf


def _check_visible(leaf: Any, label: Any) -> None:
    """Refuses objects whose numbers JAX cannot see: a compiled program would keep the ones it was first given."""
    kind = type(leaf).__name__
    if isinstance(leaf, (set, frozenset)):
        raise TypeError(f"{label} must be numbers in some order, but is a {kind}, which has none. Write a list or a tuple.")
    by_identity = type(leaf).__hash__ is object.__hash__ and not callable(leaf)  # type: ignore[comparison-overlap]
    try:
        hash(leaf)
    except TypeError:
        by_identity = True
    if by_identity:
        raise TypeError(
            f"{label} must be numbers, arrays, or a pytree of them, but is a {kind}, whose numbers JAX cannot see. "
            f"Register its class, `jax.tree_util.register_dataclass({kind})`, make it an `equinox.Module`, or write a dict."
        )


def state_and_params(q: Any, qdot: Any, params: PyTree, names: tuple[str, str] = ("q", "qdot")) -> Given:
    """`state` and `parameters`, packed; a structure of plain numbers is checked once."""
    found = known((q, qdot, params))
    if found is None:
        position, velocity = state(q, qdot, names)
        found = Given.of((position, velocity, parameters(params, position)))
        remember((q, qdot, params), found)
    return found


def sample_times(ts: Any, dtype: Any, *, repeated: bool = False) -> Float[Array | np.ndarray, " T"]:
    """The sample times as a vector, at least two and increasing; with `repeated`, some may be equal."""
    if isinstance(ts, Mapping):
        raise TypeError(f"`ts` must be a list of times, but is a {type(ts).__name__}. Pass `ts` before `params`.")
    ts = numbers(ts, "`ts`", dtype)
    if ts.ndim != 1 or ts.size < 2:
        raise ValueError(f"`ts` must be a list of at least two times, but has shape {ts.shape}. Start it with the time of q0.")
    if is_concrete(ts):
        _check_order(np.asarray(ts), repeated)
    return ts


def _check_order(ts, repeated):
    increasing = (ts[1:] >= ts[:-1]) & (ts[-1] > ts[0]) if repeated else ts[1:] > ts[:-1]
    if increasing.all() and np.isfinite(ts[[0, -1]]).all():
        return
    if not np.isfinite(ts).all():
        raise ValueError("`ts` must be finite, but has a NaN or an infinity. Drop the rows without a time.")
    i = int(np.argmin(increasing))
    cure = "Sort the times, of which two must differ." if repeated else "Sort the times and drop repeated ones."
    raise ValueError(f"`ts` must increase, but ts[{i}] = {ts[i]:g} is followed by ts[{i + 1}] = {ts[i + 1]:g}. {cure}")


def check(system: System, t: Array, q: Arrays, qdot: Arrays, params: PyTree, states: Mapping[str, PyTree]) -> None:
    """Refuses functions that return the wrong kind of thing. Evaluates shapes only: it runs while a program is traced, never with it."""
    _check_state_names(system, q, params)
    beside = dict(states) | {"states": states}
    for slot in ("lagrangian", "dissipation"):
        for name, function in getattr(system, slot):
            more = {} if slot == "lagrangian" else {"multipliers": _multipliers(system, t, q, qdot, params, beside)}
            out = _shape_of(function, role(slot, name), params, t=t, q=q, qdot=qdot, **beside, **more)
            if not (isinstance(out, jax.ShapeDtypeStruct) and out.shape == ()):
                raise ValueError(
                    f"{role(slot, name)} must return a real scalar, but returned {described(out)}. "
                    "Did you forget to sum, e.g. `qdot @ qdot`?"
                )
    for slot, has_velocity in CONSTRAINT_SLOTS.items():
        for name, function in getattr(system, slot):
            velocity = {"qdot": qdot} if has_velocity else {}
            out = _shape_of(function, role(slot, name), params, t=t, q=q, **velocity, **beside)
            if not jax.tree.leaves(out):
                raise ValueError(
                    f"{role(slot, name)} must return residuals, but returned {described(out)}. "
                    "Return what has to be zero, e.g. `q @ q - l**2`."
                )
            if slot == "unilateral" and not (isinstance(out, jax.ShapeDtypeStruct) and out.size):
                raise ValueError(
                    f"{role(slot, name)} must return a gap, a real number, or an array of them, but returned {described(out)}. "
                    "Return an array, or give each contact its name."
                )
            if slot == "unilateral" and not _uses_q(function, role(slot, name), params, q, t=t, **beside):
                raise ValueError(
                    f"{role(slot, name)} must depend on q, but does not: no force could keep it open. Write the distance to the obstacle."
                )
    for name, function in system.force:
        label, state = role("force", name), {"t": t, "q": q, "qdot": qdot, "multipliers": _multipliers(system, t, q, qdot, params, beside)}
        _shape_of(function, label, params, functools.partial(flat_like, q, label), **state, **beside)
    rates = [("rate", name, of.rate) for name, of in of_first_order(system).items()]
    for what, name, function in [*rates, *(("update", name, of.update) for name, of in sampled(system).items())]:
        label = f"`{what}` of state {name!r}"
        then = functools.partial(shaped_like, label, states[name])
        _shape_of(function, label, params, then, t=t, q=q, qdot=qdot, **beside)
    for name, event in system.events:
        _check_event(system, name, event, t, q, qdot, params, states)
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), (q, eqx.filter(params, eqx.is_array)))
    warn_of_recreated_functions([(role(s, n), f) for s in SLOTS for n, f in getattr(system, s)], shapes)


def _check_event(system, name, event, t, q, qdot, params, states):
    """Its witness is a number, and what it makes of the state a state."""
    beside = dict(states) | {"states": states}
    multipliers = _multipliers(system, t, q, qdot, params, beside)
    if callable(event.when):
        out = _shape_of(event.when, f"`when` of {name!r}", params, t=t, q=q, qdot=qdot, multipliers=multipliers, **beside)
        if not (isinstance(out, jax.ShapeDtypeStruct) and out.shape == ()):
            raise ValueError(
                f"`when` of {name!r} must return one real number, but returned {described(out)}. State an event for each number."
            )
    if event.then is not None:
        label, now = f"`then` of {name!r}", {"q": q, "qdot": qdot, "states": dict(states)}
        _shape_of(event.then, label, params, functools.partial(merged, label, now), t=t, q=q, qdot=qdot, **beside)


def _check_state_names(system, q, params):
    """A name stands for one thing."""
    names = [name for name, _ in system.states]
    check_entries(params, names)
    for name in set(names) & set(q if isinstance(q, Mapping) else ()):
        raise ValueError(f"`states` must not have a state named {name!r}, but has one, and so has q. Rename the state.")
    if isinstance(params, Mapping) and "speed" in params:
        for name, e in system.restitution:
            if callable(e) and asks_for(e, "speed"):
                raise ValueError(
                    f"`params` must not have an entry named 'speed' where `restitution` of {name!r} asks for the speed of approach under "
                    "that name, but has one. Rename the entry."
                )


def without_contacts(system: System, label: str) -> None:
    """Refuses systems whose contacts open and close, where these must not."""
    for name, _ in system.unilateral:
        raise ValueError(
            f"`system` must have no contacts that open and close in {label}, but has {name!r}. "
            "State those that stay closed as `holonomic`, and leave out the others."
        )


def without_events(system: System, label: str) -> None:
    """Refuses systems with events, where these must not be."""
    for name, _ in system.events:
        raise ValueError(
            f"`system` must have no events in {label}, but has {name!r}. Take `system.with_events(None)` and records between the events."
        )


def at_state(core: Callable[..., Any], system: System, q: Any, qdot: Any, params: Any, t: Any, states: Any = None) -> Any:
    """`core(flat, t, q, v)` of the checked system at a state given by the user; compiled once for each `core` and `system`.

    **Raises:** `ValueError` if an entry of params is NaN; under `jit` the result is NaN there.
    """
    given = state_and_params(q, qdot, params)
    t = number(t, "`t`", given.dtype, cure="Pass one time, and use `jax.vmap` for several.")
    found, sound = _at_state(core, system, t, given, {} if states is None else given_states(system, states, given.trees[0]))
    refuse_nan(given.trees[2], sound)
    return found


@compiled
def _at_state(core, system, t, given, states):
    q, qdot, params = given.trees
    sound = none_is_nan(params)
    return where_known(sound, core(*checked(system, t, q, qdot, params, states))), sound


def checked(system: System, t: Array, q: PyTree, qdot: PyTree, params: PyTree, states: Any) -> tuple[Flat, Array, Array, Array]:
    """The system over flat vectors and the state in them, after the check."""
    values = start_values(system, states, t, q, qdot, params)
    check(system, t, q, qdot, params, values)
    ravelled, rate = (jax.flatten_util.ravel_pytree(tree)[0] for tree in (q, qdot))
    return bind(system, q, params, StatesAt(values, t, ravelled, rate)), t, ravelled, rate


def _multipliers(system, t, q, qdot, params, beside):
    slots = [
        (role(s, n), f, {"qdot": qdot} if has_velocity else {})
        for s, has_velocity in CONSTRAINT_SLOTS.items()
        for n, f in getattr(system, s)
    ]
    shapes = [_shape_of(f, label, params, t=t, q=q, **velocity, **beside) for label, f, velocity in slots]
    return dict(zip(system.constraints, jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes), strict=True))


def _uses_q(function, label, params, q, /, **state):
    """Whether the program of a function uses any coordinate."""
    numbers, rest = eqx.partition(params, eqx.is_array)
    program = lambda q, numbers, state: call(function, label, eqx.combine(numbers, rest), q=q, **state)
    return any(jax.tree.leaves(used_arguments(program, q, numbers, state)[0]))


def _shape_of(function, label, params, then=lambda out: out, /, **state):
    numbers, rest = eqx.partition(params, eqx.is_array)
    try:
        return jax.eval_shape(lambda numbers, state: then(call(function, label, eqx.combine(numbers, rest), **state)), numbers, state)
    except KeyError as error:
        if not (isinstance(state["q"], Mapping) or isinstance(params, Mapping)):
            raise
        raise ValueError(missing(label, error.args[0] if error.args else "", state["q"], params)) from error
