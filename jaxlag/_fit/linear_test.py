"""Tests of the motion near a steady state, by modes or by the frequency response: what they share, and how a fit predicts them."""

import abc
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from .._linear.equilibrium import equilibrium, steady
from .._linear.linear_system import LinearSystem
from .._linear.linearise import linearise
from .._linear.rest import Search, steady_state
from .._model.injection import check_function
from .._model.paths import entry_names, is_within
from .._model.system import System
from .._model.validation import coordinates, parameters, state
from .._program.jit import compiled
from .experiment import Experiment, with_own
from .parameters import Free


class LinearTest(eqx.Module):
    """What was measured near a steady state: `values`, real or complex, and `sigma` of each, of complex ones that of either part."""

    values: PyTree
    sigma: PyTree
    q: PyTree
    qdot: PyTree
    params: dict[str, Any]
    observe: Callable | None = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    fixed: tuple[str, ...] = eqx.field(static=True)
    fixed_rates: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        values: PyTree,
        sigma: PyTree,
        q: PyTree,
        qdot: PyTree,
        params: Mapping[str, Any] | None,
        observe: Callable | None,
        inputs: Sequence[str] = (),
        fixed: Sequence[str] = (),
        fixed_rates: Sequence[str] = (),
    ):
        self.values, self.sigma = values, sigma
        q = coordinates(q, "q")
        self.q, self.qdot = state(q, jax.tree.map(np.zeros_like, q) if qdot is None else qdot)
        if params is not None and not isinstance(params, Mapping):
            raise TypeError(f"`params` of a test must be a mapping, but is a {type(params).__name__}. Name its entries in a dict.")
        self.params = dict(parameters(params or {}, self.q))
        if observe is not None:
            check_function(observe, "`observe`")
        self.observe = observe
        self.inputs, self.fixed, self.fixed_rates = tuple(inputs), tuple(fixed), tuple(fixed_rates)

    @property
    def measurements(self) -> int:
        """How many real numbers were measured."""
        return sum(int(np.sum(np.isfinite(z))) * (2 if np.iscomplexobj(z) else 1) for z in jax.tree.leaves(self.values))

    @abc.abstractmethod
    def predicted(self, near: LinearSystem) -> PyTree:
        """What the test should have shown of a linear system; structured like `values`."""

    @abc.abstractmethod
    def labels(self, near: LinearSystem) -> list[str]:
        """A name for each channel: for what belongs together of `values`."""

    @abc.abstractmethod
    def refuse_misfit(self, near: LinearSystem) -> None:
        """Raises where what was measured cannot be of this linear system."""

    @abc.abstractmethod
    def doubts(self, near: LinearSystem) -> list[str]:
        """What is in doubt about how measured and predicted values belong together."""


class Evaluated(NamedTuple):
    """A test at given parameters: (predicted − measured)/sigma in real numbers, 0 where nothing was measured; Jacobian; predictions."""

    residuals: Any
    jacobian: Any
    predictions: PyTree


class PreparedTest(eqx.Module):
    """A test, and the linear system and the states of first order at the start, from which those at other parameters are found."""

    test: LinearTest
    near: LinearSystem
    states: dict[str, PyTree]
    search: Search = eqx.field(static=True)

    @classmethod
    def of(cls, system: System, test: LinearTest, params: PyTree) -> "PreparedTest":
        """The test near the steady state at `params`."""
        own = with_own(params, test.params)
        moving = np.flatnonzero(np.asarray(ravel_pytree(test.qdot)[0]))
        if moving.size:
            at = steady(system, test.q, test.qdot, own, fixed=test.fixed, fixed_rates=test.fixed_rates)
        else:
            at = equilibrium(system, test.q, own, fixed=test.fixed)
        near = linearise(system, at, params=own, inputs=test.inputs, outputs=test.observe)
        test.refuse_misfit(near)
        within = lambda names: [i for i, entry in enumerate(entry_names(test.q, "q")) if any(is_within(entry, name) for name in names)]
        running = tuple(int(i) for i in moving if i not in within(test.fixed_rates))
        held = any(np.any(np.asarray(force)) for force, _ in at.friction.values())
        return cls(test, near, at.states, Search(fixed=tuple(within(test.fixed)), running=running, held=held))

    @property
    def size(self) -> int:
        """The number of residuals."""
        return sum(np.size(z) * (2 if np.iscomplexobj(z) else 1) for z in jax.tree.leaves(self.test.values))

    def linear(self, system: System, params: PyTree) -> LinearSystem:
        """The linear system at other parameters, near the steady state there; NaN where there is none."""
        own, t = with_own(params, self.test.params), jnp.zeros((), jax.tree.leaves(self.near.q)[0].dtype)
        at = steady_state(self.search, system, t, self.near.q, self.near.qdot, own, self.states)
        return linearise(system, at, params=own, inputs=self.test.inputs, outputs=self.test.observe, independent=self.near)

    def evaluated(self, system: System, params: PyTree) -> tuple[Float[Array, " k"], PyTree]:
        """Residuals, infinite where there is no prediction, and predictions."""
        predictions = self.test.predicted(self.linear(system, params))
        weighted = jax.tree.map(_weighted, predictions, self.test.values, self.test.sigma)
        r = jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(weighted)])
        return jnp.where(jnp.all(jnp.isfinite(r)), r, jnp.inf), predictions

    def linearised(self, system: System, free: Free, y: Any) -> Evaluated:
        """With the Jacobian with respect to y of the free parameters."""

        def residuals(y):
            r, predictions = self.evaluated(system, free.insert(free.theta(y)))
            return r, (r, predictions)

        J, (r, predictions) = jax.jacfwd(residuals, has_aux=True)(y)
        finite = jnp.all(jnp.isfinite(r)) & jnp.all(jnp.isfinite(J))
        return Evaluated(jnp.where(finite, r, jnp.inf), jnp.where(finite, J, 0), predictions)


def _weighted(predicted, measured, sigma):
    there = jnp.isfinite(measured)
    r = jnp.where(there, (predicted - jnp.where(there, measured, 0)) / sigma, 0)
    return parts(r)


def parts(x: Any) -> Any:
    """Real numbers; of complex ones both parts, as a last axis."""
    return jnp.stack([x.real, x.imag], axis=-1) if jnp.iscomplexobj(x) else x


def deviations(test: LinearTest, found: Evaluated, covariance: np.ndarray) -> PyTree:
    """√(J cov Jᵀ) of the predictions; of complex ones those of both parts, as a complex number. NaN where nothing was measured."""
    if found.jacobian is None:
        return jax.tree.map(lambda z: np.full(z.shape, np.nan), test.values)
    J = np.asarray(found.jacobian)
    rows = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", J, covariance, J), 0))
    leaves, structure = jax.tree.flatten(test.values)
    ends = np.cumsum([z.size * (2 if np.iscomplexobj(z) else 1) for z in leaves])
    of_each = zip(np.split(rows, ends[:-1]), leaves, jax.tree.leaves(test.sigma), strict=True)
    return jax.tree.unflatten(structure, [_of_values(*one) for one in of_each])


def _of_values(rows, z, sigma):
    own = rows.reshape((*z.shape, 2)) @ [1, 1j] if np.iscomplexobj(z) else rows
    return np.where(np.isfinite(z), own * sigma, np.nan)


@compiled
def linear_at(part: PreparedTest, system: System, params: PyTree) -> LinearSystem:
    """`PreparedTest.linear`, compiled."""
    return part.linear(system, params)


def apart(experiments: Sequence[Any]) -> tuple[tuple[Experiment, ...], tuple[LinearTest, ...]]:
    """The recordings in time, and the tests."""
    recordings = tuple(e for e in experiments if isinstance(e, Experiment))
    return recordings, tuple(e for e in experiments if not isinstance(e, Experiment))


def in_given_order(experiments: Sequence[Any], of_recordings: Sequence[Any], of_tests: Sequence[Any]) -> list[Any]:
    """What there is of recordings and of tests, in the order of the experiments."""
    recordings, tests = iter(of_recordings), iter(of_tests)
    return [next(recordings if isinstance(e, Experiment) else tests) for e in experiments]
