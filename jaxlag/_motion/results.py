"""Why a motion ended."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._mechanics.projection import IMPOSSIBLE
from .._mechanics.saddle_point import NO_INERTIA
from .._mechanics.singular_directions import NOT_AFFINE, UNDEFINED


class RESULTS(dfx.RESULTS):  # pyright: ignore
    """Why a motion ended: the reasons of diffrax, and those of mechanics."""

    not_finite = "`q0`, `qdot0`, `ts` and `params` must be finite, but there is a NaN or an infinity among them. Look for missing values."
    unordered = "`ts` must increase, but a time is smaller than the one before it. Sort the times, and what was measured along with them."
    no_inertia = NO_INERTIA
    impossible_start = IMPOSSIBLE
    not_affine = NOT_AFFINE
    undefined = UNDEFINED
    contradictory = (
        "the constraints are not satisfied there: they contradict each other, nearly repeat each other, or ask for more than the mechanism "
        "can reach. Look at them with `examine`, and at what drives them."
    )
    beyond_reach = (
        "the constraints leave the motion no way on: they drive a mechanism beyond its reach, or into a position that locks it. "
        "Let them ask for less, or leave out the one that does."
    )
    negative_bound = "`dissipation` must have bounds of friction that are not negative, but one is. Take `jnp.abs` of a normal force."
    missed = (
        "friction is beyond its bound there, or slips against its force: an end of sticking or slipping was missed. Take a smaller `rtol`, "
        "and give loads that come and go as `Signal`s."
    )
    no_friction = (
        "no sliding and no sticking agrees with the friction forces it brings about, or more than one does (Painlevé's paradox). "
        "Lower the coefficient of friction, or give the contact its compliance."
    )
    chattering = (
        "friction changed between sliding and sticking more than `max_transitions` times: it chatters. "
        "Allow more by `friction=StickSlip(max_transitions=...)`, or smooth it by `friction=Regularised(width)`."
    )


OF_THE_INPUT = (
    RESULTS.not_finite,
    RESULTS.unordered,
    RESULTS.no_inertia,
    RESULTS.impossible_start,
    RESULTS.not_affine,
    RESULTS.negative_bound,
)
OF_THE_STEPS = (RESULTS.max_steps_reached, RESULTS.dt_min_reached)  # which other numerics may mend


def reason_of(result: Any) -> str:
    """What a result says; of a batch, what the first failure says, and before all others one of the input, which may bring these about."""
    successful: Any = RESULTS.successful
    named = lambda value: RESULTS[eqx.tree_at(lambda r: r._value, successful, jnp.asarray(value))]  # type: ignore[misc]
    reasons = [named(value) for value in dict.fromkeys(np.ravel(result._value)[np.ravel(result != successful)].tolist())]
    of_input = [reason for reason in reasons if reason in [RESULTS[given] for given in OF_THE_INPUT]]  # type: ignore[misc]
    return [*of_input, *reasons, RESULTS[successful]][0]  # type: ignore[misc]


def names_of(result: Any) -> np.ndarray:
    """The names of results, which outlast the numbers that stand for them."""
    named = {int(item._value): name for name, item in RESULTS._name_to_item.items()}  # type: ignore[attr-defined]
    return np.reshape([named[value] for value in np.ravel(result._value).tolist()], np.shape(result._value))


def result_of(names: np.ndarray) -> RESULTS:
    """The results of these names."""
    successful: Any = RESULTS.successful
    values = [RESULTS._name_to_item[name]._value for name in np.ravel(names).tolist()]  # type: ignore[attr-defined]
    return eqx.tree_at(lambda r: r._value, successful, jnp.reshape(jnp.asarray(values), np.shape(names)))
