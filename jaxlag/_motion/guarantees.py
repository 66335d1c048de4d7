"""What a successful motion guarantees at each of its samples."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._model.injection import asks_for
from .event_record import rattles
from .first_order import EquationsOfMotion
from .results import RESULTS
from .sample import Evidence, Sample
from .unreached import nan_unless


def verified(
    equations: EquationsOfMotion,
    ts: Float[Array, " T1"],
    ys: Float[Array, "T1 y"],
    samples: tuple[Sample, Evidence],
    result: RESULTS,
    rtol: Array,
) -> tuple[Sample, RESULTS, Float[Array, ""]]:
    """The samples that keep the guarantees, NaN from the first that does not; the reason that the motion ended; and the time it reached.

    The last sample is not one of the motion but the last state that the integration reached, and says why it got no farther.
    """
    reached = ts[-1]
    result = RESULTS.where((result == RESULTS.dt_min_reached) & _locks(equations, ts, samples[0]), RESULTS.beyond_reach, result)
    rattled = (result == RESULTS.max_steps_reached) & rattles(equations, ys[-1])
    result = RESULTS.where(rattled, RESULTS.on_a_jump, result)
    agree = _agree(equations, *samples)
    result = RESULTS.where((result == RESULTS.undefined) & ~agree[-1], RESULTS.no_multipliers, result)
    ts, ys, (sample, evidence) = jax.tree.map(lambda leaf: leaf[:-1], (ts, ys, samples))
    finite = jnp.all(jnp.isfinite(ys), axis=1)
    passed = ts < reached if equations.events else ts <= reached  # behind the end of a motion there is nothing
    there = finite | (passed & (result == RESULTS.successful))
    of_numbers = [(finite, RESULTS.undefined), (agree[:-1], RESULTS.no_multipliers)]
    kept, reasons = zip(*of_numbers, *_guarantees(equations, ts, sample, evidence, rtol), strict=True)
    every = jnp.stack(kept)  # one reduction for all: each is a kernel or two to compile
    first = jnp.min(jnp.where(there & ~jnp.all(every, axis=0), np.arange(len(ts)), len(ts)))
    of_first, broken = every[:, jnp.minimum(first, len(ts) - 1)], first < len(ts)
    for holds, reason in reversed(list(zip(of_first, reasons, strict=True))):
        result = RESULTS.where(broken & ~holds, reason, result)
    there = there & (np.arange(len(ts)) < first)
    reached = jnp.where(broken, jnp.minimum(reached, ts[jnp.minimum(first, len(ts) - 1)]), reached)

    def masked(leaf):
        return nan_unless(there.reshape(-1, *[1] * (leaf.ndim - 1)), leaf) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf

    return jax.tree.map(masked, sample), result, reached


def _agree(equations: EquationsOfMotion, sample: Sample, evidence: Evidence) -> Bool[Array, " T"]:
    """At which samples multipliers agree with the forces that depend on them, if the constraints alone leave a solution."""
    agree = jnp.ones_like(evidence.off, bool)
    if not any(asks_for(term, "multipliers") for _, term in (*equations.system.dissipation, *equations.system.force)):
        return agree
    for leaf in jax.tree.leaves(sample.multipliers):
        agree = agree & ~jnp.any(jnp.isnan(leaf.reshape(len(leaf), -1)), axis=1)
    return agree | ~(evidence.sound.determined & evidence.sound.satisfied)


def _guarantees(equations: EquationsOfMotion, ts, sample: Sample, evidence: Evidence, rtol) -> list[tuple[Bool[Array, " T"], Any]]:
    """Which samples keep each guarantee, and the reason that a motion ended where one does not."""
    numbers = jax.tree.leaves((sample.qddot, sample.multipliers))
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf.reshape(len(ts), -1)), axis=1) for leaf in numbers]), axis=0)
    guarantees = [(finite, RESULTS.undefined)]
    if equations.modes:
        excess, scale = evidence.violation
        within = excess <= LITTLE * scale + LITTLE**1.5 * jnp.max(jnp.where(jnp.isfinite(scale), scale, 0), axis=0, keepdims=True)
        guarantees.append((jnp.all(within, axis=1), RESULTS.missed))
    if equations.projection is not None:
        kept = (evidence.off <= _residual_bound(rtol)) & evidence.sound.satisfied
        guarantees.append((kept, RESULTS.contradictory))
    elif equations.system.constraints:  # what drifts contradicts itself in time
        guarantees.append((evidence.sound.satisfied | (jnp.arange(len(ts)) > 0), RESULTS.contradictory))
    return guarantees


def _residual_bound(rtol):
    """What projection leaves: far less than the tolerance of the integration, and where that is below √eps, than √eps."""
    return jnp.maximum(rtol, jnp.finfo(rtol.dtype).eps ** 0.5)


def _locks(equations, ts, sample):
    """Whether constrained velocities grow without bounds within next to no time of the motion, as at the end of a mechanism's reach."""
    if not equations.system.constraints:
        return jnp.array(False)
    largest = lambda tree: jnp.max(jnp.stack([jnp.max(jnp.abs(leaf[-1])) for leaf in jax.tree.leaves(tree)]))
    return largest(sample.qdot) < SUDDEN * (ts[-2] - ts[0]) * largest(sample.qddot)


SUDDEN = 1e-6
LITTLE = 1e-4  # of the bound of friction, by which it may be exceeded where a sample lies between two steps
