"""What loads make of velocities at the start of a motion, before anything has moved: a scale for those that have none of their own."""

from typing import Any

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np

from .._mechanics.lagrange import inertia, velocity_rows
from .._program.sparse_jacobian import MANY
from .._program.sparse_matrix import SparseMatrix
from .first_order import EquationsOfMotion
from .protocol import Arguments


def told_of_loads(equations: Any, t, y, args: Arguments) -> Arguments:
    """With what constraints at the start, and dry friction at its bound, make of each velocity: where they hold another force, the rounding
    of both is a rate of its own; where slip begins in a plane, it has no scale of its own yet, and its direction follows the load at a
    rate of 1/|v|.
    """
    if not isinstance(equations, EquationsOfMotion) or args.scales is None or not (equations.elements or equations.system.constraints):
        return args
    args, parts = args._replace(scales=args.scales._replace(driven=None)), equations.parts(y)
    flat, elements = equations.contents(t, parts, args)
    M = inertia(flat, t, parts.q, parts.v)[0]
    if not isinstance(M, lx.DiagonalLinearOperator) and equations.size >= MANY and elements is None:
        return args
    mass = M.diagonal if isinstance(M, lx.DiagonalLinearOperator) else jnp.diagonal(M.as_matrix())
    rate = lambda pulls: pulls / jnp.where(mass > 0, mass, jnp.inf)
    scales, held = args.scales, jnp.zeros_like(parts.v)
    if equations.system.constraints:
        G = velocity_rows(flat, t, parts.q, parts.v)[1]
        G = SparseMatrix(jnp.abs(G.values), G.places) if isinstance(G, SparseMatrix) else jnp.abs(G)
        held = held + rate(G.T @ jnp.abs(equations.accelerated(t, parts, args, False).multipliers[: flat.rows]))
    if elements is not None:
        slopes = jnp.abs(jax.jacfwd(lambda v: elements.slip(t, parts.q, v))(parts.v))
        bound = jnp.abs(equations.friction(t, parts, args).bound)[elements.element_of_row]
        in_plane = elements.is_vector[elements.element_of_row]
        held = held + rate(bound @ slopes)
        if np.any(in_plane):
            scales = scales._replace(driven=0.1 * scales.duration * rate(bound[in_plane] @ slopes[in_plane]))
    return args._replace(scales=jax.lax.stop_gradient(scales._replace(held=held)))
