"""Lengths of records, padded to few sizes: so that motions of many lengths share a few compiled programs."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

from .._model.signal import Signal, is_signal
from .._program.jit import is_called_by_python, is_concrete, jitted
from .moments import with_counts
from .provenance import Provenance
from .trajectory import COUNTED, Trajectory

EXACT = 16  # lengths up to here are left: they are those of examples


def padded_size(length: int) -> int:
    """The next of eight sizes to each power of two, at most an eighth more."""
    step = 1 << max((length - 1).bit_length() - 4, 0)
    return length if length <= EXACT else -(-length // step) * step


def padded_times(ts: Any) -> Any:
    """Sample times, with the last one repeated; those of a program that is being traced are left."""
    return _padded(ts) if is_concrete(ts) and is_called_by_python() else ts


def padded_signals(params: PyTree) -> PyTree:
    """Params in which signals repeat their last time and value, which does not change them; traced ones are left."""

    def longer(node: Any) -> Any:
        if not is_signal(node) or not is_concrete(node) or np.ndim(node.ts) != 1 or padded_size(len(node.ts)) == len(node.ts):
            return node
        return eqx.tree_at(lambda signal: (signal.ts, signal.values), node, (_padded(node.ts), _padded(node.values)))

    has_signals = any(issubclass(kind, Signal) for kind in {*map(type, jax.tree.leaves(params, is_leaf=is_signal))})
    return jax.tree.map(longer, params, is_leaf=is_signal) if has_signals and is_called_by_python() else params


def _padded(rows: Any) -> np.ndarray:
    rows = np.asarray(rows)
    return np.concatenate([rows, np.repeat(rows[-1:], padded_size(len(rows)) - len(rows), axis=0)])


def without_padding(t: Trajectory, length: int) -> Trajectory:
    """The motion without the samples that were added."""
    counts = {name: count for name, count in t.stats.items() if name in COUNTED}
    happened = {name: event.count for name, event in t.events.items()}
    state, parts = (t.ts, t.q, t.qdot, t.qddot, t.multipliers), (t.works, t.friction, counts, t.states, t.contacts, happened)
    state, (works, friction, counts, states, contacts, happened) = _first((state, parts), length)
    events = with_counts(t.events, happened)
    return Trajectory(*state, t.result, t.stats | counts, works, friction, t.provenance, states, contacts, events)


@jitted
def _first(arrays, length):
    return jax.tree.map(lambda array: array[:length], arrays)


def with_params(trajectory: Trajectory, params: PyTree) -> Trajectory:
    """The motion with the params as they were given, where its own are padded."""
    of = trajectory.provenance
    return dataclasses.replace(trajectory, provenance=Provenance.of(of.system, params, of.friction))
