"""The motion of eigenvalues with a parameter, and the values at which the system becomes unstable."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, PyTree

from .._model.injection import call
from .._model.numbers import number, numbers, refuse_nan
from .._model.paths import leaf_names
from .._model.state_values import given_states, sampled
from .._model.system import System
from .._model.validation import coordinates, parameters, state
from .._program.jit import compiled, is_concrete, seen
from .branches import Spectrum, Transition, finer, followed
from .crossing import Crossing, located, moving
from .eigenvalues import eigen, rounding
from .equilibrium import equilibrium, steady
from .linear_system import LinearSystem
from .linearise import linearise
from .matrices import Choice, Matrices, matrices
from .not_differentiated import without_derivative
from .zero_eigenvalues import Core


class RootLocus(eqx.Module):
    """Eigenvalues `over` a parameter: `eigenvalues[k, i]` of branch i at `values[k]`, and the `crossings` in their order; `units` of the
    system.
    """

    over: str = eqx.field(static=True)
    values: Float[Array, " k"]
    eigenvalues: Complex[Array, "k d"]
    crossings: tuple[Crossing, ...]
    units: tuple[tuple[str, str], ...] = eqx.field(static=True, default=())

    def __repr__(self) -> str:
        head = f"RootLocus of {self.eigenvalues.shape[1]} eigenvalues over {self.over} = {self.values[0]:g} … {self.values[-1]:g}"
        if not is_concrete(self):
            return head
        rate = f"rad/{dict(self.units).get('t', 's')}"
        lines = [
            f"  {self.over} = {float(c.value):.8g}: {c.kind} {c.direction}" + (f", {c.frequency:.5g} {rate}" if c.frequency else "")
            for c in self.crossings
        ]
        return "\n".join([head, *(lines or ["  no branch crosses the imaginary axis"])])


def root_locus(
    system: System,
    q: Any,
    qdot: Any = None,
    params: PyTree = None,
    *,
    over: str,
    values: Any,
    t: Any = 0.0,
    states: PyTree = None,
) -> RootLocus:
    r"""Eigenvalues of the motion near a steady state, over a parameter, and the values at which it becomes unstable or stable.

    $$ \det(\lambda - A(p)) = 0, \qquad \mathrm{Re}\,\lambda(p^*) = 0, \qquad
       \mathrm dp^* = -\frac{\mathrm{Re}\,(y^H\,\mathrm dA\,x/y^H x)}{\mathrm{Re}\,(y^H A' x/y^H x)} $$

    Branches are followed by their eigenvectors, so that they do not swap where they cross. A crossing is located to rounding; a branch that
    crosses and returns within an eighth of a step is not seen.

    **Arguments:** `q`, `qdot`: the steady state as functions of `params` and its entries, e.g. `qdot=lambda v, r: {"x": v, "phi": v / r}`;
    or a guess, from which `equilibrium` or `steady` finds it at each value, which takes longer. `over`: the name of a number in `params`;
    `values`: increasing, at least two. `t`, `states` as for `acceleration`. Any consistent units.

    **Returns:** a `RootLocus`. The `value` of a crossing is differentiable once in `params`; the derivative of `eigenvalues` is NaN:
    differentiate `linearise` instead.

    **Raises:** `ValueError` if a state is not steady, `over` names no number, or the system has sampled states.

    **Source:** Bolotin, Nonconservative Problems of the Theory of Elastic Stability (flutter, divergence); Seyranian & Mailybaev,
    Multiparameter Stability Theory with Mechanical Applications, sections 2.4 and 2.9 (derivatives, also where eigenvalues meet).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    bead = jl.System(  # on a hoop that rotates with w
        lambda q, qdot, R, g, w: 0.5 * R**2 * (qdot**2 + (jnp.sin(q) * w) ** 2) + g * R * jnp.cos(q)
    )
    locus = jl.root_locus(bead, 0.0, params={"R": 1.0, "g": 9.81, "w": 0.0}, over="w", values=jnp.linspace(0.0, 5.0, 11))
    locus.crossings[0].value  # √(g/R) = 3.132
    ```
    """
    values = np.asarray(numbers(values, "`values`"))
    if values.ndim != 1 or len(values) < 2 or not np.all(np.diff(values) > 0):
        raise ValueError("`values` must be a list of at least two numbers that increase, but is not. Write e.g. `jnp.linspace(0, 10, 21)`.")
    if sampled(system):
        raise ValueError("`system` must have no sampled states, but has. Linearise it at each value: its eigenvalues are those of a step.")
    family = _Family(system, q, qdot, params, over, t, states, float(values[0]))
    known = seen(family.params)
    matrix = functools.cache(lambda at: np.asarray(family.matrix(at, known)))
    grid = [matrix(at) for at in finer(values)]
    core = Core.of(grid)
    shown, transitions = followed(lambda at: _spectrum(at, *core.without_zeros(matrix(at))), values)
    family.refuse_unsteady(float(values[-1]), known)
    crossings = [_crossing(family, matrix, core, transition) for transition in transitions]
    eigenvalues = np.stack([at.values for at in shown])
    eigenvalues = np.concatenate([eigenvalues, np.zeros((len(values), len(grid[0]) - eigenvalues.shape[1]))], axis=1)
    eigenvalues = without_derivative(jnp.asarray(eigenvalues), family.params)
    return RootLocus(over, jnp.asarray(values), eigenvalues, tuple(crossings), system.units)


class _Family:
    """A steady state and its linear system as functions of a parameter."""

    def __init__(self, system: System, q: Any, qdot: Any, params: PyTree, over: str, t: Any, states: PyTree, first: float):
        self.system, self.q, self.qdot, self.over = system, q, qdot, over
        like = q if not callable(q) else call(q, "`q`", params, t=0.0)
        like = coordinates(like, "q")
        self.t = number(t, "`t`", jax.tree.leaves(like)[0].dtype, cure="Pass one time.")
        self.params, self.states = parameters(params, like), given_states(system, states, like)
        if not is_concrete(jax.lax.stop_gradient((self.params, self.states, self.t))):
            raise ValueError(
                "`params` must be known to follow branches, but are hidden by `jit` or one set of many under `vmap`. "
                "Call `root_locus` from Python, for one set after the other."
            )
        names = leaf_names(self.params, "params")
        if over not in names or np.shape(jax.tree.leaves(self.params)[names.index(over)]):
            raise ValueError(f"`over` must name one number of `params`, but is {over!r}. The entries are {', '.join(names)}.")
        self.index = names.index(over)
        refuse_nan(self.at(first, self.params))
        self.steady: dict[float, Any] = {}  # states that were found, from which others start
        self.choice = Choice((), None, self._linearised(first, seen(self.params)).coordinates.partition, 0)
        self.closed = np.asarray(self._matrices(first, seen(self.params)).closed)

    def at(self, value: Any, params: PyTree) -> PyTree:
        """`params` with this value."""
        leaves, structure = jax.tree.flatten(params)
        leaves[self.index] = jnp.asarray(value, leaves[self.index].dtype)
        return jax.tree.unflatten(structure, leaves)

    def matrix(self, value: Any, params: PyTree) -> Float[Array, "d d"]:
        """A."""
        found = self._matrices(value, params)
        if is_concrete(found.closed) and np.any(np.asarray(found.closed) != self.closed):
            raise ValueError(
                f"`values` must be those at which contacts stay open or closed, but at {self.over} = {float(value):g} one changes. "
                "Follow the branches up to there, and from there on."
            )
        return found.rates.by_state

    def _matrices(self, value: Any, params: PyTree) -> Matrices:
        return matrices(self.choice, self.system, self.t, *self.state(value, params))

    def state(self, value: Any, params: PyTree) -> tuple[PyTree, PyTree, PyTree, PyTree]:
        """The arguments of A: q, q̇, `params` and the first-order states."""
        moved = self.at(value, params)
        if callable(self.q) or callable(self.qdot):
            return *given_state(self.q, self.qdot, self.t, moved), moved, self.states
        found = self._found(value, params)
        return found.q, found.qdot, moved, found.states

    def refuse_unsteady(self, value: float, params: PyTree) -> None:
        """Raises if the state is not steady at this value."""
        self._linearised(value, params)

    def _linearised(self, value: Any, params: PyTree) -> LinearSystem:
        params = self.at(value, params)
        if callable(self.q) or callable(self.qdot):
            q, qdot = given_state(self.q, self.qdot, self.t, params)
            return linearise(self.system, q, qdot, params, t=self.t, states=self.states)
        return linearise(self.system, self._found(value, params), params=params)

    def _found(self, value, params):
        params = self.at(value, params)
        near = self.steady[min(self.steady, key=lambda known: abs(known - value))] if self.steady else None
        q, qdot = (self.q, self.qdot) if near is None else (near.q, near.qdot)
        if self.qdot is None:
            found = equilibrium(self.system, q, params, t=self.t, states=self.states)
        else:
            found = steady(self.system, q, qdot, params, t=self.t, states=self.states)
        if is_concrete(found):
            self.steady[value] = found
        return found


def given_state(q: Any, qdot: Any, t: Any, params: PyTree) -> tuple[PyTree, PyTree]:
    """The steady state that functions give."""
    q, qdot = (call(of, f"`{name}`", params, t=t) if callable(of) else of for of, name in ((q, "q"), (qdot, "qdot")))
    return state(q, jax.tree.map(lambda x: 0.0 * jnp.asarray(x), q) if qdot is None else qdot)


def _spectrum(at: float, A: np.ndarray, basis: np.ndarray) -> Spectrum:
    """The spectrum of a matrix that is written in the coordinates of `basis`."""
    values, vectors, bound = map(np.asarray, eigen_and_rounding(A)) if A.size else (np.zeros(0, complex), A + 0j, np.zeros(0))
    return Spectrum(at, values, basis @ vectors, bound)


@compiled
def eigen_and_rounding(A: Float[Array, "d d"]) -> tuple[Array, Array, Array]:
    """Eigenvalues, eigenvectors as columns, and the rounding error of each eigenvalue."""
    values, vectors = eigen(A)
    return values, vectors, rounding(A, vectors)


def _crossing(family: _Family, matrix: Callable, core: Core, transition: Transition) -> Crossing:
    """A transition, with its derivative in `params`."""
    comes_to_zero = abs(transition.eigenvalue.imag) <= 10 * transition.spectrum.rounding[transition.which]
    at, value = transition.at, transition.eigenvalue
    if not (core.zeros and comes_to_zero):
        at, value = located(lambda at: core.taken(matrix(at)), transition)
    point = jnp.asarray(at)
    if not is_concrete(family.params):
        if core.zeros and comes_to_zero:
            raise ValueError(
                f"`params` must not be differentiated at {family.over} = {at:g}, but are: an eigenvalue comes to zero there beside others "
                "that are always zero. Take differences."
            )
        A, known = np.asarray(matrix(at)), seen(family.params)
        state = lambda value: family.state(value, known)
        point = moving(point, A, core, value, (family.choice, family.system, family.t), state, family.state(at, family.params))
    direction = "destabilises" if transition.grows else "stabilises"
    kind, frequency = ("divergence", 0.0) if comes_to_zero else ("flutter", float(abs(value.imag)))
    return Crossing(point, frequency, kind, direction)
