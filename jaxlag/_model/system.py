"""The mechanical system as its user states it, and the same system over flat vectors."""

import dataclasses
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from .injection import call, check_function, names, told
from .pickling import portable, restored

Terms = tuple[tuple[str, Callable], ...]
Slot = Any  # a function, a mapping from names to functions, or None: `_terms` checks it, with a sentence
SLOTS = ("lagrangian", "dissipation", "force", "holonomic", "nonholonomic")
EXPLICIT_TIME = "time"  # how the energy that explicit time in L brings in is named among the powers


@dataclasses.dataclass(frozen=True, init=False, repr=False)
class System:
    r"""A mechanical system, stated by its energies, forces and constraints.

    $$ \frac{d}{dt}\frac{\partial L}{\partial\dot q} - \frac{\partial L}{\partial q}
       + \frac{\partial D}{\partial\dot q} = Q + G^T\lambda, \qquad g(t, q) = 0, \qquad a(t, q, \dot q) = 0 $$

    Each slot takes one function or a mapping of named functions, whose terms add up and whose results come
    back under these names (one function alone goes by the name of its slot). A function receives exactly the
    arguments it names: `t`, `q`, `qdot`, `params`, any entry of `params` where that is a mapping, and, in
    `dissipation` and `force`, `multipliers`.

    **Arguments:**

    - `lagrangian`: L(t, q, q̇), a real scalar.
    - `dissipation`: D(t, q, q̇), a real scalar; the generalized force is −∂D/∂q̇.
    - `force`: Q(t, q, q̇), shaped like q, with lists for vectors if you like; where q is a mapping, coordinates may be left out.
    - `holonomic`: g(t, q), any array or pytree of arrays, kept at zero.
    - `nonholonomic`: a(t, q, q̇), affine in q̇, kept at zero.
    - `one_sided`: names of holonomic constraints that push and never pull, as a table does: g ≥ 0 and λ ≥ 0, for λ > 0 pushes along +∇g.
      The motion is computed with g = 0 kept all the same; but where λ < 0 the contact would have opened, and `Trajectory.pulling()`,
      its card, `examine` and `plot.forces` say so.

    Any consistent set of units. What a function returns may be plain numbers, integers or lists: it becomes floating arrays. A system
    is immutable, hashable and compared by its functions: state it once, for one made anew from new functions is compiled anew. What
    was compiled for it, and what its functions hold, stays until `jax.clear_caches()`.

    **Raises:** `TypeError` where a slot holds no function; `ValueError` where two terms share a name, or `one_sided` names no holonomic
    constraint.

    **Source:** Goldstein, Classical Mechanics, 3rd ed., sections 1.5 and 2.4; sign of λ: M q̈ = f + Gᵀλ.

    ```python
    import jaxlag as jl

    def lagrangian(q, qdot, m, c):
        return 0.5 * m * qdot**2 - 0.5 * c * q**2

    system = jl.System(lagrangian, dissipation=lambda qdot, b: 0.5 * b * qdot**2)
    jl.acceleration(system, q=1.0, qdot=0.5, params={"m": 2.0, "c": 8.0, "b": 1.0}).qddot  # -4.25
    ```
    """

    lagrangian: Terms
    dissipation: Terms
    force: Terms
    holonomic: Terms
    nonholonomic: Terms
    one_sided: tuple[str, ...]

    def __init__(
        self,
        lagrangian: Slot,
        *,
        dissipation: Slot = None,
        force: Slot = None,
        holonomic: Slot = None,
        nonholonomic: Slot = None,
        one_sided: Any = (),  # a name, or a collection of names
    ):
        for slot, given in zip(SLOTS, (lagrangian, dissipation, force, holonomic, nonholonomic), strict=True):
            object.__setattr__(self, slot, _terms(slot, given))
        if not self.lagrangian:
            raise TypeError("`lagrangian` must be a function L(q, qdot), but none was given. Hand over at least the kinetic energy.")
        for name in self.terms:
            if self.terms.count(name) > 1:
                raise ValueError(
                    f"terms must be named differently, but two are called {name!r}. Rename one, for powers and multipliers go by names."
                )
        given = one_sided if isinstance(one_sided, Collection) and not isinstance(one_sided, str) else (one_sided,)
        known = [name for name, _ in self.holonomic]
        for name in given:
            if name not in known:
                there = ", ".join(known) or "none"
                raise ValueError(f"`one_sided` must name holonomic constraints, but holds {name!r}. There are {there}.")
        object.__setattr__(self, "one_sided", tuple(name for name in known if name in given))

    def __copy__(self) -> "System":
        return self

    def __deepcopy__(self, memo: Any) -> "System":
        return self

    def __reduce__(self) -> Any:
        stands = {slot: {name: portable(f, role(slot, name)) for name, f in getattr(self, slot)} for slot in SLOTS}
        return _unpickled, (stands, self.one_sided)

    def __repr__(self) -> str:
        def listed(slot: str, terms: Terms) -> str:
            return slot if [name for name, _ in terms] == [slot] else f"{slot}: {', '.join(name for name, _ in terms)}"

        parts = [listed(slot, getattr(self, slot)) for slot in SLOTS if getattr(self, slot)]
        parts += [f"one-sided: {', '.join(self.one_sided)}"] * bool(self.one_sided)
        return f"System({'; '.join(parts)})"

    @property
    def constraints(self) -> tuple[str, ...]:
        """Names of all constraints, in the order of the rows of G."""
        return tuple(name for name, _ in (*self.holonomic, *self.nonholonomic))

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of all that does work: dissipation, forces, constraints, and explicit time in L."""
        return (*(name for name, _ in (*self.dissipation, *self.force)), *self.constraints, EXPLICIT_TIME)


def _unpickled(stands: dict[str, dict[str, Any]], one_sided: tuple[str, ...]) -> System:
    slots = {slot: {name: restored(f) for name, f in terms.items()} for slot, terms in stands.items()}
    return System(**slots, one_sided=one_sided)


def _terms(slot: str, given: Any) -> Terms:
    if given is None:
        return ()
    terms = tuple(given.items()) if isinstance(given, Mapping) else ((slot, given),)
    for name, function in terms:
        if not isinstance(name, str) or not callable(function):
            raise TypeError(
                f"`{slot}` must be a function or a mapping from names to functions, but it holds {function!r} under {name!r}. "
                "Hand over the function itself, not its value."
            )
        check_function(function, role(slot, name))
    return terms


def role(slot: str, name: str) -> str:
    """How messages speak of a user's function."""
    return f"`{slot}`" if name == slot else f"`{slot}` {name!r}"


class Flat(NamedTuple):
    """A system with its parameters, over flat vectors q, v of length n and λ of length m: what the mechanics works on."""

    lagrangian: Callable[..., Float[Array, ""]]  # L(t, q, v)
    dissipations: dict[str, Callable[..., Float[Array, ""]]]  # D(t, q, v, λ)
    forces: dict[str, Callable[..., Float[Array, " n"]]]  # Q(t, q, v, λ)
    holonomic: Callable[..., Float[Array, " h"]]  # g(t, q)
    nonholonomic: Callable[..., Float[Array, " k"]]  # a(t, q, v)
    position: Callable[..., PyTree]  # x(t, q) of a position map
    unravel: Callable[[Float[Array, " n"]], PyTree]
    unravel_multipliers: Callable[[Float[Array, " m"]], dict[str, PyTree]]
    needs_multipliers: bool
    holonomic_names: tuple[str, ...]
    terms: tuple[str, ...]
    rows: int  # of G, those of the user's constraints
    held: dict[str, np.ndarray] = {}  # noqa: RUF012 - rows of G beyond those, with which a dissipation term sticks


def bind(system: System, like: PyTree, params: PyTree) -> Flat:
    """The system over flat vectors, for coordinates structured `like` these, which need be shapes only."""
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)
    zero, unravel = ravel_pytree(zeros)

    def value(slot, term, t, q, v, **more):
        name, function = term
        state = {"t": t, "q": unravel(q)} | ({} if v is None else {"qdot": unravel(v)}) | more
        return call(function, role(slot, name), params, **state)

    def lagrangian(t, q, v):
        terms = (jnp.asarray(value("lagrangian", term, t, q, v), q.dtype) for term in system.lagrangian)
        return sum(terms, start=jnp.zeros((), q.dtype))

    def dissipation(term):
        def potential(t, q, v, multipliers):
            return jnp.asarray(value("dissipation", term, t, q, v, multipliers=unravel_multipliers(multipliers)), q.dtype)

        return potential

    def vector(slot, t, q, v):
        parts = [ravel_pytree(value(slot, term, t, q, v))[0].astype(q.dtype) for term in getattr(system, slot)]
        return jnp.concatenate([jnp.zeros(0, q.dtype), *parts])

    def force(term):
        def generalized(t, q, v, multipliers):
            force = value("force", term, t, q, v, multipliers=unravel_multipliers(multipliers))
            return flat_like(zeros, role("force", term[0]), force)

        return generalized

    def position(at, t, q):
        return jax.tree.map(lambda x: jnp.asarray(x, q.dtype), call(at, "a position map", params, t=t, q=unravel(q)))

    one = jnp.zeros((), zero.dtype)
    shapes = [
        jax.eval_shape(lambda slot=slot, term=term: value(slot, term, one, zero, None if slot == "holonomic" else zero))
        for slot in ("holonomic", "nonholonomic")
        for term in getattr(system, slot)
    ]
    no_multipliers, unravel_values = ravel_pytree([jax.tree.map(lambda s: jnp.zeros(s.shape, zero.dtype), shape) for shape in shapes])

    def unravel_multipliers(multipliers):
        return dict(zip(system.constraints, unravel_values(multipliers[: no_multipliers.size]), strict=True))

    return Flat(
        lagrangian=lagrangian,
        dissipations={term[0]: dissipation(term) for term in system.dissipation},
        forces={term[0]: force(term) for term in system.force},
        holonomic=lambda t, q: vector("holonomic", t, q, None),
        nonholonomic=lambda t, q, v: vector("nonholonomic", t, q, v),
        position=position,
        unravel=unravel,
        unravel_multipliers=unravel_multipliers,
        needs_multipliers=any(names(function, "multipliers") for _, function in (*system.dissipation, *system.force)),
        holonomic_names=tuple(name for name, _ in system.holonomic),
        terms=system.terms,
        rows=no_multipliers.size,
    )


def flat_like(like: PyTree, spoken: str, given: PyTree) -> Float[Array, " n"]:
    """What a force returned, as a flat vector in the order of the coordinates `like`.

    Entries of mappings may be left out, lists stand for arrays, and a plain 0 for zeros of any shape.
    """
    parts = jax.tree_util.tree_flatten_with_path(given)[0]
    places = jax.tree_util.tree_flatten_with_path(like)[0]
    for path, _ in parts:
        if not any(path[: len(place)] == place for place, _ in places):
            at = jax.tree_util.keystr(path) or "without a name"
            raise ValueError(f"{spoken} must be shaped like q, but returned an entry {at} that q has not. {SHAPED}")
    return jnp.concatenate([_part(place, leaf, parts, spoken) for place, leaf in places])


SHAPED = "Return one entry for each coordinate; where q is a mapping, coordinates without a force may be left out."


def _part(place, coordinate, parts, spoken):
    """The force on one array of coordinates, flat."""
    spoken_part, shape = f"{spoken}{jax.tree_util.keystr(place)}", coordinate.shape
    own = [(path[len(place) :], x) for path, x in parts if path[: len(place)] == place]
    if not own:
        known = max((_common(place, path) for path, _ in parts), default=0)
        if not (known < len(place) and isinstance(place[known], jax.tree_util.DictKey)):
            raise ValueError(f"{spoken_part} must be real and of shape {shape}, but nothing was returned. {SHAPED}")
        return jnp.zeros(coordinate.size, coordinate.dtype)
    flat = []
    for path, x in own:
        rest = shape[len(path) :]
        in_list = len(path) <= len(shape) and all(isinstance(key, jax.tree_util.SequenceKey) for key in path)
        is_zero = isinstance(x, np.ndarray) and x.shape == () and x == 0  # a plain one
        if not in_list or (x.shape != rest and not is_zero):
            of = f" of {len(own)} entries with" if path else ""
            raise ValueError(f"{spoken_part} must be real and of shape {shape}, but is{of} {told(x)}. {SHAPED}")
        flat.append(jnp.ravel(jnp.broadcast_to(jnp.asarray(x, coordinate.dtype), rest)))
    if sum(x.size for x in flat) != coordinate.size:
        raise ValueError(f"{spoken_part} must be real and of shape {shape}, but has {len(own)} entries. {SHAPED}")
    return jnp.concatenate(flat)


def _common(one: tuple, other: tuple) -> int:
    """How many keys two paths have in common."""
    return next((i for i, pair in enumerate(zip(one, other, strict=False)) if pair[0] != pair[1]), min(len(one), len(other)))


def rows_by_name(flat: Flat) -> dict[str, np.ndarray]:
    """Which rows of G, and entries of λ, belong to which constraint."""
    with jax.ensure_compile_time_eval():
        rows = jax.tree.map(np.asarray, flat.unravel_multipliers(jnp.arange(flat.rows, dtype=float)))
    return {name: np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(rows[name])]).astype(int) for name in rows}
