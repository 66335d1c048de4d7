"""Periodic motions over a parameter: Newton's method in a plane across their curve, and what is told of each of them."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._linear.newton import differentiable_root
from .._linear.return_map import OF_SLOPES, Frame, Given, Setting, forced_period, passage, sizes_of
from .._model.event import Every
from .._model.system import System
from .._motion.simulate import simulate
from .._program.jit import compiled
from .critical import critical
from .in_plane import UNKNOWN, Plane, in_plane
from .measures import Measure, Measured, extrema, harmonics_of, moved_by_impacts, values_of

ORDINARY = "ordinary"  # a point of a curve that is not special
HARMONICS = 8
APART = 4  # last digits of the clock between samples
WIDE = 3  # a change of a state by so many times its size counts as much as one of the parameter over all values asked for
CLOSE = 30  # rounding of motions, of which Newton's last step may consist


class Family(NamedTuple):
    """What is static about a curve: the system, its return map, and the place of the parameter among the leaves of `params`."""

    system: System
    map: Setting
    place: int


class Numbers(NamedTuple):
    """The numbers of a curve: what its orbits are computed from, the time of one, and the width of the values asked for."""

    given: Given
    usual: Float[Array, ""]
    width: Float[Array, ""]


class Near(NamedTuple):
    """What Newton's method found: the point, the Jacobian of the return, the scales and time of the orbit; how it got there."""

    z: Float[Array, " u"]
    J: Float[Array, "k u"]
    scale: Float[Array, " u"]
    time: Float[Array, ""]
    found: Bool[Array, ""]
    turns: Int[Array, ""]


class Telling(NamedTuple):
    """What is told of a point: measures, from so many samples of a period; as what it moves with the parameters."""

    measures: tuple[Measure, ...]
    samples: int
    kind: str


class Told(NamedTuple):
    """What is told of an orbit: z, its state and drift, the period, what was measured, and how often things happened in it."""

    z: Float[Array, " u"]
    state: dict[str, PyTree]
    drift: PyTree
    period: Float[Array, ""]
    measured: tuple[Measured, ...]
    counts: tuple[Array, ...]


def with_value(params: PyTree, index: int, value: Any) -> PyTree:
    """`params` with this value of the parameter that is this one of its leaves."""
    leaves, structure = jax.tree.flatten(params)
    leaves[index] = jnp.asarray(value, jnp.result_type(leaves[index]))
    return jax.tree.unflatten(structure, leaves)


def returned(family: Family, numbers: Numbers, z: Float[Array, " u"]) -> tuple[Array, Array, Frame]:
    """By how much the state does not return, the time until then, and the numbers of the map."""
    setting, of = family.map, np.array(family.map.returning, int)
    given = numbers.given._replace(params=with_value(numbers.given.params, family.place, z[-1]))
    first, unravel = ravel_pytree(given.start)
    usual = forced_period(setting, given) if isinstance(setting.section, Every) else numbers.usual
    frame = Frame(given, first.at[of].set(z[:-1]), usual, (1 + 0.9 / setting.turns) * usual)
    after, time = passage(family.system, setting, frame, unravel(frame.first), given.t)
    return after[of] - z[:-1], time, frame


@compiled
def corrected(family: Family, numbers: Numbers, plane: Plane, turns: Any) -> Near:
    """The orbit in a plane, by at most so many `turns` of Newton's method."""
    of = np.array(family.map.returning, int)

    def evaluated(z):
        left, time, frame = returned(family, numbers, z)
        sizes = WIDE * sizes_of(frame)[of]
        return left, (jnp.append(jnp.where(sizes > 0, sizes, plane.scale[:-1]), numbers.width), time)

    def cleaned(J, aside):
        scale, _ = aside
        is_felt = jnp.abs(J) * scale[None] / scale[:-1, None] > OF_SLOPES * numbers.given.tolerances[0]
        return jnp.where(is_felt | jnp.any(scale <= UNKNOWN), J, 0)

    small = CLOSE * numbers.given.tolerances[0]
    near = in_plane(evaluated, plane, turns, small, cleaned)
    scale, time = near.aside
    returns = jnp.max(jnp.abs(near.left) / scale[:-1], initial=0.0) <= small**0.5  # steps are short where an impact grazes, too
    return Near(near.z, near.J, scale, time, near.done & returns, near.turns)


@compiled
def told(family: Family, setting: Telling, numbers: Numbers, plane: Plane) -> Told:
    """What is told of the orbit at the z of a plane. Differentiable: where it is on the curve in that plane, or as a special point."""

    def residual(args, w):
        numbers, plane = args
        left = lambda z: returned(family, numbers, z)[0]
        z = plane.z + plane.scale * w
        if setting.kind == ORDINARY:
            return jnp.append(left(z), plane.direction @ w)
        return jnp.append(left(z), critical(setting.kind, jax.jacfwd(left)(z)[:, :-1], *plane.borders))

    plane, usual = jax.lax.stop_gradient((plane, numbers.usual))
    numbers = numbers._replace(usual=usual)
    w = differentiable_root(residual, (numbers, plane), jnp.zeros_like(plane.z), jnp.ones_like(plane.z))
    z = plane.z + plane.scale * w
    given = numbers.given._replace(params=with_value(numbers.given.params, family.place, z[-1]))
    is_forced = isinstance(family.map.section, Every)
    period = forced_period(family.map, given) if is_forced else returned(family, numbers, z)[1]
    flat, unravel = ravel_pytree(given.start)
    start = unravel(flat.at[np.array(family.map.returning, int)].set(z[:-1]))
    measured, motion = _measured(family, setting, given, start, period)
    q, of_q = ravel_pytree(start["q"])
    change = jnp.concatenate([x[-1].ravel() for x in jax.tree.leaves(motion.q)]) - q
    drift = of_q(jnp.where(np.isin(np.arange(q.size), family.map.returning), 0, change))
    return Told(z, start, drift, period, measured, counts_of(motion))


def _measured(family, setting, given, start, period):
    """The measures of one period of the motion from `start`, and that motion."""
    measures, params = setting.measures, given.params

    def moving(given, start, ts):
        """The motion at the start, at these times in order, and at the end; and the place of each of them. Times that fall together are
        moved apart, by their last digits.
        """
        order = jnp.argsort(ts)
        times = jnp.concatenate([given.t[None], ts[order], (given.t + period)[None]])
        apart = APART * jnp.finfo(times.dtype).eps * (jnp.abs(given.t) + period)
        times = times + jax.lax.stop_gradient(apart) * jnp.arange(times.size)
        rtol, atol = given.tolerances
        of = family.map.of_motions() | {"rtol": rtol, "atol": atol, "throw": False}
        motion = simulate(family.system, start["q"], start["qdot"], times, params, states=start["states"], **of)
        return motion, 1 + jnp.argsort(order)

    def values_at(ts):
        motion, places = moving(*jax.lax.stop_gradient((given, start, ts)))
        return values_of(measures, motion, params)[0][:, places]

    best = jax.lax.stop_gradient(extrema(values_at, len(measures), *jax.lax.stop_gradient((given.t, period))))
    grid = given.t + period * jnp.arange(setting.samples) / setting.samples
    motion, places = moving(given, start, jnp.concatenate([grid, best.ravel()]))
    values, rates = values_of(measures, motion, params)
    harmonics = harmonics_of(values[:, places[: grid.size]], grid, period, HARMONICS)
    at = places[grid.size :]
    ends = (values[:, at] + moved_by_impacts(motion, at, period, rates)).reshape(len(measures), 2, len(measures))
    each = range(len(measures))
    return tuple(Measured(ends[i, 0, i], ends[i, 1, i], harmonics[i]) for i in each), motion


def counts_of(motion: Any) -> tuple[Array, ...]:
    """How often things happened in a motion: changes of friction, elements that stuck, impacts of each contact, events of each name."""
    of_friction: tuple[Array, ...] = ()
    if "transitions" in motion.stats:
        of_friction = motion.stats["transitions"][-1], jnp.sum(motion.stats["time_stuck"][-1] > 0)
    impacts = (jnp.sum(contact.impacts[-1]) for contact in motion.contacts.values())
    return (*of_friction, *impacts, *(event.count[-1] for event in motion.events.values()))
