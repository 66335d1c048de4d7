"""Equilibria and steady motions: states in which nothing accelerates."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from .._model.numbers import number, refuse_nan
from .._model.paths import entry_names, is_within, listed
from .._model.state_values import given_states
from .._model.system import System
from .._model.validation import coordinates, parameters, state
from .._program.jit import is_concrete, seen
from .._program.sparse_jacobian import MANY
from .not_differentiated import without_derivative
from .rest import Rest, Search, steady_state
from .sparse_rest import MOST_DENSE, many_at_rest
from .stability import stability, undecided


class Equilibrium(eqx.Module):
    """Where a system rests, or moves steadily.

    - `q`, `qdot`: structured like the guess; `states`, `multipliers`: by name; `t`: the time.
    - `friction`: for each dissipation term with dry friction, the force that holds and the bound that it would have to exceed.
    - `stability`: "stable", "unstable" or "neutral", judged by the potential energy on the constraints; if that is impossible, a sentence
      says why.
    - `stiffness`: the second variation of the potential on the constraints, relative to M: squares of natural frequencies, ascending;
      without inertia, the eigenvalues of the stiffness itself. None if there is no potential, for large sparse systems, and under `jit` and
      `vmap`. Its derivative is NaN: differentiate `linearise` instead.
    - `undecided`: coordinates on which nothing depends: they stay where they were.
    """

    q: PyTree
    qdot: PyTree
    states: dict[str, PyTree]
    multipliers: dict[str, PyTree]
    friction: dict[str, tuple[Array, Array]]
    t: Float[Array | np.ndarray, ""]
    stiffness: Float[Array, " k"] | None
    stability: str = eqx.field(static=True)
    undecided: tuple[str, ...] = eqx.field(static=True)

    def __repr__(self) -> str:
        if not is_concrete(self):
            return "Equilibrium(traced)"
        rows = [("at", _listed(self.q))]
        if np.any(ravel_pytree(self.qdot)[0]):
            rows.append(("moving with", _listed(self.qdot)))
        rows += [(name, _listed(tree)) for name, tree in (("states", self.states), ("multipliers", self.multipliers)) if tree]
        for name, (force, bound) in self.friction.items():
            *_, largest = without_dust(np.asarray([*bound, np.max(np.abs(force), initial=0.0)]))
            rows.append(("friction", f"{name}: {largest:.4g} of {np.min(bound):.4g} that it can hold"))
        rows.append(("stability", self.stability))
        if self.undecided:
            rows.append(("undecided", f"{', '.join(self.undecided)}: nothing depends on them"))
        return "\n".join(
            ["Equilibrium" if not np.any(ravel_pytree(self.qdot)[0]) else "Steady motion", *(f"  {n:<13}{v}" for n, v in rows)]
        )


def _listed(tree: PyTree) -> str:
    """The numbers by name; if there are many, only the first ones."""
    numbers = [f"{name} = {x:.6g}" for name, x in zip(entry_names(tree, "q"), without_dust(np.asarray(ravel_pytree(tree)[0])), strict=True)]
    return ", ".join(numbers if len(numbers) <= MOST_LISTED else [*numbers[: MOST_LISTED // 2], f"… ({len(numbers)} in all)"])


MOST_LISTED = 24


def without_dust(x: np.ndarray) -> np.ndarray:
    """x with 0 for entries that are zero within rounding, relative to 1 + |x| as in the search."""
    return np.where(np.abs(x) <= 8 * np.finfo(x.dtype).eps * (1 + np.max(np.abs(x), initial=0.0)), 0.0, x)


def equilibrium(
    system: System,
    q: PyTree,
    params: PyTree = None,
    *,
    t: Any = 0.0,
    states: PyTree = None,
    fixed: Sequence[str] = (),
    stable: bool = False,
) -> Equilibrium:
    r"""Where a system rests.

    $$ f(q, 0, \lambda) + G^T\lambda = 0, \qquad g(q) = 0, \qquad \dot z = 0 $$

    Newton's method from the guess `q` to a nearby equilibrium, stable or not. Coordinates on which nothing depends stay where they are.
    With dry friction, equilibria form a band: the result is its middle, the equilibrium without friction, or, if there is none, the guess
    itself, provided that friction can hold it. Of contacts those are closed that press, g = 0 and λ ≥ 0, first those that touch at the
    guess; where these do not hold the system, it comes to rest on those that it would meet.

    **Arguments:** `q`, a guess, structured as for `simulate`; `params`, `t`, `states` (guesses, too) as for `acceleration`; `fixed`: names
    of coordinates that stay as given, to choose one of many equilibria (to hold a coordinate by a force, state a holonomic constraint);
    `stable`: first descends in the potential energy to a minimum, which requires that all forces at rest come from L, and no contacts. Any
    consistent units.

    **Returns:** an `Equilibrium`; print it. Differentiable in `params` to any order, by the implicit function theorem.

    **Raises:** `ValueError` if no equilibrium was found, with the force that is left; of many under `vmap` if the first has none.
    Under `jit`, and of the others, all is NaN there.

    **Source:** Goldstein, Classical Mechanics, 3rd ed., section 6.1.

    ```python
    import jax
    import jax.numpy as jnp
    import jaxlag as jl
    system = jl.System(lambda q, qdot, m, c, g: 0.5 * m * qdot**2 - 0.5 * c * q**2 + m * g * q)
    sag = lambda c: jl.equilibrium(system, 0.0, {"m": 2.0, "c": c, "g": 9.81}).q
    sag(100.0)  # m g/c = 0.1962
    jax.grad(sag)(100.0)  # −m g/c² = −0.001962
    ```
    """
    q = coordinates(q, "q")
    return _found(system, q, jax.tree.map(jnp.zeros_like, q), params, t, states, Search(fixed=_entries(q, fixed, "fixed"), stable=stable))


def steady(
    system: System,
    q: PyTree,
    qdot: PyTree,
    params: PyTree = None,
    *,
    t: Any = 0.0,
    states: PyTree = None,
    fixed: Sequence[str] = (),
    fixed_rates: Sequence[str] = (),
) -> Equilibrium:
    r"""A steady motion: some coordinates run uniformly, all others are at rest.

    $$ f(q, \dot q, \lambda) + G^T\lambda = 0, \qquad \ddot q = 0, \qquad g(q) = 0, \qquad \psi(q, \dot q) = 0 $$

    For example a spinning top, a governor, a rolling wheel. The coordinates that run are those whose velocity in `qdot` is not zero;
    nothing may depend on them except through their velocities, and through t if a motor drives them. Velocities that the equations leave
    open stay as given, such as the speed of a governor; others are guesses, such as the speed of a body that falls through air.

    **Arguments:** as `equilibrium`, and `qdot`, the velocities; `fixed_rates`: names of coordinates whose velocity stays as given. Any
    consistent units.

    **Returns:** an `Equilibrium`, with its `qdot`. Differentiable in `params` and in what stays as given.

    **Raises:** `ValueError` if no steady motion was found, or what was found does not stay as it is.

    **Source:** Goldstein, Classical Mechanics, 3rd ed., section 8.3 (Routh's procedure, steady motion).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    bead = jl.System(  # on a rotating hoop
        lambda q, qdot, R, g: 0.5 * R**2 * (qdot["theta"] ** 2 + (jnp.sin(q["theta"]) * qdot["phi"]) ** 2) + g * R * jnp.cos(q["theta"])
    )
    at = jl.steady(bead, {"theta": 1.0, "phi": 0.0}, {"theta": 0.0, "phi": 5.0}, {"R": 1.0, "g": 9.81}, fixed_rates=["phi"])
    at.q["theta"]  # arccos(g/(R φ̇²)) = 1.168
    ```
    """
    q, qdot = state(q, qdot)
    known = seen(qdot)
    if known is None:
        raise ValueError("`qdot` must be known outside of `jit` to say which coordinates run, but is hidden. Call `steady` from Python.")
    runs = np.flatnonzero(np.asarray(ravel_pytree(known)[0]))
    held = _entries(q, fixed_rates, "fixed_rates")
    search = Search(fixed=_entries(q, fixed, "fixed"), running=tuple(int(i) for i in runs if i not in held))
    return _found(system, q, qdot, params, t, states, search)


def _entries(q, names, label):
    """Indices of the entries of q that the names stand for."""
    names, entries = listed(names), entry_names(q, "q")
    for name in names:
        if not any(is_within(entry, name) for entry in entries):
            raise ValueError(f"`{label}` must name coordinates, but holds {name!r}. The coordinates are {', '.join(entries)}.")
    return tuple(i for i, entry in enumerate(entries) if any(is_within(entry, name) for name in names))


def _found(system: System, q: PyTree, qdot: PyTree, params: PyTree, t: Any, states: PyTree, search: Search) -> Equilibrium:
    """The result of a search or, if it fails, of a search in which friction holds."""
    if search.stable and system.unilateral:
        raise ValueError("`stable` must be False where there are contacts, but is True. Start near the equilibrium that is meant.")
    if search.stable and system.force:
        terms = ", ".join(repr(name) for name, _ in system.force)
        raise ValueError(f"`stable` must be False where forces are not from L, but there are {terms}. Write their potential into L.")
    t = number(t, "`t`", jax.tree.leaves(q)[0].dtype, cure="Pass one time, and use `jax.vmap` for several.")
    given = system, t, q, qdot, parameters(params, q), given_states(system, states, q)
    refuse_nan(given[4])
    found, names = _near(search, *given), entry_names(q, "q")
    is_known = is_concrete(jax.lax.stop_gradient(found))
    values = seen(found)
    if found.friction and not (is_known and values is not None and values.succeeded):
        held = steady_state(search._replace(held=True), *given)
        found = held if is_known else jax.tree.map(lambda free, held: jnp.where(found.succeeded, free, held), found, held)
        values = seen(found)
    if values is not None:
        values = jax.tree.map(np.asarray, values)
        _refuse(values, names)
    if values is None or not is_known:
        return Equilibrium(*found[:5], found.t, None, f"not known under `{'jit' if values is None else 'vmap'}`", ())
    stiffness, kind = stability(system, values)
    shown = None if stiffness is None else without_derivative(stiffness, given)
    return Equilibrium(*found[:5], found.t, shown, kind, undecided(values, names))


def _near(search, *given):
    """The sparse search for many coordinates, if they have structure; if it finds nothing and they are not too many, the dense search."""
    _, _, q, *_ = given
    found = many_at_rest(search, *given) if sum(np.size(leaf) for leaf in jax.tree.leaves(q)) >= MANY else None
    if found is None:
        return steady_state(search, *given)
    values = seen(found)
    if found.left.size > MOST_DENSE or (values is not None and np.all(values.succeeded)):
        return found
    if values is not None:
        return steady_state(search, *given)
    shown = jax.lax.cond(found.succeeded, lambda: found[:5], lambda: steady_state(search, *given)[:5])
    return Rest(*shown, *found[5:])


def _refuse(found, names):
    """Raises if nothing was found."""
    if found.succeeded and found.uniform:
        return
    if found.succeeded:
        raise ValueError(
            "`qdot` must run in coordinates on which nothing depends, but the motion found does not stay as it is. Let others run."
        )
    left = np.abs(np.nan_to_num(found.left, nan=np.inf))
    i = int(np.argmax(left))
    what = f"a force of {found.force[i]:.4g} is left on {names[i]!r}" if i < len(names) else "constraints or states are left unsatisfied"
    if found.friction:
        needed = ", ".join(
            f"{name!r} would have to hold {np.max(np.abs(force)):.4g} and holds {np.min(bound):.4g}"
            for name, (force, bound) in found.friction.items()
        )
        what = f"friction {needed}"
    raise ValueError(
        f"`q` must be near an equilibrium, but none was found: {what}. "
        "Start nearer, add what holds this coordinate, or let it run by `steady`."
    )
