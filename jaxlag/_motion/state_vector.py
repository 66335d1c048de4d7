"""y, the state that is integrated.

    y = (q, q̇, states of first order, sampled states, work of each term,
         σ of each slip, which elements others hold at their bound, number of transitions, time stuck,
         of each contact: whether it is closed, its impacts, when it changed, how long it was open before, its impulses,
         of each event: the sign of its witness, how often it happened; when the last one did, and the state before it;
         whether the motion has stopped)

Works are present where they were asked for, the four of friction where D is nonsmooth, five where there are contacts, the last four where
there are events.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


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
    sign: Float[Array, " w"]  # 1 or −1; 0 where it is not known yet, since the witness stays at zero
    happened: Float[Array, " w"]
    seen: Float[Array, " s"]  # t, q, q̇ and states
    stopped: Float[Array, " 0|1"]  # 1 or 0

    @property
    def y(self) -> Float[Array, " y"]:
        """Put together again."""
        return jnp.concatenate(self)

    def without(self, errors: Float[Array, " n"]) -> "Parts":
        """With no velocity that is but an error: where all comes to rest, the square of what is left would pull apart what sticks."""
        return self._replace(v=jnp.where(jnp.abs(self.v) <= errors, 0, self.v))


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
