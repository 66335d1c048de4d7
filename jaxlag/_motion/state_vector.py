"""y, the state that is integrated, and what of it is a sample of a motion.

    y = (q, q̇, states of first order, sampled states, work of each term,
         σ of each slip, which elements others hold at their bound, number of transitions, time stuck,
         of each contact: whether it is closed, its impacts, when it changed, how long it was open before, its impulses,
         of each event: the sign of its witness, how often it happened; what is recorded of all; whether the motion has stopped)

Works are present where they were asked for, the four of friction where D is nonsmooth, five where there are contacts, the last four where
there are events.
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
    closed: Float[Array, " c"]  # 1 or 0
    impacts: Float[Array, " c"]
    changed: Float[Array, " c"]
    flight: Float[Array, " c"]
    impulse: Float[Array, " c"]
    sign: Float[Array, " w"]  # 1 or -1
    happened: Float[Array, " w"]
    record: Float[Array, " x"]
    stopped: Float[Array, " 0|1"]  # 1 or 0

    @property
    def y(self) -> Float[Array, " y"]:
        """Put together again."""
        return jnp.concatenate(self)


class Start(NamedTuple):
    """y at the start; whether a friction mode is consistent with its forces; whether no bound is negative; whether it lies outside of all
    obstacles; whether an impact there takes energy, and follows from impulses.
    """

    y: Float[Array, " y"]
    has_mode: Bool[Array, ""]
    has_bounds: Bool[Array, ""]
    is_outside: Bool[Array, ""]
    dissipates: Bool[Array, ""]
    impulsive: Bool[Array, ""]


class Violation(NamedTuple):
    """How far a sample lies beyond the end of its mode, and the scale on which that is small; two per element, one per contact."""

    excess: Float[Array, " m"]
    scale: Float[Array, " m"]

    def beside(self, excess: Float[Array, " c"], scale: Float[Array, " c"]) -> "Violation":
        """With some more."""
        return Violation(jnp.concatenate([self.excess, excess]), jnp.concatenate([self.scale, scale]))


class Sample(NamedTuple):
    """One sample of a motion: what a `Trajectory` holds of it."""

    q: PyTree
    qdot: PyTree
    qddot: PyTree
    multipliers: dict[str, PyTree]
    states: dict[str, PyTree]
    works: dict[str, Array] | None
    friction: dict[str, tuple[Array, Array]]
    contacts: dict[str, tuple[Array, Array, Array, Array]]
    events: dict[str, Array]
    counts: dict[str, Array]


class Evidence(NamedTuple):
    """What tells whether a sample keeps the guarantees of a motion."""

    sound: Sound
    violation: Violation
