"""Equilibria over a parameter: Newton's method in a plane across their curve."""

import itertools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from .._linear.newton import differentiable_root
from .._linear.rest import Equations, Search
from .._linear.rest import Given as AtRest
from .._model.state_values import start_values
from .._model.system import System
from .._model.validation import checked
from .._program.jit import compiled
from .critical import FOLD, critical
from .in_plane import InPlane, Plane, in_plane
from .orbits import WIDE, with_value


class RestNumbers(NamedTuple):
    """The numbers of a curve of equilibria: a guess, params, the time, and the width of the values asked for."""

    q: PyTree
    states: PyTree
    params: PyTree
    t: Float[Array, ""]
    width: Float[Array, ""]


class Rested(NamedTuple):
    """An equilibrium: z, its coordinates, states and multipliers."""

    z: Float[Array, " u"]
    q: PyTree
    states: dict[str, PyTree]
    multipliers: dict[str, PyTree]


def _equations(system: System, place: int, numbers: RestNumbers, value: Any) -> tuple[Equations, AtRest]:
    """The equations of rest at a value of the parameter, and what they are given."""
    params = with_value(numbers.params, place, value)
    still = jax.tree.map(jnp.zeros_like, numbers.q)
    flat, t, q, v = checked(system, numbers.t, numbers.q, still, params, numbers.states)
    values = start_values(system, numbers.states, t, numbers.q, still, params)
    given = AtRest(eqx.filter(params, eqx.is_array), t, q, v, jnp.zeros(0, bool), jnp.zeros(0, bool))
    return Equations(Search(), system, numbers.q, params, values, given, flat), given


def _residual(system: System, place: int, numbers: RestNumbers, z: Array) -> Array:
    """The forces that are left, the constraints and the rates of states; at rest, those of constraints are zero whatever z."""
    equations, given = _equations(system, place, numbers, z[-1])
    R, of_states, rows = equations(given, z[:-1]), *(int(b - a) for a, b in itertools.pairwise(equations.sizes[1:]))
    return jnp.delete(R, R.size - of_states - rows + np.arange(rows), assume_unique_indices=True)


@compiled
def rest_start(system: System, place: int, numbers: RestNumbers) -> Array:
    """The unknowns z at an equilibrium, with multipliers that balance its forces."""
    value = jax.tree.leaves(numbers.params)[place]
    equations, given = _equations(system, place, numbers, value)
    flat, *_ = equations.taken_apart(given, jnp.zeros(int(equations.sizes[-1]), given.q.dtype))
    start = jnp.concatenate([given.q, ravel_pytree(numbers.states)[0].astype(given.q.dtype), jnp.zeros(flat.rows, given.q.dtype)])
    return jnp.append(equations.multipliers_at(given, start, jnp.ones_like(given.q)), value)


@compiled
def rest_near(system: System, place: int, numbers: RestNumbers, plane: Plane, turns: Any) -> InPlane:
    """The equilibrium in a plane, by at most so many turns of Newton's method; aside are the scales."""
    n = ravel_pytree(numbers.q)[0].size

    def evaluated(z):
        sizes = jnp.abs(z[:-1])
        largest = jnp.max(sizes[:n], initial=0.0)
        sizes = sizes.at[:n].set(jnp.maximum(sizes[:n], 0.1 * largest))
        scale = jnp.where(sizes > 0, WIDE * sizes, plane.scale[:-1])
        return _residual(system, place, numbers, z), jnp.append(scale, numbers.width)

    return in_plane(evaluated, plane, turns, jnp.finfo(plane.z.dtype).eps ** 0.7)


@compiled
def rest_told(system: System, place: int, kind: str, numbers: RestNumbers, plane: Plane) -> Rested:
    """The equilibrium at the z of a plane, differentiable: where it is on the curve in that plane, or as a fold."""

    def residual(args, w):
        numbers, plane = args
        left = lambda z: _residual(system, place, numbers, z)
        z = plane.z + plane.scale * w
        last = critical(FOLD, jax.jacfwd(left)(z)[:, :-1], *plane.borders) if kind == FOLD else plane.direction @ w
        return jnp.append(left(z), last)

    plane = jax.lax.stop_gradient(plane)
    w = differentiable_root(residual, (numbers, plane), jnp.zeros_like(plane.z), jnp.ones_like(plane.z))
    z = plane.z + plane.scale * w
    equations, given = _equations(system, place, numbers, z[-1])
    flat, q, _, of = equations.taken_apart(given, z[:-1])
    return Rested(z, flat.unravel(q), equations.unravel_states(of.states), flat.unravel_multipliers(of.multipliers))
