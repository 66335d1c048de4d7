"""What a printed motion says of itself, in a few lines."""

from typing import Any

import jax
import numpy as np

from .._mechanics.friction_treatment import Regularised
from .._model.paths import leaf_names
from .._program.jit import is_concrete
from .results import reason_of


def card(motion: Any) -> str:
    """The card of a `Trajectory`, of one motion or of many."""
    if not is_concrete(motion):
        return "Trajectory(traced)"
    batch = motion.ts.shape[:-1]
    most = " (the most in the batch)" if batch else ""
    rows = [("coordinates", ", ".join(leaf_names(motion.q)))]
    if motion.multipliers:
        rows.append(("constraints", ", ".join(motion.multipliers)))
    if motion.states:
        rows.append(("states", ", ".join(leaf_names(motion.states))))
    steps, rejected = (np.asarray(motion.stats[key]) for key in ("num_steps", "num_rejected_steps"))
    rows.append(("steps", f"{steps.max()}, {rejected.max()} of them rejected{most}"))
    if motion.multipliers:
        rows.append(("start moved by", f"{np.max(motion.stats['start_moved']):.2g}"))
    for name, contact in motion.contacts.items():
        impacts, closed = (np.reshape(x, (*motion.ts.shape, -1)) for x in (contact.impacts, contact.closed))
        times, at = int(np.nanmax(impacts.sum(-1), initial=0)), closed.any(-1)
        gaps = f" of {closed.shape[-1]} gaps" if np.ndim(contact.closed) > motion.ts.ndim else ""
        touches = f"closed at {at.sum()} of {at.size} samples"
        rows.append(("contact", f"{name!r}: {times} impact{'s' * (times != 1)}{gaps}{most}, {touches}"))
    for name, event in motion.events.items():
        when = np.asarray(event.ts)[np.isfinite(event.ts)]
        first = f", first at t = {when.min():.6g}" if when.size else ""
        rows.append(("event", f"{name!r}: {when.size} time{'s' * (when.size != 1)}{' in all' * bool(batch)}{first}"))
    if motion.friction:
        transitions, stuck = (np.nan_to_num(motion.stats[name]) for name in ("transitions", "time_stuck"))  # NaN where not reached
        rows.append(("friction", f"{int(transitions.max())} transitions, stuck for {stuck.max():.4g}{most}"))
    friction = motion.provenance.friction
    if isinstance(friction, Regularised):
        rows.append(("friction", f"regularised below a slip velocity of {friction.width:g}, where it creeps"))
    if motion.works is not None:
        residual = motion.balance() if not batch else jax.vmap(lambda motion: motion.balance())(motion)
        rows.append(("energy balance", f"off by {np.nanmax(np.abs(residual)):.1e} of the energy exchanged"))
    for name, pulls in motion.pulling().items():
        rows.append(("one-sided", _pulled(name, pulls, motion)))
    rows.append(("result", "successful" if np.all(motion.succeeded) else reason_of(motion.result)))
    of = f"{' × '.join(map(str, batch))} motions of " if batch else ""
    begin, end = float(np.min(motion.ts)), float(np.max(motion.ts))
    late = int(np.log10(max(abs(begin), abs(end)) / (end - begin))) if end > begin else 0  # digits that a late clock does not change
    head = f"Trajectory: {of}{motion.ts.shape[-1]} samples, t = {begin:.{6 + late}g} … {end:.{6 + late}g}"
    return "\n".join([head, *(f"  {name:<15}{value}" for name, value in rows)])


def _pulled(name, pulls, motion):
    """What the card says of a one-sided constraint."""
    samples = lambda tree: np.concatenate([np.reshape(x, (*motion.ts.shape, -1)) for x in jax.tree.leaves(tree)], axis=-1)
    where, multipliers = np.any(samples(pulls), axis=-1), samples(motion.multipliers[name])
    if not where.any():
        return f"{name!r} never pulls"
    several = f"of {int(where.any(axis=-1).sum())} motions " if where.ndim > 1 else ""
    return (
        f"{name!r} would have to pull at {where.sum()} of {where.size} samples {several}(first at t = {motion.ts[where].min():g}, "
        f"λ down to {np.nanmin(multipliers):.3g}): its contact would have opened"
    )
