"""Free parameters: selected by name from a pytree, kept within bounds, with priors."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from .._model.paths import entry_names, is_within, leaf_names, listed
from .._program.jit import numpy_for


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Free:
    r"""The p free parameters θ as a function of scaled variables y, which are zero at the start θ₀.

    $$ \theta = \theta_0 + |\theta_0| y, \qquad a \le \theta \le b $$

    The minimiser enforces the bounds. A change of variables that builds them in would have no slope where a start is near a bound.
    """

    params: PyTree  # all parameters, the free ones at their start
    start: Any  # an array (p,), as all down to `prior_deviation`
    scale: Any
    lower: Any
    upper: Any
    prior_mean: Any
    prior_deviation: Any  # infinite where there is no prior
    names: tuple[str, ...] = dataclasses.field(metadata={"static": True})  # as the user gave them
    entries: tuple[str, ...] = dataclasses.field(metadata={"static": True})  # one for each number
    leaves: tuple[int, ...] = dataclasses.field(metadata={"static": True})  # indices of the free arrays among the leaves of params

    @classmethod
    def of(
        cls,
        params: PyTree,
        free: str | Sequence[str],
        bounds: Mapping[str, Any] | None = None,
        priors: Mapping[str, Any] | None = None,
        relative: bool = True,
    ) -> "Free":
        """The entries of `params` (arrays) named by `free`; `bounds` maps names to (lower, upper), `priors` to (mean, standard deviation).

        With `relative`, y is in units of |θ₀|; otherwise θ = θ₀ + y.
        """
        free = listed(free)
        every, names = jax.tree.leaves(params), leaf_names(params, "")
        chosen = [i for name in free for i in _leaves_within(name, names, every)]
        if len(set(chosen)) < len(chosen):
            raise ValueError(f"`free` must name each parameter once, but names one twice: {', '.join(free)}. Remove one of the names.")
        entries = tuple(names[i] + entry for i in chosen for entry in entry_names(every[i]))
        flat = [np.ravel(every[i]) for i in chosen]
        xnp = numpy_for(flat)
        start = xnp.concatenate([xnp.zeros(0), *flat])
        start = start.astype(jax.dtypes.canonicalize_dtype(start.dtype))
        lower, upper = _pair_for_each_entry(bounds, "bounds", free, entries, (-np.inf, np.inf))
        mean, deviation = _pair_for_each_entry(priors, "priors", free, entries, (np.nan, np.inf))
        mean = np.where(deviation == np.inf, 0, mean)  # of none
        _check(start, lower, upper, mean, deviation, entries)
        for i, leaf in enumerate(every):
            if i not in chosen and is_unknown(leaf):
                raise ValueError(f"`params` must be known where they are not free, but {names[i]!r} is NaN. Give it a value, or free it.")
        scale = xnp.where(start == 0, 1, xnp.abs(start)) if relative else xnp.ones_like(start)
        lower, upper, mean, deviation = (np.asarray(x, start.dtype) for x in (lower, upper, mean, deviation))
        return cls(params, start, scale, lower, upper, mean, deviation, free, entries, tuple(chosen))

    @property
    def size(self) -> int:
        """p, the number of free numbers."""
        return len(self.entries)

    def theta(self, y: Any) -> Array:
        """θ(y)."""
        theta = self.start + self.scale * y
        return theta + jax.lax.stop_gradient(jnp.clip(theta, self.lower, self.upper) - theta)  # exactly at a bound, and with its derivative

    @property
    def bounds(self) -> tuple[Any, Any]:
        """Lower and upper bounds of y."""
        return (self.lower - self.start) / self.scale, (self.upper - self.start) / self.scale

    def random_starts(self, key: Array, count: int) -> Array:
        """y of random starts, (count, p): uniform between two bounds; otherwise log-normal, typically off by a factor of two, with the
        sign that they have.
        """
        share = jax.random.uniform(key, (count, self.size), self.start.dtype, 0.02, 0.98)
        factor = 2 ** jax.scipy.special.ndtri(share)

        def start(share, factor):
            lower, upper = jnp.isfinite(self.lower), jnp.isfinite(self.upper)
            bound = jnp.where(lower, self.lower, self.upper)
            away = jnp.where(self.start == bound, jnp.where(lower, self.scale, -self.scale), self.start - bound)
            free = jnp.where(self.start == 0, self.scale * jnp.log(factor), self.start * factor)
            one_sided = jnp.where(lower | upper, bound + away * factor, free)
            return jnp.where(lower & upper, self.lower + (self.upper - self.lower) * share, one_sided)

        return (jax.vmap(start)(share, factor) - self.start[None]) / self.scale[None]

    def with_default_starts(self, unbounded: float = 1.0) -> PyTree:
        """All parameters, where a free one that is NaN starts at some value within its bounds: at this one, where it has none."""
        a, b = (jnp.where(jnp.isfinite(bound), bound, jnp.nan) for bound in (self.lower, self.upper))
        beside = jnp.where(jnp.isnan(a), b - unbounded, a + unbounded)
        default = jnp.where(jnp.isnan(a) & jnp.isnan(b), unbounded, jnp.where(jnp.isnan(a) | jnp.isnan(b), beside, (a + b) / 2))
        return self.insert(jnp.where(jnp.isnan(self.start), default, self.start))

    def slope(self, y: Any) -> Array:
        """dθ/dy for each entry."""
        return jnp.broadcast_to(self.scale, y.shape)

    def prior_residual(self, y: Any) -> Array:
        """(θ − mean) / standard deviation of the priors; zero where there is none."""
        return (self.theta(y) - self.prior_mean) / self.prior_deviation

    def insert(self, theta: Any) -> PyTree:
        """All parameters, with the free ones replaced by θ."""
        leaves, structure = jax.tree.flatten(self.params)
        ends = np.cumsum([np.size(leaves[i]) for i in self.leaves])
        for i, end in zip(self.leaves, ends, strict=True):
            leaves[i] = theta[end - np.size(leaves[i]) : end].reshape(np.shape(leaves[i])).astype(leaves[i].dtype)
        return jax.tree.unflatten(structure, leaves)

    def by_name(self, theta: Any) -> dict[str, PyTree]:
        """The free parameters only, by name."""
        tree = self.insert(theta)
        return {name: _part(tree, name) for name in self.names}


def is_unknown(leaf: Any) -> bool:
    """Whether it is an array with NaN in it, as far as Python sees."""
    if isinstance(leaf, np.ndarray):
        return leaf.dtype.kind in "fc" and bool(np.isnan(leaf).any())
    return bool(eqx.is_inexact_array(leaf) and not _traced([leaf]) and np.isnan(leaf).any())


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
    """The part of the tree at a path such as "arm.lengths" or "joints[0].b"."""
    paths = [path for path, _ in jax.tree_util.tree_flatten_with_path(tree)[0]]
    name_of = lambda keys: jax.tree_util.keystr(keys, simple=True, separator=".")
    keys = next(path[:i] for path in paths for i in range(1, len(path) + 1) if name_of(path[:i]) == name)
    for key in keys:
        tree = getattr(tree, key.name) if hasattr(key, "name") else tree[key.key if hasattr(key, "key") else key.idx]
    return tree


def _pair_for_each_entry(given, argument, free, entries, default):
    """Two arrays with one number for each entry, from a mapping of names to pairs."""
    pair = [np.full(len(entries), value, float) for value in default]
    for name, values in (given or {}).items():
        if not any(is_within(name, chosen) for chosen in free):
            raise ValueError(f"`{argument}` must name free parameters, but holds {name!r}. Free are {', '.join(free)}.")
        indices = [i for i, entry in enumerate(entries) if is_within(entry, name)]
        try:
            first, second = values
            for side, value, missing in zip(pair, (first, second), default, strict=True):
                side[indices] = missing if value is None else np.ravel(np.asarray(value, float))
        except (TypeError, ValueError):
            raise ValueError(f"`{argument}` must give two numbers for {name!r}, but gives {values!r}. Write e.g. `(0.0, None)`.") from None
    return pair


def _check(start, lower, upper, mean, deviation, entries):
    if isinstance(start, jax.core.Tracer):
        return
    for i in np.flatnonzero(~(lower < upper)):
        raise ValueError(f"`bounds` of {entries[i]!r} must be in order, but are ({lower[i]:g}, {upper[i]:g}). Put the lower one first.")
    for i in np.flatnonzero(~(deviation > 0)):
        raise ValueError(
            f"`priors` of {entries[i]!r} must have a positive standard deviation, but it is {deviation[i]:g}. Give how uncertain it is."
        )
    for i in np.flatnonzero(~np.isfinite(mean)):
        raise ValueError(f"`priors` of {entries[i]!r} must have a finite mean, but it is {mean[i]:g} or left out. Give the expected value.")
    theta = np.asarray(start)
    for i in np.flatnonzero(~((lower <= theta) & (theta <= upper)) & ~np.isnan(theta)):
        raise ValueError(
            f"`params` must start {entries[i]!r} within its bounds, but {theta[i]:g} is not inside ({lower[i]:g}, {upper[i]:g}). "
            "Start inside, or widen the bounds."
        )
