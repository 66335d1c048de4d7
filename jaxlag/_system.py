"""The mechanical system as its user states it, and the same system over flat vectors."""

import dataclasses
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from ._arguments import call, names
from ._pickling import portable, restored

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
    - `force`: Q(t, q, q̇), shaped like q; where q is a mapping, coordinates may be left out.
    - `holonomic`: g(t, q), any array or pytree of arrays, kept at zero.
    - `nonholonomic`: a(t, q, q̇), affine in q̇, kept at zero.
    - `one_sided`: names of holonomic constraints that push and never pull, as a table does: g ≥ 0 and λ ≥ 0, for λ > 0 pushes along +∇g.
      The motion is computed with g = 0 kept all the same; but where λ < 0 the contact would have opened, and `Trajectory.pulling()`,
      its card, `examine` and `plot.forces` say so.

    Any consistent set of units. A system is immutable, hashable and compared by its functions.

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
        try:
            hash(function)
        except TypeError:
            raise TypeError(
                f"`{slot}` must hold hashable functions, but {name!r} is a {type(function).__name__} that holds arrays. "
                "Put its arrays into params and let the function name them."
            ) from None
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
        total = sum((value("lagrangian", term, t, q, v) for term in system.lagrangian), start=jnp.zeros((), q.dtype))
        return jnp.asarray(total, q.dtype)

    def dissipation(term):
        def potential(t, q, v, multipliers):
            return jnp.asarray(value("dissipation", term, t, q, v, multipliers=unravel_multipliers(multipliers)), q.dtype)

        return potential

    def vector(slot, t, q, v):
        parts = [ravel_pytree(value(slot, term, t, q, v))[0].astype(q.dtype) for term in getattr(system, slot)]
        return jnp.concatenate([jnp.zeros(0, q.dtype), *parts])

    def force(term):
        def generalized(t, q, v, multipliers):
            return ravel_like(zeros, value("force", term, t, q, v, multipliers=unravel_multipliers(multipliers)))

        return generalized

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
        position=lambda at, t, q: call(at, "a position map", params, t=t, q=unravel(q)),
        unravel=unravel,
        unravel_multipliers=unravel_multipliers,
        needs_multipliers=any(names(function, "multipliers") for _, function in (*system.dissipation, *system.force)),
        holonomic_names=tuple(name for name, _ in system.holonomic),
        terms=system.terms,
        rows=no_multipliers.size,
    )


def ravel_like(zeros: PyTree, partial: PyTree) -> Float[Array, " n"]:
    """`partial`, which may leave out coordinates, as a flat vector in the order of `zeros`; raises KeyError on others."""
    given = dict(jax.tree_util.tree_flatten_with_path(partial)[0])
    leaves = [jnp.asarray(given.pop(path, zero), zero.dtype) for path, zero in jax.tree_util.tree_flatten_with_path(zeros)[0]]
    for path in given:
        raise KeyError(jax.tree_util.keystr(path))
    return ravel_pytree(leaves)[0]


def rows_by_name(flat: Flat) -> dict[str, np.ndarray]:
    """Which rows of G, and entries of λ, belong to which constraint."""
    with jax.ensure_compile_time_eval():
        rows = jax.tree.map(np.asarray, flat.unravel_multipliers(jnp.arange(flat.rows, dtype=float)))
    return {name: np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(rows[name])]).astype(int) for name in rows}


def leaf_names(tree: PyTree, bare: str = "q") -> tuple[str, ...]:
    """The leaves by their paths, e.g. "wheel.phi"; `bare` names a leaf without a path."""
    paths = [jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in jax.tree_util.tree_flatten_with_path(tree)[0]]
    return tuple(path or bare for path in paths)
