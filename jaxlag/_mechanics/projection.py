"""Stabilisation of the constraints: projection of positions and velocities, feedback, or nothing."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from .._model.flat import Flat
from .._model.numbers import count, number
from .._model.system import System
from .._model.validation import at_state, coordinates
from .._program.jit import is_concrete
from .._program.scalarise import scalarised
from .._program.sparse_jacobian import jacobian
from .lagrange import constraint_rows, inertia, position_residual, velocity_residual
from .saddle_point import NO_INERTIA, augmented, is_determined, reach_of, saddle_point
from .singular_directions import NOT_AFFINE, UNDEFINED, explained, not_affine_in


@dataclasses.dataclass(frozen=True)
class Projection:
    """Puts positions and velocities back on the constraints after each step, and at each sample.

    Newton's steps of  min ½ δqᵀM δq  with  g(t, q + δq) = 0,  then  min ½ δvᵀM δv  with  ψ(t, q, v + δv) = 0:
    the nearest state in the metric of M, so that nothing moves without need.

    **Arguments:** `iterations`: Newton steps for the position, each of which squares the residual.

    **Raises:** `TypeError` or `ValueError` where `iterations` is not a whole number of 1 or more.

    **Source:** Hairer, Lubich & Wanner, Geometric Numerical Integration, section IV.4; Eich, SIAM J. Numer. Anal. 30 (1993).

    ```python
    import jaxlag as jl
    jl.Projection(iterations=3)
    ```
    """

    iterations: int = 2

    def __post_init__(self):
        count(self.iterations, "`iterations`", cure="Two nearly always suffice.")

    def projection(self) -> "Projection":
        """Itself: states are put back on the constraints."""
        return self

    def feedback(self) -> None:
        """None: the accelerations remain unchanged."""

    def project(self, flat: Flat, t: Any, q: Float[Array, " n"], v: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """The state on the constraints that is nearest to this one, which is near already."""
        M = inertia(flat, t, q, v)[0]  # at the start serves throughout: corrections are small

        @scalarised
        def newton(t, q, M):
            g, G = position_residual(flat, t, q)
            return q + saddle_point(M, G, jnp.zeros_like(q), -g, reach_of(q)).x

        @scalarised
        def on_velocities(t, q, v, M):
            psi, G, _ = constraint_rows(flat, t, q, v)
            return _corrected(v, saddle_point(M, G, jnp.zeros_like(v), -psi, reach_of(v)).x)

        if flat.holonomic_names:
            metric = _metric_of_positions(flat, M, t, q, v)
            q, _ = jax.lax.scan(lambda q, _: (newton(t, q, metric), None), q, length=self.iterations)
        return q, on_velocities(t, q, v, M)


def _corrected(v, dv):
    """v + dv, and zero where that is only rounding: what comes to rest is at rest."""
    left = v + dv
    nothing = jnp.abs(left) <= 4 * jnp.finfo(v.dtype).eps * jnp.abs(v)
    return jnp.where(nothing, left - jax.lax.stop_gradient(left), left)


def _metric_of_positions(flat, M, t, q, v):
    """M, with a weight on what nonholonomic constraints forbid: they may be all that holds a coordinate without inertia."""
    psi, G = jacobian(lambda v: flat.nonholonomic(t, q, v), v)
    return lx.MatrixLinearOperator(augmented(M.as_matrix(), G.as_matrix())[0]) if psi.size else M


@dataclasses.dataclass(frozen=True)
class Baumgarte:
    """Feeds the residuals back into the accelerations:  ψ̇ + 2α ψ + β² g = 0  (ψ̇ + 2α a = 0 for nonholonomic a).

    **Arguments:** `alpha`, `beta`: in 1/time; α = β is critical damping. Large values make the equations stiff.

    **Raises:** `TypeError` or `ValueError` where one of them is not a number of 0 or more.

    **Source:** Baumgarte, Comput. Methods Appl. Mech. Eng. 1 (1972) 1-16.

    ```python
    import jaxlag as jl
    jl.Baumgarte(alpha=20.0, beta=20.0)
    ```
    """

    alpha: float = 10.0
    beta: float = 10.0

    def __post_init__(self):
        for name in ("alpha", "beta"):
            gain = number(getattr(self, name), f"`{name}`", least=0.0, cure="Use some tenths of 1/(time of a step).")
            object.__setattr__(self, name, float(gain))

    def projection(self) -> None:
        """None: states are not projected."""

    def feedback(self) -> Callable:
        """2α ψ + β² g, added to γ."""

        def residual(flat, t, q, v):
            g, psi = flat.holonomic(t, q), velocity_residual(flat, t, q, v)
            return 2 * self.alpha * psi + self.beta**2 * jnp.concatenate([g, jnp.zeros(psi.size - g.size, g.dtype)])

        return residual


@dataclasses.dataclass(frozen=True)
class NoStabilisation:
    """Enforces the constraints on the accelerations alone, G q̈ = −γ: the residual grows with time, and so does the error it causes.

    ```python
    import jaxlag as jl
    jl.NoStabilisation()
    ```
    """

    def projection(self) -> None:
        """None: states are not projected."""

    def feedback(self) -> None:
        """None: the accelerations remain unchanged."""


CONSISTENCY_ITERATIONS = 16  # a fixed number is one loop to compile; near the constraints four suffice
STILL = 3  # iterations that move nothing, after which it ends: they make its derivatives right, k of them up to order 2ᵏ − 1


class Consistent(NamedTuple):
    """A state on the constraints; `reached` is false where the iteration found none, `determined` where inertia is missing, `affine`
    where a nonholonomic constraint is not affine in q̇, `defined` where M or a constraint is not finite at the state given.
    """

    q: Float[Array, " n"]
    v: Float[Array, " n"]
    reached: Bool[Array, ""]
    determined: Bool[Array, ""]
    affine: Bool[Array, ""]
    defined: Bool[Array, ""]


def nearest_state(flat: Flat, t, q0, v0, free: Sequence[int] | None = None) -> Consistent:
    """The state on the constraints nearest to (q0, v0), in which only the `free` coordinates move.

    Newton's method on  M (q − q0) = Gᵀλ,  g(t, q) = 0,  with M = M(q0). Its derivatives converge along with it.
    """
    moving = np.arange(q0.size) if free is None else np.asarray(free, int)
    both = np.ix_(moving, moving)
    full = inertia(flat, t, q0, v0)[0]
    M = full.as_matrix()[both]
    tolerance = jnp.finfo(q0.dtype).eps ** 0.5
    given = jnp.concatenate([flat.holonomic(t, q0), velocity_residual(flat, t, q0, v0)])
    positions = flat.holonomic(t, q0).size
    if given.size == 0:  # nothing to satisfy: saves the compilation of the search
        yes = jnp.array(True)
        return Consistent(q0, v0, yes, is_determined(M, jnp.zeros((0, moving.size), M.dtype)), yes, jnp.all(jnp.isfinite(M)))

    @scalarised
    def newton(t, q, multipliers, M, q0):
        g, G = position_residual(flat, t, q)
        bend = jax.hessian(lambda q: multipliers @ flat.holonomic(t, q))(q)[both]
        curved = jnp.where(is_determined(M - bend, G[:, moving]), M - bend, M)
        reach = reach_of(q[moving], _off(g, G, q) > tolerance)
        step, multipliers, _ = saddle_point(lx.MatrixLinearOperator(curved), G[:, moving], M @ (q0 - q)[moving], -g, reach)
        return q.at[moving].add(step), multipliers

    q = q0
    if positions:
        if given.size > 2 * positions:  # velocity constraints may be all that holds a coordinate
            held = is_determined(M, position_residual(flat, t, q0)[1][:, moving])
            M = jnp.where(held, M, _metric_of_positions(flat, full, t, q0, v0).as_matrix()[both])
        start = q0, jnp.zeros(positions, q0.dtype)

        def search(carry, _):
            (q, multipliers), still = carry
            found = jax.lax.cond(still < STILL, lambda: newton(t, q, multipliers, M, q0), lambda: (q, multipliers))
            moved = jnp.max(jnp.abs(found[0] - q)) > 4 * jnp.finfo(q.dtype).eps * jnp.max(jnp.abs(q))
            return (found, jnp.where(moved, 0, still + 1)), None

        ((q, _), _), _ = jax.lax.scan(search, (start, jnp.array(0)), length=CONSISTENCY_ITERATIONS)

    @scalarised
    def velocities(t, q, v0):
        psi, G, _ = constraint_rows(flat, t, q, v0)
        M = inertia(flat, t, q, v0)[0].as_matrix()[both]
        reach = reach_of(v0[moving], _off(psi, G, v0) > tolerance)
        nearest = saddle_point(lx.MatrixLinearOperator(M), G[:, moving], jnp.zeros_like(v0[moving]), -psi, reach)
        v = v0.at[moving].add(nearest.x)
        off = jnp.maximum(_off(*position_residual(flat, t, q), q), _off(velocity_residual(flat, t, q, v), G, v))
        return v, off, nearest.sound.determined, ~jnp.any(not_affine_in(flat, t, q0, v0))

    v, off, determined, affine = velocities(t, q, v0)
    reached = (off < tolerance) & jnp.all(jnp.isfinite(q))
    defined = jnp.all(jnp.isfinite(given)) & jnp.all(jnp.isfinite(M))
    return Consistent(q, v, reached, determined, affine, defined)


def off_constraints(flat: Flat, t, q, v) -> Float[Array, ""]:
    """Largest residual of g and ψ, in the units of its row."""
    G, beside = jax.jacfwd(flat.holonomic, argnums=1)(t, q), jax.jacfwd(flat.nonholonomic, argnums=2)(t, q, v)
    return jnp.maximum(_off(flat.holonomic(t, q), G, q), _off(velocity_residual(flat, t, q, v), jnp.concatenate([G, beside]), v))


def _off(residual, rows, x):
    """Largest residual, in the units of its row: rounding makes some eps of it."""
    size = jnp.sum(jnp.abs(rows), axis=1) * (1 + jnp.max(jnp.abs(x)))
    return jnp.max(jnp.abs(residual) / jnp.where(size > 0, size, 1), initial=0.0)


def consistent_state(
    system: System, q: PyTree, qdot: PyTree, params: PyTree = None, *, t: Any = 0.0, states: PyTree = None, fixed: Sequence[Any] = ()
) -> tuple[PyTree, PyTree]:
    r"""The state on the constraints that is nearest to the given one, in the metric of M.

    $$ \min \tfrac12 (q - q_0)^T M (q - q_0) \text{ with } g(t, q) = 0, \qquad
       \min \tfrac12 (\dot q - \dot q_0)^T M (\dot q - \dot q_0) \text{ with } \dot g = 0,\ a = 0 $$

    **Arguments:** the state `q`, `qdot` (one pytree structure), `params`, the time `t`, `states` as for `acceleration`; `fixed` lists
    coordinates whose position and velocity stay as given: keys where q is a mapping, indices where it is an array or a sequence. Any
    consistent units.

    **Returns:** (q, qdot), structured like q; differentiable in every argument.

    **Raises:** `ValueError` where no such state was found, where inertia is missing, or where `fixed` names no coordinate.
    Under `jit` the state is NaN there.

    **Source:** Hairer, Lubich & Wanner, Geometric Numerical Integration, section IV.4.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    rod = jl.System(lambda qdot: 0.5 * qdot @ qdot, holonomic=lambda q, l: q @ q - l**2)
    jl.consistent_state(rod, jnp.array([3.0, 4.0]), jnp.array([1.0, 0.0]), {"l": 10.0})  # [6, 8], [0.64, −0.48]
    ```
    """
    core = _StateOn(_fixed_indices(coordinates(q, "q"), tuple(fixed)))
    (new_q, new_qdot), (reached, determined, affine, defined) = at_state(core, system, q, qdot, params, t, states)
    if is_concrete(reached):
        for passed, reason in ((defined, UNDEFINED), (determined, NO_INERTIA), (affine, NOT_AFFINE), (reached, IMPOSSIBLE)):
            if not passed:
                raise ValueError(explained(reason, system, q, qdot, params, t, states))
    return new_q, new_qdot


IMPOSSIBLE = (
    "`holonomic` and `nonholonomic` must be satisfied by some state near the start, but none was found. "
    "Start nearer, fix fewer coordinates, or look for constraints that contradict each other."
)


@dataclasses.dataclass(frozen=True)
class _StateOn:
    """`nearest_state` with some coordinates fixed; compared by these, so that it is compiled once."""

    held: tuple[int, ...]

    def __call__(self, flat: Flat, t, q, v):
        free = [i for i in range(q.size) if i not in self.held]
        q, v, *flags = nearest_state(flat, t, q, v, free)
        known = jnp.all(jnp.stack(flags))
        return (flat.unravel(jnp.where(known, q, jnp.nan)), flat.unravel(jnp.where(known, v, jnp.nan))), flags


def _fixed_indices(q: PyTree, fixed: tuple) -> tuple[int, ...]:
    leaves, structure = jax.tree.flatten(q)
    ends = np.cumsum([leaf.size for leaf in leaves])
    indices = [np.arange(end - leaf.size, end).reshape(leaf.shape) for end, leaf in zip(ends, leaves, strict=True)]
    tree = jax.tree.unflatten(structure, indices)
    held: list[int] = []
    for name in fixed:
        try:
            part = getattr(tree, name) if isinstance(name, str) and hasattr(tree, "_fields") else tree[name]
        except (KeyError, IndexError, TypeError, AttributeError):
            there = sorted(map(str, tree)) if isinstance(tree, dict) else f"of structure {structure}"
            raise ValueError(f"`fixed` must name coordinates of q, but holds {name!r}. The coordinates are {there}.") from None
        held += [int(i) for leaf in jax.tree.leaves(part) for i in np.ravel(leaf)]
    return tuple(sorted(set(held)))
