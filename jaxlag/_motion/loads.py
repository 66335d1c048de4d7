"""What loads make of velocities at the start of a motion, before anything has moved: a scale for those that have none of their own."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Bool

from .._mechanics.augmented_inertia import units_alike
from .._mechanics.friction_elements import FrictionElements
from .._mechanics.lagrange import applied_force, inertia, position_rows, velocity_rows
from .._mechanics.stick_slip import Friction
from .._model.flat import Flat
from .._program.size_of_terms import size_of_terms
from .._program.sparse_jacobian import MANY
from .._program.sparse_matrix import SparseMatrix
from .._program.sparsity import sparsity_pattern
from .batch import BatchedEquations
from .first_order import EquationsOfMotion
from .protocol import Arguments, AugmentedSystem, undifferentiated
from .state_vector import Parts
from .variational import split_varying

LOOKS = (0.03, 0.21, 0.47, 0.68, 0.91)  # of a motion, at which forces are looked at


def told_of_loads(equations: Any, t, y, args: Arguments, begins: bool = False) -> Arguments:
    """With what weighs as much as one of each coordinate, and what forces at the start make of each velocity; where the first step
    `begins` with the mode, that finds the forces of constraints and friction (`loads_within`).
    """
    if args.scales is None:
        return args
    t, y, given = undifferentiated((t, y, args._replace(scales=args.scales._replace(driven=None))))
    found = _loads(equations, t, y, given, begins)
    return args if found is None else args._replace(scales=args.scales._replace(**found))


def told_of_directions(equations: Any, t, y, args: Arguments, directions: tuple) -> Arguments:
    """With what a change of params along each direction, for each order of (params, t0), makes of velocities by the forces that it
    changes. Where constraints and friction hold these, their rounding is all that a variation has, even of a number that is zero.
    """
    directions = directions or args.directions
    while isinstance(equations, AugmentedSystem):
        equations, y = equations.equations, y[..., 0]
    if not directions or args.scales is None or args.scales.held is None or not isinstance(equations, EquationsOfMotion):
        return args
    t, y, given = undifferentiated((t, y, args._replace(scales=None)))
    parts, times = equations.parts(y), t + args.scales.duration * np.array(LOOKS)

    def along(changed):
        varying, constant = split_varying(given.params, changed)
        flat_at = lambda t, params: equations.contents(t, parts, given._replace(params=eqx.combine(params, constant)))[0]
        forces = lambda t, params: _forces(flat_at(t, params), t, parts.q, parts.v)
        M = inertia(flat_at(t, varying), t, parts.q, parts.v)
        of_one = lambda t, direction: _rate(M, jnp.abs(jax.jvp(lambda params: forces(t, params), (varying,), (direction,))[1]))
        of_each = jax.vmap(lambda t: jax.vmap(lambda direction: of_one(t, direction), in_axes=-1, out_axes=-1)(changed))(times)
        largest = jnp.max(jnp.where(jnp.isfinite(of_each), of_each, 0), axis=0)
        return jnp.concatenate([jnp.zeros_like(largest[:, :1]), largest], axis=1)

    along_each = tuple(along(undifferentiated(changed)) if jax.tree.leaves(changed) else None for changed, _ in directions)
    return args._replace(scales=args.scales._replace(held_along=along_each))


def _loads(equations: Any, t, y, args: Arguments, begins: bool = False) -> dict[str, Any] | None:
    """What `Scales` calls units, held, given and driven; of a motion, or of each member of a batch.

    Where forces, those of constraints and of dry friction at its bound among them, hold one another, the rounding of all is a rate of its
    own. Where slip begins in a plane, it has no scale of its own yet, and its direction follows the load at a rate of 1/|v|.
    """
    if isinstance(equations, BatchedEquations):
        return equations.along_axis(lambda *of_member: _loads(equations.equations, *of_member), t, y, args)
    if isinstance(equations, AugmentedSystem):
        return _loads(equations.equations, t, y[..., 0], args._replace(directions=args.directions[:-1]))
    if not isinstance(equations, EquationsOfMotion):
        return None
    parts = equations.parts(y)
    flat, elements = equations.contents(t, parts, args)
    M = inertia(flat, t, parts.q, parts.v)
    units = units_alike(M, [])
    if not isinstance(M, lx.DiagonalLinearOperator) and equations.size >= MANY and elements is None:
        return {"units": units}
    terms = size_of_terms(lambda q: _forces(flat, t, q, parts.v), parts.q)
    held, given, driven = _rate(M, jnp.where(jnp.isfinite(terms), terms, 0)), None, None
    if equations.system.constraints and equations.projection is not None:
        given = _prescribed(flat, t, parts.q, may_move=not equations.works)  # works are integrals along what moves
    if begins:
        return {"units": units, "held": held, "given": given, "driven": driven}
    found = None if elements is None else equations.friction(t, parts, args)
    if equations.system.constraints:
        multipliers = (found or equations.accelerated(t, parts, args, False)).multipliers
        held = held + _rate(M, _pulls_of_constraints(flat, t, parts, multipliers))
    if elements is not None and found is not None:
        by_rows = _pulls_of_friction(elements, t, parts, found.bound)
        in_plane = elements.is_vector[elements.element_of_row]
        held = held + _rate(M, jnp.sum(by_rows, axis=0))
        if np.any(in_plane):
            driven = 0.1 * args.scales.duration * _rate(M, jnp.sum(by_rows[in_plane], axis=0))
    return {"units": units, "held": held, "given": given, "driven": driven}


def loads_within(flat: Flat, elements: FrictionElements, t, parts: Parts, found: Friction) -> Array:
    """What forces of constraints and of friction make of each velocity."""
    pulls = _pulls_of_constraints(flat, t, parts, found.multipliers) + jnp.sum(_pulls_of_friction(elements, t, parts, found.bound), axis=0)
    return _rate(inertia(flat, t, parts.q, parts.v), pulls)


def _rate(M, pulls):
    mass = M.diagonal if isinstance(M, lx.DiagonalLinearOperator) else jnp.diagonal(M.as_matrix())
    return pulls / jnp.where(mass > 0, mass, jnp.inf)


def _pulls_of_constraints(flat: Flat, t, parts: Parts, multipliers):
    G = velocity_rows(flat, t, parts.q, parts.v)[1]
    G = SparseMatrix(jnp.abs(G.values), G.pattern) if isinstance(G, SparseMatrix) else jnp.abs(G)
    return G.T @ jnp.abs(multipliers[: flat.rows])


def _pulls_of_friction(elements: FrictionElements, t, parts: Parts, bound):
    """Those of each row."""
    slopes = jnp.abs(jax.jacfwd(lambda v: elements.slip(t, parts.q, v))(parts.v))
    return jnp.abs(bound)[elements.element_of_row][:, None] * slopes


def _prescribed(flat: Flat, t, q, may_move: bool) -> Bool[Array, " n"]:
    """Which coordinates a constraint on them alone gives as a function of the time, so that nothing of them is integrated; or holds."""
    G = position_rows(flat, t, q)[1]
    if isinstance(G, SparseMatrix):
        rows, columns = np.asarray(G.pattern.rows), np.asarray(G.pattern.columns)
    else:
        rows, columns = np.nonzero(sparsity_pattern(lambda q: flat.holonomic(t, q), q)) if q.size < MANY else np.zeros((2, 0), int)
    alone = np.bincount(rows, minlength=1)[rows] == 1
    if not may_move:
        moves = np.nonzero(sparsity_pattern(lambda t: flat.holonomic(t[0], q), jnp.reshape(t, 1)))[0]
        alone = alone & ~np.isin(rows, moves)
    values = G.values[alone] if isinstance(G, SparseMatrix) else G[rows[alone], columns[alone]]
    return jnp.zeros(q.size, bool).at[columns[alone]].set(values != 0)


def _forces(flat: Flat, t, q, v) -> Array:
    """Those of the Lagrangian at rest, and the applied ones."""
    return jax.grad(flat.lagrangian, argnums=1)(t, q, v) + applied_force(flat, t, q, v, jnp.zeros(flat.rows, q.dtype))
