"""What a `Trajectory` holds of friction, contacts and events, and what it gives of single times."""

import dataclasses

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from .._program.jit import is_concrete


class FrictionState(eqx.Module):
    """Dry friction along a motion: the `force` on each slip velocity, also while it sticks, and whether it is `sticking`."""

    force: Float[Array, "..."]
    sticking: Bool[Array, "..."]


class ContactState(eqx.Module):
    """A contact along a motion: whether it is `closed`; the number of its `impacts` so far; when it last `changed`, by an impact, by
    opening or by closing; the sum of the `impulse`s of its impacts. One of several gaps has their axes behind those of the samples.
    """

    closed: Bool[Array, "..."]
    impacts: Float[Array, "..."]
    changed: Float[Array, "..."]
    impulse: Float[Array, "..."]


class EventState(eqx.Module):
    """Events of one name in a motion: their times `ts`, and `q`, `qdot` and `states` just before each; NaN beyond the last. `count`: how
    many there were up to each sample.
    """

    ts: Float[Array, "*members most"]
    q: PyTree
    qdot: PyTree
    states: dict[str, PyTree]
    count: Float[Array, "*members T"]

    def __repr__(self) -> str:
        """The times alone, without the places that are left."""
        if not is_concrete(self.ts) or np.ndim(self.ts) != 1:
            return super().__repr__()
        times = np.asarray(self.ts)
        happened = times[np.isfinite(times)]
        return f"EventState: {happened.size} of at most {times.size}, ts = {np.array2string(happened, threshold=8)}"


def with_counts(events: dict[str, EventState], counts: dict[str, Array]) -> dict[str, EventState]:
    """The same events, with the counts at other samples."""
    return {name: dataclasses.replace(event, count=counts[name]) for name, event in events.items()}


class Instant(eqx.Module):
    """A motion at one of its samples: the time `t`, and `q`, `qdot`, `qddot`, `multipliers` and `states` there, e.g. to continue from."""

    t: Float[Array, ""]
    q: PyTree
    qdot: PyTree
    qddot: PyTree
    multipliers: dict[str, PyTree]
    states: dict[str, PyTree]


class Interpolated(eqx.Module):
    """A motion at other times `ts`, from `Trajectory.at`.

    - `q`, `qdot`, `qddot`: structured like q0, with the axes of `ts` first. NaN outside the motion.
    - `q_error`, `qdot_error`: error estimates, from how well interpolation reproduces samples that are left out; for smooth motion they are
      about 64 and 18 times too large.
    """

    ts: Float[Array, "..."]
    q: PyTree
    qdot: PyTree
    qddot: PyTree
    q_error: PyTree
    qdot_error: PyTree
