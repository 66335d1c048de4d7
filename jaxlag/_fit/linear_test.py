"""Tests of the motion near a steady state, by modes or by the frequency response: what they share, and how a fit predicts them."""

import abc
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from .._linear.equilibrium import equilibrium, steady
from .._linear.linear_system import LinearSystem
from .._linear.linearise import linearise
from .._linear.rest import Search, steady_state
from .._model.injection import check_function
from .._model.paths import entry_names, is_within, listed
from .._model.system import System
from .._model.validation import coordinates, parameters, state
from .._program.jit import compiled
from .experiment import with_own
from .measurement import Prepared, Test


class LinearTest(Test):
    """What was measured near a steady state: `values`, real or complex, and `sigma` of each, of complex ones that of either part."""

    q: PyTree
    qdot: PyTree
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
        self.inputs, self.fixed, self.fixed_rates = map(listed, (inputs, fixed, fixed_rates))

    def prepared(self, system: System, params: PyTree) -> "PreparedTest":
        """The test near the steady state at `params`."""
        return PreparedTest.of(system, self, params)

    @abc.abstractmethod
    def predicted(self, near: LinearSystem) -> PyTree:
        """What the test should have shown of a linear system; structured like `values`."""

    @abc.abstractmethod
    def refuse_misfit(self, near: LinearSystem) -> None:
        """Raises where what was measured cannot be of this linear system."""


class PreparedTest(Prepared):
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

    def linear(self, system: System, params: PyTree) -> LinearSystem:
        """The linear system at other parameters, near the steady state there; NaN where there is none."""
        own, t = with_own(params, self.test.params), jnp.zeros((), jax.tree.leaves(self.near.q)[0].dtype)
        at = steady_state(self.search, system, t, self.near.q, self.near.qdot, own, self.states)
        return linearise(system, at, params=own, inputs=self.test.inputs, outputs=self.test.observe, independent=self.near)

    def predictions(self, system: System, params: PyTree) -> PyTree:
        """What the test should have shown."""
        return self.test.predicted(self.linear(system, params))


@compiled
def linear_at(part: PreparedTest, system: System, params: PyTree) -> LinearSystem:
    """`PreparedTest.linear`, compiled."""
    return part.linear(system, params)
