"""The lowest modes of many coordinates, each coupled to a few, without dense matrices."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, PyTree

from .._mechanics.augmented_inertia import by_weight
from .._model.flat import bind
from .._model.numbers import count as whole
from .._model.numbers import number, refuse_nan
from .._model.paths import entry_names
from .._model.system import System
from .._model.validation import coordinates, parameters, without_contacts
from .._program.jit import compiled, is_concrete
from .._program.jit import values as seen_values
from .equilibrium import Equilibrium
from .modes import Modes, damping_ratios, normalised
from .not_differentiated import without_derivative
from .origin import Origin
from .pencil import CURE, along_modes, left_over, pencil
from .sparse_modes import Found, Matrices, modes_near

STILL = 0.375  # exponent of eps: tolerance on residual forces at rest, relative to their terms


def lowest_modes(system: System, q: Any, params: PyTree = None, *, count: int = 10, shift: float = 0.0, t: Any = 0.0) -> Modes:
    r"""The lowest natural frequencies and modes of a large sparse system at rest.

    $$ (\lambda^2 M + \lambda C + K)\,\hat q = G^T \hat\mu, \qquad G \hat q = 0 $$

    M, C, K and G are read from L, D and g as sparse matrices, the matrix at `shift` is factorised once, and Arnoldi's method finds the λ
    nearest to it: time and memory grow in proportion to the number of coordinates. `linearise(…).modes()` finds all modes, with dense
    matrices.

    **Arguments:** `q`: where the system rests, or the result of `equilibrium`; `params`, `t` as for `acceleration`; `count`: the number of
    modes, less than half the degrees of freedom; `shift`: a real number in 1/time, a fraction of the lowest frequency, needed if a body is
    free to move or K is singular for another reason. Any consistent units.

    **Returns:** `Modes`, the smallest |λ − `shift`| first; without damping the lowest ω² = −λ² first, so that the fastest growth leads, and
    the inertia of the matrices confirms that none is missing (if that is not certain, a warning says so). The eigenvalues are
    differentiable once, in `params` and `q`, repeated ones through their mean and without damping only; derivatives of shapes, and of
    repeated eigenvalues with damping, are NaN.

    **Raises:** `ValueError` if q is not at rest, the matrix is singular, or modes were not found; under `jit` and `vmap`, which hide the
    numbers; and for systems with dry friction, nonholonomic constraints, contacts, events or further states.

    **Source:** Lehoucq, Sorensen & Yang, ARPACK Users' Guide, SIAM 1998, section 3.2; Tisseur & Meerbergen, SIAM Review 43 (2001) 235.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    chain = jl.System(lambda q, qdot, m, c: 0.5 * m * qdot @ qdot - 0.5 * c * jnp.sum(jnp.diff(q, prepend=0.0, append=0.0) ** 2))
    modes = jl.lowest_modes(chain, jnp.zeros(2000), {"m": 1.0, "c": 4.0}, count=3)
    modes.angular_frequency  # 4 sin(k π/4002) = 0.00314, 0.00628, 0.00942
    ```
    """
    if isinstance(q, Equilibrium):
        q, t = q.q, q.t
    q = coordinates(q, "q")
    dtype = jax.tree.leaves(q)[0].dtype
    t, params = number(t, "`t`", dtype, cure="Pass one time."), parameters(params, q)
    refuse_nan(params)
    count = whole(count, "`count`", cure="Ask for one mode or more.")
    shift = float(number(shift, "`shift`", dtype, cure="Pass a real number, in 1/time."))
    _refuse(system)
    given = (t, q, params)
    known = seen_values(given)
    if known is None:
        raise ValueError(f"`lowest_modes` must see the numbers, but `jit` or `vmap` hides them. Call it outside, or: {CURE}")
    multipliers, matrices = _at_rest(system, known, entry_names(q, "q"))
    found = modes_near(matrices, count, shift)
    values = _Slopes(system, given, multipliers, matrices, found).values()
    x, mu = np.split(found.vectors, [matrices.n])
    mu = matrices.shared(mu.real) + 1j * matrices.shared(mu.imag)
    return _described(system, given, values, found._replace(vectors=np.concatenate([x, mu])))


def _refuse(system: System) -> None:
    """Raises if a system has contacts, nonholonomic constraints, states or events."""
    without_contacts(system, "`lowest_modes`")
    for what in ("nonholonomic", "states", "events"):
        if getattr(system, what):
            raise ValueError(f"`system` must have no `{what}` in `lowest_modes`, but has. {CURE}")


def _at_rest(system: System, known: tuple, names: tuple[str, ...]) -> tuple[np.ndarray, Matrices]:
    """The λ that best balances the forces, and the pencil with it; raises if forces are left."""
    n, dtype = len(names), jax.tree.leaves(known[1])[0].dtype
    of = lambda multipliers: Matrices.of(pencil(system, *known, multipliers), n)
    loose = of(np.zeros(bind(system, *known[1:]).rows, dtype))
    if not np.all(np.isfinite(loose.pencil.left)):
        raise ValueError("`q` must be a state at which all forces are finite, but is not. `examine` says which are not.")
    f = -np.asarray(loose.pencil.left, float)[:, None]
    multipliers = loose.shared(loose.nearest(f[:n], 0 * f[n:])[n:, 0]).astype(dtype)
    matrices = of(multipliers) if len(multipliers) else loose
    left, flat = np.asarray(matrices.pencil.left), np.concatenate([np.ravel(x) for x in jax.tree.leaves(known[1])])
    size = np.concatenate([np.asarray(by_weight(jnp.asarray(matrices.units), jnp.abs(flat))), np.abs(multipliers)])
    allowed = np.finfo(dtype).eps ** STILL * (abs(matrices.K) @ size + np.asarray(matrices.pencil.terms))
    if np.any(np.abs(left) > allowed):
        i = int(np.argmax(np.abs(left) / np.where(allowed > 0, allowed, np.finfo(dtype).tiny)))
        what = f"{names[i]!r} is pushed by {-left[i]:.4g}" if i < n else "is off its constraints"
        raise ValueError(f"`q` must be at rest, but {what}. Look for the equilibrium by `equilibrium`.")
    return multipliers, matrices


class _Slopes(NamedTuple):
    """The eigenvalues as functions of t, q and params; λ = λ(t, q, params) balances the forces."""

    system: System
    given: tuple
    multipliers: np.ndarray
    matrices: Matrices
    found: Found

    def values(self) -> Complex[Array, " k"]:
        """Eigenvalues of the modes, with derivatives if they are asked for."""
        found, dtype = self.found, jnp.result_type(self.multipliers.dtype, self.matrices.pencil.left.dtype, jnp.complex64)
        values = jnp.asarray(found.values, dtype)
        if is_concrete(self.given):
            return values
        slopes = self._slopes(dtype) @ jnp.asarray(found.same / np.sum(found.same, axis=1), dtype)
        if not found.conservative:
            return _with_slopes(values, slopes * np.where(np.sum(found.same, axis=1) > 1, np.nan, 1.0))
        squares = _with_slopes(-(values**2), -slopes)  # complex: they may become damped
        there, grows = squares != 0, squares.real < 0
        omega = jnp.sqrt(jnp.where(there, jnp.where(grows, -squares, squares), 1)) * there
        return jnp.where(grows, omega, 1j * omega)

    def _slopes(self, dtype: Any) -> Complex[Array, " k"]:
        """−yᵀ P(λ) x, whose derivatives are those of the eigenvalues, also through λ: with c = ∂(yᵀ P x)/∂λ and G w = c, c dλ = wᵀ dE."""
        values, vectors, left = (jnp.asarray(x, dtype) for x in self.found[:3])
        by = lambda multipliers, given: jnp.einsum("ik,ik->k", left, along_modes(self.system, *given, multipliers, values, vectors))
        slopes = by(self.multipliers, self.given)
        if self.multipliers.size:
            known = seen_values(self.given)
            n, w = self.matrices.n, 0
            for part, one in ((jnp.real, 1), (jnp.imag, 1j)):
                c = np.asarray(jax.jacrev(lambda m, part=part: part(by(m, known)))(self.multipliers), float)
                w = w + one * self.matrices.nearest(np.zeros((n, len(c))), -c.T)[:n]
            slopes += left_over(self.system, *self.given, self.multipliers)[:n] @ jnp.asarray(w, dtype)
        return -slopes


def _described(system: System, given: tuple, values: Array, found: Found) -> Modes:
    """Modes with everything that is reported about them."""
    t, q, params = given
    vectors = jnp.asarray(found.vectors, values.dtype)
    shapes, multipliers = _taken_apart(system, q, params, vectors.real if found.conservative else vectors)
    stable, repeated = jnp.asarray(found.values.real <= 0), jnp.asarray(np.sum(found.same, axis=1) > 1)
    origin = Origin.of(t, q, jax.tree.map(jnp.zeros_like, q), params, system)
    return Modes(values, damping_ratios(values), stable, repeated, shapes, multipliers, {}, origin)


@compiled
def _taken_apart(system: System, q: PyTree, params: PyTree, vectors: Array) -> tuple[PyTree, PyTree]:
    """Scaled shapes and constraint forces; their derivatives are unknown: NaN."""
    flat, n = bind(system, q, params), len(vectors) - bind(system, q, params).rows
    vectors = without_derivative(normalised(vectors, vectors[:n], None), (q, params))
    return jax.vmap(flat.unravel, in_axes=1)(vectors[:n]), jax.vmap(flat.unravel_multipliers, in_axes=1)(vectors[n:])


@jax.custom_jvp
def _with_slopes(values: Array, of: Array) -> Array:
    """`values` with the derivatives of `of`; second derivatives are unknown: NaN."""
    return values


@_with_slopes.defjvp
def _slopes_of_first_order(primals: Any, tangents: Any) -> Any:
    (values, of), (_, slope) = primals, tangents
    return _with_slopes(values, of), slope * without_derivative(jnp.ones((), jnp.real(values).dtype), of)
