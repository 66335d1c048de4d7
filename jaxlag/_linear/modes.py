"""Modes: natural frequencies, damping, shapes, and the constraint forces that go with them."""

import dataclasses
import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, PyTree

from .._program.jit import compiled, is_concrete
from .eigenvalues import are_repeated, balanced, eigen, rounding, symmetric_eigen
from .not_differentiated import without_derivative
from .origin import Origin


class SecondOrder(NamedTuple):
    """M ξ̈ + (C + G) ξ̇ + (K + N) ξ = …: `mass` M, `damping` C and `stiffness` K symmetric, `gyroscopic` G and `circulatory` N
    antisymmetric, in independent coordinates.
    """

    mass: Float[Array, "v v"]
    damping: Float[Array, "v v"]
    gyroscopic: Float[Array, "v v"]
    stiffness: Float[Array, "v v"]
    circulatory: Float[Array, "v v"]


class Modes(eqx.Module):
    r"""Modes of a `LinearSystem`, sorted by the size of their eigenvalue: one for each conjugate pair; under `jit` and `vmap`, for each
    one.

    $$ \delta q = \mathrm{Re}\,(\hat q\,e^{\lambda t}), \qquad \omega_0 = |\lambda|, \qquad \zeta = -\mathrm{Re}\,\lambda/|\lambda| $$

    - `eigenvalues`: λ, in 1/time; exactly 0 for rigid-body modes and for coordinates on which nothing depends, one for each independent
      shape.
    - `angular_frequency`: ω₀ in rad/time; `frequency`: ω₀/2π; both of the undamped oscillation; for a real λ, its size.
    - `damping_ratio`: ζ; 1 or more if the mode does not oscillate, negative if it grows. `time_constant`: 1/|Re λ|.
    - `stable`: whether the mode does not grow. `repeated`: whether another mode has the same eigenvalue; any combination of their shapes is
      then a shape, too, and derivatives of their eigenvalues are those of the mean.
    - `shapes`: q̂, structured like q, with the modes as first axis; real where there is no damping. `states`: of the first-order states.
    - `multipliers`: the constraint forces of the mode, by name. `origin`: the state that was linearised; None along a trajectory.

    `modes[0]` is one of them, which `animate` shows. Prints as a table. In discrete time λ is log(z)/T.
    """

    eigenvalues: Complex[Array, "*k"]
    damping_ratio: Float[Array, "*k"]
    stable: Bool[Array, "*k"]
    repeated: Bool[Array, "*k"]
    shapes: PyTree
    multipliers: dict[str, PyTree]
    states: dict[str, PyTree]
    origin: Origin | None

    @property
    def angular_frequency(self) -> Float[Array, "*k"]:
        """ω₀ = |λ|, in rad/time."""
        return _size(self.eigenvalues)

    @property
    def frequency(self) -> Float[Array, "*k"]:
        """ω₀/2π, in 1/time."""
        return self.angular_frequency / (2 * jnp.pi)

    @property
    def time_constant(self) -> Float[Array, "*k"]:
        """1/|Re λ|, infinite where nothing decays or grows."""
        decay = jnp.abs(self.eigenvalues.real)
        return jnp.where(decay > 0, 1 / jnp.where(decay > 0, decay, 1), jnp.inf)

    def __len__(self) -> int:
        return self.eigenvalues.shape[-1]

    def __iter__(self) -> Iterator["Modes"]:
        return (self[i] for i in range(len(self.eigenvalues)))

    def __getitem__(self, which: Any) -> "Modes":
        """Some of the modes."""
        first = which[0] if isinstance(which, tuple) and which else which
        if isinstance(first, int | np.integer) and not -len(self.eigenvalues) <= first < len(self.eigenvalues):
            raise IndexError(f"`modes[{first}]` must be one of {len(self.eigenvalues)} modes, counted from 0.")
        origin, of_many = self.origin, self.eigenvalues.ndim - 1
        if of_many > 0:  # all modes of one system have one origin
            origin = jax.tree.map(lambda x: x[which[:of_many] if isinstance(which, tuple) else which], origin)
        parts = jax.tree.map(lambda x: x[which], dataclasses.replace(self, origin=None))
        return dataclasses.replace(parts, origin=origin)

    def __repr__(self) -> str:
        if not is_concrete(self) or self.eigenvalues.ndim != 1:
            return f"Modes(of shape {self.eigenvalues.shape})"
        time = "s" if self.origin is None else dict(self.origin.units).get("t", "s")
        units = f"ω₀ (rad/{time})", "f (Hz)" if time == "s" else f"f (1/{time})", f"1/|Re λ| ({time})"
        head = f"{'mode':>4}  {units[0]:>12}  {units[1]:>12}  {'ζ':>9}  {units[2]:>12}  "
        columns = tuple(map(np.asarray, (self.angular_frequency, self.frequency, self.damping_ratio, self.time_constant)))
        lines = []
        for still, run in itertools.groupby(range(len(self)), key=lambda i: bool(self.eigenvalues[i] == 0)):
            first, *others = run
            for i in [first] if still else [first, *others]:
                w, f, z, T = (column[i] for column in columns)
                which = f"{i}–{others[-1]}" if still and others else i
                kind = _still(1 + len(others)) if still else _kind(self.eigenvalues[i], self.stable[i], self.repeated[i])
                lines.append(f"{which:>4}  {w:>12.5g}  {f:>12.5g}  {z:>9.3g}  {T:>12.4g}  {kind}")
        return "\n".join(["Modes", head.rstrip(), *lines])


def _still(count):
    return "stays where it is put" if count == 1 else f"{count} modes stay where they are put"


def _kind(value, stable, repeated):
    kind = "stable" if stable else "flutter" if value.imag else "divergence"
    return f"{kind}{', repeated' if repeated else ''}"


def _size(values):
    """|λ|, with a derivative at λ = 0, too."""
    there = values != 0
    return jnp.where(there, jnp.abs(jnp.where(there, values, 1)), 0)


class Found(NamedTuple):
    """Eigenvalues in continuous time, eigenvectors in x as columns, and masks of modes that do not grow and of repeated modes."""

    values: Array
    vectors: Array
    stable: Array
    repeated: Array


@compiled
def of_second_order(system: SecondOrder) -> Found:
    """Modes without damping: K x = ω² M x, real and orthonormal in M."""
    root = jnp.linalg.cholesky(system.mass)
    half = jax.scipy.linalg.solve_triangular(root, system.stiffness, lower=True)
    scaled = jax.scipy.linalg.solve_triangular(root, half.T, lower=True)
    squares, vectors = symmetric_eigen((scaled + scaled.T) / 2)
    shapes = jax.scipy.linalg.solve_triangular(root.T, vectors, lower=False)
    omega = jnp.sqrt(jnp.where(squares != 0, jnp.abs(squares), 1)) * (squares != 0)
    values = jnp.where(squares < 0, omega, 1j * omega)
    order = jnp.argsort(jnp.abs(omega), stable=True)
    bound = jnp.full(len(squares), 10 * len(squares) * jnp.finfo(squares.dtype).eps * jnp.max(jnp.abs(squares), initial=0.0))
    again = jnp.sum(are_repeated(squares, bound), axis=1) > 1
    return Found(values[order], shapes[:, order], (squares >= 0)[order], again[order])


def of_first_order(A: Float[Array, "d d"], sample_time: Any) -> Found:
    """Modes of A; if the numbers are concrete, only the upper one of each conjugate pair, and one zero for each column of `at_rest`."""
    found = _of_first_order(A, sample_time)
    values = jax.lax.stop_gradient(found.values)
    if not is_concrete(values):
        return found
    values = np.asarray(values)
    still, moving = np.flatnonzero(values == 0), np.flatnonzero((values != 0) & (values.imag >= 0))
    shapes = at_rest(A if sample_time is None else A - jnp.eye(len(A), dtype=A.dtype), still.size)
    still = still[: shapes.shape[1]]
    chosen = np.concatenate([still, moving])
    vectors = jnp.concatenate([shapes.astype(found.vectors.dtype), found.vectors[:, moving]], axis=1)
    repeated = jnp.concatenate([jnp.full(still.size, still.size > 1), found.repeated[moving]])
    return Found(found.values[chosen], vectors, found.stable[chosen], repeated)


def at_rest(A: Float[Array, "d d"], zeros: int) -> Float[Array, "d k"]:
    """A basis N of the states that stay where they are put, A N = 0. There may be fewer of them than zero eigenvalues of A: a body that
    moves freely has two zeros, for position and speed, but one state at rest. Each column is 1 at an entry at which the others are 0.

    N solves A N + W s = 0, P N = 1, where P selects these entries and W spans the directions that A does not reach; derivatives follow from
    this system.
    """
    import scipy.linalg  # imported here because that takes a while

    fixed = jax.lax.stop_gradient(A)
    scale, _ = balanced(fixed)
    left, sizes, right = np.linalg.svd(np.asarray(fixed * scale[None, :] / scale[:, None]))
    dust = 100 * len(A) * np.finfo(sizes.dtype).eps * np.max(sizes, initial=0.0)
    k = min(max(int(np.sum(sizes <= dust)), 1), zeros)
    if not k:
        return jnp.zeros((len(A), 0), A.dtype)
    _, _, order = scipy.linalg.qr(right[len(A) - k :], pivoting=True)
    entries = np.eye(len(A), dtype=A.dtype)[order[:k]]
    bordered = jnp.block([[A * scale[None, :] / scale[:, None], left[:, len(A) - k :]], [entries, np.zeros((k, k), A.dtype)]])
    N = jnp.linalg.solve(bordered, np.eye(len(A) + k, k, -len(A), dtype=A.dtype))[: len(A)]
    return scale[:, None] * N / scale[order[:k]][None, :]


def undamped(found: Found) -> Found:
    """The first-order modes of an undamped system that `of_second_order` also finds, in its order, with positions alone; the growing one of
    each real pair ±ω.
    """
    values = np.asarray(jax.lax.stop_gradient(found.values))
    chosen = np.flatnonzero((values == 0) | (values.imag > 0) | (values.real > 0))
    positions = found.vectors[: len(found.vectors) // 2]
    return Found(found.values[chosen], positions[:, chosen], found.stable[chosen], found.repeated[chosen])


def with_derivatives_of(found: Found, other: Found) -> Found:
    """Modes without damping, with the derivatives of `other`, which include damping, gyroscopic and circulatory terms; shapes stay real."""
    if found.values.shape != other.values.shape:  # the two disagree on which values are rounding
        values, vectors = (without_derivative(x, other.values) for x in found[:2])
        return found._replace(values=values, vectors=vectors)

    def of(x, other):
        other = other if jnp.iscomplexobj(x) else other.real
        return jax.lax.stop_gradient(x) + (other - jax.lax.stop_gradient(other))

    return found._replace(values=of(found.values, other.values), vectors=of(found.vectors, other.vectors))


@compiled
def _of_first_order(A, sample_time):
    values, vectors = eigen(A)
    bound = rounding(A, vectors)
    again = jnp.sum(are_repeated(values, bound), axis=1) > 1
    if sample_time is not None:
        there = values != 0
        values = jnp.where(jnp.abs(values - 1) <= bound, 1 + values - jax.lax.stop_gradient(values), values)  # modes that stay put
        values = jnp.where(there, jnp.log(jnp.where(there, values, 1)) / sample_time, -jnp.inf)
        bound = bound / sample_time
        order = jnp.argsort(jnp.abs(values), stable=True)
        values, vectors, bound, again = values[order], vectors[:, order], bound[order], again[order]
    dust = jnp.where(jnp.abs(values.real) <= bound, jax.lax.stop_gradient(values.real), 0)
    return Found(values - dust, vectors, values.real <= bound, again)


def is_conservative(system: SecondOrder) -> bool:
    """Whether damping, gyroscopic and circulatory terms are nothing but rounding; False if the numbers are not concrete."""
    given = jax.lax.stop_gradient(system)
    if not is_concrete(given):
        return False
    root = np.linalg.cholesky(np.asarray(given.mass))
    of = lambda matrix: np.max(np.abs(np.linalg.solve(root, np.linalg.solve(root, np.asarray(matrix)).T)), initial=0.0)
    eps, size = np.finfo(given.mass.dtype).eps, of(given.stiffness)
    dust = 100 * len(root) * eps
    return bool(max(of(given.damping), of(given.gyroscopic)) <= dust * np.sqrt(size) and of(given.circulatory) <= dust * size)


def damping_ratios(values: Array) -> Array:
    """−Re λ/|λ|, and 0 for λ = 0."""
    size = _size(values)
    return 0 - values.real / jnp.where(size > 0, size, 1)


def normalised(vectors: Array, shapes: Array, mass: Array | None) -> Array:
    """Eigenvectors as columns, scaled so that the largest entry of each shape is 1, or positive with q̂ᴴ M q̂ = 1."""
    at = jnp.argmax(jnp.abs(shapes) >= (1 - 1e-6) * jnp.max(jnp.abs(shapes), axis=0, keepdims=True, initial=0.0), axis=0)
    largest = jnp.take_along_axis(shapes, at[None, :], axis=0)
    largest = jnp.where(largest == 0, 1, largest)  # a mode of the states alone
    if mass is None:
        return vectors / largest
    energy = jnp.einsum("ij,ik,kj->j", shapes.conj(), mass, shapes).real
    return vectors * jnp.abs(largest) / (largest * jnp.sqrt(jnp.where(energy > 0, energy, 1))[None, :])
