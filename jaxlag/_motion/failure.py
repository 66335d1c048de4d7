"""The failure of a motion, raised as an error that says when, why, and what to do."""

import jax
import numpy as np

from .._mechanics.friction_elements import unread_friction
from .._mechanics.singular_directions import Failure, explained
from .._program.jit import values
from .results import OF_THE_INPUT, OF_THE_STEPS, first_failure, has_failed, reason_of
from .trajectory import Trajectory


def raise_failure(trajectory: Trajectory, start: tuple | None = None) -> None:
    """Raises the reason of a failed motion, outside of compiled code; under `jit` the reason stays in the result.

    Given the `start` (q0, qdot0, states), it names the coordinates concerned.
    """
    if not has_failed(trajectory.result):
        return
    name, reason = first_failure(trajectory.result), reason_of(trajectory.result)
    if name in OF_THE_INPUT:
        if start is None or name not in Failure.__members__:
            raise ValueError(reason)
        q0, qdot0, states = start
        of = trajectory.provenance
        raise ValueError(explained(Failure[name], of.system, q0, qdot0, of.params, trajectory.ts[0], states))
    known = values(trajectory.q)  # also of what is differentiated
    samples, coordinate = trajectory.ts.shape[-1], np.asarray(jax.tree.leaves(trajectory.q if known is None else known)[0])
    reached = np.isfinite(coordinate.reshape(-1, samples, coordinate.size // trajectory.ts.size)[..., 0]).sum(1).min()
    numerics = (
        "Allow more `max_steps`, inspect what was computed with `throw=False`, or use a solver for stiff systems, "
        f"`solver=diffrax.Kvaerno5()`.{_unread_friction(trajectory)}"
    )
    last = np.ravel(jax.lax.stop_gradient(trajectory.ts))[-1]
    raise RuntimeError(
        f"the motion must reach t = {last:g}, but stopped at t = {np.min(trajectory.stats['reached']):g} "
        f"after {reached} of {samples} samples: {reason} {numerics if name in OF_THE_STEPS else ''}".rstrip()
    )


def _unread_friction(trajectory: Trajectory) -> str:
    """Dry friction of the system that was not recognised as such; of a batch, in its first motion."""
    for _ in trajectory.ts.shape[1:]:
        trajectory = jax.tree.map(lambda x: x[0], trajectory)
    states, t, q, v = trajectory._first()
    findings = unread_friction(trajectory._flat((states, t, q, v)), t, q, v, trajectory.friction)
    return "".join(f" And {finding}." for finding in findings)
