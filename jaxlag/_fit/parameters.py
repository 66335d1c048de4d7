"""Free parameters: named in a pytree, kept within bounds, drawn to what is known of them."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._model.paths import entry_names, is_within, leaf_names


class Free(eqx.Module):
    r"""The free parameters θ as a function of variables y of size one, which are zero at the start θ₀.

    $$ \theta = \theta_0 + |\theta_0| y, \qquad a \le \theta \le b $$

    The bounds are for those who look for a minimum: a change of variables that keeps them has no slope where a start is near one.
    """

    params: PyTree  # all of them, the free ones at their start
    start: Float[Array, " p"]
    scale: Float[Array, " p"]
    lower: Float[Array, " p"]
    upper: Float[Array, " p"]
    mean: Float[Array, " p"]  # what is known beforehand of θ,
    spread: Float[Array, " p"]  # and how well; infinite where nothing is
    names: tuple[str, ...] = eqx.field(static=True)  # as the user gave them
    entries: tuple[str, ...] = eqx.field(static=True)  # one for each number
    leaves: tuple[int, ...] = eqx.field(static=True)  # places of the free arrays among the leaves of params

    @classmethod
    def of(cls, params, free: Sequence[str], bounds=None, priors=None, relative: bool = True) -> "Free":
        """`params` as arrays; `bounds` maps names to (lower, upper), `priors` to (mean, standard deviation)."""
        if isinstance(free, str):
            raise ValueError(f"`free` must be a list of names, but is the string {free!r}. Write `free=({free!r},)`.")
        every, names = jax.tree.leaves(params), leaf_names(params, "")
        chosen = [i for name in free for i in _leaves_within(name, names, every)]
        if len(set(chosen)) < len(chosen):
            raise ValueError(f"`free` must name each parameter once, but names one twice: {', '.join(free)}. Drop one of the names.")
        entries = tuple(names[i] + entry for i in chosen for entry in entry_names(every[i]))
        flat = [np.ravel(every[i]) for i in chosen]
        start = jnp.asarray(np.concatenate([np.zeros(0), *flat]) if not _traced(flat) else jnp.concatenate(flat))
        lower, upper = _spread_over(bounds, "bounds", free, entries, (-np.inf, np.inf))
        mean, spread = _spread_over(priors, "priors", free, entries, (0.0, np.inf))
        _check(start, lower, upper, spread, entries)
        for i, leaf in enumerate(every):
            if i not in chosen and eqx.is_inexact_array(leaf) and not _traced([leaf]) and np.any(np.isnan(leaf)):
                raise ValueError(f"`params` must be known where they are not free, but {names[i]!r} is NaN. Give it a value, or free it.")
        scale = jnp.where(start == 0, 1, jnp.abs(start)) if relative else jnp.ones_like(start)
        as_start = lambda x: jnp.asarray(x, start.dtype)
        return cls(params, start, scale, *map(as_start, (lower, upper, mean, spread)), tuple(free), entries, tuple(chosen))

    @property
    def size(self) -> int:
        """p, the number of free numbers."""
        return len(self.entries)

    def theta(self, y: Array) -> Array:
        """θ(y)."""
        theta = self.start + self.scale * y
        return theta + jax.lax.stop_gradient(jnp.clip(theta, self.lower, self.upper) - theta)  # at a bound exactly, with its slope

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Of y."""
        return (self.lower - self.start) / self.scale, (self.upper - self.start) / self.scale

    def anywhere(self, key: Array, count: int) -> Array:
        """y of random starts: anywhere between two bounds, else a factor or a share of two off."""
        share = jax.random.uniform(key, (count, self.size), self.start.dtype, 0.02, 0.98)
        factor = 2 ** jax.scipy.special.ndtri(share)

        def start(share, factor):
            lower, upper = jnp.isfinite(self.lower), jnp.isfinite(self.upper)
            bound = jnp.where(lower, self.lower, self.upper)
            away = jnp.where(self.start == bound, jnp.where(lower, self.scale, -self.scale), self.start - bound)
            one_sided = jnp.where(lower | upper, bound + away * factor, self.start + self.scale * jnp.log(factor))
            return jnp.where(lower & upper, self.lower + (self.upper - self.lower) * share, one_sided)

        return (jax.vmap(start)(share, factor) - self.start[None]) / self.scale[None]

    def started(self) -> PyTree:
        """All parameters, with some start within the bounds for those that have none."""
        a, b = (jnp.where(jnp.isfinite(bound), bound, jnp.nan) for bound in (self.lower, self.upper))
        some = jnp.where(jnp.isnan(a), jnp.where(jnp.isnan(b), 1.0, b - 1), jnp.where(jnp.isnan(b), a + 1, (a + b) / 2))
        return self.insert(jnp.where(jnp.isnan(self.start), some, self.start))

    def slope(self, y: Array) -> Array:
        """dθ/dy, entry by entry."""
        return jnp.broadcast_to(self.scale, y.shape)

    def surprise(self, y: Array) -> Array:
        """(θ − mean) / spread, of what is known beforehand."""
        return (self.theta(y) - self.mean) / self.spread

    def insert(self, theta: Array) -> PyTree:
        """All parameters, the free ones taken from θ."""
        leaves, structure = jax.tree.flatten(self.params)
        sizes = np.cumsum([np.size(leaves[i]) for i in self.leaves])
        for i, part in zip(self.leaves, jnp.split(theta, sizes[:-1]) if self.leaves else [], strict=True):
            leaves[i] = part.reshape(jnp.shape(leaves[i])).astype(jnp.result_type(leaves[i]))
        return jax.tree.unflatten(structure, leaves)

    def by_name(self, theta: Array) -> dict[str, PyTree]:
        """The free parameters alone, by their names."""
        tree = self.insert(theta)
        return {name: _part(tree, name) for name in self.names}


def _traced(arrays):
    return any(isinstance(x, jax.core.Tracer) for x in arrays)


def _leaves_within(name, names, leaves):
    within = [i for i, leaf in enumerate(names) if is_within(leaf, name)]
    if not within:
        raise ValueError(f"`free` must name entries of params, but holds {name!r}. There are {', '.join(sorted(names)) or 'none'}.")
    numbers = [i for i in within if eqx.is_inexact_array(leaves[i])]
    if not numbers:
        raise ValueError(f"`free` must name real numbers, but {name!r} holds none. Write them as floating-point numbers.")
    return numbers


def _part(tree, name):
    """What lies in the tree at "arm.lengths", "joints[0].b" and the like."""
    paths = [path for path, _ in jax.tree_util.tree_flatten_with_path(tree)[0]]
    spoken = lambda keys: jax.tree_util.keystr(keys, simple=True, separator=".")
    keys = next(path[:i] for path in paths for i in range(1, len(path) + 1) if spoken(path[:i]) == name)
    for key in keys:
        tree = getattr(tree, key.name) if hasattr(key, "name") else tree[key.key if hasattr(key, "key") else key.idx]
    return tree


def _spread_over(given: Mapping[str, Any] | None, what, free, entries, default):
    """A pair of numbers for each entry."""
    pair = [np.full(len(entries), value, float) for value in default]
    for name, values in (given or {}).items():
        if not any(is_within(name, chosen) for chosen in free):
            raise ValueError(f"`{what}` must name free parameters, but holds {name!r}. Free are {', '.join(free)}.")
        of_name = [i for i, entry in enumerate(entries) if is_within(entry, name)]
        try:
            first, second = values
            for side, value, missing in zip(pair, (first, second), default, strict=True):
                side[of_name] = missing if value is None else np.ravel(np.asarray(value, float))
        except (TypeError, ValueError):
            raise ValueError(f"`{what}` must give two numbers for {name!r}, but gives {values!r}. Write e.g. `(0.0, None)`.") from None
    return pair


def _check(start, lower, upper, spread, entries):
    if isinstance(start, jax.core.Tracer):
        return
    for i in np.flatnonzero(~(lower < upper)):
        raise ValueError(f"`bounds` of {entries[i]!r} must be in order, but are ({lower[i]:g}, {upper[i]:g}). Put the lower one first.")
    for i in np.flatnonzero(~(spread > 0)):
        raise ValueError(
            f"`priors` of {entries[i]!r} must have a positive standard deviation, but it is {spread[i]:g}. Give how well it is known."
        )
    theta = np.asarray(start)
    for i in np.flatnonzero(~((lower <= theta) & (theta <= upper)) & ~np.isnan(theta)):
        raise ValueError(
            f"`params` must start {entries[i]!r} within its bounds, but {theta[i]:g} is not inside ({lower[i]:g}, {upper[i]:g}). "
            "Start inside, or widen the bounds."
        )
