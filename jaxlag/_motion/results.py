"""Why a motion ended."""

import functools
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._mechanics.singular_directions import Failure


class RESULTS(dfx.RESULTS):  # pyright: ignore
    """Why a motion ended: the reasons of diffrax, and those of mechanics."""

    not_finite = "`q0`, `qdot0`, `ts` and `params` must be finite, but there is a NaN or an infinity among them. Look for missing values."
    unordered = "`ts` must increase, but a time is smaller than the one before it, or the same. Sort the times and what was measured."
    no_period = "`every` must be positive, but the period of a sampled state is not. Look at what it is computed from."
    no_inertia = Failure.no_inertia.value
    impossible_start = Failure.impossible_start.value
    not_affine = Failure.not_affine.value
    undefined = Failure.undefined.value
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
    no_multipliers = Failure.no_multipliers.value
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
    on_a_jump = (
        "the motion comes to rest where a force jumps by the position and pushes back on either side, as sign(q) does: it rattles about "
        "that place ever faster. Let the force bend over a short distance, e.g. `jnp.clip(q / width, -1, 1)`."
    )
    chattering = (
        "friction changed between sliding and sticking more than `max_transitions` times: it chatters. "
        "Allow more with `friction=StickSlip(max_transitions=...)`, or smooth it with `friction=Regularised(width)`."
    )


# A motion that has not failed prints that; diffrax has no word for it.
RESULTS._index_to_message[int(RESULTS.successful._value)] = "successful"  # type: ignore[attr-defined]


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


OF_THE_INPUT = (  # names of results
    "not_finite",
    "unordered",
    "no_period",
    "no_inertia",
    "impossible_start",
    "not_affine",
    "negative_bound",
    "inside_obstacle",
    "not_impulsive",
)
OF_THE_STEPS = ("max_steps_reached", "dt_min_reached")  # which other numerical settings may cure


def has_failed(result: Any) -> bool:
    """Whether a motion has failed, as far as that is known: under `jit` it is not. Asked on the host, at a tenth of the time of `!=`."""
    code = result._value
    return not isinstance(code, jax.core.Tracer) and bool((np.asarray(code) != _successful()).any())


@functools.cache
def _successful() -> int:
    return int(RESULTS.successful._value)  # type: ignore[attr-defined]


def reason_of(result: Any) -> str:
    """The sentence of a failure, in a batch that of `first_failure`; none where nothing failed."""
    if (name := first_failure(result)) == "successful":
        return ""
    return RESULTS[RESULTS._name_to_item[name]]  # type: ignore[attr-defined,misc]


def first_failure(result: Any) -> str:
    """The name of a result; in a batch, that of the first failure, failures of the input before all others, which they may cause."""
    failures = [name for name in np.ravel(names_of(result)).tolist() if name != "successful"]
    return next((name for name in failures if name in OF_THE_INPUT), [*failures, "successful"][0])


def names_of(result: Any) -> np.ndarray:
    """The names of results, which stay the same where their numbers may not."""
    named = {int(item._value): name for name, item in RESULTS._name_to_item.items()}  # type: ignore[attr-defined]
    return np.reshape([named[value] for value in np.ravel(result._value).tolist()], np.shape(result._value))


def result_of(names: np.ndarray) -> RESULTS:
    """The results of these names."""
    successful: Any = RESULTS.successful
    values = [RESULTS._name_to_item[name]._value for name in np.ravel(names).tolist()]  # type: ignore[attr-defined]
    return eqx.tree_at(lambda r: r._value, successful, jnp.reshape(jnp.asarray(values), np.shape(names)))
