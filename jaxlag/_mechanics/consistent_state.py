"""States on the constraints, the nearest to a given one, and how far a state is off them."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from .._model.flat import Flat
from .._model.paths import listed
from .._model.system import System
from .._model.validation import at_state, coordinates
from .._program.implicit import undifferentiated
from .._program.jit import is_concrete
from .._program.scalarise import scalarised
from .._program.sparse_jacobian import MANY
from .._program.sparse_matrix import SparseMatrix, dense
from .augmented_inertia import alike
from .constrained_root import Linear, is_without_curvature, root_of
from .constraint_residuals import off, off_constraints, terms
from .contact import in_contact, in_current_mode
from .friction_elements import find_elements, with_all_masses
from .lagrange import inertia, position_rows, velocity_residual, velocity_rows
from .massless import inertial_part, with_first_order_rates
from .projection import metric_of_positions
from .pseudo_inverse import Constraints
from .saddle_point import Rows, is_determined, reach_of
from .singular_directions import Failure, explained, not_affine_in
from .stick_slip import first_mode, in_mode
from .structured_inertia import StructuredInertia

FEW, ITERATIONS = 4, 32  # near the constraints four suffice
LAST = 3  # changes with which one is compared
WITHOUT_CURVATURE = 200  # of a step that leaves it out: each takes away a part, the more the nearer the start is


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


def nearest_state(flat: Flat, t, q0, v0, free: Sequence[int] | None = None, *, found: bool = False, decides: bool = True) -> Consistent:
    """The state on the constraints nearest to (q0, v0), in which only the `free` coordinates move; where it is `found`, itself. It
    `decides` the velocities that follow from the rest.

    M (q − q0) = Gᵀλ,  g(t, q) = 0  by Newton's method, with M = M(q0); then  M (v − v0) = Gᵀμ,  ψ(t, q, v) = 0  with M = M(q).
    Derivatives are those that these equations imply.
    """
    moving = np.arange(q0.size) if free is None else np.asarray(free, int)
    yes = jnp.array(True)
    stated, flat = flat, with_all_masses(flat)
    full = inertia(flat, t, q0, v0)
    M = _part(full, moving)
    given = jnp.concatenate([flat.holonomic(t, q0), velocity_residual(flat, t, q0, v0)])
    positions = flat.holonomic(t, q0).size
    if given.size == 0:  # nothing to satisfy: saves the compilation of the search
        determined = is_determined(M, jnp.zeros((0, moving.size), q0.dtype))
        v = _with_decided_rates(stated, t, q0, v0) if decides else v0
        return Consistent(q0, v, yes, determined, yes, _is_finite(M))
    q = q0
    if positions:
        if given.size > 2 * positions:  # velocity constraints may be all that holds a coordinate
            held = is_determined(M, _columns(position_rows(flat, t, q0)[1], moving))
            metric = _part(metric_of_positions(flat, full, t, q0, v0), moving).as_matrix()
            M = lx.MatrixLinearOperator(jnp.where(held, M.as_matrix(), metric))
        q = _nearest_position(flat, moving, t, q0, M, found)
    v, determined = _nearest_velocity(inertial_part(flat, t, q, v0), moving, t, q, v0, found)
    if found:
        return Consistent(q, v, yes, determined, yes, yes)
    v = _with_decided_rates(stated, t, q, v) if decides else v

    @undifferentiated
    def judged(t, q0, v0, q, v, M, given):
        reach = jnp.maximum(jnp.abs(q0), jnp.abs(q)), jnp.maximum(jnp.abs(v0), jnp.abs(v))  # of what is held all is rounding
        reached = (off_constraints(flat, t, q, v, reach) < _small(q)) & jnp.all(jnp.isfinite(q))
        return reached, ~jnp.any(not_affine_in(flat, t, q0, v0)), jnp.all(jnp.isfinite(given)) & _is_finite(M)

    reached, affine, defined = judged(t, q0, v0, q, v, M, given)
    return Consistent(q, v, reached, determined, affine, defined)


def _part(M: lx.AbstractLinearOperator, moving: np.ndarray) -> lx.AbstractLinearOperator:
    """Of M that of the coordinates `moving`; diagonal where there are many of them, and in its structure where all of them move."""
    if isinstance(M, StructuredInertia) and moving.size == M.size:
        return M
    if isinstance(M, lx.DiagonalLinearOperator) and M.diagonal.size >= MANY:
        return lx.DiagonalLinearOperator(M.diagonal[moving])
    return lx.MatrixLinearOperator(M.as_matrix()[np.ix_(moving, moving)])


def _columns(G: Rows, moving: np.ndarray) -> Float[Array, "m k"] | SparseMatrix:
    return G.columns(moving) if isinstance(G, SparseMatrix) else G[:, moving]


def _is_finite(M: lx.AbstractLinearOperator) -> Bool[Array, ""]:
    if isinstance(M, StructuredInertia):
        return jnp.all(jnp.isfinite(M.slopes.values))
    return jnp.all(jnp.isfinite(M.diagonal if isinstance(M, lx.DiagonalLinearOperator) else M.as_matrix()))


def _with_decided_rates(flat: Flat, t, q, v) -> Float[Array, " n"]:
    """q̇ with the velocities that dissipation decides, in the mode of friction that holds there; contacts have no part in them."""
    flat = in_contact(flat, jnp.zeros(flat.gap_count, bool))
    elements = find_elements(flat) if flat.massless else None
    mode = flat if elements is None else in_mode(flat, elements, first_mode(flat, elements, t, q, v)[0].sigma)
    return with_first_order_rates(mode, t, q, v).v


def has_inertia(flat: Flat, t, q, v) -> Bool[Array, ""]:
    """Whether M leaves no direction without inertia that the constraints allow."""
    return scalarised(lambda t, q, v: is_determined(inertia(flat, t, q, v), velocity_rows(flat, t, q, v)[1]))(t, q, v)


def _nearest_position(flat: Flat, moving, t, q0, M, found: bool) -> Float[Array, " n"]:
    """That on the constraints, where only the coordinates `moving` move."""
    free = moving.size
    unpacked = lambda q0, w: (q0.at[moving].set(w[:free]), w[free:])
    like = jnp.concatenate([q0[moving], flat.holonomic(t, q0)])

    @scalarised
    def residual(args, w):
        (t, q0, M), (q, multipliers) = args, unpacked(args[1], w)
        g, pull = jax.vjp(lambda q: flat.holonomic(t, q), q)
        return jnp.concatenate([M.mv((q - q0)[moving]) - pull(multipliers)[0][moving], g])

    @scalarised
    def linear(args, w):
        (t, q0, M), (q, multipliers) = args, unpacked(args[1], w)
        g, G = position_rows(flat, t, q)
        metric, G, sizes = M, _columns(G, moving), abs(G) @ jnp.abs(q) + terms(flat, t, q)
        is_off = off(g, sizes + abs(G) @ alike(M, [G], jnp.abs(q[moving]))) > _small(q)
        reach = reach_of(q[moving], is_off)
        if not is_without_curvature(M, G):
            G, straight = dense(G), M.as_matrix()
            curved = straight - jax.hessian(lambda q: multipliers @ flat.holonomic(t, q))(q)[np.ix_(moving, moving)]
            metric = lx.MatrixLinearOperator(jnp.where(is_determined(lx.MatrixLinearOperator(curved), G), curved, straight))
        return Linear(metric, G, M.mv((q0 - q)[moving]), -g, reach)

    there = lambda args: jnp.concatenate([args[1][moving], jnp.zeros(like.size - free, like.dtype)])

    def by_newton(linear, args):
        eps, start = jnp.finfo(like.dtype).eps, there(args)

        def newton(carry):
            w, before, _, i = carry
            step = linear(args, w)
            rows = lambda change: dense(linear(args, w.at[:free].add(change)).G)
            found = step.solution(Constraints(lambda: -step.c, rows))
            change = jnp.abs(found.x)  # of each coordinate in its own unit, until rounding makes it
            # Rows that depend on each other on the constraints alone hold more directions off them: one or two ever smaller steps
            # onto the constraints are followed by a larger one along them, which leads off them again.
            is_off = jnp.any(jnp.isinf(step.reach.sizes))
            moves = jnp.any((change > 4 * eps * jnp.abs(w[:free])) & ((change < jnp.max(before, axis=0)) | (i < FEW) | is_off))
            return jnp.concatenate([w[:free] + found.x, found.multipliers]), jnp.stack([*before[1:], change]), moves, i + 1

        shape = jax.eval_shape(linear, args, start)
        most = WITHOUT_CURVATURE if is_without_curvature(shape.M, shape.G) else ITERATIONS
        going_on = lambda carry: carry[2] & (carry[3] < most)
        return jax.lax.while_loop(going_on, newton, (start, jnp.stack([start[:free]] * LAST), jnp.array(True), jnp.array(0)))[0], None

    find = (lambda _, args: (there(args), None)) if found else by_newton
    w, _ = root_of(residual, linear, find, (t, q0, M), like)
    return unpacked(q0, w)[0]


def _nearest_velocity(flat: Flat, moving, t, q, v0, found: bool) -> tuple[Float[Array, " n"], Bool[Array, ""]]:
    """That on the constraints, where only those of the coordinates `moving` move; and whether M leaves no direction without inertia."""
    free = moving.size
    like = jnp.concatenate([v0[moving], velocity_residual(flat, t, q, v0)])

    @scalarised
    def residual(args, w):
        t, q, v0 = args
        v = v0.at[moving].set(w[:free])
        psi, pull = jax.vjp(lambda v: velocity_residual(flat, t, q, v), v)
        pushed = inertia(flat, t, q, v0).mv(v - v0)
        return jnp.concatenate([(pushed - pull(w[free:])[0])[moving], psi])

    @scalarised
    def linear(args, w):
        t, q, v0 = args
        psi, G, _ = velocity_rows(flat, t, q, v0)
        M, G, sizes = _part(inertia(flat, t, q, v0), moving), _columns(G, moving), abs(G) @ jnp.abs(v0) + jnp.abs(psi - G @ v0)
        is_off = off(psi, sizes + abs(G) @ alike(M, [G], jnp.abs(v0[moving]))) > _small(q)
        return Linear(M, G, jnp.zeros_like(v0[moving]), -psi, reach_of(v0[moving], is_off))

    def by_one_step(linear, args):
        found = linear(args, like).solution()
        return jnp.concatenate([args[2][moving] + found.x, found.multipliers]), found.sound.determined

    def there(linear, args):
        step = linear(args, like)
        return jnp.concatenate([args[2][moving], jnp.zeros_like(step.c)]), scalarised(is_determined)(step.M, step.G)

    w, determined = root_of(residual, linear, there if found else by_one_step, (t, q, v0), like)
    return v0.at[moving].set(w[:free]), determined


def _small(q):
    """The residual of a constraint, in the units of its row, from which on a state is off it."""
    return jnp.finfo(q.dtype).eps ** 0.5


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

    **Raises:** `ValueError` if no such state was found, if inertia is missing, or if `fixed` names no coordinate. Under `jit` the state is
    NaN instead.

    **Source:** Hairer, Lubich & Wanner, Geometric Numerical Integration, section IV.4.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    rod = jl.System(lambda qdot: 0.5 * qdot @ qdot, holonomic=lambda q, l: q @ q - l**2)
    jl.consistent_state(rod, jnp.array([3.0, 4.0]), jnp.array([1.0, 0.0]), {"l": 10.0})  # [6, 8], [0.64, −0.48]
    ```
    """
    return _state(_StateOn(_fixed_indices(coordinates(q, "q"), listed(fixed))), system, q, qdot, params, t, states)


def state_in_contact(system: System, q: PyTree, qdot: PyTree, params: PyTree, t: Any, states: PyTree) -> tuple[PyTree, PyTree]:
    """`consistent_state`, and on the contacts that are closed."""
    return _state(_StateOn((), closes=True), system, q, qdot, params, t, states)


def _state(core: "_StateOn", system: System, q: PyTree, qdot: PyTree, params: PyTree, t: Any, states: PyTree) -> tuple[PyTree, PyTree]:
    """The state, or a reason why there is none."""
    (new_q, new_qdot), (reached, determined, affine, defined) = at_state(core, system, q, qdot, params, t, states)
    if is_concrete(reached):
        passed = {
            Failure.undefined: defined,
            Failure.no_inertia: determined,
            Failure.not_affine: affine,
            Failure.impossible_start: reached,
        }
        for failure in passed:
            if not passed[failure]:
                raise ValueError(explained(failure, system, q, qdot, params, t, states))
    return new_q, new_qdot


@dataclasses.dataclass(frozen=True)
class _StateOn:
    """`nearest_state` with some coordinates fixed, and on closed contacts if it `closes` them; compared by these, so that it is compiled
    once.
    """

    held: tuple[int, ...]
    closes: bool = False

    def __call__(self, flat: Flat, t, q, v):
        if self.closes and flat.contacts:
            flat = in_contact(flat, in_current_mode(flat, t, q, v).closed)
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
