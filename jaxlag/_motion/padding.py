"""Lengths of records, padded to few sizes: so that motions of many lengths share a few compiled programs."""

import functools
import weakref
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from .._model.given import Given
from .._model.signal import Signal, is_signal
from .._model.validation import sample_times
from .._program.jit import is_called_by_python, is_concrete
from .._program.registry import Table
from .trajectory import Trajectory, of_samples

EXACT = 16  # lengths up to here are left: they are those of examples


def padded_size(length: int) -> int:
    """The next of eight sizes to each power of two, at most an eighth more."""
    step = 1 << max((length - 1).bit_length() - 4, 0)
    return length if length <= EXACT else -(-length // step) * step


def padded_times(ts: Any, dtype: Any) -> tuple[Any, int]:
    """Checked sample times, with the last one repeated, and how many were given; those of a program that is being traced are left."""
    by_python, kept = is_called_by_python(), _KEPT.get(id(ts))
    if by_python and kept is not None and kept.given() is ts and kept.padded.dtype == dtype:
        return kept.padded, kept.length
    checked = sample_times(ts, dtype)
    length = checked.size
    if not (by_python and is_concrete(checked)):
        return checked, length
    padded = _padded(checked)
    if isinstance(ts, jax.Array):  # cannot change
        _keep(ts, padded, length)
    return padded, length


class Kept(NamedTuple):
    """Sample times of JAX that were checked and padded before."""

    given: weakref.ref
    padded: np.ndarray
    length: int


_KEPT = Table()


def _keep(ts, padded, length):
    """For as long as they live."""
    key = id(ts)
    _KEPT[key] = Kept(weakref.ref(ts, lambda _: _KEPT.pop(key, None)), padded, length)


def padded_signals(given: Given) -> Given:
    """Params in which signals repeat their last time and value, which does not change them; traced ones are left."""

    def longer(node: Any) -> Any:
        if not is_signal(node) or not is_concrete(node) or np.ndim(node.ts) != 1 or padded_size(len(node.ts)) == len(node.ts):
            return node
        return eqx.tree_at(lambda signal: (signal.ts, signal.values), node, (_padded(node.ts), _padded(node.values)))

    if not given.others:
        return given
    *state, params = given.trees
    has_signals = any(issubclass(kind, Signal) for kind in {*map(type, jax.tree.leaves(params, is_leaf=is_signal))})
    return Given.of((*state, jax.tree.map(longer, params, is_leaf=is_signal))) if has_signals and is_called_by_python() else given


def _padded(rows: Any) -> np.ndarray:
    rows = np.asarray(rows)
    padded = np.empty((padded_size(len(rows)), *rows.shape[1:]), rows.dtype)
    padded[: len(rows)], padded[len(rows) :] = rows, rows[-1]
    return padded


def without_padding(t: Trajectory, length: int) -> Trajectory:
    """The motion without the samples that were added."""
    leaves, structure = jax.tree.flatten(t)
    places = jax.tree.leaves(of_samples(jax.tree.unflatten(structure, range(len(leaves)))))
    for place, samples in zip(places, _first([leaves[i] for i in places], length), strict=True):
        leaves[place] = samples
    return jax.tree.unflatten(structure, leaves)


@functools.partial(jax.jit, static_argnums=1)
def _first(arrays, length):
    return [array[:length] for array in arrays]
