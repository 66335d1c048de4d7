"""What counts as small in a motion: tolerances, given or by default, and the scale of each coordinate along the motion.

By default a coordinate is compared with what it has been so far, in its own unit: no number of the package has one.
"""

import functools
import warnings
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from .._mechanics.contact import roundings
from .._model.numbers import number, numbers
from .._model.signal import least_spacing, origin_of
from .._program.jit import is_concrete

SHARE = 0.01  # of its own scale, what of a coordinate near zero is compared with
LEAST = 1e-3  # of a coordinate's own scale, what its velocity has to move it by within the motion to have a scale of its own


class Scales(NamedTuple):
    """What counts as small in a motion: tolerances, its duration, the sample spacing of its inputs, the rounding of its times, and that of
    the times that functions see, where they ask for them; and of q and q̇ the scale of each along the motion so far.
    """

    rtol: Any
    atol: Any  # None where each follows its own scale
    duration: Any
    spacing: Any
    rounding: Any
    grain: Any
    of_q: Any
    of_v: Any
    driven: Any = None  # of each velocity, the least scale that dry friction in a plane gives it
    held: Any = None  # of each velocity, the rate that forces which may hold one another give it
    given: Any = None  # of each coordinate, whether a constraint alone gives it as a function of the time
    units: Any = None  # of each coordinate, what weighs as much as one of any other
    held_along: tuple = ()  # for each order, of each velocity and direction of variations the rate that it makes of forces that may be held
    shares: tuple = ()  # of each direction of variations, for each order, the share by which it changes a number at most

    @classmethod
    def of(cls, tolerances: tuple[Array, Array | None], ts: Array, params: PyTree, q: Array, v: Array, sees_time: bool) -> "Scales":
        """The scales of a motion at the times `ts` since the origin of `params`, where q and q̇ have been as large as this."""
        end, eps = jnp.maximum(jnp.abs(ts[0]), jnp.abs(ts[-1])), jnp.finfo(ts.dtype).eps
        seen = end + jnp.abs(origin_of(params)) if sees_time else end
        found = cls(*tolerances, ts[-1] - ts[0], least_spacing(params, ts.dtype), eps * end, eps * seen, q, v)
        return jax.lax.stop_gradient(found.at(jnp.abs(jnp.concatenate([q, v]))))

    def at(self, sizes: Array) -> "Scales":
        """The same, where the largest values of the entries of y so far are these."""
        n = len(self.of_q)
        reach = jax.lax.stop_gradient(reaching(sizes, n, self.duration))
        of_v = reach[n : 2 * n] if self.driven is None else jnp.maximum(reach[n : 2 * n], self.driven)
        return self._replace(of_q=reach[:n], of_v=of_v)

    @property
    def slow(self) -> Array:
        """Of each velocity, the slip below which its direction is not worth the many steps that resolving it would take.

        Where elements begin to slide together, a velocity may be off by this much.
        """
        return 1e2 * self._absolute(self.of_v)

    @property
    def with_held_forces(self) -> "Scales":
        """The same, where coordinates have scales that have not moved yet, since forces hold one another."""
        if self.held is None:
            return self
        reach = self.held * self.duration
        return self._replace(of_q=jnp.maximum(self.of_q, reach * self.duration), of_v=jnp.maximum(self.of_v, reach))

    def roundings(self, q: Array, v: Array) -> tuple[Array, Array]:
        """What counts as rounding of q and of q̇."""
        reach = self.with_held_forces
        return roundings(q, reach.of_q), roundings(v, reach.of_v)

    def roundings_of_rates(self, qddot: Array) -> Array:
        """What counts as rounding of q̈, where forces hold one another."""
        return roundings(qddot, 0.0) if self.held is None else roundings(self.held, 0.0)

    def of_positions(self, q: Array, factor: float = 10) -> Array:
        """Of each coordinate, the error of the integration."""
        return factor * (self.rtol * jnp.abs(q) + self._absolute(self.of_q))

    def of_velocities(self, v: Array, factor: float = 10) -> Array:
        """Of each velocity, the error of the integration: slip below it counts as rest where another element changes its mode."""
        return factor * (self.rtol * jnp.abs(v) + self._absolute(self.of_v))

    def _absolute(self, own: Array) -> Array:
        if self.atol is None:
            return SHARE * self.rtol * own
        n = len(self.of_q)
        return self.atol[:n] if jnp.ndim(self.atol) else jnp.full(n, self.atol)


def shares_of(varying: PyTree, directions: PyTree) -> Array:
    """Of the motion, 1; of each direction, last in its leaves, the share of itself by which a number that is not zero changes at most."""
    pairs = zip(*map(jax.tree.leaves, (varying, directions)), strict=True)
    of_each = [jnp.where(x == 0, 0, jnp.abs(dx) / jnp.where(x == 0, 1, jnp.abs(x))) for x, dx in ((x[..., None], dx) for x, dx in pairs)]
    size = jax.tree.leaves(directions)[0].shape[-1]
    most = functools.reduce(jnp.maximum, (jnp.max(share.reshape(-1, size), axis=0, initial=0.0) for share in of_each))
    return jax.lax.stop_gradient(jnp.concatenate([jnp.ones(1, most.dtype), most]))


def reaching(size: Array, coordinates: int, duration: Any) -> Array:
    """Of each entry of y the scale that it is compared with: its size; of a velocity, at least what moves its coordinate noticeably."""
    q, v, rest = size[:coordinates], size[coordinates : 2 * coordinates], size[2 * coordinates :]
    return jnp.concatenate([q, jnp.maximum(v, LEAST * q / jnp.where(duration > 0, duration, jnp.inf)), rest])


def tolerances_of(rtol, atol, q: PyTree) -> tuple[Array | np.ndarray, Array | np.ndarray | None]:
    """The given tolerances, or the default for the precision; the absolute one of each coordinate and its velocity, where they differ."""
    dtype = np.result_type(*(leaf.dtype for leaf in jax.tree.leaves(q)))
    single = dtype.itemsize < 8
    if single:
        _warn_of_single_precision()
    default = 1e-4 if single else 1e-8
    if rtol is None and atol is None:
        return np.asarray(default, dtype), None
    rtol = number(default if rtol is None else rtol, "`rtol`", dtype, least=0.0, cure=f"The default is {default:g}.")
    if atol is None:
        return rtol, None
    cure = "Leave it out, and each coordinate is compared with its own scale."
    given, like = jax.tree.leaves(atol), jax.tree.leaves(q)
    if jax.tree_util.treedef_is_leaf(jax.tree.structure(atol)) and np.ndim(atol) == 0:
        return rtol, number(atol, "`atol`", dtype, positive=True, cure=cure)
    is_alike = jax.tree.structure(atol) == jax.tree.structure(q)  # type: ignore[operator]
    if not (is_alike and all(np.shape(x) in ((), np.shape(y)) for x, y in zip(given, like, strict=True))):
        raise ValueError(f"`atol` must be a number, or one for each coordinate in a pytree like `q0`, but is {atol!r}. {cure}")
    each = jax.tree.map(lambda x, like: jnp.broadcast_to(numbers(x, "`atol`", dtype), np.shape(like)), atol, q)
    each = ravel_pytree(each)[0]
    if is_concrete(each) and not np.all(np.asarray(each) > 0):
        raise ValueError(f"`atol` must be positive, but is {atol!r}. {cure}")
    return rtol, jnp.tile(each, 2)


@functools.cache
def _warn_of_single_precision() -> None:
    warnings.warn(
        "jaxlag runs in single precision: tolerances below 1e-5 are out of reach. "
        'For double precision: jax.config.update("jax_enable_x64", True).',
        stacklevel=5,
    )
