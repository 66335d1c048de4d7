"""Where a motion begins, goes through and ends, as numbers: some of them may be free."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._model.numbers import in_dtype, library, numbers
from .._model.paths import entry_names, is_within, listed

CURE = "Give (q, qdot), with None for what is free."


class Boundary(NamedTuple):
    """`like`: coordinates; the states (q, q̇) at shares of the time, NaN where they are free, and which are known; `returns`: which numbers
    are at the end what they were at the start.
    """

    like: PyTree
    shares: tuple[float, ...]
    states: Float[Array | np.ndarray, "k x"]
    known: tuple[tuple[bool, ...], ...]
    returns: tuple[bool, ...]

    @property
    def n(self) -> int:
        """How many coordinates there are."""
        return self.states.shape[1] // 2

    def guess(self, shares: np.ndarray) -> tuple[Array, Array]:
        """q and its slopes by the share of the time, straight between what is known of each coordinate."""
        q, slopes, known, given = [], [], np.array(self.known), np.array(self.shares)
        for j in range(self.n):
            at = np.flatnonzero(known[:, j])
            if not at.size:
                q.append(jnp.zeros(shares.size, self.states.dtype))
                slopes.append(q[-1])
                continue
            knots, values = given[at], self.states[at, j]
            q.append(jnp.interp(jnp.asarray(shares, values.dtype), jnp.asarray(knots, values.dtype), values))
            if at.size == 1:
                slopes.append(jnp.zeros_like(q[-1]))
                continue
            piece = np.clip(np.searchsorted(knots, shares, side="left"), 1, at.size - 1)
            slopes.append((jnp.diff(values) / jnp.diff(knots))[piece - 1])
        return jnp.stack(q, axis=-1), jnp.stack(slopes, axis=-1)


def boundary_of(start: Any, end: Any, waypoints: Mapping[float, Any] | None, periodic: Any) -> Boundary:
    """From what the user gave."""
    given = {0.0: _pair(start, "start")}
    for share, pair in (waypoints or {}).items():
        if not (isinstance(share, (int, float)) and 0 < share < 1):
            raise ValueError(f"`waypoints` must be at shares of the duration between 0 and 1, but one is at {share!r}. Give e.g. 0.5.")
        given[float(share)] = _pair(pair, f"waypoints[{share}]")
    given[1.0] = _pair(end, "end")
    shares = sorted(given)
    labels = {0.0: "start", 1.0: "end"}
    flat = {share: [_leaves(part, f"`{labels.get(share, 'waypoints')}`") for part in given[share]] for share in shares}
    known = [part for share in shares for part in flat[share] if part is not None]
    if not known:
        raise ValueError(f"`start` must give coordinates, but is free altogether. {CURE}")
    names, structure = known[0][0], known[0][2]
    for there, _, other in known:
        if other != structure:
            raise ValueError(
                f"`start`, `end` and `waypoints` must have one structure, but have {', '.join(names)} and {', '.join(there)}. {CURE}"
            )
    every = [leaves for _, leaves, _ in known]
    shapes = [_shape([leaves[i] for leaves in every], names[i]) for i in range(len(names))]
    dtype = jnp.result_type(float, *(leaf.dtype for leaves in every for leaf in leaves if leaf is not None))
    rows, masks = [], []
    for share in shares:
        parts = [[None] * len(names) if part is None else part[1] for part in flat[share]]
        row, mask = zip(*(_filled(leaf, shape, dtype) for part in parts for leaf, shape in zip(part, shapes, strict=True)), strict=True)
        rows.append(library(*row).concatenate(row))
        masks.append(tuple(np.concatenate(mask).tolist()))
    like = jax.tree.unflatten(structure, [np.zeros(shape, dtype) for shape in shapes])
    return Boundary(like, tuple(shares), library(*rows).stack(rows), tuple(masks), _returns(periodic, like))


def _pair(given: Any, label: str) -> tuple[Any, Any]:
    if given is None:
        return None, None
    if not (isinstance(given, Sequence) and not isinstance(given, str) and len(given) == 2):
        raise TypeError(f"`{label}` must be (q, qdot), but is {given!r}. {CURE}")
    return given[0], given[1]


def _leaves(tree: Any, label: str) -> tuple[list[str], list[Any], Any] | None:
    """Names, numbers and structure; None where all is free."""
    if tree is None:
        return None
    leaves, structure = jax.tree.flatten(tree, is_leaf=lambda x: x is None or isinstance(x, list))
    names = [name or "q" for name in entry_names(jax.tree.unflatten(structure, [np.zeros(())] * len(leaves)), "q")]
    return names, [None if leaf is None else numbers(leaf, label) for leaf in leaves], structure


def _shape(leaves: Sequence[Any], name: str) -> tuple[int, ...]:
    shapes = {np.shape(leaf) for leaf in leaves if leaf is not None}
    if not shapes:
        return ()
    if len(shapes) > 1:
        raise ValueError(
            f"`start` and `end` must have one shape for each coordinate, but {name} has {' and '.join(map(str, shapes))}. {CURE}"
        )
    return shapes.pop()


def _filled(leaf: Any, shape: tuple[int, ...], dtype: Any) -> tuple[Array | np.ndarray, np.ndarray]:
    size = int(np.prod(shape))
    if leaf is None:
        return np.full(size, np.nan, dtype), np.zeros(size, bool)
    return in_dtype(leaf, dtype).ravel(), np.ones(size, bool)


def _returns(periodic: Any, like: PyTree) -> tuple[bool, ...]:
    """Which entries of (q, q̇) are at the end what they were at the start."""
    names = entry_names(like, "q")
    if isinstance(periodic, bool):
        return (periodic,) * (2 * len(names))
    for name in (wanted := listed(periodic)):
        if not any(is_within(entry, name) for entry in names):
            raise ValueError(f"`periodic` must name coordinates, but holds {name!r}. There are {', '.join(names)}.")
    return (*(any(is_within(entry, name) for name in wanted) for entry in names),) * 2
