"""What is asked, as a `Setting` and a `Task`: checked once."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from .._mechanics.friction_elements import find_elements
from .._mechanics.lagrange import imbalance
from .._model.flat import Flat, bind, bound_from
from .._model.injection import check_function
from .._model.numbers import count, library, number, numbers, refuse_nan
from .._model.paths import is_within, leaf_names, listed
from .._model.reading import Source
from .._model.system import System
from .._model.validation import parameters, without_contacts, without_events
from .._program.jit import compiled, is_concrete
from .boundary import Boundary
from .input import Held, is_called
from .transcription import Limit, Setting, Task

Ends = tuple[Array | np.ndarray, Array | np.ndarray]  # lower and upper bounds
STATES = 3  # at random, at which it is asked whether a control does anything


def _counted(flat: Flat, t: Any, q: Any, v: Any) -> tuple[int, int, bool]:
    """How many rows all constraints have, and the holonomic ones; and whether there is dry friction."""
    return flat.rows, flat.rows_of_bilateral, find_elements(flat) is not None


def stated(system: System, boundary: Boundary, params: PyTree, given: Mapping[str, Any]) -> tuple[Setting, Task]:
    """Of the arguments of `optimise_motion`, `given` by name."""
    limits = _refuse(system, given)
    dtype, like = boundary.states.dtype, boundary.like
    params = _parameters(params, like, given["control"])
    bounds = {name: _pair(pair, f"`control[{name!r}]`", dtype) for name, pair in given["control"].items()}
    shapes = tuple((name, np.shape(low)) for name, (low, _) in bounds.items())
    moves, is_signal = _moves(system, like, params, shapes)
    source = Source.of(system, like, {**params, **_held(shapes, is_signal, dtype)}, None)
    multipliers, positions, rubs = source.read(_counted, bound_from)
    if rubs:
        raise ValueError(
            "`system` must have a smooth dissipation in `optimise_motion`, but has dry friction, whose phases are not searched. Replace "
            "it by a force where it slips, and by a holonomic constraint where it sticks, or smooth it."
        )
    _refuse_idle(moves, shapes)
    T, durations = _duration(given["duration"], dtype)
    leaves, chosen = _chosen(given["over"], params, dtype)
    of_limits, sizes = _limits(given["within"] or {}, dtype)
    setting = Setting(
        system,
        given["cost"] or _of_time,
        given["end_cost"],
        limits,
        controls=shapes,
        over=leaves,
        is_signal=is_signal,
        intervals=count(given["nodes"], "`nodes`", cure="Give the number of intervals."),
        is_free=durations is not None,
        multipliers=multipliers,
        positions=positions,
        limited=sizes,
        chosen=chosen[0].size,
        steps=count(given["steps"], "`steps`", cure="Give a number of steps."),
        is_guessed=given["guess"] is not None,
        starts=count(given["starts"], "`starts`", cure="Give the number of ways that are tried."),
    )
    task = Task(
        like,
        params,
        number(given["t"], "`t`", dtype, cure="Give the time at the start."),
        T,
        library(*(durations or (T,))).stack(durations or (T, T)),
        boundary.states[0],
        nodes_of(boundary, setting.intervals),
        np.array(boundary.returns, dtype),
        inputs=_joined(bounds.values(), dtype),
        limits=of_limits,
        chosen=chosen,
    )
    return setting, task


def _parameters(params: PyTree, like: PyTree, control: Mapping[str, Any]) -> Any:
    params = parameters({} if params is None else params, like)
    if not isinstance(params, Mapping):
        raise TypeError("`params` must be a mapping, beside whose entries the controls stand by name, but is not. Use a dict.")
    refuse_nan(params)
    for name in control:
        if name in params:
            raise ValueError(f"`control` must have names of its own, but {name!r} is an entry of `params`, too. Remove it there.")
    return params


def _of_time() -> float:
    """What least time costs."""
    return 1.0


def _refuse(system: System, given: Mapping[str, Any]) -> tuple[Limit, ...]:
    """Checks functions, the guess and what the system may have; the limits."""
    control = given["control"]
    if not isinstance(system, System):
        raise TypeError(f"`system` must be a `System`, but is of class {type(system).__name__}. Build one from a Lagrangian.")
    without_contacts(system, "`optimise_motion`")
    without_events(system, "`optimise_motion`")
    if system.states:
        raise ValueError(
            f"`system` must have no further states in `optimise_motion`, but has {', '.join(dict(system.states))}. Leave them out."
        )
    if not isinstance(control, Mapping) or not control:
        raise ValueError('`control` must name inputs with their bounds, but does not. Write e.g. `control={"u": (-20, 20)}`.')
    for name in ("cost", "end_cost"):
        if given[name] is not None:
            check_function(given[name], f"`{name}`")
    limits = []
    for name, limit in (given["within"] or {}).items():
        if not (isinstance(limit, (tuple, list)) and len(limit) == 3):
            raise ValueError(f"`within[{name!r}]` must be (function, lower, upper), but is {limit!r}. None is no limit.")
        check_function(limit[0], f"`within[{name!r}]`")
        limits.append(Limit(str(name), limit[0]))
    guess = given["guess"]
    if guess is not None and not all(hasattr(guess, part) for part in ("ts", "q", "qdot")):
        raise TypeError(f"`guess` must be a motion, but is of class {type(guess).__name__}. Give a `Trajectory` or an `OptimalMotion`.")
    return tuple(limits)


def _pair(given: Any, label: str, dtype: Any) -> Ends:
    """(lower, upper) as arrays of one shape, infinite where there is no bound."""
    if given is None:
        given = None, None
    if not (isinstance(given, (tuple, list)) and len(given) == 2):
        raise ValueError(f"{label} must be (lower, upper), but is {given!r}. None is no bound.")
    lower, upper = (numbers(end, label, dtype) if end is not None else sign * np.inf for end, sign in zip(given, (-1, 1), strict=True))
    shape = np.broadcast_shapes(np.shape(lower), np.shape(upper))
    lower, upper = (library(end).broadcast_to(library(end).asarray(end, dtype), shape) for end in (lower, upper))
    if is_concrete((lower, upper)) and not np.all(np.asarray(lower) < np.asarray(upper)):
        raise ValueError(f"{label} must be in order, but is {given!r}. Put the lower one first.")
    return lower, upper


def _joined(pairs: Iterable[Ends], dtype: Any) -> Ends:
    """All lower bounds, one after the other, and all upper ones."""
    lower, upper = zip(*pairs, strict=True) if (pairs := list(pairs)) else ((), ())
    together = lambda ends: library(*ends).concatenate([np.zeros(0, dtype), *(end.ravel() for end in ends)])
    return together(lower), together(upper)


def _limits(within: Mapping[str, Any], dtype: Any) -> tuple[Ends, tuple[int, ...]]:
    """Lower and upper limits, one after the other, and how many numbers each has."""
    pairs = [_pair(given[1:], f"`within[{name!r}]`", dtype) for name, given in within.items()]
    return _joined(pairs, dtype), tuple(pair[0].size for pair in pairs)


def _chosen(over: Any, params: PyTree, dtype: Any) -> tuple[tuple[int, ...], Ends]:
    """Which leaves of params are to be chosen, and their bounds."""
    given = over if isinstance(over, Mapping) else dict.fromkeys(listed(over))
    names, every, found, pairs = leaf_names(params), jax.tree.leaves(params), [], []
    for name, bounds in given.items():
        within = [i for i, leaf in enumerate(names) if is_within(leaf, name)]
        if not within:
            raise ValueError(f"`over` must name entries of `params`, but holds {name!r}. There are {', '.join(names) or 'none'}.")
        lower, upper = _pair(bounds, f"`over[{name!r}]`", dtype)
        found += within
        pairs += [tuple(library(end).broadcast_to(end, np.shape(every[i])) for end in (lower, upper)) for i in within]
    return tuple(found), _joined(pairs, dtype)


def _duration(given: Any, dtype: Any) -> tuple[Array | np.ndarray, Ends | None]:
    """T, as a guess where it is to be found between two."""
    cure = "Give a time, or (shortest, longest)."
    if not isinstance(given, (tuple, list)):
        return number(given, "`duration`", dtype, positive=True, cure=cure), None
    if len(given) != 2:
        raise ValueError(f"`duration` must be a time or two, but is {given!r}. {cure}")
    shortest, longest = (number(end, "`duration`", dtype, positive=True, cure=cure) for end in given)
    if is_concrete((shortest, longest)) and not shortest < longest:
        raise ValueError(f"`duration` must be in order, but is {given!r}. {cure}")
    return jnp.sqrt(shortest * longest), (shortest, longest)


def _held(shapes: Sequence[tuple[str, tuple[int, ...]]], is_signal: bool, dtype: Any) -> dict[str, Any]:
    values = {name: np.zeros(shape, dtype) for name, shape in shapes}
    return {name: Held(value) for name, value in values.items()} if is_signal else values


def _moves(system: System, like: PyTree, params: PyTree, shapes: Any) -> tuple[Array, bool]:
    """Whether each control changes the equations of motion, at some states; and whether functions of the system call them."""
    try:
        return _influence(system, like, params, shapes, False), False
    except TypeError as error:
        if not is_called(error):
            raise
        return _influence(system, like, params, shapes, True), True


@compiled
def _influence(system: System, like: PyTree, params: PyTree, shapes: Any, is_signal: bool) -> Array:
    q = ravel_pytree(like)[0]
    values, unravel = ravel_pytree(_held(shapes, is_signal, q.dtype))

    def rows(u, q, v, multipliers):
        flat = bind(system, like, {**params, **unravel(u)})
        return ravel_pytree(imbalance(flat, jnp.zeros((), q.dtype), q, v, v, multipliers))[0]

    m = bind(system, like, {**params, **unravel(values)}).rows
    states = jnp.asarray(np.random.default_rng(0).uniform(0.5, 1.5, (STATES, 2 * q.size + m + values.size)), q.dtype)
    slopes = jax.vmap(lambda s: jax.jacfwd(rows)(s[: values.size], *jnp.split(s[values.size :], [q.size, 2 * q.size])))(states)
    moves = jnp.any(slopes != 0, axis=(0, 1))  # where it is NaN, too
    return jnp.stack([jnp.any(leaf) for leaf in jax.tree.leaves(unravel(moves.astype(values.dtype)))])


def _refuse_idle(moves: Array, shapes: Sequence[tuple[str, tuple[int, ...]]]) -> None:
    if is_concrete(moves):
        for moved, (name, _) in zip(np.asarray(moves), sorted(shapes), strict=True):
            if not moved:
                raise ValueError(
                    f"`control` must move the system, but {name!r} changes none of its equations. Let a `force` take it by that name."
                )


def nodes_of(boundary: Boundary, intervals: int) -> Array | np.ndarray:
    """What is given at the end of each interval."""
    ends = [max(round(share * intervals), 1) - 1 for share in boundary.shares[1:]]
    if len(set(ends)) < len(ends):
        raise ValueError(f"`nodes` must be enough for all `waypoints` and the end, but {intervals} are not: two fall on one. Give more.")
    free = np.full(boundary.states.shape[1], np.nan, boundary.states.dtype)
    states = dict(zip(ends, boundary.states[1:], strict=True))
    return library(boundary.states).stack([states.get(k, free) for k in range(intervals)])
