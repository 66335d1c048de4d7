"""y, the state that is integrated, and what of it is a sample of a motion.

    y = (q, q̇, states of first order, sampled states, work of each term,
         σ of each slip, which elements others hold at their bound, number of transitions, time stuck)

Works are present where they were asked for, the last four where D is nonsmooth.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from .._mechanics.saddle_point import Sound


class Parts(NamedTuple):
    """y, taken apart."""

    q: Float[Array, " n"]
    v: Float[Array, " n"]
    z: Float[Array, " k"]  # states of first order
    u: Float[Array, " l"]  # sampled states
    works: Float[Array, " w"]
    sigma: Float[Array, " r"]
    held: Float[Array, " e"]  # 1 or 0
    transitions: Float[Array, " 0|1"]
    time_stuck: Float[Array, " e"]

    @property
    def y(self) -> Float[Array, " y"]:
        """Put together again."""
        return jnp.concatenate(self)


class Start(NamedTuple):
    """y at the start; whether a friction mode is consistent with its forces; whether no bound is negative."""

    y: Float[Array, " y"]
    has_mode: Bool[Array, ""]
    has_bounds: Bool[Array, ""]


class Violation(NamedTuple):
    """How far a sample lies beyond the end of its friction mode, and the scale on which that is small; two per element."""

    excess: Float[Array, " m"]
    scale: Float[Array, " m"]


class Sample(NamedTuple):
    """One sample of a motion: what a `Trajectory` holds of it."""

    q: PyTree
    qdot: PyTree
    qddot: PyTree
    multipliers: dict[str, PyTree]
    states: dict[str, PyTree]
    works: dict[str, Array] | None
    friction: dict[str, tuple[Array, Array]]
    counts: dict[str, Array]


class Evidence(NamedTuple):
    """What tells whether a sample keeps the guarantees of a motion."""

    sound: Sound
    violation: Violation
