"""Rest on contacts: which of them are closed.

    g ≥ 0,  λ ≥ 0,  g λ = 0

First those that touch where the search starts, or lie inside; where these do not hold what moves there, also the first that it would meet,
the first two, and so on. Of each such choice, a contact that pulls opens and one that was passed closes, one by one. The result is the
first choice that holds, if that is of contacts that touch; otherwise the one at the nearest state.
Source: Pfeiffer & Glocker, Multibody Dynamics with Unilateral Contacts, chapter 5.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._mechanics.augmented_inertia import unit_lengths
from .._mechanics.constrained_acceleration import constrained_acceleration
from .._mechanics.contact import contact_rows, gap_accelerations, gap_scales, in_contact, roundings_beside
from .._mechanics.friction_elements import with_all_masses
from .._mechanics.lagrange import inertia
from .._model.flat import Flat
from .newton import Root, least_change

NOTHING = 0.5  # power of eps: share of the largest force, or of the reach of a gap, that is rounding


class Tried(NamedTuple):
    """What was tried: the number of contacts to be met that are closed, how often they changed since, and which are closed; the choice that
    was found, its root, how far it is from the start, and whether there is one.
    """

    met: Any
    changes: Any
    closed: Bool[Array, " c"]
    chosen: Bool[Array, " c"]
    root: Root
    distance: Any
    done: Any


def touched(flat: Flat, t: Any, q: Array, v: Array) -> Bool[Array, " c"]:
    """Which contacts touch or lie inside, to rounding."""
    if not flat.contacts:
        return jnp.zeros(0, bool)
    t, q, v = jax.lax.stop_gradient((t, q, v))
    return flat.gaps(t, q) <= gap_scales(flat, t, q, v, *roundings_beside(with_all_masses(flat), t, q, v)).gap


def on_contacts(equations: Any, given: Any, guess: Float[Array, " u"], near: Callable, units: Float[Array, " n"]) -> tuple[Any, Root]:
    """What is given with the contacts that are closed, and the root; `near(given, guess)` searches with those of `given`."""
    fixed = jax.lax.stop_gradient(given)
    order = _order(equations, fixed, guess)
    count = order.size

    def among(met: Any) -> Array:
        return fixed.closed | (order < met)

    def turn(tried: Tried) -> Tried:
        here = fixed._replace(closed=tried.closed)
        root = near(here, equations.multipliers_at(here, guess, units))
        root = root._replace(w=_with_nothing_at_open(equations, here, root.w))
        flips = _wrong(equations, here, root.w) & root.found
        holds = root.found & ~jnp.any(flips)
        moved = jnp.linalg.norm((root.w - guess)[: equations.moving.size] / jnp.where(units > 0, units, 1)[equations.moving])
        better = holds & (moved < tried.distance)
        new, old = (_with_touching(equations, here, root.w), root, moved), (tried.chosen, tried.root, tried.distance)
        chosen, kept, distance = jax.tree.map(lambda new, old: jnp.where(better, new, old), new, old)
        goes_on = jnp.any(flips) & (tried.changes < 2 * count)
        met = jnp.where(goes_on, tried.met, tried.met + 1)
        closed = jnp.where(goes_on, tried.closed ^ flips, among(met))
        done = (holds & (tried.met == 0)) | (met > jnp.sum(order < count))
        return Tried(met, jnp.where(goes_on, tried.changes + 1, 0), closed, chosen, kept, distance, done)

    first = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(near, fixed, guess))._replace(w=guess)
    start = Tried(jnp.array(0), jnp.array(0), fixed.closed, fixed.closed, first, jnp.asarray(jnp.inf, guess.dtype), jnp.array(False))
    found = jax.lax.while_loop(lambda tried: ~tried.done, turn, start)
    chosen, root = given._replace(closed=found.chosen), found.root
    there = near(jax.lax.stop_gradient(chosen), root.w)  # once more, with those that happen to touch
    return chosen, jax.lax.stop_gradient(there._replace(found=root.found & there.found))


def _order(equations: Any, given: Any, guess: Float[Array, " u"]) -> Int[Array, " c"]:
    """Of each open contact, the number of those that what starts from rest would meet before; that of all for those it would not meet."""
    flat, q, v, _ = equations.taken_apart(given, guess)
    mode = in_contact(with_all_masses(flat), given.closed)
    x = constrained_acceleration(mode, given.t, q, v).x
    approach = -gap_accelerations(flat, given.t, q, v, x)
    meets = ~given.closed & (approach > 0)
    time = jnp.where(meets, flat.gaps(given.t, q) / jnp.where(meets, approach, 1), jnp.inf)
    return jnp.where(meets, jnp.argsort(jnp.argsort(time)), time.size)


class AtContacts(NamedTuple):
    """Of each contact at a state the gap and the force, in units of inertia, and what of either is rounding; and G, in these units."""

    gaps: Float[Array, " c"]
    forces: Float[Array, " c"]
    little_gap: Any
    little_force: Any
    G: Float[Array, "c n"]

    @classmethod
    def of(cls, equations: Any, given: Any, w: Float[Array, " u"]) -> "AtContacts":
        """Those of a root."""
        flat, q, v, of = equations.taken_apart(given, w)
        G, M = jax.jacfwd(flat.gaps, argnums=1)(given.t, q), inertia(with_all_masses(flat), given.t, q, v).as_matrix()
        lengths = unit_lengths(M, G)
        size = jnp.max(jnp.abs(G) * lengths[None], axis=1)
        size, little = jnp.where(size > 0, size, 1), jnp.finfo(q.dtype).eps ** NOTHING
        forces = jnp.where(given.closed, contact_rows(flat, of.multipliers) * size, 0)
        reach = jnp.max(jnp.maximum(jnp.abs(q), jnp.abs(given.q)) / lengths, initial=0.0)
        largest = jnp.max(jnp.abs(forces), initial=0.0)
        return cls(flat.gaps(given.t, q) / size, forces, little * reach, little * largest, G * lengths[None] / size[:, None])


def _with_nothing_at_open(equations: Any, given: Any, w: Float[Array, " u"]) -> Float[Array, " u"]:
    """w with no force at the contacts that are open: there no equation holds it, and what is left of it is rounding."""
    start = equations.sizes[2] + equations.rows_of_bilateral
    return w.at[start : start + given.closed.size].multiply(given.closed)


def _wrong(equations: Any, given: Any, w: Float[Array, " u"]) -> Bool[Array, " c"]:
    """The contact that was passed farthest, if any was; or that which pulls most, or none."""
    at = AtContacts.of(equations, given, w)
    inside, pulls = jnp.where(given.closed, 0, -at.gaps) - at.little_gap, -at.forces - at.little_force
    most = jnp.where(jnp.any(inside > 0), inside, pulls)
    return (jnp.arange(most.size) == jnp.argmax(most)) & (most > 0)


def _with_touching(equations: Any, given: Any, w: Float[Array, " u"]) -> Bool[Array, " c"]:
    """The closed contacts, with those that happen to touch, where all together can share the forces: four feet on a floor."""
    at = AtContacts.of(equations, given, w)
    touch = given.closed | (jnp.abs(at.gaps) <= at.little_gap)
    G = jnp.where(touch[:, None], at.G, 0)
    shared = least_change(G.T, G.T @ at.forces, 1.0)
    return jnp.where(jnp.all(shared >= -at.little_force), touch, given.closed)
