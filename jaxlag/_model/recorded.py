"""What an experiment recorded: measurements, the noise, times of events and delays, as a user gives them and after all checks."""

from collections.abc import Container, Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .._program.jit import is_concrete, numpy_for
from .injection import check_function
from .numbers import number, numbers
from .validation import is_vector


def with_events(values: PyTree, events: Mapping[str, Any] | None, ts: Any, dtype: Any, late: Container[str] = ()) -> PyTree:
    """The measured values, and in channels of their own the times of events: within the record, unless they are heard `late`."""
    if not events:
        return values
    if not isinstance(values, Mapping) or not isinstance(events, Mapping) or set(values) & set(events):
        raise TypeError("`values` must be a mapping of channels where there are `events`, of other names, but is not. Name the channels.")
    channels = dict(values)
    for name, given in events.items():
        channels[name] = numbers(given, f"`events[{name!r}]`", dtype)
        if channels[name].ndim != 1:
            raise ValueError(
                f"`events[{name!r}]` must be a list of times, but has shape {channels[name].shape}. Give one number for each event."
            )
        if name not in late and is_concrete((channels[name], ts)):
            outside = channels[name][(channels[name] < ts[0]) | (channels[name] > ts[-1])]
            if outside.size:
                raise ValueError(
                    f"`events[{name!r}]` must lie between the first and the last of `ts`, {ts[0]:g} and {ts[-1]:g}, but holds "
                    f"{outside[0]:g}. The motion ends with `ts`: give it a later time, with NaN for what was not measured."
                )
    return channels


def measured_values(values: PyTree, ts: Any, dtype: Any) -> PyTree:
    """The measurements as arrays with a row for each time."""

    def channel(path, value):
        at = f"`values{jax.tree_util.keystr(path)}`"
        if not (hasattr(value, "shape") or is_vector(value)):
            raise TypeError(f"{at} must be an array of real numbers, but is a {type(value).__name__}. Give one number for each time.")
        value = numbers(value, at, dtype)
        if value.shape[:1] != ts.shape:
            raise ValueError(f"{at} must have one row for each of the {ts.size} times, but has shape {value.shape}. Put the samples first.")
        if is_concrete(value):
            if np.any(np.isinf(value)):
                raise ValueError(f"{at} must be finite, but has infinities. Mark missing samples by NaN.")
            if value.size and np.any(np.all(np.isnan(value), axis=0)):
                raise ValueError(f"{at} must hold some measurements, but every sample of a channel is missing. Leave the channel out.")
        return value

    return jax.tree_util.tree_map_with_path(channel, values, is_leaf=is_vector)


def deviations(sigma: PyTree, values: PyTree) -> PyTree:
    """A standard deviation for each of the values."""
    name = lambda path: f"`sigma{jax.tree_util.keystr(path)}`"
    sigma = jax.tree_util.tree_map_with_path(lambda path, s: numbers(s, name(path)), sigma, is_leaf=is_vector)
    values = sigma if values is None else values  # of an experiment that is only planned
    xnp = numpy_for(sigma, values)
    for_each_sample = lambda s, v: xnp.broadcast_to(xnp.asarray(s, jnp.result_type(v, float)), np.shape(v))
    try:
        sigma = jax.tree.map(lambda s, v: jax.tree.map(lambda v: for_each_sample(s, v), v), sigma, values)
    except ValueError as error:
        raise ValueError(
            f"`sigma` must be a number or structured like `values`, but does not fit: {error}. Give one for each channel."
        ) from None
    for s in jax.tree.leaves(sigma):
        if is_concrete(s) and not np.all((np.asarray(s) > 0) & np.isfinite(s)):
            raise ValueError(
                "`sigma` must be positive and finite, but has an entry that is not. Give the standard deviation of the noise; "
                "set samples that are to be ignored to NaN in `values`."
            )
    return sigma


def delays(given: Any, values: PyTree) -> Any:
    """The delay of all sensors, or those by channel as pairs in order, which can be hashed."""
    if not isinstance(given, Mapping):
        return _delay(given, "`delay`")
    if values is not None:
        refuse_unknown(given, values)
    return tuple((name, _delay(given[name], f"`delay[{name!r}]`")) for name in sorted(given))


def _delay(given, label):
    if callable(given):
        check_function(given, label)
    elif given is not None and is_concrete(given):
        return float(number(given, label, cure="Give the time by which the sensors lag behind the motion."))
    return given


def refuse_unknown(delayed: Iterable[str], channels: PyTree) -> None:
    """Raises where the names of those with a delay are not all channels."""
    there = sorted(channels) if isinstance(channels, Mapping) else []
    for name in delayed:
        if name not in there:
            raise ValueError(
                f"`delay` must name channels of `values`, but holds {name!r}. There are {', '.join(there) or 'none that have names'}."
            )
