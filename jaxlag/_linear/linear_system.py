"""A linear system in state space: its eigenvalues, modes and responses."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, PyTree

from .._model.numbers import number, numbers
from .._model.state_values import Layout
from .._program.jit import compiled, is_concrete
from .eigenvalues import eigen
from .modes import (
    Modes,
    SecondOrder,
    damping_ratios,
    is_conservative,
    normalised,
    of_first_order,
    of_second_order,
    undamped,
    with_derivatives_of,
)
from .origin import Origin
from .response import Bode, bode, free_motion, frequencies, frequency_response, held, in_discrete_steps, spectral_density, zeros
from .tangent_space import Partition


class Coordinates(eqx.Module):
    """The map from vectors of a linear system to vectors of the original system."""

    partition: Partition = eqx.field(static=True)
    q: Layout = eqx.field(static=True)
    states: Layout = eqx.field(static=True)
    multipliers: Layout = eqx.field(static=True)


class LinearSystem(eqx.Module):
    r"""The motion near a state, from `linearise`:  ẋ = A x + B u,  y = C x + D u + D₁ u̇ + D₂ ü,  δ(q, q̇, z) = T x.

    In discrete time, x(k + 1) = A x(k) + B u(k), with u held over each `sample_time`. Along a `Trajectory` all arrays have the samples
    as first axis.

    - `A`, `B`, `C`, `D`; `D_rates`: D₁ and D₂, zero unless an input moves a constraint and the outputs include rates or forces.
    - `basis`: T, if inputs move no constraint; q is flat in the order of `jax.flatten_util.ravel_pytree`. `constraint_forces`: Λ, with δλ =
      Λ x. `mass`: M. `coordinates`: which entries of q are independent.
    - `state_names`, `input_names`, `output_names`: one for each number; `phi_dot` is the velocity of `phi`.
    - `q`, `qdot`: the state, structured as given; `origin`: the same, with time and params; None along a trajectory.
    - `sample_time`: None in continuous time.
    - `second_order`: the matrices M, C, G, K, N of a system of second order; None with first-order states, nonholonomic constraints or
      sticking friction.

    ```python
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, m, c: 0.5 * m * qdot**2 - 0.5 * c * q**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2)
    lin = jl.linearise(oscillator, 0.0, params={"m": 2.0, "c": 8.0, "b": 0.4}, inputs=["q"])
    lin.modes().angular_frequency  # 2.0
    lin.modes().damping_ratio  # 0.05
    lin.bode([2.0]).magnitude  # 1/(b ω) = 1.25
    ```
    """

    A: Float[Array, "*t d d"]
    B: Float[Array, "*t d m"]
    C: Float[Array, "*t p d"]
    D: Float[Array, "*t p m"]
    D_rates: Float[Array, "*t 2 p m"]
    basis: Float[Array, "*t y d"]
    constraint_forces: Float[Array, "*t l d"]  # λ = Λ x
    mass: Float[Array, "*t n n"]
    q: PyTree
    qdot: PyTree
    origin: Origin | None
    sample_time: Any
    state_names: tuple[str, ...] = eqx.field(static=True)
    input_names: tuple[str, ...] = eqx.field(static=True)
    output_names: tuple[str, ...] = eqx.field(static=True)
    coordinates: Coordinates = eqx.field(static=True)

    @property
    def eigenvalues(self) -> Complex[Array, "*t d"]:
        """Eigenvalues of A, sorted by size; in discrete time the multipliers of a step. Differentiable; of repeated ones, their mean is."""
        return _eigenvalues(self.A)

    @property
    def second_order(self) -> SecondOrder | None:
        """M ξ̈ + (C + G) ξ̇ + (K + N) ξ = … of a purely mechanical system."""
        at = self.coordinates.partition
        k, n = len(at.positions), self.coordinates.q.size
        if self.sample_time is not None or at.positions != at.velocities or len(self.state_names) != 2 * k:
            return None
        free = self.basis[..., n : 2 * n, k:]
        mass = _transposed(free) @ self.mass @ free
        damping, stiffness = -mass @ self.A[..., k:, k:], -mass @ self.A[..., k:, :k]
        return SecondOrder(mass, *_halves(damping), *_halves(stiffness))

    def modes(self, normalise: str = "largest") -> Modes:
        """The `Modes`; their shapes scaled to a largest entry of 1, or with `normalise="mass"` to q̂ᴴ M q̂ = 1."""
        if normalise not in ("largest", "mass"):
            raise ValueError(f"`normalise` must be 'largest' or 'mass', but is {normalise!r}. Take one of the two.")
        if self.A.ndim > 2:
            return jax.vmap(lambda system: system.modes(normalise))(self)
        order = self.second_order
        conservative = order is not None and is_conservative(order)
        found = of_second_order(order) if conservative else of_first_order(self.A, self.sample_time)
        n, mass = self.coordinates.q.size, self.mass if normalise == "mass" else None
        scaled = lambda found: found._replace(vectors=normalised(found.vectors, self.basis[:n, : len(found.vectors)] @ found.vectors, mass))
        found = scaled(found)
        if conservative and not is_concrete(order):  # differentiated, also with respect to damping, gyroscopic and circulatory terms
            found = with_derivatives_of(found, scaled(undamped(of_first_order(self.A, None))))
        d, vectors = len(found.vectors), found.vectors
        q, z, forces = self.basis[:n, :d] @ vectors, self.basis[2 * n :, :d] @ vectors, self.constraint_forces[:, :d] @ vectors
        shaped = lambda layout, columns: jax.vmap(lambda x: _unravelled(layout, x))(columns.T)
        at = self.coordinates
        of = shaped(at.q, q), shaped(at.multipliers, forces), shaped(at.states, z)
        return Modes(found.values, damping_ratios(found.values), found.stable, found.repeated, *of, self.origin)

    def frequency_response(self, omega: Any) -> Complex[Array, "w p m"]:
        """G(iω) from the inputs to the outputs at the angular frequencies `omega`, rad/time, 0 or more: (len(omega), outputs, inputs)."""
        A, B, C, D = self._matrices
        return frequency_response(A, B, C, D, frequencies(omega), self.sample_time)

    def bode(self, omega: Any) -> Bode:
        """`Bode(magnitude, phase)` of the response at angular frequencies `omega`, the phase in degrees and without jumps."""
        return bode(self.frequency_response(omega))

    def power_spectrum(self, omega: Any, density: Any) -> Complex[Array, "w p p"]:
        """Spectral density of the outputs, G S Gᴴ, under inputs of the spectral `density` S: a number (white noise in each input), a
        matrix, or one of these for each of `omega`, as measured. It has the convention of S: two-sided and per rad/time, or one-sided and
        per Hz.
        """
        response = self.frequency_response(omega)
        S = spectral_density(density, len(response), response.shape[-1])
        return response @ S @ _transposed(response.conj())

    def step_response(self, ts: Any) -> Float[Array, "t p m"]:
        """Outputs at the times `ts` (0 or later, increasing) after each input has become 1 at t = 0, from rest."""
        A, B, C, D = self._matrices
        self._refuse_rates("the response to a step")
        if self.sample_time is not None:
            return in_discrete_steps(A, B, C, D[0], self._steps(ts), jnp.zeros_like(B))
        d, m = B.shape
        both = jnp.block([[A, B], [jnp.zeros((m, d + m), A.dtype)]])
        after = free_motion(both, jnp.concatenate([jnp.zeros_like(B), jnp.eye(m)]), _times(ts))[:, :d]
        return jnp.einsum("pd,tdm->tpm", C, after) + D[:1]

    def impulse_response(self, ts: Any) -> Float[Array, "t p m"]:
        """Outputs at the times `ts` after a unit impulse of each input at t = 0; without the impulse that D passes on. In discrete time,
        after an input that is 1 only at the first sample.
        """
        A, B, C, D = self._matrices
        self._refuse_rates("the response to an impulse")
        if self.sample_time is not None:
            steps = self._steps(ts)
            after = in_discrete_steps(A, 0 * B, C, 0 * D[0], np.maximum(steps - 1, 0), B)
            return jnp.where((steps == 0)[:, None, None], D[:1], after)
        return jnp.einsum("pd,tdm->tpm", C, free_motion(A, B, _times(ts)))

    def transfer_zeros(self) -> np.ndarray:
        """Invariant zeros, where the transfer matrix loses rank; as NumPy numbers, not differentiable."""
        A, B, C, D = self._matrices
        if not is_concrete(self):
            raise TypeError(
                "`transfer_zeros` must be called with known numbers, but is traced. Call it outside of `jit`, `grad` and `vmap`."
            )
        self._refuse_rates("`transfer_zeros`")
        return zeros(A, B, C, D[0])

    def discrete(self, sample_time: Any) -> "LinearSystem":
        """The same system in discrete time, exact for inputs held over each `sample_time`; of many systems, each."""
        if self.sample_time is not None:
            raise ValueError("`discrete` must start from continuous time, but this system is in discrete time already. Linearise it anew.")
        self._refuse_rates("`discrete`")
        T = number(sample_time, "`sample_time`", self.A.dtype, positive=True, cure="Give the time between two samples.")
        if self.A.ndim > 2:
            return jax.vmap(lambda system: system.discrete(T))(self)
        A, B = held(self.A, self.B, T)
        return eqx.tree_at(lambda s: (s.A, s.B, s.sample_time), self, (A, B, T), is_leaf=lambda x: x is None)

    def to_scipy(self) -> Any:
        """As `scipy.signal.StateSpace`."""
        from scipy.signal import StateSpace

        return StateSpace(*self._numbers(), **({} if self.sample_time is None else {"dt": float(self.sample_time)}))

    def to_control(self) -> Any:
        """As `control.StateSpace` of the package python-control, with the names of states, inputs and outputs."""
        import control

        names = dict(states=list(self.state_names), inputs=list(self.input_names), outputs=list(self.output_names))
        return control.StateSpace(*self._numbers(), 0 if self.sample_time is None else float(self.sample_time), **names)

    def __repr__(self) -> str:
        return card(self)

    @property
    def _matrices(self):
        if self.A.ndim > 2:
            raise ValueError("a response or state space is that of one linear system, but these are many. Take one, or use `jax.vmap`.")
        return self.A, self.B, self.C, jnp.concatenate([self.D[None], self.D_rates])

    def _numbers(self):
        A, B, C, D = self._matrices
        self._refuse_rates("a state space")
        return tuple(map(np.asarray, (A, B, C, D[0])))

    def _refuse_rates(self, what):
        if is_concrete(self.D_rates) and np.any(np.asarray(self.D_rates)):
            raise ValueError(
                f"{what} must not need u̇, but an output sees the velocity or acceleration of an input that moves a constraint. "
                "Take `frequency_response`, or see positions alone."
            )

    def _steps(self, ts):
        ts = _times(ts)
        if not is_concrete((ts, self.sample_time)) or not len(ts):
            raise ValueError(
                "`ts` must hold known times, one or more, but is empty, or hidden by `jit`, or the sample time is. Call it outside."
            )
        steps = np.asarray(ts) / np.asarray(self.sample_time)
        if np.any(np.abs(steps - np.round(steps)) > 1e-6):
            raise ValueError("`ts` must be multiples of the sample time, but are not. In discrete time there is nothing in between.")
        return np.round(steps).astype(int)


def _times(ts):
    ts = numbers(ts, "`ts`")
    if ts.ndim != 1 or (is_concrete(ts) and not (np.all(np.asarray(ts) >= 0) and np.all(np.diff(ts) >= 0))):
        raise ValueError("`ts` must be a list of times from 0 on, increasing, but is not. Count time from the step.")
    return ts


def _transposed(x):
    return jnp.swapaxes(x, -1, -2)


def _halves(x):
    """The symmetric and the antisymmetric part."""
    return (x + _transposed(x)) / 2, (x - _transposed(x)) / 2


@compiled
def _eigenvalues(A):
    """Eigenvalues of a matrix, or of each in a batch."""
    of = lambda A: eigen(A).values
    for _ in range(A.ndim - 2):
        of = jax.vmap(of)
    return of(A)


def _unravelled(layout, x):
    """A pytree of the given layout, with numbers that may be complex."""
    sizes = [int(np.prod(shape)) for shape, _ in layout.leaves]
    parts = jnp.split(x, np.cumsum(sizes)[:-1]) if sizes else []
    return jax.tree.unflatten(layout.structure, [part.reshape(shape) for part, (shape, _) in zip(parts, layout.leaves, strict=True)])


def card(system: LinearSystem) -> str:
    """A linear system in a few lines."""
    kind = "" if system.sample_time is None else ", in discrete time"
    lines = [f"LinearSystem of {len(system.state_names)} states{kind}"]
    rows = [("states", system.state_names), ("inputs", system.input_names), ("outputs", system.output_names)]
    lines += [f"  {name:<12}{', '.join(entries) or 'none'}" for name, entries in rows]
    if is_concrete(system) and system.A.ndim == 2:
        lines += ["  eigenvalues " + ", ".join(_number(x) for x in np.asarray(system.eigenvalues) if x.imag >= 0)]
    return "\n".join(lines)


def _number(x):
    return f"{x.real:.5g}" + (f" ± {x.imag:.5g}i" if x.imag else "")
