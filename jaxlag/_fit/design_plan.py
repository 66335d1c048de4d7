"""Planned measurements as functions of what is chosen of them: the information they give, and what limits say along the motion."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._mechanics.consistent_state import consistent_state
from .._model.injection import call
from .._model.paths import is_within, leaf_names
from .._motion.simulate import simulate
from .._program.jit import compiled
from .arrow import Arrow, whole
from .experiment import Experiment, with_own
from .experiment_batch import ExperimentBatch
from .frequency_response_test import FrequencyResponseTest
from .measurement import Test
from .parameters import Free
from .problem import LeastSquaresProblem, with_expected_zeros
from .residuals import Model

START, FREQUENCIES = ("q0", "qdot0", "ts"), ("omega",)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Planned:
    """One measurement: the least-squares problem of it alone, and what is chosen of it, as a function of y, which is zero in the plan;
    `beside`: what may be chosen beside its own params.
    """

    problem: LeastSquaresProblem
    chosen: Free
    beside: tuple[str, ...] = dataclasses.field(metadata={"static": True})

    @classmethod
    def of(
        cls, model: Model, free: Free, plan: Experiment | Test, params: PyTree, over: Sequence[str], bounds: Mapping[str, Any]
    ) -> "Planned":
        """With the entries of `plan`, or of `params`, that `over` names and the plan has."""
        tree = entries_of(plan, params, over)
        names = leaf_names(tree)
        here = [name for name in over if any(is_within(leaf, name) for leaf in names)]
        beside = beside_params(plan)
        own = {name: tree[name] for name in tree if name not in beside}
        plan = eqx.tree_at(lambda e: e.params, plan, own, is_leaf=lambda x: x is plan.params)
        if isinstance(plan, Experiment):
            plan = with_expected_zeros(model, free, plan)
            problem = LeastSquaresProblem.of(model, free, [plan])
            ends: dict[str, Any] = {"ts": (float(plan.ts[0]), float(plan.ts[-1]))} if "ts" in here else {}
        else:
            problem, ends = LeastSquaresProblem.of(model, free, [], [plan]), {"omega": (0.0, None)} if beside else {}
        within = {name: pair for name, pair in (ends | dict(bounds)).items() if any(is_within(name, one) for one in here)}
        chosen = Free.of(tree, here, within)
        return cls(problem, dataclasses.replace(chosen, scale=_sizes(chosen)), beside)

    @property
    def size(self) -> int:
        """How many numbers are chosen."""
        return self.chosen.size

    @property
    def batch(self) -> ExperimentBatch | None:
        """The recording, a batch of one."""
        return self.problem.batches[0] if self.problem.batches else None

    def entries(self, y: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        """What the measurement is made of: its own params, and what stands beside them."""
        entries = self.chosen.insert(self.chosen.theta(y))
        return {name: x for name, x in entries.items() if name not in self.beside}, {name: entries[name] for name in self.beside}

    def placed(self, y: Any) -> LeastSquaresProblem:
        """The problem of the measurement that is chosen."""
        own, beside = self.entries(y)
        if self.batch is None:
            (test,) = self.problem.tests
            test = eqx.tree_at(lambda part: part.test.params, test, own, is_leaf=lambda x: x is test.test.params)
            if self.beside:
                test = eqx.tree_at(lambda part: part.test.omega, test, beside["omega"])
            return dataclasses.replace(self.problem, tests=(test,))
        one = lambda tree: jax.tree.map(lambda x: x[None] if eqx.is_array(x) else x, tree)
        ts = jnp.concatenate([self.batch.ts[0, :1], beside["ts"]])
        batch = dataclasses.replace(
            self.batch, ts=ts[None], q0=one(beside["q0"]), qdot0=one(beside["qdot0"]), params=self.batch.params | one(own)
        )
        return dataclasses.replace(self.problem, batches=(batch,))

    def measurement(self, plan: Experiment | Test, y: Any) -> Any:
        """The plan to carry out, whose start is on the constraints."""
        own, beside = self.entries(jnp.asarray(y))
        if self.batch is None:
            plan = eqx.tree_at(lambda e: e.params, plan, own, is_leaf=lambda x: x is plan.params)
            return eqx.tree_at(lambda e: e.omega, plan, np.asarray(beside["omega"])) if self.beside else plan
        ts = np.concatenate([np.asarray(plan.ts)[:1], beside["ts"]])
        q0, qdot0 = beside["q0"], beside["qdot0"]
        if self.problem.model.system.constraints:
            q0, qdot0 = self._on_constraints(own, beside)
        of_plan = lambda e: (e.ts, e.q0, e.qdot0, e.params)
        parts = of_plan(plan)
        return eqx.tree_at(of_plan, plan, (ts, q0, qdot0, own), is_leaf=lambda x: any(x is part for part in parts))

    def settled(self, y: np.ndarray) -> np.ndarray:
        """With a start that is on the constraints, as far as it is chosen."""
        system = self.problem.model.system
        if not (system.constraints and self.batch and any(is_within(entry, which) for entry in self.chosen.entries for which in START[:2])):
            return y
        own, beside = self.entries(jnp.asarray(y))
        q0, qdot0 = self._on_constraints(own, beside)
        leaves = jax.tree.leaves(own | beside | {"q0": q0, "qdot0": qdot0})
        theta = np.concatenate([np.ravel(leaves[i]) for i in self.chosen.leaves])
        return (theta - np.asarray(self.chosen.start)) / np.asarray(self.chosen.scale)

    def in_order(self, y: np.ndarray) -> np.ndarray:
        """With times that increase."""
        at = [i for i, entry in enumerate(self.chosen.entries) if is_within(entry, "ts")]
        start, scale, y = np.asarray(self.chosen.start)[at], np.asarray(self.chosen.scale)[at], y.copy()
        y[at] = (np.sort(start + scale * y[at]) - start) / scale
        return y

    def _on_constraints(self, own: dict[str, Any], beside: dict[str, Any]) -> tuple[PyTree, PyTree]:
        assert self.batch is not None
        params = with_own(self.problem.free.params, own)
        return consistent_state(self.problem.model.system, beside["q0"], beside["qdot0"], params, t=self.batch.ts[0, 0])

    def pauses(self) -> tuple[np.ndarray, np.ndarray]:
        """Where times are chosen, those between them over the whole time, an affine function of y: its slopes, and its value at zero."""
        names = np.array([is_within(entry, "ts") for entry in self.chosen.entries], bool)
        at, start = np.flatnonzero(names), np.asarray(self.chosen.start)
        if at.size < 2:
            return np.zeros((0, self.size)), np.zeros(0)
        slopes = np.zeros((at.size - 1, self.size))
        rows, scale = np.arange(at.size - 1), np.asarray(self.chosen.scale)
        slopes[rows, at[1:]], slopes[rows, at[:-1]] = scale[at[1:]], -scale[at[:-1]]
        long = scale[at[0]]
        return slopes / long, np.diff(start[at]) / long


@compiled
def informed(part: Planned, y: Float[Array, " m"]) -> tuple[Float[Array, "x x"], Float[Array, "x x m"]]:
    """JᵀJ of all unknowns of a measurement, and its derivatives by y; NaN where there is no motion."""

    def of(y):
        found = part.placed(y).linearise(jnp.zeros(part.problem.size))
        J = whole(found.jacobian) if isinstance(found.jacobian, Arrow) else found.jacobian
        F = jnp.where(jnp.all(jnp.isfinite(found.residuals)), J.T @ J, jnp.nan)
        return F, F

    dF, F = jax.jacfwd(of, has_aux=True)(y)
    return F, dF


@compiled
def along_the_motion(part: Planned, y: Float[Array, " m"], functions: tuple[tuple[str, Callable], ...], shares: Any) -> tuple[Any, Any]:
    """What each function says at shares of the time, by name (S, ...), and its derivatives by y; NaN where there is no motion."""
    model = part.problem.model

    def of(y):
        own, beside = part.entries(y)
        params = with_own(part.problem.free.params, own)
        assert part.batch is not None
        begin, end = part.batch.ts[0, 0], jnp.concatenate([part.batch.ts[0, :1], beside["ts"]])[-1]
        ts = begin + (end - begin) * jnp.asarray(shares, part.batch.ts.dtype)
        motion = simulate(model.system, beside["q0"], beside["qdot0"], ts, params, **{**dict(model.numerics), "throw": False})

        def said(t, q, qdot, qddot, multipliers, states):
            state = dict(t=t, q=q, qdot=qdot, qddot=qddot, multipliers=multipliers)
            of_one = lambda name, function: jnp.ravel(jnp.asarray(call(function, f"`within[{name!r}]`", params, **state, **states)))
            return {name: of_one(name, function) for name, function in functions}

        values = jax.vmap(said)(motion.ts, motion.q, motion.qdot, motion.qddot, motion.multipliers, motion.states)
        return values, values

    slopes, values = jax.jacfwd(of, has_aux=True)(y)
    return values, slopes


def of_parameters(F: np.ndarray, dF: np.ndarray, p: int) -> tuple[np.ndarray, np.ndarray]:
    """What is left for the first p numbers where the others are unknown too: the Schur complement, and its derivatives."""
    if F.shape[0] == p:
        return F, dF
    if not np.all(np.isfinite(F)):
        return F[:p, :p], dF[:p, :p]
    T = np.hstack([np.eye(p), -F[:p, p:] @ np.linalg.pinv(F[p:, p:], hermitian=True)])
    return T @ F @ T.T, np.einsum("ai,ijm,bj->abm", T, dF, T)


def beside_params(plan: Experiment | Test) -> tuple[str, ...]:
    """What can be chosen of a measurement beside its own params."""
    return START if isinstance(plan, Experiment) else FREQUENCIES if isinstance(plan, FrequencyResponseTest) else ()


def entries_of(plan: Experiment | Test, params: PyTree, over: Sequence[str]) -> dict[str, Any]:
    """What can be chosen of a measurement: its own params, those of all that `over` names, its start and times, or its frequencies."""
    top = {name.split(".")[0].split("[")[0] for name in over}
    common = {name: params[name] for name in params if name in top} if isinstance(params, Mapping) else {}
    own = common | dict(plan.params)
    if clash := {*own} & {*beside_params(plan)}:
        raise ValueError(f"`params` must not have an entry {min(clash)!r} where that of the plan is meant, but has one. Rename it.")
    if isinstance(plan, Experiment):
        own |= {"q0": plan.q0, "qdot0": plan.qdot0, "ts": plan.ts[1:]}
    elif isinstance(plan, FrequencyResponseTest):
        own |= {"omega": plan.omega}
    return jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, np.ndarray) else x, own)


def _sizes(chosen: Free) -> np.ndarray:
    """Of the numbers that are chosen: of an array, of its largest number; where that is zero, of the width of the bounds; NaN where there
    are none.
    """
    leaves = jax.tree.leaves(chosen.params)
    sizes = np.concatenate([np.full(np.size(leaves[i]), np.max(np.abs(leaves[i]))) for i in chosen.leaves] or [np.zeros(0)])
    width = np.asarray(chosen.upper) - np.asarray(chosen.lower)
    times = np.array([is_within(entry, "ts") for entry in chosen.entries], bool)
    sizes = np.where(times, width, sizes)
    return np.where(sizes > 0, sizes, np.where(np.isfinite(width), width, np.nan))
