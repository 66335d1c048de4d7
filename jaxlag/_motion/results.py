"""Why a motion ended."""

import functools
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._mechanics.consistent_state import IMPOSSIBLE
from .._mechanics.saddle_point import NO_INERTIA
from .._mechanics.self_consistent import NOT_CONSISTENT
from .._mechanics.singular_directions import NOT_AFFINE, UNDEFINED


class RESULTS(dfx.RESULTS):  # pyright: ignore
    """Why a motion ended: the reasons of diffrax, and those of mechanics."""

    not_finite = "`q0`, `qdot0`, `ts` and `params` must be finite, but there is a NaN or an infinity among them. Look for missing values."
    unordered = "`ts` must increase, but a time is smaller than the one before it. Sort the times, and what was measured along with them."
    no_period = "`every` must be positive, but the period of a sampled state is not. Look at what it is computed from."
    no_inertia = NO_INERTIA
    impossible_start = IMPOSSIBLE
    not_affine = NOT_AFFINE
    undefined = UNDEFINED
    contradictory = (
        "the constraints are not satisfied there: they contradict each other, nearly repeat each other, or demand more than the mechanism "
        "can reach. Check them with `examine`, and check what drives them."
    )
    beyond_reach = (
        "the constraints leave no way to continue: they drive a mechanism beyond its reach, or into a position that locks it. "
        "Let them demand less, or leave out the one that does."
    )
    negative_bound = "`dissipation` must have friction bounds that are not negative, but one is. Take `jnp.abs` of a normal force."
    missed = (
        "friction exceeds its bound there, or slips against its force: the end of sticking or slipping was missed. Use a smaller `rtol`, "
        "and give intermittent loads as `Signal`s."
    )
    no_friction = (
        "no mode of sliding and sticking is consistent with the friction forces it causes, or more than one is (Painlevé's paradox). "
        "Lower the coefficient of friction, or give the contact its compliance."
    )
    no_multipliers = NOT_CONSISTENT
    inside_obstacle = (
        "`q0` must lie outside of all obstacles, but a gap of `unilateral` is negative there. Start outside, or on the contact, g = 0."
    )
    energy_gained = (
        "an impact gained energy, as Newton's law of restitution may where impacts are coupled by friction (Kane's paradox) or by several "
        "contacts of different restitution. Lower `restitution` or the coefficient of friction."
    )
    not_impulsive = (
        "`dissipation` must be homogeneous in the force of a contact that it follows, as mu * multipliers['table'] * |v| is, for an impact "
        "to say what its friction is, but is not. Write it so."
    )
    too_many_events = (
        "an event happened more than `most` times. Allow more, `Event(..., most=...)`; one that happens at once for ever chatters: let "
        "`then` take the state away from where `when` is zero."
    )
    chattering = (
        "friction changed between sliding and sticking more than `max_transitions` times: it chatters. "
        "Allow more with `friction=StickSlip(max_transitions=...)`, or smooth it with `friction=Regularised(width)`."
    )


def under_diffrax(reason: Any) -> dfx.RESULTS:
    """A reason of mechanics as diffrax carries it through its loop: a number beyond its own, and not `successful`."""
    successful: Any = dfx.RESULTS.successful
    return eqx.tree_at(lambda r: r._value, successful, reason._value)


def from_diffrax(result: Any) -> RESULTS:
    """What diffrax returns, with the reasons of mechanics told apart again. The numbers of its own reasons are the same in both."""
    successful: Any = RESULTS.successful
    return eqx.tree_at(lambda r: r._value, successful, result._value)


def number_of(result: Any) -> Any:
    """The number of a reason of diffrax, for a loop that holds numbers only."""
    return result._value


def numbered(number: Any) -> dfx.RESULTS:
    """The reason of diffrax with this number."""
    successful: Any = dfx.RESULTS.successful
    return eqx.tree_at(lambda r: r._value, successful, number.astype(successful._value.dtype))


OF_THE_INPUT = (
    RESULTS.not_finite,
    RESULTS.unordered,
    RESULTS.no_period,
    RESULTS.no_inertia,
    RESULTS.impossible_start,
    RESULTS.not_affine,
    RESULTS.negative_bound,
    RESULTS.inside_obstacle,
    RESULTS.not_impulsive,
)
OF_THE_STEPS = (RESULTS.max_steps_reached, RESULTS.dt_min_reached)  # which other numerical settings may cure


def has_failed(result: Any) -> bool:
    """Whether a motion has failed, as far as that is known: under `jit` it is not. Asked on the host, at a tenth of the time of `!=`."""
    code = result._value
    return not isinstance(code, jax.core.Tracer) and bool((np.asarray(code) != _successful()).any())


@functools.cache
def _successful() -> int:
    return int(RESULTS.successful._value)  # type: ignore[attr-defined]


def reason_of(result: Any) -> str:
    """The sentence of a result; in a batch, that of the first failure, failures of the input before all others, which they may cause."""
    successful: Any = RESULTS.successful
    named = lambda value: RESULTS[eqx.tree_at(lambda r: r._value, successful, jnp.asarray(value))]  # type: ignore[misc]
    reasons = [named(value) for value in dict.fromkeys(np.ravel(result._value)[np.ravel(result != successful)].tolist())]
    of_input = [reason for reason in reasons if reason in [RESULTS[given] for given in OF_THE_INPUT]]  # type: ignore[misc]
    return [*of_input, *reasons, RESULTS[successful]][0]  # type: ignore[misc]


def names_of(result: Any) -> np.ndarray:
    """The names of results, which stay the same where their numbers may not."""
    named = {int(item._value): name for name, item in RESULTS._name_to_item.items()}  # type: ignore[attr-defined]
    return np.reshape([named[value] for value in np.ravel(result._value).tolist()], np.shape(result._value))


def result_of(names: np.ndarray) -> RESULTS:
    """The results of these names."""
    successful: Any = RESULTS.successful
    values = [RESULTS._name_to_item[name]._value for name in np.ravel(names).tolist()]  # type: ignore[attr-defined]
    return eqx.tree_at(lambda r: r._value, successful, jnp.reshape(jnp.asarray(values), np.shape(names)))
